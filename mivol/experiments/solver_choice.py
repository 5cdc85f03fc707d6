"""The solver of a scan: the choices behind "auto", their memory, the stored rows and the prior.

The choices follow the table of docs/benchmarks.md, with slices of few, noisy and many views. For these slices pcg has the
smallest error after 20 iterations, with a start from filtered back-projection, unknowns twice as fine as the voxels, and a
total variation balancing the noise. The scan determines whether a filtered start is possible, whether the finer unknowns fit
into memory, and the size of the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from mivol import config
from mivol.back_end import check_memory
from mivol.config import AUTO
from mivol.errors import MivolError
from mivol.experiments.projections import Projections
from mivol.optim.projections.inversion import ALL_SOLVERS, DIRECT, ProjectionProblem
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import (
    SmoothedTV,
    SolverState,
    expected_residual_norm,
    last_state,
    scale_tv_to_noise,
)
from mivol.report.record import PlanLine
from mivol.tomography.filtered import check_directions
from mivol.tomography.geometry import ParallelBeam, VoxelGrid, subdivide_grid
from mivol.tomography.projector import Projector, count_product_bytes
from mivol.tomography.stored import is_worth_storing, matrix_bytes, store_matrix

MOST_UNKNOWNS = 1 << 24
"""Largest number of unknowns that "auto" chooses: 256^3. With a hundred views an iteration then takes ten seconds on two cores,
and a solver keeps about ten fields of this size."""


def tv_strength(settings: config.SolveSettings) -> float:
    """Value of ``solve.tv``; if absent, 1 for "auto" in units of the noise, else 0."""
    if settings.tv is not None:
        return settings.tv
    return 1.0 if settings.name == AUTO and settings.tv_unit == "noise" else 0.0


ITERATIONS, GAIN_ITERATIONS = 20, 60
"""Iterations if the settings leave them open, without and with unknown gains of the pixels."""


MOST_STEPS = 60_000_000_000
"""Largest number of steps from cell to cell in all iterations that "auto" chooses: four minutes of processor time."""


def choose_direct(settings: config.SolveSettings, walk: Projector, iterations: int) -> PlanLine | None:
    """The reason to take filtered back-projection as "auto"; None to iterate.

    Iterations beyond ``MOST_STEPS`` are left out if the views suffice: as many as columns, in directions that filtered
    back-projection takes. A setting of the iterations is a wish to iterate.
    """
    views, _, columns = walk.projection_shape
    wishes = (settings.iterations, settings.start, settings.supersampling, settings.tv, settings.discrepancy or None)
    if settings.name != AUTO or settings.storage != "auto" or any(wish is not None for wish in wishes) or views < columns:
        return None
    try:
        check_directions(walk)
    except MivolError:
        return None
    grid = subdivide_grid(walk.grid, resolve_supersampling(settings, walk)[0], walk.geometry)
    across = grid.shape[1:] if isinstance(walk.geometry, ParallelBeam) else grid.shape
    steps = 2 * iterations * math.prod(walk.projection_shape) * sum(across)
    if steps <= MOST_STEPS:
        return None
    name = "fbp" if isinstance(walk.geometry, ParallelBeam) else "fdk"
    reason = (
        f"{iterations} iterations of pcg take {steps / 1e9:.3g} thousand million steps from cell to cell, of at most "
        f'{MOST_STEPS / 1e9:g}, and the {views} views are no fewer than the {columns} columns (solve.name = "pcg" iterates)'
    )
    return PlanLine(choice=f"solver: {name}", reason=reason)


def resolve_solver(
    settings: config.SolveSettings, walk: Projector, iterations: int = ITERATIONS, may_be_direct: bool = False
) -> tuple[config.SolveSettings, list[PlanLine]]:
    """Put values in place of all open settings.

    Args:
        settings: settings of a file.
        walk: projector of the fitted views, through the requested voxels.
        iterations: iterations if the settings leave them open.
        may_be_direct: whether "auto" may be a single step (:func:`choose_direct`).

    Returns:
        Complete settings, and their reasons.
    """
    name = settings.solver
    if may_be_direct and (line := choose_direct(settings, walk, settings.iterations or iterations)):
        direct = "fbp" if isinstance(walk.geometry, ParallelBeam) else "fdk"
        given = {"name": direct, "start": "empty", "supersampling": 1, "tv": 0.0}
        return msgspec.structs.replace(settings, iterations=iterations, **given), [line]
    start, start_line = resolve_start(settings, walk)
    parts, parts_line = resolve_supersampling(settings, walk)
    settled = msgspec.structs.replace(
        settings,
        name=name,
        tv=tv_strength(settings),
        start=start,
        supersampling=parts,
        iterations=settings.iterations or iterations,
    )
    by_table = "it has the least error with few, noisy and many views in the table of docs/benchmarks.md"
    reason = by_table if settings.name == AUTO else ALL_SOLVERS[name].promises
    return settled, [PlanLine(choice=f"solver: {name}", reason=reason), *start_line, *parts_line]


def resolve_start(settings: config.SolveSettings, walk: Projector) -> tuple[str, list[PlanLine]]:
    """Return the first volume, and the reason of an automatic choice."""
    if settings.start is not None or settings.name != AUTO:
        return settings.start or "empty", []
    try:
        check_directions(walk)
    except MivolError as error:
        return "empty", [PlanLine(choice="start: empty", reason=f"filtered back-projection refuses: {error}")]
    return "filtered", [PlanLine(choice="start: filtered back-projection", reason="it saves half of the iterations")]


def resolve_supersampling(settings: config.SolveSettings, walk: Projector) -> tuple[int, list[PlanLine]]:
    """Return the unknowns along an edge of a voxel, and the reason of an automatic choice."""
    if settings.supersampling is not None or settings.name != AUTO:
        return settings.supersampling or 1, []
    unknowns = subdivide_grid(walk.grid, 2, walk.geometry).size
    if unknowns > MOST_UNKNOWNS:
        reason = f"twice as many along each edge were {unknowns / 2**20:.4g} Mi, of at most {MOST_UNKNOWNS >> 20} Mi"
        return 1, [PlanLine(choice="unknowns: the voxels", reason=f"{reason} (solve.supersampling = 2 takes them)")]
    choice = "unknowns: two along each edge of a voxel; the voxel is their mean"
    return 2, [PlanLine(choice=choice, reason="surfaces pass through voxels")]


FIELDS, FIELDS_OF_ONE_STEP = 10, 3
"""Fields of 4-byte numbers, one per unknown, in an iterative and in a direct solver."""


def check_solver_memory(settings: config.ScanExperiment, grid: VoxelGrid, rays: int = 0) -> None:
    """Refuse unknowns beyond the memory of this machine, where solvers keep their fields, or of the GPU that takes products.

    Args:
        settings: of the run.
        grid: the unknowns.
        rays: number of rays; 0 before the scan is read.

    Raises:
        MivolError: with their number.
    """
    fields = FIELDS_OF_ONE_STEP if settings.solve.solver in DIRECT else FIELDS
    subject = f"a reconstruction of {' x '.join(str(n) for n in grid.shape)} unknowns"
    way_out, product = "give grid.shape fewer voxels, or set solve.supersampling = 1", count_product_bytes(grid.size, rays)
    check_memory(4 * fields * grid.size, subject, way_out, on_gpu=product)


BY_SUBSETS = ("sart", "os-sart")
"""Solvers with many small products per iteration."""


@dataclass(frozen=True)
class Storage:
    """Choice of the operator.

    Attributes:
        is_stored: whether the rows of a layer are stored.
        line: the choice and its reason.
    """

    is_stored: bool
    line: PlanLine

    def apply(self, walk: Projector) -> Projector:
        """Return the chosen operator."""
        return store_matrix(walk) if self.is_stored else walk


def choose_matrix_storage(settings: config.SolveSettings, walk: Projector) -> Storage:
    """Estimate memory and time, and choose; nothing is stored yet.

    Args:
        settings: settings of the solver.
        walk: projector of the fitted views.

    Raises:
        MivolError: requested rows that the solver cannot use, that do not exist, or that need more memory than allowed.
    """
    if settings.storage == "walk":
        return plan_walk("as requested")
    if settings.name in DIRECT:
        return refuse_matrix(settings, f"{settings.name} is a direct solver, without a matrix")
    size = matrix_bytes(walk)
    if size is None:
        return refuse_matrix(settings, "only a parallel beam, or a fan of one row, has layers of rays that share a matrix")
    rows, use = walk.projection_shape[1], f"{size / 2**20:.3g} MiB, of at most {settings.memory:.3g} GiB"
    if size > settings.memory * 2**30:
        return refuse_matrix(settings, f"the rows of a layer take {use} (solve.memory)")
    if settings.storage == "auto" and not is_worth_storing(rows, settings.iterations, settings.name in BY_SUBSETS):
        return plan_walk(f"{settings.iterations} iterations on {rows} rows of the detector do not pay for storing {use}")
    shared = "" if rows == 1 else f", shared by the {rows} rows of the detector"
    return Storage(True, PlanLine(choice="storage: the exact integrals of a layer, kept as sparse rows", reason=use + shared))


def plan_walk(reason: str) -> Storage:
    """Choose to store nothing."""
    return Storage(False, PlanLine(choice="storage: none, each product walks through the grid", reason=reason))


def refuse_matrix(settings: config.SolveSettings, reason: str) -> Storage:
    """Choose to store nothing, unless stored rows were requested.

    Raises:
        MivolError: stored rows were requested.
    """
    if settings.storage == "matrix":
        raise MivolError(f"solve.storage = matrix is impossible: {reason}: choose auto or walk.")
    return plan_walk(reason)


PLAIN_ITERATIONS = {"filtered": 5, "empty": 20}
"""Iterations without a prior after which the residual of noiseless views is the misfit of the voxels, by the first volume."""


def make_prior(settings: config.SolveSettings, a: Projector, data: Projections, kept: np.ndarray) -> SmoothedTV | None:
    """Return the total variation in the requested unit, with weights as inverse variances; None without total variation."""
    if not settings.tv:
        return None
    if settings.tv_unit == "length":
        return SmoothedTV(a.grid.shape, settings.tv, settings.delta, a.grid.voxel_size)
    return scale_tv_to_noise(a, data.y[kept], data.weights[kept], settings.tv, settings.delta)


def estimate_noise(problem: ProjectionProblem, settings: config.SolveSettings, data: Projections) -> list[PlanLine]:
    """If the prior needs an unknown noise, take the residual of a few iterations without a prior, and continue from there.

    The variances are then ``s^2 / w``, and s is found. Least squares with weights w need ``s^2`` times the strength for ``w /
    s^2``, which is 1/s of the strength that balances noise of variance 1 / w: the prior becomes s times as strong.
    """
    task = problem.linear_problem
    if task.prior is None or settings.tv_unit == "length" or data.is_noise_known:
        return []
    n = PLAIN_ITERATIONS[settings.start]
    state = last_state(projected_cg(replace(task, prior=None)), n)
    if state is None:
        return []
    left = state.residual_norm / expected_residual_norm(task, "pcg")
    prior = replace(task.prior, strength=left * task.prior.strength)
    problem.linear_problem = replace(task, x0=state.x, prior=prior)
    reason = f"the noise is unknown: estimated from the residual after {n} iterations without total variation"
    return [PlanLine(choice=f"noise: {left:.4g} times the size implied by the weights", reason=reason)]


def explain_prior(prior: SmoothedTV | None, state: SolverState) -> list[PlanLine]:
    """Return the strength of the prior and its effect."""
    if prior is None:
        return []
    share, edges = prior.value(state.x) / abs(state.objective), prior.share_of_edges(state.x)
    return [
        PlanLine(
            choice=f"total variation: strength {prior.strength:.4g} / length, smooth below {prior.delta:.4g} / length^2",
            reason=f"{share:.2%} of the final objective; {edges:.2%} of the differences between neighbours count as edges",
        )
    ]


def check_noise(setting: str, data: Projections) -> None:
    """Refuse a setting that needs the size of an unknown noise.

    Raises:
        MivolError: the noise is unknown.
    """
    if not data.is_noise_known:
        raise MivolError(
            f"{setting} needs the noise of the projections, which is unknown: give readings with flats and darks, or "
            "simulate with photons."
        )
