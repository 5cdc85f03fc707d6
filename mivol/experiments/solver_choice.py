"""What ``solve.name = "auto"`` means for one scan: what a file leaves open, settled by the table of docs/benchmarks.md.

That table has slices of few, noisy and many views. In all kinds the least error after 20 iterations has pcg that begins at
filtered back-projection, on unknowns twice as fine as the voxels, with total variation that balances the noise. What depends on
the scan is whether it can be begun so, whether the finer unknowns fit, and what is taken for the noise.
"""

from __future__ import annotations

import msgspec

from mivol import config
from mivol.config import AUTO
from mivol.errors import MivolError
from mivol.optim.projections.solvers import METHODS
from mivol.report.record import PlanLine
from mivol.tomography.filtered import check_directions
from mivol.tomography.projector import Projector
from mivol.tomography.supersampling import subdivide

MOST_UNKNOWNS = 1 << 24
"""More unknowns than 256^3 are taken only where they are asked for: with a hundred views an iteration takes ten seconds on two
cores there, and a solver keeps some ten fields of so many numbers."""


def solver_of(wanted: config.Solve) -> str:
    """The key of METHODS that a file asks for, which "auto" leaves to the table."""
    return "pcg" if wanted.name == AUTO else wanted.name


def strength_of(wanted: config.Solve) -> float:
    """``solve.tv`` as it is meant: absent, it is 1 where "auto" chooses and the unit is the noise, else 0."""
    if wanted.tv is not None:
        return wanted.tv
    return 1.0 if wanted.name == AUTO and wanted.tv_unit == "noise" else 0.0


def settle_solver(wanted: config.Solve, walk: Projector) -> tuple[config.Solve, list[PlanLine]]:
    """Put values in the places of all that was left open.

    Args:
        wanted: settings of a file.
        walk: of the views that are fitted, through the voxels that are asked for.

    Returns:
        Settings without a gap, and why they are these.
    """
    name = solver_of(wanted)
    start, start_line = settle_start(wanted, walk)
    parts, parts_line = settle_supersampling(wanted, walk)
    settled = msgspec.structs.replace(wanted, name=name, tv=strength_of(wanted), start=start, supersampling=parts)
    by_table = "the least error of few, noisy and many views in the table of docs/benchmarks.md"
    reason = by_table if wanted.name == AUTO else METHODS[name].promises
    return settled, [PlanLine(choice=f"solver: {name}", reason=reason), *start_line, *parts_line]


def settle_start(wanted: config.Solve, walk: Projector) -> tuple[str, list[PlanLine]]:
    """Where to begin, and why where it was left open to "auto"."""
    if wanted.start is not None or wanted.name != AUTO:
        return wanted.start or "empty", []
    try:
        check_directions(walk)
    except MivolError as error:
        return "empty", [PlanLine(choice="start: empty", reason=f"filtered back-projection refuses: {error}")]
    return "filtered", [PlanLine(choice="start: filtered back-projection", reason="half of the iterations are saved")]


def settle_supersampling(wanted: config.Solve, walk: Projector) -> tuple[int, list[PlanLine]]:
    """Unknowns along an edge of a voxel, and why where it was left open to "auto"."""
    if wanted.supersampling is not None or wanted.name != AUTO:
        return wanted.supersampling or 1, []
    unknowns = subdivide(walk.grid, 2, walk.geometry).size
    if unknowns > MOST_UNKNOWNS:
        reason = f"twice as many along each edge were {unknowns / 2**20:.4g} Mi, of at most {MOST_UNKNOWNS >> 20} Mi"
        return 1, [PlanLine(choice="unknowns: the voxels", reason=f"{reason} (solve.supersampling = 2 takes them)")]
    return 2, [PlanLine(choice="unknowns: two along each edge of a voxel, which is their mean", reason="edges cut voxels")]
