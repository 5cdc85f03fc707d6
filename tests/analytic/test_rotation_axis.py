"""Parts of the search for a rotation axis, on numbers that are known."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.tomography import rotation_axis as axes


def test_the_offset_of_a_column() -> None:
    assert axes.Axis(5.0, 0.1, "").offset(8) == 1.5
    assert axes.Axis(5.0, 0.1, "").offset(8, 0.5) == 0.75


def test_pairs_of_opposite_views() -> None:
    """The best first, those beyond 5 degrees left out, at most as many as are asked for."""
    degrees = np.array([0.0, 90, 179, 183, 266])
    first, second, miss = axes._opposite_pairs(np.radians(degrees), 12)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 2), (0, 3), (1, 4)]
    assert np.degrees(miss) == pytest.approx([-1, 3, -4])
    assert [part.tolist() for part in axes._opposite_pairs(np.radians(degrees), 1)[:2]] == [[0], [2]]
    with pytest.raises(MivolError, match="half a turn apart"):
        axes._opposite_pairs(np.radians([0.0, 90, 174.9]), 12)


def bump(centre: float, n: int = 40) -> np.ndarray:
    """A smooth shadow, two rows of it."""
    s = np.arange(n) - centre
    return np.stack([np.exp(-(s**2) / 18), 2 * np.exp(-(s**2) / 8)])


@pytest.mark.parametrize("column", [18.3, 21.0, 23.75])
def test_mirrors_have_their_column_in_the_middle(column: float) -> None:
    """a(s) = b(2 c - s): cubic interpolation of a bump of 3 and 2 pixels is good to a few thousandths."""
    assert axes._find_mirror_column(bump(column - 3), bump(column + 3)) == pytest.approx(column, abs=5e-3)


def test_a_constant_and_its_deviation() -> None:
    """The mean of four numbers and its standard error; as a line through five, that of least squares."""
    values = np.array([1.0, 2, 4, 5])
    assert axes._fit_first_coefficient(np.ones((4, 1)), values) == pytest.approx((3, np.sqrt(10 / 3 / 4)))
    x, y = np.array([0.0, 1, 2, 3, 5]), np.array([1.0, 2, 2, 4, 4])
    (slope, offset), covariance = np.polyfit(x, y, 1, cov=True)
    assert slope > 0
    assert axes._fit_first_coefficient(np.stack([np.ones(5), x], 1), y) == pytest.approx((offset, np.sqrt(covariance[1, 1])))
    assert axes._fit_first_coefficient(np.ones((1, 1)), np.array([7.0])) == pytest.approx((7, 0))


def test_moments_follow_a_circle() -> None:
    """Two rows of one pixel of mass each: centres of mass at 5 + cos and 5 + 2 sin; both rows say 5."""
    angles = np.linspace(0, 2 * np.pi, 7)
    y = np.zeros((7, 2, 11))
    for view, angle in enumerate(angles):
        for row, centre in enumerate((5 + np.cos(angle), 5 + 2 * np.sin(angle))):
            low = int(centre)
            y[view, row, low], y[view, row, low + 1] = low + 1 - centre, centre - low
    found = axes.axis_from_moments(y, angles)
    assert (found.column, found.uncertainty) == pytest.approx((5, 0), abs=1e-9)
    y[:, 1] = np.roll(y[:, 1], 2, axis=-1)
    found = axes.axis_from_moments(y, angles)
    # Views agree and rows do not: 5 and 7 scatter by sqrt(2), and their mean by 1.
    assert (found.column, found.uncertainty) == pytest.approx((6, 1))
    y[:, 1] = np.roll(y[:, 1], -2, axis=-1)
    rough = y.copy()
    rough[3] = np.roll(y[3], 1, axis=-1)
    found = axes.axis_from_moments(rough, angles)
    design = np.stack([np.ones(7), np.cos(angles), np.sin(angles)], 1)
    centres = rough @ np.arange(11)
    each = [axes._fit_first_coefficient(design, centres[:, row]) for row in range(2)]
    assert found.column == pytest.approx((each[0][0] + each[1][0]) / 2)
    scatter = abs(each[0][0] - each[1][0]) / np.sqrt(2)
    assert scatter < np.hypot(each[0][1], each[1][1]) / np.sqrt(2)
    assert found.uncertainty == pytest.approx(np.hypot(each[0][1], each[1][1]) / 2)
    y[2, 1] = 0
    with pytest.raises(MivolError, match="no absorption"):
        axes.axis_from_moments(y, angles)


def test_how_far_the_object_reaches() -> None:
    """From column 4.5 to that of the ninth of the densest ray; a tenth is not seen, and a tenth more is added."""
    y = np.zeros((2, 1, 20))
    y[0, 0, 5], y[1, 0, 15], y[1, 0, 18], y[0, 0, 1] = 10.0, 1.1, 1.0, 1.0
    assert axes._object_radius(y, 4.5) == int(np.ceil(1.1 * 10.5))
    assert axes._object_radius(y, 14.0) == int(np.ceil(1.1 * 9))


def test_the_least_of_a_parabola() -> None:
    """3 (x - 7)^2 + 2 by five points around 6.5: exact, and as wide as its own least value makes it."""
    found = axes._parabola_minimum(lambda x: 3 * (x - 7) ** 2 + 2, 6.5, 2.0, 50)
    assert found == pytest.approx((7, np.sqrt(2 / (3 * 50))))
    assert axes._parabola_minimum(lambda x: (x - 1.99) ** 2 + 1, 1.0, 1.0, 1)[0] == pytest.approx(1.99)
    for f in (lambda x: (x - 2.01) ** 2, lambda x: (x + 0.01) ** 2, lambda x: -((x - 1) ** 2), lambda x: x):
        with pytest.raises(MivolError, match=r"between columns 0\.0 and 2\.0"):
            axes._parabola_minimum(f, 1.0, 1.0, 1)


def test_halves_of_the_views_predict_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The middle rows; five trials over the width, and five over a fourth of it; the mean, and the larger of the two errors."""
    asked = []

    def misfit(y: np.ndarray, w: np.ndarray, angles: np.ndarray, column: float, known: slice, hidden: slice) -> float:
        asked.append((y.shape, w.shape, column, known, hidden))
        return 2 + 3 * (column - (7.0 if known == slice(0, None, 2) else 7.2)) ** 2

    monkeypatch.setattr(axes, "_held_out_misfit", misfit)
    y, weights = np.ones((6, 4, 5)), np.ones((6, 4, 5))
    weights[1] = 0
    found = axes.axis_from_reconstructions(y, weights, np.arange(6.0), 6.5)
    # 20 weighted pixels of one half, 30 of the other: 2 / (3 n) each.
    assert found.column == pytest.approx(7.1)
    assert found.uncertainty == pytest.approx(max(0.1, np.sqrt(2 / 60 + 2 / 90) / 2))
    assert found.method == "one half of the views predicted from the other"
    assert {shape for shape, *_ in asked} == {(6, 2, 5)} and {shape for _, shape, *_ in asked} == {(6, 2, 5)}
    columns = [column for _, _, column, *_ in asked]
    np.testing.assert_allclose(columns[:5], 6.5 + 2 * np.linspace(-1, 1, 5))
    np.testing.assert_allclose(columns[5:10], 7.0 + 0.5 * np.linspace(-1, 1, 5))
    halves = [(known, hidden) for *_, known, hidden in asked]
    assert halves == [(slice(0, None, 2), slice(1, None, 2))] * 10 + [(slice(1, None, 2), slice(0, None, 2))] * 10
    asked.clear()
    axes.axis_from_reconstructions(np.ones((6, 3, 5)), np.ones((6, 3, 5)), np.arange(6.0), 6.5)
    assert asked[0][0] == (6, 1, 5)


@pytest.mark.parametrize(("column", "uncertainty", "wanted"), [(7.5, 0.1, 0.25), (7.0, 0.1, 0.1)])
def test_the_refined_axis_counts(monkeypatch: pytest.MonkeyPatch, column: float, uncertainty: float, wanted: float) -> None:
    """It is as uncertain as half of its distance from the rough one, at least; moments serve where there are no mirrors."""
    monkeypatch.setattr(axes, "axis_from_mirrors", lambda *_: axes.Axis(7.0, 0.0, "mirrors"))
    monkeypatch.setattr(axes, "axis_from_reconstructions", lambda y, w, a, start: axes.Axis(column, uncertainty, f"{start}"))
    assert axes.find_axis(None, None, None) == axes.Axis(column, wanted, "7.0")

    def no_mirrors(*_: object) -> None:
        raise MivolError("none")

    monkeypatch.setattr(axes, "axis_from_mirrors", no_mirrors)
    monkeypatch.setattr(axes, "axis_from_moments", lambda *_: axes.Axis(6.0, 0.0, "moments"))
    assert axes.find_axis(None, None, None).method == "6.0"


def test_pairs_that_miss_half_a_turn_are_read_where_they_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Columns of 10 + 3 e for pairs that miss by e: 10; where all miss alike their mean. A view without contrast is refused."""
    angles = np.array([0.0, 0.1, 0.2, np.pi - 0.02, np.pi + 0.11, np.pi + 0.23])
    y = np.arange(6.0)[:, None, None] + np.arange(4.0)
    columns = lambda a, b: 10 + 3 * (angles[int(b[0, 0])] - angles[int(a[0, 0])] - np.pi)  # noqa: E731
    monkeypatch.setattr(axes, "_find_mirror_column", columns)
    found = axes.axis_from_mirrors(y, angles, 3)
    assert (found.column, found.uncertainty) == pytest.approx((10, 0), abs=1e-9)
    assert found.method == "mirror images, 3 pairs of views"
    exact = np.array([0.0, 0.1, np.pi, np.pi + 0.1])
    monkeypatch.setattr(axes, "_find_mirror_column", lambda a, b: 4.0 + a[0, 0])
    found = axes.axis_from_mirrors(y, exact, 2)
    assert (found.column, found.uncertainty) == pytest.approx((4.5, 0.5))
    flat = y.copy()
    flat[2] = 1
    with pytest.raises(MivolError, match="view 2 without contrast"):
        axes.axis_from_mirrors(flat, exact, 2)
    flat[2, 0, 0] = 0.9
    axes.axis_from_mirrors(flat, exact, 2)
