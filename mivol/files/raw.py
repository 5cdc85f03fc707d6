"""Raw bytes of a volume: with size and type from the caller, or by a header of NRRD, MetaImage or TOML beside them.

Conventions. Numbers fill the file, x fastest, then y, then z. Without a header, voxels are unit cubes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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


def read_layout(path: Path) -> dict[str, Any]:
    """Return the arguments of :func:`read_raw` from ``a.toml`` or ``a.raw.toml`` beside ``a.raw``; empty without such a file.

    A TOML file counts if it has the keys ``shape`` and ``dtype``.

    Raises:
        MivolError: invalid TOML, another key, or values of a wrong kind.
    """
    for beside in (path.with_suffix(".toml"), path.with_name(f"{path.name}.toml")):
        text = beside.read_text(encoding="utf-8", errors="replace") if beside.is_file() and beside != path else ""
        if "shape" not in text or "dtype" not in text:
            continue
        try:
            found = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise refusal(beside, f"invalid TOML ({str(error)[:120]})", "TOML", "correct it") from error
        if not {"shape", "dtype"} <= set(found):
            continue
        kinds = {"shape": int, "dtype": str, "spacing": (int, float), "origin": (int, float), "unit": str}
        for key, value in found.items():
            numbers = value if isinstance(value, list) and key in ("shape", "spacing", "origin") else [value]
            if key not in kinds or not all(isinstance(number, kinds[key]) for number in numbers):
                expected = 'shape = [Z, Y, X], dtype = "uint16", and perhaps spacing and origin = [x, y, z], and unit = "mm"'
                raise refusal(beside, f"{key} = {str(value)[:60]}", expected, "correct it")
        return found
    return {}


def read_raw(
    path: Path,
    shape: Sequence[int],
    dtype: np.dtype | str,
    spacing: Sequence[float] = (1.0, 1.0, 1.0),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    unit: str = "voxel",
) -> VolumeData:
    """Read raw bytes.

    Args:
        path: file.
        shape: voxels (Z, Y, X), or (Z, Y, X, C).
        dtype: real type of NumPy with its byte order (``"<u2"``, ``">f4"``); ``"uint16"`` is little-endian.
        spacing: distance between voxel centres along x, y, z [unit].
        origin: centre of the first voxel (x, y, z) [unit].
        unit: unit of lengths.

    Raises:
        MivolError: another length of the file, an unknown type, or an invalid shape or place.
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
    meta = {"path": str(path), "format": "raw", "dtype": str(little), "space": None, "unit": unit}
    if np.shape(spacing) != (3,) or np.shape(origin) != (3,):
        raise refusal(path, f"spacing {spacing} and origin {origin}", "three numbers (x, y, z) in each", "correct them")
    to_world = frame_from_steps(values.shape[2::-1], np.diag(spacing), np.asarray(origin, float))
    return VolumeData(values, to_world, meta)
