"""Films of runs: that of a fit of photographs, whose camera's way is settled before the fit, and that of a volume."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.config import ShowSettings
from mivol.errors import MivolError
from mivol.experiments.fit_kind import Progress
from mivol.experiments.run_folder import RunFolder
from mivol.photos import Camera, Photos, follow_keyframes, interpolate_cameras, turntable
from mivol.report.record import Image
from mivol.report.video import NO_FFMPEG_NOTE, film_suffix, volume_frames, write_video

__all__ = ["Film", "film_of_volume", "plan_film"]

FILM_SIZE = 256
"""Longest edge of a film [pixel]."""

SECONDS = 4
"""Length of a film."""

WAYS = {
    "turntable": "views around the box",
    "views": "views through the photographs' places",
    "keyframes": "views past the keyframes",
}


@dataclass(frozen=True)
class Film:
    """Where the camera of a film goes.

    Attributes:
        cameras: one a picture; none where there is no film.
        way: key of WAYS.
        shrink: how many times smaller than the photographs the pictures are.
        notes: why there is no film although one was asked for.
    """

    cameras: tuple[Camera, ...]
    way: str = "turntable"
    shrink: float = 1.0
    notes: tuple[str, ...] = ()

    def write(self, folder: Path, picture: Callable[[Camera], NDArray], progress: Progress) -> Image:
        """Make the pictures and write them; says how films become mp4 where they do not.

        Args:
            folder: run folder; the film lies in ``film/``.
            picture: (H, W, 3) code values that a camera sees.
            progress: who is told how it goes.
        """
        path = f"film/{self.way}{film_suffix()}"
        if not path.endswith(".mp4"):
            progress.say([NO_FFMPEG_NOTE])

        def frames() -> Iterator[NDArray[np.uint8]]:
            for camera in progress.track(self.cameras, "frames"):
                yield np.round(np.clip(picture(camera), 0, 1) * 255).astype(np.uint8)

        write_video(folder / path, frames(), fps=len(self.cameras) / SECONDS)
        return Image(path=path, role="film", caption=f"{len(self.cameras)} {WAYS[self.way]}")


def plan_film(show: ShowSettings, photos: Photos) -> Film:
    """Place the cameras of a film, before anything is fitted.

    Raises:
        MivolError: keyframes that no camera can take. Where photographs have no common upward direction, or there is one
            alone, a film that nobody described is left out with a note.
    """
    if not show.frames:
        return Film(())
    cameras = [view.camera for view in photos.views]
    try:
        if show.way == "turntable":
            found = turntable(cameras, photos.box, show.frames)
        elif show.way == "views":
            found = interpolate_cameras(cameras, show.frames)
        else:
            found = follow_keyframes(cameras, show.keyframes, show.frames)
    except MivolError as error:
        if show.way == "keyframes":
            raise
        return Film((), notes=(f"There is no film: {error}",))
    small = tuple(_small(camera) for camera in found)
    return Film(small, show.way, found[0].size[0] / small[0].size[0])


def film_of_volume(run: RunFolder, values: NDArray, size: Sequence[float], upright: str, quantity: str) -> list[Image]:
    """Write a volume as it turns about its upright axis; no film where :func:`volume_frames` has none.

    It is an animated WebP everywhere, which is small: its pictures are grey.

    Args:
        run: the film lies in its ``film/``.
        values: (Z, Y, X, C).
        size: world lengths of the box's edges along x, y, z.
        upright: "y" or "z".
        quantity: of the values, for the caption.
    """
    frames, largest = volume_frames(values, size, upright)
    if not frames:
        return []
    run.make("film")
    write_video(run.path / "film/volume.webp", frames, fps=len(frames) / SECONDS)
    white = f"white is {largest:.3g} ({quantity} times length)"
    said = f"The volume from {len(frames)} sides: integrals along parallel rays, {white}"
    return [Image(path="film/volume.webp", role="film", caption=said)]


def _small(camera: Camera) -> Camera:
    """A camera with at most the pixels of a film."""
    scale = min(1.0, FILM_SIZE / max(camera.size))
    return camera.resized(tuple(max(1, round(edge * scale)) for edge in camera.size))
