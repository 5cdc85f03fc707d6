"""Films of a run: a camera path through a fitted model, planned before the fit, and a rotating volume."""

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

FILM_SIZE = 256
"""Longest edge of a film [pixel]."""

SECONDS = 4
"""Length of a film [s]."""

WAYS = {
    "turntable": "views around the box",
    "views": "views through the photographs' places",
    "keyframes": "views past the keyframes",
}


@dataclass(frozen=True)
class Film:
    """Camera path of a film.

    Attributes:
        cameras: camera of each frame; empty without a film.
        way: key of WAYS.
        shrink: size of the photographs over the size of the frames.
        notes: reason of a missing film.
    """

    cameras: tuple[Camera, ...]
    way: str = "turntable"
    shrink: float = 1.0
    notes: tuple[str, ...] = ()

    def write(self, folder: Path, picture: Callable[[Camera], NDArray], progress: Progress) -> Image:
        """Render the frames and write the film; without ffmpeg, say how to get an mp4.

        Args:
            folder: run folder; the film is in ``film/``.
            picture: function from a camera to code values (H, W, 3).
            progress: display of the run's progress.
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
    """Place the cameras of a film.

    Without keyframes, a single photograph or photographs without a common upward direction give no film but a note.

    Raises:
        MivolError: keyframes without a valid camera.
    """
    if not show.frames:
        return Film(())
    cameras = [view.camera for view in photos.views]
    try:
        if show.way == "turntable":
            film_cameras = turntable(cameras, photos.box, show.frames)
        elif show.way == "views":
            film_cameras = interpolate_cameras(cameras, show.frames)
        else:
            film_cameras = follow_keyframes(cameras, show.keyframes, show.frames)
    except MivolError as error:
        if show.way == "keyframes":
            raise
        return Film((), notes=(f"There is no film: {error}",))
    small = tuple(_small(camera) for camera in film_cameras)
    return Film(small, show.way, film_cameras[0].size[0] / small[0].size[0])


def film_of_volume(run: RunFolder, values: NDArray, size: Sequence[float], upright: str, quantity: str) -> list[Image]:
    """Write a film of a volume that rotates about its upright axis; empty for volumes left out by :func:`volume_frames`.

    The film is an animated WebP, which is small for grey images.

    Args:
        run: run folder; the film is in ``film/``.
        values: values (Z, Y, X, C).
        size: lengths of the box's edges along x, y, z in the world.
        upright: "y" or "z".
        quantity: quantity of the values, for the caption.
    """
    frames, largest = volume_frames(values, size, upright)
    if not frames:
        return []
    run.make("film")
    write_video(run.path / "film/volume.webp", frames, fps=len(frames) / SECONDS)
    scale = f"0 (black) to {largest:.3g} (white) [{quantity} times length]"
    caption = f"The volume from {len(frames)} sides: integrals along parallel rays, {scale}"
    return [Image(path="film/volume.webp", role="film", caption=caption)]


def _small(camera: Camera) -> Camera:
    """Return a camera with at most the pixels of a film."""
    scale = min(1.0, FILM_SIZE / max(camera.size))
    return camera.resized(tuple(max(1, round(edge * scale)) for edge in camera.size))
