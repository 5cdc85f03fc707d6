"""Ratio tracking of a field of which only a majorant is known: a ball of constant extinction, one ray a lane."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball
from false_alarms import Estimate, assert_same_mean, fresh

from mivol.transport.estimators.flights.tracking import LOOKUP_RATE, ratio_tracking
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.traversal.random_numbers import seed_pcg32

pytestmark = pytest.mark.usefixtures("variant_rgb")

N, SIGMA, SCALE = 1 << 16, 0.125, 1.2
TAU = 2 * SIGMA * SCALE
"""Through the middle of the ball."""


def estimates(slack: float, on: bool = True, seed: int = 1, n: int = N, sigma: float = SIGMA) -> np.ndarray:
    part = BoundedExtinction("sigma_t", Ball(mi.Float(sigma), 1.0, (0, 0, 2)), mi.Float(SCALE), mi.Float(sigma * slack))
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    rng = seed_pcg32((dr.arange(mi.Float, n) + 0.5) / n, n, fresh(seed))
    (T,), after = ratio_tracking(part, mi.Float(SCALE), RayInterval(ray, mi.Float(0), mi.Float(dr.inf), mi.Bool(on)), rng)
    assert np.array(after).size == n
    return np.array(T, np.float64)


def of_lanes(values: np.ndarray) -> Estimate:
    return Estimate(values.mean(), values.var(ddof=1) / values.size, values.size - 1)


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
def test_mean_and_variance_are_those_that_are_declared(slack: float) -> None:
    """T, and T^2 (exp(int sigma^2 / (kappa M) dt) - 1) = T^2 (exp(tau / (kappa slack)) - 1): a loose majorant has less of it.

    At tau = 0.3 an estimate falls below FAINT by 8 points of a process of 1.2 (slack 1): 1 in 30000, and the roulette adds less
    than 1e-5 to a variance of 0.04.
    """
    T, found = np.exp(-TAU), estimates(slack)
    assert_same_mean(of_lanes(found), T, what="the transmittance")
    assert_same_mean(of_lanes((found - T) ** 2), T**2 * (np.exp(TAU / (LOOKUP_RATE * slack)) - 1), what="the variance")


@pytest.mark.statistical
def test_the_roulette_of_faint_rays_changes_no_mean():
    """At an optical depth of 3 estimates end up near 0.05, below FAINT."""
    assert_same_mean(of_lanes(estimates(1.0, seed=2, sigma=1.25)), np.exp(-3.0), what="the transmittance of a dense ball")


def test_lanes_that_are_off_and_fields_of_nothing_let_all_through():
    """A majorant of 0 has its next point infinitely far away."""
    assert (estimates(1.0, False, n=16) == 1).all()
    assert (estimates(0.0, n=16) == 1).all()
