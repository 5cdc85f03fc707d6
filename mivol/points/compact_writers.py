"""Writers of compact files of Gaussians: ``.splat``, ``.ksplat`` (level 0) and ``.spz`` (version 3).

Conventions. The formats are described in :mod:`mivol.points.compact_files`. Rounding is to the nearest step. What a format
does not hold is left out with a warning: ``.splat`` has no harmonics above degree 0, ``.ksplat`` none above degree 2.
"""

from __future__ import annotations

import gzip
import struct
import warnings
from typing import BinaryIO

import numpy as np

from mivol.files.source import refusal
from mivol.points.compact_files import (
    COLOUR_SCALE,
    HEAD,
    HEADER_SIZE,
    PARITY,
    RECORD,
    SECTION_HEADER_SIZE,
    SPZ_MAGIC,
)
from mivol.points.gaussians import Gaussians

FRACTION_BITS = 12
"""Bits behind the point of a position in ``.spz``, unless coordinates are large."""

HIGHEST_KSPLAT = 2
"""Highest degree of harmonics in a ``.ksplat``."""


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _unit(gaussians: Gaussians) -> np.ndarray:
    """Unit quaternions (N, 4), (w, x, y, z)."""
    return gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)


def _leave_out(gaussians: Gaussians, degree: int, suffix: str) -> Gaussians:
    """The Gaussians with harmonics up to a degree; a warning if that leaves some out."""
    if gaussians.degree <= degree:
        return gaussians
    text = f"a {suffix} holds harmonics up to degree {degree}: those of degree {degree + 1} to {gaussians.degree} are left out."
    warnings.warn(text, RuntimeWarning, stacklevel=4)
    return gaussians.with_degree(degree)


def write_splat(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write a ``.splat``."""
    plain = _leave_out(gaussians, 0, ".splat")
    table = np.empty(plain.count, RECORD)
    table["mean"], table["scale"] = plain.means, plain.scales()
    table["colour"], table["opacity"] = _to_bytes(255 * plain.base_colours()), _to_bytes(255 * plain.opacities())
    table["quaternion"] = _to_bytes(128 + 128 * _unit(plain))
    file.write(table.tobytes())


def write_ksplat(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write a ``.ksplat`` of one section with float32 numbers; colours and opacities have 8 bits."""
    kept = _leave_out(gaussians, HIGHEST_KSPLAT, ".ksplat")
    count, higher = kept.count, 3 * ((kept.degree + 1) ** 2 - 1)
    fields = [("mean", "<f4", 3), ("scale", "<f4", 3), ("quaternion", "<f4", 4), ("colour", "u1", 3), ("opacity", "u1")]
    record = np.dtype([*fields, ("harmonics", "<f4", higher)])
    table = np.empty(count, record)
    table["mean"], table["scale"], table["quaternion"] = kept.means, kept.scales(), _unit(kept)
    table["colour"], table["opacity"] = _to_bytes(255 * kept.base_colours()), _to_bytes(255 * kept.opacities())
    bands = [kept.harmonics[:, d * d : (d + 1) ** 2] for d in range(1, kept.degree + 1)]
    rows = [np.swapaxes(band, 1, 2).reshape(count, -1) for band in bands]
    table["harmonics"] = np.concatenate([np.empty((count, 0), np.float32), *rows], axis=1)
    header, section = bytearray(HEADER_SIZE), bytearray(SECTION_HEADER_SIZE)
    struct.pack_into("<BB2xIIIIH", header, 0, 0, 1, 1, 1, count, count, 0)
    struct.pack_into("<IIIIfH2xIIIIH", section, 0, count, count, 0, 0, 0.0, 0, 0, table.nbytes, 0, 0, kept.degree)
    file.write(bytes(header) + bytes(section) + table.tobytes())


def write_spz(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write an ``.spz`` of version 3.

    Raises:
        MivolError: coordinates beyond 2^23.
    """
    largest = float(np.abs(gaussians.means).max(initial=0))
    if largest >= 1 << 23:
        raise refusal("an .spz", f"coordinates up to {largest:.3g}", "less than 2^23", "scale the scene, or write a .ply")
    bits = min(FRACTION_BITS, int(np.floor(np.log2(((1 << 23) - 1) / max(largest, 1e-6)))))
    fixed = np.round(gaussians.means.astype(np.float64) * [1, -1, -1] * 2.0**bits).astype(np.int32)
    positions = np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16 & 255], axis=2).astype(np.uint8)
    harmonics = gaussians.harmonics * PARITY[: gaussians.harmonics.shape[1], None]
    attributes = [
        positions,
        _to_bytes(255 * gaussians.opacities()),
        _to_bytes(255 * (0.5 + COLOUR_SCALE * harmonics[:, 0])),
        _to_bytes(16 * (gaussians.log_scales + 10)),
        _pack_smallest_three(_unit(gaussians) * [1, 1, -1, -1]),
        _to_bytes(128 + 128 * harmonics[:, 1:]),
    ]
    head = HEAD.pack(SPZ_MAGIC, 3, gaussians.count, gaussians.degree, bits, 0, 0)
    # No time in the header: the same Gaussians give the same file.
    file.write(gzip.compress(head + b"".join(array.tobytes() for array in attributes), mtime=0))


def _pack_smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """Words (N,) of unit quaternions (w, x, y, z): see :mod:`mivol.points.compact_files`."""
    entries = np.roll(quaternions, -1, axis=1)
    largest = np.argmax(np.abs(entries), axis=1)
    rows = np.arange(len(entries))
    entries = entries * np.where(entries[rows, largest] < 0, -1, 1)[:, None]
    others = entries[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = np.round(np.abs(others) * np.sqrt(2) * 511).astype(np.uint32)
    codes = np.minimum(codes, 511) | (others < 0).astype(np.uint32) << 9
    word = largest.astype(np.uint32) << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]
    return word.astype("<u4")
