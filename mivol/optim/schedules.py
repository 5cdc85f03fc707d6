"""Schedules: factors on the learning rate by iteration.

Conventions. ``factor(iteration, iterations)`` takes ``iteration`` in 0 .. iterations - 1; every schedule starts at 1. SCHEDULES
lists the schedules available in files.
"""

from __future__ import annotations

import math
from typing import Annotated

from mivol.optim.strategy import Strategy, make_table, setting


class Schedule(Strategy, tag="schedule"):
    """A factor on the learning rate, per iteration."""

    def factor(self, iteration: int, iterations: int) -> float:
        """Factor in [0, 1] of iteration ``iteration`` out of ``iterations``."""
        raise NotImplementedError


class Constant(Schedule, tag="constant"):
    """A constant factor of 1."""

    def factor(self, iteration: int, iterations: int) -> float:
        return 1.0


class Cosine(Schedule, tag="cosine"):
    """Half a cosine from 1 down to ``final``. Source: Loshchilov and Hutter 2017, SGDR, Eq. 5 (one period)."""

    final: Annotated[float, setting("1", "factor of the last iteration", ge=0, le=1)] = 0.0

    def factor(self, iteration: int, iterations: int) -> float:
        progress = iteration / max(iterations - 1, 1)
        return self.final + (1.0 - self.final) * 0.5 * (1.0 + math.cos(math.pi * progress))


class Step(Schedule, tag="step"):
    """A product of factors ``ratio``, one after each fraction ``at`` of the run."""

    at: Annotated[tuple[float, ...], setting("fraction of the run", "points at which the rate drops")] = (0.75, 0.85, 0.95)
    ratio: Annotated[float, setting("1", "factor at each drop", gt=0, le=1)] = 0.5

    def factor(self, iteration: int, iterations: int) -> float:
        return self.ratio ** sum(iteration >= fraction * iterations for fraction in self.at)


class Exponential(Schedule, tag="exponential"):
    """1 for the first ``delay`` iterations, then geometric decay to ``final`` in the last iteration."""

    final: Annotated[float, setting("1", "factor of the last iteration", gt=0, le=1)] = 0.1
    delay: Annotated[int, setting("iteration", "iterations at the full rate", ge=0)] = 0

    def factor(self, iteration: int, iterations: int) -> float:
        progress = max(iteration - self.delay, 0) / max(iterations - 1 - self.delay, 1)
        return self.final ** min(progress, 1.0)


SCHEDULES = make_table(Constant, Cosine, Step, Exponential)
