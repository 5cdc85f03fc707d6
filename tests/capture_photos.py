"""Small captures of a ball among far walls, all with smooth patterns; some photographs are brighter than others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.files import write_png
from mivol.files.image_files import decode_srgb
from mivol.photos import Camera, Photo, aim_camera, intrinsics, pixel_centres, rays
from mivol.photos.transforms import write_transforms

SIZE = (32, 24)
RADIUS, WALLS, DISTANCE = 0.5, 6.0, 2.0
"""Radius of the ball at the origin, half the edge of the cube of walls, distance of the cameras from the origin [length]."""


def pattern(points: NDArray, wave: float) -> NDArray:
    """Smooth pattern of colours over points (..., 3), from 0.1 to 0.9."""
    x, y, z = np.moveaxis(wave * points, -1, 0)
    return 0.5 + 0.4 * np.stack([np.sin(x + 2 * y), np.sin(2 * z - y + 1), np.sin(x - z + 2)], axis=-1)


def hit_distance(o: NDArray, d: NDArray) -> NDArray:
    """Distance of rays (..., 3) from inside the walls to the ball or to a wall [length]."""
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: a ray in the middle plane meets no such wall
        wall = np.nanmin((WALLS * np.sign(d) - o) / d, axis=-1)
    along = np.sum(o * d, axis=-1)
    inside = along**2 - np.sum(o * o, axis=-1) + RADIUS**2
    return np.where(inside > 0, -along - np.sqrt(np.maximum(inside, 0)), wall)


def trace_image(camera: Camera) -> NDArray:
    """Image of a camera inside the walls (height, width, 3)."""
    o, d = rays(camera, pixel_centres(camera.size))
    hit = o + d * hit_distance(o, d)[..., None]
    is_ball = np.linalg.norm(hit, axis=-1, keepdims=True) < 2 * RADIUS
    return np.where(is_ball, pattern(hit, 3.0), pattern(hit, 0.25))


def make_cameras(count: int, size: tuple[int, int]) -> list[Camera]:
    """Cameras all around the ball, at several heights, aimed at its centre; size in pixels (width, height)."""
    width, height = size
    like = Camera(intrinsics(0.6 * width, 0.6 * width, width / 2, height / 2), size, np.eye(4))
    cameras = []
    for k in range(count):
        turn, rise = 2.4 * k, 0.6 * np.sin(1.7 * k)
        origin = DISTANCE * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        cameras.append(aim_camera(like, origin, np.zeros(3), np.array([0.0, 0.0, 1.0]), f"view_{k:02d}.png"))
    return cameras


def cameras(count: int) -> list[Camera]:
    """All around the ball, at several heights, looking at it."""
    return make_cameras(count, SIZE)


def capture(count: int, uneven: float = 0.0) -> list[Photo]:
    """Photographs of the place; their gains are spread by exp(uneven * normal)."""
    gains = np.exp(uneven * np.random.default_rng(7).normal(size=count))
    black = np.zeros(3, np.float32)
    return [
        Photo(camera.name, np.float32(np.clip(gain * trace_image(camera), 0, 1)), None, None, camera, black)
        for camera, gain in zip(cameras(count), gains, strict=True)
    ]


def write_capture(folder: Path, count: int) -> Path:
    """The photographs and their file of cameras in a folder."""
    folder.mkdir(parents=True)
    made = capture(count)
    for photo in made:
        write_png(folder / photo.name, decode_srgb(photo.image))
    write_transforms(folder / "transforms.json", {photo.name: photo.camera for photo in made}, [])
    return folder
