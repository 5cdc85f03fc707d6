"""What a reconstruction takes of the memory, counted before any of it is taken."""

from __future__ import annotations

import math

from mivol import config
from mivol.experiments.solver_choice import solver_of
from mivol.machine import check_fits
from mivol.optim.projections.solvers import DIRECT
from mivol.tomography.geometry import VoxelGrid

__all__ = ["check_grid", "check_rays"]

FIELDS, FIELDS_OF_ONE_STEP = 10, 3
"""Fields of so many numbers as there are unknowns, of four bytes each, that an iterative and a direct solver keep."""

RAY_BYTES = 3 * 8
"""Of a ray of a computed scan: what is exact, what is seen of it and its weight, in float64."""


def check_grid(chosen: config.Scan, grid: VoxelGrid) -> None:
    """Refuse unknowns that a solver cannot keep.

    Raises:
        MivolError: with how many there are.
    """
    fields = FIELDS_OF_ONE_STEP if solver_of(chosen.solve) in DIRECT else FIELDS
    what = f"a reconstruction of {' x '.join(str(n) for n in grid.shape)} unknowns"
    check_fits(4 * fields * math.prod(grid.shape), what, "give grid.shape fewer voxels, or set solve.supersampling = 1")


def check_rays(chosen: config.Scan) -> None:
    """Refuse a computed scan of more rays than can be kept; of a table of views, one view is counted.

    Raises:
        MivolError: with how many there are.
    """
    rows, columns = chosen.scan.detector
    views = getattr(chosen.scan, "views", 1)
    what = f"a scan of {views} x {rows} x {columns} rays"
    check_fits(RAY_BYTES * views * rows * columns, what, "give scan.detector or scan.views fewer of them")
