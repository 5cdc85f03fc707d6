"""Random numbers of lanes: means, squares and correlations; strata."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean, fresh

from mivol.transport.traversal.random_numbers import LaneSampler, Strata, draw_pcg32, seed_pcg32
from mivol.validate.moments import Moments

pytestmark = pytest.mark.usefixtures("variant_rgb")


def start(number: float) -> mi.Float:
    """A seed in [0, 1) for generators, different in each round of seeds."""
    return mi.Float((number + fresh(0) * 0.6180339887498949) % 1)


@pytest.mark.statistical
def test_numbers_are_uniform():
    """2^16 lanes, 4 numbers each: means of 1/2, squares of 1/3, no correlation within a lane or between neighbours."""
    _, numbers = draw_pcg32(seed_pcg32(start(0.25), 1 << 16), 4)
    u = np.array([np.array(x, dtype=np.float64) for x in numbers])
    assert u.min() > 0 and u.max() < 1
    assert_same_mean(Moments.from_values(u.T), 1 / 2, what="numbers")
    assert_same_mean(Moments.from_values(u.T**2), 1 / 3, what="squares")
    rows = np.vstack([u, np.roll(u[0], 1)]) - 0.5
    pairs = [rows[i] * rows[j] for i in range(5) for j in range(i)]
    assert_same_mean(Moments.from_values(np.array(pairs).T), what="products")


@pytest.mark.statistical
def test_numbers_of_paths_are_uniform() -> None:
    """2^16 paths of equal seeds, 4 numbers each, as above."""
    sampler = LaneSampler.seeded(mi.UInt32(7 + fresh(0)), mi.UInt32(11), dr.arange(mi.UInt32, 1 << 16))
    u = np.array([np.array(x, dtype=np.float64) for x in (sampler.next_1d(), *sampler.next_2d(), sampler.next_1d())])
    rows = np.vstack([u, np.roll(u[0], 1)]) - 0.5
    pairs = [rows[i] * rows[j] for i in range(5) for j in range(i)]
    assert_same_mean(Moments.from_values(np.vstack([u - 1 / 2, u**2 - 1 / 3, pairs]).T), 0, what="numbers, squares, products")
    assert np.array_equal(np.array(sampler.next_1d(False)), np.array(sampler.next_1d(False)))


def test_each_lane_stays_in_its_cell():
    """Cell k of 3 by 2 holds the points (k % 3 + u) / 3, (k // 3 + v) / 2."""
    u, v = np.random.default_rng(4).uniform(0, 1, (2, 6)).astype(np.float32)
    found = Strata(dr.arange(mi.UInt32, 6), 3, 2).jitter(mi.Point2f(mi.Float(u), mi.Float(v)))
    k = np.arange(6)
    np.testing.assert_allclose(np.array(found), [(k % 3 + u) / 3, (k // 3 + v) / 2], atol=2.0**-23)
