"""A picture of Gaussians in float64 NumPy, written to be read: no tiles, no lists, no early stop; all pixels ask all Gaussians.

It shares no code with the renderer. Which Gaussians a pixel draws (alpha >= least_alpha) and in which order can be frozen, so
that finite differences see a smooth function: the one whose derivative a renderer gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from mivol.photos.camera import Camera, pixel_centres, rays

__all__ = ["Drawn", "alphas", "colours", "draw", "moved", "peaks", "project"]


@dataclass(frozen=True)
class Drawn:
    """The decisions of a picture.

    Attributes:
        order: (n,) Gaussians in front of the near plane, nearest first.
        mask: (n, height, width) whether they are drawn in a pixel, in that order.
    """

    order: np.ndarray
    mask: np.ndarray


def moved(camera: Camera, motion: np.ndarray) -> Camera:
    """A camera turned about its place by a rotation vector in the world's axes, and shifted."""
    pose = camera.to_world.copy()
    pose[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += motion[3:]
    return Camera(camera.K, camera.size, pose)


def project(cloud: dict[str, np.ndarray], camera: Camera, low_pass: float, compensated: bool = False) -> tuple[np.ndarray, ...]:
    """Depths (N,), centres (N, 2), inverse covariances (N, 2, 2) and opacities (N,) in the image."""
    local = (cloud["means"] - camera.origin) @ camera.to_world[:3, :3] * [1, -1, -1]
    z = local[:, 2]
    focal, centre = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = local[:, :2] / z[:, None]
    size = np.array(camera.size)
    beyond = 0.3 * size / 2 / focal
    bent = np.clip(plane, -centre / focal - beyond, (size - centre) / focal + beyond)
    q = cloud["quaternions"] / np.linalg.norm(cloud["quaternions"], axis=1, keepdims=True)
    turn = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    axes = turn * np.exp(cloud["log_scales"])[:, None, :]
    sigma = axes @ axes.transpose(0, 2, 1)
    to_camera = np.diag([1.0, -1.0, -1.0]) @ camera.to_world[:3, :3].T
    jacobian = np.zeros((len(z), 2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / z, focal[1] / z
        jacobian[:, :, 2] = -focal * bent / z[:, None]
    a = jacobian @ to_camera
    sharp = a @ sigma @ a.transpose(0, 2, 1)
    covariance = sharp + low_pass * np.eye(2)
    opacity = expit(cloud["opacity_logits"])
    if compensated:
        opacity = opacity * np.sqrt(np.linalg.det(sharp) / np.linalg.det(covariance))
    return z, plane * focal + centre, np.linalg.inv(covariance), opacity


def alphas(cloud: dict[str, np.ndarray], camera: Camera, low_pass: float, compensated: bool = False) -> np.ndarray:
    """(N, height, width) alpha of each Gaussian at the centre of each pixel."""
    width, height = camera.size
    _, centre, inverse, opacity = project(cloud, camera, low_pass, compensated)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    d = np.stack([x - centre[:, 0, None, None], y - centre[:, 1, None, None]], axis=-1)
    q = np.einsum("nhwi,nij,nhwj->nhw", d, inverse, d)
    return opacity[:, None, None] * np.exp(-0.5 * q)


def peaks(cloud: dict[str, np.ndarray], camera: Camera) -> np.ndarray:
    """(N, height, width) alpha by ray tracing: the largest value of each Gaussian along the ray through a pixel's centre."""
    o, d = rays(camera, pixel_centres(camera.size))
    found = []
    for n, mean in enumerate(cloud["means"]):
        turn = Rotation.from_quat(cloud["quaternions"][n, [1, 2, 3, 0]]).as_matrix()
        scale = np.exp(cloud["log_scales"][n])
        start, way = (o - mean) @ turn / scale, d @ turn / scale
        nearest = start - (np.sum(start * way, -1) / np.sum(way * way, -1))[..., None] * way
        found.append(expit(cloud["opacity_logits"][n]) * np.exp(-0.5 * np.sum(nearest**2, -1)))
    return np.array(found)


def colours(cloud: dict[str, np.ndarray], camera: Camera) -> np.ndarray:
    """(N, 3) as the camera sees them, from harmonics up to degree 3."""
    d = cloud["means"] - camera.origin
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T
    pi = np.pi
    basis = [np.full_like(x, np.sqrt(1 / (4 * pi)))]
    basis += [s * np.sqrt(3 / (4 * pi)) * v for s, v in ((-1, y), (1, z), (-1, x))]
    basis += [np.sqrt(15 / (4 * pi)) * x * y, -np.sqrt(15 / (4 * pi)) * y * z, np.sqrt(5 / (16 * pi)) * (3 * z * z - 1)]
    basis += [-np.sqrt(15 / (4 * pi)) * x * z, np.sqrt(15 / (16 * pi)) * (x * x - y * y)]
    basis += [-np.sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y), np.sqrt(105 / (4 * pi)) * x * y * z]
    basis += [-np.sqrt(21 / (32 * pi)) * y * (5 * z * z - 1), np.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3)]
    basis += [-np.sqrt(21 / (32 * pi)) * x * (5 * z * z - 1), np.sqrt(105 / (16 * pi)) * z * (x * x - y * y)]
    basis += [-np.sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y)]
    count = cloud["harmonics"].shape[1]
    return np.maximum(0.5 + np.einsum("bn,nbc->nc", np.array(basis[:count]), cloud["harmonics"]), 0)


def draw(
    cloud: dict[str, np.ndarray],
    camera: Camera,
    low_pass: float = 0.3,
    near: float = 0.01,
    least_alpha: float = 1 / 255,
    compensated: bool = False,
    frozen: Drawn | None = None,
) -> tuple[np.ndarray, Drawn]:
    """The picture (height, width, 5): rgb, depth (both multiplied by alpha) and alpha; and its decisions."""
    cloud = {name: np.asarray(value, float) for name, value in cloud.items()}
    z = project(cloud, camera, low_pass)[0]
    a, colour = alphas(cloud, camera, low_pass, compensated), colours(cloud, camera)
    if frozen is None:
        order = np.argsort(np.where(z > near, z, np.inf), kind="stable")[: np.count_nonzero(z > near)]
        frozen = Drawn(order, a[order] >= least_alpha)
    picture = np.zeros((*a.shape[1:], 5))
    clear = np.ones(a.shape[1:])
    for n, mask in zip(frozen.order, frozen.mask, strict=True):
        weight = clear * np.where(mask, a[n], 0)
        picture += weight[..., None] * np.array([*colour[n], z[n], 1])
        clear = clear - weight
    return picture, frozen
