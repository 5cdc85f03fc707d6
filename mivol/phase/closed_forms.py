r"""Phase functions in closed form: Henyey-Greenstein, Rayleigh, Draine and Cornette-Shanks; mixtures; domains of parameters.

.. math:: p_{HG}(\theta) = \frac{1}{4\pi} \frac{1 - g^2}{D^{3/2}}, \quad D = 1 + g^2 - 2 g \cos\theta, \qquad
          p_{Rayleigh}(\theta) = \frac{3}{16\pi} (1 + \cos^2\theta), \qquad
          p_{Draine}(\theta) = p_{HG}(\theta; g)\,\frac{1 + \alpha \cos^2\theta}{1 + \alpha (1 + 2 g^2)/3}

Conventions. As in :mod:`mivol.phase`; -1 < g < 1. With a = |g| and m = 1 - cos (1 + cos for g < 0), D is
(1 - a)^2 + 2 a m, a sum of positive terms. Rayleigh's phase function describes unpolarised light at particles much smaller
than the wavelength. In Draine's phase function alpha = 0 is Henyey-Greenstein, alpha = 1 Cornette-Shanks, and alpha = 1 with g
= 0 Rayleigh; g is the mean cosine for alpha = 0 only (:func:`mean_cosine`).

Scattering angle. It is stored as 1 - cos and 1 + cos, for accuracy near forward and backward scattering:

.. math:: 1 - \cos\theta = \tfrac12 |\omega - \omega'|^2, \qquad 1 + \cos\theta = \tfrac12 |\omega + \omega'|^2

Light travels along omega' before and along omega after the scattering. ``wi`` is Mitsuba's and points back along the path, so
omega' = -wi. In float32 ``1 - dot`` is a multiple of 6e-8 and has no digit left at an angle of 3e-4; the squared differences
keep their relative precision.

Inversions. Henyey-Greenstein: the usual formula, solved for 1 - cos. Rayleigh: c^3 + 3 c = 4 (2 u - 1) by
c = 2 sinh(asinh(2 (2 u - 1)) / 3). Draine: the closed-form root of a quartic equation (Jendersie & d'Eon) loses its digits in
float32. Newton steps invert the cumulative distribution instead, in the variable of the Henyey-Greenstein inversion, in which
the distribution is smooth for every g.

Mixtures. A convex combination :math:`p = \sum_k s_k p_k`, :math:`s_k = w_k / \sum_j w_j`, is sampled by the choice of a
component. Weights are at least 0 and need not sum to 1. If every weight is 0 (a voxel in a grid of weights), the components
have equal probabilities.

Domains. A value that an optimizer has moved outside is refused when it is set. The host cannot read a value inside a
recording by ``dr.freeze``, or in a volume of unknown values. The nearest value inside then replaces the value, with a
derivative of 0.

Source: Henyey & Greenstein 1941 (Astrophysical Journal 93); Rayleigh 1871; Chandrasekhar, Radiative Transfer (1960), chapter 1;
Draine 2003 (Scattering by Interstellar Dust Grains. I, Astrophysical Journal 598); Cornette & Shanks 1992 (Applied Optics 31);
droplets by Jendersie & d'Eon 2023 (An Approximate Mie Scattering Function for Fog and Cloud Rendering).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError


@dataclass(frozen=True)
class Domain:
    """An interval of float32 numbers.

    Attributes:
        low, high: the least and the largest allowed number.
        words: the interval, for the error message.
        way_out: advice for the same message.
    """

    low: float
    high: float
    words: str
    way_out: str

    def check(self, values: np.ndarray, name: str) -> None:
        """Refuse values outside.

        Raises:
            MivolError: NaN, or outside the interval after rounding to float32; the message names the first bad value and its
                index.
        """
        values = np.asarray(values, dtype=np.float32)
        wrong = np.argwhere(~((values >= np.float32(self.low)) & (values <= np.float32(self.high))))
        if len(wrong) == 0:
            return
        first = tuple(int(i) for i in wrong[0])
        place = "" if values.size == 1 else f" at {first if len(first) > 1 else first[0]}"
        raise MivolError(f"{name} is {float(values[first]):.9g}{place}; {self.words} is expected: {self.way_out}.")

    def project(self, x: mi.Float) -> mi.Float:
        """The nearest value inside; its derivative is 0 where the value differs from ``x``. NaN stays NaN."""
        # dr.minimum and dr.maximum are not used: where x lies on a bound, their derivative may be that of the constant.
        x = dr.select(x < self.low, self.low, x)
        return x if math.isinf(self.high) else dr.select(x > self.high, self.high, x)


NEXT_TO_ONE = 1 - 2.0**-24
"""The largest float32 below 1."""

LARGEST = 1e30
"""Largest weight or value. Sums of a few such numbers, and their inverses, are within the range of float32."""

ASYMMETRY = Domain(
    -NEXT_TO_ONE, NEXT_TO_ONE, "a number above -1 and below 1", "choose one, or clip it after each step, for instance to 0.999"
)
COSINE_SQUARED = WEIGHT = Domain(
    0.0, LARGEST, "a finite number of at least 0, and at most 1e30,", "choose one, or clip it after each step"
)


def eval_hg(angle: ScatteringAngle, g: mi.Float) -> mi.Float:
    r"""Density [1/sr].

    .. math:: \partial p/\partial g = \frac{1}{4\pi}\big[-2 g D^{-3/2} - 3 (1 - g^2)(g - \cos\theta) D^{-5/2}\big]

    which is 3 cos / (4 pi) at g = 0.

    Error: about 6e-7, relative, for every g in (-1, 1) and every angle.
    """
    back = g < 0
    # dr.abs is not used, since its derivative at 0 is 0 and that of p is not.
    a = dr.select(back, -g, g)
    m = dr.select(back, angle.above_minus_one, angle.below_one)
    # As 1 + g^2 - 2 g cos, D has a rounding error of 6e-8 beside a smallest value of (1 - a)^2: several times D at a = 0.9999.
    inv = dr.rcp(dr.fma(2 * a, m, dr.square(1 - a)))
    # inv sqrt(inv) is more accurate than the cube of Dr.Jit's rsqrt, which is approximate.
    return INV_FOUR_PI * ((1 - a) * (1 + a)) * (inv * dr.sqrt(inv))


def sample_hg(u: mi.Float, g: mi.Float) -> ScatteringAngle:
    r"""Draw a scattering angle with density :func:`eval_hg`.

    .. math:: 1 - \cos = \frac{2 (1 - g)^2 (1 - u)(1 + g u)}{(1 - g + 2 g u)^2}, \qquad
              1 + \cos = \frac{2 (1 + g)^2 u (1 - g + g u)}{(1 - g + 2 g u)^2} \qquad (g \ge 0)

    and the mirror image for g < 0: no branch at small g, no difference of nearly equal numbers.

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


def eval_rayleigh(angle: ScatteringAngle) -> mi.Float:
    """Density [1/sr]."""
    return (0.75 * INV_FOUR_PI) * dr.fma(angle.cos, angle.cos, 1)


def sample_rayleigh(u: mi.Float) -> ScatteringAngle:
    """Draw a scattering angle with density :func:`eval_rayleigh`; u = 0, 1/2 and 1 give cos = -1, 0 and 1.

    Error: 2e-7 of cos.
    """
    c = 2 * dr.sinh(dr.asinh(2 * (2 * u - 1)) * (1 / 3))
    c = dr.clip(c, -1, 1)
    return ScatteringAngle(1 - c, 1 + c)


NEWTON_STEPS = 16
"""Each step divides the error of u by at least 3.4 (where 1 + alpha cos^2 nearly vanishes); otherwise a step squares the
error.
"""


def mean_cosine(g: mi.Float | float, alpha: mi.Float | float) -> mi.Float | float:
    """The mean cosine g (1 + alpha (3 + 2 g^2) / 5) / (1 + alpha (1 + 2 g^2) / 3) of :func:`eval_draine`, Draine 2003."""
    return g * (1 + alpha * (3 + 2 * g * g) / 5) / (1 + alpha * (1 + 2 * g * g) / 3)


def eval_draine(angle: ScatteringAngle, g: mi.Float, alpha: mi.Float) -> mi.Float:
    """Density [1/sr].

    Error: about 8e-7, relative.
    """
    c = angle.cos
    return eval_hg(angle, g) * dr.fma(alpha, c * c, 1) * dr.rcp(dr.fma(alpha, (1 + 2 * g * g) * (1 / 3), 1))


@dr.syntax
def sample_draine(u: mi.Float, g: mi.Float, alpha: mi.Float) -> ScatteringAngle:
    r"""Draw a scattering angle with density :func:`eval_draine`.

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
        diameter: diameter of the droplets [micrometre], 5 to 50.

    Returns:
        ``g_hg``, ``g_draine``, ``alpha`` and ``weight_draine``, the fraction of the second component; for white light.

    Raises:
        MivolError: a diameter outside the range of the fit.
    """
    if not 5 <= diameter <= 50:
        raise MivolError(f"droplets of {diameter} micrometre; the fit covers 5 to 50: take mivol.phase.mie for others.")
    return {
        "g_hg": math.exp(-0.0990567 / (diameter - 1.67154)),
        "g_draine": math.exp(-2.20679 / (diameter + 3.91029) - 0.428934),
        "alpha": math.exp(3.62489 - 8.29288 / (diameter + 5.52825)),
        "weight_draine": math.exp(-0.599085 / (diameter - 0.641583) - 0.665888),
    }


# -- Mixtures --------------------------------------------------------------------------------------------------------------


def normalise_weights(weights: Sequence[mi.Float]) -> list[mi.Float]:
    """Normalise weights by their sum, with derivatives; the weights become equal for a sum of 0."""
    total = sum(weights[1:], weights[0])
    empty = ~(total > 0) & (total == 0)
    inv = dr.rcp(total)  # infinite for a sum of 0; select has no derivative for the unused branch
    return [dr.select(empty, 1 / len(weights), w * inv) for w in weights]


def choose_lobe(shares: Sequence[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Choose a component with its normalised weight as probability.

    Returns:
        The index of the component, and ``u`` rescaled to [0, 1) within its interval, for another use.
    """
    chosen, low, high = mi.UInt32(0), dr.zeros(mi.Float, 1), mi.Float(shares[0])
    start = mi.Float(0)
    for k, share in enumerate(shares):
        # A component of weight 0 is never chosen, not even where rounding leaves u above the sum of all weights.
        is_chosen = (u >= start) & (share > 0)
        end = start + share
        chosen, low, high = dr.select(is_chosen, k, chosen), dr.select(is_chosen, start, low), dr.select(is_chosen, end, high)
        start = end
    inside = (u - low) * dr.rcp(dr.select(high > low, high - low, 1))
    return chosen, dr.clip(inside, 0, 1 - 2.0**-24)


# -- Scattering angle -------------------------------------------------------------------------------------------------------


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
