r"""Is it the same picture? Means, their variance, and tests whose rate of false alarms is set beforehand.

Conventions. ``mean`` is an average of n independent batches, ``var`` the variance *of that mean* (standard error squared),
both float64 arrays of one shape. ``alpha`` is the chance that a test raises the alarm although the means agree, for the
whole image: it is divided among the comparisons (:data:`FAMILIES`). Nothing here knows of Mitsuba.

Source: Welford 1962 (Technometrics 4) and Chan, Golub, LeVeque 1983 (The American Statistician 37) for running moments;
Sidak 1967 (JASA 62) for many comparisons; Satterthwaite 1946 (Biometrics Bulletin 2) and Welch 1947 (Biometrika 34) for
sums of estimated variances; Hoeffding 1963 (JASA 58), Theorem 1, for bounded samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from mivol.errors import MivolError

__all__ = [
    "FAMILIES",
    "Bias",
    "Moments",
    "assert_same_bounded_mean",
    "assert_same_mean",
    "batches_for",
    "bias",
    "bounded_p_value",
    "effective_dof",
    "level_of_one",
    "nrmse",
    "p_value",
    "pool",
    "pooled_dof",
    "psnr",
    "smallest_detectable_bias",
    "ssim",
    "z_bound",
    "z_image",
]


# -- Mean and variance of the mean ----------------------------------------------------------------


@dataclass(frozen=True)
class Moments:
    r"""Mean and sum of squared deviations of n values, one or many at a time.

    A value x changes the mean m and the sum M of squared deviations by

    .. math:: d = x - m, \quad m' = m + d/n', \quad M' = M + d\,(x - m'),

    and two sets merge by

    .. math:: m = m_a + \delta\,n_b/n, \quad M = M_a + M_b + \delta^2 n_a n_b/n, \quad \delta = m_b - m_a:

    no large numbers are subtracted, so that M keeps its digits where the naive sum of squares minus n m^2 loses them all.

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
        """No values yet."""
        return Moments(0, np.zeros(shape), np.zeros(shape))

    @staticmethod
    def of(values: np.ndarray) -> Moments:
        """Moments of all values along the first axis."""
        v = np.asarray(values, dtype=np.float64)
        mean = v.mean(axis=0)
        return Moments(len(v), mean, ((v - mean) ** 2).sum(axis=0))

    def add(self, value: np.ndarray) -> Moments:
        """With one value more (Welford)."""
        x = np.asarray(value, dtype=np.float64)
        n = self.n + 1
        mean = self.mean + (x - self.mean) / n
        return Moments(n, mean, self.m2 + (x - self.mean) * (x - mean))

    def merge(self, other: Moments) -> Moments:
        """With all values of another set (Chan, Golub, LeVeque)."""
        n = self.n + other.n
        if n == 0:
            return self
        delta = other.mean - self.mean
        mean = self.mean + delta * (other.n / n)
        return Moments(n, mean, self.m2 + other.m2 + delta**2 * (self.n * other.n / n))

    @property
    def variance(self) -> np.ndarray:
        """Unbiased variance of one value, M/(n - 1).

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


def pool(mean: np.ndarray, var: np.ndarray, tile: int) -> tuple[np.ndarray, np.ndarray]:
    """Average tiles of pixels, for estimators with heavy tails.

    A batch mean with rare bright samples is far from normal: seen rarely, both its mean and its variance are too small.
    The skewness of an average of k independent values falls as 1/sqrt(k), so tiles come nearer to the normal law than
    pixels; what is lost is the place of a bias smaller than a tile. Rows and columns that fill no tile are left out.

    Args:
        mean: (H, W, C).
        var: (H, W, C), of independent pixels (a box filter).
        tile: side of a tile [pixel].

    Returns:
        mean and variance of the mean, (H // tile, W // tile, C).
    """
    return _tiles(mean, tile).mean(axis=(1, 3)), _tiles(var, tile).sum(axis=(1, 3)) / tile**4


def _tiles(image: np.ndarray, tile: int) -> np.ndarray:
    """An image (H, W, C) as (rows of tiles, tile, columns of tiles, tile, C), without what fills no tile."""
    h, w, c = image.shape
    if tile < 1 or h < tile or w < tile:
        raise MivolError(f"tiles of {tile} pixels do not fit an image of {w}x{h}; choose 1 to {min(h, w)}.")
    cut = (h // tile, tile, w // tile, tile, c)
    return image[: cut[0] * tile, : cut[2] * tile].reshape(cut)


# -- Degrees of freedom ---------------------------------------------------------------------------


def effective_dof(variances: np.ndarray, dof: np.ndarray | float, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    r"""Degrees of freedom of a sum of independent estimated variances, by Welch and Satterthwaite.

    An estimate v of a variance with d degrees of freedom, of normal values, is :math:`E[v]\,\chi^2_d/d`: its own variance is
    :math:`2 E[v]^2/d`. The sum of independent ones has the mean :math:`\sum E[v_i]` and the variance
    :math:`\sum 2 E[v_i]^2/d_i`; a single scaled :math:`\chi^2_\nu` of the same mean and variance has

    .. math:: \nu = \frac{(\sum_i v_i)^2}{\sum_i v_i^2/d_i}

    with the estimates in the place of the expectations. Since :math:`E[v_i^2] = E[v_i]^2 (1 + 2/d_i)`, the denominator is
    estimated too large and :math:`\nu` too small: a t-test at it is cautious. k equal variances of d degrees have k d, one
    that outweighs all others has its own d.

    Args:
        variances: estimates, at least 0, in any common unit.
        dof: degrees of freedom of each; inf where a variance is known.
        axis: along which variances are added; all by default.

    Returns:
        float64 array; inf where no variance was estimated or all are 0.
    """
    v = np.asarray(variances, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Relative to the largest: squares of variances below 1e-154 would be 0 in float64.
        v = v / v.max(axis=axis, keepdims=True)
        nu = v.sum(axis=axis) ** 2 / (v**2 / dof).sum(axis=axis)
    return np.where(np.isnan(nu), np.inf, nu)


def pooled_dof(var: np.ndarray, dof: float, tile: int) -> np.ndarray:
    """Degrees of freedom of the variances that :func:`pool` gives, (H // tile, W // tile, C).

    Args:
        var: (H, W, C), of independent pixels.
        dof: of the variance of one pixel.
        tile: side of a tile [pixel].
    """
    return effective_dof(_tiles(var, tile), dof, axis=(1, 3))


# -- Tests ----------------------------------------------------------------------------------------


def _sidak(alpha: float, m: int) -> float:
    # 1 - (1 - alpha)^(1/m) by expm1 and log1p: the difference of numbers near 1 would keep no digit at alpha/m < 1e-16.
    return float(-np.expm1(np.log1p(-alpha) / m))


# Level of one of m comparisons so that the family raises a false alarm with chance alpha. Sidak is exact for independent
# comparisons (and safe for any jointly normal ones, two-sided); Bonferroni is safe for all.
FAMILIES: dict[str, Callable[[float, int], float]] = {
    "sidak": _sidak,
    "bonferroni": lambda alpha, m: alpha / m,
}


def level_of_one(alpha: float, comparisons: int, family: str = "sidak") -> float:
    """Chance of a false alarm that each of many comparisons may have.

    Raises:
        MivolError: alpha outside (0, 1), no comparison, or a family that is not in ``FAMILIES``.
    """
    if not 0 < alpha < 1 or comparisons < 1:
        raise MivolError(f"alpha = {alpha} over {comparisons} comparisons; expected 0 < alpha < 1 and at least 1.")
    if family not in FAMILIES:
        raise MivolError(f'unknown family "{family}"; known are: {", ".join(FAMILIES)}.')
    return FAMILIES[family](alpha, comparisons)


def z_bound(alpha: float, comparisons: int = 1, dof: np.ndarray | float = np.inf, family: str = "sidak") -> np.ndarray:
    """Two-sided bound on |z| that a family of comparisons exceeds with chance alpha.

    Args:
        alpha: chance of a false alarm of the whole family.
        comparisons: how many.
        dof: degrees of freedom of the variance; inf where it is known (normal), else Student's t.
        family: key of ``FAMILIES``.
    """
    tail = level_of_one(alpha, comparisons, family) / 2
    dof = np.asarray(dof, dtype=np.float64)
    normal = -NormalDist().inv_cdf(tail)
    if np.all(np.isinf(dof)):
        return np.full(dof.shape, normal)
    from scipy.special import stdtrit

    return np.where(np.isinf(dof), normal, -stdtrit(np.where(np.isinf(dof), 1.0, dof), tail))


def _welch(var_a: np.ndarray, dof_a: np.ndarray | float, var_b: np.ndarray, dof_b: np.ndarray | float) -> np.ndarray:
    """Degrees of freedom of the variance of a difference."""
    dof = np.stack(np.broadcast_arrays(dof_a, dof_b, var_a)[:2]).astype(np.float64)
    return effective_dof(np.stack([var_a, var_b]), dof, axis=0)


def z_image(
    a: np.ndarray, var_a: np.ndarray, b: np.ndarray, var_b: np.ndarray | float = 0.0, rounding: float = 0.0
) -> np.ndarray:
    """Difference in standard errors, (a - b)/sqrt(var_a + var_b + rounding^2).

    Args:
        a, b: means.
        var_a, var_b: variances of the means; 0 for an exact answer.
        rounding: what float32 arithmetic alone may cause, as one standard deviation in units of ``a``.

    Returns:
        float64 array; 0 where the means are equal, infinite where they differ without any variance.
    """
    difference = np.asarray(a, dtype=np.float64) - b
    variance = np.broadcast_to(np.asarray(var_a, dtype=np.float64) + var_b + rounding**2, difference.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = difference / np.sqrt(variance)
    return np.where(difference == 0, 0.0, z)


def assert_same_mean(
    a: np.ndarray,
    var_a: np.ndarray,
    b: np.ndarray,
    var_b: np.ndarray | float = 0.0,
    *,
    alpha: float = 1e-6,
    dof_a: np.ndarray | float = np.inf,
    dof_b: np.ndarray | float = np.inf,
    comparisons: int | None = None,
    tile: int = 1,
    rounding: float = 0.0,
    family: str = "sidak",
    what: str = "the means",
) -> None:
    """Raise unless two images have the same mean, each pixel by a z-test (or t-test) at a level that alpha pays for.

    Args:
        a, b: means; any shape, (H, W, C) where ``tile`` is above 1.
        var_a, var_b: variances of the means.
        alpha: chance that this call raises although the means agree.
        dof_a, dof_b: degrees of freedom of each estimated variance, one less than the batches behind it (or what
            :func:`effective_dof` gives for a sum; an array only where ``tile`` is 1): Student's t with Welch's degrees of
            freedom takes the place of the normal law. Infinite: the variance is exact.
        comparisons: how many comparisons share alpha; by default the pixels of this image. Give more where several
            images are tested for one alpha.
        tile: average tiles of so many pixels first; for heavy tails, see :func:`pool`. The variance of a tile has the
            degrees of freedom of all its pixels, :func:`pooled_dof`.
        rounding: see :func:`z_image`.
        family: key of ``FAMILIES``.
        what: subject of the sentence.

    Raises:
        AssertionError: which pixel differs, by how many standard errors, the bound, how many differ, and the smallest bias
            that this test would find nine times in ten.
        MivolError: a value that is not finite, or a negative variance: nothing can be said then.
    """
    a, b, var_a, var_b, dof = _prepared(a, var_a, b, var_b, dof_a, dof_b, tile)
    m = comparisons or max(a.size, 1)
    z = z_image(a, var_a, b, var_b, rounding)
    bound = z_bound(alpha, m, dof, family)
    beyond = np.abs(z) > bound
    if not beyond.any():
        return
    worst = np.unravel_index(np.argmax(np.where(beyond, np.abs(z) / bound, 0)), z.shape)
    power = smallest_detectable_bias(var_a, var_b, alpha=alpha, comparisons=m, dof=dof)
    raise AssertionError(
        f"{what} differ at {tuple(int(i) for i in worst)}: {a[worst]:.8g} and {b[worst]:.8g}, {z[worst]:+.2f} standard "
        f"errors, bound {bound[worst]:.2f} (alpha {alpha:g} over {m} comparisons); {beyond.sum()} of {z.size} beyond it; "
        f"a bias of {np.median(power):.2g} is found 9 times in 10."
    )


def p_value(
    a: np.ndarray,
    var_a: np.ndarray,
    b: np.ndarray,
    var_b: np.ndarray | float = 0.0,
    *,
    dof_a: np.ndarray | float = np.inf,
    dof_b: np.ndarray | float = np.inf,
    comparisons: int | None = None,
    tile: int = 1,
    rounding: float = 0.0,
) -> float:
    """Chance that means that agree differ as much as these do somewhere: the alpha at which :func:`assert_same_mean` turns.

    Args: see :func:`assert_same_mean`; many comparisons by Sidak's formula.
    """
    from scipy.special import ndtr, stdtr

    a, b, var_a, var_b, dof = _prepared(a, var_a, b, var_b, dof_a, dof_b, tile)
    z = np.abs(z_image(a, var_a, b, var_b, rounding))
    tail = 2 * np.where(np.isinf(dof), ndtr(-z), stdtr(np.where(np.isinf(dof), 1.0, dof), -z))
    return float(-np.expm1((comparisons or max(a.size, 1)) * np.log1p(-np.min(tail, initial=1.0).clip(max=1 - 1e-16))))


def _prepared(a, var_a, b, var_b, dof_a, dof_b, tile: int) -> tuple[np.ndarray, ...]:
    """Means and variances of pixels or tiles, and the degrees of freedom of the variance of their difference."""
    a, b, var_a, var_b = _checked(a, b, var_a, var_b)
    if tile > 1:
        dof_a, dof_b = pooled_dof(var_a, dof_a, tile), pooled_dof(var_b, dof_b, tile)
        (a, var_a), (b, var_b) = pool(a, var_a, tile), pool(b, var_b, tile)
    return a, b, var_a, var_b, _welch(var_a, dof_a, var_b, dof_b)


def _checked(a, b, var_a, var_b) -> tuple[np.ndarray, ...]:
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if b.ndim and a.shape != b.shape:
        raise MivolError(f"images of shape {a.shape} and {b.shape} cannot be compared; render both at one size.")
    arrays = np.broadcast_arrays(a, b, np.asarray(var_a, dtype=np.float64), np.asarray(var_b, dtype=np.float64))
    for name, array in zip(("first mean", "second mean", "first variance", "second variance"), arrays, strict=True):
        bad = ~np.isfinite(array) | (array < 0 if "variance" in name else False)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            raise MivolError(f"the {name} is {array[where]} at {where}; nothing can be tested with it.")
    return tuple(arrays)


def bounded_p_value(mean: np.ndarray, n: int, truth: np.ndarray, low: float = 0.0, high: float = 1.0) -> np.ndarray:
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
        low, high: bounds of one sample, for instance 0 and the radiance of the background.

    Returns:
        Upper bound of the p-value, in [0, 1]; 0 where the truth is a bound and the mean is not.
    """
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
    low: float = 0.0,
    high: float = 1.0,
    alpha: float = 1e-6,
    comparisons: int | None = None,
    what: str = "the means",
) -> None:
    """Raise unless means of n bounded samples agree with an exact answer: no normality, no estimated variance.

    Args and bound: see :func:`bounded_p_value`; alpha and comparisons: see :func:`assert_same_mean`.

    Raises:
        AssertionError: which pixel differs and how unlikely that is.
    """
    p = np.atleast_1d(bounded_p_value(mean, n, truth, low, high))
    m = comparisons or p.size
    level = level_of_one(alpha, m)
    if not (p < level).any():
        return
    worst = np.unravel_index(np.argmin(p), p.shape)
    x, t = (np.broadcast_to(v, p.shape)[worst] for v in (mean, truth))
    raise AssertionError(
        f"{what} differ at {tuple(int(i) for i in worst)}: {x:.8g} for {t:.8g} after {n} samples, p < {p[worst]:.2g} "
        f"(level {level:.2g}: alpha {alpha:g} over {m} comparisons); {(p < level).sum()} of {p.size} beyond it."
    )


# -- Power ----------------------------------------------------------------------------------------


def smallest_detectable_bias(
    var_a: np.ndarray,
    var_b: np.ndarray | float = 0.0,
    *,
    alpha: float = 1e-6,
    comparisons: int = 1,
    power: float = 0.9,
    dof: np.ndarray | float = np.inf,
) -> np.ndarray:
    """Bias that a two-sided z-test finds with chance ``power``: (z_alpha + z_power) standard errors.

    The test fires when |difference| > z_alpha s; with a bias b the difference is normal about b, and exceeds z_alpha s with
    chance Phi(b/s - z_alpha) (the other tail is below alpha/2): b = (z_alpha + Phi^-1(power)) s. With ``dof`` degrees of
    freedom z_alpha is the bound of Student's t, and b what is found in the mean over estimates of s.
    """
    if not 0 < power < 1:
        raise MivolError(f"power = {power}; expected a chance between 0 and 1.")
    s = np.sqrt(np.asarray(var_a, dtype=np.float64) + var_b)
    return (z_bound(alpha, comparisons, dof) + NormalDist().inv_cdf(power)) * s


def batches_for(
    wanted_bias: float, variance: float, *, alpha: float = 1e-6, comparisons: int = 1, power: float = 0.9
) -> int:
    """Batches (or samples) so that a bias worth catching is caught: variance ((z_alpha + z_power)/bias)^2, rounded up.

    Args:
        wanted_bias: smallest bias worth catching, above 0.
        variance: of one batch (or sample).
    """
    if not wanted_bias > 0:
        raise MivolError(f"a bias of {wanted_bias} cannot be looked for; give one above 0.")
    one = float(smallest_detectable_bias(variance, alpha=alpha, comparisons=comparisons, power=power))
    return max(1, int(np.ceil((one / wanted_bias) ** 2)))


@dataclass(frozen=True)
class Bias:
    """Mean difference of two images, with its confidence interval.

    Attributes:
        value: mean over pixels and channels of a - b.
        standard_error: of ``value``.
        low, high: ends of the interval that misses the true bias with chance ``alpha``.
    """

    value: float
    standard_error: float
    low: float
    high: float
    alpha: float


def bias(
    a: np.ndarray,
    var_a: np.ndarray,
    b: np.ndarray,
    var_b: np.ndarray | float = 0.0,
    *,
    alpha: float = 1e-3,
    correlated: int = 1,
    dof_a: float = np.inf,
    dof_b: float = np.inf,
) -> Bias:
    """Mean difference of two images: finds a bias too small for any one pixel to show.

    Args:
        dof_a, dof_b: degrees of freedom of each pixel's variance, one less than the batches behind it; their sum has as
            many as :func:`effective_dof` says, of which ``correlated`` pixels share each one.
        correlated: how many values share samples with any one, itself included (1: box filter and grey noise; a filter of
            radius r pixels: at most (2 floor(2 r) + 1)^2 pixels; times 3 where the channels share paths). The variance of
            the sum is at most ``correlated`` times the sum of variances, since Cov(i, j) <= (v_i + v_j)/2.
    """
    a, b, var_a, var_b = _checked(a, b, var_a, var_b)
    value = float((a - b).mean())
    error = float(np.sqrt(correlated * (var_a + var_b).sum()) / a.size)
    spread = effective_dof(np.stack([var_a, var_b]), np.reshape([dof_a, dof_b], (2,) + (1,) * a.ndim))
    half = float(z_bound(alpha, dof=spread / correlated)) * error
    return Bias(value, error, value - half, value + half, alpha)


# -- Distances between images and between volumes -------------------------------------------------


def _rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(a, dtype=np.float64) - b) ** 2)))


def psnr(image: np.ndarray, truth: np.ndarray, peak: float | None = None) -> float:
    """Peak signal to noise ratio, 20 log10(peak / RMSE) [dB]; infinite for equal images.

    Args:
        peak: the largest value of a signal; by default the truth's.

    Raises:
        MivolError: the peak is not above 0.
    """
    peak = float(np.max(truth)) if peak is None else peak
    if not peak > 0:
        raise MivolError(f"a peak of {peak} leaves no signal to compare the noise with; give the largest value expected.")
    error = _rms(image, truth)
    return float("inf") if error == 0 else float(20 * np.log10(peak / error))


def nrmse(x: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error divided by the root mean square of the truth: |x - truth| / |truth|.

    (Some divide by the range of the truth instead, which makes the number of a mostly empty volume several times smaller.)

    Raises:
        MivolError: the truth is 0 everywhere.
    """
    norm = float(np.linalg.norm(np.asarray(truth, dtype=np.float64)))
    if norm == 0:
        raise MivolError("the truth is 0 everywhere; a relative error has no meaning there.")
    return float(np.linalg.norm(np.asarray(x, dtype=np.float64) - truth)) / norm


def ssim(image: np.ndarray, truth: np.ndarray, peak: float | None = None) -> float:
    """Structural similarity (Wang et al. 2004, IEEE TIP 13), by scikit-image, mean over channels; 1 for equal images.

    The window is the paper's, 11 x 11 pixels with Gaussian weights of standard deviation 1.5, wholly inside the image.

    Raises:
        MivolError: the image is smaller than the window.
    """
    from skimage.metrics import structural_similarity  # slow to import

    truth = np.asarray(truth, dtype=np.float64)
    if min(truth.shape[:2]) < 11:
        raise MivolError(f"an image of {truth.shape[1]}x{truth.shape[0]} is smaller than the 11 pixel window of SSIM.")
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    peak = float(truth.max()) if peak is None else peak
    axis = 2 if truth.ndim == 3 else None
    return float(structural_similarity(np.asarray(image, np.float64), truth, data_range=peak, channel_axis=axis, **window))
