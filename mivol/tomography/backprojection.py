"""Voxel-driven back-projection: every voxel reads each view once, interpolated between the pixels at its shadow.

The operation is not the transpose of the projector, which spreads rays over voxels: do not use it in an iterative solver. In
parallel light all layers share the columns of their shadows, so a voxel reads its rows of sixteen layers at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.threads import check_one_thread
from mivol.tomography.geometry import FlatDetector, VoxelGrid

VIEWS_AT_ONCE = 4
"""Views per kernel; the kernel reads and writes the sums once for all its views."""


def pixel_matrices(beam: FlatDetector, grid: VoxelGrid, views: Sequence[int] | np.ndarray | None = None) -> np.ndarray:
    """(views, 3, 4) float64 matrices from a voxel's indices (x, y, z, 1) to (column t, row t, t) of the shadowed pixel.

    ``t`` is the fraction of the way from the source to the detector's plane; 1 in parallel light.
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


def backproject_voxels(matrices: np.ndarray, images: np.ndarray, grid: VoxelGrid, weighted: bool) -> np.ndarray:
    """Sum over views of the pixel at each voxel's shadow, bilinear between pixel centres, 0 beyond the detector's edge.

    Args:
        matrices: matrices of :func:`pixel_matrices`.
        images: (views, rows, cols).
        grid: grid of the result.
        weighted: whether each reading is divided by t^2.

    Returns:
        (Z, Y, X) float32.

    Cost: four reads per voxel and view.
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
            total += _read_view(entries, pixels, grid.size, shape, size, weighted)
        dr.eval(total)
    return np.array(total).reshape(grid.shape)


MOST_LAYERS, VIEWS_OF_LOOP = 16, 64
"""Most layers read at once, from neighbours in memory, and views of a kernel: the pixels that a few neighbouring voxels read in
64 views fit into a first-level cache."""


def have_layers(matrices: np.ndarray) -> bool:
    """Whether the row of a shadow in parallel light depends on z alone, in the same way in all views: to 1e-9 rows a voxel."""
    rows = matrices[:, 1]
    return bool(np.abs(rows[:, :2]).max() < 1e-9 and np.ptp(rows, axis=0).max() < 1e-9)


def backproject_layers(matrices: np.ndarray, images: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """As :func:`backproject_voxels` without weights, for parallel light about z: a shadow's row depends on z alone.

    Args:
        matrices: matrices of :func:`pixel_matrices` for a :class:`~mivol.tomography.geometry.ParallelBeam`.
        images: (views, rows, cols).
        grid: grid of the result.

    Returns:
        (Z, Y, X) float32.
    """
    check_one_thread()
    n_views, rows, columns = images.shape
    n_z, n_y, n_x = grid.shape
    place = matrices[0, 1, 2] * np.arange(n_z) + matrices[0, 1, 3]
    is_seen = (place > -0.5) & (place < rows - 0.5)
    lower = np.clip(place, 0, rows - 1).astype(int)
    fraction = (np.clip(place, 0, rows - 1) - lower).astype(np.float32)
    entries = mi.Float(np.ascontiguousarray(matrices[:, 0][:, [0, 1, 3]], np.float32).ravel())
    found = np.empty(grid.shape, np.float32)
    # A packet has a power of two of numbers.
    at_once = min(MOST_LAYERS, 1 << (n_z - 1).bit_length())
    for first in range(0, n_z, at_once):
        group = slice(first, min(first + at_once, n_z))
        # (views, cols, layers): a layer between two rows is interpolated, and layers beyond the detector are 0.
        pixels = np.zeros((n_views, columns, at_once), np.float32)
        for k, z in enumerate(range(first, group.stop)):
            if is_seen[z]:
                pixels[:, :, k] = images[:, lower[z]]
                if fraction[z]:
                    pixels[:, :, k] += fraction[z] * (images[:, lower[z] + 1] - images[:, lower[z]])
        total = _sum_layers(entries, mi.Float(pixels.ravel()), pixels.shape, (n_y, n_x))
        found[group] = np.reshape(total, (at_once, n_y, n_x))[: group.stop - first]
    return found


def _sum_layers(entries: mi.Float, pixels: mi.Float, size: tuple[int, int, int], shape: tuple[int, int]) -> np.ndarray:
    """Sums over views (layers, voxels of a layer) of ``pixels`` of size (views, cols, layers).

    ``entries`` has the affine map from (x, y, 1) to the column of each view.
    """
    n_views, columns, layers = size
    width, count = dr.opaque(mi.UInt32, shape[1]), dr.opaque(mi.UInt32, columns)
    index = dr.arange(mi.UInt32, shape[0] * shape[1])
    x, y, last = mi.Float(index % width), mi.Float(index // width), mi.Float(count - 1)

    def add_view(view: mi.UInt32, *total: mi.Float) -> tuple[mi.UInt32, *tuple[mi.Float, ...]]:
        a, b, c = (dr.gather(mi.Float, entries, 3 * view + k) for k in range(3))
        column = dr.fma(a, x, dr.fma(b, y, c))
        seen = (column > -0.5) & (column < last + 0.5)
        inside = dr.clip(column, 0, last)
        lower = mi.UInt32(inside)
        fraction = inside - mi.Float(lower)
        # Packets: the layers are neighbours in memory, and come in one load.
        left, right = (
            dr.gather(mi.ArrayXf, pixels, view * count + k, seen, shape=(layers, dr.width(index)))
            for k in (lower, dr.minimum(lower + 1, count - 1))
        )
        return view + 1, *(t + dr.lerp(p, q, fraction) for t, p, q in zip(total, left, right, strict=True))

    total = [dr.zeros(mi.Float, dr.width(index)) for _ in range(layers)]
    for first in range(0, n_views, VIEWS_OF_LOOP):
        end = dr.opaque(mi.UInt32, min(n_views, first + VIEWS_OF_LOOP))
        state = (dr.opaque(mi.UInt32, first), *total)
        total = dr.while_loop(state, lambda view, *_, end=end: view < end, add_view)[1:]
        dr.eval(total)
    return np.stack([np.array(t) for t in total])


def _read_view(
    entries: list[mi.Float],
    image: mi.Float,
    n: int,
    shape: tuple[mi.UInt32, mi.UInt32],
    size: tuple[mi.UInt32, mi.UInt32],
    weighted: bool,
) -> mi.Float:
    """Reading of each voxel in a view; ``shape`` is (X, Y) of the grid, ``size`` (rows, cols) of the image."""
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
        # A pixel is as wide as its pitch: half of the pixel lies beyond the outermost centres.
        seen &= (place > -0.5) & (place < last + 0.5)
        inside = dr.clip(place, 0, last)
        lower = mi.UInt32(inside)
        parts.append((lower, dr.minimum(lower + 1, count - 1), inside - mi.Float(lower)))
    (r0, r1, fr), (c0, c1, fc) = parts
    a, b, c, d = (dr.gather(mi.Float, image, r * size[1] + k, seen) for r in (r0, r1) for k in (c0, c1))
    value = dr.lerp(dr.lerp(a, b, fc), dr.lerp(c, d, fc), fr)
    return value * dr.square(inverse) if weighted else value
