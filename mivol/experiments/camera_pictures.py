"""Where the cameras or the scanner of a run stand, as two pictures of its page: from the side and from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
from numpy.typing import NDArray

from mivol.optim.scenes.views import View
from mivol.photos import PhotoFrame, Photos, PhotoSurvey
from mivol.report.cameras import PARTS, list_parts, plot_cameras
from mivol.report.record import Image
from mivol.report.scanner import plot_scanner, select_views
from mivol.scene.camera_rigs import find_media_box
from mivol.scene.sensors import to_camera
from mivol.tomography.geometry import FlatDetector, VoxelGrid

__all__ = ["pictures_of_photos", "pictures_of_scan", "pictures_of_views", "survey_of"]

CAPTIONS = {
    "side": "Where the cameras stand, and the box where matter may be",
    "plan": "The same from above",
    "far": "All nested boxes from above",
}


def pictures_of_photos(folder: Path, photos: Photos, judged: Photos | None, levels: int = 1) -> list[Image]:
    """Cameras of all photographs, those that judge among them, about their boxes.

    Args:
        folder: of the run, where the pictures are written.
        photos: what was fitted.
        judged: what it is judged by; None for nothing.
        levels: nested boxes that were fitted.
    """
    return _pictures(folder, survey_of(photos, judged, levels))


def survey_of(photos: Photos, judged: Photos | None, levels: int) -> PhotoSurvey:
    """What is drawn of a fit: the cameras of all its photographs, and so many nested boxes."""
    frames = photos.survey.frames + (() if judged is None else judged.survey.frames)
    return replace(photos.survey, frames=frames, levels=levels)


def pictures_of_views(folder: Path, scene: mi.Scene, views: Mapping[str, Sequence[View]]) -> list[Image]:
    """Cameras of a scene's views about the box of its media; none where no view is of a pinhole.

    Args:
        folder: of the run, where the pictures are written.
        scene: what they look at.
        views: by key of ``mivol.photos.SPLITS``.
    """
    frames = tuple(
        PhotoFrame(Path(view.name), to_camera(view.sensor, view.name), split)
        for split, of in views.items()
        for view in of
        if view.sensor.class_name() == "PerspectiveCamera"
    )
    if not frames:
        return []
    return _pictures(folder, PhotoSurvey(folder, "a scene", frames, (), find_media_box(scene), "about its media", (0.0, 0.0)))


def pictures_of_scan(folder: Path, geometry: FlatDetector, grid: VoxelGrid, held_out: NDArray) -> list[Image]:
    """Sources and detectors of a scanner about the voxels.

    Args:
        folder: of the run, where the pictures are written.
        geometry: with all views.
        grid: the voxels.
        held_out: numbers of the views that were not fitted.
    """
    for part in PARTS:
        plot_scanner(geometry, grid, held_out, folder / f"scanner_{part}.png", part)
    count = geometry.shape[0]
    shown = sum(map(len, select_views(count, held_out)))
    what = "Which way the light goes" if geometry.whole_lines else "Where the source stands"
    captions = {
        "side": f"{what} in {f'{shown} of ' * (shown < count)}{count} views, some detectors, and the box of the voxels",
        "plan": CAPTIONS["plan"],
    }
    return [Image(path=f"scanner_{part}.png", role="picture", caption=captions[part]) for part in PARTS]


def _pictures(folder: Path, survey: PhotoSurvey) -> list[Image]:
    parts = list_parts(survey)
    for part in parts:
        plot_cameras(survey, folder / f"cameras_{part}.png", part)
    return [Image(path=f"cameras_{part}.png", role="picture", caption=CAPTIONS[part]) for part in parts]
