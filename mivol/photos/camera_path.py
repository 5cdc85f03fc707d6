"""Camera paths for films of a photographed subject: around it, from view to view, or through keyframes.

Conventions. Every camera of a path is a pinhole with the size and focal length of the first given camera (a field of view of
``WIDE`` degrees for a wide lens), without distortion, and with the optical axis through the image centre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mivol.files.source import refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.lens import Lens

ALL_ROUND = np.radians(90)
"""Largest azimuth gap [radian] between cameras of a full circle; a larger gap makes the path swing between its ends."""

WIDE = 70.0
"""Field of view of films of wide lenses [degree]: a larger one would stretch the border of the image."""


def aim_camera(like: Camera, origin: np.ndarray, target: np.ndarray, up: np.ndarray, name: str = "camera") -> Camera:
    """Return a pinhole at ``origin`` looking at ``target``, with ``up`` upwards in the image.

    Args:
        like: camera with the size and the focal length of the pinhole.
        origin: position (3,) [length].
        target: point (3,) in the image centre [length].
        up: upward direction (3,).
        name: subject of the refusal.

    Raises:
        MivolError: equal origin and target, or an upward direction along the view.
    """
    back = np.asarray(origin, np.float64) - target
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(back) * np.linalg.norm(up):
        raise refusal(name, "a view along the upward direction, or a target at the camera", "another target", "move the target")
    axes = np.column_stack([right, np.cross(back, right), back])
    pose = np.eye(4)
    pose[:3, :3] = axes / np.linalg.norm(axes, axis=0)
    pose[:3, 3] = origin
    return _pinhole(like, pose, name)


def turntable(cameras: Sequence[Camera], box: np.ndarray, n: int) -> list[Camera]:
    """Return n cameras around the centre of a box, in equal steps on a closed path.

    The circle is centred on the upward direction of the photographs, at their mean distance and elevation. If the photographs
    leave an azimuth gap of more than 90 degrees, the path swings sinusoidally between the ends of the gap instead.

    Raises:
        MivolError: cameras without a common upward direction.
    """
    middle = np.mean(box, axis=0)
    up = _mean_up(cameras)
    side = np.linalg.qr(np.column_stack([up, np.eye(3)[np.argmin(np.abs(up))]]))[0][:, 1]
    front = np.cross(up, side)
    offsets = np.array([camera.origin for camera in cameras]) - middle
    height, across = offsets @ up, np.stack([offsets @ side, offsets @ front])
    radius = float(np.linalg.norm(across, axis=0).mean())
    azimuths = _azimuths(np.arctan2(across[1], across[0]), n)
    return [
        aim_camera(
            cameras[0], middle + radius * (np.cos(a) * side + np.sin(a) * front) + height.mean() * up, middle, up, f"turn {i}"
        )
        for i, a in enumerate(azimuths)
    ]


def interpolate_cameras(cameras: Sequence[Camera], n: int) -> list[Camera]:
    """Return n cameras on a smooth path through the given cameras, at equal time steps.

    Raises:
        MivolError: fewer than two cameras.
    """
    if len(cameras) < 2:
        raise refusal("a path between views", f"{len(cameras)} cameras", "at least 2", "give more views")
    keys, times = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, n)
    rotations = RotationSpline(keys, Rotation.from_matrix([c.to_world[:3, :3] for c in cameras]))(times).as_matrix()
    positions = CubicSpline(keys, [camera.origin for camera in cameras])(times)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return [_pinhole(cameras[0], pose, f"step {i}") for i, pose in enumerate(poses)]


def follow_keyframes(cameras: Sequence[Camera], keyframes: Sequence[Sequence[float]], n: int) -> list[Camera]:
    """Return n cameras on a smooth path through keyframes, at equal time steps, upright as the photographs.

    Args:
        cameras: cameras of the photographs.
        keyframes: at least two rows of six numbers: position and target [length].
        n: number of cameras.

    Raises:
        MivolError: fewer than two keyframes, numbers that are not finite, photographs without a common upward direction, or a
            camera looking at its own position or straight up or down.
    """
    keys = np.array(keyframes, np.float64).reshape(-1, 6)
    if len(keys) < 2 or not np.isfinite(keys).all():
        raise refusal("keyframes", keys.tolist(), "at least two of six finite numbers", "give positions and targets")
    up = _mean_up(cameras)
    rows = CubicSpline(np.arange(len(keys)), keys)(np.linspace(0, len(keys) - 1, n))
    return [aim_camera(cameras[0], row[:3], row[3:], up, f"step {i}") for i, row in enumerate(rows)]


def _pinhole(like: Camera, pose: np.ndarray, name: str) -> Camera:
    f = float(like.K[[0, 1], [0, 1]].max())
    if like.distortion.is_wide:
        f = like.size[0] / 2 / np.tan(np.radians(WIDE) / 2)
    return Camera(intrinsics(f, f, like.size[0] / 2, like.size[1] / 2), like.size, pose, Lens(), name)


def _mean_up(cameras: Sequence[Camera]) -> np.ndarray:
    """The common upward direction: perpendicular to the horizontal image axes in the least-squares sense.

    If several directions fit (cameras above each other), the vertical image axes decide, with a weight of 1e-6.
    """
    right, up = (np.array([camera.to_world[:3, axis] for camera in cameras]) for axis in (0, 1))
    direction = np.linalg.eigh(right.T @ right - 1e-6 * up.T @ up)[1][:, 0]
    heights = up @ direction
    if abs(heights.mean()) < 0.1:
        raise refusal("turntable", "cameras without a common upward direction", "upright cameras", "choose a path of views")
    return direction * np.sign(heights.mean())


def _azimuths(photographed: np.ndarray, n: int) -> np.ndarray:
    ordered = np.sort(photographed)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= ALL_ROUND:
        return ordered[0] + 2 * np.pi * np.arange(n) / n
    start = ordered[(widest + 1) % len(ordered)]
    return start + (2 * np.pi - gaps[widest]) * (1 - np.cos(2 * np.pi * np.arange(n) / n)) / 2
