"""Fields that are known at points and on paper: what the tests of sampled rays share."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.sampled_field import PointValues, Region
from mivol.transport.line_integrals.radiance_field import RayBundle

CUBE = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]])


@dataclass
class Slab:
    """A constant density and colour where x lies between two planes, nothing elsewhere."""

    sigma: float = 1.5
    low: float = -1.0
    high: float = 1.0
    to_world: np.ndarray = field(default_factory=lambda: CUBE)
    space: str = "srgb"
    region: Region | None = None
    coarse: None = None

    def density(self, p: mi.Point3f) -> mi.Float:
        return dr.select((p.x >= self.low) & (p.x <= self.high), mi.Float(self.sigma), 0)

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        colour = mi.Color3f(0.2, 0.5, 0.9) + dr.zeros(mi.Color3f, dr.width(p))
        return PointValues(self.density(p), colour, lambda dsigma, dcolour: {"sigma": dsigma, "colour": dr.ravel(dcolour)})


class Cloud(Slab):
    """A density and a colour that vary smoothly; the adjoint returns the derivatives of the samples."""

    def density(self, p: mi.Point3f) -> mi.Float:
        return self.sigma * dr.square(dr.sin(3 * p.x + p.y)) * dr.exp(-dr.square(p.z))

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        values = super().evaluate(p, d)
        values.colour = mi.Color3f(0.5 + 0.5 * p.x, 0.5 + 0.3 * d.y, 0.5 + 0.4 * dr.sin(4 * p.z))
        return values


OBLONG = np.array([[2.0, 0, 0, -1], [0, 1.5, 0, -0.5], [0, 0, 3.0, 0], [0, 0, 0, 1]])


def random_points(count: int) -> tuple[mi.Point3f, mi.Vector3f]:
    """Points in the box ``OBLONG``, and directions."""
    rng = np.random.default_rng(2)
    p = OBLONG[:3, :3] @ rng.random((3, count)) + OBLONG[:3, 3:]
    d = rng.normal(size=(3, count))
    d /= np.linalg.norm(d, axis=0)
    return mi.Point3f(np.float32(p)), mi.Vector3f(np.float32(d))


def random_rays(count: int, seed: int = 0) -> RayBundle:
    """Rays from a sphere of radius 3 towards points of the cube."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(count, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.8, 0.8, (count, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (np.ascontiguousarray(np.float32(a.T)) for a in (o, d))
    return RayBundle(mi.Point3f(o), mi.Vector3f(d))


def chords(rays: RayBundle, low: float = -1.0, high: float = 1.0) -> np.ndarray:
    """Lengths of rays in the cube, with x between two planes: float64."""
    o, d = np.array(rays.o, np.float64).T, np.array(rays.d, np.float64).T
    lower, upper = np.array([low, -1.0, -1.0]), np.array([high, 1.0, 1.0])
    a, b = (lower - o) / d, (upper - o) / d
    near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.maximum(far - np.maximum(near, 0), 0)
