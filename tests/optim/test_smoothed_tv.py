"""Smoothed total variation: its derivatives, its majorisers, and its value for a step."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.optim.projections.smoothed_tv import SmoothedTV


def test_prior_derivatives_and_majorisers():
    """Gradient against differences; the majoriser lies above the penalty, and its separable form above that."""
    shape, rng = (4, 5, 6), np.random.default_rng(5)
    prior = SmoothedTV(shape, 0.7, 0.4, (1.0, 0.5, 2.0))
    x, p = rng.normal(size=(2, 120))
    h = 1e-6
    slope = (prior.value(x + h * p) - prior.value(x - h * p)) / (2 * h)
    assert prior.gradient(x) @ p == pytest.approx(slope, rel=1e-7)
    for scale in (0.01, 0.3, 3.0):
        d = scale * p
        bound = prior.value(x) + prior.gradient(x) @ d + 0.5 * prior.curvature(x, d)
        assert prior.value(x + d) <= bound + 1e-12
        assert prior.curvature(x, d) <= prior.separable(x) @ (d * d) + 1e-12


def test_total_variation_of_a_step_is_its_area_times_height():
    """delta -> 0: a step of height 3 across an area of 5 x 4 voxels of 0.5 x 2 (y, z); a quarter of 3 * 5 * 0.5 * 4 * 2."""
    x = np.zeros((4, 5, 6))
    x[:, :, 3:] = 3.0
    prior = SmoothedTV(x.shape, 0.25, 1e-9, (3.0, 0.5, 2.0))
    assert prior.value(x.reshape(-1)) == pytest.approx(0.25 * 3 * 5 * 0.5 * 4 * 2, rel=1e-8)
