"""Shadows of paths in media: one exact shadow ray a path, chosen by a table."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, over_pixels
from scattering_scenes import PLACE, close_up, mivol, moments, point, rough_grid, smoke, sun

from mivol.experiments.script import explain
from mivol.scene import choices
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.tabulated_shadows import (
    KeptShadow,
    TabulatedShadow,
    TransmittanceGrid,
    find_sun,
    measure_transmittance_bias,
)
from mivol.transport.path import successive
from mivol.transport.path.estimators import Settings
from scenes import box_of, centred, grid_volume, medium, sky

DEPTH = 6


@pytest.fixture(autouse=True)
def small_renders_have_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choices, "TABLE_SHARE", 1.0)


def floor() -> dict:
    place = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def shade() -> dict:
    """A black disk over half of the smoke."""
    place = mi.ScalarTransform4f().translate([0.5, 0, 1.1]).scale(0.6)
    return {"type": "disk", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def lamp() -> dict:
    place = mi.ScalarTransform4f().look_at([0, 0.4, 1.6], [0, 0, 0], [0, 1, 0]).scale(0.6)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 6.0}}


def sun_in_a_map() -> dict:
    """A third of the light comes from a sun of one pixel."""
    picture = np.full((16, 32, 3), 0.3, np.float32)
    picture[4, 9] = 40.0
    return {"type": "envmap", "bitmap": mi.Bitmap(picture)}


def matter(g: float = 0.0) -> dict:
    return smoke(rough_grid(3, 6.0), 0.9, name="hg" if g else "isotropic", g=g)[0]


def coloured() -> dict:
    """Smoke in a traced cylinder, with an extinction for each colour."""
    values = np.concatenate([rough_grid(seed, 5.0) for seed in (1, 2, 3)], axis=-1)
    inside = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.8)
    place = mi.ScalarTransform4f().translate([0, 0, -0.4]).scale([0.5, 0.5, 0.8])
    caps = {"p0": [0, 0, 0], "p1": [0, 0, 1], "radius": 1.0}
    return {"type": "cylinder", "to_world": place, **caps, "bsdf": {"type": "null"}, "interior": inside}


SCENES: dict[str, Callable[[], dict]] = {
    "sun and sky, side flights": lambda: {"a": matter(0.8), "sun": sun([0.3, 0.2, -1.0])[0], "sky": sky(0.5)},
    "lamp inside": lambda: {"a": matter(), "lamp": point([0.1, 0.2, 0.1])[0]},
    "lamp behind a shade": lambda: {"a": matter(), "lamp": lamp(), "floor": floor(), "shade": shade()},
    "sun in a map": lambda: {"a": matter(0.5), "sky": sun_in_a_map()},
    "colours in a traced boundary": lambda: {"a": coloured(), "sun": sun([0.3, 0.2, -1.0])[0]},
}


def assert_as_exact(name: str, depth: int, spp: int, precision: float) -> None:
    """Images with and without a table have the same mean; ``precision`` is the standard error of their difference over it."""
    scene = close_up(SCENES[name](), res=8)
    table, exact = (
        over_pixels(moments(scene, mivol(max_depth=depth, shadows=s), spp, 16, first))
        for s, first in (("auto", 0), ("exact", 100))
    )
    assert_same_mean(table, exact, what="whole images")
    assert_precise(difference(table, exact), precision * np.abs(exact.mean), what="whole images")


@pytest.mark.statistical
@pytest.mark.parametrize("name", SCENES)
def test_a_table_keeps_the_mean_of_exact_shadow_rays(name: str) -> None:
    assert_as_exact(name, DEPTH, spp=64, precision=0.02)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "depth"),
    [
        ("sun and sky, side flights", 20),
        ("lamp inside", DEPTH),
        pytest.param("lamp behind a shade", DEPTH, marks=pytest.mark.slow),
    ],
)
def test_the_kept_shadow_ray_corrects_any_table(name: str, depth: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A table that says one half everywhere has the mean of exact shadows; paths of depth 20 follow each other in lanes."""
    monkeypatch.setattr(TransmittanceGrid, "transmittance", lambda *_: mi.Spectrum(0.5))
    monkeypatch.setitem(successive.MIN_LANES, mi.variant().split("_")[0], 64)
    assert_as_exact(name, depth, spp=128, precision=0.03)


def test_a_path_keeps_a_shadow_ray_in_proportion_to_its_light() -> None:
    """Chances on a lattice: of vertices of light 1 and 3, and a bright one that is off, the second is kept by 3 / 4."""
    n = 1000
    chance = (dr.arange(mi.Float, n) + 0.5) / n
    kept = KeptShadow.empty(n)
    for number, (light, on) in enumerate([(1.0, True), (3.0, True), (9.0, False)]):
        p = mi.Point3d(number, 0, 0)
        shadow = TabulatedShadow(p, mi.Point3f(0), dr.zeros(mi.MediumPtr, n), mi.Float(0.5), mi.Spectrum(light))
        kept = kept.offer(shadow, chance, dr.full(mi.Bool, on, n))
    assert np.count_nonzero(np.array(kept.p.x) == 1) == 750 and np.all(np.array(kept.p.x) <= 1)
    np.testing.assert_allclose(np.array(kept.light.x * kept.total / kept.weight), 4.0, rtol=1e-6)


def test_the_sun_of_a_map_is_found() -> None:
    """Its direction to a pixel of 11 degrees, and its share of the light: (40 - 0.3) of a pixel beside 0.3 everywhere."""
    emitter = mi.load_dict({"type": "scene", "sky": sun_in_a_map()}).emitters()[0]
    direction, share = find_sun(emitter)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -direction
    assert float(np.array(emitter.eval(si)).max()) > 10
    latitude = (4 + 0.5) / 16 * np.pi
    pixel = (np.pi / 16) * (2 * np.pi / 32) * np.sin(latitude)
    # Mitsuba interpolates between pixels: the light of a pixel spreads over four, and not all of it is within the radius.
    assert 0.1 * 40 * pixel / (0.3 * 4 * np.pi + 40 * pixel) < share[0] < 1.2 * 40 * pixel / (0.3 * 4 * np.pi + 40 * pixel)


def test_a_lamp_in_a_node_of_the_table_casts_no_shadow() -> None:
    """From the lamp itself there is no direction to it; NaN there would spread to the cells around."""
    box, _ = smoke(rough_grid(1))
    scene = close_up({"a": box, "lamp": point([0, 0, 0])[0]}, res=8)
    image = np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=DEPTH)), spp=64))
    assert np.all(np.isfinite(image)) and image.mean() > 0


@pytest.mark.parametrize(
    ("parts", "more", "has_table"),
    [
        (lambda: {"a": matter(), "sun": sun([0, 0, -1.0])[0]}, {}, True),
        (lambda: {"a": matter(), "sky": sky(1.0)}, {}, False),
        (lambda: {"a": box_of(medium("homogeneous", 2.0, 0.9), PLACE), "sun": sun([0, 0, -1.0])[0]}, {}, False),
        (lambda: {"a": matter(), "sun": sun([0, 0, -1.0])[0]}, {"max_depth": 2}, False),
    ],
    ids=["smoke", "even sky", "fog in closed form", "depth 2"],
)
def test_the_plan_takes_a_table_where_shadow_rays_are_walked(parts: Callable, more: dict, has_table: bool) -> None:
    text = explain(close_up(parts(), res=32), **({"max_depth": DEPTH} | more))
    assert ("one exact shadow ray a path" in text) == has_table


# -- A table in place of shadow rays ----------------------------------------------------------------------------------------


def open_direct(scene: mi.Scene):
    survey, settings = survey_scene(scene), Settings(max_depth=2)
    needs = find_needs(scene, scene.sensors()[0], survey)
    return build_estimators(scene, needs, make_plan(needs, settings), settings, survey, for_images=True).direct


@pytest.mark.slow
def test_light_grid_against_exact_shadows():
    """The error of tau between nodes is h^2: two nodes a cell have at most a quarter of the error of one node in two cells."""
    box, _ = smoke(rough_grid(1, shape=(16, 16, 16)))
    emitter, _ = sun([0.3, 0.2, -1.0])
    scene = close_up({"smoke": box, "emitter": emitter})
    direct = open_direct(scene)
    lattice = direct.media.bodies[0].view.parts[0].lattice
    with dr.suspend_grad():
        grids = (TransmittanceGrid.over_lattice(direct.media, direct.emitters, lattice, cells) for cells in (4, 1))
        coarse, fine = (measure_transmittance_bias(direct.media, direct.emitters, grid, lattice)[1] for grid in grids)
    assert 0 < fine < 0.5 * coarse < 0.25
    exact, looked_up = (
        np.array(mi.render(scene, integrator=mi.load_dict(mivol(deterministic=True, shadows=s)), spp=16))
        for s in ("exact", "grid")
    )
    # The image is an integral of the same transmittances: it cannot be off by more than some of their rms errors.
    assert 0 < np.abs(exact - looked_up).mean() <= 4 * fine * exact.mean()


@pytest.mark.parametrize(("cells", "nodes"), [(1, (9, 6, 2)), (4, (3, 3, 2)), (3, (4, 3, 2))])
def test_nodes_of_a_light_grid_are_so_many_cells_apart(cells, nodes):
    """At most ``cells`` apart, with nodes in both faces: n cells have ceil(n / cells) steps, and one node more."""
    box, _ = smoke(rough_grid(1, shape=(8, 5, 1)))
    scene = close_up({"smoke": box, "emitter": sun([0.3, 0.2, -1.0])[0]})
    with dr.suspend_grad():
        direct = open_direct(scene)
        lattice = direct.media.bodies[0].view.parts[0].lattice
        assert TransmittanceGrid.over_lattice(direct.media, direct.emitters, lattice, cells).nodes == nodes


def test_light_grid_keeps_optical_depth_not_transmittance():
    """Under suns along the axes, tau of a constant grid is linear, and interpolated exactly; T would be 8 % too bright."""
    box, _ = smoke(np.full((4, 3, 5), 2.0, np.float32), to_world=centred(2 * np.eye(3)))
    suns = {f"sun {axis}": sun(-np.eye(3)[axis])[0] for axis in range(3)}
    scene = close_up({"smoke": box, **suns})
    with dr.suspend_grad():
        direct = open_direct(scene)
        lattice = direct.media.bodies[0].view.parts[0].lattice
        grid = TransmittanceGrid.over_lattice(direct.media, direct.emitters, lattice)
        bias, rms = measure_transmittance_bias(direct.media, direct.emitters, grid, lattice)
    # Nodes in the faces look from 1e-5 of the box inside, where tau is up to 4e-5 off.
    assert abs(bias) <= rms <= 1e-4
    nodes = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 4, 6)), indexing="ij"), axis=-1)
    np.testing.assert_allclose(np.array(grid.tau).reshape(5, 4, 6, 3), 2 * 2 * (1 - nodes[..., ::-1]), atol=5e-5)


def test_a_point_has_the_light_of_its_place():
    """An optical depth linear in x, y and z, for each of two emitters and three channels, at points of a rotated box."""
    to_world = np.array([[2.0, 0.3, 0, -1], [-0.2, 1.5, 0.1, 0.4], [0, 0.1, 3, 2], [0, 0, 0, 1]])
    rows = [[mi.Float64(v) for v in row] for row in np.linalg.inv(to_world)[:3]]
    shape, rng = (3, 5, 4), np.random.default_rng(2)
    slope, level = rng.uniform(0, 1, (2, 3, 3)), rng.uniform(0, 1, (2, 3))
    nodes = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"), axis=-1)[..., ::-1]
    tau = np.einsum("zyxa,eca->zyxec", nodes, slope) + level
    grid = TransmittanceGrid(mi.Float(tau.ravel()), shape, rows, 2, 3, [None, None])
    u, number = rng.random((200, 3)), np.arange(200) % 2
    p = u @ to_world[:3, :3].T + to_world[:3, 3]
    found = np.array(grid.transmittance(mi.Point3f(*p.T), mi.UInt32(number), mi.Bool(True)))
    # Places of float32, 1e-6 of the box, and depths of 4 at most.
    np.testing.assert_allclose(-np.log(found.T), np.einsum("na,nca->nc", u, slope[number]) + level[number], atol=2e-5)


def test_explain_measures_the_light_grid():
    box, _ = smoke(rough_grid(1))
    emitter, _ = sun([0.3, 0.2, -1.0])
    text = explain(close_up({"smoke": box, "emitter": emitter}), max_depth=2)
    assert "exact; with deterministic, a light grid" in text and "bias" in text


def test_microflakes_beside_paths_without_a_shadow(variant_rgb: str) -> None:
    """The projected area of microflakes has no value along the ray of a path that has kept no shadow."""
    matrix = np.tile(np.array([0.2, 0.2, 0.8, 0.0, 0.05, 0.0]), (2, 2, 2, 1))
    flakes = {"type": "sggx", "S": grid_volume("gridvolume", matrix)}
    fog = medium("heterogeneous", grid_volume("gridvolume", rough_grid(3, 6.0), PLACE), 0.9, phase=flakes)
    scene = close_up({"fog": box_of(fog, PLACE), "sun": sun((0.5, 0.4, -1))[0]})
    assert "table" in explain(scene, DEPTH)
    assert np.isfinite(np.asarray(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=DEPTH)), spp=32))).all()
