"""Blocks of cells of a grid: distances to the nearest non-empty block, minorants and majorants, and means.

Conventions. Block b of an axis holds the cells b 2^shift - 1 to (b + 1) 2^shift - 2, and all nodes touching these cells.
Distances are Chebyshev distances (the largest of the distances along the three axes), counted in blocks. From a block at
distance k a ray may cross k - 1 blocks in a step. A walk reads *packed* distances: eight blocks share a word, the first one has
its lowest four bits. (A processor gathers words, not bytes: a gather of bytes is a loop over the lanes.)

Blocks of a sparse grid are found from the stored bricks alone (:mod:`mivol.fields.bricks`). A node outside them has the value
0. Sums run in another order than in a dense grid, so means differ by rounding.

References: Cohen & Sheffer 1994 (proximity clouds); Szirmay-Kalos et al. 2011 (super-grids).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.bricks import ABSENT, BITS, EDGE, Bricks
from mivol.files.volume import VOXELS
from mivol.numerics import maximum
from mivol.transport.traversal.lattice import Lattice

__all__ = [
    "BLOCK",
    "REACH",
    "block_shift",
    "SHIFT",
    "BlockExtremes",
    "bound_blocks",
    "count_blocks",
    "find_distances",
    "find_distances_of_bounds",
    "find_extremes",
    "find_occupied_blocks",
    "find_empty_distances",
    "find_stored_distances",
    "read_distance",
    "read_distances",
    "tabulate_ranges",
    "BlockRanges",
    "find_block_ranges",
    "CoarseGrid",
    "coarsen_grid",
    "mean_of_bricks",
    "occupied_blocks",
    "range_of_bricks",
]


SHIFT = 2
"""log2 of the edge of a block."""

BLOCK = 1 << SHIFT
"""Edge of a block [cells]. (An edge of 2 is no faster on threads in a grid of 512^3.)"""

REACH = 15
"""Largest stored distance [blocks]: that of four bits. Larger distances count as this distance. A ray crosses an empty box of
128^3 cells in 3 steps.
"""


@dataclass
class BlockExtremes:
    """The smallest and the largest value of each block of cells of a grid (Z, Y, X, C).

    Attributes:
        low, high: of each channel, flat over the blocks (z, y, x). They are infinite in a block with NaN.
        res: resolution (Z, Y, X) of the grid.
        shift: log2 of the edge of a block [cells].
    """

    low: list[mi.Float]
    high: list[mi.Float]
    res: tuple[int, int, int]
    shift: int

    @property
    def bounds(self) -> mi.Float:
        """The largest |value| of any channel in each block. A block with bound 0 is empty."""
        return maximum([dr.abs(end) for end in (*self.low, *self.high)])

    def floor(self) -> BlockExtremes:
        """The extremes of the values with 0 in place of negative values."""
        low, high = ([dr.maximum(end, 0) for end in ends] for ends in (self.low, self.high))
        return replace(self, low=low, high=high)

    def join(self) -> BlockExtremes:
        """The extremes of blocks with twice the edge."""
        counts, fine = ([count_blocks(n, self.shift + k) for n in self.res] for k in (1, 0))
        z, y, x = _split_index(dr.arange(mi.UInt32, math.prod(counts)), counts)
        low, high = ([mi.Float(end)] * len(self.low) for end in (dr.inf, -dr.inf))
        for q in range(8):
            # An odd number of blocks ends with a single block.
            parts = [dr.minimum(2 * i + (q >> k & 1), n - 1) for k, i, n in zip((2, 1, 0), (z, y, x), fine, strict=True)]
            block = (parts[0] * fine[1] + parts[1]) * fine[2] + parts[2]
            low = [dr.minimum(a, dr.gather(mi.Float, b, block)) for a, b in zip(low, self.low, strict=True)]
            high = [dr.maximum(a, dr.gather(mi.Float, b, block)) for a, b in zip(high, self.high, strict=True)]
        return BlockExtremes(low, high, self.res, self.shift + 1)


def find_extremes(values: mi.TensorXf, shift: int = SHIFT) -> BlockExtremes:
    """Find the smallest and the largest value of each block of 2^shift cells, in one kernel.

    Args:
        values: (Z, Y, X, C).
        shift: log2 of the edge of a block [cells].

    Cost: (1 + 2^-shift)^3 look-ups a voxel.
    """
    res, channels, edge, flat = tuple(values.shape[:3]), values.shape[3], (1 << shift) + 1, dr.detach(values.array)
    counts = [count_blocks(n, shift) for n in res]
    block = _split_index(dr.arange(mi.UInt32, math.prod(counts)), counts)
    # Block b of edge e holds the cells e b - 1 .. e (b + 1) - 2, so the nodes e b - 1 .. e (b + 1) - 1.
    z, y, x = (mi.Int32(b << shift) - 1 for b in block)
    low, high = ([dr.full(mi.Float, end, dr.width(z)) for _ in range(channels)] for end in (dr.inf, -dr.inf))

    def meet(row: mi.Int32, low: list, high: list, is_finite: mi.Bool) -> tuple[mi.Int32, list, list, mi.Bool]:
        first = _clamp(z + row // edge, res[0]) * res[1] + _clamp(y + row % edge, res[1])
        for k in range(edge):
            node = (first * res[2] + _clamp(x + k, res[2])) * channels
            found = [dr.gather(mi.Float, flat, node + c) for c in range(channels)]
            low = [dr.minimum(a, b) for a, b in zip(low, found, strict=True)]
            high = [dr.maximum(a, b) for a, b in zip(high, found, strict=True)]
            for value in found:
                is_finite &= dr.isfinite(value)
        return row + 1, low, high, is_finite

    state = (dr.zeros(mi.Int32, dr.width(z)), low, high, dr.full(mi.Bool, True, dr.width(z)))
    _, low, high, is_finite = dr.while_loop(state, lambda row, *_: row < edge * edge, meet, label="extremes of blocks")
    low, high = ([dr.select(is_finite, a, end) for a in ends] for ends, end in ((low, -dr.inf), (high, dr.inf)))
    dr.eval(low, high)
    return BlockExtremes(low, high, res, shift)


def _split_index(index: mi.UInt32, counts: Sequence[int]) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """The places along (z, y, x) of a flat index."""
    return index // (counts[1] * counts[2]), index // counts[2] % counts[1], index % counts[2]


def _clamp(node: mi.Int32, n: int) -> mi.UInt32:
    """An index of a node, clamped to the grid."""
    return mi.UInt32(dr.clip(node, 0, n - 1))


def bound_blocks(values: mi.TensorXf) -> mi.Float:
    """Bound |values| over each block of ``BLOCK``^3 cells, all channels together: ``BlockExtremes.bounds``."""
    return find_extremes(values).bounds


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


def find_empty_distances(values: mi.TensorXf) -> mi.UInt32:
    """Find the packed distances of :func:`find_distances_of_bounds` for a grid (Z, Y, X, C)."""
    return find_distances_of_bounds(bound_blocks(values), values.shape[:3])


def find_distances_of_bounds(bounds: mi.Float | mi.Bool, res: tuple[int, int, int]) -> mi.UInt32:
    """Find the packed distance of each block to the nearest non-empty block.

    Args:
        bounds: from :func:`bound_blocks`, or whether each block is occupied.
        res: resolution of the grid (Z, Y, X).

    Returns:
        Chebyshev distances [blocks], 0 for a non-empty block, at most ``REACH``; a word for eight blocks (z, y, x).

    Cost: at most 6 ``REACH`` look-ups a block.
    """
    occupied = bounds if dr.is_mask_v(bounds) else bounds > 0
    return _pack(find_distances(occupied, tuple(count_blocks(n) for n in res)))


def find_stored_distances(bricks: Bricks) -> mi.UInt32:
    """Find the packed distance of each block to the nearest block with a stored node of a sparse grid."""
    counts = tuple(count_blocks(n) for n in bricks.res)
    return _pack(find_distances(occupied_blocks(None, bricks, SHIFT, counts), counts))


def _pack(distances: mi.UInt8) -> mi.UInt32:
    """Pack the distances of eight blocks into a word."""
    count = dr.width(distances)
    first, packed = dr.arange(mi.UInt32, -(-count // 8)) * 8, mi.UInt32(0)
    for k in range(8):
        packed |= mi.UInt32(dr.gather(mi.UInt8, distances, first + k, first + k < count)) << (4 * k)
    dr.eval(packed)
    return packed


def read_distance(packed: mi.UInt32, block: mi.UInt32, active: mi.Bool = True) -> mi.Int32:
    """Read the distance of a block."""
    return mi.Int32((dr.gather(mi.UInt32, packed, block >> 3, active) >> ((block & 7) << 2)) & 15)


def read_distances(packed: mi.UInt32, res: tuple[int, int, int]) -> mi.Int32:
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
    """
    if bricks is None:
        return tabulate_ranges(find_extremes(values, block_shift(values.shape[:3]) if shift is None else shift))
    shift = block_shift(bricks.res) if shift is None else shift
    res, c, flat = tuple(count_blocks(n, shift) for n in bricks.res), values.shape[-1], dr.detach(values.array)
    node = dr.arange(mi.UInt32, dr.width(flat) // c) * c
    ends = [range_of_bricks(dr.gather(mi.Float, flat, node + channel), bricks, shift, res) for channel in range(c)]
    return tabulate_ranges(BlockExtremes(*(list(end) for end in zip(*ends, strict=True)), bricks.res, shift))


def tabulate_ranges(extremes: BlockExtremes) -> BlockRanges:
    """The minorant and the range of each block."""
    res, c = tuple(count_blocks(n, extremes.shift) for n in extremes.res), len(extremes.low)
    # A tracker divides (value - low) by this range. The range is rounded up, so that rounding never makes that exceed 1.
    ranges = [(high - low) * (1 + 1e-6) for low, high in zip(extremes.low, extremes.high, strict=True)]
    table = dr.empty(mi.Float, math.prod(res) * (c + 1))
    dr.scatter(table, mi.ArrayXf([*extremes.low, maximum(ranges)]), dr.arange(mi.UInt32, math.prod(res)))
    dr.eval(table)
    return BlockRanges(table, res, c, extremes.shift)


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


def place_blocks(lattice: Lattice, means: mi.TensorXf, shift: int, empty_distances: mi.UInt32 | None) -> Lattice:
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


# -- Blocks of sparse grids ------------------------------------------------------------------------------------------


Groups = list[tuple[int, list[int]]]
"""Blocks along an axis that a brick reaches, counted from the block of its first node, and the nodes of the brick in each."""


def occupied_blocks(nodes: mi.UInt8 | None, bricks: Bricks, shift: int, counts: tuple[int, int, int]) -> mi.Bool:
    """Find the blocks with a marked node.

    Args:
        nodes: mark of each stored node, 0 or 1; None marks them all.
        bricks: where the nodes are.
        shift: log2 of the edge of a block [cells].
        counts: blocks (Z, Y, X).

    Returns:
        Flat array over the blocks (z, y, x).
    """
    occupied = dr.zeros(mi.Bool, counts[0] * counts[1] * counts[2])
    groups = [_cell_groups(o, shift) for o in bricks.offset]
    if nodes is None:
        marks = dr.full(mi.UInt8, 1, bricks.count * _product([len(g) for g in groups]))
    else:
        marks = _reduce(nodes, bricks, groups, dr.maximum, 0, None)
    for block, mark, exists in _spread(marks, bricks, groups, shift, counts):
        dr.scatter(occupied, True, block, exists & (mark > 0))
    dr.eval(occupied)
    return occupied


def range_of_bricks(values: mi.Float, bricks: Bricks, shift: int, counts: tuple[int, int, int]) -> tuple[mi.Float, mi.Float]:
    """The smallest and the largest value of each block, flat over the blocks (z, y, x).

    Args:
        values: a number for each stored node.
        bricks: where the nodes are.
        shift: log2 of the edge of a block [cells].
        counts: blocks (Z, Y, X).
    """
    groups = [_cell_groups(o, shift) for o in bricks.offset]
    ends = []
    for combine, neutral in ((dr.minimum, dr.inf), (dr.maximum, -dr.inf)):
        reduced = _reduce(values, bricks, groups, combine, neutral, None)
        ends.append(_collect(reduced, bricks, groups, shift, counts, (-1, (1 << shift) - 1), combine, neutral))
    return ends[0], ends[1]


def mean_of_bricks(values: mi.Float, bricks: Bricks, shift: int) -> mi.Float:
    """Means over blocks of 2^shift voxels, as :func:`mivol.transport.traversal.grid_blocks.coarsen_grid`, of one channel."""
    counts = tuple(-(-n >> shift) for n in bricks.res)
    groups = [_voxel_groups(o, shift) for o in bricks.offset]
    # The last block repeats the border of the grid.
    repeats = tuple((m << shift) - n for m, n in zip(counts, bricks.res, strict=True))
    sums = _reduce(values, bricks, groups, _add, 0, repeats)
    return _collect(sums, bricks, groups, shift, counts, (0, (1 << shift) - 1), _add, 0) * 2.0 ** (-3 * shift)


def _add(a: mi.Float, b: mi.Float) -> mi.Float:
    return a + b


def _cell_groups(offset: int, shift: int) -> Groups:
    """Block b holds the cells b 2^shift - 1 to (b + 1) 2^shift - 2: a node i lies in the block of i + 1, and perhaps also in
    the block before it.
    """
    held: dict[int, list[int]] = {}
    for inner in range(EDGE):
        cell = inner - offset + 1
        held.setdefault(cell >> shift, []).append(inner)
        if cell % (1 << shift) == 0:
            held.setdefault((cell >> shift) - 1, []).append(inner)
    return sorted(held.items())


def _voxel_groups(offset: int, shift: int) -> Groups:
    held: dict[int, list[int]] = {}
    for inner in range(EDGE):
        held.setdefault((inner - offset) >> shift, []).append(inner)
    return sorted(held.items())


def _reduce(
    flat: mi.Float | mi.UInt8,
    bricks: Bricks,
    groups: Sequence[Groups],
    combine: Callable,
    neutral: float,
    repeats: tuple[int, int, int] | None,
) -> mi.Float | mi.UInt8:
    """Reduce the nodes of each brick to its blocks, axis by axis: (bricks, 8, 8, 8) to (bricks, blocks z, y, x).

    Nodes outside of the box count as ``neutral``. A node at the upper border counts 1 + ``repeats`` times in a sum.
    """
    sizes = [EDGE, EDGE, EDGE]
    for axis in (2, 1, 0):
        outer, inner, own = sizes[:axis], sizes[axis + 1 :], groups[axis]
        before, after = _product(outer), _product(inner)
        lane = dr.arange(mi.UInt32, bricks.count * before * after)
        brick, row = lane // (before * after), lane // after
        origin = mi.Int32(_place(bricks, dr.gather(mi.UInt32, bricks.stored, brick), axis) * EDGE) - bricks.offset[axis]
        reduced = dr.empty(type(flat), bricks.count * before * len(own) * after)
        for k, (_, nodes) in enumerate(own):
            best = type(flat)(neutral)
            for inner_node in nodes:
                value = dr.gather(type(flat), flat, (row * EDGE + inner_node) * after + lane % after)
                node = origin + inner_node
                if repeats is not None:
                    value *= dr.select(node == bricks.res[axis] - 1, 1 + repeats[axis], 1)
                best = combine(best, dr.select((node >= 0) & (node < bricks.res[axis]), value, type(flat)(neutral)))
            dr.scatter(reduced, best, (row * len(own) + k) * after + lane % after)
        dr.eval(reduced)
        flat, sizes[axis] = reduced, len(own)
    return flat


def _spread(
    reduced: mi.Float | mi.UInt8, bricks: Bricks, groups: Sequence[Groups], shift: int, counts: tuple[int, int, int]
) -> list[tuple[mi.UInt32, mi.Float | mi.UInt8, mi.Bool]]:
    """The flat block and the value of each entry of :func:`_reduce`, and whether the block exists."""
    sizes, found = [len(g) for g in groups], []
    row = dr.arange(mi.UInt32, bricks.count) * _product(sizes)
    first = [mi.Int32(_place(bricks, bricks.stored, axis) << (BITS - shift)) for axis in range(3)]
    for number, which in enumerate(itertools.product(*groups)):
        block = [start + steps for start, (steps, _) in zip(first, which, strict=True)]
        exists = mi.Bool(True)
        for b, n in zip(block, counts, strict=True):
            exists &= (b >= 0) & (b < n)
        flat = mi.UInt32((block[0] * counts[1] + block[1]) * counts[2] + block[2])
        found.append((flat, dr.gather(type(reduced), reduced, row + number), exists))
    return found


def _collect(
    reduced: mi.Float,
    bricks: Bricks,
    groups: Sequence[Groups],
    shift: int,
    counts: tuple[int, int, int],
    reach: tuple[int, int],
    combine: Callable,
    neutral: float,
) -> mi.Float:
    """Combine the entries of :func:`_reduce` for each block, from the first to the last node (``reach``, from 2^shift times the
    block); a brick that is not stored counts as 0. No scatter: a recording could not tell the size of what follows.
    """
    index = dr.arange(mi.UInt32, counts[0] * counts[1] * counts[2])
    block = (index // (counts[1] * counts[2]), index // counts[2] % counts[1], index % counts[2])
    axes = []
    for b, n, offset, group in zip(block, bricks.res, bricks.offset, groups, strict=True):
        first, last = (dr.clip((mi.Int32(b) << shift) + r, 0, n - 1) + offset >> BITS for r in reach)
        entry = [mi.Int32(b) - (brick << (BITS - shift)) - group[0][0] for brick in (first, last)]
        # At most two bricks along an axis.
        axes.append([(first, entry[0], mi.Bool(True)), (last, entry[1], first != last)])
    _, y, x = bricks.counts
    best, (_, size_y, size_x) = mi.Float(neutral), [len(g) for g in groups]
    for (k, at_z, on_z), (j, at_y, on_y), (i, at_x, on_x) in itertools.product(*axes):
        on = on_z & on_y & on_x
        slot = dr.gather(mi.UInt32, bricks.table, mi.UInt32((k * y + j) * x + i), on)
        row = mi.Int32(slot // VOXELS) * len(groups[0])
        place = mi.UInt32(((row + at_z) * size_y + at_y) * size_x + at_x)
        value = dr.gather(mi.Float, reduced, place, on & (slot < ABSENT))
        best = dr.select(on, combine(best, value), best)
    dr.eval(best)
    return best


def _place(bricks: Bricks, number: mi.UInt32, axis: int) -> mi.UInt32:
    """Place of a brick along an axis (0: z)."""
    _, y, x = bricks.counts
    return (number // (y * x), number // x % y, number % x)[axis]


def _product(sizes: Sequence[int]) -> int:
    total = 1
    for n in sizes:
        total *= n
    return total
