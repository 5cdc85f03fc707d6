"""Sorting rays changes nothing but the order of sums."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from radiance_rays import TO_WORLD, aim, make, rays_of
from sampled_fields import CUBE

from mivol.fields.spherical_grid import SphericalGrid
from mivol.kernel_recording import ALIGNMENT
from mivol.transport.line_integrals.radiance_field import (
    RayBundle,
    RayGradient,
    RenderedRays,
    find_occupied_cells,
    make_model,
    render_rays,
    vjp_rays,
)
from mivol.transport.line_integrals.radiance_source import Baked, bake, make_exact
from mivol.transport.traversal import occupied_cells
from mivol.transport.traversal.occupied_cells import FEWEST_RAYS, RayOrder

COUNT = 700
HALF = np.array([[0.5, 0, 0, 0.25], [0, 0.5, 0, 0.25], [0, 0, 0.5, 0.25], [0, 0, 0, 1]])
"""The unit cube to half of it about its middle."""


@pytest.fixture
def sorts() -> None:
    """Rays are sorted on CPUs only."""
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
        pytest.skip("rays are not sorted here")


def field_of(levels: int = 1, to_world: np.ndarray = TO_WORLD) -> SphericalGrid:
    """Rough fields; for nested boxes the place of the innermost box."""
    inner = SphericalGrid.from_dense(*make((9, 11, 10), basis=4, scale=1.0), to_world)
    if levels == 1:
        return inner
    outer = make((9, 11, 10), basis=4, seed=1, scale=0.5)
    return SphericalGrid.from_levels([inner, SphericalGrid.from_dense(*outer, inner.level_to_world(1))])


def numbers(seen: RenderedRays) -> list[np.ndarray]:
    values = seen.colour, seen.T, seen.distance, seen.tau, seen.before, seen.first.t, seen.last.t, seen.cell
    return [np.array(v) for v in values]


def stepped(field: SphericalGrid, rays: RayBundle, few: int, monkeypatch: pytest.MonkeyPatch):
    """Rendered values, derivatives of a sum with a weight for each ray, and whether rays were sorted."""
    monkeypatch.setattr(occupied_cells, "FEWEST_RAYS", few)
    rng = np.random.default_rng(3)
    active = mi.Bool(rng.uniform(size=COUNT) < 0.8)
    weights = [mi.Float(rng.normal(size=COUNT).astype(np.float32)) for _ in range(5)]
    cells, source, model = find_occupied_cells(field), make_exact(field, rays.d, slope=True), make_model(field)
    seen = render_rays(cells, source, model, rays, active)
    also = mi.Bool(rng.uniform(size=COUNT) < 0.8)
    vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(*weights[:3]), *weights[3:]), also)
    return numbers(seen), [np.array(s) for s in source.slopes()], seen.order


@pytest.mark.parametrize("levels", [1, 2])
def test_sorted_rays_see_and_derive_the_same(levels: int, sorts: None, monkeypatch: pytest.MonkeyPatch):
    """Some rays end in the box, some miss the box, and some are inactive."""
    field = field_of(levels)
    o, d = aim(COUNT)
    d[::9] *= -1
    t_max = mi.Float(np.random.default_rng(4).uniform(1, 9, COUNT).astype(np.float32))
    rays = replace(rays_of(o, d), t_max=t_max)
    light, slopes, order = stepped(field, rays, 1, monkeypatch)
    same_light, same_slopes, none = stepped(field, rays, 1 << 30, monkeypatch)
    assert order is not None
    assert none is None
    for a, b in zip(light, same_light, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.ptp(b) > 0
    for a, b in zip(slopes, same_slopes, strict=True):
        # Up to COUNT terms: their roundings, 2^-24 of the sum so far, add up like a random walk.
        np.testing.assert_allclose(a, b, rtol=0, atol=2**-24 * COUNT**0.5 * np.abs(b).max())
        assert np.abs(b).max() > 0.01


def test_numbers_for_all_rays_stay_numbers_for_all(sorts: None, monkeypatch: pytest.MonkeyPatch):
    """An end and weights shared by all rays."""
    field, rays = field_of(), rays_of(*aim(COUNT))
    found = []
    for few in (1, 1 << 30):
        monkeypatch.setattr(occupied_cells, "FEWEST_RAYS", few)
        cells, source, model = find_occupied_cells(field), make_exact(field, rays.d, slope=True), make_model(field)
        seen = render_rays(cells, source, model, rays)
        vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(0.3, -0.5, 0.9)))
        found.append((numbers(seen), np.array(source.slopes()[0])))
    for a, b in zip(*(light for light, _ in found), strict=True):
        np.testing.assert_array_equal(a, b)
    ours, theirs = (slopes for _, slopes in found)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=2**-24 * COUNT**0.5 * np.abs(theirs).max())


@pytest.mark.parametrize("levels", [1, 2])
def test_neighbours_enter_and_leave_side_by_side(levels: int, sorts: None):
    """Compared with NumPy, in the outermost box, here [-1, 1]^3."""
    cells = find_occupied_cells(field_of(levels, CUBE if levels == 1 else CUBE @ HALF))
    rng = np.random.default_rng(5)
    o = rng.normal(size=(FEWEST_RAYS, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1.5, 1.5, (FEWEST_RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    rays = rays_of(o, d)
    order = RayOrder.find(cells, rays.o, rays.d, rays.t_max)
    places, back = np.array(order.rays), np.array(order.positions)
    np.testing.assert_array_equal(places[back], np.arange(FEWEST_RAYS))
    sides = [(side - o) / d for side in (-1, 1)]
    t0, t1 = np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
    hits = (t1 > t0)[places]
    assert 0.5 < hits.mean() < 0.95
    # Those that miss come last.
    assert np.all(hits[:-1] >= hits[1:])
    for t in (t0, t1):
        points = (o + t[:, None] * d)[places[hits]]
        apart, any_two = (np.linalg.norm(points - np.roll(points, k, axis=0), axis=1).mean() for k in (1, len(points) // 2))
        # There are eight times as many pairs of coarse cells as rays, so many have none in their own.
        assert apart < any_two / 2


def test_few_rays_and_rays_from_pinholes_stay_as_they_are(sorts: None):
    field = field_of()
    cells, model = find_occupied_cells(field), make_model(field)
    few, many = (rays_of(*aim(n)) for n in (FEWEST_RAYS - 1, FEWEST_RAYS))
    pinhole = bake(field, cells, np.float64([[0, 0, 5]]), mi.UInt32(0))
    assert render_rays(cells, make_exact(field, few.d), model, few).order is None
    assert render_rays(cells, make_exact(field, many.d), model, many).order is not None
    assert render_rays(cells, pinhole, model, many).order is None


def test_sorted_rays_keep_their_pinholes(sorts: None, monkeypatch: pytest.MonkeyPatch):
    """A source of pinholes gains nothing from an order, and still renders correctly in any order."""
    field, rays = field_of(), rays_of(*aim(COUNT))
    view = mi.UInt32(np.random.default_rng(6).integers(2, size=COUNT).astype(np.uint32))
    source = bake(field, find_occupied_cells(field), np.float64([[0, 0, 5], [5, 0, 0]]), view)
    plain = numbers(render_rays(find_occupied_cells(field), source, make_model(field), rays))
    monkeypatch.setattr(occupied_cells, "FEWEST_RAYS", 1)
    monkeypatch.setattr(Baked, "gains_by_sorting", True)
    seen = render_rays(find_occupied_cells(field), source, make_model(field), rays)
    assert seen.order is not None
    for a, b in zip(numbers(seen), plain, strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_number_of_rays_compiles_nothing(sorts: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(occupied_cells, "FEWEST_RAYS", 1)
    field = field_of()
    cells, model = find_occupied_cells(field), make_model(field)
    compiled = []
    for count in (300, 301, 517):
        rays = rays_of(*aim(count))
        dr.eval(rays)
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            source = make_exact(field, rays.d, slope=True)
            seen = render_rays(cells, source, model, rays)
            vjp_rays(cells, source, model, seen, RayGradient(2 * seen.colour))
            dr.eval(source.slopes())
            kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        # Two walks, tables before and sums after them, and a few that read lanes: not a walk for each array that is read.
        assert len(kernels) < 12
        compiled.append(sum(not k["cache_hit"] or k["cache_disk"] for k in kernels))
        assert [a.numpy().ctypes.data % ALIGNMENT for a in (seen.order.rays, seen.order.positions)] == [0, 0]
    assert compiled[1:] == [0, 0]
