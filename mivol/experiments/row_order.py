"""Detection of upside-down detector rows, by coarse reconstructions with both row orders.

Views from opposite sides see the heights of an object from either side. If source and detector are symmetric about a plane, as
on a circle with a centred detector, an upside-down scan equals a scan of the mirrored object. Both cases have the same
projections, also in parallel light. A detector displaced along v, a helix, or another trajectory breaks the symmetry.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from mivol import config
from mivol.config import Stack
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.optim.projections.solvers import SOLVERS
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import PanelViews
from mivol.tomography.projector import Projector

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


def note_rows(data: config.Readings, geometry: FlatDetector, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray) -> list[str]:
    """Return a note with a remedy if the rows of measured projections seem to be upside down."""
    if not can_tell(geometry, grid):
        return []
    order = compare_rows(geometry, grid, y, weights)
    if not order.excess > LIMIT:
        return []
    way_out = "turn the sign of the geometry's steps along v"
    if isinstance(data, Stack):
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
    *_, state = itertools.islice(SOLVERS["cgls"].run(problem), ITERATIONS)
    return np.sum(mask * (y - projector @ state.x.reshape(projector.grid.shape)) ** 2, axis=(1, 2))
