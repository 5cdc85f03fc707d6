"""Mie phase functions, compared with small particles, a single size, and a float64 twin."""

from __future__ import annotations

import sys

import numpy as np
import oracle_phase as oracle
import pytest

from mivol.errors import MivolError
from mivol.phase import mie

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.fixture
def twin(monkeypatch):
    """Mie's theory from the book in place of miepython, which need not be installed."""
    monkeypatch.setitem(sys.modules, "miepython", oracle.Mie)
    return oracle.Mie


def test_mie_of_small_particles_is_rayleigh(twin, monkeypatch):
    monkeypatch.setattr(mie, "RADII", 16)
    table = mie.aerosol(1e-3, 1.05, 1.5, tolerance=1e-4)
    c = np.linspace(-1, 1, 101)
    # The next term is of relative size x^2 = (2 pi 1e-3 / 0.55)^2 = 1.3e-4; lines miss by 1e-4.
    assert np.max(np.abs(np.interp(c, table.cosines, table.density) / (2 * np.pi * oracle.rayleigh(c)) - 1)) <= 5e-4


def test_mie_of_one_size_is_the_theory(twin, monkeypatch):
    """A very narrow distribution is a single size: values and mean cosine of this sphere."""
    monkeypatch.setattr(mie, "RADII", 8)
    table = mie.aerosol(0.5, 1 + 1e-6, 1.5 - 0.01j, tolerance=1e-3)
    x = 2 * np.pi * 0.5 / 0.55
    want = 2 * np.pi * twin.i_unpolarized(1.5 - 0.01j, x, table.cosines, norm="one")
    # Chords lie off by 1e-3, so their integral does by less; sizes differ by 1e-5, times x.
    assert np.max(np.abs(table.density / want - 1)) <= 2e-3
    assert table.mean_cosine == pytest.approx(twin.efficiencies_mx(1.5 - 0.01j, np.array([x]))[3][0], abs=1e-3)


def test_droplets_of_a_cloud(twin, monkeypatch):
    """A forward peak, and the mean cosine of the sizes, weighted by their scattered light."""
    monkeypatch.setattr(mie, "RADII", 200)
    table = mie.water_droplets(2.0)
    r = np.linspace(0.05, 8, 200)
    _, q_sca, _, g = twin.efficiencies_mx(mie.WATER_INDEX, 2 * np.pi * r / 0.55)
    share = r ** (1 / 0.1 - 1) * np.exp(-r / (2.0 * 0.1)) * q_sca
    # Both sums step over narrow resonances; 128 radii against 1024 differ by 7e-4, and chords by 3e-4 (measured).
    assert table.mean_cosine == pytest.approx((share @ g) / share.sum(), abs=3e-3)
    assert table.density[-1] > 50 * np.interp(0.9, table.cosines, table.density)
    assert np.diff(table.cosines).min() > 0


def test_ends_of_a_lognormal_distribution():
    """Each end leaves out the fraction CUT: of the area r^2 n(r) below, and of the light of small particles, r^6 n(r),
    above.
    """
    median, s = 0.3, np.log(1.8)
    low, high = np.log(mie._ends_of_lognormal(median, s))

    def share(k, a, b):
        log_r = np.log(median) + s * np.linspace(-20, 30, 500001)
        weight = np.exp(k * log_r - 0.5 * ((log_r - np.log(median)) / s) ** 2)
        return weight[(log_r >= a) & (log_r <= b)].sum() / weight.sum()

    # The rectangle rule in steps of s / 10000 is exact but for the step in which the end lies: the hazard rate of a normal
    # distribution 5.2 deviations out is 5.4 a deviation, so that step holds 5.4e-4 of the share.
    assert share(2, -np.inf, low) == pytest.approx(mie.CUT, rel=1e-3)
    assert share(6, high, np.inf) == pytest.approx(mie.CUT, rel=1e-3)


def test_the_twin_is_miepython():
    """If miepython is installed, its coefficients equal those of the twin."""
    real = pytest.importorskip("miepython", reason='miepython is not installed: pip install "mivol[mie]"')
    for index, x in ((1.333 + 0j, 0.1), (1.5 - 0.01j, 10.0), (1.333 + 0j, 114.0)):
        ours, theirs = oracle.Mie.coefficients(index, x), np.atleast_2d(real.coefficients(index, x))
        n = min(ours.shape[1], theirs.shape[1])
        # Waves turn the other way round in miepython. One of them recurs upwards, which grows 1e-16 to 1e-10 (measured).
        assert np.max(np.abs(ours[:, :n] - theirs[:, :n].conj())) <= 1e-8


def test_without_miepython_there_is_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "miepython", None)
    with pytest.raises(MivolError, match=r'pip install "mivol\[mie\]"'):
        mie.water_droplets(5.0)


@pytest.mark.parametrize(
    "call",
    [
        lambda: mie.water_droplets(-1.0),
        lambda: mie.water_droplets(5.0, effective_variance=0.6),
        lambda: mie.aerosol(0.1, 0.9, 1.5),
        lambda: mie.aerosol(0.1, 1.5, 1.5, wavelength=np.nan),
        lambda: mie.aerosol(0.1, 1.5, 1.0),
        lambda: mie.aerosol(0.1, 1.5, -1.5 - 0.1j),
        lambda: mie.aerosol(1.0, 5.0, 1.5),
        lambda: mie.water_droplets(1000.0),
    ],
)
def test_particles_that_cannot_be_are_refused(twin, call):
    with pytest.raises(MivolError, match="expected"):
        call()
