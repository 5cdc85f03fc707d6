"""Where the values of a sparse grid are stored: bricks of 8^3 nodes, and a table of the bricks of its box.

Conventions. Those of :mod:`mivol.files.sparse_volume`. The *slot* of a node is its row among the stored values: the first slot
of its brick plus its place in the brick (z, y, x). A node of a brick that is not stored has the value 0 and no derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.files.sparse_volume import EDGE, VOXELS, count_bricks

__all__ = ["ABSENT", "Bricks", "Nodes"]

BITS = EDGE.bit_length() - 1

ABSENT = 1 << 31
"""First slot of a brick that is not stored. Stored slots are smaller."""


@dataclass
class Nodes:
    """Nodes of a grid as a reader sees them.

    Attributes:
        index: row of each node among the stored values.
        stored: which nodes are stored; None for a dense grid.
    """

    index: list[mi.UInt32]
    stored: list[mi.Bool] | None = None

    def select(self, active: mi.Bool) -> list[mi.Bool]:
        """For each node, the lanes of ``active`` in which the node is stored."""
        return [active] * len(self.index) if self.stored is None else [active & s for s in self.stored]


@dataclass
class Bricks:
    """The bricks of a sparse grid.

    Attributes:
        res: nodes (Z, Y, X) of the box.
        offset: nodes of the first brick before the box (Z, Y, X).
        table: UInt32, the first slot of each brick of the box (z, y, x); ``ABSENT`` if the brick is not stored.
        stored: UInt32, ascending numbers of the stored bricks.
        distances: UInt8, packed distance of each block of cells to the nearest one with a stored node, for a walk to skip.
    """

    res: tuple[int, int, int]
    offset: tuple[int, int, int]
    table: mi.UInt32
    stored: mi.UInt32
    distances: mi.UInt8 | None = None

    @classmethod
    def from_numbers(cls, res: tuple[int, int, int], offset: tuple[int, int, int], stored: mi.UInt32) -> Bricks:
        """Make the table from the ascending numbers of the stored bricks."""
        table = dr.full(mi.UInt32, ABSENT, int(np.prod(count_bricks(res, offset))))
        dr.scatter(table, dr.arange(mi.UInt32, dr.width(stored)) * VOXELS, stored)
        dr.eval(table)
        return cls(res, offset, table, stored)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Bricks of the box (Z, Y, X)."""
        return count_bricks(self.res, self.offset)

    @property
    def count(self) -> int:
        """Number of stored bricks."""
        return dr.width(self.stored)

    def has_same_slots(self, other: Bricks) -> bool:
        """Whether the nodes of two grids have the same slots. Tables are compared by identity, not by their values."""
        return (self.res, self.offset, self.table.index) == (other.res, other.offset, other.table.index)

    def find_corners(self, cell: mi.Vector3i, ahead: object, active: mi.Bool) -> Nodes:
        """Find the 8 corners of a cell, near and far along ``ahead``; a node beyond the border is the node at the border.

        Cost: one look-up in the table, and seven more where a cell of any of the lanes that are computed together (SIMD) lies
        in several bricks.
        """
        return find_corners(self.table, self.res, self.offset, cell, ahead, active)

    def find_slot(self, node: mi.Vector3i, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Find the slot of a node of the box, and whether it is stored."""
        place = node + mi.Vector3i(*self.offset[::-1])
        brick, inner = (place >> BITS) * _brick_strides(self.res, self.offset), (place & (EDGE - 1)) * _inner_strides()
        first = dr.gather(mi.UInt32, self.table, mi.UInt32(brick.x + brick.y + brick.z), active)
        return first + mi.UInt32(inner.x + inner.y + inner.z), active & (first < ABSENT)


def find_corners(
    table: mi.UInt32,
    res: tuple[int, int, int],
    offset: tuple[int, int, int],
    cell: mi.Vector3i,
    ahead: object,
    active: mi.Bool,
) -> Nodes:
    """Implement :meth:`Bricks.find_corners` for a loop, whose state holds the table alone."""
    brick, inner = _split_planes(res, offset, cell, ahead)
    return _find_nodes(table, brick[0], inner[0], list(zip(brick[1] - brick[0], inner[1] - inner[0], strict=True)), active)


def find_face(
    table: mi.UInt32,
    res: tuple[int, int, int],
    offset: tuple[int, int, int],
    cell: mi.Vector3i,
    ahead: object,
    through: object,
    is_far: mi.Bool,
    active: mi.Bool,
) -> Nodes:
    """Find the 4 corners in the near or far face of a cell across the axis ``through``.

    The order is that of the two other axes, the lower axis fastest: (y, z), (x, z) or (x, y).
    """
    brick, inner = _split_planes(res, offset, cell, ahead)
    steps = [(far - near, move - place) for near, far, place, move in zip(brick[0], brick[1], inner[0], inner[1], strict=True)]
    is_beyond = through & is_far
    brick, inner = dr.select(is_beyond, brick[1], brick[0]), dr.select(is_beyond, inner[1], inner[0])
    first = [dr.select(through.x, y, x) for x, y in zip(steps[0], steps[1], strict=True)]
    second = [dr.select(through.z, y, z) for y, z in zip(steps[1], steps[2], strict=True)]
    return _find_nodes(table, brick, inner, [tuple(first), tuple(second)], active)


def _split_planes(
    res: tuple[int, int, int], offset: tuple[int, int, int], cell: mi.Vector3i, ahead: object
) -> tuple[tuple[mi.Vector3i, mi.Vector3i], tuple[mi.Vector3i, mi.Vector3i]]:
    """The near and the far plane of a cell along each axis: their bricks, and their places in a brick."""
    z, y, x = res
    top, shift = mi.Vector3i(x - 1, y - 1, z - 1), mi.Vector3i(*offset[::-1])
    low, high = dr.clip(cell, 0, top) + shift, dr.clip(cell + 1, 0, top) + shift
    planes = dr.select(ahead, low, high), dr.select(ahead, high, low)
    strides, inner = _brick_strides(res, offset), _inner_strides()
    return tuple((p >> BITS) * strides for p in planes), tuple((p & (EDGE - 1)) * inner for p in planes)


def _find_nodes(
    table: mi.UInt32,
    brick: mi.Vector3i,
    place: mi.Vector3i,
    steps: list[tuple[mi.Int32, mi.Int32]],
    active: mi.Bool,
) -> Nodes:
    """Find a node and its neighbours by any of some steps; bit k of the number of a neighbour is step k.

    Args:
        table: first slots.
        brick, place: brick and place of the node, an axis each.
        steps: change of the brick and of the place in it.
        active: lanes to look up.
    """
    number, place = brick.x + brick.y + brick.z, place.x + place.y + place.z
    own = dr.gather(mi.UInt32, table, mi.UInt32(number), active)
    numbers, places, leaves = [number], [place], [mi.Bool(False)]
    for change, move in steps:
        leaves += [other | (change != 0) for other in leaves]
        numbers += [other + change for other in numbers]
        places += [other + move for other in places]

    def look_up(own: mi.UInt32, numbers: list[mi.Int32], leaves: list[mi.Bool]) -> list[mi.UInt32]:
        found = [dr.gather(mi.UInt32, table, mi.UInt32(n), on) for n, on in zip(numbers, leaves, strict=True)]
        return [dr.select(on, first, own) for first, on in zip(found, leaves, strict=True)]

    def repeat(own: mi.UInt32, numbers: list[mi.Int32], leaves: list[mi.Bool]) -> list[mi.UInt32]:
        return [mi.UInt32(own) for _ in numbers]

    # A gather costs the same for any number of lanes; most cells lie in one brick, and a branch passes them by.
    leaves = [active & other for other in leaves]
    others = dr.if_stmt((own, numbers[1:], leaves[1:]), leaves[-1], look_up, repeat, label="other bricks")
    firsts = [own, *others]
    index = [first + mi.UInt32(p) for first, p in zip(firsts, places, strict=True)]
    return Nodes(index, [first < ABSENT for first in firsts])


def _brick_strides(res: tuple[int, int, int], offset: tuple[int, int, int]) -> mi.Vector3i:
    _, y, x = count_bricks(res, offset)
    return mi.Vector3i(1, x, x * y)


def _inner_strides() -> mi.Vector3i:
    return mi.Vector3i(1, EDGE, EDGE * EDGE)
