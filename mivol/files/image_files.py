"""Image files (OpenEXR for linear numbers, PNG for people), and small images for notebooks.

Conventions. Images are (rows, columns), the first row on top. OpenEXR files have one part of scan lines, every channel float32
and ZIP compressed, so ``mi.Bitmap`` reads them. Channels of a layer are ``name.R``, ``name.G``, ``name.B``; the main image has
no layer name. A file is made in memory and then written whole, because OpenEXR 3.5 does not notice a full disk. PNG holds 8-bit
sRGB: values are clipped to 0..1, and alpha, the fourth channel, is not gamma-coded.

Reference: IEC 61966-2-1 (the sRGB curve).
"""

from __future__ import annotations

import base64
import html
import io
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from mivol.display import text_html
from mivol.files import source
from mivol.files.atomic import write_whole, write_whole_bytes
from mivol.files.source import refusal

MAGIC = b"\x76\x2f\x31\x01"

#: number of channels of an array -> names of the channels in a layer.
COMPONENTS: dict[int, str] = {1: "Y", 3: "RGB", 4: "RGBA"}


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], header: Mapping[str, str | int | float] | None = None
) -> None:
    """Write an image of named channels, whole or not at all.

    Args:
        path: destination.
        channels: (rows, columns) by channel name, or (rows, columns, 1, 3 or 4) by layer name, "" for the main image; the
            channels of a layer are ``layer.R`` ... All arrays have equal sizes. NaN and Inf are kept.
        header: attributes of the file: text (for instance JSON) or numbers.

    Raises:
        MivolError: no channel, different sizes, another rank or number of channels, or a full disk.
    """
    planes: dict[str, np.ndarray] = {}
    for name, array in channels.items():
        planes.update(_planes(path, name, np.asarray(array)))
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1 or 0 in next(iter(shapes)):
        found = ", ".join(f"{name} {plane.shape}" for name, plane in planes.items()) or "no channel"
        raise refusal(path, found, "at least one channel and equal sizes", "write separate files")
    attributes = {**(header or {}), "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    OpenEXR.File(attributes, {name: OpenEXR.Channel(plane) for name, plane in planes.items()}).write(buffer)
    write_whole_bytes(path, buffer.getvalue())


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all channels of an OpenEXR file of one part.

    Returns:
        Channels, float32 (rows, columns), by their names in the file ("R", "variance.R" ...), and the attributes of the
        header. :func:`stack_layers` stacks the channels into layers.

    Raises:
        MivolError: a missing, foreign or truncated file, several parts, deep or subsampled pixels.
    """
    data = source.read_bytes(path)
    if not data.startswith(MAGIC):
        raise refusal(path, "another format (by the first bytes)", "OpenEXR", "name an .exr file")
    try:
        file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
        parts, header, channels = len(file.parts), dict(file.header()), file.channels()
    except (RuntimeError, ValueError, IndexError) as error:
        raise refusal(path, "a damaged OpenEXR file", "a complete file", "the file is truncated: copy it again") from error
    if parts != 1:
        raise refusal(path, f"{parts} parts", "one part", "save one part as a separate file")
    images = {name: np.asarray(channel.pixels) for name, channel in channels.items()}
    if any(image.dtype.kind not in "fiu" or image.ndim != 2 for image in images.values()):
        raise refusal(path, "deep pixels", "one number per pixel and channel", "flatten the image first")
    if len({image.shape for image in images.values()}) != 1:
        raise refusal(path, "channels of different sizes (subsampled)", "equal sizes", "save the image without subsampling")
    header.pop("channels", None)
    return {name: image.astype(np.float32) for name, image in images.items()}, header


def read_exr_header(path: str | os.PathLike) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Read (width, height) and the names of the channels of an OpenEXR file, without pixels.

    Raises:
        MivolError: a missing, foreign or damaged file.
    """
    with source.check_file(path).open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise refusal(path, "another format (by the first bytes)", "OpenEXR", "name an .exr file")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
        names = tuple(channel.name for channel in header["channels"])
    except (RuntimeError, ValueError, IndexError, KeyError) as error:
        raise refusal(path, "a damaged OpenEXR file", "a complete file", "the file is truncated: copy it again") from error
    width, height = (int(n) for n in high - low + 1)
    return (width, height), names


def stack_layers(channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stack channels into layers: "R", "G", "B" become "", and "a.R" ... become "a"; other channels stay single.

    Args:
        channels: channels of :func:`read_exr`.

    Returns:
        (rows, columns, 3 or 4) by layer name, and (rows, columns) by the name of a single channel.
    """
    stacked: dict[str, np.ndarray] = {}
    for name in channels:
        layer = name.rpartition(".")[0]
        prefix = f"{layer}." if layer else ""
        for letters in ("RGBA", "RGB"):
            if name.removeprefix(prefix) in letters and all(prefix + letter in channels for letter in letters):
                stacked[layer] = np.stack([channels[prefix + letter] for letter in letters], axis=-1)
                break
        else:
            stacked[name] = channels[name]
    return stacked


def _planes(path: object, name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    if array.dtype.kind not in "biuf":
        raise refusal(path, f"pixels of type {array.dtype} in {name!r}", "real numbers", "convert the pixels to float32")
    plane = np.ascontiguousarray(array, np.float32)
    if array.ndim == 2 and name:
        return {name: plane}
    if array.ndim == 3 and array.shape[2] in COMPONENTS:
        prefix = f"{name}." if name else ""
        letters = COMPONENTS[array.shape[2]]
        return {prefix + letter: np.ascontiguousarray(plane[..., i]) for i, letter in enumerate(letters)}
    raise refusal(
        path, f"{name!r} of shape {array.shape}", "(rows, columns) with a name or (rows, columns, 1, 3 or 4)", "reshape it"
    )


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a linear image as 8-bit sRGB PNG, whole or not at all.

    Args:
        path: destination.
        image: real numbers (rows, columns) or (rows, columns, 1, 3 or 4).

    Raises:
        MivolError: another shape, an empty image, NaN (with its pixel), or a full disk.
    """
    image = np.asarray(image)
    if image.dtype.kind not in "biuf" or image.ndim not in (2, 3) or image.size == 0:
        raise refusal(path, f"an array {image.shape} of {image.dtype}", "an image of real numbers", "convert the array")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise refusal(path, f"{image.shape[2]} channels", "1, 3 or 4 channels", "choose channels with image[..., :3]")
    image = image.astype(np.float32)
    bad = np.isnan(image)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0][:2])
        raise refusal(path, f"NaN at row {row}, column {column}", "numbers", "find the cause, or use numpy.nan_to_num")
    coded = encode_srgb(image)
    if image.ndim == 3 and image.shape[2] == 4:
        coded[..., 3] = np.clip(image[..., 3], 0, 1)
    pixels = np.round(coded * 255).astype(np.uint8)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    write_whole(path, lambda file: Image.fromarray(pixels).save(file, format="PNG"))


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear light, clipped to 0..1, to code values 0..1 by the sRGB curve, in the same shape."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(code: np.ndarray) -> np.ndarray:
    """Convert code values 0..1 to linear light by the sRGB curve, in the same shape."""
    code = np.clip(code, 0, 1)
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


# -- Images for notebooks ----------------------------------------------------------------------------------------------

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
