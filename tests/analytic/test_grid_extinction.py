"""An extinction on a grid: trilinear between voxel centres, constant beyond them, and nothing outside of the box."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.grid_extinction import GridExtinction, add_to_cell
from mivol.transport.traversal.lattice import Lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")

PLANE = np.arange(8.0).reshape(2, 2, 2)
"""x + 2 y + 4 z in the voxels of the unit cube, whose centres lie at 0.25 and 0.75."""


def grid(*factors: float) -> GridExtinction:
    values = np.stack([f * PLANE for f in factors], axis=-1).astype(np.float32)
    return GridExtinction("sigma_t", Lattice(mi.TensorXf(values), np.eye(4)))


def across(x: list[float], y: list[float], z: list[float]) -> mi.Ray3f:
    """Rays along x through points."""
    return mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(z)), mi.Vector3f(1, 0, 0))


def test_values_at_points():
    """The middle, a voxel centre, a corner of the box, and a point outside; each channel by itself."""
    ray = across([0.25, 0.5, 0.75, 0.75], [0.5, 0.25, 0.875, 0.5], [0.5, 0.75, 0.875, 0.5])
    found = grid(1, 2, 0.5).eval_at(mi.Float(2), ray, mi.Float(0.25, 0.25, 0.125, 0.5), mi.Bool(True))
    expected = np.array([2 * 3.5, 2 * 5, 2 * 7, 0])
    np.testing.assert_array_equal(np.array(found), [expected, 2 * expected, 0.5 * expected])


def test_optical_depth_across_the_box():
    """0 up to the first centre, then linear, then 1: 1/4 + 1/4; and half of the way, 1/16 of it linear."""
    ray = across([0, 0], [0.25] * 2, [0.25] * 2)
    found = grid(1).integrate(RayInterval(ray, mi.Float(0, 0), mi.Float(1, 0.5), mi.Bool(True)))
    # A cell is integrated with two Gauss points, whose places are rounded: a few roundings of numbers of size 1.
    np.testing.assert_allclose(np.array(found), [[0.5, 0.0625]], atol=4 * 2.0**-23)


def test_derivatives_at_a_point_are_the_weights_of_its_corners():
    part, scale = grid(1, 1, 1), mi.Float(4)
    dr.enable_grad(scale, part.lattice.values)
    gradient = part.start_gradient()
    with dr.suspend_grad():
        ray, t = across([0.25], [0.25], [0.25]), mi.Float(0.375)
        part.vjp_at(gradient, [mi.Float(1), mi.Float(0), mi.Float(2)], ray, t, mi.Bool(True))
        part.vjp_at(gradient, [mi.Float(1)] * 3, ray, t, mi.Bool(False))
    dr.backward(part.deliver(scale, gradient))
    expected = np.zeros((2, 2, 2, 3))
    expected[0, 0] = np.outer([0.25, 0.75], [1, 0, 2])
    np.testing.assert_array_equal(np.array(dr.grad(part.lattice.values)), 4 * expected)
    # The value there is 0.75 in each channel.
    assert dr.grad(scale)[0] == 0.75 * 3


def test_terms_of_a_cell_are_added_corner_by_corner():
    part = grid(1)
    gradient = part.start_gradient()
    first, second = ([mi.Float(float(k == q)) for k in range(8)] for q in (1, 6))
    add_to_cell(gradient, mi.Vector3i(0), [([mi.Float(2)], first), ([mi.Float(3)], second)], mi.Bool(True))
    expected = np.zeros(8)
    expected[[1, 6]] = 2, 3
    np.testing.assert_array_equal(np.array(gradient.fold()).ravel(), expected)
