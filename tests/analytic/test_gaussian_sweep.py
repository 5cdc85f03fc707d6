"""Light and optical depth of Gaussians over intervals of rays, and their order, compared with the sorted list of the float64
twin.
"""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians

from mivol.fields.gaussian_field import GaussianField
from mivol.fields.gaussian_line import WhitenedLine
from mivol.points.gaussians import Gaussians
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.gaussian_sweep import SLOTS, GaussianSweep, visit_far_to_near

RAYS, ROUNDING = 64, 1e-4
"""ROUNDING as in tests/conformance/test_gaussian_radiance.py."""


def cloud() -> Gaussians:
    found = random_gaussians(60, 2)
    found.means[:] *= 0.5
    found.log_scales[:] += 1.5
    return found


def sweep(gaussians: Gaussians, ends: tuple[np.ndarray, np.ndarray], scale: float, shows: bool, rows: int = 3) -> tuple:
    """Rays (o, d), and the sums along them: N (rows, RAYS) and tau (RAYS,)."""
    rng = np.random.default_rng(1)
    o = rng.normal(size=(RAYS, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.3, 0.3, (RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (v.astype(np.float32).astype(np.float64) for v in (o, d))
    part = GaussianExtinction("sigma_t", GaussianField.from_gaussians(gaussians, np.eye(4)), mi.Float(scale), shows)
    body = SimpleNamespace(view=SimpleNamespace(gaussians=part, scale=mi.Float(scale)), tangents=[])
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    t0, t1 = (mi.Float64(t) for t in ends)
    interval = SimpleNamespace(ray=ray, t0=t0, t1=t1, active=dr.full(mi.Bool, True, RAYS), body=body)
    integral = GaussianSweep(interval, rows).integrate(False)
    return (o, d), np.array([np.array(row) for row in integral.N]), np.array(integral.tau[0])


@pytest.mark.parametrize("span", [(0.0, np.inf), (2.5, 3.3), (3.0, np.inf)])
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_light_over_an_interval_is_that_of_the_twin(span: tuple[float, float], scale: float) -> None:
    gaussians, ends = cloud(), tuple(np.full(RAYS, t) for t in span)
    rays, N, tau = sweep(gaussians, ends, scale, shows=True)
    colour = oracle.colours(gaussians.harmonics.astype(np.float64), rays[1], "srgb")
    light, T = oracle.composite(oracle.Cloud.of(gaussians), colour, rays, ends, scale=scale)
    assert light.max() > 0.1
    np.testing.assert_allclose(N.T, light, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(np.exp(-tau), T, atol=ROUNDING)


def test_gaussians_that_are_not_shown_only_dim() -> None:
    ends = np.zeros(RAYS), np.full(RAYS, np.inf)
    rays, N, tau = sweep(cloud(), ends, 1.0, shows=False)
    assert not N.any()
    truth = oracle.optical_depth(oracle.Cloud.of(cloud()), *rays, *ends)
    np.testing.assert_allclose(tau, truth, rtol=ROUNDING, atol=ROUNDING)


def test_one_row_is_their_luminance() -> None:
    """As in mono variants: ITU-R BT.709."""
    ends = np.zeros(RAYS), np.full(RAYS, np.inf)
    _, rgb, _ = sweep(cloud(), ends, 1.0, shows=True)
    _, grey, _ = sweep(cloud(), ends, 1.0, shows=True, rows=1)
    np.testing.assert_allclose(grey[0], [0.212671, 0.715160, 0.072169] @ rgb, rtol=1e-5, atol=1e-6)


SORTED_RAYS = 32


def rays(away: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (SORTED_RAYS, 3) through the middle, in float32 precision."""
    rng = np.random.default_rng(1)
    o = rng.normal(size=(SORTED_RAYS, 3))
    o *= away / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.3, 0.3, (SORTED_RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return o.astype(np.float32).astype(np.float64), d.astype(np.float32).astype(np.float64)


def visited(gaussians: Gaussians, o: np.ndarray, d: np.ndarray, span: tuple[float, float]) -> list[list[int]]:
    """The numbers of the Gaussians visited by each ray, in the order of the visits."""
    part = GaussianExtinction("sigma_t", GaussianField.from_gaussians(gaussians, np.eye(4)), mi.Float(1))
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    interval = RayInterval(ray, mi.Float64(span[0]), mi.Float64(span[1]), dr.full(mi.Bool, True, len(o)))
    most = gaussians.count
    seen = dr.full(mi.UInt32, most, most * len(o))
    lane = dr.arange(mi.UInt32, len(o))

    def add(count: mi.UInt32, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> mi.UInt32:
        dr.scatter(seen, index, lane * most + count)
        return count + 1

    counts = np.array(visit_far_to_near(part, interval, dr.zeros(mi.UInt32, len(o)), add))
    table = np.array(seen).reshape(len(o), most)
    return [row[:n].tolist() for row, n in zip(table, counts, strict=True)]


@pytest.mark.parametrize("span", [(0.0, np.inf), (2.6, 3.2), (3.0, np.inf)])
def test_each_is_visited_once_from_the_farthest_peak_on(span: tuple[float, float]) -> None:
    """Wide Gaussians, so cells hold more than are sorted at once; an interval visits the Gaussians reaching into it."""
    gaussians, (o, d) = random_gaussians(300, 0), rays()
    gaussians.log_scales[:] += 1.5
    cloud, ends = oracle.Cloud.of(gaussians), tuple(np.full(SORTED_RAYS, t) for t in span)
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
    """Whether the chord of a Gaussian ends at the end of the interval."""
    half = np.sqrt(max(oracle.REACH**2 - line.m2[ray, number], 0)) / line.speed[ray, number]
    ends = line.peak[ray, number] + half * np.array([-1, 1])
    return bool(min(abs(ends[1] - span[0]), abs(ends[0] - span[1])) < 1e-4)


def test_of_the_same_peak_the_higher_number_is_farther() -> None:
    gaussians = random_gaussians(3 * SLOTS, 0)
    gaussians.means[:] = 0
    gaussians.log_scales[:], gaussians.quaternions[:] = -1, [1, 0, 0, 0]
    numbers = visited(gaussians, np.array([[0, 0, 3.0]]), np.array([[0, 0, -1.0]]), (0.0, np.inf))
    assert numbers == [list(range(3 * SLOTS))[::-1]]
