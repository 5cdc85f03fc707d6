"""The row of each stored node among many numbered nodes, with two bits a node.

The stored nodes lie in ascending order. The row of a stored node is its rank, the number of stored nodes before it. The index
holds, for each word of 32 nodes, their bits and the rank of the first; a population count of the bits below a node's own bit
gives the rest.

References: Jacobson 1989 (the rank of a bit in constant time).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


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
