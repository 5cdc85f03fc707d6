"""A capture of a place without bounds, traced: a ball near the cameras, walls far behind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mivol.photos import Camera, Photo, aim_camera, intrinsics, pixel_centres, rays

__all__ = ["DISTANCE", "RADIUS", "WALLS", "cameras_of", "distance_of", "image_of", "room"]

RADIUS, WALLS, DISTANCE = 0.5, 6.0, 2.0
"""Of the ball at the origin, half the edge of the cube of walls, and of the cameras from the origin [length]."""


def colours(points: NDArray, wave: float) -> NDArray:
    """A smooth pattern of many colours over points (..., 3), from 0.1 to 0.9."""
    x, y, z = np.moveaxis(wave * points, -1, 0)
    return 0.5 + 0.4 * np.stack([np.sin(x + 2 * y), np.sin(2 * z - y + 1), np.sin(x - z + 2)], axis=-1)


def distance_of(o: NDArray, d: NDArray) -> NDArray:
    """How far rays (..., 3) from among the walls go, to the ball or to a wall [length]."""
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: a ray in the middle plane, which meets no such wall
        wall = np.nanmin((WALLS * np.sign(d) - o) / d, axis=-1)
    along = np.sum(o * d, axis=-1)
    inside = along**2 - np.sum(o * o, axis=-1) + RADIUS**2
    return np.where(inside > 0, -along - np.sqrt(np.maximum(inside, 0)), wall)


def image_of(camera: Camera) -> NDArray:
    """What a camera among the walls sees (height, width, 3)."""
    o, d = rays(camera, pixel_centres(camera.size))
    at = o + d * distance_of(o, d)[..., None]
    is_ball = np.linalg.norm(at, axis=-1, keepdims=True) < 2 * RADIUS
    return np.where(is_ball, colours(at, 3.0), colours(at, 0.25))


def cameras_of(count: int, size: tuple[int, int]) -> list[Camera]:
    """All around the ball, at several heights, looking at it."""
    width, height = size
    like, made = Camera(intrinsics(0.6 * width, 0.6 * width, width / 2, height / 2), size, np.eye(4)), []
    for k in range(count):
        turn, rise = 2.4 * k, 0.6 * np.sin(1.7 * k)
        origin = DISTANCE * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        made.append(aim_camera(like, origin, np.zeros(3), np.array([0.0, 0.0, 1.0]), f"view_{k:02d}.png"))
    return made


def room(count: int, size: tuple[int, int]) -> list[Photo]:
    """Photographs of the place, of so many pixels (width, height)."""
    black = np.zeros(3, np.float32)
    return [
        Photo(f"view_{k:02d}.png", np.float32(image_of(camera)), None, None, camera, black)
        for k, camera in enumerate(cameras_of(count, size))
    ]
