"""Density gradients of images by one integrator, and the lights in which integrators are compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.scenes import box_scene, make_integrator

ALBEDO = 0.75
INTEGRATORS = ("mivol", "prbvolpath")

KEY = "box.interior_medium.sigma_t.data"
"""Key of the voxels in ``mi.traverse``."""


@dataclass(frozen=True)
class Light:
    """A light on a box, and the number of scatterings in the box.

    Attributes:
        parts: makes the parts of the scene.
        bar: smallest ratio of variance x time.
        depth: ``max_depth``; -1: unlimited.
        albedo: albedo of the medium.
        samples_emitters: the twin samples emitters at collisions; otherwise its paths find light by chance.
        hidden: ``hide_emitters``.
        traps_light: the boundary of the medium reflects all light of some directions, so this light stays inside.
        rounds: factor on the number of rounds, for variances as well known as in other lights.
    """

    parts: Callable[[], dict]
    bar: float = math.nan
    depth: int = 2
    albedo: float = ALBEDO
    samples_emitters: bool = False
    hidden: bool = False
    traps_light: bool = False
    rounds: int = 1

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        """The box around an extinction (Z, Y, X), seen in an image with ``side`` x ``side`` pixels."""
        return mi.load_dict(box_scene(values, side, self.albedo, **self.parts()))

    def integrator(self, name: str) -> mi.Integrator:
        """An integrator with the depth of this light."""
        return make_integrator(name, self.depth, self.hidden)

    def gradients(self, values: np.ndarray, side: int) -> dict[str, DensityGradient]:
        """The gradients of both integrators, with separate scenes."""
        return {name: DensityGradient(self.scene(values, side), self.integrator(name)) for name in INTEGRATORS}


@dataclass
class DensityGradient:
    """Gradients with respect to one parameter of a scene, by one integrator made for this scene."""

    scene: mi.Scene
    integrator: mi.Integrator
    key: str = KEY

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
        """Mean of the image for other values (Z, Y, X)."""
        self.params[self.key] = mi.TensorXf(np.float32(values)[..., None])
        self.params.update()
        return float(np.mean(np.array(mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp), np.float64)))


def square_error(target: mi.TensorXf) -> Callable[[mi.TensorXf], mi.Float]:
    """The mean squared difference of an image to a target."""
    return lambda image: dr.mean(dr.square(image - target), axis=None)
