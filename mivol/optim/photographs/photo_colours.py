r"""Colours of photographs in a fit: their reals, the weight of a pixel's error, and the exposure of each photograph.

Scales. 8-bit codes are perceptually uniform, so their reals are the colours themselves and all errors have equal weight.
Radiance spans orders of magnitude. Its reals are :math:`r = \mathrm{asinh}(c)`, the colour near 0 and its logarithm far from
0, so one learning rate changes lamps and shadows by equal factors. The weight of an error is the slope of a tone curve
:math:`\log(y + \epsilon)`,

.. math:: L = \sum_i \Big(\frac{\hat y_i - y_i}{\mathrm{sg}(\hat y_i) + \epsilon}\Big)^2,

where sg makes its argument a constant: the weight comes from the last step and has no derivative.

Exposure. Gains of the three channels of each photograph are fitted with the field. A gain multiplies the rendered colour in
the values of the photographs. For sRGB codes c, a gain g equals the exposure g^2.4, since the curve is nearly a power. The
logarithms are stored, (photographs, 3). Their mean over all photographs is 0, because a field twice as bright with half the
exposure gives the same photographs. Gains are pulled towards 1: for matter in a single photograph, gain and field colours are
interchangeable, and the field's colours should explain it.

Source: Mildenhall et al. 2022 (NeRF in the Dark, eq. 4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.optim.photographs.ray_batches import RayBatch

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


@dataclass
class RayErrors:
    """Errors of rendered rays against photographs.

    Attributes:
        colour: rendered colour over the backdrop, with the gain.
        error: weighted difference of this colour and the photograph's.
        loss: squared error of each ray, weighted, mean over rgb.
        by_colour, by_radiance, by_T: derivatives of the mean loss over rays by the colour with the gain, by the radiance
            without, and by the transmittance.
    """

    colour: mi.Color3f
    error: mi.Color3f
    loss: mi.Float
    by_colour: mi.Color3f
    by_radiance: mi.Color3f
    by_T: mi.Float


def compare_rays(
    batch: RayBatch,
    radiance: mi.Color3f,
    T: mi.Float,
    backdrop: mi.Color3f,
    scale: SrgbScale | LinearScale,
    gain: mi.Color3f | None = None,
) -> RayErrors:
    """Compare rendered rays with the photographs.

    Args:
        batch: rays and colours of the photographs.
        radiance, T: rendered rays, without a background.
        backdrop: put behind the rays.
        scale: of the photographs' values.
        gain: of each ray's photograph; None: 1.
    """
    gain = mi.Color3f(1) if gain is None else gain
    colour = gain * (radiance + T * backdrop)
    # A transparent pixel of a photograph shows its own background: the error replaces it by the backdrop.
    error = colour - batch.target - (1 - batch.alpha) * (backdrop - batch.background)
    weight = scale.weight(colour)
    error *= batch.counted * weight
    by_colour = error * weight * (2 / (3 * dr.width(batch.slot)))
    by_radiance = by_colour * gain
    return RayErrors(colour, error, dr.squared_norm(error) * (1 / 3), by_colour, by_radiance, dr.dot(by_radiance, backdrop))


def mean_of(values: mi.Float) -> mi.Float:
    """The mean, equal to the bit in a recording and without: ``dr.mean`` divides by a width that it hides from a recording."""
    return dr.sum(values) * (1 / dr.width(values))


CHANNELS = 3

GAIN_RATE = 0.01
"""Initial learning rate of the logarithms, which falls with the other rates: 50 steps reach 0.5."""

GAIN_PULL = 0.2
"""Share of a logarithm, times the learning rate, by which the logarithm falls per step: initially 0.2 %."""


@dataclass(frozen=True)
class Exposure:
    """Gains of photographs.

    Attributes:
        logs: Float, natural logarithms of each photograph's three gains.
    """

    logs: mi.Float

    @classmethod
    def neutral(cls, photographs: int) -> Exposure:
        """Gains of 1."""
        return cls(dr.zeros(mi.Float, photographs * CHANNELS))

    @property
    def tensor(self) -> mi.TensorXf:
        """(photographs, 3) logarithms."""
        return mi.TensorXf(self.logs, (dr.width(self.logs) // CHANNELS, CHANNELS))

    @property
    def spread(self) -> float:
        """Root mean square of the logarithms."""
        return float(np.sqrt(np.mean(np.square(np.array(self.logs, np.float64)))))

    def table(self) -> np.ndarray:
        """(photographs, 3) gains."""
        return np.exp(np.array(self.logs, np.float64).reshape(-1, CHANNELS))

    def gains(self, view: mi.UInt32) -> mi.Color3f:
        """Gains of photographs, by their numbers."""
        return mi.Color3f(*(dr.exp(dr.gather(mi.Float, self.logs, view * CHANNELS + k)) for k in range(CHANNELS)))

    def gradient(self, view: mi.UInt32, by: mi.Color3f) -> mi.Float:
        """Derivatives of a scalar by ``logs``, from its derivatives by the logarithms of each ray's gains."""
        total = dr.zeros(mi.Float, dr.width(self.logs))
        for k in range(CHANNELS):
            dr.scatter_add(total, by[k], view * CHANNELS + k)
        return total

    def regularized(self, pull: mi.Float) -> Exposure:
        """Gains after a step's prior: pulled towards 1 by a share, with a mean logarithm of 0 in each channel."""
        entry, photographs = dr.arange(mi.UInt32, dr.width(self.logs)), dr.arange(mi.UInt32, dr.width(self.logs) // CHANNELS)
        means = [mean_of(dr.gather(mi.Float, self.logs, photographs * CHANNELS + k)) for k in range(CHANNELS)]
        mean = dr.select(entry % CHANNELS == 0, means[0], dr.select(entry % CHANNELS == 1, means[1], means[2]))
        return Exposure((self.logs - mean) * (1 - pull))


def pull_at(rate: float) -> mi.Float:
    """Share by which :meth:`Exposure.regularized` pulls gains with a learning rate."""
    return dr.opaque(mi.Float, GAIN_PULL * rate)
