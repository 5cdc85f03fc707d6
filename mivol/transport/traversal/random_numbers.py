r"""Random numbers: points spread over the samples of a pixel, and generators (PCG32) for each lane.

Dimensions are drawn one or two at a time. Each draw has Sobol points of its own, in one or two dimensions: the sequence of van
der Corput, and its partner by Pascal's triangle. Owen's scrambling makes each point uniform, so estimates stay unbiased. It
keeps the stratification: of the first 2^m points of two dimensions, each of the 2^m cells of 2^a by 2^(m-a) holds one, for
any a. The points of each draw are in an order of their own, shuffled by the same scrambling of their index; otherwise the
dimensions would be correlated.

The *lead* is one more dimension: the index itself, over the number of points. With any two dimensions, the lead forms a net in
three dimensions (Hammersley points); each sample's lead lies in its own stratum. So the samples whose lead lies in an interval,
say all that collide on their first flight, have spread numbers in their further dimensions too. They also lie side by side in
the lanes of a pass.

A walk that draws a number in every cell does not use these points, nor Mitsuba's samplers: the number of dimensions differs
from lane to lane. A single number seeds the generator of such a walk.

References: Sobol 1967; Owen 1995 (scrambling); Laine & Karras 2011, Burley 2020 (scrambling by hashes, shuffling); Vegdahl 2021
(constants of the hash); Ahmed 2024 (Pascal's triangle in five steps); O'Neill 2014 (permuted congruential generators, RXS-M-XS
32).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["SpreadSampler", "draw_lead", "draw_pcg32", "draw_state", "fork_state", "seed_pcg32"]


LARGEST_UNIT = 1 - 2.0**-24
"""Largest float32 below 1."""


# -- Generators ----------------------------------------------------------------------------------------------------------


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
    return fork_state(seed, number)


def draw_pcg32(state: mi.UInt32, count: int) -> tuple[mi.UInt32, list[mi.Float]]:
    """Draw uniform numbers from a permuted congruential generator (RXS-M-XS 32).

    Returns:
        The next state, and ``count`` numbers in the open interval (0, 1). The numbers are never 0. A reservoir keeps a
        candidate if u times the sum of weights is below the weight of the candidate, so u = 0 would keep every candidate. A
        tracker would get an infinite distance -log(0) to the next collision. Nor are they 1: u n would be no index of n.
    """
    numbers = []
    for _ in range(count):
        # Above 2^23 a half is rounded to an even number, the largest to 2^24.
        u = (mi.Float(_permute_state(state) >> 8) + 0.5) * (1 / (1 << 24))
        numbers.append(dr.minimum(u, dr.one_minus_epsilon(mi.Float)))
        state = _advance_state(state)
    return state, numbers


def fork_state(state: mi.UInt32, number: int | mi.UInt32) -> mi.UInt32:
    """The state of another generator; forks of different numbers are independent."""
    return state + mi.UInt32(number) * mi.UInt32(0xC2B2AE35)


def _permute_state(state: mi.UInt32) -> mi.UInt32:
    """The random word of a state."""
    word = ((state >> ((state >> 28) + 4)) ^ state) * mi.UInt32(277803737)
    return (word >> 22) ^ word


def _advance_state(state: mi.UInt32) -> mi.UInt32:
    return state * mi.UInt32(747796405) + mi.UInt32(2891336453)


# -- Spread points -------------------------------------------------------------------------------------------------------


@dataclass
class SpreadSampler:
    """Random numbers of paths: Owen-scrambled Sobol points over the samples of a pixel.

    All samples of a pixel share a generator, whose words seed the scramblings: one draw has the same dimensions in all of them.
    Lanes that are not active draw too, so no path gets the numbers of another depth.

    Attributes:
        bits: bits of the index of the point, in reverse order.
        state: state of the generator of the pixel.
        lead: number returned by the first call of :meth:`next_lead`; negative once it is drawn.

    Bias: none over all samples of a pixel; pixels are independent. Variance: of smooth functions of up to two dimensions
    n^-3 of n samples, of steps about n^-1.5, and never much more than n^-1 (Owen 1997).
    """

    bits: mi.UInt32
    state: mi.UInt32
    lead: mi.Float

    @classmethod
    def of_pixels(cls, pixel: mi.Vector2i, seed: mi.UInt32, sample: mi.UInt32, count: mi.UInt32) -> SpreadSampler:
        """The numbers of samples of pixels.

        Args:
            pixel: place of each sample's pixel, on the whole film [pixels].
            seed: seed of the render.
            sample: index of each sample among those of its pixel.
            count: number of samples of a pixel.
        """
        a, b = mi.sample_tea_32(mi.UInt32(pixel.x), mi.UInt32(pixel.y))
        sampler = cls(dr.brev(sample), mi.sample_tea_32(a ^ seed, b)[0], mi.Float(0))
        jitter = _to_unit(sampler.next_state())
        sampler.lead = dr.minimum((mi.Float(sample) + jitter) / mi.Float(count), LARGEST_UNIT)
        return sampler

    def clone(self) -> SpreadSampler:
        """A sampler that draws the same numbers again."""
        return SpreadSampler(self.bits, self.state, self.lead)

    def gather(self, index: mi.UInt32, active: mi.Bool = True) -> SpreadSampler:
        """The numbers of the lanes with an index."""
        return SpreadSampler(*(dr.gather(type(v), v, index, active) for v in (self.bits, self.state, self.lead)))

    def branch(self, number: mi.UInt32, count: mi.UInt32) -> SpreadSampler:
        """Random numbers for one of ``count`` continuations of a path, stratified over the continuations of a pixel."""
        # Other dimensions than those of the path itself.
        state = _permute_state(fork_state(self.state, 1))
        return SpreadSampler(dr.brev(dr.brev(self.bits) * count + number), state, dr.full(mi.Float, -1, dr.width(state)))

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """Draw a number in [0, 1) in every lane."""
        return _to_unit(_scramble(self._draw_index(), self._draw_word()))

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """Draw two numbers in [0, 1) in every lane."""
        index = self._draw_index()
        x = _scramble(index, self._draw_word())
        return mi.Point2f(_to_unit(x), _to_unit(_scramble(_apply_pascal(index), self._draw_word())))

    def next_lead(self) -> mi.Float:
        """Draw the lead in [0, 1); from the second call on, any number."""
        lead, other = self.lead, self.next_1d()
        self.lead = dr.full(mi.Float, -1, dr.width(self.bits))
        return dr.select(lead < 0, other, lead)

    def next_state(self, active: mi.Bool = True) -> mi.UInt32:
        """Draw the state of another generator, independent from sample to sample, in every lane."""
        return _permute_state(_permute_state(self._draw_word() ^ self.bits) + self.state)

    def _draw_word(self) -> mi.UInt32:
        word = _permute_state(self.state)
        self.state = _advance_state(self.state)
        return word

    def _draw_index(self) -> mi.UInt32:
        """The index of the point in a shuffled order: Owen's scrambling moves aligned blocks of 2^m points as a whole."""
        return dr.brev(_scramble(self.bits, self._draw_word()))


def _scramble(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Scramble the bits of a number: each bit is flipped or not, by a hash of the bits below (constants: Vegdahl 2021)."""
    x = x ^ (x * mi.UInt32(0x3D20ADEA))
    x = (x + seed) * ((seed >> 16) | 1)
    x = x ^ (x * mi.UInt32(0x05526C56))
    return x ^ (x * mi.UInt32(0x53A22864))


def _apply_pascal(index: mi.UInt32) -> mi.UInt32:
    """The second Sobol dimension of an index, its bits in reverse order.

    The bits are the coefficients of a polynomial p over {0, 1}; the result has those of p(x + 1), by halves:
    q(x) + x^k r(x) becomes q(x + 1) + r(x + 1) + x^k r(x + 1), since (x + 1)^k = x^k + 1 for a power of two.
    """
    for k, upper in ((16, 0xFFFF0000), (8, 0xFF00FF00), (4, 0xF0F0F0F0), (2, 0xCCCCCCCC), (1, 0xAAAAAAAA)):
        index = index ^ ((index & mi.UInt32(upper)) >> k)
    return index


def _to_unit(bits: mi.UInt32) -> mi.Float:
    """The number in [0, 1) with these binary digits, the first digit in the lowest bit."""
    return mi.Float(dr.brev(bits) >> 8) * (1 / (1 << 24))


# -- Draws from any sampler ----------------------------------------------------------------------------------------------


def draw_lead(sampler: mi.Sampler | SpreadSampler) -> mi.Float:
    """Draw the number in [0, 1) that matters most to the further path, in every lane."""
    return sampler.next_lead() if isinstance(sampler, SpreadSampler) else sampler.next_1d()


def draw_state(sampler: mi.Sampler | SpreadSampler, active: mi.Bool = True) -> mi.UInt32:
    """Draw the state of a generator for each lane.

    A number of Mitsuba's samplers has 24 bits, too few to tell millions of lanes apart, so the index of the lane is mixed in.
    """
    if isinstance(sampler, SpreadSampler):
        return sampler.next_state(active)
    u = sampler.next_1d(active)
    return seed_pcg32(u, dr.width(u))
