"""The camera of a photograph: rays of image points, image points of world points, and a pose corrected by renders.

Conventions. **Camera to world as in OpenGL and NeRF: x to the right, y up, the camera looks along -z**; a rotation and a
position, no scale. An image point is (x, y) in pixels from the upper left **corner**, so the pixel of row i, column j has its
centre at (j + 1/2, i + 1/2). ``K`` is OpenCV's matrix in these coordinates, without skew. Lengths are world lengths.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mivol.files.source import refusal
from mivol.photos.lens import LARGEST_TERM, Fisheye, Lens, Panorama, distort, undistort

PIXELS_LOST = 0.1
"""Largest shift of an image corner by an inexact rotation matrix [pixel]."""

ROUNDING = 1e-5
"""Largest deviation of a transform's last row from 0, 0, 0, 1: ARKit multiplies matrices of float32, each within 1e-7."""

FLIP = np.array([1.0, -1.0, -1.0])
"""Signs that convert OpenCV's camera axes (y down, z forward) to the axes here, and back."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics, lens and pose of a camera.

    Attributes:
        K: (3, 3) float64 [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixel].
        size: (width, height) [pixel].
        to_world: (4, 4) float64, camera to world; the constructor makes the rotation exact.
        distortion: lens model; a wide lens has no image plane (:mod:`mivol.photos.lens`).
        name: subject of refusals.

    Raises:
        MivolError: NaN, a focal length or size that is not positive, or a ``to_world`` without a rotation.
    """

    K: np.ndarray
    size: tuple[int, int]
    to_world: np.ndarray
    distortion: Lens | Fisheye | Panorama = field(default_factory=Lens)
    name: str = "camera"

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _check_intrinsics(self.K, self.size, self.name))
        object.__setattr__(self, "to_world", _check_pose(self.to_world, self.K, self.size, self.name))
        if not (np.abs(dataclasses.astuple(self.distortion)) <= LARGEST_TERM).all():  # NaN fails every comparison
            expected = f"finite numbers of at most {LARGEST_TERM:g}"
            raise refusal(self.name, f"the distortion {self.distortion}", expected, "correct its coefficients")

    @property
    def origin(self) -> np.ndarray:
        """World position (3,)."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Unit direction (3,) of the optical axis in the world."""
        return -self.to_world[:3, 2]

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the camera with (width, height) pixels over the same sensor."""
        scale = np.array([size[0] / self.size[0], size[1] / self.size[1], 1.0])
        return dataclasses.replace(self, K=scale[:, None] * self.K, size=size)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return K (3, 3) from focal lengths and principal point [pixel from the upper left corner]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def panorama_intrinsics(size: tuple[float, float]) -> np.ndarray:
    """Return K (3, 3) of a panorama of (width, height) pixels, in pixels per radian."""
    return intrinsics(size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)


def pixel_centres(size: tuple[int, int]) -> np.ndarray:
    """Return the centres (height, width, 2) of the pixels of an image of (width, height) pixels."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return np.stack([x, y], axis=-1)


def move_camera(camera: Camera, turn: np.ndarray, shift: np.ndarray) -> Camera:
    """Return the camera after a small motion.

    Args:
        camera: camera before the motion.
        turn: rotation vector (3,) about the camera's position, in the axes of the world [rad].
        shift: translation (3,) in the world [length].
    """
    angle, pose = float(np.linalg.norm(turn)), camera.to_world.copy()
    x, y, z = np.asarray(turn, np.float64) / (angle or 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # Rodrigues' formula
    pose[:3, :3], pose[:3, 3] = rotation @ pose[:3, :3], pose[:3, 3] + shift
    return dataclasses.replace(camera, to_world=pose)


def directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return unit directions (..., 3) in the camera frame of image points (..., 2), traced exactly through the lens.

    Points outside the image of a wide lens (:func:`is_seen`) get the direction at the rim of the image.

    Raises:
        MivolError: a lens whose image folds back (:func:`mivol.photos.lens.undistort`).
    """
    plane = _plane(camera, pixels)
    if camera.distortion.is_wide:
        return camera.distortion.direction(plane) * FLIP
    plane = undistort(camera.distortion, plane, camera.name)
    d = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) * FLIP
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def is_seen(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return whether image points (..., 2) show a direction: the corners of a fisheye image lie outside its circle."""
    if not camera.distortion.is_wide:
        return np.ones(np.shape(pixels)[:-1], bool)
    return camera.distortion.sees(_plane(camera, pixels))


def field_of_view(camera: Camera) -> float:
    """Return the horizontal angle of view of the middle row [degree]; only wide lenses are distorted."""
    middle = camera.K[:2, 2]
    ends = np.array([[0.0, middle[1]], [camera.size[0], middle[1]]])
    if not camera.distortion.is_wide:
        return float(np.degrees(np.abs(np.arctan(_plane(camera, ends)[:, 0])).sum()))
    if isinstance(camera.distortion, Panorama):
        return float(np.degrees(np.abs(_plane(camera, ends)[:, 0]).sum()))
    return float(np.degrees(np.arccos(np.clip(camera.distortion.direction(_plane(camera, ends))[:, 2], -1, 1)).sum()))


def _plane(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Image points (..., 2) in focal lengths from the principal point."""
    return (np.asarray(pixels, np.float64) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]


def rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays of image points.

    Args:
        camera: camera of the image.
        pixels: points (..., 2) as (x, y) [pixel]; (j + 1/2, i + 1/2) is the centre of row i, column j.

    Returns:
        Origins (..., 3) [length] and unit directions (..., 3) in the world, float64.

    Raises:
        MivolError: a lens whose image folds back.
    """
    d = directions(camera, pixels) @ camera.to_world[:3, :3].T
    return np.broadcast_to(camera.origin, d.shape), d


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to the image.

    Args:
        camera: camera of the image.
        points: world points (..., 3) [length].

    Returns:
        Image points (..., 2) as (x, y) [pixel], and the depths (...) along the optical axis [length]. A point behind the
        camera has a negative depth; its image point is NaN, as for a point beyond the fold of the lens. For a wide lens the
        depth is the distance, and points outside its image are NaN.
    """
    local = (np.asarray(points, np.float64) - camera.origin) @ camera.to_world[:3, :3] * FLIP
    if camera.distortion.is_wide:
        pixels = camera.distortion.point(local) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        return pixels, np.linalg.norm(local, axis=-1)
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(depth[..., None] > 0, local[..., :2] / depth[..., None], np.nan)
    if camera.distortion:
        inside = np.linalg.norm(plane, axis=-1, keepdims=True) <= camera.distortion.fold
        plane = np.where(inside, distort(camera.distortion, plane), np.nan)
    return plane * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], depth


def _check_intrinsics(matrix: np.ndarray, size: tuple[int, int], name: str) -> np.ndarray:
    K = np.array(matrix, np.float64)
    if min(size) < 1:
        raise refusal(name, f"an image of {size[0]} x {size[1]} pixels", "at least 1 x 1", "correct w and h")
    if K.shape != (3, 3):
        raise refusal(name, f"intrinsics of shape {K.shape}", "3 x 3 numbers", "correct its intrinsics")
    if not (np.isfinite(K[[0, 1], [0, 1]]).all() and min(K[0, 0], K[1, 1]) > 0):
        found = f"focal lengths {K[0, 0]:.6g}, {K[1, 1]:.6g}"
        raise refusal(name, found, "finite numbers above 0 in pixels", "correct its intrinsics")
    if not np.isfinite(K[:2, 2]).all():
        found = f"a principal point ({K[0, 2]:.6g}, {K[1, 2]:.6g})"
        raise refusal(name, found, "finite numbers in pixels", "correct its intrinsics")
    if K[0, 1] or K[1, 0] or not np.array_equal(K[2], (0, 0, 1)):
        raise refusal(name, f"K = {K.tolist()}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", "skew is not supported")
    return K


def _check_pose(matrix: np.ndarray, K: np.ndarray, size: tuple[int, int], name: str) -> np.ndarray:
    """Return the pose with the nearest rotation.

    A matrix M with |M^T M - 1| = e rotates or stretches the rays by about e. The image then moves by up to e times the sum of
    focal length and half the diagonal. This shift is limited to ``PIXELS_LOST``.
    """
    pose = np.array(matrix, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        found = f"a transform of shape {pose.shape}" if pose.shape != (4, 4) else "a transform with NaN or infinity"
        raise refusal(name, found, "4 x 4 finite numbers", "correct it in the file of cameras")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > ROUNDING:
        raise refusal(name, f"a transform with last row {pose[3].tolist()}", "0, 0, 0, 1", "correct it in the file of cameras")
    u, _, vt = np.linalg.svd(pose[:3, :3])
    error = np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max()
    allowed = PIXELS_LOST / (K[[0, 1], [0, 1]].max() + np.hypot(*size) / 2)
    if error > allowed or np.linalg.det(u @ vt) < 0:
        kind = "mirrors" if error <= allowed else f"is off by {error:.2g}"
        raise refusal(
            name,
            f"a transform that is not a rotation: it {kind}",
            f"columns of length 1 at right angles to {allowed:.1g}, right-handed",
            "remove scale, shear and mirroring",
        )
    pose[:3, :3], pose[3] = u @ vt, (0, 0, 0, 1)
    return pose


# -- Correction of a pose ----------------------------------------------------------------------------------------------------


MOTION = 6
"""Numbers of a motion."""

ALIGNMENT_ITERATIONS = 4
"""Iterations of an alignment: seven renders each."""

DIFFERENCE = 0.5
"""Difference of a motion for derivatives [pixel]."""

DAMPING = 0.01, 0.1, 10.0
"""First damping, relative to the diagonal, and its factors after a better and a worse step."""


@dataclass(frozen=True)
class Motions:
    """Motions of some cameras, searched by least squares: six numbers each, a rotation about the camera's position and a
    translation, in the axes of the world. Each is in a unit that moves the image of the subject by about a pixel
    (:func:`motion_unit`).

    Source: Levenberg 1944, Marquardt 1963 (damped least squares); derivatives are differences of renders.

    Attributes:
        motion: (cameras, 6) [pixel].
        damping: (cameras,) of the next step, relative to the diagonal of its equations.
    """

    motion: np.ndarray
    damping: np.ndarray

    @classmethod
    def none(cls, cameras: int) -> Motions:
        """No motion yet."""
        return cls(np.zeros((cameras, MOTION)), np.full(cameras, DAMPING[0]))

    def improve(self, error: Callable[[np.ndarray], np.ndarray], expected: float = math.inf) -> Motions:
        """The motions after one damped step of each camera; a step that does not lower its error is not taken.

        Args:
            error: differences of renders and photographs (cameras, n) at motions (cameras, 6). It is called eight times, each
                time for all cameras, which share no differences.
            expected: standard deviation of each number of a motion, for a prior [pixel].
        """
        residual = error(self.motion)
        weight = (residual**2).mean(axis=1) / expected**2

        def cost(differences: np.ndarray, motion: np.ndarray) -> np.ndarray:
            return (differences**2).sum(axis=1) + weight * (motion**2).sum(axis=1)

        slopes = np.stack([(error(self.motion + DIFFERENCE * axis) - residual) / DIFFERENCE for axis in np.eye(MOTION)], axis=2)
        normal = np.einsum("cni,cnj->cij", slopes, slopes) + weight[:, None, None] * np.eye(MOTION)
        trace = np.trace(normal, axis1=1, axis2=2)
        floor = np.where(trace > 0, 1e-6 * trace, 1.0)  # a model that shows nothing to a camera does not move the camera
        diagonal = np.maximum(np.diagonal(normal, axis1=1, axis2=2), floor[:, None])
        damped = normal + (self.damping[:, None] * diagonal)[:, :, None] * np.eye(MOTION)
        gradient = np.einsum("cni,cn->ci", slopes, residual) + weight[:, None] * self.motion
        tried = self.motion - np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        is_better = cost(error(tried), tried) < cost(residual, self.motion)
        factor = np.where(is_better, DAMPING[1], DAMPING[2])
        return Motions(np.where(is_better[:, None], tried, self.motion), self.damping * factor)


def motion_unit(camera: Camera, distance: float) -> np.ndarray:
    """Rotations [rad] and translations [length] (6,) that move the image of a subject at a distance by about a pixel."""
    return np.repeat([1.0, distance], 3) / camera.K[0, 0]


def align_camera(
    render: Callable[[Camera], np.ndarray], camera: Camera, image: np.ndarray, mask: np.ndarray | None, distance: float
) -> Camera:
    """Return the camera whose render is nearest to a photograph by least squares, searched near the given pose.

    Args:
        render: view (H, W, 3) of a model from a camera.
        camera: camera of the photograph.
        image: the photograph (H, W, 3).
        mask: (H, W) bool, False for pixels that do not count; None: all pixels count.
        distance: of the subject from the camera [length].
    """
    unit = motion_unit(camera, distance)
    used = np.ones(image.shape[:2], bool) if mask is None else mask

    def moved(motion: np.ndarray) -> Camera:
        return move_camera(camera, motion[:3] * unit[:3], motion[3:] * unit[3:])

    def error(motions: np.ndarray) -> np.ndarray:
        return (render(moved(motions[0])) - image)[used].reshape(1, -1)

    found = Motions.none(1)
    for _ in range(ALIGNMENT_ITERATIONS):
        found = found.improve(error)
    return moved(found.motion[0])
