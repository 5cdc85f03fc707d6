"""Points drawn uniformly over several intervals, in the box of a bounded field or in some media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball
from refusals import assert_refused

from mivol.transport.media.body import Body
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.media.ray_intervals import (
    RaySegment,
    UniformPoint,
    draw_uniform_point,
    offer_medium_interval,
    start_reservoirs,
)
from mivol.transport.media.scene_media import SceneMedia
from scenes import ball_of, box_of, camera, centred, grid_volume, media_of, medium

N = 1024


def bounded_points(*intervals: tuple[float, float], on: bool = True) -> tuple[np.ndarray, float]:
    """Points for N evenly spaced numbers, and the length, of a ray inside the box of the field from 1 to 3."""
    part = BoundedExtinction("sigma_t", Ball(mi.Float(1), 1.0, (0, 0, 2)), mi.Float(1), mi.Float(1))
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    (point,) = start_reservoirs(1, (dr.arange(mi.Float, N) + 0.5) / N, N)
    for t0, t1 in intervals:
        point = offer_medium_interval(point, part, RayInterval(ray, mi.Float(t0), mi.Float(t1), mi.Bool(on)))
    return np.array(point.t), float(np.array(point.total).max())


def test_one_interval_is_shared_out_evenly():
    t, total = bounded_points((0, 1.5))
    assert total == 0.5
    np.testing.assert_array_equal(t, 1 + 0.5 * (np.arange(N) + 0.5) / N)


def test_three_intervals_are_shared_out_by_their_lengths():
    """1, 0 (outside) and 0.5: two thirds of the numbers keep the first interval, and each of the N points has 1/N of the length
    1.5."""
    t, total = bounded_points((1, 2), (4, 5), (2.5, 7))
    assert total == 1.5
    along = np.sort(np.where(t < 2.25, t - 1, t - 1.5))
    # The number of points in an interval is whole: each is at most one place off.
    np.testing.assert_allclose(along, 1.5 * (np.arange(N) + 0.5) / N, atol=1.5 / N)
    assert abs(np.sum(t < 2.25) - N * 2 / 3) <= 1


def test_lanes_that_are_off_have_no_length():
    assert bounded_points((0, 9), on=False)[1] == 0.0


def test_a_segment_needs_a_random_number_where_something_is_bounded():
    assert start_reservoirs(0, None, 1) == []
    assert_refused("give RaySegment.u", start_reservoirs, 1, None, 1)


LOW, HIGH = (2.0, 3.0), (4.5, 4.75)
"""What the ray along z from z = -3 sees of two boxes, which lie from -1 to 0 and from 1.5 to 1.75."""


def two_boxes(same: bool = False) -> SceneMedia:
    """A grid, whose box need not clip its intervals, and a constant; or one medium behind two traced boundaries."""
    low, high = (centred(np.diag([2, 2, z]), (0, 0, m)) for z, m in ((1, -0.5), (0.25, 1.625)))
    constant = medium("homogeneous", 0.5)
    grid = medium("mivol_medium", grid_volume("mivol_voxels", np.full((3, 2, 4), 0.5), low))
    boxes = {"low": box_of(constant if same else grid, low), "high": box_of(dict(constant), high)}
    return media_of(mi.load_dict({"type": "scene", **boxes, "sensor": camera([0, -1, 6], [0, 0, 0])}))


def even_points(
    media: SceneMedia, length: float = 9.0, x: float = 0.0, among: list[Body] | None = None, on: bool = True
) -> UniformPoint:
    """Points for N evenly spaced numbers, on a ray of some length, by default in all media."""
    ray = mi.Ray3f(mi.Point3f(x, 0, -3), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    u = (dr.arange(mi.Float, N) + 0.5) / N
    passed = RaySegment.upto(ray, dr.zeros(mi.MediumPtr), mi.Float64(length))
    return draw_uniform_point(media, passed, media.bodies if among is None else among, u, dr.full(mi.Bool, on, N))


@pytest.mark.parametrize("same", [False, True], ids=["two media", "one medium, entered twice"])
def test_means_are_integrals(same):
    """The means of t^p times the length are its integrals over both boxes."""
    media = two_boxes(same)
    assert len(media.bodies) == (1 if same else 2) and bool(media.traced) == same
    point = even_points(media)
    assert np.array(point.on).all()
    for power in (0, 1, 2):
        found = np.mean(np.array(point.t) ** power * np.array(point.length))
        exact = sum((b ** (power + 1) - a ** (power + 1)) / (power + 1) for a, b in (LOW, HIGH))
        # A midpoint rule of N steps, of which the one that the boxes share has a jump; boundaries are traced to 1e-5.
        assert found == pytest.approx(exact, abs=(1.25 / N + 4e-5) * 4.75**power)


def test_points_know_their_medium():
    """Four fifths of the length lie in the first box."""
    media = two_boxes()
    point = even_points(media)
    t, body = np.array(point.t), np.array(point.body)
    first = (t >= LOW[0]) & (t <= LOW[1])
    assert abs(first.sum() - 0.8 * N) <= 1
    assert np.all(first | ((t >= HIGH[0]) & (t <= HIGH[1])))
    low = next(k for k, b in enumerate(media.bodies) if b.box.to_world[2, 3] < 0)
    assert np.all(np.where(first, body == low, body == 1 - low))


def test_only_what_the_segment_has_passed_of_the_media_asked_about():
    """The segment ends in the first box; only one of the media counts; the ray misses both; lanes are inactive."""
    media = two_boxes()
    low, high = sorted(media.bodies, key=lambda body: body.box.to_world[2, 3])
    cases = (
        (even_points(media, length=2.25), 0.25),
        (even_points(media, among=[low]), 1.0),
        (even_points(media, among=[high]), 0.25),
    )
    for point, length in cases:
        assert np.array(point.on).all()
        np.testing.assert_allclose(np.array(point.length), length, rtol=4 * 2.0**-23)
    assert not np.array(even_points(media, x=5.0).on).any()
    assert not np.array(even_points(media, on=False).on).any()
    assert not np.array(even_points(media, among=[]).on).any()


def test_intervals_without_end_count_as_empty():
    """Fog without a shape of its own, around a ball: escaping rays have no point in the fog.

    Rays from a surface are as long as the largest float32, the others infinite.
    """
    fog = mi.load_dict(medium("homogeneous", 0.5))
    wall = ball_of(medium("homogeneous", 0.7), (0, 0, 0), 1.0) | {"bsdf": {"type": "diffuse"}, "exterior": fog}
    media = media_of(mi.load_dict({"type": "scene", "wall": wall, "sensor": camera([0, -1, 6], [0, 0, 0]) | {"medium": fog}}))
    ray = mi.Ray3f(mi.Point3f(mi.Float(0, 5, 5), 0, -3), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    around = dr.select(dr.full(mi.Bool, True, 3), mi.MediumPtr(fog), None)
    passed = RaySegment.upto(ray, around, mi.Float64(2, np.inf, dr.largest(mi.Float)))
    point = draw_uniform_point(media, passed, media.bodies, mi.Float(0.5), dr.full(mi.Bool, True, 3))
    assert np.array(point.on).tolist() == [True, False, False]
    assert np.array(point.t)[0] == pytest.approx(1.0, abs=1e-5)
    assert np.array(point.length)[0] == pytest.approx(2.0, abs=1e-5)
