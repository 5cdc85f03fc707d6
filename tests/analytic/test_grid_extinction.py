"""An extinction on a grid: values, optical depths and derivatives, with and without an activation, and sums of parts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.activation import select_activation
from mivol.transport.media.extinction import ConstantExtinction, RayInterval
from mivol.transport.media.grid_extinction import (
    ActivatedGridExtinction,
    GridExtinction,
    SummedExtinction,
    add_to_cell,
    have_same_cells,
)
from mivol.transport.traversal.lattice import Lattice

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
    """0 up to the first centre, then linear, then 1: 1/4 + 1/4; over half of the way, 1/16 in the linear part."""
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
    dr.backward(dr.sum(dr.ravel(part.scaled(scale)) * part.fold_gradient(gradient)))
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


ROUNDING = 8 * 2.0**-23
"""Of a few sums and one exponential of numbers near 1, relative to them."""


def two() -> ActivatedGridExtinction:
    values = mi.TensorXf(np.full((2, 3, 2, 1), np.log(2), np.float32))
    return ActivatedGridExtinction("sigma_t", Lattice(values, np.eye(4)), select_activation("exp"))


def ray() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(-1, 0.4, 0.3), mi.Vector3f(1, 0, 0))


def test_nothing_lies_outside_of_the_box():
    """Without the box test, the activation exp would give 1 for the 0 read outside."""
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
    dr.backward(dr.sum(dr.ravel(part.scaled(mi.Float(1))) * part.fold_gradient(gradient)))
    assert np.array(dr.grad(part.lattice.values)).sum() == pytest.approx(6, rel=ROUNDING)


def lattice(channels: int = 1, res: tuple[int, ...] = (2, 2, 2), shift: float = 0.0) -> Lattice:
    place = np.eye(4)
    place[0, 3] = shift
    return Lattice(mi.TensorXf(np.zeros((*res, channels), np.float32)), place)


def corners(*values: float) -> list[list[mi.Float]]:
    """[channel][corner] values of an array with channels constant in the cell."""
    return [[mi.Float(v)] * 8 for v in values]


def test_parts_are_summed_for_each_channel():
    """scale (grey grid + rgb grid + grey constant + rgb constant)."""
    parts = [
        GridExtinction("sigma_a", lattice()),
        ConstantExtinction("sigma_a", mi.Float(0.5)),
        GridExtinction("sigma_s", lattice(3)),
        ConstantExtinction("sigma_s", mi.Color3f(1, 2, 4)),
    ]
    found = SummedExtinction(parts, [p.values for p in parts], mi.Float(2))
    assert found.channels == 3 and found.has_constants
    np.testing.assert_array_equal(np.array(found.constant).ravel(), [3, 5, 9])
    points = [mi.Vector3f(0.25), mi.Vector3f(0.75)]
    rows = found.along([corners(8), corners(16, 32, 64)], points)
    np.testing.assert_array_equal(np.array(rows)[:, :, 0], np.repeat([[3 + 48], [5 + 80], [9 + 144]], 2, axis=1))
    assert found.slopes([corners(8)], points) is None


def test_points_of_a_cell_are_interpolated():
    """A cell of values x + 2 y + 4 z at its corners."""
    part = GridExtinction("sigma_t", lattice())
    found = SummedExtinction([part], [part.values], mi.Float(1))
    assert not found.has_constants
    ((value,),) = found.along([[[mi.Float(k) for k in range(8)]]], [mi.Vector3f(0.5, 0.25, 0.125)])
    assert value[0] == 0.5 + 2 * 0.25 + 4 * 0.125


def test_values_are_activated_and_tangents_are_not():
    part = ActivatedGridExtinction("sigma_t", lattice(), select_activation("relu"))
    below, above, point = corners(-3), corners(3), [mi.Vector3f(0.5)]
    values, tangents = (SummedExtinction([part], [part.values], mi.Float(1), linear=k) for k in (False, True))
    assert [values.along([c], point)[0][0][0] for c in (below, above)] == [0, 3]
    assert [tangents.along([c], point)[0][0][0] for c in (below, above)] == [-3, 3]
    assert [values.slopes([c], point)[0][0] for c in (below, above)] == [0, 1]


def test_cells_are_shared_by_grids_of_one_resolution_and_place():
    assert have_same_cells(lattice(), lattice(3))
    assert not have_same_cells(lattice(), lattice(res=(2, 2, 3)))
    assert not have_same_cells(lattice(), lattice(shift=1e-3))
