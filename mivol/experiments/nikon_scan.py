"""A Nikon scan as an experiment takes it: transmission, geometry and grid, and what is to be said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.config import Nikon
from mivol.files.nikon import NikonScan, read_nikon, read_nikon_angles, read_nikon_transmission
from mivol.files.source import refusal
from mivol.tomography.geometry import ConeBeam, VoxelGrid
from mivol.tomography.nikon import nikon_geometry
from mivol.tomography.panel_views import PanelViews
from mivol.tomography.preprocess import Transmission, of_unknown_noise


def read_nikon_scan(wanted: Nikon, base: Path) -> tuple[Transmission, ConeBeam | PanelViews, list[str]]:
    """Transmission, geometry, and notes.

    Raises:
        MivolError: as :mod:`mivol.files.nikon`.
    """
    scan = read_nikon(base / wanted.file)
    angles = read_nikon_angles(base / wanted.angles, len(scan.images)) if wanted.angles else scan.angles
    geometry = nikon_geometry(scan, angles)
    return of_unknown_noise(read_nikon_transmission(scan, wanted.saturation)), geometry, notes_of(scan, geometry)


def notes_of(scan: NikonScan, geometry: ConeBeam | PanelViews) -> list[str]:
    """Sentences about what the settings hold beyond a circle."""
    notes = []
    if isinstance(geometry, PanelViews):
        notes.append(f"the rotation axis is tilted by {scan.tilt:g} and rolled by {scan.roll:g} degrees: z runs along it")
    if scan.left_out:
        notes.append(f"not heeded: {', '.join(scan.left_out)}")
    return notes


def nikon_grid(wanted: Nikon, base: Path) -> VoxelGrid:
    """The voxels of the settings, about the middle of the axis.

    Raises:
        MivolError: there are none.
    """
    scan = read_nikon(base / wanted.file)
    if scan.shape is None:
        raise refusal(scan.path, "no VoxelsX, Y, Z and VoxelSizeX, Y, Z above 0", "a grid", "give a table [grid]")
    return VoxelGrid(scan.shape, np.asarray(scan.voxel_size))
