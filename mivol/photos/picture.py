"""The pixels of a photograph: read, shrunk by area, put over a background, in the values that are fitted.

Conventions. Pictures are float32 (rows, columns, 3), the first row on top, alpha (rows, columns) in 0..1. **8-bit files hold
sRGB code values 0..1 and OpenEXR files linear light, and each stays what it is unless the other is asked for**
(:data:`SPACES`); radiance fields of 8-bit photographs are usually fitted to the code values. PNG keeps colour apart from alpha,
OpenEXR multiplied by it; here all is multiplied by alpha before it is averaged or put over a background. Averages and
backgrounds are taken in the values that are fitted, as NeRF's protocol does.

Reference: IEC 61966-2-1 (the sRGB curve); Porter and Duff 1984 (SIGGRAPH), "over" with multiplied alpha.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from mivol.files import encode_srgb, read_exr
from mivol.files.source import existing_file, refusal

__all__ = ["SPACES", "SUFFIXES", "decode_srgb", "picture_size", "read_mask", "read_picture", "shrink", "space_of"]

#: suffixes of photographs, in the order in which a name without one is tried.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")

#: modes of Pillow that hold 8 bits a channel -> what they are read as.
MODES = {"1": "RGB", "L": "RGB", "LA": "RGBA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA", "RGBX": "RGB"}


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


def space_of(path: Path) -> str:
    """What the values of a file are, by its suffix: "linear" (OpenEXR) or "srgb"."""
    return "linear" if path.suffix.lower() == ".exr" else "srgb"


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header.

    Raises:
        MivolError: missing or damaged file.
    """
    if path.suffix.lower() == ".exr":
        rows, columns = next(iter(read_exr(path)[0].values())).shape
        return columns, rows
    with _opened(path) as image:
        return image.size


def read_picture(path: Path, space: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour multiplied by alpha (rows, columns, 3), and alpha (rows, columns) or None where the file has none.

    Args:
        path: PNG, JPEG or OpenEXR.
        space: "srgb" or "linear", what the values shall be.

    Raises:
        MivolError: a damaged file, more than 8 bits in a PNG, channels that are no picture, NaN.
    """
    stored = space_of(path)
    colour, alpha = (_read_exr if stored == "linear" else _read_8_bit)(path)
    if stored == "linear" and alpha is not None:
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


def _read_8_bit(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour not multiplied, and alpha."""
    with _opened(path) as image:
        if image.mode not in MODES:
            raise refusal(
                path, f"pixels of the kind {image.mode}", "8 bits a channel, grey or RGB", "convert it, or use OpenEXR"
            )
        kind = "RGB" if image.mode == "P" and "transparency" not in image.info else MODES[image.mode]
        values = np.asarray(_loaded(image, path).convert(kind), np.float32) / np.float32(255)
    return (values[..., :3], values[..., 3]) if kind == "RGBA" else (values, None)


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


def _opened(path: Path) -> Image.Image:
    try:
        return Image.open(existing_file(path))
    except (UnidentifiedImageError, OSError) as error:
        raise _damaged(path) from error


def _loaded(image: Image.Image, path: Path) -> Image.Image:
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise _damaged(path) from error
    return image


def _damaged(path: Path) -> Exception:
    return refusal(path, "a damaged or foreign file", "a PNG, JPEG or OpenEXR image", "copy it again")
