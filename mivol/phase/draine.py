r"""Draine's phase function: Henyey-Greenstein times 1 + alpha cos^2, with Rayleigh and Cornette-Shanks as special cases.

.. math:: p(\theta) = p_{HG}(\theta; g)\,\frac{1 + \alpha \cos^2\theta}{1 + \alpha (1 + 2 g^2)/3}

Conventions. alpha = 0 is Henyey-Greenstein, alpha = 1 Cornette-Shanks, alpha = 1 with g = 0 Rayleigh. The parameter g is the
mean cosine for alpha = 0 only: :func:`mean_cosine`.

Source: Draine 2003 (Scattering by Interstellar Dust Grains. I, Astrophysical Journal 598); Cornette & Shanks 1992 (Applied
Optics 31); droplets by Jendersie & d'Eon 2023 (An Approximate Mie Scattering Function for Fog and Cloud Rendering).
The closed-form inversion by the root of a quartic equation, which they give, loses its digits in float32. Here the cumulative
distribution is inverted by Newton steps in the variable of the Henyey-Greenstein inversion, in which it is smooth for every g.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.phase.hg import eval_hg, sample_hg
from mivol.phase.turn import Turn

__all__ = ["droplets", "eval_draine", "mean_cosine", "sample_draine"]

NEWTON_STEPS = 16
"""Each step divides the error of u by 3.4 at least (where 1 + alpha cos^2 nearly vanishes); elsewhere it squares the error."""


def mean_cosine(g: mi.Float | float, alpha: mi.Float | float) -> mi.Float | float:
    """g (1 + alpha (3 + 2 g^2) / 5) / (1 + alpha (1 + 2 g^2) / 3), Draine 2003."""
    return g * (1 + alpha * (3 + 2 * g * g) / 5) / (1 + alpha * (1 + 2 * g * g) / 3)


def eval_draine(turn: Turn, g: mi.Float, alpha: mi.Float) -> mi.Float:
    """Density [1/sr].

    Error: about 8e-7 of it.
    """
    c = turn.cos
    return eval_hg(turn, g) * dr.fma(alpha, c * c, 1) * dr.rcp(dr.fma(alpha, (1 + 2 * g * g) * (1 / 3), 1))


@dr.syntax
def sample_draine(u: mi.Float, g: mi.Float, alpha: mi.Float) -> Turn:
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
