"""Clouds of Gaussians for tests, and a camera that looks at them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mivol.photos.camera import Camera, intrinsics

__all__ = ["cloud", "looking", "tensors"]


def cloud(n: int, degree: int, scale: float, seed: int = 0) -> dict[str, np.ndarray]:
    """n Gaussians of about that scale in the unit cube around the origin; float32."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.5, 0.5, (n, 3)).astype(np.float32),
        "log_scales": np.log(rng.uniform(0.5, 1.5, (n, 3)) * scale).astype(np.float32),
        "quaternions": rng.normal(size=(n, 4)).astype(np.float32),
        "opacity_logits": rng.normal(size=n).astype(np.float32),
        "harmonics": (0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3))).astype(np.float32),
    }


def tensors(arrays: dict[str, np.ndarray]) -> dict[str, mi.TensorXf]:
    """As the splatter takes them."""
    return {name: mi.TensorXf(value) for name, value in arrays.items()}


def looking(width: int, height: int, distance: float = 1.8, focal: float = 0.9) -> Camera:
    """A camera at a distance from the origin that looks at it, turned so that none of its axes is the world's."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, -0.15, 0.2]).as_matrix()
    pose[:3, 3] = distance * pose[:3, 2]
    K = intrinsics(focal * width, focal * width, 0.48 * width, 0.51 * height)
    return Camera(K, (width, height), pose)
