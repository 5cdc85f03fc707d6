"""Scenes of stock plugins for all renderers: a box with an extinction, a camera of the tutorial, and lights; gradients.

Conventions. The box is [-1, 1]^3. A light is a function that returns the changed parts of a scene: ``emitter``, and ``phase``
of the medium.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TO_WORLD

__all__ = [
    "DENSITY",
    "ParameterGradient",
    "box_scene",
    "camera",
    "constant_light",
    "directional_light",
    "emitter_inside",
    "glass_under_a_sky",
    "make_integrator",
    "map_directions",
    "milk_in_a_glass",
    "milky_glass",
    "perspective",
    "point_light",
    "square_error",
    "sun_and_sky",
    "sun_before_the_camera",
]


def perspective(side: int) -> dict:
    """A camera of the tutorial: distance 4, field of view 45 degrees, turned by 18 degrees; z of the smoke is up."""
    angle = math.radians(18)
    return camera(side, (4 * math.sin(angle), -4 * math.cos(angle), 0), (0, 0, 0), 45)


def camera(
    side: int,
    origin: Sequence[float],
    target: Sequence[float],
    fov: float = 40,
    up: Sequence[float] = (0, 0, 1),
) -> dict:
    """A camera with a square image, a box filter and independent samples; the field of view in degrees."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up)),
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
    """A box with an extinction, seen by a camera of the tutorial.

    Args:
        values: extinction (Z, Y, X), or (3,) of a homogeneous rgb medium [1/length].
        side: edge of the image [pixels].
        albedo: albedo of the medium; rgb for an rgb extinction.
        more: ``phase`` of the medium, ``bsdf`` of the box, and parts of the scene. A scene without parts gets a sky of
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
    # Colours of a scene are at most 1; a scale holds the rest.
    most = float(sigma_t.max())
    share = {"type": "rgb", "value": [float(x) / most for x in sigma_t]}
    return {
        "type": "homogeneous",
        "sigma_t": share,
        "scale": most,
        "albedo": {"type": "rgb", "value": [float(x) for x in albedo]},
    }


def constant_light() -> dict:
    """Radiance 1 from all directions, isotropic scattering."""
    return {"emitter": {"type": "constant"}, "phase": {"type": "isotropic"}}


def point_light(position: tuple[float, float, float]) -> dict:
    """A point light, isotropic scattering."""
    emitter = {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"emitter": emitter, "phase": {"type": "isotropic"}}


def sun_and_sky(height: int = 128) -> dict:
    """A sky that brightens upwards, and a sun of 2 degrees' radius with a third of the light; HG g = 0.8.

    Args:
        height: height of the environment map [pixels].
    """
    d = map_directions(height)
    sky = (0.25 + 0.15 * d[..., 2:]) * np.array([0.8, 1.0, 1.3])
    sun = d @ np.array([0.48, 0.6, 0.64]) > math.cos(math.radians(2.0))
    image = np.where(sun[..., None], np.array([420.0, 390.0, 330.0]), sky)
    return _environment(image) | {"phase": {"type": "hg", "g": 0.8}}


def sun_before_the_camera(height: int = 128) -> dict:
    """A sun of 4 degrees' radius, 35 degrees off the axis of the camera, in a nearly black sky; HG g = 0.8.

    Args:
        height: height of the environment map [pixels].
    """
    d = map_directions(height)
    sun = d @ np.array([-0.253, 0.778, 0.574]) > math.cos(math.radians(4.0))
    return _environment(np.where(sun[..., None], np.array([105.0, 97.0, 82.0]), 0.01)) | {"phase": {"type": "hg", "g": 0.8}}


def glass_under_a_sky(height: int = 16) -> dict:
    """A box of smooth glass under a sky that brightens upwards, isotropic scattering.

    Args:
        height: height of the environment map [pixels].
    """
    image = (1 + 0.5 * map_directions(height)[..., 2:]) * np.array([0.8, 1.0, 1.2])
    return _environment(image) | {"phase": {"type": "isotropic"}, "bsdf": {"type": "dielectric"}}


def map_directions(height: int) -> np.ndarray:
    """World directions (H, 2 H, 3) of the pixels of an environment map in :func:`_environment`, z up."""
    theta, phi = np.meshgrid((np.arange(height) + 0.5) / height * np.pi, np.arange(2 * height) / height * np.pi, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1)


def _environment(image: np.ndarray) -> dict:
    """An environment map (H, 2 H, 3). Mitsuba's maps have y up, these scenes have z up."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"emitter": {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "to_world": turned}}


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
    """The light of :func:`milky_glass`; a liquid with the index of water in a glass of a twentieth of the box on each side."""
    water, glass, air = 1.333, 1.5, 1.0
    wall = {"type": "dielectric", "int_ior": glass, "ext_ior": air}
    outside = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(1.1), "bsdf": wall}
    return milky_glass() | {"bsdf": {"type": "dielectric", "int_ior": water, "ext_ior": glass}, "glass": outside}


def make_integrator(name: str, depth: int, hide_emitters: bool = False, roulette: int = 64) -> mi.Integrator:
    """An integrator with a ``max_depth``, to be made anew for each scene: ``prbvolpath`` keeps flags of its first scene.

    Russian roulette begins at the depth ``roulette``. In absorbing scenes, paths beyond a depth of 64 hardly count.
    """
    return mi.load_dict({"type": name, "max_depth": depth, "rr_depth": roulette, "hide_emitters": hide_emitters})


DENSITY = "box.interior_medium.sigma_t.data"
"""Key of the voxels of :func:`mivol.bench.scenes.box_scene` in ``mi.traverse``."""


@dataclass
class ParameterGradient:
    """Gradients with respect to one parameter of a scene, by one integrator made for this scene."""

    scene: mi.Scene
    integrator: mi.Integrator
    key: str = DENSITY

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.scene)

    def _collect(self, backward: Callable[[], None]) -> mi.Float:
        values = self.params[self.key]
        values = type(values)(values)
        dr.enable_grad(values)
        self.params[self.key] = values
        self.params.update()
        backward()
        gradient = dr.ravel(dr.grad(self.params[self.key]))
        dr.eval(gradient)
        dr.disable_grad(self.params[self.key])
        return gradient

    def of_mean(self, seed: int, spp: int) -> mi.Float:
        """Gradient of the mean of the image."""
        width, height = self.scene.sensors()[0].film().size()
        ones = dr.full(mi.TensorXf, 1 / (3 * height * width), (height, width, 3))
        return self._collect(lambda: self.integrator.render_backward(self.scene, self.params, ones, seed=seed, spp=spp))

    def of_loss(self, loss: Callable[[mi.TensorXf], mi.Float], seed: int, spp: int) -> mi.Float:
        """Gradient of a loss of the image, with the render of the image."""

        def backward() -> None:
            dr.backward(loss(mi.render(self.scene, self.params, integrator=self.integrator, seed=seed, spp=spp)))

        return self._collect(backward)

    def mean(self, values: np.ndarray, seed: int, spp: int) -> float:
        """Mean of the image for other values (Z, Y, X) of a grid."""
        self.params[self.key] = mi.TensorXf(np.float32(values)[..., None])
        self.params.update()
        return float(np.mean(np.array(mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp), np.float64)))


def square_error(target: mi.TensorXf) -> Callable[[mi.TensorXf], mi.Float]:
    """The mean squared difference of an image to a target."""
    return lambda image: dr.mean(dr.square(image - target), axis=None)
