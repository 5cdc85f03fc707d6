"""The index of stored nodes against counts by NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.sparse_index import SparseIndex

pytestmark = pytest.mark.usefixtures("variant_rgb")

COUNTS = [1, 7, 8, 9, 32, 33, 1000]
"""Ends of words of 8 and of 32 nodes, and one node more and less."""


def draw_stored(node_count: int, share: float) -> np.ndarray:
    return np.random.default_rng(node_count).random(node_count) < share


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("node_count", COUNTS)
def test_ranks_are_counts_of_stored_nodes_before(node_count: int, share: float) -> None:
    stored = draw_stored(node_count, share)
    index = SparseIndex.from_sorted(mi.UInt32(np.flatnonzero(stored).astype(np.uint32)), node_count)
    rank, is_stored = index.rank(dr.arange(mi.UInt32, node_count))
    assert np.array_equal(np.array(is_stored), stored)
    assert np.array_equal(np.array(rank), np.cumsum(stored) - stored)
    assert index.bytes == 8 * -(-node_count // 32)
