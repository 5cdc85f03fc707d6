"""Weights of samples that could have been drawn in two ways (multiple importance sampling).

References: Veach 1997, Eq. 9.13.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["power_heuristic"]


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample of density ``a`` beside ``b``, exponent 2 (Veach 1997, Eq. 9.13)."""
    # As a ratio: a^2 overflows float32 for a > 1.8e19.
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)
