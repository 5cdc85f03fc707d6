"""Multiple importance sampling: weights of samples that two techniques could have drawn.

References: Veach 1997, Eq. 9.13.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["power_heuristic"]


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample drawn with density ``a`` that another technique draws with density ``b`` (Veach 1997, Eq. 9.13)."""
    # As a function of b / a, since a^2 overflows float32 for a > 1.8e19.
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)
