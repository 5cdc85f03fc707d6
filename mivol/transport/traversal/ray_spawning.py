"""Rays that continue behind a surface, and the distance of a surface along the ray that began at the camera."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.fine_ray import Ray

__all__ = ["camera_ray", "distance_along", "spawn_ray"]


def distance_along(ray: Ray, hit: mi.SurfaceInteraction3f) -> mi.Float:
    """Distance of a hit along the ray that began at the camera.

    The lengths of the spawned rays are not summed: each of them starts an epsilon (1e-4 of a length) further on and to the
    side, so the hit lies beside the first ray. Instead the first ray is intersected with the tangent plane of the surface at
    the hit. At grazing incidence that intersection is ill-conditioned, and the point of the ray nearest to the hit is taken.
    """
    slope = dr.dot(hit.n, ray.d)
    steep = dr.abs(slope) > 1e-2
    along = hit.p - mi.Point3f(ray.o)
    return dr.select(steep, dr.dot(along, hit.n) / dr.select(steep, slope, 1), dr.dot(along, ray.d))


def spawn_ray(si: mi.SurfaceInteraction3f, d: mi.Vector3f, size: mi.Float) -> mi.Ray3f:
    """Spawn a ray that continues in direction ``d`` and begins a little behind the surface.

    Mitsuba offsets the origin by 1e-4 (1 + the largest coordinate), which can step over whole shapes in a scene that is small.
    Here the 1 is replaced by a quarter of the scene's ``size`` [length], where that is less.
    """
    step = (dr.minimum(0.25 * size, 1) + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon
    ray = si.spawn_ray(d)
    ray.o = si.p + si.n * dr.mulsign(step, dr.dot(si.n, d))
    return ray


def camera_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """The ray of a sensor, ended at the sensor's ``far_clip``; ``maxt`` is infinite where that is not finite."""
    end = dr.select(ray.maxt < dr.largest(mi.Float), ray.maxt, dr.inf)
    return mi.Ray3f(ray.o, ray.d, end, ray.time, ray.wavelengths)
