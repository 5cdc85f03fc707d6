"""A volume reconstructed from projections: from the settings of a scan to a run folder, one call per arrow.

Conventions. ``metrics.jsonl`` has ``loss`` (what the solver minimises), ``residual`` (relative, weighted) and ``nrmse`` where
the truth is known. Views that are held out are predicted at the end.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.projections import Projections, beam_of, fitted_views, held_out_views, make_data, make_grid
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.scan_outputs import write_best, write_outputs
from mivol.experiments.solver_choice import (
    check_grid,
    check_noise,
    choose_storage,
    make_prior,
    plan_of_prior,
    settle_noise,
    settle_solver,
    strength_of,
)
from mivol.experiments.task import Task
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Course, Fit, begin_fit
from mivol.optim.projections.inversion import LinearSolve, ProjectionProblem, fit_drift
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts, SolverState, expected_residual_norm
from mivol.optim.projections.solvers import ALL_SOLVERS, DIRECT
from mivol.report.page import write_page
from mivol.report.pixel_scale import is_preview_due, write_preview
from mivol.report.record import PlanLine, RunRecord
from mivol.tomography.filtered import feldkamp, filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.preprocess import bridge_gaps
from mivol.tomography.projector import Projector
from mivol.tomography.supersampling import subdivide, voxel_means
from mivol.validate.metrics import nrmse

CITED = {
    "pcg": ("hestenes_1952", "erdogan_1999"),
    "cgls": ("hestenes_1952",),
    "sirt": ("andersen_1984",),
    "sart": ("andersen_1984",),
    "os-sart": ("andersen_1984",),
    "ml-tr": ("nuyts_1998", "erdogan_1999"),
    "fbp": ("kak_1988",),
    "fdk": ("feldkamp_1984", "parker_1982"),
}


def scan_fit(task: Task) -> Path:
    """Reconstruct a volume from projections; result and refusals as :func:`mivol.experiments.scene_fit.scene_fit`.

    Args:
        task: with a :class:`~mivol.config.Scan`.
    """
    chosen: config.Scan = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    run = RunFolder(task.folder, new_record(task), task.resume)
    with run.at_work():
        grid = make_grid(chosen, task.base)
        with run.stage("projections"):
            check_grid(chosen, grid)
            data = make_data(chosen, task.base, grid)
            run.record.notes += data.notes
            task.watcher.say(data.notes)
        held_out = held_out_views(chosen, len(data.y))
        kept = fitted_views(held_out, len(data.y))
        chosen, lines = settle(chosen, data, grid, kept)
        task = replace(task, chosen=chosen)
        run.record.plan += lines
        projector = make_projector(chosen, data, grid)
        with run.stage("solve"):
            problem = make_problem(chosen, projector, data, kept)
            best = BestIterate(run)
            storage = choose_storage(chosen.solve, problem.linear_problem.A)
            run.record.plan.append(storage.line)
            storage.apply(problem)
            run.record.plan += settle_noise(problem, chosen.solve, data)
            state = solve(task, run, problem, data, grid, best)
            residual = state.residual_norm / norm_of(problem.linear_problem)
            run.record.results = {"iterations": float(state.iteration), "residual": residual}
            run.record.plan += plan_of_prior(problem.linear_problem.prior, state)
            if data.is_noise_known:
                run.record.results["discrepancy"] = state.residual_norm / expected_residual_norm(
                    problem.linear_problem, chosen.solve.name
                )
            data = without_drift(problem, data, held_out, state)
        with run.stage("images and volumes"):
            write_outputs(run, projector, grid, data, held_out, state.x.reshape(projector.grid.shape))
            write_best(run, grid, best)
    page = write_page(task.folder)
    task.watcher.say([*best.says(), run.summary()])
    return page


def new_record(task: Task) -> RunRecord:
    """The record of a run that begins."""
    chosen: config.Scan = task.chosen
    name = chosen.solve.solver
    return RunRecord.new(
        chosen.title,
        method=f"{name} on line integrals of a {beam_of(chosen)}",
        config=config.resolved(chosen),
        command=task.command,
        seeds={"noise": getattr(chosen.data, "seed", 0)},
        units={"loss": "1"},
        plan=[
            PlanLine(choice="projector: exact line integrals and their exact transpose", reason="a matched pair: no bias"),
        ],
        citations=["mitsuba3", "drjit", *CITED[name], *(["rudin_1992", "huber_1964"] if strength_of(chosen.solve) else [])],
    )


def settle(chosen: config.Scan, data: Projections, grid: VoxelGrid, kept: np.ndarray) -> tuple[config.Scan, list[PlanLine]]:
    """All settings with what was left open to the solver's table, and why."""
    solve, lines = settle_solver(chosen.solve, Projector(data.geometry, grid, kept))
    return msgspec.structs.replace(chosen, solve=solve), lines


def make_projector(chosen: config.Scan, data: Projections, grid: VoxelGrid) -> Projector:
    """All rays, and the unknowns that they cross.

    Raises:
        MivolError: more unknowns than the solver can keep in memory.
    """
    unknowns = subdivide(grid, chosen.solve.supersampling, data.geometry)
    check_grid(chosen, unknowns)
    return Projector(data.geometry, unknowns)


def make_problem(chosen: config.Scan, projector: Projector, data: Projections, kept: np.ndarray) -> ProjectionProblem:
    """What the solver minimises, over the views that are fitted.

    Raises:
        MivolError: ML-TR without counts.
    """
    wanted = chosen.solve
    a = projector.subset(kept)
    prior = make_prior(wanted, a, data, kept)
    x0 = start_volume(wanted, a, data, kept)
    if ALL_SOLVERS[wanted.name].problem is LeastSquares:
        least_squares = LeastSquares(a, data.y[kept], data.weights[kept], x0, wanted.nonnegative, prior)
        return ProjectionProblem(least_squares, times=times_of(data)[kept] if getattr(chosen.data, "drift", 0) else None)
    if data.quanta is None:
        raise MivolError("ml-tr needs counts of quanta, found line integrals: simulate with photons, or choose pcg.")
    quanta = data.quanta.of_views(kept)
    return ProjectionProblem(PoissonCounts(a, quanta.counts, quanta.blank, quanta.background, x0, prior, quanta.used))


def times_of(data: Projections) -> np.ndarray:
    """When each view was taken, from -1 to 1: views are taken one after the other."""
    return np.linspace(-1.0, 1.0, len(data.y))


def without_drift(problem: ProjectionProblem, data: Projections, held_out: np.ndarray, state: SolverState) -> Projections:
    """Line integrals of the object alone, the drift of the light fitted to the views that are not held out."""
    if problem.times is None:
        return data
    drift = fit_drift(problem.linear_problem, state.x, problem.times)
    return replace(data, y=data.y - drift.eval(times_of(data)))


def start_volume(wanted: config.Solve, a: Projector, data: Projections, kept: np.ndarray) -> np.ndarray | None:
    """Where an iterative solver begins: None for an empty volume, else by fbp or fdk, at or above 0 where that is asked for.

    Raises:
        MivolError: what the direct method refuses.
    """
    if wanted.start == "empty" or wanted.name in DIRECT:
        return None
    method = filtered_backprojection if isinstance(a.geometry, ParallelBeam) else feldkamp
    x = method(a, bridge_gaps(data.y[kept], data.weights[kept]), wanted.window, wanted.cutoff)
    return np.maximum(x, 0) if wanted.nonnegative else x


def solve(
    task: Task, run: RunFolder, problem: ProjectionProblem, data: Projections, grid: VoxelGrid, best: BestIterate
) -> SolverState:
    """All iterations, with metrics and checkpoints; where the solver stands after them.

    Raises:
        MivolError: a checkpoint of another run, settings that the solver refuses, or projections that hold nothing.
    """
    chosen: config.Scan = task.chosen
    course = Course(chosen.solve.iterations, events=(Checkpoint(every=chosen.checkpoint_every),))
    store = CheckpointFile(run.checkpoint, {"data": data.digest(), **config.flat(run.record.config)}, task.resume)
    noise = noise_of(chosen, problem, data)
    fit = begin_fit(problem, make_solver(chosen, noise), course, checkpoint=store)
    best.restore()
    run.begin(fit.next_iteration)
    with task.watcher.watch(course.iterations) as watch:

        def observe(fit: Fit) -> None:
            volume = voxel_means(fit.run.state.x.reshape(problem.linear_problem.A.grid.shape), grid.shape)
            errors = {"residual": fit.run.state.residual_norm / norm_of(problem.linear_problem)}
            if data.truth is not None:
                errors["nrmse"] = nrmse(volume, data.truth)
            if noise:
                errors["discrepancy"] = fit.run.state.residual_norm / noise
            run.append(fit.next_iteration, fit.seconds, loss=fit.history[-1]["loss"], **errors)
            best.see(fit.next_iteration, errors, {"volume": volume})
            if is_preview_due(fit.next_iteration, course.iterations):
                write_preview(run.path, volume, tuple(grid.extent))
            watch(fit)

        fit.complete(observe)
    if fit.run.stop_reason and fit.next_iteration < course.iterations:
        run.record.notes.append(f"stopped after iteration {fit.next_iteration} of {course.iterations}: {fit.run.stop_reason}")
    return fit.run.state


def noise_of(chosen: config.Scan, problem: ProjectionProblem, data: Projections) -> float | None:
    """The norm of the residual that noise alone would leave; None where the noise is not known.

    Raises:
        MivolError: it is not known, and the solver is to stop by it.
    """
    if chosen.solve.discrepancy:
        check_noise("solve.discrepancy", data)
    return expected_residual_norm(problem.linear_problem, chosen.solve.name) if data.is_noise_known else None


def make_solver(chosen: config.Scan, noise: float | None) -> LinearSolve:
    """The solver with its settings, which stops by the noise where that is asked for."""
    wanted = chosen.solve
    shared = {name: getattr(wanted, name) for name in ("subsets", "relaxation", "decay", "window", "cutoff")}
    if wanted.discrepancy:
        shared["stop_norm"] = wanted.discrepancy * noise
    return LinearSolve(solver=wanted.name, drift=getattr(chosen.data, "drift", 0), **shared)


def norm_of(task: LeastSquares | PoissonCounts) -> float:
    """|W^(1/2) b|, or the expected norm of Pearson's residuals, sqrt(m)."""
    if isinstance(task, PoissonCounts):
        return float(np.sqrt(np.size(task.counts) if task.used is None else np.sum(task.used)))
    return float(np.sqrt(np.sum(task.weights * task.b**2))) or 1.0
