"""Scenes as people build them: media in rooms, over floors, in glass, in fog, with lamps inside and beside.

Conventions. z is up. The medium fills the shape ``body``, in most scenes the box or ball of edge or diameter 2 at the origin.
Coefficients are in 1 / length. Each scene has the ``max_depth`` that its light needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.bench.scenes import camera, make_integrator

ORIGIN, UP = (0, 0, 0), (0, 0, 1)


@dataclass(frozen=True)
class EverydayScene:
    """A scene and the terms of its contest.

    Attributes:
        build: side of the image -> parts of the scene.
        depth: ``max_depth`` of all integrators; -1: unlimited.
        image_bar: smallest ratio of variance x time for images.
        gradient_bar: the same for gradients; None: no bar.
        parameter: parameter that gradients are with respect to.
        roulette: depth at which Russian roulette begins.
    """

    build: Callable[[int], dict]
    depth: int
    image_bar: float
    gradient_bar: float | None
    parameter: str = "body.interior_medium.sigma_t.data"
    roulette: int = 64

    def load(self, side: int, sampler: str = "independent", spp: int = 1) -> mi.Scene:
        """Load the scene with a sampler for ``spp`` samples per pixel."""
        parts = self.build(side)
        parts["sensor"]["sampler"] = {"type": sampler, "sample_count": spp}
        return mi.load_dict({"type": "scene", **parts})

    def integrator(self, name: str) -> mi.Integrator:
        """An integrator for this scene alone."""
        return make_integrator(name, self.depth, roulette=self.roulette)


# -- Parts ------------------------------------------------------------------------------------------------------------------


def _rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def _facing(origin: Sequence[float], target: Sequence[float], up: Sequence[float] = UP) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


def _square_lamp(origin: Sequence[float], radiance: float, half_edge: float = 1.0) -> dict:
    """A square that shines at the origin."""
    place = _facing(origin, ORIGIN, (0, 1, 0)).scale(half_edge)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}


def _spot(place: mi.ScalarTransform4f, intensity: float, angle: float) -> dict:
    return {"type": "spot", "to_world": place, "intensity": intensity, "cutoff_angle": angle}


def _sky(radiance: float = 1.0) -> dict:
    return {"type": "constant", "radiance": radiance}


def _sky_and_sun(radiance: float = 1.0) -> dict:
    """An even sky, and a distant sun."""
    return {"sky": _sky(radiance), "sun": {"type": "directional", "direction": [-0.4, -0.3, -1], "irradiance": 3.0}}


def _sun_in_a_map() -> dict:
    """A dim noisy sky with a sun of one pixel. Mitsuba's maps have y up."""
    picture = 0.3 * np.random.default_rng(3).random((32, 64, 3)).astype(np.float32)
    picture[9, 14] = 2000
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": turned}}


def _floor() -> dict:
    """A large brown floor just below the body."""
    bsdf = {"type": "diffuse", "reflectance": _rgb(0.6, 0.5, 0.4)}
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.001]).scale(6), "bsdf": bsdf}


def _even(albedo: float | dict, sigma_t: float | dict, g: float = 0.0) -> dict:
    """A homogeneous medium."""
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    return {"type": "homogeneous", "albedo": albedo, "sigma_t": sigma_t, "phase": phase}


def _ball(medium: dict, bsdf: dict | None = None) -> dict:
    return {"type": "sphere", "bsdf": bsdf or {"type": "null"}, "interior": medium}


def _grid(values: np.ndarray, scale: float = 1.0) -> dict:
    """A volume (Z, Y, X, channels) over the box of half edge ``scale``."""
    place = mi.ScalarTransform4f().scale(scale).translate(-1).scale(2)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values.astype(np.float32)), "to_world": place}


def _puffs(res: int) -> np.ndarray:
    """Forty soft blobs with a peak of 1, (res, res, res, 1)."""
    rng, centres = np.random.default_rng(1), np.linspace(-1, 1, res)
    points = np.stack(np.meshgrid(centres, centres, centres, indexing="ij"), -1)
    total = np.zeros((res,) * 3)
    for _ in range(40):
        centre = rng.uniform(-0.7, 0.7, 3)
        total += np.exp(-np.sum((points - centre) ** 2, axis=-1) / (2 * rng.uniform(0.05, 0.2) ** 2))
    return (total / total.max())[..., None]


def _smoke(peak: float, g: float = 0.0, albedo: float | dict = 0.8, res: int = 64, scale: float = 1.0) -> dict:
    """A box of puffs without a visible boundary."""
    medium = _even(albedo, _grid(peak * _puffs(res), scale), g) | {"type": "heterogeneous"}
    place = mi.ScalarTransform4f().scale(scale)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}


# -- Scenes -----------------------------------------------------------------------------------------------------------------


def _jade(side: int) -> dict:
    ball = _ball(_even(_rgb(0.9, 0.8, 0.6), 4.0))
    return _sun_in_a_map() | {"body": ball, "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _wax(side: int) -> dict:
    ball = _ball(_even(_rgb(0.95, 0.85, 0.6), 6.0), {"type": "roughdielectric", "alpha": 0.2})
    lamp = _square_lamp((2, 2, 3), 30.0, 0.5)
    return {"sky": _sky(), "lamp": lamp, "body": ball, "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _tissue(side: int) -> dict:
    lamp = _square_lamp((0, 1, 4), 20.0)
    return {"lamp": lamp, "body": _ball(_even(0.99, 30.0, 0.7)), "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _fog(side: int) -> dict:
    """A fog without a boundary: the camera stands in the fog, and looks past a lamp at a wall."""
    grey = {"type": "diffuse", "reflectance": 0.5}
    wall = {"type": "rectangle", "to_world": _facing((4, 0, 0), ORIGIN).scale(6), "bsdf": grey}
    lamp = {"type": "point", "position": [2.0, 0, 1.0], "intensity": 10.0}
    sensor = camera(side, ORIGIN, (1, 0, 0)) | {"medium": {"type": "ref", "id": "fog"}}
    # Mitsuba resolves a reference only to an object that it has loaded before.
    return {"fog": _even(0.6, 0.2), "wall": wall, "lamp": lamp, "sensor": sensor}


def _god_rays(side: int) -> dict:
    haze = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": {"type": "null"}}
    return {
        "body": haze | {"interior": _even(0.9, 0.25, 0.5)},
        "lamp": _spot(_facing((0, 0, 1.9), ORIGIN, (0, 1, 0)), 40.0, 35.0),
        "ball": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}},
        "floor": _floor(),
        "sensor": camera(side, (0, 6, 1), ORIGIN),
    }


def _aquarium(side: int) -> dict:
    """A box of coloured water with a lamp and a ball inside, seen through its flat side."""
    middle = (0, 4, 0)
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle).scale(3)}
    glass = {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.0}
    return {
        "body": box | {"bsdf": glass, "interior": _even(_rgb(0.3, 0.5, 0.6), _rgb(0.5, 0.3, 0.25), 0.8)},
        "lamp": _spot(_facing((1.5, 2, 1.5), middle), 30.0, 30.0),
        "ball": {"type": "sphere", "center": list(middle), "radius": 0.7, "bsdf": {"type": "diffuse"}},
        "sensor": camera(side, (0, -3, 0), middle),
    }


def _milk(side: int) -> dict:
    """A ball of milk in a thin ball of glass."""
    return {
        "sky": _sky(),
        "lamp": _square_lamp((3, 2, 4), 20.0, 0.7),
        "glass": {"type": "sphere", "radius": 1.1, "bsdf": {"type": "dielectric", "int_ior": 1.5}},
        "body": _ball(_even(_rgb(0.99, 0.97, 0.9), 8.0, 0.6), {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.5}),
        "floor": _floor(),
        "sensor": camera(side, (0, 4, 1.5), ORIGIN),
    }


def _smoke_on_floor(side: int) -> dict:
    return _sky_and_sun(0.4) | {"body": _smoke(12.0), "floor": _floor(), "sensor": camera(side, (0, 6, 2.5), (0, 0, -0.2))}


def _smoke_in_room(side: int) -> dict:
    """Smoke in Mitsuba's Cornell box in place of its two boxes; there, y is up."""
    stock = mi.cornell_box()
    room = {name: part for name, part in stock.items() if isinstance(part, dict) and part["type"] in ("rectangle", "diffuse")}
    sensor = camera(side, (0, 0, 3.9), ORIGIN, 39.3077, (0, 1, 0)) | {"near_clip": 0.001}
    return room | {"body": _smoke(8.0, res=48, scale=0.6), "sensor": sensor}


def _smoke_under(lights: Callable[[], dict], *smoke: float) -> Callable[[int], dict]:
    """Make the builder of a scene of one smoke, seen from above, from its lights."""
    return lambda side: lights() | {"body": _smoke(*smoke), "sensor": camera(side, (0, 5, 2), ORIGIN)}


def _coloured_albedo(side: int) -> dict:
    albedo = _grid(np.random.default_rng(0).uniform(0.3, 0.95, (16, 16, 16, 3)))
    return {"sky": _sky(), "body": _smoke(15.0, albedo=albedo), "sensor": camera(side, (0, 5, 2), ORIGIN)}


def _lamp_inside() -> dict:
    return {"lamp": {"type": "point", "position": [0.1, 0.2, 0.1], "intensity": 5.0}}


def _lamp_beside() -> dict:
    return {"lamp": _square_lamp((0, 1.5, 1.6), 20.0, 0.4)}


EVEN, ALBEDO = "body.interior_medium.sigma_t.value.value", "body.interior_medium.albedo.data"

SCENES = {
    "jade_null_sun": EverydayScene(_jade, 12, 2.5, 2, EVEN),
    "wax_rough_glass": EverydayScene(_wax, 16, 2, 2, EVEN),
    "tissue": EverydayScene(_tissue, -1, 12, 4, EVEN, roulette=20),
    "fog_unbounded": EverydayScene(_fog, 8, 10, None, "fog.sigma_t.value.value"),
    "god_rays": EverydayScene(_god_rays, 8, 6, 8, EVEN),
    "aquarium": EverydayScene(_aquarium, 10, 3, None, EVEN),
    "milk_in_glass": EverydayScene(_milk, 10, 2, 3, EVEN),
    "smoke_sun_map": EverydayScene(_smoke_under(_sun_in_a_map, 20.0, 0.8), 16, 40, 40),
    "smoke_on_floor": EverydayScene(_smoke_on_floor, 16, 9, 20),
    "smoke_in_room": EverydayScene(_smoke_in_room, 10, 3, 15),
    "thin_smoke": EverydayScene(_smoke_under(_sky_and_sun, 1.0), 8, 10, 900),
    "smoke_point_inside": EverydayScene(_smoke_under(_lamp_inside, 10.0), 8, 15, 20),
    "smoke_area_close": EverydayScene(_smoke_under(_lamp_beside, 10.0), 8, 6, 12),
    "coloured_albedo": EverydayScene(_coloured_albedo, 8, 20, 10, ALBEDO),
    "cloud_bright": EverydayScene(_smoke_under(lambda: _sky_and_sun(0.3), 80.0, 0.85, 0.999), 64, 120, None),
}
"""The scenes by name."""
