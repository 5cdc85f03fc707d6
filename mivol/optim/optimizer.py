"""Base classes of optimizers: the settings, and the started run.

Conventions. An :class:`Optimizer` holds settings only. :meth:`Optimizer.begin` returns an :class:`OptimizerRun`, which owns the
reals. :meth:`OptimizerRun.step` completes or, interrupted at a safe point, leaves the run unchanged. ``pack`` returns and
``unpack`` restores all inputs of the next step, and a restored run continues with the same bits.
"""

from __future__ import annotations

from typing import Annotated

import mitsuba as mi
import numpy as np

from mivol.optim.problem import Problem, Reals, Refinement
from mivol.optim.strategy import Strategy, setting


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
        int, setting("view", "views per iteration, drawn without replacement; 0 leaves it to the problem", ge=0)
    ] = 0
