"""Where the values of a sparse grid are stored: in bricks of 8^3 nodes with a table of the bricks of the box, or node by node.

Conventions. Those of :mod:`mivol.files.volume`. The *slot* of a node is its row among the stored values: the first slot
of its brick plus its place in the brick (z, y, x). A node of a brick that is not stored has the value 0 and no derivative.

:class:`SparseIndex` stores single nodes instead, in ascending order. The row of a stored node is its rank, the number of stored
nodes before it. The index holds, for each word of 32 nodes, their bits and the rank of the first; a population count of the
bits below a node's own bit gives the rest (Jacobson 1989: the rank of a bit in constant time).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.files.volume import EDGE, VOXELS, count_bricks
from mivol.numerics import fast_max, fast_min

__all__ = [
    "ABSENT",
    "Bricks",
    "Nodes",
    "SparseIndex",
]

BITS = EDGE.bit_length() - 1

ADDRESS_BITS = 3 * BITS
"""Bits of the address of a node that hold its place in a brick."""

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
        distances: UInt32, packed distance of each block of cells to the nearest one with a stored node, for a walk to skip.
    """

    res: tuple[int, int, int]
    offset: tuple[int, int, int]
    table: mi.UInt32
    stored: mi.UInt32
    distances: mi.UInt32 | None = None

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
        shares = _address_shares(node + mi.Vector3i(*self.offset[::-1]), self.res, self.offset)
        address = mi.UInt32(shares.x + shares.y + shares.z)
        first = dr.gather(mi.UInt32, self.table, address >> ADDRESS_BITS, active)
        return first + (address & (VOXELS - 1)), active & (first < ABSENT)


def find_corners(
    table: mi.UInt32,
    res: tuple[int, int, int],
    offset: tuple[int, int, int],
    cell: mi.Vector3i,
    ahead: object,
    active: mi.Bool,
) -> Nodes:
    """Implement :meth:`Bricks.find_corners` for a loop, whose state holds the table alone."""
    near, far = _planes(res, offset, cell, ahead)
    return _find_nodes(table, near.x + near.y + near.z, [f - n for n, f in zip(near, far, strict=True)], active)


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
    near, far = _planes(res, offset, cell, ahead)
    wide = far - near
    base = dr.select(through & is_far, far, near)
    steps = [dr.select(through.x, wide.y, wide.x), dr.select(through.z, wide.y, wide.z)]
    return _find_nodes(table, base.x + base.y + base.z, steps, active)


def _planes(
    res: tuple[int, int, int], offset: tuple[int, int, int], cell: mi.Vector3i, ahead: object
) -> tuple[mi.Vector3i, mi.Vector3i]:
    """The shares of the near and the far plane of a cell in the address of a node, along each axis."""
    z, y, x = res
    shift = mi.Vector3i(*offset[::-1])
    low, high = fast_max(cell, 0), fast_min(cell + 1, mi.Vector3i(x - 1, y - 1, z - 1))
    low, high = (_address_shares(p + shift, res, offset) for p in (low, high))
    return dr.select(ahead, low, high), dr.select(ahead, high, low)


def _address_shares(place: mi.Vector3i, res: tuple[int, int, int], offset: tuple[int, int, int]) -> mi.Vector3i:
    """The shares of the axes in the address of a node, from its place counted from the first brick.

    The address is 512 times the number of the brick plus the place in the brick, and the sum of the three shares.
    """
    inner = mi.Vector3i(1, EDGE, EDGE * EDGE)
    return place * inner + (place >> BITS) * (VOXELS * _brick_strides(res, offset) - EDGE * inner)


def _find_nodes(table: mi.UInt32, first: mi.Int32, steps: list[mi.Int32], active: mi.Bool) -> Nodes:
    """Find a node and its neighbours by any of some steps; bit k of the number of a neighbour is step k.

    Args:
        table: first slots.
        first: address of the node.
        steps: changes of the address.
        active: lanes to look up.
    """
    addresses = [mi.UInt32(first)]
    leaves = [mi.Bool(False)]
    for step in steps:
        moved = [a + mi.UInt32(step) for a in addresses]
        crosses = (moved[0] ^ addresses[0]) >= VOXELS
        addresses, leaves = addresses + moved, leaves + [on | crosses for on in leaves]

    own = dr.gather(mi.UInt32, table, addresses[0] >> ADDRESS_BITS, active)
    leaves = [active & on for on in leaves]

    def look_up(own: mi.UInt32, addresses: list[mi.UInt32], leaves: list[mi.Bool]) -> list[mi.UInt32]:
        found = [dr.gather(mi.UInt32, table, a >> ADDRESS_BITS, on) for a, on in zip(addresses, leaves, strict=True)]
        return [dr.select(on, first, own) for first, on in zip(found, leaves, strict=True)]

    def repeat(own: mi.UInt32, addresses: list[mi.UInt32], leaves: list[mi.Bool]) -> list[mi.UInt32]:
        return [mi.UInt32(own) for _ in addresses]

    # A gather costs the same for any number of lanes; most cells lie in one brick, and a branch passes them by.
    firsts = [own, *dr.if_stmt((own, addresses[1:], leaves[1:]), leaves[-1], look_up, repeat, label="other bricks")]
    index = [f + (a & (VOXELS - 1)) for f, a in zip(firsts, addresses, strict=True)]
    return Nodes(index, [f < ABSENT for f in firsts])


def _brick_strides(res: tuple[int, int, int], offset: tuple[int, int, int]) -> mi.Vector3i:
    _, y, x = count_bricks(res, offset)
    return mi.Vector3i(1, x, x * y)


# -- Rows of numbered nodes --------------------------------------------------------------------------------------------


@dataclass
class SparseIndex:
    """The index of stored nodes.

    Attributes:
        words: UInt32, two for each 32 nodes: their bits, and the number of stored nodes before them.
        count: number of stored nodes.
    """

    words: mi.UInt32
    count: int

    @property
    def bytes(self) -> int:
        """Size of the index [bytes]."""
        return 4 * dr.width(self.words)

    @classmethod
    def from_sorted(cls, stored: mi.UInt32, node_count: int) -> SparseIndex:
        """Make the index of some nodes.

        Args:
            stored: ascending numbers of the stored nodes.
            node_count: number of all nodes.
        """
        n = -(-max(node_count, 1) // 32)
        bits = dr.zeros(mi.UInt32, n)
        if dr.width(stored):
            dr.scatter_add(bits, mi.UInt32(1) << (stored & 31), stored >> 5)
        words = dr.zeros(mi.UInt32, 2 * n)
        word = dr.arange(mi.UInt32, n)
        before = dr.prefix_sum(dr.popcnt(bits))
        dr.scatter(words, mi.ArrayXu([bits, before]), word)
        dr.eval(words)
        return cls(words, dr.width(stored))

    def rank(self, node: mi.UInt32, active: mi.Bool = True) -> tuple[mi.UInt32, mi.Bool]:
        """The number of stored nodes before each node, and whether the node is stored."""
        bits, before = dr.gather(mi.ArrayXu, self.words, node >> 5, active, shape=(2, 1))
        own = mi.UInt32(1) << (node & 31)
        return before + dr.popcnt(bits & (own - 1)), (bits & own) != 0
