r"""What is believed of a radiance field before it is seen: that it varies little, and that most of it is empty.

.. math:: TV = \sum_k \sqrt{\epsilon + |\nabla_h v_k|^2}, \qquad S = \sum_k \log(1 + 2 \sigma_k^2)

Conventions. Differences go to the next node along each axis (0 at the border; nodes that are not stored hold the vacuum) and
are scaled to a grid of 256 nodes, so one weight serves all resolutions. A step looks at a run of rows that begins anywhere and
stands for all. The weights' unit is that of svox2, where a step looks at a hundredth of all nodes.

References: Rudin, Osher & Fatemi 1992; Fridovich-Keil, Yu et al. 2022 (runs of voxels; the Cauchy prior is that of Hedman et
al. 2021).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical import SphericalGrid

__all__ = ["add_sparsity", "add_variation", "next_rows"]

FINENESS = 256
SHARE = 0.01
SMOOTH = 1e-9
"""Epsilon: differences below 3e-5 count quadratically."""


def next_rows(field: SphericalGrid) -> list[mi.UInt32]:
    """The row of the next node along x, y and z of each row; a node at the border is its own."""
    z, y, x = field.res
    rows = field.node_rows()
    node = mi.UInt32(field.listed().astype(np.uint32))
    found = []
    for stride, n in ((1, x), (x, y), (x * y, z)):
        inside = node // stride % n < n - 1
        found.append(dr.gather(mi.UInt32, rows, dr.select(inside, node + stride, node)))
    dr.eval(found)
    return found


def add_variation(
    values: mi.Float,
    slopes: mi.Float,
    width: int,
    neighbours: list[mi.UInt32],
    weight: float,
    fineness: float,
    share: float,
    start: int,
) -> None:
    """Add the derivative of the total variation of a run of rows.

    Args:
        values, slopes: ``width`` numbers a row; the derivative is added to ``slopes``.
        neighbours: from :func:`next_rows`.
        weight: of the prior; 0 adds nothing.
        fineness: nodes along the longest edge.
        share: of the rows that are looked at.
        start: the first of them.
    """
    if weight == 0:
        return
    rows, scaled = dr.width(neighbours[0]), fineness / FINENESS
    row = (dr.arange(mi.UInt32, max(int(rows * share), 1)) + dr.opaque(mi.UInt32, start)) % rows
    ends = [row, *(dr.gather(mi.UInt32, n, row) for n in neighbours)]
    here, *there = (dr.gather(mi.ArrayXf, values, end, shape=(width, 1)) for end in ends)
    moved = [[] for _ in ends]
    for c in range(width):
        steps = [(t[c] - here[c]) * scaled for t in there]
        norm = dr.rsqrt(SMOOTH + sum(dr.square(s) for s in steps)) * (weight * scaled * SHARE / share)
        for target, change in zip(moved, (-sum(steps), *steps), strict=True):
            target.append(norm * change)
    for end, change in zip(ends, moved, strict=True):
        dr.scatter_add(slopes, mi.ArrayXf(change), end, mode=dr.ReduceMode.Direct)


def add_sparsity(density: mi.Float, slopes: mi.Float, weight: float, unit: float) -> mi.Float:
    """Slopes with the derivative of the Cauchy prior on the extinction, in units of 1 / ``unit``, where there is some."""
    if weight == 0:
        return slopes
    sigma = dr.maximum(density * unit, 0)
    return slopes + (4 * weight * unit) * sigma / (1 + 2 * dr.square(sigma))
