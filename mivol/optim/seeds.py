"""Seeds of renders, each for one purpose and independent of all others."""

from __future__ import annotations

import numpy as np

PRIMAL, ADJOINT, HELD_OUT, FINAL = range(4)
"""Purposes: an image of a fit, its derivative, an evaluation, an image that is kept."""


def seed_of(*key: int) -> int:
    """A 32-bit seed from integers: SeedSequence mixes them, so that neighbours share nothing."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])
