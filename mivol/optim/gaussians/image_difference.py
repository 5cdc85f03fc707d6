r"""Difference between an image and a photograph: absolute error and structural similarity, with derivatives.

.. math:: f = (1 - \lambda) \, \mathrm{mean} |x - y| + \lambda \, (1 - \mathrm{mean} \, \mathrm{SSIM}(x, y))

Conventions. Images are flat arrays of height x width x 3 numbers, rows from the top, channels interleaved. Windows are 11 x 11
pixels with Gaussian weights of standard deviation 1.5, applied along columns and then along rows; both images are 0 beyond the
border. Derivatives are written out: every sum over a window takes two short kernels, whose code is independent of the size.

References: Wang et al. 2004 (IEEE TIP 13: SSIM, its window and constants); Kerbl et al. 2023 (the sum, with lambda = 0.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

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
    """f, an array of width 1, and its derivative by each number of x; both can be recorded (``dr.freeze``).

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
    """Mean SSIM over pixels and channels, an array of width 1, and its derivative by each number of x; arguments evaluated."""
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
