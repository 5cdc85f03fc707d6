"""Boxes in the world (parallelepipeds), and the slab test that clips a ray to a box.

References: Kay & Kajiya 1986 (slab test).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.scene_graph import traverse

__all__ = ["Box", "fit_box", "clip_to_box"]


@dataclass
class Box:
    """A parallelepiped in the world: the unit cube under ``to_world`` (4x4, float64)."""

    to_world: np.ndarray

    def rows(self) -> list[list[mi.Float64]]:
        """The (3, 4) map from the world to the unit cube, as opaque arrays, so that boxes in different places share a kernel.

        The arrays are made anew for each render: ``dr.freeze`` cannot record a function using arrays that were made before the
        recording and are not passed to the function.
        """
        return [[dr.opaque(mi.Float64, float(v)) for v in row] for row in np.linalg.inv(self.to_world)[:3]]

    @property
    def edge(self) -> float:
        """Edge length of the cube of the same volume."""
        return float(abs(np.linalg.det(self.to_world[:3, :3])) ** (1 / 3))

    def corners(self) -> np.ndarray:
        """The 8 corners, (8, 3)."""
        unit = np.array([[x, y, z, 1] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
        return (unit @ self.to_world.T)[:, :3]

    def contains(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box lies inside this box, up to ``tolerance`` of the edges of this box."""
        local = np.c_[Box(other).corners(), np.ones(8)] @ np.linalg.inv(self.to_world).T
        return bool((local[:, :3] >= -tolerance).all() and (local[:, :3] <= 1 + tolerance).all())

    def matches(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box has the same corners, up to ``tolerance`` of the size of the other box."""
        theirs = Box(other).corners()
        size = np.ptp(theirs, axis=0).max()
        apart = np.linalg.norm(self.corners()[:, None] - theirs[None], axis=-1).min(axis=1)
        return bool(apart.max() <= tolerance * size)


def fit_box(shape: mi.Shape) -> Box:
    """Fit the box of a ``cube`` shape. The vertices are read on the host, which is not possible inside ``dr.freeze``."""
    world = _vertices(shape)
    unit = (_vertices(mi.load_dict({"type": "cube"})) + 1) / 2
    fit, *_ = np.linalg.lstsq(np.c_[unit, np.ones(len(unit))], world, rcond=None)
    to_world = np.eye(4)
    to_world[:3] = fit.T
    return Box(to_world)


def _vertices(shape: mi.Shape) -> np.ndarray:
    return np.array(traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)


def clip_to_box(
    rows: list, low: tuple, high: tuple, o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[list[mi.Float64], list[mi.Float64], mi.Float64, mi.Float64]:
    """Clip [t0, t1] of a ray to a box, in float64.

    Args:
        rows: (3, 4) map from the world to the coordinates of the box.
        low, high: corners of the box in these coordinates.
        o, d: world ray.
        t0, t1: interval of the ray [length].

    Returns:
        Origin and direction of the ray in the coordinates of the box, and the interval inside; t1 <= t0 if the ray misses the
        box.
    """
    f64 = mi.Float64
    o, d = [f64(o[a]) for a in range(3)], [f64(d[a]) for a in range(3)]
    q, v = [], []
    for a, row in enumerate(rows):
        q.append(dr.fma(row[0], o[0], dr.fma(row[1], o[1], dr.fma(row[2], o[2], row[3]))))
        v.append(dr.fma(row[0], d[0], dr.fma(row[1], d[1], row[2] * d[2])))
        parallel = v[a] == 0
        inv = 1 / dr.select(parallel, 1, v[a])
        near, far = (low[a] - q[a]) * inv, (high[a] - q[a]) * inv
        # A ray parallel to two faces lies between them along all its length or nowhere; the products with 1 / 0 would be NaN.
        # In the plane of a face it counts as outside.
        inside = (q[a] > low[a]) & (q[a] < high[a])
        t0 = dr.select(parallel, dr.select(inside, t0, dr.inf), dr.maximum(t0, dr.minimum(near, far)))
        t1 = dr.select(parallel, t1, dr.minimum(t1, dr.maximum(near, far)))
    # The comparison is false for NaN, so rays with NaN get an empty interval; so do directions of length 0, whose interval
    # would be infinite.
    return q, v, t0, dr.select((t1 > t0) & dr.isfinite(t1 - t0), t1, t0)
