"""A ray-traced capture of an unbounded place, as COLMAP leaves it: a ball near the cameras, walls far behind.

Conventions of the reconstruction. Points are seen by random pixels. A photograph that sees a point finds it with probability
``FOUND``, and points found by three photographs are kept. Positions have the errors of a triangulation: one pixel of
photographs ``FINER`` times as large, and along the view more by the ratio of distance to baseline. A share ``WILD`` has a wrong
distance.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mivol.files import write_png
from mivol.photos import Camera, Photo, aim_camera, intrinsics, pixel_centres, project, rays
from mivol.photos.camera import FLIP
from mivol.photos.photo_file import decode_srgb

__all__ = ["DISTANCE", "RADIUS", "WALLS", "hit_distance", "make_cameras", "make_points", "trace_image", "write_room"]

RADIUS, WALLS, DISTANCE = 0.5, 6.0, 2.0
"""Radius of the ball at the origin, half the edge of the cube of walls, distance of the cameras from the origin [length]."""

PIXELS, FOUND, WILD = 250, 0.5, 0.03
"""Tried pixels of a photograph, share of the points that a photograph finds, share of points with a wrong distance."""

FINER = 8
"""Points are found in photographs with this factor more pixels along an edge than the fitted photographs have."""

FEWEST = 3
"""Smallest number of photographs that find a kept point."""


# -- Photographs ------------------------------------------------------------------------------------------------------------


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


def make_photos(count: int, size: tuple[int, int]) -> list[Photo]:
    """Photographs of the place."""
    black = np.zeros(3, np.float32)
    return [Photo(c.name, np.float32(trace_image(c)), None, None, c, black) for c in make_cameras(count, size)]


# -- Reconstruction ---------------------------------------------------------------------------------------------------------


def make_points(cameras: list[Camera], rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Points (N, 3) [length], and their finding cameras (V, N)."""
    hits = []
    for camera in cameras:
        o, d = rays(camera, rng.uniform(0, camera.size, (PIXELS, 2)))
        hits.append(o + d * hit_distance(o, d)[:, None])
    points = np.concatenate(hits)
    finds = np.array([is_visible(camera, points) for camera in cameras]) & (rng.random((len(cameras), len(points))) < FOUND)
    kept = finds.sum(axis=0) >= FEWEST
    points, finds = points[kept], finds[:, kept]
    return triangulate(points, finds, cameras, rng), finds


def is_visible(camera: Camera, points: NDArray) -> NDArray:
    """Whether a camera sees points, inside its image and not hidden."""
    at, depth = project(camera, points)
    away = points - camera.origin
    distance = np.linalg.norm(away, axis=1)
    nearest = hit_distance(np.broadcast_to(camera.origin, away.shape), away / distance[:, None])
    return (depth > 0) & ((at >= 0) & (at <= camera.size)).all(axis=1) & (np.abs(nearest - distance) < 1e-3 * distance)


def triangulate(points: NDArray, finds: NDArray, cameras: list[Camera], rng: np.random.Generator) -> NDArray:
    """Add the errors of a triangulation to points (N, 3)."""
    origins, focal = np.array([camera.origin for camera in cameras]), cameras[0].K[0, 0]
    noisy = np.empty_like(points)
    for number, point in enumerate(points):
        own = origins[finds[:, number]]
        middle = own.mean(axis=0)
        away = point - middle
        distance, base = np.linalg.norm(away), np.linalg.norm(own - middle, axis=1).max()
        pixel = distance / (FINER * focal) / np.sqrt(len(own))
        factor = rng.uniform(0.2, 1.5) if rng.random() < WILD else 1.0
        across, along = pixel * rng.normal(size=3), away / distance * pixel * distance / base * rng.normal()
        noisy[number] = middle + factor * away + across + along
    return noisy


def write_room(folder: Path, count: int, size: tuple[int, int], seed: int = 11) -> Path:
    """Write the photographs and their reconstruction to ``images/`` and ``sparse/0/`` of a folder, which is returned."""
    model = folder / "sparse" / "0"
    for made in (folder / "images", model):
        made.mkdir(parents=True)
    photos = make_photos(count, size)
    points, finds = make_points([photo.camera for photo in photos], np.random.default_rng(seed))
    K = photos[0].camera.K
    (model / "cameras.txt").write_text(f"1 PINHOLE {size[0]} {size[1]} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    lines = []
    for number, photo in enumerate(photos, 1):
        write_png(folder / "images" / photo.name, decode_srgb(photo.image))
        turn = (photo.camera.to_world[:3, :3] * FLIP).T
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        pose = (w, x, y, z, *(-turn @ photo.camera.origin))
        lines += [f"{number} {' '.join(repr(float(v)) for v in pose)} 1 {photo.name}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    rows = []
    for number, (point, own) in enumerate(zip(points.tolist(), finds.T, strict=True), 1):
        track = " ".join(f"{view + 1} 0" for view in np.flatnonzero(own))
        rows.append(f"{number} {' '.join(map(repr, point))} 128 128 128 1 {track}")
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder
