"""Hard cases of single scattering, each against a closed form or the float64 twin."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from false_alarms import assert_same_mean
from hard_scattering import BATCHES, holds_twin
from scattering_scenes import PLACE, aimed, fog, mivol, pencils, point, rough_grid, smoke, sun

import scenes
from scenes import as_float32, box_of, centred, grid_volume, medium, refused, tensor

GRID = "smoke.interior_medium.sigma_t.data"
ALBEDO = "smoke.interior_medium.albedo.value.value"
EPS = 2.0**-23


def set_grid(scene: mi.Scene, values: np.ndarray, key: str = GRID) -> None:
    params = mi.traverse(scene)
    params[key] = tensor(values)
    params.update()


def test_picture_of_no_density():
    """Exactly the background; no NaN from 0/0."""
    box, _ = smoke(0 * rough_grid(1), 1.0)
    seen = pencils({"smoke": box, "sky": scenes.sky(0.7), "bulb": point([0.1, 0.2, 0.3])[0]}, *aimed(1, 6))
    assert np.all(np.abs(scenes.render(seen.scene, mivol(), 16) - as_float32(0.7)) <= 4 * EPS)


@pytest.mark.parametrize("kind", small.KINDS)
def test_albedo_0(kind):
    """L = T B without noise."""
    values = rough_grid(2)
    parts = {"smoke": smoke(values, 0.0, kind)[0], "emitter": point([1.5, 1, 2.0])[0], "sky": scenes.sky(0.4)}
    seen = pencils(parts, *aimed(2, 2))
    T = np.exp(-twins.Grid(values, PLACE).tau(seen.o, seen.d, np.full(2, np.inf)))
    # tau is right to 2e-6 of itself (at most 3).
    assert np.all(np.abs(scenes.render(seen.scene, mivol(), 4)[0] - 0.4 * T) <= 1e-5 * 0.4)


@pytest.mark.parametrize("kind", small.KINDS)
@pytest.mark.parametrize("value", [-0.1, 1.2, math.nan, math.inf])
@pytest.mark.parametrize("is_grid", [False, True])
def test_albedo_outside_its_domain(is_grid, value, kind):
    """An optimizer's overshoot, of a number or of one voxel, is refused with a sentence naming the albedo, not rendered with a
    gain of energy."""
    medium_type, volume_type = small.KINDS[kind]
    values = np.full((2, 3, 4, 1), 0.5)
    albedo = grid_volume(volume_type, values, PLACE) if is_grid else 0.5
    box = box_of(medium(medium_type, grid_volume(volume_type, rough_grid(3), PLACE), albedo), PLACE)
    seen = pencils({"smoke": box, "emitter": point([1.5, 1, 2.0])[0]}, *aimed(3, 2))
    params, key = mi.traverse(seen.scene), "smoke.interior_medium.albedo." + ("data" if is_grid else "value.value")
    values[1, 2, 3] = value
    with refused("albedo"):
        params[key] = tensor(values) if is_grid else type(params[key])(value)
        params.update()
        scenes.render(seen.scene, mivol(), 1)


@pytest.mark.slow_for("nan-own", "nan-stock")
@pytest.mark.parametrize("kind", small.KINDS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_density_that_is_no_number(value, kind):
    """A voxel of NaN or infinity is refused and named by its indices; rendering works again after a step back."""
    values = rough_grid(4)
    box, _ = smoke(values, 0.8, kind)
    seen = pencils({"smoke": box, "emitter": point([1.5, 1, 2.0])[0]}, *aimed(4, 2))
    before = scenes.render(seen.scene, mivol(), 4, seed=1)
    bad = values.copy()
    bad[3, 1, 2] = value
    with refused(r"z=3, y=1, x=2"):
        set_grid(seen.scene, bad)
        scenes.render(seen.scene, mivol(), 4)
    set_grid(seen.scene, values)
    assert np.array_equal(scenes.render(seen.scene, mivol(), 4, seed=1), before)


@pytest.mark.slow_for("own")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.cases(small.KINDS, ["stock"]))
def test_density_that_has_grown(kind):
    """An optimizer has raised the values tenfold: bounds of the old values must not be used."""
    values = rough_grid(5, 0.5)
    box, m = smoke(values, 0.8, kind)
    emitter = point([1.5, 1, 2.0])
    seen = pencils({"smoke": box, "emitter": emitter[0]}, *aimed(5, 4))
    scenes.render(seen.scene, mivol(), 4)
    grown = as_float32(10 * values)
    set_grid(seen.scene, grown)
    holds_twin(seen, twins.Medium(twins.Grid(grown, PLACE), 0.8), emitter[1])
    # From nothing to something: blocks that were empty are empty no more.
    set_grid(seen.scene, 0 * values)
    assert not scenes.render(seen.scene, mivol(), 4).any()
    set_grid(seen.scene, values)
    holds_twin(seen, m, emitter[1])


@pytest.mark.slow_for("0.001")
@pytest.mark.statistical
@pytest.mark.parametrize("h", [1e-3, 0.03, 0.4])
def test_point_light_beside_the_ray(h):
    """Close to the ray the radiance grows as 1/h: equal angles keep the noise constant."""
    values = rough_grid(8)
    box, m = smoke(values, 0.8, "own")
    emitter = point([0.1, as_float32(0.2 + h), 0.3])
    seen = pencils({"smoke": box, "emitter": emitter[0]}, as_float32([-3, 0.2, 0.3]), [1.0, 0, 0])
    # The distance of the emitter from the ray is a difference of float32 numbers of 0.5: 6e-8/h of it.
    holds_twin(seen, m, emitter[1], level=2e-5 + 1e-7 / h, precision=0.02)


@pytest.mark.slow_for("grid")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["grid", "homogeneous"])
def test_point_light_on_the_ray(kind):
    """The integral diverges: the pixel must be finite, and its neighbours right."""
    values = rough_grid(8)
    box, m = smoke(values, 0.8, "own") if kind == "grid" else fog(0.7, 0.8)
    emitter = point([0.1, 0.2, 0.3])
    o = as_float32([[-3, 0.2, 0.3], [-3, 0.5, 0.3]])
    seen = pencils({"smoke": box, "emitter": emitter[0]}, o, [1.0, 0, 0])
    image = scenes.render(seen.scene, mivol(), 256)
    assert np.all(np.isfinite(image))
    assert image[0, 0, 0] > 5 * image[0, 1, 0] > 0
    holds_twin(pencils({"smoke": box, "emitter": emitter[0]}, o[1:], [1.0, 0, 0]), m, emitter[1])


@pytest.mark.slow_for("face", "node")
@pytest.mark.statistical
@pytest.mark.parametrize("where", ["node", "face", "edge", "border"])
def test_point_light_at_a_special_place(where):
    """A point light at a voxel's centre, on a face and an edge between cells, and on the border of the grid."""
    values = rough_grid(9, 1.0, (4, 4, 4))
    step = 0.5  # voxel centres of [-1, 1]^3 in 4: -0.75, -0.25, 0.25, 0.75
    place = {
        "node": [0.25, 0.25, -0.25],
        "face": [0.25, 0.1, 0.0],
        "edge": [0.25, -0.25, 0.07],
        "border": [1.0, 0.2, 0.3],
    }[where]
    assert (np.array(place[0]) / step * 2) % 1 in (0.0, 0.5)
    box, m = smoke(values, 0.8, "own")
    emitter = point(place)
    holds_twin(pencils({"smoke": box, "emitter": emitter[0]}, *aimed(9, 5)), m, emitter[1], spp=4096)


@pytest.mark.slow_for("1000.0")
@pytest.mark.statistical
@pytest.mark.parametrize("away", [1e3, 1e5])
def test_point_light_far_away_is_a_sun(away):
    """Irradiance I / r^2 from one direction, up to the parallax 1/r; the angle of a cell is not computed as a difference."""
    values = rough_grid(10)
    box, m = smoke(values, 0.8, "own", name="hg", g=0.5)
    towards = np.array([0.48, -0.6, 0.64])
    emitter = point(away * towards, intensity=2.0 * away**2)
    seen = pencils({"smoke": box, "emitter": emitter[0]}, *aimed(10, 6))
    # 2 / r of parallax; a float32 distance to the emitter is good to 1e-7 of it, so directions to that; r^2 to 2e-7.
    holds_twin(seen, m, twins.Directional(-towards, 2.0), level=2e-5 + 8 / away)


@pytest.mark.slow_for("0.0-grid")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["grid", "homogeneous"])
@pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-3])
def test_light_along_the_camera_ray(tilt, kind):
    """mu -> mu0 in transmission: alpha p E0 (tau/mu) e^{-tau/mu}, without 0/0."""
    sigma = 1.3
    frame = as_float32(scenes.affine(np.diag([400.0, 400, 1]), (-200, -200, 0)))
    build = fog(sigma, 0.8, frame) if kind == "homogeneous" else smoke(np.full((3, 2, 2, 1), sigma), 0.8, "own", frame)
    travel = np.array([math.sin(0.3 + tilt), 0, -math.cos(0.3 + tilt)])
    d = np.array([math.sin(0.3), 0, -math.cos(0.3)])
    # The camera looks along the light from above: it sees the light that turned straight back; from below the one that went on.
    o = np.array([[0, 0, 3.0], [0, 0, -2.0]])
    seen = pencils({"slab": build[0], "sun": sun(travel, 2.0)[0]}, o, np.array([d, -d]))
    p, mu, mu0 = 1 / (4 * math.pi), abs(seen.d[0, 2]), abs(travel[2])
    truth = np.array([[f(0.8, p, 2.0, mu, mu0, sigma)] * 3 for f in (twins.slab_reflected, twins.slab_transmitted)])
    found = seen.moments(mivol(), 4096, BATCHES)
    assert_same_mean(found, truth, rounding=1e-5 * truth.max())


@pytest.mark.slow_for("direction0")
@pytest.mark.statistical
@pytest.mark.parametrize("direction", [[0, 0, -1.0], [0, -1.0, 0], [1.0, 0, 0]])
def test_shadow_rays_along_the_faces_of_cells(direction):
    """Camera rays in planes between cells, through voxel centres, and light along other such planes: T is continuous."""
    values = rough_grid(11, 2.0, (4, 4, 4))
    box, m = smoke(values, 0.8, "own")
    emitter = sun(direction)
    # y and z: in a face between cells, in an edge between them, in the grid's middle.
    o = np.array([[-3, 0.25, 0.1], [-3, 0.25, -0.25], [-3, 0.0, 0.0], [-3, 0.75, 0.999]])
    seen = pencils({"smoke": box, "sun": emitter[0]}, o, [1.0, 0, 0])
    holds_twin(seen, m, emitter[1], spp=4096)


@pytest.mark.statistical
def test_no_light_is_lost_where_shadow_rays_start():
    """Dense smoke of voxels 1e-3 wide: Mitsuba's offset of 1e-4 at the start of a shadow ray would cause an error of 10 %."""
    scale = 2e-3
    values = as_float32(rough_grid(12, 2.0) / scale)
    frame = as_float32(centred(scale * np.eye(3)))
    box, m = smoke(values, 0.8, "own", frame)
    emitter = sun([0.3, 0.2, -1.0])
    o, d = aimed(12, 6, 0.8 / 2, 3.0)
    seen = pencils({"smoke": box, "sun": emitter[0]}, as_float32(o * scale), d)
    holds_twin(seen, m, emitter[1], spp=4096)


def test_surfaces_shine_on_the_medium_only_directly():
    """A white floor lit by an emitter lights the smoke above at depth 3, not at 2; an area light does at 2."""
    box, _ = smoke(rough_grid(13), 0.9)
    turn, ray = mi.ScalarTransform4f, ([-5, 0.1, 0.2], [1.0, 0, 0])
    floor = {"type": "rectangle", "to_world": turn().translate([0, 0, -1.2]).scale(3)}
    white = floor | {"bsdf": {"type": "diffuse"}}
    # The shade keeps the sun off the smoke but not off the floor around it.
    shade = {"type": "rectangle", "to_world": turn().translate([0, 0, 1.2]).scale(1.2), "bsdf": {"type": "diffuse"}}
    dark = pencils({"smoke": box, "floor": white, "shade": shade, "sun": sun([0, 0, -1.0])[0]}, *ray)
    assert not scenes.render(dark.scene, mivol(), 64).any()
    lit = pencils({"smoke": box, "floor": floor | {"emitter": {"type": "area", "radiance": 1.0}}}, *ray)
    assert scenes.render(lit.scene, mivol(), 64).min() > 0.01
