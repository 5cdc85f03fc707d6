"""Scenes of stock plugins that every renderer takes: a box of extinction, a camera of the tutorial's, a kind of light.

Conventions. The box is [-1, 1]^3. Lights are functions that return the parts of a scene which they change: ``emitter`` and
the medium's ``phase``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TO_WORLD

__all__ = [
    "box_scene",
    "constant_light",
    "directional_light",
    "directions_of_map",
    "emitter_inside",
    "glass_under_a_sky",
    "milk_in_a_glass",
    "milky_glass",
    "make_integrator",
    "perspective",
    "point_light",
    "sun_and_sky",
    "sun_before_the_camera",
]


def perspective(side: int) -> dict:
    """One of the tutorial's cameras: 4 away, 45 degrees wide, turned by 18 degrees; the smoke's own z is up."""
    angle = math.radians(18)
    origin = [4 * math.sin(angle), -4 * math.cos(angle), 0]
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 0, 1]),
        "film": {
            "type": "hdrfilm",
            "width": side,
            "height": side,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def box_scene(values: np.ndarray, side: int, albedo: float | Sequence[float] = 0.0, **more: dict) -> dict:
    """A box that holds an extinction, seen by one of the tutorial's cameras.

    Args:
        values: (Z, Y, X), or (3,) of a homogeneous medium in rgb [1/length].
        side: of the picture [pixels].
        albedo: of the medium; rgb where the extinction is.
        more: ``phase`` of the medium, ``bsdf`` of the box; all else are parts of the scene. Without emitters, a sky of
            radiance 1.
    """
    medium = liquid(values, albedo) if values.ndim == 1 else grid_medium(values, albedo)
    if "phase" in more:
        medium["phase"] = more.pop("phase")
    bsdf = more.pop("bsdf", {"type": "null"})
    return {
        "type": "scene",
        "box": {"type": "cube", "bsdf": bsdf, "interior": medium},
        "sensor": perspective(side),
        **(more or {"sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}}),
    }


def grid_medium(values: np.ndarray, albedo: float) -> dict:
    """A medium whose extinction is a grid (Z, Y, X) [1/length]."""
    to_world = mi.ScalarTransform4f(np.float32(TO_WORLD))
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values[..., None]), "raw": True, "to_world": to_world}
    return {"type": "heterogeneous", "sigma_t": grid, "albedo": albedo}


def liquid(sigma_t: np.ndarray, albedo: Sequence[float]) -> dict:
    """A homogeneous medium of an extinction (3,) [1/length] and an albedo in rgb."""
    # Colours of a scene are at most 1; what is above that is a scale.
    most = float(sigma_t.max())
    share = {"type": "rgb", "value": [float(x) / most for x in sigma_t]}
    return {
        "type": "homogeneous",
        "sigma_t": share,
        "scale": most,
        "albedo": {"type": "rgb", "value": [float(x) for x in albedo]},
    }


def constant_light() -> dict:
    """Light of radiance 1 from everywhere, isotropic scattering."""
    return {"emitter": {"type": "constant"}, "phase": {"type": "isotropic"}}


def point_light(position: tuple[float, float, float]) -> dict:
    """A point light, isotropic scattering."""
    emitter = {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"emitter": emitter, "phase": {"type": "isotropic"}}


def sun_and_sky(height: int = 128) -> dict:
    """A sky that brightens upwards and a sun of 2 degrees' radius that gives a third of the light; HG g = 0.8.

    Args:
        height: of the environment map [pixels].
    """
    d = directions_of_map(height)
    sky = (0.25 + 0.15 * d[..., 2:]) * np.array([0.8, 1.0, 1.3])
    sun = d @ np.array([0.48, 0.6, 0.64]) > math.cos(math.radians(2.0))
    picture = np.where(sun[..., None], np.array([420.0, 390.0, 330.0]), sky)
    return _sky_of(picture) | {"phase": {"type": "hg", "g": 0.8}}


def sun_before_the_camera(height: int = 128) -> dict:
    """A sun of 4 degrees' radius, 35 degrees off where the camera looks, in a sky that is nearly black; HG g = 0.8.

    Args:
        height: of the environment map [pixels].
    """
    d = directions_of_map(height)
    sun = d @ np.array([-0.253, 0.778, 0.574]) > math.cos(math.radians(4.0))
    return _sky_of(np.where(sun[..., None], np.array([105.0, 97.0, 82.0]), 0.01)) | {"phase": {"type": "hg", "g": 0.8}}


def glass_under_a_sky(height: int = 16) -> dict:
    """A box of smooth glass under a sky that brightens upwards, isotropic scattering.

    Args:
        height: of the environment map [pixels].
    """
    picture = (1 + 0.5 * directions_of_map(height)[..., 2:]) * np.array([0.8, 1.0, 1.2])
    return _sky_of(picture) | {"phase": {"type": "isotropic"}, "bsdf": {"type": "dielectric"}}


def directions_of_map(height: int) -> np.ndarray:
    """World directions (H, 2 H, 3) of the pixels of an environment map that :func:`_sky_of` places, z up."""
    theta, phi = np.meshgrid((np.arange(height) + 0.5) / height * np.pi, np.arange(2 * height) / height * np.pi, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1)


def _sky_of(picture: np.ndarray) -> dict:
    """An environment map (H, 2 H, 3). Mitsuba's maps have y up, the benches z."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"emitter": {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "to_world": turned}}


def directional_light() -> dict:
    """A directional light from above, HG g = 0.8."""
    emitter = {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"emitter": emitter, "phase": {"type": "hg", "g": 0.8}}


def emitter_inside() -> dict:
    """A small ball of light in the medium, isotropic scattering."""
    emitter = {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.2, "emitter": {"type": "area", "radiance": 9.0}}
    return {"emitter": emitter, "phase": {"type": "isotropic"}}


def milky_glass() -> dict:
    """A box of smooth glass under a large emitter and a faint sky, isotropic scattering."""
    emitter = {"type": "sphere", "center": [1.2, -1.5, 2.2], "radius": 0.6, "emitter": {"type": "area", "radiance": 9.0}}
    sky = {"type": "constant", "radiance": 0.5}
    return {"emitter": emitter, "sky": sky, "phase": {"type": "isotropic"}, "bsdf": {"type": "dielectric"}}


def milk_in_a_glass() -> dict:
    """The light of :func:`milky_glass`; liquid of the index of water in a glass, a twentieth of the box thick on each side."""
    water, glass, air = 1.333, 1.5, 1.0
    wall = {"type": "dielectric", "int_ior": glass, "ext_ior": air}
    outside = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(1.1), "bsdf": wall}
    return milky_glass() | {"bsdf": {"type": "dielectric", "int_ior": water, "ext_ior": glass}, "glass": outside}


def make_integrator(name: str, depth: int, hide_emitters: bool = False) -> mi.Integrator:
    """That integrator with this ``max_depth``, made anew for each scene: ``prbvolpath`` keeps flags of the first scene it sees.

    Roulette begins at depth 64 for all, beyond which a path of an unlimited one hardly counts in scenes that absorb.
    """
    return mi.load_dict({"type": name, "max_depth": depth, "rr_depth": 64, "hide_emitters": hide_emitters})
