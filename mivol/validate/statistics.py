"""Do two images have the same mean? Running means and variances, and tests with a chosen rate of false alarms.

Conventions. All numbers are float64. An :class:`Estimate` is a mean of independent batches with the variance *of this mean*
(squared standard error), both arrays of the same shape. A :class:`Significance` is the chance of a false alarm for a whole
image; the chance is divided among the comparisons (:data:`FAMILIES`). The module does not depend on Mitsuba.

Source: Welford 1962 (Technometrics 4) and Chan, Golub, LeVeque 1983 (The American Statistician 37) for running variances; Sidak
1967 (JASA 62) for many comparisons; Satterthwaite 1946 (Biometrics Bulletin 2) and Welch 1947 (Biometrika 34) for sums of
estimated variances; Hoeffding 1963 (JASA 58), Theorem 1, for bounded samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mivol.errors import MivolError

BATCHES = 16
"""Independent renders behind a mean: the standard error is known to 1 / sqrt(2 * 15) = 18 %."""


@dataclass(frozen=True)
class Moments:
    r"""Mean and sum of squared deviations of n values, as scalars or arrays.

    A value x changes the mean m and the sum M of squared deviations by

    .. math:: d = x - m, \quad m' = m + d/n', \quad M' = M + d\,(x - m'),

    and two sets merge by

    .. math:: m = m_a + \delta\,n_b/n, \quad M = M_a + M_b + \delta^2 n_a n_b/n, \quad \delta = m_b - m_a.

    No large numbers are subtracted, so M keeps its digits; the naive sum of squares minus n m^2 would lose all digits.

    Attributes:
        n: number of values.
        mean: float64 array.
        m2: sum of squared deviations from the mean, same shape.
    """

    n: int
    mean: np.ndarray
    m2: np.ndarray

    @staticmethod
    def empty(shape: tuple[int, ...] = ()) -> Moments:
        """Moments of no values."""
        return Moments(0, np.zeros(shape), np.zeros(shape))

    @staticmethod
    def from_values(values: np.ndarray) -> Moments:
        """Moments of values along the first axis."""
        v = np.asarray(values, dtype=np.float64)
        mean = v.mean(axis=0)
        return Moments(len(v), mean, ((v - mean) ** 2).sum(axis=0))

    @staticmethod
    def from_batches(values: Iterable[ArrayLike]) -> Moments:
        """Moments of a stream of values of the same shape, with a single value in memory."""
        found = Moments.empty()
        for value in values:
            found = found.add(np.asarray(value))
        return found

    def add(self, value: np.ndarray) -> Moments:
        """Add a value (Welford)."""
        x = np.asarray(value, dtype=np.float64)
        n = self.n + 1
        mean = self.mean + (x - self.mean) / n
        return Moments(n, mean, self.m2 + (x - self.mean) * (x - mean))

    @property
    def variance(self) -> np.ndarray:
        """Unbiased variance of a single value, M/(n - 1).

        Raises:
            MivolError: fewer than two values.
        """
        if self.n < 2:
            raise MivolError(f"the variance of {self.n} batches is not known; at least 2 are needed.")
        return self.m2 / (self.n - 1)

    @property
    def variance_of_mean(self) -> np.ndarray:
        """Unbiased variance of the mean of n independent values, M/(n (n - 1))."""
        return self.variance / self.n


def average_tiles(mean: np.ndarray, var: np.ndarray, tile: int) -> tuple[np.ndarray, np.ndarray]:
    """Average tiles of pixels, for estimators with heavy tails.

    A batch mean with rare bright samples is far from normal: without these samples, both its mean and its variance are too
    small. The skewness of an average of k independent values falls as 1/sqrt(k), so tiles come nearer to the normal law than
    pixels. A bias smaller than a tile can no longer be located. Rows and columns beyond the last whole tile are left out.

    Args:
        mean: (H, W, C).
        var: (H, W, C), of independent pixels (a box filter).
        tile: side of a tile [pixel].

    Returns:
        mean and variance of the mean, (H // tile, W // tile, C).
    """
    return split_tiles(mean, tile).mean(axis=(1, 3)), split_tiles(var, tile).sum(axis=(1, 3)) / tile**4


def split_tiles(image: np.ndarray, tile: int) -> np.ndarray:
    """An image (H, W, C) as (rows of tiles, tile, columns of tiles, tile, C), cut to whole tiles."""
    h, w, c = image.shape
    if tile < 1 or h < tile or w < tile:
        raise MivolError(f"tiles of {tile} pixels do not fit an image of {w}x{h}; choose 1 to {min(h, w)}.")
    cut = (h // tile, tile, w // tile, tile, c)
    return image[: cut[0] * tile, : cut[2] * tile].reshape(cut)


# -- Tests of means ----------------------------------------------------------------------------------------------------


class Estimate(NamedTuple):
    """Means (of arbitrary shape), the variances of the means, and the degrees of freedom of the variances.

    Attributes:
        mean: mean of independent batches, or an exact answer.
        var: variances of the means; 0 for an exact answer.
        dof: degrees of freedom of each variance: number of batches minus 1, or from :func:`effective_dof` for a sum; infinite
            for an exact variance.
    """

    mean: np.ndarray
    var: np.ndarray | float = 0.0
    dof: np.ndarray | float = np.inf

    @staticmethod
    def from_result(given: Estimate | Moments | np.ndarray | float) -> Estimate:
        """Convert moments of batches or an exact answer to an estimate."""
        if isinstance(given, Estimate):
            return given
        if isinstance(given, Moments):
            return Estimate(given.mean, given.variance_of_mean, given.n - 1)
        return Estimate(np.asarray(given, dtype=np.float64))


# -- Degrees of freedom ---------------------------------------------------------------------------


def effective_dof(variances: np.ndarray, dof: np.ndarray | float, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    r"""Degrees of freedom of a sum of independent estimated variances, by Welch and Satterthwaite.

    An estimate v of a variance with d degrees of freedom, of normal values, is :math:`E[v]\,\chi^2_d/d` with the variance
    :math:`2 E[v]^2/d`. A sum of independent estimates has the mean :math:`\sum E[v_i]` and the variance :math:`\sum 2
    E[v_i]^2/d_i`. A single scaled :math:`\chi^2_\nu` of the same mean and variance has

    .. math:: \nu = \frac{(\sum_i v_i)^2}{\sum_i v_i^2/d_i}

    with estimates in place of the expectations. Since :math:`E[v_i^2] = E[v_i]^2 (1 + 2/d_i)`, the denominator is too large on
    average and :math:`\nu` too small: a t-test with :math:`\nu` is cautious. A sum of k equal variances of d degrees has k d
    degrees; a sum with a dominating variance has the degrees of that variance.

    Args:
        variances: estimates, at least 0, in a common unit.
        dof: degrees of freedom of each; inf for a known variance.
        axis: axis of the sum; by default all axes.

    Returns:
        float64 array; inf without estimated variances or for variances of 0.
    """
    v = np.asarray(variances, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Relative to the largest: squares of variances below 1e-154 would be 0 in float64.
        v = v / v.max(axis=axis, keepdims=True)
        nu = v.sum(axis=axis) ** 2 / (v**2 / dof).sum(axis=axis)
    return np.where(np.isnan(nu), np.inf, nu)


def pooled_dof(var: np.ndarray, dof: float, tile: int) -> np.ndarray:
    """Degrees of freedom of the variances from :func:`mivol.validate.statistics.average_tiles`, (H // tile, W // tile, C).

    Args:
        var: (H, W, C), of independent pixels.
        dof: degrees of freedom of the variance of a pixel.
        tile: side of a tile [pixel].
    """
    return effective_dof(split_tiles(var, tile), dof, axis=(1, 3))


# -- Tests ----------------------------------------------------------------------------------------


def _sidak(alpha: float, m: int) -> float:
    # 1 - (1 - alpha)^(1/m) by expm1 and log1p: the difference of numbers near 1 would keep no digit at alpha/m < 1e-16.
    return float(-np.expm1(np.log1p(-alpha) / m))


# Significance of each of m comparisons for a chance alpha of a false alarm in the family. Sidak is exact for independent
# comparisons (and safe for jointly normal comparisons, two-sided); Bonferroni is always safe.
FAMILIES: dict[str, Callable[[float, int], float]] = {"sidak": _sidak, "bonferroni": lambda alpha, m: alpha / m}


@dataclass(frozen=True)
class Significance:
    """Rate of false alarms of a family of comparisons.

    Attributes:
        alpha: chance of at least a single false alarm although all means agree.
        comparisons: number of comparisons that share ``alpha``; None: the entries of the compared arrays.
        family: key of ``FAMILIES``.

    Raises:
        MivolError: alpha outside (0, 1), no comparison, or a family missing from ``FAMILIES``.
    """

    alpha: float = 1e-6
    comparisons: int | None = None
    family: str = "sidak"

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1 or (self.comparisons is not None and self.comparisons < 1):
            raise MivolError(
                f"alpha = {self.alpha} over {self.comparisons} comparisons; expected 0 < alpha < 1 and at least 1."
            )
        if self.family not in FAMILIES:
            raise MivolError(f'unknown family "{self.family}"; known are: {", ".join(FAMILIES)}.')

    def __str__(self) -> str:
        return f"alpha {self.alpha:g} over {self.comparisons} comparisons"

    def over(self, size: int) -> Significance:
        """The level with its own number of comparisons, else with ``size`` comparisons."""
        return replace(self, comparisons=self.comparisons or max(size, 1))

    @property
    def of_one(self) -> float:
        """Chance of a false alarm of each comparison."""
        return FAMILIES[self.family](self.alpha, self.comparisons or 1)


STRICT = Significance()
"""Level of a single test in a suite of many tests."""


def z_bound(level: Significance, dof: np.ndarray | float = np.inf) -> np.ndarray:
    """Two-sided bound on |z|, exceeded by a family of comparisons with the chance ``level.alpha``.

    Args:
        level: level of the family; a single comparison by default.
        dof: degrees of freedom of the variance; inf for a known variance (normal law), else Student's t.
    """
    tail = level.of_one / 2
    dof = np.asarray(dof, dtype=np.float64)
    normal = -NormalDist().inv_cdf(tail)
    if np.all(np.isinf(dof)):
        return np.full(dof.shape, normal)
    from scipy.special import stdtrit

    return np.where(np.isinf(dof), normal, -stdtrit(np.where(np.isinf(dof), 1.0, dof), tail))


def _difference_dof(a: Estimate, b: Estimate) -> np.ndarray:
    """Degrees of freedom of the variance of a difference."""
    dof = np.stack(np.broadcast_arrays(a.dof, b.dof, a.var)[:2]).astype(np.float64)
    return effective_dof(np.stack([a.var, b.var]), dof, axis=0)


def z_image(a: Estimate, b: Estimate, rounding: float = 0.0) -> np.ndarray:
    """Difference in standard errors, (a - b)/sqrt(var_a + var_b + rounding^2).

    Args:
        a, b: means, with their variances.
        rounding: standard deviation of float32 rounding, in units of the means.

    Returns:
        float64 array; 0 for equal means, infinite for different means without variance.
    """
    difference = np.asarray(a.mean, dtype=np.float64) - b.mean
    variance = np.broadcast_to(np.asarray(a.var, dtype=np.float64) + b.var + rounding**2, difference.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = difference / np.sqrt(variance)
    return np.where(difference == 0, 0.0, z)


def assert_same_mean(
    a: Estimate, b: Estimate, *, level: Significance = STRICT, tile: int = 1, rounding: float = 0.0, what: str = "the means"
) -> None:
    """Raise unless two images have the same mean: a z-test (or t-test) for each pixel at the given level.

    Args:
        a, b: means of arbitrary shape; (H, W, C) with ``tile`` above 1. Estimated variances use Student's t with Welch's
            degrees of freedom; ``dof`` is a single number with ``tile`` above 1.
        level: chance of raising although the means agree. Give the number of comparisons if several images share the chance.
        tile: side of tiles that are averaged first [pixel]; for heavy tails, see :func:`average_tiles`.
            The variance of a tile has the degrees of freedom of all its pixels, :func:`pooled_dof`.
        rounding: as in :func:`z_image`.
        what: subject of the sentence.

    Raises:
        AssertionError: the worst pixel, its difference in standard errors, the bound, the number of differing pixels, and the
            smallest bias found nine times in ten.
        MivolError: a value that is not finite, or a negative variance.
    """
    a, b, dof = _prepare_tiles(a, b, tile)
    level = level.over(a.mean.size)
    z = z_image(a, b, rounding)
    bound = z_bound(level, dof)
    beyond = np.abs(z) > bound
    if not beyond.any():
        return
    worst = np.unravel_index(np.argmax(np.where(beyond, np.abs(z) / bound, 0)), z.shape)
    power = smallest_detectable_bias(a.var + b.var, level=level, dof=dof)
    raise AssertionError(
        f"{what} differ at {tuple(int(i) for i in worst)}: {a.mean[worst]:.8g} and {b.mean[worst]:.8g}, {z[worst]:+.2f} "
        f"standard errors, bound {bound[worst]:.2f} ({level}); {beyond.sum()} of {z.size} beyond it; "
        f"a bias of {np.median(power):.2g} is found 9 times in 10."
    )


def p_value(a: Estimate, b: Estimate, *, comparisons: int | None = None, tile: int = 1, rounding: float = 0.0) -> float:
    """Chance of a difference as large as the largest difference here, for means that agree: the alpha at which
    :func:`assert_same_mean` starts to raise.

    Args: as :func:`assert_same_mean`; many comparisons by Sidak's formula.
    """
    from scipy.special import ndtr, stdtr

    a, b, dof = _prepare_tiles(a, b, tile)
    z = np.abs(z_image(a, b, rounding))
    tail = 2 * np.where(np.isinf(dof), ndtr(-z), stdtr(np.where(np.isinf(dof), 1.0, dof), -z))
    m = comparisons or max(a.mean.size, 1)
    return float(-np.expm1(m * np.log1p(-np.min(tail, initial=1.0).clip(max=1 - 1e-16))))


def _prepare_tiles(a: Estimate, b: Estimate, tile: int) -> tuple[Estimate, Estimate, np.ndarray]:
    """Estimates of pixels or tiles, and the degrees of freedom of the variance of their difference."""
    a, b = _check_estimates(a, b)
    if tile > 1:
        a, b = (Estimate(*average_tiles(e.mean, e.var, tile), pooled_dof(e.var, e.dof, tile)) for e in (a, b))
    return a, b, _difference_dof(a, b)


def _check_estimates(a: Estimate, b: Estimate) -> tuple[Estimate, Estimate]:
    """Two estimates as float64 arrays of the same shape.

    Raises:
        MivolError: different shapes, a value that is not finite, or a negative variance.
    """
    first, second = np.asarray(a.mean, dtype=np.float64), np.asarray(b.mean, dtype=np.float64)
    if second.ndim and first.shape != second.shape:
        raise MivolError(f"images of shape {first.shape} and {second.shape} cannot be compared; render both at one size.")
    arrays = np.broadcast_arrays(first, second, np.asarray(a.var, dtype=np.float64), np.asarray(b.var, dtype=np.float64))
    for name, array in zip(("first mean", "second mean", "first variance", "second variance"), arrays, strict=True):
        bad = ~np.isfinite(array) | (array < 0 if "variance" in name else False)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            raise MivolError(f"the {name} is {array[where]} at {where}: a test needs finite means and variances of at least 0.")
    return Estimate(arrays[0], arrays[2], a.dof), Estimate(arrays[1], arrays[3], b.dof)


# -- Power ----------------------------------------------------------------------------------------


def smallest_detectable_bias(
    variance: np.ndarray, *, level: Significance = STRICT, power: float = 0.9, dof: np.ndarray | float = np.inf
) -> np.ndarray:
    """Bias found by a two-sided z-test with chance ``power``: (z_alpha + z_power) standard errors.

    The test raises if |difference| > z_alpha s. With a bias b the difference is normal about b, and exceeds z_alpha s with
    chance Phi(b/s - z_alpha), neglecting the other tail below alpha/2. So b = (z_alpha + Phi^-1(power)) s. With ``dof``
    degrees of freedom z_alpha is the bound of Student's t, and b the average over estimates of s.

    Args:
        variance: variance s^2 of the difference of the means.
        level: level of the test.
        power: chance of finding the bias, in (0, 1).
        dof: degrees of freedom of the variance.
    """
    if not 0 < power < 1:
        raise MivolError(f"power = {power}; expected a chance between 0 and 1.")
    s = np.sqrt(np.asarray(variance, dtype=np.float64))
    return (z_bound(level, dof) + NormalDist().inv_cdf(power)) * s


@dataclass(frozen=True)
class Bias:
    """Mean difference of two images, with its confidence interval.

    Attributes:
        value: mean over pixels and channels of a - b.
        standard_error: standard error of ``value``.
        low, high: ends of the interval; the interval misses the true bias with chance ``alpha``.
    """

    value: float
    standard_error: float
    low: float
    high: float
    alpha: float


def estimate_bias(a: Estimate, b: Estimate, *, alpha: float = 1e-3, correlated: int = 1) -> Bias:
    """Estimate the mean difference of two images: finds a bias too small to show in a single pixel.

    Args:
        a, b: images; ``dof`` belongs to the variance of each pixel. The sum has the degrees of :func:`effective_dof`, divided
            by ``correlated``.
        alpha: chance that the interval misses the true bias.
        correlated: number of values that share samples, including the value itself. 1: box filter and grey noise. A filter of
            radius r pixels: at most (2 floor(2 r) + 1)^2. Times 3 if the channels share paths. The variance of the sum is at
            most ``correlated`` times the sum of variances, since Cov(i, j) <= (v_i + v_j)/2.
    """
    a, b = _check_estimates(a, b)
    value = float((a.mean - b.mean).mean())
    error = float(np.sqrt(correlated * (a.var + b.var).sum()) / a.mean.size)
    spread = effective_dof(np.stack([a.var, b.var]), np.reshape([a.dof, b.dof], (2,) + (1,) * a.mean.ndim))
    half = float(z_bound(Significance(alpha), spread / correlated)) * error
    return Bias(value, error, value - half, value + half, alpha)


def bounded_p_value(mean: np.ndarray, n: int, truth: np.ndarray, bounds: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
    r"""Upper bound of the chance of a mean of n samples at least as far from the truth, for samples between two bounds.

    Hoeffding's first bound: for samples in [0, 1] of expectation p, the mean X of n samples satisfies

    .. math:: P(X \ge x) \le e^{-n\,K(x, p)}, \quad K(x, p) = x\ln\frac{x}{p} + (1 - x)\ln\frac{1 - x}{1 - p}
        \quad (x \ge p),

    and the same below p; twice the smaller exponential bounds both sides. The bound needs no estimated variance and no limit
    theorem, so the bound holds where the z-test fails: a transmittance of 1e-6 never seen by delta tracking in n samples has
    an estimated variance of 0. The bound is nearly sharp for samples of 0 or 1, and cautious for others.

    Args:
        mean: sample means.
        n: samples behind each mean.
        truth: expectations.
        bounds: bounds of a sample, for instance 0 and the radiance of the background.

    Returns:
        Upper bound of the p-value, in [0, 1]; 0 if the truth equals a bound and the mean does not.
    """
    low, high = bounds
    scale = high - low
    if not scale > 0:
        raise MivolError(f"found samples between {low} and {high}, expected the lower bound below the upper bound.")
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
    """Raise unless means of n bounded samples agree with an exact answer, without normality or estimated variance.

    Args and bound: as :func:`bounded_p_value`; level: as :class:`mivol.validate.statistics.Significance`.

    Raises:
        AssertionError: the worst pixel, and the probability of its difference.
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
