r"""A mixture of phase functions: a convex combination, sampled by the choice of a component.

.. math:: p = \sum_k s_k p_k, \qquad s_k = w_k / \sum_j w_j

Conventions. Weights are at least 0 and need not sum to 1. If every weight is 0 (a voxel in a grid of weights), the components
have equal probabilities.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

__all__ = ["choose_lobe", "normalise_weights"]


def normalise_weights(weights: Sequence[mi.Float]) -> list[mi.Float]:
    """Normalise weights by their sum, with derivatives; the weights become equal for a sum of 0."""
    total = sum(weights[1:], weights[0])
    empty = ~(total > 0) & (total == 0)
    inv = dr.rcp(total)  # infinite where nothing is taken of it: Dr.Jit's derivatives of what is not taken are 0
    return [dr.select(empty, 1 / len(weights), w * inv) for w in weights]


def choose_lobe(shares: Sequence[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Choose a component with its normalised weight as probability.

    Returns:
        The index of the component, and ``u`` rescaled to [0, 1) within its interval, for another use.
    """
    chosen, low, high = mi.UInt32(0), dr.zeros(mi.Float, 1), mi.Float(shares[0])
    start = mi.Float(0)
    for k, share in enumerate(shares):
        # A component of weight 0 is never chosen, not even where rounding leaves u above the sum of all weights.
        is_chosen = (u >= start) & (share > 0)
        end = start + share
        chosen, low, high = dr.select(is_chosen, k, chosen), dr.select(is_chosen, start, low), dr.select(is_chosen, end, high)
        start = end
    inside = (u - low) * dr.rcp(dr.select(high > low, high - low, 1))
    return chosen, dr.clip(inside, 0, 1 - 2.0**-24)
