"""Line integrals of grids in hard cases.

The judge is the float64 twin with the same float32 rays and voxels. The bound is
|error| <= 2e-6 * integral of (sigma + h |grad sigma|), h a voxel: about 16 float32 roundings of the value and of the
position inside a cell; for a known sum of a few terms, a few roundings of the sum.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hard_rays import EPS, assert_tau, positive

from mivol.threads import set_thread_count
from scenes import affine, as_float32, centred, make_lattice, random_rays, tau_and_row, tau_fast, to_lanes


@pytest.mark.parametrize("power", [-8, -4, 0, 2, 4])
def test_any_optical_depth(power):
    rng = np.random.default_rng(1)
    values = as_float32(10.0**power * rng.uniform(0.5, 1, (6, 6, 6)))
    fast = assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 64))
    assert fast.max() > 0.5 * 10.0**power


@pytest.mark.slow_for("True")
@pytest.mark.parametrize("skip", [False, True])
def test_where_the_segment_ends(skip):
    rng = np.random.default_rng(17)
    values = positive(rng, (6, 5, 8))
    o, d = random_rays(rng, np.eye(4), 64, away=0.3)
    for t_max in (1e-6, 0.01, 0.3, 3e38, math.inf):
        assert_tau(values, np.eye(4), o, d, t_max, skip)
    assert_tau(values, np.eye(4), o, d, rng.uniform(0, 1.5, 64), skip)
    for t_max in (0.0, -0.0, -1.0, -math.inf):
        assert np.array_equal(tau_fast(values, np.eye(4), o, d, t_max, skip), np.zeros((64, 1)))


def test_segments_within_one_cell():
    rng = np.random.default_rng(18)
    values = as_float32(rng.uniform(0.5, 1, (4, 4, 4)))
    o, d = rng.uniform(0.3, 0.6, (64, 3)), rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    for t_max in (1e-3, 1e-8, 1e-20, 1e-37):
        assert_tau(values, np.eye(4), o, d, t_max)


def test_inactive_and_broken_rays():
    from mivol.transport.media.grid_extinction import integrate_tau

    lattice = make_lattice(np.ones((4, 4, 4)), np.eye(4))
    o, d = np.tile([0.5, 0.5, -1.0], (4, 1)), np.tile([0.0, 0, 1], (4, 1))
    d[1] = 0  # no direction: it stays where it is for ever
    active = mi.Bool([True, True, False, True])
    tau = integrate_tau(lattice, *to_lanes(o, d), mi.Float(math.inf), active)
    assert np.array_equal(np.asarray(tau), [1, 0, 0, 1])


@pytest.mark.parametrize("sigma", [1.0, 1e3])
def test_camera_inside_a_dense_medium(sigma):
    values = np.full((16, 16, 16), sigma)
    rng = np.random.default_rng(19)
    d = rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert_tau(values, centred(2 * np.eye(3)), np.zeros((64, 3)), d)
    assert tau_fast(values, centred(2 * np.eye(3)), [0, 0, 0], [0, 1, 0])[0, 0] == pytest.approx(sigma, rel=16 * EPS)


@pytest.mark.slow_for("17")
@pytest.mark.parametrize("n", [2, 3, 17])
def test_checkerboard(n):
    rng = np.random.default_rng(27)
    values = 50.0 * (np.indices((n, n, n)).sum(axis=0) % 2)
    for skip in (False, True):
        assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 64), skip=skip)


@pytest.mark.parametrize("skip", [False, True])
def test_empty_grid(skip):
    rng = np.random.default_rng(28)
    fast = tau_fast(np.zeros((20, 9, 17, 3)), np.eye(4), *random_rays(rng, np.eye(4), 64), skip=skip)
    assert fast.shape == (64, 3)
    assert np.array_equal(fast, np.zeros((64, 3)))


def test_outer_half_voxel():
    """Between the outermost voxel centres and the faces the field is constant in that direction."""
    rng = np.random.default_rng(31)
    values = as_float32(rng.uniform(0.1, 1, (8, 4, 6)))
    assert_tau(
        values, np.eye(4), np.column_stack([np.full(16, -1), rng.uniform(0, 1 / 8, 16), rng.uniform(0, 1, 16)]), [1, 0, 0]
    )
    o = np.array([[-1, 0.01, 0.03], [-1, 0.99, 0.97]])
    corner_rows = np.array([values[0, 0].sum() / 6, values[7, 3].sum() / 6])
    fast = tau_fast(values, np.eye(4), o, [1, 0, 0])[:, 0]
    assert np.all(np.abs(fast - corner_rows) <= 8 * EPS * corner_rows)
    o, d = rng.uniform(0, 1, (32, 3)), np.zeros((32, 3))
    o[:, 0], d[:, 1:] = rng.uniform(0, 1 / 12, 32), rng.normal(size=(32, 2))
    assert_tau(values, np.eye(4), o, d / np.linalg.norm(d, axis=1, keepdims=True))


def test_long_rays():
    rng = np.random.default_rng(32)
    for shape in ((1024, 2, 2), (2, 1024, 2), (2, 2, 1024)):
        values = positive(rng, shape)
        to_world = affine(np.diag(np.array(shape[::-1], dtype=float)))
        o, d = random_rays(rng, to_world, 16)
        axis = 2 - shape.index(1024)
        aim = np.zeros((16, 3))
        aim[:, axis] = 1
        aim += rng.uniform(-1, 1, (16, 3)) / 2048
        start = rng.uniform(0.6, 1.4, (16, 3))
        start[:, axis] = -5
        assert_tau(values, to_world, o, d)
        fast = assert_tau(values, to_world, start, aim / np.linalg.norm(aim, axis=1, keepdims=True))
        assert fast.min() > 100


def test_the_same_twice():
    """Forward there is no sum across lanes, so no order: bit for bit the same, alone or among others."""
    rng = np.random.default_rng(33)
    values = positive(rng, (9, 9, 9))
    o, d = random_rays(rng, np.eye(4), 4096)
    whole = tau_fast(values, np.eye(4), o, d)
    assert np.array_equal(whole, tau_fast(values, np.eye(4), o, d))
    assert np.array_equal(whole[100:117], tau_fast(values, np.eye(4), o[100:117], d[100:117]))


def test_gradients_bitwise_with_one_thread(cpu_back_end, two_threads):
    rng = np.random.default_rng(34)
    o, d = random_rays(rng, np.eye(4), 100_000)
    threads = dr.thread_count()
    several = [tau_and_row((5, 5, 5), np.eye(4), o, d)[1] for _ in range(2)]
    set_thread_count(1)
    try:
        one = [tau_and_row((5, 5, 5), np.eye(4), o, d)[1] for _ in range(2)]
    finally:
        set_thread_count(threads)
    assert np.array_equal(*one)
    # Several threads add in any order: 2e-7 seen; random signs over 1e5 terms of float32 stay below 1e-5.
    assert np.all(np.abs(several[0] - several[1]) <= 1e-5 * one[0])
    assert np.all(np.abs(several[0] - one[0]) <= 1e-5 * one[0])


@pytest.mark.slow_for("True")
@pytest.mark.parametrize("skip", [False, True])
def test_256_cubed_against_the_twin(skip):
    rng = np.random.default_rng(36)
    values = np.zeros((256, 256, 256), dtype=np.float32)
    values[40:210, 60:250, 10:230] = rng.uniform(0, 1, (170, 190, 220)).astype(np.float32)
    to_world = centred(2 * np.eye(3))
    assert_tau(values, to_world, *random_rays(rng, to_world, 150), skip=skip)


def test_smooth_fields_against_the_twin():
    """A smooth field leaves no random sign to cancel what a systematic error of position would do."""
    n = 128
    c = (np.arange(n) + 0.5) / n - 0.5
    r2 = c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2
    values = as_float32(np.exp(-r2 / 0.02))
    rng = np.random.default_rng(37)
    assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 150))
