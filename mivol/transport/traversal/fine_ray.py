"""Rays whose origin keeps its digits: scattering points of dense media, far from the origin of the world.

A float32 coordinate of 100 is rounded by up to 4e-6. For an extinction of 1e5 that is 0.4 optical depths, and light that
leaves such a point is too bright, since a shorter way counts for more than a longer one. Boxes and grids are cut in float64, so
an origin in float64 is all that they need. Shapes are traced by Mitsuba, in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Union

import drjit as dr
import mitsuba as mi

__all__ = ["FineRay", "Ray", "point_along", "traced"]


@dataclass
class FineRay:
    """A ray with the attributes of ``mi.Ray3f``, and an origin in float64.

    Attributes:
        o: origin, in world space.
        d: unit direction.
        maxt: where it ends [length]; may be infinite.
        time, wavelengths: as Mitsuba's.
    """

    o: mi.Point3d
    d: mi.Vector3f
    maxt: mi.Float
    time: mi.Float
    wavelengths: mi.Color0f

    @classmethod
    def of(cls, ray: Ray) -> FineRay:
        """A copy of a ray."""
        return cls(mi.Point3d(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Float(ray.time), ray.wavelengths)

    @classmethod
    def leaving(cls, o: mi.Point3d, d: mi.Vector3f, at: mi.Interaction3f, maxt: mi.Float = dr.inf) -> FineRay:
        """A ray that leaves a point, at the time of an interaction there."""
        return cls(o, mi.Vector3f(d), mi.Float(maxt), mi.Float(at.time), mi.Color0f())

    def __call__(self, t: mi.Float | mi.Float64) -> mi.Point3f:
        """The point at a distance [length], rounded once."""
        return mi.Point3f(point_along(self, t))


Ray = Union["mi.Ray3f", FineRay]
"""What walks through media: it has an origin ``o``, a direction ``d``, an end ``maxt``, and points ``ray(t)``."""


def point_along(ray: Ray, t: mi.Float | mi.Float64) -> mi.Point3d:
    """The point of a ray at a distance [length], in float64."""
    return mi.Point3d(*(dr.fma(mi.Float64(t), mi.Float64(ray.d[a]), mi.Float64(ray.o[a])) for a in range(3)))


def traced(ray: Ray) -> mi.Ray3f:
    """A copy of a ray, as Mitsuba traces it: with an origin in float32."""
    return mi.Ray3f(mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Float(ray.time), ray.wavelengths)
