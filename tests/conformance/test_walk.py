"""Surfaces among absorbing media keep the shading that Mitsuba gives them: every kind of emitter and BSDF, against volpath."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_apart, assert_precise, assert_same_mean, fresh, over_pixels
from scattering_scenes import cases

import scenes
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.scores import Primal
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.walk import advance_path, begin_path, leave_camera, walk_path
from mivol.validate.statistics import Moments
from scenes import ball_of, box_of, camera, grid_volume, medium, sky

PLACE = scenes.centred(2 * np.eye(3))
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}


def turn() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def room(**more: object) -> dict:
    """A ball in a volume over a floor; emitters are added."""
    values = np.random.default_rng(5).uniform(0, 1, (4, 5, 6, 1)).astype(np.float32)
    return {
        "type": "scene",
        "box": box_of(medium("heterogeneous", grid_volume("gridvolume", values, PLACE)), PLACE),
        "floor": {"type": "rectangle", "bsdf": RED, "to_world": turn().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(5)},
        "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse"}},
        "sensor": camera((2.0, 1.5, 3.0), (0.0, -0.2, 0.0), res=8, fov=40.0),
        **more,
    }


def emitter(size: float = 1.0) -> dict:
    return {
        "type": "rectangle",
        "to_world": turn().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(size),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
    }


POINT = {"type": "point", "position": [1.0, 3.0, 1.0], "intensity": 5.0}
SUN = {"type": "directional", "direction": [0.3, -1.0, -0.2], "irradiance": 2.0}
SPOT = {"type": "spot", "to_world": {}, "intensity": 9.0, "cutoff_angle": 30.0}
SHINY = {"type": "roughconductor", "alpha": 0.05}
MASK = {"type": "mask", "opacity": 0.4, "nested": RED}


def rooms() -> dict[str, tuple[dict, int]]:
    spot = SPOT | {"to_world": turn().look_at([1, 3, 1], [0, 0, 0], [0, 0, 1])}
    masked = {"type": "rectangle", "bsdf": MASK, "to_world": turn().translate([0, 0, 1.5])}
    glass = ball_of(medium("homogeneous", 0.7), (0, 0, 0), 0.8) | {"bsdf": {"type": "dielectric"}}
    fogs = {
        "one": ball_of(medium("homogeneous", 0.7), (0, 0, 0), 1.0),
        "two": ball_of(medium("homogeneous", 2.7), (1.5, 0, -1), 0.7),
    }
    del_box = {"box": None, "ball": None}
    return {
        "sky, depth 2": (room(sky=sky()), 2),
        "sky, no limit": (room(sky=sky()), -1),
        "point": (room(emitter=POINT), 2),
        "sun, depth 3": (room(emitter=SUN), 3),
        "spot": (room(emitter=spot), 2),
        "area, depth 1": (room(emitter=emitter(3), sensor=camera((0.0, -1.0, 4.0), (0.0, 1.5, 0.0), res=8, fov=60.0)), 1),
        "area, depth 4": (room(emitter=emitter()), 4),
        "glossy under a wide emitter": (room(emitter=emitter(3), floor=room()["floor"] | {"bsdf": SHINY}), 2),
        "mask, depth 1": (room(sky=sky(), mask=masked), 1),
        "mask, depth 3": (room(sky=sky(), mask=masked), 3),
        "two fogs in spheres": (room(sky=sky(), **del_box, **fogs), 2),
        "glass full of ink": (room(sky=sky(), **del_box, glass=glass), 8),
    }


NAMES = (
    "sky, depth 2", "sky, no limit", "point", "sun, depth 3", "spot", "area, depth 1", "area, depth 4",
    "glossy under a wide emitter", "mask, depth 1", "mask, depth 3", "two fogs in spheres", "glass full of ink",
)  # fmt: skip
FAST = ("sky, no limit", "glossy under a wide emitter", "mask, depth 3", "glass full of ink")


def batches(scene: mi.Scene, kind: str, depth: int, first: int, **more: object) -> Moments:
    integrator = mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": 50, **more})
    seeds = (fresh(first + s) for s in range(10))
    return Moments.from_values(np.stack([np.array(mi.render(scene, integrator=integrator, spp=96, seed=s)) for s in seeds]))


@pytest.mark.slow_for("glossy under a wide emitter", "mask, depth 3", "sky, no limit")
@pytest.mark.statistical
@pytest.mark.parametrize("name", cases(NAMES, [name for name in NAMES if name not in FAST]))
def test_surfaces_and_emitters_like_volpath(name):
    """Means of 10 batches of 96 samples, Student's t over all pixels and channels."""
    parts, depth = rooms()[name]
    scene = mi.load_dict({k: v for k, v in parts.items() if v is not None})
    ours, stock = batches(scene, "mivol", depth, 0), batches(scene, "volpath", depth, 500)
    # Stock measures media from spawned rays, 1e-4 of a length further on at each boundary: 6e-4 of the radiance (at most 4).
    assert_same_mean(ours, stock, rounding=2.4e-3, what=name)
    assert ours.mean.max() > 1e-3


@pytest.mark.statistical
@pytest.mark.slow
def test_hidden_emitters():
    """hide_emitters takes the emitter and the sky out of the picture, not their light off the surfaces."""
    scene = mi.load_dict(room(sky=sky(), emitter=emitter(3), sensor=camera((0.0, 1.5, 6.0), (0.0, 1.5, 0.0), res=8, fov=70.0)))
    grey = []
    for hide in (False, True):
        ours, stock = (batches(scene, kind, 2, n, hide_emitters=hide) for kind, n in (("mivol", 0), ("volpath", 500)))
        ours, stock = over_pixels(ours), over_pixels(stock)
        assert_same_mean(ours, stock, rounding=6e-4, what="images")
        assert_precise(ours, 0.02, what="images")
        grey.append(Estimate(*(x[0] for x in ours)))
    shown, hidden = grey
    assert_apart(shown, hidden, expected=0.4, what="emitters shown and hidden")


def rays_into(parts: dict, depth: int) -> tuple[Estimators, mi.Sampler, mi.Ray3f, Primal]:
    """The estimators of a room, and 256 rays of its camera with their random numbers and a score."""
    scene, settings, n = mi.load_dict({k: v for k, v in parts.items() if v is not None}), Settings(max_depth=depth), 256
    survey = survey_scene(scene)
    needs = find_needs(scene, scene.sensors()[0], survey)
    estimators = build_estimators(scene, needs, make_plan(needs, settings), settings, survey, for_images=True)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(fresh(7), n)
    ray, _ = scene.sensors()[0].sample_ray(mi.Float(0), mi.Float(0), sampler.next_2d(), mi.Point2f(0.5))
    return estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, n))


@pytest.mark.parametrize(("lights", "ends"), [({"emitter": POINT}, True), ({"sky": sky()}, False)])
def test_paths_end_where_the_last_segment_meets_no_light(lights, ends):
    """At depth 3 a path scatters twice. Behind the second time it finds the sky, and no lamp without a size."""
    fog = ball_of(medium("homogeneous", 1.0, 0.9), (0, -0.2, 0), 1.0)
    with dr.suspend_grad():
        estimators, sampler, ray, score = rays_into(room(box=fog, ball=None, **lights), 3)
        path = begin_path(estimators, leave_camera(estimators, sampler, ray), score)
        for _ in range(8):
            path = advance_path(estimators, path) if not ends or dr.any(path.active) else path
            last = path.active & (path.depth == 2)
            if dr.any(last):
                break
    assert dr.any(path.depth == 2) and dr.any(last) != ends


def test_a_ray_through_a_mask_reaches_what_is_behind():
    """It has not scattered, so it goes on without a light that it could meet, and the pixel is opaque."""
    wall = {"type": "rectangle", "bsdf": RED, "to_world": turn().look_at([0, -0.2, 0], [2.0, 1.5, 3.0], [0, 1, 0]).scale(9)}
    mask = {"type": "rectangle", "bsdf": MASK, "to_world": turn().look_at([1, 0.6, 1.5], [2.0, 1.5, 3.0], [0, 1, 0])}
    with dr.suspend_grad():
        estimators, sampler, ray, score = rays_into(room(ball=None, floor=wall, mask=mask, emitter=POINT), 1)
        _, alpha = walk_path(estimators, sampler, ray, score)
    assert np.all(np.array(alpha) == 1)
