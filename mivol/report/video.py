"""Pictures one after the other, as a film.

Conventions. Frames are uint8 (H, W, 3), sRGB, all of one size; ``.mp4`` is H.264 that browsers play (through the ffmpeg of
imageio-ffmpeg, 8-bit 4:2:0, odd sizes get one more row or column), ``.gif`` needs nothing and has 256 colours. Written whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mivol.errors import MivolError
from mivol.files import whole_file

__all__ = ["WRITERS", "write_video"]

Frames = Iterator[NDArray[np.uint8]]

QUALITY = "18"
"""H.264's constant rate factor: 0 is lossless, 18 looks it."""


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], *, fps: float = 25.0) -> Path:
    """Write a film; frames are taken one at a time.

    Args:
        path: .mp4 or .gif.
        frames: uint8 (H, W, 3).
        fps: frames per second; a .gif counts hundredths of a second.

    Raises:
        MivolError: another suffix, no frame, frames of two sizes or of another type, imageio-ffmpeg not installed.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise MivolError(f'a video cannot be written as "{path.name}"; name it {" or ".join(WRITERS)}.')
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
            'a .mp4 needs imageio-ffmpeg, which is not installed; pip install "mivol[video]", or write a .gif.'
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


def _write_gif(path: Path, frames: Frames, fps: float) -> None:
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)


#: suffix -> writer.
WRITERS: dict[str, Callable[[Path, Frames, float], None]] = {".mp4": _write_mp4, ".gif": _write_gif}
