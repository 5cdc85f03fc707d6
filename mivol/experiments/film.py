"""Films of a run: a camera path through a fitted model, planned before the fit, and a rotating volume.

Conventions. Frames are uint8 (H, W, 3) in sRGB, of equal size. ``.mp4`` is H.264 for browsers, written by the ffmpeg of
imageio-ffmpeg in 8-bit 4:2:0; odd sizes get one more row or column. ``.webp`` and ``.gif`` are animated images: they need no
other program and are several times larger. A ``.gif`` has 256 colours. Files are written whole or not at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mivol.config import ShowSettings
from mivol.errors import MivolError
from mivol.experiments.fit_kind import Progress
from mivol.experiments.run_folder import RunFolder
from mivol.files import whole_file
from mivol.photos import Camera, Photos, follow_keyframes, interpolate_cameras, turntable
from mivol.report.record import Image

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


# -- Files of films --------------------------------------------------------------------------------------------------------


FilmFrames = Iterator[NDArray[np.uint8]]

QUALITY = "18"
"""Constant rate factor of H.264: 0 is lossless, 18 looks lossless."""


NO_FFMPEG_NOTE = 'Without imageio-ffmpeg films are written as .webp; install it for .mp4: pip install "mivol[video]".'
"""Note for the user if :func:`film_suffix` is not ``.mp4``."""


def film_suffix() -> str:
    """Return the suffix of films on this machine: ``.mp4`` with imageio-ffmpeg and its program, else ``.webp``."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return ".webp"
    return ".mp4"


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], *, fps: float = 25.0) -> Path:
    """Write a film, one frame at a time.

    Args:
        path: .mp4, .webp or .gif.
        frames: uint8 (H, W, 3).
        fps: frames per second, rounded to milliseconds in a .webp and to hundredths of a second in a .gif.

    Raises:
        MivolError: another suffix, no frame, frames of different sizes or of another type, or a missing imageio-ffmpeg.
    """
    path = Path(path)
    if path.suffix not in FILM_WRITERS:
        raise MivolError(f'a film cannot be written as "{path.name}"; choose the suffix {", ".join(FILM_WRITERS)}.')
    if not 0 < fps <= 1000:
        raise MivolError(f"a film cannot have {fps} frames per second; choose a number above 0 and at most 1000, such as 25.")
    with whole_file(path) as temporary:
        FILM_WRITERS[path.suffix](temporary, _check_frames(frames), fps)
    return path


def _check_frames(frames: Iterable[NDArray]) -> FilmFrames:
    shape = None
    for number, frame in enumerate(frames):
        frame = np.asarray(frame)
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise MivolError(f"frame {number} is {frame.dtype} {frame.shape}; give uint8 (height, width, 3).")
        shape = shape or frame.shape
        if frame.shape != shape:
            raise MivolError(f"frame {number} has shape {frame.shape}, the first {shape}; give frames of one size.")
        yield frame
    if shape is None:
        raise MivolError("a film needs at least one frame; none was given.")


def _write_mp4(path: Path, frames: FilmFrames, fps: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MivolError(
            'a .mp4 needs imageio-ffmpeg, which is not installed; write a .webp, or install it: pip install "mivol[video]".'
        ) from None
    first = _pad_to_even(next(frames))
    writer = imageio_ffmpeg.write_frames(
        str(path),
        first.shape[1::-1],
        fps=fps,
        codec="libx264",
        macro_block_size=1,
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", QUALITY, "-f", "mp4", "-movflags", "+faststart", "-threads", "1"],
    )
    writer.send(None)
    try:
        writer.send(first.tobytes())
        for frame in frames:
            writer.send(_pad_to_even(frame).tobytes())
    finally:
        writer.close()


def _pad_to_even(frame: NDArray) -> NDArray:
    """Pad to an even number of rows and columns, which 4:2:0 halves."""
    rows, columns = frame.shape[0] % 2, frame.shape[1] % 2
    return np.ascontiguousarray(np.pad(frame, ((0, rows), (0, columns), (0, 0)), mode="edge"))


def _write_gif(path: Path, frames: FilmFrames, fps: float) -> None:
    images = (PIL.Image.fromarray(frame) for frame in frames)
    _save_animation(path, next(images), images, fps, "GIF")


def _write_webp(path: Path, frames: FilmFrames, fps: float) -> None:
    """Pillow takes all frames of a .webp at once. They wait in a file, which Pillow reads in place."""
    with TemporaryFile(dir=path.parent) as stored:
        first = next(frames)
        for frame in chain([first], frames):
            stored.write(np.pad(frame, ((0, 0), (0, 0), (0, 1))).tobytes())
        stored.flush()
        pixels = np.memmap(stored, np.uint8, "r").reshape(-1, *first.shape[:2], 4)
        images = [PIL.Image.frombuffer("RGBX", first.shape[1::-1], frame, "raw", "RGBX", 0, 1) for frame in pixels]
        _save_animation(path, images[0], images[1:], fps, "WEBP", quality=90)


def _save_animation(
    path: Path, first: PIL.Image.Image, others: Iterable[PIL.Image.Image], fps: float, kind: str, **more: int
) -> None:
    first.save(path, kind, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, **more)


#: suffix -> writer.
FILM_WRITERS: dict[str, Callable[[Path, FilmFrames, float], None]] = {
    ".mp4": _write_mp4,
    ".webp": _write_webp,
    ".gif": _write_gif,
}


# -- A turning volume ---------------------------------------------------------------------------------------------

FEWEST_LAYERS = 8
"""Fewest voxels along each axis of a film; the slices on the page show thinner volumes."""

LARGEST = 96
"""Largest number of projected voxels along an edge; larger volumes are averaged in blocks."""

WIDTH = 192
"""Width of a frame [pixel]."""


def volume_frames(
    values: NDArray, size: Sequence[float], upright: str, count: int = 36
) -> tuple[list[NDArray[np.uint8]], float]:
    """Return parallel projections of a volume turning about its upright axis, at equal angles of a full turn.

    Rays are horizontal, so each layer is projected separately: a Radon transform by bilinear samples, whose step is the
    smallest voxel edge. Grey is the line integral divided by the largest integral of all frames; an empty ray is black.

    Args:
        values: (Z, Y, X, C); channels are averaged, and negative values count as 0.
        size: edges of the box along x, y, z [length].
        upright: "y" or "z", the axis of rotation; its highest layer is at the top of a frame.
        count: number of frames.

    Returns:
        Grey frames, uint8 (height, width, 3), and the line integral shown white [unit of the values times length]. The list
        is empty and the integral 0 for fewer than ``FEWEST_LAYERS`` voxels along an axis and for a volume of zeros.
    """
    if min(values.shape[:3]) < FEWEST_LAYERS:
        return [], 0.0
    axes = (1, 0, 2) if upright == "y" else (0, 1, 2)
    grid = np.maximum(values, 0).mean(axis=3, dtype=np.float64).transpose(axes)[::-1]
    lengths = np.array(size[::-1])[list(axes)]
    for axis in range(3):
        grid = _block_means(grid, axis)
    steps = lengths / grid.shape
    angles = 2 * math.pi * np.arange(count) / count
    frames = [grid.reshape(len(grid), -1) @ _projection_matrix(grid.shape[1:], steps[1:], angle).T for angle in angles]
    largest = max(float(frame.max()) for frame in frames)
    if largest <= 0:
        return [], 0.0
    height = max(1, round(WIDTH * lengths[0] / (frames[0].shape[1] * steps[1:].min())))
    return [_to_grey_frame(frame / largest, (WIDTH, height)) for frame in frames], largest


def _block_means(grid: NDArray, axis: int) -> NDArray:
    n = grid.shape[axis]
    starts = np.arange(0, n, math.ceil(n / LARGEST))
    counts = np.diff(np.append(starts, n)).reshape([-1 if k == axis else 1 for k in range(3)])
    return np.add.reduceat(grid, starts, axis) / counts


def _projection_matrix(shape: Sequence[int], steps: NDArray, angle: float) -> csr_matrix:
    """The matrix (rays, voxels of a layer) that integrates a layer along parallel rays at an angle [radian]."""
    pitch = steps.min()
    count = math.ceil(math.hypot(*(steps * shape)) / pitch)
    places = (np.arange(count) - (count - 1) / 2) * pitch
    across, along = np.meshgrid(places, places, indexing="ij")
    turned = math.cos(angle) * along + math.sin(angle) * across, math.cos(angle) * across - math.sin(angle) * along
    voxel_coordinates = [place / step + (n - 1) / 2 for place, step, n in zip(turned, steps, shape, strict=True)]
    low = [np.floor(coordinate).astype(int) for coordinate in voxel_coordinates]
    rays, voxels, weights = [], [], []
    ray = np.broadcast_to(np.arange(count)[:, None], across.shape)
    for corner in np.ndindex(2, 2):
        voxel = [index + offset for index, offset in zip(low, corner, strict=True)]
        inside = np.logical_and.reduce([(index >= 0) & (index < n) for index, n in zip(voxel, shape, strict=True)])
        weight = np.prod([1 - np.abs(i - x) for i, x in zip(voxel, voxel_coordinates, strict=True)], axis=0)
        rays.append(ray[inside])
        voxels.append((voxel[0] * shape[1] + voxel[1])[inside])
        weights.append(weight[inside] * pitch)
    entries = np.concatenate(weights), (np.concatenate(rays), np.concatenate(voxels))
    return csr_matrix(entries, shape=(count, shape[0] * shape[1]))


def _to_grey_frame(share: NDArray, size: tuple[int, int]) -> NDArray[np.uint8]:
    frame = PIL.Image.fromarray(np.round(255 * share).astype(np.uint8)).resize(size, PIL.Image.Resampling.BILINEAR)
    return np.repeat(np.asarray(frame)[..., None], 3, axis=2)
