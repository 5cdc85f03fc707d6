"""Draine's phase function: values, special cases, inversion, and the fit to droplets."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, U, as64, f32, lanes, turns

from mivol.errors import MivolError
from mivol.phase.draine import droplets, eval_draine, mean_cosine, sample_draine
from mivol.phase.hg import eval_hg
from mivol.phase.rayleigh import eval_rayleigh

pytestmark = pytest.mark.usefixtures("variant_rgb")


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
    """The fit's mean cosine lies by Mie's for clouds, 0.85 to 0.88; outside its range it is refused."""
    fit = droplets(20.0)
    share = fit["weight_draine"]
    g = (1 - share) * fit["g_hg"] + share * mean_cosine(fit["g_draine"], fit["alpha"])
    assert 0.85 < g < 0.89
    with pytest.raises(MivolError, match="5 to 50"):
        droplets(1.0)
