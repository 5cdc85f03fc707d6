"""The pixels of a photograph: read, shrunk by area, put over a background, in the values that are fitted.

Conventions. Pictures are float32 (rows, columns, 3), the first row on top, alpha (rows, columns) in 0..1. **PNG and JPEG hold
sRGB code values 0..1 and OpenEXR files linear light, and each stays what it is unless the other is asked for**
(:data:`SPACES`); radiance fields of such photographs are usually fitted to the code values. A PNG whose gAMA chunk says 1 holds
linear light, and so do files of which the caller says it. PNG keeps colour apart from alpha, OpenEXR multiplied by it; here
all is multiplied by alpha before it is averaged or put over a background. Averages and backgrounds are taken in the values that
are fitted, as NeRF's protocol does. PNG of 16 bits a channel is read at full depth.

References: IEC 61966-2-1 (the sRGB curve); W3C PNG, section 11.3.2.2 (gAMA); Porter and Duff 1984 (SIGGRAPH), "over" with
multiplied alpha.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from mivol.files import encode_srgb, read_exr, read_exr_header
from mivol.files.source import check_file, refusal

__all__ = [
    "SPACES",
    "SUFFIXES",
    "PhotoHeader",
    "decode_srgb",
    "read_photo_header",
    "read_mask",
    "read_photo",
    "shrink",
    "find_colour_space",
]

#: suffixes of photographs, in the order in which a name without one is tried.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")

#: modes of Pillow that hold 8 bits a channel -> what they are read as.
MODES = {"1": "RGB", "L": "RGB", "LA": "RGBA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA", "RGBX": "RGB"}

GREY_16 = ("I;16", "I")
"""Modes of Pillow, old and new, of a grey PNG of 16 bits."""

ORIENTATION = 0x0112
"""The tag of EXIF that says how a viewer turns a picture (CIPA DC-008, section 4.6.4): 1 as it is, 6 a quarter turn, ..."""


def decode_srgb(code: np.ndarray) -> np.ndarray:
    """Code values 0..1 to linear light, by the sRGB curve (same shape)."""
    code = np.clip(code, 0, 1)
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


def _same(values: np.ndarray) -> np.ndarray:
    return values


#: (what the file holds, what is asked for) -> how to get there.
SPACES: dict[tuple[str, str], Callable[[np.ndarray], np.ndarray]] = {
    ("srgb", "srgb"): _same,
    ("linear", "linear"): _same,
    ("srgb", "linear"): decode_srgb,
    ("linear", "srgb"): encode_srgb,
}


def find_colour_space(path: Path, stored: str | None = None) -> str:
    """What the values of a file are: "linear" (OpenEXR, and a PNG that says so) or "srgb".

    Args:
        stored: what the caller says of PNG and JPEG.

    Raises:
        MivolError: missing or damaged file.
    """
    if path.suffix.lower() == ".exr":
        return "linear"
    if stored is not None:
        return stored
    with _opened(path) as image:
        return "linear" if image.info.get("gamma") == 1 else "srgb"


@dataclass(frozen=True)
class PhotoHeader:
    """What a file says before its pixels are read.

    Attributes:
        size: (width, height) as the pixels are stored.
        has_alpha: whether pixels have an opacity.
        orientation: EXIF's number, 1..8; 1 where it says none.
    """

    size: tuple[int, int]
    has_alpha: bool
    orientation: int = 1


def read_photo_header(path: Path) -> PhotoHeader:
    """The header of a photograph.

    Raises:
        MivolError: missing or damaged file.
    """
    if path.suffix.lower() == ".exr":
        size, names = read_exr_header(path)
        return PhotoHeader(size, "A" in names)
    with _opened(path) as image:
        orientation = image.getexif().get(ORIENTATION, 1) if "exif" in image.info else 1
        return PhotoHeader(image.size, _kind(image) == "RGBA", orientation)


def read_photo(path: Path, space: str, stored: str | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour multiplied by alpha (rows, columns, 3), and alpha (rows, columns) or None where the file has none.

    Args:
        path: PNG, JPEG or OpenEXR.
        space: "srgb" or "linear", what the values shall be.
        stored: what those of a PNG or JPEG are; None: as :func:`find_colour_space` says.

    Raises:
        MivolError: a damaged file, grey with alpha of 16 bits, channels that are no picture, NaN.
    """
    is_exr, stored = path.suffix.lower() == ".exr", find_colour_space(path, stored)
    colour, alpha = (_read_exr if is_exr else _read_codes)(path)
    if is_exr and alpha is not None:
        if space == "linear":
            return colour, alpha
        colour = colour / np.where(alpha > 0, alpha, 1)[..., None]
    colour = SPACES[stored, space](colour).astype(np.float32)
    return (colour if alpha is None else colour * alpha[..., None]), alpha


def read_mask(path: Path) -> np.ndarray:
    """(rows, columns) bool, False where a mask is black: such pixels count for nothing.

    Raises:
        MivolError: missing or damaged file.
    """
    with _opened(path) as image:
        return np.asarray(_loaded(image, path).convert("L")) > 0


def shrink(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The exact mean over the area of each new pixel, for any (width, height) not above the old.

    Args:
        image: (rows, columns) or (rows, columns, channels), multiplied by alpha where there is one.
        size: (width, height).
    """
    for axis, n in ((0, size[1]), (1, size[0])):
        image = _mean_over_pieces(image, axis, n)
    return image.astype(np.float32)


def _mean_over_pieces(image: np.ndarray, axis: int, n: int) -> np.ndarray:
    """Means over n equal pieces of an axis: differences of its integral, which is linear between pixel edges."""
    old = image.shape[axis]
    if n == old:
        return image
    values = np.moveaxis(image, axis, 0).astype(np.float64)
    if old % n == 0:
        return np.moveaxis(values.reshape(n, old // n, *values.shape[1:]).mean(axis=1), 0, axis)
    integral = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    edges = np.arange(n + 1) * (old / n)
    low = np.minimum(edges.astype(int), old - 1)
    part = (edges - low).reshape(-1, *[1] * (values.ndim - 1))
    at_edges = integral[low] + part * values[low]
    return np.moveaxis(np.diff(at_edges, axis=0) * (n / old), 0, axis)


def _kind(image: Image.Image) -> str:
    """ "RGB" or "RGBA": what a picture of 8 bits a channel is read as."""
    return "RGB" if image.mode == "P" and "transparency" not in image.info else MODES.get(image.mode, "RGB")


def _read_codes(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour not multiplied, and alpha: code values of 8 or 16 bits over the largest."""
    with _opened(path) as image:
        packed = image.tile[0][3] if image.format == "PNG" and image.tile else ""
        if image.mode in GREY_16:
            codes = np.asarray(_loaded(image, path), np.float32)
            return np.repeat(codes[..., None] / np.float32(65535), 3, axis=2), None
        if packed in ("RGB;16B", "RGBA;16B"):
            values = _read_16_bit(path, packed)
        elif image.mode not in MODES or packed == "LA;16B":
            found = f"pixels of the kind {image.mode}" if image.mode not in MODES else "grey with alpha of 16 bits"
            raise refusal(path, found, "grey, RGB or RGBA of 8 bits, grey or RGB of 16", "convert it, or use OpenEXR")
        else:
            values = np.asarray(_loaded(image, path).convert(_kind(image)), np.float32) / np.float32(255)
    return (values[..., :3], values[..., 3]) if values.shape[-1] == 4 else (values, None)


def _read_16_bit(path: Path, packed: str) -> np.ndarray:
    """Codes of 16 bits over the largest.

    Pillow keeps the first byte of each number, which is its high one in a PNG. Told that low bytes come first, it keeps the
    second.
    """
    halves = []
    for order in (packed, packed.replace("16B", "16L")):
        with _opened(path) as image:
            image.tile = [(codec, extents, offset, order) for codec, extents, offset, _ in image.tile]
            halves.append(np.asarray(_loaded(image, path), np.float32))
    return (256 * halves[0] + halves[1]) / np.float32(65535)


def _read_exr(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour multiplied by alpha, and alpha."""
    channels, _ = read_exr(path)
    names = [name for name in ("RGB", "Y") if all(letter in channels for letter in name)]
    if not names:
        raise refusal(path, f"the channels {', '.join(channels)}", "R, G, B or Y", "name the picture's channels so")
    colour = np.stack([channels[letter] for letter in (names[0] * 3)[:3]], axis=-1)
    alpha = channels.get("A")
    for values in (colour, alpha):
        if values is not None and not np.isfinite(values).all():
            row, column = (int(i) for i in np.argwhere(~np.isfinite(values))[0][:2])
            raise refusal(path, f"NaN or infinity at row {row}, column {column}", "finite numbers", "render it again")
    return colour, alpha


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image of which the header is read; of any size, since what its pixels take is counted before they are read."""
    bound, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        image = Image.open(check_file(path))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise _damaged(path) from error
    finally:
        Image.MAX_IMAGE_PIXELS = bound
    with image:
        yield image


def _loaded(image: Image.Image, path: Path) -> Image.Image:
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise _damaged(path) from error
    return image


def _damaged(path: Path) -> Exception:
    return refusal(path, "a damaged or foreign file", "a PNG, JPEG or OpenEXR image", "copy it again")
