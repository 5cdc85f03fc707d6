"""Gradients of images with respect to one parameter of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["DENSITY", "ParameterGradient", "square_error"]

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
