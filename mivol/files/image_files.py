"""OpenEXR: float32 channels of one image, in layers, with text in the header.

Conventions. Images are (rows, columns), the first row on top. One part, scan lines, every channel float32 and ZIP
compressed, so that ``mi.Bitmap`` reads them; layers are ``name.R``, ``name.G``, ``name.B``, the picture itself has no
layer name. The file is made in memory and then written whole: OpenEXR 3.5 does not notice a full disk.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from mivol.files import source
from mivol.files.atomic import write_whole, write_whole_bytes
from mivol.files.source import refusal

MAGIC = b"\x76\x2f\x31\x01"

#: channels of an array (rows, columns, C) -> their names within a layer.
COMPONENTS: dict[int, str] = {1: "Y", 3: "RGB", 4: "RGBA"}


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], header: Mapping[str, str | int | float] | None = None
) -> None:
    """Write one image of named channels.

    Args:
        path: destination; written whole or not at all.
        channels: name -> (rows, columns), one channel of that name; or layer -> (rows, columns, 3 or 4), the channels
            ``layer.R`` and so on ("" for the picture itself: R, G, B). All of one size; NaN and Inf are kept.
        header: text (for instance JSON) or numbers to store as attributes.

    Raises:
        MivolError: no channel, sizes that differ, a rank or channel count that is not known, disk full.
    """
    planes: dict[str, np.ndarray] = {}
    for name, array in channels.items():
        planes.update(_planes(path, name, np.asarray(array)))
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1 or 0 in next(iter(shapes)):
        found = ", ".join(f"{name} {plane.shape}" for name, plane in planes.items()) or "no channel"
        raise refusal(path, found, "at least one channel and one size for all", "write them to separate files")
    attributes = {**(header or {}), "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    OpenEXR.File(attributes, {name: OpenEXR.Channel(plane) for name, plane in planes.items()}).write(buffer)
    write_whole_bytes(path, buffer.getvalue())


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read every channel of a one-part image.

    Returns:
        name -> float32 (rows, columns), with the names of the file ("R", "variance.R" ...), and the header's
        attributes. :func:`stack_layers` stacks the channels again.

    Raises:
        MivolError: missing, foreign, truncated, several parts, deep or subsampled pixels.
    """
    data = source.read_bytes(path)
    if not data.startswith(MAGIC):
        raise refusal(path, "another kind of file (by its first bytes)", "OpenEXR", "name an .exr file")
    try:
        file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
        parts, header, found = len(file.parts), dict(file.header()), file.channels()
    except (RuntimeError, ValueError, IndexError) as error:
        raise refusal(path, "a damaged OpenEXR file", "a whole one", "the file is truncated: copy it again") from error
    if parts != 1:
        raise refusal(path, f"{parts} parts", "one", "save the part you want as a file of its own")
    images = {name: np.asarray(channel.pixels) for name, channel in found.items()}
    if any(image.dtype.kind not in "fiu" or image.ndim != 2 for image in images.values()):
        raise refusal(path, "deep pixels", "one number per pixel and channel", "flatten the image first")
    if len({image.shape for image in images.values()}) != 1:
        raise refusal(path, "channels of several sizes (subsampled)", "one size", "save it without subsampling")
    header.pop("channels", None)
    return {name: image.astype(np.float32) for name, image in images.items()}, header


def read_exr_header(path: str | os.PathLike) -> tuple[tuple[int, int], tuple[str, ...]]:
    """(width, height) and the names of the channels, before a pixel is read.

    Raises:
        MivolError: missing, foreign or damaged.
    """
    with source.check_file(path).open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise refusal(path, "another kind of file (by its first bytes)", "OpenEXR", "name an .exr file")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
        names = tuple(channel.name for channel in header["channels"])
    except (RuntimeError, ValueError, IndexError, KeyError) as error:
        raise refusal(path, "a damaged OpenEXR file", "a whole one", "the file is truncated: copy it again") from error
    width, height = (int(n) for n in high - low + 1)
    return (width, height), names


def stack_layers(channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stack channels into layers: "R", "G", "B" become "" (rows, columns, 3), "a.R" ... become "a"; others stay.

    Args:
        channels: as :func:`read_exr` gives them.

    Returns:
        layer -> (rows, columns, 3 or 4), and single channels under their own name -> (rows, columns).
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
        raise refusal(path, f"pixels of type {array.dtype} in {name!r}", "real numbers", "convert them to float32")
    plane = np.ascontiguousarray(array, np.float32)
    if array.ndim == 2 and name:
        return {name: plane}
    if array.ndim == 3 and array.shape[2] in COMPONENTS:
        prefix = f"{name}." if name else ""
        letters = COMPONENTS[array.shape[2]]
        return {prefix + letter: np.ascontiguousarray(plane[..., i]) for i, letter in enumerate(letters)}
    raise refusal(
        path,
        f"{name!r} of shape {array.shape}",
        "(rows, columns) with a name or (rows, columns, 1, 3 or 4)",
        "reshape it",
    )


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
