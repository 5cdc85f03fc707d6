"""The quadrature of one cell in float64: exact for constant source functions, and linear emission in constant extinction."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.cell_quadrature import share_opacity, weigh_emission_density
from mivol.transport.traversal.interpolation import GAUSS_POINT

DT = 0.7
SIGMAS = np.array([0.0, 1e-6, 0.1, 1.0, 30.0, 1e5])
MOMENTS = 2e-5
"""What the moments E_n and the opacity may err by (mivol.numerics), relative."""


@pytest.mark.parametrize("ratio", [0.0, 0.5, 1.0, 7.0])
def test_a_constant_source_function_shows_the_opacity(ratio):
    """At every optical depth, and for every two extinctions; the relative error of the opacity is 4e-7."""
    shares = share_opacity(mi.Float64(DT), mi.Float64(SIGMAS), mi.Float64(ratio * SIGMAS))
    exact = -np.expm1(-0.5 * DT * (1 + ratio) * SIGMAS)
    np.testing.assert_allclose(np.array(shares.radiance(mi.Float64(3), mi.Float64(3))), 3 * exact, rtol=5e-7)
    np.testing.assert_allclose(sum(np.array(w) for w in shares.weights), exact, rtol=5e-7)
    assert all((np.array(w) >= 0).all() for w in shares.weights)


def test_the_first_point_counts_more_in_a_deep_cell():
    """(1 - f) / f is 1 / Q in constant extinction: 1 in a thin cell, and Q > 5 x^2 / 6 = 5 tau^2 / 18 in every cell."""
    shares = share_opacity(mi.Float64(DT), mi.Float64(SIGMAS), mi.Float64(SIGMAS))
    f, tau = np.array(shares.f), DT * SIGMAS
    assert f[0] == 0.5 and f[1] == pytest.approx(0.5, abs=tau[1])
    assert (np.diff(f) > 0).all()
    np.testing.assert_array_less((1 - f[1:]) / f[1:], 18 / (5 * tau[1:] ** 2))


def test_linear_emission_in_constant_extinction():
    r"""The two points represent the mean position of the light leaving the cell, so a linear density is exact.

    \int_0^D (1 + b t) exp(-s t) dt = (1 - exp(-s D)) / s + b (1 - (1 + s D) exp(-s D)) / s^2, as long as the mean position lies
    between the points: 1 / s > 0.21 D.
    """
    sigma, slope = SIGMAS[2:4], 2.0
    found = weigh_emission_density(mi.Float64(DT), mi.Float64(sigma), mi.Float64(sigma))
    at = [1 + slope * DT * p for p in (GAUSS_POINT, 1 - GAUSS_POINT)]
    total = sum(np.array(w) * j for w, j in zip(found.weights, at, strict=True))
    tau = sigma * DT
    exact = -np.expm1(-tau) / sigma + slope * (1 - (1 + tau) * np.exp(-tau)) / sigma**2
    np.testing.assert_allclose(total, exact, rtol=MOMENTS)


def test_slopes_of_the_weights():
    """Compared with central differences, to their error h^2 and to the error of the moments over h."""
    rng, h = np.random.default_rng(2), 1e-2
    sigma = rng.uniform(0.5, 2, (2, 100))
    exact = weigh_emission_density(mi.Float64(DT), *map(mi.Float64, sigma))
    for q in range(2):
        step = h * np.eye(2)[q][:, None]
        up, down = (weigh_emission_density(mi.Float64(DT), *map(mi.Float64, sigma + s)) for s in (step, -step))
        for k in range(2):
            difference = (np.array(up.weights[k]) - np.array(down.weights[k])) / (2 * h)
            # The third derivative of a weight of the size dt by sigma is below dt^4; moments err by 4e-7 below x = 2.
            np.testing.assert_allclose(np.array(exact.slopes[k][q]), difference, atol=h**2 * DT**4 + 8e-7 * DT / h)
