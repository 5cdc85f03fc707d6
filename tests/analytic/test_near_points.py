"""Points of near light in thin grids, against quadrature in float64."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle
import pytest
from false_alarms import Estimate, assert_same_mean, fresh
from scattering_scenes import PLACE, close_up, rough_grid

from mivol.transport.estimators.lighting.emitters import EquiangularSampler, make_ball_sampler
from mivol.transport.estimators.single_scattering.near_points import NearPoint, draw_near_point
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.traversal.random_numbers import seed_pcg32
from scenes import box_of, grid_volume, media_of

N = 1 << 16
ORIGIN, TOWARDS, LENGTH = np.array([-3.0, -0.4, 0.3]), np.array([0.96, 0.28, 0.0]), 3.6
LAMP = np.array([0.1, 0.7, 0.2])
"""A ray that enters the box [-1, 1]^3 behind 2.08 and ends inside, and a lamp beside it."""


def draw(values: np.ndarray, probe_depth: float = 0.0) -> NearPoint:
    """Points of ``N`` equal rays through a grid."""
    interior = {"type": "mivol_medium", "albedo": 0.5, "sigma_t": grid_volume("mivol_voxels", values, PLACE)}
    media = media_of(close_up({"smoke": box_of(interior, PLACE)}, res=1))
    media.bodies[0].view.parts[0].largest = mi.Float(float(values.max()))
    o, d = dr.full(mi.Point3f, 0, N) + mi.Point3f(ORIGIN.tolist()), mi.Vector3f(TOWARDS.tolist())
    ray = mi.Ray3f(o, d, 10, mi.Float(0), mi.Color0f())
    rng = seed_pcg32(mi.Float((0.7 + 0.618 * fresh(0)) % 1), N)
    passed = RaySegment(ray, dr.zeros(mi.MediumPtr, N), mi.Float(LENGTH))
    return draw_near_point(media, passed, angle_of(ray), probe_depth, rng, mi.Bool(True))


def angle_of(ray: mi.Ray3f) -> EquiangularSampler:
    return make_ball_sampler(ray, [*LAMP.tolist(), 0.0])


def along(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Extinction (points, channels) at distances along the ray, 0 outside of the box."""
    q, d = oracle.to_lattice(values, PLACE, ORIGIN, TOWARDS)
    p = ORIGIN + t[:, None] * TOWARDS
    inside = np.all(np.abs(p) < 1, axis=1)
    return np.where(inside[:, None], oracle.trilinear(values, q + t[:, None] * d), 0)


def squared_distance(t: np.ndarray) -> np.ndarray:
    return np.sum((ORIGIN + t[:, None] * TOWARDS - LAMP) ** 2, axis=1)


RGB = np.concatenate([rough_grid(3), 0.3 * rough_grid(4), 0.05 * rough_grid(5)], axis=-1)
GRIDS = {"thin": 0.3 * rough_grid(1), "roulette": 4 * rough_grid(2), "rgb": RGB, "holes": np.maximum(rough_grid(6) - 0.6, 0)}


@pytest.mark.statistical
@pytest.mark.parametrize("probe_depth", [0.0, 4.0], ids=["image", "derivatives"])
@pytest.mark.parametrize("name", GRIDS)
def test_means_are_integrals_along_the_ray(name: str, probe_depth: float) -> None:
    """The mean of the reach times a function of place and extinction is its integral times the transmittance, in each channel:
    of the scattered light, and of that in the half near the camera. Derivatives ask for functions of the place alone, too.
    """
    values = GRIDS[name]
    point = draw(values, probe_depth)
    t, reach, on, here = (np.array(a, np.float64) for a in (point.t, point.reach, point.on, point.sigma_t))
    assert np.all(reach >= 0) and np.all(reach[:, on == 0] == 0) and np.mean(on) > 0.99

    # The box is entered at 2 / 0.96; 4e5 steps of the trapezium rule have errors below 1e-9.
    steps = np.linspace(2 / 0.96, LENGTH, 400_001)
    sigma = along(values, steps)
    tau = np.zeros_like(sigma)
    tau[1:] = np.cumsum((sigma[1:] + sigma[:-1]) / 2, axis=0) * (steps[1] - steps[0])
    functions = {
        "scattered": lambda s, t: s / squared_distance(t),
        "in front": lambda s, t: np.where(t < 2.8, s, 0),
        "even": lambda s, t: 1 / squared_distance(t),
    }
    for what, f in functions.items():
        if what == "even" and not probe_depth:
            continue
        for c in range(sigma.shape[1]):
            truth = np.trapezoid(np.exp(-tau[:, c]) * f(sigma[:, c], steps), steps)
            found = reach[c] * f(here[c], t)
            lanes = Estimate(found.mean(), found.var(ddof=1) / N, N - 1)
            assert_same_mean(lanes, truth, rounding=1e-4 * truth, what=f"{what}, channel {c}")


def test_in_an_empty_grid_points_are_spread_over_the_angle() -> None:
    """Derivatives of an empty grid: all points have one weight, so the reach times 1 / r^2 is the angle over its height."""
    point = draw(np.zeros((4, 4, 4, 1), np.float32), 4.0)
    t, reach = np.array(point.t), np.array(point.reach)[0]
    begin, end = ((ORIGIN + s * TOWARDS - LAMP) for s in (2 / 0.96, LENGTH))
    height = np.linalg.norm(np.cross(begin, TOWARDS))
    low, high = (np.arctan(p @ TOWARDS / height) for p in (begin, end))
    # Coordinates near 3 have errors of 2^-22, 1e-6 of the height.
    np.testing.assert_allclose(reach / squared_distance(t), (high - low) / height, rtol=2e-5)
    share = (np.arctan((t - t.mean() + (ORIGIN + t.mean() * TOWARDS - LAMP) @ TOWARDS) / height) - low) / (high - low)
    counts = np.histogram(share, 12, (0, 1))[0]
    # Twelve bins of equal chance: counts have the standard deviation sqrt(N / 12 x 11 / 12) = 71; six of them.
    assert counts.sum() == N and np.all(np.abs(counts - N / 12) < 6 * 71)


def test_an_empty_grid_scatters_no_light() -> None:
    point = draw(np.zeros((4, 4, 4, 1), np.float32))
    assert not np.any(point.on) and not np.any(np.array(point.reach))
