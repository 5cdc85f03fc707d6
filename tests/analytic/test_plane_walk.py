"""The walk between planes: intervals of cells, compared with the sorted crossings of each ray in float64."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.gaussian_field import PlaneGrid
from mivol.transport.traversal.plane_walk import walk_planes

pytestmark = pytest.mark.usefixtures("variant_rgb")

PLANES = [np.float32([-1, -0.9, -0.1, 0.03, 1]), np.float32([-1, 0.4, 1]), np.float32([-1, 0, 0.001, 0.5, 0.75, 2])]
"""Thin and wide cells."""

ROUNDING = 2e-5
"""Of a distance in a box of size 3: a place has 2e-7, and the least cosine of the rays below, 0.02, divides it."""


def rays_inside(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts in the box, unit directions and lengths up to the box's end; some run along an axis, some in a plane."""
    rng = np.random.default_rng(0)
    low, high = (np.array([axis[k] for axis in PLANES], np.float64) for k in (0, -1))
    o, d = rng.uniform(low, high, (count, 3)), rng.normal(size=(count, 3))
    d = np.where(np.abs(d) < 0.1, 0.1, d)
    d[:30] = np.eye(3)[rng.integers(3, size=30)] * rng.choice([-1, 1], (30, 1))
    o[:10, 0] = PLANES[0][2]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (x.astype(np.float32).astype(np.float64) for x in (o, d))
    with np.errstate(divide="ignore"):
        length = np.where(d > 0, high - o, low - o) / np.where(d == 0, np.inf, d)
    length = np.where(d == 0, np.inf, length).min(axis=1)
    return o, d, length.astype(np.float32)


def walk(o: np.ndarray, d: np.ndarray, length: np.ndarray, until: float | None = None) -> np.ndarray:
    """For each ray: sums of interval lengths, of lengths times the number of the cell, of ends minus next starts, and cells."""
    grid = PlaneGrid.from_planes(PLANES)

    def visit(state: tuple, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> tuple:
        number = mi.Float(cell.x + 10 * cell.y + 100 * cell.z)
        total, weighted, gap, last, cells = state
        return total + (t1 - t0), weighted + (t1 - t0) * number, gap + dr.abs(t0 - last), t1, cells + 1

    start = tuple(dr.zeros(mi.Float, len(o)) for _ in range(5))
    place, along = mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))
    enough = None if until is None else lambda state: state[0] > until
    return np.stack([np.array(x) for x in walk_planes(grid, place, along, mi.Float(length), visit, start, True, enough)])


def test_cells_and_intervals_are_those_of_the_sorted_crossings() -> None:
    o, d, length = rays_inside(300)
    total, weighted, gap, last, cells = walk(o, d, length)
    np.testing.assert_array_equal(gap, 0)
    np.testing.assert_array_equal(last, length)
    np.testing.assert_allclose(total, length, rtol=1e-6)
    for k in range(300):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.concatenate([(axis[1:-1] - o[k, a]) / d[k, a] for a, axis in enumerate(PLANES)])
        t = np.sort(np.concatenate([[0.0, length[k]], t[(t > 0) & (t < length[k])]]))
        middle = o[k] + d[k] * ((t[1:] + t[:-1]) / 2)[:, None]
        numbers = sum(10**a * (np.searchsorted(axis, middle[:, a], "right") - 1) for a, axis in enumerate(PLANES))
        assert weighted[k] == pytest.approx(np.diff(t) @ numbers, abs=500 * ROUNDING)
        assert len(t) - 1 <= cells[k] <= len(t) + 1


def test_a_walk_stops_where_enough_is_met() -> None:
    """Behind the cell in which the sum passes the limit; lanes of length 0 visit nothing."""
    o, d, length = rays_inside(300)
    length[:5] = 0
    whole, short = walk(o, d, length), walk(o, d, length, 0.5)
    passes = whole[0] > 0.5
    assert (short[0][passes] > 0.5).all() and (short[4] < whole[4]).any()
    np.testing.assert_array_equal(short[:, ~passes], whole[:, ~passes])
    np.testing.assert_array_equal(short[4][:5], 0)


def test_points_get_the_cell_that_holds_them() -> None:
    o, _, _ = rays_inside(300)
    o[:3] = [[-1, -1, -1], [1, 1, 2], [0, 0, 2.1]]
    cell, inside = PlaneGrid.from_planes(PLANES).find_cell(mi.Point3f(o.T.astype(np.float32)))
    for a, axis in enumerate(PLANES):
        truth = np.searchsorted(axis, np.float32(o[:, a]), side="right") - 1
        np.testing.assert_array_equal(np.array(cell)[a], np.clip(truth, 0, len(axis) - 2))
    np.testing.assert_array_equal(np.array(inside), np.arange(300) != 2)
