"""Means of a grid over blocks of voxels, and the list of blocks that are not empty, against NumPy."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.coarse_grid import coarsen_grid
from mivol.transport.traversal.empty_blocks import find_empty_distances
from scenes import centred, make_lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")


SIZE = (9, 14, 11)


TWO = centred(2 * np.eye(3))


def sparse(channels: int) -> np.ndarray:
    """A grid with few voxels that are not 0, one of them in a corner."""
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
def test_blocks_that_hold_anything_are_listed(shift):
    """Every block with a node that is not 0; none that is further than a block from one."""
    values, edge = sparse(1)[..., 0], 1 << shift
    held = np.array(coarsen_grid(make_lattice(mi.TensorXf(values[..., None]), TWO), shift, True).held)
    blocks = [(n >> shift) + 1 for n in SIZE]
    nodes = [np.clip(np.arange(b * edge + 1)[None] - 1, 0, n - 1)[0] for b, n in zip(blocks, SIZE, strict=True)]
    padded = values[np.ix_(*nodes)] > 0
    own, wide = np.zeros(blocks, bool), np.zeros(blocks, bool)
    for at in np.ndindex(*blocks):
        own[at] = padded[tuple(slice(b * edge, (b + 1) * edge + 1) for b in at)].any()
        wide[at] = padded[tuple(slice(max(b * edge - edge, 0), (b + 2) * edge + 1) for b in at)].any()
    listed = np.zeros(blocks, bool)
    listed.ravel()[held] = True
    assert np.all(listed[own])
    assert not np.any(listed[~wide])
    assert 0 < own.sum() < own.size
