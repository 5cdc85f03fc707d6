"""Base classes of optimizers: the settings, and the started run; schedules of the learning rate.

Conventions. An :class:`Optimizer` holds settings only. :meth:`Optimizer.begin` returns an :class:`OptimizerRun`, which owns the
reals. :meth:`OptimizerRun.step` completes or, interrupted at a safe point, leaves the run unchanged. ``pack`` returns and
``unpack`` restores all inputs of the next step, and a restored run continues with the same bits.

A schedule is a factor on the learning rate by iteration. ``factor(iteration, iterations)`` takes ``iteration`` in
0 .. iterations - 1; every schedule starts at 1. SCHEDULES lists the schedules available in files.
"""

from __future__ import annotations

import math
from typing import Annotated

import mitsuba as mi
import numpy as np

from mivol.optim.problem import Problem, Reals, Refinement
from mivol.optim.strategy import Strategy, make_table, setting


class OptimizerRun:
    """An optimizer in progress.

    Attributes:
        problem: the problem to minimise.
        reals: the latest point.
        stop_reason: why no further step helps, or "".
    """

    stop_reason = ""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.reals: Reals = problem.initial_reals()

    def step(self, iteration: int, factor: float) -> float | mi.Float | None:
        """Take an iteration with learning rates times ``factor``.

        Returns:
            The loss before the step; None if the optimizer had stopped.
        """
        raise NotImplementedError

    def warning(self) -> str:
        """A sentence about a fault that slows the steps down, or ""."""
        return ""

    def pack(self) -> dict[str, np.ndarray]:
        """All inputs of the next step, as arrays."""
        return {f"reals/{name}": np.array(value) for name, value in self.reals.items()}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        """Continue from the arrays of :meth:`pack`."""
        self.reals = {name: mi.TensorXf(arrays[f"reals/{name}"]) for name in self.reals}

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        """Give a parameter another value, possibly of another shape, and drop its moments."""
        self.reals = {**self.reals, name: reals}

    def refine(self, refinement: Refinement) -> None:
        """Change to other unknowns. Moments are dropped unless the optimizer can carry them over."""
        for name, value in refinement.reals.items():
            self.replace(name, value)


class Optimizer(Strategy, tag="optimizer"):
    """Settings of a minimisation."""

    def begin(self, problem: Problem) -> OptimizerRun:
        """Start from the problem's present values."""
        raise NotImplementedError


class FirstOrder(Optimizer, tag="first order"):
    """Settings of a minimisation along gradients, optionally of a few views per iteration."""

    views: Annotated[
        int, setting("view", "views per iteration, drawn without replacement; 0: all of a scene, or as the preset says", ge=0)
    ] = 0


# -- Schedules ---------------------------------------------------------------------------------------------------------


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
