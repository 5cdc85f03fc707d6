"""Agreement of two noisy means: z, its bound by Student's t, and the smallest visible bias.

Conventions. Values are float64, one for each round; a round has its own seed. An error is the variance of a mean with the
degrees of freedom of its estimate (:class:`mivol.validate.statistics.Estimate`). A time ratio of two methods is meaningless
if their means differ, so every study of unbiased methods compares the means first.
"""

from __future__ import annotations

import math

import numpy as np

from mivol.validate.moments import Moments
from mivol.validate.statistics import Estimate, Significance, effective_dof, z_bound, z_image

__all__ = ["FALSE_ALARM", "compare_means", "finite_or_none", "mean_of_pixels", "mean_of_rounds"]

FALSE_ALARM = 1e-3
"""Probability that a run reports a difference although all means agree."""


def mean_of_rounds(values: np.ndarray) -> Estimate:
    """Estimate the mean of at least two independent values (rounds,)."""
    m = Moments.from_values(values)
    return Estimate(float(m.mean), float(m.variance_of_mean), m.n - 1)


def mean_of_pixels(rounds: np.ndarray) -> Estimate:
    """Estimate the mean over rounds and pixels (rounds, pixels).

    Two variances are known, and the larger one counts. The sum of the variances of the pixels has many degrees of freedom
    (:func:`effective_dof`; few if one pixel has most of the noise), but misses noise shared by pixels, for instance random
    numbers of a tile. The variance of the means of rounds has this shared noise.
    """
    shared = mean_of_rounds(rounds.mean(axis=1))
    v = Moments.from_values(rounds).variance_of_mean
    alone = float(v.sum()) / v.size**2
    if alone <= shared.var:
        return shared
    return Estimate(shared.mean, alone, float(effective_dof(v, rounds.shape[0] - 1)))


def compare_means(a: Estimate, b: Estimate, comparisons: int) -> dict[str, float | None]:
    """Compare two means by Student's t with Welch's degrees of freedom.

    Args:
        a: mean under test.
        b: reference mean; percentages are relative to this mean.
        comparisons: number of comparisons that share ``FALSE_ALARM``.

    Returns:
        z of a - b, the bound of z, the difference and its standard error in percent of b. An infinite value is None: z for
        means without variance, the percentages for b = 0.
    """
    variance = a.var + b.var
    dof = effective_dof(np.array([a.var, b.var]), np.array([a.dof, b.dof]))
    scale = 100 / abs(b.mean) if b.mean else math.inf
    return {
        "z": finite_or_none(z_image(a, b)),
        "z_bound": float(z_bound(Significance(FALSE_ALARM, comparisons), dof)),
        "percent": finite_or_none(scale * math.copysign(1, b.mean) * (a.mean - b.mean)),
        "standard_error_percent": finite_or_none(scale * math.sqrt(variance)),
    }


def finite_or_none(x: float) -> float | None:
    """Replace infinity and NaN, which JSON lacks, by None."""
    return float(x) if np.isfinite(x) else None
