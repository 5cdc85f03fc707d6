"""Shares of rays that measure a line twice, and steps of views, at their ends and joints."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.tomography.redundancy import BLEND_COLUMNS, angle_steps, covers_circle, full_turn_weights, parker_weights, widest_gap


def test_the_widest_gap_and_where_it_ends() -> None:
    """Views anywhere on the circle, in any order; the gap may lie across its end, and ends at the view after it."""
    assert widest_gap(np.array([4.0, 0.5, 1.0]), 6.0) == (3.0, 4.0)
    assert widest_gap(np.array([1.0, 2.0, 3.0]), 6.0) == (4.0, 1.0)
    assert widest_gap(np.array([-1.0, 7.0]), 6.0) == (4.0, 5.0)
    assert widest_gap(np.array([2.0]), 6.0) == (6.0, 2.0)
    assert widest_gap(np.array([0.0, 3.0]), 6.0) == (3.0, 3.0)


@pytest.mark.parametrize(("missing", "covered"), [(3, True), (4, False)])
def test_four_steps_may_lie_between_two_views(missing: int, covered: bool) -> None:
    """Of 16 views on a circle of 16 so many lie elsewhere: a gap of one more; exactly four steps are enough."""
    angles = np.concatenate([np.arange(16.0 - missing), np.full(missing, 0.5)])
    assert covers_circle(angles, 16.0) == covered


def test_steps_of_one_view_and_of_equal_ones() -> None:
    assert angle_steps(np.array([2.0]), 6.0).tolist() == [6]
    assert angle_steps(np.array([2.0, 2.0]), 6.0).tolist() == [3, 3]
    assert angle_steps(np.array([5.0, -5.0, 3.0]), 6.0).tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("turned", [False, True])
def test_shares_of_a_displaced_detector(turned: bool) -> None:
    """Over a fifth of the shorter side, or 20 columns, or all of it, whichever is wider and there: a half up to its beginning,
    3/4 in its middle, 1 from the end of the shorter side on; and what is left of 1 on that side."""
    for short, column in ((100, 0.01), (200, 0.01), (10, 0.01)):
        gamma = np.arange(-short, 2 * short + 1) * column
        width = min(short, max(short / 5, BLEND_COLUMNS)) * column
        shares = full_turn_weights(gamma)
        if turned:
            shares = full_turn_weights(-gamma[::-1])[::-1]
        begin = short * column - width
        wanted = np.sin(np.pi / 2 * np.clip((np.abs(gamma) - begin) / width, 0, 1)) ** 2
        np.testing.assert_allclose(shares, 0.5 * (1 + np.where(gamma < 0, -1, 1) * wanted), atol=1e-9)
        assert shares[0] == pytest.approx(0, abs=1e-9) and shares[-1] == 1


def test_detectors_that_are_centred_or_miss_the_axis() -> None:
    """Within a column of the middle all count a half; the axis must be seen."""
    assert full_turn_weights(np.array([-2.0, -1, 0, 1, 2.9])).tolist() == [0.5] * 5
    assert full_turn_weights(np.arange(-2.0, 4.0))[-1] == 1
    for gamma in (np.array([0.0, 0.1, 0.2]), np.array([0.1, 0.2]), np.array([-0.3, -0.2, -0.1]), np.array([0.3])):
        with pytest.raises(MivolError, match="wholly on one side of the rotation axis"):
            full_turn_weights(gamma)


def test_parkers_shares() -> None:
    """His formula with gamma the other way round (Parker 1982, equation 12): rise, 1, and fall, for each ray."""
    excess, gamma = 0.4, np.array([-0.6, -0.4, -0.1, 0.0, 0.3, 0.4, 0.5])
    beta = np.linspace(0, np.pi + 2 * excess, 23)
    found = parker_weights(beta, gamma, excess)
    for i, b in enumerate(beta):
        for j, g in enumerate(-np.clip(gamma, -excess, excess)):
            if b < 2 * (excess - g):
                wanted = np.sin(np.pi / 4 * b / (excess - g)) ** 2
            elif b <= np.pi - 2 * g:
                wanted = 1.0
            else:
                wanted = np.sin(np.pi / 4 * (np.pi + 2 * excess - b) / (excess + g)) ** 2
            assert found[i, j] == pytest.approx(wanted, abs=1e-12)
