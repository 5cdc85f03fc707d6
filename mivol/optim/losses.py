"""Difference between an image and its reference: one penalty per pixel and channel, averaged.

Conventions. Images are tensors (height, width, channels) of radiance; the residual is ``image - reference``. A loss is the mean
penalty over pixels and channels, independent of the size of the sensor. Penalties are differentiable through Dr.Jit in
``image``; weights depend on ``reference`` only. LOSSES lists the losses that a file can name. The noise of a render adds to
every loss unless ``pairs`` removes it (:mod:`mivol.optim.scenes.render_noise`).
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

    ``is_squared`` tells that it is W/2 r^2: then pairs take the render's noise out exactly, and its gradient, carried
    back by samples of its own, has no bias in any case. ``unit`` is that of a penalty, for labels ("": not known).
    """

    is_squared: ClassVar[bool] = False
    unit: ClassVar[str] = ""

    pairs: Annotated[bool, setting("1", "take the noise of renders out of the loss, by two renders of half the samples")] = (
        False
    )

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        """Penalty of each pixel and channel, same shape as ``image``."""
        raise NotImplementedError

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        """W of the form 1/2 W (I - I_ref)^2, for Gauss-Newton; only quadratic losses have one.

        Raises:
            MivolError: the loss is not quadratic in the image.
        """
        raise MivolError(
            f'gauss_newton needs a loss that is quadratic in the image, found "{self.label()}": '
            'choose "l2" or "relative_l2", or another optimiser.'
        )

    def __call__(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
        """Mean penalty.

        Raises:
            MivolError: the shapes differ.
        """
        check_shapes(image, reference)
        return dr.mean(self.penalty(image, reference).array)


def check_shapes(image: mi.TensorXf, reference: mi.TensorXf) -> None:
    """Refuse an image and a reference that differ in shape.

    Raises:
        MivolError: with both.
    """
    if image.shape != reference.shape:
        raise MivolError(
            f"the image has shape {tuple(image.shape)} and its reference {tuple(reference.shape)}: "
            "render or crop the reference to the size of its sensor."
        )


class L1(Loss, tag="l1"):
    """|r|: the median of noisy references; robust against outliers."""

    unit = "radiance"

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.abs(image - reference)


class L2(Loss, tag="l2"):
    """r^2: the mean of noisy references; maximum likelihood for equal Gaussian noise."""

    is_squared = True
    unit = "radiance²"

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.square(image - reference)

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.full(mi.TensorXf, 2.0, reference.shape)


class RelativeL2(Loss, tag="relative_l2"):
    """r^2 / (I_ref^2 + floor^2): dark and bright pixels count alike.

    The noise of the reference enters the weight, which favours pixels that came out too dark: keep ``floor`` above the
    noise. Source: Lehtinen et al. 2018, Noise2Noise, section 3.3 (there with the prediction in the denominator, held
    fixed, which a line search does not allow).
    """

    is_squared = True
    unit = "1"

    floor: Annotated[float, setting("radiance", "pixels darker than this count as if they were this bright", gt=0)] = 1e-2

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        return dr.square(image - reference) / (dr.square(reference) + self.floor**2)

    def weight(self, reference: mi.TensorXf) -> mi.TensorXf:
        return 2.0 / (dr.square(reference) + self.floor**2)


class Huber(Loss, tag="huber"):
    """r^2 / 2 where |r| <= delta, delta (|r| - delta / 2) beyond: quadratic inside the noise, linear outside it.

    Source: Huber 1964, Annals of Mathematical Statistics 35(1).
    """

    cites = ("huber_1964",)
    unit = "radiance²"

    delta: Annotated[float, setting("radiance", "residual at which the parabola goes over into a line", gt=0)] = 0.1

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        size = dr.abs(image - reference)
        return dr.select(size <= self.delta, 0.5 * dr.square(size), self.delta * (size - 0.5 * self.delta))


def log_radiance(radiance: mi.TensorXf, floor: float) -> mi.TensorXf:
    """log(radiance), continued below ``floor`` by its tangent.

    The tangent keeps value and slope finite for radiance that underflowed to 0 or that noise made negative, and keeps
    the slope (1 / floor) that leads back; the function is monotone and once continuously differentiable.
    """
    tangent = math.log(floor) + (radiance - floor) / floor
    return dr.select(radiance > floor, dr.log(dr.maximum(radiance, floor)), tangent)


class Log(Loss, tag="log"):
    """w (log I - log I_ref)^2: linear in the optical depth of a pencil ray, whatever its transmittance.

    The weight w = I_ref^2 / (I_ref^2 + floor^2) is the delta method's (the variance of log I_ref is var(I) / I^2) for
    constant noise of ``floor``: saturated pixels count for nothing, and so do negative ones. Pixels brighter than the
    light are negative optical depths, and are kept. Source: Elbakri and Fessler 2002, IEEE TMI 21(2).
    """

    unit = "1"

    floor: Annotated[float, setting("radiance", "noise of a pixel; below it the log goes on as its tangent", gt=0)] = 1e-3

    def penalty(self, image: mi.TensorXf, reference: mi.TensorXf) -> mi.TensorXf:
        seen = dr.square(dr.maximum(reference, 0.0))
        weight = seen / (seen + self.floor**2)
        return weight * dr.square(log_radiance(image, self.floor) - log_radiance(reference, self.floor))


LOSSES = make_table(L1, L2, RelativeL2, Huber, Log)


class FunctionLoss(Loss, tag="given", kw_only=True):
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


def to_loss(given: Loss | Callable[[mi.TensorXf, mi.TensorXf], Any]) -> Loss:
    """One of LOSSES as it is, any other function of two images as a loss.

    Raises:
        MivolError: it cannot be called.
    """
    if isinstance(given, Loss):
        return given
    if not callable(given):
        raise MivolError(f"a loss is one of mivol's or a function of image and reference, found {type(given).__name__}.")
    return FunctionLoss(function=given)
