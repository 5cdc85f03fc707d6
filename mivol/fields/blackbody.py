r"""The light of hot matter: Planck's law, and its colour for the human eye.

.. math:: B_\lambda(T) = \frac{c_1}{\lambda^5 \big(e^{c_2 / \lambda T} - 1\big)}, \qquad
          X = \int B_\lambda(T)\, \bar x(\lambda)\, d\lambda \quad \text{and so on}

By Kirchhoff's law B is the source function of absorbing matter, however thick: the ``emission`` of a ``mivol_medium`` whose
``sigma_a`` is the absorption of the matter.

Conventions. Temperatures are kelvin, wavelengths nm in vacuum, spectral radiance W m^-2 sr^-1 nm^-1. XYZ and linear sRGB are
integrals of spectral radiance over the CIE 1931 functions [W m^-2 sr^-1]; Y times 683 is luminance [cd m^-2]. An image needs an
exposure, a free factor. Arrays are float64.

References: Planck 1901; Kirchhoff 1860; CODATA 2018 (c_1 = 2 h c^2 / sr, c_2 = h c / k, exact); CIE 15:2004, table T.4
(matching functions, as stored in Mitsuba); IEC 61966-2-1 (sRGB).
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal

C1, C2 = 1.1910429723971884e20, 1.438776877503933e7
"""2 h c^2 [W nm^4 m^-2 sr^-1] and h c / k [nm K]."""

PEAK = 2.897771955e6
"""Wavelength of the largest spectral radiance times the temperature [nm K] (Wien's displacement law, CODATA 2018)."""

COLDEST = 100.0
"""Temperature [K] up to which a table has no light: the true radiance is below 1e-60 W m^-2 sr^-1."""

TABLE_SIZE = 4096
"""Temperatures of a table."""

LUMENS_PER_WATT = 683.0
"""Luminance [cd m^-2] of Y = 1 W m^-2 sr^-1 (683.002 of the present definition of the candela, to 3e-6)."""

XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])

CHUNK_SIZE = 1 << 14
"""Temperatures integrated at once: 64 MB at 1 nm."""


def planck(wavelength: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Spectral radiance of a black body.

    Args:
        wavelength: [nm], above 0.
        temperature: [K], at least 0; broadcast against the wavelengths.

    Returns:
        Spectral radiance [W m^-2 sr^-1 nm^-1]. Values below 1e-300 are 0, also at 0 K.

    Raises:
        MivolError: a temperature that is negative or not finite.
    """
    wavelength, temperature = np.asarray(wavelength, dtype=np.float64), _check_temperature(temperature)
    x = np.minimum(C2 / (wavelength * np.maximum(temperature, 1e-3)), 690.0)
    return np.where(x < 690, C1 / wavelength**5 / np.expm1(x), 0.0)


def blackbody_xyz(temperature: np.ndarray) -> np.ndarray:
    """CIE 1931 XYZ [W m^-2 sr^-1] of black bodies.

    Args:
        temperature: [K], any shape, at least 0.

    Returns:
        (..., 3) for temperatures of shape (...).

    Raises:
        MivolError: a temperature that is negative or not finite, or no active variant of Mitsuba.

    Error: 1e-4 at 1000 K and above, from the trapezium rule at 1 nm between 360 and 830 nm.
    """
    temperature = _check_temperature(temperature)
    nm, matching = weighted_matching_functions()
    flat = temperature.ravel()
    xyz = [planck(nm, flat[i : i + CHUNK_SIZE, None]) @ matching for i in range(0, flat.size, CHUNK_SIZE)]
    return np.concatenate(xyz).reshape(*temperature.shape, 3) if xyz else np.zeros((*temperature.shape, 3))


def blackbody_rgb(temperature: np.ndarray) -> np.ndarray:
    """Linear sRGB [W m^-2 sr^-1] of black bodies.

    Below 1900 K the blue of a black body lies outside sRGB, below 900 K also the green; these channels are clamped to 0.
    Elsewhere the luminance equals 683 times the Y of :func:`blackbody_xyz` [cd m^-2].

    Args:
        temperature: [K], any shape, at least 0.

    Raises:
        MivolError: as :func:`blackbody_xyz`.

    Example:
        >>> emission = blackbody_rgb(read_volume("temperature.vol").values[..., 0])  # (Z, Y, X, 3)
    """
    return np.maximum(blackbody_xyz(temperature) @ XYZ_TO_SRGB.T, 0)


def tabulated_rgb(temperature: np.ndarray, peak: bool = False) -> np.ndarray:
    """Linear sRGB of black bodies, as :func:`blackbody_rgb`, from a table: for grids of many millions of voxels.

    Args:
        temperature: [K], any shape, at least 0.
        peak: divide each spectrum by its largest value (Wien's displacement law), so that the colour counts and not the power
            [nm]: the result is the integral of a spectrum with the peak 1 over the matching functions.

    Returns:
        float32 (..., 3): 0 up to ``COLDEST``.

    Raises:
        MivolError: as :func:`blackbody_xyz`.

    Error: linear in 4096 steps up to the highest temperature T, 2e-4 of the radiance of T.
    """
    temperature = _check_temperature(temperature)
    highest = max(float(temperature.max(initial=0)), COLDEST)
    steps = np.linspace(0, highest, TABLE_SIZE)
    table = blackbody_rgb(steps)
    if peak:
        table[1:] /= planck(PEAK / steps[1:], steps[1:])[:, None]
    table[steps <= COLDEST] = 0
    place = temperature.ravel() * ((TABLE_SIZE - 1) / highest)
    at = np.minimum(place.astype(np.int64), TABLE_SIZE - 2)
    share = (place - at).astype(np.float32)[:, None]
    rows = table.astype(np.float32)
    return (rows[at] + share * (rows[at + 1] - rows[at])).reshape(*temperature.shape, 3)


@dataclass(frozen=True)
class HotMatter:
    """How temperatures of a grid become radiance: the temperature of a voxel is kelvin (value - offset), at least 0 K.

    Attributes:
        kelvin: temperature per unit of the grid [K].
        offset: value of the grid at 0 K.
        normalize: whether spectra are divided by their peaks.
        name: name of the plugin in messages.
    """

    kelvin: float
    offset: float
    normalize: bool
    name: str

    def emit(self, values: np.ndarray) -> np.ndarray:
        """Radiance (..., 3) of values (..., 1), float32.

        Raises:
            MivolError: values of another number of channels, NaN or infinite values.
        """
        if values.shape[-1] != 1:
            raise refusal(self.name, f"{values.shape[-1]} channels", "1, the temperature", "choose another grid of the file")
        temperature = self.kelvin * np.maximum(values[..., 0].astype(np.float64) - self.offset, 0)
        return tabulated_rgb(temperature, self.normalize)


def read_hot_matter(props: mi.Properties) -> HotMatter:
    """Read the parameters ``kelvin``, ``offset`` and ``normalize``.

    Raises:
        MivolError: a factor of 0 or below, or numbers that are not finite.
    """
    kelvin, offset, name = (
        float(props.get("kelvin", 1.0)),
        float(props.get("offset", 0.0)),
        f"mivol_blackbody {props.id()}".strip(),
    )
    if not (np.isfinite([kelvin, offset]).all() and kelvin > 0):
        found = f"kelvin {kelvin:g} and offset {offset:g}"
        raise refusal(name, found, "a factor above 0 and a finite offset", "correct them")
    return HotMatter(kelvin, offset, bool(props.get("normalize", False)), name)


def weighted_matching_functions() -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths (n,) [nm], and the matching functions times the quadrature weights (n, 3) [nm]."""
    if mi.variant() is None:
        raise MivolError("no variant of Mitsuba is active, which keeps the CIE tables; call mitsuba.set_variant first.")
    nm = np.arange(360.0, 831.0)
    weight = np.where((nm == nm[0]) | (nm == nm[-1]), 0.5, 1.0)
    if mi.variant().startswith("scalar"):
        functions = np.array([[float(v) for v in mi.cie1931_xyz(float(w))] for w in nm])
    else:
        functions = np.array(mi.cie1931_xyz(mi.Float(nm.astype(np.float32))), dtype=np.float64).T
    return nm, functions * weight[:, None]


def _check_temperature(temperature: np.ndarray) -> np.ndarray:
    temperature = np.asarray(temperature, dtype=np.float64)
    if not (np.isfinite(temperature) & (temperature >= 0)).all():
        raise MivolError(
            f"temperatures between {np.min(temperature):.4g} and {np.max(temperature):.4g} K were given; finite numbers of at "
            "least 0 are expected (is it degrees Celsius?)."
        )
    return temperature
