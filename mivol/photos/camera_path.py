"""Cameras for a film of what was photographed: around it, from view to view, or past places of one's own.

Conventions. Every camera of a path is a pinhole like the first of those given: its size and focal length (or WIDE degrees,
where its lens has no image plane), without distortion, its axis through the middle of the image. A turntable keeps the
photographs' mean distance and elevation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mivol.files.source import refusal
from mivol.photos.camera import Camera, intrinsics
from mivol.photos.lens import Lens

__all__ = ["interpolate_cameras", "aim_camera", "follow_keyframes", "turntable"]

ALL_ROUND = np.radians(90)
"""Cameras that leave no larger gap of azimuth than this go all the way round; others are swung between."""

WIDE = 70.0
"""Field of view [degree] of films of what wide lenses saw: that of a wide photograph, without the stretch of a wider one."""


def aim_camera(like: Camera, origin: np.ndarray, target: np.ndarray, up: np.ndarray, name: str = "camera") -> Camera:
    """A pinhole like another camera that stands at ``origin`` and looks at ``target``, with ``up`` upwards in the image.

    Raises:
        MivolError: origin and target are one point, or up is along the view.
    """
    back = np.asarray(origin, np.float64) - target
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(back) * np.linalg.norm(up):
        raise refusal(name, "a view along its own upward direction, or of its own place", "another target", "move it")
    axes = np.column_stack([right, np.cross(back, right), back])
    pose = np.eye(4)
    pose[:3, :3] = axes / np.linalg.norm(axes, axis=0)
    pose[:3, 3] = origin
    return _pinhole(like, pose, name)


def turntable(cameras: Sequence[Camera], box: np.ndarray, n: int) -> list[Camera]:
    """n cameras around the middle of a box, in equal steps; the last is followed by the first.

    The circle lies about the photographs' upward direction, at their mean distance and elevation. Where they leave a gap
    of more than 90 degrees, the cameras swing between its ends and back instead (sinusoidal, so that it can be repeated).

    Raises:
        MivolError: cameras without a common upward direction.
    """
    middle = np.mean(box, axis=0)
    up = _mean_up(cameras)
    side = np.linalg.qr(np.column_stack([up, np.eye(3)[np.argmin(np.abs(up))]]))[0][:, 1]
    ahead = np.cross(up, side)
    offsets = np.array([camera.origin for camera in cameras]) - middle
    height, along = offsets @ up, np.stack([offsets @ side, offsets @ ahead])
    radius = float(np.linalg.norm(along, axis=0).mean())
    azimuths = _azimuths(np.arctan2(along[1], along[0]), n)
    return [
        aim_camera(
            cameras[0], middle + radius * (np.cos(a) * side + np.sin(a) * ahead) + height.mean() * up, middle, up, f"turn {i}"
        )
        for i, a in enumerate(azimuths)
    ]


def interpolate_cameras(cameras: Sequence[Camera], n: int) -> list[Camera]:
    """n cameras on a smooth way from the first to the last of at least two, through all of them, in equal times.

    Raises:
        MivolError: fewer than two cameras.
    """
    if len(cameras) < 2:
        raise refusal("between", f"{len(cameras)} cameras", "at least 2", "give more views")
    times, wanted = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, n)
    turns = RotationSpline(times, Rotation.from_matrix([camera.to_world[:3, :3] for camera in cameras]))(wanted).as_matrix()
    places = CubicSpline(times, [camera.origin for camera in cameras])(wanted)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, places
    return [_pinhole(cameras[0], pose, f"step {i}") for i, pose in enumerate(poses)]


def follow_keyframes(cameras: Sequence[Camera], keyframes: Sequence[Sequence[float]], n: int) -> list[Camera]:
    """n cameras on a smooth way past places of one's own, in equal times; upwards is what is up in the photographs.

    Args:
        cameras: those of the photographs.
        keyframes: at least two; where the camera stands and what it looks at, six numbers each [length].
        n: cameras.

    Raises:
        MivolError: fewer than two keyframes, numbers that are not finite, cameras without a common upward direction, or a
            camera that stands where it looks or looks straight up or down.
    """
    keys = np.array(keyframes, np.float64).reshape(-1, 6)
    if len(keys) < 2 or not np.isfinite(keys).all():
        raise refusal("keyframes", keys.tolist(), "at least two of six finite numbers", "give places and targets")
    up, times = _mean_up(cameras), np.arange(len(keys))
    found = CubicSpline(times, keys)(np.linspace(0, len(keys) - 1, n))
    return [aim_camera(cameras[0], place[:3], place[3:], up, f"step {i}") for i, place in enumerate(found)]


def _pinhole(like: Camera, pose: np.ndarray, name: str) -> Camera:
    f = float(like.K[[0, 1], [0, 1]].max())
    if like.distortion.is_wide:
        f = like.size[0] / 2 / np.tan(np.radians(WIDE) / 2)
    return Camera(intrinsics(f, f, like.size[0] / 2, like.size[1] / 2), like.size, pose, Lens(), name)


def _mean_up(cameras: Sequence[Camera]) -> np.ndarray:
    """The unit direction at right angles to what is right in all images (least squares): up, for cameras held level.

    Where that leaves a choice (cameras one above the other), their own upward directions decide, at a weight of 1e-6.
    """
    right, up = (np.array([camera.to_world[:3, axis] for camera in cameras]) for axis in (0, 1))
    found = np.linalg.eigh(right.T @ right - 1e-6 * up.T @ up)[1][:, 0]
    heights = up @ found
    if abs(heights.mean()) < 0.1:
        raise refusal("turntable", "cameras without a common upward direction", "most of them upright", "give a path of views")
    return found * np.sign(heights.mean())


def _azimuths(seen: np.ndarray, n: int) -> np.ndarray:
    ordered = np.sort(seen)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= ALL_ROUND:
        return ordered[0] + 2 * np.pi * np.arange(n) / n
    start = ordered[(widest + 1) % len(ordered)]
    return start + (2 * np.pi - gaps[widest]) * (1 - np.cos(2 * np.pi * np.arange(n) / n)) / 2
