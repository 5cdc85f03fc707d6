r"""Equiangular sampling against arctangents in float64.

The angle theta of [a, b] is atan2(rho (b - a), q), q = (a - t0) (b - t0) + rho^2. In float32 q errs by a few roundings of its
larger term, so theta errs by 2^-22 (|a - t0| |b - t0| + rho^2) / hypot(rho (b - a), q), beside a few roundings of itself.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.emitters import EquiangularSampler, make_ball_sampler

pytestmark = pytest.mark.usefixtures("variant_rgb")

ROUNDING = 2.0**-22


def pieces(n: int = 2000) -> tuple[np.ndarray, ...]:
    """Pieces [a, a + dt] of rays, the nearest distance t0 and rho of an emitter, and numbers u, as float32."""
    rng = np.random.default_rng(5)
    a, t0 = rng.uniform(0, 4, (2, n))
    dt, rho = 10 ** rng.uniform(-2, 1, (2, n))
    return tuple(x.astype(np.float32).astype(np.float64) for x in (a, dt, t0, rho, rng.uniform(0.01, 0.99, n)))


def sampler_of(t0: np.ndarray, rho: np.ndarray) -> EquiangularSampler:
    return EquiangularSampler(mi.Float(t0), mi.Float(rho), mi.Bool(True))


def angle_error(a: np.ndarray, dt: np.ndarray, t0: np.ndarray, rho: np.ndarray, theta: np.ndarray) -> np.ndarray:
    near, far = a - t0, a + dt - t0
    return ROUNDING * (theta + (np.abs(near * far) + rho**2) / np.hypot(rho * dt, near * far + rho**2))


def test_samples_divide_the_angle():
    """A distance drawn with u divides the angle in u : 1 - u; a distance rounded by e moves the angle by e rho / r^2."""
    a, dt, t0, rho, u = pieces()
    sampler = sampler_of(t0, rho)
    t = np.array(sampler.sample(mi.Float(a), mi.Float(dt), mi.Float(u)), dtype=np.float64)
    assert (t >= 0).all() and (t <= dt).all()
    begin, there, end = (np.arctan((x - t0) / rho) for x in (a, a + t, a + dt))
    # t = rho sin (1 + x^2) / (cos - x sin): its denominator is cancelled by at most its terms, 1 + |x|, x = (a - t0) / rho.
    x, part = (a - t0) / rho, u * (end - begin)
    lost = ROUNDING * (1 + np.abs(x)) / np.abs(np.cos(part) - x * np.sin(part))
    moved = (4 * ROUNDING + lost) * t * rho / (rho**2 + (a + t - t0) ** 2)
    np.testing.assert_array_less(np.abs(there - begin - part), 2 * (moved + angle_error(a, dt, t0, rho, end - begin)))


def test_density_is_the_derivative_of_the_angle():
    a, dt, t0, rho, u = pieces()
    t = (u * dt).astype(np.float32).astype(np.float64)
    found = np.array(sampler_of(t0, rho).density(mi.Float(a), mi.Float(dt), mi.Float(t)), dtype=np.float64)
    theta = np.arctan((a + dt - t0) / rho) - np.arctan((a - t0) / rho)
    exact = rho / ((rho**2 + (a + t - t0) ** 2) * theta)
    # r^2 has the rounding of (a - t0) + t, whose square it holds.
    off = np.abs(a - t0) + t
    relative = angle_error(a, dt, t0, rho, theta) / theta + ROUNDING * (2 + 2 * off**2 / (rho**2 + (a + t - t0) ** 2))
    np.testing.assert_array_less(np.abs(found - exact), relative * exact)


def test_mean_of_the_inverse_square():
    """theta / (rho dt) where the emitter has a place, 1 where it is at infinity."""
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    found = make_ball_sampler(ray, [3.0, 0.0, 4.0, 0.0]).mean(mi.Float(4), mi.Float(3))
    assert found[0] == pytest.approx(np.arctan(1) / 9, rel=1e-5)  # 1e-8 of the squared distance is added to rho^2: 1.4e-8
    assert make_ball_sampler(ray, None) is None
    assert EquiangularSampler(mi.Float(0), mi.Float(1), mi.Bool(False)).mean(mi.Float(4), mi.Float(3))[0] == 1
