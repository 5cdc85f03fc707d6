"""How far each of many places is from the nearest listed one, and where a listed one stands in its list: a byte a place.

A distance takes four bits, 0 of a listed place. The index of a listed place is the number of listed ones before it (its rank):
a number that is stored for each word of eight distances, and a count of the zeros below its own. A search for a listed place
reads one word for eight places that lie side by side, half as much memory as bytes and an eighth of indices.

References: Cohen & Sheffer 1994 (proximity clouds); Jacobson 1989 (the rank of a bit in constant time).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["FAR", "DistanceIndex"]

FAR = 15
"""The largest distance that four bits hold."""

LOW_BITS = 0x11111111
"""The lowest bit of each four of a word."""


@dataclass
class DistanceIndex:
    """Of each place the distance to the nearest listed one, in four bits, 0 for a listed one; and the ranks of these.

    Attributes:
        words: UInt32, eight distances each.
        before: UInt32, the number of listed places before each word.
    """

    words: mi.UInt32
    before: mi.UInt32

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return 4 * (dr.width(self.words) + dr.width(self.before))

    @classmethod
    def of(cls, distances: mi.UInt8) -> DistanceIndex:
        """From the distance of each place, at most ``FAR``."""
        places = dr.width(distances)
        word = dr.arange(mi.UInt32, -(-places // 8))
        words = mi.UInt32(0)
        for k in range(8):
            at = word * 8 + k
            held = at < places
            words |= dr.select(held, mi.UInt32(dr.gather(mi.UInt8, distances, at, held)), FAR) << (4 * k)
        dr.eval(words)
        before = dr.prefix_sum(dr.popcnt(_zeros(words)))
        dr.eval(before)
        return cls(words, before)

    def distance(self, place: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """The distance of places, and the word that holds it."""
        word = dr.gather(mi.UInt32, self.words, place >> 3, active)
        return (word >> ((place & 7) << 2)) & FAR, word

    def rank(self, place: mi.UInt32, word: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The index in the list of listed places, from the word of their distance."""
        below = (mi.UInt32(1) << ((place & 7) << 2)) - 1
        return dr.gather(mi.UInt32, self.before, place >> 3, active) + dr.popcnt(_zeros(word) & below)


def _zeros(word: mi.UInt32) -> mi.UInt32:
    """One bit, the lowest, of each four that are 0."""
    word = word | (word >> 1)
    return ~(word | (word >> 2)) & LOW_BITS
