"""A measured slice beside other programs: a layer of a tooth from a synchrotron, judged by views that nobody was given.

    mivol fetch tooth_projections
    scripts/bench_tomography.py --beside tooth

The settings are those of ``scenes/tooth``, without the drift of the light, which the others do not model. Views are moved along
the detector by a part of a pixel (cubic interpolation), so that the rotation axis is in the middle of a column for everybody.
There is no truth: every tenth view is predicted from the slice by exact chords, and the error is the root mean square of what
the prediction misses, over the deviation of the noise. The noise alone has 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import shift

from mivol import config
from mivol.bench.studies.tomography_peers import Slice
from mivol.experiments.examples import examples_folder
from mivol.experiments.projections import fitted_views, held_out_views, make_data, make_grid
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

__all__ = ["MeasuredSlice", "centred", "slice_of_the_tooth"]


@dataclass(frozen=True)
class MeasuredSlice(Slice):
    """A slice without a known truth.

    Attributes:
        held_out: the projector of the views that are predicted.
        seen, certain: what they are, (views, 1, columns), and their inverse variances.
    """

    held_out: Projector | None = None
    seen: np.ndarray | None = None
    certain: np.ndarray | None = None

    def error(self, x: np.ndarray) -> float:
        """Root mean square of what the prediction misses, over the noise."""
        missed = self.held_out @ np.ascontiguousarray(x, np.float32).reshape(self.grid.shape) - self.seen
        return float(np.sqrt(np.sum(self.certain * missed**2) / np.count_nonzero(self.certain)))


def centred(values: np.ndarray, column: float, order: int) -> np.ndarray:
    """Readings (views, rows, columns) about ``column``, moved into the middle of an odd number of columns.

    Args:
        order: of the interpolation; 3 for values, 0 for weights.
    """
    middle = round(column)
    reach = min(middle, values.shape[2] - 1 - middle)
    moved = shift(values, (0, 0, middle - column), order=order, mode="nearest")
    return np.ascontiguousarray(moved[..., middle - reach : middle + reach + 1])


def slice_of_the_tooth(settings: Path | None = None) -> MeasuredSlice:
    """The first layer, in a grid of as many voxels as that of the scene, or one more where they are even.

    Raises:
        MivolError: the data is not on this machine.
    """
    path = settings or examples_folder() / "tooth" / "fit.toml"
    chosen = config.load(path)
    edge = chosen.grid.shape[1] // 2 * 2 + 1
    data = make_data(chosen, path.parent, make_grid(chosen, path.parent))
    beam = data.geometry
    column = beam.axis_offset / np.broadcast_to(beam.pitch, 2)[1] + (beam.detector[1] - 1) / 2
    y, weights = (centred(a[:, :1], column, order) for a, order in ((data.y, 3), (data.weights, 0)))
    unseen = held_out_views(chosen, len(y))
    kept, grid = fitted_views(unseen, len(y)), VoxelGrid((1, edge, edge))
    fitted, held = (ParallelBeam(beam.angles[views], y.shape[1:]) for views in (kept, unseen))
    return MeasuredSlice(
        fitted, grid, y[kept], weights[kept], None,
        held_out=Projector(held, grid), seen=y[unseen], certain=weights[unseen],
    )  # fmt: skip
