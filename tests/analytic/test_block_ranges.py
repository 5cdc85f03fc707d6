"""The smallest and the largest value of each block of cells, against NumPy."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.block_ranges import find_block_ranges

pytestmark = pytest.mark.usefixtures("variant_rgb")


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
