"""A reconstruction of a volume beyond memory: slabs of layers along z, one after the other, written as they are finished.

A slab needs the detector rows onto which it projects. In parallel light these are its own rows; in a cone beam neighbouring
slabs share rows. Filtered back-projection treats each row and each layer separately, so slabs equal the whole volume to
rounding. An iterative solver solves each slab of a parallel beam by itself. If layers lie between rows, or a prior compares
neighbouring layers, slabs overlap by ``OVERLAP`` layers, which are dropped. In a cone beam, ``sirt`` and ``os-sart`` sweep over
the whole volume on the disk first (:class:`DiskSweeps`), and the slabs are then copied from it.

Conventions. The run folder has ``preview.png`` and ``volumes/preview.npz`` first, then slices in ``volumes/slices`` or
``volumes/reconstruction.zarr``. ``slabs.json`` lists the finished slabs; a resumed run continues after them.
"""

from __future__ import annotations

import itertools
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mivol import config
from mivol.back_end import choose_back_end
from mivol.config import AUTO, Ellipsoids, Known
from mivol.errors import MivolError
from mivol.experiments.fit_kind import RunContext, Say
from mivol.experiments.projections import (
    Projections,
    add_noise,
    describe_beam,
    grid_of_detector,
    make_geometry,
    make_voxel_grid,
    read_measured,
)
from mivol.experiments.readings import detector_size, read_scan
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.scan_fit import draw_steps, make_problem, make_solver
from mivol.experiments.solver_choice import choose_matrix_storage, estimate_noise, resolve_solver
from mivol.files import write_volume
from mivol.files.atomic import write_whole_text
from mivol.files.tiff import TiffSlices
from mivol.files.zarr import ZarrSlices
from mivol.machine import peak_memory
from mivol.optim.projections.disk_sweeps import DiskSweeps, SweepState
from mivol.optim.projections.inversion import ALL_SOLVERS, DIRECT
from mivol.optim.projections.linear_problems import last_state
from mivol.report.page import write_page
from mivol.report.pixel_scale import PREVIEW, write_preview
from mivol.report.record import Image, PlanLine, RunRecord
from mivol.scene.explain import Explanation
from mivol.tomography.filtered import check_directions, feldkamp, filtered_backprojection, pixel_matrices
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid, subdivide_grid, voxel_means
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import find_air, interpolate_gaps
from mivol.tomography.projector import Projector

STATE = "slabs.json"
"""Finished slabs, with the settings."""

AXIS_ROWS = 16
"""Rows in the middle of the detector in which rotation axis and air are looked for."""

OVERLAP = 8
"""Layers of a slab beyond its ends, in which the effect of missing neighbours fades."""

BASE_BYTES = 350 << 20
"""Memory of Python, Dr.Jit and Mitsuba before the first slab [byte]."""

RAY_BYTES, VOXEL_BYTES = {"direct": 60, "iterative": 160}, {"direct": 12, "iterative": 60}
"""Memory per ray and per unknown of a slab [byte]. ``mivol bench scan_size --only whole`` prints the peak beside the planned
memory, with ``--solver pcg`` that of an iterative solver."""

SWEEPS = "volumes/sweeps"
"""Folder of volume and projections during sweeps; removed in the end."""

SWEPT = ("sirt", "os-sart")
"""Solvers whose iterations sweep over a volume on the disk: they need no other vectors of its size from one to the next."""

PREVIEW_STEP, PREVIEW_UPDATES = 8, 1 << 34
"""Layers between two slices of the preview, and most readings of pixels by voxels: about ten seconds on two cores."""

JUDGED_LAYERS = 64
"""Most layers that are compared with a known truth."""


@dataclass(frozen=True)
class RowSource:
    """Projections by rows of the detector.

    Attributes:
        beam: beam with the whole detector.
        read: function from rows to their line integrals.
        truth: function from a grid to the true volume; None if unknown.
        notes: notes for the report.
        sample: some rows in the middle, whose steps of preparation the report shows; None if computed.
    """

    beam: ParallelBeam | ConeBeam
    read: Callable[[slice], Projections]
    truth: Callable[[VoxelGrid], np.ndarray] | None = None
    notes: tuple[str, ...] = ()
    sample: Projections | None = None


def open_source(settings: config.ScanExperiment, base: Path) -> RowSource:
    """Find geometry, rotation axis and air of a scan from a few of its rows; read the others later.

    Raises:
        MivolError: a trajectory, data or settings that slabs do not take; or as :func:`read_measured`.
    """
    _check_settings(settings)
    if isinstance(settings.data, Ellipsoids):
        return _computed_source(settings, base)
    _, rows, columns = detector_size(settings, base)
    some = min(rows, AXIS_ROWS + (rows - AXIS_ROWS) % 2)
    middle = slice((rows - some) // 2, (rows + some) // 2)
    sample = read_measured(settings, base, middle)
    if not isinstance(sample.geometry, ParallelBeam | ConeBeam):
        raise MivolError("found a tilted or rolled axis in the scan, expected a circle about z for slabs: leave out [slabs].")
    beam = replace(sample.geometry, detector=(rows, columns))
    air = find_air(read_scan(settings, base, middle).transmission) if settings.data.air is None else None
    fixed = msgspec.structs.replace(settings, data=msgspec.structs.replace(settings.data, find_axis=False))
    if settings.data.air is None and (air is None or not air.is_needed):
        fixed, air = msgspec.structs.replace(fixed, data=msgspec.structs.replace(fixed.data, air=0)), None

    def read(part: slice) -> Projections:
        data = read_measured(fixed, base, part, air)
        return replace(data, geometry=beam.select_rows(part))

    return RowSource(beam, read, notes=sample.notes, sample=sample)


def _check_settings(settings: config.ScanExperiment) -> None:
    if isinstance(settings.data, Known):
        raise MivolError('slabs need projections by rows, found data.source = "volume": use "shepp_logan" or measured data.')
    if settings.solve.name == "ml-tr" or getattr(settings.data, "drift", 0):
        raise MivolError("slabs take neither ml-tr nor data.drift, which need all rows at once: choose another solver.")
    whole = {
        'data.rings = "fit"': getattr(settings.data, "rings", "none") == "fit",
        "data.hardening": getattr(settings.data, "hardening", 0),
        "data.scatter": getattr(settings.data, "scatter", False),
        "scan.refine": getattr(settings.scan, "refine", ()),
        "scan.tilt": getattr(settings.scan, "tilt", 0.0),
    }
    found = [name for name, is_set in whole.items() if is_set]
    if found:
        raise MivolError(f"slabs do not take {found[0]}, which needs all rows at once: leave it out, or leave out [slabs].")
    if not (config.is_circle(settings.scan) or isinstance(settings.scan, config.OfData)):
        raise MivolError("slabs need a circle about z, found another trajectory: leave out [slabs].")


def _computed_source(settings: config.ScanExperiment, base: Path) -> RowSource:
    data, beam = settings.data, make_geometry(settings, base)
    phantom = shepp_logan(data.table, data.half_width)

    def read(rows: slice) -> Projections:
        some = beam.select_rows(rows)
        exact = data.scale * phantom.project(some)
        if not data.photons:
            return add_noise(some, exact, None, 0, 0)
        # Each row has random numbers of its own, so that noise does not depend on the size of a slab.
        seeds = [[data.seed, row] for row in range(beam.shape[1])[rows]]
        parts = [add_noise(some, exact[:, k : k + 1], None, data.photons, seed) for k, seed in enumerate(seeds)]
        y, weights = (np.concatenate([getattr(part, name) for part in parts], axis=1) for name in ("y", "weights"))
        return Projections(some, y, weights, is_noise_known=True)

    return RowSource(beam, read, lambda grid: data.scale * phantom.voxelise(grid, 4))


# -- Plan ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlabPlan:
    """Slabs of a grid, and the solver.

    Attributes:
        source: the projections.
        grid: all voxels.
        settings: settings with a resolved solver.
        layers: layers of each slab.
        overlap: layers of a slab beyond its ends, dropped in the end.
        choices: choices and reasons.
    """

    source: RowSource
    grid: VoxelGrid
    settings: config.ScanExperiment
    layers: tuple[slice, ...]
    overlap: int
    choices: tuple[PlanLine, ...]


def plan_slabs(settings: config.ScanExperiment, base: Path) -> SlabPlan:
    """Choose solver and slabs.

    Raises:
        MivolError: as :func:`open_source`, a memory below that of a single layer, or another iterative solver of a cone beam.
    """
    source = open_source(settings, base)
    has_grid = settings.grid is not None or isinstance(settings.scan, config.OfData)
    grid = make_voxel_grid(settings, base) if has_grid else grid_of_detector(source.beam)
    walk = Projector(source.beam, grid)
    solve, choices = _resolve(settings.solve, source.beam, walk)
    if isinstance(source.beam, ConeBeam):
        _check_cone_solver(solve)
    if solve.name in DIRECT and settings.solve.tv:
        raise MivolError(f"{solve.name} takes no solve.tv: choose pcg, or leave it out.")
    is_local = solve.name in DIRECT or isinstance(source.beam, ConeBeam)
    overlap = 0 if is_local or (not solve.tv and _are_layers_rows(source.beam, grid)) else OVERLAP
    settings = msgspec.structs.replace(settings, solve=solve)
    count = _most_layers(settings, source.beam, grid, overlap)
    layers = tuple(slice(first, min(first + count, grid.shape[0])) for first in range(0, grid.shape[0], count))
    reason = (
        f"{_slab_bytes(settings, source.beam, grid, layers, overlap) / 2**30:.2g} GiB, of at most {settings.slabs.memory:g}"
    )
    number = f"{len(layers)} slab" + "s" * (len(layers) != 1)
    choices.append(PlanLine(choice=f"{number} of {count} layers", reason=reason))
    if settings.held_out_every:
        choices.append(PlanLine(choice="held out: no view", reason="slabs predict no views, so all views are used"))
    return SlabPlan(source, grid, settings, layers, overlap, tuple(choices))


def _check_cone_solver(solve: config.SolveSettings) -> None:
    """Refuse solvers whose vectors do not fit, and unknowns that are not the voxels."""
    if solve.name not in (*DIRECT, *SWEPT):
        raise MivolError(
            f"found {solve.name} for slabs of a cone beam, expected fdk, sirt or os-sart: rays cross slabs, and {solve.name} "
            "keeps several vectors of the volume's size; choose os-sart, or leave out [slabs] and give grid.shape fewer voxels."
        )
    if solve.name in SWEPT and (solve.tv or solve.supersampling != 1):
        raise MivolError(
            f"found solve.tv = {solve.tv:g} and solve.supersampling = {solve.supersampling} for slabs of a cone beam by "
            f"{solve.name}, expected 0 and 1: leave them out."
        )


def _resolve(
    solve: config.SolveSettings, beam: ParallelBeam | ConeBeam, walk: Projector
) -> tuple[config.SolveSettings, list[PlanLine]]:
    """The solver; ``auto`` is a single step if the views allow it."""
    if solve.name == AUTO:
        try:
            check_directions(walk)
        except MivolError:
            swept = isinstance(beam, ConeBeam)
            return resolve_solver(msgspec.structs.replace(solve, name="os-sart") if swept else solve, walk)
        name = "fbp" if isinstance(beam, ParallelBeam) else "fdk"
        found = msgspec.structs.replace(solve, name=name, start="empty", supersampling=1, tv=solve.tv or 0.0)
        return found, [PlanLine(choice=f"solver: {name}", reason="slabs are done in a single step; solve.name sets another")]
    if solve.name in DIRECT:
        check_directions(walk)
    return resolve_solver(solve, walk)


def _are_layers_rows(beam: ParallelBeam, grid: VoxelGrid) -> bool:
    """Whether each layer of the grid lies at the height of a row."""
    row = (grid.axis("z") - beam.v[0]) / beam.pitch[0]
    return bool(np.abs(row - np.rint(row)).max() < 1e-6 and math.isclose(grid.voxel_size[2], beam.pitch[0]))


def _most_layers(settings: config.ScanExperiment, beam: ParallelBeam | ConeBeam, grid: VoxelGrid, overlap: int) -> int:
    """Most layers of a slab within the memory, in whole packets of sixteen if possible."""
    budget, total = settings.slabs.memory * 2**30, grid.shape[0]

    def fits(count: int) -> bool:
        starts = {0, (total - count) // 2, total - count}
        return _slab_bytes(settings, beam, grid, [slice(s, s + count) for s in starts], overlap) <= budget

    if fits(total):
        return total
    if not fits(1):
        needed = _slab_bytes(settings, beam, grid, [slice(0, 1)], overlap) / 2**30
        raise MivolError(
            f"a slab of one layer needs {needed:.2g} GiB, found slabs.memory = {settings.slabs.memory:g}: set it to "
            f"{math.ceil(10 * needed) / 10:g} or more."
        )
    low, high = 1, total
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low if low < 16 else low - low % 16


def _slab_bytes(
    settings: config.ScanExperiment, beam: ParallelBeam | ConeBeam, grid: VoxelGrid, layers: Any, overlap: int
) -> float:
    """Memory of the largest of some slabs [byte]."""
    kind = "direct" if settings.solve.name in DIRECT else "iterative"
    views, _, columns = beam.shape
    if _is_swept(settings.solve, beam):
        views = _views_at_once(settings, beam)
    most = 0.0
    for part in layers:
        wide = _widen(part, overlap, grid.shape[0])
        slab = grid.select_layers(wide)
        rows = rows_of_slab(beam, slab)
        rays = views * columns * len(range(rows.start, rows.stop))
        voxels = subdivide_grid(slab, settings.solve.supersampling or 1, beam).size
        most = max(most, rays * RAY_BYTES[kind] + voxels * VOXEL_BYTES[kind])
    return BASE_BYTES + most


def _views_at_once(settings: config.ScanExperiment, beam: ConeBeam) -> int:
    """Views of a product during sweeps: their rays take a third of the memory."""
    views, rows, columns = beam.shape
    budget = (settings.slabs.memory * 2**30 - BASE_BYTES) / 3
    return min(views, max(1, int(budget / (RAY_BYTES["iterative"] * rows * columns))))


def _widen(layers: slice, overlap: int, total: int) -> slice:
    return slice(max(0, layers.start - overlap), min(total, layers.stop + overlap))


def rows_of_slab(beam: ParallelBeam | ConeBeam, slab: VoxelGrid) -> slice:
    """Return the rows of the detector between which the voxel centres of a slab cast their shadows, upwards; may be empty."""
    return _shadowed_rows(beam, slab, 0.0)


def rows_of_box(beam: ParallelBeam | ConeBeam, slab: VoxelGrid) -> slice:
    """Return the rows whose rays cross the box of a slab, as :func:`rows_of_slab`."""
    return _shadowed_rows(beam, slab, 0.5)


def _shadowed_rows(beam: ParallelBeam | ConeBeam, slab: VoxelGrid, margin: float) -> slice:
    """Rows between the shadows of the outermost voxel centres, each ``margin`` voxels further out."""
    matrices = pixel_matrices(beam, slab)
    ends = ((-margin, n - 1 + margin) for n in slab.shape[::-1])
    corners = np.array(list(itertools.product(*ends, (1,))), float)
    row, depth = matrices[:, 1] @ corners.T, matrices[:, 2] @ corners.T
    rows = beam.shape[1]
    if not (depth > 0).all():
        return slice(0, rows)
    place = row / depth
    # Rounding must not add a row.
    first, end = math.floor(place.min() + 1e-6), math.ceil(place.max() - 1e-6) + 1
    return slice(min(max(first, 0), rows), min(max(end, 0), rows))


# -- Run -------------------------------------------------------------------------------------------------------------------


def run_slabs(context: RunContext) -> Path:
    """Reconstruct slab by slab, and write preview, slabs and report page.

    Returns:
        The report page.

    Raises:
        MivolError: as :func:`plan_slabs`, a folder of a run with other settings, or a disk error.
        KeyboardInterrupt: Ctrl-C; finished slabs are kept, and ``context.resume`` continues.
    """
    settings = context.settings
    if context.distribution is not None:
        raise MivolError("slabs run in one process, found --cluster: leave it out.")
    choose_back_end(settings.variant, settings.threads)
    state = _read_state(context) if context.resume else {"settings": _fingerprint(settings), "done": {}}
    record = RunRecord.new(
        settings.title,
        config=config.list_all_settings(settings),
        command=context.command,
        method=f"slabs on line integrals of a {describe_beam(settings)}",
        seeds={"noise": getattr(settings.data, "seed", 0)},
        citations=["mitsuba3", "drjit"],
    )
    record.notes += context.notes
    run = RunFolder(context.folder, record, context.resume)
    with run.at_work():
        with run.stage("projections"):
            plan = plan_slabs(settings, context.base)
        record.notes += plan.source.notes
        record.plan += plan.choices
        record.citations += [*ALL_SOLVERS[plan.settings.solve.name].cites]
        context.progress.say([*plan.source.notes, *(f"{line.choice}, because {line.reason}" for line in plan.choices)])
        run.begin(0)
        run.make("volumes")
        if plan.source.sample is not None:
            record.images += draw_steps(run, plan.source.sample, "a row in the middle")
        with run.stage("preview"):
            caption = _write_preview(plan, preview_rows(plan), run.path)
            record.images.append(Image(path=PREVIEW, role="picture", caption=caption))
            context.progress.say([f"{run.path / PREVIEW}: {caption}"])
        solved = _sweep(plan, state, run, context) if _is_swept(plan.settings.solve, plan.source.beam) else None
        with run.stage("slabs"):
            writer = _open_writer(plan, run)
            for layers in context.progress.track(plan.layers, "slabs"):
                _complete_slab(plan, layers, writer, state, run.path, solved)
        shutil.rmtree(run.path / SWEEPS, ignore_errors=True)
        record.results |= _results(plan, state)
        record.notes.append(
            f"the volume is {writer.path.relative_to(run.path)}, {' x '.join(map(str, plan.grid.shape))} voxels"
        )
    page = write_page(context.folder)
    context.progress.say([run.summary(), str(writer.path)])
    return page


def _open_writer(plan: SlabPlan, run: RunFolder) -> TiffSlices | ZarrSlices:
    if plan.settings.slabs.format == "tiff":
        return TiffSlices(run.path / "volumes/slices", plan.grid.shape)
    path = run.path / "volumes/reconstruction.zarr"
    return ZarrSlices(path, plan.grid.shape, plan.grid.to_world, unit=plan.settings.unit, resume=run.is_resumed)


def explain_slabs(settings: config.ScanExperiment, base: Path, say: Say) -> Explanation:
    """Describe a reconstruction by slabs; say facts."""
    plan = plan_slabs(settings, base)
    views, rows, columns = plan.source.beam.shape
    say(f"  grid      {' x '.join(map(str, plan.grid.shape))} voxels")
    say(f"  scan      {views} views of {rows} x {columns} pixels, {describe_beam(settings)}")
    for note in plan.source.notes:
        say(f"  data      {note}")
    for line in plan.choices:
        say(f"  {line.choice}, because {line.reason}")
    return Explanation((f"  solver    {plan.settings.solve.name}, slab by slab",))


def _is_swept(solve: config.SolveSettings, beam: ParallelBeam | ConeBeam) -> bool:
    return solve.name in SWEPT and isinstance(beam, ConeBeam)


def make_sweeps(plan: SlabPlan, folder: Path) -> DiskSweeps:
    """Return the sweeps of a cone beam's iterative solver over the files of a folder."""
    solve, views = plan.settings.solve, plan.source.beam.shape[0]
    options: dict[str, Any] = {}
    if solve.name == "os-sart":
        options = {"n_subsets": min(solve.subsets, views), "relaxation": solve.relaxation, "decay": solve.decay}
    return DiskSweeps(
        plan.source.beam,
        plan.grid,
        plan.layers,
        lambda slab: rows_of_box(plan.source.beam, slab),
        _views_at_once(plan.settings, plan.source.beam),
        folder,
        nonnegative=solve.nonnegative,
        **options,
    )


def prepare_sweeps(plan: SlabPlan, sweeps: DiskSweeps) -> SweepState:
    """Write line integrals and the first volume of sweeps."""

    def read(rows: slice) -> np.ndarray:
        data = plan.source.read(rows)
        return np.where(data.weights > 0, data.y, np.nan)

    def filtered(layers: slice) -> np.ndarray:
        volume = _backproject_slab(plan, layers, config.SolveSettings(name="fdk"))
        return np.maximum(volume, 0) if sweeps.nonnegative else volume

    return sweeps.prepare(read, filtered if plan.settings.solve.start == "filtered" else None)


def _sweep(plan: SlabPlan, state: dict[str, Any], run: RunFolder, context: RunContext) -> np.ndarray | None:
    """The volume after all sweeps, read from the disk; None if all slabs are written."""
    if len(state["done"]) == len(plan.layers):
        return None
    run.make(SWEEPS)
    sweeps = make_sweeps(plan, run.path / SWEEPS)
    with run.stage("sweeps"):
        if "sweeps" in state:
            at = SweepState(**state["sweeps"])
        else:
            at = prepare_sweeps(plan, sweeps)
            _keep(state, run.path, sweeps=asdict(at))
        total = plan.settings.solve.iterations * sweeps.n_subsets
        states = sweeps.run(at)
        for _ in context.progress.track(range(at.steps, total), "subsets"):
            at = next(states)
            _keep(state, run.path, sweeps=asdict(at))
    norms = ", ".join(f"{value:.4g}" for value in (at.residuals[0], at.residuals[-1]))
    context.progress.say([f"{len(at.residuals)} sweeps over the volume; residual of the first and the last: {norms}"])
    return sweeps.volume(at)


def _keep(state: dict[str, Any], folder: Path, **more: Any) -> None:
    """Add to the progress of a run, and write it."""
    state |= more
    write_whole_text(folder / STATE, json.dumps(state))


def _complete_slab(
    plan: SlabPlan,
    layers: slice,
    writer: TiffSlices | ZarrSlices,
    state: dict[str, Any],
    folder: Path,
    solved: np.ndarray | None,
) -> None:
    """Reconstruct a slab, or take it from the solved volume, and write it, unless it is finished."""
    key = f"{layers.start}-{layers.stop}"
    if key in state["done"]:
        return
    volume = reconstruct_slab(plan, layers) if solved is None else np.array(solved[layers])
    writer.write(layers.start, volume)
    _keep(state, folder, done=state["done"] | {key: _compare(plan, layers, volume)})


def reconstruct_slab(plan: SlabPlan, layers: slice) -> np.ndarray:
    """Return some layers (layers, Y, X) of the volume, by a solver that takes each slab by itself."""
    if plan.settings.solve.name in DIRECT:
        return _backproject_slab(plan, layers, plan.settings.solve)
    wide = _widen(layers, plan.overlap, plan.grid.shape[0])
    slab = plan.grid.select_layers(wide)
    rows = rows_of_slab(plan.source.beam, slab)
    if rows.start == rows.stop:
        return np.zeros((layers.stop - layers.start, *slab.shape[1:]), np.float32)
    volume = _iterate(plan.settings, plan.source.read(rows), slab)
    return volume[layers.start - wide.start :][: layers.stop - layers.start]


def _backproject_slab(plan: SlabPlan, layers: slice, solve: config.SolveSettings) -> np.ndarray:
    """Some layers (layers, Y, X) by filtered back-projection; 0 beyond the detector's rows."""
    slab = plan.grid.select_layers(layers)
    rows = rows_of_slab(plan.source.beam, slab)
    if rows.start == rows.stop:
        return np.zeros(slab.shape, np.float32)
    data = plan.source.read(rows)
    return _reconstruct_directly(Projector(data.geometry, slab), interpolate_gaps(data.y, data.weights), solve)


def _reconstruct_directly(projector: Projector, y: np.ndarray, solve: config.SolveSettings, cutoff: float = 1.0) -> np.ndarray:
    method = filtered_backprojection if isinstance(projector.geometry, ParallelBeam) else feldkamp
    return method(projector, y, solve.window, solve.cutoff * cutoff)


def _iterate(settings: config.ScanExperiment, data: Projections, slab: VoxelGrid) -> np.ndarray:
    """Solve a slab as a scan of its own."""
    solve = settings.solve
    projector = Projector(data.geometry, subdivide_grid(slab, solve.supersampling, data.geometry))
    operator = choose_matrix_storage(solve, projector).apply(projector)
    problem = make_problem(settings, operator, data, np.arange(projector.n_views))
    estimate_noise(problem, solve, data)
    options = make_solver(settings, None).options()
    state = last_state(ALL_SOLVERS[solve.name].run(problem.linear_problem, None, **options), solve.iterations)
    if state is None:
        return np.zeros(slab.shape, np.float32)
    return voxel_means(state.x.reshape(projector.grid.shape), slab.shape)


def preview_rows(plan: SlabPlan) -> slice:
    """Return the rows of the preview: every eighth, or more of a small scan."""
    rows = plan.source.beam.shape[1]
    step = min(PREVIEW_STEP, max(1, rows // 4), max(1, plan.grid.shape[0] // 4))
    return slice(step // 2, rows, step)


def _read_lines(plan: SlabPlan, rows: slice, views: np.ndarray) -> np.ndarray:
    """Line integrals (views, rows, cols), float32, of some rows and views. Half of the memory limits the rows read at once."""
    n_views, n_rows, columns = plan.source.beam.shape
    chosen = range(n_rows)[rows]
    budget = (plan.settings.slabs.memory * 2**30 - BASE_BYTES) / 2
    at_once = max(1, int(budget / (RAY_BYTES["direct"] * n_views * columns)))
    lines = np.empty((len(views), len(chosen), columns), np.float32)
    for first in range(0, len(chosen), at_once):
        part = chosen[first : first + at_once]
        data = plan.source.read(slice(part.start, part.stop, part.step))
        lines[:, first : first + len(part)] = interpolate_gaps(data.y, data.weights)[views]
    return lines


def _write_preview(plan: SlabPlan, rows: slice, folder: Path) -> str:
    """Write every eighth slice from some rows, coarse enough for half a minute; return a caption."""
    beam, grid, step = plan.source.beam, plan.grid, rows.step
    layers = grid.select_layers(slice(step // 2, grid.shape[0], step))
    weight = 1 if isinstance(beam, ParallelBeam) else 8
    updates = weight * layers.size * beam.shape[0]
    coarse = next(k for k in itertools.count(1) if updates <= PREVIEW_UPDATES * k**3)
    n_y, n_x = (max(1, n // coarse) for n in grid.shape[1:])
    x_size, y_size, z_size = layers.voxel_size
    small = VoxelGrid((layers.shape[0], n_y, n_x), (x_size * coarse, y_size * coarse, z_size), layers.centre)
    views = np.arange(0, beam.shape[0], coarse)
    solve = plan.settings.solve if plan.settings.solve.name in DIRECT else config.SolveSettings()
    try:
        projector = Projector(beam.select_rows(rows), small, views)
        check_directions(projector)
        volume = _reconstruct_directly(projector, _read_lines(plan, rows, views), solve, 1 / coarse)
    except MivolError as error:
        return f"no preview: {error}"
    write_volume(folder / "volumes/preview.npz", volume, small.to_world, compress=False)
    write_preview(folder, volume, tuple(small.extent))
    coarser = f", from one view of {coarse}, with voxels of {coarse} x {coarse}" * (coarse > 1)
    return f"preview of one slice of {step}{coarser} (volumes/preview.npz)"


def _compare(plan: SlabPlan, layers: slice, volume: np.ndarray) -> list[float]:
    """Squared error and squared norm of some layers whose truth is known."""
    step = max(1, plan.grid.shape[0] // JUDGED_LAYERS)
    judged = [layer for layer in range(layers.start, layers.stop) if layer % step == step // 2]
    if plan.source.truth is None or not judged:
        return [0.0, 0.0]
    pairs = [(volume[z - layers.start], plan.source.truth(plan.grid.select_layers(slice(z, z + 1)))[0]) for z in judged]
    return [
        float(sum(np.sum((a - b) ** 2.0) for a, b in pairs)),
        float(sum(np.sum(np.square(b, dtype=float)) for _, b in pairs)),
    ]


def _results(plan: SlabPlan, state: dict[str, Any]) -> dict[str, float | None]:
    error, norm = np.sum([*state["done"].values()], axis=0)
    memory = peak_memory()
    results: dict[str, float | None] = {"slabs": float(len(plan.layers))}
    results |= {} if memory is None else {"memory": memory / 2**20}
    return results | ({"nrmse": math.sqrt(error / norm)} if norm else {})


# -- Resume ----------------------------------------------------------------------------------------------------------------


def _fingerprint(settings: config.ScanExperiment) -> dict[str, str]:
    """Settings that a resumed run must share, as text."""
    return {name: str(value) for name, value in config.flatten_settings(config.list_all_settings(settings)).items()}


def _read_state(context: RunContext) -> dict[str, Any]:
    path = context.folder / STATE
    try:
        state = json.loads(path.read_text())
        known, _ = state["settings"], state["done"]
    except FileNotFoundError:
        raise MivolError(f"{path}: found no finished slab, expected a run to resume: leave out --resume.") from None
    except (ValueError, KeyError, TypeError):
        raise MivolError(f"{path}: found a damaged list of slabs, expected that of a run: leave out --resume.") from None
    mine = _fingerprint(context.settings)
    differing = [name for name in known.keys() | mine.keys() if known.get(name) != mine.get(name)]
    if differing:
        name = sorted(differing)[0]
        raise MivolError(
            f"{path}: found {name} = {known.get(name)}, expected {mine.get(name)} as in these settings: resume with the same "
            "settings, or leave out --resume."
        )
    return state
