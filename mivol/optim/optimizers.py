"""Optimizers by name, and the adapter for the optimizers of ``mi.ad``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.first_order import Adam, RMSprop
from mivol.optim.optimizer import Optimizer, OptimizerRun
from mivol.optim.problem import DifferentiableProblem
from mivol.optim.second_order import GaussNewton, Lbfgs
from mivol.optim.strategy import make_table

OPTIMIZERS = make_table(Adam, RMSprop, Lbfgs, GaussNewton)


class MitsubaOptimizer(Optimizer, tag="given", kw_only=True):
    """An optimiser of ``mi.ad``, at the learning rate that it was made with.

    Its state is its own, so that such a fit has no checkpoint.
    """

    optimiser: Any

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        return MitsubaOptimizerRun(self, problem)


class MitsubaOptimizerRun(OptimizerRun):
    """State: the reals, and whatever the optimiser keeps."""

    def __init__(self, settings: MitsubaOptimizer, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.optimiser = settings.optimiser
        self.optimiser.update(self.reals)
        self.rates = {name: self.optimiser.learning_rate(name) for name in self.reals}

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, gradients = self.problem.loss_and_gradient(self.reals, iteration)
        if factor != 1.0:
            self.optimiser.set_learning_rate({name: rate * factor for name, rate in self.rates.items()})
        for name, gradient in gradients.items():
            dr.enable_grad(self.optimiser[name])
            dr.set_grad(self.optimiser[name], gradient)
        self.optimiser.step()
        stepped = {name: dr.detach(self.optimiser[name]) for name in self.reals}
        self.reals = self.problem.after_step(stepped, iteration)
        for name, value in self.reals.items():
            self.optimiser[name] = value
        return loss

    def pack(self) -> dict[str, np.ndarray]:
        raise MivolError(
            f"the state of {type(self.optimiser).__name__} is its own, and cannot be kept in a checkpoint: leave store out, or "
            "take one of mivol's optimisers."
        )

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.optimiser[name] = reals
        self.optimiser.reset(name)


def to_optimizer(given: Optimizer | mi.ad.Optimizer) -> Optimizer:
    """One of OPTIMISERS as it is, one of ``mi.ad`` as an optimiser.

    Raises:
        MivolError: it is neither, or a class of which no object was made.
    """
    if isinstance(given, type):
        raise MivolError(f"an optimiser is an object, found the class {given.__name__}: call it, as {given.__name__}(...).")
    if hasattr(given, "begin"):
        return given
    if not isinstance(given, mi.ad.Optimizer):
        raise MivolError(
            f"an optimiser is one of mivol's, one of mi.ad, or has a method begin(problem), found {type(given).__name__}."
        )
    return MitsubaOptimizer(optimiser=given)
