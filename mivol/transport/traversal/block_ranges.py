"""The smallest and the largest value in each block of a grid's cells: local minorants and majorants for ratio tracking.

Conventions. Block b of an axis holds the cells b 2^shift - 1 to (b + 1) 2^shift - 2, and all nodes that they touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import largest_of
from mivol.transport.traversal.empty_blocks import Reduction, count_blocks, over_blocks

__all__ = ["BlockRanges", "find_block_ranges"]


SMALL = 96
"""Largest grid, in voxels along an axis, whose blocks are of 4 cells: their bounds are tighter, and a ray crosses few of them
(measured on delta tracking: up to 64^3 blocks of 4 cost less than blocks of 8, from 128^3 on more)."""


@dataclass
class BlockRanges:
    """The smallest value (minorant) and the range up to the largest (majorant) in each block of cells of a grid.

    Attributes:
        table: flat (blocks in z, y, x; then the smallest value of each channel, and last one range for all channels: the
            largest difference that any of them has between its largest and its smallest value).
        res: number of blocks along Z, Y, X.
        channels: number of channels of the grid.
        shift: log2 of the edge of a block [cells].
    """

    table: mi.Float
    res: tuple[int, int, int]
    channels: int
    shift: int

    def at(self, block: mi.Vector3i, active: mi.Bool) -> tuple[list[mi.Float], mi.Float]:
        """The smallest value of each channel in a block, and the range above it."""
        _, y, x = self.res
        n = self.channels + 1
        index = mi.UInt32((block.z * y + block.y) * x + block.x)
        row = [dr.gather(mi.Float, self.table, index * n + c, active) for c in range(n)]
        return row[:-1], row[-1]


def find_block_ranges(values: mi.TensorXf, shift: int | None = None) -> BlockRanges:
    """Find the minorant and the range of each block of a grid.

    Args:
        values: (Z, Y, X, C), finite.
        shift: log2 of the edge of a block [cells]; None for 2 in a grid of at most ``SMALL`` voxels an axis, else 3.

    Cost: 9/8 reads a voxel along each axis, since neighbouring blocks share a layer of nodes.
    """
    z, y, x, c = values.shape
    flat = dr.detach(values.array)
    if shift is None:
        shift = 2 if max(z, y, x) <= SMALL else 3
    res = tuple(count_blocks(n, shift) for n in (z, y, x))
    rows, ranges = [], []
    for channel in range(c):
        own = dr.gather(mi.Float, flat, dr.arange(mi.UInt32, z * y * x) * c + channel) if c > 1 else flat
        low = over_blocks(own, (z, y, x), shift, Reduction(dr.minimum, dr.inf))
        high = over_blocks(own, (z, y, x), shift, Reduction(dr.maximum, -dr.inf))
        rows.append(low)
        # A tracker divides (value - low) by this range. The range is rounded up, so that rounding never makes that exceed 1.
        ranges.append((high - low) * (1 + 1e-6))
    n = res[0] * res[1] * res[2]
    table = dr.zeros(mi.Float, n * (c + 1))
    for k, row in enumerate([*rows, largest_of(ranges)]):
        dr.scatter(table, row, dr.arange(mi.UInt32, n) * (c + 1) + k)
    dr.eval(table)
    return BlockRanges(table, res, c, shift)
