"""The scattering angle between directions: precision near forward and backward scattering."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from phase_angles import EPS, as64, turns

from mivol.phase.scattering_angle import angle_between, scattered_direction

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_turn_between_directions_keeps_small_angles():
    """An angle of 1e-3 between float32 directions: 1 - cos to a few roundings of itself, where 1 - dot keeps 12 bits."""
    rng = np.random.default_rng(0)
    wi = rng.normal(size=(4096, 3))
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    side = np.cross(wi, rng.normal(size=(4096, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    for sign in (-1, 1):
        wo = sign * wi * np.cos(1e-3) + side * np.sin(1e-3)
        a, b = (x.astype(np.float32).astype(np.float64) for x in (wi, wo))
        turn = angle_between(mi.Vector3f(a.T), mi.Vector3f(b.T))
        # A difference of neighbours is exact; three squares, two sums and a product are six roundings.
        for x, want in ((turn.below_one, ((a + b) ** 2).sum(1) / 2), (turn.above_minus_one, ((a - b) ** 2).sum(1) / 2)):
            assert np.max(np.abs(as64(x) / want - 1)) <= 3 * EPS


def test_direction_after_turns_by_the_angle():
    """Straight on is -wi, straight back is wi, and the sine is right down to 1e-6."""
    turn, m, p = turns()
    wi = mi.Vector3f(0.6, 0.0, 0.8)
    wo = as64(scattered_direction(wi, turn, mi.Float(0.3))).T
    # The three products of each component and the frame are a few roundings of 1.
    assert np.max(np.abs(wo @ [0.6, 0, 0.8] + (p - m) / 2)) <= 4 * EPS
    # Across the axis the vector is sin times a unit vector with its own roundings, plus those of cos wi.
    across = np.linalg.norm(wo + ((p - m) / 2)[:, None] * [0.6, 0, 0.8], axis=1)
    assert np.max(np.abs(across - np.sqrt(m * p))) <= 4 * EPS
    assert turn.sin[0] == pytest.approx(1e-6, rel=4 * EPS)
