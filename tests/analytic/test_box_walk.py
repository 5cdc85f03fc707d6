"""The walk through the cells of a box, against the planes that a ray crosses."""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.box import Box
from mivol.transport.traversal.box_walk import walk_box
from scenes import FRAMES, random_rays, to_lanes

pytestmark = pytest.mark.usefixtures("variant_rgb")

COUNT = 4


def lengths(place: np.ndarray, o: np.ndarray, d: np.ndarray, on: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What rays pass of each cell (n, z, y, x), where the last cell of each ends, and gaps between cells."""
    rows = [[COUNT * v for v in row] for row in Box(place).rows()]
    p, w = to_lanes(o, d)
    n = dr.width(p)
    table = dr.zeros(mi.Float, n * COUNT**3)

    def visit(state: tuple, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> tuple:
        last, gap = state
        k = mi.UInt32((cell.z * COUNT + cell.y) * COUNT + cell.x)
        dr.scatter_add(table, t1 - t0, dr.arange(mi.UInt32, n) * COUNT**3 + k, on)
        gap = dr.select(on & (last > 0), dr.maximum(gap, dr.abs(t0 - last)), gap)
        return dr.select(on, t1, last), gap

    zero = dr.zeros(mi.Float, n)
    last, gap = walk_box(rows, COUNT, mi.Ray3f(p, w), visit, (zero, zero), dr.full(mi.Bool, on, n))
    return np.array(table).reshape(n, COUNT, COUNT, COUNT), np.array(last), np.array(gap)


def truth(place: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The same in float64, by sorting all crossings of planes of each ray."""
    inverse = np.linalg.inv(place)
    found = np.zeros((len(o), COUNT, COUNT, COUNT))
    for i, (p, w) in enumerate(zip(o, d, strict=True)):
        q, v = COUNT * (inverse[:3, :3] @ p + inverse[:3, 3]), COUNT * (inverse[:3, :3] @ w)
        crossings = [(k - q[a]) / v[a] for a in range(3) if v[a] != 0 for k in range(COUNT + 1)]
        t = np.sort([0.0, *(c for c in crossings if c > 0)])
        for t0, t1 in pairwise(t):
            cell = np.floor(q + 0.5 * (t0 + t1) * v).astype(int)
            if (cell >= 0).all() and (cell < COUNT).all():
                found[i, cell[2], cell[1], cell[0]] += t1 - t0
    return found


@pytest.mark.parametrize("frame", ["stretched", "sheared"])
@pytest.mark.parametrize("inside", [False, True])
def test_cells_and_what_rays_pass_of_them(frame: str, inside: bool) -> None:
    place = FRAMES[frame]
    rng = np.random.default_rng(3)
    o, d = random_rays(rng, place, 200)
    if inside:
        o = (np.c_[rng.uniform(0, 1, (200, 3)), np.ones(200)] @ place.T)[:, :3].astype(np.float32)
    exact = truth(place, np.float64(o), np.float64(d))
    found, _, gap = lengths(place, o, d)
    size = np.linalg.norm(place[:3, :3].sum(axis=1)) + np.abs(o).max()
    # A crossing is known to some steps of float32 of its distance.
    assert np.abs(found - exact).max() <= 1e-5 * size
    assert exact.sum() > 10 and gap.max() == 0
    assert np.abs(found.sum(axis=(1, 2, 3)) - exact.sum(axis=(1, 2, 3))).max() <= 1e-5 * size


def test_no_cell_outside_is_visited() -> None:
    """Where rounding lets a ray leave its last cell before it leaves the box."""
    place, n = FRAMES["sheared"], 100_000
    p, w = to_lanes(*random_rays(np.random.default_rng(5), place, n))

    def visit(wrong: mi.Bool, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> mi.Bool:
        return wrong | (on & ~dr.all((cell >= 0) & (cell < COUNT)))

    rows, none = [[COUNT * v for v in row] for row in Box(place).rows()], dr.full(mi.Bool, False, n)
    assert not np.array(walk_box(rows, COUNT, mi.Ray3f(p, w), visit, none, ~none)).any()


def test_rays_along_axes_and_rays_that_miss() -> None:
    """Parallel to two faces, in a row of cells; beside the box; in lanes that are off."""
    place = np.eye(4)
    o, d = np.float32([[0.4, 0.9, -1], [2, 0.6, 0.1], [0.4, 1.1, -1]]), np.float32([[0, 0, 1], [-1, 0, 0], [0, 0, 1]])
    found, last, _ = lengths(place, o, d)
    expected = np.zeros((3, COUNT, COUNT, COUNT))
    expected[0, :, 3, 1] = expected[1, 0, 2, :] = 0.25
    assert np.abs(found - expected).max() <= 1e-6
    assert np.abs(last - [2, 2, 0]).max() <= 1e-6
    assert not lengths(place, o, d, on=False)[0].any()
