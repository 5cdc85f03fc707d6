"""Do two noisy measurements have the same mean? z, its bound by Student's t, and how small a bias could have been seen.

Conventions. Values are float64, one for each round (a round has its own seed); an error is a variance of a mean together
with the degrees of freedom that it was estimated with (:class:`mivol.validate.statistics.Estimate`). A ratio of times between
methods whose means differ says nothing, so every bench of unbiased methods judges their means first.
"""

from __future__ import annotations

import math

import numpy as np

from mivol.validate.moments import Moments
from mivol.validate.statistics import Estimate, Significance, effective_dof, z_bound, z_image

__all__ = ["FALSE_ALARM", "compare_means", "finite", "mean_of_pixels", "mean_of_rounds", "number"]

FALSE_ALARM = 1e-3
"""Chance that a run of a bench in which all means agree is said not to."""


def mean_of_rounds(values: np.ndarray) -> Estimate:
    """The mean of independent values (rounds,), two at least."""
    m = Moments.of(values)
    return Estimate(float(m.mean), float(m.variance_of_mean), m.n - 1)


def mean_of_pixels(rounds: np.ndarray) -> Estimate:
    """The mean over rounds and pixels (rounds, pixels).

    Pixels with samples of their own tell its variance well: it is the sum of theirs, with the degrees of freedom that
    :func:`effective_dof` gives: few where one pixel has most of the noise. Rounds tell it whatever pixels
    share (random numbers, in a tile). The larger of the two variances counts.
    """
    shared = mean_of_rounds(rounds.mean(axis=1))
    v = Moments.of(rounds).variance_of_mean
    alone = float(v.sum()) / v.size**2
    if alone <= shared.var:
        return shared
    return Estimate(shared.mean, alone, float(effective_dof(v, rounds.shape[0] - 1)))


def compare_means(a: Estimate, b: Estimate, comparisons: int) -> dict[str, float | None]:
    """Compare two means by Student's t with Welch's degrees of freedom.

    Args:
        a, b: the second one is what percents are of.
        comparisons: how many of them share FALSE_ALARM.

    Returns:
        z of a - b, its bound, the difference and its standard error in percent of b; None where b, or both variances, are 0.
    """
    variance = a.var + b.var
    dof = effective_dof(np.array([a.var, b.var]), np.array([a.dof, b.dof]))
    scale = 100 / abs(b.mean) if b.mean else math.inf
    return {
        "z": finite(z_image(a, b)),
        "z_bound": float(z_bound(Significance(FALSE_ALARM, comparisons), dof)),
        "percent": finite(scale * math.copysign(1, b.mean) * (a.mean - b.mean)),
        "standard_error_percent": finite(scale * math.sqrt(variance)),
    }


def finite(x: float) -> float | None:
    """The number, or None: JSON has no infinity."""
    return float(x) if np.isfinite(x) else None


def number(x: float | None) -> float:
    """The number, or NaN where there is none: to be printed."""
    return math.nan if x is None else x
