"""The level that derivatives of free flights are taken from: the light of paths that collide."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.flights.flight_derivatives import Baseline
from mivol.transport.path.derivatives import prepare_derivatives
from mivol.transport.path.estimators import Settings
from scenes import box_of, camera, medium, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")

ALBEDO, SIGMA = 0.8, 0.05
FAR, POWER = 200.0, 3e4


MISSED = 40.0
"""Where a ray passes all boxes."""


def levels_of(
    emitter: dict, *interiors: dict, depth: int = 3, at: tuple = (0, MISSED, 0.5, MISSED), seen: tuple = (0.5,) * 4
) -> Baseline | None:
    """For boxes with these media, 5 beside each other, the first one [-1, 1]^3, and rays that pass x = ``at``.

    They lie at (``seen``, 0.5) on the film.
    """
    boxes = {f"box{k}": box_of(interior, PLACE + 5 * k * np.eye(4, k=3)) for k, interior in enumerate(interiors)}
    scene = mi.load_dict({"type": "scene", **boxes, "emitter": emitter, "sensor": camera([0, -1, 6], [0, 0, 0])})
    survey, settings = survey_scene(scene), Settings(max_depth=depth)
    o = mi.Point3f(mi.Float(at), 0, -4)
    ray = mi.Ray3f(o, mi.Vector3f(0, 0, 1), dr.inf, dr.zeros(mi.Float, len(at)), mi.Color0f())
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        plan = make_plan(needs, settings)
        assert plan.segment == "free_flight"
        estimators = build_estimators(scene, needs, plan, settings, survey, pictures=False)
        prepare_derivatives(estimators, ray, mi.Point2f(mi.Float(seen[: len(at)]), 0.5))
    return estimators.segment.baseline


def level_of(*args: dict, **options: object) -> np.ndarray:
    """The one of later flights, which is the same for all of the film."""
    return np.array(levels_of(*args, **options).later).ravel()


def test_in_a_white_furnace_it_is_the_light_of_the_sky():
    """Of every path, to the rounding of a sum of 4096."""
    found = level_of(sky(0.5), medium("homogeneous", SIGMA, 1.0), depth=-1)
    np.testing.assert_allclose(found, 0.5, rtol=12 * 2.0**-23)


def test_collisions_count_as_their_derivatives_weigh():
    """A white box of sigma 3 and a black one of 0.5, kappa = 0.6 / 2: half of the paths fly to each, and collide there with
    probabilities of 1 - exp(-2 sigma). 2048 paths tell the second one to 1.7 %, and are always the same."""
    sigma, light = np.array([3.0, 0.5]), np.array([0.5, 0.0])
    weight = (1 - np.exp(-2 * sigma)) / (sigma + 0.3) ** 2
    boxes = [medium("homogeneous", s, albedo) for s, albedo in zip(sigma, (1.0, 0.0), strict=True)]
    found = level_of(sky(0.5), *boxes, depth=-1, at=(0, 5, 0, 5))
    np.testing.assert_allclose(found, np.sum(weight * light) / weight.sum(), rtol=0.08)


def test_where_nothing_collides_it_is_the_mean_of_all_rays():
    np.testing.assert_allclose(level_of(sky(0.5), medium("homogeneous", SIGMA, 1.0), at=(MISSED, MISSED)), 0.5, rtol=1e-6)


def test_under_an_emitter_it_is_the_mean_of_paths_that_collide():
    """Albedo times I / (4 pi r^2), of the one path in twenty that collides.

    Shadows take 1 - exp(-0.17) of it at most, since no way through the box is longer than 3.5, and a second scattering adds
    less than that share; the emitter is 200 away, give or take 1. The paths are always the same.
    """
    emitter = {"type": "point", "position": [0.0, 0.0, FAR], "intensity": POWER}
    once = ALBEDO * POWER / (4 * np.pi * FAR**2)
    found = level_of(emitter, medium("homogeneous", SIGMA, ALBEDO))
    assert np.all((0.82 * once < found) & (found < 1.19 * once))


def test_there_is_none_beside_a_sigma_s():
    """Absorption that has no share of collisions has no such balance."""
    parts = {"type": "mivol_medium", "sigma_a": 0.1, "sigma_s": 0.2}
    assert levels_of(sky(0.5), parts) is None


def test_first_flights_have_a_level_for_each_tile():
    """White and black boxes in two tiles: the light of each, drawn to the mean of all by as much as 16 collisions weigh.

    Of 4096 paths n = 2048 (1 - exp(-2 sigma)) collide in each, with a standard deviation of 0.9 %; paths are always the same.
    Rays beside the film belong to the tiles at its edge.
    """
    boxes = [medium("homogeneous", 1.0, albedo) for albedo in (1.0, 0.0)]
    found = levels_of(sky(0.5), *boxes, depth=-1, at=(0, 5, 0, 5), seen=(-0.1, 0.99, 0.0, 1.2))
    n = 2048 * (1 - np.exp(-2.0))
    first, mean = np.array(found.first)[0], np.array(found.later)[0, 0]
    np.testing.assert_allclose(first[::2] / mean, (2 * n + 16) / (n + 16), rtol=0.06)
    np.testing.assert_allclose(first[1::2] / mean, 16 / (n + 16), rtol=0.06)
    assert np.array_equal(np.array(found.at_depth(mi.UInt32([0, 0, 1, 2])))[0], [first[0], first[1], mean, mean])
