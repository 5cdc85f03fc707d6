"""An activation of a grid: exp of the logarithm of 2 is an extinction of 2 inside of the box, and nothing outside."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.activation import activation_of
from mivol.transport.media.activated_grid_extinction import ActivatedGridExtinction
from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.lattice import Lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")

ROUNDING = 8 * 2.0**-23
"""Of a few sums and one exponential of numbers near 1, relative to them."""


def two() -> ActivatedGridExtinction:
    values = mi.TensorXf(np.full((2, 3, 2, 1), np.log(2), np.float32))
    return ActivatedGridExtinction("sigma_t", Lattice(values, np.eye(4)), activation_of("exp"))


def ray() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(-1, 0.4, 0.3), mi.Vector3f(1, 0, 0))


def test_nothing_lies_outside_of_the_box():
    """exp of the 0 that is read there would be 1."""
    found = two().eval_at(mi.Float(1), ray(), mi.Float(0.5, 1.5, 2.5), mi.Bool(True))
    np.testing.assert_allclose(np.array(found), [[0, 2, 0]], rtol=ROUNDING)


def test_optical_depth_is_that_of_the_activated_values():
    interval = RayInterval(ray(), mi.Float(0, 1.5, 0), mi.Float(9, 9, 9), mi.Bool(True, True, False))
    found = two().integrate(interval)
    np.testing.assert_allclose(np.array(found), [[2, 1, 0]], rtol=ROUNDING)


@pytest.mark.parametrize("where", ["along", "at"])
def test_derivatives_hold_the_slope_of_the_activation(where: str) -> None:
    """The slope of exp is its value: a change of all voxels by v changes an optical depth over 1 by 2 v, and a value by 2 v."""
    part, on = two(), mi.Bool(True)
    asked = (ray(), mi.Float(1.5), on) if where == "at" else (RayInterval(ray(), mi.Float(0), mi.Float(9), on),)
    jvp, vjp = (part.jvp_at, part.vjp_at) if where == "at" else (part.jvp, part.vjp)
    np.testing.assert_allclose(np.array(jvp(dr.full(mi.Float, 0.25, 12), *asked)).ravel(), [0.5], rtol=ROUNDING)
    dr.enable_grad(part.lattice.values)
    gradient = part.start_gradient()
    with dr.suspend_grad():
        vjp(gradient, [mi.Float(3)], *asked)
    dr.backward(part.deliver(mi.Float(1), gradient))
    assert np.array(dr.grad(part.lattice.values)).sum() == pytest.approx(6, rel=ROUNDING)
