r"""Scales of colours in a fit: the reals of a colour, and the weight of a pixel's error.

8-bit codes are perceptually uniform, so their reals are the colours themselves and all errors have equal weight. Radiance spans
orders of magnitude. Its reals are :math:`r = \mathrm{asinh}(c)`, the colour near 0 and its logarithm far from 0, so one
learning rate changes lamps and shadows by equal factors. The weight of an error is the slope of a tone curve :math:`\log(y +
\epsilon)`,

.. math:: L = \sum_i \Big(\frac{\hat y_i - y_i}{\mathrm{sg}(\hat y_i) + \epsilon}\Big)^2,

where sg makes its argument a constant: the weight comes from the last step and has no derivative.

Source: Mildenhall et al. 2022 (NeRF in the Dark, eq. 4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

EPSILON = 0.1
"""Radiance, relative to white, below which all errors have about the same weight. Mildenhall et al. use 0.001."""


@dataclass(frozen=True)
class SrgbScale:
    """Code values of sRGB.

    Attributes:
        rate: factor on the learning rates of colours.
    """

    rate: ClassVar[float] = 1.0

    def to_reals(self, colours: mi.Float) -> mi.Float:
        """Reals of colour coefficients, or of texels."""
        return colours

    def to_colours(self, reals: mi.Float) -> mi.Float:
        """The inverse of :meth:`to_reals`."""
        return reals

    def gradient_by_reals(self, slopes: mi.Float, reals: mi.Float) -> mi.Float:
        """Derivatives by reals, from derivatives by colours."""
        return slopes

    def weight(self, colour: mi.Color3f) -> mi.Color3f:
        """Factor on an error at a rendered colour."""
        return mi.Color3f(1)

    def fog_colour(self, pixels: Callable[[], np.ndarray]) -> np.ndarray:
        """Colour (3,) of the initial fog; ``pixels`` returns the pixels (N, 3) of the photographs."""
        return np.full(3, 0.5)


@dataclass(frozen=True)
class LinearScale:
    """Linear radiance, in units of about white; methods as in :class:`SrgbScale`."""

    rate: ClassVar[float] = 4.0
    """A lamp of 100 is as far from grey, in reals, as white would be in codes three times as large; the factor 4 reaches it."""

    def to_reals(self, colours: mi.Float) -> mi.Float:
        """Reals that grow with the logarithm of large values."""
        return dr.asinh(colours)

    def to_colours(self, reals: mi.Float) -> mi.Float:
        """The inverse of :meth:`to_reals`."""
        return dr.sinh(reals)

    def gradient_by_reals(self, slopes: mi.Float, reals: mi.Float) -> mi.Float:
        """Derivatives by reals, from derivatives by colours."""
        return slopes * dr.cosh(reals)

    def fog_colour(self, pixels: Callable[[], np.ndarray]) -> np.ndarray:
        """Half the 99th percentile of the pixels, at most the value of :class:`SrgbScale`.

        A fog brighter than all pixels would vanish before it learns a colour, and never return: densities below 0 have no
        derivative.
        """
        colours = pixels()
        return np.minimum(np.quantile(colours, 0.99, axis=0) / 2, 0.5) if len(colours) else np.full(3, 0.5)

    def weight(self, colour: mi.Color3f) -> mi.Color3f:
        """The slope of the tone curve."""
        return dr.rcp(dr.maximum(dr.detach(colour), 0) + EPSILON)


SCALES: dict[str, SrgbScale | LinearScale] = {"srgb": SrgbScale(), "linear": LinearScale()}
"""Scales by the kind of photograph values (:data:`mivol.photos.photo_file.CONVERSIONS`)."""
