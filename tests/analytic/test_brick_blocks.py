"""Blocks of a sparse grid are those of the dense grid with the same values."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from conformance.test_sparse_voxels import ROUNDING, TWINS, cut, lattice_of, patches, plugin
from scattering_scenes import cases

from mivol.transport.traversal import grid_blocks
from mivol.transport.traversal.lattice import Lattice


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
