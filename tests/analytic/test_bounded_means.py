"""Hoeffding's bound against exact binomial chances, and where it stays silent that a z-test cannot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from mivol.errors import MivolError
from mivol.validate.statistics import Estimate, assert_same_bounded_mean, assert_same_mean, bounded_p_value


@pytest.mark.parametrize("p", [1e-4, 0.03, 0.5, 0.97])
@pytest.mark.parametrize("n", [16, 500])
def test_bounded_p_values_hold(p, n):
    """For 0/1 samples the exact binomial chance of a mean as far out is below the bound, and not 30 times below.

    The exponential bound misses the exact tail by a factor of order sqrt(2 pi n p (1 - p)) (Bahadur, Rao 1960), and twice
    for the other side: below 2 sqrt(2 pi 125) = 56 here, and never below 1.
    """
    k = np.arange(n + 1)
    upper, lower = binom.sf(k - 1, n, p), binom.cdf(k, n, p)
    exact = np.minimum(upper, lower)
    claimed = bounded_p_value(k / n, n, np.full(n + 1, p))
    assert np.all(claimed >= exact * (1 - 1e-9))
    seen = exact > 1e-250
    assert np.all(claimed[seen] <= 120 * exact[seen] + 1e-12)


def test_bounded_p_value_at_the_ends():
    """Certain where the truth is a bound and the mean is not; 1 where they are equal; refused outside the bounds."""
    p = bounded_p_value(np.array([0.0, 1.0, 0.1, 0.0]), 10, np.array([0.0, 1.0, 0.0, 1.0]))
    np.testing.assert_array_equal(p, [1, 1, 0, 0])
    assert bounded_p_value(3.0, 100, 3.0, (2, 7)) == 1
    with pytest.raises(MivolError, match="outside the bounds"):
        bounded_p_value(np.array([1.5]), 10, np.array([0.5]))
    with pytest.raises(MivolError, match="low below high"):
        bounded_p_value(0.0, 10, 0.0, (1, 1))


def test_unseen_transmittance_is_no_alarm():
    """T = 1e-6 that 4096 samples of delta tracking never saw: the z-test cannot say, the bounded one is silent.

    It still speaks where T = 0.01 was never seen: 4096 samples miss it with chance 1e-18.
    """
    unseen = np.zeros((8, 8, 1))
    with pytest.raises(AssertionError):
        assert_same_mean(Estimate(unseen), Estimate(np.full_like(unseen, 1e-6)))
    assert_same_bounded_mean(unseen, 4096, np.full_like(unseen, 1e-6))
    with pytest.raises(AssertionError, match="p < "):
        assert_same_bounded_mean(unseen, 4096, np.full_like(unseen, 0.01))


def test_a_bounded_mean_that_differs_is_named() -> None:
    assert_same_bounded_mean(np.array([0.5, 0.5]), 1000, 0.5, bounds=(0, 1), what="rays")
    with pytest.raises(AssertionError, match=r"rays differ at \(1,\): 0.9 for 0.5 after 1000 samples, p < .* 1 of 2 beyond it"):
        assert_same_bounded_mean(np.array([0.5, 0.9]), 1000, 0.5, bounds=(0, 1), what="rays")
