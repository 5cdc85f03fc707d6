"""The poses of LLFF: ``poses_bounds.npy`` beside a folder ``images``.

Each row holds 17 numbers: a matrix of 3 x 5, row by row, and the nearest and the farthest distance of visible matter along the
optical axis. The columns of the matrix are the camera's axes in the world (down, right, backwards), its position, and height,
width and focal length in pixels. Rows belong to the photographs in the order of their names.

Source: Mildenhall et al. 2019 (Local Light Field Fusion), "Using your own poses without running COLMAP" in its documentation.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.listing import SHRUNK, Entry, Listing
from mivol.photos.photo_file import SUFFIXES

FILE = "poses_bounds.npy"

NUMBERS = 17
"""Numbers of a photograph."""

SAME_WAY = 45.0
"""Largest angle from the mean direction at which all cameras look one way [degree]."""


def read_llff(path: Path) -> Listing:
    """Read the folder of a ``poses_bounds.npy``, or the file.

    If all cameras look within ``SAME_WAY`` of their mean direction, the box is around the frusta between the distances.
    Cameras around a subject have the box of other data sets.

    Raises:
        MivolError: another array, distances that are not 0 < near < far, or another number of photographs.
    """
    file = path / FILE if path.is_dir() else path
    rows = _read_rows(file)
    names = ("images", *(f"images_{k}" for k in SHRUNK[1:]))
    folder = next((file.parent / name for name in names if (file.parent / name).is_dir()), file.parent / "images")
    images = sorted(image for image in folder.rglob("*") if image.suffix.lower() in SUFFIXES)
    if len(images) != len(rows):
        found = f"{len(rows)} poses and {len(images)} photographs in {folder.name}"
        raise refusal(file, found, "a pose for each photograph, in the order of names", "copy all photographs")
    entries, corners, axes = [], [], []
    for image, row in zip(images, rows, strict=True):
        camera = _make_camera(row, f"{FILE} {image.name}")
        entries.append(Entry(image.name, image, camera.resized, "train", camera.size))
        corners.append(_frustum(camera, row[15:]))
        axes.append(camera.forward)
    ends, mean = np.concatenate(corners), np.mean(axes, axis=0)
    looks_one_way = (np.array(axes) @ mean).min() > np.cos(np.radians(SAME_WAY)) * np.linalg.norm(mean)
    return Listing(entries, box=np.array([ends.min(axis=0), ends.max(axis=0)]) if looks_one_way else None)


def _read_rows(file: Path) -> np.ndarray:
    """The numbers (N, 17) of a file."""
    try:
        rows = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise refusal(file, "no array of NumPy", f"{NUMBERS} numbers for each photograph", "copy the file again") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != NUMBERS or rows.dtype.kind not in "fiu":
        found = f"{rows.dtype} of shape {rows.shape}" if isinstance(rows, np.ndarray) else "several arrays"
        raise refusal(file, found, f"{NUMBERS} numbers for each photograph", "write it again")
    rows = rows.astype(np.float64)
    near, far = rows[:, 15], rows[:, 16]
    if not (np.isfinite(rows).all() and (near > 0).all() and (near < far).all()):
        number = int(np.argmin(np.isfinite(rows).all(axis=1) & (near > 0) & (near < far)))
        raise refusal(file, f"row {number} with {rows[number].tolist()}", "finite numbers and 0 < near < far", "write it again")
    return rows


def _make_camera(row: np.ndarray, name: str) -> Camera:
    """The camera of a row, at the size in the row."""
    down, right, back, position, (height, width, focal) = row[:15].reshape(3, 5).T
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, -down, back, position])
    return Camera(intrinsics(focal, focal, width / 2, height / 2), (round(width), round(height)), pose, name=name)


def _frustum(camera: Camera, depths: np.ndarray) -> np.ndarray:
    """The corners (8, 3) of a camera's frustum between two depths along the axis [length]."""
    (width, height), focal = camera.size, camera.K[0, 0]
    plane = np.array([[x * width / 2, y * height / 2, -focal] for x in (-1, 1) for y in (-1, 1)]) / focal
    local = np.concatenate([plane * depth for depth in depths])
    return local @ camera.to_world[:3, :3].T + camera.origin
