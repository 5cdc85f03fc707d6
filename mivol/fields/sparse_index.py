"""Which of many places are listed, and where in the list: two bits a place.

A list holds some of N numbered places in ascending order. The index of one of them is the number of listed places before it
(its rank): a number that is stored for each word of 32 bits, and a population count of the bits below its own.

References: Jacobson 1989 (the rank of a bit in constant time).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["SparseIndex"]


@dataclass
class SparseIndex:
    """Which places are listed.

    Attributes:
        words: UInt32, two for each 32 places: their bits, and the number of listed places before them.
        count: of listed places.
    """

    words: mi.UInt32
    count: int

    @property
    def bytes(self) -> int:
        """Memory that they take."""
        return 4 * dr.width(self.words)

    @classmethod
    def from_sorted(cls, listed: mi.UInt32, places: int) -> SparseIndex:
        """From the ascending numbers of the listed ones among so many places."""
        n = -(-max(places, 1) // 32)
        bits = dr.zeros(mi.UInt32, n)
        if dr.width(listed):
            dr.scatter_add(bits, mi.UInt32(1) << (listed & 31), listed >> 5)
        words = dr.zeros(mi.UInt32, 2 * n)
        word = dr.arange(mi.UInt32, n)
        before = dr.prefix_sum(dr.popcnt(bits))
        dr.scatter(words, mi.ArrayXu([bits, before]), word)
        dr.eval(words)
        return cls(words, dr.width(listed))

    def rank(self, place: mi.UInt32, active: mi.Bool = True) -> tuple[mi.UInt32, mi.Bool]:
        """The index of places in the list, and whether they are in it; where they are not, how many are before them."""
        bits, before = dr.gather(mi.ArrayXu, self.words, place >> 5, active, shape=(2, 1))
        own = mi.UInt32(1) << (place & 31)
        return before + dr.popcnt(bits & (own - 1)), (bits & own) != 0
