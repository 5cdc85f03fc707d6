"""How much work the bench of gradients does, and in which lights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from mivol.bench.scenes import constant_light, sun_and_sky
from mivol.bench.timing import Budget

__all__ = ["ALBEDO", "BARS", "FULL", "LIGHTS", "OURS", "QUICK", "STOCK", "Size"]

ALBEDO = 0.75
OURS, STOCK = "mivol", "prbvolpath"

LIGHTS: dict[str, Callable[[], dict]] = {"constant light": constant_light, "HG 0.8, sun in a sky": sun_and_sky}
BARS = {"constant light": 60, "HG 0.8, sun in a sky": 30}
"""How many times sooner mivol's gradient has to be as exact, in each light."""


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        rounds, side, budget: gradients of the smoke: how many, of how large a picture [pixels], samples of one gradient.
        table_rounds, table_side, table_budget, table_res: the same for the table of biases, and its voxels along an edge.
        difference_spp: samples per pixel of each picture of a finite difference.
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
    difference_spp=256,
    certain_percent=math.inf,
    reference_spp=256,
    check_spp=4,
    loss_spp=16,
    resolutions=(4, 8),
    steps=(2, 2),
    step_spp=(2, 4),
)
