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
        distances: UInt8, distance of each block of cells to the nearest block with a stored node, for a walk to skip.
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

        Cost: one look-up in the table, and one for each corner in another brick than the near corner (0.4 on average).
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
    z, y, x = res
    top, shift = mi.Vector3i(x - 1, y - 1, z - 1), mi.Vector3i(*offset[::-1])
    low, high = dr.clip(cell, 0, top) + shift, dr.clip(cell + 1, 0, top) + shift
    near, far = dr.select(ahead, low, high), dr.select(ahead, high, low)
    strides, inner = _brick_strides(res, offset), _inner_strides()
    brick, step = (near >> BITS) * strides, ((far >> BITS) - (near >> BITS)) * strides
    near, far = (near & (EDGE - 1)) * inner, (far & (EDGE - 1)) * inner
    brick, crosses = brick.x + brick.y + brick.z, step != 0
    own = dr.gather(mi.UInt32, table, mi.UInt32(brick), active)
    index, stored = [], []
    for q in range(8):
        first = own
        if q:
            axes = [a for a in range(3) if q >> a & 1]
            beyond, other = mi.Bool(False), brick
            for a in axes:
                beyond, other = beyond | crosses[a], other + step[a]
            # Few lanes look up: a gather costs its active lanes.
            first = dr.select(beyond, dr.gather(mi.UInt32, table, mi.UInt32(other), active & beyond), own)
        place = (far if q & 4 else near).z + (far if q & 2 else near).y + (far if q & 1 else near).x
        index.append(first + mi.UInt32(place))
        stored.append(first < ABSENT)
    return Nodes(index, stored)


def _brick_strides(res: tuple[int, int, int], offset: tuple[int, int, int]) -> mi.Vector3i:
    _, y, x = count_bricks(res, offset)
    return mi.Vector3i(1, x, x * y)


def _inner_strides() -> mi.Vector3i:
    return mi.Vector3i(1, EDGE, EDGE * EDGE)
