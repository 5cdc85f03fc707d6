"""The cameras of photographs in the view: a frustum each, with the photograph, coloured by what it is for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageOps
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mivol.errors import MivolError
from mivol.photos import Camera, PhotoSurvey, intrinsics, to_pinhole
from mivol.photos.camera import FLIP
from mivol.photos.camera_path import WIDE
from mivol.photos.photo_file import read_photo, shrink
from mivol.photos.survey import PhotoFrame

TRAIN, HELD_OUT = "train", "held out"

COLOURS = {TRAIN: (90, 160, 255), HELD_OUT: (255, 140, 40)}
"""Colours of frusta: blue photographs were fitted, orange ones judge the fit."""

MOST = 300
"""Most frusta of a page; of more photographs, every second, third, ... is shown."""

EDGE = 160
"""Longest edge of a photograph in its frustum [pixel]."""

SIZE = 0.05, 0.4
"""Depth of a frustum at most: over the median distance of cameras from the middle of the photographs' box, and over the median
distance of neighbouring cameras."""


class Frusta:
    """The frusta of a page, with a checkbox for each kind. A click on one moves the page's camera there.

    Args:
        server: the server of viser.
        survey: cameras and files; None for no photographs.
        fly: receives the page and the camera of a clicked frustum.
    """

    def __init__(self, server: Any, survey: PhotoSurvey | None, fly: Callable[[Any, Camera], None]) -> None:
        self._waiting: list[tuple[PhotoFrame, Any]] = []
        if survey is None:
            return
        frames = survey.frames[:: -(-len(survey.frames) // MOST)]
        depth = frustum_size(survey)
        kinds = {id(frame): TRAIN if frame.split == "train" else HELD_OUT for frame in frames}
        shown = {
            kind: server.gui.add_checkbox(f"{kind} photographs ({sum(k == kind for k in kinds.values())})", True)
            for kind in (TRAIN, HELD_OUT)
        }
        groups = {kind: server.scene.add_frame(f"/{kind.replace(' ', '_')}", show_axes=False) for kind in shown}
        for kind, checkbox in shown.items():
            checkbox.on_update(lambda event, kind=kind: setattr(groups[kind], "visible", event.target.value))
        for number, frame in enumerate(frames):
            camera, kind = _pinhole(frame.camera), kinds[id(frame)]
            across, up = np.divide(camera.size, 2 * camera.K[[0, 1], [0, 1]])
            x, y, z, w = Rotation.from_matrix(camera.to_world[:3, :3] * FLIP).as_quat()
            handle = server.scene.add_camera_frustum(
                f"{groups[kind].name}/{number}",
                fov=float(2 * np.arctan(up)),
                aspect=float(across / up),
                scale=depth * float(np.cbrt(across * up / 3)),  # viser's scale is the third root of a third of the volume
                thickness=1.5,
                thickness_units="screen",
                color=COLOURS[kind],
                wxyz=(w, x, y, z),
                position=camera.origin,
            )
            handle.on_click(lambda event, camera=camera: fly(event.client, camera))
            self._waiting.append((frame, handle))
        self._waiting.reverse()

    @property
    def is_loading(self) -> bool:
        """Whether photographs have not been read yet."""
        return bool(self._waiting)

    def load_next(self) -> None:
        """Read the next photograph into its frustum; a damaged photograph leaves it empty.

        Raises:
            MivolError: a damaged photograph.
        """
        frame, handle = self._waiting.pop()
        handle.image = thumbnail(frame)


def frustum_size(survey: PhotoSurvey) -> float:
    """Depth of the frusta [length]: small beside the subject, and beside the distances of the cameras."""
    origins = np.array([frame.camera.origin for frame in survey.frames])
    size = SIZE[0] * float(np.median(np.linalg.norm(origins - np.mean(survey.box, axis=0), axis=1)))
    if len(origins) < 2:
        return size
    near = cKDTree(origins).query(origins, k=2)[0][:, 1]
    return min(size, SIZE[1] * float(np.median(near[near > 0]))) if (near > 0).any() else size


def _pinhole(camera: Camera) -> Camera:
    """The pinhole of a frustum; of a wide lens, one of ``WIDE`` degrees."""
    if not camera.distortion.is_wide:
        return to_pinhole(camera)
    focal = camera.size[0] / 2 / np.tan(np.radians(WIDE) / 2)
    return Camera(intrinsics(focal, focal, camera.size[0] / 2, camera.size[1] / 2), camera.size, camera.to_world)


def thumbnail(frame: PhotoFrame) -> np.ndarray:
    """A photograph with a longest edge of ``EDGE`` pixels, upright as its camera, uint8 (H, W, 3).

    Raises:
        MivolError: a damaged photograph.
    """
    try:
        with PIL.Image.open(frame.file) as image:
            image.draft("RGB", (EDGE, EDGE))
            upright = PIL.ImageOps.exif_transpose(image) if frame.orientation != 1 else image
            small = upright.convert("RGB")
            small.thumbnail((EDGE, EDGE))
            return np.asarray(small)
    except PIL.UnidentifiedImageError:
        values, _ = read_photo(frame.file, "srgb", None, frame.orientation)
        scale = EDGE / max(values.shape[:2])
        size = tuple(max(1, round(edge * min(scale, 1.0))) for edge in values.shape[1::-1])
        return np.round(np.clip(shrink(values, size), 0, 1) * 255).astype(np.uint8)
    except OSError as error:
        raise MivolError(f"{frame.file} cannot be read ({error}): copy it again.") from error
