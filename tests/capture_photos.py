"""A capture of an unbounded place, traced in NumPy: a ball near the cameras, walls far behind, some photographs brighter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from photo_sets import look_at

from mivol.files import write_png
from mivol.photos import Camera, Photo, pixel_centres, rays
from mivol.photos.camera import intrinsics
from mivol.photos.picture import decode_srgb
from mivol.photos.transforms import write_transforms

RADIUS, WALLS, DISTANCE = 0.5, 6.0, 2.0
"""Of the ball at the origin, half the edge of the cube of walls, and of the cameras from the origin [length]."""

SIZE = (32, 24)


def colours(points: np.ndarray, wave: float) -> np.ndarray:
    """A smooth pattern of many colours over points (..., 3), from 0.1 to 0.9."""
    x, y, z = np.moveaxis(wave * points, -1, 0)
    return 0.5 + 0.4 * np.stack([np.sin(x + 2 * y), np.sin(2 * z - y + 1), np.sin(x - z + 2)], axis=-1)


def image_of(camera: Camera) -> np.ndarray:
    """What a camera among the walls sees (height, width, 3)."""
    o, d = rays(camera, pixel_centres(camera.size))
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: a ray in the middle plane, which meets no such wall
        wall = o + d * np.nanmin((WALLS * np.sign(d) - o) / d, axis=-1, keepdims=True)
    along = np.sum(o * d, axis=-1)
    inside = along**2 - np.sum(o * o, axis=-1) + RADIUS**2
    t = -along - np.sqrt(np.maximum(inside, 0))
    return np.where((inside > 0)[..., None], colours(o + d * t[..., None], 3.0), colours(wall, 0.25))


def cameras(count: int) -> list[Camera]:
    """All around the ball, at several heights, looking at it."""
    made = []
    for k in range(count):
        turn, height = 2.4 * k, 0.6 * np.sin(1.7 * k)
        origin = DISTANCE * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        K = intrinsics(0.6 * SIZE[0], 0.6 * SIZE[0], SIZE[0] / 2, SIZE[1] / 2)
        made.append(Camera(K, SIZE, look_at(origin), name=f"view_{k:02d}.png"))
    return made


def capture(count: int, uneven: float = 0.0) -> list[Photo]:
    """Photographs of the place; their gains are spread by exp(uneven * normal)."""
    gains = np.exp(uneven * np.random.default_rng(7).normal(size=count))
    black = np.zeros(3, np.float32)
    return [
        Photo(camera.name, np.float32(np.clip(gain * image_of(camera), 0, 1)), None, None, camera, black)
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
