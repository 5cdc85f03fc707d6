"""PNG for people: linear light to 8-bit sRGB.

Conventions. Images are (rows, columns) or (rows, columns, 1, 3 or 4), linear, first row on top; values outside 0..1 are
clipped, alpha (the fourth) is not gamma-coded.

Reference: IEC 61966-2-1 (the sRGB curve).
"""

from __future__ import annotations

import os

import numpy as np
from PIL import Image

from mivol.files.atomic import write_whole
from mivol.files.source import refusal


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a linear image as 8-bit sRGB PNG.

    Args:
        path: destination; written whole or not at all.
        image: real numbers (rows, columns) or (rows, columns, 1, 3 or 4).

    Raises:
        MivolError: another shape, an empty image, NaN (named by its pixel), disk full.
    """
    image = np.asarray(image)
    if image.dtype.kind not in "biuf" or image.ndim not in (2, 3) or image.size == 0:
        raise refusal(path, f"an array {image.shape} of {image.dtype}", "an image of real numbers", "reshape it")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise refusal(path, f"{image.shape[2]} channels", "1, 3 or 4", "choose channels with image[..., :3]")
    image = image.astype(np.float32)
    bad = np.isnan(image)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0][:2])
        raise refusal(path, f"NaN at row {row}, column {column}", "numbers", "find its cause or use numpy.nan_to_num")
    coded = encode_srgb(image)
    if image.ndim == 3 and image.shape[2] == 4:
        coded[..., 3] = np.clip(image[..., 3], 0, 1)
    pixels = np.round(coded * 255).astype(np.uint8)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    write_whole(path, lambda file: Image.fromarray(pixels).save(file, format="PNG"))


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve of IEC 61966-2-1: linear light, clipped to 0..1, to code values 0..1 (same shape)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
