"""A cubic over a piece of a ray: its coefficients, its integral, and the inverse of the integral.

A trilinear extinction is a cubic along a ray inside one cell, so its optical depth is a quartic.

Conventions. A piece has the length ``dt`` [length]; x in [0, 1] is a fraction of it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["cubic_at", "cubic_integral", "cubic_through", "invert_cubic_integral"]


NEWTON_STEPS = 8
"""Each step doubles the number of right digits. Where the extinction vanishes at an end of the piece the steps are bisections;
these leave an error of 2^-8 of a cell in a place that holds hardly any light."""


def cubic_through(f0: mi.Float, f1: mi.Float, f2: mi.Float, f3: mi.Float) -> list[mi.Float]:
    """Coefficients of the cubic through values at 0, 1/3, 2/3, 1 (Lagrange)."""
    return [
        f0,
        -5.5 * f0 + 9 * f1 - 4.5 * f2 + f3,
        9 * f0 - 22.5 * f1 + 18 * f2 - 4.5 * f3,
        4.5 * (f3 - f0) + 13.5 * (f1 - f2),
    ]


def cubic_at(c: list[mi.Float], x: mi.Float) -> mi.Float:
    """The value at x."""
    return dr.fma(x, dr.fma(x, dr.fma(x, c[3], c[2]), c[1]), c[0])


def cubic_integral(c: list[mi.Float], dt: mi.Float, x: mi.Float) -> mi.Float:
    """The integral from 0 to x over a piece of the length ``dt``; rounding makes it no less than 0."""
    return dr.maximum(dt * x * dr.fma(x, dr.fma(x, dr.fma(x, 0.25 * c[3], c[2] / 3), 0.5 * c[1]), c[0]), 0)


def invert_cubic_integral(c: list[mi.Float], dt: mi.Float, goal: mi.Float, whole: mi.Float) -> mi.Float:
    """Find the x at which the integral of a cubic that is nowhere negative is ``goal``, by Newton steps in a bracket.

    Args:
        c: coefficients.
        dt: length of the piece.
        goal: at most ``whole``.
        whole: the integral over all of the piece.
    """
    low, high, x = mi.Float(0), mi.Float(1), dr.clip(goal / dr.maximum(whole, 1e-30), 0, 1)
    for _ in range(NEWTON_STEPS):
        error = cubic_integral(c, dt, x) - goal
        low, high = dr.select(error < 0, x, low), dr.select(error > 0, x, high)
        step = x - error / dr.maximum(dt * cubic_at(c, x), 1e-30)
        # The ends of the bracket count as inside: once x is at the root, it is one of the ends, and a step of 0 must keep it
        # there.
        x = dr.select((step >= low) & (step <= high), step, 0.5 * (low + high))
    return x
