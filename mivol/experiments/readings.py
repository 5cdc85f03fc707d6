"""Measured projections from files: transmission, with angles or geometry if present in the files; wrong orders are noted.

Upside-down rows. Coarse reconstructions with both row orders detect them. Views from opposite sides see the heights of an
object from either side. If source and detector are symmetric about a plane, as on a circle with a centred detector, an
upside-down scan equals a scan of the mirrored object. Both cases have the same projections, also in parallel light. A detector
displaced along v, a helix, or another trajectory breaks the symmetry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol import config
from mivol.config import Detector, Matrices, Measured, Nikon, Stack, ViewTable
from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.files import read_projections, read_stack
from mivol.files.dicom_views import has_views, survey_dicom_views
from mivol.files.fetch import resolve_path
from mivol.files.image_stack import ALL, read_header_angles, stack_shape
from mivol.files.mrc import read_tilt_angles
from mivol.files.nikon import NikonScan, read_nikon, read_nikon_angles, read_nikon_transmission
from mivol.files.scan_hdf5 import NO_DARKS, survey_projections
from mivol.files.source import refusal
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares, last_state
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import PanelViews, geometry_from_nikon
from mivol.tomography.preprocess import Transmission, assume_quantum_noise, correct_transmission
from mivol.tomography.projector import Projector


@with_short_repr
@dataclass(frozen=True, eq=False)
class ScanReadings:
    """Content of the files of a scan.

    Attributes:
        transmission: transmission (views, rows, cols), lowest row first.
        angles: angles (views,) [rad]; None if the geometry has the angles.
        geometry: geometry, if present in the files.
        intensity: readings, flats and darks, if present in the files.
        notes: notes for the report.
    """

    transmission: Transmission
    angles: np.ndarray | None = None
    geometry: FlatDetector | None = None
    intensity: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    notes: tuple[str, ...] = ()


def read_scan(settings: config.ScanExperiment, base: Path, rows: slice) -> ScanReadings:
    """Read a measured scan, or some rows of its detector, counted upwards.

    Raises:
        MivolError: an unreadable file, or files of different sizes.
    """
    return READERS[type(settings.data)](settings, base, rows)


def detector_size(settings: config.ScanExperiment, base: Path) -> tuple[int, int, int]:
    """Return (views, rows, columns) of a measured scan, without its readings if the format allows.

    Raises:
        MivolError: as :func:`read_scan`.
    """
    data = settings.data
    if isinstance(data, Measured):
        names = {role: getattr(data, role) for role in ("data", "flats", "darks", "angles")}
        scan = survey_projections(resolve_path(base, data.file), data.group, names, data.angle_unit)
        rows = data.rows[1] - data.rows[0] if data.rows else scan.pixels[0]
        return scan.frames[0], rows, scan.pixels[1]
    if isinstance(data, Stack):
        first, second, columns = stack_shape(base / data.file, data.dataset or None)
        return (second, first, columns) if data.images == "sinograms" else (first, second, columns)
    scan = read_nikon(base / data.file)
    return len(scan.images), *scan.detector


def read_hdf5_scan(settings: config.ScanExperiment, base: Path, rows: slice) -> ScanReadings:
    """Read a scan in an HDF5 file.

    Raises:
        MivolError: as :func:`read_scan`.
    """
    data: Measured = settings.data
    names = {role: getattr(data, role) for role in ("data", "flats", "darks", "angles")}
    path = resolve_path(base, data.file)
    part, order = _rows_in_file(settings, base, rows)
    scan = read_projections(path, data.group, names, data.angle_unit, _rows_of_file(data.rows, part))
    fields = scan.projections[:, order], scan.flats[:, order], scan.darks[:, order]
    angles = scan.angles
    if angles is None and not isinstance(settings.scan, ViewTable | Matrices):
        angles = even_angles(settings.scan, len(scan.projections))
    elif angles is not None:
        check_unit(np.degrees(angles), "degree", 'set data.angle_unit = "radian"')
    return ScanReadings(correct_transmission(*fields, data.saturation), angles, intensity=fields, notes=scan.notes)


def _rows_in_file(settings: config.ScanExperiment, base: Path, rows: slice) -> tuple[slice, slice]:
    """Rows of the detector as the file counts them, for ``rows`` counted upwards; and a slice that puts them upwards again."""
    if settings.data.first_row == "lowest":
        return rows, ALL
    if rows == ALL:
        return ALL, slice(None, None, -1)
    down = range(detector_size(settings, base)[1])[::-1][rows]
    return slice(down[-1], down[0] + 1, -down.step), slice(None, None, -1)


def _rows_of_file(chosen: tuple[int, int] | None, rows: slice) -> slice | None:
    """Rows of the detector: ``rows`` of the rows that the settings choose."""
    if rows == ALL:
        return slice(*chosen) if chosen else None
    first = chosen[0] if chosen else 0
    return slice(first + rows.start, first + rows.stop, rows.step)


def read_stack_scan(settings: config.ScanExperiment, base: Path, rows: slice) -> ScanReadings:
    """Read a stack of images or an array.

    Raises:
        MivolError: as :func:`read_scan`.
    """
    data: Stack = settings.data
    rows, order = _rows_in_file(settings, base, rows)

    def stack(name: str) -> np.ndarray:
        if data.images == "sinograms":
            values = read_stack(base / name, data.dataset or None)[rows].swapaxes(0, 1)
        else:
            values = read_stack(base / name, data.dataset or None, rows)
        return values[:, order]

    readings = stack(data.file)
    fields, notes = None, ()
    if data.reading == "intensity":
        darks = stack(data.darks) if data.darks else np.zeros((1, *readings.shape[1:]), np.float32)
        notes = () if data.darks else (NO_DARKS,)
        flats = stack(data.flats) if data.flats else np.full((1, *readings.shape[1:]), data.light, np.float32)
        fields = readings, flats, darks
    if fields:
        transmission = correct_transmission(*fields, data.saturation)
    else:
        transmission = assume_quantum_noise(np.exp(-readings.astype(float)) if data.reading == "line_integral" else readings)
    return ScanReadings(transmission, read_angles(settings, base, len(readings)), intensity=fields, notes=notes)


def read_angles(settings: config.ScanExperiment, base: Path, views: int) -> np.ndarray | None:
    """Return the angles [rad] of a stack: from a file, or evenly over the arc; None if a table has the geometry.

    Raises:
        MivolError: different numbers of angles and views, or angles in another unit.
    """
    data: Stack = settings.data
    if isinstance(settings.scan, ViewTable | Matrices):
        return None
    if not data.angles:
        return even_angles(settings.scan, views)
    file = base / data.angles
    if file.suffix.lower() == ".edf":
        motor = read_header_angles(file)
        if motor is None:
            raise refusal(file, "no motor of a rotation that moves", "one in each header", "give a text file as data.angles")
        angles = motor[1]
    else:
        angles = survey_dicom_views(file).angles if has_views(file) else read_tilt_angles(file)
    if len(angles) != views:
        raise MivolError(f"{data.angles} has {len(angles)} angles for {views} projections: give one for each.")
    return to_radians(angles, data.angle_unit)


def even_angles(scan: Detector, views: int) -> np.ndarray:
    """Angles [rad] of ``views`` views, spread evenly over the arc, for each of several sources."""
    runs = max(1, len(getattr(scan, "sources", ())))
    return np.radians(scan.arc) * np.tile(np.arange(views // runs) / max(1, views // runs), runs)


def to_radians(angles: np.ndarray, unit: str) -> np.ndarray:
    """Convert angles to radians.

    Raises:
        MivolError: as :func:`check_unit`.
    """
    check_unit(angles, unit, "set angle_unit")
    return np.radians(angles) if unit == "degree" else angles


def check_unit(angles: np.ndarray, unit: str, way_out: str) -> None:
    """Refuse angles (views,) in another unit.

    Raises:
        MivolError: more than 8 turns in radians, at least 16 views within 6.3 degrees, or several views at one angle.
    """
    span = float(np.ptp(angles))
    if len(angles) > 1 and span == 0:
        raise MivolError(f"all {len(angles)} views have the angle {angles[0]:g}: give the angles of the scan.")
    if unit == "radian" and span > 16 * np.pi:
        raise MivolError(
            f"the angles span {span:.4g} radians ({span / (2 * np.pi):.0f} turns): they seem to be degrees, {way_out}."
        )
    if unit == "degree" and len(angles) >= 16 and span <= 2 * np.pi + 1e-3:
        raise MivolError(f"{len(angles)} views span {span:.4g} degrees: they seem to be radians, {way_out}.")


def note_order(angles: np.ndarray) -> list[str]:
    """Return a note if the angles go back and forth, which scanners rarely do."""
    steps = np.diff(angles)
    back = np.flatnonzero(np.sign(steps) * np.sign(np.sum(np.sign(steps))) < 0)
    if not len(back):
        return []
    at = int(back[0])
    turned = f"view {at + 1} at {np.degrees(angles[at + 1]):.2f} degrees follows view {at} at {np.degrees(angles[at]):.2f}"
    return [f"the angles turn back {len(back)} times ({turned}): they are used as given"]


def read_nikon_scan(settings: config.ScanExperiment, base: Path, rows: slice) -> ScanReadings:
    """Read a Nikon scan.

    Raises:
        MivolError: as :mod:`mivol.files.nikon`.
    """
    data: Nikon = settings.data
    scan = read_nikon(base / data.file)
    angles = read_nikon_angles(base / data.angles, len(scan.images)) if data.angles else scan.angles
    geometry = geometry_from_nikon(scan, angles)
    transmission = assume_quantum_noise(read_nikon_transmission(scan, data.saturation, rows))
    if rows != ALL and isinstance(geometry, ConeBeam):
        geometry = replace(geometry, detector=transmission.value.shape[1:])
    return ScanReadings(transmission, geometry=geometry, notes=tuple(describe_nikon_settings(scan, geometry)))


READERS: dict[type, Callable[[config.ScanExperiment, Path, slice], ScanReadings]] = {
    Measured: read_hdf5_scan,
    Stack: read_stack_scan,
    Nikon: read_nikon_scan,
}
"""Reader of measured projections by the type of ``settings.data``."""


def describe_nikon_settings(scan: NikonScan, geometry: ConeBeam | PanelViews) -> list[str]:
    """Return notes on settings beyond a circular scan."""
    notes = []
    if isinstance(geometry, PanelViews):
        notes.append(f"the rotation axis is tilted by {scan.tilt:g} and rolled by {scan.roll:g} degrees: z runs along it")
    if scan.left_out:
        notes.append(f"ignored settings: {', '.join(scan.left_out)}")
    return notes


def nikon_grid(settings: Nikon, base: Path) -> VoxelGrid:
    """Return the voxels of the settings file, centred on the axis.

    Raises:
        MivolError: a settings file without voxels.
    """
    scan = read_nikon(base / settings.file)
    if scan.shape is None:
        raise refusal(scan.path, "no VoxelsX, Y, Z and VoxelSizeX, Y, Z above 0", "a grid", "give a table [grid]")
    return VoxelGrid(scan.shape, np.asarray(scan.voxel_size))


# -- Upside-down rows ------------------------------------------------------------------------------------------------------


VIEWS, EDGE, ITERATIONS = 32, 24, 10
"""Bounds of the comparison: number of views; rows, columns and voxels along an edge; iterations of CGLS."""

LIMIT = 6.0
"""Mean difference of the views' residuals over its standard error, above which rows count as upside down. If both orders
explain a scan equally well, Student's t of 31 degrees of freedom exceeds 6 with probability 6e-7."""

ROUNDING = 1e-4
"""Relative rounding error of a residual after ten iterations of float32 products, whose sums have errors of about 1e-6 each."""


@dataclass(frozen=True)
class RowOrder:
    """Agreement of both row orders with the projections.

    Attributes:
        as_read, upside_down: relative residual of a small reconstruction.
        excess: excess of the residual as read over the residual upside down [standard error].
    """

    as_read: float
    upside_down: float
    excess: float


def can_tell(geometry: object, grid: VoxelGrid) -> bool:
    """Whether a scan of an object differs from a scan of the mirrored object."""
    if isinstance(geometry, ParallelBeam) or geometry.shape[1] < 2:
        return False
    return not isinstance(geometry, ConeBeam) or geometry.detector_offset[0] != 0 or grid.centre[2] != 0


def compare_rows(geometry: FlatDetector, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray) -> RowOrder:
    """Reconstruct coarsely with both row orders, and compare the residuals view by view.

    Args:
        y: line integrals (views, rows, cols).
        weights: weights; 0 for unused pixels.
    """
    small, mask = _coarse(geometry, y, weights)
    shape = tuple(min(n, EDGE) for n in grid.shape)
    edges = tuple(float(e) for e in grid.extent / np.array(shape[::-1]))
    projector = Projector(small.geometry, VoxelGrid(shape, edges, grid.centre))
    ways = [_residuals(projector, small.y[:, way], mask[:, way]) for way in (slice(None), slice(None, None, -1))]
    more, size = ways[0] - ways[1], float(np.sum(mask * small.y**2)) or 1.0
    error = float(np.hypot(np.std(more) / np.sqrt(max(len(more) - 1, 1)), ROUNDING * np.mean(ways))) or 1.0
    as_read, upside_down = (float(np.sqrt(way.sum() / size)) for way in ways)
    return RowOrder(as_read, upside_down, float(more.mean()) / error)


def note_rows(
    data: config.ReadingSettings, geometry: FlatDetector, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray
) -> list[str]:
    """Return a note with a remedy if the rows of measured projections seem to be upside down."""
    if not can_tell(geometry, grid):
        return []
    order = compare_rows(geometry, grid, y, weights)
    if not order.excess > LIMIT:
        return []
    way_out = "turn the sign of the geometry's steps along v"
    if isinstance(data, Stack | Measured):
        way_out = f'set data.first_row = "{"lowest" if data.first_row == "highest" else "highest"}"'
    if isinstance(geometry, ConeBeam) and geometry.detector_offset[0]:
        way_out += ", or turn the sign of scan.detector_offset along v"
    return [
        f"the detector's rows seem to be upside down: a small reconstruction misses {order.as_read:.1%} of the projections as "
        f"they are read, and {order.upside_down:.1%} upside down: {way_out}"
    ]


@dataclass(frozen=True, eq=False)
class _Small:
    """A scan of few views and pixels."""

    geometry: PanelViews
    y: np.ndarray


def _coarse(geometry: FlatDetector, y: np.ndarray, weights: np.ndarray) -> tuple[_Small, np.ndarray]:
    """Means over blocks of used pixels in some views, and the blocks with used pixels."""
    views = np.unique(np.linspace(0, len(y) - 1, VIEWS).astype(int))
    (block_v, rows, first_v), (block_u, cols, first_u) = (_blocks(n) for n in y.shape[1:])
    inner = np.s_[first_v : first_v + rows * block_v, first_u : first_u + cols * block_u]
    used = (weights[views] > 0)[:, *inner]

    def blocks(a: np.ndarray) -> np.ndarray:
        return a.reshape(len(views), rows, block_v, cols, block_u).sum((2, 4))

    count = blocks(used.astype(float))
    panels = geometry.panels(views)
    middle = panels.corner + (first_v + (rows * block_v - 1) / 2) * panels.along_v
    middle = middle + (first_u + (cols * block_u - 1) / 2) * panels.along_u
    table = np.hstack([panels.source, middle, block_u * panels.along_u, block_v * panels.along_v])
    mean = blocks(np.where(used, y[views][:, *inner], 0.0)) / np.maximum(count, 1)
    return _Small(PanelViews(table, (rows, cols)), mean), (count > 0).astype(float)


def _blocks(pixels: int) -> tuple[int, int, int]:
    """(pixels per block, blocks, first pixel): at most EDGE blocks in the middle of the pixels."""
    size = -(-pixels // EDGE)
    return size, pixels // size, (pixels - pixels // size * size) // 2


def _residuals(projector: Projector, y: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Squared residuals (views,) after a few iterations."""
    problem = LeastSquares(projector, y, mask, nonnegative=False)
    state = last_state(SOLVERS["cgls"].run(problem), ITERATIONS)
    return np.sum(mask * (y - projector @ state.x.reshape(projector.grid.shape)) ** 2, axis=(1, 2))
