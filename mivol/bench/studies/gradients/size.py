"""How much work the bench of gradients does, on which volumes, and in which lights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import Extinction, fine_smoke, les_cloud, smoke
from mivol.bench.harness.timing import Budget
from mivol.bench.scenes import (
    box_scene,
    constant_light,
    directional_light,
    emitter_inside,
    glass_under_a_sky,
    of_depth,
    sun_and_sky,
    sun_before_the_camera,
)

__all__ = ["ALBEDO", "CONTESTS", "FULL", "OURS", "QUICK", "STOCK", "TABLES", "TUTORIALS", "Light", "Size"]

ALBEDO = 0.75
OURS, STOCK = "mivol", "prbvolpath"


@dataclass(frozen=True)
class Light:
    """What lights a box, and how often it may scatter there.

    Attributes:
        parts: of the scene.
        bar: how many times sooner mivol's gradient has to be as exact.
        depth: ``max_depth``.
        albedo: of the medium.
        drawn: whether the twin draws emitter samples at collisions; elsewhere light is found by chance alone.
        hidden: ``hide_emitters``.
        catches: whether the boundary of the medium reflects all light of some directions, so that it stays within.
        rounds: how many times as many rounds it takes to know variances as well as those of the other lights.
    """

    parts: Callable[[], dict]
    bar: float = math.nan
    depth: int = 2
    albedo: float = ALBEDO
    drawn: bool = False
    hidden: bool = False
    catches: bool = False
    rounds: int = 1

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        """The box around extinctions (Z, Y, X), seen in a picture of that size [pixels]."""
        return mi.load_dict(box_scene(values, side, self.albedo, **self.parts()))

    def integrator(self, name: str) -> mi.Integrator:
        """That integrator at this depth."""
        return of_depth(name, self.depth, self.hidden)


CONSTANT, SUN, DIRECTIONAL = "constant light", "HG 0.8, sun in a sky", "HG 0.8, directional"

SHONE = {
    CONSTANT: Light(constant_light),
    "HG 0.8, sun before the camera": Light(sun_before_the_camera, drawn=True),
    "emitter inside": Light(emitter_inside, drawn=True, hidden=True),
    "glass": Light(glass_under_a_sky, catches=True),
}
"""Lights in which the derivative of a picture's mean does not nearly cancel, so that its relative error is soon known. The ball
of light is hidden from the camera: seen directly, the few pixels that it fills would have most of the noise."""

CONTESTS: dict[str, tuple[Callable[[], Extinction], dict[str, Light]]] = {
    "smoke": (smoke, {CONSTANT: Light(constant_light, 60), SUN: Light(sun_and_sky, 30)}),
    "deep smoke": (
        smoke,
        {
            CONSTANT: Light(constant_light, 100, 6),
            SUN: Light(sun_and_sky, 100, 6),
            DIRECTIONAL: Light(directional_light, 35, 6),
        },
    ),
    "deep fine smoke": (lambda: fine_smoke(128), {CONSTANT: Light(constant_light, 40, 6), SUN: Light(sun_and_sky, 20, 6)}),
    "deep cloud": (les_cloud, {SUN: Light(sun_and_sky, 80, 6, 0.999, rounds=6)}),
}
"""Volumes and lights in which variance x time is compared, by question."""

TABLES: dict[str, dict[str, Light]] = {
    "estimators": {CONSTANT: Light(constant_light), SUN: Light(sun_and_sky)},
    "deep estimators": {
        f"{name}, {'depth 6' if depth > 0 else 'unlimited'}": replace(light, depth=depth)
        for depth in (6, -1)
        for name, light in SHONE.items()
    },
}
"""Lights in which estimators are compared with finite differences, or with the twin, by question."""

TUTORIALS: dict[str, tuple[int, float, float]] = {"tutorial": (2, 20, math.nan), "deep tutorial": (6, 60, 30)}
"""``max_depth`` of the tutorial, and how many times sooner mivol has to have prbvolpath's last and its lowest loss."""


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        rounds, side, budget: gradients of the smoke: how many, of how large a picture [pixels], samples of one gradient.
        table_rounds, table_side, table_budget, table_res: the same for the table of biases, and its voxels along an edge.
        derivative_spp: samples per pixel of each of our derivatives in that table.
        difference_spp: samples per pixel of each picture of a finite difference, and of each derivative of the twin.
        certain_percent: how well the means of the table have to be known.
        most_estimates: of which such a mean is made at most.
        reference_spp, check_spp, loss_spp: samples of the tutorial's references, of those by volpath, of its image loss.
        resolutions, steps, step_spp: of the tutorial's stages.
        seed: of the gradients and differences; another one gives independent ones.
    """

    name: str = "full"
    rounds: int = 8
    side: int = 64
    budget: Budget = field(default=Budget(seconds=2.0))
    table_rounds: int = 16
    table_side: int = 24
    table_budget: Budget = field(default=Budget(seconds=0.4))
    table_res: int = 16
    derivative_spp: int = 256
    difference_spp: int = 1024
    certain_percent: float = 0.06
    most_estimates: int = 750
    reference_spp: int = 4096
    check_spp: int = 4
    loss_spp: int = 32
    resolutions: tuple[int, ...] = (16, 64)
    steps: tuple[int, ...] = (20, 20)
    step_spp: tuple[int, ...] = (8, 64)
    seed: int = 0


FULL = Size()
QUICK = Size(
    name="quick",
    rounds=5,
    side=12,
    budget=Budget(seconds=0.05),
    table_rounds=8,
    table_side=8,
    table_budget=Budget(seconds=0.05),
    table_res=6,
    derivative_spp=64,
    difference_spp=256,
    certain_percent=math.inf,
    reference_spp=256,
    check_spp=4,
    loss_spp=16,
    resolutions=(4, 8),
    steps=(2, 2),
    step_spp=(2, 4),
)
