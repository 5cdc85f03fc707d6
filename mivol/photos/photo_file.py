"""The image file of a photograph: header, pixels and mask.

Conventions. Images are float32 (rows, columns, 3), row 0 at the top; alpha is (rows, columns) in 0..1. **PNG and JPEG hold
sRGB code values 0..1, OpenEXR holds linear light, and no value is converted unless the caller asks for the other space**
(:data:`CONVERSIONS`). Radiance fields are usually fitted to the code values. A PNG with a gAMA chunk of 1 holds linear light,
and the caller can declare other files linear. PNG stores colour without alpha, OpenEXR stores colour multiplied by alpha. Here
colour is multiplied by alpha before averaging and before blending over a background. Both happen in the values of the fit, as
in NeRF's protocol. PNG of 16 bits per channel is read at full depth.

References: IEC 61966-2-1 (the sRGB curve); W3C PNG, section 11.3.2.2 (gAMA); Porter and Duff 1984 (SIGGRAPH), "over" with
multiplied alpha.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from mivol.errors import MivolError
from mivol.files import decode_srgb, encode_srgb, read_exr, read_exr_header
from mivol.files.source import check_file, refusal

#: suffixes of photographs, in the order of the trials for a name without suffix.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".webp", ".heic", ".heif", ".avif")

HEIC = (".heic", ".heif")
"""Suffixes that Pillow reads with pillow-heif alone."""

#: mode of Pillow with 8 bits per channel -> mode after reading.
MODES = {"1": "RGB", "L": "RGB", "LA": "RGBA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA", "RGBX": "RGB"}

GREY_16 = ("I;16", "I")
"""Modes of Pillow, old and new, for a grey PNG of 16 bits."""

ORIENTATION = 0x0112
"""EXIF tag of the rotation by image viewers (CIPA DC-008, section 4.6.4): 1 none, 6 a quarter turn, ..."""

#: orientation of EXIF -> function from stored pixels (rows, columns, ...) to upright pixels.
TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: np.swapaxes(image, 0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.swapaxes(image[::-1, ::-1], 0, 1),
    8: lambda image: np.rot90(image),
}


#: (space of the file, requested space) -> conversion.
CONVERSIONS: dict[tuple[str, str], Callable[[np.ndarray], np.ndarray]] = {
    ("srgb", "srgb"): lambda values: values,
    ("linear", "linear"): lambda values: values,
    ("srgb", "linear"): decode_srgb,
    ("linear", "srgb"): encode_srgb,
}


def find_colour_space(path: Path, stored: str | None) -> str:
    """Return the colour space of a file: "linear" (OpenEXR, and PNG with a gAMA chunk of 1) or "srgb".

    Args:
        path: PNG, JPEG or OpenEXR.
        stored: colour space of PNG and JPEG files according to the caller, optional.

    Raises:
        MivolError: a missing or damaged file.
    """
    if path.suffix.lower() == ".exr":
        return "linear"
    if stored is not None:
        return stored
    with _opened(path) as image:
        return "linear" if image.info.get("gamma") == 1 else "srgb"


@dataclass(frozen=True)
class PhotoHeader:
    """The header of an image file.

    Attributes:
        size: (width, height) of the stored pixels.
        has_alpha: whether pixels have an opacity.
        orientation: orientation of EXIF in 1..8, by default 1.
    """

    size: tuple[int, int]
    has_alpha: bool
    orientation: int = 1

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) after the turn by the orientation."""
        return self.size[::-1] if self.orientation > 4 else self.size


def read_photo_header(path: Path) -> PhotoHeader:
    """Read the header of a photograph.

    Raises:
        MivolError: a missing or damaged file.
    """
    if path.suffix.lower() == ".exr":
        size, names = read_exr_header(path)
        return PhotoHeader(size, "A" in names)
    with _opened(path) as image:
        orientation = image.getexif().get(ORIENTATION, 1) if "exif" in image.info else 1
        return PhotoHeader(image.size, _read_mode(image) == "RGBA", orientation)


LENS_TAGS = {0x010F: None, 0x0110: None, 0xA434: 0x8769, 0x920A: 0x8769, 0xA405: 0x8769}
"""EXIF tags of make, model, lens, focal length and its equivalent, with the directory of the tag."""


def read_lens_facts(path: Path) -> tuple:
    """Return what tells the lenses of photographs apart: the upright size, and the ``LENS_TAGS`` of EXIF (None if missing).

    Raises:
        MivolError: a missing or damaged file.
    """
    size = read_photo_header(path).upright_size
    if path.suffix.lower() == ".exr":
        return (size,)
    with _opened(path) as image:
        exif = image.getexif()
        tables = {None: exif, 0x8769: exif.get_ifd(0x8769)}
        return (size, *(str(tables[table].get(tag)) for tag, table in LENS_TAGS.items()))


def is_damaged(path: Path) -> bool:
    """Return whether a photograph cannot be decoded, such as half of a JPEG, or a JPEG with a foreign piece in its middle.

    A JPEG is decoded at an eighth of its size, which takes a fraction of the time.

    Raises:
        MivolError: a HEIC image on a machine without pillow-heif.
    """
    if path.suffix.lower() in HEIC:
        _register_heif(path)
    try:
        if path.suffix.lower() == ".exr":
            _read_exr(path)
            return False
        with _opened(path) as image:
            image.draft(None, (1, 1))
            _loaded(image, path)
            return image.format in ("JPEG", "MPO") and not _reads_to_the_end(path.read_bytes(), np.asarray(image))
    except MivolError:
        return True


MARKER = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")
"""The end of the codes of a JPEG: a marker other than a restart (ITU-T T.81, B.1.1)."""

RESTART = re.compile(rb"\xff([\xd0-\xd7])")

START_OF_SCAN, END_OF_IMAGE = 0xDA, 0xD9


def _reads_to_the_end(data: bytes, pixels: np.ndarray) -> bool:
    """Whether the codes of a JPEG give all of its pixels and no more.

    Codes have different lengths, so after a foreign piece the decoder reads codes in wrong places, which is no error, and ends
    too early or too late. Then bytes that are added after the codes change pixels, or other bytes in the place of the last ones
    change none. Not noticed are an end that is a few pixels off in a flat part, and a piece in the later scans of a progressive
    JPEG, which change nothing at an eighth of the size.

    Args:
        data: the file.
        pixels: the image at an eighth of its size, of any shape.
    """
    scans = _find_scans(data)
    longer, last = b"", 0
    for start, end in scans:
        codes = data[start:end]
        restarts = [mark[0] - 0xD0 for mark in RESTART.findall(codes)]
        if any(number != n % 8 for n, number in enumerate(restarts)):
            return False
        longer += data[last:start] + RESTART.sub(lambda mark: ADDED + mark[0], codes) + ADDED
        last = end
    if not scans or not np.array_equal(_decode_small(longer + data[last:]), pixels):
        return False
    start, end = scans[0]
    other = data[: max(start, end - len(ADDED))].rstrip(b"\xff") + ADDED + data[end:]
    return not np.array_equal(_decode_small(other), pixels)


ADDED = bytes(range(1, 255))
"""Bytes beside the codes of a JPEG: different ones, so that they change pixels if a decoder reads them."""


def _find_scans(data: bytes) -> list[tuple[int, int]]:
    """First byte and end of the codes of each scan of a JPEG; what follows its end, such as a film, is ignored."""
    scans, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != END_OF_IMAGE:
        kind, at = data[at + 1], at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == START_OF_SCAN:
            marker = MARKER.search(data, at)
            if marker is None:
                return scans
            scans.append((at, marker.start()))
            at = marker.end() - 2
    return scans


def _decode_small(data: bytes) -> np.ndarray | None:
    """The pixels of a JPEG at an eighth of its size; None if it cannot be decoded."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.draft(None, (1, 1))
            return np.asarray(image)
    except (OSError, SyntaxError, ValueError):
        return None


def write_upright(path: Path, copy: Path, orientation: int) -> None:
    """Write sRGB codes of a photograph, turned by an orientation of ``TURNS``, as JPEG for a name of JPEG and else as PNG.

    EXIF stays, for the focal length.

    Raises:
        MivolError: a damaged photograph.
    """
    colour, _ = read_photo(path, "srgb", orientation=orientation)
    exif = None
    if path.suffix.lower() != ".exr":
        with _opened(path) as image:
            exif = image.getexif()
            exif[ORIENTATION] = 1
    codes = np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)
    kind = {"format": "JPEG", "quality": 95} if path.suffix.lower() in (".jpg", ".jpeg") else {"format": "PNG"}
    Image.fromarray(codes).save(copy, exif=exif, **kind)


def read_photo(path: Path, space: str, stored: str | None = None, orientation: int = 1) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the pixels of a photograph.

    Args:
        path: OpenEXR, or any image that Pillow reads.
        space: requested colour space, "srgb" or "linear".
        stored: colour space of other files than OpenEXR, by default the result of :func:`find_colour_space`.
        orientation: key of ``TURNS``, by which the stored pixels are turned.

    Returns:
        Colour multiplied by alpha (rows, columns, 3), and alpha (rows, columns), or None for a file without alpha.

    Raises:
        MivolError: a damaged file, 16-bit grey with alpha, missing colour channels, or NaN.
    """
    is_exr, stored = path.suffix.lower() == ".exr", find_colour_space(path, stored)
    colour, alpha = (_read_exr if is_exr else _read_codes)(path)
    if is_exr and alpha is not None:
        if space == "linear":
            return colour, alpha
        colour = colour / np.where(alpha > 0, alpha, 1)[..., None]
    colour = np.ascontiguousarray(TURNS[orientation](CONVERSIONS[stored, space](colour)), np.float32)
    alpha = None if alpha is None else np.ascontiguousarray(TURNS[orientation](alpha))
    return (colour if alpha is None else colour * alpha[..., None]), alpha


def read_mask(path: Path) -> np.ndarray:
    """Read a mask (rows, columns): False for black pixels, which a fit ignores.

    Raises:
        MivolError: a missing or damaged file.
    """
    with _opened(path) as image:
        return np.asarray(_loaded(image, path).convert("L")) > 0


def shrink(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Shrink an image by exact means over the area of each new pixel.

    Args:
        image: (rows, columns) or (rows, columns, channels), already multiplied by alpha.
        size: new (width, height), at most the old size.
    """
    for axis, n in ((0, size[1]), (1, size[0])):
        image = _mean_over_pieces(image, axis, n)
    return image.astype(np.float32)


def _mean_over_pieces(image: np.ndarray, axis: int, n: int) -> np.ndarray:
    """Means over n equal pieces of an axis, as differences of the integral, which is linear between pixel edges."""
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


def _read_mode(image: Image.Image) -> str:
    """The mode, "RGB" or "RGBA", after reading an image of 8 bits per channel."""
    return "RGB" if image.mode == "P" and "transparency" not in image.info else MODES.get(image.mode, "RGB")


def _read_codes(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour without alpha, and alpha: codes of 8 or 16 bits divided by the largest code."""
    with _opened(path) as image:
        packed = image.tile[0][3] if image.format == "PNG" and image.tile else ""
        if image.mode in GREY_16:
            codes = np.asarray(_loaded(image, path), np.float32)
            return np.repeat(codes[..., None] / np.float32(65535), 3, axis=2), None
        if packed in ("RGB;16B", "RGBA;16B"):
            values = _read_16_bit(path, packed)
        elif image.mode not in MODES or packed == "LA;16B":
            found = f"pixels of mode {image.mode}" if image.mode not in MODES else "16-bit grey with alpha"
            raise refusal(path, found, "grey, RGB or RGBA of 8 bits, or grey or RGB of 16", "convert the file")
        else:
            values = np.asarray(_loaded(image, path).convert(_read_mode(image)), np.float32) / np.float32(255)
    return (values[..., :3], values[..., 3]) if values.shape[-1] == 4 else (values, None)


def _read_16_bit(path: Path, packed: str) -> np.ndarray:
    """Codes of 16 bits divided by the largest code.

    Pillow keeps the first byte of each number, the high byte in a PNG. Declaring the other byte order makes Pillow keep the
    low byte.
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
        raise refusal(path, f"the channels {', '.join(channels)}", "R, G, B or Y", "rename the channels")
    colour = np.stack([channels[letter] for letter in (names[0] * 3)[:3]], axis=-1)
    alpha = channels.get("A")
    for values in (colour, alpha):
        if values is not None and not np.isfinite(values).all():
            row, column = (int(i) for i in np.argwhere(~np.isfinite(values))[0][:2])
            raise refusal(path, f"NaN or infinity at row {row}, column {column}", "finite numbers", "render the image again")
    return colour, alpha


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image and read its header. The size is unlimited, because the caller checks the memory before reading pixels."""
    if path.suffix.lower() in HEIC:
        _register_heif(path)
    bound, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        image = Image.open(check_file(path))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise _damaged(path) from error
    finally:
        Image.MAX_IMAGE_PIXELS = bound
    with image:
        yield image


def _register_heif(path: Path) -> None:
    """Teach Pillow to read HEIC.

    Raises:
        MivolError: a machine without pillow-heif.
    """
    try:
        import pillow_heif
    except ImportError:
        found, advice = (
            "a HEIC image, which Pillow does not read alone",
            'install it with pip install "mivol[heic]", or convert the file',
        )
        raise refusal(path, found, "the package pillow-heif", advice) from None
    pillow_heif.register_heif_opener()


def _loaded(image: Image.Image, path: Path) -> Image.Image:
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise _damaged(path) from error
    return image


def _damaged(path: Path) -> Exception:
    return refusal(path, "a damaged or foreign file", "a PNG, JPEG, WebP or OpenEXR image", "copy the file again")
