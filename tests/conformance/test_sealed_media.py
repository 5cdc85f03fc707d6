"""Media behind boundaries that refract: no straight ray finds an emitter, so none is sent."""

from __future__ import annotations

import mitsuba as mi
import pytest

import scenes
from mivol.scene.build import build_estimators
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.settings import Settings

pytestmark = pytest.mark.usefixtures("variant_rgb")

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
    assert survey.is_sealed == sealed
    needs = find_needs(scene, scene.sensors()[0], survey)
    if not needs.media:
        return
    plan = make_plan(needs, settings)
    drawn = any(kind != "uniform" for kind in needs.emitter_kinds)
    assert build_estimators(scene, needs, plan, settings, survey, True).lights_media == (drawn and not sealed)
    assert not (sealed and plan.lobe is not None)


def test_media_around_shapes_are_not_sealed() -> None:
    """A ray may begin in them: the medium of the sensor, or of the outside of a shape."""
    milk = mi.load_dict({"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9})
    bubble = ball(0.0, bsdf=GLASS, exterior=milk, interior={"type": "homogeneous", "sigma_t": 1.0})
    assert not survey_scene(mi.load_dict({"type": "scene", "bubble": bubble, "sky": scenes.sky()})).is_sealed
