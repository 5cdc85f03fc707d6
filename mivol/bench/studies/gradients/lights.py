"""The lights in which integrators are compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.bench.scenes import ParameterGradient, box_scene, make_integrator

ALBEDO = 0.75
INTEGRATORS = ("mivol", "prbvolpath")


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

    def gradients(self, values: np.ndarray, side: int) -> dict[str, ParameterGradient]:
        """The gradients of both integrators, with separate scenes."""
        return {name: ParameterGradient(self.scene(values, side), self.integrator(name)) for name in INTEGRATORS}
