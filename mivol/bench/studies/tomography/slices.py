"""Slices and their projections: the Shepp-Logan head in closed form, and a measured layer of a tooth.

The head. Projections of a parallel beam are exact chords (float64, no grid), with the noise of quanta for some kinds of data,
so no operator reconstructs data of its own. Grid and detector have odd numbers of cells, so every program has the rotation axis
in the middle of a cell. The error is |x - truth| / |truth| over the disc inside the grid; outside, scikit-image reconstructs
nothing.

The tooth. A layer from a synchrotron, with the settings of ``scenes/tooth``, but without the drift of the light, which other
programs do not model. Views are moved along the detector by a fraction of a pixel (cubic interpolation), so that the rotation
axis is in the middle of a column for every program. The truth is unknown: every tenth view is predicted from the slice by exact
chords, and the error is the root mean square difference to this view over the standard deviation of the noise. A perfect
prediction has an error of 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import shift

from mivol import config
from mivol.experiments.examples import examples_folder
from mivol.experiments.projections import fitted_views, held_out_views, make_data, make_grid
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse


@dataclass(frozen=True)
class Slice:
    """A slice and its projections.

    Attributes:
        beam, grid: geometry; lengths in voxels.
        y, weights: projections and their weights (views, 1, columns); weights are inverse variances, or 1 without noise.
        truth: averages over voxels (1, n, n); None if unknown.
        photons: quanta per pixel without an object; 0: no noise.
    """

    beam: ParallelBeam
    grid: VoxelGrid
    y: np.ndarray
    weights: np.ndarray
    truth: np.ndarray | None
    photons: float = 0.0

    def error(self, x: np.ndarray) -> float:
        """nRMSE over the disc inside the grid."""
        at = self.grid.axis("x")
        inside = np.hypot(at[:, None], at) < at[-1]
        return nrmse(np.reshape(x, self.truth.shape)[0][inside], self.truth[0][inside])


@dataclass(frozen=True)
class MeasuredSlice(Slice):
    """A slice without a known truth.

    Attributes:
        held_out: projector of the predicted views.
        measured, certainty: the predicted views and their inverse variances (views, 1, columns).
    """

    held_out: Projector | None = None
    measured: np.ndarray | None = None
    certainty: np.ndarray | None = None

    def error(self, x: np.ndarray) -> float:
        """Root mean square error of the prediction over the noise."""
        missed = self.held_out @ np.ascontiguousarray(x, np.float32).reshape(self.grid.shape) - self.measured
        return float(np.sqrt(np.sum(self.certainty * missed**2) / np.count_nonzero(self.certainty)))


def make_slice(n: int, views: int, photons: float) -> Slice:
    """Slice of the head with ``n`` x ``n`` voxels (odd) and 3/2 as many detector pixels."""
    columns = 3 * n // 2 // 2 * 2 + 1
    beam = ParallelBeam(np.arange(views) * np.pi / views, (1, columns))
    head = shepp_logan("toft-schabel", n / 2)
    scale = 4.0 / n  # so that the value 1 across the grid has an optical depth of 4
    exact = scale * head.project(beam)
    truth = scale * head.voxelise(VoxelGrid((1, n, n), (1.0, 1.0, 1e-6)), 4)
    grid = VoxelGrid((1, n, n))
    if not photons:
        return Slice(beam, grid, exact, np.ones_like(exact), truth)
    counts = np.maximum(np.random.default_rng(0).poisson(photons * np.exp(-exact)), 1.0)
    return Slice(beam, grid, -np.log(counts / photons), counts, truth, photons)


def centre_axis(values: np.ndarray, column: float, order: int) -> np.ndarray:
    """Move the rotation axis of projections to the middle of an odd number of columns.

    Args:
        values: (views, rows, columns).
        column: column of the axis.
        order: order of the interpolation: 3 for values, 0 for weights.
    """
    middle = round(column)
    reach = min(middle, values.shape[2] - 1 - middle)
    moved = shift(values, (0, 0, middle - column), order=order, mode="nearest")
    return np.ascontiguousarray(moved[..., middle - reach : middle + reach + 1])


def load_tooth(settings: Path | None = None) -> MeasuredSlice:
    """The first layer of the tooth, in a grid with the number of voxels of the scene, or one more if this number is even.

    Raises:
        MivolError: the data is not on this machine.
    """
    path = settings or examples_folder() / "tooth" / "fit.toml"
    chosen = config.load(path)
    edge = chosen.grid.shape[1] // 2 * 2 + 1
    data = make_data(chosen, path.parent, make_grid(chosen, path.parent))
    beam = data.geometry
    column = beam.axis_offset / np.broadcast_to(beam.pitch, 2)[1] + (beam.detector[1] - 1) / 2
    y, weights = (centre_axis(a[:, :1], column, order) for a, order in ((data.y, 3), (data.weights, 0)))
    held_out = held_out_views(chosen, len(y))
    kept, grid = fitted_views(held_out, len(y)), VoxelGrid((1, edge, edge))
    fitted, predicted = (ParallelBeam(beam.angles[views], y.shape[1:]) for views in (kept, held_out))
    return MeasuredSlice(
        fitted, grid, y[kept], weights[kept], None,
        held_out=Projector(predicted, grid), measured=y[held_out], certainty=weights[held_out],
    )  # fmt: skip
