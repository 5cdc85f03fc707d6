"""Phase functions in float64 NumPy, from the textbook; no Dr.Jit, no Mitsuba, nothing of mivol.

Conventions. A turn is (m, p) = (1 - cos, 1 + cos); densities are per steradian.
"""

from __future__ import annotations

import functools
import math

import numpy as np


@functools.cache
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss-Legendre quadrature over [-1, 1]."""
    return np.polynomial.legendre.leggauss(n)


def turns(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """1 - cos and 1 + cos of angles, without cancellation, rounded to what a float32 lane holds."""
    half = np.asarray(angles, dtype=np.float64) / 2
    return tuple((2 * f(half) ** 2).astype(np.float32).astype(np.float64) for f in (np.sin, np.cos))


def hg_d(m: np.ndarray, p: np.ndarray, g: float) -> np.ndarray:
    """1 + g^2 - 2 g cos as a sum of positive terms."""
    return (1 - g) ** 2 + 2 * g * m if g >= 0 else (1 + g) ** 2 - 2 * g * p


def hg(m: np.ndarray, p: np.ndarray, g: float) -> np.ndarray:
    """Henyey-Greenstein."""
    return (1 - g) * (1 + g) / (4 * math.pi * hg_d(m, p, g) ** 1.5)


def hg_slope(m: np.ndarray, p: np.ndarray, g: float) -> np.ndarray:
    """Its derivative by g."""
    d = hg_d(m, p, g)
    slope_of_d = 2 * m - 2 * (1 - g) if g >= 0 else 2 * (1 + g) - 2 * p
    return (-2 * g * d**-1.5 - 1.5 * (1 - g) * (1 + g) * slope_of_d * d**-2.5) / (4 * math.pi)


def hg_below(m: np.ndarray, p: np.ndarray, g: float) -> tuple[np.ndarray, np.ndarray]:
    """Chance of a smaller and of a larger cosine, each without cancellation.

    The integral (1 - g^2)/(2 g) [1/q - 1/(1 + g)], q = sqrt(D), with (1 + g)^2 - q^2 = 2 g (1 + cos) put in.
    """
    q = np.sqrt(hg_d(m, p, g))
    return (1 - g) * p / (q * (1 + g + q)), (1 + g) * m / (q * (1 - g + q))


def draine(m: np.ndarray, p: np.ndarray, g: float, alpha: float) -> np.ndarray:
    """Draine 2003."""
    c = (p - m) / 2
    return hg(m, p, g) * (1 + alpha * c * c) / (1 + alpha * (1 + 2 * g * g) / 3)


def rayleigh(c: np.ndarray) -> np.ndarray:
    """Rayleigh."""
    return 3 / (16 * math.pi) * (1 + c * c)


def draine_below(m: np.ndarray, p: np.ndarray, g: float, alpha: float) -> np.ndarray:
    """Chance of a smaller cosine, by Gauss-Legendre over the Henyey-Greenstein chance: the integrand is a smooth cos^2."""
    top, _ = hg_below(m, p, abs(g)) if g >= 0 else hg_below(p, m, abs(g))
    a = abs(g)
    nodes, weights = gauss(48)
    total = np.zeros_like(top)
    for low, high in zip(*(np.geomspace(1e-9, 1, 13)[s] - 1e-9 for s in (slice(None, -1), slice(1, None))), strict=True):
        v = top[:, None] * (low + (high - low) * (nodes + 1) / 2)
        s = 1 - a + 2 * a * v
        c = (2 * (1 + a) ** 2 * v * (1 - a + a * v) - 2 * (1 - a) ** 2 * (1 - v) * (1 + a * v)) / (2 * s * s)
        total += top * (high - low) / 2 * ((1 + alpha * c * c) @ weights)
    total /= (1 + alpha * (1 + 2 * a * a) / 3) * (1 - 1e-9)
    return total if g >= 0 else 1 - total


# -- Mie's theory --------------------------------------------------------------------------------------------------------


def mie_coefficients(index: complex, x: float) -> tuple[np.ndarray, np.ndarray]:
    """The coefficients a_n, b_n of a sphere of size parameter x (Bohren & Huffman 1983, chapter 4).

    The logarithmic derivative runs downwards and chi upwards, both stable; psi is Miller's downward recurrence.
    """
    index = complex(index.real, -abs(complex(index).imag)) if isinstance(index, complex) else complex(index)
    count = int(x + 4.05 * x ** (1 / 3) + 12)
    start = int(max(count, abs(index * x))) + 30
    d = np.zeros(start + 1, dtype=complex)
    z = index * x
    for n in range(start, 0, -1):
        d[n - 1] = n / z - 1 / (d[n] + n / z)
    psi = np.zeros(start + 2)
    psi[start] = 1e-200
    for n in range(start, 0, -1):
        psi[n - 1] = (2 * n + 1) / x * psi[n] - psi[n + 1]
        if abs(psi[n - 1]) > 1e200:
            psi[n - 1 :] *= 1e-200
    # psi_0 = sin x may be nearly 0; psi_1 = sin x / x - cos x is not small with it.
    true0, true1 = math.sin(x), math.sin(x) / x - math.cos(x)
    psi *= true0 / psi[0] if abs(true0) > abs(true1) else true1 / psi[1]
    chi = np.zeros(count + 1)
    chi[0], chi[1] = math.cos(x), math.cos(x) / x + math.sin(x)
    for n in range(1, count):
        chi[n + 1] = (2 * n + 1) / x * chi[n] - chi[n - 1]
    n = np.arange(1, count + 1)
    xi, xi_before = psi[n] - 1j * -chi[n], psi[n - 1] - 1j * -chi[n - 1]
    electric, magnetic = d[n] / index + n / x, d[n] * index + n / x
    a = (electric * psi[n] - psi[n - 1]) / (electric * xi - xi_before)
    b = (magnetic * psi[n] - psi[n - 1]) / (magnetic * xi - xi_before)
    return a, b


class Mie:
    """What mivol asks of ``miepython``, and more to compare with, under its names, written from the book."""

    @staticmethod
    def coefficients(index: complex, x: float) -> np.ndarray:
        """Rows a_n and b_n."""
        return np.array(mie_coefficients(index, x))

    @staticmethod
    def efficiencies_mx(index: complex, sizes: np.ndarray) -> tuple[np.ndarray, ...]:
        """Extinction, scattering and (not computed) backward efficiencies, and the mean cosine, of each size."""
        rows = []
        for x in np.atleast_1d(sizes):
            a, b = mie_coefficients(index, float(x))
            n = np.arange(1, len(a) + 1)
            ext = 2 / x**2 * ((2 * n + 1) * (a + b).real).sum()
            sca = 2 / x**2 * ((2 * n + 1) * (abs(a) ** 2 + abs(b) ** 2)).sum()
            k = n[:-1]
            cross = k * (k + 2) / (k + 1) * (a[:-1] * a[1:].conj() + b[:-1] * b[1:].conj()).real
            own = (2 * n + 1) / (n * (n + 1)) * (a * b.conj()).real
            rows.append((ext, sca, math.nan, 4 / x**2 * (cross.sum() + own.sum()) / sca))
        return tuple(np.array(rows).T)

    @staticmethod
    def i_unpolarized(index: complex, x: float, cosines: np.ndarray, norm: str) -> np.ndarray:
        """Scattered intensity of unpolarised light, whose integral over directions is 1."""
        assert norm == "one"
        a, b = mie_coefficients(index, float(x))
        s1, s2 = np.zeros((2, len(cosines)), dtype=complex)
        before, pi = np.zeros(len(cosines)), np.ones(len(cosines))
        for n in range(1, len(a) + 1):
            tau = n * cosines * pi - (n + 1) * before
            factor = (2 * n + 1) / (n * (n + 1))
            s1 += factor * (a[n - 1] * pi + b[n - 1] * tau)
            s2 += factor * (a[n - 1] * tau + b[n - 1] * pi)
            before, pi = pi, ((2 * n + 1) * cosines * pi - (n + 1) * before) / n
        sca = 2 / x**2 * ((2 * np.arange(1, len(a) + 1) + 1) * (abs(a) ** 2 + abs(b) ** 2)).sum()
        return (abs(s1) ** 2 + abs(s2) ** 2) / 2 / (math.pi * x**2 * sca)
