"""Running moments against exact sums; variances of tiles against measurement."""

from __future__ import annotations

import numpy as np
import pytest
from false_alarms import assert_same_variance

from mivol.errors import MivolError
from mivol.validate.moments import Moments, average_tiles


def test_moments_keep_their_digits(seed):
    """Values of spread 1 about 1e8: the naive sum of squares has no digit left in float64 (1e16 * 1e-16 = 1)."""
    offsets = np.random.default_rng(seed).normal(size=(1000, 3))
    values = 1e8 + offsets
    offsets = values - 1e8  # exact: what the sum with 1e8 has left of the offset
    one_by_one = Moments.empty((3,))
    for value in values:
        one_by_one = one_by_one.add(value)
    merged = Moments.of(values[:1]).merge(Moments.of(values[1:17])).merge(Moments.empty((3,))).merge(Moments.of(values[17:]))
    for moments in (one_by_one, merged, Moments.of(values)):
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
    with pytest.raises(MivolError, match="tiles of 9 pixels"):
        average_tiles(sigma, sigma, 9)
