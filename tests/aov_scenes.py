"""Scenes and rays for tests of AOVs and expected depth."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from scenes import as_float32, centred, film, pencil, pixel_rays, render

EPS = 2.0**-23
CUBE = centred(np.eye(3))


def shoot(parts, o, d, integrator, inside=None, spp=1, seed=0):
    """The image (n, channels) along rays (n, 3), one pixel for each, and those rays as the sensor sent them.

    ``inside`` names the medium around the sensor.
    """
    o, d = np.atleast_2d(o), np.atleast_2d(d)
    rays = {f"ray{i:03d}": pencil(p, w) for i, (p, w) in enumerate(zip(o, d, strict=True))}
    sensor = {"type": "batch", **rays, "film": film(len(o), 1), "sampler": {"type": "independent"}}
    if inside is not None:
        sensor["medium"] = {"type": "ref", "id": inside}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
    o, d = (x[0, :, 0] for x in pixel_rays(scene.sensors()[0], 1))
    return render(scene, integrator, spp, seed)[0], o, d


def see(parts, o, d, aovs, inside=None, **more):
    """AOVs (n, names) along rays (n, 3), and those rays as the sensor sent them."""
    image, o, d = shoot(parts, o, d, {"type": "mivol", "max_depth": 1, "aovs": aovs, **more}, inside)
    return image[:, 3:].astype(np.float64), o, d


def rays(n=8, origin=(0.2, 0.3, 4.0), seed=0, wide=0.35):
    """Rays from around one point through the middle of the scene."""
    rng = np.random.default_rng([seed, 5])
    o = as_float32(np.asarray(origin) + rng.uniform(-0.1, 0.1, (n, 3)))
    d = np.column_stack([rng.uniform(-wide, wide, (n, 2)), np.zeros(n)]) - o
    return o, as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))


def grid(seed, channels=1, top=4.0, shape=(9, 8, 10)):
    """A smooth grid: a few waves along each axis, at least a tenth of its top."""
    rng = np.random.default_rng(seed)
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    waves = [np.sin(2 * math.pi * (rng.uniform(0.3, 1, 3) @ [z.ravel(), y.ravel(), x.ravel()]) + c) for c in range(channels)]
    return as_float32(top * (0.55 + 0.45 * np.array(waves).T.reshape(*shape, channels)))
