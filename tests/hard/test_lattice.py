"""Grids in the world in hard cases: far away, in other scales and frames, and refused frames."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest
from hard_rays import BOUND, assert_tau, positive
from oracle import tau_scale

from scenes import FRAMES, affine, as_float32, centred, make_lattice, random_rays, rotation, tau_fast


def test_origin_inside_or_on_a_face():
    rng = np.random.default_rng(16)
    values = positive(rng, (6, 5, 8))
    o, d = rng.uniform(0, 1, (64, 3)), rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert_tau(values, np.eye(4), o, d)
    for axis, face in itertools.product(range(3), (0.0, 1.0)):
        o[:, axis] = face
        fast = assert_tau(values, np.eye(4), o, d)
        outwards = (d[:, axis] > 0) == (face == 1)
        assert np.array_equal(fast[outwards], np.zeros((outwards.sum(), 1)))
    o = (np.floor(rng.uniform(0, 8, (64, 3))) + 0.5) / 8  # on planes where cells meet, and past the far side
    assert_tau(values, np.eye(4), o, d)
    assert np.array_equal(tau_fast(values, np.eye(4), o + 2 * np.abs(d) / d, np.sign(d)), np.zeros((64, 1)))


@pytest.mark.parametrize("power", [2, 3, 4, 5, 6])
def test_origin_far_away(power):
    """A float32 origin there is a coarse one, but it is a point like any other: through the middle, exactly."""
    rng = np.random.default_rng(20)
    values = positive(rng, (24, 24, 24))
    n = 64
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = as_float32(rng.uniform(0.3, 0.7, (n, 3)) - 10.0**power * d)
    target = rng.uniform(0.3, 0.7, (n, 3))
    d = as_float32((target - o) / np.linalg.norm(target - o, axis=1, keepdims=True))
    fast = assert_tau(values, np.eye(4), o, d)
    assert np.count_nonzero(fast) > n / 4
    axis_aligned = np.column_stack([np.full(n, -(10.0**power)), rng.uniform(0, 1, (n, 2))])
    fast = assert_tau(values, np.eye(4), axis_aligned, [1, 0, 0])
    assert np.count_nonzero(fast) == n


def test_box_far_from_the_origin_of_the_world():
    rng = np.random.default_rng(21)
    values = positive(rng, (8, 8, 8))
    to_world = centred(100 * rotation([1, 1, 0], 0.5), (1e5, -2e5, 3e4))
    assert_tau(values, to_world, *random_rays(rng, to_world, 64))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scene_scale(scale):
    rng = np.random.default_rng(22)
    values = positive(rng, (7, 6, 5))
    o, d = random_rays(rng, centred(np.eye(3)), 64)
    fast = assert_tau(values / scale, centred(scale * np.eye(3)), o * scale, d)
    assert fast.max() > 0.3


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("skip", [False, True])
def test_frames(name, skip):
    rng = np.random.default_rng(23)
    values = positive(rng, (12, 5, 9, 3))
    assert_tau(values, FRAMES[name], *random_rays(rng, FRAMES[name], 64), skip=skip)


@pytest.mark.parametrize(
    ("matrix", "named"),
    [
        (np.diag([1.0, 1, 0, 1]), "degenerate"),
        (affine(np.ones((3, 3))), "degenerate"),
        (np.full((4, 4), np.nan), "finite"),
        (affine(np.diag([1, 1, np.inf])), "finite"),
        (np.eye(3), "4x4"),
        (np.diag([1.0, 1, 1, 2]), "affine"),
    ],
)
def test_degenerate_frames_are_refused(matrix, named):
    with pytest.raises(ValueError, match=named):
        make_lattice(np.ones((2, 2, 2)), matrix)


@pytest.mark.parametrize("shape", [(0, 2, 2, 1), (2, 2, 2), (2, 2)])
def test_empty_or_flat_grids_are_refused(shape):
    from mivol.transport.traversal.lattice import Lattice

    with pytest.raises(ValueError, match="shape"):
        Lattice(mi.TensorXf(np.ones(shape, dtype=np.float32)), np.eye(4))


@pytest.mark.slow_for("shape2", "shape4", "shape5", "shape6")
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 7), (1, 7, 1), (7, 1, 1), (1, 5, 6), (5, 1, 6), (5, 6, 1)])
def test_single_voxels(shape):
    rng = np.random.default_rng(26)
    values = as_float32(rng.uniform(0.1, 1, shape))
    o, d = random_rays(rng, FRAMES["stretched"], 48)
    fast = assert_tau(values, FRAMES["stretched"], o, d)
    assert np.array_equal(fast, tau_fast(values, FRAMES["stretched"], o, d, skip=True))
    # An axis of one voxel is an axis along which nothing changes: doubling it is the same field.
    axis = shape.index(1)
    doubled = tau_fast(np.repeat(values, 2, axis=axis), FRAMES["stretched"], o, d)
    assert np.all(np.abs(doubled - fast) <= 2 * BOUND * tau_scale(values, FRAMES["stretched"], o, d) + 1e-30)
