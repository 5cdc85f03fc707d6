"""Radiance fields: light along rays against a float64 twin and closed forms, derivatives against differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle_radiance import Twin
from radiance_rays import TO_WORLD, aim, derive, looked, make, rays_of, see
from sampled_fields import CUBE

from mivol.fields.activation import ACTIVATIONS
from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells, make_model, raise_to_max_weights, render_rays
from mivol.transport.line_integrals.radiance_source import make_exact
from mivol.transport.traversal.occupied_cells import OccupiedCells


@pytest.mark.slow_for("none")
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_agrees_with_the_twin(variant_rgb: str, activation: str) -> None:
    density, sh = make()
    density = np.abs(density) if activation == "none" else density / (1 if activation == "relu" else 4)
    field = SphericalGrid.from_dense(density, sh, TO_WORLD, activation=activation)
    o, d = aim(40)
    colour, T, distance = see(field, o, d)
    twin = Twin(density, sh, TO_WORLD, activation)
    for i in range(40):
        unit = d[i].astype(np.float64) / np.linalg.norm(d[i].astype(np.float64))
        L, t, far = twin.render(o[i], unit)
        # A position errs by 2^-23 (X + Y + Z) = 2e-6 of a cell, an extinction changes by 30 of its mean of 6 over a cell: 1e-5.
        np.testing.assert_allclose(colour[i], L, atol=2e-5)
        np.testing.assert_allclose([T[i], distance[i]], [t, far], atol=5e-5)


def test_derivatives_are_those_of_the_twin(variant_rgb: str) -> None:
    density, sh = make()
    field = SphericalGrid.from_dense(density, sh, TO_WORLD)
    o, d = aim(12)
    by = [0.3, -0.5, 0.9]
    slopes = derive(field, o, d, by, 0.7, 0.2)
    rng = np.random.default_rng(3)
    for which in (0, 1):
        for _ in range(3):
            move = rng.normal(size=(density, sh)[which].shape)
            ends = []
            for sign in (-1, 1):
                moved = [density.astype(np.float64), sh.astype(np.float64)]
                moved[which] = moved[which] + sign * 1e-6 * move
                twin = Twin(*moved, TO_WORLD)
                seen = [twin.render(a, b / np.linalg.norm(b.astype(np.float64))) for a, b in zip(o, d, strict=True)]
                ends.append(sum(np.dot(by, L) + 0.7 * T + 0.2 * D for L, T, D in seen))
            expected = (ends[1] - ends[0]) / 2e-6
            found = np.sum(slopes[which].reshape(move.shape) * move)
            # As above, 1e-5 of the largest terms, which add up like a random walk over 12 rays.
            assert abs(found - expected) <= 1e-4 * np.sqrt(np.sum((slopes[which].reshape(move.shape) * move) ** 2)) + 1e-4


def ramp(n: int):
    """A field linear along x, dense or thin, with colour: grids of any size are equal between their outer nodes."""
    x = (np.arange(n) + 0.5) / n
    density = np.broadcast_to(30 * x, (n, n, n)).astype(np.float64)
    sh = np.zeros((n, n, n, 1, 3))
    sh[..., 0, :] = ((1 - x)[:, None] * [1.0, 0.5, 2.0]) / 0.28209479177387814
    return density, sh


def test_fourth_order_and_ten_times_nearer_than_midpoints(variant_rgb: str) -> None:
    # From node planes to node planes of the coarsest grid (1/8 to 7/8), where all grids hold the same linear field.
    o, d = np.array([0.125, 0.4, 0.45]), np.array([1.0, 0.02, 0.01])
    d /= np.linalg.norm(d)
    o32, d32 = np.float32(o), np.float32(d)
    errors, midpoints = [], []
    t_max = 0.75 / d[0]
    for n in (4, 8, 16, 32):
        density, sh = ramp(n)
        field = SphericalGrid.from_dense(density, sh, np.eye(4), activation="none", offset=0.0)
        rays = rays_of(o32, d32)
        rays.t_max = mi.Float(t_max)
        seen = render_rays(find_occupied_cells(field), make_exact(field, rays.d), make_model(field), rays)

        # The same line, finely, by the midpoint rule in float64, and with as many midpoints as ours has points.
        def line(count):
            t = (np.arange(count) + 0.5) / count * t_max
            x = o[0] + d[0] * t
            tau = 30 * x * t_max / count
            T = np.exp(-np.concatenate([[0], np.cumsum(tau)[:-1]]))
            return np.sum(T * -np.expm1(-tau) * (1 - x))

        truth = line(1 << 20)
        errors.append(abs(float(seen.colour[0][0]) - truth))
        midpoints.append(abs(line(round(2 * 0.75 * n)) - truth))
    # Rates of 2^4 a halving, down to the rounding of float32 (2e-7 of colours below 1); the midpoints' rate is 2^2, and 10 is
    # asked for from 12 cells on.
    assert errors[1] / errors[2] > 10
    assert errors[2] / max(errors[3], 2e-7) > 8
    assert all(m > 10 * max(e, 2e-7) for e, m in zip(errors[2:], midpoints[2:], strict=True))


@pytest.mark.slow_for("1e-08")
@pytest.mark.parametrize("tau", [1e-8, 1e-4, 1.0, 87.0, 1e4, 1e6])
def test_constant_colour_and_no_nan_at_any_depth(variant_rgb: str, tau: float) -> None:
    density, sh = make(basis=1)
    density = np.abs(density).clip(0.1)
    density *= tau * 4 / density.mean()
    sh[...] = np.float32([1.0, -0.6, 0.2])
    field = SphericalGrid.from_dense(density, sh, CUBE)
    o, d = aim(30, CUBE)
    colour, T, _ = see(field, o, d)
    constant = 0.28209479177387814 * np.array([1.0, -0.6, 0.2]) + 0.5
    # Rounding of some 20 cells: 20 * 2^-24 of the light; at small depths of the light itself.
    opacity = np.maximum(1 - T.astype(np.float64), 1e-30)
    twin = Twin(density, sh, CUBE)
    exact_opacity = np.array([1 - twin.render(a, b / np.linalg.norm(b))[1] for a, b in zip(o, d, strict=True)])
    assert np.abs(colour - exact_opacity[:, None] * constant).max() <= 2e-5 * exact_opacity.max()
    assert np.abs(colour - opacity[:, None] * constant).max() <= 3e-6
    slopes = derive(field, o, d, [1.0, 1.0, 1.0], 0.5, 0.5)
    assert all(np.isfinite(s).all() for s in slopes)
    assert np.abs(slopes[0]).max() > 0


def test_nothing_is_derived_behind_an_opaque_wall(variant_rgb: str) -> None:
    density, sh = make((4, 4, 40), basis=1)
    density = np.abs(density) + 1
    density[:, :, 10:20] = 1e4
    field = SphericalGrid.from_dense(density, sh, CUBE)
    slopes, _ = derive(field, [[-3, 0.1, 0.05]], [[1, 0, 0]], [1.0, 1.0, 1.0], 1.0)
    slopes = slopes.reshape(density.shape)
    assert np.abs(slopes[:, :, :10]).max() > 1e-4
    # exp(-1e4 / 40 * 2 * 10) is 0 in any arithmetic; a ray ends in the cell that hides the rest.
    assert (slopes[:, :, 12:] == 0).all()


def test_the_background_of_the_same_colour(variant_rgb: str) -> None:
    density, sh = make(basis=1)
    field = SphericalGrid.from_dense(density, np.zeros_like(sh), CUBE)
    o, d = aim(20, CUBE)
    by = [0.3, 0.4, 0.3]
    slopes, _ = derive(field, o, d, by, 0.5 * sum(by))
    alone, _ = derive(field, o, d, by, 0.0)
    # L + 0.5 T = 0.5 whatever the density: what is left are roundings of sums of 1.
    assert np.abs(slopes).max() <= 2e-6 * max(np.abs(alone).max(), 1.0)
    assert np.abs(alone).max() > 1e-2


def test_the_brightest_weight_of_a_cell(variant_rgb: str) -> None:
    """T alpha of each cell behind the cells in front; the largest value for rays from both sides."""
    field = SphericalGrid.from_dense(np.full((4, 3, 5), 3.0), np.zeros((4, 3, 5, 1, 3)), CUBE)
    cells, model = find_occupied_cells(field), make_model(field)
    weight = dr.zeros(mi.Float, cells.count)
    # The outer cells are half as long as the others; a voxel is 1/2 long.
    tau = 3 * np.array([0.25, 0.5, 0.5, 0.5, 0.25])
    one_way = np.exp(tau - np.cumsum(tau)) * -np.expm1(-tau)
    for side, expected in ((-1, one_way), (1, np.maximum(one_way, one_way[::-1]))):
        rays = rays_of([0.1, 0.1, 3.0 * side], [0.0, 0.0, -1.0 * side])
        raise_to_max_weights(cells, make_exact(field, rays.d), model, rays, weight)
        # x = 0.1 lies in the fourth of six cells, y = 0.1 in the third of four.
        seen = np.array(weight)[numbers_of(cells)[:, 2, 3]]
        # Optical depths of 6 at most, known to some 1e-6.
        np.testing.assert_allclose(seen, expected, rtol=1e-5)
    assert np.count_nonzero(np.array(weight)) == 5


def test_camera_inside(variant_rgb: str) -> None:
    field = SphericalGrid.from_dense(np.full((4, 4, 4), 2.0), np.zeros((4, 4, 4, 1, 3)), CUBE)
    colour, T, distance = see(field, [[0.5, 0.1, 0.2]], [[1, 0, 0]])
    # 0.5 of matter ahead at extinction 2; the mean distance of exponential emission over it.
    np.testing.assert_allclose(T, np.exp(-1), rtol=1e-6)
    np.testing.assert_allclose(colour[0], 0.5 * (1 - np.exp(-1)), rtol=1e-6)
    np.testing.assert_allclose(distance, (1 - 2 * np.exp(-1)) / 2, rtol=1e-3)


def test_a_rotated_field_looks_as_it_did(variant_rgb: str) -> None:
    density, sh = make(basis=16)
    angle = 0.7
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn = turn @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    o, d = aim(20)
    before = see(SphericalGrid.from_dense(density, sh, TO_WORLD), o, d)[0]
    after = see(SphericalGrid.from_dense(density, sh, turn @ TO_WORLD), o @ turn[:3, :3].T, d @ turn[:3, :3].T)[0]
    # Rays are rounded to float32 anew, 1e-7 of a distance of 5 voxels' worth of gradient.
    np.testing.assert_allclose(after, before, atol=2e-5)
    assert np.abs(before - see(SphericalGrid.from_dense(density, sh, TO_WORLD), o, -d)[0]).max() > 0.1


@pytest.mark.slow
def test_sparse_is_dense(variant_rgb: str) -> None:
    rng = np.random.default_rng(5)
    density, sh = make((12, 11, 13), basis=9)
    keep = rng.random(density.shape) < 0.3
    sh[~keep], density[~keep] = 0, 0
    o, d = aim(50)
    dense, sparse = (SphericalGrid.from_dense(density, sh, TO_WORLD, k) for k in (None, keep))
    assert sparse.rows == keep.sum() + 1
    for a, b in zip(see(dense, o, d), see(sparse, o, d), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # the same sums in the same order
    slopes = [derive(f, o, d, [1.0, 0.5, 0.2]) for f in (dense, sparse)]
    for a, b in zip(slopes[0], slopes[1], strict=True):
        # Sums over rays in another order: 2^-24 of some 100 terms.
        np.testing.assert_allclose(a.reshape(-1, *b.shape[1:])[keep.reshape(-1)], b, atol=1e-5 * np.abs(b).max())


def test_a_ray_that_stops_early_errs_by_what_it_leaves(variant_rgb: str) -> None:
    density, sh = make(scale=20.0)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    o, d = aim(50, CUBE)
    brightest = np.abs(sh).sum(axis=3).max() + 0.5
    assert np.abs(see(field, o, d)[0] - see(field, o, d, stop=0.05)[0]).max() <= 0.05 * brightest


def numbers_of(cells: OccupiedCells) -> np.ndarray:
    """The list number of each cell (Z, Y, X); only listed cells have one."""
    return looked(cells.index, (1, *(n + 1 for n in cells.res)), (True, True, True))[1][0]


@pytest.mark.parametrize("sparse", [False, True])
def test_cells_with_matter_are_listed(variant_rgb: str, sparse: bool) -> None:
    density, sh = make((30, 21, 25), basis=1)
    density = np.where(np.random.default_rng(1).random(density.shape) < 3e-4, 1, -1)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    cells = find_occupied_cells(field.select_nodes(density > 0) if sparse else field)
    padded = np.pad(density > 0, 1, mode="edge")
    occupied = np.zeros((31, 22, 26), bool)
    for corner in range(8):
        z, y, x = corner >> 2, corner >> 1 & 1, corner & 1
        occupied |= padded[z : z + 31, y : y + 22, x : x + 26]
    assert cells.count == occupied.sum() > 0
    assert sorted(numbers_of(cells)[occupied]) == list(range(cells.count))


def test_an_empty_field_shows_nothing(variant_rgb: str) -> None:
    field = SphericalGrid.from_dense(np.full((3, 3, 3), -1.0), np.zeros((3, 3, 3, 4, 3)), CUBE)
    o, d = aim(5, CUBE)
    colour, T, distance = see(field, o, d)
    assert (colour == 0).all() and (T == 1).all() and (distance == 0).all()
    assert all((s == 0).all() for s in derive(field, o, d, [1.0, 1.0, 1.0], 1.0))


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_and_their_slopes(variant_rgb: str, name: str) -> None:
    x = np.float32([-15, -3, -0.5, 0.25, 1, 7, 20]) if name != "none" else np.float32([0.25, 1, 7])
    value, slope = ACTIVATIONS[name].value_and_slope(mi.Float(x))
    truth = {
        "none": lambda v: v,
        "relu": lambda v: np.maximum(v, 0),
        "softplus": lambda v: np.logaddexp(0, v),
        "exp": np.exp,
    }[name]
    x = x.astype(np.float64)
    np.testing.assert_allclose(np.array(value), truth(x), rtol=2e-6)
    slope = np.broadcast_to(np.array(slope), x.shape)
    np.testing.assert_allclose(slope, (truth(x + 1e-6) - truth(x - 1e-6)) / 2e-6, rtol=1e-5, atol=1e-9)
    assert dr.all(dr.isfinite(ACTIVATIONS[name].value_and_slope(mi.Float(1e9))[0]))
