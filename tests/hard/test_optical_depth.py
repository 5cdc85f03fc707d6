"""Where the line integral of a grid breaks: each case by its number in the list of hard cases.

The judge is the float64 twin, fed with the very float32 rays and voxels of the code under test. What is asked is
|error| <= 2e-6 * integral of (sigma + h |grad sigma|), h a voxel: about 16 float32 roundings of the value and of the
position inside a cell; where a sum of a few terms is known, a few roundings of it.
"""

from __future__ import annotations

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import box_interval, overlap, tau_gradient_twin, tau_scale, tau_twin

from scenes import (
    FRAMES,
    affine,
    as_float32,
    centred,
    make_lattice,
    random_rays,
    rotation,
    tau_and_row,
    tau_fast,
    tensor,
    to_lanes,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")

BOUND = 2e-6
"""Error asked for, relative to the integral of sigma + h |grad sigma|."""

EPS = 2.0**-23
"""Spacing of float32 at 1."""


def positive(rng, shape):
    """Voxels in [0, 1), a third of them empty, as float32 holds them."""
    values = rng.uniform(0, 1, shape)
    return as_float32(np.where(rng.uniform(size=shape) < 1 / 3, 0, values))


def assert_tau(values, to_world, o, d, t_max=math.inf, skip=False):
    """The code under test agrees with the twin on every ray."""
    o, d = np.broadcast_arrays(np.atleast_2d(as_float32(o)), np.atleast_2d(as_float32(d)))
    t_max = as_float32(t_max)
    fast = tau_fast(values, to_world, o, d, t_max, skip)
    twin = tau_twin(values, to_world, o, d, 0.0, t_max)
    allowed = BOUND * tau_scale(values, to_world, o, d, 0.0, t_max)
    assert np.isfinite(fast).all()
    worst = np.unravel_index(np.argmax(np.abs(fast - twin) - allowed), fast.shape)
    assert np.all(np.abs(fast - twin) <= allowed), (
        f"ray {o[worst[0]].tolist()} + t {d[worst[0]].tolist()}: {fast[worst]!r}, the twin says {twin[worst]!r} "
        f"+- {allowed[worst]:.2g}"
    )
    return fast


# -- 1: any optical depth -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [-8, -4, 0, 2, 4])
def test_any_optical_depth(power):
    """Hard case 1."""
    rng = np.random.default_rng(1)
    values = as_float32(10.0**power * rng.uniform(0.5, 1, (6, 6, 6)))
    fast = assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 64))
    assert fast.max() > 0.5 * 10.0**power


# -- 9, 10: along an axis -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zero", [0.0, -0.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_aligned_row_sums(axis, zero):
    # Through voxel centres tau is the voxel's edge times the sum of the row: 8 terms, 8 roundings at most.
    """Hard case 9."""
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
    """Hard case 9."""
    rng = np.random.default_rng(10)
    values = positive(rng, (5, 7, 6, 3))
    for axis, sign, zero in itertools.product(range(3), (1.0, -1.0), (0.0, -0.0)):
        o, d = rng.uniform(-0.1, 1.1, (32, 3)), np.full((32, 3), zero)
        o[:, axis] -= 2 * sign
        d[:, axis] = sign
        assert_tau(values, np.eye(4), o, d)


def test_in_a_coordinate_plane():
    """Hard case 9."""
    rng = np.random.default_rng(11)
    values = positive(rng, (5, 7, 6))
    for axis, zero in itertools.product(range(3), (0.0, -0.0)):
        o, d = random_rays(rng, np.eye(4), 32)
        d[:, axis] = zero
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        assert_tau(values, np.eye(4), o, d)


@pytest.mark.parametrize("tiny", [1e-7, 1e-16, -1e-16, 1e-30, 1e-38, -1e-38, 1e-41, -1e-45])
def test_nearly_axis_aligned(tiny):
    """Hard case 10."""
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
    # 1e-7 over 1e6 lengths is a tenth of the box: rays that start beside it and hit, or start level with it and miss.
    """Hard case 10."""
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


# -- 11, 12: faces, edges, corners ------------------------------------------------------------------------------------


def test_in_cell_faces_and_edges():
    # Cells meet in the planes through voxel centres; 8 voxels, so those planes are exact in binary.
    """Hard case 11."""
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
    # On the plane between two rows of voxels: half of each, to the 8 roundings of the sum.
    """Hard case 11."""
    rng = np.random.default_rng(14)
    values = as_float32(rng.uniform(0.1, 1, (8, 8, 8)))
    o = np.array([[-1, j / 8, (k + 0.5) / 8] for j in range(1, 8) for k in range(8)])
    mean = np.array([(values[k, j - 1] + values[k, j]).sum() / 16 for j in range(1, 8) for k in range(8)])
    fast = tau_fast(values, np.eye(4), o, [1, 0, 0])[:, 0]
    assert np.all(np.abs(fast - mean) <= 8 * EPS * mean)


@pytest.mark.parametrize("n", [1, 2, 8, 16])
def test_diagonals_through_corners(n):
    """Hard case 11."""
    rng = np.random.default_rng(15)
    values = positive(rng, (n, n, n))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    d = signs / math.sqrt(3)
    assert_tau(values, np.eye(4), 0.5 - 2 * signs, d)
    assert_tau(values, np.eye(4), 0.5 - 2 * signs, d, skip=True)
    # Each unit of length once: through a grid of ones, the diagonal of the cube.
    fast = tau_fast(np.ones((n, n, n)), np.eye(4), 0.5 - 2 * signs, signs)
    assert np.all(np.abs(fast - 1) <= (3 * n + 3) * EPS)


def test_grazing_from_outside():
    """Hard case 12."""
    ones = np.ones((4, 4, 4))
    corner = np.array([[2.0, 0, 0.5], [2, 0, 1], [0, 2, 0], [0.5, 2, 0]])  # x + y = 2 touches the edge x = y = 1
    d = np.array([[-1.0, 1, 0], [-1, 1, 0], [1, -1, 0], [0, -1, 1]]) / math.sqrt(2)
    fast = tau_fast(ones, np.eye(4), corner, d)
    assert np.array_equal(fast[:3], np.zeros((3, 1)))
    assert_tau(ones, np.eye(4), corner[3:], d[3:])
    outside = np.nextafter(np.float32(1), np.float32(2))
    fast = tau_fast(ones, np.eye(4), [[-1, outside, 0.5], [0.5, -1e-20, -1], [0.5, 0.5, -1e-30]],
                    [[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert np.array_equal(fast, np.zeros((3, 1)))
    # A face belongs to the grid or to the vacuum, as a set of no volume: all of it or none, never a part.
    fast = tau_fast(ones, np.eye(4), [[-1, 1, 0.5], [-1, 0, 0.5], [0.5, 1, -1]], [[1, 0, 0], [1, 0, 0], [0, 0, 1]])
    assert set(fast.ravel()) <= {0.0, 1.0}


def test_chord_across_a_corner():
    # From 0.1 to one float32 step inside the edge: the chord is sqrt(2) times the depth, in float64.
    """Hard case 12."""
    depths = 2.0 ** -np.arange(3, 23)
    o = np.array([[2 - h, 0, 0.5] for h in depths])
    d = np.array([-1.0, 1, 0]) / math.sqrt(2)
    assert_tau(np.ones((4, 4, 4)), np.eye(4), o, d)


# -- 13, 14, 45: where the ray begins and ends ------------------------------------------------------------------------


def test_origin_inside_or_on_a_face():
    """Hard case 13."""
    rng = np.random.default_rng(16)
    values = positive(rng, (6, 5, 8))
    o, d = rng.uniform(0, 1, (64, 3)), rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert_tau(values, np.eye(4), o, d)
    for axis, face in itertools.product(range(3), (0.0, 1.0)):
        o[:, axis] = face
        fast = assert_tau(values, np.eye(4), o, d)
        outwards = (d[:, axis] > 0) == (face == 1)
        assert np.array_equal(fast[outwards], np.zeros((outwards.sum(), 1)))
    o = (np.floor(rng.uniform(0, 8, (64, 3))) + 0.5) / 8  # on planes where cells meet, and past the far side
    assert_tau(values, np.eye(4), o, d)
    assert np.array_equal(tau_fast(values, np.eye(4), o + 2 * np.abs(d) / d, np.sign(d)), np.zeros((64, 1)))


@pytest.mark.parametrize("skip", [False, True])
def test_where_the_segment_ends(skip):
    """Hard case 14."""
    rng = np.random.default_rng(17)
    values = positive(rng, (6, 5, 8))
    o, d = random_rays(rng, np.eye(4), 64, away=0.3)
    for t_max in (1e-6, 0.01, 0.3, 3e38, math.inf):
        assert_tau(values, np.eye(4), o, d, t_max, skip)
    assert_tau(values, np.eye(4), o, d, rng.uniform(0, 1.5, 64), skip)
    for t_max in (0.0, -0.0, -1.0, -math.inf):
        assert np.array_equal(tau_fast(values, np.eye(4), o, d, t_max, skip), np.zeros((64, 1)))


def test_segments_within_one_cell():
    """Hard case 14."""
    rng = np.random.default_rng(18)
    values = as_float32(rng.uniform(0.5, 1, (4, 4, 4)))
    o, d = rng.uniform(0.3, 0.6, (64, 3)), rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    for t_max in (1e-3, 1e-8, 1e-20, 1e-37):
        assert_tau(values, np.eye(4), o, d, t_max)


def test_inactive_and_broken_rays():
    """Hard case 14."""
    from mivol.transport.media.grid_integral import integrate_tau

    lattice = make_lattice(np.ones((4, 4, 4)), np.eye(4))
    o, d = np.tile([0.5, 0.5, -1.0], (4, 1)), np.tile([0.0, 0, 1], (4, 1))
    d[1] = 0  # no direction: it stays where it is for ever
    active = mi.Bool([True, True, False, True])
    tau = integrate_tau(lattice, *to_lanes(o, d), mi.Float(math.inf), active)
    assert np.array_equal(np.asarray(tau), [1, 0, 0, 1])


@pytest.mark.parametrize("sigma", [1.0, 1e3])
def test_camera_inside_a_dense_medium(sigma):
    """Hard case 45."""
    values = np.full((16, 16, 16), sigma)
    rng = np.random.default_rng(19)
    d = rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert_tau(values, centred(2 * np.eye(3)), np.zeros((64, 3)), d)
    assert tau_fast(values, centred(2 * np.eye(3)), [0, 0, 0], [0, 1, 0])[0, 0] == pytest.approx(sigma, rel=16 * EPS)


# -- 15, 16, 17: frames -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [2, 3, 4, 5, 6])
def test_origin_far_away(power):
    # A float32 origin there is a coarse one, but it is a point like any other: through the middle, exactly.
    """Hard case 15."""
    rng = np.random.default_rng(20)
    values = positive(rng, (24, 24, 24))
    n = 64
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = as_float32(rng.uniform(0.3, 0.7, (n, 3)) - 10.0**power * d)
    target = rng.uniform(0.3, 0.7, (n, 3))
    d = as_float32((target - o) / np.linalg.norm(target - o, axis=1, keepdims=True))
    fast = assert_tau(values, np.eye(4), o, d)
    assert np.count_nonzero(fast) > n / 4
    axis_aligned = np.column_stack([np.full(n, -(10.0**power)), rng.uniform(0, 1, (n, 2))])
    fast = assert_tau(values, np.eye(4), axis_aligned, [1, 0, 0])
    assert np.count_nonzero(fast) == n


def test_box_far_from_the_origin_of_the_world():
    """Hard case 15."""
    rng = np.random.default_rng(21)
    values = positive(rng, (8, 8, 8))
    to_world = centred(100 * rotation([1, 1, 0], 0.5), (1e5, -2e5, 3e4))
    assert_tau(values, to_world, *random_rays(rng, to_world, 64))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scene_scale(scale):
    """Hard case 16."""
    rng = np.random.default_rng(22)
    values = positive(rng, (7, 6, 5))
    o, d = random_rays(rng, centred(np.eye(3)), 64)
    fast = assert_tau(values / scale, centred(scale * np.eye(3)), o * scale, d)
    assert fast.max() > 0.3


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("skip", [False, True])
def test_frames(name, skip):
    """Hard case 17."""
    rng = np.random.default_rng(23)
    values = positive(rng, (12, 5, 9, 3))
    assert_tau(values, FRAMES[name], *random_rays(rng, FRAMES[name], 64), skip=skip)


def test_change_of_frame_changes_nothing():
    # The same rays and the same field, turned, mirrored and moved together; both errors count, and the rounding of the
    # moved ray to float32 (positions of up to 8 voxels by EPS) is below the third.
    """Hard case 17."""
    rng = np.random.default_rng(24)
    values = positive(rng, (8, 8, 8))
    o, d = random_rays(rng, centred(np.eye(3)), 128)
    here = tau_fast(values, centred(np.eye(3)), o, d)
    allowed = 3 * BOUND * tau_scale(values, centred(np.eye(3)), o, d)
    turns = [rotation([3, -1, 2], 1.1), np.diag([1.0, -1, 1]), np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])]
    sane = allowed[:, 0] > 0.1 * np.median(allowed)
    for turn in turns:
        there = tau_fast(values, centred(turn), o @ turn.T, d @ turn.T)
        assert np.all((np.abs(there - here) <= allowed)[sane])


def test_length_is_world_length():
    """Hard case 17."""
    rng = np.random.default_rng(25)
    for to_world in FRAMES.values():
        o, d = random_rays(rng, to_world, 32)
        inside = [overlap((0, math.inf), box_interval(to_world, *ray)) for ray in zip(o, d, strict=True)]
        chord = np.diff(inside, axis=1)
        fast = tau_fast(np.ones((3, 2, 4)), to_world, o, d)
        assert np.all(np.abs(fast - chord) <= BOUND * chord)


@pytest.mark.parametrize(
    ("matrix", "named"),
    [
        (np.diag([1.0, 1, 0, 1]), "degenerate"),
        (affine(np.ones((3, 3))), "degenerate"),
        (np.full((4, 4), np.nan), "finite"),
        (affine(np.diag([1, 1, np.inf])), "finite"),
        (np.eye(3), "4x4"),
        (np.diag([1.0, 1, 1, 2]), "affine"),
    ],
)
def test_degenerate_frames_are_refused(matrix, named):
    """Hard case 49."""
    with pytest.raises(ValueError, match=named):
        make_lattice(np.ones((2, 2, 2)), matrix)


@pytest.mark.parametrize("shape", [(0, 2, 2, 1), (2, 2, 2), (2, 2)])
def test_empty_or_flat_grids_are_refused(shape):
    """Hard case 49."""
    from mivol.transport.traversal.lattice import Lattice

    with pytest.raises(ValueError, match="shape"):
        Lattice(mi.TensorXf(np.ones(shape, dtype=np.float32)), np.eye(4))


# -- 18, 19, 20, 22, 50: grids ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 7), (1, 7, 1), (7, 1, 1), (1, 5, 6), (5, 1, 6), (5, 6, 1)])
def test_single_voxels(shape):
    """Hard case 18."""
    rng = np.random.default_rng(26)
    values = as_float32(rng.uniform(0.1, 1, shape))
    o, d = random_rays(rng, FRAMES["stretched"], 48)
    fast = assert_tau(values, FRAMES["stretched"], o, d)
    assert np.array_equal(fast, tau_fast(values, FRAMES["stretched"], o, d, skip=True))
    # An axis of one voxel is an axis along which nothing changes: doubling it is the same field.
    axis = shape.index(1)
    doubled = tau_fast(np.repeat(values, 2, axis=axis), FRAMES["stretched"], o, d)
    assert np.all(np.abs(doubled - fast) <= 2 * BOUND * tau_scale(values, FRAMES["stretched"], o, d) + 1e-30)


@pytest.mark.parametrize("n", [2, 3, 17])
def test_checkerboard(n):
    """Hard case 19."""
    rng = np.random.default_rng(27)
    values = 50.0 * (np.indices((n, n, n)).sum(axis=0) % 2)
    for skip in (False, True):
        assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 64), skip=skip)


@pytest.mark.parametrize("skip", [False, True])
def test_empty_grid(skip):
    """Hard case 20."""
    rng = np.random.default_rng(28)
    fast = tau_fast(np.zeros((20, 9, 17, 3)), np.eye(4), *random_rays(rng, np.eye(4), 64), skip=skip)
    assert fast.shape == (64, 3)
    assert np.array_equal(fast, np.zeros((64, 3)))


def shell(n):
    """One voxel thick, of radius 0.35, in an otherwise empty grid."""
    c = (np.arange(n) + 0.5) / n - 0.5
    r = np.sqrt(c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2)
    return (np.abs(r - 0.35) < 0.5 / n).astype(float)


@pytest.mark.parametrize("tau_shell", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("skip", [False, True])
def test_thin_shell(tau_shell, skip):
    """Hard case 22."""
    rng = np.random.default_rng(29)
    n = 40
    values = as_float32(shell(n) * n * tau_shell)
    assert np.count_nonzero(values) > 1000
    assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 96), skip=skip)


@pytest.mark.parametrize("skip", [False, True])
def test_half_empty(skip):
    """Hard case 22."""
    rng = np.random.default_rng(30)
    values = positive(rng, (33, 20, 41, 3))
    values[:, :, 13:] = 0
    values[0, 0, 40] = 1  # one voxel alone in a corner, which half a voxel of border repeats
    assert_tau(values, FRAMES["mirrored"], *random_rays(rng, FRAMES["mirrored"], 96), skip=skip)
    corner = np.array([40.6, 0.3, 0.2]) / [41, 20, 33]
    o = np.tile(corner - [0, 0, 1], (1, 1))
    assert assert_tau(values, np.eye(4), o, [0, 0, 1], skip=skip)[0, 0] > 0.01


def test_gaps_are_the_distances_between_blocks():
    # Chebyshev distances of integers, by brute force over the blocks that hold anything: equal, not close.
    """Hard case 22."""
    from mivol.transport.traversal.empty_blocks import BLOCK, REACH, block_bounds, find_empty_distances

    rng = np.random.default_rng(32)
    values = np.where(rng.uniform(size=(23, 90, 41)) < 2e-4, 1, 0)
    empty_distances = np.array(find_empty_distances(tensor(values))).reshape(*(-(-(n + 1) // BLOCK) for n in values.shape))
    held = np.argwhere(np.array(block_bounds(tensor(values))).reshape(empty_distances.shape) > 0)
    assert 1 < len(held) < empty_distances.size / 4
    away = np.abs(np.indices(empty_distances.shape).reshape(3, -1).T[:, None] - held).max(axis=2).min(axis=1)
    assert away.max() > 2
    np.testing.assert_array_equal(empty_distances.ravel(), np.minimum(away, REACH))
    assert np.all(np.array(find_empty_distances(tensor(np.zeros((9, 9, 9))))) == REACH)


@pytest.mark.parametrize("skip", [False, True])
def test_gradient_in_and_out_of_the_shell(skip):
    # d tau / d sigma does not know sigma: the voxels of an empty block have the same row of A as all others.
    """Hard case 22."""
    from mivol.transport.media.grid_integral import integrate_tau

    values = tensor(shell(24))
    dr.enable_grad(values)
    o, d = np.array([[-1.0, 0.43, 0.52]]), np.array([[0.96, 0.28, 0.0]])
    tau = integrate_tau(make_lattice(values, np.eye(4), skip), *to_lanes(o, d), mi.Float(math.inf), mi.Bool(True))
    dr.backward(tau)
    row = tau_gradient_twin((24, 24, 24), np.eye(4), as_float32(o[0]), as_float32(d[0]))
    got = np.asarray(dr.grad(values))[..., 0]
    assert np.all(np.abs(got - row) <= BOUND * 2 / 24 + BOUND * row)
    assert np.count_nonzero(got) >= np.count_nonzero(row > 1e-4)


def test_outer_half_voxel():
    # Between the outermost voxel centres and the faces the field is constant in that direction.
    """Hard case 50."""
    rng = np.random.default_rng(31)
    values = as_float32(rng.uniform(0.1, 1, (8, 4, 6)))
    assert_tau(values, np.eye(4), np.column_stack([np.full(16, -1), rng.uniform(0, 1 / 8, 16), rng.uniform(0, 1, 16)]),
               [1, 0, 0])
    o = np.array([[-1, 0.01, 0.03], [-1, 0.99, 0.97]])
    corner_rows = np.array([values[0, 0].sum() / 6, values[7, 3].sum() / 6])
    fast = tau_fast(values, np.eye(4), o, [1, 0, 0])[:, 0]
    assert np.all(np.abs(fast - corner_rows) <= 8 * EPS * corner_rows)
    o, d = rng.uniform(0, 1, (32, 3)), np.zeros((32, 3))
    o[:, 0], d[:, 1:] = rng.uniform(0, 1 / 12, 32), rng.normal(size=(32, 2))
    assert_tau(values, np.eye(4), o, d / np.linalg.norm(d, axis=1, keepdims=True))


# -- 41, 43, 44, 52: rounding -----------------------------------------------------------------------------------------


def test_long_rays():
    """Hard case 41."""
    rng = np.random.default_rng(32)
    for shape in ((1024, 2, 2), (2, 1024, 2), (2, 2, 1024)):
        values = positive(rng, shape)
        to_world = affine(np.diag(np.array(shape[::-1], dtype=float)))
        o, d = random_rays(rng, to_world, 16)
        axis = 2 - shape.index(1024)
        aim = np.zeros((16, 3))
        aim[:, axis] = 1
        aim += rng.uniform(-1, 1, (16, 3)) / 2048
        start = rng.uniform(0.6, 1.4, (16, 3))
        start[:, axis] = -5
        assert_tau(values, to_world, o, d)
        fast = assert_tau(values, to_world, start, aim / np.linalg.norm(aim, axis=1, keepdims=True))
        assert fast.min() > 100


def test_the_same_twice():
    # Forward there is no sum across lanes, so no order: bit for bit the same, alone or among others.
    """Hard case 43."""
    rng = np.random.default_rng(33)
    values = positive(rng, (9, 9, 9))
    o, d = random_rays(rng, np.eye(4), 4096)
    whole = tau_fast(values, np.eye(4), o, d)
    assert np.array_equal(whole, tau_fast(values, np.eye(4), o, d))
    assert np.array_equal(whole[100:117], tau_fast(values, np.eye(4), o[100:117], d[100:117]))


def test_gradients_bitwise_with_one_thread(two_threads):
    """Hard case 43."""
    rng = np.random.default_rng(34)
    o, d = random_rays(rng, np.eye(4), 100_000)
    threads = dr.thread_count()
    several = [tau_and_row((5, 5, 5), np.eye(4), o, d)[1] for _ in range(2)]
    dr.set_thread_count(1)
    try:
        one = [tau_and_row((5, 5, 5), np.eye(4), o, d)[1] for _ in range(2)]
    finally:
        dr.set_thread_count(threads)
    assert np.array_equal(*one)
    # Several threads add in any order: 2e-7 seen; random signs over 1e5 terms of float32 stay below 1e-5.
    assert np.all(np.abs(several[0] - several[1]) <= 1e-5 * one[0])
    assert np.all(np.abs(several[0] - one[0]) <= 1e-5 * one[0])


def test_planes_that_coincide():
    # Rays through the edges and corners of cells reach two or three planes at once: each unit of length still once.
    """Hard case 44."""
    rng = np.random.default_rng(35)
    values = positive(rng, (8, 8, 8))
    nodes = (rng.integers(0, 8, (96, 3)) + 0.5) / 8
    steps = rng.integers(-2, 3, (96, 3)).astype(float)
    steps[np.all(steps == 0, axis=1)] = [1, 1, 0]
    d = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    for skip in (False, True):
        assert_tau(values, np.eye(4), nodes - 4 * steps, d, skip=skip)
        assert_tau(values, np.eye(4), nodes, d, skip=skip)
        # Directions of any length: t then counts in that length, and the planes coincide to the last bit.
        assert_tau(values, np.eye(4), nodes - 4 * steps, steps, skip=skip)


@pytest.mark.parametrize("skip", [False, True])
def test_cubed_against_the_twin(skip):
    """Hard cases 52 and 256."""
    rng = np.random.default_rng(36)
    values = np.zeros((256, 256, 256), dtype=np.float32)
    values[40:210, 60:250, 10:230] = rng.uniform(0, 1, (170, 190, 220)).astype(np.float32)
    to_world = centred(2 * np.eye(3))
    assert_tau(values, to_world, *random_rays(rng, to_world, 150), skip=skip)


def lattice_step(n):
    """Half a float32 spacing at n: how well a position among n voxels is known, in voxels."""
    return n * EPS / 2


@pytest.mark.parametrize("filled", [slice(250, 256), slice(255, 256)])
def test_the_end_is_where_it_is_after_256_cells(filled):
    """Rationale: a wall, or the box, ends a ray in the only filled cells, after 250 empty ones.
    Expected: the end is as good as a float32 position on that lattice, not as a running difference of 600 steps.

    Hard case 14.
    """
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
    # Rays that graze a diagonal sheet for 256 cells: a position errs by the float32 step of the lattice, always to one
    # side, and the gradient turns that into optical depth.
    """Hard case 52."""
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


def test_smooth_fields_against_the_twin():
    # A smooth field leaves no random sign to cancel what a systematic error of position would do.
    """Hard case 52."""
    n = 128
    c = (np.arange(n) + 0.5) / n - 0.5
    r2 = c[:, None, None] ** 2 + c[None, :, None] ** 2 + c[None, None, :] ** 2
    values = as_float32(np.exp(-r2 / 0.02))
    rng = np.random.default_rng(37)
    assert_tau(values, np.eye(4), *random_rays(rng, np.eye(4), 150))
