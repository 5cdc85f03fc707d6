"""Photographs out of a video: sharp frames between which the camera moved, by the ffmpeg of imageio-ffmpeg.

Conventions. The video is cut into pieces of equal time, and the sharpest of ``CANDIDATES`` frames of each piece is kept, if the
image has moved since the last kept frame. Sharpness is the variance of the Laplacian (Pech-Pacheco et al. 2000). Motion is the
shift of the whole image by phase correlation (Kuglin and Hines 1975), as a share of its width.

A turn of the camera on the spot shifts the image as a step does, but shows no depth. It maps image points by a homography,
whatever the scene; a step does so for a plane only. Parallax is what the homography that fits best leaves of the shifts of
small blocks. A frame without parallax is kept only after a large shift, before the overlap with the last frame is lost.
"""

from __future__ import annotations

import logging
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

PARALLAX = 0.002
"""Least parallax between two kept frames that overlap well, over the width of the image."""

FAR = 0.08
"""Shift between two kept frames from which parallax is not asked for, over the width of the image."""

SMALL = 256
"""Width of the images whose shift is found [pixel]."""

BLOCK, STEP = 64, 20
"""Edge of the blocks whose shifts show parallax, and the distance between them [pixel]."""

CLEAR = 0.15
"""Least height of the peak of a block's phase correlation, which is 1 for a pure shift."""

ENOUGH = 12
"""Blocks with a clear shift for a homography, which has 8 numbers."""


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
    with tempfile.TemporaryDirectory(prefix=".frames-", dir=folder.parent) as place:
        images = Path(place) / "images"
        images.mkdir()
        kept, pieces = _keep_frames(video, rate, images)
        if kept < 3:
            found = f"{kept} frame{'s' * (kept != 1)} between which the camera moved, of {pieces} pieces"
            raise refusal(video, found, "at least 3", "film while you walk around the subject")
        folder.mkdir(exist_ok=True)
        images.rename(folder / "images")
    rest = f"{pieces - kept} without motion or parallax are left out"
    say(f"{folder / 'images'}: {kept} sharp frames of {duration:.0f} s; {rest}")
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
    # Of a phone's film, whose frames ffmpeg turns upright, it would warn that their size is another one than in the file.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
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
        if last is None or shows_more(last, small):
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


def shows_more(last: np.ndarray, frame: np.ndarray) -> bool:
    """Whether a small grey image (H, W) shows depth, or other parts, beside the last kept one."""
    shift = measure_shift(last, frame)
    return shift >= FAR or (shift >= MOTION and parallax(last, frame) >= PARALLAX)


def measure_shift(one: np.ndarray, other: np.ndarray) -> float:
    """Shift between two small grey images of equal size (H, W), over their width."""
    return float(np.hypot(*find_shift(one, other)[0])) / one.shape[1]


def find_shift(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, float]:
    """Shift (row, column) of the contents from an image to another of equal size [pixel], and the height of its peak, 0..1.

    The peak of the phase correlation is refined by parabolas along both axes.
    """
    window = np.outer(np.hanning(one.shape[0]), np.hanning(one.shape[1]))
    a, b = (np.fft.rfft2((image - image.mean()) * window) for image in (one, other))
    cross = b * np.conj(a)
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), one.shape)
    place, shift = np.unravel_index(int(np.argmax(peak)), peak.shape), np.zeros(2)
    for axis, n in enumerate(peak.shape):
        low, middle, high = (np.take(peak, place[axis] + k, axis, mode="wrap")[place[1 - axis]] for k in (-1, 0, 1))
        index = place[axis] if place[axis] <= n // 2 else place[axis] - n
        shift[axis] = index + 0.5 * (high - low) / max(2 * middle - low - high, 1e-12)
    return shift, float(peak[place])


def parallax(one: np.ndarray, other: np.ndarray) -> float:
    """What no homography explains of the shifts of blocks: root mean square of the rest, over the width of the images.

    Args:
        one, other: small grey images of equal size (H, W).

    Returns:
        Infinite if fewer than ``ENOUGH`` blocks have a clear shift: then nothing says that there is no parallax.
    """
    first = np.round(find_shift(one, other)[0]).astype(int)
    pairs = []
    for row in range(0, one.shape[0] - BLOCK + 1, STEP):
        for column in range(0, one.shape[1] - BLOCK + 1, STEP):
            place = np.array([row, column])
            # Twice: blocks that overlap as far as they can have a clear peak, and a wrong peak is not found again.
            there, shift, height = place + first, np.zeros(2), 0.0
            for _ in range(2):
                there = there + np.round(shift).astype(int)
                is_inside = (there >= 0).all() and (there + BLOCK <= one.shape).all()
                shift, height = find_shift(_cut(one, place), _cut(other, there)) if is_inside else (shift, 0.0)
            if height >= CLEAR:
                middle = place + BLOCK / 2
                pairs.append([*middle, *(middle + there - place + shift)])
    if len(pairs) < ENOUGH:
        return np.inf
    y, x, v, u = (np.array(pairs) / one.shape[1] - 0.5).T
    zero, unit = np.zeros_like(x), np.ones_like(x)
    rows = [[x, y, unit, zero, zero, zero, -u * x, -u * y], [zero, zero, zero, x, y, unit, -v * x, -v * y]]
    matrix = np.concatenate([np.stack(row, axis=1) for row in rows])
    rest = matrix @ np.linalg.lstsq(matrix, np.concatenate([u, v]), rcond=None)[0] - np.concatenate([u, v])
    return float(np.sqrt(2 * np.mean(rest**2)))


def _cut(image: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """The block at a corner."""
    return image[corner[0] : corner[0] + BLOCK, corner[1] : corner[1] + BLOCK]


def _shrink(frame: np.ndarray) -> np.ndarray:
    """The grey image ``SMALL`` pixels wide, float32 (H, W)."""
    size = SMALL, max(8, round(SMALL * frame.shape[0] / frame.shape[1]))
    return np.asarray(PIL.Image.fromarray(frame).convert("L").resize(size, PIL.Image.Resampling.BOX), np.float32)
