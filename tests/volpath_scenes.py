"""Scenes that are compared with Mitsuba's volpath, for tests of single scattering and of the media along a ray."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import scattering_scenes as small
from scattering_scenes import PLACE, assert_same_images, close_up, moments, point, rough_grid, spot, sun, volpath

import scenes
from mivol.validate.statistics import Moments
from scenes import affine, grid_volume, medium, transform

LEAK = 1e-4
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}


def turn() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def same(parts: dict, level: float | None = None, **more: object) -> tuple[Moments, Moments]:
    """Both integrators show the same; what volpath leaks is counted as a share of the brightest pixel."""
    scene = close_up(parts)
    level = float(moments(scene, volpath(), 16, 2).mean.max()) if level is None else level
    return assert_same_images(scene, rounding=LEAK * level, **more)


def panorama() -> mi.Bitmap:
    """A sky of 8 x 16 with a bright spot of 60 in it, one texel of another colour."""
    sky = np.random.default_rng(3).uniform(0.1, 0.6, (8, 16, 3)).astype(np.float32)
    sky[2, 5] = (60.0, 50.0, 30.0)
    return mi.Bitmap(sky)


def square(x: float, y: float, z: float, size: float = 0.5, towards: tuple = (0, 0, 0)) -> dict:
    """A square at a place, facing another."""
    place = turn().look_at([x, y, z], list(towards), [0.1, 0.9, 0.2])
    return {"type": "rectangle", "to_world": place.scale([size, size, 1])}


def area(x: float, y: float, z: float, radiance: object = 8.0, size: float = 0.5) -> dict:
    """A luminous square facing the middle."""
    light = {"type": "rgb", "value": radiance} if isinstance(radiance, list) else radiance
    return square(x, y, z, size) | {"emitter": {"type": "area", "radiance": light}}


def projector() -> dict:
    picture = np.random.default_rng(4).uniform(0, 2, (4, 6, 3)).astype(np.float32)
    return {
        "type": "projector",
        "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(picture), "filter_type": "nearest", "raw": True},
        "to_world": turn().look_at([2.0, -1, 2.5], [0, 0, 0], [0, 0, 1]),
        "fov": 40,
        "scale": 5.0,
    }


def textured() -> dict:
    picture = np.random.default_rng(5).uniform(0, 9, (3, 5, 3)).astype(np.float32)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True}
    return square(0, -0.4, 2.2, 1.0) | {"emitter": {"type": "area", "radiance": radiance}}


EMITTERS = {
    "constant": lambda: {"emitter": scenes.sky(0.8)},
    "envmap": lambda: {"emitter": {"type": "envmap", "bitmap": panorama(), "to_world": turn().rotate([1, 0, 0], 70)}},
    "sunsky": lambda: {"emitter": {"type": "sunsky", "turbidity": 4.0, "sun_direction": [0.4, 0.3, 0.8], "sun_aperture": 3.0}},
    "directional": lambda: {"emitter": sun([0.3, 0.5, -1.0])[0]},
    "point": lambda: {"emitter": point([1.5, -1.2, 1.6])[0]},
    "spot": lambda: {"emitter": spot([1.0, -2, 2.2], [0, 0, 0])[0]},
    "projector": lambda: {"emitter": projector()},
    "area outside": lambda: {"emitter": area(1.5, 0.5, 1.8, [9.0, 6.0, 2.0])},
    "textured area": lambda: {"emitter": textured()},
    "area inside": lambda: {"emitter": {"type": "sphere", "radius": 0.25, "center": [0.3, 0.2, 0.1]}
                            | {"emitter": {"type": "area", "radiance": 4.0}}},
    "two that can be met": lambda: {**EMITTERS["envmap"](), "wide": area(-1.6, 0.5, 1.5, 3.0, 1.5)},
    "several": lambda: {"a": scenes.sky(0.1), "b": point([1.5, -1.2, 1.6])[0], "c": sun([0, 1, -0.5], 0.5)[0],
                        "d": area(-1.6, 0.5, 1.5)},
}  # fmt: skip


def lit(parts: dict) -> dict:
    return {**parts, "bulb": point([1.6, -1.3, 1.7], 40.0)[0], "sky": scenes.sky(0.1)}


def grid_in(boundary: dict, kind: str = "stock", to_world: np.ndarray = PLACE, seed: int = 3, **more: object) -> dict:
    """A boundary around a grid."""
    medium_type, volume_type = small.KINDS[kind]
    phase = {"type": "hg", "g": 0.3}
    albedo = more.pop("albedo", 0.8)
    interior = medium(medium_type, grid_volume(volume_type, rough_grid(seed), to_world), albedo, phase=phase, **more)
    return boundary | {"interior": interior}


BARE = {"bsdf": {"type": "null"}}


def cube(to_world: np.ndarray) -> dict:
    return {"type": "cube", "to_world": transform(np.asarray(to_world) @ affine(0.5 * np.eye(3), np.full(3, 0.5))), **BARE}


def behind_a_mask() -> dict:
    """A black mask between the bulb and the volume lets 40 % of the light through, and of what the camera sees behind it."""
    bsdf = {"type": "mask", "opacity": 0.6, "nested": {"type": "diffuse", "reflectance": 0.0}}
    return {"smoke": grid_in(cube(PLACE)), "mask": square(0.8, -0.65, 0.85, 0.6, (1.6, -1.3, 1.7)) | {"bsdf": bsdf}}


FOG = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.7, "phase": {"type": "hg", "g": 0.3}, "id": "fog"}


def floor() -> dict:
    """Just below the box: volpath loses a part of the light of a surface in the plane of a boundary."""
    return {"floor": {"type": "rectangle", "to_world": turn().translate([0, 0, -1.01]).scale(5), "bsdf": RED}}
