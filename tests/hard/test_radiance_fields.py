"""Hard cases of radiance fields: opaque and empty voxels, underflow, overflowing colours, sparse storage, cameras inside."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import draw_tiles
from emission_scenes import changes, colours, gradients
from oracle import box_interval
from oracle_radiance import Twin
from radiance_rays import TO_WORLD, aim, derive, followed, rays_of, see
from sampled_fields import CUBE
from scattering_scenes import Pencils, pencils
from scipy.special import lpmv

from mivol.fields.activation import ACTIVATIONS
from mivol.fields.harmonics import MAX_DEGREE, basis_size
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import begin_fit, reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.photos import Camera, Photo, pixel_centres, rays
from mivol.photos.camera import intrinsics
from mivol.transport.line_integrals.radiance_field import RayGradient, find_occupied_cells, make_model, render_rays, vjp_rays
from mivol.transport.line_integrals.radiance_source import bake, make_exact
from mivol.transport.traversal.grid_blocks import REACH
from mivol.transport.traversal.lattice import clip_to_grid
from mivol.transport.traversal.occupied_walk import walk_occupied_cells
from scenes import box_of, tensor, transform

Y0 = 0.28209479177387814
"""The constant harmonic, 1 / sqrt(4 pi)."""

EPS = 2.0**-24


def even(density: float, sh: float = 0.0, to_world=CUBE, res=(3, 4, 5), **more) -> SphericalGrid:
    """The same density and the same constant harmonic (other than the offset's 0.5) everywhere."""
    return SphericalGrid.from_dense(np.full(res, density), np.full((*res, 1, 3), sh), to_world, **more)


def unit(d: np.ndarray) -> np.ndarray:
    d = np.float64(d)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def entries(to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter a placed unit cube (0: from inside), and how far they go in it."""
    ends = np.array([box_interval(to_world, a, b) for a, b in zip(np.float64(o), unit(d), strict=True)]).clip(0)
    return ends[:, 0], ends[:, 1] - ends[:, 0]


def lengths(to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    return entries(to_world, o, d)[1]


def in_a_scene(field: SphericalGrid, o: np.ndarray, d: np.ndarray, background: float) -> Pencils:
    """The field as a volume of a scene, before a sky, along pencils."""
    density, sh = field.to_dense()
    volume = {"type": "mivol_sh", "density": tensor(density), "sh": tensor(sh), "to_world": transform(field.to_world)}
    medium = {"type": "mivol_medium", "emission": volume | {"activation": field.activation}}
    return pencils({"box": box_of(medium, field.to_world), "sky": colours(background)}, o, d)


def seen_by(scene: Pencils, **more) -> np.ndarray:
    """Channels (n, C) of pencils."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, **more})
    return np.array(mi.render(scene.scene, integrator=integrator, spp=1), dtype=np.float64)[0]


@pytest.mark.parametrize("name", PRESETS)
def test_rates_of_a_stage_reach_opaque_voxels(name: str) -> None:
    """The density can climb to an optical depth of 4.6 (alpha 0.99) in one voxel of the last stage within that stage.

    The tutorial's 420 steps of 0.05 make a voxel of 1/128 opaque to 15 %.
    """
    plan = PRESETS[name]
    last = plan.stages[-1]
    climbed = sum(plan.learning_rates(step)[0] for step in range(plan.steps - last.steps, plan.steps))
    # Rates count in half the longest edge, of which a voxel is 2 / longest.
    assert climbed * 2 / last.longest > -math.log(0.01)


def plain_view(back: np.ndarray, side: int = 16) -> Photo:
    """A photograph of something grey that fills it and lets nothing through."""
    z = back / np.linalg.norm(back)
    x = np.cross([0, 0.3, 1], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), back
    camera = Camera(intrinsics(4 * side, 4 * side, side / 2, side / 2), (side, side), pose)
    return Photo("grey", np.full((side, side, 3), 0.5, np.float32), np.ones((side, side), np.float32), None, camera, np.ones(3))


def test_a_short_fit_makes_matter_opaque() -> None:
    """40 steps from a fog of an optical depth of 0.1 to something that hides all, in a box of any size."""
    half = 0.02
    photos = [plain_view(4 * half * np.array(v)) for v in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-0.6, -0.6, -0.6])]
    plan = RadiancePlan((RadianceStage(8, 40, 1, 4, 16),), degree=0, delay=0.0)
    problem = RadianceProblem(RayBatches.from_photos(photos), np.array([[-half] * 3, [half] * 3]), plan)
    reconstruct(problem, plan.optimizer, plan.course())
    opacity = render_view(problem.field, photos[0].camera, np.ones(3)).opacity
    # Rates add up to 100 over half the edge: an optical depth of 25 a voxel if all derivatives agree. A tenth is asked for.
    assert np.quantile(opacity, 0.1) > 0.99
    # And not by depth alone: single voxels are walls.
    assert np.array(problem.field.density).max() * 2 * half / 8 > 2.5


def visited(field: SphericalGrid, o, d) -> np.ndarray:
    """How many cells each ray visits."""
    rays, cells = rays_of(o, d), find_occupied_cells(field)
    segment = clip_to_grid(cells, rays.o, rays.d, 0, rays.t_max)
    count, _, _ = walk_occupied_cells(cells, segment, lambda n, here, on: n + mi.UInt32(on), mi.UInt32(0))
    return np.array(count)


def test_only_occupied_cells_are_visited() -> None:
    """As many visits as a ray crosses cells with a corner above 0, counted from sorted crossings in float64."""
    density = np.random.default_rng(4).normal(-1.2, 1, (9, 8, 10)).astype(np.float32)
    field = SphericalGrid.from_dense(density, np.zeros((*density.shape, 1, 3)), TO_WORLD)
    o, d = aim(40)
    twin = Twin(density, np.zeros((*density.shape, 1, 3)), TO_WORLD)
    padded, crossed, among = np.pad(density, 1, mode="edge"), [], []
    for a, b in zip(o, d, strict=True):
        q, v, t = twin.cuts(a.astype(np.float64), unit(b))
        cell = np.floor(q + v * (0.5 * (t[1:] + t[:-1]))[:, None]).astype(int) + 1
        occupied = [padded[k : k + 2, j : j + 2, i : i + 2].max() > 0 for i, j, k in cell]
        # Crossings of two planes 1e-5 of a cell apart may be rounded into one.
        occupied = np.array(occupied)[np.diff(t) * np.linalg.norm(v) > 1e-5]
        crossed.append(occupied.sum())
        among.append(len(occupied))
    found = visited(field, o, d)
    assert np.array_equal(found, crossed)
    assert 0.2 < np.sum(crossed) / np.sum(among) < 0.8
    assert (visited(even(-1.0), *aim(20, CUBE)) == 0).all()


@pytest.mark.parametrize(("density", "reads"), [(-1.0, math.ceil(61 / (4 * REACH))), (1.0, 61)])
def test_an_empty_box_is_left_in_leaps(density: float, reads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads of the map of bricks along a row of 60 voxels: one a cell where it is full, one in 15 bricks where it is empty."""
    field = even(density, res=(1, 1, 60))
    ray, cells = rays_of([-3, 0.1, 0.2], [1, 0, 0]), find_occupied_cells(field)
    segment = clip_to_grid(cells, ray.o, ray.d, 0, ray.t_max)
    gather, count = dr.gather, []

    def counted(kind, source, *rest, **more):
        if kind is mi.UInt32 and source.index == cells.index.bricks.index:
            count.append(1)
        return gather(kind, source, *rest, **more)

    monkeypatch.setattr(dr, "gather", counted)
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        walk_occupied_cells(cells, segment, lambda n, here, on: n + mi.UInt32(on), mi.UInt32(0))
    assert len(count) == reads


def test_a_ray_that_ends_inside_a_cell() -> None:
    """c (1 - exp(-sigma L)) for the length L up to its end, in a sheared box with voxels of three lengths."""
    o, d = aim(60)
    sigma, (entry, whole) = 3.0, entries(TO_WORLD, o, d)
    field, ray = even(sigma, 1.0, TO_WORLD), rays_of(o, d)
    ends = np.float32(entry + whole * np.random.default_rng(2).uniform(-0.3, 1.3, 60))
    ray.t_max = mi.Float(ends)
    cells = find_occupied_cells(field)
    source, model = make_exact(field, ray.d, slope=True), make_model(field)
    seen = render_rays(cells, source, model, ray)
    L = np.clip(ends - entry, 0, whole)
    # t_max is near 5 length units, of which float32 keeps 2.4e-7, and so do the faces of the box; times sigma.
    tolerance = 3 * 5 * 2.4e-7
    np.testing.assert_allclose(np.array(seen.T), np.exp(-sigma * L), atol=tolerance)
    sent = np.outer(-np.expm1(-sigma * L), np.full(3, 0.5 + Y0))
    np.testing.assert_allclose(np.array(seen.colour).T, sent, atol=tolerance)
    vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(0), 1.0))
    assert np.array(source.slopes()[0], np.float64).sum() == pytest.approx(-np.sum(L * np.exp(-sigma * L)), rel=1e-5)
    share = L / whole
    assert all(kind.any() for kind in (share == 0, share == 1, (share > 0) & (share < 1)))


@pytest.mark.slow_for("3000.0")
@pytest.mark.parametrize("most", [3e3, 1e5])
def test_no_nan_where_transmittance_underflows(most: float) -> None:
    """A random grid 16^3, optical depths up to 190 and 6000 a step: derivatives of fields and of scenes, against the twin."""
    rng = np.random.default_rng(0)
    density = rng.uniform(0, most, (16, 16, 16)).astype(np.float32)
    sh = rng.normal(0, 0.4, (16, 16, 16, 1, 3)).astype(np.float32)
    field = SphericalGrid.from_dense(density, sh, np.eye(4))
    o, d = aim(12, np.eye(4))
    scene = in_a_scene(field, o, d, 0.25)
    o, d = np.float32(scene.o), np.float32(scene.d)
    by = [0.3, -0.5, 0.9]
    slopes = [s.reshape(v.shape) for s, v in zip(derive(field, o, d, by, 0.25 * sum(by)), (density, sh), strict=True)]
    found = gradients(scene, ["density", "sh"], np.broadcast_to(by, (12, 3)))
    assert all(np.isfinite(s).all() for s in slopes + found)

    def twin_sees(*values: np.ndarray) -> float:
        twin = Twin(*values, np.eye(4))
        seen = [twin.render(a, b) for a, b in zip(np.float64(o), unit(d), strict=True)]
        return sum(np.dot(by, L + 0.25 * T) for L, T, _ in seen)

    for k, step in ((0, 1e-6 * most), (1, 1e-6)):
        way = rng.normal(size=(density, sh)[k].shape)
        ends = [[np.float64(density), np.float64(sh)] for _ in range(2)]
        ends[0][k] -= step * way
        ends[1][k] += step * way
        expected = (twin_sees(*ends[1]) - twin_sees(*ends[0])) / (2 * step)
        size = np.linalg.norm(slopes[k] * way)
        # A position errs by 2^-23 (16 + 16 + 16) = 6e-6 of a cell, and the extinction there by as much of the most; what shows
        # through the first half cell goes with the ratio of two extinctions, of which one may be a hundredth of the most.
        assert abs(np.sum(slopes[k] * way) - expected) <= 1e-3 * size
        assert abs(np.sum(found[k].reshape(way.shape) * way) - expected) <= 1e-3 * size
        assert size > 0


def test_a_fit_goes_on_from_an_opaque_field() -> None:
    """A step from densities up to 1e5 leaves finite values and a finite state."""
    photos = [plain_view(4 * np.array(v)) for v in ([1.0, 0, 0], [0, 1.0, 0])]
    plan = RadiancePlan((RadianceStage(16, 4, 1, 2, 16),), degree=0)
    problem = RadianceProblem(RayBatches.from_photos(photos), np.array([[-1.0] * 3, [1.0] * 3]), plan)
    rng = np.random.default_rng(1)
    dense = mi.Float(rng.uniform(0, 1e5, problem.field.rows).astype(np.float32))
    harmonics = mi.Float(rng.normal(size=dr.width(problem.field.harmonics)).astype(np.float32))
    problem.field = problem.field.with_values(dense, harmonics)
    fit = begin_fit(problem, plan.optimizer, plan.course())
    fit.advance()
    state = fit.run.pack()
    assert set(state) == {"reals/density", "reals/harmonics", "roots/density", "roots/harmonics"}
    assert all(np.isfinite(array).all() for array in state.values())
    assert np.any(state["roots/density"] > 0) and np.any(state["roots/harmonics"] > 0)


@pytest.mark.slow_for("10.0-True")
@pytest.mark.parametrize(("sh", "clamp"), [(10.0, True), (0.3, True), (-2.0, True), (-2.0, False)])
def test_colours_keep_their_derivatives(sh: float, clamp: bool) -> None:
    """Above 1 as between 0 and 1: Y_0 alpha; below 0, where black is shown, the density still knows the background."""
    field, behind = even(1.5, sh, clamp=clamp), 0.25
    o, d = aim(10, CUBE)
    L = lengths(CUBE, o, d)
    T = np.exp(-1.5 * L)
    black = clamp and 0.5 + Y0 * sh < 0
    shown = 0.0 if black else 0.5 + Y0 * sh
    # Rounding of some 15 cells, each of a few operations on numbers of this size.
    tolerance = 60 * EPS * max(abs(shown), 1)
    np.testing.assert_allclose(see(field, o, d)[0], np.outer(shown * (1 - T), np.ones(3)), atol=tolerance)
    by = [1.0, 0.5, 0.25]
    density, harmonics = (np.float64(s) for s in derive(field, o, d, by, behind * sum(by)))
    for k in range(3):
        expected = 0.0 if black else by[k] * Y0 * np.sum(1 - T)
        assert harmonics[:, 0, k].sum() == pytest.approx(expected, rel=1e-5)
    assert density.sum() == pytest.approx(sum(by) * (shown - behind) * np.sum(L * T), rel=1e-5)
    assert abs(density.sum()) > 0.1


@pytest.mark.slow_for("exp", "softplus")
@pytest.mark.parametrize("name", ["relu", "softplus", "exp"])
def test_negative_densities(name: str) -> None:
    """Softplus and exp have an extinction and a derivative everywhere; a ReLU has neither below 0, and a fit begins above."""
    raw = -3.0
    field = even(raw, 1.0, activation=name)
    o, d = aim(10, CUBE)
    L = lengths(CUBE, o, d)
    sigma = {"relu": 0.0, "softplus": math.log1p(math.exp(raw)), "exp": math.exp(raw)}[name]
    slope = {"relu": 0.0, "softplus": 1 / (1 + math.exp(-raw)), "exp": math.exp(raw)}[name]
    colour, T, _ = see(field, o, d)
    np.testing.assert_allclose(T, np.exp(-sigma * L), rtol=1e-6)
    density, harmonics = (np.float64(s) for s in derive(field, o, d, [1.0, 1.0, 1.0], 0.75))
    # d/d rho of c (1 - T) + B T = (c - B) L T a'(rho), for three channels of c = 0.5 + Y_0 and B = 0.25.
    assert density.sum() == pytest.approx(3 * (0.25 + Y0) * slope * np.sum(L * np.exp(-sigma * L)), rel=1e-5)
    assert harmonics.sum() == pytest.approx(3 * Y0 * np.sum(-np.expm1(-sigma * L)), rel=1e-5)
    if name == "relu":
        assert (density == 0).all() and (harmonics == 0).all() and (colour == 0).all()


def test_a_fit_begins_above_zero() -> None:
    for plan in PRESETS.values():
        small = RadiancePlan((RadianceStage(8, 1, 1, 1, 1),), degree=plan.degree, start=plan.start)
        batches = RayBatches.from_photos([plain_view(np.array([4.0, 0, 0]))])
        field = RadianceProblem(batches, np.array([[-1.0] * 3, [1.0] * 3]), small).field
        assert dr.all(field.density > 0) and field.activation in ACTIVATIONS


def test_background_and_alpha_have_their_derivatives() -> None:
    """An empty volume is not there; through a fog the sky is seen, and alpha = 1 - exp(-sigma L) has its derivative."""
    o, d = aim(8, CUBE)
    empty = seen_by(in_a_scene(even(-1.0), o, d, 0.25), aovs="alpha")
    assert (empty[:, :3] == 0.25).all() and (empty[:, 3] == 0).all()
    scene = in_a_scene(even(0.7, 1.0), o, d, 0.25)
    L = lengths(CUBE, np.float32(scene.o), np.float32(scene.d))
    T = np.exp(-0.7 * L)
    fog = seen_by(scene, aovs="alpha")
    # Rounding of 15 cells.
    np.testing.assert_allclose(fog[:, 3], 1 - T, atol=60 * EPS)
    np.testing.assert_allclose(fog[:, :3], np.outer((0.5 + Y0) * (1 - T) + 0.25 * T, np.ones(3)), atol=60 * EPS)
    only_alpha = np.zeros((8, 4))
    only_alpha[:, 3] = np.arange(1, 9)
    (density,) = gradients(scene, ["density"], only_alpha, aovs="alpha")
    assert density.sum() == pytest.approx(np.sum(np.arange(1, 9) * L * T), rel=1e-5)
    forward = changes(scene, {"density": np.ones((3, 4, 5, 1))}, aovs="alpha")
    np.testing.assert_allclose(forward[:, 3], L * T, rtol=1e-5)
    # Of three channels of c (1 - T) + B T: 3 (c - B) L T.
    (density,) = gradients(scene, ["density"], np.ones((8, 3)))
    assert density.sum() == pytest.approx(3 * (0.25 + Y0) * np.sum(L * T), rel=1e-5)


def test_memory_goes_with_what_is_there() -> None:
    """Values, derivatives, squares and tables of a thin shell in 64^3: a twentieth of the tutorial's 16 bytes a coefficient."""
    n = 64
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    keep = np.abs(np.sqrt(x * x + y * y + z * z) - 0.6) < 1.5 / n
    nodes = np.flatnonzero(keep)
    stored = np.ones(len(nodes), np.float32), np.zeros((len(nodes), 9, 3), np.float32)
    field = SphericalGrid.from_rows((n, n, n), CUBE, *stored, mi.UInt32(nodes.astype(np.uint32)))
    cells, pinholes = find_occupied_cells(field), np.array([[3.0, 0, 0]])
    tables = bake(field, cells, pinholes, mi.UInt32(0), slope=True)
    ray = rays_of([3, 0, 0], [-1, 0, 0])
    slopes = make_exact(field, ray.d, slope=True)
    held = [field.density, field.harmonics] * 2  # the values and the optimizer's squares
    held += [slopes.table, slopes.slope, *slopes.slopes(), field.nodes]
    held += [cells.corners, cells.rows, tables.table, tables.slope]
    taken = sum(dr.width(a) * dr.itemsize_v(a) for a in held) + field.sparse_index().bytes + cells.index.bytes
    assert field.bytes == 4 * ((len(nodes) + 1) * 29 + len(nodes))
    # A fortieth of the nodes is kept: three rows of 29 numbers for each, and for the cells around it 8 corners and two tables.
    assert taken < 0.05 * 16 * 28 * n**3
    # A byte a cell and two bits a node of the box, which was 8 bytes; a little more for the last words.
    assert field.sparse_index().bytes + cells.index.bytes < 1.26 * (n + 1) ** 3
    assert see(field, [3, 0, 0], [-1, 0, 0])[1] < 1


def test_no_colour_is_read_where_nothing_is() -> None:
    """Harmonics are NaN but at the corners of cells with extinction on the ray: neither light nor derivatives see it."""
    density = np.full((4, 4, 30), -1.0, np.float32)
    density[:, :, 12:14] = 2.0
    # A corner of cells 20 and 21 is above 0, off the ray, whose points in them are below.
    density[3, 3, 21] = 0.1
    sh = np.full((*density.shape, 1, 3), np.nan, np.float32)
    sh[:, :, 11:15] = 1.0
    clean = SphericalGrid.from_dense(density, np.nan_to_num(sh), CUBE, clamp=False)  # a clamp would hide NaN
    rows = np.zeros((density.size, clean.width), np.float32)
    rows[:, :3] = sh.reshape(-1, 3)
    poisoned = clean.with_values(clean.density, mi.Float(rows.reshape(-1)))
    o, d = [-3, 0.45, 0.4], [1, 0, 0]
    assert visited(clean, o, d)[0] == 5
    for a, b in zip(see(clean, o, d), see(poisoned, o, d), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(derive(clean, o, d, [1.0, 1.0, 1.0]), derive(poisoned, o, d, [1.0, 1.0, 1.0]), strict=True):
        np.testing.assert_array_equal(a, b)


def harmonics(d: np.ndarray, degree: int) -> np.ndarray:
    """Real harmonics from associated Legendre functions (Condon-Shortley sign): (n, basis), l (l + 1) + m in order."""
    azimuth, found = np.arctan2(d[:, 1], d[:, 0]), []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            turn = math.sqrt(2) * (np.sin(k * azimuth) if m < 0 else np.cos(k * azimuth)) if m else 1.0
            found.append(norm * lpmv(k, n, d[:, 2]) * turn)
    return np.stack(found, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("degree", range(MAX_DEGREE + 1))
def test_any_degree(degree: int) -> None:
    """0.5 + Y . k from opaque matter of the same coefficients everywhere, and the same after a degree is added."""
    k = np.random.default_rng(degree).normal(0, 0.1, (basis_size(degree), 3))
    o, d = aim(20, CUBE)
    field = SphericalGrid.from_dense(np.full((2, 2, 2), 200.0), np.broadcast_to(k, (2, 2, 2, *k.shape)), CUBE)
    expected = np.maximum(0.5 + harmonics(unit(d), degree) @ np.float32(k).astype(np.float64), 0)
    opacity = -np.expm1(-200 * lengths(CUBE, o, d))
    # A direction is rounded to 6e-8, a harmonic of degree 4 changes by up to 4 of its size of 1; 25 terms of 0.1.
    np.testing.assert_allclose(see(field, o, d)[0], opacity[:, None] * expected, atol=5e-6)
    if degree < MAX_DEGREE:
        np.testing.assert_allclose(see(field.with_degree(degree + 1), o, d)[0], opacity[:, None] * expected, atol=5e-6)


def test_a_ray_stops_in_the_cell_that_hides_enough() -> None:
    """At the first plane behind which less than ``stop`` of the light is left, and there its transmittance is the true one."""
    n, sigma, stop = 40, 6.0, 0.01
    seen = followed(even(sigma, res=(1, 1, n)), [-3, 0.1, 0.1], [1, 0, 0], stop)
    # Planes: the outer half voxel, then one voxel after the other.
    planes = 2 / n * (np.arange(n) + 0.5)
    end = planes[planes * sigma > -math.log(stop)][0]
    assert float(seen.last.t[0]) == pytest.approx(end, rel=1e-6)
    assert float(seen.T[0]) == pytest.approx(math.exp(-sigma * end), rel=1e-5)
    # What is left out is less than stop times the one colour there is.
    assert 0 < 0.5 * -math.expm1(-2 * sigma) - float(seen.colour.x[0]) < 0.5 * stop


def test_photographs_of_different_sizes_without_jitter() -> None:
    """Each ray goes through the middle of the pixel whose value it is compared with, whatever the photograph's size."""
    rng, photos = np.random.default_rng(0), []
    for width, height in ((20, 12), (9, 30), (17, 16)):
        camera = plain_view(rng.normal(size=3) * 3).camera
        camera = Camera(intrinsics(1.3 * width, 1.1 * width, 0.45 * width, 0.6 * height), (width, height), camera.to_world)
        codes = rng.integers(0, 256, (height, width, 4)).astype(np.float32) / 255
        photos.append(Photo("noise", codes[..., :3], codes[..., 3], None, camera, np.ones(3)))
    views = RayBatches.from_photos(photos)
    order = np.array([2, 0, 1])
    batches = [draw_tiles(views, 1, order, 30, np.random.default_rng(seed)) for seed in range(2)]
    for batch in batches:
        d, slot = np.array(batch.rays.d).T, np.array(batch.slot)
        target = np.concatenate([np.array(batch.target).T, np.array(batch.alpha)[:, None]], axis=1)
        assert len(slot) == 3 * 30 * TILE**2
        for k, view in enumerate(order):
            photo, mine = photos[view], slot == k
            middle = rays(photo.camera, pixel_centres(photo.camera.size))[1].reshape(-1, 3)
            angle = np.linalg.norm(d[mine][:, None] - middle[None], axis=2)
            pixel = angle.argmin(axis=1)
            # Three roundings of a direction, where pixels are 1 / 26 apart.
            assert angle.min(axis=1).max() < 4e-7
            values = np.concatenate([photo.image, photo.alpha[..., None]], axis=2).reshape(-1, 4)
            # Codes times float32's 1 / 255.
            np.testing.assert_allclose(target[mine], values[pixel], atol=1.2e-7)
            assert len(np.unique(pixel)) > 0.5 * len(values)
    assert np.any(np.array(batches[0].rays.d) != np.array(batches[1].rays.d))


@pytest.mark.slow
def test_a_camera_inside_sees_nothing_behind_it() -> None:
    """Matter behind the camera only: radiance 0, alpha 0 and no derivative, exactly; turned round it is all there."""
    density = np.full((6, 6, 8), -1.0, np.float32)
    density[:, :, :3] = 40.0
    field = SphericalGrid.from_dense(density, np.zeros((6, 6, 8, 1, 3)), CUBE)
    o, ahead = np.array([[0.3, 0.1, 0.2]] * 2), np.array([[1.0, 0, 0], [0.8, 0.36, -0.48]])
    colour, T, distance = see(field, o, ahead)
    assert (colour == 0).all() and (T == 1).all() and (distance == 0).all()
    assert all((s == 0).all() for s in derive(field, o, ahead, [1.0, 1.0, 1.0], 1.0, 1.0))
    scene = in_a_scene(field, o, ahead, 0.25)
    shown = seen_by(scene, aovs="alpha")
    assert (shown[:, :3] == 0.25).all() and (shown[:, 3] == 0).all()
    assert all((g == 0).all() for g in gradients(scene, ["density", "sh"], np.ones((2, 3))))
    assert (np.abs(see(field, o, -ahead)[0] - 0.5) < 1e-6).all()


def test_what_a_wall_of_depth_50_leaves() -> None:
    """Hidden nodes get their e^-50 to float32's digits, before a bright background, where a remainder would be 1e-7."""
    rng = np.random.default_rng(3)
    density = rng.uniform(0.2, 2, (1, 1, 24))
    density[..., 9] = 50 / (2 / 24)
    density, sh = np.float32(density), rng.normal(0, 0.4, (1, 1, 24, 1, 3)).astype(np.float32)
    o, d, by, behind = np.array([-3.0, 0.1, 0.1]), np.array([1.0, 0, 0]), [1.0, 0.5, 0.25], 5.0
    found = derive(SphericalGrid.from_dense(density, sh, CUBE), o, d, by, behind * sum(by))
    hidden = range(11, 24)  # cells of the node before lie behind the wall's, which ends at node 10
    values = [np.float64(density), np.float64(sh)]

    def light(which: int, at: tuple, step: float) -> float:
        moved = [v.copy() for v in values]
        moved[which][at] += step
        # From node 10 on: what is in front dims both ends of the difference alike.
        L, T, _ = Twin(*moved, CUBE).render([-1 + 2 * 10.5 / 24, 0.1, 0.1], d)
        return np.dot(by, L + behind * T)

    front = -math.log(Twin(*values, CUBE).render(o, d)[1] / Twin(*values, CUBE).render([-1 + 2 * 10.5 / 24, 0.1, 0.1], d)[1])
    for which, at in ((0, ()), (1, (0, 0))):
        slope = [(light(which, (0, 0, i, *at), 1e-6) - light(which, (0, 0, i, *at), -1e-6)) / 2e-6 for i in hidden]
        expected = math.exp(-front) * np.array(slope)
        ours = np.array([np.float64(found[which]).reshape(values[which].shape)[(0, 0, i, *at)] for i in hidden])
        # An optical depth of 51 is known to 2e-6 after each of 13 subtractions.
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
        assert 0 < np.abs(expected).max() < 1e-20
