"""Losses and optimisers that a script brings along: any function of two images, any ``mi.ad`` optimiser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.losses import Loss, check_shapes
from mivol.optim.optimiser import Optimiser, Run
from mivol.optim.problem import Differentiable

__all__ = ["GivenLoss", "GivenOptimiser", "as_loss", "as_optimiser"]


class GivenLoss(Loss, tag="given", kw_only=True):
    """A function (image, reference) -> number, of one view at a time: it may look at neighbours, which views side by side would
    give it wrong ones of.

    Both are tensors (height, width, channels); the number is differentiable through Dr.Jit in ``image``.
    """

    function: Callable[[mi.TensorXf, mi.TensorXf], Any]

    def __call__(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
        """The function's number.

        Raises:
            MivolError: image and reference differ in shape, or it gives something else, or nothing that depends on the image.
        """
        check_shapes(image, reference)
        value = self.function(image, reference)
        name = getattr(self.function, "__name__", type(self.function).__name__)
        if not dr.is_array_v(value) or dr.width(value) != 1 or not dr.is_float_v(value):
            size = f" of shape {tuple(value.shape)}" if hasattr(value, "shape") else ""
            raise MivolError(
                f'the loss "{name}" gave a {type(value).__name__}{size}, expected one number that Dr.Jit holds: end it with '
                "dr.mean(..., axis=None)."
            )
        if dr.grad_enabled(image) and not dr.grad_enabled(value):
            raise MivolError(
                f'no derivative leads from the loss "{name}" to the image: compute it by Dr.Jit, without detach or NumPy.'
            )
        return value.array if dr.is_tensor_v(value) else value


class GivenOptimiser(Optimiser, tag="given", kw_only=True):
    """An optimiser of ``mi.ad``, at the learning rate that it was made with.

    Its state is its own, so that such a fit has no checkpoint.
    """

    optimiser: Any

    def begin(self, problem: Differentiable) -> Run:
        return GivenRun(self, problem)


class GivenRun(Run):
    """State: the reals, and whatever the optimiser keeps."""

    def __init__(self, settings: GivenOptimiser, problem: Differentiable) -> None:
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


def as_loss(given: Loss | Callable[[mi.TensorXf, mi.TensorXf], Any]) -> Loss:
    """One of LOSSES as it is, any other function of two images as a loss.

    Raises:
        MivolError: it cannot be called.
    """
    if isinstance(given, Loss):
        return given
    if not callable(given):
        raise MivolError(f"a loss is one of mivol's or a function of image and reference, found {type(given).__name__}.")
    return GivenLoss(function=given)


def as_optimiser(given: Optimiser | mi.ad.Optimizer) -> Optimiser:
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
    return GivenOptimiser(optimiser=given)
