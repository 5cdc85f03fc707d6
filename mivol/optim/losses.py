"""Difference between an image and a reference: a penalty per pixel and channel, averaged.

Conventions. Images are tensors (height, width, channels) of radiance; the residual is ``image - reference``. A loss is the mean
penalty over pixels and channels, independent of the size of the sensor. Penalties are differentiable through Dr.Jit in
``image``; weights depend on ``reference`` only. LOSSES lists the losses available in files. The noise of a render adds to
every loss unless ``pairs`` is set (:mod:`mivol.optim.scenes.render_noise`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.optim.strategy import Strategy, make_table, setting


class Loss(Strategy, tag="loss"):
    """A penalty per pixel and channel.

    ``is_squared`` marks penalties of the form W/2 r^2. For these, pairs remove the render's noise exactly, and the gradient,
    carried back by independent samples, has no bias even without pairs. ``unit`` is the unit of a penalty, for labels ("":
    unknown).
    """

    is_squared: ClassVar[bool] = False
    unit: ClassVar[str] = ""

    pairs: Annotated[bool, setting("1", "remove the noise of renders from the loss, by two renders of half the samples")] = (
        False
    )

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        """Penalty of each pixel and channel, same shape as ``image``."""
        raise NotImplementedError

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        """W of the form 1/2 W (I - I_ref)^2, for Gauss-Newton.

        Raises:
            MivolError: the loss is not quadratic in the image.
        """
        raise MivolError(
            f'gauss_newton needs a loss that is quadratic in the image, found "{self.label()}": '
            'choose "l2" or "relative_l2", or another optimizer.'
        )

    def __call__(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
        """Mean penalty.

        Raises:
            MivolError: the shapes differ.
        """
        check_shapes(image, reference)
        return dr.mean(self.penalty(image, reference).array)


def check_shapes(image: mi.TensorXf, reference: mi.TensorXf) -> None:
    """Check the shapes of an image and a reference.

    Raises:
        MivolError: different shapes.
    """
    if image.shape != reference.shape:
        raise MivolError(
            f"the image has shape {tuple(image.shape)} and its reference {tuple(reference.shape)}: "
            "render or crop the reference to the size of its sensor."
        )


class L1(Loss, tag="l1"):
    """|r|: fits the median of noisy references; robust against outliers."""

    unit = "radiance"

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.abs(image - reference)


class L2(Loss, tag="l2"):
    """r^2: fits the mean of noisy references; maximum likelihood for equal Gaussian noise."""

    is_squared = True
    unit = "radiance²"

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.square(image - reference)

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.full(mi.TensorXf, 2.0, reference.shape)


class RelativeL2(Loss, tag="relative_l2"):
    """r^2 / (I_ref^2 + floor^2): equal weight for dark and bright pixels.

    Noise of the reference enters the weight and favours pixels that are too dark: keep ``floor`` above the noise. Source:
    Lehtinen et al. 2018, Noise2Noise, section 3.3 (their denominator is the prediction, held fixed, which a line search does
    not allow).
    """

    is_squared = True
    unit = "1"

    floor: Annotated[float, setting("radiance", "smallest radiance in the weight of a pixel", gt=0)] = 1e-2

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.square(image - reference) / (dr.square(reference) + self.floor**2)

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        return 2.0 / (dr.square(reference) + self.floor**2)


class Huber(Loss, tag="huber"):
    """r^2 / 2 for |r| <= delta, delta (|r| - delta / 2) beyond: quadratic inside the noise, linear outside.

    Source: Huber 1964, Annals of Mathematical Statistics 35(1).
    """

    cites = ("huber_1964",)
    unit = "radiance²"

    delta: Annotated[float, setting("radiance", "residual at which the parabola turns into a line", gt=0)] = 0.1

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        size = dr.abs(image - reference)
        return dr.select(size <= self.delta, 0.5 * dr.square(size), self.delta * (size - 0.5 * self.delta))


def log_radiance(radiance: mi.TensorXf, floor: float) -> mi.TensorXf:
    """log(radiance), continued below ``floor`` by its tangent.

    The tangent keeps value and slope finite for radiance of 0 or below, from underflow or noise. Its slope 1 / floor leads back
    above the floor. The function is monotone and once continuously differentiable.
    """
    tangent = math.log(floor) + (radiance - floor) / floor
    return dr.select(radiance > floor, dr.log(dr.maximum(radiance, floor)), tangent)


class Log(Loss, tag="log"):
    """w (log I - log I_ref)^2: linear in the optical depth of a single ray at every transmittance.

    The weight w = I_ref^2 / (I_ref^2 + floor^2) follows from the delta method (the variance of log I_ref is var(I) / I^2) for
    constant noise of ``floor``. Saturated pixels (I_ref far below ``floor``) and negative pixels have no weight. Pixels
    brighter than the light have negative optical depths and keep their weight. Source: Elbakri and Fessler 2002, IEEE TMI
    21(2).
    """

    unit = "1"

    floor: Annotated[float, setting("radiance", "noise of a pixel; the log continues below as its tangent", gt=0)] = 1e-3

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        signal = dr.square(dr.maximum(reference, 0.0))
        weight = signal / (signal + self.floor**2)
        return weight * dr.square(log_radiance(image, self.floor) - log_radiance(reference, self.floor))


LOSSES = make_table(L1, L2, RelativeL2, Huber, Log)
"""Losses available in files."""


class FunctionLoss(Loss, tag="given", kw_only=True):
    """A function (image, reference) -> number, evaluated for one view at a time: it may read neighbouring pixels, which views
    in one image would mix.

    Both arguments are tensors (height, width, channels); the number is differentiable through Dr.Jit in ``image``.
    """

    function: Callable[[mi.TensorXf, mi.TensorXf], Any]

    def __call__(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
        """The function's number.

        Raises:
            MivolError: image and reference differ in shape, or the result is no number, or does not depend on the image.
        """
        check_shapes(image, reference)
        value = self.function(image, reference)
        name = getattr(self.function, "__name__", type(self.function).__name__)
        if not dr.is_array_v(value) or dr.width(value) != 1 or not dr.is_float_v(value):
            size = f" of shape {tuple(value.shape)}" if hasattr(value, "shape") else ""
            raise MivolError(
                f'the loss "{name}" returned a {type(value).__name__}{size}, expected one Dr.Jit number: end it with '
                "dr.mean(..., axis=None)."
            )
        if dr.grad_enabled(image) and not dr.grad_enabled(value):
            raise MivolError(
                f'the loss "{name}" has no derivative by the image: compute it with Dr.Jit, without detach or NumPy.'
            )
        return value.array if dr.is_tensor_v(value) else value


def to_loss(given: Loss | Callable[[mi.TensorXf, mi.TensorXf], Any]) -> Loss:
    """A loss of mivol unchanged; another function of two images as a loss.

    Raises:
        MivolError: the object cannot be called.
    """
    if isinstance(given, Loss):
        return given
    if not callable(given):
        raise MivolError(f"found {type(given).__name__}, expected a loss of mivol or a function of image and reference.")
    return FunctionLoss(function=given)
