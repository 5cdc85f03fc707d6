"""A point of a bounded extinction, drawn along several intervals: evenly over their lengths in the field's box."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball

from mivol.errors import MivolError
from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.drawn_points import draw_in, start_points
from mivol.transport.media.extinction import RayInterval

pytestmark = pytest.mark.usefixtures("variant_rgb")

N = 1024


def drawn(*intervals: tuple[float, float], on: bool = True) -> tuple[np.ndarray, float]:
    """Points for N even numbers, and the length, of a ray that is in the field's box from 1 to 3."""
    part = BoundedExtinction("sigma_t", Ball(mi.Float(1), 1.0, (0, 0, 2)), mi.Float(1), mi.Float(1))
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    (point,) = start_points(1, (dr.arange(mi.Float, N) + 0.5) / N, N)
    for t0, t1 in intervals:
        point = draw_in(point, part, RayInterval(ray, mi.Float(t0), mi.Float(t1), mi.Bool(on)))
    return np.array(point.t), float(np.array(point.total).max())


def test_one_interval_is_shared_out_evenly():
    t, total = drawn((0, 1.5))
    assert total == 0.5
    np.testing.assert_array_equal(t, 1 + 0.5 * (np.arange(N) + 0.5) / N)


def test_three_intervals_are_shared_out_by_their_lengths():
    """1, 0 (outside) and 0.5: two thirds of the numbers keep the first, and each of the N points has its own 1/N of 1.5."""
    t, total = drawn((1, 2), (4, 5), (2.5, 7))
    assert total == 1.5
    along = np.sort(np.where(t < 2.25, t - 1, t - 1.5))
    # The number of points in an interval is whole: each is at most one place off.
    np.testing.assert_allclose(along, 1.5 * (np.arange(N) + 0.5) / N, atol=1.5 / N)
    assert abs(np.sum(t < 2.25) - N * 2 / 3) <= 1


def test_lanes_that_are_off_have_no_length():
    assert drawn((0, 9), on=False)[1] == 0.0


def test_a_segment_needs_a_random_number_where_something_is_bounded():
    assert start_points(0, None, 1) == []
    with pytest.raises(MivolError, match="which is estimated only"):
        start_points(1, None, 1)
