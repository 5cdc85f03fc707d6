"""Images of the cameras or the scanner of a run, from the side and from above."""

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

CAPTIONS = {"side": "Cameras, and the box of the matter", "plan": "View from above", "far": "All nested boxes from above"}


def draw_photo_cameras(folder: Path, photos: Photos, judged: Photos | None, levels: int = 1) -> list[Image]:
    """Draw the photographs' cameras and the boxes of the model.

    Args:
        folder: run folder.
        photos: photographs to fit.
        judged: held-out photographs; may be None.
        levels: nested boxes of the model.
    """
    return _pictures(folder, survey_all_cameras(photos, judged, levels))


def survey_all_cameras(photos: Photos, judged: Photos | None, levels: int) -> PhotoSurvey:
    """Survey of fitted and held-out photographs, with the nested boxes of a fit."""
    frames = photos.survey.frames + (() if judged is None else judged.survey.frames)
    return replace(photos.survey, frames=frames, levels=levels)


def draw_view_cameras(folder: Path, scene: mi.Scene, views: Mapping[str, Sequence[View]]) -> list[Image]:
    """Draw the cameras of a scene's views around the box of its media; without pinhole cameras nothing is drawn.

    Args:
        folder: run folder.
        scene: the scene.
        views: views by key of ``mivol.photos.SPLITS``.
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


def draw_scanner(folder: Path, geometry: FlatDetector, grid: VoxelGrid, held_out: NDArray) -> list[Image]:
    """Draw sources and detectors of a scanner around the voxels.

    Args:
        folder: run folder.
        geometry: geometry of the scan.
        grid: the voxels.
        held_out: indices of the held-out views.
    """
    for part in PARTS:
        plot_scanner(geometry, grid, held_out, folder / f"scanner_{part}.png", part)
    count = geometry.shape[0]
    drawn = sum(map(len, select_views(count, held_out)))
    title = "Directions of the light" if geometry.whole_lines else "Positions of the source"
    captions = {
        "side": f"{title} in {f'{drawn} of ' * (drawn < count)}{count} views, some detectors, and the box of the voxels",
        "plan": CAPTIONS["plan"],
    }
    return [Image(path=f"scanner_{part}.png", role="picture", caption=captions[part]) for part in PARTS]


def _pictures(folder: Path, survey: PhotoSurvey) -> list[Image]:
    parts = list_parts(survey)
    for part in parts:
        plot_cameras(survey, folder / f"cameras_{part}.png", part)
    return [Image(path=f"cameras_{part}.png", role="picture", caption=CAPTIONS[part]) for part in parts]
