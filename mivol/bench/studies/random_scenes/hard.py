"""Hard scenes, path by path: is every sample of light a finite number that is not negative?"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import as_dense_as_smoke, smoke, threads_in_space
from mivol.bench.harness.bars import say
from mivol.bench.scenes import box_scene, constant_light, emitter_inside, make_integrator, milky_glass, sun_and_sky
from mivol.bench.studies.random_scenes.trials import Size

__all__ = ["HARD", "try_hard_scenes"]

SIDE = 1024
"""Of a picture of one path a pixel."""


def _colours() -> np.ndarray:
    """Extinctions of three colours at ratios of 10,000, one of them 0 in a half of the box."""
    values = np.random.default_rng(1).uniform(0, 1, (8, 8, 8, 3)) * np.array([4.0, 4e-4, 40.0])
    values[:4, ..., 0] = 0
    return values.astype(np.float32)


def _sun(g: float) -> dict:
    """A sun in a sky, and a phase function that is nearly a line."""
    return sun_and_sky() | {"phase": {"type": "hg", "g": g}}


HARD: dict[str, Callable[[], dict]] = {
    "white box of optical depth 64": lambda: box_scene(np.full((4, 4, 4), 32, np.float32), SIDE, 0.999, **constant_light()),
    "one voxel of optical depth 2000": lambda: box_scene(np.full((1, 1, 1), 1e3, np.float32), SIDE, 0.9, **sun_and_sky()),
    "empty box": lambda: box_scene(np.zeros((4, 4, 4), np.float32), SIDE, 0.9, **sun_and_sky()),
    "thin as 1e-12": lambda: box_scene(np.full((4, 4, 4), 1e-12, np.float32), SIDE, 0.9, **sun_and_sky()),
    "colours at ratios of 10,000": lambda: _box_of_colours(),
    "HG 0.99": lambda: box_scene(smoke().values, SIDE, 0.99, **_sun(0.99)),
    "HG -0.99": lambda: box_scene(smoke().values, SIDE, 0.99, **_sun(-0.99)),
    "emitter inside": lambda: box_scene(smoke().values, SIDE, 1.0, **emitter_inside()),
    "glass": lambda: box_scene(smoke().values, SIDE, 1.0, **milky_glass()),
    "threads": lambda: box_scene(as_dense_as_smoke(threads_in_space(128)).values, SIDE, 0.75, **sun_and_sky()),
}
"""Scenes that are followed at unlimited depth."""


def _box_of_colours() -> dict:
    scene = box_scene(np.zeros((2, 2, 2), np.float32), SIDE, 0.99, **emitter_inside())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(_colours())
    return scene


def try_hard_scenes(size: Size) -> dict:
    """Are all paths of hard scenes of a finite radiance that is not negative?"""
    answer = {}
    for name, parts in HARD.items():
        scene, integrator = mi.load_dict(parts()), make_integrator("mivol", -1)
        answer[name] = found = {"paths": 0, "not_finite": 0, "negative": 0, "brightest": 0.0}
        for k in range(size.hard_pictures):
            picture = np.array(mi.render(scene, integrator=integrator, spp=1, seed=k))
            found["paths"] += picture.shape[0] * picture.shape[1]
            found["not_finite"] += int(np.sum(~np.isfinite(picture)))
            found["negative"] += int(np.sum(picture < 0))
            found["brightest"] = max(found["brightest"], float(np.nanmax(picture)))
        dr.flush_malloc_cache()
        say(f"  {name}: {found}")
    return answer
