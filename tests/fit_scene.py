"""A small absorbing cube in front of a white sky, seen by a few cameras: what the tests of fits share."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.optim.parameters import Parameter
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View

KEY = "cube.interior_medium.sigma_t.data"


def absorbing_scene(values: np.ndarray) -> mi.Scene:
    """A cube [-1, 1]^3 of stock ``heterogeneous`` matter with albedo 0, over a stock grid (Z, Y, X, 1)."""
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32))
    medium = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": {"type": "gridvolume", "grid": grid, "to_world": place}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol"},
            "sky": {"type": "constant"},
            "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        }
    )


def film(size: int, rfilter: str = "box", pixel_format: str = "rgb") -> dict:
    """A square film."""
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": pixel_format,
        "component_format": "float32",
        "rfilter": {"type": rfilter},
    }


def camera(angle: float, size: int = 8, rfilter: str = "box", pixel_format: str = "rgb") -> mi.Sensor:
    """A perspective camera on a circle of radius 4 about the cube; ``angle`` in radians."""
    origin = [4 * np.cos(angle), 1.0, 4 * np.sin(angle)]
    pose = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0])
    return mi.load_dict({"type": "perspective", "fov": 35, "to_world": pose, "film": film(size, rfilter, pixel_format)})


def frontal(size: int = 4) -> mi.Sensor:
    """Parallel rays along -z that fill the middle of the cube's face: T = exp(-2 sigma) in a constant cube."""
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]).scale([0.5, 0.5, 1])
    return mi.load_dict({"type": "orthographic", "to_world": pose, "film": film(size)})


def views_of_truth(truth: np.ndarray, sensors: list[mi.Sensor], spp: int = 64) -> list[View]:
    """What the cameras see of a true volume."""
    scene = absorbing_scene(truth)
    images = [mi.render(scene, sensor=sensor, spp=spp, seed=100 + i) for i, sensor in enumerate(sensors)]
    return [View(f"view {i}", s, mi.TensorXf(image)) for i, (s, image) in enumerate(zip(sensors, images, strict=True))]


def small_problem(start: float = 0.3, n_views: int = 3, **settings: object) -> SceneProblem:
    """A random 4^3 truth in [0, 2], three views of 8 x 8 pixels, a constant start."""
    truth = np.random.default_rng(3).uniform(0, 2, (4, 4, 4, 1))
    sensors = [camera(2 * np.pi * i / n_views + 0.3) for i in range(n_views)]
    parameter = Parameter(KEY, "1/length", (0.0, np.inf), lr=0.1)
    scene = absorbing_scene(np.full((4, 4, 4, 1), start))
    chosen = {"parameters": [parameter], "spp": 4, "seed": 5} | settings
    return SceneProblem(scene, views_of_truth(truth, sensors), **chosen)
