"""Cameras in JSON: ``transforms_train.json`` of Blender and NeRF, ``transforms.json`` of nerfstudio and instant-ngp.

Conventions. ``transform_matrix`` is camera to world with the axes of :mod:`mivol.photos.camera`. ``camera_angle_x`` is the full
horizontal angle [radian]. Focal lengths and principal points are in pixels from the upper left corner, as in COLMAP. The lists
``train_filenames``, ``val_filenames`` and ``test_filenames`` define the splits. With a training list, photographs outside all
lists are ignored. Settings for the unit cube of another program (``aabb_scale``, ``scale``, ``offset``) are ignored as well.
``ply_file_path`` names the points of a sparse reconstruction in the frame of the cameras. A file from another machine may name
no existing photograph: then names without the leading folders that all of them share are tried, and other suffixes.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mivol.files.atomic import write_whole_text
from mivol.files.ply import read_vertices, vertex_positions
from mivol.files.source import read_bytes, refusal
from mivol.photos.camera import Camera, intrinsics, panorama_intrinsics
from mivol.photos.lens import Fisheye, Lens, Panorama
from mivol.photos.listing import UNLISTED, Entry, Listing, check_points, find_image

#: file of a Blender data set -> split.
SPLIT_FILES = {"transforms_train.json": "train", "transforms_val.json": "val", "transforms_test.json": "test"}

BROWN = tuple(Lens.__dataclass_fields__)

#: camera_model -> lens class, and the allowed coefficients.
MODELS: dict[str, tuple[type[Lens | Fisheye | Panorama], tuple[str, ...]]] = {
    "OPENCV": (Lens, BROWN),
    "RADIAL": (Lens, BROWN),
    "SIMPLE_RADIAL": (Lens, BROWN),
    "PINHOLE": (Lens, ()),
    "SIMPLE_PINHOLE": (Lens, ()),
    "OPENCV_FISHEYE": (Fisheye, ("k1", "k2", "k3", "k4")),
    "EQUIRECTANGULAR": (Panorama, ()),
}

#: keys of unsupported cameras: other projections and rolling shutters.
OTHER_CAMERAS = ("ftheta_p0", "latlong", "equirectangular", "orthographic", "rolling_shutter")


def read_blender(path: Path) -> Listing:
    """Read a folder with ``transforms_train.json`` and optional ``_val`` and ``_test`` files.

    Raises:
        MivolError: errors of :func:`read_transforms`.
    """
    entries = []
    for name, split in SPLIT_FILES.items():
        if (path / name).is_file():
            entries += _entries(path / name, _read_json(path / name), split)
    return Listing(entries)


def read_transforms(path: Path) -> Listing:
    """Read a JSON file, or the folder of a ``transforms.json``.

    Raises:
        MivolError: no JSON, no frames, a frame without file or transform, or a missing file of points.
    """
    file = path / "transforms.json" if path.is_dir() else path
    table = _read_json(file)
    entries, notes = _find_elsewhere(file.parent, _entries(file, table, "train"))
    return Listing(entries, _points(file, table), notes=notes)


def write_transforms(path: Path, cameras: Mapping[str, Camera], test: Sequence[str] = ()) -> None:
    """Write cameras as nerfstudio's ``transforms.json``, whole or not at all. Reading the file returns equal cameras.

    Args:
        path: destination.
        cameras: camera of each photograph, whose path is relative to the folder of ``path``.
        test: photographs of the test split.

    Raises:
        MivolError: a full disk, a missing folder, or different classes of lenses.
    """
    frames = [{"file_path": name, **_camera_entry(camera)} for name, camera in cameras.items()]
    models = {MODEL_OF[type(camera.distortion)] for camera in cameras.values()}
    if len(models) > 1:
        raise refusal(
            path, f"the camera models {', '.join(sorted(models))}", "a single model per file", "write a file for each"
        )
    table = {"camera_model": models.pop() if models else "OPENCV", "frames": frames}
    if test:
        table |= {"train_filenames": [name for name in cameras if name not in test], "test_filenames": list(test)}
    write_whole_text(path, json.dumps(table, indent=1))


MODEL_OF = {Lens: "OPENCV", Fisheye: "OPENCV_FISHEYE", Panorama: "EQUIRECTANGULAR"}


def _camera_entry(camera: Camera) -> dict[str, Any]:
    lens = {key: value for key, value in asdict(camera.distortion).items() if value}
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    w, h = camera.size
    numbers = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": w, "h": h}
    return {**numbers, **lens, "transform_matrix": camera.to_world.tolist()}


def _read_json(file: Path) -> dict[str, Any]:
    try:
        table = json.loads(read_bytes(file))
    except (ValueError, RecursionError) as error:  # invalid JSON or UTF-8, or numbers of thousands of digits
        raise refusal(file, f"text that is not JSON ({error})", "cameras in JSON", "write the file again") from error
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise refusal(file, "no list of frames", "a key frames with one entry per photograph", "write the file again")
    return table


def _points(file: Path, table: Mapping[str, Any]) -> np.ndarray | None:
    """The points (N, 3) of a file of cameras [length], if the file names points."""
    name = table.get("ply_file_path")
    if not name:
        return None
    if not isinstance(name, str):
        raise refusal(file, f"ply_file_path = {name!r}", "the name of a file", "correct it")
    path = file.parent / to_forward_slashes(file.parent, name)
    if not path.is_file():
        raise refusal(file, f"ply_file_path = {name!r}, a missing file", "a file of points", "add the file, or remove the key")
    points = np.asarray(vertex_positions(read_vertices(path)), np.float64)
    check_points(points, path, "remove this point")
    return points


def _entries(file: Path, table: Mapping[str, Any], split: str) -> list[Entry]:
    splits = _read_splits(file, table)
    entries = [_entry(file, table, frame, number, split) for number, frame in enumerate(table["frames"])]
    rest = UNLISTED if "train" in splits.values() else split
    return [dataclasses.replace(entry, split=splits.get(_full_path(file, entry.name), rest)) for entry in entries]


def _read_splits(file: Path, table: Mapping[str, Any]) -> dict[str, str]:
    """Path -> split of the listed photographs. A photograph of several lists belongs to the last of train, val and test.

    Raises:
        MivolError: a list with other entries than names.
    """
    splits = {}
    for split in ("train", "val", "test"):
        names = table.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise refusal(file, f"{split}_filenames = {names!r}", "a list of the names of files", "correct it")
        splits |= {_full_path(file, name): split for name in names}
    return splits


def _find_elsewhere(folder: Path, entries: list[Entry]) -> tuple[list[Entry], tuple[str, ...]]:
    """If no listed photograph exists, look for them with other suffixes, and without leading folders that all names share.

    Returns:
        The entries with the files that were found, and a note on them.
    """
    if any(entry.file.is_file() for entry in entries):
        return entries, ()
    listed = [PurePosixPath(entry.name) for entry in entries]
    heads = [PurePosixPath(), *reversed(listed[0].parents)]
    for left_out in (head for head in heads if all(name.is_relative_to(head) for name in listed)):
        names = [name.relative_to(left_out) for name in listed]
        for stems in (names, [name.with_suffix("") for name in names]):
            files = [find_image(folder / stem) for stem in stems]
            if file := next((file for file in files if file.is_file()), None):
                moved = [_move_entry(folder, *found, left_out) for found in zip(entries, names, files, strict=True)]
                return moved, (f"no photograph has its listed name; {entries[files.index(file)].name} was found as {file}",)
    return entries, ()


def _move_entry(folder: Path, entry: Entry, name: PurePosixPath, file: Path, left_out: PurePosixPath) -> Entry:
    """An entry with a shorter name and the file that was found; its mask loses the same leading folders."""
    mask = entry.mask
    if mask is not None and mask.is_relative_to(folder / left_out):
        mask = folder / mask.relative_to(folder / left_out)
    return dataclasses.replace(entry, name=str(name), file=file, mask=mask)


def _full_path(file: Path, name: str) -> str:
    """Normalised path of a photograph: ``./a.png`` and ``a.png`` are equal."""
    return os.path.normpath(file.parent.absolute() / to_forward_slashes(file.parent, name))


LONGEST_NAME = 255
"""Largest name in a folder on common file systems [byte]."""


def to_forward_slashes(folder: Path, name: str) -> str:
    """Return the name of a file with forward slashes, because data sets made on Windows name ``images\\a.png``.

    Raises:
        MivolError: a name longer than ``LONGEST_NAME``.
    """
    if any(len(part.encode(errors="replace")) > LONGEST_NAME for part in re.split(r"[\\/]", name)):
        raise refusal(folder, f"a photograph with a name of {len(name)} characters", f"at most {LONGEST_NAME}", "correct it")
    return name if "\\" not in name or (folder / name).is_file() else name.replace("\\", "/")


def _entry(file: Path, table: Mapping[str, Any], frame: Mapping[str, Any], number: int, split: str) -> Entry:
    missing = [key for key in ("file_path", "transform_matrix") if not isinstance(frame, dict) or key not in frame]
    if missing:
        raise refusal(file, f"frame {number} without {missing[0]}", "file_path and transform_matrix", "write it again")
    name = to_forward_slashes(file.parent, str(frame["file_path"]))
    settings = FrameSettings({**table, **frame}, f"{file.name} {name}")

    def camera(size: tuple[int, int]) -> Camera:
        lens = settings.lens()
        K = settings.panorama(size) if isinstance(lens, Panorama) else settings.intrinsics(size)
        return Camera(K, size, settings.matrix(), lens, settings.name)

    mask = settings.values.get("mask_path")
    if not isinstance(mask, str | None):
        raise refusal(settings.name, f"mask_path = {mask!r}", "the name of a file", "correct it")
    return Entry(
        name,
        find_image(file.parent / name),
        camera,
        split,
        settings.size(),
        file.parent / to_forward_slashes(file.parent, mask) if mask else None,
    )


@dataclass(frozen=True)
class FrameSettings:
    """The settings of a frame, completed by the settings of the file.

    Attributes:
        values: settings by key.
        name: name of the frame in refusals.
    """

    values: Mapping[str, Any]
    name: str

    def number(self, key: str, default: float = 0.0) -> float:
        """Return the number under a key, or ``default`` without the key.

        Raises:
            MivolError: another value.
        """
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise refusal(self.name, f"{key} = {value!r}", "a number", "correct it")
        return float(value)

    def size(self) -> tuple[int, int] | None:
        """Return (width, height) from ``w`` and ``h``, if present.

        Raises:
            MivolError: a number that is not whole.
        """
        if "w" not in self.values or "h" not in self.values:
            return None
        width, height = self.number("w"), self.number("h")
        if not all(n >= 1 and n == int(n) for n in (width, height)):
            raise refusal(self.name, f"w = {width}, h = {height}", "whole numbers of pixels", "correct w and h")
        return int(width), int(height)

    def intrinsics(self, size: tuple[int, int]) -> np.ndarray:
        """Return K (3, 3). ``K`` precedes focal lengths, and these precede angles; the default principal point is the centre.

        One focal length or angle serves both axes.

        Raises:
            MivolError: no focal length, angle or ``K``, or a ``K`` that is no matrix of a camera without skew.
        """
        if "K" in self.values:
            return self._matrix_of_camera()
        fx = self._focal("fl_x", "camera_angle_x", size[0])
        fy = self._focal("fl_y", "camera_angle_y", size[1])
        if fx is None and fy is None:
            raise refusal(
                self.name, "no focal length", "fl_x, fl_y, camera_angle_x, camera_angle_y or K", "add it to the file of cameras"
            )
        fx, fy = fy if fx is None else fx, fx if fy is None else fy
        return intrinsics(fx, fy, self.number("cx", size[0] / 2), self.number("cy", size[1] / 2))

    def _matrix_of_camera(self) -> np.ndarray:
        try:
            K = np.asarray(self.values["K"], np.float64)
        except (ValueError, TypeError):
            K = np.empty(0)
        expected = "3 x 3 numbers fx, 0, cx; 0, fy, cy; 0, 0, 1 of a camera without skew"
        if K.shape != (3, 3) or not np.array_equal(K, intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2])):
            raise refusal(self.name, f"K = {self.values['K']!r}", expected, "correct K")
        return K

    def panorama(self, size: tuple[int, int]) -> np.ndarray:
        """Return K (3, 3) of a panorama in pixels per radian; focal lengths in the file are ignored.

        Raises:
            MivolError: an image that is not twice as wide as high.
        """
        if size[0] != 2 * size[1]:
            raise refusal(
                self.name,
                f"a panorama of {size[0]} x {size[1]} pixels",
                "an image twice as wide as high",
                "use the uncropped image",
            )
        return panorama_intrinsics(size)

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
        """Return the lens. ``is_fisheye`` is the key of instant-ngp for OPENCV_FISHEYE.

        Raises:
            MivolError: a camera outside ``MODELS``, or a coefficient unknown to the lens.
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
        """Return ``transform_matrix`` without checks of its shape; 3 rows get the last row 0, 0, 0, 1.

        Raises:
            MivolError: entries other than numbers.
        """
        try:
            matrix = np.array(self.values["transform_matrix"], np.float64)
            return np.vstack([matrix, [0, 0, 0, 1]]) if matrix.shape == (3, 4) else matrix
        except (ValueError, TypeError) as error:
            raise refusal(
                self.name, "a transform_matrix that is not a matrix", "4 rows of 4 numbers", "correct the matrix"
            ) from error
