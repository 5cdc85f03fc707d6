r"""A trilinear function in a cell: its value, its transpose, the cubic along a ray; quadrature of emission and absorption.

Along a line a trilinear function is a cubic in each cell. Two Gauss points integrate the cubic exactly, and its integral, a
quartic, is inverted to sample distances.

Conventions. Bits 0, 1, 2 of the index of a corner are x, y, z. A cubic covers a piece of a ray of length ``dt`` [length]; x in
[0, 1] is a fraction of the piece.

Emission and absorption in a cell have a fourth-order quadrature with two points, which conserves energy:

.. math:: S = \int_0^\Delta \sigma c\, e^{-\tau(t)} dt \approx (1 - e^{-\tau}) \big( f c_1 + (1 - f) c_2 \big), \quad
          f = \frac{\sigma_1 Q}{\sigma_1 Q + \sigma_2}, \quad Q = 1 + x + \tfrac{x^2}{2} + \tfrac{x^3}{6 + 3 x}, \quad
          x = \frac{\tau}{\sqrt 3}

with :math:`\tau = \tfrac{\Delta}{2} (\sigma_1 + \sigma_2)`, exact for a cubic. This is the two-stage Gauss collocation method
(Hairer & Wanner 1996, table IV.5.1): its optical depths in front of the two points differ by :math:`\tau / \sqrt 3`, so
:math:`\sigma_1` and :math:`\sigma_2 e^{-x}` weigh the source functions. Two things are changed:

* The weights are scaled to sum to the opacity of the cell. A constant source function then gives c (1 - T) to rounding at any
  optical depth.
* Q replaces exp(x). Q agrees with exp(x) beyond the order of the method but grows only quadratically. The derivative with
  respect to sigma_1 of a cell that is opaque behind its first point grows as Q; with the exponential it would be of the size of
  exp(tau / sqrt 3) and useless to an optimizer. The price is 1.9 times the error of the exponential at an optical depth of 0.5
  a cell (4.5 times with 1 + x + x^2 / 2).

An emission density j (radiance per length, independent of the extinction) is taken at the same points,

.. math:: \int_0^\Delta j\, e^{-\tau(t)} dt \approx N \big( (1 - v) j_1 + v j_2 \big)

N is the integral of the transmittance over the cell, and v follows from the mean position of the light leaving the cell. Both
come from the moments E_n of :mod:`mivol.numerics`, to second and to first order in the slope of the extinction.

Conventions. Points 1 and 2 are the first and second Gauss point along the ray (:data:`GAUSS_POINT`). No division by an
extinction or by a transmittance occurs, so values and derivatives are finite for every sigma >= 0, 0 included. Derivatives are
returned in closed form; Dr.Jit tracks no derivatives.

References: Abramowitz & Stegun 25.4.30 (Gauss points); Max 1995 (emission and absorption along a ray); Hochbruck & Ostermann
2010 (phi functions).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import exp_moments, fast_min, one_minus_exp, phi1, reciprocal
from mivol.transport.traversal.grid_walk import Cell

__all__ = [
    "GAUSS_POINT",
    "DensityWeights",
    "OpacityShares",
    "eval_cubic",
    "fit_cubic",
    "fraction_from_lower",
    "gauss_points",
    "integrate_cubic",
    "interpolate",
    "invert_cubic_integral",
    "node_weights",
    "share_opacity",
    "trilinear_weights",
    "weigh_emission_density",
]

GAUSS_POINT = 0.5 - math.sqrt(3) / 6
"""First of the two Gauss-Legendre points on [0, 1]; the second is 1 - GAUSS_POINT. The rule is exact for cubics."""


def gauss_points(cell: Cell) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The two Gauss points of the interval of a ray in a cell, as fractions from the near planes of the cell."""
    return dr.fma(cell.step, GAUSS_POINT, cell.frac), dr.fma(cell.step, 1 - GAUSS_POINT, cell.frac)


def interpolate(corners: list[mi.Float], frac: mi.Vector3f) -> mi.Float:
    """The trilinear value at a point of a cell; bits 0, 1, 2 of the corner are x, y, z."""
    # a + t (b - a), and not a (1 - t) + b t, since all points of a cell share the differences b - a along x. The result is off
    # by at most an ulp of the larger corner, and exact where the corners are equal.
    x = [_lerp(corners[q], corners[q + 1], frac.x) for q in (0, 2, 4, 6)]
    y = [_lerp(x[0], x[1], frac.y), _lerp(x[2], x[3], frac.y)]
    return _lerp(y[0], y[1], frac.z)


def _lerp(a: mi.Float, b: mi.Float, t: mi.Float) -> mi.Float:
    return dr.fma(t, b - a, a)


def trilinear_weights(frac: mi.Vector3f) -> list[mi.Float]:
    """The 8 trilinear weights at a point of a cell: the transpose of :func:`interpolate`."""
    x, y, z = (1 - frac.x, frac.x), (1 - frac.y, frac.y), (1 - frac.z, frac.z)
    return [c * b * a for c in z for b in y for a in x]


def node_weights(frac: mi.Vector3f, cell: Cell, res: tuple[int, int, int]) -> list[mi.Float]:
    """The 8 trilinear weights at a point of a cell (from its near planes), in the order of the axes of the grid."""
    return trilinear_weights(_natural_frac(frac, cell, res))


def _natural_frac(frac: mi.Vector3f, cell: Cell, res: tuple[int, int, int]) -> mi.Vector3f:
    """Fractions along the axes of the grid, from fractions along the ray; see :func:`fraction_from_lower`."""
    return fraction_from_lower(dr.select(cell.ahead, frac, 1 - frac), cell.lower, res)


def fraction_from_lower(frac: mi.Vector3f, lower: mi.Vector3i, res: tuple[int, int, int]) -> mi.Vector3f:
    """Fractions from the lower node of a cell; in the outer half voxel all weight goes to the only node there."""
    z, y, x = res
    return dr.select(lower < 0, 1, dr.select(lower >= mi.Vector3i(x - 1, y - 1, z - 1), 0, frac))


NEWTON_STEPS = 8
"""Each step doubles the number of right digits. If the extinction vanishes at an end of the piece the steps are bisections,
which leave an error of 2^-8 of a cell in a place of hardly any light.
"""


def fit_cubic(f0: mi.Float, f1: mi.Float, f2: mi.Float, f3: mi.Float) -> list[mi.Float]:
    """Coefficients of the cubic through values at 0, 1/3, 2/3, 1 (Lagrange)."""
    return [
        f0,
        -5.5 * f0 + 9 * f1 - 4.5 * f2 + f3,
        9 * f0 - 22.5 * f1 + 18 * f2 - 4.5 * f3,
        4.5 * (f3 - f0) + 13.5 * (f1 - f2),
    ]


def eval_cubic(c: list[mi.Float], x: mi.Float) -> mi.Float:
    """The value at x."""
    return dr.fma(x, dr.fma(x, dr.fma(x, c[3], c[2]), c[1]), c[0])


def integrate_cubic(c: list[mi.Float], dt: mi.Float, x: mi.Float) -> mi.Float:
    """The integral from 0 to x over a piece of length ``dt``; clamped to at least 0 against rounding."""
    return dr.maximum(dt * x * dr.fma(x, dr.fma(x, dr.fma(x, 0.25 * c[3], c[2] / 3), 0.5 * c[1]), c[0]), 0)


def invert_cubic_integral(c: list[mi.Float], dt: mi.Float, goal: mi.Float, whole: mi.Float) -> mi.Float:
    """Find the x at which the integral of a non-negative cubic is ``goal``, by Newton steps in a bracket.

    Args:
        c: coefficients.
        dt: length of the piece.
        goal: at most ``whole``.
        whole: the integral over the whole piece.
    """
    low, high, x = mi.Float(0), mi.Float(1), dr.clip(goal / dr.maximum(whole, 1e-30), 0, 1)
    for _ in range(NEWTON_STEPS):
        error = integrate_cubic(c, dt, x) - goal
        low, high = dr.select(error < 0, x, low), dr.select(error > 0, x, high)
        step = x - error / dr.maximum(dt * eval_cubic(c, x), 1e-30)
        # The ends of the bracket count as inside: once x is at the root, it is one of the ends, and a step of 0 must keep it
        # there.
        x = dr.select((step >= low) & (step <= high), step, 0.5 * (low + high))
    return x


# -- Emission and absorption in a cell ---------------------------------------------------------------------------------

STEEP = 1e12
"""Largest used x. Beyond it Q would overflow float32; at it, 1 / Q is negligible beside any ratio of two float32 extinctions,
so the clamp changes no result.
"""


@dataclass
class OpacityShares:
    """Division of the opacity of a cell between the source functions at its two points.

    Attributes:
        tau, T, alpha: optical depth, transmittance and opacity of the cell [1].
        f: fraction of the opacity of the first point.
        half: half the length of the cell.
        lean: shift of the fraction in the derivative: d (alpha f) / d sigma_q is ``half * (T f + lean[q])``.
        per_sigma: each weight divided by the extinction at its point [length]; finite for an extinction of 0.
    """

    tau: mi.Float
    T: mi.Float
    alpha: mi.Float
    f: mi.Float
    half: mi.Float
    lean: tuple[mi.Float, mi.Float]
    per_sigma: tuple[mi.Float, mi.Float]

    @property
    def weights(self) -> tuple[mi.Float, mi.Float]:
        """Weights of the source functions at the two points; their sum is the opacity."""
        return self.alpha * self.f, self.alpha * (1 - self.f)

    def radiance(self, c1: mi.Float, c2: mi.Float) -> mi.Float:
        """Radiance S leaving the cell towards the origin of the ray, for source functions c1 and c2 [radiance]."""
        return self.alpha * dr.fma(self.f, c1 - c2, c2)

    def slopes(self, c1: mi.Float, c2: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Derivatives of S with respect to the extinction at each point, at constant source functions."""
        mean, difference = self.T * dr.fma(self.f, c1 - c2, c2), c1 - c2
        return self.half * dr.fma(self.lean[0], difference, mean), self.half * dr.fma(self.lean[1], difference, mean)


def share_opacity(dt: mi.Float, sigma1: mi.Float, sigma2: mi.Float) -> OpacityShares:
    """Divide the opacity of a cell between its two points: emission-absorption quadrature with a source function.

    Args:
        dt: length of the cell [length], finite.
        sigma1, sigma2: extinction [1/length] at the Gauss points, finite and at least 0.

    Bias: O(dt^5) a cell for smooth fields; none for a constant source function.
    """
    half, total = 0.5 * dt, sigma1 + sigma2
    tau = half * total
    x = dr.minimum(tau * (1 / math.sqrt(3)), STEEP)
    r = x * reciprocal(x + 2)
    q = dr.fma(x, dr.fma(x, dr.fma(r, 1 / 3, 0.5), 1), 1)
    first = sigma1 * q
    both = first + sigma2
    some = both > 0
    inverse = reciprocal(dr.select(some, both, 1))
    # A GPU's reciprocals err by an ulp or two: a weight 1 - f must not become negative.
    f = dr.select(some, fast_min(first * inverse, 1), 0.5)
    scale = phi1(tau) * dr.select(some, total * inverse, 1)
    growth = half * (1 / math.sqrt(3)) * (1 + x + (2 / 3) * dr.square(r) * (3 + x))  # dq / d sigma, for either point
    lean = (scale * dr.fma(sigma1, growth, q) * (1 - f), -scale * f * (1 - sigma2 * growth / q))
    return OpacityShares(tau, dr.exp(-tau), one_minus_exp(tau), f, half, lean, (half * scale * q, half * scale))


@dataclass
class DensityWeights:
    """Weights of the emission density of a cell in the light leaving the cell.

    Attributes:
        weights: [length], of the emission density at the two points.
        slopes: derivatives of the weights with respect to the extinction, [weight][point of the extinction].
    """

    weights: tuple[mi.Float, mi.Float]
    slopes: tuple[tuple[mi.Float, mi.Float], tuple[mi.Float, mi.Float]]


def weigh_emission_density(dt: mi.Float, sigma1: mi.Float, sigma2: mi.Float) -> DensityWeights:
    """Weigh the emission density [radiance/length] at the two points of a cell.

    Args:
        dt, sigma1, sigma2: as of :func:`share_opacity`.

    Bias: O(dt^5) a cell for smooth fields; none for a constant emission density in a constant extinction. Weights are never
        negative.
    """
    tau, lean = 0.5 * dt * (sigma1 + sigma2), (0.5 * math.sqrt(3)) * dt * (sigma2 - sigma1)
    E = exp_moments(tau)
    inverse = reciprocal(E[0])
    e = [m * inverse for m in E]
    twice = e[2] - 2 * e[3] + e[4]
    total = E[0] * (1 + lean * (e[1] - e[2] + 0.5 * lean * twice))
    by_tau = -E[0] * (e[1] + lean * (e[2] - e[3] + 0.5 * lean * (e[3] - 2 * e[4] + e[5])))
    by_lean = E[0] * (e[1] - e[2] + lean * twice)

    # The mean position in the cell of the light that leaves it (1/2 in a thin cell), and its derivatives.
    drift = [dr.fma(e[n], e[1], -e[n + 1]) for n in range(5)]  # d e_n / d tau; that of e_0 is 0
    shift = e[2] - e[3] - e[1] * (e[1] - e[2])
    place = dr.fma(lean, shift, e[1])
    moves = drift[1] + lean * (drift[2] - drift[3] - drift[1] * (e[1] - e[2]) - e[1] * (drift[1] - drift[2]))
    spread = 1 / (1 - 2 * GAUSS_POINT)
    v = (place - GAUSS_POINT) * spread
    between = (v > 0) & (v < 1)
    v = dr.clip(v, 0, 1)
    v_tau, v_lean = dr.select(between, spread * moves, 0), dr.select(between, spread * shift, 0)

    slopes = []
    for share, turn in ((1 - v, -1.0), (v, 1.0)):
        tau_slope = dr.fma(turn * total, v_tau, by_tau * share) * (0.5 * dt * dt)
        lean_slope = dr.fma(turn * total, v_lean, by_lean * share) * (0.5 * math.sqrt(3) * dt * dt)
        slopes.append((tau_slope - lean_slope, tau_slope + lean_slope))
    return DensityWeights((dt * total * (1 - v), dt * total * v), (slopes[0], slopes[1]))
