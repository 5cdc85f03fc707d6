"""Laws that every line integral obeys, on seeded random grids, frames and rays; no oracle is needed.

Tolerances: each side of an equation errs by at most 2e-6 * integral of (sigma + h |grad sigma|),
so a law with k terms is granted k times that; where float32 arithmetic is exact (multiplying by a power of two) it is
equality.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import box_interval, overlap, tau_scale

from scenes import FRAMES, affine, as_float32, centred, random_rays, rotation, tau_and_row, tau_fast

pytestmark = pytest.mark.usefixtures("variant_rgb")

BOUND = 2e-6
N_RAYS = 64


def draw(seed, name, channels=1):
    """A grid, its place, and rays through it."""
    rng = np.random.default_rng([seed, *name.encode()])
    values = as_float32(rng.uniform(0, 1, (9, 6, 7, channels)) ** 3)
    return rng, values, FRAMES[name], *random_rays(rng, FRAMES[name], N_RAYS)


def slack(values, to_world, o, d, t1=math.inf):
    """What one integral may err by."""
    return BOUND * tau_scale(values, to_world, o, d, 0.0, t1) + 1e-37


@pytest.mark.parametrize("name", FRAMES)
def test_transmittance_is_multiplicative(seed, name):
    # T(a, c) = T(a, b) T(b, c): tau up to c is tau up to b and tau from b on. The new origin is rounded to float32,
    # which moves it by EPS of its coordinate: ends by that much of sigma, sides by that much of the gradient.
    rng, values, to_world, o, d = draw(seed, name, 3)
    inside = [overlap((0, math.inf), box_interval(to_world, *ray)) for ray in zip(o, d, strict=True)]
    b = as_float32([t0 + u * (t1 - t0) for (t0, t1), u in zip(inside, rng.uniform(0, 1, N_RAYS), strict=True)])
    middle = o + b[:, None] * d
    rounding = np.linalg.norm(as_float32(middle) - middle, axis=1)[:, None]
    h = np.linalg.norm(to_world[:3, :3], axis=0).min() / 9
    whole, first, rest = tau_fast(values, to_world, o, d), tau_fast(values, to_world, o, d, b), None
    rest = tau_fast(values, to_world, middle, d)
    moved = rounding / h * (tau_scale(values, to_world, o, d) + values.max() * h)
    assert np.all(np.abs(first + rest - whole) <= 2 * slack(values, to_world, o, d) + moved)


@pytest.mark.parametrize("name", FRAMES)
def test_subdivision_changes_nothing(seed, name):
    # With one origin and rising ends nothing is rounded anew: tau(t) is the sum of its increments, and never falls.
    _, values, to_world, o, d = draw(seed, name)
    size = np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    ends = np.linspace(0, 5 * size, 40)
    tau = np.array([tau_fast(values, to_world, o, d, t)[:, 0] for t in ends])
    assert np.all(np.diff(tau, axis=0) >= -slack(values, to_world, o, d)[:, 0])
    assert np.all(np.abs(tau[-1] - tau_fast(values, to_world, o, d)[:, 0]) <= slack(values, to_world, o, d)[:, 0])


@pytest.mark.parametrize("name", FRAMES)
def test_reversal(seed, name):
    # tau(a -> b) = tau(b -> a), between points that float32 holds and a direction that is exactly the opposite.
    rng, values, to_world, _, _ = draw(seed, name, 3)
    grid = 2.0**-12
    corners = (to_world @ np.column_stack([rng.uniform(-0.2, 1.2, (N_RAYS, 3)), np.ones(N_RAYS)]).T).T[:, :3]
    a = np.round(corners / grid) * grid
    steps = np.round(rng.normal(size=(N_RAYS, 3)) / grid) * grid
    b = a + steps
    assert np.array_equal(a, as_float32(a))
    assert np.array_equal(b, as_float32(b))
    there, back = tau_fast(values, to_world, a, steps, 1.0), tau_fast(values, to_world, b, -steps, 1.0)
    assert np.all(np.abs(there - back) <= 2 * slack(values, to_world, a, steps, 1.0))


@pytest.mark.parametrize("name", FRAMES)
def test_monotone_in_sigma(seed, name):
    rng, values, to_world, o, d = draw(seed, name)
    more = as_float32(values + rng.uniform(0, 0.5, values.shape))
    assert np.all(tau_fast(more, to_world, o, d) >= tau_fast(values, to_world, o, d))
    assert np.all(tau_fast(values, to_world, o, d) >= 0)


@pytest.mark.parametrize("name", FRAMES)
def test_linear_in_sigma(seed, name):
    rng, values, to_world, o, d = draw(seed, name)
    other = as_float32(rng.uniform(0, 1, values.shape))
    both = as_float32(values - 0.25 * other)  # a tangent may be negative: the integral takes any sign
    a, b, c = (tau_fast(v, to_world, o, d) for v in (values, other, both))
    allowed = slack(np.abs(values), to_world, o, d) + 2 * slack(other, to_world, o, d)
    assert np.all(np.abs(a - 0.25 * b - c) <= allowed)
    assert np.array_equal(tau_fast(8 * values, to_world, o, d), 8 * a)
    assert np.array_equal(tau_fast(-values, to_world, o, d), -a)


def test_channels_do_not_mix(seed):
    _, values, to_world, o, d = draw(seed, "rotated", 3)
    whole = tau_fast(values, to_world, o, d)
    alone = np.hstack([tau_fast(values[..., c : c + 1], to_world, o, d) for c in range(3)])
    assert np.all(np.abs(whole - alone) <= slack(values, to_world, o, d))


@pytest.mark.parametrize("power", [-10, 7])
def test_scaling(seed, power):
    # World times k, sigma over k: the same optical depth; for a power of two every float32 is scaled exactly.
    k = 2.0**power
    _, values, _, o, d = draw(seed, "stretched")
    to_world = FRAMES["stretched"]
    scaled = np.diag([k, k, k, 1]) @ to_world
    here, there = tau_fast(values, to_world, o, d), tau_fast(values / k, scaled, o * k, d)
    assert np.all(np.abs(here - there) <= 2 * slack(values, to_world, o, d))


@pytest.mark.parametrize("order", [(1, 2, 0), (2, 0, 1), (1, 0, 2)])
def test_permutation_of_axes(seed, order):
    _, values, _, o, d = draw(seed, "unit", 3)
    here = tau_fast(values, np.eye(4), o, d)
    turned = values.transpose(*(2 - a for a in order[::-1]), 3)
    there = tau_fast(turned, np.eye(4), o[:, list(order)], d[:, list(order)])
    assert np.all(np.abs(here - there) <= 2 * slack(values, np.eye(4), o, d))


def test_mirroring_the_grid_mirrors_the_ray(seed):
    _, values, _, o, d = draw(seed, "unit", 3)
    for axis in range(3):
        flip = np.ones(3)
        flip[axis] = -1
        to_world = centred(np.eye(3))
        here = tau_fast(values, to_world, o - 0.5, d)
        there = tau_fast(np.flip(values, 2 - axis), to_world, (o - 0.5) * flip, d * flip)
        mirrored = tau_fast(values, centred(np.diag(flip)), (o - 0.5) * flip, d * flip)
        allowed = 2 * slack(values, to_world, as_float32(o - 0.5), d)
        assert np.all(np.abs(here - there) <= allowed)
        assert np.all(np.abs(here - mirrored) <= allowed)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("skip", [False, True])
def test_row_sums_to_the_chord(seed, name, skip):
    # sum_k d tau / d sigma_k = chord; over N_RAYS rays the atomics add float32 terms of one sign.
    _, values, to_world, o, d = draw(seed, name)
    inside = [overlap((0, math.inf), box_interval(to_world, *ray)) for ray in zip(o, d, strict=True)]
    chord = np.diff(inside, axis=1)[:, 0]
    tau, row = tau_and_row(values.shape[:3], to_world, o, d, skip=skip)
    assert np.all(np.abs(tau - chord) <= BOUND * chord)
    assert row.sum(dtype=np.float64) == pytest.approx(chord.sum(), rel=BOUND)


def test_first_moments(seed):
    # sum_k x_k d tau / d sigma_k = integral of x ds, along intervals between the outermost voxel centres.
    rng = np.random.default_rng([seed, 1])
    n = np.array([7, 6, 9])
    to_world = affine(rotation([1, -1, 2], 0.4) @ np.diag([2.0, 1.0, 1.5]))
    a, b = (((rng.uniform(0, n - 1, (N_RAYS, 3)) + 0.5) / n) @ to_world[:3, :3].T for _ in range(2))
    a = as_float32(a)
    d = as_float32(b - a)
    _, row = tau_and_row((9, 6, 7), to_world, a, d, 1.0)
    k, j, i = np.indices((9, 6, 7))
    centres = np.stack([(i + 0.5) / 7, (j + 0.5) / 6, (k + 0.5) / 9], axis=-1) @ to_world[:3, :3].T
    moment = np.tensordot(row.astype(np.float64), centres, axes=3)
    middle = a + d / 2
    # Terms of size |x| <= 4, summed with weights that add to N_RAYS: relative to that, the bound of a row.
    assert np.all(np.abs(moment - middle.sum(axis=0)) <= 4 * BOUND * N_RAYS)


def test_axis_row_is_known_exactly(seed):
    # Along voxel centres each voxel of the row has weight 1/n, and no other voxel has any.
    rng = np.random.default_rng([seed, 2])
    for axis, n in ((0, 8), (1, 4), (2, 16)):
        index = rng.integers(0, [8, 4, 16])
        o = (index + 0.5) / np.array([8, 4, 16])
        o[axis] = -0.5
        _, row = tau_and_row((16, 4, 8), np.eye(4), o, np.eye(3)[axis])
        where = [index[2], index[1], index[0]]
        where[2 - axis] = slice(None)
        line = row[tuple(where)].copy()
        assert np.all(np.abs(line - 1 / n) <= 4 * 2.0**-24)
        row[tuple(where)] = 0
        assert np.all(row <= 4 * 2.0**-24 / n)


def test_width_one_broadcasts(seed):
    # One ray against many ends: lanes of width 1 mean the same for all.
    from mivol.transport.media.grid_integral import integrate_tau
    from scenes import make_lattice

    lattice = make_lattice(np.ones((3, 3, 3)), np.eye(4))
    ends = mi.Float(0.5, 1.0, 1.5, 2.5)
    tau = integrate_tau(lattice, mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0), ends, mi.Bool(True))
    assert dr.width(tau) == 4
    assert np.allclose(np.asarray(tau), [0, 0, 0.5, 1], rtol=0, atol=BOUND)
