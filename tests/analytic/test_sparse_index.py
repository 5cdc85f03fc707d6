"""Which places are listed, and where in the list: against counts by NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.sparse_index import SparseIndex

pytestmark = pytest.mark.usefixtures("variant_rgb")

COUNTS = [1, 7, 8, 9, 32, 33, 1000]
"""Ends of words of 8 and of 32 places, and one place more and less."""


def chosen(places: int, share: float) -> np.ndarray:
    return np.random.default_rng(places).random(places) < share


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("places", COUNTS)
def test_ranks_are_counts_of_listed_places_before(places: int, share: float) -> None:
    listed = chosen(places, share)
    found = SparseIndex.from_sorted(mi.UInt32(np.flatnonzero(listed).astype(np.uint32)), places)
    rank, held = found.rank(dr.arange(mi.UInt32, places))
    assert np.array_equal(np.array(held), listed)
    assert np.array_equal(np.array(rank), np.cumsum(listed) - listed)
    assert found.bytes == 8 * -(-places // 32)
