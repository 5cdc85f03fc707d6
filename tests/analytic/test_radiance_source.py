"""Sources of a radiance field: derivatives of baked harmonics, and corner values that are carried from cell to cell."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from radiance_rays import TO_WORLD, aim, derive, make, rays_of, see
from sampled_fields import CUBE

from mivol.fields.spherical_grid import SphericalGrid
from mivol.kernel_recording import ALIGNMENT
from mivol.transport.line_integrals.radiance_field import RayGradient, find_occupied_cells, make_model, render_rays, vjp_rays
from mivol.transport.line_integrals.radiance_source import Exact, bake, make_exact, vjp_bake
from mivol.transport.traversal.occupied_cells import OccupiedCells


def test_pinhole_derivatives_are_those_of_what_a_pinhole_sees(variant_rgb: str) -> None:
    """The baked table is linear in the field: a step along the gradient changes the image by its squared norm."""
    density, sh = make(basis=9)
    pinholes = np.array([[3.0, 1, 0.5], [-2.0, 2.5, 1]])
    o = np.repeat(pinholes, 10, axis=0)
    target = np.random.default_rng(0).uniform(0.2, 0.8, (20, 3)) @ TO_WORLD[:3, :3].T + TO_WORLD[:3, 3]
    d = (target - o) / np.linalg.norm(target - o, axis=1, keepdims=True)
    rays, view = rays_of(o, d), mi.UInt32(np.repeat([0, 1], 10))

    def total(field, slope=False):
        cells = find_occupied_cells(field)
        source = bake(field, cells, pinholes, view, slope)
        model = make_model(field)
        seen = render_rays(cells, source, model, rays)
        if slope:
            vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(1, 0.5, -0.7)))
            return field.with_values(*vjp_bake(field, cells, source, pinholes)).values()
        return float(np.dot(np.array(seen.colour, np.float64).sum(axis=1), [1, 0.5, -0.7]))

    slopes = total(SphericalGrid.from_dense(density, sh, TO_WORLD), True)
    for which in (0, 1):
        move = slopes[which].reshape((density, sh)[which].shape) / np.linalg.norm(slopes[which])
        step = 0.02 if which == 0 else 0.002
        ends = []
        for sign in (-1, 1):
            moved = [density, sh]
            moved[which] = moved[which] + sign * step * move
            ends.append(total(SphericalGrid.from_dense(*moved, TO_WORLD)))
        # Differences lose 1e-6 of the sum of 20 rays over the step, and their own bias is of second order in it.
        expected = np.linalg.norm(slopes[which])
        assert abs((ends[1] - ends[0]) / (2 * step) - expected) <= 5e-3 * expected


@pytest.mark.slow
def test_a_pinhole_table_converges_to_exact_directions(variant_rgb: str) -> None:
    pinhole = np.array([2.5, 1.5, 2.0])
    differences = []
    for n in (8, 16):
        g = (np.arange(n) + 0.5) / n * 2 - 1
        z, y, x = np.meshgrid(g, g, g, indexing="ij")
        sh = np.stack([np.sin(x + b) * np.cos(y - b + c) * 0.3 for b in range(9) for c in range(3)], axis=-1)
        field = SphericalGrid.from_dense(6 * (0.7 - np.sqrt(x * x + y * y + z * z)), sh.reshape(n, n, n, 9, 3), CUBE)
        d = np.random.default_rng(2).uniform(-0.5, 0.5, (200, 3)) - pinhole
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        o = np.broadcast_to(pinhole, d.shape)
        differences.append(np.sqrt(np.mean((see(field, o, d)[0] - see(field, o, d, pinhole=pinhole)[0]) ** 2)))
    # Second order: a quarter, within a third of it; 16^3 is already 60 dB below white.
    assert differences[1] < differences[0] / 3
    assert differences[1] < 1e-3


def followed(field: SphericalGrid, cells: OccupiedCells, o, d) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Values of rays through the given cells, and the derivatives of a weighted sum."""
    rays, model = rays_of(o, d), make_model(field)
    source = make_exact(field, rays.d, slope=True)
    seen = render_rays(cells, source, model, rays)
    vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(0.3, -0.5, 0.9), 0.7, 0.2))
    return [np.array(v) for v in (seen.colour, seen.T, seen.distance)], [np.array(s) for s in source.slopes()]


def test_cells_that_are_left_out_between_others_change_nothing():
    """Holes break the chain of faces: light and derivatives equal a walk through all cells, in which the chain never breaks."""
    density, sh = make((9, 11, 10), basis=9)
    # A tenth of the nodes are dense, which makes errors at the slightly negative walls of holes visible.
    field = SphericalGrid.from_dense(np.where(density > 9.5, density, np.float32(-0.1)), sh, TO_WORLD)
    some = find_occupied_cells(field)
    whole = OccupiedCells.find(field.res, TO_WORLD, field.look_up_rows, lambda _: mi.Bool(True), field.rows)
    assert 0.2 * whole.count < some.count < 0.8 * whole.count
    o, d = aim(100)
    for ours, theirs in zip(followed(field, some, o, d), followed(field, whole, o, d), strict=True):
        for a, b in zip(ours, theirs, strict=True):
            # The terms are equal; terms of a cell and its neighbour are added in another order.
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * max(np.abs(b).max(), 1))
            assert np.abs(b).max() > 0.01


@pytest.mark.parametrize("along", [(1, 1, 1), (1, -1, 0), (0, -1, -1), (-1, 0, 1)])
def test_a_ray_through_edges_reads_the_cell_that_it_comes_to(along: tuple[int, int, int]):
    """A ray that leaves through two faces at once shares no face with the next cell; nearby rays cross both in turn."""
    density, sh = make((8, 8, 8), basis=4)
    field = SphericalGrid.from_dense(np.abs(density), sh, CUBE)
    d = np.array(along) / np.linalg.norm(along)
    beside = np.array([2e-5, -3e-5, 1e-5])
    (a, ta, _), (b, tb, _) = (see(field, [o], [d]) for o in (-3 * d, -3 * d + beside))
    # 3e-5 is 1e-4 of a voxel, over which an extinction of 6 and a colour change by some 1e-3.
    np.testing.assert_allclose(a, b, atol=2e-3)
    np.testing.assert_allclose(ta, tb, atol=2e-3)


@pytest.mark.parametrize("basis", [1, 4, 9, 16, 25])
def test_rows_of_all_degrees_are_packed_and_unpacked(basis: int):
    """In a thin field light is linear in density and colour: the derivative times the values is the light."""
    density, sh = make((4, 5, 6), basis=basis)
    density = np.float32(1e-6) * (1 + np.abs(density))
    field = SphericalGrid.from_dense(density, sh, CUBE, offset=0.0, clamp=False)
    o, d = aim(30, CUBE)
    by_density, by_sh = (np.float64(s) for s in derive(field, o, d, [1.0, 0.5, -0.7]))
    light = np.sum(np.float64(see(field, o, d)[0]) @ [1.0, 0.5, -0.7])
    size = np.sum(np.abs(by_sh * sh.reshape(by_sh.shape)))
    # The optical depth of 2e-5 is the relative error of linearity; the sums have terms of both signs.
    assert np.sum(by_density * density.reshape(-1)) == pytest.approx(light, abs=1e-4 * size)
    assert np.sum(by_sh * sh.reshape(by_sh.shape)) == pytest.approx(light, abs=1e-4 * size)
    assert abs(light) > 1e-3 * size


def test_a_cell_costs_four_corners_and_the_first_one_eight(monkeypatch: pytest.MonkeyPatch):
    density, sh = make((6, 6, 6), basis=1)
    field = SphericalGrid.from_dense(np.abs(density) * 0.01 + 0.01, sh, CUBE)
    rays, cells, read, written = rays_of([-3, 0.1, 0.2], [1, 0, 0]), find_occupied_cells(field), [], []
    value, write = Exact._value, Exact._write

    def counted(call, count):
        def called(self, row, *rest):
            count.append(int(dr.count(rest[-1] & dr.full(mi.Bool, True, 1))[0]))
            return call(self, row, *rest)

        return called

    monkeypatch.setattr(Exact, "_value", counted(value, read))
    monkeypatch.setattr(Exact, "_write", counted(write, written))
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False), dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False):
        source = make_exact(field, rays.d, slope=True)
        seen = render_rays(cells, source, make_model(field), rays)
        # Seven cells: half a voxel before the first node, five between nodes, half a voxel behind the last one.
        assert sum(read) == 4 * (7 + 1)
        vjp_rays(cells, source, make_model(field), seen, RayGradient(mi.Color3f(1)))
        assert sum(written) == 4 * (7 + 1)


def test_rows_of_a_field_are_aligned():
    """Dr.Jit gathers a row as packets only from aligned arrays."""
    density, sh = make(basis=9)
    field = SphericalGrid.from_dense(density, sh, TO_WORLD)
    if dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        assert [a.numpy().ctypes.data % ALIGNMENT for a in (field.density, field.harmonics)] == [0, 0]
