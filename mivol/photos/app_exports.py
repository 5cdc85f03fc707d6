"""Poses that programs export: Polycam, Record3D, 3D Scanner App (ARKit), RealityCapture and LLFF.

Conventions. The phones write ARKit's poses: camera to world with the axes of :mod:`mivol.photos.camera`, y up in the world, in
metres, of the pixels as they are stored. RealityCapture has z up. NeRFCapture writes ``transforms.json``.

Sources, looked up in programs that read them (nerfstudio, polyform, usa, brush):

* Polycam: ``keyframes/corrected_cameras/ID.json`` for ``keyframes/corrected_images/ID.jpg``, without them ``cameras`` and
  ``images``; focal lengths, principal point, size, and the rows ``t_00`` to ``t_23`` of the pose.
* Record3D: ``metadata.json`` (``metadata`` in an unpacked .r3d) with ``K`` column by column, the size ``w`` and ``h``, and
  ``poses`` (x, y, z, w of the quaternion, position), for ``rgb/N.jpg`` or ``rgbd/N.jpg``. ``perFrameIntrinsicCoeffs`` (fx, fy,
  cx, cy) of newer versions take precedence.
* 3D Scanner App: ``frame_N.json`` for ``frame_N.jpg``, with ``intrinsics`` and ``cameraPoseARFrame`` row by row.
* RealityCapture ("Internal/External camera parameters"): a row of a CSV file for each photograph, beside it or in ``images``.
  The pose is ``x``, ``y``, ``alt``, and the rotations by -``heading`` about z, ``pitch`` about x and ``roll`` about y [degree].
  ``f`` is for 36 mm film, whose length is the longer edge. ``px`` and ``py`` are from the middle, over the longer edge.
  ``k1`` to ``k4``, ``t1`` and ``t2`` are those of :class:`~mivol.photos.lens.Lens`. Columns of the lens may be missing.
* LLFF: ``poses_bounds.npy`` beside a folder ``images``. Each row holds 17 numbers: a matrix of 3 x 5, row by row, and the
  nearest and the farthest distance of visible matter along the optical axis. The columns of the matrix are the camera's axes in
  the world (down, right, backwards), its position, and height, width and focal length in pixels. Rows belong to the photographs
  in the order of their names (Mildenhall et al. 2019, Local Light Field Fusion, "Using your own poses without running COLMAP").
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mivol.files.source import read_bytes, refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.lens import Lens
from mivol.photos.listing import SHRUNK, Entry, Listing, find_image, split_numbers
from mivol.photos.photo_file import SUFFIXES

CORRECTED, PLAIN = ("corrected_cameras", "corrected_images"), ("cameras", "images")
"""Folders of cameras and images of Polycam: after and before its bundle adjustment."""

POSE_COLUMNS = ("x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns of RealityCapture beside the name, which every file has."""

FILM = 36.0
"""Longer edge of the film of RealityCapture's focal lengths [mm]."""


def is_polycam(path: Path) -> bool:
    """Whether a folder holds raw data of Polycam."""
    return _polycam_folders(path) is not None


def is_record3d(path: Path) -> bool:
    """Whether a folder holds an export of Record3D."""
    return _record3d_files(path) is not None


def is_arkit(path: Path) -> bool:
    """Whether a folder holds frames of 3D Scanner App."""
    return path.is_dir() and next(path.glob("frame_*.json"), None) is not None


def is_reality_capture(path: Path) -> bool:
    """Whether a path is, or a folder holds, a CSV file of RealityCapture's cameras."""
    return _reality_capture_file(path) is not None


def read_polycam(path: Path) -> Listing:
    """Read the raw data of Polycam.

    Raises:
        MivolError: a file that is no JSON, or lacks a number.
    """
    cameras, images = _polycam_folders(path)
    entries = []
    for file in sorted(cameras.glob("*.json"), key=lambda file: split_numbers(file.name)):
        table = _read_table(file)
        fx, fy, cx, cy, width, height = (_numbers(file, table, key, 0) for key in ("fx", "fy", "cx", "cy", "width", "height"))
        pose = [[_numbers(file, table, f"t_{row}{column}", 0) for column in range(4)] for row in range(3)]
        size = _whole_size(file, width, height)
        entries.append(_entry(images / file.stem, intrinsics(fx, fy, cx, cy), _to_world(pose), size))
    return Listing(entries)


def read_record3d(path: Path) -> Listing:
    """Read an export of Record3D.

    Raises:
        MivolError: a file that is no JSON, or numbers that are missing or too few.
    """
    file, images = _record3d_files(path)
    table = _read_table(file)
    K = _numbers(file, table, "K", 9).reshape(3, 3).T
    size = _whole_size(file, *(_numbers(file, table, key, 0) for key in ("w", "h")))
    poses = _numbers(file, table, "poses", (-1, 7))
    lenses = None
    if table.get("perFrameIntrinsicCoeffs"):
        lenses = _numbers(file, table, "perFrameIntrinsicCoeffs", (len(poses), 4))
    entries = []
    for number, row in enumerate(poses):
        if not np.linalg.norm(row[:4]) > 0:
            raise refusal(file, f"pose {number} with the quaternion {row[:4].tolist()}", "a rotation", "export it again")
        pose = np.column_stack([Rotation.from_quat(row[:4]).as_matrix(), row[4:]])
        lens = (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) if lenses is None else lenses[number]
        entries.append(_entry(images / str(number), intrinsics(*lens), _to_world(pose), size))
    return Listing(entries)


def read_arkit(path: Path) -> Listing:
    """Read the frames of 3D Scanner App.

    Raises:
        MivolError: a file that is no JSON, or numbers that are missing or too few.
    """
    entries = []
    for file in sorted(path.glob("frame_*.json"), key=lambda file: split_numbers(file.name)):
        table = _read_table(file)
        K = _numbers(file, table, "intrinsics", 9).reshape(3, 3)
        pose = _numbers(file, table, "cameraPoseARFrame", 16).reshape(4, 4)
        entries.append(_entry(path / file.stem, intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2]), pose))
    # Most frames of a scan have a pose and no photograph.
    kept = [entry for entry in entries if entry.file.is_file()]
    return Listing(kept or entries)


def read_reality_capture(path: Path) -> Listing:
    """Read a CSV file of RealityCapture's cameras.

    Raises:
        MivolError: a row without a name, or a value that is no finite number.
    """
    file = _reality_capture_file(path)
    lines = read_bytes(file).decode("utf-8-sig", errors="replace").splitlines()
    head = next(number for number, line in enumerate(lines) if _column_names(line))
    entries = []
    for row in csv.DictReader(lines[head + 1 :], _column_names(lines[head])):
        name = (row.get("name") or "").replace("\\", "/")
        if not name:
            raise refusal(
                file, f"the row {','.join(map(str, row.values()))}", "the name of a photograph first", "export it again"
            )
        entries.append(_reality_capture_entry(file, name, row))
    return Listing(entries)


def _reality_capture_file(path: Path) -> Path | None:
    """The first CSV file with RealityCapture's columns in its first or second line; the first may count the cameras."""
    files = [path] if path.suffix.lower() == ".csv" else sorted(path.glob("*.csv")) if path.is_dir() else []
    for file in files:
        with file.open(encoding="utf-8-sig", errors="replace") as lines:
            if any(_column_names(line) for _, line in zip(range(2), lines, strict=False)):
                return file
    return None


def _column_names(line: str) -> list[str]:
    """The columns of RealityCapture's file, if a line names them."""
    names = line.strip().removeprefix("#").lower().split(",")
    return names if {"name", *POSE_COLUMNS} <= set(names) else []


def _reality_capture_entry(file: Path, name: str, row: Mapping[str, str]) -> Entry:
    beside = find_image(file.parent / name)
    image = next((found for found in (find_image(file.parent / "images" / name), beside) if found.is_file()), beside)
    pose = {key: _numbers(file, row, key, 0) for key in POSE_COLUMNS}
    more = {key: _numbers(file, row, key, 0) for key in ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2") if row.get(key)}
    turn = Rotation.from_euler("ZXY", [-pose["heading"], pose["pitch"], pose["roll"]], degrees=True).as_matrix()
    to_world = _to_world(np.column_stack([turn, [pose["x"], pose["y"], pose["alt"]]]))
    terms = {"t1": "p1", "t2": "p2"}
    lens = Lens(**{terms.get(key, key): value for key, value in more.items() if key not in ("px", "py")})

    def camera(size: tuple[int, int]) -> Camera:
        edge = max(size)
        middle = (size[0] / 2 + edge * more.get("px", 0.0), size[1] / 2 + edge * more.get("py", 0.0))
        return Camera(intrinsics(*2 * [edge * pose["f"] / FILM], *middle), size, to_world, lens, f"{file.name} {name}")

    return Entry(name, image, camera)


def _polycam_folders(path: Path) -> tuple[Path, Path] | None:
    """Folders of cameras and images of Polycam, of which the corrected ones may be missing or empty."""
    for cameras, images in ((path / "keyframes" / a, path / "keyframes" / b) for a, b in (CORRECTED, PLAIN)):
        if next(cameras.glob("*.json"), None) is not None and images.is_dir():
            return cameras, images
    return None


def _record3d_files(path: Path) -> tuple[Path, Path] | None:
    file = next((path / name for name in ("metadata.json", "metadata") if (path / name).is_file()), None)
    images = next((path / name for name in ("rgb", "rgbd") if (path / name).is_dir()), None)
    return None if file is None or images is None else (file, images)


def _read_table(file: Path) -> dict[str, Any]:
    try:
        table = json.loads(read_bytes(file))
    except (ValueError, RecursionError) as error:
        raise refusal(file, f"text that is not JSON ({error})", "a camera in JSON", "export it again") from error
    if not isinstance(table, dict):
        raise refusal(file, "no table of numbers", "a camera in JSON", "export it again")
    return table


def _numbers(file: Path, table: Mapping[str, Any], key: str, count: int | tuple[int, int]) -> Any:
    """The finite number (``count`` 0), list of numbers or table of numbers under a key."""
    shape = () if count == 0 else (count,) if isinstance(count, int) else count
    try:
        found = np.asarray(table[key], np.float64)
    except KeyError:
        raise refusal(file, f"no {key}", "the numbers of a camera", "export it again") from None
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    fits = found.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, found.shape, strict=True)) and found.size
    if not fits or not np.isfinite(found).all():
        expected = " x ".join("any" if n < 0 else str(n) for n in shape) + " finite numbers" if shape else "a finite number"
        raise refusal(file, f"{key} of {found.size} values, or not of numbers", expected, "export it again")
    return found if shape else float(found)


def _whole_size(file: Path, width: float, height: float) -> tuple[int, int]:
    if not all(n >= 1 and n == int(n) for n in (width, height)):
        raise refusal(file, f"an image of {width:g} x {height:g} pixels", "whole numbers of pixels", "export it again")
    return int(width), int(height)


def _to_world(rows: Sequence | np.ndarray) -> np.ndarray:
    return np.vstack([np.asarray(rows, np.float64), [0, 0, 0, 1]])


def _entry(image: Path, K: np.ndarray, to_world: np.ndarray, size: tuple[int, int] | None = None) -> Entry:
    file = find_image(image)

    def camera(pixels: tuple[int, int]) -> Camera:
        return Camera(K, pixels, to_world, name=file.name)

    return Entry(file.name, file, camera, size=size, is_stored=True)


# -- LLFF --------------------------------------------------------------------------------------------------------------

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
