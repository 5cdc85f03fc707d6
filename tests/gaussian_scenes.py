"""Renders of Gaussians in a scene, and the rays that saw them, for twins in float64."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

SIDE = 12
"""Of the pictures [pixels]."""


def render(found: mi.Scene, depth: int = 1, spp: int = 1, seed: int = 0, **more: object) -> np.ndarray:
    """The picture in float64; ``more`` are settings of the integrator."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth, **more})
    return np.array(mi.render(found, integrator=integrator, spp=spp, seed=seed), np.float64)


def camera_rays(found: mi.Scene, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The rays of one sample a pixel with a seed: they do not depend on what they meet."""
    sampler = found.sensors()[0].sampler().clone()
    sampler.seed(seed, SIDE * SIDE)
    index = dr.arange(mi.UInt32, SIDE * SIDE)
    place = (mi.Vector2f(index % SIDE, index // SIDE) + sampler.next_2d()) / SIDE
    ray, _ = found.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    return np.array(ray.o, np.float64).T, np.array(ray.d, np.float64).T
