"""Empty blocks: what skips them is what does not, and knows how far the next voxel is."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hard_rays import BOUND, assert_tau, positive
from oracle import tau_gradient_twin

from scenes import (
    FRAMES,
    as_float32,
    make_lattice,
    random_rays,
    tensor,
    to_lanes,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")


def shell(n):
    """One voxel thick, of radius 0.35, in an otherwise empty grid."""
    c = (np.arange(n) + 0.5) / n - 0.5
    r = np.sqrt(c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2)
    return (np.abs(r - 0.35) < 0.5 / n).astype(float)


@pytest.mark.parametrize("tau_shell", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("skip", [False, True])
def test_thin_shell(tau_shell, skip):
    """Hard case 22."""
    rng = np.random.default_rng(29)
    n = 40
    values = as_float32(shell(n) * n * tau_shell)
    assert np.count_nonzero(values) > 1000
    assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 96), skip=skip)


@pytest.mark.parametrize("skip", [False, True])
def test_half_empty(skip):
    """Hard case 22."""
    rng = np.random.default_rng(30)
    values = positive(rng, (33, 20, 41, 3))
    values[:, :, 13:] = 0
    values[0, 0, 40] = 1  # one voxel alone in a corner, which half a voxel of border repeats
    assert_tau(values, FRAMES["mirrored"], *random_rays(rng, FRAMES["mirrored"], 96), skip=skip)
    corner = np.array([40.6, 0.3, 0.2]) / [41, 20, 33]
    o = np.tile(corner - [0, 0, 1], (1, 1))
    assert assert_tau(values, np.eye(4), o, [0, 0, 1], skip=skip)[0, 0] > 0.01


def test_gaps_are_the_distances_between_blocks():
    # Chebyshev distances of integers, by brute force over the blocks that hold anything: equal, not close.
    """Hard case 22."""
    from mivol.transport.traversal.empty_blocks import BLOCK, REACH, block_bounds, find_empty_distances

    rng = np.random.default_rng(32)
    values = np.where(rng.uniform(size=(23, 90, 41)) < 2e-4, 1, 0)
    empty_distances = np.array(find_empty_distances(tensor(values))).reshape(*(-(-(n + 1) // BLOCK) for n in values.shape))
    held = np.argwhere(np.array(block_bounds(tensor(values))).reshape(empty_distances.shape) > 0)
    assert 1 < len(held) < empty_distances.size / 4
    away = np.abs(np.indices(empty_distances.shape).reshape(3, -1).T[:, None] - held).max(axis=2).min(axis=1)
    assert away.max() > 2
    np.testing.assert_array_equal(empty_distances.ravel(), np.minimum(away, REACH))
    assert np.all(np.array(find_empty_distances(tensor(np.zeros((9, 9, 9))))) == REACH)


@pytest.mark.parametrize("skip", [False, True])
def test_gradient_in_and_out_of_the_shell(skip):
    # d tau / d sigma does not know sigma: the voxels of an empty block have the same row of A as all others.
    """Hard case 22."""
    from mivol.transport.media.grid_integral import integrate_tau

    values = tensor(shell(24))
    dr.enable_grad(values)
    o, d = np.array([[-1.0, 0.43, 0.52]]), np.array([[0.96, 0.28, 0.0]])
    tau = integrate_tau(make_lattice(values, np.eye(4), skip), *to_lanes(o, d), mi.Float(math.inf), mi.Bool(True))
    dr.backward(tau)
    row = tau_gradient_twin((24, 24, 24), np.eye(4), as_float32(o[0]), as_float32(d[0]))
    got = np.asarray(dr.grad(values))[..., 0]
    assert np.all(np.abs(got - row) <= BOUND * 2 / 24 + BOUND * row)
    assert np.count_nonzero(got) >= np.count_nonzero(row > 1e-4)
