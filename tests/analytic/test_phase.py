"""Phase functions against float64 closed forms: values, moments, inversions, tables, mixtures, measured media.

eps is 2^-23. A float32 expression of k roundings is within k eps/2 of its float64 twin, where nothing cancels.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from phase_angles import EPS, cosines_of, integrals, lanes, uniforms

from mivol.phase.closed_forms import eval_draine, eval_rayleigh, mean_cosine, sample_draine, sample_hg, sample_rayleigh

pytestmark = pytest.mark.usefixtures("variant_rgb")


# -- Turns -----------------------------------------------------------------------------------------------------------------


# -- Values ----------------------------------------------------------------------------------------------------------------


def test_moments_of_rayleigh_and_draine():
    assert np.max(np.abs(integrals(eval_rayleigh) - [1, 0, 0.4, 0])) <= 4 * EPS
    for g, alpha in ((0.0, 1.0), (0.6, 1.0), (-0.6, 27.0), (0.8, 300.0)):
        got = integrals(lambda t, g=g, a=alpha: eval_draine(t, mi.Float(g), mi.Float(a)), 2)
        assert np.max(np.abs(got - [1, mean_cosine(g, alpha)])) <= 20 * EPS / (1 - abs(g))


# -- Samples ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [0.5, -0.8])
def test_mean_cosine_of_samples(g):
    n = 2**16
    # Midpoints of an integrand with second derivative below 2/(1 - g)^2 ... : n^-2 / 24 of it, 1e-9; and roundings of cos.
    for sample, want in (
        (sample_hg(*lanes(uniforms(n)), mi.Float(g)), g),
        (sample_draine(*lanes(uniforms(n)), mi.Float(g), mi.Float(5)), mean_cosine(g, 5.0)),
        (sample_rayleigh(*lanes(uniforms(n))), 0),
    ):
        assert cosines_of(sample).mean() == pytest.approx(want, abs=4 * EPS)


# -- Tables ----------------------------------------------------------------------------------------------------------------


# -- Mixtures --------------------------------------------------------------------------------------------------------------


# -- Domains ---------------------------------------------------------------------------------------------------------------


# -- Measured media ----------------------------------------------------------------------------------------------------------


# -- Mie -------------------------------------------------------------------------------------------------------------------
