"""Base classes of optimizers: the settings, and the run that they start.

Conventions. An :class:`Optimizer` holds settings only. :meth:`Optimizer.begin` returns an :class:`OptimizerRun`, which owns the
reals. :meth:`OptimizerRun.step` completes or, interrupted at a safe point, leaves the run unchanged. ``pack`` returns and
``unpack`` restores all inputs of the next step, so a restored run continues with the same bits.
"""

from __future__ import annotations

from typing import Annotated

import mitsuba as mi
import numpy as np

from mivol.optim.problem import Problem, Reals, Refinement
from mivol.optim.strategy import Strategy, setting


class OptimizerRun:
    """An optimiser at work.

    Attributes:
        problem: what is minimised.
        reals: the newest point.
        stop_reason: why there is nothing left to gain, or "".
    """

    stop_reason = ""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.reals: Reals = problem.initial_reals()

    def step(self, iteration: int, factor: float) -> float | mi.Float | None:
        """One iteration with the learning rate times ``factor``.

        Returns:
            The loss as the step met it; None where there was nothing left to gain and no step was taken.
        """
        raise NotImplementedError

    def pack(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on, as arrays."""
        return {f"reals/{name}": np.array(value) for name, value in self.reals.items()}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        """Continue from what :meth:`pack` gave."""
        self.reals = {name: mi.TensorXf(arrays[f"reals/{name}"]) for name in self.reals}

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        """Give a parameter another value, of another shape perhaps: what was learnt about its old one is dropped."""
        self.reals = {**self.reals, name: reals}

    def refine(self, refinement: Refinement) -> None:
        """Go over to other unknowns: what was learnt about the old ones is dropped, unless the optimiser can carry it over."""
        for name, value in refinement.reals.items():
            self.replace(name, value)


class Optimizer(Strategy, tag="optimiser"):
    """Settings of a minimisation."""

    def begin(self, problem: Problem) -> OptimizerRun:
        """Start from the values that the problem holds."""
        raise NotImplementedError


class FirstOrder(Optimizer, tag="first order"):
    """Settings of a minimisation along gradients, of some of the views at a time where that is asked for."""

    views: Annotated[
        int, setting("view", "views per iteration, drawn without replacement; 0 leaves it to the problem", ge=0)
    ] = 0
