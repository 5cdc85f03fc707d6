"""What ``solve.name = "auto"`` means for one scan: what a file leaves open, settled by the table of docs/benchmarks.md.

That table has slices of few, noisy and many views. In all kinds the least error after 20 iterations has pcg that begins at
filtered back-projection, on unknowns twice as fine as the voxels, with total variation that balances the noise. What depends on
the scan is whether it can be begun so, whether the finer unknowns fit, and what is taken for the noise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from mivol import config
from mivol.config import AUTO
from mivol.errors import MivolError
from mivol.experiments.projections import Projections
from mivol.machine import check_memory
from mivol.optim.projections.inversion import ProjectionProblem
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import SolverState, expected_residual_norm
from mivol.optim.projections.smoothed_tv import SmoothedTV, scale_tv_to_noise
from mivol.optim.projections.solvers import ALL_SOLVERS, DIRECT
from mivol.report.record import PlanLine
from mivol.tomography.filtered import check_directions
from mivol.tomography.geometry import VoxelGrid, subdivide_grid
from mivol.tomography.projector import Projector
from mivol.tomography.stored import is_worth_storing, matrix_bytes, store_matrix

MOST_UNKNOWNS = 1 << 24
"""More unknowns than 256^3 are taken only where they are asked for: with a hundred views an iteration takes ten seconds on two
cores there, and a solver keeps some ten fields of so many numbers."""


def strength_of(wanted: config.SolveSettings) -> float:
    """``solve.tv`` as it is meant: absent, it is 1 where "auto" chooses and the unit is the noise, else 0."""
    if wanted.tv is not None:
        return wanted.tv
    return 1.0 if wanted.name == AUTO and wanted.tv_unit == "noise" else 0.0


def settle_solver(wanted: config.SolveSettings, walk: Projector) -> tuple[config.SolveSettings, list[PlanLine]]:
    """Put values in the places of all that was left open.

    Args:
        wanted: settings of a file.
        walk: of the views that are fitted, through the voxels that are asked for.

    Returns:
        Settings without a gap, and why they are these.
    """
    name = wanted.solver
    start, start_line = settle_start(wanted, walk)
    parts, parts_line = settle_supersampling(wanted, walk)
    settled = msgspec.structs.replace(wanted, name=name, tv=strength_of(wanted), start=start, supersampling=parts)
    by_table = "the least error of few, noisy and many views in the table of docs/benchmarks.md"
    reason = by_table if wanted.name == AUTO else ALL_SOLVERS[name].promises
    return settled, [PlanLine(choice=f"solver: {name}", reason=reason), *start_line, *parts_line]


def settle_start(wanted: config.SolveSettings, walk: Projector) -> tuple[str, list[PlanLine]]:
    """Where to begin, and why where it was left open to "auto"."""
    if wanted.start is not None or wanted.name != AUTO:
        return wanted.start or "empty", []
    try:
        check_directions(walk)
    except MivolError as error:
        return "empty", [PlanLine(choice="start: empty", reason=f"filtered back-projection refuses: {error}")]
    return "filtered", [PlanLine(choice="start: filtered back-projection", reason="half of the iterations are saved")]


def settle_supersampling(wanted: config.SolveSettings, walk: Projector) -> tuple[int, list[PlanLine]]:
    """Unknowns along an edge of a voxel, and why where it was left open to "auto"."""
    if wanted.supersampling is not None or wanted.name != AUTO:
        return wanted.supersampling or 1, []
    unknowns = subdivide_grid(walk.grid, 2, walk.geometry).size
    if unknowns > MOST_UNKNOWNS:
        reason = f"twice as many along each edge were {unknowns / 2**20:.4g} Mi, of at most {MOST_UNKNOWNS >> 20} Mi"
        return 1, [PlanLine(choice="unknowns: the voxels", reason=f"{reason} (solve.supersampling = 2 takes them)")]
    return 2, [PlanLine(choice="unknowns: two along each edge of a voxel, which is their mean", reason="edges cut voxels")]


FIELDS, FIELDS_OF_ONE_STEP = 10, 3
"""Fields of so many numbers as there are unknowns, of four bytes each, that an iterative and a direct solver keep."""


def check_grid(chosen: config.ScanExperiment, grid: VoxelGrid) -> None:
    """Refuse unknowns that a solver cannot keep.

    Raises:
        MivolError: with how many there are.
    """
    fields = FIELDS_OF_ONE_STEP if chosen.solve.solver in DIRECT else FIELDS
    what = f"a reconstruction of {' x '.join(str(n) for n in grid.shape)} unknowns"
    check_memory(4 * fields * math.prod(grid.shape), what, "give grid.shape fewer voxels, or set solve.supersampling = 1")


BY_SUBSETS = ("sart", "os-sart")
"""Solvers that take many small products an iteration."""


@dataclass(frozen=True)
class Storage:
    """What was chosen.

    Attributes:
        is_stored: whether the rows of a layer are kept.
        line: the choice and its reason.
    """

    is_stored: bool
    line: PlanLine

    def apply(self, problem: ProjectionProblem) -> None:
        """Give the solver's problem the operator that was chosen."""
        if self.is_stored:
            problem.linear_problem = replace(problem.linear_problem, A=store_matrix(problem.linear_problem.A))


def choose_storage(wanted: config.SolveSettings, walk: Projector) -> Storage:
    """Count, and choose; nothing is stored yet.

    Args:
        wanted: its ``storage``, ``memory``, solver and iterations.
        walk: of the views that are fitted.

    Raises:
        MivolError: stored rows were asked for that the solver does not read, do not exist, or need more memory than is allowed.
    """
    if wanted.storage == "walk":
        return walked("as asked for")
    if wanted.name in DIRECT:
        return refused(wanted, f"{wanted.name} takes one step, without a matrix")
    size = matrix_bytes(walk)
    if size is None:
        return refused(wanted, "only the rays of a parallel beam, or of a fan of one row, lie in layers that share a matrix")
    rows, said = walk.projection_shape[1], f"{size / 2**20:.3g} MiB, of at most {wanted.memory:.3g} GiB"
    if size > wanted.memory * 2**30:
        return refused(wanted, f"the rows of a layer take {said} (solve.memory)")
    if wanted.storage == "auto" and not is_worth_storing(rows, wanted.iterations, wanted.name in BY_SUBSETS):
        return walked(f"{wanted.iterations} iterations on {rows} rows of the detector do not pay for storing {said}")
    shared = "" if rows == 1 else f", shared by the {rows} rows of the detector"
    return Storage(True, PlanLine(choice="storage: the exact integrals of a layer, kept as sparse rows", reason=said + shared))


def walked(reason: str) -> Storage:
    """Nothing is stored."""
    return Storage(False, PlanLine(choice="storage: none, each product walks through the grid", reason=reason))


def refused(wanted: config.SolveSettings, reason: str) -> Storage:
    """A walk, unless stored rows were asked for by name.

    Raises:
        MivolError: they were.
    """
    if wanted.storage == "matrix":
        raise MivolError(f"solve.storage = matrix cannot be had: {reason}: choose auto or walk.")
    return walked(reason)


PLAIN_ITERATIONS = {"filtered": 5, "empty": 20}
"""Iterations without a prior after which what is left of noiseless views is the misfit of voxels, by where they began."""


def make_prior(wanted: config.SolveSettings, a: Projector, data: Projections, kept: np.ndarray) -> SmoothedTV | None:
    """Total variation in the unit that was asked for, as if weights were inverse variances; None where none was."""
    if not wanted.tv:
        return None
    if wanted.tv_unit == "length":
        return SmoothedTV(a.grid.shape, wanted.tv, wanted.delta, a.grid.voxel_size)
    return scale_tv_to_noise(a, data.y[kept], data.weights[kept], wanted.tv, wanted.delta)


def settle_noise(problem: ProjectionProblem, wanted: config.SolveSettings, data: Projections) -> list[PlanLine]:
    """Where a prior's unit is a noise that is not known: take what a few iterations without a prior leave, and begin there.

    Variances are ``s^2 / w`` then, and s is found. Least squares with weights w need ``s^2`` times the strength that goes with
    ``w / s^2``, which is 1/s of what balances noise of the variances 1 / w: the prior becomes s times as strong.
    """
    task = problem.linear_problem
    if task.prior is None or wanted.tv_unit == "length" or data.is_noise_known:
        return []
    n = PLAIN_ITERATIONS[wanted.start]
    *_, state = (None, *itertools.islice(projected_cg(replace(task, prior=None)), n))
    if state is None:
        return []
    left = state.residual_norm / expected_residual_norm(task, "pcg")
    prior = replace(task.prior, strength=left * task.prior.strength)
    problem.linear_problem = replace(task, x0=state.x, prior=prior)
    reason = f"the projections have none that is known: this is what {n} iterations without total variation leave of them"
    return [PlanLine(choice=f"noise: {left:.4g} times what the weights say", reason=reason)]


def plan_of_prior(prior: SmoothedTV | None, state: SolverState) -> list[PlanLine]:
    """How strong the prior was, and what it did."""
    if prior is None:
        return []
    share, edges = prior.value(state.x) / abs(state.objective), prior.share_of_edges(state.x)
    return [
        PlanLine(
            choice=f"total variation: strength {prior.strength:.4g} / length, smooth below {prior.delta:.4g} / length^2",
            reason=f"it is {share:.2%} of the objective in the end, and keeps {edges:.2%} of the slopes as edges",
        )
    ]


def check_noise(asked: str, data: Projections) -> None:
    """Refuse what needs the size of the noise where it is not known.

    Raises:
        MivolError: it is not.
    """
    if not data.is_noise_known:
        raise MivolError(
            f"{asked} needs the noise of the projections, which these do not have: give readings with flats and darks, or "
            "simulate with photons."
        )
