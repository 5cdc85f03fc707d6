"""The level that derivatives of free flights are taken from: about as bright as the light of paths that meet a medium."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE

from mivol.scene.build import build_estimators
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.level import prepare_derivatives
from mivol.transport.path.settings import Settings
from scenes import box_of, camera, medium, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")

ALBEDO, SIGMA = 0.8, 0.05
FAR, POWER = 200.0, 3e4


def level_of(lamp: dict, *interiors: dict, depth: int = 3) -> np.ndarray | None:
    """For boxes beside each other with these media; half of the rays miss the first, [-1, 1]^3."""
    boxes = {f"box{k}": box_of(interior, PLACE + 5 * k * np.eye(4, k=3)) for k, interior in enumerate(interiors)}
    scene = mi.load_dict({"type": "scene", **boxes, "lamp": lamp, "sensor": camera([0, -1, 6], [0, 0, 0])})
    survey, settings = survey_scene(scene), Settings(max_depth=depth)
    o = mi.Point3f(mi.Float([0, 40, 0.5, 40]), 0, -4)
    ray = mi.Ray3f(o, mi.Vector3f(0, 0, 1), dr.inf, dr.zeros(mi.Float, 4), mi.Color0f())
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        plan = make_plan(needs, settings)
        assert plan.segment == "free_flight"
        estimators = build_estimators(scene, needs, plan, settings, survey, pictures=False)
        prepare_derivatives(estimators, settings, ray)
    level = estimators.segment.level
    return None if level is None else np.array(level).ravel()


def test_under_a_constant_sky_it_is_what_media_scatter_of_it():
    """The mean albedo times the radiance."""
    found = level_of(sky(0.5), medium("homogeneous", SIGMA, 0.6), medium("homogeneous", SIGMA, 0.8))
    np.testing.assert_allclose(found, 0.7 * 0.5, rtol=4 * 2.0**-23)


def test_under_a_lamp_it_is_the_mean_of_paths_that_collide():
    """Albedo times I / (4 pi r^2), of the one path in twenty that collides.

    Shadows take 1 - exp(-0.17) of it at most, since no way through the box is longer than 3.5, and a second scattering adds
    less than that share; the lamp is 200 away, give or take 1. The paths are always the same.
    """
    lamp = {"type": "point", "position": [0.0, 0.0, FAR], "intensity": POWER}
    once = ALBEDO * POWER / (4 * np.pi * FAR**2)
    found = level_of(lamp, medium("homogeneous", SIGMA, ALBEDO))
    assert np.all((0.82 * once < found) & (found < 1.19 * once))


def test_there_is_none_beside_a_sigma_s():
    """Absorption that has no share of collisions has no such balance."""
    parts = {"type": "mivol_medium", "sigma_a": 0.1, "sigma_s": 0.2}
    assert level_of(sky(0.5), parts) is None
