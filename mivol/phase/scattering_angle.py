r"""The scattering angle, stored as 1 - cos and 1 + cos for accuracy near forward and backward scattering.

.. math:: 1 - \cos\theta = \tfrac12 |\omega - \omega'|^2, \qquad 1 + \cos\theta = \tfrac12 |\omega + \omega'|^2

Conventions. Light travels along omega' before and along omega after the scattering. ``wi`` is Mitsuba's and points back along
the path, so omega' = -wi. In float32 ``1 - dot`` is a multiple of 6e-8 and has no digit left at an angle of 3e-4; the squared
differences keep their relative precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

INV_TWO_PI = 0.15915494309189535
INV_FOUR_PI = 0.07957747154594767


@dataclass
class ScatteringAngle:
    """A scattering angle, as the differences of its cosine from 1 and from -1.

    Attributes:
        below_one: 1 - cos, in [0, 2].
        above_minus_one: 1 + cos, in [0, 2].
    """

    below_one: mi.Float
    above_minus_one: mi.Float

    @property
    def cos(self) -> mi.Float:
        """The cosine, to 3e-8."""
        return 0.5 * (self.above_minus_one - self.below_one)

    @property
    def sin(self) -> mi.Float:
        """The sine, to a few roundings of itself at every angle."""
        return dr.sqrt(self.below_one * self.above_minus_one)

    def mirrored(self, where: mi.Bool) -> ScatteringAngle:
        """The same angle with the cosine negated in some lanes."""
        return ScatteringAngle(
            dr.select(where, self.above_minus_one, self.below_one), dr.select(where, self.below_one, self.above_minus_one)
        )


def angle_between(wi: mi.Vector3f, wo: mi.Vector3f) -> ScatteringAngle:
    """The scattering angle between travel along ``-wi`` and travel along ``wo``, both of unit length.

    Error: the error of the directions; an angle near 0 or pi is known to 1e-7.
    """
    return ScatteringAngle(0.5 * dr.squared_norm(wo + wi), 0.5 * dr.squared_norm(wo - wi))


def scattered_direction(wi: mi.Vector3f, angle: ScatteringAngle, u: mi.Float) -> mi.Vector3f:
    """The direction after scattering by an angle; ``u`` in [0, 1) is the azimuth, as a fraction of 2 pi."""
    s, t = mi.coordinate_system(wi)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u)
    return angle.sin * (cos_phi * s + sin_phi * t) - angle.cos * wi
