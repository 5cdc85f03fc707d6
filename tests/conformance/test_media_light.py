"""Light of media that is drawn where paths scatter: the same mean as by chance, closed forms, and what a plan chooses."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, over_pixels
from media_light_scenes import PLACE, SCENES, burning, drawn, floor, met, seen, wall
from scattering_scenes import assert_same_whole, close_up, moments, pencils, volpath

from mivol.experiments.script import explain
from mivol.scene.media_light import SAMPLING_COST
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.previews import measure_media_light, sampling_gain
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import Settings
from scenes import ball_of, box_of, centred, medium, refused, render, skip_recorded_grids_on_a_gpu, sky, tensor

AUTO = {"type": "mivol", "max_depth": 2, "rr_depth": 100}

R, J = 0.3, np.array([9.0, 6.0, 3.0])
"""Radius of a clear ball at the origin, and its emission density [radiance/length]."""


def clear_ball() -> dict:
    light = {"type": "rgb", "value": J.tolist()}
    return ball_of(medium("mivol_medium", 0.0, 0.0, emission_density=light), (0, 0, 0), R)


@pytest.mark.statistical
def test_a_clear_ball_shines_as_a_point() -> None:
    """What it sends through a plane beside it is 4 pi R^3 / 3 J over the squared distance to its middle, times the cosine."""
    z = 0.6
    there = np.array([[0.0, 0.0, -z], [0.5, 0.2, -z], [-0.9, 0.7, -z]])
    d = np.array([[0.5, 1.0, -1.5], [0.6, 1.0, -2.0], [-0.5, 1.0, -1.0]])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    found = pencils({"fire": clear_ball(), "floor": floor(-z)}, there - 0.2 * d, d).moments(drawn(2), 512)
    r = np.linalg.norm(there, axis=1, keepdims=True)
    truth = 0.6 / np.pi * 4 / 3 * np.pi * R**3 * J * z / r**3
    assert_same_mean(found, truth, rounding=1e-4 * truth.max(), what="rays")
    assert_precise(found, 0.02 * truth, what="rays")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, 3, 6])
def test_a_clear_ball_lights_a_corner_as_a_point_light_does(depth: int) -> None:
    """Of volpath: nothing stands in the way of what walls send to each other."""
    corner = {"floor": floor(), "wall": wall({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}})}
    intensity = {"type": "rgb", "value": (4 / 3 * np.pi * R**3 * J).tolist()}
    point = {"type": "point", "position": [0, 0, 0], "intensity": intensity}
    low = {"origin": (1.0, -0.1, 0.3), "target": (0.5, 1.1, -0.6), "res": 8, "fov": 30}
    found = moments(close_up({"fire": clear_ball(), **corner}, **low), drawn(depth), 256)
    truth = moments(close_up({"bulb": point, **corner}, **low), volpath(max_depth=depth), 256, first=100)
    assert_same_mean(found, truth, tile=2, what="tiles")
    assert_same_whole(found, truth)


def test_no_light_passes_a_roof() -> None:
    """Under it the floor is black, sample by sample."""
    fire = box_of(medium("mivol_medium", 1.0, 0.0, emission=2.0), centred(0.5 * np.eye(3)))
    parts = {"fire": fire, "roof": floor(-0.4), "floor": floor(-0.6)}
    o, d = np.array([[0.3, -1.2, -0.5], [0.3, -1.2, -0.3]]), np.array([[0.0, 1.0, -0.5], [0.0, 1.0, -0.5]])
    under, above = pencils(parts, o, d).moments(drawn(2), 16).mean
    assert not under.any() and above.all()


@pytest.mark.slow
@pytest.mark.statistical
def test_isothermal_furnace() -> None:
    """What absorbs and glows like its surroundings cannot be seen, nor can a white wall in it."""
    interior = medium("mivol_medium", 1.5, 0.6, emission=1.0)
    ball = {"type": "sphere", "center": [0.1, 0.0, -0.2], "radius": 0.4, "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    scene = close_up({"box": box_of(interior, centred(2 * np.eye(3))), "ball": ball, "sky": sky(1.0)}, res=8)
    found = over_pixels(moments(scene, drawn(-1), 64))
    assert_same_mean(found, 1.0, rounding=1e-4, what="radiance")
    assert_precise(found, 1e-2, what="radiance")


def _cases() -> list:
    quick = ("over a floor", 3)
    return [
        pytest.param(name, depth, marks=() if (name, depth) == quick else pytest.mark.slow)
        for name in SCENES
        for depth in (2, 3, 6)
    ]


@pytest.mark.slow_for("over a floor-3")
@pytest.mark.statistical
@pytest.mark.parametrize(("name", "depth"), _cases())
def test_draws_keep_the_mean(name: str, depth: int) -> None:
    """Tiles of four pixels, and the whole image."""
    scene = seen(name)
    found, truth = moments(scene, drawn(depth), 32, 16), moments(scene, met(depth), 256, 16, first=100)
    assert_same_mean(found, truth, tile=2, what="tiles")
    found, truth = over_pixels(found), over_pixels(truth)
    assert_same_mean(found, truth, what="whole images")
    assert_precise(difference(found, truth), 0.05 * truth.mean, what="whole images")


@pytest.mark.statistical
def test_a_mirror_shows_all_of_a_fire() -> None:
    """No draw could have found what a delta function reflects, so it counts fully: as much as is seen of it directly."""
    parts, mirror = {"fire": clear_ball()}, {"type": "conductor", "specular_reflectance": 1.0}
    o, d = np.array([[0.0, -2.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    at = mi.ScalarTransform4f().translate([0, -4, 0]).rotate([1, 0, 0], -90).scale(2)
    back = {"type": "rectangle", "to_world": at, "bsdf": mirror}
    directly = pencils(parts, o, d).moments(met(1), 1).mean
    found = pencils(parts | {"mirror": back, "floor": floor(-3.0)}, o, -d).moments(drawn(2), 16)
    assert_same_mean(found, directly, rounding=1e-4, what="rays")


# -- The plan ------------------------------------------------------------------------------------------------------------


def room() -> mi.Scene:
    """Filled by a medium that glows evenly."""
    glow = medium("mivol_medium", 0.3, 0.0, emission=1.0)
    return close_up({"glow": box_of(glow, centred(3 * np.eye(3))), "floor": floor(), "wall": wall({"type": "diffuse"})}, res=8)


def plan_of(scene: mi.Scene, **more: object) -> object:
    return make_plan(find_needs(scene, scene.sensors()[0]), Settings(**{"max_depth": 2, **more}))


@pytest.mark.parametrize("name", ["over a floor", "in fog"])
def test_a_fire_is_drawn_and_a_room_is_met(name: str) -> None:
    """In a room that glows evenly draws add noise to what hardly has any."""
    scene = seen(name)
    assert plan_of(scene).draws_emission and not plan_of(scene, media_light="met").draws_emission
    assert not plan_of(scene, max_depth=1).draws_emission
    assert plan_of(room(), media_light="drawn").draws_emission and not plan_of(room()).draws_emission


def test_what_draws_gain() -> None:
    """Of a small ball over a floor: by chance a share s of the directions finds it, with a relative variance of 1 / s - 1.
    Draws always find it, and what the floor scatters of each varies by less than a twentieth: with distance and cosine."""
    small = clear_ball() | {"radius": 0.1}
    scene = close_up({"fire": small, "floor": floor()}, res=4, origin=(0.1, -0.1, 0.9), fov=20)
    share = 0.1**2 / 0.6**2
    assert find_needs(scene, scene.sensors()[0]).media_light.gain * SAMPLING_COST > 20 * (1 / share - 1)
    assert 0.1 < find_needs(room(), room().sensors()[0]).media_light.gain < 0.9


def test_the_gain_is_of_variances_or_of_what_chance_has_missed() -> None:
    """Cells of variances 4 and 1, and a cell in which chance finds nothing of a light of 1: 16 samples of it weigh 16."""
    swing = np.tile([-1.0, 1.0], 8) * np.sqrt(15 / 16)
    drawn_cells = np.stack([5 + swing, 5 + swing, 1 + 0.5 * swing])
    assert sampling_gain(5 + 2 * swing[None], drawn_cells[:1]) == pytest.approx(4 / SAMPLING_COST)
    assert sampling_gain(0 * swing[None], drawn_cells[2:]) == pytest.approx(16 / 0.25 / SAMPLING_COST)
    median = sampling_gain(np.stack([5 + 2 * swing, 5 + 3 * swing, 0 * swing]), drawn_cells)
    assert median == pytest.approx(9 / SAMPLING_COST)
    assert sampling_gain(np.zeros((2, 4)), np.zeros((2, 4))) == 0.0


@pytest.mark.slow
def test_draws_do_not_pay_where_other_light_has_the_noise() -> None:
    """A lamp in the fog: the prediction knows of the fire only, the preview is asked, once."""
    lamp = {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([1, 1, 2], [0, 0, 0], [0, 0, 1]), "intensity": 900.0}
    scenes = seen("in fog"), close_up(SCENES["in fog"]() | {"lamp": lamp}, res=8, fov=45)
    for scene, pays in zip(scenes, (True, False), strict=True):
        survey, sensor, settings = survey_scene(scene), scene.sensors()[0], Settings(max_depth=3)
        needs = find_needs(scene, sensor, survey)
        assert needs.media_light.gain > 1
        assert measure_media_light(scene, sensor, needs, survey, Settings(max_depth=3, media_light="drawn")) is needs
        measured = measure_media_light(scene, sensor, needs, survey, settings)
        assert (measured.media_light.gain > 1) == make_plan(measured, settings).draws_emission == pays
        survey.gain_of_draws = 7.0
        assert measure_media_light(scene, sensor, needs, survey, settings).media_light.gain == 7.0


@pytest.mark.slow
def test_a_render_asks_the_preview() -> None:
    """Where draws are predicted to pay, and nowhere else."""
    for scene, asked in ((seen("over a floor", 4), True), (room(), False)):
        integrator = mi.load_dict(AUTO)
        mi.render(scene, integrator=integrator, spp=1)
        assert (integrator.session._surveyed.survey.gain_of_draws is not None) == asked


def test_explain_says_how_light_of_media_is_found() -> None:
    said = " ".join(explain(seen("over a floor"), 2).split())
    assert "light of media sampled by emission, and met by chance because sampling reaches the same error" in said
    assert "light of media met by chance because sampling reaches the same error" in " ".join(explain(room(), 2).split())
    assert "light of media" not in explain(seen("over a floor"), 1)


@pytest.mark.slow
def test_what_is_not_asked_for_is_not_read() -> None:
    """At depth 1, where nothing scatters, and where light is to be met by chance."""
    lonely = close_up({"fire": box_of(burning(), PLACE)}, res=4)
    for scene, settings in ((seen("over a floor", 4), drawn(1)), (seen("over a floor", 4), met(2)), (lonely, drawn(3))):
        integrator = mi.load_dict(settings)
        mi.render(scene, integrator=integrator, spp=1)
        assert integrator.session._surveyed.survey.media_light is None
    integrator = mi.load_dict(drawn(2))
    mi.render(seen("over a floor", 4), integrator=integrator, spp=1)
    assert integrator.session._surveyed.survey.media_light is not None


def test_the_table_follows_the_medium(variant_rgb: str) -> None:
    """A new array is read, an old one is not read again."""
    scene = seen("over a floor", 4)
    survey, sensor = survey_scene(scene), scene.sensors()[0]
    first = find_needs(scene, sensor, survey).media_light
    assert find_needs(scene, sensor, survey).media_light is first
    params = mi.traverse(scene)
    key = "fire.interior_medium.emission.data"
    params[key] = tensor(np.array(params[key])[::-1].copy())
    params.update()
    second = find_needs(scene, sensor, survey).media_light
    assert not np.allclose(np.array(second.density), np.array(first.density))
    again = find_needs(scene, sensor, survey_scene(scene)).media_light
    # Sums of a GPU have no fixed order: a few roundings.
    rtol = 0 if variant_rgb.startswith("llvm") else 1e-6
    np.testing.assert_allclose(np.array(second.density), np.array(again.density), rtol=rtol)
    assert second.gain == pytest.approx(again.gain, rel=rtol, abs=0)


@pytest.mark.slow
def test_what_cannot_be_drawn_is_refused_or_met() -> None:
    """An unknown word; a medium around the camera, which fills no shape; a recording."""
    with refused("media_light is 'sampled'; auto, drawn or met is expected"):
        render(seen("over a floor", 4), drawn(2, media_light="sampled"), 1)
    haze = {"type": "mivol_medium", "sigma_t": 0.2, "albedo": 0.5, "emission": 1.0, "id": "haze"}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}, "exterior": {"type": "ref", "id": "haze"}}
    around = close_up({"haze": haze, "ball": ball}, res=4)
    assert not plan_of(around, max_depth=2).draws_emission
    assert "an emitting medium fills no shape of its own" in explain(around, 2)
    with refused("media_light is 'drawn', and an emitting medium fills no shape of its own"):
        plan_of(around, media_light="drawn")
    scene, (auto, by_chance, by_draws) = seen("over a floor", 4), (mi.load_dict(i) for i in (AUTO, met(2), drawn(2)))
    for integrator in (auto, by_draws):
        _shoot(scene, integrator, mi.UInt32(1))  # a recording knows what was read before
    skip_recorded_grids_on_a_gpu()
    image, judge = np.array(dr.freeze(_shoot)(scene, auto, mi.UInt32(3))), np.array(_shoot(scene, by_chance, mi.UInt32(3)))
    # In a recording of the user, a ray is spawned 1.8e-4 (1 + coordinate) beside the boundary of the medium, and the light of
    # the floor changes by some times this; an ordinary render does not trace the boundary. Draws would change it altogether.
    np.testing.assert_allclose(image, judge, rtol=0, atol=1e-3 * judge.max())
    with refused("media_light is 'drawn', and the emission cannot be read while dr.freeze records"):
        dr.freeze(_shoot)(scene, by_draws, mi.UInt32(1))


def _shoot(scene: mi.Scene, integrator: mi.Integrator, seed: mi.UInt32) -> mi.TensorXf:
    return mi.render(scene, integrator=integrator, spp=4, seed=seed)
