"""Ratio tracking and delta tracking in grids with block ranges and in bounded fields, against exact walks.

Every estimate of a transmittance T lies in [0, 1], so its variance is at most T (1 - T) for any distribution. Bernstein's
inequality then bounds the error of a mean of R estimates by sqrt(2 v q / R) + q / (3 R), except with a probability of 2
exp(-q).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bounded_ball import Ball
from false_alarms import Estimate, assert_rate, assert_same_mean, assert_within, fresh
from oracle import tau_twin, to_lattice, trilinear
from scattering_scenes import PLACE, aimed, assert_same_images, cases, close_up, mivol, point, rough_grid, smoke, sun

import scenes
from mivol.experiments.script import explain
from mivol.transport.estimators.flights import tracking
from mivol.transport.estimators.flights.free_flight import FreeFlight, _channel_probabilities, regular_tracking
from mivol.transport.estimators.flights.tracking import (
    LOOKUP_RATE,
    delta_tracking,
    delta_tracking_in_blocks,
    ratio_tracking,
    ratio_tracking_in_grid,
    residual_ratio_tracking,
)
from mivol.transport.estimators.scores import IMAGE
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.media.grid_extinction import GridExtinction, integrate_segment
from mivol.transport.traversal.grid_blocks import find_block_ranges
from mivol.transport.traversal.lattice import Lattice, clip_to_grid
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, seed_pcg32
from mivol.transport.traversal.rays import FineRay
from mivol.validate.statistics import Moments
from scenes import as_float32, make_lattice, media_of, refused

Q = 25.0
"""2 exp(-25) = 3e-11: the chance of each of the means that are compared here, some 100 in a test."""

RAYS, REPEATS = 32, 8192


def steps(shape: tuple[int, ...], top: float) -> np.ndarray:
    """Values 0 or ``top``, in cubes of three voxels: every edge is sharp."""
    z, y, x = np.indices(shape) // 3
    return as_float32(top * ((x + y + z) % 2))[..., None]


def one_dense(shape: tuple[int, ...], top: float) -> np.ndarray:
    values = np.zeros((*shape, 1), np.float32)
    values[shape[0] // 2, shape[1] // 2, shape[2] // 2] = top
    return values


FIELDS = {
    "rough": lambda: rough_grid(1, 4.0, (17, 21, 30)),
    "edges": lambda: steps((20, 19, 18), 3.0),
    "empty": lambda: np.zeros((12, 12, 12, 1), np.float32),
    "one voxel": lambda: np.full((1, 1, 1, 1), 0.7, np.float32),
    "a sheet of voxels": lambda: rough_grid(2, 2.0, (1, 9, 33)),
    "one dense voxel": lambda: one_dense((16, 16, 16), 500.0),
    "tau 1e-3": lambda: rough_grid(3, 1e-3, (12, 10, 9)),
    "tau 1e3": lambda: rough_grid(4, 2e3, (12, 10, 9)),
    "rgb": lambda: rough_grid(5, 1.0, (18, 9, 10)) * as_float32([0.2, 2.0, 6.0]),
}


def grid(values: np.ndarray, shift: int | None = None) -> Lattice:
    lattice = Lattice(mi.TensorXf(np.ascontiguousarray(values)), np.array(PLACE))
    lattice.block_ranges = find_block_ranges(lattice.values, shift)
    return lattice


def start(number: float) -> mi.Float:
    """Seed of the generators in this round of seeds: a number in [0, 1)."""
    return mi.Float((number + fresh(0) * 0.6180339887498949) % 1)


def estimates(lattice: Lattice, scale: float = 1.0, rate: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """[channel, repeat, ray] estimates along random rays, and [channel, ray] exact transmittances in float64.

    With a ``rate`` [1/length] the estimates are those of look-ups without a walk.
    """
    o, d = (np.tile(v, (REPEATS, 1)).T for v in aimed(7, RAYS))
    o, d = mi.Point3f(o), mi.Vector3f(d)
    n, segment = RAYS * REPEATS, clip_to_grid(lattice, o, d, 0, dr.inf)
    rng, on = seed_pcg32(start(0.3), n), mi.Bool(True)
    if rate is None:
        found, _ = residual_ratio_tracking(lattice, segment, mi.Float(scale), rng, on)
    else:
        found, _ = ratio_tracking_in_grid(lattice, segment, mi.Float(scale), mi.Float(rate), rng, on)
    exact = integrate_segment(lattice, lattice.values.array, segment)
    T = [np.exp(-scale * np.array(t, dtype=np.float64)[:RAYS]) for t in exact]
    return np.array([np.array(f, dtype=np.float64).reshape(REPEATS, RAYS) for f in found]), np.array(T)


def bound(variance: np.ndarray, count: int) -> np.ndarray:
    """Bound on the error of a mean of `count` estimates of at most this `variance`, but for a probability of 2 exp(-Q)."""
    return np.sqrt(2 * variance * Q / count) + Q / (3 * count)


def assert_means(found: np.ndarray, T: np.ndarray, variance: np.ndarray, count: int) -> None:
    # Exact walks err by 2e-6 of the optical depth, which is T tau <= 0.4 of the transmittance.
    chance = 2 * np.exp(-Q) * np.size(found)
    assert_within(found - T, bound(variance, count) + 1e-6, chance=chance, what="transmittances")


@pytest.mark.slow_for("rgb")
@pytest.mark.statistical
@pytest.mark.parametrize("name", cases(FIELDS, ["empty", "one voxel", "a sheet of voxels", "one dense voxel", "tau 1e-3"]))
def test_estimates_have_the_exact_mean(name):
    """The mean of each ray, and the mean of all rays together, which detects a bias sqrt(32) times smaller."""
    found, T = estimates(grid(FIELDS[name]()))
    assert found.min() >= 0 and found.max() <= 1
    variance = T * (1 - T)
    assert_means(found.mean(axis=1), T, variance, REPEATS)
    assert_means(found.mean(axis=(1, 2)), T.mean(axis=1), variance.mean(axis=1), RAYS * REPEATS)


@pytest.mark.slow_for("rough")
@pytest.mark.statistical
@pytest.mark.parametrize("name", ["rough", "edges", "a sheet of voxels", "tau 1e-3", "rgb"])
def test_look_ups_have_the_exact_mean(name):
    """With a scale, at the smallest rate, of which the values reach all."""
    values = FIELDS[name]()
    found, T = estimates(grid(values), scale=0.4, rate=0.4 * values.max() * (1 + 1e-6))
    assert found.min() >= 0 and found.max() <= 1
    assert_means(found.mean(axis=1), T, T * (1 - T), REPEATS)
    assert_means(found.mean(axis=(1, 2)), T.mean(axis=1), (T * (1 - T)).mean(axis=1), RAYS * REPEATS)


@pytest.mark.statistical
def test_look_ups_vary_as_derived():
    """T^2 (exp(tau sigma / rate) - 1) in a grid of one value, here with 4 look-ups for each unit of the optical depth."""
    found, T = estimates(grid(np.full((9, 9, 9, 1), 0.5, np.float32)), rate=2.0)
    second = T**2 * np.exp(-np.log(T) / 4)
    assert_means((found**2).mean(axis=1), second, second * (1 - second), REPEATS)


def test_look_ups_leave_out_lanes_that_are_off():
    lattice, (o, d) = grid(FIELDS["rough"]()), (mi.Point3f(0, 0, -5), mi.Vector3f(0, 0, 1))
    segment = clip_to_grid(lattice, o, d, 0, dr.inf)
    on = mi.Bool([True, False])
    (T,), _ = ratio_tracking_in_grid(lattice, segment, mi.Float(1), mi.Float(1e3), seed_pcg32(start(0.1), 2), on)
    assert T[0] < 1 and T[1] == 1


@pytest.mark.statistical
def test_a_scale_counts():
    found, T = estimates(grid(FIELDS["rough"]()), scale=0.4)
    assert_means(found.mean(axis=1), T, T * (1 - T), REPEATS)


def test_channels_are_drawn_by_their_throughput(variant_rgb: str) -> None:
    """Alike on a path without throughput, whose derivative by an albedo of 0 is not 0."""
    found = [[float(p[0]) for p in _channel_probabilities(mi.Spectrum(beta))] for beta in ([3.0, 1.0, 0.0], [0.0] * 3)]
    np.testing.assert_allclose(found, [[3 / 4, 1 / 4, 0], [1 / 3] * 3], rtol=1e-6)


def test_nothing_is_noisy_where_nothing_varies():
    """Blocks of one value need no look-up: the estimate is exact, up to rounding."""
    found, T = estimates(grid(np.full((9, 9, 9, 1), 0.5, np.float32)))
    # 30 steps, each of which rounds an optical depth of 1 by 6e-8.
    assert np.allclose(found, T[:, None], rtol=5e-6)


@pytest.mark.statistical
def test_variance_is_as_derived():
    """T^2 (exp(int E(c - m)^2 / (kappa (M - m)) dt) - 1) along the x axis, through one block whose values rise along x."""
    values = np.zeros((7, 7, 7, 1), np.float32)
    values[..., 0] = 0.1 + 0.15 * np.arange(7)
    lattice, n = grid(values, shift=3), 1 << 19
    o = mi.Point3f(dr.full(mi.Float, -2, n), mi.Float(0), mi.Float(0))
    segment = clip_to_grid(lattice, o, mi.Vector3f(1, 0, 0), 0, dr.inf)
    found, _ = residual_ratio_tracking(lattice, segment, mi.Float(1), seed_pcg32(start(0.7), n), mi.Bool(True))
    found = np.array(found[0], dtype=np.float64)
    f = (np.arange(1000) + 0.5) / 1000
    low, high = values[0, 0, :-1, 0] - 0.1, values[0, 0, 1:, 0] - 0.1
    # Two half voxels at the ends, of constant value; 2 / 7 of a length a cell.
    square = np.mean((1 - f) * low[:, None] ** 2 + f * high[:, None] ** 2, axis=1).sum() + 0.5 * (low[0] ** 2 + high[-1] ** 2)
    T = np.exp(-values[0, 0, :, 0].sum() * 2 / 7)
    variance = T**2 * np.expm1(square * 2 / 7 / (tracking.LOOKUP_RATE * 0.9))
    assert T > 3 * tracking.ROULETTE_BELOW * 0.9
    # The midpoints of the square's integral err by 1e-6, optical depths of 1 by 2e-6.
    assert_same_mean(Moments.from_values((found - T) ** 2), variance, rounding=1e-5 * variance, what="variances")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", cases(["rough", "rgb"], ["rough"]))
def test_pictures_have_the_same_mean(name):
    """Images with exact and estimated shadows, under a sky and an emitter."""
    parts = {"smoke": smoke(FIELDS[name]() * 0.5, name="hg", g=0.4)[0], "bulb": point([1.5, -1.2, 1.6])[0]}
    scene = close_up({**parts, "sky": scenes.sky(0.3)}, res=8)
    one, other = mivol(shadows="estimated"), mivol(shadows="exact")
    assert_same_images(scene, (64, 64), ours=one, stock=other)
    # Of one seed the two differ by the estimates alone, which err by per cents: they are not exact shadows by another name.
    image, exact = (scenes.render(scene, shadows, 4, seed=1) for shadows in (one, other))
    assert np.abs(image - exact).max() > 1e-3 * exact.max()


def test_gradients_have_exact_shadows():
    """Gradients are equal up to the order of sums for both kinds of shadows in images; estimates would change them by per
    cents."""
    scene = close_up({"smoke": smoke(rough_grid(1))[0], "sky": scenes.sky(0.3)}, res=4)
    params, key, found = mi.traverse(scene), "smoke.interior_medium.sigma_t.data", []
    for shadows in ("exact", "estimated"):
        dr.enable_grad(params[key])
        integrator = mi.load_dict(mivol(shadows=shadows))
        integrator.render_backward(scene, params, mi.TensorXf(np.ones((4, 4, 3), np.float32)), seed=3, spp=4)
        found.append(np.array(dr.grad(params[key])))
        dr.disable_grad(params[key])
    assert np.allclose(*found, rtol=1e-4, atol=1e-6)


def test_fine_grids_are_looked_up():
    """The plan names the estimated shadows, and the reason."""
    emitter, fine = scenes.sky(0.3), np.full((160, 160, 8, 1), 0.1, np.float32)
    coarse, dense = (explain(close_up({"smoke": smoke(v)[0], "sky": emitter}, res=4), 2) for v in (fine[::8, ::8], fine))
    assert "shadows of smoke" in coarse and "estimated" not in coarse
    assert "estimated" in dense and "328 occupied cells" in dense
    sparse = fine.copy()
    sparse[8:] = 0
    assert "estimated" not in explain(close_up({"smoke": smoke(sparse)[0], "sky": emitter}, res=4), 2)


def test_one_grid_beside_fog_is_estimated():
    """A medium with blocks makes all shadows of the scene estimated, visible by the noise: both images have the same seed."""
    fog = scenes.ball_of(scenes.medium("homogeneous", 0.5), (4, 0, 0), 0.5)
    scene = close_up({"smoke": smoke(rough_grid(1))[0], "fog": fog, "sun": sun([0.3, 0.2, -1.0])[0]}, res=4)
    exact, estimated = (
        np.array(mi.render(scene, integrator=mi.load_dict(mivol(shadows=shadows)), spp=4, seed=1))
        for shadows in ("exact", "estimated")
    )
    assert np.abs(estimated - exact).max() > 1e-3 * exact.max()


def test_estimated_shadows_see_the_area_of_microflakes():
    """Nothing varies in a block of one value, so the estimate is the exact shadow, also of flakes of area 0.6 to 1."""
    flakes = np.array([1, 0.36, 0.64, 0, 0, 0], np.float32).reshape(1, 1, 1, 6)
    cube = smoke(np.full((4, 4, 4, 1), 0.7, np.float32))[0]
    cube["interior"]["phase"] = {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(flakes), "raw": True}}
    scene = close_up({"smoke": cube, "sun": sun([0.3, 0.2, -1.0])[0]}, res=4)
    exact, estimated = (scenes.render(scene, mivol(shadows=shadows), 4, seed=1) for shadows in ("exact", "estimated"))
    # Optical depths of order 1 in 30 float32 steps.
    np.testing.assert_allclose(estimated, exact, rtol=1e-5)


def test_words_for_shadows():
    scene = close_up({"smoke": smoke(rough_grid(1))[0], "sky": scenes.sky(0.3)}, res=4)
    with refused("auto, exact, estimated or grid"):
        mi.render(scene, integrator=mi.load_dict(mivol(shadows="soft")), spp=1)
    with refused("estimates are noise"):
        mi.render(scene, integrator=mi.load_dict(mivol(shadows="estimated", deterministic=True)), spp=1)


N, SCALE = 1 << 16, 1.3
START, D = as_float32([-2.5, -1.2, -1.9]), as_float32(np.array([2.5, 1.4, 1.7]) / np.linalg.norm([2.5, 1.4, 1.7]))
"""A ray across the box [-1, 1]^3, which it meets from about 1.8 to 3.5."""


def ray() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(*map(float, START)), mi.Vector3f(*map(float, D)))


def ray_interval(t0: float = 0.0, t1: float = np.inf, on: bool = True) -> RayInterval:
    """An interval of the same ray in all lanes."""
    return RayInterval(ray(), mi.Float64(t0), mi.Float64(t1), dr.full(mi.Bool, on, N))


def lane_generators(seed: int) -> mi.UInt32:
    return seed_pcg32((dr.arange(mi.Float, N) + 0.5) / N, N, fresh(seed))


def fly(part: GridExtinction, interval: RayInterval, seed: int) -> mi.Float64:
    """Distances of collisions; the first number of each lane's generator is that of the first tentative collision."""
    rng, (u,) = draw_pcg32(lane_generators(seed), 1)
    return delta_tracking_in_blocks(part, mi.Float(SCALE), interval, mi.UInt32(0), u, rng)[0]


def make_grid(values: np.ndarray, shift: int) -> GridExtinction:
    lattice = make_lattice(values, PLACE)
    lattice.block_ranges = find_block_ranges(lattice.values, shift)
    return GridExtinction("sigma_t", lattice)


def assert_flights(t: mi.Float64, tau: np.ndarray, T: float) -> None:
    """Collisions at t [N], at optical depths tau [N], are distributed as free flights through a transmittance T."""
    met = np.isfinite(np.array(t))
    u = np.where(met, -np.expm1(-np.where(met, tau, 0)), 0)
    assert u.max() <= 1 - T + 1e-5
    assert_rate(int(met.sum()), N, 1 - T)
    # Optical depths of about 1 are known to 1e-5.
    assert_same_mean(Moments.from_values(u), (1 - T) ** 2 / 2, rounding=1e-5, what="the mean of u")
    assert_same_mean(Moments.from_values(u**2), (1 - T) ** 3 / 3, rounding=1e-5, what="the mean of u^2")


def face() -> tuple[float, float]:
    """Entry and exit of the ray at the box."""
    sides = np.sort([(-1 - START) / D, (1 - START) / D], axis=0)
    return sides[0].max(), sides[1].min()


def depths(values: np.ndarray, t: mi.Float64, t0: float) -> np.ndarray:
    """Optical depth from t0 to t, summed over 20000 points of the ray: steps of 1e-4, linear in between to 1e-7."""
    (start, end), (q, dq) = face(), to_lattice(values, PLACE, START, D)
    edges = np.linspace(max(start, t0), end, 20001)
    steps = np.diff(edges)
    sigma = trilinear(values, q + (edges[:-1] + steps / 2)[:, None] * dq)[:, 0]
    return np.interp(np.minimum(np.array(t), end), edges, SCALE * np.append(0, np.cumsum(sigma * steps)))


@pytest.mark.statistical
@pytest.mark.parametrize("shift", [2, 3])
def test_flights_through_a_grid(shift):
    """Rough values, in blocks of 4 and of 8 cells."""
    values = rough_grid(1, 2.0, (9, 12, 17))
    t = fly(make_grid(values, shift), ray_interval(), 1)
    T = np.exp(-SCALE * tau_twin(values, PLACE, START, D)[0])
    assert_flights(t, depths(values, t, 0.0), T)


def rgb_grid() -> np.ndarray:
    """Rough values of three channels, of which each is the largest somewhere."""
    rough = np.concatenate([rough_grid(seed, 2.0, (9, 12, 17)) for seed in (1, 2, 3)], axis=-1)
    return rough * as_float32([0.3, 1.0, 0.6])


@pytest.mark.statistical
@pytest.mark.parametrize("inverts", [False, True])
def test_densities_of_flights_weigh_every_channel(inverts: bool) -> None:
    """Flights of a channel drawn for each lane, weighted by a channel's density over the mean density, are flights of it.

    Weights are at most 3, the number of channels.
    """
    values, channel = rgb_grid(), dr.arange(mi.UInt32, N) % 3
    part, rng = make_grid(values, 2), lane_generators(7)
    rng, (u,) = draw_pcg32(rng, 1)
    if inverts:
        t, densities = regular_tracking(part, mi.Float(SCALE), ray_interval(), -dr.log(1 - u), channel)
    else:
        t, densities, _ = delta_tracking_in_blocks(part, mi.Float(SCALE), ray_interval(), channel, u, rng)
    density = np.array(densities, np.float64)
    assert density.max() <= 1 + 1e-6 and np.all(density.max(axis=0) > 0.999)
    weights = density / density.mean(axis=0)
    met = np.isfinite(np.array(t))
    for k, tau in enumerate(SCALE * tau_twin(values, PLACE, START, D)):
        opacity, w = -np.expm1(-tau), weights[k]
        reached = np.where(met, -np.expm1(-depths(values[..., k : k + 1], t, 0.0)), 0)
        # Optical depths of about 1 are known to 1e-5, and weights of up to 3 to 1e-6 of them.
        for found, mean in ((w, 1.0), (w * met, opacity), (w * reached, opacity**2 / 2)):
            assert_same_mean(Moments.from_values(found), mean, rounding=3e-5, what=f"channel {k}")


@pytest.mark.statistical
def test_flights_that_begin_and_end_in_the_grid():
    """Flights from 2.2 to 3.1 have no collisions outside."""
    values = rough_grid(1, 2.0, (9, 12, 17))
    t = fly(make_grid(values, 2), ray_interval(2.2, 3.1), 2)
    assert_flights(t, depths(values, t, 2.2), np.exp(-SCALE * tau_twin(values, PLACE, START, D, 2.2, 3.1)[0]))
    assert np.nanmin(np.array(t)) >= 2.2 and not np.any((np.array(t) > 3.1 + 1e-6) & np.isfinite(np.array(t)))


def test_every_collision_is_real_where_blocks_have_one_value():
    """The first random number u determines the collision: -log(1 - u) over the extinction, behind the face of the box."""
    t = fly(make_grid(np.full((9, 12, 17), 0.8), 2), ray_interval(), 3)
    _, (u,) = draw_pcg32(lane_generators(3), 1)
    start, end = face()
    expected = start - np.log(1 - np.array(u, np.float64)) / (0.8 * SCALE)
    expected[expected > end] = np.inf
    # The lengths of 15 blocks, and as many optical depths, are subtracted from numbers of up to 16.
    np.testing.assert_allclose(np.array(t), expected, atol=15 * 16 * 2.0**-24 / 0.8)


def test_camera_rays_spread_their_collisions():
    """Of 64 samples of a pixel, each has the collision of a stratum of [0, 1) of its own: as many collide as the opacity says.

    The estimate of the first segment then takes the collision as it is, and the next segment draws its own.
    """
    values, count = rough_grid(1, 2.0, (9, 12, 17)), 64
    scene = close_up({"smoke": smoke(values, 0.5)[0], "lamp": point([0, 0, 9.0])[0]}, res=2)
    flights = FreeFlight(media_of(scene))
    (part,) = flights.bodies[0].view.parts
    part.lattice.block_ranges = find_block_ranges(part.lattice.values, 2)
    lane = dr.arange(mi.UInt32, count)
    sampler = SpreadSampler.of_pixels(mi.Vector2i(3, 5), mi.UInt32(1), lane, mi.UInt32(count))
    one = mi.Ray3f(ray().o, ray().d, mi.Float(dr.inf), mi.Float(0), mi.Color0f())
    many = dr.gather(mi.Ray3f, one, dr.zeros(mi.UInt32, count))
    on, outside = dr.full(mi.Bool, True, count), dr.zeros(mi.MediumPtr, count)
    with dr.suspend_grad():
        known = flights.find_first_collision(many, outside, sampler, on)
        segment = PathSegment(FineRay.from_ray(many), outside, dr.full(mi.Spectrum, 1, count), on, flights.draw(sampler, on),
                              dr.zeros(mi.UInt32, count), known=known)  # fmt: skip
        first = flights.estimate(segment, IMAGE, on).collision
        segment.known = known.forget()
        again = flights.estimate(segment, IMAGE, on).collision
    t, tau = np.array(known.t), depths(values, known.t, 0.0) / SCALE
    u = np.where(np.isfinite(t), -np.expm1(-tau), np.nan)
    opacity = -np.expm1(-tau_twin(values, PLACE, START, D)[0])
    # Optical depths of about 1 are known to 1e-5.
    hit = np.flatnonzero(np.isfinite(u))
    assert np.all(hit / count - 1e-5 < u[hit]) and np.all(u[hit] < (hit + 1) / count + 1e-5)
    assert np.all(np.diff(hit) == 1) and abs(len(hit) - opacity * count) <= 1 and 20 < len(hit) < 60
    np.testing.assert_array_equal(np.array(first.on), np.isfinite(t))
    np.testing.assert_array_equal(np.array(first.t)[hit], t[hit])
    assert np.mean(np.array(again.t)[hit] == t[hit]) < 0.1


def test_camera_rays_spread_their_channels_too() -> None:
    """A third of the samples of a pixel has each channel; their collisions are spread among the samples of this channel."""
    values, count = rgb_grid(), 96
    scene = close_up({"smoke": smoke(values, 0.5)[0], "lamp": point([0, 0, 9.0])[0]}, res=2)
    flights = FreeFlight(media_of(scene))
    (part,) = flights.bodies[0].view.parts
    part.lattice.block_ranges = find_block_ranges(part.lattice.values, 2)
    sampler = SpreadSampler.of_pixels(mi.Vector2i(3, 5), mi.UInt32(1), dr.arange(mi.UInt32, count), mi.UInt32(count))
    one = mi.Ray3f(ray().o, ray().d, mi.Float(dr.inf), mi.Float(0), mi.Color0f())
    many = dr.gather(mi.Ray3f, one, dr.zeros(mi.UInt32, count))
    with dr.suspend_grad():
        known = flights.find_first_collision(many, dr.zeros(mi.MediumPtr, count), sampler, dr.full(mi.Bool, True, count))
    t, tau = np.array(known.t), tau_twin(values, PLACE, START, D)
    for k in range(3):
        own = t[32 * k : 32 * k + 32]
        u = -np.expm1(-depths(values[..., k : k + 1], mi.Float64(own), 0.0) / SCALE)
        hit = np.flatnonzero(np.isfinite(own))
        # As for grey extinctions.
        assert np.all(hit / 32 - 1e-5 < u[hit]) and np.all(u[hit] < (hit + 1) / 32 + 1e-5)
        assert abs(len(hit) + 32 * np.expm1(-tau[k])) <= 1
    # The weights of a white medium keep the sum of the throughputs.
    np.testing.assert_allclose(np.array(known.weight).sum(axis=0), 3, rtol=1e-6)


def test_lanes_that_are_off_and_vacuum_have_no_collision():
    """Blocks of 0 have a majorant of 0: the next tentative collision is at infinity."""
    part, empty = make_grid(rough_grid(1), 2), make_grid(np.zeros((5, 4, 6)), 2)
    assert np.isinf(np.array(fly(part, ray_interval(on=False), 4))).all()
    assert np.isinf(np.array(fly(empty, ray_interval(), 4))).all()


def ball(slack: float, sigma: float | list[float] = 0.6) -> BoundedExtinction:
    """A ball of radius 1 about the point of the ray at 2.5."""
    field = Ball(mi.Color3f(sigma) if isinstance(sigma, list) else mi.Float(sigma), 1.0, tuple(START + 2.5 * D))
    return BoundedExtinction("sigma_t", field, mi.Float(SCALE), mi.Float(float(np.max(sigma)) * slack))


def fly_in_ball(part: BoundedExtinction, interval: RayInterval, seed: int) -> mi.Float64:
    return delta_tracking(part, mi.Float(SCALE), interval, mi.UInt32(0), lane_generators(seed))[0]


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
def test_flights_through_a_ball(slack):
    """Collisions between 1.5 and 3.5, for any majorant."""
    t, densities, after = delta_tracking(ball(slack), mi.Float(SCALE), ray_interval(), mi.UInt32(0), lane_generators(5))
    tau = 0.6 * SCALE * np.clip(np.array(t) - 1.5, 0, 2)
    assert_flights(t, tau, np.exp(-2 * 0.6 * SCALE))
    assert dr.width(after) == N and densities == []


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
def test_densities_of_flights_through_a_coloured_ball(slack: float) -> None:
    """As for grids: 1 - exp(-tau) of what a channel's flights have passed has the mean of its square over 2."""
    sigma, channel = [0.6, 0.1, 1.5], dr.arange(mi.UInt32, N) % 3
    t, densities, _ = delta_tracking(ball(slack, sigma), mi.Float(SCALE), ray_interval(), channel, lane_generators(8))
    density, met = np.array(densities, np.float64), np.isfinite(np.array(t))
    assert density.max() <= 1 + 1e-6 and np.all(density.max(axis=0) > 0.999)
    weights, passed = density / density.mean(axis=0), np.where(met, np.clip(np.array(t) - 1.5, 0, 2), 0)
    for w, value in zip(weights, sigma, strict=True):
        opacity, reached = -np.expm1(-2 * SCALE * value), -np.expm1(-SCALE * value * passed)
        for found, mean in ((w, 1.0), (w * met, opacity), (w * reached * met, opacity**2 / 2)):
            assert_same_mean(Moments.from_values(found), mean, rounding=3e-5, what=f"extinction {value}")


@pytest.mark.statistical
def test_flights_that_begin_and_end_in_the_ball():
    t = fly_in_ball(ball(2.0), ray_interval(2.0, 3.0), 6)
    assert_flights(t, 0.6 * SCALE * (np.array(t) - 2.0), np.exp(-0.6 * SCALE))


def test_lanes_that_are_off_and_balls_of_nothing_have_no_collision():
    assert np.isinf(np.array(fly_in_ball(ball(1.0), ray_interval(on=False), 7))).all()
    assert np.isinf(np.array(fly_in_ball(ball(0.0), ray_interval(), 7))).all()


LANES, BALL_SIGMA, BALL_SCALE = 1 << 16, 0.125, 1.2
BALL_TAU = 2 * BALL_SIGMA * BALL_SCALE
"""Through the middle of the ball."""


def bounded_estimates(slack: float, on: bool = True, seed: int = 1, n: int = LANES, sigma: float = BALL_SIGMA) -> np.ndarray:
    part = BoundedExtinction("sigma_t", Ball(mi.Float(sigma), 1.0, (0, 0, 2)), mi.Float(BALL_SCALE), mi.Float(sigma * slack))
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    rng = seed_pcg32((dr.arange(mi.Float, n) + 0.5) / n, n, fresh(seed))
    (T,), after = ratio_tracking(part, mi.Float(BALL_SCALE), RayInterval(ray, mi.Float(0), mi.Float(dr.inf), mi.Bool(on)), rng)
    assert np.array(after).size == n
    return np.array(T, np.float64)


def of_lanes(values: np.ndarray) -> Estimate:
    return Estimate(values.mean(), values.var(ddof=1) / values.size, values.size - 1)


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
def test_mean_and_variance_are_those_that_are_declared(slack: float) -> None:
    """T, and T^2 (exp(int sigma^2 / (kappa M) dt) - 1) = T^2 (exp(tau / (kappa slack)) - 1): a loose majorant has less of it.

    At tau = 0.3 an estimate falls below FAINT by 8 points of a process of 1.2 (slack 1): 1 in 30000, and the roulette adds less
    than 1e-5 to a variance of 0.04.
    """
    T, found = np.exp(-BALL_TAU), bounded_estimates(slack)
    assert_same_mean(of_lanes(found), T, what="the transmittance")
    assert_same_mean(of_lanes((found - T) ** 2), T**2 * (np.exp(BALL_TAU / (LOOKUP_RATE * slack)) - 1), what="the variance")


@pytest.mark.statistical
def test_the_roulette_of_faint_rays_changes_no_mean():
    """At an optical depth of 3 estimates end up near 0.05, below FAINT."""
    assert_same_mean(
        of_lanes(bounded_estimates(1.0, seed=2, sigma=1.25)), np.exp(-3.0), what="the transmittance of a dense ball"
    )


def test_lanes_that_are_off_and_fields_of_nothing_let_all_through():
    """A majorant of 0 has its next point infinitely far away."""
    assert (bounded_estimates(1.0, False, n=16) == 1).all()
    assert (bounded_estimates(0.0, n=16) == 1).all()
