"""Boundaries that are boxes (parallelepipeds), which rays are cut to by a slab test instead of being traced."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["Box", "read_box", "clip_to_box"]


@dataclass
class Box:
    """A parallelepiped in the world: the unit cube under ``to_world`` (4x4, float64)."""

    to_world: np.ndarray

    def rows(self) -> list[list[mi.Float64]]:
        """The (3, 4) map from the world to the unit cube, as opaque arrays, so that boxes in other places share one kernel.

        They are made anew for each render: ``dr.freeze`` cannot record a function that uses arrays made before the recording
        without being passed to it.
        """
        return [[dr.opaque(mi.Float64, float(v)) for v in row] for row in np.linalg.inv(self.to_world)[:3]]

    @property
    def edge(self) -> float:
        """Length of an edge of the cube of the same volume."""
        return float(abs(np.linalg.det(self.to_world[:3, :3])) ** (1 / 3))

    def corners(self) -> np.ndarray:
        """The 8 corners, (8, 3)."""
        unit = np.array([[x, y, z, 1] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
        return (unit @ self.to_world.T)[:, :3]

    def contains(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box lies inside this one, to ``tolerance`` of this one's edges."""
        local = np.c_[Box(other).corners(), np.ones(8)] @ np.linalg.inv(self.to_world).T
        return bool((local[:, :3] >= -tolerance).all() and (local[:, :3] <= 1 + tolerance).all())

    def matches(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box has the same corners, to ``tolerance`` of its size."""
        theirs = Box(other).corners()
        size = np.ptp(theirs, axis=0).max()
        apart = np.linalg.norm(self.corners()[:, None] - theirs[None], axis=-1).min(axis=1)
        return bool(apart.max() <= tolerance * size)


def read_box(shape: mi.Shape) -> Box:
    """The box of a ``cube`` shape. It reads the vertices on the host, which is not possible inside ``dr.freeze``."""
    world = _vertices(shape)
    unit = (_vertices(mi.load_dict({"type": "cube"})) + 1) / 2
    fit, *_ = np.linalg.lstsq(np.c_[unit, np.ones(len(unit))], world, rcond=None)
    to_world = np.eye(4)
    to_world[:3] = fit.T
    return Box(to_world)


def _vertices(shape: mi.Shape) -> np.ndarray:
    return np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)


def clip_to_box(
    rows: list, low: tuple, high: tuple, o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[list[mi.Float64], list[mi.Float64], mi.Float64, mi.Float64]:
    """Cut [t0, t1] of a ray to a box, in float64 (the slab test of Kay & Kajiya 1986).

    Args:
        rows: (3, 4) map from the world to the box's coordinates.
        low, high: the box there.
        o, d: world ray.
        t0, t1: the interval of the ray to cut [length].

    Returns:
        The ray's origin and direction in the box's coordinates, and the interval inside; t1 <= t0 where there is none.
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
