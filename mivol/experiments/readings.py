"""Measured projections from files: transmission, with angles or geometry if present in the files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol import config
from mivol.config import Matrices, Measured, Nikon, Stack, Table
from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.files import read_columns, read_projections, read_stack
from mivol.files.fetch import resolve_path
from mivol.files.nikon import NikonScan, read_nikon, read_nikon_angles, read_nikon_transmission
from mivol.files.source import refusal
from mivol.tomography.geometry import ConeBeam, FlatDetector, VoxelGrid
from mivol.tomography.panel_views import PanelViews, geometry_from_nikon
from mivol.tomography.preprocess import Transmission, assume_quantum_noise, correct_transmission


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


def read_scan(settings: config.ScanExperiment, base: Path) -> ScanReadings:
    """Read a measured scan.

    Raises:
        MivolError: an unreadable file, or files of different sizes.
    """
    data = settings.data
    if isinstance(data, Nikon):
        transmission, geometry, notes = read_nikon_scan(data, base)
        return ScanReadings(transmission, geometry=geometry, notes=tuple(notes))
    if isinstance(data, Measured):
        scan = read_projections(resolve_path(base, data.file), data.group)
        fields = scan.projections, scan.flats, scan.darks
        check_unit(np.degrees(scan.angles), "degree", "write theta in degrees")
        return ScanReadings(correct_transmission(*fields, data.saturation), scan.angles, intensity=fields)
    return read_stack_scan(settings, base)


def read_stack_scan(settings: config.ScanExperiment, base: Path) -> ScanReadings:
    """Read a stack of images or an array.

    Raises:
        MivolError: as :func:`read_scan`.
    """
    data: Stack = settings.data

    def stack(name: str) -> np.ndarray:
        values = read_stack(base / name, data.dataset or None)
        return values[:, ::-1] if data.first_row == "highest" else values

    readings = stack(data.file)
    fields = (readings, stack(data.flats), stack(data.darks)) if data.reading == "intensity" else None
    if fields:
        transmission = correct_transmission(*fields, data.saturation)
    else:
        transmission = assume_quantum_noise(np.exp(-readings.astype(float)) if data.reading == "line_integral" else readings)
    return ScanReadings(transmission, read_angles(settings, base, len(readings)), intensity=fields)


def read_angles(settings: config.ScanExperiment, base: Path, views: int) -> np.ndarray | None:
    """Return the angles [rad] of a stack: from a file, or evenly over the arc; None if a table has the geometry.

    Raises:
        MivolError: different numbers of angles and views, or angles in another unit.
    """
    data: Stack = settings.data
    if isinstance(settings.scan, Table | Matrices):
        return None
    if not data.angles:
        return np.radians(settings.scan.arc) * np.arange(views) / views
    angles = read_columns(base / data.angles, 1)[:, 0]
    if len(angles) != views:
        raise MivolError(f"{data.angles} has {len(angles)} angles for {views} projections: give one for each.")
    return to_radians(angles, data.angle_unit)


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
        MivolError: more than 8 turns in radians, or at least 16 views within 6.3 degrees.
    """
    span = float(np.ptp(angles))
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


def read_nikon_scan(settings: Nikon, base: Path) -> tuple[Transmission, ConeBeam | PanelViews, list[str]]:
    """Read a Nikon scan: transmission, geometry and notes.

    Raises:
        MivolError: as :mod:`mivol.files.nikon`.
    """
    scan = read_nikon(base / settings.file)
    angles = read_nikon_angles(base / settings.angles, len(scan.images)) if settings.angles else scan.angles
    geometry = geometry_from_nikon(scan, angles)
    return (
        assume_quantum_noise(read_nikon_transmission(scan, settings.saturation)),
        geometry,
        describe_nikon_settings(scan, geometry),
    )


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
