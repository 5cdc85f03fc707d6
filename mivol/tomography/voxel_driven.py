"""Back-projection voxel by voxel: each reads the detector where its shadow falls.

Filtered back-projection smears a continuous function over the grid, so that every voxel reads it once a view, interpolated
between pixels. This is not the transpose of the projector, which spreads rays over voxels: do not
use it in an iterative solver.

References: Feldkamp, Davis & Kress 1984, J. Opt. Soc. Am. A 1, 612.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.threads import check_one_thread
from mivol.tomography.geometry import FlatDetector, VoxelGrid

__all__ = ["pixel_matrices", "smear"]

VIEWS_AT_ONCE = 4
"""Views of one kernel: the sums are read and written once for all of them."""


def pixel_matrices(beam: FlatDetector, grid: VoxelGrid, views: Sequence[int] | np.ndarray | None = None) -> np.ndarray:
    """(views, 3, 4) float64: a voxel's indices (x, y, z, 1) to (column t, row t, t) of the pixel that it shades.

    ``t`` is the voxel's part of the way from the source to the detector's plane; 1 in parallel light.
    """
    panels = beam.panels(views)
    to_corner = panels.corner - panels.source if not beam.whole_lines else panels.source
    # x - S = t (corner - S + c u + r v): the inverse of the matrix of columns (u, v, corner - S) gives (c t, r t, t).
    inverse = np.linalg.inv(np.stack([panels.along_u, panels.along_v, to_corner], -1))
    start = panels.corner if beam.whole_lines else panels.source
    matrices = np.concatenate([inverse, -np.einsum("nij,nj->ni", inverse, start)[:, :, None]], -1)
    if beam.whole_lines:
        matrices[:, 2] = (0.0, 0.0, 0.0, 1.0)
    index_to_world = np.diag([*grid.voxel_size, 1.0])
    index_to_world[:3, 3] = [grid.axis(name)[0] for name in "xyz"]
    return matrices @ index_to_world


def smear(matrices: np.ndarray, images: np.ndarray, grid: VoxelGrid, weighted: bool) -> np.ndarray:
    """Sum over views of what each voxel reads, bilinear between pixel centres, 0 beyond the detector's edge.

    Args:
        matrices: of :func:`pixel_matrices`.
        images: (views, rows, cols).
        grid: of the result.
        weighted: divide what is read by t^2.

    Returns:
        (Z, Y, X) float32.

    Cost: four reads a voxel and view.
    """
    check_one_thread()
    total = dr.zeros(mi.Float, grid.size)
    shape = tuple(dr.opaque(mi.UInt32, n) for n in grid.shape[:0:-1])
    size = tuple(dr.opaque(mi.UInt32, n) for n in images.shape[1:])
    for first in range(0, len(matrices), VIEWS_AT_ONCE):
        some = slice(first, first + VIEWS_AT_ONCE)
        for matrix, image in zip(matrices[some], images[some], strict=True):
            entries = [dr.opaque(mi.Float, float(value)) for value in matrix.ravel()]
            pixels = mi.Float(np.ascontiguousarray(image, np.float32).ravel())
            total += _read(entries, pixels, grid.size, shape, size, weighted)
        dr.eval(total)
    return np.array(total).reshape(grid.shape)


def _read(
    entries: list[mi.Float],
    image: mi.Float,
    n: int,
    shape: tuple[mi.UInt32, mi.UInt32],
    size: tuple[mi.UInt32, mi.UInt32],
    weighted: bool,
) -> mi.Float:
    """What each voxel reads of one view; ``shape`` is (X, Y) of the grid, ``size`` (rows, cols) of the image."""
    index = dr.arange(mi.UInt32, n)
    line, x = index // shape[0], index % shape[0]
    p = (mi.Float(x), mi.Float(line % shape[1]), mi.Float(line // shape[1]))
    column, row, t = (
        dr.fma(a, p[0], dr.fma(b, p[1], dr.fma(c, p[2], d))) for a, b, c, d in (entries[4 * i : 4 * i + 4] for i in range(3))
    )
    inverse = dr.rcp(t)
    column, row = column * inverse, row * inverse
    seen = t > 0
    parts = []
    for place, count in ((row, size[0]), (column, size[1])):
        last = mi.Float(count - 1)
        # A pixel is as wide as its pitch: half of it lies beyond the outermost centres.
        seen &= (place > -0.5) & (place < last + 0.5)
        inside = dr.clip(place, 0, last)
        lower = mi.UInt32(inside)
        parts.append((lower, dr.minimum(lower + 1, count - 1), inside - mi.Float(lower)))
    (r0, r1, fr), (c0, c1, fc) = parts
    a, b, c, d = (dr.gather(mi.Float, image, r * size[1] + k, seen) for r in (r0, r1) for k in (c0, c1))
    value = dr.lerp(dr.lerp(a, b, fc), dr.lerp(c, d, fc), fr)
    return value * dr.square(inverse) if weighted else value
