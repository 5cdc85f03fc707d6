"""Trilinear interpolation in a cell, its transpose, and the two Gauss points of a ray's interval in it.

Conventions. Bits 0, 1, 2 of the number of a corner are x, y, z. Along a line a trilinear function is a cubic in each cell, so
two Gauss points integrate it exactly.

References: Abramowitz & Stegun 25.4.30 (Gauss points).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.grid_walk import Cell

__all__ = ["GAUSS", "gauss_points", "interpolate", "node_weights", "upward_frac", "weights"]


GAUSS = 0.5 - math.sqrt(3) / 6
"""First of the two Gauss-Legendre points on [0, 1]; the other is 1 minus it. The rule is exact for cubics."""


def gauss_points(cell: Cell) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The two Gauss points of a ray's interval in a cell, as fractions from the cell's near planes."""
    return dr.fma(cell.step, GAUSS, cell.frac), dr.fma(cell.step, 1 - GAUSS, cell.frac)


def interpolate(corners: list[mi.Float], frac: mi.Vector3f) -> mi.Float:
    """The trilinear value at a point of a cell; bits 0, 1, 2 of the corner are x, y, z."""
    # a + t (b - a), and not a (1 - t) + b t, since all points of a cell share the differences b - a along x. The result is off
    # by at most an ulp of the larger corner, and exact where the corners are equal.
    x = [_lerp(corners[q], corners[q + 1], frac.x) for q in (0, 2, 4, 6)]
    y = [_lerp(x[0], x[1], frac.y), _lerp(x[2], x[3], frac.y)]
    return _lerp(y[0], y[1], frac.z)


def _lerp(a: mi.Float, b: mi.Float, t: mi.Float) -> mi.Float:
    return dr.fma(t, b - a, a)


def weights(frac: mi.Vector3f) -> list[mi.Float]:
    """The 8 trilinear weights at a point of a cell: the transpose of :func:`interpolate`."""
    x, y, z = (1 - frac.x, frac.x), (1 - frac.y, frac.y), (1 - frac.z, frac.z)
    return [c * b * a for c in z for b in y for a in x]


def node_weights(frac: mi.Vector3f, cell: Cell, res: tuple[int, int, int]) -> list[mi.Float]:
    """The 8 trilinear weights at a point of a cell (from its near planes), in the order of the grid's own axes."""
    return weights(_natural_frac(frac, cell, res))


def _natural_frac(frac: mi.Vector3f, cell: Cell, res: tuple[int, int, int]) -> mi.Vector3f:
    """Fractions along the grid's own axes, from fractions along the ray; see :func:`upward_frac`."""
    return upward_frac(dr.select(cell.ahead, frac, 1 - frac), cell.lower, res)


def upward_frac(frac: mi.Vector3f, lower: mi.Vector3i, res: tuple[int, int, int]) -> mi.Vector3f:
    """Fractions from the lower node of a cell; in the outer half voxel they put all weight on the only node that exists."""
    z, y, x = res
    return dr.select(lower < 0, 1, dr.select(lower >= mi.Vector3i(x - 1, y - 1, z - 1), 0, frac))
