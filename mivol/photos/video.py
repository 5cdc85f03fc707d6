"""Photographs out of a video: sharp frames between which the camera moved, by the ffmpeg of imageio-ffmpeg.

Conventions. The video is cut into pieces of equal time, and the sharpest of ``CANDIDATES`` frames of each piece is kept, if the
image has moved since the last kept frame. Sharpness is the variance of the Laplacian (Pech-Pacheco et al. 2000). Motion is the
shift of the whole image by phase correlation (Kuglin and Hines 1975), as a share of its width; a turn of the camera shifts the
image as a step does.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import PIL.Image

from mivol.errors import MivolError
from mivol.files.source import refusal

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")

RATE = 2.0
"""Frames kept a second, at most."""

CANDIDATES = 4
"""Frames of which the sharpest is kept."""

MOST = 300
"""Most frames of a video; a longer video gives fewer a second."""

LONGEST = 1800.0
"""Longest video [s]: half an hour is decoded in minutes."""

MOTION = 0.01
"""Least shift between two kept frames, over the width of the image."""

SMALL = 128
"""Width of the images whose shift is found [pixel]."""


def extract_frames(video: Path, rate: float | None = None, say: Callable[[str], None] = lambda line: None) -> Path:
    """Write sharp frames of a video to ``images/`` in a folder beside the video and of the same name; complete or not at all.

    Args:
        video: the file.
        rate: frames a second, at most; None: ``RATE``, or less for a long video.
        say: receives lines about findings and progress.

    Returns:
        The folder. Existing frames are kept.

    Raises:
        MivolError: a missing imageio-ffmpeg, a file that is no video, a video that is too long, or a camera that stands still.
    """
    folder = video.with_suffix("")
    if (folder / "images").is_dir():
        say(f"{folder / 'images'}: the frames that are there are used")
        return folder
    if rate is not None and not 0 < rate <= 30:
        raise MivolError(f"--fps {rate:g}: expected more than 0 and at most 30 frames a second; write --fps 2.")
    duration, _ = _read_header(video)
    if duration > LONGEST:
        way_out = "cut it, or take photographs of the subject out of it"
        raise refusal(video, f"a video of {duration / 60:.0f} minutes", f"at most {LONGEST / 60:.0f}", way_out)
    rate = min(RATE, MOST / max(duration, 1)) if rate is None else rate
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".frames-", dir=folder) as place:
        images = Path(place) / "images"
        images.mkdir()
        kept, pieces = _keep_frames(video, rate, images)
        if kept < 3:
            found = f"{kept} frame{'s' * (kept != 1)} between which the camera moved, of {pieces} pieces"
            raise refusal(video, found, "at least 3", "film while you walk around the subject")
        images.rename(folder / "images")
    say(f"{folder / 'images'}: {kept} sharp frames of {duration:.0f} s; {pieces - kept} without motion are left out")
    return folder


def _read_header(video: Path) -> tuple[float, tuple[int, int]]:
    """Duration [s] and size of the frames of a video."""
    frames = _read(video, ["-frames:v", "1"])
    meta = next(frames)
    frames.close()
    if not meta.get("duration") or not all(meta.get("size", (0, 0))):
        raise refusal(video, "no frames", "a video that ffmpeg reads", "convert it to .mp4")
    return float(meta["duration"]), meta["size"]


def _read(video: Path, options: list[str]) -> Iterator:
    """What ``imageio_ffmpeg.read_frames`` yields: facts first, then frames as bytes."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MivolError('a video needs imageio-ffmpeg, which is not installed: pip install "mivol[video]".') from None
    if not video.is_file():
        raise refusal(video, "no file", "a video", "check the path")
    try:
        yield from imageio_ffmpeg.read_frames(str(video), output_params=options)
    except (OSError, RuntimeError, IndexError) as error:
        last = str(error).strip().splitlines()[-1:] or ["no reason given"]
        raise refusal(
            video, f"no video that ffmpeg reads ({last[0].strip()})", "one", "convert it to .mp4, or copy it again"
        ) from None


def _keep_frames(video: Path, rate: float, images: Path) -> tuple[int, int]:
    """Write the kept frames; return their number, and the number of pieces."""
    frames = _read(video, ["-vf", f"fps={rate * CANDIDATES:.6g}"])
    width, height = next(frames)["size"]
    best: tuple[float, np.ndarray] | None = None
    last: np.ndarray | None = None
    kept = pieces = number = 0

    def end_piece() -> None:
        nonlocal best, last, kept, pieces
        if best is None:
            return
        pieces += 1
        small = _shrink(best[1])
        if last is None or motion(last, small) >= MOTION:
            kept, last = kept + 1, small
            PIL.Image.fromarray(best[1]).save(images / f"frame_{kept:05d}.jpg", quality=95, subsampling=0)
        best = None

    for number, data in enumerate(frames):
        if number and number % CANDIDATES == 0:
            end_piece()
        frame = np.frombuffer(data, np.uint8).reshape(height, width, 3)
        score = sharpness(frame)
        if best is None or score > best[0]:
            best = score, frame
    end_piece()
    return kept, pieces


def sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of the green channel at half the size; more is sharper."""
    rows, columns = (n // 2 * 2 for n in frame.shape[:2])
    half = frame[:rows, :columns, 1].astype(np.float32).reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3))
    inner = half[1:-1, 1:-1]
    return float((half[:-2, 1:-1] + half[2:, 1:-1] + half[1:-1, :-2] + half[1:-1, 2:] - 4 * inner).var())


def motion(one: np.ndarray, other: np.ndarray) -> float:
    """Shift between two small grey images of equal size (H, W), over their width."""
    window = np.outer(np.hanning(one.shape[0]), np.hanning(one.shape[1]))
    a, b = (np.fft.rfft2((image - image.mean()) * window) for image in (one, other))
    cross = a * np.conj(b)
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), one.shape)
    row, column = np.unravel_index(int(np.argmax(peak)), peak.shape)
    shifts = [index if index <= n // 2 else index - n for index, n in zip((row, column), peak.shape, strict=True)]
    return float(np.hypot(*shifts)) / one.shape[1]


def _shrink(frame: np.ndarray) -> np.ndarray:
    """The grey image ``SMALL`` pixels wide, float32 (H, W)."""
    size = SMALL, max(8, round(SMALL * frame.shape[0] / frame.shape[1]))
    return np.asarray(PIL.Image.fromarray(frame).convert("L").resize(size, PIL.Image.Resampling.BOX), np.float32)
