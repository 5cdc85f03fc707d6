"""Small images of arrays for notebooks: middle slices of a volume, and photographs beside renders."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from mivol.display import text_html
from mivol.files.image_files import encode_srgb

EDGE, GAP = 160, 4
"""Longest edge of an image, and the gap between two images [pixel]."""


def slices_html(values: np.ndarray, caption: str) -> str:
    """Return the middle slices along z, y and x with a caption; the smallest value is black, the largest is white.

    Args:
        values: (Z, Y, X) or (Z, Y, X, C); only the first channel is shown, and values that are not finite are black.
        caption: line of text below the slices.
    """
    grid = np.nan_to_num(np.asarray(values, dtype=np.float32).reshape(*values.shape[:3], -1)[..., 0], posinf=0.0, neginf=0.0)
    low, high = float(grid.min()), float(grid.max())
    middles = [np.take(grid, grid.shape[axis] // 2, axis) for axis in range(3)]
    # Row 0 of a slice is at the bottom.
    scaled = [(plane[::-1] - low) / ((high - low) or 1.0) for plane in middles]
    images = [_resize(Image.fromarray(np.round(255 * plane).astype(np.uint8))) for plane in scaled]
    return _row_html(images, "middle slices along z, y, x", caption)


def pairs_html(pairs: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> str:
    """Return each view as photograph and render side by side, with the name below; empty text without views.

    Args:
        pairs: name, photograph and render of each view; the images are radiance (H, W, 1 or 3). Both are shown in sRGB with the
            largest value of the photograph as white; values that are not finite are black.
    """
    return "".join(_pair_html(*pair) for pair in pairs)


def _pair_html(name: str, photo: np.ndarray, rendered: np.ndarray) -> str:
    white = float(np.nan_to_num(photo, posinf=0.0).max()) or 1.0
    caption = f"{name}: photograph, render"
    return _row_html([_to_srgb(image, white) for image in (photo, rendered)], caption, caption)


def _to_srgb(image: np.ndarray, white: float) -> Image.Image:
    """An sRGB image; a single channel becomes grey."""
    codes = encode_srgb(np.nan_to_num(np.asarray(image, np.float64), posinf=0.0, neginf=0.0)[..., :3] / white)
    if codes.shape[-1] < 3:
        codes = np.repeat(codes[..., :1], 3, axis=2)
    return _resize(Image.fromarray(np.round(255 * codes).astype(np.uint8)), Image.Resampling.BOX)


def _resize(image: Image.Image, shrinking: Image.Resampling = Image.Resampling.NEAREST) -> Image.Image:
    """Resize an image to a longest edge of ``EDGE`` pixels, by repeating pixels or by the filter ``shrinking``."""
    factor = EDGE / max(image.size)
    resampling = Image.Resampling.NEAREST if factor > 1 else shrinking
    return image.resize(tuple(max(1, round(edge * factor)) for edge in image.size), resampling)


def _row_html(images: Sequence[Image.Image], alt: str, caption: str) -> str:
    """Images side by side on white, with a caption."""
    width = sum(image.width + GAP for image in images) - GAP
    row = Image.new(images[0].mode, (width, max(image.height for image in images)), "white")
    left = 0
    for image in images:
        row.paste(image, (left, 0))
        left += image.width + GAP
    file = io.BytesIO()
    row.save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}"/>{text_html(caption)}'
