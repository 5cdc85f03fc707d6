"""``mivol optimize`` on projections: a scan from its TOML to its run folder.

Conventions. The folder is that of :mod:`mivol.cli.experiment`; ``metrics.jsonl`` has ``loss`` (what the solver
minimises), ``residual`` (relative, weighted) and ``nrmse`` where the truth is known. Views that are held out are predicted
at the end. States of a solver are never written again, so Ctrl-C may come at any moment: the last whole one is kept.
"""

from __future__ import annotations

import hashlib
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol import config
from mivol.cli.experiment import CHECKPOINT, recorded, stage, write_curves
from mivol.cli.progress import tracked
from mivol.cli.rendering import set_threads, set_variant
from mivol.config import Cone, Ellipsoids, Known, Measured
from mivol.errors import MivolError
from mivol.files import read_projections, read_volume, write_exr, write_volume
from mivol.optim import checkpoint
from mivol.optim.solvers import SOLVERS, LeastSquares, PoissonCounts, SmoothedTV, State
from mivol.report.page import write_page
from mivol.report.record import Choice, Image, RunRecord, Volume, append_metrics, rewind_metrics
from mivol.threads import check_one_thread
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import correct_transmission, find_axis, line_integrals, normalise_air
from mivol.tomography.projector import Projector
from mivol.validate.statistics import nrmse

CITED = {
    "pcg": ("hestenes_1952", "erdogan_1999"),
    "cgls": ("hestenes_1952",),
    "sirt": ("andersen_1984",),
    "os-sart": ("andersen_1984",),
    "ml-tr": ("nuyts_1998", "erdogan_1999"),
}


@dataclass(frozen=True)
class Data:
    """Projections and what they were taken with.

    Attributes:
        geometry: beam and detector.
        y: line integrals (views, rows, cols).
        weights: their inverse variances.
        truth: (Z, Y, X), where known.
        counts: quanta (views, rows, cols), where noise was simulated.
        note: what was found out on the way, or "".
    """

    geometry: Geometry
    y: np.ndarray
    weights: np.ndarray
    truth: np.ndarray | None = None
    counts: np.ndarray | None = None
    note: str = ""

    def digest(self) -> str:
        """SHA-256 of projections and weights."""
        return hashlib.sha256(self.y.tobytes() + self.weights.tobytes()).hexdigest()


def run(chosen: config.Scan, base: Path, folder: Path, *, resume: bool = False) -> Path:
    """Do an experiment on projections; arguments, result and refusals as :func:`mivol.cli.experiment.run`."""
    check_one_thread()
    set_variant(chosen.variant)
    set_threads(chosen.threads)
    folder.mkdir(parents=True, exist_ok=True)
    record = new_record(chosen)
    grid = VoxelGrid(chosen.grid.shape, chosen.grid.voxel_size)
    with recorded(record, folder):
        with stage(record, "projections"):
            data = make_data(chosen, base, grid)
            record.notes += [data.note] if data.note else []
        projector = Projector(data.geometry, grid)
        held_out = held_out_views(chosen, projector.n_views)
        with stage(record, "solve"):
            state = solve(chosen, folder, projector, data, held_out, resume)
        with stage(record, "images and volumes"):
            write_outputs(folder, record, projector, data, held_out, state)
    return write_page(folder)


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


# -- Data ---------------------------------------------------------------------------------------------------------


def make_geometry(chosen: config.Scan) -> Geometry:
    """Beam and detector of computed projections."""
    wanted = chosen.scan
    angles = np.radians(wanted.arc) * np.arange(wanted.views) / wanted.views
    if isinstance(wanted, Cone):
        distances = wanted.source_to_axis, wanted.source_to_detector
        return ConeBeam(angles, wanted.detector, *distances, wanted.pitch, wanted.axis_offset)
    return ParallelBeam(angles, wanted.detector, wanted.pitch, wanted.axis_offset)


def make_data(chosen: config.Scan, base: Path, grid: VoxelGrid) -> Data:
    """Projections, measured or computed.

    Raises:
        MivolError: files that cannot be read or do not fit, or a measured cone beam.
    """
    if isinstance(chosen.data, Measured):
        return read_measured(chosen, base)
    geometry = make_geometry(chosen)
    exact, truth = SIMULATED[type(chosen.data)](chosen.data, base, geometry, grid)
    return add_noise(geometry, exact, truth, chosen.data.photons, chosen.data.seed)


def project_ellipsoids(wanted: Ellipsoids, base: Path, geometry: Geometry, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Exact chords, and the phantom averaged over voxels."""
    phantom = shepp_logan(wanted.table, wanted.half_width)
    return wanted.scale * phantom.project(geometry), wanted.scale * phantom.voxelise(grid)


def project_volume(wanted: Known, base: Path, geometry: Geometry, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals of a volume file, and the volume.

    Raises:
        MivolError: it has several channels or another shape than the grid.
    """
    values = read_volume(base / wanted.file).values
    if values.shape != (*grid.shape, 1):
        raise MivolError(f"{wanted.file} has shape {values.shape}, grid.shape is {grid.shape} of one channel: make them equal.")
    truth = wanted.scale * values[..., 0]
    return Projector(geometry, grid) @ truth, truth


SIMULATED = {Ellipsoids: project_ellipsoids, Known: project_volume}


def add_noise(geometry: Geometry, exact: np.ndarray, truth: np.ndarray, photons: float, seed: int) -> Data:
    """Line integrals of Poisson counts, weighted by 1 / var y = counts; without photons the exact ones.

    A pixel without a single quantum has no logarithm: y = 0 and weight 0.
    """
    if not photons:
        return Data(geometry, exact, np.ones_like(exact), truth)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-exact)).astype(np.float64)
    y = np.where(counts > 0, -np.log(np.maximum(counts, 1.0) / photons), 0.0)
    return Data(geometry, y, counts, truth, counts)


def read_measured(chosen: config.Scan, base: Path) -> Data:
    """Readings with flat and dark fields; the axis is found where asked for.

    Raises:
        MivolError: the file cannot be read, or the beam is not parallel.
    """
    if isinstance(chosen.scan, Cone):
        raise MivolError('a measured scan is of a parallel beam, found scan.beam = "cone": set it to "parallel".')
    wanted, scan = chosen.data, read_projections(base / chosen.data.file, chosen.data.group)
    transmission = correct_transmission(scan.projections, scan.flats, scan.darks)
    y, weights = line_integrals(normalise_air(transmission, wanted.air) if wanted.air else transmission)
    offset, note = chosen.scan.axis_offset, ""
    if wanted.find_axis:
        axis = find_axis(y, weights, scan.angles)
        offset = axis.offset(y.shape[2], chosen.scan.pitch)
        note = f"rotation axis at column {axis.column:.2f} +- {axis.uncertainty:.2f} ({axis.method})"
    return Data(ParallelBeam(scan.angles, y.shape[1:], chosen.scan.pitch, offset), y, weights, note=note)


def held_out_views(chosen: config.Scan, count: int) -> np.ndarray:
    """Numbers of the views that are predicted, not fitted."""
    every = chosen.held_out_every
    if every == 1:
        raise MivolError("held_out_every = 1 holds out all views, expected some to fit: choose 2 or more, or 0.")
    return np.arange(every // 2, count, every) if every else np.arange(0)


# -- Solution -----------------------------------------------------------------------------------------------------


def make_problem(chosen: config.Scan, projector: Projector, data: Data, kept: np.ndarray) -> LeastSquares | PoissonCounts:
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


def solve(chosen: config.Scan, folder: Path, projector: Projector, data: Data, held_out: np.ndarray, resume: bool) -> State:
    """All iterations, with metrics and checkpoints.

    Raises:
        MivolError: a checkpoint of another run, or settings that the solver refuses.
    """
    kept = np.setdiff1d(np.arange(projector.n_views), held_out)
    problem = make_problem(chosen, projector, data, kept)
    fingerprint = {"data": data.digest(), **config.flat(config.resolved(chosen))}
    path, state = folder / CHECKPOINT, None
    if resume:
        state = State.from_arrays(checkpoint.read(path, fingerprint)[0])
    done = state.iteration if state else 0
    rewind_metrics(folder, done)
    started = time.perf_counter()
    try:
        for reached in tracked(Bounded(chosen, problem, state), "iterations"):
            state = reached
            write_metrics(folder, problem, data, state, time.perf_counter() - started)
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


def write_metrics(folder: Path, problem: LeastSquares | PoissonCounts, data: Data, state: State, seconds: float) -> None:
    """One line for an iteration; seconds since the start or the resumption."""
    values = {"loss": state.objective, "residual": state.residual_norm / norm_of(problem)}
    if data.truth is not None:
        values["nrmse"] = nrmse(state.x.reshape(data.truth.shape), data.truth)
    append_metrics(folder, state.iteration, seconds, **values)


def norm_of(problem: LeastSquares | PoissonCounts) -> float:
    """|W^(1/2) b|, or the expected norm of Pearson's residuals, sqrt(m)."""
    if isinstance(problem, PoissonCounts):
        return float(np.sqrt(np.size(problem.counts)))
    return float(np.sqrt(np.sum(problem.weights * problem.b**2))) or 1.0


# -- What came of it ----------------------------------------------------------------------------------------------


def write_outputs(
    folder: Path, record: RunRecord, projector: Projector, data: Data, held_out: np.ndarray, state: State
) -> None:
    """Volume, sinogram, held-out views, curves, results."""
    for name in ("views", "volumes", "curves"):
        (folder / name).mkdir(exist_ok=True)
    x = state.x.reshape(projector.grid.shape)
    predicted = projector @ x
    record.volumes += write_grids(folder, projector.grid, x, data.truth)
    middle = data.y.shape[1] // 2
    record.images += write_pair(folder, "sinogram", data.y[:, middle], predicted[:, middle], False)
    if data.y.shape[1] > 1:
        for view in held_out[:4]:
            record.images += write_pair(folder, f"view {view}", data.y[view], predicted[view], True)
    write_curves(folder)
    record.results = {"iterations": float(state.iteration), "views": float(projector.n_views - len(held_out))}
    if data.truth is not None:
        record.results["nrmse"] = nrmse(x, data.truth)
    if len(held_out):
        z = (data.y - predicted)[held_out] * np.sqrt(data.weights[held_out])
        record.results["held_out_rms_of_residual_over_noise"] = float(np.sqrt(np.mean(z**2)))


def write_pair(folder: Path, name: str, measured: np.ndarray, predicted: np.ndarray, held_out: bool) -> list[Image]:
    """Measured line integrals beside those of the reconstruction, as layers of one file."""
    path = f"views/{name.replace(' ', '_')}.exr"
    layers = {"Y": predicted.astype(np.float32), "reference.Y": measured.astype(np.float32)}
    write_exr(folder / path, layers)
    roles = {"render": "Y", "reference": "reference.Y"}
    common = {"path": path, "view": name, "held_out": held_out, "quantity": "line integral"}
    return [Image(role=role, layer=layer, **common) for role, layer in roles.items()]


def write_grids(folder: Path, grid: VoxelGrid, x: np.ndarray, truth: np.ndarray | None) -> list[Volume]:
    """The reconstruction as .vol and .npz; the truth beside it."""
    found, size = [], tuple(float(edge) for edge in grid.extent)
    for role, values in {"reconstruction": x, **({"truth": truth} if truth is not None else {})}.items():
        write_volume(folder / f"volumes/{role}.vol", values, grid.to_world)
        write_volume(folder / f"volumes/{role}.npz", values, grid.to_world)
        found.append(Volume(path=f"volumes/{role}.npz", role=role, size=size))
    return found
