"""Rays that go on from a surface, and the distance of a surface along the ray that began at the camera."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["camera_ray", "distance_along", "spawn_ray"]


def distance_along(ray: mi.Ray3f, hit: mi.SurfaceInteraction3f) -> mi.Float:
    """Distance of a hit along the ray that began at the camera.

    Not the sum of the parts: each spawned ray starts an epsilon (1e-4 of a length) further on and to the side, so the hit
    lies beside the first ray. The plane of the surface is met by both; at grazing incidence, where that plane says little,
    the nearest point of the ray does.
    """
    slope = dr.dot(hit.n, ray.d)
    steep = dr.abs(slope) > 1e-2
    along = hit.p - ray.o
    return dr.select(steep, dr.dot(along, hit.n) / dr.select(steep, slope, 1), dr.dot(along, ray.d))


def spawn_ray(si: mi.SurfaceInteraction3f, d: mi.Vector3f, size: mi.Float) -> mi.Ray3f:
    """A ray onward from a surface, which begins a little behind it.

    Mitsuba's own begin 1e-4 of (1 + the largest coordinate) behind it, which passes whole shapes by in scenes that are not much
    larger than that: here, of a quarter of their ``size``, where that is below 1.
    """
    step = (dr.minimum(0.25 * size, 1) + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon
    ray = si.spawn_ray(d)
    ray.o = si.p + si.n * dr.mulsign(step, dr.dot(si.n, d))
    return ray


def camera_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """A ray of a sensor, which ends where the sensor ends it: at its ``far_clip``; without an end where that is not finite."""
    end = dr.select(ray.maxt < dr.largest(mi.Float), ray.maxt, dr.inf)
    return mi.Ray3f(ray.o, ray.d, end, ray.time, ray.wavelengths)
