"""Projections of a scan: measured, of a volume that is known, or exact chords through a phantom."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol import config
from mivol.config import Cone, Detector, Ellipsoids, Known, Matrices, Measured, Nikon, OfData, Parallel, Stack, Table
from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.experiments.readings import ScanReadings, nikon_grid, note_order, read_scan
from mivol.experiments.row_order import note_rows
from mivol.files import read_columns, read_volume
from mivol.files.fetch import resolve_path
from mivol.machine import check_memory
from mivol.optim.projections.linear_problems import PoissonCounts
from mivol.optim.projections.solvers import ALL_SOLVERS
from mivol.tomography.fan_axis import axis_from_fans, cone_axis_offset
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import COLUMNS, PanelViews, panels_from_matrices
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import (
    Quanta,
    count_quanta,
    fit_air,
    normalise_air,
    to_line_integrals,
)
from mivol.tomography.projector import Projector
from mivol.tomography.rotation_axis import find_axis

RAY_BYTES = 3 * 8
"""Of a ray of a computed scan: what is exact, what is seen of it and its weight, in float64."""


@with_short_repr
@dataclass(frozen=True)
class Projections:
    """Line integrals and what they were taken with.

    Attributes:
        geometry: beam and detector.
        y: line integrals (views, rows, cols).
        weights: their inverse variances.
        truth: (Z, Y, X), where known.
        quanta: numbers of quanta, where they are known: simulated, or of readings with flats and darks.
        notes: what was found out on the way.
        is_noise_known: whether 1 / weights are variances, and not only in proportion to them.
    """

    geometry: FlatDetector
    y: np.ndarray
    weights: np.ndarray
    truth: np.ndarray | None = None
    quanta: Quanta | None = None
    notes: tuple[str, ...] = ()
    is_noise_known: bool = False

    def digest(self) -> str:
        """SHA-256 of projections and weights."""
        return hashlib.sha256(self.y.tobytes() + self.weights.tobytes()).hexdigest()


def beam_of(chosen: config.ScanExperiment) -> str:
    """The kind of beam, for people."""
    return f"{type(chosen.data if isinstance(chosen.scan, OfData) else chosen.scan).__name__.lower()} beam"


def make_geometry(chosen: config.ScanExperiment, base: Path) -> FlatDetector:
    """Beam and detector of computed projections."""
    wanted = chosen.scan
    angles = np.arange(0) if isinstance(wanted, Table | Matrices) else evenly(wanted)
    return place_beam(chosen, base, angles, wanted.detector)


def evenly(wanted: Detector) -> np.ndarray:
    """Angles [rad] spread over the arc."""
    return np.radians(wanted.arc) * np.arange(wanted.views) / wanted.views


def place_beam(
    chosen: config.ScanExperiment, base: Path, angles: np.ndarray, detector: tuple[int, int], axis_offset: float | None = None
) -> FlatDetector:
    """The beam that was asked for, with these angles [rad] and pixels; a found ``axis_offset`` replaces the file's."""
    wanted = chosen.scan
    if isinstance(wanted, Table):
        return PanelViews(read_columns(base / wanted.file, COLUMNS), detector)
    if isinstance(wanted, Matrices):
        matrices = read_columns(base / wanted.file, COLUMNS).reshape(-1, 3, 4)
        return panels_from_matrices(matrices, detector, chosen.grid.centre, wanted.first_pixel)
    offsets = {
        "axis_offset": wanted.axis_offset if axis_offset is None else axis_offset,
        "detector_offset": wanted.detector_offset,
    }
    if isinstance(wanted, Cone):
        return ConeBeam(angles, detector, wanted.source_to_axis, wanted.source_to_detector, wanted.pitch, **offsets)
    return ParallelBeam(angles, detector, wanted.pitch, **offsets)


def make_grid(chosen: config.ScanExperiment, base: Path) -> VoxelGrid:
    """Where the voxels lie.

    Raises:
        MivolError: no table ``grid``, and none in the data.
    """
    wanted = chosen.grid
    return nikon_grid(chosen.data, base) if wanted is None else VoxelGrid(wanted.shape, wanted.voxel_size, wanted.centre)


def make_data(chosen: config.ScanExperiment, base: Path, grid: VoxelGrid) -> Projections:
    """Projections, measured or computed.

    Raises:
        MivolError: files that cannot be read or do not fit, rays that all miss the grid, or more of them than memory.
    """
    is_measured = isinstance(chosen.data, Measured | Stack | Nikon)
    if is_measured:
        data = read_measured(chosen, base)
    else:
        check_rays(chosen)
        geometry = make_geometry(chosen, base)
        exact, truth = SIMULATED[type(chosen.data)](chosen.data, base, geometry, grid)
        data = add_noise(geometry, exact, truth, chosen.data.photons, chosen.data.seed)
    check_hits(Projector(data.geometry, grid))
    if not is_measured:
        return data
    return replace(data, notes=(*data.notes, *note_rows(chosen.data, data.geometry, grid, data.y, data.weights)))


def check_rays(chosen: config.ScanExperiment) -> None:
    """Refuse a computed scan of more rays than can be kept; of a table of views, one view is counted.

    Raises:
        MivolError: with how many there are.
    """
    rows, columns = chosen.scan.detector
    views = getattr(chosen.scan, "views", 1)
    what = f"a scan of {views} x {rows} x {columns} rays"
    check_memory(RAY_BYTES * views * rows * columns, what, "give scan.detector or scan.views fewer of them")


def check_hits(projector: Projector) -> None:
    """Refuse a scan whose rays all miss the grid, by up to eight of its views.

    Raises:
        MivolError: how far the grid is from the rays' origins.
    """
    some = projector.subset(np.unique(np.linspace(0, projector.n_views - 1, 8).astype(int)))
    if (some @ np.ones(projector.grid.shape, np.float32)).any():
        return
    grid = projector.grid
    raise MivolError(
        f"no ray meets the grid, which reaches {grid.radius:.4g} from {tuple(round(c, 4) for c in grid.centre)}: give all "
        "lengths of scan and grid in one unit, and check distances, offsets and grid.centre."
    )


def project_ellipsoids(
    wanted: Ellipsoids, base: Path, geometry: FlatDetector, grid: VoxelGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Exact chords, and the phantom averaged over voxels."""
    phantom = shepp_logan(wanted.table, wanted.half_width)
    # Two sub-points an edge err by 0.06 of a head of 128^3, four by 0.015: less than what is judged by them.
    return wanted.scale * phantom.project(geometry), wanted.scale * phantom.voxelise(grid, 4)


def project_volume(wanted: Known, base: Path, geometry: FlatDetector, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals of a volume file, and the volume.

    Raises:
        MivolError: it has several channels or another shape than the grid.
    """
    values = read_volume(resolve_path(base, wanted.file)).values
    if values.shape != (*grid.shape, 1):
        raise MivolError(f"{wanted.file} has shape {values.shape}, grid.shape is {grid.shape} of one channel: make them equal.")
    truth = wanted.scale * values[..., 0]
    return Projector(geometry, grid) @ truth, truth


SIMULATED = {Ellipsoids: project_ellipsoids, Known: project_volume}


def add_noise(geometry: FlatDetector, exact: np.ndarray, truth: np.ndarray, photons: float, seed: int) -> Projections:
    """Line integrals of Poisson counts, weighted by 1 / var y = counts; without photons the exact ones.

    A pixel without a single quantum has no logarithm: y = 0 and weight 0.
    """
    if not photons:
        return Projections(geometry, exact, np.ones_like(exact), truth)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-exact)).astype(np.float64)
    y = np.where(counts > 0, -np.log(np.maximum(counts, 1.0) / photons), 0.0)
    quanta = Quanta(counts, photons, 0.0, np.ones(counts.shape, bool))
    return Projections(geometry, y, counts, truth, quanta, is_noise_known=True)


def read_measured(chosen: config.ScanExperiment, base: Path) -> Projections:
    """Readings from files as line integrals with weights; the axis of a circular scan is found where asked for.

    Raises:
        MivolError: a file that cannot be read, or does not fit the others.
    """
    wanted, found = chosen.data, read_scan(chosen, base)
    notes, angles = list(found.notes), found.angles
    if angles is not None:
        notes += note_order(angles)
    y, weights = to_line_integrals(normalise_air(found.transmission, wanted.air) if wanted.air else found.transmission)
    offset = None
    if isinstance(chosen.scan, Parallel | Cone):
        offset, said = settle_axis(chosen, base, y, weights, angles)
        notes += said
    unused = int((weights == 0).sum())
    if unused:
        notes.append(f"{unused} of {weights.size} pixels have no light or no finite reading: they are not used")
    geometry = found.geometry
    if geometry is None:
        geometry = place_beam(chosen, base, np.arange(0) if angles is None else angles, y.shape[1:], offset)
    if geometry.shape != y.shape:
        raise MivolError(f"found {len(y)} projections and a geometry of {geometry.shape[0]} views, expected as many.")
    quanta = quanta_of(chosen, found) if ALL_SOLVERS[chosen.solve.solver].problem is PoissonCounts else None
    return Projections(geometry, y, weights, quanta=quanta, notes=tuple(notes), is_noise_known=found.intensity is not None)


def settle_axis(
    chosen: config.ScanExperiment, base: Path, y: np.ndarray, weights: np.ndarray, angles: np.ndarray
) -> tuple[float | None, list[str]]:
    """The ``axis_offset`` of a circular scan [length] where it is looked for, else None, and what is said about it.

    An offset in a file holds, unless the file says ``data.find_axis = true`` besides.
    """
    wanted, given = chosen.data.find_axis, chosen.scan.axis_offset
    if wanted or (wanted is None and not given):
        offset, said = look_for_axis(chosen, base, y, weights, angles)
        return offset, [said]
    if wanted is None:
        return None, [f"the rotation axis is where scan.axis_offset has it, {given:g}: data.find_axis = true looks for it"]
    return None, []


def look_for_axis(
    chosen: config.ScanExperiment, base: Path, y: np.ndarray, weights: np.ndarray, angles: np.ndarray
) -> tuple[float | None, str]:
    """The ``axis_offset`` of a circular scan [length], and a sentence about it; None where a cone beam does not tell it.

    Raises:
        MivolError: as :func:`mivol.tomography.rotation_axis.find_axis`, of a parallel beam.
    """
    if isinstance(chosen.scan, Parallel):
        axis = find_axis(y, weights, angles)
        offset = axis.offset(y.shape[2], float(np.broadcast_to(chosen.scan.pitch, (2,))[1]))
    else:
        beam = place_beam(chosen, base, angles, y.shape[1:])
        try:
            axis = axis_from_fans(y, weights, beam)
        except MivolError as error:
            return None, f"the rotation axis is where scan.axis_offset has it, {beam.axis_offset:g}: {error}"
        offset = cone_axis_offset(axis, beam)
    return offset, f"rotation axis at column {axis.column:.2f} +- {axis.uncertainty:.2f} ({axis.method})"


def quanta_of(chosen: config.ScanExperiment, found: ScanReadings) -> Quanta:
    """Numbers of quanta of a measured scan; where air is named, the light without an object is as bright as it is there.

    Raises:
        MivolError: data without flats and darks, or with a drift, which only line integrals take.
    """
    if found.intensity is None or chosen.data.drift:
        raise MivolError(
            "ml-tr needs counts of quanta, found line integrals, transmissions or a drift: give readings with flats and darks, "
            "and no data.drift, or choose pcg."
        )
    quanta = count_quanta(*found.intensity, chosen.data.saturation)
    if not chosen.data.air:
        return quanta
    return replace(quanta, blank=quanta.blank * fit_air(found.transmission.value, chosen.data.air))


def held_out_views(chosen: config.ScanExperiment, count: int) -> np.ndarray:
    """Numbers of the views that are predicted, not fitted."""
    every = chosen.held_out_every
    if every == 1:
        raise MivolError("held_out_every = 1 holds out all views, expected some to fit: choose 2 or more, or 0.")
    return np.arange(every // 2, count, every) if every else np.arange(0)


def fitted_views(held_out: np.ndarray, count: int) -> np.ndarray:
    """Numbers of the views that are not held out."""
    return np.setdiff1d(np.arange(count), held_out)
