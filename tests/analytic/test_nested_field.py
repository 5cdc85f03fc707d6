"""Nested boxes: light and derivatives along rays against a float64 twin with rays cut at all faces, and against one grid."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle_radiance import NestedTwin, Twin, sh_basis
from radiance_rays import TO_WORLD, derive, followed, make, rays_of, see
from refusals import assert_refused
from sampled_fields import CUBE

from mivol.fields.harmonics import local_frame
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.transport.line_integrals.radiance_field import RayGradient, find_occupied_cells, make_model, render_rays, vjp_rays
from mivol.transport.line_integrals.radiance_source import bake, make_exact, vjp_bake

LEVELS = 3


def place(level: int, to_world: np.ndarray = TO_WORLD) -> np.ndarray:
    """The box of a level: 2^level times as large about the same middle."""
    moved = to_world.copy()
    middle = to_world[:3] @ [0.5, 0.5, 0.5, 1]
    moved[:3, :3] *= 2.0**level
    moved[:3, 3] = middle + 2.0**level * (to_world[:3, 3] - middle)
    return moved


def arrays(seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rough densities and harmonics of each level, in world units: outer levels are thinner."""
    made = []
    for level in range(LEVELS):
        density, sh = make(seed=seed + level)
        made.append((density / 2.0**level, sh))
    return made


def field_of(values: list[tuple[np.ndarray, np.ndarray]]) -> SphericalGrid:
    return SphericalGrid.from_levels([SphericalGrid.from_dense(*v, place(i)) for i, v in enumerate(values)])


def twin_of(values: list[tuple[np.ndarray, np.ndarray]]) -> NestedTwin:
    return NestedTwin([Twin(*v, place(i)) for i, v in enumerate(values)])


def lines(count: int, seed: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Rays that begin in each level and outside of all levels, and rays past the inner boxes."""
    rng = np.random.default_rng(seed)
    middle = TO_WORLD[:3] @ [0.5, 0.5, 0.5, 1]
    o = np.float32(middle + rng.normal(size=(count, 3)) * rng.choice([0.3, 1.0, 3.0, 9.0], (count, 1)))
    d = middle + rng.normal(size=(count, 3)) * rng.choice([0.3, 3.0], (count, 1)) - o
    return o, np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


def unit(d: np.ndarray) -> np.ndarray:
    return d.astype(np.float64) / np.linalg.norm(d.astype(np.float64))


def test_light_of_all_levels_is_that_of_the_twin() -> None:
    values = arrays()
    o, d = lines(60)
    colour, T, distance = see(field_of(values), o, d)
    twin = twin_of(values)
    for i in range(60):
        L, t, far = twin.render(o[i], unit(d[i]))
        # As of one level (test_radiance_field): 1e-5 a level; distances are up to 10 times as large.
        np.testing.assert_allclose(colour[i], L, atol=2e-5 * LEVELS)
        assert T[i] == pytest.approx(t, abs=5e-5 * LEVELS)
        assert distance[i] == pytest.approx(far, abs=5e-4 * LEVELS)


def test_rays_take_their_pieces_from_all_levels() -> None:
    """The rays of these tests begin and end in every level; otherwise the other tests would check less than they claim."""
    o, d = lines(60)
    seen = followed(field_of(arrays()), o, d)
    assert set(np.array(seen.first.piece)) >= {-1, 0, 1, 2, 3}
    assert set(np.array(seen.last.piece)) >= {-1, 0, 4}
    stopped = followed(field_of(arrays()), o, d, stop=0.3)
    assert set(np.array(stopped.last.piece)) >= {-1, 0, 1, 2, 3, 4}


def test_a_ray_that_stops_has_the_derivatives_of_what_it_saw() -> None:
    """With a stop at 1e-3 all derivatives move by less than the remaining light, and derivatives behind the stop are 0."""
    o, d = lines(40, seed=6)
    dense = [(8 * density, sh) for density, sh in arrays()]
    whole, cut = (derive(field_of(dense), o, d, [1.0, 1.0, 1.0], stop=stop) for stop in (0.0, 1e-3))
    for a, b in zip(whole, cut, strict=True):
        # 3 channels of colours up to 3, of 40 rays, through cells of up to 4 own lengths.
        assert 0 < np.abs(a - b).max() < 1e-3 * 3 * 3 * 40 * 4
        assert np.abs(a - b).max() < 0.05 * np.abs(a).max()


def test_derivatives_of_all_levels_are_those_of_the_twin() -> None:
    values, by = arrays(), [0.3, -0.5, 0.9]
    o, d = lines(24, seed=6)
    slopes = derive(field_of(values), o, d, by, 0.7, 0.2)
    count, rng = values[0][0].size, np.random.default_rng(3)
    for which in (0, 1):
        for level in range(LEVELS):
            move = rng.normal(size=values[0][which].shape)
            ends = []
            for sign in (-1, 1):
                moved = [[np.float64(a) for a in pair] for pair in values]
                # Stored densities are the world's times 2^level.
                moved[level][which] += sign * 1e-6 * move / (2.0**level if which == 0 else 1)
                twin = twin_of(moved)
                seen = [twin.render(a, unit(b)) for a, b in zip(o, d, strict=True)]
                ends.append(sum(np.dot(by, L) + 0.7 * T + 0.2 * D for L, T, D in seen))
            expected = (ends[1] - ends[0]) / 2e-6
            own = slopes[which][level * count : (level + 1) * count].reshape(move.shape)
            # 1e-4 of the terms, which add up like a random walk, as of one level; distances are 4 times as large.
            assert abs(np.sum(own * move) - expected) <= 4e-4 * np.sqrt(np.sum((own * move) ** 2)) + 4e-4
            assert np.abs(own).max() > 0.01


def test_one_fine_grid_that_holds_the_same_values_looks_the_same() -> None:
    """The inner nodes are nodes of a grid of twice as many nodes in the outer box, so both fields are equal between them."""
    rng, n = np.random.default_rng(1), 6
    fine = rng.normal(1, 3, (2 * n,) * 3), rng.normal(0, 0.4, (*(2 * n,) * 3, 4, 3))
    inner = tuple(a[n // 2 : n // 2 + n, n // 2 : n // 2 + n, n // 2 : n // 2 + n] for a in fine)
    outer = np.zeros((n, n, n)), np.zeros((n, n, n, 4, 3))
    nested = SphericalGrid.from_levels([SphericalGrid.from_dense(*v, place(i, CUBE)) for i, v in enumerate((inner, outer))])
    whole = SphericalGrid.from_dense(*fine, place(1, CUBE))
    # From within the hull of the inner nodes to within it: (n - 1) / n of the inner box.
    ends = rng.uniform(-0.8, 0.8, (2, 20, 3))
    rays = rays_of(ends[0], (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True))
    rays.t_max = mi.Float(np.float32(np.linalg.norm(ends[1] - ends[0], axis=1)))
    found = [render_rays(find_occupied_cells(f), make_exact(f, rays.d), make_model(f), rays) for f in (nested, whole)]
    # Positions err by 2^-23 of the nodes across, 4e-6 of a cell, over which an extinction changes by 10: 4e-5 of a light of 1.
    np.testing.assert_allclose(np.array(found[0].colour), np.array(found[1].colour), atol=4e-5)
    np.testing.assert_allclose(np.array(found[0].T), np.array(found[1].T), atol=4e-5)
    assert np.ptp(np.array(found[0].T)) > 0.5


def test_what_the_inner_box_covers_is_vacuum_in_the_outer_one() -> None:
    """Covered nodes have no influence on rays: NaN there is invisible. A change of any other node changes some ray."""
    res, rng = (9, 8, 12), np.random.default_rng(2)
    grids = [
        SphericalGrid.from_dense(rng.uniform(0.1, 0.4, res), np.zeros((*res, 1, 3)), place(i, CUBE), activation="none")
        for i in range(2)
    ]
    field = SphericalGrid.from_levels(grids)
    covered = np.array(is_covered_by_inner(dr.arange(mi.UInt32, field.node_count), field.res))
    half = covered[field.node_count // 2 :].reshape(res)
    # n / 4 nodes on either side of the middle, less one whose cells reach over the face.
    expected = np.ones(res, bool)
    for axis, n in enumerate(res):
        inside = np.abs(np.arange(n) - (n - 1) / 2) <= n / 4 - 1
        expected &= inside.reshape([-1 if a == axis else 1 for a in range(3)])
    assert not covered[: field.node_count // 2].any() and np.array_equal(half, expected) and half.any()
    density = np.append(field.values()[0], np.float32(0))
    density[:-1][covered] = np.nan
    o, d = lines(400, seed=8)
    poisoned = field.with_values(mi.Float(density), field.harmonics)
    for a, b in zip(see(field, o, d), see(poisoned, o, d), strict=True):
        np.testing.assert_array_equal(a, b)


def test_values_at_points_are_those_that_rays_see() -> None:
    values = arrays()
    field, twin = field_of(values), twin_of(values)
    o, d = lines(80, seed=9)
    rays = rays_of(o, d)
    sigma, colour = field.eval(mi.Point3f(rays.o), rays.d)
    sigma, colour = np.array(sigma), np.array(colour).T
    met = set()
    for i in range(80):
        u = [(w.inverse[:3, :3] @ np.float64(o[i]) + w.inverse[:3, 3]) for w in twin.levels]
        level = next((n for n, p in enumerate(u) if ((p >= 0) & (p <= 1)).all()), None)
        met.add(level)
        if level is None:
            assert sigma[i] == 0 and (colour[i] == 0).all()
            continue
        w = twin.levels[level]
        s, c = w.at(u[level] * w.n - 0.5, sh_basis(w.frame @ unit(d[i]), 4))
        # A position to 2e-6 of a cell, over which an extinction changes by up to 30.
        np.testing.assert_allclose(sigma[i], s, atol=1e-4)
        np.testing.assert_allclose(colour[i], c, atol=1e-5)
    assert met == {None, *range(LEVELS)}


def test_tables_of_pinholes_hold_what_is_seen_of_all_levels() -> None:
    """For one pinhole, the table has the sum of harmonics in the directions of the nodes, and vjp_bake is the transpose."""
    field = field_of(arrays())
    cells, pinhole = find_occupied_cells(field), np.array([[0.4, -2.0, 7.0]])
    table = np.array(bake(field, cells, pinhole, mi.UInt32(0)).table).reshape(-1, 4)
    rows = np.array(cells.rows)
    z, y, x = field.res
    count = z * y * x
    nodes = field.stored_nodes()[rows]
    density, sh = field.values()
    frame = local_frame(field.to_world)
    for entry in np.random.default_rng(0).integers(len(rows), size=40):
        level, inner = divmod(int(nodes[entry]), count)
        k, j, i = np.unravel_index(inner, field.res)
        point = place(level)[:3] @ [(i + 0.5) / x, (j + 0.5) / y, (k + 0.5) / z, 1]
        d = frame @ (point - pinhole[0])
        expected = 0.5 + sh_basis(d / np.linalg.norm(d), 4) @ np.float64(sh[rows[entry]])
        # Directions are rounded to 2e-7; four terms of some 0.5.
        np.testing.assert_allclose(table[entry], [density[rows[entry]], *expected], atol=2e-6, rtol=1e-6)
    # The transpose: <bake(f), g> is <f, fold(g)> but for the offset.
    baked = bake(field, cells, pinhole, mi.UInt32(0), slope=True)
    g = np.random.default_rng(1).normal(size=dr.width(baked.table)).astype(np.float32)
    baked.slope = mi.Float(np.append(g, np.zeros(dr.width(baked.slope) - len(g), np.float32)))
    by_density, by_sh = (np.float64(a) for a in vjp_bake(field, cells, baked, pinhole))
    there = np.sum((np.float64(table) - [0, 0.5, 0.5, 0.5]) * g.reshape(-1, 4))
    own = np.sum(np.float64(field.density) * by_density) + np.sum(np.float64(field.harmonics) * by_sh)
    # Sums of some 5000 rounded terms of about 1.
    assert own == pytest.approx(there, abs=5000**0.5 * 1e-5)


def test_near_derivatives_are_scaled_and_far_ones_are_not() -> None:
    """Along a ray through a constant, derivatives nearer than ``near`` are scaled by t^2 / near^2, others unchanged."""
    field = SphericalGrid.from_dense(np.full((2, 2, 2), 1e-3), np.zeros((2, 2, 2, 1, 3)), CUBE)
    o, d = [[-1.0, 0.1, 0.2]], [[1.0, 0.0, 0.0]]
    rays, cells = rays_of(o, d), find_occupied_cells(field)

    def slope(near: float) -> float:
        source = make_exact(field, rays.d, slope=True)
        seen = render_rays(cells, source, make_model(field), rays)
        vjp_rays(cells, source, make_model(field), seen, RayGradient(mi.Color3f(1, 1, 1)), near=near)
        return float(np.sum(np.float64(source.slopes()[0])))

    # d L / d sigma = integral of 0.5 x 3 over t from 0 to 2, less 1e-3 of it for what is hidden; with t^2 / near^2 below near.
    assert slope(0.0) == pytest.approx(3.0, rel=2e-3)
    assert slope(1e-3) == pytest.approx(3.0, rel=2e-3)
    assert slope(4.0) == pytest.approx(1.5 * (2**3 / 3) / 16, rel=4e-3)


def test_what_does_not_nest_is_refused() -> None:
    grid = SphericalGrid.from_dense(np.ones((4, 4, 4)), np.zeros((4, 4, 4, 1, 3)), CUBE)
    assert_refused(r"grid 1 of a nested field is not 2\^1 times", SphericalGrid.from_levels, [grid, grid])
    other = SphericalGrid.from_dense(np.ones((4, 4, 4)), np.zeros((4, 4, 4, 4, 3)), place(1, CUBE))
    assert_refused("another kind", SphericalGrid.from_levels, [grid, other])
    values = np.ones((4, 4, 4)), np.zeros((4, 4, 4, 1, 3))
    soft = [SphericalGrid.from_dense(*values, place(i, CUBE), activation="exp") for i in (0, 1)]
    assert_refused("activation exp", SphericalGrid.from_levels, soft)


def test_a_level_is_a_grid_again() -> None:
    values = arrays()
    field = field_of(values)
    for level in range(LEVELS):
        back = field.extract_level(level)
        assert np.array_equal(back.to_dense()[0], np.float32(values[level][0]))
        assert np.array_equal(back.to_dense()[1], values[level][1])
        np.testing.assert_allclose(back.to_world, place(level), atol=1e-12)
    assert_refused("level 3 of a field of 3", field.extract_level, LEVELS)
    assert_refused("3 nested levels is no one grid", field.to_dense)
