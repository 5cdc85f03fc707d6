r"""Transmittance by looking here and there: unbiased, and cheaper than every cell where a grid is fine.

.. math:: \hat T = e^{-\int m\,dt} \prod_j \left(1 - \frac{\sigma(x_j) - m}{\kappa\,(M - m)}\right)

Of each block of cells its least value m and its largest value M are known. What m takes from a ray is known exactly; of what
lies above it the ray learns at points that a Poisson process of the rate kappa (M - m) puts on it (residual ratio tracking).
At such a point one of the eight corners of the cell is read, drawn by its trilinear weight: the product is linear in each of
its factors, so the mean is that of the trilinear value.

Conventions. Every factor lies in [0, 1], for m and M bound the corners themselves: an estimate is never above exp(-int m), and
its variance never above T (exp(-int m) - T). A block without extinction costs one step and no look-up.

References: Novak et al. 2014 (residual ratio tracking); Szirmay-Kalos et al. 2011 (blocks); Hofmann et al. 2021 (a corner in
place of eight).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.dice import roll
from mivol.transport.lattice import Cell, Lattice, Segment, count_blocks, over_blocks, walk

__all__ = ["Blocks", "find_blocks", "track"]

SHIFT = 3
"""log2 of the edge of a block, in cells."""

FAINT = 0.1
"""Estimate below which a ray is ended by chance: what little it would bring is not worth its look-ups."""

KAPPA = 4.0
"""Look-ups for each optical depth 1 between the least and the largest value."""


@dataclass
class Blocks:
    """The least and the largest value of each block of cells of a grid.

    Block b of an axis holds the cells b 2^SHIFT - 1 to (b + 1) 2^SHIFT - 2, and all nodes that they touch.

    Attributes:
        table: flat (blocks in z, y, x; least value of each channel, then the largest that any channel has above its least).
        res: blocks along Z, Y, X.
        channels: of the grid.
    """

    table: mi.Float
    res: tuple[int, int, int]
    channels: int

    def at(self, block: mi.Vector3i, active: mi.Bool) -> tuple[list[mi.Float], mi.Float]:
        """Least value of each channel, and the range above, of a block."""
        _, y, x = self.res
        n = self.channels + 1
        index = mi.UInt32((block.z * y + block.y) * x + block.x)
        row = [dr.gather(mi.Float, self.table, index * n + c, active) for c in range(n)]
        return row[:-1], row[-1]


def find_blocks(values: mi.TensorXf) -> Blocks:
    """Look at every voxel of a grid once (9/8 times along each axis).

    Args:
        values: (Z, Y, X, C), finite.
    """
    z, y, x, c = values.shape
    flat = dr.detach(values.array)
    res = tuple(count_blocks(n, SHIFT) for n in (z, y, x))
    rows, ranges = [], []
    for channel in range(c):
        own = dr.gather(mi.Float, flat, dr.arange(mi.UInt32, z * y * x) * c + channel) if c > 1 else flat
        low = over_blocks(own, (z, y, x), SHIFT, dr.minimum, dr.inf)
        high = over_blocks(own, (z, y, x), SHIFT, dr.maximum, -dr.inf)
        rows.append(low)
        # Rounding of the differences below must not take a factor out of [0, 1].
        ranges.append((high - low) * (1 + 1e-6))
    n = res[0] * res[1] * res[2]
    table = dr.zeros(mi.Float, n * (c + 1))
    for k, row in enumerate([*rows, _most(ranges)]):
        dr.scatter(table, row, dr.arange(mi.UInt32, n) * (c + 1) + k)
    dr.eval(table)
    return Blocks(table, res, c)


@dataclass
class _Coarse:
    """The blocks as cells of a lattice of their own, for a walk."""

    res: tuple[int, int, int]
    gaps: None = None


@dataclass
class Tracked:
    """What has been learnt of a ray.

    Attributes:
        tau: optical depth [1] of the least values, of each channel.
        weight: product of the factors, of each channel.
        ahead: optical depth of the process to the next point.
        dice: state of the generator.
    """

    tau: list[mi.Float]
    weight: list[mi.Float]
    ahead: mi.Float
    dice: mi.UInt32


def track(
    lattice: Lattice,
    segment: Segment,
    scale: mi.Float,
    dice: mi.UInt32,
    active: mi.Bool,
) -> tuple[list[mi.Float], mi.UInt32]:
    """Estimate the transmittance of a segment for each channel.

    Args:
        lattice: the grid, and its blocks.
        segment: from :func:`mivol.transport.lattice.clip`.
        scale: factor on the values.
        dice: state of the generator.
        active: lanes to track; the others return 1.

    Returns:
        The estimates, and the state of the generator.

    Bias: none. Variance: T^2 (exp(int E(c - m)^2 / (kappa (M - m)) dt) - 1), c the corner that is drawn, and what the roulette
        adds; T (max(exp(-int m dt), FAINT) - T) at most.
    Cost: one step a block, one read for each look-up, kappa int (M - m) dt of them.
    """
    ahead = segment.d > 0
    speed = dr.abs(segment.d) * 2.0**-SHIFT
    rate = KAPPA * scale
    coarse = _coarse_segment(segment)
    blocks, res, channels, values = lattice.blocks, lattice.res, lattice.channels, dr.detach(lattice.values.array)

    def visit(state: Tracked, cell: Cell, on: mi.Bool) -> tuple[Tracked, mi.Float]:
        least, above = blocks.at(cell.lower + 1, on)
        density = rate * above
        # -- How far: to the end of the block, or to the next point -----------------------------------------------------
        meets = on & (state.ahead < density * cell.dt)
        dt = dr.select(meets, dr.minimum(state.ahead / density, cell.dt), cell.dt)
        tau = [t + dr.select(on, scale * m * dt, 0) for t, m in zip(state.tau, least, strict=True)]
        # -- What is there: one corner of the cell ----------------------------------------------------------------------
        near = dr.fma(speed, dt, cell.frac)
        inside = dr.select(ahead, near, 1 - near) * (1 << SHIFT)
        dice, u = roll(state.dice, 5)
        node = mi.Vector3i(dr.floor(inside + mi.Vector3f(*u[:3])))
        node = (cell.lower + 1) * (1 << SHIFT) - 1 + node
        node = dr.clip(node, 0, mi.Vector3i(res[2] - 1, res[1] - 1, res[0] - 1))
        index = mi.UInt32((node.z * res[1] + node.y) * res[2] + node.x) * channels
        weight = []
        for c, (w, m) in enumerate(zip(state.weight, least, strict=True)):
            value = dr.gather(mi.Float, values, index + c, meets)
            factor = 1 - (value - m) / (KAPPA * above)
            weight.append(dr.select(meets, w * factor, w))
        fresh = -dr.log(u[3])
        left = dr.select(meets, fresh, dr.maximum(state.ahead - dr.select(on, density * dt, 0), 0))
        # -- Roulette ---------------------------------------------------------------------------------------------------
        seen = _most([w * dr.exp(-t) for w, t in zip(weight, tau, strict=True)])
        lives = u[4] * FAINT < seen
        lift = dr.select(lives, dr.maximum(1, FAINT / seen), 0)
        weight = [dr.select(on, w * lift, w) for w in weight]
        return Tracked(tau, weight, left, dice), dt

    def is_dark(state: Tracked) -> mi.Bool:
        return _most(state.weight) == 0

    width = dr.width(segment.t0)
    dice, u = roll(dice, 1)
    start = Tracked(
        [dr.zeros(mi.Float, width) for _ in range(channels)],
        [dr.full(mi.Float, 1, width) for _ in range(channels)],
        -dr.log(u[0]),
        mi.UInt32(dice),
    )
    end = walk(_Coarse(tuple(n - 1 for n in blocks.res)), coarse, visit, start, (), active, is_dark, halts=True)
    return [w * dr.exp(-t) for t, w in zip(end.tau, end.weight, strict=True)], end.dice


def _most(rows: list[mi.Float]) -> mi.Float:
    most = rows[0]
    for row in rows[1:]:
        most = dr.maximum(most, row)
    return most


def _coarse_segment(segment: Segment) -> Segment:
    """A segment among the cells as one among the blocks: exact, for a block is a power of two of cells."""
    share = 2.0**-SHIFT
    cell = segment.cell + 1
    block = cell >> SHIFT
    frac = (mi.Vector3f(cell & ((1 << SHIFT) - 1)) + segment.frac) * share
    return Segment(block - 1, frac, segment.d * share, segment.d_rest * share, segment.t0, segment.length)
