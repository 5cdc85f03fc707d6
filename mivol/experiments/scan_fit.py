"""A volume reconstructed from projections: from the settings of a scan to a run folder, one call per arrow.

Conventions. ``metrics.jsonl`` has ``loss`` (what the solver minimises), ``residual`` (relative, weighted) and ``nrmse`` where
the truth is known. Views that are held out are predicted at the end.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.projections import Projections, held_out_views, make_data
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.scan_outputs import write_outputs
from mivol.experiments.task import Task
from mivol.optim import checkpoint
from mivol.optim.solvers import SOLVERS, LeastSquares, PoissonCounts, SmoothedTV, State
from mivol.report.page import write_page
from mivol.report.record import Choice, RunRecord
from mivol.tomography.geometry import VoxelGrid
from mivol.tomography.projector import Projector
from mivol.validate.statistics import nrmse

CITED = {
    "pcg": ("hestenes_1952", "erdogan_1999"),
    "cgls": ("hestenes_1952",),
    "sirt": ("andersen_1984",),
    "os-sart": ("andersen_1984",),
    "ml-tr": ("nuyts_1998", "erdogan_1999"),
}


def scan_fit(task: Task) -> Path:
    """Reconstruct a volume from projections; result and refusals as :func:`mivol.experiments.scene_fit.scene_fit`.

    Args:
        task: with a :class:`~mivol.config.Scan`.
    """
    chosen: config.Scan = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    run = RunFolder(task.folder, new_record(chosen))
    grid = VoxelGrid(chosen.grid.shape, chosen.grid.voxel_size)
    with run.at_work():
        with run.stage("projections"):
            data = make_data(chosen, task.base, grid)
            run.record.notes += [data.note] if data.note else []
        projector = Projector(data.geometry, grid)
        held_out = held_out_views(chosen, projector.n_views)
        with run.stage("solve"):
            state = solve(task, run, projector, data, held_out)
            run.record.results = {"iterations": float(state.iteration)}
        with run.stage("images and volumes"):
            write_outputs(run, projector, data, held_out, state.x.reshape(grid.shape))
    return write_page(task.folder)


def new_record(chosen: config.Scan) -> RunRecord:
    """The record of a run that begins."""
    solver = SOLVERS[chosen.solve.name]
    return RunRecord.new(
        chosen.title,
        method=f"{chosen.solve.name} on line integrals of a {type(chosen.scan).__name__.lower()} beam",
        config=config.resolved(chosen),
        command="mivol optimize",
        seeds={"noise": getattr(chosen.data, "seed", 0)},
        plan=[
            Choice(choice="projector: exact line integrals and their exact transpose", reason="a matched pair: no bias"),
            Choice(choice=f"solver: {chosen.solve.name}", reason=solver.promises),
        ],
        citations=["mitsuba3", "drjit", *CITED[chosen.solve.name], *(["rudin_1992", "huber_1964"] if chosen.solve.tv else [])],
    )


def make_problem(
    chosen: config.Scan, projector: Projector, data: Projections, kept: np.ndarray
) -> LeastSquares | PoissonCounts:
    """What the solver minimises, over the views that are kept.

    Raises:
        MivolError: ML-TR without counts.
    """
    wanted = chosen.solve
    prior = SmoothedTV(projector.grid.shape, wanted.tv, wanted.delta, projector.grid.voxel_size) if wanted.tv else None
    a = projector.subset(kept)
    if SOLVERS[wanted.name].problem is LeastSquares:
        return LeastSquares(a, data.y[kept], data.weights[kept], None, wanted.nonnegative, prior)
    if data.counts is None:
        raise MivolError("ml-tr needs counts of quanta, found line integrals: simulate with photons, or choose pcg.")
    return PoissonCounts(a, data.counts[kept], chosen.data.photons, prior=prior)


def solve(task: Task, run: RunFolder, projector: Projector, data: Projections, held_out: np.ndarray) -> State:
    """All iterations, with metrics and checkpoints.

    Raises:
        MivolError: a checkpoint of another run, or settings that the solver refuses.
    """
    chosen: config.Scan = task.chosen
    kept = np.setdiff1d(np.arange(projector.n_views), held_out)
    problem = make_problem(chosen, projector, data, kept)
    fingerprint = {"data": data.digest(), **config.flat(config.resolved(chosen))}
    path, state = run.checkpoint, None
    if task.resume:
        state = State.from_arrays(checkpoint.read(path, fingerprint)[0])
    done = state.iteration if state else 0
    run.rewind(done)
    started = time.perf_counter()
    try:
        for reached in task.watcher.track(Bounded(chosen, problem, state), "iterations"):
            state = reached
            write_metrics(run, problem, data, state, time.perf_counter() - started)
            if state.iteration % chosen.checkpoint_every == 0:
                checkpoint.write(path, state.to_arrays(), {"fingerprint": fingerprint})
    finally:
        if state is not None:
            checkpoint.write(path, state.to_arrays(), {"fingerprint": fingerprint})
    if state is None:
        raise MivolError("the projections hold nothing to reconstruct: all weights are 0, or all line integrals.")
    return state


class Bounded:
    """The states of a solver up to the last iteration asked for; its length is known."""

    def __init__(self, chosen: config.Scan, problem: LeastSquares | PoissonCounts, state: State | None) -> None:
        options = {"n_subsets": chosen.solve.subsets} if chosen.solve.name == "os-sart" else {}
        self.left = chosen.solve.iterations - (state.iteration if state else 0)
        self.states = SOLVERS[chosen.solve.name].run(problem, state, **options)

    def __len__(self) -> int:
        return max(self.left, 0)

    def __iter__(self) -> Iterator[State]:
        return itertools.islice(self.states, len(self))


def write_metrics(
    run: RunFolder, problem: LeastSquares | PoissonCounts, data: Projections, state: State, seconds: float
) -> None:
    """One line for an iteration; seconds since the start or the resumption."""
    values = {"loss": state.objective, "residual": state.residual_norm / norm_of(problem)}
    if data.truth is not None:
        values["nrmse"] = nrmse(state.x.reshape(data.truth.shape), data.truth)
    run.append(state.iteration, seconds, **values)


def norm_of(problem: LeastSquares | PoissonCounts) -> float:
    """|W^(1/2) b|, or the expected norm of Pearson's residuals, sqrt(m)."""
    if isinstance(problem, PoissonCounts):
        return float(np.sqrt(np.size(problem.counts)))
    return float(np.sqrt(np.sum(problem.weights * problem.b**2))) or 1.0
