"""Blocks of a grid: skipping empty blocks changes no integral, and distances, ranges and means are right."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.test_sparse_voxels import ROUNDING, TWINS, cut, lattice_of, patches, plugin
from hard_rays import BOUND, assert_tau, positive
from oracle import tau_gradient_twin
from scattering_scenes import cases

from mivol.transport.traversal import grid_blocks
from mivol.transport.traversal.grid_blocks import (
    coarsen_grid,
    find_block_ranges,
    find_empty_distances,
    find_extremes,
    tabulate_ranges,
)
from mivol.transport.traversal.grid_walk import walk_cells
from mivol.transport.traversal.lattice import Lattice, clip_to_grid
from scenes import FRAMES, as_float32, centred, make_lattice, random_rays, tensor, to_lanes


def shell(n):
    """A shell of radius 0.35, a voxel thick, in an otherwise empty grid."""
    c = (np.arange(n) + 0.5) / n - 0.5
    r = np.sqrt(c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2)
    return (np.abs(r - 0.35) < 0.5 / n).astype(float)


@pytest.mark.parametrize("tau_shell", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("skip", [False, True, "ends"])
def test_thin_shell(tau_shell, skip):
    rng = np.random.default_rng(29)
    n = 40
    values = as_float32(shell(n) * n * tau_shell)
    assert np.count_nonzero(values) > 1000
    assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 96), skip=skip)


@pytest.mark.parametrize("skip", [False, True, "ends"])
def test_half_empty(skip):
    rng = np.random.default_rng(30)
    values = positive(rng, (33, 20, 41, 3))
    values[:, :, 13:] = 0
    values[0, 0, 40] = 1  # one voxel alone in a corner, which half a voxel of border repeats
    assert_tau(values, FRAMES["mirrored"], *random_rays(rng, FRAMES["mirrored"], 96), skip=skip)
    corner = np.array([40.6, 0.3, 0.2]) / [41, 20, 33]
    o = np.tile(corner - [0, 0, 1], (1, 1))
    assert assert_tau(values, np.eye(4), o, [0, 0, 1], skip=skip)[0, 0] > 0.01


def test_trimmed_walks_are_walks_through_every_cell():
    """The cells between the first and the last occupied block of each ray are visited, and no others; depths are the same.

    The ball has the radius of 5 cells in a box of 32. The longest way in its blocks is that of their circumscribed ball.
    """
    n, rng = 32, np.random.default_rng(31)
    c = np.arange(n) - 15.5
    inside = c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2 < 25
    values = np.where(inside, positive(rng, (n, n, n)), 0)
    o, d = (np.concatenate(rays) for rays in zip(random_rays(rng, np.eye(4), 200)[:2], along_the_axes(rng, 24), strict=True))
    rays, count = to_lanes(o, d), {}
    for skip in (False, "ends"):
        lattice = make_lattice(values, np.eye(4), skip)
        segment = clip_to_grid(lattice, *rays, 0, mi.Float(math.inf))
        count[skip] = np.array(walk_cells(lattice, segment, lambda sum, cell, on: sum + dr.select(on, 1, 0), mi.UInt32(0)))
    assert (count["ends"] <= count[False]).all() and count["ends"].max() <= 3 * (2 * 5 + 8) + 1
    assert (count["ends"] == 0).any() and 10 * count["ends"].sum() < 4 * count[False].sum()
    every = assert_tau(values, np.eye(4), o, d)
    assert (count["ends"] > 0)[every[:, 0] > 0].all()
    assert_tau(values, np.eye(4), o, d, skip="ends")
    # Through the ball, to any place of a cell behind its surface.
    d = np.tile(d[:224], (3, 1))
    o = 0.5 + rng.uniform(-0.08, 0.08, d.shape) - 2 * d
    assert_tau(values, np.eye(4), o, d, 2 + rng.uniform(0.15, 0.4, len(d)), skip="ends")


def along_the_axes(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays nearly along an axis, from before the unit cube, through places of it: 1e-9 to 1e-2 off."""
    d = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-9, -2, (n, 1))
    d[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1, 1], n)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return rng.uniform(0.3, 0.7, (n, 3)) - 2 * d, d


def test_gaps_are_the_distances_between_blocks():
    """Chebyshev distances of integers, by brute force over the blocks that hold anything: equal, not close."""
    from mivol.transport.traversal.grid_blocks import BLOCK, REACH, bound_blocks, find_empty_distances, read_distances

    rng = np.random.default_rng(32)
    values = np.where(rng.uniform(size=(23, 90, 41)) < 2e-4, 1, 0)
    packed = find_empty_distances(tensor(values))
    empty_distances = np.array(read_distances(packed, values.shape)).reshape(*(-(-(n + 1) // BLOCK) for n in values.shape))
    held = np.argwhere(np.array(bound_blocks(tensor(values))).reshape(empty_distances.shape) > 0)
    assert 1 < len(held) < empty_distances.size / 4
    away = np.abs(np.indices(empty_distances.shape).reshape(3, -1).T[:, None] - held).max(axis=2).min(axis=1)
    assert away.max() > 2
    np.testing.assert_array_equal(empty_distances.ravel(), np.minimum(away, REACH))
    assert dr.width(packed) == -(-empty_distances.size // 8)  # eight blocks in a word
    assert np.all(np.array(read_distances(find_empty_distances(tensor(np.zeros((9, 9, 9)))), (9, 9, 9))) == REACH)


@pytest.mark.parametrize("skip", [False, True, "ends"])
def test_gradient_in_and_out_of_the_shell(skip):
    """d tau / d sigma does not know sigma: the voxels of an empty block have the same row of A as all others."""
    from mivol.transport.media.grid_extinction import integrate_tau

    values = tensor(shell(24))
    dr.enable_grad(values)
    o, d = np.array([[-1.0, 0.43, 0.52]]), np.array([[0.96, 0.28, 0.0]])
    tau = integrate_tau(make_lattice(values, np.eye(4), skip), *to_lanes(o, d), mi.Float(math.inf), mi.Bool(True))
    dr.backward(tau)
    row = tau_gradient_twin((24, 24, 24), np.eye(4), as_float32(o[0]), as_float32(d[0]))
    got = np.asarray(dr.grad(values))[..., 0]
    assert np.all(np.abs(got - row) <= BOUND * 2 / 24 + BOUND * row)
    assert np.count_nonzero(got) >= np.count_nonzero(row > 1e-4)


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 8, 9), (15, 16, 17), (23, 1, 24)])
def test_blocks_hold_all_nodes_of_their_cells(shape):
    values = np.random.default_rng(1).uniform(0, 5, (*shape, 3)).astype(np.float32)
    blocks = find_block_ranges(mi.TensorXf(values))
    edge = 1 << blocks.shift
    assert blocks.res == tuple(-(-(n + 1) // edge) for n in shape)
    table = np.array(blocks.table).reshape(*blocks.res, 4)
    for index in np.ndindex(*blocks.res):
        nodes = [np.clip(np.arange(edge * b - 1, edge * b + edge), 0, n - 1) for b, n in zip(index, shape, strict=True)]
        own = values[np.ix_(*nodes)].reshape(-1, 3)
        assert np.array_equal(table[index][:3], own.min(axis=0))
        assert table[index][3] == pytest.approx(np.ptp(own, axis=0).max(), rel=2e-6)


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 8, 9), (15, 16, 17), (23, 1, 24)])
def test_blocks_of_twice_the_edge_are_joined(shape):
    values = mi.TensorXf(np.random.default_rng(2).normal(size=(*shape, 3)).astype(np.float32))
    joined, whole = tabulate_ranges(find_extremes(values, 1).join()), find_block_ranges(values, 2)
    assert (joined.res, joined.shift) == (whole.res, whole.shift)
    assert np.array_equal(np.array(joined.table), np.array(whole.table))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_blocks_with_a_bad_value_have_no_bounds(bad):
    values = np.ones((9, 9, 9), np.float32)
    values[8, 8, 8] = bad
    extremes = find_extremes(tensor(values))
    assert np.array_equal(np.array(extremes.low[0])[[0, -1]], [1, -np.inf])
    assert np.array_equal(np.array(extremes.high[0])[[0, -1]], [1, np.inf])


SIZE = (9, 14, 11)
TWO = centred(2 * np.eye(3))


def sparse(channels: int) -> np.ndarray:
    """A grid with few non-zero voxels, including a corner."""
    rng = np.random.default_rng(3)
    values = np.where(rng.uniform(size=(*SIZE, channels)) < 4e-3, rng.uniform(0.1, 1, (*SIZE, channels)), 0)
    values[-1, -1, -1] = 0.5
    return values.astype(np.float32)


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_coarse_grids_are_means_in_their_place(channels, shift):
    values, edge = sparse(channels), 1 << shift
    coarse = coarsen_grid(make_lattice(mi.TensorXf(values), TWO), shift, True)
    sizes = [-(-n // edge) for n in SIZE]
    index = [np.minimum(np.arange(m * edge), n - 1) for m, n in zip(sizes, SIZE, strict=True)]
    means = values[np.ix_(*index)].reshape(sizes[0], edge, sizes[1], edge, sizes[2], edge, channels).mean((1, 3, 5), np.float64)
    # Sums of 2^(3 shift) numbers of one sign, axis by axis: 3 (2^shift + 1) roundings of 2^-24.
    np.testing.assert_allclose(np.array(coarse.lattice.values), means, rtol=3 * (edge + 1) * 2.0**-24)
    # A voxel is as wide as 2^shift: the far corner of the coarse grid is further out by what was repeated.
    far = TWO @ [*(edge * m / n for m, n in zip(sizes[::-1], SIZE[::-1], strict=True)), 1]
    np.testing.assert_allclose(coarse.lattice.to_world @ np.ones(4), far, rtol=1e-12)


@pytest.mark.parametrize("skip", [False, True])
def test_coarse_grids_skip_what_is_empty_where_the_fine_one_does(skip):
    coarse = coarsen_grid(make_lattice(mi.TensorXf(sparse(1)), TWO, skip), 1, False).lattice
    assert (coarse.empty_distances is not None) == skip
    if skip:
        assert np.array_equal(np.array(coarse.empty_distances), np.array(find_empty_distances(coarse.values)))


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_blocks_that_hold_anything_are_found(shift):
    """Every block with a non-zero node, and no block further than a block from such a node."""
    values, edge = sparse(1)[..., 0], 1 << shift
    found = np.array(coarsen_grid(make_lattice(mi.TensorXf(values[..., None]), TWO), shift, True).is_occupied)
    blocks = [(n >> shift) + 1 for n in SIZE]
    nodes = [np.clip(np.arange(b * edge + 1)[None] - 1, 0, n - 1)[0] for b, n in zip(blocks, SIZE, strict=True)]
    padded = values[np.ix_(*nodes)] > 0
    own, wide = np.zeros(blocks, bool), np.zeros(blocks, bool)
    for at in np.ndindex(*blocks):
        own[at] = padded[tuple(slice(b * edge, (b + 1) * edge + 1) for b in at)].any()
        wide[at] = padded[tuple(slice(max(b * edge - edge, 0), (b + 2) * edge + 1) for b in at)].any()
    found = found.reshape(blocks)
    assert np.all(found[own])
    assert not np.any(found[~wide])
    assert 0 < own.sum() < own.size


@pytest.mark.parametrize("name", cases(TWINS, slow=("one brick", "part of a brick", "bricks", "every cell walked")))
def test_blocks_of_a_sparse_grid(name: str) -> None:
    """Occupied blocks, ranges of values and means are those of the dense grid."""
    seed, shape, offset, channels, *_ = TWINS[name]
    values = patches(np.random.default_rng(seed), shape, channels)
    sparse, dense = lattice_of(mi.load_dict(plugin(cut(values, offset)))), Lattice(mi.TensorXf(values), np.eye(4))
    occupied = np.array(grid_blocks.find_occupied_blocks(sparse.values, sparse.bricks))
    assert np.array_equal(occupied, np.array(grid_blocks.bound_blocks(dense.values)) > 0)
    stored, empty = sparse.bricks.distances, grid_blocks.find_empty_distances(dense.values)
    assert np.array(grid_blocks.read_distances(stored, shape) <= grid_blocks.read_distances(empty, shape)).all()
    for shift in (2, 3):
        ranges = [grid_blocks.find_block_ranges(g.values, shift, g.bricks) for g in (sparse, dense)]
        assert np.array_equal(*(np.array(r.table) for r in ranges))
    for shift in range(4):
        found, truth = (np.array(grid_blocks.coarsen_grid(g, shift, False).lattice.values) for g in (sparse, dense))
        assert np.abs(found - truth).max() <= ROUNDING * truth.max()
