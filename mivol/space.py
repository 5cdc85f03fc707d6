"""Placement of a grid: unit cube, voxel centres and world.

Conventions. A grid of resolution (Z, Y, X) fills the unit cube [0, 1]^3, x fastest; ``to_world`` (4x4, float64) maps the
cube to the world. Voxel (i, j, k) has its centre at ((i + 1/2)/X, (j + 1/2)/Y, (k + 1/2)/Z): lattice coordinates
q = u N - 1/2 put node n at q = n, the faces of the cube at -1/2 and N - 1/2 (the convention of Mitsuba's ``gridvolume``).
"""

from __future__ import annotations

import numpy as np

from mivol.errors import MivolError


def check_affine(matrix: np.ndarray, name: str = "to_world") -> np.ndarray:
    """Return ``matrix`` as float64 (4, 4); refuse a matrix unable to place a box in space.

    Args:
        matrix: (4, 4) affine map, last row (0, 0, 0, 1).
        name: name of the matrix in the message.

    Raises:
        MivolError: wrong shape, a non-finite value, a projective last row, or a volume of zero.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (4, 4):
        raise MivolError(f"{name} has shape {m.shape}; a 4x4 affine matrix is expected.")
    if not np.isfinite(m).all():
        raise MivolError(f"{name} holds a non-finite value; give a matrix of finite numbers.")
    if not np.array_equal(m[3], (0.0, 0.0, 0.0, 1.0)):
        raise MivolError(f"{name} has the last row {m[3].tolist()}; only affine maps (0, 0, 0, 1) can place a grid.")
    # det / (product of column lengths) is the volume of the box over the volume of a right-angled box with equal edges. This
    # ratio has no scale: a box of size 1e-6 passes, a flat box fails. Below 1e-7 float32 cannot distinguish an edge from a flat
    # one.
    edges = np.linalg.norm(m[:3, :3], axis=0)
    if not (edges > 0).all() or abs(np.linalg.det(m[:3, :3] / edges)) < 1e-7:
        raise MivolError(f"{name} is degenerate (determinant 0): the box has no volume; scale every axis by more than 0.")
    return m


def lattice_from_world(to_world: np.ndarray, res: tuple[int, int, int]) -> np.ndarray:
    """Return the (3, 4) float64 map from world points to lattice coordinates (x, y, z) of a grid.

    Args:
        to_world: (4, 4) map of the unit cube to the world.
        res: resolution (Z, Y, X).
    """
    inverse = np.linalg.inv(check_affine(to_world))
    n = np.array(res[::-1], dtype=np.float64)[:, None]
    q = inverse[:3] * n
    q[:, 3] -= 0.5
    return q


def place_grid(box: np.ndarray, longest: int) -> tuple[tuple[int, int, int], np.ndarray]:
    """Resolution (Z, Y, X) and ``to_world`` of a grid of cubic voxels that covers a box (2, 3)."""
    edges = box[1] - box[0]
    h = edges.max() / longest
    counts = np.maximum(np.ceil(edges / h - 1e-9), 1).astype(int)
    to_world = np.diag([*(counts * h), 1.0])
    to_world[:3, 3] = box.mean(axis=0) - counts * h / 2
    return (int(counts[2]), int(counts[1]), int(counts[0])), to_world


def bounds_of(to_world: np.ndarray) -> np.ndarray:
    """The upright box (2, 3) around the unit cube under a map (4, 4) to the world."""
    corners = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ to_world.T
    return np.stack([corners[:, :3].min(axis=0), corners[:, :3].max(axis=0)])
