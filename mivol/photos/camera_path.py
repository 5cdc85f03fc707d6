"""Camera paths for films of a photographed subject (around it, from view to view, through keyframes), and its first view.

Conventions. Every camera of a path is a pinhole with the size and focal length of the first given camera (for a turntable, the
first of the most common size; a field of view of ``WIDE`` degrees for a wide lens), without distortion, and with the optical
axis through the image centre.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos.camera import Camera, field_of_view, intrinsics
from mivol.photos.lens import Lens
from mivol.photos.region import find_subject

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
    """Return n cameras around what a box holds (:func:`mivol.photos.region.find_subject`), in equal steps on a closed path.

    The circle is centred on the upward direction of the photographs, at their mean distance and elevation. If the photographs
    leave an azimuth gap of more than 90 degrees, the path swings sinusoidally between the ends of the gap instead.

    Raises:
        MivolError: cameras without a common upward direction.
    """
    middle = find_subject(cameras, box)
    up = _mean_up(cameras)
    side = np.linalg.qr(np.column_stack([up, np.eye(3)[np.argmin(np.abs(up))]]))[0][:, 1]
    front = np.cross(up, side)
    offsets = np.array([camera.origin for camera in cameras]) - middle
    height, across = offsets @ up, np.stack([offsets @ side, offsets @ front])
    radius = float(np.linalg.norm(across, axis=0).mean())
    azimuths = _azimuths(np.arctan2(across[1], across[0]), n)
    sizes = Counter(camera.size for camera in cameras)
    like = next(camera for camera in cameras if camera.size == sizes.most_common(1)[0][0])
    return [
        aim_camera(like, middle + radius * (np.cos(a) * side + np.sin(a) * front) + height.mean() * up, middle, up, f"turn {i}")
        for i, a in enumerate(azimuths)
    ]


def interpolate_cameras(cameras: Sequence[Camera], n: int) -> list[Camera]:
    """Return n cameras on a smooth path through the given cameras, at equal time steps.

    Raises:
        MivolError: fewer than two cameras.
    """
    if len(cameras) < 2:
        raise refusal("a path between views", f"{len(cameras)} cameras", "at least 2", "give more views")
    from scipy.interpolate import CubicSpline  # a second of import, which only paths need
    from scipy.spatial.transform import Rotation, RotationSpline

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
    from scipy.interpolate import CubicSpline

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


# -- First view ------------------------------------------------------------------------------------------------------------


HOME_NUMBERS = 12
"""Numbers of a first view."""


@dataclass(frozen=True)
class HomeView:
    """The first view of a model fitted to photographs: upright, from the place of a photograph, along its view.

    Attributes:
        up: upward direction (3,) of the photographs.
        origin: position (3,) of the camera [length].
        target: point (3,) in the image centre [length].
        fov: horizontal field of view [degree].
        size: (width, height) [pixel].
    """

    up: tuple[float, ...]
    origin: tuple[float, ...]
    target: tuple[float, ...]
    fov: float
    size: tuple[int, int]

    @property
    def numbers(self) -> tuple[float, ...]:
        """The ``HOME_NUMBERS`` numbers of a file: up, origin, target, field of view, width and height."""
        return (*self.up, *self.origin, *self.target, self.fov, *map(float, self.size))

    @staticmethod
    def from_numbers(numbers: Sequence[float], name: object) -> HomeView:
        """Make a view from the numbers of a file.

        Raises:
            MivolError: another count, or numbers of no camera; ``name`` is the subject.
        """
        values = np.asarray(numbers, np.float64)
        is_valid = values.shape == (HOME_NUMBERS,) and np.isfinite(values).all()
        if not is_valid or not 0 < values[9] < 180 or not (values[10:] >= 1).all():
            found, expected = f"a first view of {values.tolist()}", f"{HOME_NUMBERS} numbers: up, origin, target, fov, size"
            raise refusal(name, found, expected, "write the file again")
        up, origin, target = (tuple(row) for row in values[:9].reshape(3, 3).tolist())
        return HomeView(up, origin, target, float(values[9]), (int(values[10]), int(values[11])))

    def scaled(self, longest: int) -> tuple[int, int]:
        """(width, height) with another longest edge [pixel]."""
        width, height = (max(1, round(n * longest / max(self.size))) for n in self.size)
        return width, height


def find_home_view(cameras: Sequence[Camera], box: np.ndarray) -> HomeView:
    """Return the view of the photograph that aims best at what a box (2, 3) holds [length], as :func:`turntable` does.

    Up is the common upward direction of the photographs, or the photograph's own without a common direction.
    """
    middle = find_subject(cameras, box)
    aims = [float((middle - c.origin) @ c.forward / max(np.linalg.norm(middle - c.origin), 1e-30)) for c in cameras]
    best = cameras[int(np.argmax(aims))]
    try:
        up = _mean_up(cameras)
    except MivolError:
        up = best.to_world[:3, 1]
    along = float((middle - best.origin) @ best.forward)
    reach = along if along > 0 else float(np.linalg.norm(box[1] - box[0]))
    fov = min(field_of_view(best), WIDE) if best.distortion.is_wide else field_of_view(best)
    target = best.origin + reach * best.forward
    return HomeView(tuple(up.tolist()), tuple(best.origin.tolist()), tuple(target.tolist()), fov, best.size)
