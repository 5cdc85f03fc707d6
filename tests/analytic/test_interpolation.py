"""Trilinear interpolation, its weights, the outer half voxel, and the cubic along a ray."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.interpolation import (
    GAUSS_POINT,
    eval_cubic,
    fit_cubic,
    fraction_from_lower,
    integrate_cubic,
    interpolate,
    invert_cubic_integral,
    share_opacity,
    trilinear_weights,
    weigh_emission_density,
)
from scenes import as_float32

BITS = np.array([[q & 1, q >> 1 & 1, q >> 2] for q in range(8)])
ROUNDING = 2.0**-24


def points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(7).uniform(0, 1, (3, n)).astype(np.float32)


def test_a_trilinear_function_is_its_interpolant():
    """1 + 2 x + 3 y + 5 z + 7 x y z of the bits of the corners; each of seven steps rounds by at most half an ulp of 18."""
    p = points()
    x, y, z = BITS.T
    corners = 1.0 + 2 * x + 3 * y + 5 * z + 7 * x * y * z
    found = np.array(interpolate([mi.Float(float(c)) for c in corners], mi.Vector3f(*p)), dtype=np.float64)
    x, y, z = p.astype(np.float64)
    np.testing.assert_allclose(found, 1 + 2 * x + 3 * y + 5 * z + 7 * x * y * z, atol=14 * 18 * ROUNDING)


def test_weights_are_the_transpose():
    """Products of three factors x or 1 - x: at most five roundings each."""
    p = points()
    exact = np.prod(np.where(BITS[:, :, None] == 1, p.astype(np.float64), 1 - p.astype(np.float64)), axis=1)
    for found, weight in zip(trilinear_weights(mi.Vector3f(*p)), exact, strict=True):
        np.testing.assert_allclose(np.array(found), weight, rtol=5 * ROUNDING)


def test_the_outer_half_voxel_has_one_node():
    """A grid of (Z, Y, X) = (4, 3, 2): all weight is on the upper node before the first node, and on the lower node from the
    last on."""
    lower = mi.Vector3i(mi.Int32(-1, 0, 1), mi.Int32(-1, 1, 2), mi.Int32(-1, 2, 3))
    found = np.array(fraction_from_lower(mi.Vector3f(0.25), lower, (4, 3, 2)))
    np.testing.assert_array_equal(found, [[1, 0.25, 0]] * 3)


N, DT = 4096, 0.7
OF_VALUE, OF_INTEGRAL = 666 * 2.0**-24, (666 + 444) * 2.0**-24
THIRDS = np.arange(4) / 3


def curves(least: float = 0.0) -> np.ndarray:
    """Values (4, N) at 0, 1/3, 2/3, 1 of products of linear functions between numbers from ``least`` to 1, times up to 4."""
    ends = np.random.default_rng(1).uniform(least, 1, (2, 3, N))
    values = np.prod(ends[0] + THIRDS[:, None, None] * (ends[1] - ends[0]), axis=1)
    return as_float32(4 * values * np.random.default_rng(2).uniform(0.1, 1, N))


def exact(values: np.ndarray) -> np.ndarray:
    """Coefficients (4, N) of the cubics through values, constant term first."""
    return np.linalg.solve(THIRDS[:, None] ** np.arange(4), values)


def depth(values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The integral from 0 to x."""
    return DT * sum(c * x ** (k + 1) / (k + 1) for k, c in enumerate(exact(values)))


def lanes(values: np.ndarray) -> list[mi.Float]:
    return fit_cubic(*(mi.Float(row) for row in values))


def inverted(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The x at which the integral is the fraction ``u`` of the whole."""
    curve = lanes(values)
    whole = integrate_cubic(curve, mi.Float(DT), mi.Float(1))
    return np.array(invert_cubic_integral(curve, mi.Float(DT), mi.Float(u) * whole, whole), np.float64)


def test_values_and_integrals_are_those_of_the_cubic():
    values, x = curves(), as_float32(np.random.default_rng(3).uniform(0, 1, N))
    curve, top = lanes(values), values.max(axis=0)
    found = np.array(eval_cubic(curve, mi.Float(x)))
    np.testing.assert_array_less(np.abs(found - sum(c * x**k for k, c in enumerate(exact(values)))), OF_VALUE * top)
    found = np.array(integrate_cubic(curve, mi.Float(DT), mi.Float(x)))
    np.testing.assert_array_less(np.abs(found - depth(values, x)), OF_INTEGRAL * DT * top)


def test_no_integral_is_negative():
    """The integral of F x^3 from 0 to 1e-4 is little more than the rounding of the coefficients, which are 0 on paper."""
    values = as_float32(np.random.default_rng(4).uniform(1, 2, N) * THIRDS[:, None] ** 3)
    assert np.array(integrate_cubic(lanes(values), mi.Float(1), mi.Float(1e-4))).min() == 0


def test_the_inverse_reaches_its_goal():
    """If the extinction is at least 0.001 of its largest value, Newton steps end at the rounding of the integral and of x."""
    values, u = curves(least=0.1), as_float32(np.random.default_rng(5).uniform(0, 1, N))
    off, top = np.abs(depth(values, inverted(values, u)) - u * depth(values, 1)), values.max(axis=0)
    np.testing.assert_array_less(off, (2 * OF_INTEGRAL + 2.0**-24) * DT * top)


@pytest.mark.parametrize("at", ["start", "end"])
def test_an_extinction_that_vanishes_at_an_end(at):
    """F x^3, whose integral is the fourth power.

    Newton steps from above reduce an error v of x^4 to at most (3/4)^4 v. The first step is a bisection, to x^4 <= 1/16 at
    small u; at most one of the seven others ends below the root: 0.316^6 / 16 = 6.3e-5 of the whole.
    """
    u = as_float32((np.arange(N) + 0.5) / N)
    values = as_float32(3 * np.broadcast_to(THIRDS[:, None] if at == "start" else 1 - THIRDS[:, None], (4, N)) ** 3)
    off = np.abs(depth(values, inverted(values, u)) / depth(values, 1) - u)
    np.testing.assert_array_less(off, 0.75**24 / 16 + 4 * OF_INTEGRAL)


def test_goals_at_the_ends_and_a_flat_extinction():
    """Goal 0 gives x = 0, the whole goal x = 1; in a constant extinction x is the goal over the whole."""
    flat, u = np.full((4, 3), 2.0), np.array([0.0, 0.25, 1.0])
    # Coefficients of a constant cancel to 2^-24 of 111 F, and so do those of the integral.
    np.testing.assert_allclose(inverted(flat, u), u, atol=OF_INTEGRAL)
    sloped = np.broadcast_to(1 + THIRDS[:, None], (4, 3))
    np.testing.assert_allclose(inverted(sloped, u)[[0, 2]], [0, 1], atol=OF_INTEGRAL)


# -- Emission and absorption in a cell ---------------------------------------------------------------------------------

CELL_LENGTH = 0.7
SIGMAS = np.array([0.0, 1e-6, 0.1, 1.0, 30.0, 1e5])
MOMENTS = 2e-5
"""What the moments E_n and the opacity may err by (mivol.numerics), relative."""


@pytest.mark.parametrize("ratio", [0.0, 0.5, 1.0, 7.0])
def test_a_constant_source_function_shows_the_opacity(ratio):
    """At every optical depth, and for every two extinctions; the relative error of the opacity is 4e-7."""
    shares = share_opacity(mi.Float64(CELL_LENGTH), mi.Float64(SIGMAS), mi.Float64(ratio * SIGMAS))
    exact = -np.expm1(-0.5 * CELL_LENGTH * (1 + ratio) * SIGMAS)
    np.testing.assert_allclose(np.array(shares.radiance(mi.Float64(3), mi.Float64(3))), 3 * exact, rtol=5e-7)
    np.testing.assert_allclose(sum(np.array(w) for w in shares.weights), exact, rtol=5e-7)
    assert all((np.array(w) >= 0).all() for w in shares.weights)


def test_the_first_point_counts_more_in_a_deep_cell():
    """(1 - f) / f is 1 / Q in constant extinction: 1 in a thin cell, and Q > 5 x^2 / 6 = 5 tau^2 / 18 in every cell."""
    shares = share_opacity(mi.Float64(CELL_LENGTH), mi.Float64(SIGMAS), mi.Float64(SIGMAS))
    f, tau = np.array(shares.f), CELL_LENGTH * SIGMAS
    assert f[0] == 0.5 and f[1] == pytest.approx(0.5, abs=tau[1])
    assert (np.diff(f) > 0).all()
    np.testing.assert_array_less((1 - f[1:]) / f[1:], 18 / (5 * tau[1:] ** 2))


def test_linear_emission_in_constant_extinction():
    r"""The two points represent the mean position of the light leaving the cell, so a linear density is exact.

    \int_0^D (1 + b t) exp(-s t) dt = (1 - exp(-s D)) / s + b (1 - (1 + s D) exp(-s D)) / s^2, as long as the mean position lies
    between the points: 1 / s > 0.21 D.
    """
    sigma, slope = SIGMAS[2:4], 2.0
    found = weigh_emission_density(mi.Float64(CELL_LENGTH), mi.Float64(sigma), mi.Float64(sigma))
    at = [1 + slope * CELL_LENGTH * p for p in (GAUSS_POINT, 1 - GAUSS_POINT)]
    total = sum(np.array(w) * j for w, j in zip(found.weights, at, strict=True))
    tau = sigma * CELL_LENGTH
    exact = -np.expm1(-tau) / sigma + slope * (1 - (1 + tau) * np.exp(-tau)) / sigma**2
    np.testing.assert_allclose(total, exact, rtol=MOMENTS)


def test_slopes_of_the_weights():
    """Compared with central differences, to their error h^2 and to the error of the moments over h."""
    rng, h = np.random.default_rng(2), 1e-2
    sigma = rng.uniform(0.5, 2, (2, 100))
    exact = weigh_emission_density(mi.Float64(CELL_LENGTH), *map(mi.Float64, sigma))
    for q in range(2):
        step = h * np.eye(2)[q][:, None]
        up, down = (weigh_emission_density(mi.Float64(CELL_LENGTH), *map(mi.Float64, sigma + s)) for s in (step, -step))
        for k in range(2):
            difference = (np.array(up.weights[k]) - np.array(down.weights[k])) / (2 * h)
            # The third derivative of a weight of the size dt by sigma is below dt^4; moments err by 4e-7 below x = 2.
            np.testing.assert_allclose(
                np.array(exact.slopes[k][q]), difference, atol=h**2 * CELL_LENGTH**4 + 8e-7 * CELL_LENGTH / h
            )
