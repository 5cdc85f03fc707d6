"""Random numbers that a lane makes for itself: a walk that draws in every cell would soon have used up a sampler.

References: O'Neill 2014 (the generator).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["draw_pcg32", "seed_pcg32"]


def seed_pcg32(u: mi.Float, width: int, number: int = 0) -> mi.UInt32:
    """A generator for each lane, from a number in [0, 1); others, told apart by ``number``, from the same."""
    seed = mi.UInt32(u * (1 << 24)) * mi.UInt32(0x9E3779B9) + dr.arange(mi.UInt32, width) * mi.UInt32(0x85EBCA6B)
    return seed + mi.UInt32((0xC2B2AE35 * number) % (1 << 32))


def draw_pcg32(state: mi.UInt32, count: int) -> tuple[mi.UInt32, list[mi.Float]]:
    """Draw from a permuted congruential generator (RXS-M-XS 32).

    Returns:
        Its next state, and ``count`` numbers in (0, 1): never 0, which would be kept or met for ever.
    """
    numbers = []
    for _ in range(count):
        word = ((state >> ((state >> 28) + 4)) ^ state) * mi.UInt32(277803737)
        word = (word >> 22) ^ word
        numbers.append((mi.Float(word >> 8) + 0.5) * (1 / (1 << 24)))
        state = state * mi.UInt32(747796405) + mi.UInt32(2891336453)
    return state, numbers
