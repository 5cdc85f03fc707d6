"""Renders of Gaussians in a scene, and the rays that saw them, for twins in float64."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.special import logit

from mivol.photos.camera import Camera, intrinsics
from mivol.points.gaussians import Gaussians
from mivol.transport.path.film import CameraRays, RenderSamples, film_passes

SIDE = 12
"""Of the pictures [pixels]."""


def cloud(count: int, seed: int = 0, degree: int = 2) -> Gaussians:
    """Flat and long, faint and nearly opaque ones; some channels are black."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-0.5, 0.5, (count, 3)),
        log_scales=np.log(rng.uniform(0.08, 0.3, (count, 3))),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=logit(rng.uniform(0.2, 0.95, count)),
        harmonics=0.6 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def tensors_of(gaussians: Gaussians, names: tuple[str, ...], **more: object) -> dict:
    """A plugin of Gaussians from its arrays of these names."""
    return {"type": "mivol_gaussians", **{name: mi.TensorXf(getattr(gaussians, name)) for name in names}, **more}


def boxed(medium: dict, sensor: dict | None = None, **more: object) -> mi.Scene:
    """A cube of edge 4 that holds the medium, before a camera whose box filter sees the middles of pixels at one sample."""
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0.4, 0.3, 5.0], [0, 0, 0], [0, 1, 0])
    camera = sensor or {"type": "perspective", "fov": 25.0}
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": {"type": "null"}, "interior": medium}
    parts = {"cloud": cube, "sensor": {"to_world": place, **camera, "film": film, "sampler": {"type": "independent"}}}
    return mi.load_dict({"type": "scene", **parts, **more})


def pinhole(side: int, focal: float, distance: float) -> tuple[Camera, np.ndarray, np.ndarray]:
    """A camera on the z axis that looks down, and the rays (o, d) through the middles of its pixels."""
    pose = np.eye(4)
    pose[2, 3] = distance
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) + 0.5 - side / 2) / focal
    d = np.column_stack([grid[:, 0], -grid[:, 1], -np.ones(len(grid))])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    camera = Camera(intrinsics(focal, focal, side / 2, side / 2), (side, side), pose)
    return camera, np.broadcast_to(pose[:3, 3], d.shape), d


def render(found: mi.Scene, depth: int = 1, spp: int = 1, seed: int = 0, **more: object) -> np.ndarray:
    """The picture in float64; ``more`` are settings of the integrator."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth, **more})
    return np.array(mi.render(found, integrator=integrator, spp=spp, seed=seed), np.float64)


def camera_samples(found: mi.Scene, seed: int) -> CameraRays:
    """The samples of the film, one a pixel: they do not depend on what they meet."""
    (samples,) = film_passes(RenderSamples(found.sensors()[0], seed, 1, SIDE * SIDE))
    return samples


def camera_rays(found: mi.Scene, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of :func:`camera_samples`."""
    ray = camera_samples(found, seed).ray
    return np.array(ray.o, np.float64).T, np.array(ray.d, np.float64).T
