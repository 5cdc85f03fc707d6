"""Mixtures of phase functions: normalised weights and the choice of a component."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from phase_angles import EPS, as64, lanes

from mivol.phase.mixture import choose_lobe, normalise_weights

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_shares_and_choice():
    shares = normalise_weights([mi.Float(1), mi.Float(0), mi.Float(3)])
    assert [float(s[0]) for s in shares] == [0.25, 0, 0.75]
    chosen, inside = choose_lobe(shares, *lanes([0, 0.1, 0.2499, 0.25, 0.5, 1 - 2.0**-24]))
    assert list(chosen) == [0, 0, 0, 2, 2, 2]
    # u / 0.25 is exact; (u - 0.25) / 0.75 has two roundings.
    assert as64(inside) == pytest.approx([0, 0.4, 0.9996, 0, 1 / 3, 1], abs=2 * EPS)
    assert np.all(as64(inside) < 1)


def test_a_lobe_without_a_share_is_never_chosen():
    """Neither at the ends: u = 0 before a first such lobe, u = 1 (rounded shares may sum to less) after a last such lobe."""
    for weights, want in (([0, 1, 0], [1, 1, 1]), ([2, 0, 0], [0, 0, 0]), ([0, 0, 3], [2, 2, 2])):
        chosen, _ = choose_lobe(normalise_weights([mi.Float(w) for w in weights]), mi.Float(0, 0.5, 1))
        assert list(chosen) == want


def test_shares_without_any_weight_are_equal():
    """With a derivative of 0 by weights summing to 0, where the derivative of w / 0 does not exist."""
    weights = [mi.Float(0, 1), mi.Float(0, 3)]
    dr.enable_grad(weights)
    shares = normalise_weights(weights)
    assert [list(s) for s in shares] == [[0.5, 0.25], [0.5, 0.75]]
    dr.backward(shares[0])
    # Of 1 / (1 + 3): 3/16 by the first weight and -1/16 by the second.
    assert [list(dr.grad(w)) for w in weights] == [[0, 0.1875], [0, -0.0625]]
