r"""Flights by delta tracking: how many collide, and where.

With u = 1 - exp(-tau(t)) of the distance t of a collision, u is uniform in [0, 1 - T], whatever the field is: a share of 1 - T
of all flights collides, and the means of u and u^2 (0 of flights that do not collide) are (1 - T)^2 / 2 and (1 - T)^3 / 3.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball
from false_alarms import assert_rate, assert_same_mean, fresh
from oracle import tau_twin, to_lattice, trilinear
from scattering_scenes import PLACE, rough_grid

from mivol.transport.estimators.flights.tracking import delta_tracking, delta_tracking_in_blocks
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.traversal.grid_blocks import find_block_ranges
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32
from mivol.validate.moments import Moments
from scenes import as_float32, make_lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")

N, SCALE = 1 << 16, 1.3
START, D = as_float32([-2.5, -1.2, -1.9]), as_float32(np.array([2.5, 1.4, 1.7]) / np.linalg.norm([2.5, 1.4, 1.7]))
"""A ray across the box [-1, 1]^3, which it meets from about 1.8 to 3.5."""


def ray() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(*map(float, START)), mi.Vector3f(*map(float, D)))


def interval(t0: float = 0.0, t1: float = np.inf, on: bool = True) -> RayInterval:
    """Of the one ray, in N lanes."""
    return RayInterval(ray(), mi.Float64(t0), mi.Float64(t1), dr.full(mi.Bool, on, N))


def generators(seed: int) -> mi.UInt32:
    return seed_pcg32((dr.arange(mi.Float, N) + 0.5) / N, N, fresh(seed))


def grid(values: np.ndarray, shift: int) -> GridExtinction:
    lattice = make_lattice(values, PLACE)
    lattice.block_ranges = find_block_ranges(lattice.values, shift)
    return GridExtinction("sigma_t", lattice)


def assert_flights(t: mi.Float64, tau: np.ndarray, T: float) -> None:
    """Collisions at t [N], at optical depths tau [N], are those of free flights through a transmittance T."""
    met = np.isfinite(np.array(t))
    u = np.where(met, -np.expm1(-np.where(met, tau, 0)), 0)
    assert u.max() <= 1 - T + 1e-5
    assert_rate(int(met.sum()), N, 1 - T)
    # Optical depths of about 1 are known to 1e-5.
    assert_same_mean(Moments.of(u), (1 - T) ** 2 / 2, rounding=1e-5, what="the mean of u")
    assert_same_mean(Moments.of(u**2), (1 - T) ** 3 / 3, rounding=1e-5, what="the mean of u^2")


def face() -> tuple[float, float]:
    """Where the ray enters the box, and where it leaves."""
    sides = np.sort([(-1 - START) / D, (1 - START) / D], axis=0)
    return sides[0].max(), sides[1].min()


def depths(values: np.ndarray, t: mi.Float64, t0: float) -> np.ndarray:
    """Optical depth from t0 to t, summed over 20000 points of the ray: steps of 1e-4, between which it is linear to 1e-7."""
    (start, end), (q, dq) = face(), to_lattice(values, PLACE, START, D)
    edges = np.linspace(max(start, t0), end, 20001)
    steps = np.diff(edges)
    sigma = trilinear(values, q + (edges[:-1] + steps / 2)[:, None] * dq)[:, 0]
    return np.interp(np.minimum(np.array(t), end), edges, SCALE * np.append(0, np.cumsum(sigma * steps)))


@pytest.mark.statistical
@pytest.mark.parametrize("shift", [2, 3])
def test_flights_through_a_grid(shift):
    """Rough values, in blocks of 4 and of 8 cells."""
    values = rough_grid(1, 2.0, (9, 12, 17))
    t, _ = delta_tracking_in_blocks(grid(values, shift), mi.Float(SCALE), interval(), generators(1))
    T = np.exp(-SCALE * tau_twin(values, PLACE, START, D)[0])
    assert_flights(t, depths(values, t, 0.0), T)


@pytest.mark.statistical
def test_flights_that_begin_and_end_in_the_grid():
    """From 2.2 on, up to 3.1; nothing is found outside."""
    values = rough_grid(1, 2.0, (9, 12, 17))
    t, _ = delta_tracking_in_blocks(grid(values, 2), mi.Float(SCALE), interval(2.2, 3.1), generators(2))
    assert_flights(t, depths(values, t, 2.2), np.exp(-SCALE * tau_twin(values, PLACE, START, D, 2.2, 3.1)[0]))
    assert np.nanmin(np.array(t)) >= 2.2 and not np.any((np.array(t) > 3.1 + 1e-6) & np.isfinite(np.array(t)))


def test_every_collision_is_real_where_blocks_have_one_value():
    """So the first number says where: -log u over the extinction, behind the face of the box."""
    t, _ = delta_tracking_in_blocks(grid(np.full((9, 12, 17), 0.8), 2), mi.Float(SCALE), interval(), generators(3))
    _, (u,) = draw_pcg32(generators(3), 1)
    start, end = face()
    expected = start - np.log(np.array(u, np.float64)) / (0.8 * SCALE)
    expected[expected > end] = np.inf
    # The lengths of 15 blocks, and as many optical depths, are subtracted from numbers of up to 16.
    np.testing.assert_allclose(np.array(t), expected, atol=15 * 16 * 2.0**-24 / 0.8)


def test_lanes_that_are_off_and_vacuum_have_no_collision():
    """Blocks of 0 have a majorant of 0: the next tentative collision is infinitely far."""
    part, empty = grid(rough_grid(1), 2), grid(np.zeros((5, 4, 6)), 2)
    assert np.isinf(np.array(delta_tracking_in_blocks(part, mi.Float(SCALE), interval(on=False), generators(4))[0])).all()
    assert np.isinf(np.array(delta_tracking_in_blocks(empty, mi.Float(SCALE), interval(), generators(4))[0])).all()


# -- A field of which no more than a majorant is known ------------------------------------------------------------------


def ball(slack: float, sigma: float = 0.6) -> BoundedExtinction:
    """About the point of the ray at 2.5, of radius 1."""
    field = Ball(mi.Float(sigma), 1.0, tuple(START + 2.5 * D))
    return BoundedExtinction("sigma_t", field, mi.Float(SCALE), mi.Float(sigma * slack))


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
def test_flights_through_a_ball(slack):
    """Between 1.5 and 3.5, whatever the majorant."""
    t, after = delta_tracking(ball(slack), mi.Float(SCALE), interval(), generators(5))
    tau = 0.6 * SCALE * np.clip(np.array(t) - 1.5, 0, 2)
    assert_flights(t, tau, np.exp(-2 * 0.6 * SCALE))
    assert dr.width(after) == N


@pytest.mark.statistical
def test_flights_that_begin_and_end_in_the_ball():
    t, _ = delta_tracking(ball(2.0), mi.Float(SCALE), interval(2.0, 3.0), generators(6))
    assert_flights(t, 0.6 * SCALE * (np.array(t) - 2.0), np.exp(-0.6 * SCALE))


def test_lanes_that_are_off_and_balls_of_nothing_have_no_collision():
    assert np.isinf(np.array(delta_tracking(ball(1.0), mi.Float(SCALE), interval(on=False), generators(7))[0])).all()
    assert np.isinf(np.array(delta_tracking(ball(0.0), mi.Float(SCALE), interval(), generators(7))[0])).all()
