"""Running means and variances of independent batches, and averages over tiles of pixels.

Conventions. All numbers are float64. The variance of a mean is the squared standard error.

Source: Welford 1962 (Technometrics 4) and Chan, Golub, LeVeque 1983 (The American Statistician 37).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

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

    def merge(self, other: Moments) -> Moments:
        """Add all values of another set (Chan, Golub, LeVeque)."""
        n = self.n + other.n
        if n == 0:
            return self
        delta = other.mean - self.mean
        mean = self.mean + delta * (other.n / n)
        return Moments(n, mean, self.m2 + other.m2 + delta**2 * (self.n * other.n / n))

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
