"""Blocks of cells of a grid: distances to the nearest non-empty block, minorants and majorants, and means.

Conventions. Block b of an axis holds the cells b 2^shift - 1 to (b + 1) 2^shift - 2, and all nodes touching these cells.
Distances are Chebyshev distances (the largest of the distances along the three axes), counted in blocks. From a block at
distance k a ray may cross k - 1 blocks in a step. A walk reads *packed* distances: two blocks share a byte, the first one has
its lower four bits.

References: Cohen & Sheffer 1994 (proximity clouds); Szirmay-Kalos et al. 2011 (super-grids).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.bricks import BITS, Bricks
from mivol.numerics import maximum
from mivol.transport.traversal.brick_blocks import mean_of_bricks, occupied_blocks, range_of_bricks
from mivol.transport.traversal.lattice import Lattice

__all__ = [
    "BLOCK",
    "REACH",
    "block_shift",
    "SHIFT",
    "Reduction",
    "bound_blocks",
    "count_blocks",
    "find_distances",
    "find_distances_of_bounds",
    "find_occupied_blocks",
    "find_empty_distances",
    "find_stored_distances",
    "read_distance",
    "read_distances",
    "reduce_blocks",
    "BlockRanges",
    "find_block_ranges",
    "CoarseGrid",
    "coarsen_grid",
]


SHIFT = 2
"""log2 of the edge of a block."""

BLOCK = 1 << SHIFT
"""Edge of a block [cells]. (An edge of 2 is no faster on threads in a grid of 512^3.)"""

REACH = 15
"""Largest stored distance [blocks]: that of four bits. Larger distances count as this distance. A ray crosses an empty box of
128^3 cells in 3 steps.
"""


def bound_blocks(values: mi.TensorXf) -> mi.Float:
    """Bound |values| over each block of ``BLOCK``^3 cells, all channels together.

    Returns:
        Flat array over the blocks (z, y, x), ceil((N + 1) / BLOCK) along an axis of N voxels. A block with bound 0 is empty.

    Cost: 5/4 look-ups a voxel along x, fewer along y and z.
    """
    flat = _channel_max(dr.abs(dr.detach(values.array)), values.shape[3])
    return reduce_blocks(flat, values.shape[:3], SHIFT, Reduction(dr.maximum, 0))


def find_occupied_blocks(values: mi.TensorXf, bricks: Bricks) -> mi.Bool:
    """Find the blocks of a sparse grid (bricks, 8, 8, 8, C) with a value other than 0, flat over the blocks (z, y, x)."""
    counts = tuple(count_blocks(n) for n in bricks.res)
    flat, c = dr.detach(values.array), values.shape[-1]
    node, occupied = dr.arange(mi.UInt32, dr.width(flat) // c) * c, mi.Bool(False)
    for channel in range(c):
        occupied |= dr.gather(mi.Float, flat, node + channel) != 0
    return occupied_blocks(dr.select(occupied, mi.UInt8(1), mi.UInt8(0)), bricks, SHIFT, counts)


def count_blocks(n: int, shift: int = SHIFT) -> int:
    """Number of blocks of 2^shift cells along an axis of n voxels (n + 1 cells)."""
    return -(-(n + 1) >> shift)


class Reduction(NamedTuple):
    """An associative function of two arrays, with its neutral element."""

    combine: Callable[[mi.Float, mi.Float], mi.Float]
    neutral: float


def reduce_blocks(flat: mi.Float, res: tuple[int, int, int], shift: int, reduction: Reduction) -> mi.Float:
    """Reduce the values at all nodes of each block of cells, axis by axis.

    Args:
        flat: a number for each voxel (Z, Y, X).
        res: (Z, Y, X).
        shift: log2 of the edge of a block [cells].
        reduction: function that combines two values.

    Returns:
        Flat array over the blocks (z, y, x).
    """
    z, y, x = res
    b_y, b_x = count_blocks(y, shift), count_blocks(x, shift)
    for shape in ((z * y, x, 1), (z, y, b_x), (1, z, b_y * b_x)):
        flat = _over_axis(flat, shape, shift, reduction)
    return flat


def _channel_max(flat: mi.Float, channels: int) -> mi.Float:
    """Maximum over the last axis of (voxels, channels)."""
    base = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    best = mi.Float(0)
    for c in range(channels):
        best = dr.maximum(best, dr.gather(mi.Float, flat, base + c))
    return best


def _over_axis(flat: mi.Float, shape: tuple[int, int, int], shift: int, reduction: Reduction) -> mi.Float:
    """Reduce the nodes of each block along the middle axis of ``shape`` = (outer, n, inner)."""
    outer, n, inner = shape
    b, edge = count_blocks(n, shift), 1 << shift
    i = dr.arange(mi.UInt32, outer * b * inner)
    # Block b of edge e holds the cells e b - 1 .. e (b + 1) - 2, so the nodes e b - 1 .. e (b + 1) - 1.
    first = mi.Int32((i // inner) % b) * edge - 1
    row = (i // (inner * b)) * (n * inner) + i % inner
    best = mi.Float(reduction.neutral)
    for k in range(edge + 1):
        node = mi.UInt32(dr.clip(first + k, 0, n - 1))
        best = reduction.combine(best, dr.gather(mi.Float, flat, row + node * inner))
    dr.eval(best)
    return best


def find_empty_distances(values: mi.TensorXf) -> mi.UInt8:
    """Find the packed distances of :func:`find_distances_of_bounds` for a grid (Z, Y, X, C)."""
    return find_distances_of_bounds(bound_blocks(values), values.shape[:3])


def find_distances_of_bounds(bounds: mi.Float | mi.Bool, res: tuple[int, int, int]) -> mi.UInt8:
    """Find the packed distance of each block to the nearest non-empty block.

    Args:
        bounds: from :func:`bound_blocks`, or whether each block is occupied.
        res: resolution of the grid (Z, Y, X).

    Returns:
        Chebyshev distances [blocks], 0 for a non-empty block, at most ``REACH``; a byte for two blocks (z, y, x).

    Cost: at most 6 ``REACH`` look-ups a block.
    """
    occupied = bounds if dr.is_mask_v(bounds) else bounds > 0
    return _pack(find_distances(occupied, tuple(count_blocks(n) for n in res)))


def find_stored_distances(bricks: Bricks) -> mi.UInt8:
    """Find the packed distance of each block to the nearest block with a stored node of a sparse grid."""
    counts = tuple(count_blocks(n) for n in bricks.res)
    return _pack(find_distances(occupied_blocks(None, bricks, SHIFT, counts), counts))


def _pack(distances: mi.UInt8) -> mi.UInt8:
    """Pack the distances of two blocks into a byte."""
    count = dr.width(distances)
    first = dr.arange(mi.UInt32, (count + 1) // 2) * 2
    low, high = (dr.gather(mi.UInt8, distances, block, block < count) for block in (first, first + 1))
    packed = mi.UInt8(mi.UInt32(low) | (mi.UInt32(high) << 4))
    dr.eval(packed)
    return packed


def read_distance(packed: mi.UInt8, block: mi.UInt32, active: mi.Bool = True) -> mi.Int32:
    """Read the distance of a block."""
    pair = mi.UInt32(dr.gather(mi.UInt8, packed, block >> 1, active))
    return mi.Int32((pair >> ((block & 1) << 2)) & 15)


def read_distances(packed: mi.UInt8, res: tuple[int, int, int]) -> mi.Int32:
    """Read the distances of all blocks (z, y, x) of a grid (Z, Y, X)."""
    return read_distance(packed, dr.arange(mi.UInt32, math.prod(count_blocks(n) for n in res)))


def find_distances(occupied: mi.Bool, counts: tuple[int, int, int]) -> mi.UInt8:
    """Find the Chebyshev distance of each of (Z, Y, X) blocks to the nearest occupied block, at most ``REACH``.

    Cost: at most 6 ``REACH`` look-ups a block, axis by axis.
    """
    z, y, x = counts
    far = dr.select(occupied, mi.UInt8(0), mi.UInt8(REACH))
    for stride, n in ((1, x), (x, y), (x * y, z)):
        dr.eval(far)
        far = _nearest(far, stride, n)
    dr.eval(far)
    return far


@dr.syntax
def _nearest(far: mi.UInt8, stride: int, n: int) -> mi.UInt8:
    """Extend distances across the previous axes to another axis.

    The new distance of a block is a minimum over its neighbours along the axis. The term of a neighbour is the larger of two
    numbers: its distance along the axis, and its own distance ``far`` across the previous axes.
    """
    index = dr.arange(mi.Int32, dr.width(far))
    place = index // stride % n
    best = mi.UInt8(far)
    k = mi.Int32(1)
    while k < mi.Int32(best):
        low = dr.gather(mi.UInt8, far, mi.UInt32(index - k * stride), place >= k)
        high = dr.gather(mi.UInt8, far, mi.UInt32(index + k * stride), place + k < n)
        low = dr.select(place >= k, low, mi.UInt8(REACH))
        high = dr.select(place + k < n, high, mi.UInt8(REACH))
        best = dr.minimum(best, dr.maximum(dr.minimum(low, high), mi.UInt8(k)))
        k += 1
    return best


SMALL = 96
"""Largest grid [voxels along an axis] with blocks of 4 cells. (Delta tracking: blocks of 4 cost less than blocks of 8 up to
64^3, and more from 128^3 on.)
"""


@dataclass
class BlockRanges:
    """The smallest value (minorant) and the range up to the largest value (majorant) of each block of cells.

    Attributes:
        table: flat; blocks (z, y, x), then the smallest value of each channel, then a range shared by the channels: the largest
            difference of any channel between its largest and its smallest value.
        res: number of blocks along Z, Y, X.
        channels: number of channels of the grid.
        shift: log2 of the edge of a block [cells].
    """

    table: mi.Float
    res: tuple[int, int, int]
    channels: int
    shift: int

    def read(self, block: mi.Vector3i, active: mi.Bool) -> tuple[list[mi.Float], mi.Float]:
        """Read the smallest value of each channel in a block, and the range above the smallest values."""
        _, y, x = self.res
        n = self.channels + 1
        index = mi.UInt32((block.z * y + block.y) * x + block.x)
        row = [dr.gather(mi.Float, self.table, index * n + c, active) for c in range(n)]
        return row[:-1], row[-1]


def block_shift(res: tuple[int, int, int]) -> int:
    """log2 of the edge of the blocks of a grid (Z, Y, X) [cells]: 2 up to ``SMALL`` voxels an axis, 3 for larger grids."""
    return 2 if max(res) <= SMALL else 3


def find_block_ranges(values: mi.TensorXf, shift: int | None = None, bricks: Bricks | None = None) -> BlockRanges:
    """Find the minorant and the range of each block of a grid.

    Args:
        values: (Z, Y, X, C), finite; (bricks, 8, 8, 8, C) of a sparse grid.
        shift: log2 of the edge of a block [cells]; by default :func:`block_shift`.
        bricks: where the values of a sparse grid are stored.

    Cost: 9/8 reads a voxel along each axis, since neighbouring blocks share a layer of nodes.
    """
    c, flat = values.shape[-1], dr.detach(values.array)
    nodes = values.shape[:3] if bricks is None else bricks.res
    shift = block_shift(nodes) if shift is None else shift
    res = tuple(count_blocks(n, shift) for n in nodes)
    rows, ranges = [], []
    for channel in range(c):
        own = dr.gather(mi.Float, flat, dr.arange(mi.UInt32, dr.width(flat) // c) * c + channel) if c > 1 else flat
        if bricks is None:
            low = reduce_blocks(own, nodes, shift, Reduction(dr.minimum, dr.inf))
            high = reduce_blocks(own, nodes, shift, Reduction(dr.maximum, -dr.inf))
        else:
            low, high = range_of_bricks(own, bricks, shift, res)
        rows.append(low)
        # A tracker divides (value - low) by this range. The range is rounded up, so that rounding never makes that exceed 1.
        ranges.append((high - low) * (1 + 1e-6))
    n = res[0] * res[1] * res[2]
    table = dr.zeros(mi.Float, n * (c + 1))
    for k, row in enumerate([*rows, maximum(ranges)]):
        dr.scatter(table, row, dr.arange(mi.UInt32, n) * (c + 1) + k)
    dr.eval(table)
    return BlockRanges(table, res, c, shift)


@dataclass
class CoarseGrid:
    """The means of a grid over blocks of voxels, as a grid in the same place.

    Attributes:
        lattice: voxel i holds the mean of the voxels 2^shift i to 2^shift (i + 1) - 1 along each axis; the last voxel repeats
            the border of the grid.
        is_occupied: whether each block (z, y, x) is non-empty, for a visibility cache; None if it was not asked for.
    """

    lattice: Lattice
    is_occupied: mi.Bool | None


def coarsen_grid(lattice: Lattice, shift: int, finds_occupied: bool) -> CoarseGrid:
    """Average a grid over blocks of 2^shift voxels along each axis.

    Args:
        lattice: the grid.
        shift: log2 of the edge of a block [voxels].
        finds_occupied: whether to find the non-empty blocks.

    Cost: 8/7 look-ups a voxel, 8 a block.
    """
    c, shape, below = lattice.channels, list(lattice.res), 0
    flat = dr.detach(lattice.values.array)
    if lattice.bricks is not None:
        # A block of more voxels than a brick is the mean of smaller blocks, of which the last repeats the border.
        below = min(shift, BITS)
        flat, shape = _mean_stored(lattice, below), [-(-n >> below) for n in shape]
    edge = 1 << shift - below
    for axis in (2, 1, 0) if edge > 1 or lattice.bricks is None else ():
        inner = int(np.prod(shape[axis + 1 :])) * c
        flat = _mean_along(flat, shape[axis], inner, edge)
        shape[axis] = -(-shape[axis] // edge)
    values = mi.TensorXf(flat, (*shape, c))
    empty_distances = find_empty_distances(values) if lattice.empty_distances is not None else None
    is_occupied = _find_occupied(values, lattice.res, shift) if finds_occupied else None
    return CoarseGrid(place_blocks(lattice, values, shift, empty_distances), is_occupied)


def place_blocks(lattice: Lattice, means: mi.TensorXf, shift: int, empty_distances: mi.UInt8 | None = None) -> Lattice:
    """Place the means of blocks of 2^shift voxels of a lattice as a grid of their own."""
    ratios = [(m << shift) / n for m, n in zip(means.shape[2::-1], lattice.res[::-1], strict=True)]
    return Lattice(means, lattice.to_world @ np.diag([*ratios, 1.0]), empty_distances)


def _mean_stored(lattice: Lattice, shift: int) -> mi.Float:
    """Means of blocks of a sparse grid (Z, Y, X, C), flat."""
    c, flat = lattice.channels, dr.detach(lattice.values.array)
    node = dr.arange(mi.UInt32, dr.width(flat) // c)
    means = [mean_of_bricks(dr.gather(mi.Float, flat, node * c + k), lattice.bricks, shift) for k in range(c)]
    return dr.ravel(mi.ArrayXf(means)) if c > 1 else means[0]


def _mean_along(flat: mi.Float, n: int, inner: int, edge: int) -> mi.Float:
    """Means of ``edge`` neighbours along the middle axis of (outer, n, inner)."""
    b = -(-n // edge)
    i = dr.arange(mi.UInt32, dr.width(flat) // n * b)
    row, first = (i // (inner * b)) * (n * inner) + i % inner, (i // inner) % b * edge
    total = mi.Float(0)
    for k in range(edge):
        total += dr.gather(mi.Float, flat, row + dr.minimum(first + k, n - 1) * inner)
    total *= 1 / edge
    dr.eval(total)
    return total


def _find_occupied(means: mi.TensorXf, res: tuple[int, int, int], shift: int) -> mi.Bool:
    """Find the blocks of cells with a node above 0.

    A block of cells lies across two mean voxels along each axis (a single voxel at the border), so a block with 8 zero means is
    empty.
    """
    c, sizes = means.shape[3], [(n >> shift) + 1 for n in res]
    i, is_occupied = dr.arange(mi.UInt32, sizes[0] * sizes[1] * sizes[2]), mi.Bool(False)
    block = (i // (sizes[1] * sizes[2]), i // sizes[2] % sizes[1], i % sizes[2])
    for corner in range(8):
        z, y, x = (
            dr.clip(mi.Int32(b) - (corner >> k & 1), 0, n - 1) for k, (b, n) in enumerate(zip(block, means.shape, strict=False))
        )
        node = mi.UInt32((z * means.shape[1] + y) * means.shape[2] + x) * c
        for channel in range(c):
            is_occupied |= dr.gather(mi.Float, means.array, node + channel) > 0
    return is_occupied
