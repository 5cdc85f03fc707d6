r"""Phase functions of droplets and dust by Mie's theory, averaged over their sizes.

.. math:: p(\theta) = \frac{\int n(r)\,r^2 Q_{sca}(r)\,p_r(\theta)\,dr}{\int n(r)\,r^2 Q_{sca}(r)\,dr}

Conventions. Lengths in micrometres; unpolarised light; the refractive index is relative to the surroundings and its imaginary
part, of either sign, absorbs. The theory itself is ``miepython``'s, an optional package.

References: Bohren & Huffman, Absorption and Scattering of Light by Small Particles (1983), chapter 4. Size distribution of
droplets: Hansen & Travis 1974 (Space Science Reviews 16), the gamma distribution by effective radius a and variance b,
n(r) ~ r^((1 - 3 b)/b) exp(-r/(a b)).
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
from scipy.special import gammainccinv, gammaincinv

from mivol.errors import MivolError
from mivol.phase.tabulated import Table, adapt_nodes

__all__ = ["WATER_INDEX", "aerosol", "water_droplets"]

WATER_INDEX = 1.333
"""Refractive index of water in the middle of the visible; what it absorbs there does not change the shape."""

RADII = 128
"""Gauss-Legendre nodes over the radii; the resonances of single droplets are narrower and average out."""


CUT = 1e-7
"""Share of a distribution that is left out at each end."""


def water_droplets(
    effective_radius: float,
    effective_variance: float = 0.1,
    wavelength: float = 0.55,
    index: complex = WATER_INDEX,
    tolerance: float = 5e-3,
) -> Table:
    """Cloud and fog droplets: a gamma distribution of radii.

    Args:
        effective_radius: mean radius weighted by area [micrometre]; fog and clouds have 3 to 20.
        effective_variance: its relative variance, above 0 and below 1/2; clouds have about 0.1.
        wavelength: in the surroundings [micrometre].
        index: refractive index relative to the surroundings.
        tolerance: how far a line between nodes may miss the function, as a part of it.

    Raises:
        MivolError: a size, variance or wavelength that cannot be, or ``miepython`` is not installed.

    Cost: about 0.02 s per micrometre of radius.
    """
    _check_positive(effective_radius=effective_radius, wavelength=wavelength, tolerance=tolerance)
    if not 0 < effective_variance < 0.5:
        raise MivolError(f"effective_variance is {effective_variance}; a number above 0 and below 0.5 is expected.")
    # The area r^2 n(r) is a gamma distribution of shape 1/b and mean a; what small droplets scatter counts r^4 more.
    shape, scale = 1 / effective_variance, effective_radius * effective_variance
    low, high = gammaincinv(shape, CUT) * scale, gammainccinv(shape + 4, CUT) * scale
    return _average(lambda r: (shape - 1) * np.log(r) - r / scale, low, high, wavelength, index, tolerance)


def aerosol(
    median_radius: float, geometric_deviation: float, index: complex, wavelength: float = 0.55, tolerance: float = 5e-3
) -> Table:
    """Dust, smoke, haze: a lognormal distribution of radii.

    Args:
        median_radius: half the particles are smaller [micrometre].
        geometric_deviation: exp of the standard deviation of log r, above 1; 1.5 to 2.2 is usual.
        index: refractive index relative to the surroundings, for instance 1.53 - 0.006j for dust.
        wavelength: in the surroundings [micrometre].
        tolerance: how far a line between nodes may miss the function, as a part of it.

    Raises:
        MivolError: a size, deviation or wavelength that cannot be, or ``miepython`` is not installed.
    """
    _check_positive(median_radius=median_radius, wavelength=wavelength, tolerance=tolerance)
    if not geometric_deviation > 1:
        raise MivolError(f"geometric_deviation is {geometric_deviation}; a number above 1 is expected.")
    s = np.log(geometric_deviation)
    # r^2 n(r) is lognormal about log(median) + 2 s^2; what small particles scatter counts r^4 more, about + 6 s^2.
    low, high = (median_radius * np.exp(k) for k in (2 * s * s - 5 * s, 6 * s * s + 5 * s))
    return _average(
        lambda r: np.log(r) - 0.5 * (np.log(r / median_radius) / s) ** 2, low, high, wavelength, index, tolerance
    )


def _average(
    log_area: Callable[[np.ndarray], np.ndarray], low: float, high: float, wavelength: float, index: complex, tolerance: float
) -> Table:
    """The table of spheres with radii between two; ``log_area`` is the logarithm of r^2 n(r), up to a constant."""
    mie = _miepython()
    nodes, weights = np.polynomial.legendre.leggauss(RADII)
    radii = np.exp(0.5 * (np.log(high) + np.log(low) + nodes * np.log(high / low)))
    sizes = 2 * np.pi * radii / wavelength
    _, q_sca, _, _ = mie.efficiencies_mx(index, sizes)
    log_share = log_area(radii) + np.log(radii)  # equal steps of log r
    share = weights * np.exp(log_share - log_share.max()) * q_sca
    share /= share.sum()
    kept = share > 1e-7 * share.max()

    def density(cosines: np.ndarray) -> np.ndarray:
        parts = (s * mie.i_unpolarized(index, x, cosines, norm="one") for s, x in zip(share[kept], sizes[kept], strict=True))
        return sum(parts, np.zeros(len(cosines)))

    cosines, values = adapt_nodes(density, tolerance, least=65)
    return Table(cosines, values, "the Mie table")


def _check_positive(**given: float) -> None:
    for name, value in given.items():
        if not (np.isfinite(value) and value > 0):
            raise MivolError(f"{name} is {value}; a finite number above 0 is expected.")


def _miepython() -> ModuleType:
    try:
        import miepython
    except ImportError as error:
        raise MivolError(
            f'Mie phase functions need miepython, which cannot be imported ({error}): pip install "mivol[mie]"'
        ) from error
    return miepython
