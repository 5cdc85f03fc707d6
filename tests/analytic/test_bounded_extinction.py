"""A bounded extinction, of a ball in its box: where it may be met, its values, and its derivatives at a point."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball

from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.extinction import RayInterval

pytestmark = pytest.mark.usefixtures("variant_rgb")


def ball(*sigma: float, scale: float = 2.0) -> BoundedExtinction:
    """Of radius 1, about (0, 0, 2)."""
    value = mi.Color3f(*sigma) if len(sigma) == 3 else mi.Float(*sigma)
    return BoundedExtinction("sigma_t", Ball(value, 1.0, (0, 0, 2)), mi.Float(scale), mi.Float(max(sigma)))


def upward(x: float = 0.0) -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(x, 0, 0), mi.Vector3f(0, 0, 1))


def test_the_interval_is_that_of_the_box():
    """A ray at x = 0.9 crosses the box where it hardly meets the ball; one at 1.1 misses both."""
    part = ball(1.5)
    on = mi.Bool(True)
    begin, end = part.clip(RayInterval(upward(0.9), mi.Float(0, 2, 0), mi.Float(dr.inf, dr.inf, 2.5), on))
    np.testing.assert_array_equal([np.array(begin), np.array(end)], [[1, 2, 1], [3, 3, 2.5]])
    begin, end = part.clip(RayInterval(upward(1.1), mi.Float(0), mi.Float(dr.inf), on))
    assert not begin[0] < end[0]


def test_values_in_and_out_of_the_ball():
    found = ball(1.5, 0.5, 0.25).eval_at(mi.Float(4), upward(), mi.Float(0.5, 2, 3.5), mi.Bool(True))
    np.testing.assert_array_equal(np.array(found), [[0, 6, 0], [0, 2, 0], [0, 1, 0]])


def test_a_tangent_is_that_of_the_scale_and_that_of_the_field():
    part = ball(1.5)
    dr.enable_grad(part.field.sigma)
    dr.set_grad(part.field.sigma, 0.5)
    with dr.suspend_grad():
        found = part.jvp_at(mi.Float(0.25), upward(), mi.Float(2, 2, 0.5), mi.Bool(True, False, True))
    np.testing.assert_array_equal(np.array(found), [[0.25 * 1.5 + 2 * 0.5, 0, 0]])


def test_a_gradient_reaches_the_scale_and_the_field():
    part, scale = ball(1.5, 0.5, 0.25), mi.Float(2)
    dr.enable_grad(part.field.sigma, scale)
    gradient = part.start_gradient()
    with dr.suspend_grad():
        weight = [mi.Float(1, 1), mi.Float(2, 2), mi.Float(4, 4)]
        part.vjp_at(gradient, weight, upward(), mi.Float(2, 2), mi.Bool(True, False))
    np.testing.assert_array_equal(np.array(dr.grad(part.field.sigma)).ravel(), [2, 4, 8])
    dr.backward(part.deliver(scale, gradient))
    assert dr.grad(scale)[0] == 1.5 + 2 * 0.5 + 4 * 0.25
