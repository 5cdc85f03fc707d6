"""How far places are from the nearest listed one, and where in the list these are: against counts by NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.distance_index import FAR, DistanceIndex
from mivol.transport.traversal.empty_blocks import REACH

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("places", [1, 7, 8, 9, 1000])
def test_distances_are_kept_and_zeros_are_counted(places: int) -> None:
    """Of places that end with a word of eight, one before and one after."""
    rng = np.random.default_rng(places)
    listed = rng.random(places) < 0.3
    distance = np.where(listed, 0, rng.integers(1, FAR + 1, places)).astype(np.uint8)
    index, place = DistanceIndex.of(mi.UInt8(distance)), dr.arange(mi.UInt32, places)
    far, word = index.distance(place, mi.Bool(True))
    assert np.array_equal(np.array(far), distance)
    assert np.array_equal(np.array(index.rank(place, word, mi.Bool(True)))[listed], np.arange(listed.sum()))
    assert index.bytes == 8 * -(-places // 8)


def test_all_distances_that_are_measured_fit() -> None:
    assert REACH <= FAR
