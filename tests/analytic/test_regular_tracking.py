"""Regular tracking: the optical depth of the first collision, in constants, grids and Gaussians, against the float64 twin.

Bounds. Depths of walks are exact to BOUND of tau_scale. In the cell of the collision a cubic is inverted, to 1.4e-4 of the
largest extinction times the length of the piece (derived in test_interpolation.py), which is at most the diagonal of a cell.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, fresh
from hard_rays import BOUND
from oracle import tau_scale, tau_twin, to_lattice, trilinear
from scattering_scenes import PLACE, aimed, rough_grid
from scipy.special import logit

from mivol.fields import gaussian_field
from mivol.fields.activation import select_activation
from mivol.fields.gaussian_field import GaussianField
from mivol.points.gaussians import Gaussians
from mivol.transport.estimators.flights.free_flight import regular_tracking, sample_gaussian_flight
from mivol.transport.media.extinction import ConstantExtinction, ExactExtinction, RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.grid_extinction import ActivatedGridExtinction, GridExtinction
from mivol.transport.traversal.random_numbers import seed_pcg32
from scenes import as_float32, make_lattice, to_lanes

N, SCALE = 96, 1.5
ROUNDING = 4 * 2.0**-23


def rays(o: np.ndarray, d: np.ndarray) -> mi.Ray3f:
    return mi.Ray3f(*to_lanes(o, d))


def goals(seed: int = 1) -> np.ndarray:
    """Optical depths of free flights."""
    return as_float32(-np.log(np.random.default_rng(seed).uniform(0, 1, N)))


def fly(
    part: ExactExtinction, ray: mi.Ray3f, t0: object, t1: object, goal: np.ndarray, channel: object = 0, on: bool = True
) -> np.ndarray:
    ends = [mi.Float64(x) if np.ndim(x) else mi.Float64(float(x)) for x in (t0, t1)]
    interval = RayInterval(ray, *ends, mi.Bool(on))
    with dr.suspend_grad():
        return np.array(regular_tracking(part, mi.Float(SCALE), interval, mi.Float(goal), mi.UInt32(channel))[0])


@pytest.mark.parametrize("case", ["all of the ray", "part of the ray", "rgb", "empty blocks skipped"])
def test_the_depth_to_a_collision_is_the_goal(case):
    """The optical depth up to the collision is the goal; an interval with less has no collision. ``rgb`` follows one channel in
    each lane."""
    (o, d), goal = aimed(3, N), goals()
    t0, t1, channel = np.zeros(N), np.full(N, np.inf), np.zeros(N, int)
    values = rough_grid(1)
    if case == "part of the ray":
        # The rays come from a distance of 3, and the box is within 1.8 of its middle: they begin and end in it.
        t0, t1 = as_float32(np.random.default_rng(2).uniform([[2], [3]], [[3], [5]], (2, N)))
    elif case == "rgb":
        values, channel = rough_grid(1, 1.0) * as_float32([0.3, 2.0, 6.0]), np.arange(N) % 3
    elif case == "empty blocks skipped":
        values = rough_grid(1, 9.0, (5, 4, 24))
        values[..., 3:21, :] = 0
    part = GridExtinction("sigma_t", make_lattice(values, PLACE, skip=case == "empty blocks skipped"))
    t = fly(part, rays(o, d), t0, t1, goal, channel)
    of = np.arange(N), channel
    whole = SCALE * tau_twin(values, PLACE, o, d, t0, t1)[of]
    diagonal = np.linalg.norm(2 / np.array(values.shape[:3]))
    allowed = SCALE * (BOUND * tau_scale(values, PLACE, o, d, t0, t1)[of] + 1.4e-4 * diagonal * values.max())
    met = np.isfinite(t)
    assert 0.2 < met.mean() < 0.9
    assert np.all(met[whole > goal + allowed]) and not met[whole < goal - allowed].any()
    reached = SCALE * tau_twin(values, PLACE, o, d, t0, np.where(met, t, 0))[of]
    np.testing.assert_array_less(np.abs(reached - goal)[met], allowed[met])
    assert np.all((t >= t0)[met]) and np.all((t <= t1)[met])


def test_a_flight_through_an_rgb_grid_knows_its_density_in_each_channel() -> None:
    """exp(-tau) sigma at a collision and exp(-tau) at the end, of each channel, relative to the largest."""
    (o, d), goal, channel = aimed(3, N), goals(), np.arange(N) % 3
    rough = np.concatenate([rough_grid(seed) for seed in (1, 4, 5)], axis=-1)
    values = rough * as_float32([0.3, 1.0, 2.0])
    part = GridExtinction("sigma_t", make_lattice(values, PLACE))
    interval = RayInterval(rays(o, d), mi.Float64(0), mi.Float64(np.inf), mi.Bool(True))
    with dr.suspend_grad():
        t, found = regular_tracking(part, mi.Float(SCALE), interval, mi.Float(goal), mi.UInt32(channel))
    t, found = np.array(t), np.array(found, np.float64)
    met = np.isfinite(t)
    assert 0.2 < met.mean() < 0.9
    expected = np.exp(-SCALE * tau_twin(values, PLACE, o, d, 0.0, t)).T
    places = o + np.where(met, t, 0)[:, None] * d
    q = np.array([to_lattice(values, PLACE, p, p)[0] for p in places])
    expected = np.where(met, expected * trilinear(values, q).T, expected)
    expected /= expected.max(axis=0)
    # Optical depths of up to 9 are known to 1e-6 of it.
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_constants_are_left_after_the_goal_over_the_extinction():
    """t0 + goal / (scale sigma), up to the end of the interval; no collision in vacuum and in inactive lanes."""
    ray, goal = rays(np.zeros((1, 3)), np.float64([[0, 0, 1]])), np.array([0.25, 1.0, 4.0])
    grey = ConstantExtinction("sigma_t", mi.Float(0.5))
    expected = 2 + goal / (SCALE * 0.5)
    np.testing.assert_allclose(fly(grey, ray, 2, np.inf, goal), expected, rtol=ROUNDING)
    assert np.isfinite(fly(grey, ray, 2, 4, goal)).tolist() == [True, True, False]
    assert np.isinf(fly(grey, ray, 2, np.inf, goal, on=False)).all()
    assert np.isinf(fly(ConstantExtinction("sigma_t", mi.Float(0)), ray, 2, np.inf, goal)).all()
    rgb = ConstantExtinction("sigma_t", mi.Color3f(0, 0.5, 4))
    found = fly(rgb, ray, 2, np.inf, np.float64([1, 1, 1]), np.arange(3))
    np.testing.assert_allclose(found, [np.inf, 2 + 1 / (SCALE * 0.5), 2 + 1 / (SCALE * 4)], rtol=ROUNDING)


def test_an_activation_makes_the_extinction():
    """The extinction is exp(log 2) = 2 between 1 and 2, and 0 outside (not exp(0) = 1)."""
    values = np.full((2, 3, 2, 1), np.log(2))
    part = ActivatedGridExtinction("sigma_t", make_lattice(values, np.eye(4)), select_activation("exp"))
    goal = np.array([0.3, 1.5, 2.9, 3.1])
    found = fly(part, rays(np.float64([[-1, 0.4, 0.3]]), np.float64([[1, 0, 0]])), 0, np.inf, goal)
    # An exponential of a few roundings, and a goal and a distance of about 2.
    np.testing.assert_allclose(found, [1.1, 1.5, 1 + 2.9 / 3, np.inf], rtol=2 * ROUNDING)


def test_lanes_that_are_off_do_not_collide_with_a_grid():
    part = GridExtinction("sigma_t", make_lattice(rough_grid(1), PLACE))
    assert np.isinf(fly(part, rays(*aimed(3, N)), 0, np.inf, np.full(N, 1e-3), on=False)).all()


def test_a_mono_variant_flies_through_the_luminance():
    """The luminance of extinctions 0.2, 1 and 3 in the channels is 0.9742, with Mitsuba's weights (ITU-R BT.709)."""
    try:
        mi.set_variant("llvm_ad_mono")
        values = np.broadcast_to([0.2, 1.0, 3.0], (2, 2, 2, 3))
        part = GridExtinction("sigma_t", make_lattice(values, np.eye(4)))
        t = fly(part, rays(np.float64([[-1, 0.4, 0.3]]), np.float64([[1, 0, 0]])), 0, np.inf, np.array([0.3, 1.0]))
    finally:
        mi.set_variant("llvm_ad_rgb")
    sigma = 0.212671 * 0.2 + 0.715160 * 1.0 + 0.072169 * 3.0
    np.testing.assert_allclose(t, 1 + np.array([0.3, 1.0]) / (SCALE * sigma), rtol=2 * ROUNDING)


FLIGHTS, GAUSSIAN_SCALE = 1 << 16, 0.6


@pytest.mark.statistical
@pytest.mark.parametrize("cells", [0.5, 50.0])
def test_flights_end_where_the_depth_of_the_twin_says(cells: float, variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The share of flights ending before t is 1 - exp(-tau(t)), with few and many cells; the other flights are infinite."""
    monkeypatch.setattr(gaussian_field, "CELLS_PER_GAUSSIAN", cells)
    rng = np.random.default_rng(0)
    means, scales = np.linspace([-1, 0, 0], [1, 0, 0], 20) + rng.uniform(-0.3, 0.3, (20, 3)), rng.uniform(0.1, 0.4, (20, 3))
    turns, opacities = rng.normal(size=(20, 4)), rng.uniform(0.05, 0.5, 20)
    # The long one is entered first, and the small one may end a flight before it does.
    means[:2], scales[:2], turns[:2], opacities[:2] = [[0.5, 0, 0], [-1, 0, 0]], [[1, 0.3, 0.3], [0.1] * 3], [1, 0, 0, 0], 0.9
    gaussians = Gaussians(means, np.log(scales), turns, logit(opacities), np.zeros((20, 1, 3)))
    part = GaussianExtinction("sigma_t", GaussianField.from_gaussians(gaussians, np.eye(4)), mi.Float(GAUSSIAN_SCALE))
    o, d, end = np.array([[-4.0, 0.1, 0.05]]), np.array([[1.0, 0.0, 0.0]]), 4.8
    ray = mi.Ray3f(dr.zeros(mi.Point3f, FLIGHTS) + mi.Point3f(*o[0].tolist()), mi.Vector3f(*d[0].tolist()))
    interval = RayInterval(ray, mi.Float64(0), mi.Float64(end), dr.full(mi.Bool, True, FLIGHTS))
    seed = mi.Float(np.random.default_rng(fresh(3)).uniform())
    t = np.array(sample_gaussian_flight(part, mi.Float(GAUSSIAN_SCALE), interval, seed_pcg32(seed, FLIGHTS))[0])
    twin = oracle.Cloud.of(gaussians)
    assert (np.isinf(t) | (t <= end + 1e-5)).all()
    for place in np.linspace(2.6, end, 6):
        tau = GAUSSIAN_SCALE * oracle.optical_depth(twin, o, d, np.zeros(1), np.full(1, place))[0]
        ended = t < (np.inf if place == end else place)
        shares = ended.reshape(64, -1).mean(axis=1)
        found = Estimate(shares.mean(), shares.var(ddof=1) / 64, 63)
        assert_same_mean(found, -np.expm1(-tau), rounding=1e-5, what=f"flights that end before {place:.2f}")
        assert_precise(found, 0.004, what="the share")
