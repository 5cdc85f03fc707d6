"""Raw bytes of a volume: with size and type from the caller, or by a header of NRRD or MetaImage beside them.

Conventions. Numbers fill the file, x fastest, then y, then z. Raw bytes have no place: voxels are unit cubes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import refusal
from mivol.files.volume import VolumeData, frame_from_steps, to_values

SUFFIXES = (".raw", ".img")
"""Suffixes of raw bytes; other suffixes count by their contents."""

HEADERS = (".nhdr", ".mhd")
"""Suffixes of headers that name a file of raw bytes."""


def find_header(path: Path) -> Path | None:
    """Return the header beside a file that has its name (``a.nhdr`` or ``a.raw.nhdr`` for ``a.raw``) and names it.

    Raises:
        MivolError: several such headers.
    """
    beside = [path.with_name(name + suffix) for suffix in HEADERS for name in dict.fromkeys((path.stem, path.name))]
    found = [header for header in beside if header.is_file() and header != path and path.name.encode() in header.read_bytes()]
    if len(found) > 1:
        listed = ", ".join(header.name for header in found)
        raise refusal(path, f"{len(found)} headers ({listed})", "one", "name the header in place of the file")
    return found[0] if found else None


def read_raw(path: Path, shape: Sequence[int], dtype: np.dtype | str) -> VolumeData:
    """Read raw bytes.

    Args:
        path: file.
        shape: voxels (Z, Y, X), or (Z, Y, X, C).
        dtype: real type of NumPy with its byte order (``"<u2"``, ``">f4"``); ``"uint16"`` is little-endian.

    Raises:
        MivolError: another length of the file, an unknown type, or an invalid shape.
    """
    try:
        kind = np.dtype(dtype)
    except (TypeError, ValueError, SyntaxError):
        kind = np.dtype("O")
    if kind.kind not in "biuf":
        raise refusal(path, f"the type {str(dtype)!r}", "a real type such as uint16, >i2 or float32", "correct dtype")
    if len(shape) not in (3, 4) or min(shape) < 1:
        raise refusal(path, f"the shape {tuple(shape)}", "Z, Y, X or Z, Y, X, C, all above 0", "correct shape")
    little = kind.newbyteorder("<") if kind.byteorder == "=" else kind
    data, count = source.read_bytes(path), int(np.prod(shape, dtype=object))
    if len(data) != count * kind.itemsize:
        expected = f"{count * kind.itemsize} bytes ({' x '.join(map(str, shape))} numbers of {kind.itemsize} bytes)"
        raise refusal(path, f"{len(data)} bytes", expected, "correct shape or dtype; a header .nhdr tells bytes to skip")
    values = to_values(np.frombuffer(data, little).reshape(shape), path)
    meta = {"path": str(path), "format": "raw", "dtype": str(little), "space": None, "unit": "voxel"}
    return VolumeData(values, frame_from_steps(values.shape[2::-1], np.eye(3), np.zeros(3)), meta)
