"""Sparse reconstructions of COLMAP: cameras, images and points, in binary and in text.

Own parser: pycolmap takes 135 MB. COLMAP stores world to camera, x_c = R(q) x + t, with the quaternion (w, x, y, z) and
OpenCV's axes (y down, z forward). COLMAP counts pixels from the upper left corner, as mivol does. Coefficients missing in a
camera model are 0. Rigs (``rigs.bin`` and ``frames.bin`` of COLMAP 3.12 and later) are not read, because the file of images has
the pose of each image in the world.

Source: the file formats in COLMAP's documentation ("Output Format") and the parameters of its camera models.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files.source import parse_reals, read_bytes, refusal
from mivol.photos.camera import FLIP, Camera, intrinsics, panorama_intrinsics
from mivol.photos.lens import Fisheye, Lens, Panorama
from mivol.photos.listing import SHRUNK, Entry, Listing, check_points, find_image, list_photographs, name_first

MODEL_NUMBERS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION"),
    *("DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)

#: name -> names of the parameters, in the order of the file.
CAMERA_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EQUIRECTANGULAR": ("w", "h"),
}


@dataclass(frozen=True)
class Sensor:
    """A camera of COLMAP: (width, height), K and lens."""

    size: tuple[int, int]
    K: np.ndarray
    lens: Lens | Fisheye | Panorama


@dataclass(frozen=True)
class Pose:
    """An image of COLMAP: name, id of the camera, camera to world in mivol's axes, and id of the image."""

    name: str
    camera: int
    to_world: np.ndarray
    number: int


@dataclass(frozen=True)
class Points:
    """The points of COLMAP.

    Attributes:
        rows: (N, 6) world positions [length] and colours in 0..255.
        tracks: ids of the images of each point, N arrays.
    """

    rows: np.ndarray
    tracks: list[np.ndarray]

    def by_image(self) -> dict[int, np.ndarray]:
        """Return a table from the id of an image to the positions (K, 3) of its points."""
        images = np.concatenate([np.zeros(0, int), *self.tracks])
        positions = self.rows[np.repeat(np.arange(len(self.tracks)), [len(track) for track in self.tracks]), :3]
        order = np.argsort(images, kind="stable")
        ids, starts = np.unique(images[order], return_index=True)
        parts = np.split(positions[order], starts[1:]) if len(ids) else []
        return dict(zip(ids.tolist(), parts, strict=True))


def find_model(path: Path) -> Path | None:
    """Return the folder with cameras and images: ``path``, or its ``sparse/0``, ``sparse`` or ``colmap/sparse/0``."""
    for folder in (path, path / "sparse/0", path / "sparse", path / "colmap/sparse/0"):
        if any((folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file() for suffix in READERS):
            return folder
    return None


def read_colmap(path: Path) -> Listing:
    """Read a sparse model with photographs in ``images/`` beside ``sparse/``, or beside ``sparse/`` itself.

    Returns:
        Photographs sorted by name, the points of the model, and a note on photographs without a pose.

    Raises:
        MivolError: a camera model outside ``CAMERA_MODELS``, a truncated file, invalid numbers, an unknown camera, or a point
            without a finite position.
    """
    model = find_model(path)
    suffix = next(s for s in READERS if (model / f"cameras{s}").is_file() and (model / f"images{s}").is_file())
    read = READERS[suffix]
    sensors, poses = read.cameras(model / f"cameras{suffix}"), read.images(model / f"images{suffix}")
    points_file = model / f"points3D{suffix}"
    points = read.points(points_file) if points_file.is_file() else None
    if points is not None:
        check_points(points.rows, points_file, "export the model again")
    visible = {} if points is None else points.by_image()
    folders = ["images", *(f"images_{k}" for k in SHRUNK[1:])]
    bases = (folder for folder in (path, *model.parents[:2]) if any((folder / name).is_dir() for name in folders))
    base = next(bases, None)
    if base is not None:
        photographs = base / "images"
    else:
        photographs = model.parent.parent if path == model and model.parent.name == "sparse" else path
    file = model / f"images{suffix}"
    entries = [
        _entry(photographs, pose, sensors, file, visible.get(pose.number)) for pose in sorted(poses, key=lambda pose: pose.name)
    ]
    notes = _note_unposed(photographs, model, {pose.name for pose in poses}, suffix)
    return Listing(entries, None if points is None else points.rows[:, :3], notes=notes)


def _note_unposed(folder: Path, model: Path, posed: set[str], suffix: str) -> tuple[str, ...]:
    """A sentence on the photographs of a folder without a pose in the model, and on larger models beside it."""
    names = list_photographs(folder.parent if folder.name == "images" else folder)[1]
    unposed = sorted(set(names) - posed)
    if not unposed:
        return ()
    counted = f"{len(posed)} of {len(posed) + len(unposed)} photographs have a pose in {model}"
    note = f"{counted}; without a pose: {name_first(unposed)}"
    others = {other: _count_poses(other / f"images{suffix}") for other in model.parent.iterdir() if other.name.isdecimal()}
    largest = max(others, key=others.get, default=model)
    if others.get(largest, 0) > len(posed):
        note += f"; {largest} has poses of {others[largest]} photographs: name that folder"
    elif len(posed) < len(unposed):
        note += f"; without {model}, mivol poses searches again"
    return (note,)


def _count_poses(file: Path) -> int:
    """Number of photographs of a model; 0 without a file."""
    return len(READERS[file.suffix].images(file)) if file.is_file() else 0


def read_points3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points of ``points3D.bin`` or ``points3D.txt``.

    Returns:
        World positions (N, 3) [length] and colours (N, 3) in 0..255.

    Raises:
        MivolError: another suffix, a truncated file, or invalid numbers.
    """
    if path.suffix not in READERS:
        raise refusal(path, f"the suffix {path.suffix!r}", f"one of {', '.join(READERS)}", "name COLMAP's points3D")
    rows = READERS[path.suffix].points(path).rows
    return rows[:, :3], rows[:, 3:]


def quaternion_to_matrix(q: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion (w, x, y, z); a quaternion of length l gives l^2 times a rotation."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _entry(folder: Path, pose: Pose, sensors: dict[int, Sensor], file: Path, points: np.ndarray | None) -> Entry:
    if pose.camera not in sensors:
        raise refusal(file, f"camera {pose.camera} of {pose.name}", "a camera of the model", "export the model again")
    sensor = sensors[pose.camera]

    def camera(size: tuple[int, int]) -> Camera:
        return Camera(sensor.K, size, pose.to_world, sensor.lens, f"{file.name} {pose.name}")

    # COLMAP ignores the orientation of EXIF (pycolmap 4.2.1).
    return Entry(pose.name, find_image(folder / pose.name), camera, "train", sensor.size, points=points, is_stored=True)


def _sensor(path: Path, model: str, size: tuple[int, int], parameters: tuple[float, ...]) -> Sensor:
    named = dict(zip(_parameter_names(path, model), parameters, strict=True))
    if model == "EQUIRECTANGULAR":
        return Sensor(size, panorama_intrinsics((named["w"], named["h"])), Panorama())
    fx, fy = named.get("fx", named.get("f")), named.get("fy", named.get("f"))
    kind = Fisheye if model.endswith("FISHEYE") else Lens
    lens = kind(**{key: value for key, value in named.items() if key in kind.__dataclass_fields__})
    return Sensor(size, intrinsics(fx, fy, named["cx"], named["cy"]), lens)


def _parameter_names(path: Path, model: str) -> tuple[str, ...]:
    if model not in CAMERA_MODELS:
        raise refusal(
            path, f"the camera model {model}", f"one of {', '.join(CAMERA_MODELS)}", "undistort with colmap image_undistorter"
        )
    return CAMERA_MODELS[model]


def _to_world(q: np.ndarray, t: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(np.asarray(q)).T * FLIP
    pose[:3, 3] = -quaternion_to_matrix(np.asarray(q)).T @ t
    return pose


# -- Binary -------------------------------------------------------------------------------------------------------


class Fields:
    """Sequential reader of little-endian fields of a file."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, form: str) -> tuple[Any, ...]:
        """Return the next fields in a format of :mod:`struct`.

        Raises:
            MivolError: the file ends too early.
        """
        form = f"<{form}"
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self.data, self.at - struct.calcsize(form))

    def skip(self, count: int) -> None:
        """Skip ``count`` bytes.

        Raises:
            MivolError: the file ends too early.
        """
        self.at += count
        if self.at > len(self.data):
            raise refusal(self.path, f"{len(self.data)} bytes", f"at least {self.at}", "the file is truncated: copy it again")

    def word(self) -> str:
        """Return the text up to the next NUL.

        Raises:
            MivolError: no NUL follows.
        """
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise refusal(self.path, "a name without an end", "a complete file", "the file is truncated: copy it again")
        start, self.at = self.at, end + 1
        return self.data[start:end].decode("utf-8", errors="replace")


def _cameras_bin(path: Path) -> dict[int, Sensor]:
    fields, sensors = Fields(path), {}
    for _ in range(fields.take("Q")[0]):
        number, model, width, height = fields.take("iiQQ")
        name = MODEL_NUMBERS[model] if 0 <= model < len(MODEL_NUMBERS) else f"number {model}"
        sensors[number] = _sensor(path, name, (width, height), fields.take(f"{len(_parameter_names(path, name))}d"))
    return sensors


def _images_bin(path: Path) -> list[Pose]:
    fields, poses = Fields(path), []
    for _ in range(fields.take("Q")[0]):
        number, *pose, camera = fields.take("I7dI")
        poses.append(Pose(fields.word(), camera, _to_world(pose[:4], pose[4:]), number))
        fields.skip(24 * fields.take("Q")[0])
    return poses


def _points_bin(path: Path) -> Points:
    fields, rows, tracks = Fields(path), [], []
    for _ in range(fields.take("Q")[0]):
        rows.append(fields.take("Q3d3Bd")[1:7])
        length = fields.take("Q")[0]
        fields.skip(8 * length)
        tracks.append(np.frombuffer(fields.data, "<u4", 2 * length, fields.at - 8 * length)[::2].astype(int))
    return Points(np.array(rows).reshape(-1, 6), tracks)


# -- Text ---------------------------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[str]:
    """Lines without comments. Empty lines stay, because an image without points has an empty line."""
    text = read_bytes(path).decode("utf-8", errors="replace")
    return (line.strip() for line in text.splitlines() if not line.lstrip().startswith("#"))


def _cameras_txt(path: Path) -> dict[int, Sensor]:
    sensors = {}
    for line in filter(None, _lines(path)):
        number, model, *rest = [*line.split(maxsplit=2), "", ""][:3]
        values = parse_reals(rest[0], 2 + len(_parameter_names(path, model)), path, f"camera {number}")
        if not np.isfinite(values[:2]).all():
            raise refusal(path, f"an image of {values[0]:g} x {values[1]:g} pixels", "finite numbers", "export the model again")
        sensors[_parse_id(number, path)] = _sensor(path, model, (int(values[0]), int(values[1])), tuple(values[2:]))
    return sensors


def _images_txt(path: Path) -> list[Pose]:
    poses, lines = [], _lines(path)
    for line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise refusal(path, f"the line '{line}'", "id, quaternion, translation, camera, name", "export it again")
        pose = parse_reals(" ".join(words[1:8]), 7, path, words[9])
        poses.append(Pose(words[9], _parse_id(words[8], path), _to_world(pose[:4], pose[4:]), _parse_id(words[0], path)))
        next(lines, None)
    return poses


def _points_txt(path: Path) -> Points:
    """Points of a text file. An empty file is valid: COLMAP's manual asks for it with known poses."""
    if path.stat().st_size == 0:
        return Points(np.empty((0, 6)), [])
    rows, tracks = [], []
    for line in filter(None, _lines(path)):
        words = line.split()
        rows.append(parse_reals(" ".join(words[1:7]), 6, path, f"point {words[0]}"))
        tracks.append(np.array([_parse_id(word, path) for word in words[8::2]], int))
    return Points(np.array(rows).reshape(-1, 6), tracks)


def _parse_id(word: str, path: Path) -> int:
    if not word.isdecimal() or len(word) > 18:  # Python rejects integers of thousands of digits
        raise refusal(path, f"the number '{word}'", "a whole number", "export the model again")
    return int(word)


@dataclass(frozen=True)
class Reader:
    """The readers of an encoding of models."""

    cameras: Callable[[Path], dict[int, Sensor]]
    images: Callable[[Path], list[Pose]]
    points: Callable[[Path], Points]


#: suffix -> reader; binary first, as COLMAP does.
READERS = {".bin": Reader(_cameras_bin, _images_bin, _points_bin), ".txt": Reader(_cameras_txt, _images_txt, _points_txt)}
