r"""What is believed of a radiance field before it is seen: it varies little, most of it is empty, most of it is matte.

.. math:: TV = \sum_k \sqrt{\delta^2 + |\nabla_h v_k|^2}, \qquad S = \sum_k \log(1 + 2 \sigma_k^2)

Conventions. A belief moves values by itself, after the step that the photographs asked for, as decoupled weight decay does:
inside RMSprop's quotient the weakest belief would move a row that no ray touched by a whole learning rate (measured on the
still life from 12 views: 24.4 dB so, 25.7 dB without, 30.5 dB with all three moved apart). How far is a share of the learning
rate, for that is how far photographs that agree move a value. Differences go to the next node along each axis (0 at the
border; nodes that are not stored hold the vacuum).

References: Rudin, Osher & Fatemi 1992; Fridovich-Keil, Yu et al. 2022 (runs of voxels; the Cauchy prior is that of Hedman et
al. 2021); Loshchilov & Hutter 2019 (decoupling).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical import SphericalGrid

__all__ = ["dull", "next_rows", "smooth", "thin_out"]


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


def smooth(
    values: mi.Float, width: int, neighbours: list[mi.UInt32], amount: float, share: float, start: int, rows: int
) -> None:
    """Move a run of rows down the slope of their total variation.

    With delta = 6 amount / share no step is longer than a sixth of the difference, so what was between the smallest and the
    largest value stays there.

    Args:
        values: ``width`` numbers a row; moved in place.
        neighbours: from :func:`next_rows`.
        amount: length of a step down a slope of 1, in the values' unit; 0 moves nothing.
        share: of the rows that are looked at; they stand for all.
        start: the first of them.
        rows: those that may move: the first so many.
    """
    if amount == 0:
        return
    count = dr.width(neighbours[0])
    row = (dr.arange(mi.UInt32, max(int(count * share), 1)) + dr.opaque(mi.UInt32, start)) % count
    ends = [row, *(dr.gather(mi.UInt32, n, row) for n in neighbours)]
    here, *there = (dr.gather(mi.ArrayXf, values, end, shape=(width, 1)) for end in ends)
    length = dr.opaque(mi.Float, amount / share)
    moved = [[] for _ in ends]
    for c in range(width):
        steps = [t[c] - here[c] for t in there]
        pull = length * dr.rsqrt(dr.square(6 * length) + sum(dr.square(s) for s in steps))
        for target, change in zip(moved, (sum(steps), *(-s for s in steps)), strict=True):
            target.append(pull * change)
    for end, change in zip(ends, moved, strict=True):
        dr.scatter_add(values, mi.ArrayXf(change), end, end < rows, mode=dr.ReduceMode.Direct)


def thin_out(density: mi.Float, amount: float, unit: float) -> mi.Float:
    """Density after a step of ``amount`` [1] down the Cauchy prior's slope, in units of 1 / ``unit``; it ends at 0."""
    if amount == 0:
        return density
    sigma = dr.maximum(density * unit, 0)
    step = dr.opaque(mi.Float, 4 * amount) * sigma / (1 + 2 * dr.square(sigma))
    return density - dr.minimum(step, sigma) * (1 / unit)


def dull(harmonics: mi.Float, width: int, share: float) -> mi.Float:
    """Coefficients, ``width`` a row, of which all but the three constant ones have lost a share."""
    if share == 0:
        return harmonics
    kept = dr.opaque(mi.Float, 1 - min(share, 1))
    return dr.select(dr.arange(mi.UInt32, dr.width(harmonics)) % width < 3, harmonics, harmonics * kept)
