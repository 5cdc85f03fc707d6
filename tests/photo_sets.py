"""Small data sets of posed photographs, written as their programs write them, with the cameras known."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mivol.photos import Camera
from mivol.photos.camera_path import aim_camera


def look_at(origin: np.ndarray, target: np.ndarray = (0.0, 0.0, 0.0), up: np.ndarray = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(4, 4) camera to world with x right, y up, looking along -z."""
    back = np.asarray(origin, float) - target
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(back, right), back, origin])
    return pose


def ring(n: int, distance: float = 4.0, height: float = 1.0) -> list[np.ndarray]:
    """Poses on a circle about z, all looking at the origin."""
    angles = 2 * np.pi * np.arange(n) / n
    return [look_at(np.array([distance * np.cos(a), distance * np.sin(a), height])) for a in angles]


def orbit(name: str, count: int, height: float, like: Camera) -> dict[str, Camera]:
    """Cameras by name on a sphere of radius 3.5, all around the origin, up to a share of the height of the poles."""
    cameras = {}
    for n in range(count):
        turn, z = 2.4 * n, height * (2 * (n + 0.5) / count - 1)
        origin = 3.5 * np.array([*(np.sqrt(1 - z**2) * np.array([np.cos(turn), np.sin(turn)])), z])
        cameras[name.format(n)] = aim_camera(like, origin, np.zeros(3), np.array([0, 0, 1.0]), name.format(n))
    return cameras


def pixels(width: int, height: int, seed: int = 0, alpha: bool = True) -> np.ndarray:
    """(height, width, 4 or 3) uint8 noise."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 4 if alpha else 3), np.uint8)


def write_blender(folder: Path, train: int = 4, test: int = 2, size: tuple[int, int] = (12, 8), alpha: bool = True) -> Path:
    """A set as NeRF's: names without suffix, one angle, one file of cameras per split."""
    for split, count in {"train": train, "test": test}.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for i, pose in enumerate(ring(count)):
            seed = i if split == "train" else 100 + i
            Image.fromarray(pixels(*size, seed, alpha)).save(folder / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        table = {"camera_angle_x": 0.8, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(table))
    return folder


def edit(path: Path, change: object) -> None:
    """Change the JSON of a file in place by a function of its table."""
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


def write_transforms(folder: Path, settings: dict, size: tuple[int, int] = (12, 8), n: int = 4) -> Path:
    """A set as nerfstudio's or instant-ngp's, without alpha."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, pose in enumerate(ring(n)):
        Image.fromarray(pixels(*size, i, False)).save(folder / "images" / f"{i:04d}.png")
        frames.append({"file_path": f"images/{i:04d}.png", "transform_matrix": pose.tolist()})
    table = {"w": float(size[0]), "h": float(size[1]), **settings, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table))
    return folder


MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV")
MODEL_IDS = {model: number for number, model in enumerate((*MODELS, "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"))}
MODEL_IDS |= {"SIMPLE_FISHEYE": 14, "FISHEYE": 15, "EQUIRECTANGULAR": 17}

COLMAP_CAMERAS = {
    "SIMPLE_PINHOLE": (50.0, 31.0, 22.0),
    "PINHOLE": (50.0, 55.0, 31.0, 22.0),
    "SIMPLE_RADIAL": (50.0, 31.0, 22.0, 0.07),
    "RADIAL": (50.0, 31.0, 22.0, 0.07, -0.04),
    "OPENCV": (50.0, 55.0, 31.0, 22.0, 0.07, -0.04, 0.002, -0.003),
}


def colmap_pose(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World to camera with y down and z forward of one of our poses: quaternion (w, x, y, z) and translation."""
    turned = (pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    x, y, z, w = Rotation.from_matrix(turned).as_quat()
    return np.array([w, x, y, z]), -turned @ pose[:3, 3]


def write_colmap(
    folder: Path,
    model: str = "OPENCV",
    encoding: str = "bin",
    n: int = 4,
    points: np.ndarray | None = None,
    tracks: list[tuple[int, ...]] | None = None,
) -> Path:
    """A sparse model of n views on a ring, 64 x 48 pixels, each with two image points; image numbers run backwards.

    Points were found in the images 1 and 2, or in those of ``tracks``.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    for i in range(n):
        Image.fromarray(pixels(64, 48, i, False)).save(folder / "images" / f"a view {i}.png")
    poses = [colmap_pose(pose) for pose in ring(n)]
    points = np.zeros((0, 3)) if points is None else points
    write = {"bin": _write_colmap_bin, "txt": _write_colmap_txt}[encoding]
    write(folder / "sparse" / "0", model, poses, points, tracks or [(1, 2)] * len(points))
    return folder


def _write_colmap_bin(folder: Path, model: str, poses: list, points: np.ndarray, tracks: list) -> None:
    parameters = COLMAP_CAMERAS.get(model, (50.0, 50.0, 31.0, 22.0, 0, 0, 0, 0))
    camera = struct.pack(f"<QiiQQ{len(parameters)}d", 1, 7, MODEL_IDS[model], 64, 48, *parameters)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(poses))
    for i, (q, t) in reversed(list(enumerate(poses))):
        images += struct.pack("<I7dI", i + 1, *q, *t, 7) + f"a view {i}.png".encode() + b"\0"
        images += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(images)
    cloud = struct.pack("<Q", len(points))
    for i, (point, track) in enumerate(zip(points, tracks, strict=True)):
        cloud += struct.pack("<Q3d3BdQ", i, *point, 1, 2, 3, 0.5, len(track))
        cloud += b"".join(struct.pack("<2i", image, k) for k, image in enumerate(track))
    (folder / "points3D.bin").write_bytes(cloud)


def _write_colmap_txt(folder: Path, model: str, poses: list, points: np.ndarray, tracks: list) -> None:
    parameters = " ".join(map(repr, COLMAP_CAMERAS.get(model, (50.0, 50.0, 31.0, 22.0, 0, 0, 0, 0))))
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {model} 64 48 {parameters}\n")
    lines = ["# Image list with two lines of data per image:"]
    for i, (q, t) in reversed(list(enumerate(poses))):
        numbers = " ".join(repr(float(v)) for v in [*q, *t])
        lines += [f"{i + 1} {numbers} 7 a view {i}.png", "1.5 2.5 -1" if i % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    ends = [" ".join(f"{image} {k}" for k, image in enumerate(track)) for track in tracks]
    rows = [f"{i} {x!r} {y!r} {z!r} 1 2 3 0.5 {ends[i]}" for i, (x, y, z) in enumerate(points.tolist())]
    (folder / "points3D.txt").write_text("\n".join(["# 3D point list", *rows]) + "\n")


def png_of_16_bits(codes: np.ndarray, gamma: int | None = None) -> bytes:
    """A PNG of 16 bits a channel, (rows, columns, 3 or 4) uint16, chunk by chunk (W3C PNG, section 5); ``gamma`` x 100,000."""
    rows, columns, channels = codes.shape
    head = struct.pack(">IIBBBBB", columns, rows, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in codes)
    said = [] if gamma is None else [(b"gAMA", struct.pack(">I", gamma))]
    chunks = ((b"IHDR", head), *said, (b"IDAT", zlib.compress(lines)), (b"IEND", b""))
    packed = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)
