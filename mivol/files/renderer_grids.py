"""Grids of renderers: Mitsuba's ``.vol``, the ``volumegrid`` of pbrt-v2 in a scene file, and AT3D's text of clouds.

Own readers: Mitsuba's needs a variant and reads float32 only, no library reads pbrt's statement, and only AT3D reads its text.

``.vol``. A header of 48 bytes, then the numbers, x fastest after the channel. Layout, little endian: "VOL", version 3
(uint8), encoding (int32), voxels along x, y, z (3 int32), channels (int32), box corners (6 float32), data. Encoding 1 is
float32, the only encoding of Mitsuba 3. Mitsuba 0.6 (``gridvolume``) also defines 2 float16, 3 uint8 (0..255 for 0..1) and 4
quantised directions, which are refused. Stock ``gridvolume`` ignores the box without ``use_grid_bbox``.

``volumegrid``. Sizes, a box and densities as text, x fastest. ``p0`` and ``p1`` are the corners of the box. Densities are
values at voxel centres. Only the first volume with densities is read, in its object space: transforms of the scene file are
ignored.

Clouds of large-eddy simulations. i, j, k, liquid water content [g/m^3] and effective radius [um] of wet cells, as text. The
lines are: a comment; nx, ny, nz; dx, dy [km]; nz evenly spaced altitudes [km]; the names of the columns; one line per cell
with indices from 0. Missing cells are dry. World lengths are metres. Water drops much larger than the wavelength have the
extinction 1.5 lwc / r_e [1/m], for water of 1 g/cm^3 and an extinction efficiency of 2.

Reference: Pharr, Humphreys, Physically Based Rendering, 2nd ed., section 11.3.3; Matheou and Chung 2014 (the simulation).
"""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset, select_dataset
from mivol.files.volume import VolumeData, frame_from_box, frame_from_steps, to_values

VOL_MAGIC = b"VOL"
VOL_VERSION = 3
VOL_HEADER = struct.Struct("<3sB5i6f")

#: encoding -> (type on disk, factor to the stored quantity).
ENCODINGS: dict[int, tuple[str, float]] = {1: ("<f4", 1.0), 2: ("<f2", 1.0), 3: ("u1", 1 / 255)}


def read_vol(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a ``.vol`` file with its box.

    Raises:
        MivolError: a truncated or too long file, another version or encoding, or sizes below 1.
    """
    refuse_dataset(path, dataset)
    data = source.read_bytes(path)
    if len(data) < VOL_HEADER.size:
        raise refusal(path, f"{len(data)} bytes", f"a header of {VOL_HEADER.size}", "the file is truncated: copy it again")
    _, version, encoding, nx, ny, nz, channels, *box = VOL_HEADER.unpack_from(data)
    if version != VOL_VERSION:
        raise refusal(path, f"version {version} of the format", "version 3", "write it again with Mitsuba 3 or mivol")
    if encoding not in ENCODINGS:
        raise refusal(path, f"encoding {encoding}", "1 (float32), 2 (float16) or 3 (uint8)", "write it again as float32")
    if min(nx, ny, nz, channels) < 1:
        raise refusal(path, f"{nx} x {ny} x {nz} voxels of {channels} channels", "at least 1 each", "write the file again")
    dtype, factor = ENCODINGS[encoding]
    stored = source.parse_elements(data, dtype, nx * ny * nz * channels, path, offset=VOL_HEADER.size)
    values = to_values(stored.reshape(nz, ny, nx, channels), path)
    if factor != 1:
        values *= np.float32(factor)
    meta = {"path": str(path), "format": "vol", "dtype": str(stored.dtype), "space": None, "encoding": encoding}
    return VolumeData(values, frame_from_box(box[:3], box[3:]), meta)


def write_vol(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write version 3 in float32. The corners of the axis-aligned box are rounded to float32.

    Raises:
        MivolError: a rotated, sheared or mirrored ``to_world``, or metadata, which the format cannot hold.
    """
    if metadata:
        raise refusal("write_volume", "metadata for a .vol file", "no metadata", "write .npz, or remove the metadata")
    sides = np.diagonal(to_world)[:3]
    if np.count_nonzero(to_world[:3, :3] - np.diag(sides)) or sides.min() <= 0:
        raise refusal(
            "write_volume",
            "a rotated, sheared or mirrored to_world for a .vol file",
            "an axis-aligned box",
            "write .npz or .nrrd, or give the transform in the scene",
        )
    low = to_world[:3, 3]
    box = np.array([low, low + sides], np.float64)
    if np.abs(box).max() > np.finfo(np.float32).max or (np.diff(box.astype(np.float32), axis=0) <= 0).any():
        raise refusal(
            "write_volume",
            f"a box from {low.tolist()} with sides {sides.tolist()} for a .vol file",
            "corners that differ in float32",
            "write .npz or .nrrd, or move the box nearer to the origin",
        )
    nz, ny, nx, channels = values.shape
    file.write(VOL_HEADER.pack(VOL_MAGIC, VOL_VERSION, 1, nx, ny, nz, channels, *box.ravel()))
    file.write(np.ascontiguousarray(values, "<f4").data)


PARAMETER = re.compile(r'"(integer|point|float)\s+(nx|ny|nz|p0|p1|density)"\s*(?:\[([^\]]*)(\]?)|(-?\d+))')


def is_pbrt(head: bytes) -> bool:
    """Return whether the first bytes hold a Volume statement with a grid size."""
    return b'"integer nx"' in head and b"Volume" in head


def read_pbrt(path: Path, dataset: str | None = None) -> VolumeData:
    """Read the density grid of a ``.pbrt`` file.

    Raises:
        MivolError: a missing parameter, a list that breaks off, or a number of densities other than nx ny nz.
    """
    refuse_dataset(path, dataset)
    text = source.read_bytes(path).decode("ascii", errors="replace")
    parameters: dict[str, str] = {}
    for match in PARAMETER.finditer(text):
        _, name, listed, closed, single = match.groups()
        if single is None and not closed:
            raise refusal(path, f'a list of "{name}" that breaks off', "its ]", "the file is truncated: copy it again")
        parameters.setdefault(name, single if listed is None else listed)
    missing = [name for name in ("nx", "ny", "nz", "p0", "p1", "density") if name not in parameters]
    if missing:
        raise refusal(path, f"no {', '.join(missing)}", "nx, ny, nz, p0, p1 and density", "add them to the Volume")
    size = [source.parse_integers(parameters[name], 1, path, name)[0] for name in ("nx", "ny", "nz")]
    if min(size) < 1:
        raise refusal(path, f"sizes {size}", "at least 1 each", "correct nx, ny, nz")
    density = source.parse_numbers(parameters["density"], size[0] * size[1] * size[2], path)
    to_world = frame_from_box(source.parse_numbers(parameters["p0"], 3, path), source.parse_numbers(parameters["p1"], 3, path))
    meta = {"path": str(path), "format": "pbrt", "dtype": "text", "space": None}
    return VolumeData(to_values(np.reshape(density, size[::-1]), path), to_world, meta)


COLUMNS = ("x,y,z,lwc,reff", "i,j,k,lwc,reff")
"""The line of the column names in AT3D's files and in its documentation; both give cell indices."""

#: Largest unevenness of the altitudes [mean step]: rounding to 1 m at steps of 40 m.
UNEVEN = 0.03

#: Largest number of cells. The list of wet cells does not bound the grid, so a damaged size could request unlimited memory.
LARGEST = 2**30


def is_les(head: bytes) -> bool:
    """Return whether the first bytes name the columns."""
    return any(names.encode() in head.replace(b" ", b"") for names in COLUMNS)


def read_les(path: Path, dataset: str | None = None) -> VolumeData:
    """Read ``extinction`` [1/m] (the default), ``lwc`` [g/m^3] or ``reff`` [um] on the dense grid.

    Raises:
        MivolError: an invalid header, cells outside the grid, uneven altitudes, or water with a radius of 0.
    """
    lines = [line.partition("#")[0].strip() for line in source.read_bytes(path).decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line]
    if len(lines) < 4 or lines[3].replace(" ", "") not in COLUMNS:
        raise refusal(path, "another header", f"sizes, spacings, altitudes and {' or '.join(COLUMNS)}", "correct the file")
    size = source.parse_integers(lines[0].replace(",", " "), 3, path, "nx,ny,nz")
    dx, dy = source.parse_numbers(lines[1], 2, path)
    altitudes = source.parse_numbers(lines[2], size[2], path)
    dz = np.diff(altitudes)
    if size[2] > 1 and np.ptp(dz) > UNEVEN * dz.mean():
        raise refusal(path, "altitudes of uneven steps", "an even grid", "resample the file first")
    cells = source.parse_numbers(",".join(lines[4:]), 5 * (len(lines) - 4), path).reshape(-1, 5)
    if min(size) < 1 or math.prod(size) > LARGEST:
        raise refusal(path, f"a grid of {size}", f"1 to {LARGEST} cells", "correct the second line")
    index = cells[:, :3].astype(int)
    if (index < 0).any() or (index >= size).any():
        raise refusal(path, f"the cell {index[(index >= size).any(1)][:1].tolist()}", f"within {size}", "correct it")
    fields = {"extinction": water_extinction(cells[:, 3], cells[:, 4], path), "lwc": cells[:, 3], "reff": cells[:, 4]}
    name = select_dataset(path, dataset or "extinction", list(fields))
    grid = np.zeros(size[::-1])
    grid[index[:, 2], index[:, 1], index[:, 0]] = fields[name]
    spacing = 1e3 * np.array([dx, dy, dz.mean() if size[2] > 1 else dx])
    to_world = frame_from_steps(size, np.diag(spacing), (0.0, 0.0, 1e3 * altitudes[0]))
    meta = {"path": str(path), "format": "les", "dtype": "text", "space": None, "dataset": name, "unit": "m"}
    return VolumeData(to_values(grid, path), to_world, meta)


def water_extinction(water: np.ndarray, radius: np.ndarray, path: Path) -> np.ndarray:
    """Extinction [1/m] of liquid water content [g/m^3] in drops of an effective radius [um]; 0 where no radius is known.

    Raises:
        MivolError: water in drops of radius 0.
    """
    if ((radius <= 0) & (water > 0)).any():
        raise refusal(path, "water of effective radius 0", "a radius above 0 in wet cells", "correct the file")
    return np.divide(1.5 * water, radius, out=np.zeros(np.shape(water)), where=radius > 0)
