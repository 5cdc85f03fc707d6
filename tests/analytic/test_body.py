"""One medium in its boundary: parts of a walk, extinction with derivatives, and coefficients at points, with answers on
paper.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball
from refusals import assert_refused

from mivol.transport.line_integrals.composite import BodySweep
from mivol.transport.line_integrals.integrand import LineIntegral
from mivol.transport.media.body import Body, eval_albedo, flight_parts, is_followed, medium_interaction
from mivol.transport.media.compositing import CellIntegral, transmittance_of
from mivol.transport.media.extinction import BoundedExtinction, ConstantExtinction, RayInterval
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.lattice import Lattice
from scenes import as_float32, box_of, camera, centred, grid_volume, media_of

UNIT = Box(np.eye(4))
ON = True
ROUNDING = 8 * 2.0**-23
"""A few roundings of numbers of size 1, relative to them."""


def grid(name: str = "sigma_t", n: int = 2, edge: float = 1.0, value: float = 0.5) -> GridExtinction:
    place = centred(edge * np.eye(3), (0.5, 0.5, 0.5))
    return GridExtinction(name, Lattice(mi.TensorXf(np.full((n, n, n, 1), value, np.float32)), place))


def constant(*value: float, name: str = "sigma_a") -> ConstantExtinction:
    return ConstantExtinction(name, mi.Float(*value) if len(value) == 1 else mi.Color3f(*value))


def bounded() -> BoundedExtinction:
    return BoundedExtinction("sigma_t", Ball(mi.Float(1), 0.5, (0.5, 0.5, 0.5)), mi.Float(1), mi.Float(1))


def body_of(*parts: object, box: Box | None = UNIT, **more: object) -> Body:
    return Body(MediumView(None, list(parts), mi.Float(2), **more), box)


def across() -> mi.Ray3f:
    """A ray through the middle of the unit cube, inside from 1 to 2."""
    return mi.Ray3f(mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0))


def inside() -> RayInterval:
    return RayInterval(across(), mi.Float(1), mi.Float(2), mi.Bool(ON))


def values(rows: list[mi.Float]) -> list[float]:
    return [float(row[0]) for row in rows]


def test_a_boundary_cuts_what_does_not_fit_into_it():
    assert not body_of(grid()).cuts_grids and not body_of(grid(edge=1 + 1e-6)).cuts_grids
    assert body_of(grid(edge=1.01)).cuts_grids and body_of(grid(), constant(1.0)).cuts_grids
    assert body_of(grid(), emission_density=mi.Float(1)).cuts_grids
    assert not body_of(constant(1.0), box=None).cuts_grids


def test_free_flights_walk_the_cells_of_the_grid_that_scatters():
    absorbs, scatters, alike, same = grid("sigma_a", 3), grid("sigma_s"), grid("sigma_a"), constant(1.0)
    assert flight_parts([absorbs, scatters, same]) == [scatters, same]
    assert flight_parts([alike, scatters, same]) == [alike, scatters, same]
    assert flight_parts([absorbs, same, bounded()]) == [absorbs, same]
    assert flight_parts([same]) == [same]


def test_optical_depth_is_the_sum_of_the_parts_times_the_scale():
    body, ray = body_of(constant(0.25, 0.5, 1), grid()), across()
    found = body.optical_depth(inside(), 3)
    np.testing.assert_allclose(values(found), [1.5, 2, 3], rtol=ROUNDING)
    only = body.optical_depth(inside(), 3, body.view.parts[1:])
    np.testing.assert_allclose(values(only), [1, 1, 1], rtol=ROUNDING)
    assert values(body.extinction(ray).constant) == [0.5, 1, 2]
    assert values(body.extinction(ray, body.view.parts[:1]).constant) == [0.5, 1, 2]


def test_the_optical_depth_of_a_bounded_field_is_refused():
    body = body_of(bounded(), constant(0.5))
    assert body.is_bounded and not body_of(grid()).is_bounded
    assert_refused("its transmittance instead", body.optical_depth, inside(), 1)
    assert values(body.optical_depth(inside(), 1, body.exact_parts)) == [1.0]


def test_a_point_has_the_parts_that_are_asked_for():
    body, at = body_of(constant(0.25), grid("sigma_s")), (across(), mi.Float(1.5), 3, mi.Bool(ON))
    np.testing.assert_allclose(values(body.extinction_at(*at)), [1.5] * 3, rtol=ROUNDING)
    np.testing.assert_allclose(values(body.extinction_at(*at, "sigma_s")), [1] * 3, rtol=ROUNDING)
    body.tangents = [mi.Float(3), dr.full(mi.Float, 4, 8)]
    body.has_tangent = [True, True]
    np.testing.assert_allclose(values(body.jvp_extinction_at(*at)), [7] * 3, rtol=ROUNDING)
    np.testing.assert_allclose(values(body.jvp_extinction_at(*at, "sigma_s")), [4] * 3, rtol=ROUNDING)
    np.testing.assert_allclose(values(body.jvp_optical_depth(inside(), 3)), [7] * 3, rtol=ROUNDING)


def started(*parts: object, **more: object) -> Body:
    body = body_of(*parts, **more)
    body.gradients = [p.start_gradient() for p in parts]
    return body


def vjp(body: Body) -> list[float]:
    """The sum of the gradient of each part."""
    flat = [g.fold() if hasattr(g, "fold") else g for g in body.gradients]
    return [float(np.array(g).sum()) for g in flat]


def test_gradients_go_to_the_parts_that_are_named():
    weight, ray, t, on = [mi.Float(1), mi.Float(2), mi.Float(4)], across(), mi.Float(1.5), mi.Bool(ON)
    for deposit, expected in {
        "all": (lambda b: b.vjp_extinction_at(ray, t, weight, on), [7, 7]),
        "named": (lambda b: b.vjp_extinction_at(ray, t, weight, on, "sigma_s"), [0, 7]),
        "along": (lambda b: b.vjp_optical_depth(inside(), weight), [7, 7]),
        "constants": (lambda b: b.add_to_constants(weight, on), [7, 0]),
        "a cell": (lambda b: b.add_to_grid(b.view.parts[1], mi.Vector3i(0), [(weight, [mi.Float(0.125)] * 8)], on), [0, 7]),
    }.values():
        body = started(constant(0.25), grid("sigma_s"))
        deposit(body)
        np.testing.assert_allclose(vjp(body), expected, rtol=ROUNDING)


def test_bounded_parts_are_left_out_of_derivatives_along_a_ray():
    body = started(constant(0.25), bounded())
    body.vjp_optical_depth(inside(), [mi.Float(3)])
    assert vjp(body) == [3, 0]
    body.tangents, body.has_tangent = [mi.Float(5), mi.Float(7)], [True, True]
    assert values(body.jvp_optical_depth(inside(), 1)) == [5]


FLAKES = np.array([[4, 1, 0.5], [1, 2, 0.25], [0.5, 0.25, 8]])
"""The matrix S of microflakes."""

ENTRIES = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


def flakes() -> list[mi.Float]:
    return [mi.Float(FLAKES[a, b]) for a, b in ENTRIES]


@pytest.mark.parametrize("where", ["at a point", "along an interval"])
def test_flakes_multiply_the_extinction_by_their_projected_area(where: str) -> None:
    """sigma = sqrt(w S w), with derivatives w w / (2 sqrt(w S w)) by S; an off-diagonal entry occurs twice."""
    d = np.array([0.48, 0.6, 0.64])
    area = np.sqrt(d @ FLAKES @ d)
    slopes = np.array([(1 if a == b else 2) * d[a] * d[b] / (2 * area) for a, b in ENTRIES])
    ray, on, tangent = mi.Ray3f(mi.Point3f(0), mi.Vector3f(d)), mi.Bool(ON), np.array([1, -2, 3, -1, 2, -3])
    body = started(constant(0.5, name="sigma_t"), microflakes=flakes())
    body.tangents, body.has_tangent, body.microflakes_gradient = [mi.Float(0)], [True], dr.zeros(mi.Float, 6)
    body.microflakes_tangent = [mi.Float(t) for t in tangent]
    weight = [mi.Float(3)]
    if where == "at a point":
        (sigma,), (change,) = (f(ray, mi.Float(1), 1, on) for f in (body.extinction_at, body.jvp_extinction_at))
        body.vjp_extinction_at(ray, mi.Float(1), weight, on)
    else:
        interval = RayInterval(ray, mi.Float(1), mi.Float(2), on)
        (sigma,), (change,) = (f(interval, 1) for f in (body.optical_depth, body.jvp_optical_depth))
        body.vjp_optical_depth(interval, weight)
    # The scale is 2 and the constant 0.5.
    assert sigma[0] == pytest.approx(area, rel=ROUNDING)
    assert change[0] == pytest.approx(slopes @ tangent, abs=ROUNDING * np.abs(slopes * tangent).sum())
    np.testing.assert_allclose(np.array(body.microflakes_gradient), 3 * slopes, rtol=2 * ROUNDING)
    assert vjp(body) == [pytest.approx(3 * area, rel=ROUNDING)]


def test_derivatives_of_flakes_are_followed_where_they_are_asked_for():
    plain, asked = flakes(), flakes()
    dr.enable_grad(asked)
    with dr.suspend_grad():
        assert is_followed(asked) and not is_followed(plain) and not is_followed(None)


def test_a_far_point_is_rounded_once():
    """The sum is made in float64; in float32 it would be 16 ulps off, 1e4 in front of a camera 1e4 away."""
    rng = np.random.default_rng(2)
    d = as_float32(rng.normal(size=(3, 64)))
    d = as_float32(d / np.linalg.norm(d, axis=0))
    t = 1e4 + rng.uniform(size=64)
    o = as_float32(-1e4 * d)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d), 0.25, mi.Color0f())
    mei = medium_interaction(ray, mi.Float64(t))
    np.testing.assert_array_equal(np.array(mei.p), (o + t * d).astype(np.float32))
    np.testing.assert_array_equal(np.array(mei.wi), -d.astype(np.float32))
    assert np.array(mei.t).tolist() == t.astype(np.float32).tolist() and mei.time[0] == 0.25
    np.testing.assert_allclose(np.array(mei.sh_frame.n), -d, atol=2.0**-23)


def test_the_medium_is_the_one_that_is_named():
    ray, fog = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)), mi.load_dict({"type": "homogeneous"})
    named, bare = medium_interaction(ray, mi.Float(1), fog), medium_interaction(ray, mi.Float(1))
    assert named.medium == mi.MediumPtr(fog) and bare.medium == None


def test_albedo_of_a_grid_and_of_a_number():
    volume = mi.load_dict(grid_volume("mivol_voxels", np.arange(8.0).reshape(2, 2, 2) / 8))
    ray = mi.Ray3f(mi.Point3f(0.5, 0.25, 0.25), mi.Vector3f(0, 0, 1))
    for albedo, expected in ((volume, 2.5 / 8), (mi.Color3f(0.25, 0.5, 1), [0.25, 0.5, 1]), (mi.Float(0.75), 0.75)):
        view = MediumView(None, [ConstantExtinction("sigma_t", mi.Float(1))], mi.Float(1), albedo=albedo)
        found = eval_albedo(Body(view, None), medium_interaction(ray, mi.Float(0.25)), mi.Bool(True))
        # Float32 weights of eight corners.
        np.testing.assert_allclose(np.array(found).ravel(), np.broadcast_to(expected, 3), rtol=4 * 2.0**-23)


# -- Sweeps of a body --------------------------------------------------------------------------------------------------

N = 5
SIGMA = np.array([0.5, 2.0, 0.25, 1.0, 4.0], np.float32)
"""Voxels of a unit cube along x, in a constant of 0.5 that fills [-1, 2]^3."""

CONSTANT = 0.5
SUM_ROUNDING = 32 * 2.0**-23
"""Bound of the rounding of sums of 7 pieces, with several roundings each, relative to numbers of size 1."""


class Opacity:
    """N = 1 - exp(-tau) of a cell with the mean extinction, or of a constant."""

    rows, points = 1, (0.25, 0.75)

    def integrate_cell(self, piece: object, sigma: list) -> list[CellIntegral]:
        (row,) = sigma
        tau = piece.dt * 0.5 * (row[0] + row[1])
        half, T = 0.5 * piece.dt, dr.exp(-tau)
        return [CellIntegral(tau, T, 1 - T, [half, half], [T * half, T * half])]

    def integrate_constant(self, piece: object, sigma: list) -> list[CellIntegral]:
        T = dr.exp(-sigma[0] * piece.dt)
        return [CellIntegral(sigma[0] * piece.dt, T, 1 - T, [piece.dt], [T * piece.dt])]

    def vjp(self, piece: object, sigma: list, weight: list) -> None:
        """Do nothing: the integrand has no parameters."""

    def jvp(self, piece: object, sigma: list) -> list[mi.Float]:
        return [mi.Float(0)]


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    grid = grid_volume("mivol_voxels", SIGMA.reshape(1, 1, N, 1))
    fog = {"type": "mivol_medium", "sigma_s": grid, "sigma_a": CONSTANT}
    box = box_of(fog, centred(3 * np.eye(3), (0.5, 0.5, 0.5)))
    return media_of(mi.load_dict({"type": "scene", "box": box, "sensor": camera([0, -4, 0], [0, 0, 0])}))


def sweep(media: SceneMedia, tangent: bool = False) -> BodySweep:
    """A sweep along x through the grid, from -1 + 0.5 to 2."""
    ray = mi.Ray3f(mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0), dr.inf, mi.Float(0), mi.Color0f())
    on, (body,) = mi.Bool(True), media.bodies
    line = LineIntegral(media, Opacity(), RaySegment(ray, mi.MediumPtr(None), mi.Float(3)), on)
    return BodySweep(line, MediumInterval(ray, mi.Float64(0.5), mi.Float64(3), on, body), tangent)


TAU = SIGMA.mean() + 2.5 * CONSTANT
"""The trilinear values, with a constant border, have the mean of the voxels."""


def in_order(body: Body, grid: object, constant: object) -> list:
    """One entry for each part of the medium, in order."""
    return [constant if part.lattice is None else grid for part in body.view.parts]


def test_opacities_add_up(media):
    with dr.suspend_grad():
        found = sweep(media).integrate(skip=True)
    assert float(found.tau[0][0]) == pytest.approx(TAU, rel=SUM_ROUNDING)
    assert found.N[0][0] == pytest.approx(1 - np.exp(-TAU), rel=SUM_ROUNDING)


def test_tangents_follow(media):
    """N' = T tau' for any change of the voxels and of the constant."""
    v = np.array([1, -2, 3, -4, 5], np.float32)
    media.bodies[0].tangents = in_order(media.bodies[0], mi.Float(v), mi.Float(0.75))
    with dr.suspend_grad():
        found = sweep(media, tangent=True).integrate(skip=False)
    dtau = v.mean() + 2.5 * 0.75
    assert float(found.tau[1][0]) == pytest.approx(dtau, rel=SUM_ROUNDING * 4)
    assert found.N[1][0] == pytest.approx(np.exp(-TAU) * dtau, abs=SUM_ROUNDING)


def test_the_transpose_gives_each_voxel_its_share(media):
    """weight T_front T over the length of each part, minus the light behind the medium."""
    media.start_gradients()
    front, weight, behind = 0.25, 3.0, 0.125
    with dr.suspend_grad():
        ahead = [mi.Float64(front + TAU)]
        sweep(media).vjp([mi.Float(weight)], ahead, [mi.Float(behind)])
    slope = weight * np.exp(-front - TAU) - behind
    (body,) = media.bodies
    grid, constant = sorted(zip(in_order(body, 0, 1), body.gradients, strict=True), key=lambda pair: pair[0])
    np.testing.assert_allclose(np.array(grid[1].fold()).ravel(), np.full(N, slope / N), atol=SUM_ROUNDING)
    assert np.array(constant[1])[0] == pytest.approx(2.5 * slope, abs=SUM_ROUNDING)


def test_a_depth_that_rounding_left_below_0_lets_all_through():
    found = np.array(transmittance_of(mi.Float64(-1e-9, 0, 1)))
    assert found[:2].tolist() == [1, 1] and found[2] == pytest.approx(np.exp(-1), rel=2 * 2.0**-23)
