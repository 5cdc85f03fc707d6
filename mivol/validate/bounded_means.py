"""Tests of means of bounded samples, by Hoeffding's bound: no variance is estimated, and no limit theorem used.

Source: Hoeffding 1963 (JASA 58), Theorem 1.
"""

from __future__ import annotations

import numpy as np

from mivol.errors import MivolError
from mivol.validate.statistics import STRICT, Significance

__all__ = ["assert_same_bounded_mean", "bounded_p_value"]


def bounded_p_value(
    mean: np.ndarray, n: int, truth: np.ndarray, bounds: tuple[float, float] = (0.0, 1.0)
) -> np.ndarray:
    r"""Chance, at most, of a mean of n samples at least as far from the truth, for samples between two bounds.

    Hoeffding's first bound: for samples in [0, 1] of expectation p, the mean X of n of them satisfies

    .. math:: P(X \ge x) \le e^{-n\,K(x, p)}, \quad K(x, p) = x\ln\frac{x}{p} + (1 - x)\ln\frac{1 - x}{1 - p}
        \quad (x \ge p),

    and the same below p; twice the smaller exponential bounds both sides. No variance is estimated and no limit theorem
    used, so it holds where the z-test fails: a transmittance of 1e-6 that delta tracking has not seen once in n samples
    has an estimated variance of 0. It is nearly sharp for samples that are 0 or 1, and cautious for others.

    Args:
        mean: sample means.
        n: samples behind each.
        truth: expectations.
        bounds: of one sample, for instance 0 and the radiance of the background.

    Returns:
        Upper bound of the p-value, in [0, 1]; 0 where the truth is a bound and the mean is not.
    """
    low, high = bounds
    scale = high - low
    if not scale > 0:
        raise MivolError(f"samples between {low} and {high} leave nothing to test; give low below high.")
    # 1e-6 of the range is forgiven at both ends: a float32 mean of up to 2^20 terms is rounded by that much.
    x = (np.asarray(mean, dtype=np.float64) - low) / scale
    p = (np.asarray(truth, dtype=np.float64) - low) / scale
    for name, q in (("mean", x), ("truth", p)):
        if not np.all((q >= -1e-6) & (q <= 1 + 1e-6)):
            raise MivolError(f"the {name} lies outside the bounds {low} to {high} of its samples; give wider bounds.")
    x, p = np.clip(x, 0, 1), np.clip(p, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.where(x == 0, 0.0, x * (np.log(x) - np.log(p)))
        down = np.where(x == 1, 0.0, (1 - x) * (np.log1p(-x) - np.log1p(-p)))
    return np.minimum(1.0, 2 * np.exp(-n * np.maximum(up + down, 0.0)))


def assert_same_bounded_mean(
    mean: np.ndarray,
    n: int,
    truth: np.ndarray,
    *,
    bounds: tuple[float, float] = (0.0, 1.0),
    level: Significance = STRICT,
    what: str = "the means",
) -> None:
    """Raise unless means of n bounded samples agree with an exact answer: no normality, no estimated variance.

    Args and bound: see :func:`bounded_p_value`; level: see :class:`mivol.validate.statistics.Significance`.

    Raises:
        AssertionError: which pixel differs and how unlikely that is.
    """
    p = np.atleast_1d(bounded_p_value(mean, n, truth, bounds))
    level = level.over(p.size)
    one = level.of_one
    if not (p < one).any():
        return
    worst = np.unravel_index(np.argmin(p), p.shape)
    x, t = (np.broadcast_to(v, p.shape)[worst] for v in (mean, truth))
    raise AssertionError(
        f"{what} differ at {tuple(int(i) for i in worst)}: {x:.8g} for {t:.8g} after {n} samples, p < {p[worst]:.2g} "
        f"(level {one:.2g}: {level}); {(p < one).sum()} of {p.size} beyond it."
    )
