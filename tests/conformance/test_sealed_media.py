"""Media behind refracting boundaries, which straight shadow rays cannot pass; and the roulette of long paths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, over_pixels
from scattering_scenes import PLACE, moments, rough_grid

import scenes
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import Settings
from mivol.transport.path.walk import LONG_PATH

GLASS, ROUGH, NONE = {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.3}, {"type": "null"}


def ball(at: float, radius: float = 0.4, **more: object) -> dict:
    return {"type": "sphere", "center": [at, 0.0, 0.0], "radius": radius, **more}


def lamp(at: float) -> dict:
    return ball(at, emitter={"type": "area", "radiance": 1.0})


def tank(bsdf: dict) -> dict:
    milk = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9, "phase": {"type": "hg", "g": 0.8}}
    return {"type": "cube", "bsdf": bsdf, "interior": milk}


SUN = {"type": "directional", "direction": [0.0, 0.0, -1.0]}
SEALED = {
    "lamp beside it": ({"tank": tank(GLASS), "lamp": lamp(2.0)}, True),
    "sky, rough glass, a spoon in it": ({"tank": tank(ROUGH), "sky": scenes.sky(), "spoon": ball(0.0)}, True),
    "glass around it": ({"tank": tank(GLASS), "glass": ball(0.0, 2.0, bsdf=GLASS), "lamp": lamp(3.0)}, True),
    "lamp inside": ({"tank": tank(GLASS), "lamp": lamp(0.2)}, False),
    "lamp through its wall": ({"tank": tank(GLASS), "lamp": lamp(1.1)}, False),
    "one of two lamps inside": ({"tank": tank(GLASS), "far": lamp(2.0), "lamp": lamp(0.2)}, False),
    "sun": ({"tank": tank(GLASS), "sun": SUN}, False),
    "no boundary": ({"tank": tank(NONE), "lamp": lamp(2.0)}, False),
    "thin glass": ({"tank": tank({"type": "thindielectric"}), "lamp": lamp(2.0)}, False),
    "glass with holes": ({"tank": tank({"type": "mask", "opacity": 0.5, "bsdf": GLASS}), "lamp": lamp(2.0)}, False),
    "fog beside it": ({"tank": tank(GLASS), "fog": ball(3.0, bsdf=NONE, interior={"type": "homogeneous"})}, False),
    "no medium": ({"lamp": lamp(2.0)}, False),
}


@pytest.mark.parametrize("name", SEALED)
def test_emitters_are_drawn_where_a_straight_ray_may_find_one(name: str) -> None:
    parts, sealed = SEALED[name]
    eye = scenes.camera((2.0, 1.5, 6.0), (0.0, 0.0, 0.0), res=2)
    scene = mi.load_dict({"type": "scene", **parts, "sensor": eye})
    survey, settings = survey_scene(scene), Settings(max_depth=-1)
    assert survey.facts.is_sealed == sealed
    needs = find_needs(scene, scene.sensors()[0], survey)
    if not needs.media:
        return
    plan = make_plan(needs, settings)
    drawn = any(kind != "uniform" for kind in needs.emitter_kinds)
    assert build_estimators(scene, needs, plan, settings, survey, True).lights_media == (drawn and not sealed)
    assert not (sealed and plan.side_flight_cosine is not None)


def test_media_around_shapes_are_not_sealed() -> None:
    """A ray may begin in the medium of the sensor, or in the medium outside a shape."""
    milk = mi.load_dict({"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9})
    bubble = ball(0.0, bsdf=GLASS, exterior=milk, interior={"type": "homogeneous", "sigma_t": 1.0})
    assert not survey_scene(mi.load_dict({"type": "scene", "bubble": bubble, "sky": scenes.sky()})).facts.is_sealed


STOPPED = {**dict.fromkeys(SEALED, True), "thin glass": False, "glass with holes": False}
"""Whether a segment stays in one medium. Boxes and balls are clipped: no other boundary counts."""


@pytest.mark.parametrize("name", SEALED)
def test_a_segment_stays_in_one_medium_behind_what_refracts(name: str) -> None:
    assert survey_scene(mi.load_dict({"type": "scene", **SEALED[name][0]})).facts.stops_rays == STOPPED[name]


def test_a_traced_boundary_without_glass_is_passed() -> None:
    can = {"type": "cylinder", "bsdf": NONE, "interior": {"type": "homogeneous"}}
    assert not survey_scene(mi.load_dict({"type": "scene", "can": can, "sky": scenes.sky()})).facts.stops_rays


BULB = {"bulb": {"type": "point", "position": [0.3, 0.2, 0.1], "intensity": 3.0}}
AMONG = {"tank": tank(GLASS), "spoon": ball(-0.5), "table": ball(-2.5, 1.3)}
SOLID = {
    "a grid in glass": ("stops_rays", {"tank": tank(GLASS), "spoon": ball(-0.5), **BULB}, "data"),
    "a grid in glass among surfaces": ("has_solid_surfaces", AMONG | BULB, "data"),
    "a lamp in a homogeneous medium": ("has_solid_surfaces", AMONG | BULB, "value.value"),
    "a homogeneous medium": ("has_solid_surfaces", AMONG | {"sky": scenes.sky(), "lamp": lamp(2.0)}, "value.value"),
    "a box": ("has_solid_surfaces", AMONG | BULB | {"tank": tank(NONE)}, "data"),
}
"""What tells that rays end at surfaces, scenes in which they do, and the end of the name of the extinction."""


@pytest.mark.parametrize("name", SOLID)
def test_what_is_not_traced_again_is_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and derivatives of a tank: to the rounding of the length of a segment."""
    fact, shapes, end = SOLID[name]
    smoke = scenes.grid_volume("mivol_voxels", rough_grid(1, 3.0), PLACE) if end == "data" else 1.5
    parts = shapes | {"tank": shapes["tank"] | {"interior": {"type": "mivol_medium", "sigma_t": smoke, "albedo": 0.8}}}
    eye = scenes.camera((2.0, 1.5, 6.0), (0.0, 0.0, 0.0), res=6)
    key, found, seen = f"tank.interior_medium.sigma_t.{end}", [], []
    known = SceneMedia.__init__
    monkeypatch.setattr(SceneMedia, "__init__", lambda self, *a, **k: known(self, *a, **k) or seen.append(getattr(self, fact)))
    for again in (False, True):
        if again:
            assert seen and all(seen)
            monkeypatch.setattr(SceneMedia, fact, property(lambda self: False, lambda self, value: None), raising=False)
        scene = mi.load_dict({"type": "scene", **parts, "sensor": eye})
        params = mi.traverse(scene)
        dr.enable_grad(params[key])
        image = mi.render(scene, params, integrator=mi.load_dict({"type": "mivol", "max_depth": 5}), spp=4, seed=1)
        dr.backward(dr.mean(image, axis=None))
        found.append((np.array(image), np.array(dr.grad(params[key]))))
    for short, traced in zip(*found, strict=True):
        assert np.abs(traced).max() > 0
        # A path of 5 segments, whose ends agree to a rounding; sums over 144 paths.
        np.testing.assert_allclose(short, traced, rtol=0, atol=1e3 * 2.0**-24 * np.abs(traced).max())


# -- Roulette of long paths ------------------------------------------------------------------------------------------------

WAIT = 100
"""``rr_depth`` of the furnace."""


def furnace(sky: dict, interior: dict | None = None) -> mi.Scene:
    """A white ball with a mean free path of a sixteenth of its radius, in even light of 1; the index of its boundary equals
    air.
    """
    milk = {"type": "homogeneous", "sigma_t": 16.0, "albedo": 1.0}
    matched = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0}
    eye = scenes.camera((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), res=64, fov=12.0)
    parts = {"ball": {"type": "sphere", "bsdf": matched, "interior": interior or milk}, "sky": sky, "sensor": eye}
    return mi.load_dict({"type": "scene", **parts})


def panorama() -> dict:
    """A constant sky of 1 as an environment map: the plan does not know that it is constant."""
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}


UNLIMITED = {"type": "mivol", "max_depth": -1, "rr_depth": WAIT}


def test_roulette_spares_long_paths_in_even_light() -> None:
    """Every escaping path finds 1. At the surface, roulette ends paths after ``rr_depth`` scattering events with a probability
    of 0.05, and no other paths.
    """
    light = scenes.render(furnace(scenes.sky()), UNLIMITED, 1, seed=3)[..., 0].ravel()
    ends = np.array([0, 1, 1 / 0.95])
    assert np.abs(light[:, None] - ends).min(axis=1).max() < 1e-4  # some thousand factors of 1 +- 6e-8
    assert (light > 1.02).mean() > 0.05


def test_roulette_ends_long_paths_in_light_that_has_a_place() -> None:
    """A path of n > LONG_PATH scattering events has the throughput sqrt(n / LONG_PATH): n is a whole number up to rounding, and
    some are twice LONG_PATH.
    """
    light = scenes.render(furnace(panorama()), UNLIMITED, 1, seed=3)[..., 0].ravel()
    raised = light[light > 1.06] * 0.95
    n = raised**2 * LONG_PATH
    assert np.abs(n - np.round(n)).max() < 0.2  # n up to some 1000, of relative error 1e-4
    assert n.min() > LONG_PATH
    assert n.max() > 2 * LONG_PATH


@pytest.mark.statistical
def test_roulette_of_long_paths_keeps_the_mean() -> None:
    found = over_pixels(moments(furnace(panorama()), UNLIMITED, 4))
    assert_same_mean(found, 1.0, rounding=1e-4, what="radiance")
    assert_precise(found, 0.02, what="radiance")


def test_roulette_spares_long_paths_where_media_emit() -> None:
    """The light of a path grows with its length, so long paths are worth their cost."""
    glow = {"type": "mivol_medium", "sigma_t": 16.0, "albedo": 1.0, "emission": 1.0}
    scene = furnace(panorama(), glow)
    survey, settings = survey_scene(scene), Settings(max_depth=-1)
    needs = find_needs(scene, scene.sensors()[0], survey)
    assert build_estimators(scene, needs, make_plan(needs, settings), settings, survey, True).long_paths_count
