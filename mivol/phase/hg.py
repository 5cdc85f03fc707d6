r"""The Henyey-Greenstein phase function, with its mean cosine g as the only parameter.

.. math:: p(\theta) = \frac{1}{4\pi} \frac{1 - g^2}{D^{3/2}}, \qquad D = 1 + g^2 - 2 g \cos\theta

Conventions. As in :mod:`mivol.phase`; -1 < g < 1. With a = \|g\| and m = 1 - cos (1 + cos for g < 0) the same D is
(1 - a)^2 + 2 a m, a sum of positive terms.

Source: Henyey & Greenstein 1941 (Astrophysical Journal 93); the inversion is that formula's, with 1 - cos solved for.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.phase.turn import INV_FOUR_PI, Turn

__all__ = ["eval_hg", "sample_hg"]


def eval_hg(turn: Turn, g: mi.Float) -> mi.Float:
    r"""Density [1/sr].

    .. math:: \partial p/\partial g = \frac{1}{4\pi}\big[-2 g D^{-3/2} - 3 (1 - g^2)(g - \cos\theta) D^{-5/2}\big]

    which is 3 cos / (4 pi) at g = 0.

    Error: about 6e-7 of it, for every g in (-1, 1) and every turn.
    """
    back = g < 0
    # dr.abs is not used, since its derivative at 0 is 0 and that of p is not.
    a = dr.select(back, -g, g)
    m = dr.select(back, turn.above_minus_one, turn.below_one)
    # As 1 + g^2 - 2 g cos, D has a rounding error of 6e-8 beside a smallest value of (1 - a)^2: several times D at a = 0.9999.
    inv = dr.rcp(dr.fma(2 * a, m, dr.square(1 - a)))
    # inv sqrt(inv) is more accurate than the cube of Dr.Jit's rsqrt, which is approximate.
    return INV_FOUR_PI * ((1 - a) * (1 + a)) * (inv * dr.sqrt(inv))


def sample_hg(u: mi.Float, g: mi.Float) -> Turn:
    r"""Draw a turn with density :func:`eval_hg`.

    .. math:: 1 - \cos = \frac{2 (1 - g)^2 (1 - u)(1 + g u)}{(1 - g + 2 g u)^2}, \qquad
              1 + \cos = \frac{2 (1 + g)^2 u (1 - g + g u)}{(1 - g + 2 g u)^2} \qquad (g \ge 0)

    and the mirror image for g < 0: no branch at small g, no difference of nearly equal numbers at any.

    Error: 4e-7 of both, for every g and u.
    """
    back = g < 0
    a = dr.select(back, -g, g)
    # u and 1 - u are both needed with full precision; in float32 1 - (1 - u) is not u.
    v, w = dr.select(back, 1 - u, u), dr.select(back, u, 1 - u)
    inv = dr.rcp(dr.square(dr.fma(2 * a, v, 1 - a)))
    below_one = 2 * dr.square(1 - a) * w * dr.fma(a, v, 1) * inv
    above_minus_one = 2 * dr.square(1 + a) * v * dr.fma(a, v, 1 - a) * inv
    return Turn(below_one, above_minus_one).mirrored(back)
