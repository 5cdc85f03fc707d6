"""Boundaries that are boxes (parallelepipeds), which rays are cut to by a slab test instead of being traced."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["Box", "box_of_cube"]


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


def box_of_cube(shape: mi.Shape) -> Box:
    """The box of a ``cube`` shape. It reads the vertices on the host, which is not possible inside ``dr.freeze``."""
    world = _vertices(shape)
    unit = (_vertices(mi.load_dict({"type": "cube"})) + 1) / 2
    fit, *_ = np.linalg.lstsq(np.c_[unit, np.ones(len(unit))], world, rcond=None)
    to_world = np.eye(4)
    to_world[:3] = fit.T
    return Box(to_world)


def _vertices(shape: mi.Shape) -> np.ndarray:
    return np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)
