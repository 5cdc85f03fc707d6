"""Projections of a scan: measured, of a volume that is known, or exact chords through a phantom."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol import config
from mivol.config import Cone, Ellipsoids, Known, Measured
from mivol.errors import MivolError
from mivol.files import read_projections, read_volume
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import correct_transmission, line_integrals, normalise_air
from mivol.tomography.projector import Projector
from mivol.tomography.rotation_axis import find_axis


@dataclass(frozen=True)
class Projections:
    """Line integrals and what they were taken with.

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


def make_geometry(chosen: config.Scan) -> Geometry:
    """Beam and detector of computed projections."""
    wanted = chosen.scan
    angles = np.radians(wanted.arc) * np.arange(wanted.views) / wanted.views
    if isinstance(wanted, Cone):
        distances = wanted.source_to_axis, wanted.source_to_detector
        return ConeBeam(angles, wanted.detector, *distances, wanted.pitch, wanted.axis_offset, wanted.detector_offset)
    return ParallelBeam(angles, wanted.detector, wanted.pitch, wanted.axis_offset, wanted.detector_offset)


def make_data(chosen: config.Scan, base: Path, grid: VoxelGrid) -> Projections:
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


def add_noise(geometry: Geometry, exact: np.ndarray, truth: np.ndarray, photons: float, seed: int) -> Projections:
    """Line integrals of Poisson counts, weighted by 1 / var y = counts; without photons the exact ones.

    A pixel without a single quantum has no logarithm: y = 0 and weight 0.
    """
    if not photons:
        return Projections(geometry, exact, np.ones_like(exact), truth)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-exact)).astype(np.float64)
    y = np.where(counts > 0, -np.log(np.maximum(counts, 1.0) / photons), 0.0)
    return Projections(geometry, y, counts, truth, counts)


def read_measured(chosen: config.Scan, base: Path) -> Projections:
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
    return Projections(ParallelBeam(scan.angles, y.shape[1:], chosen.scan.pitch, offset), y, weights, note=note)


def held_out_views(chosen: config.Scan, count: int) -> np.ndarray:
    """Numbers of the views that are predicted, not fitted."""
    every = chosen.held_out_every
    if every == 1:
        raise MivolError("held_out_every = 1 holds out all views, expected some to fit: choose 2 or more, or 0.")
    return np.arange(every // 2, count, every) if every else np.arange(0)
