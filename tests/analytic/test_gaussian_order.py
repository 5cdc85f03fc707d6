"""The order in which a ray meets the peaks of Gaussians, against the sorted list of the float64 twin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians

from mivol.fields.gaussian_line import Line
from mivol.fields.gaussians import GaussianField
from mivol.points.gaussians import Gaussians
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.gaussian_order import SLOTS, visit_from_the_far_end

pytestmark = pytest.mark.usefixtures("variant_rgb")

RAYS = 32


def rays(away: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (RAYS, 3) through the middle, as float32 has them."""
    rng = np.random.default_rng(1)
    o = rng.normal(size=(RAYS, 3))
    o *= away / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.3, 0.3, (RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return o.astype(np.float32).astype(np.float64), d.astype(np.float32).astype(np.float64)


def visited(gaussians: Gaussians, o: np.ndarray, d: np.ndarray, span: tuple[float, float]) -> list[list[int]]:
    """The numbers of the Gaussians that each ray visits, in the order of the visits."""
    part = GaussianExtinction("sigma_t", GaussianField.of(gaussians, np.eye(4)), mi.Float(1))
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    interval = RayInterval(ray, mi.Float64(span[0]), mi.Float64(span[1]), dr.full(mi.Bool, True, len(o)))
    most = gaussians.count
    seen = dr.full(mi.UInt32, most, most * len(o))
    lane = dr.arange(mi.UInt32, len(o))

    def add(count: mi.UInt32, line: Line, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> mi.UInt32:
        dr.scatter(seen, index, lane * most + count)
        return count + 1

    counts = np.array(visit_from_the_far_end(part, interval, dr.zeros(mi.UInt32, len(o)), add))
    table = np.array(seen).reshape(len(o), most)
    return [row[:n].tolist() for row, n in zip(table, counts, strict=True)]


@pytest.mark.parametrize("span", [(0.0, np.inf), (2.6, 3.2), (3.0, np.inf)])
def test_each_is_visited_once_from_the_farthest_peak_on(span: tuple[float, float]) -> None:
    """Wide ones, so that cells hold more than are sorted at once; of an interval those that reach into it."""
    gaussians, (o, d) = random_gaussians(300, 0), rays()
    gaussians.log_scales[:] += 1.5
    cloud, ends = oracle.Cloud.of(gaussians), tuple(np.full(RAYS, t) for t in span)
    hits, order = oracle.find_cut(cloud, o, d, *ends).hits, oracle.order_of(cloud, o, d)
    line = oracle.see(cloud, o, d)
    found = visited(gaussians, o, d, span)
    assert hits.sum(axis=1).max() > 4 * SLOTS
    for ray, numbers in enumerate(found):
        truth = [int(k) for k in order[ray][::-1] if hits[ray, k]]
        assert len(numbers) == len(set(numbers))
        # A Gaussian that a ray touches within rounding may or may not be met.
        for k in set(truth) ^ set(numbers):
            assert np.abs(line.m2[ray, k] - oracle.REACH**2) < 1e-2 or _ends_near(line, ray, k, span)
        peaks = line.peak[ray, numbers]
        assert (np.diff(peaks) < 1e-5).all()


def _ends_near(line: oracle.Lines, ray: int, number: int, span: tuple[float, float]) -> bool:
    """Whether the chord of a Gaussian ends where the interval does."""
    half = np.sqrt(max(oracle.REACH**2 - line.m2[ray, number], 0)) / line.speed[ray, number]
    ends = line.peak[ray, number] + half * np.array([-1, 1])
    return bool(min(abs(ends[1] - span[0]), abs(ends[0] - span[1])) < 1e-4)


def test_of_the_same_peak_the_higher_number_is_farther() -> None:
    gaussians = random_gaussians(3 * SLOTS, 0)
    gaussians.means[:] = 0
    gaussians.log_scales[:], gaussians.quaternions[:] = -1, [1, 0, 0, 0]
    numbers = visited(gaussians, np.array([[0, 0, 3.0]]), np.array([[0, 0, -1.0]]), (0.0, np.inf))
    assert numbers == [list(range(3 * SLOTS))[::-1]]
