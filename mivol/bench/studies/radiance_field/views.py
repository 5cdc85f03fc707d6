"""Cameras on a ring about [-1, 1]^3, what they see of a radiance field, and rays through their pixels."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera, Photo, intrinsics, pixel_centres, rays
from mivol.photos.camera_path import aim_camera
from mivol.transport.line_integrals.radiance_field import RayBundle

__all__ = ["BOX", "between", "camera", "photographed", "rays_of", "rays_through", "ring", "tiled"]

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
BLACK = np.zeros(3, np.float32)


def camera(k: float, of: int, side: int) -> Camera:
    """Camera k on a ring of so many, 3 from the axis and 0.9 above the middle of the box, which it looks at."""
    angle = 2 * np.pi * k / of
    like = Camera(intrinsics(1.2 * side, 1.2 * side, side / 2, side / 2), (side, side), np.eye(4))
    origin = np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.9])
    return aim_camera(like, origin, np.zeros(3), np.array([0.0, 0, 1]), f"camera {k}")


def ring(side: int, count: int = 7) -> list[Camera]:
    """Cameras of a ring."""
    return [camera(k, count, side) for k in range(count)]


def between(side: int, count: int = 7) -> list[Camera]:
    """Cameras half-way between every second pair of a ring's."""
    return [camera(k + 0.5, count, side) for k in range(0, count, 2)]


def photographed(field: SphericalGrid, cameras: Sequence[Camera]) -> list[Photo]:
    """Views of a field over black."""
    images = [np.clip(render_view(field, one, BLACK).image, 0, 1) for one in cameras]
    return [Photo(one.name, image, None, None, one, BLACK) for one, image in zip(cameras, images, strict=True)]


def tiled(side: int) -> np.ndarray:
    """Pixels of a view (row, column), tile by tile of 4 x 4."""
    i = np.arange(side * side)
    tile, within = i // 16, i % 16
    return np.stack([tile // (side // 4) * 4 + within // 4, tile % (side // 4) * 4 + within % 4], axis=1)


def rays_through(one: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays through the centres of pixels (row, column)."""
    o, d = rays(one, pixel_centres(one.size)[pixels[:, 0], pixels[:, 1]])
    return np.broadcast_to(o, d.shape), d


def rays_of(o: np.ndarray, d: np.ndarray) -> RayBundle:
    """Rays on the device."""
    made = RayBundle(*(kind(np.ascontiguousarray(np.float32(a.T))) for kind, a in ((mi.Point3f, o), (mi.Vector3f, d))))
    dr.eval(made.o, made.d)
    return made
