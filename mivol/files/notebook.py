"""A volume in a notebook: its three middle slices as one small grey picture."""

from __future__ import annotations

import base64
import io

import numpy as np
from PIL import Image

from mivol.shown import text_html

__all__ = ["slices_html"]

EDGE = 160
"""Longest edge of a slice [pixel]."""


def slices_html(values: np.ndarray, says: str) -> str:
    """The middle slices along z, y and x, black to the smallest value and white to the largest, with a line of text.

    Args:
        values: (Z, Y, X) or (Z, Y, X, C), of which the first channel is shown; what is not finite is black.
        says: the line.
    """
    grid = np.nan_to_num(np.asarray(values, dtype=np.float32).reshape(*values.shape[:3], -1)[..., 0], posinf=0.0, neginf=0.0)
    low, high = float(grid.min()), float(grid.max())
    middles = [np.take(grid, grid.shape[axis] // 2, axis) for axis in range(3)]
    pictures = [grey(slice_, low, high) for slice_ in middles]
    whole = Image.new("L", (sum(one.width for one in pictures) + 8, max(one.height for one in pictures)), 255)
    left = 0
    for one in pictures:
        whole.paste(one, (left, 0))
        left += one.width + 4
    file = io.BytesIO()
    whole.save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="middle slices along z, y, x" src="data:image/png;base64,{data}"/>{text_html(says)}'


def grey(plane: np.ndarray, low: float, high: float) -> Image.Image:
    """A plane as a picture, its first row at the bottom, pixels repeated up to ``EDGE``."""
    scaled = (plane - low) / ((high - low) or 1.0)
    picture = Image.fromarray(np.round(255 * scaled[::-1]).astype(np.uint8))
    factor = EDGE / max(picture.size)
    size = tuple(max(1, round(edge * factor)) for edge in picture.size)
    return picture.resize(size, Image.Resampling.NEAREST)
