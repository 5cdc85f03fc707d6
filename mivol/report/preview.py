"""Three slices of a volume in one picture, written while a run goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.files.atomic import write_whole_bytes
from mivol.report import show

PREVIEW = "preview.png"
EDGE, GAP = 320, 8
"""Pixels of the box's longest edge, and between two slices."""


def is_due(iteration: int, iterations: int) -> bool:
    """Whether a preview is written after an iteration: the first and the last one, and some twenty between."""
    return iteration in (1, iterations) or iteration % max(1, iterations // 20) == 0


def write_preview(folder: Path, volume: NDArray, size: tuple[float, float, float]) -> Path:
    """Write ``preview.png`` whole: the middle slices xy, xz and yz side by side, on one grey scale, second axis upwards.

    Args:
        folder: of the run.
        volume: (Z, Y, X).
        size: lengths of the box's edges along x, y, z; the longest is EDGE pixels.
    """
    cut = show.slices(volume, size)
    scale = show.scale_of(*cut.images.values())
    edges = dict(zip("xyz", np.maximum(1, np.rint(EDGE * np.array(size) / max(size))).astype(int), strict=True))
    parts = [_resized(show.pixels(image, scale), edges[plane[1]], edges[plane[0]]) for plane, image in cut.images.items()]
    height = max(part.shape[0] for part in parts)
    paper = np.full((height, sum(part.shape[1] for part in parts) + 2 * GAP, 3), 255, np.uint8)
    left = 0
    for part in parts:
        paper[height - part.shape[0] :, left : left + part.shape[1]] = part
        left += part.shape[1] + GAP
    write_whole_bytes(folder / PREVIEW, show.png(paper))
    return folder / PREVIEW


def _resized(rgb: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """The nearest pixels."""
    rows, columns = ((np.arange(n) + 0.5) * have // n for n, have in zip((height, width), rgb.shape, strict=False))
    return rgb[rows.astype(int)[:, None], columns.astype(int)]
