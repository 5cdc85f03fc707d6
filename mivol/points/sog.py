"""Gaussians in SOG, PlayCanvas' delivery format: images in a ZIP archive, read (version 2) and written.

Own reader: gaussforge 0.6 ends Python with a segmentation fault if ``count`` is larger than the images.

Layout. ``meta.json`` names lossless WebP images of the same size, a pixel for each Gaussian, row by row. Positions are 16 bits
over the range of each axis of ``sign(x) log(1 + |x|)``, low and high bytes in two images. Logarithms of scales and coefficients
of degree 0 are numbers of entries of a table of 256 values each; alpha of the latter is the opacity. Of the unit quaternion
(w, x, y, z) the number of its largest entry is alpha less 252, the others are bytes over -1/sqrt(2)..1/sqrt(2). Higher
harmonics are numbers of rows of a palette, low and high byte; the palette has 64 rows in a line of its image, a pixel for each
coefficient, and its bytes are numbers of entries of a table of 256 values.

Errors. Tables of 256 values are fitted to the values (Lloyd 1982). Up to 65536 different sets of harmonics the palette holds
them all; of more it holds ``FEWER`` means of similar sets.

Source: PlayCanvas' documentation of SOG and its open-source converter splat-transform (MIT licence).
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import PIL.Image

from mivol.files.npy import check_memory
from mivol.files.source import read_bytes, refusal
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, complete_quaternions, logit

META = "meta.json"
VERSION = 2
CODES = 256
"""Entries of a table."""

MOST, FEWER = 65536, 4096
"""Largest palette, and the size of a palette of means."""

IN_A_LINE = 64
"""Rows of the palette in a line of its image."""

ROUNDS = 8
"""Rounds of Lloyd's algorithm."""

FIRST_TAG = 252
"""Alpha of a quaternion whose largest entry is w."""

LARGEST_IMAGE = 16384
"""Longest edge of an image in WebP [pixel]."""


def write_sog(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write Gaussians along a curve through space, which compresses best (Morton 1966)."""
    sorted_ones = gaussians.select(morton_order(gaussians.means))
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": "mivol"}, "count": gaussians.count, "antialias": False}
    images: dict[str, np.ndarray] = {}
    for encode in (_encode_means, _encode_scales, _encode_quaternions, _encode_colours, _encode_harmonics):
        encode(sorted_ones, meta, images)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, image in images.items():
            # A fixed time: the same Gaussians give the same file.
            archive.writestr(zipfile.ZipInfo(name), _to_webp(image))
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))


def read_sog(path: Path) -> Gaussians:
    """Read a ``.sog``; the opacity 255 of 255 becomes the logit inf, 0 becomes -inf.

    Raises:
        MivolError: another format or version, a missing image or one of another size, or a damaged archive.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            meta = json.loads(archive.read(META))
            if meta.get("version") != VERSION:
                raise refusal(
                    path, f"version {meta.get('version')}", f"version {VERSION}", "write it again with a newer program"
                )
            count = int(meta["count"])
            check_memory(path, 256 * count)
            return _decode(path, meta, count, archive)
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, IndexError, PIL.UnidentifiedImageError, OSError) as error:
        raise refusal(path, f"a damaged SOG ({error})", "meta.json and its images in a ZIP archive", "copy it again") from error


def morton_order(places: np.ndarray) -> np.ndarray:
    """Numbers of places (N, 3) along the Z-curve of a grid of 1024^3 cells around them."""
    low, size = places.min(axis=0), np.maximum(np.ptp(places, axis=0), 1e-30)
    cells = np.minimum((places - low) / size * 1024, 1023).astype(np.uint64)
    code = np.zeros(len(places), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def fit_table(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A table (256,) that fits values, ascending, and the number of the nearest entry for each value, uint8.

    Lloyd's algorithm for one dimension, from evenly spaced quantiles and evenly spaced values: the latter serve rare values at
    the ends. Few different values are kept exactly.
    """
    flat = np.sort(values.astype(np.float64).reshape(-1))
    different = np.unique(flat)
    if len(different) <= CODES:
        table = np.concatenate([different, np.full(CODES - len(different), different[-1])])
    else:
        half = CODES // 2
        even = np.linspace(flat[0], flat[-1], half)
        table = np.sort(np.concatenate([np.quantile(flat, (np.arange(half) + 0.5) / half), even]))
        total = np.concatenate([[0.0], np.cumsum(flat)])
        for _ in range(ROUNDS):
            ends = np.concatenate([[0], np.searchsorted(flat, (table[1:] + table[:-1]) / 2), [len(flat)]])
            sizes = np.diff(ends)
            table = np.where(sizes > 0, np.diff(total[ends]) / np.maximum(sizes, 1), table)
    codes = np.searchsorted((table[1:] + table[:-1]) / 2, values)
    return table.astype(np.float32), np.minimum(codes, CODES - 1).astype(np.uint8)


def fit_palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A palette of rows (n, width) that fits rows (N, width), and the number of the entry of each row.

    Up to ``MOST`` different rows are kept exactly; otherwise Lloyd's algorithm starts from evenly spaced rows.
    """
    palette, numbers = np.unique(rows, axis=0, return_inverse=True)
    if len(palette) <= MOST:
        return palette, numbers.reshape(-1)
    palette = rows[np.linspace(0, len(rows) - 1, FEWER).astype(int)]
    for _ in range(ROUNDS):
        numbers = _nearest(rows, palette)
        sizes = np.bincount(numbers, minlength=len(palette))
        sums = np.stack([np.bincount(numbers, column, len(palette)) for column in rows.T], axis=1)
        palette = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], palette).astype(np.float32)
    return palette, _nearest(rows, palette)


def _nearest(rows: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Number of the nearest row of the palette for each row, block by block."""
    squares = (palette**2).sum(axis=1)
    blocks = [np.argmin(squares - 2 * rows[k : k + 4096] @ palette.T, axis=1) for k in range(0, len(rows), 4096)]
    return np.concatenate(blocks)


# -- To images ---------------------------------------------------------------------------------------------------------


def _to_pixels(bytes_: np.ndarray, alpha: np.ndarray | int = 255) -> np.ndarray:
    """An image uint8 (H, W, 4), nearly square, of (N, 3) bytes; unused pixels are 0."""
    count = len(bytes_)
    width = 4 * int(np.ceil(np.sqrt(count) / 4))
    height = 4 * int(np.ceil(count / width / 4))
    image = np.zeros((width * height, 4), np.uint8)
    image[:count, :3], image[:count, 3] = bytes_, alpha
    return image.reshape(height, width, 4)


def _to_webp(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    # exact: colours of clear pixels are kept.
    PIL.Image.fromarray(image, "RGBA").save(buffer, "WEBP", lossless=True, exact=True, quality=60, method=4)
    return buffer.getvalue()


def _encode_means(gaussians: Gaussians, meta: dict, images: dict) -> None:
    means = gaussians.means.astype(np.float64)
    folded = np.sign(means) * np.log1p(np.abs(means))
    low, high = folded.min(axis=0), folded.max(axis=0)
    steps = np.round((folded - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    images["means_l.webp"], images["means_u.webp"] = _to_pixels(steps & 255), _to_pixels(steps >> 8)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _encode_scales(gaussians: Gaussians, meta: dict, images: dict) -> None:
    table, codes = fit_table(gaussians.log_scales)
    images["scales.webp"] = _to_pixels(codes)
    meta["scales"] = {"codebook": table.tolist(), "files": ["scales.webp"]}


def _encode_quaternions(gaussians: Gaussians, meta: dict, images: dict) -> None:
    unit = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    largest, rows = np.argmax(np.abs(unit), axis=1), np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1, 1)[:, None]
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = np.clip(np.round((others * np.sqrt(2) + 1) / 2 * 255), 0, 255).astype(np.uint8)
    images["quats.webp"] = _to_pixels(codes, (FIRST_TAG + largest).astype(np.uint8))
    meta["quats"] = {"files": ["quats.webp"]}


def _encode_colours(gaussians: Gaussians, meta: dict, images: dict) -> None:
    table, codes = fit_table(gaussians.harmonics[:, 0])
    images["sh0.webp"] = _to_pixels(codes, np.round(255 * gaussians.opacities()).astype(np.uint8))
    meta["sh0"] = {"codebook": table.tolist(), "files": ["sh0.webp"]}


def _encode_harmonics(gaussians: Gaussians, meta: dict, images: dict) -> None:
    if gaussians.degree == 0:
        return
    coefficients = gaussians.harmonics.shape[1] - 1
    palette, numbers = fit_palette(gaussians.harmonics[:, 1:].reshape(gaussians.count, -1))
    table, codes = fit_table(palette)
    lines = -(-len(palette) // IN_A_LINE)
    image = np.zeros((lines * IN_A_LINE, coefficients, 4), np.uint8)
    image[: len(palette), :, :3], image[..., 3] = codes.reshape(len(palette), coefficients, 3), 255
    images["shN_centroids.webp"] = image.reshape(lines, IN_A_LINE * coefficients, 4)
    images["shN_labels.webp"] = _to_pixels(np.stack([numbers & 255, numbers >> 8, numbers * 0], axis=1).astype(np.uint8))
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta["shN"] = {"count": len(palette), "bands": gaussians.degree, "codebook": table.tolist(), "files": files}


# -- From images -------------------------------------------------------------------------------------------------------


def _decode(path: Path, meta: dict, count: int, archive: zipfile.ZipFile) -> Gaussians:
    def pixels(part: str, number: int = 0) -> np.ndarray:
        """The pixels (n, 4) of an image of a part."""
        return _read_image(path, archive.read(meta[part]["files"][number])).reshape(-1, 4)

    def rows(part: str, number: int = 0) -> np.ndarray:
        """The pixels (count, 4) of an image with one a Gaussian."""
        found = pixels(part, number)
        if count < 1 or len(found) < count:
            raise refusal(path, f"{len(found)} pixels of {part}", f"{count}", "write the file again")
        return found[:count]

    steps = rows("means")[:, :3].astype(np.int32) | rows("means", 1)[:, :3].astype(np.int32) << 8
    low, high = (np.array(meta["means"][end], np.float64) for end in ("mins", "maxs"))
    folded = low + (high - low) * (steps / 65535)
    colours, quaternions = rows("sh0"), rows("quats")
    harmonics = np.array(meta["sh0"]["codebook"], np.float64)[colours[:, None, :3]]
    if "shN" in meta:
        harmonics = np.concatenate([harmonics, _decode_harmonics(path, meta["shN"], pixels("shN"), rows("shN", 1))], axis=1)
    which = quaternions[:, 3].astype(np.int64) - FIRST_TAG
    if which.min() < 0:
        raise refusal(path, f"a quaternion with the mark {which.min() + FIRST_TAG}", "252 to 255", "write the file again")
    return Gaussians(
        np.sign(folded) * np.expm1(np.abs(folded)),
        np.array(meta["scales"]["codebook"], np.float64)[rows("scales")[:, :3]],
        complete_quaternions((quaternions[:, :3] / 255 * 2 - 1) / np.sqrt(2), which),
        logit(colours[:, 3] / 255),
        harmonics,
    )


def _decode_harmonics(path: Path, about: dict, centroids: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Coefficients above degree 0, (N, K - 1, 3)."""
    degree = int(about["bands"])
    if not 1 <= degree <= HIGHEST_DEGREE:
        raise refusal(path, f"harmonics of degree {degree}", f"1 to {HIGHEST_DEGREE}", "write the file again")
    coefficients = (degree + 1) ** 2 - 1
    numbers = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    palette = centroids[: len(centroids) // coefficients * coefficients, :3].reshape(-1, coefficients, 3)
    if numbers.max() >= min(len(palette), int(about["count"])):
        raise refusal(
            path, f"number {numbers.max()} of a palette of {about['count']}", "a number in it", "write the file again"
        )
    return np.array(about["codebook"], np.float64)[palette[numbers]]


def _read_image(path: Path, data: bytes) -> np.ndarray:
    """An image uint8 (H, W, 4)."""
    with PIL.Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        if max(image.size) > LARGEST_IMAGE:
            raise refusal(path, f"an image of {image.size} pixels", f"at most {LARGEST_IMAGE}", "write the file again")
        return np.asarray(image.convert("RGBA"))
