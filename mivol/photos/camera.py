"""A camera that took a photograph: which ray each point of the image is, and where in the image each point of space lies.

Conventions. **Camera to world, OpenGL and NeRF: x to the right, y up, the camera looks along -z**; a rotation and a place, no
scale. A point of the image is (x, y) in pixels from the upper left **corner**, so that the pixel of row i, column j has its
centre at (j + 1/2, i + 1/2). ``K`` is OpenCV's matrix in those coordinates, without skew; lengths are those of the world.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from mivol.files.source import refusal
from mivol.photos.lens import LARGEST_TERM, Fisheye, Lens, Panorama, distort, undistort

__all__ = ["Camera", "directions", "field_of_view", "intrinsics", "is_seen", "pixel_centres", "project", "rays"]

PIXELS_LOST = 0.1
"""How far [pixel] a matrix that is not quite a rotation may move the corner of an image."""

FLIP = np.array([1.0, -1.0, -1.0])
"""OpenCV's camera axes (y down, z forward) to ours, and back."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Lens, sensor and place of a camera.

    Attributes:
        K: (3, 3) float64 [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixel].
        size: (width, height) [pixel].
        to_world: (4, 4) float64, camera to world; its rotation is made exact.
        distortion: of the lens; a wide one has no image plane (:mod:`mivol.photos.lens`).
        name: how refusals call it.

    Raises:
        MivolError: NaN, no positive focal length or size, or a ``to_world`` that is no rotation.
    """

    K: np.ndarray
    size: tuple[int, int]
    to_world: np.ndarray
    distortion: Lens | Fisheye | Panorama = field(default_factory=Lens)
    name: str = "camera"

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _checked_intrinsics(self.K, self.size, self.name))
        object.__setattr__(self, "to_world", _checked_pose(self.to_world, self.K, self.size, self.name))
        if not (np.abs(dataclasses.astuple(self.distortion)) <= LARGEST_TERM).all():  # NaN fails every comparison
            expected = f"finite numbers of at most {LARGEST_TERM:g}"
            raise refusal(self.name, f"the distortion {self.distortion}", expected, "correct its coefficients")

    @property
    def origin(self) -> np.ndarray:
        """(3,) where it stands."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) unit direction in which it looks."""
        return -self.to_world[:3, 2]

    def resized(self, size: tuple[int, int]) -> Camera:
        """The same camera with (width, height) other pixels over the same sensor."""
        scale = np.array([size[0] / self.size[0], size[1] / self.size[1], 1.0])
        return dataclasses.replace(self, K=scale[:, None] * self.K, size=size)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """(3, 3) K of focal lengths and principal point [pixel from the upper left corner]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pixel_centres(size: tuple[int, int]) -> np.ndarray:
    """(height, width, 2) the centres (x, y) of all pixels of an image of that (width, height)."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return np.stack([x, y], axis=-1)


def directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Unit directions (..., 3) in the camera's frame of points (..., 2) of the image; the lens is traced exactly.

    Where a wide lens shows nothing (:func:`is_seen`), those at the rim of its image.

    Raises:
        MivolError: a lens that folds back (:func:`mivol.photos.lens.undistort`).
    """
    plane = _plane(camera, pixels)
    if camera.distortion.is_wide:
        return camera.distortion.direction(plane) * FLIP
    plane = undistort(camera.distortion, plane, camera.name)
    d = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) * FLIP
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def is_seen(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """(...) bool: whether points (..., 2) show a direction. The corners of a fisheye's image lie outside of its circle."""
    if not camera.distortion.is_wide:
        return np.ones(np.shape(pixels)[:-1], bool)
    return camera.distortion.sees(_plane(camera, pixels))


def field_of_view(camera: Camera) -> float:
    """The angle [degree] that the middle row of the image sees, without distortion where the lens has an image plane."""
    middle = camera.K[:2, 2]
    ends = np.array([[0.0, middle[1]], [camera.size[0], middle[1]]])
    if not camera.distortion.is_wide:
        return float(np.degrees(np.abs(np.arctan(_plane(camera, ends)[:, 0])).sum()))
    if isinstance(camera.distortion, Panorama):
        return float(np.degrees(np.abs(_plane(camera, ends)[:, 0]).sum()))
    return float(np.degrees(np.arccos(np.clip(camera.distortion.direction(_plane(camera, ends))[:, 2], -1, 1)).sum()))


def _plane(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the image in focal lengths from the principal point."""
    return (np.asarray(pixels, np.float64) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]


def rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rays that points of the image see.

    Args:
        camera: who looks.
        pixels: (..., 2) points (x, y) [pixel]; (j + 1/2, i + 1/2) is the centre of row i, column j.

    Returns:
        Origins (..., 3) [length] and unit directions (..., 3) in the world, float64.

    Raises:
        MivolError: a lens that folds back.
    """
    d = directions(camera, pixels) @ camera.to_world[:3, :3].T
    return np.broadcast_to(camera.origin, d.shape), d


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points of the world lie in the image.

    Args:
        camera: who looks.
        points: (..., 3) [length].

    Returns:
        (..., 2) points (x, y) of the image [pixel], and the depth (...) along the view [length]; behind the camera the depth
        is negative and the point of the image NaN, as it is beyond the fold of the lens. Of a wide lens the depth is the
        distance, and the point NaN where the lens does not look.
    """
    local = (np.asarray(points, np.float64) - camera.origin) @ camera.to_world[:3, :3] * FLIP
    if camera.distortion.is_wide:
        at = camera.distortion.point(local) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        return at, np.linalg.norm(local, axis=-1)
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(depth[..., None] > 0, local[..., :2] / depth[..., None], np.nan)
    if camera.distortion:
        seen = np.linalg.norm(plane, axis=-1, keepdims=True) <= camera.distortion.fold
        plane = np.where(seen, distort(camera.distortion, plane), np.nan)
    return plane * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], depth


def _checked_intrinsics(matrix: np.ndarray, size: tuple[int, int], name: str) -> np.ndarray:
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


def _checked_pose(matrix: np.ndarray, K: np.ndarray, size: tuple[int, int], name: str) -> np.ndarray:
    """The pose with the nearest rotation.

    A matrix M with |M^T M - 1| = e turns or stretches the rays by about e, which moves the image by up to e times the focal
    length and half the diagonal together: e is allowed as far as that is ``PIXELS_LOST``.
    """
    pose = np.array(matrix, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        found = f"a transform of shape {pose.shape}" if pose.shape != (4, 4) else "a transform that holds NaN or infinity"
        raise refusal(name, found, "4 x 4 finite numbers", "correct it in the file of cameras")
    if not np.array_equal(pose[3], (0, 0, 0, 1)):
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
            "take scale, shear and mirroring out of it",
        )
    pose[:3, :3] = u @ vt
    return pose
