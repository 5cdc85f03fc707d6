"""Planck's law against Stefan-Boltzmann, Wien and Rayleigh-Jeans; its colours against the Planckian locus."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused
from scipy.constants import Boltzmann, Planck, Stefan_Boltzmann, Wien, speed_of_light

from mivol.fields.blackbody import LUMENS_PER_WATT, blackbody_rgb, blackbody_xyz, planck

TEMPERATURES = (200.0, 1000.0, 2856.0, 6500.0, 2e4)


@pytest.mark.parametrize("T", TEMPERATURES)
def test_stefan_boltzmann(T):
    """The integral over all wavelengths is sigma T^4 / pi."""
    x = np.linspace(np.log(0.02), np.log(2000), 4001)  # of c_2 / lambda T: what is left out is below 1e-5
    nm = 1.438776877e7 / (T * np.exp(x))
    total = np.trapezoid(planck(nm, T) * nm, x)
    assert total == pytest.approx(Stefan_Boltzmann * T**4 / np.pi, rel=1e-5)


@pytest.mark.parametrize("T", TEMPERATURES)
def test_wien(T):
    """The peak is at b / T."""
    nm = Wien / T * 1e9 * np.linspace(0.99, 1.01, 20001)
    assert nm[np.argmax(planck(nm, T))] == pytest.approx(Wien / T * 1e9, rel=2e-6)


def test_values():
    """Against the law in SI units, and Rayleigh-Jeans at long waves."""
    m, T = 550e-9, 1300.0
    expected = 2 * Planck * speed_of_light**2 / m**5 / np.expm1(Planck * speed_of_light / (m * Boltzmann * T)) * 1e-9
    assert planck(550.0, T) == pytest.approx(expected, rel=1e-9)
    assert planck(550.0, 0.0) == 0
    assert planck(1e9, 300.0) == pytest.approx(2 * speed_of_light * Boltzmann * 300 * 1e-9, rel=1e-4)


LOCUS = {1000: (0.6528, 0.3444), 2000: (0.5267, 0.4133), 2856: (0.4476, 0.4074), 6500: (0.3135, 0.3237)}
"""Chromaticities (x, y) of the Planckian locus (Wyszecki & Stiles 1982, table 1(3.11); 2856 K is CIE illuminant A)."""


@pytest.mark.parametrize("T", LOCUS)
def test_chromaticity(T, variant_rgb):
    """To the digits of the table, and of c_2, which was 1.4388 cm K then."""
    xyz = blackbody_xyz(np.array(float(T)))
    assert xyz[:2] / xyz.sum() == pytest.approx(LOCUS[T], abs=2e-4)


def test_luminance(variant_rgb):
    """Freezing platinum, 2041.4 K, once defined the candela: 60 cd cm^-2. A kelvin of it, which is what it is known to, is 0.7
    %."""
    assert LUMENS_PER_WATT * blackbody_xyz(np.array(2041.4))[1] == pytest.approx(60e4, rel=1e-2)


def test_any_temperature(variant_rgb):
    """From 0 K to 2e4 K: finite, not negative, growing, of any shape and size."""
    T = np.concatenate([[0.0, 1.0], np.geomspace(200, 2e4, 20000)])
    rgb = blackbody_rgb(T)
    assert np.isfinite(rgb).all() and rgb.min() >= 0 and not rgb[:2].any()
    assert np.all(np.diff(rgb[2:, 0]) > 0) and np.all(np.diff(rgb, axis=0) >= 0)
    assert blackbody_rgb(T[:60].reshape(3, 4, 5)).shape == (3, 4, 5, 3)
    # Sums over some 500 wavelengths in another order: float64 roundings of terms of the size of the largest channel.
    shaped = blackbody_rgb(T[:60].reshape(3, 4, 5)).reshape(-1, 3)
    assert np.all(np.abs(shaped - rgb[:60]) <= 1e-12 * rgb[:60].max(axis=1, keepdims=True))
    assert blackbody_rgb(np.zeros((0, 2))).shape == (0, 2, 3)


def test_bad_temperatures():
    for bad in (-3.0, np.nan, np.inf):
        assert_refused("Celsius", planck, 500.0, np.array([300.0, bad]))
