"""Forms of exp at small, middling and large arguments, against float64."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import hyp1f1

from mivol.numerics import exp_moments, fast_max, fast_min, maximum, minimum, one_minus_exp, phi1

MOMENT_BOUNDS = (4e-7, 4e-7, 8e-7, 2e-6, 6e-6, 2e-5)


def arguments() -> np.ndarray:
    """Float32 numbers over twelve decades, and densely where the series end."""
    spread = 10 ** np.random.default_rng(0).uniform(-9, 4, 40_000)
    return np.concatenate([spread, np.linspace(0.4, 0.6, 20_000), np.linspace(1.8, 2.2, 20_000), [0.0]]).astype(np.float32)


def moment(n: int, x: np.ndarray) -> np.ndarray:
    """E_n in float64: exp(-x) 1F1(1, n + 2, x) / (n + 1), a sum of positive terms; n! / x^(n + 1) where exp(-x) is nothing."""
    near, far = np.minimum(x, 300), np.maximum(x, 1)
    return np.where(x < 300, np.exp(-near) * hyp1f1(1, n + 2, near) / (n + 1), math.factorial(n) / far ** (n + 1))


def worst(got: mi.Float, exact: np.ndarray) -> float:
    """Largest error relative to the exact numbers."""
    return float(np.max(np.abs(np.array(got, dtype=np.float64) - exact) / exact))


def test_opacity_at_any_optical_depth():
    x = arguments()[:-1]
    assert worst(one_minus_exp(mi.Float(x)), -np.expm1(-x.astype(np.float64))) <= 4e-7
    assert np.array(one_minus_exp(mi.Float([0.0, 1e-8, dr.inf]))) == pytest.approx([0.0, 1e-8, 1.0], rel=4e-7, abs=0)
    # The form that it replaces has nothing left at 1e-8.
    assert (1 - dr.exp(mi.Float(-1e-8)))[0] == 0


def test_phi1():
    x = arguments()
    assert worst(phi1(mi.Float(x)), moment(0, x.astype(np.float64))) <= 4e-7
    assert phi1(mi.Float(0))[0] == 1


@pytest.mark.parametrize("n", range(6))
def test_moments(n):
    x = arguments()
    assert worst(exp_moments(mi.Float(x))[n], moment(n, x.astype(np.float64))) <= MOMENT_BOUNDS[n]
    assert exp_moments(mi.Float(0))[n][0] == pytest.approx(1 / (n + 1), rel=2e-7)
    assert exp_moments(mi.Float(dr.inf))[n][0] == 0


def test_moments_against_quadrature():
    # The truth itself: midpoints of the definition, error 1e-10.
    u = (np.arange(100_000) + 0.5) / 100_000
    for x in (0.01, 0.7, 3.0, 20.0):
        for n in range(6):
            assert moment(n, np.array([x]))[0] == pytest.approx(np.mean(u**n * np.exp(-x * u)), rel=1e-6)


def test_a_negative_argument_is_no_special_case():
    # An extinction that an optimizer has pushed below 0 must not make NaN.
    x = np.array([-0.3, -1.5, -4.0])
    assert np.array(one_minus_exp(mi.Float(x))) == pytest.approx(-np.expm1(-x), rel=1e-6)
    assert np.array(phi1(mi.Float(x))) == pytest.approx(-np.expm1(-x) / x, rel=1e-6)
    assert np.all(np.isfinite(np.array(exp_moments(mi.Float(x)))))


def test_extremes_of_numbers_in_each_lane():
    values = np.random.default_rng(3).normal(size=(3, 50)).astype(np.float32)
    rows = [mi.Float(row) for row in values]
    np.testing.assert_array_equal(np.array(minimum(rows)), values.min(axis=0))
    np.testing.assert_array_equal(np.array(maximum(rows)), values.max(axis=0))
    np.testing.assert_array_equal(np.array(fast_min(*rows[:2])), values[:2].min(axis=0))
    np.testing.assert_array_equal(np.array(fast_max(*rows[:2])), values[:2].max(axis=0))
