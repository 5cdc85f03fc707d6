"""The pieces of a ray through nested boxes: begin and end of each piece, in the lengths of its level."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from sampled_fields import CUBE

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells
from mivol.transport.traversal.occupied_cells import _numbered
from mivol.transport.traversal.occupied_walk import count_pieces, find_piece


def test_pieces_of_a_ray_through_the_middle_and_of_one_that_misses() -> None:
    """Boxes of half-extent 1, 2, 4. A ray along x from -5 meets their faces at these distances; a ray at y = 1.5 misses the
    innermost."""
    grids = []
    for level in range(3):
        place = CUBE * 2.0**level
        place[3, 3] = 1
        grids.append(SphericalGrid.from_dense(np.ones((4, 4, 4)), np.zeros((4, 4, 4, 1, 3)), place))
    cells = find_occupied_cells(SphericalGrid.from_levels(grids))
    o, d = mi.Point3f([-5.0, -5.0, 0.5], [0.25, 1.5, 0.25], 0.125), mi.Vector3f(1, 0, 0)
    # Starts and ends in world lengths: of the ray through the middle, of the one that misses, of one from within.
    expected = [
        [(1, 3), (3, 4), (4, 6), (6, 7), (7, 9)],
        [(1, 3), (3, 7), None, None, (7, 9)],
        [None, None, (0, 0.5), (0.5, 1.5), (1.5, 3.5)],
    ]
    assert count_pieces(cells) == 5
    for number in range(5):
        piece = find_piece(cells, o, d, np.inf, mi.Int32(number))
        level = abs(number - 2)
        assert int(piece.level[0]) == level and float(piece.scale[0]) == 2**level
        start = np.array(piece.segment.t0) * 2.0**level
        length = np.array(piece.segment.length) * 2.0**level
        for ray in range(3):
            wanted = expected[ray][number]
            assert (length[ray] > 0) == (wanted is not None)
            if wanted is not None:
                # Powers of two and their sums: nothing is rounded.
                assert (start[ray], start[ray] + length[ray]) == wanted


def test_rows_are_numbered_in_their_order(variant_rgb: str) -> None:
    """The last possible row among them."""
    different, place = _numbered([mi.UInt32([3, 0]), mi.UInt32([5, 3])], 5)
    assert np.array(different).tolist() == [0, 3, 5]
    assert np.array(place)[[0, 3, 5]].tolist() == [0, 1, 2]
