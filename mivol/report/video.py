"""Pictures one after the other, as a film.

Conventions. Frames are uint8 (H, W, 3), sRGB, all of one size; ``.mp4`` is H.264 that browsers play (through the ffmpeg of
imageio-ffmpeg, 8-bit 4:2:0, odd sizes get one more row or column). ``.webp`` and ``.gif`` are animated images, which need
nothing and are several times larger; a ``.gif`` has 256 colours. Written whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mivol.errors import MivolError
from mivol.files import whole_file

__all__ = ["WITHOUT_FFMPEG", "WRITERS", "film_suffix", "write_video"]

Frames = Iterator[NDArray[np.uint8]]

QUALITY = "18"
"""H.264's constant rate factor: 0 is lossless, 18 looks it."""


WITHOUT_FFMPEG = 'imageio-ffmpeg is not installed, so films are written as .webp: pip install "mivol[video]" makes them .mp4.'
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
