"""Cameras in JSON: ``transforms_train.json`` of Blender and NeRF, ``transforms.json`` of nerfstudio and instant-ngp.

Conventions. ``transform_matrix`` is camera to world with our axes (:mod:`mivol.photos.camera`), ``camera_angle_x`` the full
horizontal angle [radian]; focal lengths and principal points count pixels from the upper left corner, as COLMAP's do.
``train_filenames``, ``val_filenames`` and ``test_filenames`` divide the set; where there is a list to train on, what no list
names is left alone, as are settings that only place a scene in another program's unit cube (``aabb_scale``, ``scale``,
``offset``). ``ply_file_path`` names points of a sparse reconstruction, in the frame of the cameras.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files.atomic import write_whole_text
from mivol.files.ply import read_vertices, vertex_positions
from mivol.files.source import read_bytes, refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.lens import Fisheye, Lens, Panorama
from mivol.photos.listing import UNLISTED, Entry, Listing, check_points
from mivol.photos.photo_file import SUFFIXES

__all__ = ["MODELS", "Settings", "read_blender", "read_transforms", "write_transforms"]

#: files of a Blender data set -> split.
SPLIT_FILES = {"transforms_train.json": "train", "transforms_val.json": "val", "transforms_test.json": "test"}

BROWN = tuple(Lens.__dataclass_fields__)

#: camera_model -> its lens, and the coefficients that it may have.
MODELS: dict[str, tuple[type[Lens | Fisheye | Panorama], tuple[str, ...]]] = {
    "OPENCV": (Lens, BROWN),
    "RADIAL": (Lens, BROWN),
    "SIMPLE_RADIAL": (Lens, BROWN),
    "PINHOLE": (Lens, ()),
    "SIMPLE_PINHOLE": (Lens, ()),
    "OPENCV_FISHEYE": (Fisheye, ("k1", "k2", "k3", "k4")),
    "EQUIRECTANGULAR": (Panorama, ()),
}

#: keys that say, if they are set, that a frame was taken by another kind of camera or while it moved.
OTHER_CAMERAS = ("ftheta_p0", "latlong", "equirectangular", "orthographic", "rolling_shutter")


def read_blender(path: Path) -> Listing:
    """A folder with ``transforms_train.json`` and perhaps ``_val`` and ``_test``.

    Raises:
        MivolError: as :func:`read_transforms`.
    """
    entries = []
    for name, split in SPLIT_FILES.items():
        if (path / name).is_file():
            entries += _entries(path / name, _table(path / name), split)
    return Listing(entries)


def read_transforms(path: Path) -> Listing:
    """One JSON file, or the folder of a ``transforms.json``.

    Raises:
        MivolError: no JSON, no frames, a frame without file or transform, or points that it names and that are not there.
    """
    file = path / "transforms.json" if path.is_dir() else path
    table = _table(file)
    return Listing(_entries(file, table, "train"), _points(file, table))


def write_transforms(path: Path, cameras: Mapping[str, Camera], test: Sequence[str] = ()) -> None:
    """Write cameras as nerfstudio's ``transforms.json``, whole or not at all; read again they are the same.

    Args:
        path: destination.
        cameras: by photograph, relative to the folder of ``path``.
        test: which of the photographs are the test split.

    Raises:
        MivolError: disk full, no such folder, or lenses of several kinds.
    """
    frames = [{"file_path": name, **_described(camera)} for name, camera in cameras.items()]
    models = {MODEL_OF[type(camera.distortion)] for camera in cameras.values()}
    if len(models) > 1:
        raise refusal(path, f"cameras of the kinds {', '.join(sorted(models))}", "one kind in a file", "write a file for each")
    table = {"camera_model": models.pop() if models else "OPENCV", "frames": frames}
    if test:
        table |= {"train_filenames": [name for name in cameras if name not in test], "test_filenames": list(test)}
    write_whole_text(path, json.dumps(table, indent=1))


MODEL_OF = {Lens: "OPENCV", Fisheye: "OPENCV_FISHEYE", Panorama: "EQUIRECTANGULAR"}


def _described(camera: Camera) -> dict[str, Any]:
    lens = {key: value for key, value in asdict(camera.distortion).items() if value}
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    w, h = camera.size
    numbers = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": w, "h": h}
    return {**numbers, **lens, "transform_matrix": camera.to_world.tolist()}


def _table(file: Path) -> dict[str, Any]:
    try:
        table = json.loads(read_bytes(file))
    except (ValueError, RecursionError) as error:  # of JSON, of UTF-8, and of numbers of thousands of digits
        raise refusal(file, f"text that is not JSON ({error})", "cameras in JSON", "write it again") from error
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise refusal(file, "no list of frames", "a key frames with one entry per photograph", "write it again")
    return table


def _points(file: Path, table: Mapping[str, Any]) -> np.ndarray | None:
    """(N, 3) the points that a file of cameras names [length]; None where it names none."""
    name = table.get("ply_file_path")
    if not name:
        return None
    if not isinstance(name, str):
        raise refusal(file, f"ply_file_path = {name!r}", "the name of a file", "correct it")
    path = file.parent / slashed(file.parent, name)
    if not path.is_file():
        raise refusal(file, f"ply_file_path = {name!r}, which is not there", "a file of points", "add it, or remove the key")
    points = np.asarray(vertex_positions(read_vertices(path)), np.float64)
    check_points(points, path, "remove this point")
    return points


def _entries(file: Path, table: Mapping[str, Any], split: str) -> list[Entry]:
    listed = _listed(file, table)
    entries = [_entry(file, table, frame, number, split) for number, frame in enumerate(table["frames"])]
    rest = UNLISTED if "train" in listed.values() else split
    return [dataclasses.replace(entry, split=listed.get(_place(file, entry.name), rest)) for entry in entries]


def _listed(file: Path, table: Mapping[str, Any]) -> dict[str, str]:
    """Places of photographs -> split, as far as the lists of the data set go; a test view is one whatever else names it.

    Raises:
        MivolError: something else than names.
    """
    found = {}
    for split in ("train", "val", "test"):
        names = table.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise refusal(file, f"{split}_filenames = {names!r}", "a list of the names of files", "correct it")
        found |= {_place(file, name): split for name in names}
    return found


def _place(file: Path, name: str) -> str:
    """Where a photograph lies, however it is written: ``./a.png`` and ``a.png`` are one."""
    return os.path.normpath(file.parent.absolute() / slashed(file.parent, name))


LONGEST_NAME = 255
"""Bytes of a name in a folder: the bound of all common file systems."""


def slashed(folder: Path, name: str) -> str:
    """The name of a file with forward slashes: data sets made on Windows name ``images\\a.png``, which other systems miss.

    Raises:
        MivolError: a name longer than file systems have.
    """
    if any(len(part.encode(errors="replace")) > LONGEST_NAME for part in re.split(r"[\\/]", name)):
        raise refusal(folder, f"a photograph with a name of {len(name)} characters", f"at most {LONGEST_NAME}", "correct it")
    return name if "\\" not in name or (folder / name).is_file() else name.replace("\\", "/")


def _entry(file: Path, table: Mapping[str, Any], frame: Mapping[str, Any], number: int, split: str) -> Entry:
    missing = [key for key in ("file_path", "transform_matrix") if not isinstance(frame, dict) or key not in frame]
    if missing:
        raise refusal(file, f"frame {number} without {missing[0]}", "file_path and transform_matrix", "write it again")
    name = slashed(file.parent, str(frame["file_path"]))
    settings = Settings({**table, **frame}, f"{file.name} {name}")

    def camera(size: tuple[int, int]) -> Camera:
        lens = settings.lens()
        K = settings.panorama(size) if isinstance(lens, Panorama) else settings.intrinsics(size)
        return Camera(K, size, settings.matrix(), lens, settings.name)

    mask = settings.values.get("mask_path")
    if not isinstance(mask, str | None):
        raise refusal(settings.name, f"mask_path = {mask!r}", "the name of a file", "correct it")
    return Entry(
        name,
        _photograph(file.parent / name),
        camera,
        split,
        settings.size(),
        file.parent / slashed(file.parent, mask) if mask else None,
    )


def _photograph(path: Path) -> Path:
    """The file of a name that may lack its suffix; the first of ``SUFFIXES`` where nothing is there."""
    if path.suffix.lower() in SUFFIXES or path.is_file():
        return path
    tried = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    return next((file for file in tried if file.is_file()), tried[0])


@dataclass(frozen=True)
class Settings:
    """What holds for one frame: its own keys, then those of the file.

    Attributes:
        values: by key.
        name: of the frame, for refusals.
    """

    values: Mapping[str, Any]
    name: str

    def number(self, key: str, default: float = 0.0) -> float:
        """The number under a key; ``default`` where it is absent.

        Raises:
            MivolError: something else stands there.
        """
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise refusal(self.name, f"{key} = {value!r}", "a number", "correct it")
        return float(value)

    def size(self) -> tuple[int, int] | None:
        """(width, height), where ``w`` and ``h`` say it.

        Raises:
            MivolError: not whole.
        """
        if "w" not in self.values or "h" not in self.values:
            return None
        found = self.number("w"), self.number("h")
        if not all(n >= 1 and n == int(n) for n in found):
            raise refusal(self.name, f"w = {found[0]}, h = {found[1]}", "whole numbers of pixels", "correct them")
        return int(found[0]), int(found[1])

    def intrinsics(self, size: tuple[int, int]) -> np.ndarray:
        """(3, 3) K. Focal lengths count before angles; the principal point is the middle unless it is said.

        Raises:
            MivolError: neither a focal length nor an angle.
        """
        fx = self._focal("fl_x", "camera_angle_x", size[0])
        if fx is None:
            raise refusal(self.name, "no focal length", "fl_x or camera_angle_x", "add it to the file of cameras")
        fy = self._focal("fl_y", "camera_angle_y", size[1])
        fy = fx if fy is None else fy
        return intrinsics(fx, fy, self.number("cx", size[0] / 2), self.number("cy", size[1] / 2))

    def panorama(self, size: tuple[int, int]) -> np.ndarray:
        """(3, 3) K of an image of all directions: pixels a radian. Focal lengths that the file gives say nothing more.

        Raises:
            MivolError: an image that is not twice as wide as high.
        """
        if size[0] != 2 * size[1]:
            raise refusal(self.name, f"a panorama of {size[0]} x {size[1]} pixels", "twice as wide as high", "crop nothing")
        return intrinsics(size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)

    def _focal(self, length: str, angle: str, pixels: int) -> float | None:
        if length in self.values:
            return self.number(length)
        if angle not in self.values:
            return None
        radians = self.number(angle)
        if not 0 < radians < np.pi:
            raise refusal(self.name, f"{angle} = {radians:g}", "an angle between 0 and pi", "give it in radians")
        return 0.5 * pixels / float(np.tan(radians / 2))

    def lens(self) -> Lens | Fisheye | Panorama:
        """The lens. ``is_fisheye`` is instant-ngp's word for OPENCV_FISHEYE.

        Raises:
            MivolError: a camera that is not in ``MODELS``, or coefficients that its lens has not.
        """
        model = self.values.get("camera_model", "OPENCV_FISHEYE" if self.values.get("is_fisheye") else "OPENCV")
        other = next((key for key in OTHER_CAMERAS if self.values.get(key)), None)
        if not isinstance(model, str) or model not in MODELS or other:
            found = f"{other} = {self.values[other]}" if other else f"camera_model {model}"
            raise refusal(self.name, found, f"one of {', '.join(MODELS)}", "undistort the images first")
        kind, terms = MODELS[model]
        given = {key: self.number(key) for key in BROWN}
        extra = next((key for key, value in given.items() if value and key not in terms), None)
        if extra:
            allowed = f"only {', '.join(terms)}" if terms else "no distortion"
            raise refusal(self.name, f"a {model} with {extra} = {given[extra]:g}", allowed, "correct camera_model")
        return kind(**{key: given[key] for key in terms})

    def matrix(self) -> np.ndarray:
        """``transform_matrix`` as it stands.

        Raises:
            MivolError: not a matrix of numbers.
        """
        try:
            return np.array(self.values["transform_matrix"], np.float64)
        except (ValueError, TypeError) as error:
            raise refusal(self.name, "a transform_matrix that is no matrix", "4 rows of 4 numbers", "correct it") from error
