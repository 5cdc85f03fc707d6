"""Tests of means are tested: false alarms and power against the rates that they promise."""

from __future__ import annotations

import numpy as np
import pytest
from false_alarms import assert_rate, assert_same_variance, note
from refusals import assert_refused
from scipy.special import erfc, stdtr
from scipy.stats import binom, norm

from mivol.errors import MivolError
from mivol.validate.statistics import (
    FAMILIES,
    Estimate,
    Moments,
    Significance,
    assert_same_bounded_mean,
    assert_same_mean,
    average_tiles,
    bounded_p_value,
    effective_dof,
    estimate_bias,
    p_value,
    pooled_dof,
    smallest_detectable_bias,
    z_bound,
    z_image,
)


def _raises(a: Estimate, b: Estimate, alpha: float = 1e-6, **settings: object) -> bool:
    try:
        assert_same_mean(a, b, level=Significance(alpha), **settings)
    except AssertionError:
        return True
    return False


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("m", [1, 3, 10**4, 10**12])
def test_levels_add_up(family, m):
    """Sidak: (1 - level)^m = 1 - alpha; Bonferroni: m level = alpha. No digit is lost at a trillion comparisons."""
    level = Significance(1e-6, m, family).of_one
    total = -np.expm1(m * np.log1p(-level)) if family == "sidak" else m * level
    assert total == pytest.approx(1e-6, rel=1e-12)


def test_bounds_are_quantiles():
    """erfc(z/sqrt(2)) and twice the t tail give the level back."""
    for alpha in (0.3, 1e-3, 1e-6, 1e-15):
        assert erfc(float(z_bound(Significance(alpha))) / np.sqrt(2)) == pytest.approx(alpha, rel=1e-9)
    dof = np.array([3.0, 31.0, np.inf])
    bounds = z_bound(Significance(1e-4), dof)
    np.testing.assert_allclose(2 * stdtr(dof[:2], -bounds[:2]), 1e-4, rtol=1e-9)
    assert bounds[2] == z_bound(Significance(1e-4))


def test_z_of_equal_and_of_exact_values():
    """0 where equal even without variance, infinite where exact answers differ, finite with a rounding error."""
    z = z_image(Estimate(np.array([1.0, 1.0, 1.0])), Estimate(np.array([1.0, 2.0, 0.5])))
    np.testing.assert_array_equal(z, [0, -np.inf, np.inf])
    one, two = Estimate(np.array([1.0])), Estimate(np.array([2.0]))
    np.testing.assert_allclose(z_image(one, two, rounding=0.5), -2)
    np.testing.assert_allclose(z_image(one._replace(var=9.0), two._replace(var=16.0)), -0.2)


@pytest.mark.statistical
def test_false_alarms_of_known_variance(seed):
    """Rationale: alpha is what the whole suite rests on. Expected: 5 % of 2000 equal images of 40 pixels raise.

    Catches: a one-sided tail (10 %), a bound that forgets the 40 comparisons (87 %), variance for standard error.
    """
    rng = np.random.default_rng(seed)
    va, vb = rng.uniform(0.1, 4, (2, 40))
    runs = 2000
    pairs = ((Estimate(rng.normal(0, np.sqrt(va)), va), Estimate(rng.normal(0, np.sqrt(vb)), vb)) for _ in range(runs))
    hits = sum(_raises(a, b, alpha=0.05) for a, b in pairs)
    assert_rate(hits, runs, 0.05)


@pytest.mark.slow_for("0-4")
@pytest.mark.statistical
@pytest.mark.parametrize("n", [4, 12])
def test_false_alarms_of_estimated_variance(seed, n):
    """Student's t keeps the rate with 4 batches, where the normal law would raise several times too often."""
    rng = np.random.default_rng(seed)
    hits = normal = 0
    runs = 2000
    for _ in range(runs):
        m = Moments.from_values(rng.normal(size=(n, 10)))
        hits += _raises(Estimate.from_result(m), Estimate(np.zeros(10)), alpha=0.05)
        normal += _raises(Estimate(m.mean, m.variance_of_mean), Estimate(np.zeros(10)), alpha=0.05)
    assert_rate(hits, runs, 0.05)
    # 0.16 of the runs with 12 batches and more with 4, beside 0.05: 1.5 times are 7 standard deviations away.
    note(norm.sf(7), "alarms of the normal law")
    assert normal > 1.5 * hits


@pytest.mark.statistical
def test_power_is_as_promised(seed):
    """Of 2000 biases of the smallest detectable size, nine in ten are found."""
    rng = np.random.default_rng(seed)
    level = Significance(1e-3, 100)
    size = float(smallest_detectable_bias(9.0, level=level))
    runs = 2000
    hits = 0
    for _ in range(runs):
        a, b = Estimate(rng.normal(size, 2, 1), 4.0), Estimate(rng.normal(0, np.sqrt(5), 1), 5.0)
        try:
            assert_same_mean(a, b, level=level)
        except AssertionError:
            hits += 1
    assert_rate(hits, runs, 0.9)


def test_message_names_pixel_and_power():
    """The sentence says where, how far, the bound, and what would have been found."""
    b = np.zeros((3, 4))
    a = b.copy()
    a[1, 2] = 0.5
    with pytest.raises(AssertionError, match=r"at \(1, 2\): 0.5 and 0, \+50.00 standard errors.*1 of 12 beyond"):
        assert_same_mean(Estimate(a, 1e-4), Estimate(b))
    assert_same_mean(Estimate(a, 1e-4), Estimate(b), rounding=0.1)


def test_welch_trusts_the_side_that_has_the_variance():
    """An exact answer beside 4 batches leaves 3 degrees of freedom; a noisy reference of 1000 beside exact pixels, 999."""
    a, zero = np.array([8.0]), np.zeros(1)
    assert not _raises(Estimate(a, 1.0, 3), Estimate(zero, zero))  # t of 3 dof: bound 103
    assert _raises(Estimate(a, zero, 3), Estimate(zero, 1.0, 999))  # bound 4.9


def test_degrees_of_freedom_of_sums():
    """k equal variances have k times the degrees of one, one that outweighs all has its own, a known one has none to add."""
    assert effective_dof(np.full(48, 3e-200), 15) == pytest.approx(48 * 15, rel=1e-12)
    assert effective_dof(np.array([1.0, 1e-9]), np.array([7, 1e6])) == pytest.approx(7, rel=1e-6)
    assert effective_dof(np.array([1.0, 1.0]), np.array([7, np.inf])) == pytest.approx(28, rel=1e-12)
    assert effective_dof(np.zeros(3), 15) == np.inf
    by_tile = pooled_dof(np.ones((5, 6, 1)), 3, 2)
    np.testing.assert_allclose(by_tile, np.full((2, 3, 1), 12))


@pytest.mark.statistical
def test_false_alarms_of_pooled_variances(seed):
    """Tiles of 16 pixels of unequal variance, 4 batches each: Student's t of their effective degrees of freedom keeps the rate,
    on the side of caution (0.035 for 0.05), where those of one pixel, 3, would give 0.001."""
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(0.2, 3, (8, 8, 1))
    runs, hits = 2000, 0
    for _ in range(runs):
        m = Moments.from_values(rng.normal(size=(4, 8, 8, 1)) * sigma)
        hits += _raises(Estimate.from_result(m), Estimate(np.zeros((8, 8, 1))), alpha=0.05, tile=4)
    assert_rate(hits, runs, 0.05, at_least=0.02)


@pytest.mark.statistical
def test_p_values_are_even(seed):
    """Of comparisons that hold a tenth has a p-value below 0.1, and a comparison turns where alpha passes it."""
    rng = np.random.default_rng(seed)
    runs, below = 2000, 0
    for _ in range(runs):
        m = Moments.from_values(rng.normal(size=(6, 10)))
        given = Estimate.from_result(m), Estimate(np.zeros(10))
        p = p_value(*given)
        below += p < 0.1
        assert not _raises(*given, alpha=0.999 * p)
        assert _raises(*given, alpha=min(1.001 * p, 1 - 1e-12))
    assert_rate(below, runs, 0.1)


@pytest.mark.statistical
def test_bias_covers_and_finds(seed):
    """Its interval misses the truth at the rate alpha; 3 % of a pixel's noise is found in 10^5 of them."""
    rng = np.random.default_rng(seed)
    runs = 1000
    missed = 0
    for _ in range(runs):
        found = estimate_bias(Estimate(rng.normal(0.3, 1, 50), 1.0), Estimate(np.zeros(50)), alpha=0.05)
        missed += not found.low <= 0.3 <= found.high
    assert_rate(missed, runs, 0.05)
    # 6.3 standard errors, of which the interval takes 3.3.
    note(norm.sf(100_000**0.5 * 0.03 - 3.3), "bias")
    found = estimate_bias(Estimate(rng.normal(0.03, 1, 100_000), 1.0), Estimate(np.zeros(100_000)))
    assert found.low > 0


@pytest.mark.statistical
def test_bias_of_estimated_variances(seed):
    """Three batches of two pixels: the interval is Student's, of about 4 degrees of freedom, half of them where both share."""
    rng = np.random.default_rng(seed)
    runs, missed = 2000, 0
    for _ in range(runs):
        m = Moments.from_values(rng.normal(0.3, 1, (3, 2)))
        found = estimate_bias(Estimate.from_result(m), Estimate(np.zeros(2)), alpha=0.05)
        missed += not found.low <= 0.3 <= found.high
    assert_rate(missed, runs, 0.05, at_least=0.02)


@pytest.mark.statistical
def test_bias_of_correlated_pixels(seed):
    """Pixels that share samples: five neighbours averaged; the standard error with ``correlated`` covers the real one."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2000, 304))
    smooth = np.stack([noise[:, i : i + 300] for i in range(5)]).mean(axis=0)
    image, zero = Estimate(smooth[0], 1 / 5), Estimate(np.zeros(300))
    naive = estimate_bias(image, zero).standard_error
    safe = estimate_bias(image, zero, correlated=9).standard_error
    # The sum counts each sample five times, those near the ends one to four times.
    counts = np.convolve(np.ones(300), np.ones(5))
    real = np.sqrt(np.sum(counts**2)) / 5 / 300
    assert_same_variance(smooth.mean(axis=1), real**2, what="means")
    assert real / naive == pytest.approx(np.sqrt(5), rel=0.01)
    assert safe == pytest.approx(3 * naive)
    assert safe > real


def test_refusals():
    """One sentence each."""
    one = np.ones((3, 3))
    nan = one.copy()
    nan[2, 1] = np.nan
    cases = [
        (lambda: assert_same_mean(Estimate(nan, one), Estimate(one)), r"first mean is nan at \(2, 1\)"),
        (lambda: assert_same_mean(Estimate(one, -one), Estimate(one)), "first variance is -1.0"),
        (lambda: assert_same_mean(Estimate(one, one), Estimate(np.ones((3, 4)))), "cannot be compared"),
        (lambda: Significance(0, 3), "alpha = 0"),
        (lambda: Significance(0.1, 0), "over 0 comparisons"),
        (lambda: Significance(0.1, 3, "sidek"), "sidak"),
        (lambda: smallest_detectable_bias(1.0, power=1), "power = 1"),
    ]
    for call, words in cases:
        assert_refused(words, call)


def test_moments_keep_their_digits(seed):
    """Values of spread 1 about 1e8: the naive sum of squares has no digit left in float64 (1e16 * 1e-16 = 1)."""
    offsets = np.random.default_rng(seed).normal(size=(1000, 3))
    values = 1e8 + offsets
    offsets = values - 1e8  # exact: what the sum with 1e8 has left of the offset
    one_by_one = Moments.empty((3,))
    for value in values:
        one_by_one = one_by_one.add(value)
    for moments in (one_by_one, Moments.from_values(values)):
        assert moments.n == 1000
        # Each step rounds the mean (1e8) to 1.5e-8; n such steps move M by 1e-8 sum|x - m| at most: 1e-8 relative.
        np.testing.assert_allclose(moments.variance, offsets.var(axis=0, ddof=1), rtol=1e-7)
        np.testing.assert_allclose(moments.mean - 1e8, offsets.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(moments.variance_of_mean, moments.variance / 1000, rtol=1e-15)


def test_variance_of_one_batch_is_refused():
    """One batch says nothing of its variance."""
    with pytest.raises(MivolError, match="the variance of 1 batches is not known"):
        _ = Moments.empty().add(np.array(3.0)).variance


@pytest.mark.statistical
def test_pooled_tiles(seed):
    """Means of 2x2 tiles, their variance by measurement over 4000 images, and what does not fill a tile left out."""
    rng = np.random.default_rng(seed)
    sigma = np.arange(1, 31, dtype=float).reshape(5, 6, 1)
    means = np.array([average_tiles(rng.normal(size=sigma.shape) * sigma, sigma**2, 2)[0] for _ in range(4000)])
    _, var = average_tiles(sigma, sigma**2, 2)
    assert means.shape[1:] == (2, 3, 1)
    assert_same_variance(means, var, what="tiles")
    assert_refused("tiles of 9 pixels", average_tiles, sigma, sigma, 9)


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
    assert_refused("outside the bounds", bounded_p_value, np.array([1.5]), 10, np.array([0.5]))
    assert_refused("expected the lower bound below", bounded_p_value, 0.0, 10, 0.0, (1, 1))


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
