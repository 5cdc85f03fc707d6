"""Small data sets of posed photographs, written as their programs write them, with the cameras known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image


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


def pixels(width: int, height: int, seed: int = 0, alpha: bool = True) -> np.ndarray:
    """(height, width, 4 or 3) uint8 noise."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 4 if alpha else 3), np.uint8)


def write_blender(folder: Path, train: int = 4, test: int = 2, size: tuple[int, int] = (12, 8), alpha: bool = True) -> Path:
    """A set as NeRF's: names without suffix, one angle, one file of cameras per split."""
    for split, count in {"train": train, "test": test}.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for i, pose in enumerate(ring(count)):
            Image.fromarray(pixels(*size, i, alpha)).save(folder / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        table = {"camera_angle_x": 0.8, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(table))
    return folder


def edit(path: Path, change: object) -> None:
    """Change the JSON of a file in place by a function of its table."""
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
