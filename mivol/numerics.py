r"""Exponential forms that keep their digits in float32: opacity and moments; minimum and maximum of rows.

.. math:: E_n(x) = \int_0^1 u^n e^{-x u}\,du, \qquad E_0 = \varphi_1, \qquad x E_0 = 1 - e^{-x}

Conventions. Arguments are Dr.Jit floats. Differences lose all digits at small x (1 - exp(-1e-8) is 0 in float32), so small
arguments use sums of positive terms, :math:`E_n = \frac{e^{-x}}{n+1} (1 + \frac{x}{n+2} (1 + \ldots))`. Derivatives are not
tracked. Error bounds are relative, hold for x >= 0, and are measured in tests/analytic/test_numerics.py.

References: Abramowitz & Stegun 6.5.29 (the series of the incomplete gamma function); Hochbruck & Ostermann 2010 (phi_1).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

PHI_SERIES_BELOW, PHI_TERMS = 0.5, 8
"""First neglected term: x^8 / 9! <= 1.1e-8."""

MOMENTS = 6

MOMENT_SERIES_BELOW, MOMENT_TERMS = 2.0, 11
"""First neglected term, relative to the first term: 2^12 6! / 18! = 5e-10. For x >= 2 a step of the recurrence loses at most a
factor of 3 in precision."""


def one_minus_exp(tau: mi.Float) -> mi.Float:
    """Opacity 1 - exp(-tau) of an optical depth [1].

    Error: at most 4e-7, for every tau up to infinity (opacity 1).
    """
    return dr.select(dr.abs(tau) < PHI_SERIES_BELOW, tau * _series(tau, 0, PHI_TERMS), 1 - dr.exp(-tau))


def phi1(x: mi.Float) -> mi.Float:
    """(1 - exp(-x)) / x, with the limit 1 at 0.

    Error: at most 4e-7.
    """
    small = dr.abs(x) < PHI_SERIES_BELOW
    return dr.select(small, _series(x, 0, PHI_TERMS), (1 - dr.exp(-x)) * reciprocal(dr.select(small, 1, x)))


def exp_moments(x: mi.Float) -> list[mi.Float]:
    """Moments E_0 to E_5 of exp(-x u) over u in [0, 1]; 1/(n + 1) at 0.

    Error: at most 4e-7, 4e-7, 8e-7, 2e-6, 6e-6, 2e-5 for E_0 to E_5.
    """
    tr = dr.exp(-x)
    small = dr.abs(x) < MOMENT_SERIES_BELOW
    inv = reciprocal(dr.select(small, 1, x))
    # x < 2: recur down from E_5 by sums of positive terms. x >= 2: recur up from E_0; n E_{n-1} - exp(-x) then loses little.
    down, up = [_series(x, MOMENTS - 1, MOMENT_TERMS)], [(1 - tr) * inv]
    for n in range(1, MOMENTS):
        down.insert(0, dr.fma(x, down[0], tr) * (1 / (MOMENTS - n)))
        up.append((n * up[-1] - tr) * inv)
    return [dr.select(small, d, u) for d, u in zip(down, up, strict=True)]


def reciprocal(x: mi.Float) -> mi.Float:
    """1 / x in full precision. ``dr.rcp`` of a double has only 20 bits on a GPU (PTX: rcp.approx.ftz.f64)."""
    return 1 / x


def fast_min(a: mi.Float, b: mi.Float) -> mi.Float:
    """The smaller of two numbers, NaN excluded. ``dr.minimum`` handles NaN and costs twice as much."""
    return dr.select(a < b, a, b)


def fast_max(a: mi.Float, b: mi.Float) -> mi.Float:
    """The larger of two numbers, NaN excluded."""
    return dr.select(a > b, a, b)


def minimum(rows: Sequence[mi.Float]) -> mi.Float:
    """The smallest of several numbers in each lane; NaN if a number is NaN."""
    return functools.reduce(dr.minimum, rows)


def maximum(rows: Sequence[mi.Float]) -> mi.Float:
    """The largest of several numbers in each lane; NaN if a number is NaN."""
    return functools.reduce(dr.maximum, rows)


def _series(x: mi.Float, n: int, terms: int) -> mi.Float:
    """E_n(x) for small x."""
    total = dr.ones(type(x), 1)
    for k in range(n + terms, n + 1, -1):
        total = dr.fma(total * x, 1 / k, 1)
    return dr.exp(-x) * total * (1 / (n + 1))
