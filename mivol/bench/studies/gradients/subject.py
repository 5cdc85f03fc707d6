"""Gradients of pictures with respect to the voxels of an extinction, by mivol and by ``prbvolpath``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.timing import Budget, Contestant, Timing, race
from mivol.bench.studies.gradients.size import OURS, STOCK, Light
from mivol.validate.moments import Moments

__all__ = ["KEY", "SEEDS", "Step", "Subject", "along", "compete", "subjects", "variance_over"]

KEY = "box.interior_medium.sigma_t.data"
"""Of the voxels in ``mi.traverse``."""

SEEDS = 100_000
"""How far seeds of a size lie from those of the next one."""


@dataclass
class Subject:
    """A scene whose densities are differentiated, and an integrator made for it."""

    scene: mi.Scene
    integrator: mi.Integrator

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.scene)

    def _collect(self, backward: Callable[[], None]) -> mi.Float:
        values = mi.TensorXf(self.params[KEY])
        dr.enable_grad(values)
        self.params[KEY] = values
        self.params.update()
        backward()
        gradient = dr.grad(self.params[KEY]).array
        dr.eval(gradient)
        dr.disable_grad(self.params[KEY])
        return gradient

    def of_mean(self, seed: int, spp: int) -> mi.Float:
        """The gradient of the picture's mean."""
        height, width = self.scene.sensors()[0].film().size()[::-1]
        ones = dr.full(mi.TensorXf, 1 / (3 * height * width), (height, width, 3))
        back = lambda: self.integrator.render_backward(self.scene, self.params, ones, seed=seed, spp=spp)  # noqa: E731
        return self._collect(back)

    def of_loss(self, target: mi.TensorXf, seed: int, spp: int) -> mi.Float:
        """The gradient of the mean squared difference to a target, picture and all."""

        def backward() -> None:
            picture = mi.render(self.scene, self.params, integrator=self.integrator, seed=seed, spp=spp)
            dr.backward(dr.mean(dr.square(picture - target), axis=None))

        return self._collect(backward)

    def mean(self, values: np.ndarray, seed: int, spp: int) -> float:
        """The picture's mean for other values (Z, Y, X)."""
        self.params[KEY] = mi.TensorXf(np.float32(values)[..., None])
        self.params.update()
        return float(np.mean(np.array(mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp), np.float64)))


def subjects(values: np.ndarray, side: int, light: Light) -> dict[str, Subject]:
    """The same scene once for each integrator."""
    return {name: Subject(light.scene(values, side), light.integrator(name)) for name in (OURS, STOCK)}


Step = Callable[[int, int], object]
"""Seed and samples per pixel to a gradient."""


def compete(steps: dict[str, Step], budget: Budget, rounds: int, seed: int = 0) -> tuple[dict[str, Timing], dict[str, int]]:
    """Gradients in turns, each with the samples of its budget; timings with their results, and samples per pixel.

    Args:
        steps: by name; each gets seeds of its own.
        budget: of one gradient.
        rounds: gradients of each.
        seed: another one gives independent gradients.
    """
    spp = {name: budget.samples(step) for name, step in steps.items()}
    calls: dict[str, Contestant] = {
        name: lambda number, step=step, n=spp[name], k=k: step(SEEDS * seed + 1000 * (k + 1) + number, n)
        for k, (name, step) in enumerate(steps.items())
    }
    return race(calls, rounds, keep=True), spp


def along(timing: Timing, direction: np.ndarray) -> np.ndarray:
    """Derivatives along a direction (Z, Y, X), one for each round."""
    return np.array(timing.results, np.float64) @ direction.ravel().astype(np.float64)


def variance_over(timing: Timing, chosen: np.ndarray) -> float:
    """Sum of the variances of chosen voxels."""
    return float(Moments.of(np.array(timing.results)).variance[chosen.ravel()].sum())
