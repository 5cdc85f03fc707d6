"""Whether a detector's rows are upside down: which way round a small reconstruction explains the projections better.

Opposite views see an object's heights from either side. Where source and detector lie alike above and below a plane, as on a
circle with a centred detector, a scan that is read upside down is that of the mirrored object, and nobody can tell; nor can
parallel light. A detector that is displaced along v, a helix, or any other trajectory tells.
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
"""At most so many views of so many rows, columns and voxels along an edge are compared, after so many iterations of CGLS."""

LIMIT = 6.0
"""Mean difference of the views' misfits over its standard error, from which on they are said to be upside down. Where both ways
explain a scan alike, Student's t of 31 degrees of freedom is beyond 6 with a chance of 6e-7."""

ROUNDING = 1e-4
"""Parts of a misfit that are no difference: ten iterations of products in float32, whose sums are good to some 1e-6 each."""


@dataclass(frozen=True)
class RowOrder:
    """Which way round the rows fit.

    Attributes:
        as_read, upside_down: what a small reconstruction misses of the projections, relative.
        excess: by how many standard errors the views are missed more as they are read than upside down.
    """

    as_read: float
    upside_down: float
    excess: float


def can_tell(geometry: object, grid: VoxelGrid) -> bool:
    """Whether a scan and its mirror image above and below are two different scans."""
    if isinstance(geometry, ParallelBeam) or geometry.shape[1] < 2:
        return False
    return not isinstance(geometry, ConeBeam) or geometry.detector_offset[0] != 0 or grid.centre[2] != 0


def compare_rows(geometry: FlatDetector, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray) -> RowOrder:
    """Reconstruct coarsely from the rows as they are and from those upside down, and compare what is missed, view by view.

    Args:
        y: (views, rows, cols) line integrals.
        weights: 0: not used.
    """
    small, seen = _coarse(geometry, y, weights)
    shape = tuple(min(n, EDGE) for n in grid.shape)
    edges = tuple(float(e) for e in grid.extent / np.array(shape[::-1]))
    projector = Projector(small.geometry, VoxelGrid(shape, edges, grid.centre))
    ways = [_missed(projector, small.y[:, way], seen[:, way]) for way in (slice(None), slice(None, None, -1))]
    more, size = ways[0] - ways[1], float(np.sum(seen * small.y**2)) or 1.0
    error = float(np.hypot(np.std(more) / np.sqrt(max(len(more) - 1, 1)), ROUNDING * np.mean(ways))) or 1.0
    as_read, upside_down = (float(np.sqrt(way.sum() / size)) for way in ways)
    return RowOrder(as_read, upside_down, float(more.mean()) / error)


def note_rows(
    wanted: config.Readings, geometry: FlatDetector, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray
) -> list[str]:
    """A sentence where the rows of measured projections seem to be upside down, with the way out."""
    if not can_tell(geometry, grid):
        return []
    found = compare_rows(geometry, grid, y, weights)
    if not found.excess > LIMIT:
        return []
    way_out = "turn the sign of the geometry's steps along v"
    if isinstance(wanted, Stack):
        way_out = f'set data.first_row = "{"lowest" if wanted.first_row == "highest" else "highest"}"'
    if isinstance(geometry, ConeBeam) and geometry.detector_offset[0]:
        way_out += ", or turn the sign of scan.detector_offset along v"
    return [
        f"the detector's rows seem to be upside down: a small reconstruction misses {found.as_read:.1%} of the projections as "
        f"they are read, and {found.upside_down:.1%} upside down: {way_out}"
    ]


@dataclass(frozen=True, eq=False)
class _Small:
    """A scan of few views and pixels."""

    geometry: PanelViews
    y: np.ndarray


def _coarse(geometry: FlatDetector, y: np.ndarray, weights: np.ndarray) -> tuple[_Small, np.ndarray]:
    """Means over blocks of used pixels of some views, and which blocks have any."""
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
    """(pixels of a block, blocks, first pixel): at most EDGE blocks in the middle of so many pixels."""
    size = -(-pixels // EDGE)
    return size, pixels // size, (pixels - pixels // size * size) // 2


def _missed(projector: Projector, y: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(views,) squares of what a few iterations leave of the projections."""
    problem = LeastSquares(projector, y, seen, nonnegative=False)
    *_, state = itertools.islice(SOLVERS["cgls"].run(problem), ITERATIONS)
    return np.sum(seen * (y - projector @ state.x.reshape(projector.grid.shape)) ** 2, axis=(1, 2))
