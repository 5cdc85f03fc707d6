"""Rays: origins in float64, spawned rays behind surfaces, and distances along the ray of the camera.

A float32 coordinate of 100 is rounded by up to 4e-6. At an extinction of 1e5 this error is an optical depth of 0.4, and light
leaving a rounded point is too bright on average, since a shorter way counts for more than a longer one. Scattering points of
dense media far from the origin of the world therefore keep their origin in float64. Boxes and grids are clipped in float64;
Mitsuba traces shapes in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Union

import drjit as dr
import mitsuba as mi

__all__ = [
    "FineRay",
    "Ray",
    "clip_camera_ray",
    "give_each_lane_a_ray",
    "hit_distance",
    "point_along",
    "spawn_ray",
    "to_mitsuba_ray",
]


@dataclass
class FineRay:
    """A ray with the attributes of ``mi.Ray3f`` and an origin in float64.

    Attributes:
        o: origin in world space.
        d: unit direction.
        maxt: end of the ray [length]; may be infinite.
        time, wavelengths: as of Mitsuba's rays.
    """

    o: mi.Point3d
    d: mi.Vector3f
    maxt: mi.Float
    time: mi.Float
    wavelengths: mi.Color0f

    @classmethod
    def from_ray(cls, ray: Ray) -> FineRay:
        """Copy a ray."""
        return cls(mi.Point3d(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Float(ray.time), ray.wavelengths)

    @classmethod
    def from_point(cls, o: mi.Point3d, d: mi.Vector3f, at: mi.Interaction3f, maxt: mi.Float = dr.inf) -> FineRay:
        """Make a ray from a point, at the time of an interaction at the point."""
        return cls(o, mi.Vector3f(d), mi.Float(maxt), mi.Float(at.time), mi.Color0f())

    def __call__(self, t: mi.Float | mi.Float64) -> mi.Point3f:
        """The point at a distance [length], rounded once to float32."""
        return mi.Point3f(point_along(self, t))


Ray = Union["mi.Ray3f", FineRay]
"""A ray through media: origin ``o``, direction ``d``, end ``maxt``, and points ``ray(t)``."""


def point_along(ray: Ray, t: mi.Float | mi.Float64) -> mi.Point3d:
    """The point of a ray at a distance [length], in float64."""
    return mi.Point3d(*(dr.fma(mi.Float64(t), mi.Float64(ray.d[a]), mi.Float64(ray.o[a])) for a in range(3)))


def to_mitsuba_ray(ray: Ray) -> mi.Ray3f:
    """Copy a ray for Mitsuba's ray tracing, with the origin rounded to float32."""
    return mi.Ray3f(mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Float(ray.time), ray.wavelengths)


def hit_distance(ray: Ray, hit: mi.SurfaceInteraction3f) -> mi.Float:
    """Distance of a surface hit along the first ray of a path segment [length].

    Lengths of spawned rays are not summed. Each spawned ray starts an epsilon (1e-4 of a length) further on and to the side,
    so the hit lies beside the first ray. The first ray is therefore intersected with the tangent plane of the surface at the
    hit. At grazing incidence this intersection is ill-conditioned, and the point of the ray nearest to the hit is taken
    instead.
    """
    slope = dr.dot(hit.n, ray.d)
    steep = dr.abs(slope) > 1e-2
    along = hit.p - mi.Point3f(ray.o)
    return dr.select(steep, dr.dot(along, hit.n) / dr.select(steep, slope, 1), dr.dot(along, ray.d))


def spawn_ray(si: mi.SurfaceInteraction3f, d: mi.Vector3f, size: mi.Float) -> mi.Ray3f:
    """Spawn a ray in direction ``d`` that begins a little behind the surface.

    Mitsuba offsets the origin by 1e-4 (1 + largest coordinate), which can step over whole shapes of a small scene. Here a
    quarter of the ``size`` of the scene [length] replaces the 1 where the quarter is smaller.
    """
    step = (dr.minimum(0.25 * size, 1) + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon
    ray = si.spawn_ray(d)
    ray.o = si.p + si.n * dr.mulsign(step, dr.dot(si.n, d))
    return ray


def give_each_lane_a_ray(ray: mi.RayDifferential3f, lanes: int) -> mi.RayDifferential3f:
    """The rays of a sensor, one for each lane: a radiance meter sends the same ray everywhere, and returns it once."""
    ray.o = ray.o + dr.zeros(mi.Point3f, lanes)
    return ray


def clip_camera_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """End the ray of a sensor at the ``far_clip`` of the sensor; ``maxt`` becomes infinite without a finite ``far_clip``."""
    end = dr.select(ray.maxt < dr.largest(mi.Float), ray.maxt, dr.inf)
    return mi.Ray3f(ray.o, ray.d, end, ray.time, ray.wavelengths)
