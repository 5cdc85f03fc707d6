r"""What a fit makes of the numbers of its photographs: the reals that a step moves, and what an error in a pixel weighs.

Codes of 8 bits are even to the eye, so their reals are the colours themselves and all errors weigh the same. Radiance spans
orders of magnitude. Its reals are :math:`r = \mathrm{asinh}(c)`, near 0 the colour and far from it its logarithm, so one
learning rate moves lamps and shadows by like shares. An error weighs the slope of a tone curve :math:`\log(y + \epsilon)`,

.. math:: L = \sum_i \Big(\frac{\hat y_i - y_i}{\mathrm{sg}(\hat y_i) + \epsilon}\Big)^2,

where sg takes its argument for a constant: the weight is that of the last step, not a thing to be made smaller.

Source: Mildenhall et al. 2022 (NeRF in the Dark, eq. 4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["SCALES", "SrgbScale", "LinearScale"]

EPSILON = 0.1
"""Radiance, over that which is shown white, below which errors weigh about the same. Mildenhall et al. have 0.001: tone-mapped
views of the ball of tests/optim/test_colour_scale.py then have 31.2 dB in place of 39.8 (45.9
and 45.5 after four times the steps)."""


@dataclass(frozen=True)
class SrgbScale:
    """Code values of sRGB.

    Attributes:
        rate: factor on the learning rates of colours.
    """

    rate: ClassVar[float] = 1.0

    def reals_of(self, colours: mi.Float) -> mi.Float:
        """Reals of coefficients of colours, or of texels."""
        return colours

    def colours_of(self, reals: mi.Float) -> mi.Float:
        """The inverse of :meth:`reals_of`."""
        return reals

    def by_reals(self, slopes: mi.Float, reals: mi.Float) -> mi.Float:
        """Derivatives by reals, of those by colours."""
        return slopes

    def weight(self, shown: mi.Color3f) -> mi.Color3f:
        """By what an error is multiplied where the fit shows a colour."""
        return mi.Color3f(1)

    def fog(self, pixels: Callable[[], np.ndarray]) -> np.ndarray:
        """The colour (3,) of the fog that a fit begins with, of the pixels (N, 3) that it is to explain, if asked."""
        return np.full(3, 0.5)


@dataclass(frozen=True)
class LinearScale:
    """Linear light, in units of about what is shown white; what there is is that of :class:`SrgbScale`."""

    rate: ClassVar[float] = 4.0
    """A lamp of 100 is as far from grey, in reals, as white would be in codes three times as large; with 4 it is reached."""

    def reals_of(self, colours: mi.Float) -> mi.Float:
        """Numbers that grow with the logarithm of what is large."""
        return dr.asinh(colours)

    def colours_of(self, reals: mi.Float) -> mi.Float:
        """The inverse of :meth:`reals_of`."""
        return dr.sinh(reals)

    def by_reals(self, slopes: mi.Float, reals: mi.Float) -> mi.Float:
        """Derivatives by reals, of those by colours."""
        return slopes * dr.cosh(reals)

    def fog(self, pixels: Callable[[], np.ndarray]) -> np.ndarray:
        """Half of what the brightest hundredth of the pixels has, at most that of codes.

        A fog brighter than all that is seen is taken away before it has learnt a colour, and for good: densities below 0 have
        no derivative.
        """
        found = pixels()
        return np.minimum(np.quantile(found, 0.99, axis=0) / 2, 0.5) if len(found) else np.full(3, 0.5)

    def weight(self, shown: mi.Color3f) -> mi.Color3f:
        """The slope of the tone curve."""
        return dr.rcp(dr.maximum(dr.detach(shown), 0) + EPSILON)


SCALES: dict[str, SrgbScale | LinearScale] = {"srgb": SrgbScale(), "linear": LinearScale()}
"""By what the values of photographs are (:data:`mivol.photos.photo_file.SPACES`)."""
