"""Henyey-Greenstein, Rayleigh and Draine phase functions: values, moments and inversion in float64."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, U, as64, cosines_of, f32, integrals, lanes, turns

from mivol.errors import MivolError
from mivol.phase.closed_forms import (
    droplets,
    eval_draine,
    eval_hg,
    eval_rayleigh,
    mean_cosine,
    sample_draine,
    sample_hg,
    sample_rayleigh,
)
from mivol.phase.domain import NEXT_TO_ONE
from mivol.phase.scattering_angle import ScatteringAngle

pytestmark = pytest.mark.usefixtures("variant_rgb")


SMALL = (1e-7, 1e-5, 1e-3)


LARGE = (0.2, 0.6, 0.9, 0.99, 0.9999, 0.99999, NEXT_TO_ONE)


ALL_G = (0.0, *SMALL, *LARGE, *(-g for g in SMALL), *(-g for g in LARGE))


@pytest.mark.parametrize("g", ALL_G)
def test_hg_values(g):
    turn, m, p = turns()
    got, want = as64(eval_hg(turn, mi.Float(g))), oracle.hg(m, p, f32(g))
    # 1 - a is exact; D has 3 roundings and enters to the power 3/2, the quotient and root add 4 (a reciprocal of Dr.Jit has 2).
    assert np.max(np.abs(got / want - 1)) <= 6 * EPS


@pytest.mark.parametrize("g", [0.0, 1e-7, 1e-3, 0.5, -0.5, 0.9, -0.9])
def test_moments_of_hg(g):
    """Normalised, mean cosine g, <cos^2> = (1 + 2 g^2)/3, <cos^3> = (3 g + 2 g^3)/5; physics.md 4.9."""
    # 400 nodes: the error falls as the ellipse of convergence, (1/g)^800, < 1e-36. Left are the roundings of the values, and
    # those of the node in the peak, eps/2 of 1 - c = (1 - g), with slope 3/(1 - g)^2.
    tolerance = 10 * EPS / (1 - abs(g))
    want = [1, g, (1 + 2 * g * g) / 3, (3 * g + 2 * g**3) / 5]
    assert np.max(np.abs(integrals(lambda t: eval_hg(t, mi.Float(g))) - want)) <= tolerance


def test_legendre_moments_and_backscatter_of_hg():
    g = 0.7
    c, w = oracle.gauss(400)
    values = as64(eval_hg(ScatteringAngle(*lanes(1 - c, 1 + c)), mi.Float(g))) * 2 * np.pi * w
    moments = [(values * np.polynomial.legendre.Legendre.basis(k)(c)).sum() for k in range(10)]
    assert np.max(np.abs(moments - g ** np.arange(10.0))) <= 40 * EPS
    c, w = (c - 1) / 2, w / 2
    back = (as64(eval_hg(ScatteringAngle(*lanes(1 - c, 1 + c)), mi.Float(g))) * 2 * np.pi * w).sum()
    assert back == pytest.approx((1 - g) / (2 * g) * ((1 + g) / np.sqrt(1 + g * g) - 1), rel=10 * EPS)


@pytest.mark.parametrize("g", ALL_G)
def test_inversion_of_hg(g):
    """The probability of a smaller cosine than the sample is u, and of a larger cosine 1 - u, both to a few roundings."""
    turn = sample_hg(*lanes(U), mi.Float(g))
    m, p = as64(turn.below_one), as64(turn.above_minus_one)
    assert np.all(np.isfinite(m) & np.isfinite(p) & (m >= 0) & (p >= 0))
    below, above = oracle.hg_below(m, p, f32(g))
    # m and p are right to 4e-7 of themselves (physics.md 2.7). A chance has the slope 1 (d log / d log) in the one that is
    # small with it, and at most 1/2 and 1/2 in the other, through q: 8e-7 of the chance.
    small = U < 0.5
    assert np.all(np.abs(below[small] - U[small]) <= 8e-7 * U[small])
    assert np.all(np.abs(above[~small] - (1 - U[~small])) <= 8e-7 * (1 - U[~small]))
    assert np.max(np.abs(as64(turn.sin) ** 2 - m * p)) <= 2 * EPS


def test_rayleigh_values():
    turn, m, p = turns()
    assert np.max(np.abs(as64(eval_rayleigh(turn)) / oracle.rayleigh((p - m) / 2) - 1)) <= 3 * EPS


def test_inversion_of_rayleigh():
    c = cosines_of(sample_rayleigh(*lanes(U)))
    # F = (c^3 + 3 c + 4)/8 with slope 3/4 at most, and c to 3 roundings of 1.
    assert np.max(np.abs((c**3 + 3 * c + 4) / 8 - U)) <= 3 * EPS


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0, 27.0, 1e4])
@pytest.mark.parametrize("g", [0.0, 1e-7, 0.6, -0.6, 0.99, 0.99999])
def test_draine_values(g, alpha):
    turn, m, p = turns()
    got, want = as64(eval_draine(turn, mi.Float(g), mi.Float(alpha))), oracle.draine(m, p, f32(g), f32(alpha))
    # As Henyey-Greenstein's, and 1 + alpha c^2 with a rounded c (relative error: that of c^2 at most), over a rounded norm.
    assert np.max(np.abs(got / want - 1)) <= 10 * EPS


def test_draine_has_henyey_greenstein_rayleigh_and_cornette_shanks_as_cases():
    turn, m, p = turns()
    c = (p - m) / 2
    assert np.array_equal(as64(eval_draine(turn, mi.Float(0.7), mi.Float(0))), as64(eval_hg(turn, mi.Float(0.7))))
    got = as64(eval_draine(turn, mi.Float(0), mi.Float(1)))
    assert np.max(np.abs(got / as64(eval_rayleigh(turn)) - 1)) <= 4 * EPS
    g = f32(0.6)
    shanks = 3 / (8 * np.pi) * (1 - g * g) * (1 + c * c) / ((2 + g * g) * (1 + g * g - 2 * g * c) ** 1.5)
    assert np.max(np.abs(as64(eval_draine(turn, mi.Float(0.6), mi.Float(1))) / shanks - 1)) <= 10 * EPS


@pytest.mark.parametrize("g", [0.0, 1e-7, 0.3, 0.9, 0.99999, -0.3, -0.99])
@pytest.mark.parametrize("alpha", [0.0, 1.0, 27.0, 1e4, 1e9])
def test_inversion_of_draine(g, alpha):
    u = U[::5]
    turn = sample_draine(*lanes(u), mi.Float(g), mi.Float(alpha))
    m, p = as64(turn.below_one), as64(turn.above_minus_one)
    below = oracle.draine_below(m, p, f32(g), f32(alpha))
    # The polynomial in y has five terms of size up to 5, so u is met to about 10 roundings of 1.
    assert np.max(np.abs(below - u)) <= 10 * EPS


def test_droplets_of_jendersie_and_deon():
    """The mean cosine of the fit agrees with Mie's for clouds, 0.85 to 0.88; diameters outside the range are refused."""
    fit = droplets(20.0)
    share = fit["weight_draine"]
    g = (1 - share) * fit["g_hg"] + share * mean_cosine(fit["g_draine"], fit["alpha"])
    assert 0.85 < g < 0.89
    with pytest.raises(MivolError, match="5 to 50"):
        droplets(1.0)
