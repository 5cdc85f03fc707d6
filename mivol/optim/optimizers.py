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
from mivol.optim.strategy import check_strategy, make_table

OPTIMIZERS = make_table(Adam, RMSprop, Lbfgs, GaussNewton)
"""Optimizers available in files."""


class MitsubaOptimizer(Optimizer, tag="given", kw_only=True):
    """An optimizer of ``mi.ad`` with separate learning rates.

    Mivol cannot save the optimizer's state, and the fit has no checkpoint.
    """

    optimizer: Any

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        return MitsubaOptimizerRun(self, problem)


class MitsubaOptimizerRun(OptimizerRun):
    """State: the reals, and the state of the Mitsuba optimizer."""

    def __init__(self, settings: MitsubaOptimizer, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.optimizer = settings.optimizer
        self.optimizer.update(self.reals)
        self.rates = {name: self.optimizer.learning_rate(name) for name in self.reals}

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, gradients = self.problem.loss_and_gradient(self.reals, iteration)
        if factor != 1.0:
            self.optimizer.set_learning_rate({name: rate * factor for name, rate in self.rates.items()})
        for name, gradient in gradients.items():
            dr.enable_grad(self.optimizer[name])
            dr.set_grad(self.optimizer[name], gradient)
        self.optimizer.step()
        stepped = {name: dr.detach(self.optimizer[name]) for name in self.reals}
        self.reals = self.problem.after_step(stepped, iteration)
        for name, value in self.reals.items():
            self.optimizer[name] = value
        return loss

    def pack(self) -> dict[str, np.ndarray]:
        raise MivolError(
            f"mivol cannot save the state of {type(self.optimizer).__name__} in a checkpoint: leave checkpoint out, or "
            "choose one of mivol's optimizers."
        )

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.optimizer[name] = reals
        self.optimizer.reset(name)


def to_optimizer(given: Optimizer | mi.ad.Optimizer) -> Optimizer:
    """An optimizer of mivol unchanged; an optimizer of ``mi.ad`` in its adapter.

    Raises:
        MivolError: an object of another type, or as :func:`mivol.optim.strategy.check_strategy`.
    """
    if isinstance(given, type | Optimizer):
        return check_strategy(given)
    if hasattr(given, "begin"):
        return given
    if not isinstance(given, mi.ad.Optimizer):
        raise MivolError(
            f"found {type(given).__name__}, expected an optimizer of mivol or of mi.ad, or an object with begin(problem)."
        )
    return MitsubaOptimizer(optimizer=given)
