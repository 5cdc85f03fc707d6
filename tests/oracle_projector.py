"""The slow twin of the projector: the system matrix of a trilinear grid, float64, all plane crossings sorted.

Values sit at voxel centres and are held constant beyond the outermost ones (clamped), inside the grid's box; outside
it is nothing. Between two plane crossings the field along a ray is a cubic, which two Gauss points integrate exactly.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from mivol.tomography.geometry import Geometry, VoxelGrid

GRID = VoxelGrid((5, 7, 6), (0.5, 0.4, 0.6), centre=(0.2, -0.3, 0.1))
ANGLES = np.array([0.0, 0.4, np.pi / 2, 2.5, 4.0])

GAUSS = 0.5 + np.array([-1.0, 1.0]) * np.sqrt(3) / 6


def matrix(grid: VoxelGrid, o: np.ndarray, d: np.ndarray, whole_lines: bool = False) -> scipy.sparse.csr_array:
    """The (rays, voxels) matrix of the exact line integrals along rays (N, 3)."""
    n = np.array(grid.shape[::-1])
    q = (o - np.asarray(grid.centre)) / grid.voxel_size + n / 2 - 0.5
    e = d / grid.voxel_size
    crossings = [_crossings(q[:, i], e[:, i], np.concatenate([[-0.5], np.arange(n[i]), [n[i] - 0.5]])) for i in range(3)]
    t = np.sort(np.concatenate(crossings, axis=1), axis=1)
    t = np.where(np.isfinite(t), t, np.nanmax(np.where(np.isfinite(t), t, np.nan), axis=1, keepdims=True))
    if not whole_lines:
        t = np.maximum(t, 0.0)
    t0, dt = t[:, :-1], np.diff(t, axis=1)
    middle = q[:, None] + (t0 + dt / 2)[..., None] * e[:, None]
    inside = ((middle > -0.5) & (middle < n - 0.5)).all(-1)
    rows, columns, weights = [], [], []
    for gauss in GAUSS:
        p = q[:, None] + (t0 + gauss * dt)[..., None] * e[:, None]
        cell = np.floor(middle)
        f = np.clip(p - cell, 0.0, 1.0)
        for corner in np.ndindex(2, 2, 2):
            index = np.clip(cell + corner, 0, n - 1).astype(np.int64)
            w = np.where(corner, f, 1 - f).prod(-1) * dt / 2 * inside
            rows.append(np.broadcast_to(np.arange(len(o))[:, None], w.shape).ravel())
            columns.append((index[..., 0] + n[0] * (index[..., 1] + n[1] * index[..., 2])).ravel())
            weights.append(w.ravel())
    entries = tuple(map(np.concatenate, (weights, rows, columns)))
    a = scipy.sparse.coo_array((entries[0], entries[1:]), (len(o), grid.size)).tocsr()
    a.eliminate_zeros()
    return a


def system_matrix(geometry: Geometry, grid: VoxelGrid, views: np.ndarray | None = None) -> scipy.sparse.csr_array:
    """The matrix of a whole scan, rays in the order (view, row, column)."""
    o, d = geometry.rays(views)
    return matrix(grid, o.reshape(-1, 3), d.reshape(-1, 3), geometry.whole_lines)


def _crossings(q: np.ndarray, e: np.ndarray, planes: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(e[:, None] == 0, np.nan, (planes - q[:, None]) / e[:, None])


def numbers(*shape: int, seed: int = 1) -> np.ndarray:
    """Normal float32 numbers."""
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def assert_pair_is_its_twin(a, geometry: Geometry, grid: VoxelGrid) -> scipy.sparse.csr_array:
    """Operator and transpose against the twin, which is returned.

    2e-6 of sum |A| |x| and |A|^T |y|: float32 rounding of about 20 terms and of positions of order 10 voxels.
    """
    twin, x, y = system_matrix(geometry, grid), numbers(*grid.shape), numbers(*a.projection_shape, seed=2)
    for found, operator, operand, shape in ((a @ x, twin, x, a.projection_shape), (a.T @ y, twin.T, y, grid.shape)):
        assert found.shape == shape and found.dtype == np.float32
        expected, size = (operator @ v.ravel().astype(float) for v in (operand, np.abs(operand)))
        assert np.abs(found.ravel() - expected).max() < 2e-6 * size.max()
    return twin


def assert_pair_is_adjoint(a, grid: VoxelGrid, seed: int) -> None:
    """|<A x, y> - <x, A^T y>| <= 1e-6 |A x| |y|: the promise of a matched pair (the inner products are float64)."""
    x, y = numbers(grid.size, seed=seed), numbers(a.shape[0], seed=seed + 100)
    ax, aty = (a @ x).astype(float), (a.T @ y).astype(float)
    assert abs(ax @ y - x @ aty) <= 1e-6 * np.linalg.norm(ax) * np.linalg.norm(y)
