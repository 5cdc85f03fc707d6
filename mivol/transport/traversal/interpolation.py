"""A trilinear function in a cell: its value, its transpose, and the cubic along a ray.

Along a line a trilinear function is a cubic in each cell. Two Gauss points integrate the cubic exactly, and its integral, a
quartic, is inverted to sample distances.

Conventions. Bits 0, 1, 2 of the index of a corner are x, y, z. A cubic covers a piece of a ray of length ``dt`` [length]; x in
[0, 1] is a fraction of the piece.

References: Abramowitz & Stegun 25.4.30 (Gauss points).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.grid_walk import Cell

__all__ = [
    "GAUSS_POINT",
    "gauss_points",
    "interpolate",
    "node_weights",
    "fraction_from_lower",
    "trilinear_weights",
    "eval_cubic",
    "integrate_cubic",
    "fit_cubic",
    "invert_cubic_integral",
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
