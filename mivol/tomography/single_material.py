"""Corrections that hold for an object of one material: phase contrast, beam hardening, scattered light.

*Phase.* Near the detector, light of one wavelength through a material of thickness t has the transmission (transport of
intensity) ``T = (1 - a laplacian) exp(-mu t)`` with ``a = distance delta / mu = distance (delta / beta) lambda / (4 pi)``. In
Fourier space the inverse divides by ``1 + a k^2``.

*Beam hardening.* Soft light is absorbed first, so line integrals y grow slower than the thickness. A polynomial of y, with a
slope of 1 at 0, is fitted to path lengths through the material.

References: Paganin et al. 2002, J. Microsc. 206, 33 (phase); Herman 1979, Phys. Med. Biol. 24, 81 (polynomials); Krumm, Kasperl
& Franz 2008, NDT & E Int. 41, 242 (path lengths from the object itself); Otsu 1979, IEEE Trans. Syst. Man Cybern. 9, 62.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dctn, idctn
from scipy.optimize import minimize_scalar

from mivol.errors import MivolError
from mivol.tomography.filtered import feldkamp, filtered_backprojection
from mivol.tomography.geometry import ParallelBeam
from mivol.tomography.preprocess import Transmission, interpolate_gaps, subtract_scatter
from mivol.tomography.projector import Projector

KEV_METRES = 1.239841984e-9
"""Energy [keV] times wavelength [m]: Planck's constant times the speed of light (CODATA 2018)."""


def phase_length(delta_beta: float, distance: float, energy: float) -> float:
    """The length ``sqrt(a)`` of Paganin's filter [m].

    Args:
        delta_beta: decrement of the refractive index over its absorption index.
        distance: object to detector [mm].
        energy: of the light [keV].
    """
    return float(np.sqrt(distance * 1e-3 * delta_beta * (KEV_METRES / energy) / (4 * np.pi)))


def filter_phase(
    transmission: Transmission, delta_beta: float, distance: float, energy: float, pixel: float
) -> tuple[Transmission, float]:
    """Remove the phase contrast of a single material (Paganin's filter); edges continue as mirror images.

    Args:
        transmission: (views, rows, cols); pixels that are not finite count as interpolated in their row, and stay unused.
        delta_beta, distance, energy: as in :func:`phase_length`.
        pixel: edge of a pixel at the object [um].

    Returns:
        The transmission ``exp(-mu t)``, whose variance is that of independent pixels after the filter; the length of the filter
        [pixel].

    Raises:
        MivolError: a filter shorter than a twentieth of a pixel, or longer than half of the detector.
    """
    value = transmission.value
    length = phase_length(delta_beta, distance, energy) / (pixel * 1e-6)
    longest = max(value.shape[1:]) / 2
    if not 0.05 <= length <= longest:
        raise MivolError(
            f"found a phase filter of {length:.3g} pixels, expected 0.05 to {longest:g}: data.phase has distance in mm, energy "
            "in keV and pixel in um."
        )
    seen = np.isfinite(value)
    filled = interpolate_gaps(np.where(seen, value, 0.0), seen)
    squares = [(np.pi * np.arange(n) / n) ** 2 for n in value.shape[1:]]
    factor = 1.0 / (1.0 + length**2 * (squares[0][:, None] + squares[1]))
    filtered = np.stack([idctn(factor * dctn(view, norm="ortho"), norm="ortho") for view in filled])
    variance = transmission.variance * float(np.mean(factor**2))
    return replace(transmission, value=np.where(seen, filtered, np.nan), variance=variance), length


LEAST_GAIN, LEAST_SLOPE = 0.05, 0.5
"""Share of the misfit that a correction removes at least, and the smallest slope of its polynomial. Light that hardens gives
slopes of 1 and more. In bodies of one material, fits to 3,000 quanta a pixel that lower the misfit have slopes of .65 and more.
In bodies of several materials, slopes fall to .04 to .2, and the errors of line integrals rise three- to fiftyfold."""


@dataclass(frozen=True, eq=False)
class Hardening:
    """A polynomial of line integrals, ``y + c_2 y^2 + c_3 y^3 + ...``, after the subtraction of scattered light.

    Attributes:
        coefficients: c_2, c_3, ...
        scatter: scattered light over the light without object.
        misfit: root mean square of the straightened line integrals less those of one material, over the same without the fit.
    """

    coefficients: np.ndarray
    scatter: float
    misfit: float

    @property
    def is_needed(self) -> bool:
        """Whether the fit makes line integrals straighter by more than ``LEAST_GAIN``."""
        return self.misfit < 1 - LEAST_GAIN

    def straighten(self, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Straightened line integrals and their weights; pixels darker than the scattered light get weight 0."""
        primary, weights = subtract_scatter(y, weights, self.scatter)
        slope = 1 + sum(k * c * primary ** (k - 1) for k, c in enumerate(self.coefficients, 2))
        return _evaluate(self.coefficients, primary), weights / slope**2


def fit_hardening(a: Projector, y: np.ndarray, weights: np.ndarray, degree: int, with_scatter: bool) -> Hardening:
    """Fit the polynomial to an object of one material by its own path lengths.

    Filtered back-projection and Otsu's threshold give the material, its projections the path lengths L. The coefficients
    minimise ``sum w (mu L - y - c_2 y^2 - ...)^2`` together with mu; the second of two rounds takes the threshold from
    straightened line integrals. Scattered light is the one with the least misfit. It bends line integrals as well, so that a
    polynomial of degree 3 or more can replace most of it: their joint effect is determined, their parts are not.

    Args:
        a: projector of a parallel beam or a circular cone beam.
        y: line integrals (views, rows, cols).
        weights: inverse variances.
        degree: of the polynomial, at least 2.
        with_scatter: whether scattered light is fitted.

    Raises:
        MivolError: a polynomial with a slope below ``LEAST_SLOPE`` that lowers the misfit, or no material.
    """
    method = filtered_backprojection if isinstance(a.geometry, ParallelBeam) else feldkamp
    found = Hardening(np.zeros(degree - 1), 0.0, 1.0)
    used = weights > 0
    for _ in range(2):
        x = method(a, interpolate_gaps(found.straighten(y, weights)[0], weights))
        paths = (a @ (x > _otsu(x)).astype(np.float32)).astype(float)
        if not paths.any():
            raise MivolError("found no material by its brightness, expected one: leave data.hardening out.")
        # Edges of voxels are wrong by up to a voxel: rays that graze the material do not count.
        inside = used & ((paths > 2 * min(a.grid.voxel_size)) | (paths == 0))
        highest = float(np.exp(-y[inside].max()))

        def fit(scatter: float, paths: np.ndarray = paths, inside: np.ndarray = inside) -> tuple[float, np.ndarray]:
            primary = -np.log(np.exp(-y[inside]) - scatter)
            design = np.stack([paths[inside], *(-(primary**k) for k in range(2, degree + 1))], 1)
            solution, *_ = np.linalg.lstsq(design, primary, rcond=None)
            # Per unit of mu: a polynomial that shrinks all values would fit better without being straighter.
            return float(np.sqrt(np.mean((design @ solution - primary) ** 2)) / solution[0]), solution[1:]

        scatter = 0.0
        if with_scatter:
            scatter = float(minimize_scalar(lambda s: fit(s)[0], bounds=(0.0, 0.95 * highest), method="bounded").x)
        misfit, coefficients = fit(scatter)
        primary = -np.log(np.exp(-y[inside]) - 0.0)
        line = np.linalg.lstsq(paths[inside][:, None], primary, rcond=None)[0][0]
        plain = float(np.sqrt(np.mean((paths[inside] * line - primary) ** 2)) / line)
        found = Hardening(coefficients, scatter, misfit / plain)
    top = np.linspace(0.0, -np.log(highest - scatter), 64)
    slope = float((np.diff(_evaluate(found.coefficients, top)) / np.diff(top)).min())
    if found.is_needed and slope < LEAST_SLOPE:
        raise MivolError(
            f"found a polynomial of degree {degree} whose slope falls to {slope:.2g}, expected at least {LEAST_SLOPE:g}, "
            "because light hardens in matter: leave data.hardening out for objects of several materials, or choose a smaller "
            "degree."
        )
    return found


def _evaluate(coefficients: np.ndarray, y: np.ndarray) -> np.ndarray:
    return y + sum(c * y**k for k, c in enumerate(coefficients, 2))


def _otsu(x: np.ndarray) -> float:
    """The threshold with the largest variance between both classes, of 256 bins."""
    if not x.max() > x.min():
        return float(x.max())
    counts, edges = np.histogram(x, 256)
    middles = (edges[1:] + edges[:-1]) / 2
    below, above = np.cumsum(counts)[:-1], np.cumsum(counts[::-1])[::-1][1:]
    sum_below, total = np.cumsum(counts * middles)[:-1], float((counts * middles).sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sum_below / below - (total - sum_below) / above) ** 2
    return float(edges[1:-1][int(np.nanargmax(between))])
