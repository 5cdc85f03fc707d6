"""The order in which rays are walked."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.tomography.projector import order_rays


@pytest.mark.parametrize("shape", [(3, 4, 16), (2, 5, 9), (1, 1, 7), (4, 3, 1)])
def test_each_ray_once(shape: tuple[int, int, int]) -> None:
    assert sorted(order_rays(*shape)) == list(range(int(np.prod(shape))))


def test_a_vector_is_a_tile_and_views_follow_each_other() -> None:
    """Sixteen lanes are 2 rows of 8 columns; the second view of two rows comes before the third row of the first."""
    view, row, column = np.unravel_index(order_rays(3, 4, 16), (3, 4, 16))
    assert (set(row[:16]), set(column[:16]), set(view[:16])) == ({0, 1}, set(range(8)), {0})
    assert [(v, r // 2) for v, r in zip(view[::32], row[::32], strict=True)] == [(v, b) for b in (0, 1) for v in (0, 1, 2)]
