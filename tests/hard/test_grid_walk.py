"""Walks of cells in hard cases: rays along planes, through edges and corners, along the border of the support, and in plain
boxes.
"""

from __future__ import annotations

import itertools
import math
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hard_rays import BOUND, EPS, assert_tau, positive
from oracle import tau_scale, tau_twin

from mivol.fields.gaussian_field import PlaneGrid
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.grid_walk import walk_box_cells, walk_planes
from scenes import FRAMES, affine, as_float32, random_rays, tau_fast, to_lanes


@pytest.mark.parametrize("zero", [0.0, -0.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_aligned_row_sums(axis, zero):
    """Through voxel centres tau is the voxel's edge times the sum of the row: 8 terms, 8 roundings at most."""
    rng = np.random.default_rng(9)
    values = as_float32(rng.uniform(0.1, 1, (8, 8, 8)))
    index = list(itertools.product(range(8), repeat=2))
    for sign in (1.0, -1.0):
        o, d = np.empty((64, 3)), np.full((64, 3), zero)
        o[:, axis], d[:, axis] = -3.0 * sign + 0.5, sign
        others = [a for a in range(3) if a != axis]
        o[:, others] = (np.array(index) + 0.5) / 8
        rows = values.transpose(2, 1, 0).transpose(*others, axis).reshape(64, 8).sum(axis=1) / 8
        fast = tau_fast(values, np.eye(4), o, d)[:, 0]
        assert np.all(np.abs(fast - rows) <= 8 * EPS * rows)


def test_axis_aligned_off_centre():
    rng = np.random.default_rng(10)
    values = positive(rng, (5, 7, 6, 3))
    for axis, sign, zero in itertools.product(range(3), (1.0, -1.0), (0.0, -0.0)):
        o, d = rng.uniform(-0.1, 1.1, (32, 3)), np.full((32, 3), zero)
        o[:, axis] -= 2 * sign
        d[:, axis] = sign
        assert_tau(values, np.eye(4), o, d)


def test_in_a_coordinate_plane():
    rng = np.random.default_rng(11)
    values = positive(rng, (5, 7, 6))
    for axis, zero in itertools.product(range(3), (0.0, -0.0)):
        o, d = random_rays(rng, np.eye(4), 32)
        d[:, axis] = zero
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        assert_tau(values, np.eye(4), o, d)


@pytest.mark.slow_for("-1e-45", "1e-30", "1e-38")
@pytest.mark.parametrize("tiny", [1e-7, 1e-16, -1e-16, 1e-30, 1e-38, -1e-38, 1e-41, -1e-45])
def test_nearly_axis_aligned(tiny):
    rng = np.random.default_rng(12)
    values = positive(rng, (4, 6, 5))
    for axis in range(3):
        o, d = rng.uniform(0.02, 0.98, (24, 3)), np.full((24, 3), tiny)
        o[:, axis] = -1.5
        d[:, axis] = 1.0
        o[:8] = (np.floor(o[:8] * 4) + 0.5) / 4  # some of them in the planes where cells meet
        o[:8, axis] = -1.5
        fast = assert_tau(values, np.eye(4), o, d)
        # A ray turned by 1e-16 is displaced by less than float64 sees: the same as the straight one.
        if abs(tiny) < 1e-10:
            straight = tau_fast(values, np.eye(4), o, np.eye(3)[axis])
            allowed = 2 * BOUND * tau_scale(values, np.eye(4), as_float32(o), np.tile(np.eye(3)[axis], (24, 1)))
            assert np.all(np.abs(fast - straight) <= allowed)


def test_a_tilt_of_1e_7_counts_from_far_away():
    """1e-7 over 1e6 lengths is a tenth of the box: rays that start beside it and hit, or start level with it and miss."""
    rng = np.random.default_rng(40)
    values = as_float32(rng.uniform(0.5, 1, (4, 6, 5)))
    for axis in range(3):
        other = (axis + 1) % 3
        o, d = np.full((2, 3), 0.4), np.zeros((2, 3))
        o[:, axis], o[:, other] = -1e6, (-0.05, 0.95)
        d[:, axis], d[:, other] = 1, 1e-7
        fast = assert_tau(values, np.eye(4), o, d)
        assert fast[0] > 0.5
        assert fast[1] == 0


def test_in_cell_faces_and_edges():
    """Cells meet in the planes through voxel centres; 8 voxels, so those planes are exact in binary."""
    rng = np.random.default_rng(13)
    values = positive(rng, (8, 8, 8))
    for axis in range(3):
        b, c = (a for a in range(3) if a != axis)
        o, d = np.empty((64, 3)), rng.normal(size=(64, 3))
        o[:] = rng.uniform(-0.2, 1.2, (64, 3))
        o[:, axis] = (rng.integers(0, 8, 64) + 0.5) / 8
        d[:, axis] = 0
        assert_tau(values, np.eye(4), o, d / np.linalg.norm(d, axis=1, keepdims=True))  # in a face
        o[:, b] = (rng.integers(0, 8, 64) + 0.5) / 8
        o[:, c], d[:, b], d[:, c] = -1, 0, 1
        assert_tau(values, np.eye(4), o, d)  # along an edge


def test_midway_between_rows():
    """On the plane between two rows of voxels: half of each, to the 8 roundings of the sum."""
    rng = np.random.default_rng(14)
    values = as_float32(rng.uniform(0.1, 1, (8, 8, 8)))
    o = np.array([[-1, j / 8, (k + 0.5) / 8] for j in range(1, 8) for k in range(8)])
    mean = np.array([(values[k, j - 1] + values[k, j]).sum() / 16 for j in range(1, 8) for k in range(8)])
    fast = tau_fast(values, np.eye(4), o, [1, 0, 0])[:, 0]
    assert np.all(np.abs(fast - mean) <= 8 * EPS * mean)


@pytest.mark.parametrize("n", [1, 2, 8, 16])
def test_diagonals_through_corners(n):
    rng = np.random.default_rng(15)
    values = positive(rng, (n, n, n))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    d = signs / math.sqrt(3)
    assert_tau(values, np.eye(4), 0.5 - 2 * signs, d)
    for skip in (True, "ends"):
        assert_tau(values, np.eye(4), 0.5 - 2 * signs, d, skip=skip)
    # Each unit of length once: through a grid of ones, the diagonal of the cube.
    fast = tau_fast(np.ones((n, n, n)), np.eye(4), 0.5 - 2 * signs, signs)
    assert np.all(np.abs(fast - 1) <= (3 * n + 3) * EPS)


def test_grazing_from_outside():
    ones = np.ones((4, 4, 4))
    corner = np.array([[2.0, 0, 0.5], [2, 0, 1], [0, 2, 0], [0.5, 2, 0]])  # x + y = 2 touches the edge x = y = 1
    d = np.array([[-1.0, 1, 0], [-1, 1, 0], [1, -1, 0], [0, -1, 1]]) / math.sqrt(2)
    fast = tau_fast(ones, np.eye(4), corner, d)
    assert np.array_equal(fast[:3], np.zeros((3, 1)))
    assert_tau(ones, np.eye(4), corner[3:], d[3:])
    outside = np.nextafter(np.float32(1), np.float32(2))
    fast = tau_fast(
        ones, np.eye(4), [[-1, outside, 0.5], [0.5, -1e-20, -1], [0.5, 0.5, -1e-30]], [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
    )
    assert np.array_equal(fast, np.zeros((3, 1)))
    # A face belongs to the grid or to the vacuum, as a set of no volume: all of it or none, never a part.
    fast = tau_fast(ones, np.eye(4), [[-1, 1, 0.5], [-1, 0, 0.5], [0.5, 1, -1]], [[1, 0, 0], [1, 0, 0], [0, 0, 1]])
    assert set(fast.ravel()) <= {0.0, 1.0}


def test_chord_across_a_corner():
    """From 0.1 to one float32 step inside the edge: the chord is sqrt(2) times the depth, in float64."""
    depths = 2.0 ** -np.arange(3, 23)
    o = np.array([[2 - h, 0, 0.5] for h in depths])
    d = np.array([-1.0, 1, 0]) / math.sqrt(2)
    assert_tau(np.ones((4, 4, 4)), np.eye(4), o, d)


def test_planes_that_coincide():
    """Rays through the edges and corners of cells reach two or three planes at once: each unit of length still once."""
    rng = np.random.default_rng(35)
    values = positive(rng, (8, 8, 8))
    nodes = (rng.integers(0, 8, (96, 3)) + 0.5) / 8
    steps = rng.integers(-2, 3, (96, 3)).astype(float)
    steps[np.all(steps == 0, axis=1)] = [1, 1, 0]
    d = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    for skip in (False, True, "ends"):
        assert_tau(values, np.eye(4), nodes - 4 * steps, d, skip=skip)
        assert_tau(values, np.eye(4), nodes, d, skip=skip)
        # Directions of any length: t then counts in that length, and the planes coincide to the last bit.
        assert_tau(values, np.eye(4), nodes - 4 * steps, steps, skip=skip)


def lattice_step(n):
    """Half a float32 spacing at n [voxels]: the accuracy of a position among n voxels."""
    return n * EPS / 2


@pytest.mark.slow_for("filled0")
@pytest.mark.parametrize("filled", [slice(250, 256), slice(255, 256)])
def test_the_end_is_where_it_is_after_256_cells(filled):
    """Rationale: a wall, or the box, ends a ray in the only filled cells, after 250 empty cells. Expected: the end is as
    accurate as a float32 position on this lattice, better than a running difference of 600 steps."""
    rng = np.random.default_rng(38)
    n, rays = 256, 100
    values = np.zeros((160, 160, n), dtype=np.float32)
    values[:, :, filled] = 1
    to_world = affine(np.diag([n, 160.0, 160.0]))
    d = np.column_stack([np.ones(rays), rng.uniform(-0.3, 0.3, (rays, 2))])
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    o = as_float32(np.column_stack([np.full(rays, -3), rng.uniform(78, 82, (rays, 2))]))
    t_max = as_float32((3 + rng.uniform(filled.start + 0.6, n, rays)) / d[:, 0])
    allowed = BOUND * tau_scale(values, to_world, o, d, 0.0, t_max) + 2 * lattice_step(n)
    for end in (t_max, math.inf):
        fast, twin = tau_fast(values, to_world, o, d, end), tau_twin(values, to_world, o, d, 0.0, end)
        error = np.abs(fast - twin)
        assert np.all(error <= allowed), f"the end is off by {error.max():.2g} voxels, {allowed.max():.2g} allowed"


def test_along_the_edge_of_the_support():
    """Rays that graze a diagonal sheet for 256 cells: a position errs by the float32 step of the lattice, always to one side,
    and the gradient turns that into optical depth."""
    rng = np.random.default_rng(39)
    n, rays = 256, 100
    x = np.arange(n)
    values = np.tile(np.clip(x[None, :] - x[:, None], 0, 1).astype(np.float32), (3, 1, 1))
    to_world = affine(np.diag([n, n, 3.0]))
    start = rng.uniform(-5, 5, rays)
    o = as_float32(np.column_stack([start, start + rng.uniform(-0.5, 1.2, rays), np.full(rays, 1.4)]))
    d = np.column_stack([np.ones(rays), 1 + rng.uniform(-1e-3, 1e-3, rays), rng.uniform(-2e-3, 2e-3, rays)])
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    fast, twin = tau_fast(values, to_world, o, d), tau_twin(values, to_world, o, d)
    allowed = (BOUND + lattice_step(n)) * tau_scale(values, to_world, o, d)
    assert np.all(np.abs(fast - twin) <= allowed)


COUNT = 4


def lengths(place: np.ndarray, o: np.ndarray, d: np.ndarray, on: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Length of rays in each cell (n, z, y, x), the end of the last cell of each ray, and gaps between cells."""
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
    last, gap = walk_box_cells(rows, COUNT, mi.Ray3f(p, w), visit, (zero, zero), dr.full(mi.Bool, on, n))
    return np.array(table).reshape(n, COUNT, COUNT, COUNT), np.array(last), np.array(gap)


def truth(place: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The same in float64, by sorting all plane crossings of each ray."""
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
    """For rays that rounding lets leave their last cell before they leave the box."""
    place, n = FRAMES["sheared"], 100_000
    p, w = to_lanes(*random_rays(np.random.default_rng(5), place, n))

    def visit(wrong: mi.Bool, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> mi.Bool:
        return wrong | (on & ~dr.all((cell >= 0) & (cell < COUNT)))

    rows, none = [[COUNT * v for v in row] for row in Box(place).rows()], dr.full(mi.Bool, False, n)
    assert not np.array(walk_box_cells(rows, COUNT, mi.Ray3f(p, w), visit, none, ~none)).any()


def test_rays_along_axes_and_rays_that_miss() -> None:
    """Parallel to two faces, in a row of cells; beside the box; inactive lanes."""
    place = np.eye(4)
    o, d = np.float32([[0.4, 0.9, -1], [2, 0.6, 0.1], [0.4, 1.1, -1]]), np.float32([[0, 0, 1], [-1, 0, 0], [0, 0, 1]])
    found, last, _ = lengths(place, o, d)
    expected = np.zeros((3, COUNT, COUNT, COUNT))
    expected[0, :, 3, 1] = expected[1, 0, 2, :] = 0.25
    assert np.abs(found - expected).max() <= 1e-6
    assert np.abs(last - [2, 2, 0]).max() <= 1e-6
    assert not lengths(place, o, d, on=False)[0].any()


# -- Between planes ----------------------------------------------------------------------------------------------------

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
