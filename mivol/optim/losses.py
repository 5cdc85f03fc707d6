r"""Difference between an image and a reference: a penalty per pixel and channel, averaged.

Conventions. Images are tensors (height, width, channels) of radiance; the residual is ``image - reference``. A loss is the mean
penalty over pixels and channels, independent of the size of the sensor. Penalties are differentiable through Dr.Jit in
``image``; weights depend on ``reference`` only. LOSSES lists the losses available in files. The noise of a render adds to
every loss unless ``pairs`` is set (:mod:`mivol.optim.scenes.render_noise`).

Absolute error and structural similarity. Fits of Gaussians minimise

.. math:: f = (1 - \lambda) \, \mathrm{mean} |x - y| + \lambda \, (1 - \mathrm{mean} \, \mathrm{SSIM}(x, y))

with derivatives written out. Images are flat arrays of height x width x 3 numbers, rows from the top, channels interleaved.
Windows are 11 x 11 pixels with Gaussian weights of standard deviation 1.5, applied along columns and then along rows; both
images are 0 beyond the border. Every sum over a window takes two short kernels, whose code is independent of the size.

References: Wang et al. 2004 (IEEE TIP 13: SSIM, its window and constants); Kerbl et al. 2023 (the sum, with lambda = 0.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.strategy import Strategy, check_strategy, make_table, setting


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
        MivolError: the object cannot be called, or as :func:`mivol.optim.strategy.check_strategy`.
    """
    if isinstance(given, type | Loss):
        return check_strategy(given)
    if not callable(given):
        raise MivolError(f"found {type(given).__name__}, expected a loss of mivol or a function of image and reference.")
    return FunctionLoss(function=given)


# -- Absolute error and structural similarity ------------------------------------------------------------------------------


REACH, SIGMA = 5, 1.5
"""Half width and standard deviation of the window [pixel]."""

C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for values in a range of 1."""

WEIGHTS = np.exp(-0.5 * (np.arange(-REACH, REACH + 1) / SIGMA) ** 2)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


@dataclass
class ImageShape:
    """Size of an image on the device, so that kernels do not depend on it: width and height [pixel], and 1 over the number of
    values.
    """

    width: mi.Int32
    height: mi.Int32
    share: mi.Float

    @classmethod
    def of(cls, width: int, height: int) -> ImageShape:
        """The shape of an image of width x height pixels."""
        return cls(dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height), dr.opaque(mi.Float, 1 / (3 * width * height)))


def image_loss(x: mi.Float, y: mi.Float, shape: ImageShape, weight: float) -> tuple[mi.Float, mi.Float]:
    """f, an array of width 1, and the derivative by each number of x; both can be recorded (``dr.freeze``).

    Args:
        x: the image, evaluated.
        y: the photograph, evaluated.
        shape: of both.
        weight: lambda, from 0 (absolute error only) to 1.
    """
    error = x - y
    loss = dr.sum(dr.abs(error)) * shape.share * (1 - weight)
    # The sign of an error of 0 is 0: dr.sign would return 1 and change correct pixels.
    sign = dr.select(error == 0, 0.0, dr.sign(error))
    slope = shape.share * (1 - weight) * sign
    if weight > 0:
        ssim, d_ssim = mean_ssim(x, y, shape)
        loss += weight * (1 - ssim)
        slope -= weight * d_ssim
    return loss, slope


def mean_ssim(x: mi.Float, y: mi.Float, shape: ImageShape) -> tuple[mi.Float, mi.Float]:
    """Mean SSIM over pixels and channels, an array of width 1, and the derivative by each number of x; arguments evaluated."""
    columns, rows = _Axis.along_columns(x, shape), _Axis.along_rows(x, shape)
    sums = columns.blur((x, y), lambda a, b: (a, b, a * a, b * b, a * b))
    mx, my, xx, yy, xy = rows.blur(sums, _identity, evaluate=False)
    a1, a2 = 2 * mx * my + C1, 2 * (xy - mx * my) + C2
    b1, b2 = mx * mx + my * my + C1, xx - mx * mx + yy - my * my + C2
    ssim = a1 * a2 * dr.rcp(b1 * b2)
    # Derivatives by the three sums that contain x: E[x], E[x^2] and E[x y], each with the other two constant.
    by_xx = -ssim * dr.rcp(b2)
    by_xy = 2 * a1 * dr.rcp(b1 * b2)
    by_mx = 2 * my * a2 * dr.rcp(b1 * b2) - 2 * mx * ssim * dr.rcp(b1) - 2 * mx * by_xx - my * by_xy
    dr.eval(ssim, by_mx, by_xx, by_xy)
    # The window is symmetric, so the transpose of a blur with zeros beyond the border is the blur itself.
    sums = columns.blur((by_mx, by_xx, by_xy), _identity)
    by_mx, by_xx, by_xy = rows.blur(sums, _identity, evaluate=False)
    return dr.sum(ssim) * shape.share, (by_mx + 2 * x * by_xx + y * by_xy) * shape.share


def _identity(*values: mi.Float) -> tuple[mi.Float, ...]:
    return values


@dataclass
class _Axis:
    """A direction of an image: position of each number along it, number of positions, and distance to the next one in the
    array.
    """

    position: mi.Int32
    count: mi.Int32
    step: mi.Int32

    @classmethod
    def along_columns(cls, picture: mi.Float, shape: ImageShape) -> _Axis:
        return cls(dr.arange(mi.Int32, dr.width(picture)) // 3 % shape.width, shape.width, mi.Int32(3))

    @classmethod
    def along_rows(cls, picture: mi.Float, shape: ImageShape) -> _Axis:
        step = 3 * shape.width
        return cls(dr.arange(mi.Int32, dr.width(picture)) // step, shape.height, step)

    def blur(
        self, arrays: Sequence[mi.Float], function: Callable[..., Sequence[mi.Float]], evaluate: bool = True
    ) -> list[mi.Float]:
        """Weighted sums along the axis of a function of the arrays' numbers.

        The middle is read without a gather: a recording derives the size of a launch from such arrays, and would otherwise take
        the next size, which is 1 here.
        """
        index, sums = dr.arange(mi.Int32, dr.width(arrays[0])), None
        for offset, weight in zip(range(-REACH, REACH + 1), WEIGHTS, strict=True):
            shifted = self.position + offset
            inside = (shifted >= 0) & (shifted < self.count)
            at = index + offset * self.step
            values = function(*(dr.gather(mi.Float, array, at, inside) if offset else array for array in arrays))
            sums = [0] * len(values) if sums is None else sums
            sums = [dr.fma(value, float(weight), total) for value, total in zip(values, sums, strict=True)]
        if evaluate:
            dr.eval(sums)
        return sums
