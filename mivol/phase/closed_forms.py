r"""The Henyey-Greenstein phase function, with its mean cosine g as the only parameter.

.. math:: p(\theta) = \frac{1}{4\pi} \frac{1 - g^2}{D^{3/2}}, \qquad D = 1 + g^2 - 2 g \cos\theta

Conventions. As in :mod:`mivol.phase`; -1 < g < 1. With a = \|g\| and m = 1 - cos (1 + cos for g < 0) the same D is
(1 - a)^2 + 2 a m, a sum of positive terms.

Source: Henyey & Greenstein 1941 (Astrophysical Journal 93); the inversion is that formula's, with 1 - cos solved for.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.phase.scattering_angle import INV_FOUR_PI, ScatteringAngle

__all__ = [
    "eval_hg",
    "sample_hg",
    "eval_rayleigh",
    "sample_rayleigh",
    "droplets",
    "eval_draine",
    "mean_cosine",
    "sample_draine",
]


def eval_hg(turn: ScatteringAngle, g: mi.Float) -> mi.Float:
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


def sample_hg(u: mi.Float, g: mi.Float) -> ScatteringAngle:
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
    return ScatteringAngle(below_one, above_minus_one).mirrored(back)


def eval_rayleigh(turn: ScatteringAngle) -> mi.Float:
    """Density [1/sr]."""
    return (0.75 * INV_FOUR_PI) * dr.fma(turn.cos, turn.cos, 1)


def sample_rayleigh(u: mi.Float) -> ScatteringAngle:
    """Draw a turn with density :func:`eval_rayleigh`; u = 0, 1/2 and 1 give cos = -1, 0 and 1.

    Error: 2e-7 of cos.
    """
    c = 2 * dr.sinh(dr.asinh(2 * (2 * u - 1)) * (1 / 3))
    c = dr.clip(c, -1, 1)
    return ScatteringAngle(1 - c, 1 + c)


NEWTON_STEPS = 16
"""Each step divides the error of u by 3.4 at least (where 1 + alpha cos^2 nearly vanishes); elsewhere it squares the error."""


def mean_cosine(g: mi.Float | float, alpha: mi.Float | float) -> mi.Float | float:
    """g (1 + alpha (3 + 2 g^2) / 5) / (1 + alpha (1 + 2 g^2) / 3), Draine 2003."""
    return g * (1 + alpha * (3 + 2 * g * g) / 5) / (1 + alpha * (1 + 2 * g * g) / 3)


def eval_draine(turn: ScatteringAngle, g: mi.Float, alpha: mi.Float) -> mi.Float:
    """Density [1/sr].

    Error: about 8e-7 of it.
    """
    c = turn.cos
    return eval_hg(turn, g) * dr.fma(alpha, c * c, 1) * dr.rcp(dr.fma(alpha, (1 + 2 * g * g) * (1 / 3), 1))


@dr.syntax
def sample_draine(u: mi.Float, g: mi.Float, alpha: mi.Float) -> ScatteringAngle:
    r"""Draw a turn with density :func:`eval_draine`.

    With cos = c(v) the Henyey-Greenstein inversion at v, and y = 2 (1 + g) v / (1 - g + 2 g v) (g >= 0),

    .. math:: u = v\,\frac{1 + \alpha [1 - (1 + g) y + (1 + g)^2 y^2/3 - g (1 + g) y^3/12]}{1 + \alpha (1 + 2 g^2)/3},
              \qquad \frac{du}{dv} = \frac{1 + \alpha c^2}{1 + \alpha (1 + 2 g^2)/3}.

    Error: u is met to 1.2e-6 (10 roundings of 1), for alpha up to 1e9.
    Cost: 16 Newton steps between brackets, without memory access.
    """
    back = g < 0
    a = dr.select(back, -g, g)
    goal = dr.select(back, 1 - u, u)
    b = 1 + a
    norm = dr.rcp(dr.fma(alpha, (1 + 2 * a * a) * (1 / 3), 1))

    v = type(goal)(goal)  # state: the root, between low and high
    low, high = dr.zeros(type(goal), 1), dr.ones(type(goal), 1)
    i = mi.UInt32(0)
    while i < NEWTON_STEPS:
        inv = dr.rcp(dr.fma(2 * a, v, 1 - a))
        y = 2 * b * v * inv
        square = dr.fma(y, dr.fma(y, dr.fma(y, -a * b * (1 / 12), b * b * (1 / 3)), -b), 1)  # mean of cos^2 below v
        w = v * dr.fma(a, v, 1 - a)
        c = dr.fma(2 * (1 + a * a), w, -dr.square(1 - a)) * dr.square(inv)
        miss = v * dr.fma(alpha, square, 1) * norm - goal
        low = dr.select(miss < 0, v, low)
        high = dr.select(miss < 0, high, v)
        v = v - miss * dr.rcp(dr.fma(alpha, c * c, 1) * norm)
        v = dr.select((v >= low) & (v <= high), v, 0.5 * (low + high))
        i += 1
    return sample_hg(v, a).mirrored(back)


def droplets(diameter: float) -> dict[str, float]:
    """The parameters of a mixture of Henyey-Greenstein and Draine that approximates Mie scattering by water droplets.

    Args:
        diameter: of the droplets [micrometre], 5 to 50.

    Returns:
        ``g_hg``, ``g_draine``, ``alpha`` and ``weight_draine``, the fraction of the second component; for white light.

    Raises:
        MivolError: a diameter that the fit does not cover.
    """
    if not 5 <= diameter <= 50:
        raise MivolError(f"droplets of {diameter} micrometre; the fit covers 5 to 50: take mivol.phase.mie for others.")
    return {
        "g_hg": math.exp(-0.0990567 / (diameter - 1.67154)),
        "g_draine": math.exp(-2.20679 / (diameter + 3.91029) - 0.428934),
        "alpha": math.exp(3.62489 - 8.29288 / (diameter + 5.52825)),
        "weight_draine": math.exp(-0.599085 / (diameter - 0.641583) - 0.665888),
    }
