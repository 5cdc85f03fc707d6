"""Cameras that Mitsuba does not have, written in Python: half of all directions in a circle, and all of them in a rectangle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

FISHEYE, PANORAMA = "test_fisheye", "test_panorama"


def directions(kind: str, place: np.ndarray) -> np.ndarray:
    """(n, 3) unit directions of places (n, 2) in 0..1, in the frame of a camera that looks along +z with x to the left.

    Fisheye: the angle from the axis grows evenly to 90 degrees at the edge (equidistant), and on to 127 in the corners.
    Panorama: equal steps of longitude and of latitude, the axis in the middle.
    """
    u, v = (1 - 2 * place).T
    if kind == FISHEYE:
        angle = np.hypot(u, v) * np.pi / 2
        across = np.sin(angle) / np.maximum(np.hypot(u, v), 1e-9)
        return np.column_stack([u * across, v * across, np.cos(angle)])
    longitude, latitude = u * np.pi, v * np.pi / 2
    return np.column_stack([np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)])


def register() -> None:
    """Make both known to the variant that is set."""

    class Wide(mi.Sensor):
        """Rays through one point, whose directions are looked up for a place on the film."""

        kind = FISHEYE

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.needs_sample_3 = False

        def sample_ray(
            self, time: mi.Float, wavelength: mi.Float, position: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.Ray3f, mi.Spectrum]:
            u, v = 1 - 2 * position.x, 1 - 2 * position.y
            to_world = self.world_transform()
            ray = mi.Ray3f(to_world @ mi.Point3f(0), dr.normalize(to_world @ self.look(u, v)), time, [])
            return ray, mi.Spectrum(1)

        def sample_ray_differential(
            self, time: mi.Float, wavelength: mi.Float, position: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
            ray, weight = self.sample_ray(time, wavelength, position, aperture, active)
            return mi.RayDifferential3f(ray), weight

        def look(self, u: mi.Float, v: mi.Float) -> mi.Vector3f:
            r = dr.sqrt(u * u + v * v)
            across = dr.sin(r * dr.pi / 2) * dr.rcp(dr.maximum(r, 1e-9))
            return mi.Vector3f(u * across, v * across, dr.cos(r * dr.pi / 2))

        def bbox(self) -> mi.BoundingBox3f:
            place = self.world_transform() @ mi.Point3f(0)
            return mi.BoundingBox3f(place, place)

    class Panorama(Wide):
        kind = PANORAMA

        def look(self, u: mi.Float, v: mi.Float) -> mi.Vector3f:
            (s, c), (top, flat) = dr.sincos(u * dr.pi), dr.sincos(v * dr.pi / 2)
            return mi.Vector3f(s * flat, top, c * flat)

    for plugin in (Wide, Panorama):
        mi.register_sensor(plugin.kind, plugin)
