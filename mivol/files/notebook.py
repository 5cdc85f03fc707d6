"""Arrays in a notebook: the middle slices of a volume, and views beside what is rendered of them, as small pictures."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from mivol.files.image_files import encode_srgb
from mivol.shown import text_html

__all__ = ["pairs_html", "slices_html"]

EDGE, GAP = 160, 4
"""Longest edge of a picture, and what lies between two [pixel]."""


def slices_html(values: np.ndarray, says: str) -> str:
    """The middle slices along z, y and x, black to the smallest value and white to the largest, with a line of text.

    Args:
        values: (Z, Y, X) or (Z, Y, X, C), of which the first channel is shown; what is not finite is black.
        says: the line.
    """
    grid = np.nan_to_num(np.asarray(values, dtype=np.float32).reshape(*values.shape[:3], -1)[..., 0], posinf=0.0, neginf=0.0)
    low, high = float(grid.min()), float(grid.max())
    middles = [np.take(grid, grid.shape[axis] // 2, axis) for axis in range(3)]
    # The first row of a slice lies at the bottom.
    scaled = [(plane[::-1] - low) / ((high - low) or 1.0) for plane in middles]
    pictures = [_fitted(Image.fromarray(np.round(255 * plane).astype(np.uint8))) for plane in scaled]
    return _row_html(pictures, "middle slices along z, y, x", says)


def pairs_html(pairs: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> str:
    """Views, each as what was seen beside what is rendered of it, with its name below; nothing where there are none.

    Args:
        pairs: of each view its name, and two images (H, W, 1 or 3) of radiance. Both are shown as a screen does, with the
            largest value that was seen as white; what is not finite is black.
    """
    return "".join(_pair_html(*pair) for pair in pairs)


def _pair_html(name: str, seen: np.ndarray, rendered: np.ndarray) -> str:
    white = float(np.nan_to_num(seen, posinf=0.0).max()) or 1.0
    says = f"{name}: seen, rendered"
    return _row_html([_shown(image, white) for image in (seen, rendered)], says, says)


def _shown(image: np.ndarray, white: float) -> Image.Image:
    """An image in sRGB, one channel as grey."""
    codes = encode_srgb(np.nan_to_num(np.asarray(image, np.float64), posinf=0.0, neginf=0.0)[..., :3] / white)
    if codes.shape[-1] < 3:
        codes = np.repeat(codes[..., :1], 3, axis=2)
    return _fitted(Image.fromarray(np.round(255 * codes).astype(np.uint8)), Image.Resampling.BOX)


def _fitted(picture: Image.Image, smaller: Image.Resampling = Image.Resampling.NEAREST) -> Image.Image:
    """A picture with ``EDGE`` as its longest edge: pixels of small ones are repeated, large ones are made ``smaller``."""
    factor = EDGE / max(picture.size)
    how = Image.Resampling.NEAREST if factor > 1 else smaller
    return picture.resize(tuple(max(1, round(edge * factor)) for edge in picture.size), how)


def _row_html(pictures: Sequence[Image.Image], alt: str, says: str) -> str:
    """Pictures side by side on white, with a line of text."""
    width = sum(one.width + GAP for one in pictures) - GAP
    whole = Image.new(pictures[0].mode, (width, max(one.height for one in pictures)), "white")
    left = 0
    for one in pictures:
        whole.paste(one, (left, 0))
        left += one.width + GAP
    file = io.BytesIO()
    whole.save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}"/>{text_html(says)}'
