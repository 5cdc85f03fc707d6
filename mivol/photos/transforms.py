"""Cameras in JSON: ``transforms_train.json`` of Blender and NeRF, ``transforms.json`` of nerfstudio and instant-ngp.

Conventions. ``transform_matrix`` is camera to world with our axes (:mod:`mivol.photos.camera`), ``camera_angle_x`` the full
horizontal angle [radian]; focal lengths and principal points count pixels from the upper left corner, as COLMAP's do.
Settings that only place a scene in another program's unit cube (``aabb_scale``, ``scale``, ``offset``) are left alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files.source import read_bytes, refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.lens import Lens
from mivol.photos.listing import Entry, Listing
from mivol.photos.picture import SUFFIXES

__all__ = ["read_blender", "read_transforms"]

#: files of a Blender data set -> split.
SPLIT_FILES = {"transforms_train.json": "train", "transforms_val.json": "val", "transforms_test.json": "test"}


def read_blender(path: Path) -> Listing:
    """A folder with ``transforms_train.json`` and perhaps ``_val`` and ``_test``.

    Raises:
        MivolError: as :func:`read_transforms`.
    """
    entries = []
    for name, split in SPLIT_FILES.items():
        if (path / name).is_file():
            entries += _entries(path / name, split)
    return Listing(entries)


def read_transforms(path: Path) -> Listing:
    """One JSON file, or the folder of a ``transforms.json``.

    Raises:
        MivolError: no JSON, no frames, or a frame without file or transform.
    """
    file = path / "transforms.json" if path.is_dir() else path
    return Listing(_entries(file, "train"))


def _entries(file: Path, split: str) -> list[Entry]:
    try:
        table = json.loads(read_bytes(file))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise refusal(file, f"text that is not JSON ({error})", "cameras in JSON", "write it again") from error
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise refusal(file, "no list of frames", "a key frames with one entry per photograph", "write it again")
    return [_entry(file, table, frame, number, split) for number, frame in enumerate(frames)]


def _entry(file: Path, table: Mapping[str, Any], frame: Mapping[str, Any], number: int, split: str) -> Entry:
    missing = [key for key in ("file_path", "transform_matrix") if not isinstance(frame, dict) or key not in frame]
    if missing:
        raise refusal(file, f"frame {number} without {missing[0]}", "file_path and transform_matrix", "write it again")
    name = str(frame["file_path"])
    settings = {**table, **frame}

    def camera(size: tuple[int, int]) -> Camera:
        return Camera(
            _intrinsics(file, settings, size), size, _matrix(file, frame, name), _lens(settings), f"{file.name} {name}"
        )

    return Entry(name, _photograph(file.parent / name), camera, split)


def _photograph(path: Path) -> Path:
    """The file of a name that may lack its suffix; the first of ``SUFFIXES`` where nothing is there."""
    if path.suffix.lower() in SUFFIXES:
        return path
    tried = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    return next((file for file in tried if file.is_file()), tried[0])


def _matrix(file: Path, frame: Mapping[str, Any], name: str) -> np.ndarray:
    try:
        return np.array(frame["transform_matrix"], np.float64)
    except (ValueError, TypeError) as error:
        raise refusal(
            f"{file.name} {name}", "a transform_matrix that is no matrix", "4 rows of 4 numbers", "correct it"
        ) from error


def _intrinsics(file: Path, settings: Mapping[str, Any], size: tuple[int, int]) -> np.ndarray:
    fx = 0.5 * size[0] / np.tan(0.5 * float(settings["camera_angle_x"]))
    return intrinsics(fx, fx, size[0] / 2, size[1] / 2)


def _lens(settings: Mapping[str, Any]) -> Lens:
    return Lens(**{key: float(settings.get(key, 0.0)) for key in Lens.__dataclass_fields__})
