"""The room of :mod:`mivol.bench.studies.radiance_field.room` as COLMAP would leave it: its photographs, its text files.

Conventions. Points are those that random pixels show. A photograph that shows a point finds it with ``FOUND``; what three find
is kept. Places are off as those of a triangulation are: by a pixel of photographs that were ``FINER`` before they were made
smaller, and along the view by as much more as they stand close together; of a share ``WILD`` the distance is wrong altogether.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mivol.bench.studies.radiance_field.room import distance_of, room
from mivol.files import write_png
from mivol.photos import Camera, project, rays
from mivol.photos.camera import FLIP
from mivol.photos.photo_file import decode_srgb

__all__ = ["points_of", "write_room"]

EACH, FOUND, WILD = 250, 0.5, 0.03
"""Pixels of a photograph that are tried, the share of points that one finds, and the share whose distance is wrong."""

FINER = 8
"""Times as many pixels an edge as the photographs that are fitted have: points are found before these are made smaller."""

FEWEST = 3
"""Photographs that find a point which is kept."""


def points_of(cameras: list[Camera], rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Places (N, 3) [length] and which cameras found them (V, N)."""
    shown = []
    for camera in cameras:
        o, d = rays(camera, rng.uniform(0, camera.size, (EACH, 2)))
        shown.append(o + d * distance_of(o, d)[:, None])
    places = np.concatenate(shown)
    found = np.array([_shows(camera, places) for camera in cameras]) & (rng.random((len(cameras), len(places))) < FOUND)
    kept = found.sum(axis=0) >= FEWEST
    places, found = places[kept], found[:, kept]
    return _triangulated(places, found, cameras, rng), found


def _shows(camera: Camera, places: NDArray) -> NDArray:
    """Whether a camera sees places that nothing hides."""
    at, depth = project(camera, places)
    away = places - camera.origin
    far = np.linalg.norm(away, axis=1)
    seen = distance_of(np.broadcast_to(camera.origin, away.shape), away / far[:, None])
    return (depth > 0) & ((at >= 0) & (at <= camera.size)).all(axis=1) & (np.abs(seen - far) < 1e-3 * far)


def _triangulated(places: NDArray, found: NDArray, cameras: list[Camera], rng: np.random.Generator) -> NDArray:
    origins, focal = np.array([camera.origin for camera in cameras]), cameras[0].K[0, 0]
    made = np.empty_like(places)
    for number, place in enumerate(places):
        own = origins[found[:, number]]
        middle = own.mean(axis=0)
        away = place - middle
        far, base = np.linalg.norm(away), np.linalg.norm(own - middle, axis=1).max()
        pixel = far / (FINER * focal) / np.sqrt(len(own))
        wrong = rng.uniform(0.2, 1.5) if rng.random() < WILD else 1.0
        made[number] = middle + wrong * away + pixel * rng.normal(size=3) + away / far * pixel * far / base * rng.normal()
    return made


def write_room(folder: Path, count: int, size: tuple[int, int], seed: int = 11) -> Path:
    """The photographs and their reconstruction in a folder, ``images/`` and ``sparse/0/``."""
    model = folder / "sparse" / "0"
    for made in (folder / "images", model):
        made.mkdir(parents=True)
    photos = room(count, size)
    places, found = points_of([photo.camera for photo in photos], np.random.default_rng(seed))
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
    for number, (place, own) in enumerate(zip(places.tolist(), found.T, strict=True), 1):
        track = " ".join(f"{view + 1} 0" for view in np.flatnonzero(own))
        rows.append(f"{number} {' '.join(map(repr, place))} 128 128 128 1 {track}")
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder
