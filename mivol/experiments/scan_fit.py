"""A reconstruction of a volume from projections.

Conventions. ``metrics.jsonl`` has ``loss`` (the solver's objective), ``residual`` (relative, weighted), and ``nrmse`` if the
truth is known. Held-out views are predicted at the end.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import msgspec
import numpy as np

from mivol import config
from mivol.config import ScanExperiment
from mivol.errors import MivolError
from mivol.experiments.film import film_of_volume
from mivol.experiments.fit_kind import Evaluation, FitKind, Say, Stages
from mivol.experiments.projections import (
    Projections,
    check_data,
    describe_beam,
    fitted_views,
    grid_of_detector,
    held_out_views,
    make_data,
    make_voxel_grid,
    read_measured,
)
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.scan_corrections import correction_citations, refine_geometry, straighten_lines
from mivol.experiments.solver_choice import (
    GAIN_ITERATIONS,
    ITERATIONS,
    PLAIN_ITERATIONS,
    check_noise,
    check_solver_memory,
    choose_matrix_storage,
    estimate_noise,
    explain_prior,
    make_prior,
    resolve_solver,
    tv_strength,
)
from mivol.files import read_volume, write_exr, write_volume
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Course, Fit
from mivol.optim.projections.inversion import ALL_SOLVERS, DIRECT, DriftFit, LinearSolve, ProjectionProblem, update_light
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts, SolverState, expected_residual_norm
from mivol.report.cameras import draw_scanner
from mivol.report.figures import plot_moves, plot_ring_removal, save_figure
from mivol.report.pixel_scale import PREVIEW, is_preview_due, write_preview
from mivol.report.record import LINES, SINOGRAM, Image, PlanLine, Volume
from mivol.scene.explain import Explanation
from mivol.tomography.filtered import check_directions, feldkamp, filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid, subdivide_grid, voxel_means
from mivol.tomography.preprocess import LightDrift, interpolate_gaps
from mivol.tomography.projector import Projector
from mivol.tomography.rings import PixelGains
from mivol.validate.metrics import nrmse

RING_CITATIONS = {"gain": ("vo_2018", "eilers_2003"), "fit": ("vo_2018", "eilers_2003"), "sort": ("vo_2018",)}
"""Citations by ``data.rings``."""


class ScanFit(FitKind):
    """A reconstruction of a volume from projections.

    Attributes:
        grid: requested voxels; the projector's grid may be finer.
        data: projections; after the fit without the fitted drift of the light.
        held_out, kept: indices of the predicted and of the fitted views.
        projector: rays of the scan, and the unknowns.
    """

    stages = Stages("projections", "solve", "images and volumes")
    has_live_page = True
    settings: ScanExperiment
    problem: ProjectionProblem

    def describe_run(self) -> dict[str, Any]:
        settings = self.settings
        name = settings.solve.solver
        prior = ["rudin_1992", "huber_1964"] if tv_strength(settings.solve) else []
        rings = RING_CITATIONS.get(getattr(settings.data, "rings", "none"), ())
        return {
            "method": f"{name} on line integrals of a {describe_beam(settings)}",
            "seeds": {"noise": getattr(settings.data, "seed", 0)},
            "units": {"loss": "1"},
            "plan": [
                PlanLine(choice="projector: exact line integrals and their exact transpose", reason="a matched pair: no bias")
            ],
            "citations": ["mitsuba3", "drjit", *ALL_SOLVERS[name].cites, *prior, *rings, *correction_citations(settings)],
        }

    def load(self, say: Say) -> None:
        base = self.context.base
        self.grid, self.data = load_scan(self.settings, base)
        grid = self.grid
        edges = grid.voxel_size if len(set(grid.voxel_size)) > 1 else grid.voxel_size[:1]
        say(f"  grid      {' x '.join(map(str, grid.shape))} voxels of {' x '.join(f'{edge:g}' for edge in edges)}")
        views, rows, columns = self.data.y.shape
        say(f"  scan      {views} views of {rows} x {columns} pixels, {describe_beam(self.settings)}")
        self.data = straighten_lines(self.settings, self.data)
        self.held_out = held_out_views(self.settings, views)
        self.data, self.alignment = refine_geometry(self.settings, grid, self.data, self.held_out)
        self.kept = fitted_views(self.held_out, views)
        has_readings = self.data.weights.any((1, 2))
        self.held_out, self.kept = (part[has_readings[part]] for part in (self.held_out, self.kept))
        for note in self.data.notes:
            say(f"  data      {note}")
        self.record.notes += self.data.notes
        say(f"  held out  {len(self.held_out)} views")
        has_gains = fits_gains(self.settings, self.data)
        may_be_direct = not (has_gains or getattr(self.settings.data, "drift", 0))
        walk = Projector(self.data.geometry, grid, self.kept)
        iterations = GAIN_ITERATIONS if has_gains else ITERATIONS
        solve, self.choices = resolve_solver(self.settings.solve, walk, iterations, may_be_direct)
        self.settings = msgspec.structs.replace(self.settings, solve=solve)
        if solve.name in DIRECT:
            about = self.describe_run()
            self.record.method, self.record.citations = about["method"], about["citations"]
        self.record.plan += self.choices
        self.projector = make_projector(self.settings, self.data, grid)

    def announcement(self) -> list[str]:
        return list(self.data.notes)

    def make_problem(self) -> ProjectionProblem:
        walk = self.projector.subset(self.kept)
        storage = choose_matrix_storage(self.settings.solve, walk)
        self.record.plan.append(storage.line)
        return make_problem(self.settings, storage.apply(walk), self.data, self.kept)

    def prepare(self, run: RunFolder) -> None:
        self.problem.read_finished = lambda: self._continue_from(run.path)
        self.record.plan += estimate_noise(self.problem, self.settings.solve, self.data)
        self.noise = expected_noise(self.settings, self.problem, self.data)

    def _continue_from(self, folder: Path) -> np.ndarray:
        self.record.notes.append(f"the run continues from {FINISHED}: keep_state = true keeps the solver's state")
        return read_finished(folder, self.projector.grid)

    def optimizer(self) -> LinearSolve:
        return make_solver(self.settings, self.noise)

    def course(self) -> Course:
        return Course(self.settings.solve.iterations, events=(Checkpoint(every=self.settings.checkpoint_every),))

    def digests(self) -> dict[str, str]:
        return {"data": self.data.digest()}

    def evaluate(self, fit: Fit) -> Evaluation:
        state, problem = fit.run.state, self.problem.linear_problem
        volume = voxel_means(state.x.reshape(problem.A.grid.shape), self.grid.shape)
        errors = {"residual": state.residual_norm / data_norm(problem)}
        if self.data.truth is not None:
            errors["nrmse"] = nrmse(volume, self.data.truth)
        if self.noise:
            errors["discrepancy"] = state.residual_norm / self.noise
        return Evaluation(errors, {"volume": volume})

    def show(self, run: RunFolder, fit: Fit, evaluation: Evaluation) -> None:
        if is_preview_due(fit.next_iteration, self.settings.solve.iterations):
            write_preview(run.path, evaluation.values["volume"], tuple(self.grid.extent))
            run.write_newest(evaluation.values["volume"], self.grid.to_world)

    def live_images(self, run: RunFolder) -> list[Image]:
        preview = Image(path=PREVIEW, role="picture", caption="middle slices so far")
        return draw_steps(run, self.data, row_caption(self.data)) + ([preview] if (run.path / PREVIEW).exists() else [])

    def finish(self, fit: Fit, run: RunFolder) -> None:
        last, state, problem, record = self.settings.solve.iterations, fit.run.state, self.problem.linear_problem, self.record
        if fit.run.stop_reason and fit.next_iteration < last:
            record.notes.append(f"stopped after iteration {fit.next_iteration} of {last}: {fit.run.stop_reason}")
        record.results = {"iterations": float(state.iteration), "residual": state.residual_norm / data_norm(problem)}
        record.results["views"] = float(len(self.kept))
        record.plan += explain_prior(problem.prior, state)
        if self.data.is_noise_known:
            record.results["discrepancy"] = state.residual_norm / expected_residual_norm(problem, self.settings.solve.name)
        said = len(self.data.notes)
        self.data = subtract_fitted_light(self.problem, self.data, state)
        record.notes += self.data.notes[said:]
        if isinstance(problem, LeastSquares) and problem.gains is not None:
            size = float(np.std(self.data.removed_rings[0]))
            record.notes.append(f'rings: the gains of the columns scatter by {size:.2%} in the middle row (data.rings = "fit")')

    def write_outputs(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        volume = fit.run.state.x.reshape(self.projector.grid.shape)
        predicted = np.zeros(self.data.y.shape, np.float32)
        predicted[self.kept] = self.problem.linear_problem.A @ volume
        others = np.setdiff1d(np.arange(len(predicted)), self.kept)  # held-out and lost views
        if len(others):
            predicted[others] = self.projector.subset(others) @ volume
        write_outputs(run, predicted, self.grid, self.data, self.held_out, volume, self.settings.unit)
        if self.alignment is not None:
            moves, found = self.alignment.moves, self.alignment
            save_figure(plot_moves(moves, found.before, found.after), run.path / "moves.png")
            caption = "fitted moves of the detector, and the residual of held-out views without and with them"
            self.record.images.append(Image(path="moves.png", role="picture", caption=caption))
        write_best(run, self.grid, best, self.settings.unit)
        if not self.settings.keep_state:
            fit.run.is_left_to_outputs = True
            fit.save()

    def rehearse(self, say: Say) -> Explanation:
        settings = self.settings
        if settings.solve.start == "filtered":
            check_directions(self.projector)
        # Back-projection alone takes longer than the other steps of this rehearsal.
        cheap = msgspec.structs.replace(settings, solve=msgspec.structs.replace(settings.solve, start="empty"))
        walk = self.projector.subset(self.kept)
        storage = choose_matrix_storage(settings.solve, walk).line
        problem = make_problem(cheap, walk, self.data, self.kept)
        make_solver(settings, expected_noise(settings, problem, self.data)).begin(problem)
        for line in (*self.choices, storage):
            say(f"  {line.choice}, because {line.reason}")
        if settings.solve.tv:
            say(f"  total variation: {settings.solve.tv:g} in units of the {settings.solve.tv_unit}")
        return Explanation((f"  solver    {settings.solve.name}, at most {settings.solve.iterations} iterations",))


def load_scan(settings: config.ScanExperiment, base: Path) -> tuple[VoxelGrid, Projections]:
    """Return the voxels and the projections; without a table ``grid``, the voxels hold what the detector sees.

    Raises:
        MivolError: as :func:`make_voxel_grid` and :func:`make_data`, or voxels beyond the memory.
    """
    if settings.grid is not None or isinstance(settings.data, config.Nikon):
        grid = make_voxel_grid(settings, base)
        check_solver_memory(settings, grid)
        return grid, make_data(settings, base, grid)
    data = read_measured(settings, base)
    grid = grid_of_detector(data.geometry)
    check_solver_memory(settings, grid)
    return grid, check_data(settings, data, grid)


def make_projector(settings: config.ScanExperiment, data: Projections, grid: VoxelGrid) -> Projector:
    """Return the projector of the scan's rays through the unknowns.

    Raises:
        MivolError: more unknowns than memory.
    """
    unknowns = subdivide_grid(grid, settings.solve.supersampling, data.geometry)
    check_solver_memory(settings, unknowns, math.prod(data.geometry.shape))
    return Projector(data.geometry, unknowns)


def make_problem(settings: config.ScanExperiment, a: Projector, data: Projections, kept: np.ndarray) -> ProjectionProblem:
    """Return the solver's problem for the fitted views.

    Args:
        settings: settings with a resolved solver.
        a: projector of the fitted views.
        data: projections.
        kept: indices of the fitted views.

    Raises:
        MivolError: ML-TR without counts.
    """
    solve = settings.solve
    prior = make_prior(solve, a, data, kept)
    # Dr.Jit keeps arrays that are no longer used for later calls: as much again as a solver needs.
    dr.flush_malloc_cache()
    x0 = start_volume(solve, a, data, kept)
    dr.flush_malloc_cache()
    if ALL_SOLVERS[solve.name].problem is LeastSquares:
        weights = data.weights[kept]
        gains = PixelGains(weights) if fits_gains(settings, data) else None
        least_squares = LeastSquares(a, data.y[kept], weights, x0, solve.nonnegative, prior, gains)
        drift = DriftFit(view_times(data)[kept]) if getattr(settings.data, "drift", 0) else None
        return ProjectionProblem(least_squares, light=drift)
    if data.quanta is None:
        raise MivolError("ml-tr needs counts of quanta, found line integrals: simulate with photons, or choose pcg.")
    quanta = data.quanta.select_views(kept)
    return ProjectionProblem(PoissonCounts(a, quanta.counts, quanta.blank, quanta.background, x0, prior, quanta.used))


def fits_gains(settings: config.ScanExperiment, data: Projections) -> bool:
    """Whether gains of the pixels are unknowns of the fit: as asked, if the scan has rings."""
    return getattr(settings.data, "rings", "none") == "fit" and data.removed_rings is not None


def view_times(data: Projections) -> np.ndarray:
    """Times of the views from -1 to 1, evenly spaced."""
    return np.linspace(-1.0, 1.0, len(data.y))


def subtract_fitted_light(problem: ProjectionProblem, data: Projections, state: SolverState) -> Projections:
    """Subtract the fitted drift or gains from the line integrals of all views; the fitted views determine them."""
    task = problem.linear_problem
    if problem.light is not None:
        last = LightDrift(*(state.memory[name] for name in ("offset", "slope")))
        change = update_light(task, problem.light, last, state.x).eval(view_times(data))
        if not change.any():
            note = 'no drift of the light above chance: nothing is subtracted (data.rings = "gain" removes constant gains)'
            return replace(data, notes=(*data.notes, note))
        middle = change.shape[1] // 2
        shown = ("drift", data.y[:, middle], (data.y - change)[:, middle])
        note = f"the light of a pixel drifts by {np.std(change[-1] - change[0]):.2%} over the scan: subtracted (data.drift)"
        data = replace(data, pictures=(*data.pictures, shown), notes=(*data.notes, note))
    elif isinstance(task, LeastSquares) and task.gains is not None:
        change = task.gains.fit(task.b - (task.A @ state.x).reshape(task.b.shape))[None]
    else:
        return data
    removed = data.removed_rings
    if removed is not None:
        removed = removed + change[:, change.shape[1] // 2]
    return replace(data, y=data.y - change, removed_rings=removed)


def start_volume(solve: config.SolveSettings, a: Projector, data: Projections, kept: np.ndarray) -> np.ndarray | None:
    """Return the first volume of an iterative solver, nonnegative if requested; None means an empty volume.

    Raises:
        MivolError: geometries refused by filtered back-projection.
    """
    if solve.start == "empty" or solve.name in DIRECT:
        return None
    method = filtered_backprojection if isinstance(a.geometry, ParallelBeam) else feldkamp
    x = method(a, interpolate_gaps(data.y[kept], data.weights[kept]), solve.window, solve.cutoff)
    return np.maximum(x, 0) if solve.nonnegative else x


def expected_noise(settings: config.ScanExperiment, problem: ProjectionProblem, data: Projections) -> float | None:
    """Norm of the residual due to noise alone; None if the noise is unknown.

    Raises:
        MivolError: a stop by an unknown noise.
    """
    if settings.solve.discrepancy:
        check_noise("solve.discrepancy", data)
    return expected_residual_norm(problem.linear_problem, settings.solve.name) if data.is_noise_known else None


def make_solver(settings: config.ScanExperiment, noise: float | None) -> LinearSolve:
    """Return the solver with the settings, including a requested stop at the noise."""
    solve = settings.solve
    shared = {name: getattr(solve, name) for name in ("subsets", "relaxation", "decay", "window", "cutoff")}
    if solve.discrepancy:
        shared["stop_norm"] = solve.discrepancy * noise
    return LinearSolve(solver=solve.name, drift=drift_interval(settings), **shared)


def drift_interval(settings: config.ScanExperiment) -> int:
    """Iterations between two fits of the light's drift; 0: it is not fitted.

    The fits are spread evenly. A volume settles first, else the drift would take up what the volume does not yet explain.
    """
    count, solve = getattr(settings.data, "drift", 0), settings.solve
    return max(solve.iterations // (count + 1), PLAIN_ITERATIONS[solve.start]) if count else 0


def data_norm(task: LeastSquares | PoissonCounts) -> float:
    """|W^(1/2) b|, or sqrt(m), the expected norm of Pearson's residuals."""
    if isinstance(task, PoissonCounts):
        return float(np.sqrt(np.size(task.counts) if task.used is None else np.sum(task.used)))
    return float(np.sqrt(np.sum(task.weights * task.b**2))) or 1.0


# -- Outputs ---------------------------------------------------------------------------------------------------------------


def write_outputs(
    run: RunFolder,
    predicted: np.ndarray,
    grid: VoxelGrid,
    data: Projections,
    held_out: np.ndarray,
    x: np.ndarray,
    unit: str = "",
) -> None:
    """Write volume, sinogram, held-out views and curves, and record the files and the results.

    Args:
        run: run folder, with the iterations on record.
        predicted: line integrals (views, rows, cols) of ``x``, of fitted and held-out views.
        grid: requested voxels; those of ``x`` may be finer.
        data: projections.
        held_out: indices of the held-out views.
        x: reconstruction (Z, Y, X).
        unit: unit of lengths; "": unknown.
    """
    run.make("views", "volumes")
    record = run.record
    volume = voxel_means(x, grid.shape)
    record.volumes += write_grids(run.path, grid, volume, data.truth, unit)
    record.images += film_of_volume(run, volume[..., None], tuple(float(edge) for edge in grid.extent), "z", "sigma_t")
    middle = data.y.shape[1] // 2
    noise = line_noise(data)
    caption = row_caption(data)
    record.images += write_pair(run.path, SINOGRAM, Pair(data.y[:, middle], predicted[:, middle], noise[:, middle]), caption)
    if data.y.shape[1] > 1:
        for view in held_out[:4]:
            pair = Pair(*(part[view, ::-1] for part in (data.y, predicted, noise)))
            record.images += write_pair(run.path, f"view {view}", pair, held_out=True)
    record.images += draw_scanner(run.path, data.geometry, grid, held_out)
    record.images += draw_steps(run, data, caption)
    run.write_curves()
    if data.truth is not None:
        record.results["nrmse"] = nrmse(volume, data.truth)
    if len(held_out):
        z = (data.y - predicted)[held_out] * np.sqrt(data.weights[held_out])
        record.results["held_out_rms_of_residual_over_noise"] = float(np.sqrt(np.mean(z**2)))


STEPS = {
    "axis": "half a turn, then its mirror images about the middle of the detector (before) and about the found axis (after)",
    "motion": "moved views as measured, and at the places of an unmoved detector,",
    "rings": "ring removal",
}
"""Captions of the pictures of steps whose name does not say enough."""


def row_caption(data: Projections) -> str:
    """Name of the middle row of the detector."""
    return f"row {data.y.shape[1] // 2 + 1} of {data.y.shape[1]}"


def draw_steps(run: RunFolder, data: Projections, caption: str) -> list[Image]:
    """Draw what each step of the preparation changed in the middle row; return the pictures."""
    steps, row = list(data.pictures), data.y[:, data.y.shape[1] // 2]
    if data.removed_rings is not None:
        steps.append(("rings", row + data.removed_rings, row))
    images = []
    for name, before, after in steps:
        save_figure(plot_ring_removal(before, after), run.path / f"{name}.png")
        said = f"{STEPS.get(name, name)} in {caption}, each line one view"
        images.append(Image(path=f"{name}.png", role="picture", caption=said))
    return images


FINISHED = "volumes/reconstruction.npz"
"""The volume from which a finished run continues."""


def read_finished(folder: Path, unknowns: VoxelGrid) -> np.ndarray:
    """The volume of a finished run, (n,) on the grid of the unknowns: those in a voxel have its value.

    Raises:
        MivolError: no such volume, or one of another size.
    """
    volume = read_volume(folder / FINISHED).values[..., 0]
    parts = [n // edge for n, edge in zip(unknowns.shape, volume.shape, strict=True)]
    if tuple(k * edge for k, edge in zip(parts, volume.shape, strict=True)) != unknowns.shape:
        raise MivolError(
            f"{folder / FINISHED}: found {volume.shape} voxels, expected a divisor of {unknowns.shape}: run without --resume."
        )
    for axis, k in enumerate(parts):
        volume = np.repeat(volume, k, axis)
    return volume.reshape(-1)


def write_best(run: RunFolder, grid: VoxelGrid, best: BestIterate, unit: str) -> None:
    """Write the best iterate beside the last iterate, if the iterates differ."""
    if not best.is_newest:
        values = best.read()["volume"].reshape(grid.shape)
        write_volume(run.path / "volumes/reconstruction_best.npz", values, grid.to_world, metadata=_name_unit(unit))


def _name_unit(unit: str) -> dict[str, object]:
    """Metadata of a volume with the unit of its lengths, if known."""
    return {"unit": unit} if unit else {}


class Pair(NamedTuple):
    """Line integrals of equal shape: measured, predicted, and the standard deviation; NaN if unknown."""

    measured: np.ndarray
    predicted: np.ndarray
    noise: np.ndarray


def line_noise(data: Projections) -> np.ndarray:
    """Standard deviations of the line integrals: inf for unused pixels, NaN if only ratios of weights are known."""
    if not data.is_noise_known:
        return np.full(data.y.shape, np.nan)
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(data.weights)


def write_pair(folder: Path, name: str, pair: Pair, caption: str = "", held_out: bool = False) -> list[Image]:
    """Write measured and predicted line integrals and the noise as layers of a file."""
    path = f"views/{name.replace(' ', '_')}.exr"
    layers = {"Y": pair.predicted, "reference.Y": pair.measured}
    roles = {"render": "Y", "reference": "reference.Y"}
    if not np.isnan(pair.noise).any():
        layers["noise.Y"], roles["standard error"] = pair.noise, "noise.Y"
    write_exr(folder / path, {layer: values.astype(np.float32) for layer, values in layers.items()})
    common = {"path": path, "view": name, "held_out": held_out, "quantity": LINES, "unit": "1", "caption": caption}
    return [Image(role=role, layer=layer, **common) for role, layer in roles.items()]


def write_grids(folder: Path, grid: VoxelGrid, x: np.ndarray, truth: np.ndarray | None, unit: str) -> list[Volume]:
    """Write the reconstruction as .vol and .npz, and the truth if known; the .npz keeps the unit of lengths."""
    volumes, size = [], tuple(float(edge) for edge in grid.extent)
    for role, values in {"reconstruction": x, **({"truth": truth} if truth is not None else {})}.items():
        write_volume(folder / f"volumes/{role}.vol", values, grid.to_world)
        write_volume(folder / f"volumes/{role}.npz", values, grid.to_world, metadata=_name_unit(unit))
        about = {"size": size, "unit": f"1/{unit or 'length'}", "profiles": True}
        volumes.append(Volume(path=f"volumes/{role}.npz", role=role, **about))
    return volumes
