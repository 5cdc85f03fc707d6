"""Pictures one after the other, as a film.

Conventions. Frames are uint8 (H, W, 3), sRGB, all of one size; ``.mp4`` is H.264 that browsers play (through the ffmpeg of
imageio-ffmpeg, 8-bit 4:2:0, odd sizes get one more row or column). ``.webp`` and ``.gif`` are animated images, which need
nothing and are several times larger; a ``.gif`` has 256 colours. Written whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_matrix

from mivol.errors import MivolError
from mivol.files import whole_file

__all__ = ["NO_FFMPEG_NOTE", "WRITERS", "film_suffix", "write_video", "FEWEST_LAYERS", "volume_frames"]

Frames = Iterator[NDArray[np.uint8]]

QUALITY = "18"
"""H.264's constant rate factor: 0 is lossless, 18 looks it."""


NO_FFMPEG_NOTE = 'imageio-ffmpeg is not installed, so films are written as .webp: pip install "mivol[video]" makes them .mp4.'
"""What to say where :func:`film_suffix` is not .mp4."""


def film_suffix() -> str:
    """The best kind of film that can be written here: .mp4 where imageio-ffmpeg and its program are found, else .webp."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return ".webp"
    return ".mp4"


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], *, fps: float = 25.0) -> Path:
    """Write a film; frames are taken one at a time.

    Args:
        path: .mp4, .webp or .gif.
        frames: uint8 (H, W, 3).
        fps: frames per second; a .webp counts milliseconds, a .gif hundredths of a second.

    Raises:
        MivolError: another suffix, no frame, frames of two sizes or of another type, imageio-ffmpeg not installed.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise MivolError(f'a video cannot be written as "{path.name}"; name it {", ".join(WRITERS)}.')
    if not 0 < fps <= 1000:
        raise MivolError(f"a video of {fps} frames per second cannot be shown; choose a number above 0, such as 25.")
    with whole_file(path) as temporary:
        WRITERS[path.suffix](temporary, _checked(frames), fps)
    return path


def _checked(frames: Iterable[NDArray]) -> Frames:
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
        raise MivolError("there is no frame to make a video of; give at least one.")


def _write_mp4(path: Path, frames: Frames, fps: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MivolError(
            'a .mp4 needs imageio-ffmpeg, which is not installed; pip install "mivol[video]", or write a .webp.'
        ) from None
    first = _even(next(frames))
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
            writer.send(_even(frame).tobytes())
    finally:
        writer.close()


def _even(frame: NDArray) -> NDArray:
    """With an even number of rows and columns: 4:2:0 halves both."""
    rows, columns = frame.shape[0] % 2, frame.shape[1] % 2
    return np.ascontiguousarray(np.pad(frame, ((0, rows), (0, columns), (0, 0)), mode="edge"))


def _write_animation(path: Path, frames: Frames, fps: float, **more: str | int) -> None:
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, **more)


#: suffix -> writer.
WRITERS: dict[str, Callable[[Path, Frames, float], None]] = {
    ".mp4": _write_mp4,
    ".webp": partial(_write_animation, format="WEBP", quality=90),
    ".gif": partial(_write_animation, format="GIF"),
}


FEWEST_LAYERS = 8
"""Fewer layers along an axis are slices, which the page shows anyway."""

LARGEST = 96
"""Voxels along an edge that are projected; more are means of blocks."""

WIDTH = 192
"""Pixels of a picture."""


def volume_frames(
    values: NDArray, size: Sequence[float], upright: str, count: int = 36
) -> tuple[list[NDArray[np.uint8]], float]:
    """Pictures of a volume from ``count`` directions about its upright axis, at equal steps of a whole turn.

    Args:
        values: (Z, Y, X, C); channels are averaged, values below 0 count as 0.
        size: world lengths of the box's edges along x, y, z.
        upright: "y" or "z", the axis that it turns about.
        count: of pictures.

    Returns:
        Grey pictures, uint8 (height, width, 3), and the integral that is shown white [unit of the values times length]. None,
        and 0, for a volume of fewer than ``FEWEST_LAYERS`` along an axis, and for one that is 0 everywhere.
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
    pictures = [grid.reshape(len(grid), -1) @ _rays(grid.shape[1:], steps[1:], angle).T for angle in angles]
    largest = max(float(picture.max()) for picture in pictures)
    if largest <= 0:
        return [], 0.0
    height = max(1, round(WIDTH * lengths[0] / (pictures[0].shape[1] * steps[1:].min())))
    return [_grey(picture / largest, (WIDTH, height)) for picture in pictures], largest


def _block_means(grid: NDArray, axis: int) -> NDArray:
    n = grid.shape[axis]
    starts = np.arange(0, n, math.ceil(n / LARGEST))
    counts = np.diff(np.append(starts, n)).reshape([-1 if k == axis else 1 for k in range(3)])
    return np.add.reduceat(grid, starts, axis) / counts


def _rays(shape: Sequence[int], steps: NDArray, angle: float) -> csr_matrix:
    """(rays, voxels of a layer): integrals of a layer along rays that go in the direction of ``angle``."""
    pitch = steps.min()
    count = math.ceil(math.hypot(*(steps * shape)) / pitch)
    places = (np.arange(count) - (count - 1) / 2) * pitch
    across, along = np.meshgrid(places, places, indexing="ij")
    turned = math.cos(angle) * along + math.sin(angle) * across, math.cos(angle) * across - math.sin(angle) * along
    at = [place / step + (n - 1) / 2 for place, step, n in zip(turned, steps, shape, strict=True)]
    low = [np.floor(one).astype(int) for one in at]
    rays, voxels, weights = [], [], []
    ray = np.broadcast_to(np.arange(count)[:, None], across.shape)
    for corner in np.ndindex(2, 2):
        node = [one + step for one, step in zip(low, corner, strict=True)]
        inside = np.logical_and.reduce([(one >= 0) & (one < n) for one, n in zip(node, shape, strict=True)])
        share = np.prod([1 - np.abs(one - place) for one, place in zip(node, at, strict=True)], axis=0)
        rays.append(ray[inside])
        voxels.append((node[0] * shape[1] + node[1])[inside])
        weights.append(share[inside] * pitch)
    entries = np.concatenate(weights), (np.concatenate(rays), np.concatenate(voxels))
    return csr_matrix(entries, shape=(count, shape[0] * shape[1]))


def _grey(share: NDArray, size: tuple[int, int]) -> NDArray[np.uint8]:
    picture = Image.fromarray(np.round(255 * share).astype(np.uint8)).resize(size, Image.Resampling.BILINEAR)
    return np.repeat(np.asarray(picture)[..., None], 3, axis=2)
