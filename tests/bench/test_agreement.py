"""Agreement of two means: shared noise, degrees of freedom, and means without variance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from mivol.bench.harness.agreement import FALSE_ALARM, compare_means, finite_or_none, mean_of_pixels, mean_of_rounds
from mivol.validate.statistics import Estimate


def test_pixels_that_share_their_noise_are_not_taken_for_many() -> None:
    """The same number in all pixels of a round: the error is that of 8 numbers, not of 16000."""
    rng = np.random.default_rng(6)
    shared = np.repeat(rng.normal(10, 1, (8, 1)), 2000, axis=1)
    result = mean_of_pixels(shared)
    assert result.var == pytest.approx(np.var(shared[:, 0], ddof=1) / 8)
    assert result.dof == 7


def test_the_noisiest_pixels_have_the_degrees_of_freedom() -> None:
    """Rounds alternate in sign so that their means hide the noise: 50 equal pixels of 6 rounds have 250 degrees of freedom,
    one pixel that outweighs 49 others has 5."""
    signs = np.where(np.add.outer(np.arange(6), np.arange(50)) % 2, 1.0, -1.0)
    equal = mean_of_pixels(10 + signs)
    assert equal.var == pytest.approx(6 / 5 / 6 / 50)
    assert equal.dof == pytest.approx(250)
    one = np.zeros(50)
    one[3], one[4] = 1.0, 1.0
    assert mean_of_pixels(10 + signs * (one + 1e-9)).dof == pytest.approx(10)


def test_bounds_are_those_of_student() -> None:
    """4 and 9 values of one variance: the bound is t's at the degrees of freedom that Welch's formula gives by hand."""
    a, b = Estimate(1.0, 0.25, 3), Estimate(2.0, 0.1, 8)
    result = compare_means(a, b, 1)
    dof = 0.35**2 / (0.25**2 / 3 + 0.1**2 / 8)
    assert result["z"] == pytest.approx(-1 / math.sqrt(0.35))
    assert result["z_bound"] == pytest.approx(-stats.t.ppf(FALSE_ALARM / 2, dof), rel=1e-6)
    assert result["percent"] == pytest.approx(-50)
    assert result["standard_error_percent"] == pytest.approx(50 * math.sqrt(0.35))


def test_means_of_rounds() -> None:
    assert mean_of_rounds(np.array([1.0, 3.0])) == Estimate(2.0, 1.0, 1)


def test_what_json_cannot_say_is_none() -> None:
    result = compare_means(Estimate(1.0, 0.0, 3), Estimate(0.0, 0.0, 3), 1)
    assert (result["z"], result["percent"], result["standard_error_percent"]) == (None, None, None)
    assert finite_or_none(math.inf) is None and finite_or_none(2) == 2.0
    without_noise = compare_means(Estimate(1.0, 0.0, 5.0), Estimate(2.0, 0.0, 5.0), 1)
    assert without_noise["z"] is None and without_noise["percent"] == pytest.approx(-50)
