"""Random number generators (PCG32) for each lane, and strata for the directions of a pass.

A walk that draws a number in every cell does not use Mitsuba's samplers: the number of dimensions differs from lane to lane,
and stratified samplers have few dimensions. A single sampler dimension seeds the generator.

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
        u: uniform number in [0, 1); may be the same in all lanes.
        width: number of lanes.
        number: index of the generator; generators of different indices are independent for equal ``u``.

    Returns:
        The states.
    """
    seed = mi.UInt32(u * (1 << 24)) * mi.UInt32(0x9E3779B9) + dr.arange(mi.UInt32, width) * mi.UInt32(0x85EBCA6B)
    return seed + mi.UInt32((0xC2B2AE35 * number) % (1 << 32))


def draw_pcg32(state: mi.UInt32, count: int) -> tuple[mi.UInt32, list[mi.Float]]:
    """Draw uniform numbers from a permuted congruential generator (RXS-M-XS 32).

    Returns:
        The next state, and ``count`` numbers in the open interval (0, 1). The numbers are never 0. A reservoir keeps a
        candidate if u times the sum of weights is below the weight of the candidate, so u = 0 would keep every candidate. A
        tracker would get an infinite distance -log(0) to the next collision.
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
    """Random numbers of paths that begin at different times; each path carries its own generator.

    Attributes:
        generator: generator of 64 bits of state, enough for long paths not to share numbers.
    """

    generator: mi.PCG32

    @classmethod
    def seeded(cls, a: mi.UInt32, b: mi.UInt32, stream: mi.UInt32) -> LaneSampler:
        """Seed a generator for each lane with two numbers of 24 bits and the index of the sequence."""
        state = (mi.UInt64(a) << 32) | mi.UInt64(b)
        generator = mi.PCG32(size=dr.width(stream))
        generator.seed(state, mi.UInt64(stream))
        return cls(generator)

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """Draw a uniform number in [0, 1)."""
        return self.generator.next_float32(active)

    def next_state(self, active: mi.Bool = True) -> mi.UInt32:
        """Draw the state of another generator."""
        return self.generator.next_uint32(active)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """Draw two uniform numbers in [0, 1)."""
        x = self.next_1d(active)
        return mi.Point2f(x, self.next_1d(active))


def draw_state(sampler: mi.Sampler | LaneSampler, active: mi.Bool = True) -> mi.UInt32:
    """Draw the state of a generator for each lane.

    A ``LaneSampler`` gives 32 bits that do not depend on the index of the lane, so another lane can walk the same path again. A
    number of Mitsuba's samplers has 24 bits, too few to tell millions of lanes apart, so the index of the lane is mixed in.
    """
    if isinstance(sampler, LaneSampler):
        return sampler.next_state(active)
    u = sampler.next_1d(active)
    return seed_pcg32(u, dr.width(u))


def draw_seeds(sampler: mi.Sampler) -> tuple[mi.UInt32, mi.UInt32]:
    """Draw two seeds of 24 bits for each lane, to seed a ``LaneSampler``."""
    return mi.UInt32(sampler.next_1d() * (1 << 24)), mi.UInt32(sampler.next_1d() * (1 << 24))


@dataclass
class Strata:
    """The stratum of the unit square from which each lane of a pass draws its directions.

    The samples of a pixel divide the square into the cells of an ``across`` by ``down`` grid. All lanes of a tile of pixels
    share a cell, so neighbouring lanes trace nearly parallel shadow rays.

    Attributes:
        cell: index of the cell of each lane.
        across, down: size of the grid of cells.
    """

    cell: mi.UInt32
    across: int
    down: int

    def jitter(self, u: mi.Point2f) -> mi.Point2f:
        """Map two uniform numbers in [0, 1) into the cell of the lane."""
        i, j = self.cell % self.across, self.cell // self.across
        return mi.Point2f((mi.Float(i) + u.x) / self.across, (mi.Float(j) + u.y) / self.down)
