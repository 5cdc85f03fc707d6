"""Clouds of large-eddy simulations as text: i, j, k, liquid water content [g/m^3], effective radius [um] of wet cells.

Own reader: only AT3D itself reads this format.

Conventions. The lines are: a comment; nx, ny, nz; dx, dy [km]; nz evenly spaced altitudes [km]; the names of the columns; one
line per cell with indices from 0. Missing cells are dry. World lengths are metres. Water drops much larger than the wavelength
have the extinction 1.5 lwc / r_e [1/m], for water of 1 g/cm^3 and an extinction efficiency of 2.

Reference: Matheou and Chung 2014 (the simulation); the file format is AT3D's.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, to_values

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
    fields = {"extinction": _extinction(cells, path), "lwc": cells[:, 3], "reff": cells[:, 4]}
    name = select_dataset(path, dataset or "extinction", list(fields))
    grid = np.zeros(size[::-1])
    grid[index[:, 2], index[:, 1], index[:, 0]] = fields[name]
    spacing = 1e3 * np.array([dx, dy, dz.mean() if size[2] > 1 else dx])
    to_world = frame_from_steps(size, np.diag(spacing), (0.0, 0.0, 1e3 * altitudes[0]))
    meta = {"path": str(path), "format": "les", "dtype": "text", "space": None, "dataset": name, "unit": "m"}
    return VolumeData(to_values(grid, path), to_world, meta)


def _extinction(cells: np.ndarray, path: Path) -> np.ndarray:
    water, radius = cells[:, 3], cells[:, 4]
    if ((radius <= 0) & (water > 0)).any():
        raise refusal(path, "water of effective radius 0", "a radius above 0 in wet cells", "correct the file")
    return np.divide(1.5 * water, radius, out=np.zeros_like(water), where=radius > 0)
