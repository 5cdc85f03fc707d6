"""A constant extinction: its value times a length; the numbers are powers of 2, so that nothing is rounded."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.constant_extinction import ConstantExtinction
from mivol.transport.media.extinction import RayInterval

pytestmark = pytest.mark.usefixtures("variant_rgb")


def coloured() -> ConstantExtinction:
    return ConstantExtinction("sigma_t", mi.Color3f(0.5, 0.0, 2.0))


def intervals() -> RayInterval:
    """Four of a ray: one of length 3, one that is not active, one that ends before it begins, one without end."""
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    return RayInterval(ray, mi.Float(1, 1, 3, 1), mi.Float(4, 4, 2, dr.inf), mi.Bool(True, False, True, True))


def test_optical_depth_is_the_value_times_the_length():
    found = np.array(coloured().integrate(intervals()))
    np.testing.assert_array_equal(found, [[1.5, 0, 0, np.inf], [0, 0, 0, 0], [6, 0, 0, np.inf]])


def test_an_interval_without_end_has_no_derivative():
    part = coloured()
    np.testing.assert_array_equal(np.array(part.jvp(mi.Color3f(1, 2, 4), intervals()))[:, [0, 3]], [[3, 0], [6, 0], [12, 0]])
    gradient = part.start_gradient()
    part.vjp(gradient, [mi.Float(1, 1, 1, 5), mi.Float(0), mi.Float(2)], intervals())
    np.testing.assert_array_equal(np.array(gradient), [3, 0, 6])


def test_a_point_has_the_value_times_the_scale():
    ray, t, active = intervals().ray, intervals().t0, intervals().active
    part, scale = coloured(), mi.Float(4)
    assert part.channels == 3 and ConstantExtinction("sigma_t", mi.Float(1)).channels == 1
    np.testing.assert_array_equal(np.array(part.eval_at(scale, ray, t, active)).ravel(), [2, 0, 8])
    gradient = part.start_gradient()
    part.vjp_at(gradient, [mi.Float(1, 2, 4, 8), mi.Float(1), mi.Float(0)], ray, t, active)
    np.testing.assert_array_equal(np.array(gradient), [13, 3, 0])


def test_a_gradient_is_delivered_to_the_value_and_to_the_scale():
    part, scale = coloured(), mi.Float(4)
    dr.enable_grad(part.constant, scale)
    dr.backward(part.deliver(scale, mi.Float(1, 2, 4)))
    np.testing.assert_array_equal(np.array(dr.grad(part.constant)).ravel(), [4, 8, 16])
    assert dr.grad(scale)[0] == 0.5 * 1 + 2.0 * 4
