"""Every kind of extinction along a ray: integrals, values at points, and derivatives that are transposes of each other."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball

from mivol.fields.activation import select_activation
from mivol.transport.media.extinction import (
    BoundedExtinction,
    ConstantExtinction,
    ExactExtinction,
    RayInterval,
    colours_to_channels,
    to_part_channels,
    to_scene_channels,
)
from mivol.transport.media.grid_extinction import ActivatedGridExtinction, GridExtinction
from mivol.transport.traversal.grid_blocks import bound_blocks, find_distances_of_bounds
from mivol.transport.traversal.lattice import Lattice

RES, RAYS = (9, 10, 11), 64
BOX = np.diag([2.0, 2.0, 2.0, 1.0]) + np.pad(np.full((3, 1), -1.0), ((0, 1), (3, 0)))
"""The unit cube as [-1, 1]^3."""


def noise(channels: int, low: float) -> Lattice:
    """A grid of noise with an empty half; empty blocks are skipped."""
    values = np.random.default_rng(3).uniform(low, 2, (*RES, channels)).astype(np.float32)
    values[:, :, 5:] = min(low, 0)
    values, occupied = mi.TensorXf(values), mi.TensorXf(np.maximum(values, 0))
    return Lattice(values, BOX, find_distances_of_bounds(bound_blocks(occupied), RES))


KINDS: dict[str, Callable[[], ExactExtinction]] = {
    "a grey constant": lambda: ConstantExtinction("sigma_t", mi.Float(0.7)),
    "an rgb constant": lambda: ConstantExtinction("sigma_t", mi.Color3f(0.7, 0.1, 1.3)),
    "a grey grid": lambda: GridExtinction("sigma_t", noise(1, 0)),
    "an rgb grid": lambda: GridExtinction("sigma_t", noise(3, 0)),
    "relu of a grid": lambda: ActivatedGridExtinction("sigma_t", noise(1, -2), select_activation("relu")),
    "exp of a grid": lambda: ActivatedGridExtinction("sigma_t", Lattice(noise(1, -2).values, BOX), select_activation("exp")),
}


def rays() -> tuple[mi.Ray3f, mi.Float, mi.Float]:
    """Rays around and through the box, with an interval each; some begin inside."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(3, RAYS))
    o = rng.uniform(-0.9, 0.9, (3, RAYS)) - 1.5 * (d := d / np.linalg.norm(d, axis=0))
    ray = mi.Ray3f(mi.Point3f(o.astype(np.float32)), mi.Vector3f(d.astype(np.float32)))
    return ray, mi.Float(rng.uniform(0, 1.5, RAYS).astype(np.float32)), mi.Float(rng.uniform(1.5, 4, RAYS).astype(np.float32))


def numbers(rows: list[mi.Float]) -> np.ndarray:
    return np.array([np.broadcast_to(np.array(row, np.float64), RAYS) for row in rows])


@pytest.mark.slow_for("an rgb grid")
@pytest.mark.parametrize("name", [name for name in KINDS if "relu" not in name])
def test_an_optical_depth_is_the_sum_of_the_values_on_its_way(name: str) -> None:
    part, (ray, t0, t1), n = KINDS[name](), rays(), 4000
    dt = (t1 - t0) / n
    total = np.zeros((part.channels, RAYS))
    for first in range(0, n, 500):
        k = dr.repeat(dr.arange(mi.Float, 500), RAYS) + first + 0.5
        lane = dr.tile(dr.arange(mi.UInt32, RAYS), 500)
        many, start, step = (dr.gather(type(x), x, lane) for x in (ray, t0, dt))
        rows = part.eval_at(mi.Float(1), many, start + k * step, mi.Bool(True))
        total += np.array([np.broadcast_to(np.array(r, np.float64), 500 * RAYS).reshape(500, RAYS).sum(axis=0) for r in rows])
    largest = np.exp(2) if "exp" in name else 2.0
    found = numbers(part.integrate(RayInterval(ray, t0, t1, mi.Bool(True))))
    # A sum at midpoints misses half a step at each of the two faces of the box, and less inside; a point counts as inside up to
    # 1e-3 of a voxel beyond a face (lattice.locate). Two Gauss points a cell are wrong by up to 2 % of what an activation makes
    # of noise (the table of mivol.fields.activation, an optical depth of 0.1 to 1 a voxel: 0.5 % rms; relu has edges).
    beyond = 2 * 1e-3 * (2 / min(RES)) / np.abs(np.array(ray.d)).min(axis=0)
    bound = largest * (np.array(dt) + beyond) + (0.02 * found if " of " in name else 1e-5)
    assert (np.abs(total * np.array(dt) - found) < bound).all()


@pytest.mark.parametrize("where", ["along an interval", "at a point"])
@pytest.mark.parametrize("name", KINDS)
def test_derivatives_are_transposes(name: str, where: str) -> None:
    """<J v, w> = <v, J^T w>, for a tangent that is not 0 where the values are 0; and J v is not 0."""
    part, (ray, t0, t1), on = KINDS[name](), rays(), mi.Bool(True)
    rng = np.random.default_rng(8)
    dr.enable_grad(part.values)
    shape = dr.shape(part.scaled(mi.Float(1)))
    v = rng.normal(size=shape).astype(np.float32)
    w = rng.normal(size=(part.channels, RAYS)).astype(np.float32)
    weight, gradient = [mi.Float(row) for row in w], part.start_gradient()
    with dr.suspend_grad():
        tangent = type(dr.detach(part.values))(v)
        if where == "at a point":
            jvp = numbers(part.jvp_at(tangent, ray, 0.5 * (t0 + t1), on))
            part.vjp_at(gradient, weight, ray, 0.5 * (t0 + t1), on)
        else:
            jvp = numbers(part.jvp(tangent, RayInterval(ray, t0, t1, on)))
            part.vjp(gradient, weight, RayInterval(ray, t0, t1, on))
    dr.backward(dr.sum(dr.ravel(part.scaled(mi.Float(1))) * part.fold_gradient(gradient)))
    vjp = np.array(dr.grad(part.values), np.float64).reshape(shape)
    # Each of the terms is rounded a few times: 1e-6 of the sum of their sizes is 16 roundings of float32 each.
    terms = np.abs(jvp * w).sum() + np.abs(v * vjp).sum()
    assert np.abs(jvp).max() > 0.01
    assert abs((jvp * w).sum() - (v * vjp).sum()) < 1e-6 * terms


def coloured() -> ConstantExtinction:
    return ConstantExtinction("sigma_t", mi.Color3f(0.5, 0.0, 2.0))


def intervals() -> RayInterval:
    """Four intervals of a ray: of length 3, inactive, ending before the beginning, and without end."""
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
    dr.backward(dr.sum(dr.ravel(part.scaled(scale)) * part.fold_gradient(mi.Float(1, 2, 4))))
    np.testing.assert_array_equal(np.array(dr.grad(part.constant)).ravel(), [4, 8, 16])
    assert dr.grad(scale)[0] == 0.5 * 1 + 2.0 * 4


def ball(*sigma: float, scale: float = 2.0) -> BoundedExtinction:
    """A ball of radius 1 about (0, 0, 2)."""
    value = mi.Color3f(*sigma) if len(sigma) == 3 else mi.Float(*sigma)
    return BoundedExtinction("sigma_t", Ball(value, 1.0, (0, 0, 2)), mi.Float(scale), mi.Float(max(sigma)))


def upward(x: float = 0.0) -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(x, 0, 0), mi.Vector3f(0, 0, 1))


def test_the_interval_is_that_of_the_box():
    """A ray at x = 0.9 crosses the box and grazes the ball; a ray at 1.1 misses both."""
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
    dr.backward(dr.sum(dr.ravel(part.scaled(scale)) * part.fold_gradient(gradient)))
    assert dr.grad(scale)[0] == 1.5 + 2 * 0.5 + 4 * 0.25


# -- Channels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("part", "scene"), [(1, 1), (1, 3), (3, 3), (3, 1)])
def test_rows_and_derivatives_are_transposes(part, scene):
    """<rows of v, w> = <v, derivatives of w>; the sums have at most six products, each below 1."""
    rng = np.random.default_rng(part * 10 + scene)
    v, w = rng.uniform(0, 1, (part, 20)), rng.uniform(0, 1, (scene, 20))
    rows = to_scene_channels([mi.Float(x) for x in v], scene)
    derivatives = to_part_channels([mi.Float(x) for x in w], part)
    assert (len(rows), len(derivatives)) == (scene, part)
    left = sum(np.array(r, dtype=np.float64) * x for r, x in zip(rows, w, strict=True))
    right = sum(x * np.array(d, dtype=np.float64) for x, d in zip(v, derivatives, strict=True))
    np.testing.assert_allclose(left, right, atol=6 * 4 * 2.0**-24)


def test_grey_is_the_luminance():
    """White stays 1; the weights of ITU-R BT.709 have six digits and sum to 1 + 4.1e-8."""
    (white,) = to_scene_channels([mi.Float(1)] * 3, 1)
    (green,) = to_scene_channels([mi.Float(0), mi.Float(1), mi.Float(0)], 1)
    assert white[0] == pytest.approx(1, abs=1e-6) and green[0] == pytest.approx(0.71516, rel=1e-6)


def test_a_grey_extinction_gets_the_sum_of_colours():
    assert [x[0] for x in colours_to_channels(mi.Color3f(1, 2, 4), 1)] == [7]
    assert [x[0] for x in colours_to_channels(mi.Color3f(1, 2, 4), 3)] == [1, 2, 4]
