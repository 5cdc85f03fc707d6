"""Blocks of cells of a sparse grid, from the stored bricks alone: occupancy, bounds and means.

Conventions. :mod:`mivol.transport.traversal.grid_blocks` defines blocks, :mod:`mivol.fields.bricks` bricks. A node outside the
stored bricks has the value 0. Sums run in another order than in a dense grid, so means differ by rounding.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mivol.fields.bricks import ABSENT, BITS, EDGE, Bricks
from mivol.files.volume import VOXELS

__all__ = ["mean_of_bricks", "occupied_blocks", "range_of_bricks"]

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
