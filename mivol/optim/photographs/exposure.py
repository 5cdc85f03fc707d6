"""Exposure of photographs: gains of the three channels of each photograph, fitted with the field.

Conventions. A gain multiplies the rendered colour in the values of the photographs. For sRGB codes c, a gain g equals the
exposure g^2.4, since the curve is nearly a power. The logarithms are stored, (photographs, 3). Their mean over all photographs
is 0, because a field twice as bright with half the exposure gives the same photographs. Gains are pulled towards 1: for matter
in a single photograph, gain and field colours are interchangeable, and the field's colours should explain it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

CHANNELS = 3

RATE = 0.01
"""Initial learning rate of the logarithms, which falls with the other rates: 50 steps reach 0.5."""

PULL = 0.2
"""Share of a logarithm, times the learning rate, by which the logarithm falls per step: initially 0.2 %."""

AGREE = 0.04
"""Spread (root mean square of the logarithms) after the first stage below which photographs count as equally exposed, and the
gains are removed. A tenth of a stop is 0.03."""


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

    def regularized(self, rate: float) -> Exposure:
        """Gains after a step's prior: pulled towards 1, with a mean logarithm of 0 in each channel."""
        entry, photographs = dr.arange(mi.UInt32, dr.width(self.logs)), dr.arange(mi.UInt32, dr.width(self.logs) // CHANNELS)
        means = [dr.mean(dr.gather(mi.Float, self.logs, photographs * CHANNELS + k)) for k in range(CHANNELS)]
        mean = dr.select(entry % CHANNELS == 0, means[0], dr.select(entry % CHANNELS == 1, means[1], means[2]))
        return Exposure((self.logs - mean) * (1 - dr.opaque(mi.Float, PULL * rate)))
