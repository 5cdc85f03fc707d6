"""The projections of a scan: measured, computed from a volume, or exact line integrals of a phantom."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol import config
from mivol.config import Cone, Ellipsoids, Known, Matrices, Nikon, OfData, ReadingSettings, ViewTable, is_circle
from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.experiments.readings import ScanReadings, even_angles, nikon_grid, note_order, note_rows, read_scan
from mivol.files import read_columns, read_volume
from mivol.files.fetch import resolve_path
from mivol.files.image_stack import ALL
from mivol.machine import check_memory
from mivol.optim.projections.inversion import ALL_SOLVERS
from mivol.optim.projections.linear_problems import PoissonCounts
from mivol.tomography.cone_axis import axis_from_fans, cone_axis_offset
from mivol.tomography.filtered import covers_circle
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import COLUMNS, PanelViews, make_helix, panels_from_matrices
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import (
    AIR_RANGE,
    Air,
    Quanta,
    Transmission,
    count_quanta,
    find_air,
    find_lost_views,
    fit_air,
    interpolate_gaps,
    normalise_air,
    to_line_integrals,
)
from mivol.tomography.projector import Projector
from mivol.tomography.rings import FIRST_WIDTH, RING_WIDTHS, find_zingers, remove_rings
from mivol.tomography.rotation_axis import axis_from_entropy, find_axis
from mivol.tomography.single_material import filter_phase

RAY_BYTES = 3 * 8
"""Memory per ray of a computed scan [byte]: exact value, noisy value and weight, in float64."""


@with_short_repr
@dataclass(frozen=True)
class Projections:
    """Line integrals with their geometry.

    Attributes:
        geometry: beam and detector.
        y: line integrals (views, rows, cols).
        weights: inverse variances of the line integrals.
        truth: true volume (Z, Y, X), if known.
        quanta: numbers of quanta, if known: simulated, or from readings with flats and darks.
        notes: notes for the report.
        removed_rings: (views, cols) removed from the middle row, for the report; None without ring removal.
        pictures: (name, before, after) of other corrections, for the report; the middle row (views, cols).
        is_noise_known: whether 1 / weights are the variances; otherwise 1 / weights are only proportional to the variances.
    """

    geometry: FlatDetector
    y: np.ndarray
    weights: np.ndarray
    truth: np.ndarray | None = None
    quanta: Quanta | None = None
    notes: tuple[str, ...] = ()
    is_noise_known: bool = False
    removed_rings: np.ndarray | None = None
    pictures: tuple[tuple[str, np.ndarray, np.ndarray], ...] = ()

    def digest(self) -> str:
        """SHA-256 of projections and weights."""
        return hashlib.sha256(self.y.tobytes() + self.weights.tobytes()).hexdigest()


def describe_beam(settings: config.ScanExperiment) -> str:
    """Name of the beam."""
    return f"{type(settings.data if isinstance(settings.scan, OfData) else settings.scan).__name__.lower()} beam"


def make_geometry(settings: config.ScanExperiment, base: Path) -> FlatDetector:
    """Return beam and detector of computed projections."""
    scan = settings.scan
    if isinstance(scan, ViewTable | Matrices):
        return make_beam(settings, base, np.arange(0), scan.detector)
    angles = even_angles(scan, scan.views * max(1, len(getattr(scan, "sources", ()))))
    return make_beam(settings, base, angles, scan.detector)


def make_beam(settings: config.ScanExperiment, base: Path, angles: np.ndarray, detector: tuple[int, int]) -> FlatDetector:
    """Return the beam of the settings, with these angles [rad] and pixels."""
    scan = settings.scan
    if isinstance(scan, ViewTable):
        return PanelViews(read_columns(base / scan.file, COLUMNS), detector)
    if isinstance(scan, Matrices):
        matrices = read_columns(base / scan.file, COLUMNS).reshape(-1, 3, 4)
        return panels_from_matrices(matrices, detector, settings.grid.centre, scan.first_pixel)
    offsets = {"axis_offset": scan.axis_offset, "detector_offset": scan.detector_offset, "tilt": np.radians(scan.tilt)}
    if isinstance(scan, Cone):
        beam = ConeBeam(angles, detector, scan.source_to_axis, scan.source_to_detector, scan.pitch, **offsets)
        return beam if is_circle(scan) else make_helix(beam, scan.lift, scan.sources)
    return ParallelBeam(angles, detector, scan.pitch, **offsets)


def make_voxel_grid(settings: config.ScanExperiment, base: Path) -> VoxelGrid:
    """Return the voxels.

    Raises:
        MivolError: neither a table ``grid`` nor a grid in the data.
    """
    voxels = settings.grid
    return nikon_grid(settings.data, base) if voxels is None else VoxelGrid(voxels.shape, voxels.voxel_size, voxels.centre)


def grid_of_detector(beam: ParallelBeam | ConeBeam) -> VoxelGrid:
    """Voxels as large as a pixel at the axis, as many rows and columns as the detector has.

    If views cover a whole turn and the axis lies more than an eighth of the columns beside the middle, the wider side of the
    detector sees the whole object in half of the views each: the voxels reach as far on both sides.
    """
    rows, columns = beam.detector
    scale = beam.source_to_detector / beam.source_to_axis if isinstance(beam, ConeBeam) else 1.0
    offset = abs(beam.axis_offset * scale - beam.detector_offset[1]) / beam.pitch[1]
    if offset > columns / 8 and covers_circle(beam.angles, 2 * np.pi):
        columns = 2 * int(np.ceil(columns / 2 + offset))
    height, edge = (float(pitch) / scale for pitch in beam.pitch)
    return VoxelGrid((rows, columns, columns), (edge, edge, height))


def make_data(settings: config.ScanExperiment, base: Path, grid: VoxelGrid) -> Projections:
    """Read or compute the projections.

    Raises:
        MivolError: unreadable files, files of different sizes, rays that all miss the grid, or more rays than memory.
    """
    if isinstance(settings.data, ReadingSettings):
        return check_data(settings, read_measured(settings, base), grid)
    check_rays(settings)
    geometry = make_geometry(settings, base)
    exact, truth = SIMULATED[type(settings.data)](settings.data, base, geometry, grid)
    check_hits(Projector(geometry, grid))
    return add_noise(geometry, exact, truth, settings.data.photons, settings.data.seed)


def check_data(settings: config.ScanExperiment, data: Projections, grid: VoxelGrid) -> Projections:
    """Check measured projections against the grid, and note rows that are upside down.

    Raises:
        MivolError: as :func:`check_hits`.
    """
    check_hits(Projector(data.geometry, grid))
    return replace(data, notes=(*data.notes, *note_rows(settings.data, data.geometry, grid, data.y, data.weights)))


def check_rays(settings: config.ScanExperiment) -> None:
    """Refuse a computed scan beyond the memory; a table of views counts as one view.

    Raises:
        MivolError: with the number of rays.
    """
    rows, columns = settings.scan.detector
    views = getattr(settings.scan, "views", 1)
    subject = f"a scan of {views} x {rows} x {columns} rays"
    check_memory(RAY_BYTES * views * rows * columns, subject, "give scan.detector or scan.views fewer of them")


def check_hits(projector: Projector) -> None:
    """Refuse a scan whose source is inside the grid, or whose rays all miss the grid, by up to eight of its views.

    Raises:
        MivolError: with the extent of the grid.
    """
    grid, geometry = projector.grid, projector.geometry
    advice = "give all lengths of scan and grid in one unit, and check distances, offsets and grid.centre."
    if not geometry.whole_lines:
        distance = np.abs(geometry.panels().source - grid.centre)
        inside = (distance < np.divide(grid.extent, 2)).all(axis=1)
        if inside.any():
            raise MivolError(
                f"the source of view {inside.argmax()} is inside the grid, whose edges are "
                f"{tuple(round(edge, 4) for edge in grid.extent.tolist())}: {advice}"
            )
    some = projector.subset(np.unique(np.linspace(0, projector.n_views - 1, 8).astype(int)))
    if (some @ np.ones(projector.grid.shape, np.float32)).any():
        return
    raise MivolError(
        f"no ray meets the grid, which reaches {grid.radius:.4g} from {tuple(round(c, 4) for c in grid.centre)}: {advice}"
    )


def project_ellipsoids(
    settings: Ellipsoids, base: Path, geometry: FlatDetector, grid: VoxelGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Return exact line integrals, and the phantom averaged over voxels."""
    phantom = shepp_logan(settings.table, settings.half_width)
    # For a head of 128^3 voxels, two sub-points an edge have an error of 0.06, four an error of 0.015, below the judged errors.
    return settings.scale * phantom.project(geometry), settings.scale * phantom.voxelise(grid, 4)


def project_volume(known: Known, base: Path, geometry: FlatDetector, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return line integrals of a volume file, and the volume.

    Raises:
        MivolError: several channels, or another shape than the grid.
    """
    values = read_volume(resolve_path(base, known.file)).values
    if values.shape != (*grid.shape, 1):
        raise MivolError(f"{known.file} has shape {values.shape}, grid.shape is {grid.shape} of one channel: make them equal.")
    truth = known.scale * values[..., 0]
    return Projector(geometry, grid) @ truth, truth


SIMULATED = {Ellipsoids: project_ellipsoids, Known: project_volume}


def add_noise(geometry: FlatDetector, exact: np.ndarray, truth: np.ndarray, photons: float, seed: int) -> Projections:
    """Return line integrals of Poisson counts with weights 1 / var y = counts; exact line integrals without photons.

    A pixel without a quantum has no logarithm, and gets y = 0 with weight 0.
    """
    if not photons:
        return Projections(geometry, exact, np.ones_like(exact), truth)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-exact)).astype(np.float64)
    y = np.where(counts > 0, -np.log(np.maximum(counts, 1.0) / photons), 0.0)
    quanta = Quanta(counts, photons, 0.0, np.ones(counts.shape, bool))
    return Projections(geometry, y, counts, truth, quanta, is_noise_known=True)


def read_measured(settings: config.ScanExperiment, base: Path, rows: slice = ALL, air: Air | None = None) -> Projections:
    """Read measured projections as line integrals with weights; find the rotation axis of a circular scan if requested.

    Args:
        settings: settings of the scan.
        base: folder from which relative paths start.
        rows: rows of the detector, counted upwards. Their beam is in the middle of the detector.
        air: light of the air, found before; None: as ``data.air`` says.

    Raises:
        MivolError: an unreadable file, or files of different sizes.
    """
    data, readings = settings.data, read_scan(settings, base, rows)
    notes, angles = [*readings.notes, *readings.transmission.notes], readings.angles
    if angles is not None:
        notes += note_order(angles)
    # Scattered light brightens the air: it is not looked for before the scatter is known.
    columns = 0 if data.air is None and data.scatter and not data.hardening else data.air
    given, lost_notes = leave_out_lost_views(readings.transmission)
    transmission, light, air_notes = correct_air(given, columns, air)
    pictures = [] if light is None else [show_step("air", given.value, transmission.value)]
    if readings.intensity is not None:
        check_light(transmission)
    transmission, corrections, shown = correct_pixels(data, transmission)
    notes += [*lost_notes, *air_notes, *corrections]
    measured, weights = to_line_integrals(transmission)
    if not weights.any():
        raise MivolError(
            "found no reading of the views with light, expected some: give flats of the same exposure, which are as bright as "
            "air in the views, and darks below the views."
        )
    y, ring_notes = correct_rings(measured, weights, data)
    notes += ring_notes
    removed = None if y is measured else (measured - y)[:, y.shape[1] // 2]
    geometry = readings.geometry
    if geometry is None:
        geometry = make_beam(settings, base, np.arange(0) if angles is None else angles, y.shape[1:])
    if geometry.shape != y.shape:
        raise MivolError(f"found {len(y)} projections and a geometry of {geometry.shape[0]} views, expected as many.")
    pictures += shown
    if isinstance(geometry, ParallelBeam | ConeBeam):
        offset, axis_notes = resolve_axis(settings.data, geometry, y, weights)
        notes += axis_notes
        if offset is not None:
            geometry = replace(geometry, axis_offset=offset)
            pictures += show_axis(geometry, y)
    unused = int((weights == 0).sum())
    if unused:
        notes.append(f"{unused} of {weights.size} pixels have no light or no finite reading: they are not used")
    is_noise_known = readings.intensity is not None and readings.transmission.is_noise_known
    quanta = (
        count_measured_quanta(settings, readings, light)
        if ALL_SOLVERS[settings.solve.solver].problem is PoissonCounts
        else None
    )
    return Projections(
        geometry,
        y,
        weights,
        quanta=quanta,
        notes=tuple(notes),
        is_noise_known=is_noise_known,
        removed_rings=removed,
        pictures=tuple(pictures),
    )


def leave_out_lost_views(transmission: Transmission) -> tuple[Transmission, list[str]]:
    """Take the readings of spoiled views away, and say so; a scan of such views alone stays as it is."""
    notes, lost = [], np.zeros(len(transmission.value), bool)
    for found, why in zip(find_lost_views(transmission), ("without light", "brighter than any view can be"), strict=True):
        lost |= found
        if numbers := np.flatnonzero(found).tolist():
            named = ", ".join(map(str, numbers[:8])) + ", ..." * (len(numbers) > 8)
            notes.append(f"{len(numbers)} of {len(lost)} views are not used, because they are {why}: {named} (counted from 0)")
    if not lost.any() or lost.all():
        return transmission, []
    return replace(transmission, value=np.where(lost[:, None, None], np.nan, transmission.value)), notes


def check_light(transmission: Transmission) -> None:
    """Refuse views that are brighter than the light without object.

    Raises:
        MivolError: a median transmission above ``AIR_RANGE``.
    """
    finite = transmission.value[np.isfinite(transmission.value)]
    middle = float(np.median(finite)) if finite.size else 0.0
    if middle > AIR_RANGE[1]:
        raise MivolError(
            f"found views with {middle:.3g} times the light of the flats (median), expected at most {AIR_RANGE[1]:g}: give "
            "flats of the same exposure, or set data.air to the columns of air at each edge."
        )


def correct_pixels(
    data: config.ReadingSettings, transmission: Transmission
) -> tuple[Transmission, list[str], list[tuple[str, np.ndarray, np.ndarray]]]:
    """Leave out zingers and remove phase contrast, if the settings ask for it; notes and pictures say so.

    Raises:
        MivolError: as :func:`mivol.tomography.single_material.filter_phase`.
    """
    notes, pictures = [], []
    middle = transmission.value.shape[1] // 2
    if data.zingers:
        found = find_zingers(transmission, data.zingers)
        before = transmission.value[:, middle]
        transmission = replace(transmission, value=np.where(found, np.nan, transmission.value))
        after = interpolate_gaps(before[None], ~found[None, :, middle])[0]
        pictures.append(show_step("zingers", before[:, None], after[:, None]))
        notes.append(f"{found.sum()} of {found.size} pixels are zingers or hot (data.zingers = {data.zingers:g}): not used")
    if data.phase is not None:
        before, chosen = transmission.value, data.phase
        transmission, length = filter_phase(transmission, chosen.delta_beta, chosen.distance, chosen.energy, chosen.pixel)
        pictures.append(show_step("phase", before, transmission.value))
        notes.append(f"Paganin's filter of a single material has a length of {length:.3g} pixels (data.phase)")
    return transmission, notes, pictures


def show_step(name: str, before: np.ndarray, after: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """A picture of a step for the report: line integrals of the middle row of transmissions (views, rows, cols)."""
    middle = before.shape[1] // 2

    def lines(transmission: np.ndarray) -> np.ndarray:
        row = transmission[:, middle]
        seen = np.isfinite(row) & (row > 0)
        return np.where(seen, -np.log(np.where(seen, row, 1.0)), 0.0)

    return name, lines(before), lines(after)


def show_axis(beam: ParallelBeam | ConeBeam, y: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """A picture of the axis of a parallel beam: half a turn of the middle row, then its mirror images about the axis.

    They continue the views if the axis is right. The picture before has the axis in the middle of the detector.
    """
    if not isinstance(beam, ParallelBeam):
        return []
    row = y[np.abs(beam.angles - beam.angles[0]) < np.pi, y.shape[1] // 2]
    columns = np.arange(y.shape[2])
    middle = (y.shape[2] - 1) / 2
    found = middle + (beam.axis_offset - beam.detector_offset[1]) / beam.pitch[1]

    def mirror(column: float) -> np.ndarray:
        return np.stack([np.interp(2 * column - columns, columns, view, 0.0, 0.0) for view in row])

    return [("axis", *(np.concatenate([row, mirror(column)]) for column in (middle, found)))]


def correct_rings(y: np.ndarray, weights: np.ndarray, data: config.ReadingSettings) -> tuple[np.ndarray, list[str]]:
    """Remove rings if the settings ask for it, and say so.

    Args:
        y, weights: line integrals and weights (views, rows, cols).
        data: ``rings`` and ``ring_width`` count.

    Returns:
        The line integrals, the same array if nothing is removed; notes.

    Raises:
        MivolError: as :func:`mivol.tomography.rings.remove_rings`.
    """
    if data.rings == "none":
        return y, []
    # The gains that the solver fits are counted from what the filter leaves.
    method, width = ("gain", FIRST_WIDTH) if data.rings == "fit" else (data.rings, RING_WIDTHS[data.rings])
    width = width if data.ring_width is None else data.ring_width
    found = remove_rings(y, weights, method, width)
    if np.array_equal(found, y):
        return y, [f'no rings above chance: nothing is removed (data.rings = "{data.rings}")']
    size = float(np.sqrt(np.mean((y - found) ** 2)))
    said = f'ring removal (data.rings = "{data.rings}", {width} columns) changed the line integrals by {size:.2g} (RMS)'
    return found, [said]


def correct_air(
    transmission: Transmission, columns: int | None, found: Air | None = None
) -> tuple[Transmission, np.ndarray | None, list[str]]:
    """Divide a transmission by the light of the air at the edges of the detector, and say so.

    Args:
        transmission: transmission of a scan.
        columns: columns without object at each edge; 0: no correction; None: air is looked for.
        found: air found before, in place of a search.

    Returns:
        The corrected transmission; the light, to broadcast against it, or None; notes.
    """
    if columns:
        return normalise_air(transmission, columns), fit_air(transmission.value, columns), []
    air = (found or _find_air_of_used_views(transmission)) if columns is None else None
    if air is None or not air.is_needed:
        return transmission, None, [] if air is None or air.is_believed else [_describe_doubtful_air(air)]
    least, most = air.factor.min(), air.factor.max()
    size = f"{most:.4g} +- {air.uncertainty:.2g}" if least == most else f"{least:.4g} to {most:.4g}"
    said = f"the air at both edges of the detector has {size} of the flats' light: views are divided by it (data.air = 0: not)"
    return air.normalise(transmission), air.factor[:, None, None], [said]


def _find_air_of_used_views(transmission: Transmission) -> Air | None:
    """As :func:`mivol.tomography.preprocess.find_air`, without views that have no reading; their factor is the mean."""
    used = np.isfinite(transmission.value).any((1, 2))
    if used.all():
        return find_air(transmission)
    air = find_air(replace(transmission, value=transmission.value[used], variance=transmission.variance[used]))
    if air is None:
        return None
    factor = np.full(len(used), air.factor.mean())
    factor[used] = air.factor
    return replace(air, factor=factor)


def _describe_doubtful_air(air: Air) -> str:
    return (
        f"both edges of the detector have {air.factor.mean():.3g} of the flats' light, too far from 1 to be taken for air: the "
        f"object is wider than the detector, or the flats have another exposure; data.air = {air.columns} divides by it"
    )


def resolve_axis(
    data: config.ReadingSettings, beam: ParallelBeam | ConeBeam, y: np.ndarray, weights: np.ndarray
) -> tuple[float | None, list[str]]:
    """Return the found ``axis_offset`` of a circular scan [length] or None, and notes.

    A known offset of the beam replaces the search, unless ``data.find_axis = true``.
    """
    search, known = data.find_axis, beam.axis_offset + 0.0  # no -0
    known_place = f"where {'the scan file' if isinstance(data, Nikon) else 'scan.axis_offset'} has it, {known:g}"
    if beam.tilt and search is None:
        return None, [f"the axis is tilted by {np.degrees(beam.tilt):g} degrees: it is {known_place}"]
    if search or (search is None and not known):
        offset, notes = find_rotation_axis(beam, y, weights, known_place, search == "entropy")
        return offset, notes
    if search is None:
        return None, [f"the rotation axis is {known_place}: data.find_axis = true looks for it"]
    return None, []


def find_rotation_axis(
    beam: ParallelBeam | ConeBeam, y: np.ndarray, weights: np.ndarray, known_place: str, by_entropy: bool = False
) -> tuple[float | None, list[str]]:
    """Return the ``axis_offset`` of a circular scan [length] and notes; None if a cone beam does not determine it.

    Raises:
        MivolError: as :func:`mivol.tomography.rotation_axis.find_axis` or :func:`axis_from_entropy`, for a parallel beam.
    """
    used = weights.any((1, 2))
    if not used.all():  # a view without readings has no mirror image
        y, weights, beam = y[used], weights[used], replace(beam, angles=beam.angles[used])
    if by_entropy:
        axis = axis_from_entropy(y, weights, beam.angles)
        note = f"rotation axis at column {axis.column:.2f} ({axis.method}; no standard deviation is known)"
        try:
            other = find_axis(y, weights, beam.angles)
            judged = f"data.find_axis = true says column {other.column:.2f} +- {other.uncertainty:.2f} ({other.method})"
        except MivolError as error:
            judged = f"data.find_axis = true finds none: {error}"
        return axis.offset(y.shape[2], beam.pitch[1]) + beam.detector_offset[1], [note, judged]
    if isinstance(beam, ParallelBeam):
        axis = find_axis(y, weights, beam.angles)
        offset = axis.offset(y.shape[2], beam.pitch[1]) + beam.detector_offset[1]
    else:
        try:
            axis = axis_from_fans(y, weights, beam)
        except MivolError as error:
            return None, [f"the rotation axis is {known_place}: {error}"]
        offset = cone_axis_offset(axis, beam)
    return offset, [f"rotation axis at column {axis.column:.2f} +- {axis.uncertainty:.2f} ({axis.method})"]


def count_measured_quanta(settings: config.ScanExperiment, readings: ScanReadings, light: np.ndarray | None = None) -> Quanta:
    """Return the numbers of quanta of a measured scan; ``light`` is that of the air over the flats'.

    Raises:
        MivolError: data without flats and darks, or with a drift or ring removal, which only line integrals have.
    """
    if readings.intensity is None or settings.data.drift or settings.data.rings != "none":
        raise MivolError(
            "ml-tr needs counts of quanta, found line integrals, transmissions, a drift or ring removal: give readings with "
            "flats and darks, and neither data.drift nor data.rings, or choose pcg."
        )
    quanta = count_quanta(*readings.intensity, settings.data.saturation)
    return quanta if light is None else replace(quanta, blank=quanta.blank * light)


def held_out_views(settings: config.ScanExperiment, count: int) -> np.ndarray:
    """Indices of the held-out views, which are predicted and not fitted."""
    every = settings.held_out_every
    if every == 1:
        raise MivolError("held_out_every = 1 holds out all views, expected some to fit: choose 2 or more, or 0.")
    return np.arange(every // 2, count, every) if every else np.arange(0)


def fitted_views(held_out: np.ndarray, count: int) -> np.ndarray:
    """Indices of the fitted views."""
    return np.setdiff1d(np.arange(count), held_out)
