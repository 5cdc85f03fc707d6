"""A random number generator for each lane (PCG32), for walks that draw a number in every cell.

Mitsuba's samplers are not used there: the number of dimensions that a walk consumes differs from lane to lane, and samplers
that stratify have only few. One sampler dimension seeds the generator.

References: O'Neill 2014 (permuted congruential generators, RXS-M-XS 32).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["LaneSampler", "draw_pcg32", "draw_seeds", "draw_state", "seed_pcg32", "Strata"]


def seed_pcg32(u: mi.Float, width: int, number: int = 0) -> mi.UInt32:
    """Seed a generator for each lane.

    Args:
        u: a uniform number in [0, 1), which may be the same in all lanes.
        width: number of lanes.
        number: generators with different numbers are independent although ``u`` is the same.

    Returns:
        The states.
    """
    seed = mi.UInt32(u * (1 << 24)) * mi.UInt32(0x9E3779B9) + dr.arange(mi.UInt32, width) * mi.UInt32(0x85EBCA6B)
    return seed + mi.UInt32((0xC2B2AE35 * number) % (1 << 32))


def draw_pcg32(state: mi.UInt32, count: int) -> tuple[mi.UInt32, list[mi.Float]]:
    """Draw uniform numbers from a permuted congruential generator (RXS-M-XS 32).

    Returns:
        The next state, and ``count`` numbers in the open interval (0, 1). They are never 0: a reservoir keeps a candidate where
        u times the sum of weights is below its weight, so u = 0 would keep any; and -log(u), the distance to the next collision
        of a tracker, would be infinite.
    """
    numbers = []
    for _ in range(count):
        word = ((state >> ((state >> 28) + 4)) ^ state) * mi.UInt32(277803737)
        word = (word >> 22) ^ word
        numbers.append((mi.Float(word >> 8) + 0.5) * (1 / (1 << 24)))
        state = state * mi.UInt32(747796405) + mi.UInt32(2891336453)
    return state, numbers


@dataclass
class LaneSampler:
    """Random numbers of paths that begin at different times: each brings its own generator along.

    Attributes:
        generator: of 64 bits of state, so that paths of any length do not meet in it.
    """

    generator: mi.PCG32

    @classmethod
    def seeded(cls, a: mi.UInt32, b: mi.UInt32, stream: mi.UInt32) -> LaneSampler:
        """A generator for each lane, by two seeds of 24 bits and the number of its sequence."""
        state = (mi.UInt64(a) << 32) | mi.UInt64(b)
        generator = mi.PCG32(size=dr.width(stream))
        generator.seed(state, mi.UInt64(stream))
        return cls(generator)

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """A uniform number in [0, 1)."""
        return self.generator.next_float32(active)

    def next_state(self, active: mi.Bool = True) -> mi.UInt32:
        """The state of another generator."""
        return self.generator.next_uint32(active)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """Two of them."""
        x = self.next_1d(active)
        return mi.Point2f(x, self.next_1d(active))


def draw_state(sampler: mi.Sampler | LaneSampler, active: mi.Bool = True) -> mi.UInt32:
    """The state of a generator for each lane.

    Of a ``LaneSampler`` it has 32 bits of its own and does not depend on the number of the lane, so that a path may be walked
    again in another one. A number of Mitsuba's samplers has 24 bits, too few to tell millions of lanes apart: the number of the
    lane helps.
    """
    if isinstance(sampler, LaneSampler):
        return sampler.next_state(active)
    u = sampler.next_1d(active)
    return seed_pcg32(u, dr.width(u))


def draw_seeds(sampler: mi.Sampler) -> tuple[mi.UInt32, mi.UInt32]:
    """Two seeds of 24 bits for each lane, of a ``LaneSampler``."""
    return mi.UInt32(sampler.next_1d() * (1 << 24)), mi.UInt32(sampler.next_1d() * (1 << 24))


@dataclass
class Strata:
    """The stratum of the unit square that each lane of a pass draws its directions from.

    The samples of a pixel divide the square among them, into the cells of an ``across`` by ``down`` grid. All lanes of a tile
    of pixels have the same cell, so that neighbouring lanes trace nearly parallel shadow rays (measured on smoke at 64 samples:
    1.9 times less variance in constant light, 1.7 times with a sun in a sky, in the same time).

    Attributes:
        cell: index of each lane's cell.
        across, down: size of the grid of cells.
    """

    cell: mi.UInt32
    across: int
    down: int

    def jitter(self, u: mi.Point2f) -> mi.Point2f:
        """Map two uniform numbers in [0, 1) into the lane's cell."""
        i, j = self.cell % self.across, self.cell // self.across
        return mi.Point2f((mi.Float(i) + u.x) / self.across, (mi.Float(j) + u.y) / self.down)
