"""Rays that meet no box around a surface are not traced, and boundaries in closed form are not traced at all."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE, assert_same_whole, close_up, mivol, moments, rough_grid, smoke, sun

from mivol.scene import session
from mivol.scene.survey import survey_scene
from mivol.scene_graph import traverse
from mivol.transport.media.scene_media import SceneMedia
from scenes import as_float32, box_of, medium, sky


def turned(angle: float = 30.0) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([0.3, -0.5, 2.0]).rotate([1, 2, 3], angle)


SHAPES = {
    "tilted rectangle": lambda: {"a": {"type": "rectangle", "to_world": turned().scale([1, 2, 1])}},
    "disk": lambda: {"a": {"type": "disk", "to_world": turned()}},
    "sphere": lambda: {"a": {"type": "sphere", "center": [1, 0, 2], "radius": 0.5}},
    "tilted cube": lambda: {"a": {"type": "cube", "to_world": turned().scale([1, 0.2, 0.4])}},
    "walls that Mitsuba merges": lambda: {
        name: {"type": "rectangle", "to_world": mi.ScalarTransform4f().look_at(at, [0, 0, 0], [0.1, 0.9, 0.3])}
        for name, at in {"a": [0, 0, -2], "b": [0, 3, 0], "c": [2, 1, 1]}.items()
    },
    "far away": lambda: {"a": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([1e4, 0, 5])}},
}


def media_among(parts: dict) -> tuple[mi.Scene, SceneMedia]:
    """The smoke of a scene among surfaces, with their boxes."""
    fog = box_of(medium("homogeneous", 1.0, 0.5), PLACE)
    scene = mi.load_dict({"type": "scene", "fog": fog, **parts})
    survey = survey_scene(scene)
    boxes = survey.facts.surface_boxes
    return scene, SceneMedia(scene, [], has_surfaces=True, surface_boxes=boxes, tracer=survey.tracer)


@pytest.mark.parametrize("name", SHAPES)
def test_no_surface_is_met_outside_of_its_box(name: str) -> None:
    """Rays from everywhere, along the surface, and from the surface itself; more than a third need no tracing."""
    _, media = media_among(SHAPES[name]())
    box = media.tracer.bbox()
    centre, size = np.array(box.center()), np.array(box.extents()).max()
    rng = np.random.default_rng(7)
    o, d = centre + size * rng.uniform(-1.5, 1.5, (20_000, 3)), rng.normal(size=(20_000, 3))
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    maxt = size * rng.choice([0.1, 0.5, 2.0, np.inf], len(o))
    first = media.tracer.ray_intersect(mi.Ray3f(mi.Point3f(*o.T), mi.Vector3f(*d.T)))
    along = first.spawn_ray(first.to_world(mi.Vector3f(dr.sqrt(1 - 1e-6), 0, 1e-3)))
    for ray in (mi.Ray3f(mi.Point3f(*o.T), mi.Vector3f(*d.T), mi.Float(maxt), 0.0, mi.Color0f()), along):
        meets = np.array(media.may_meet_surface(ray, ray.maxt))
        hit = np.array(media.tracer.ray_intersect(ray).is_valid())
        assert hit.any() or ray is along
        assert not np.any(hit & ~meets)
        assert ray is along or np.mean(~meets) > 1 / 3


@pytest.mark.statistical
def test_instances_among_the_surfaces() -> None:
    """Mitsuba cannot put an instance into the scene of the surfaces alone; the image is that of the balls themselves."""
    ball, places = {"type": "sphere", "radius": 0.4}, [(1.4, 0, 0.2), (-1.3, 0.3, 0.4)]
    balls = {f"ball{k}": ball | {"center": list(place)} for k, place in enumerate(places)}
    moves, of = [mi.ScalarTransform4f().translate(place) for place in places], {"type": "ref", "id": "kind"}
    copies = {f"copy{k}": {"type": "instance", "of": of, "to_world": move} for k, move in enumerate(moves)}
    parts = {"smoke": smoke(rough_grid(2))[0], "sun": sun((-0.5, 0.3, -1.0))[0]}
    with_copies = close_up({"kind": {"type": "shapegroup", "ball": ball}, **copies, **parts}, res=12)
    assert survey_scene(with_copies).tracer is None
    judge = moments(close_up({**balls, **parts}, res=12), mivol(), 16, first=100)
    assert_same_whole(moments(with_copies, mivol(), 16), judge)


def test_an_image_does_not_depend_on_the_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit: smoke between a floor, a tilted lamp and a ball."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)}
    above = mi.ScalarTransform4f().look_at([1, 1.5, 2], [0, 0, 0], [0.1, 0.9, 0.3]).scale(0.4)
    lamp = {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": 6.0}}
    ball = {"type": "sphere", "center": [1.5, 0, 0], "radius": 0.3}
    parts = {"smoke": smoke(rough_grid(2))[0], "floor": floor, "lamp": lamp, "ball": ball}
    scene = close_up(parts, res=16)
    images = [np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=5)), spp=16, seed=3))]

    def without(scene: mi.Scene) -> object:
        survey = survey_scene(scene)
        return replace(survey, facts=replace(survey.facts, surface_boxes=None))

    assert survey_scene(scene).facts.surface_boxes is not None
    monkeypatch.setattr(session, "survey_scene", without)
    images.append(np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=5)), spp=16, seed=3)))
    assert images[0].std() > 0.01
    np.testing.assert_array_equal(*images)


def test_surfaces_behind_a_clipped_boundary_are_found() -> None:
    """Absorption alone has no noise inside of a pixel of one colour: the whole scene and the tracer agree to rounding."""
    scene, media = media_among({"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2])}})
    assert len(media.tracer.shapes()) == 1 and len(scene.shapes()) == 2
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 3), mi.Vector3f(0, 0, -1))
    np.testing.assert_allclose(np.array(media.tracer.ray_intersect(ray).t), 4.2, rtol=1e-6)


def test_a_floor_in_the_plane_of_a_face_is_found() -> None:
    """Seen through clear air in a box that stands on it; a ray that passed the face would begin below the floor."""
    air = box_of(medium("mivol_medium", 1e-9, 0.5), PLACE)
    base = PLACE @ np.array([0.5, 0.5, 0.0, 1.0])
    axis = PLACE[:3, 2] / np.linalg.norm(PLACE[:3, 2])
    place = mi.ScalarTransform4f().look_at(base[:3], base[:3] + axis, np.roll(axis, 1)).scale(9)
    floor = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.3}}
    away = base[:3] + 1.5 * axis + 2.0 * np.cross(axis, np.roll(axis, 1))
    eye = {"res": 32, "origin": tuple(away), "target": tuple(base[:3]), "fov": 40}
    scenes = [close_up({"floor": floor, "sky": sky(1.0), **more}, **eye) for more in ({}, {"air": air})]
    images = [np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=3)), spp=4)) for scene in scenes]
    np.testing.assert_allclose(*images, rtol=1e-3)


def test_the_names_of_shapes_are_kept() -> None:
    parts = {"smoke": smoke(rough_grid(2))[0], "floor": {"type": "rectangle"}, "sun": sun([0.3, 0.2, -1.0])[0]}
    scene = close_up(parts, res=8)
    before = set(mi.traverse(scene).keys())
    mi.render(scene, integrator=mi.load_dict(mivol(max_depth=5)), spp=1)
    assert set(mi.traverse(scene).keys()) == before and "floor.to_world" in before


def test_a_surface_that_moves_is_traced_at_its_new_place() -> None:
    def build(height: float) -> mi.Scene:
        ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0, 0, height]).scale(0.4)}
        return close_up({"smoke": smoke(rough_grid(2))[0], "ball": ball, "sky": sky(1.0)}, res=16, fov=90)

    moved, integrator = build(0.0), mi.load_dict(mivol(max_depth=5))
    first = np.array(mi.render(moved, integrator=integrator, spp=4, seed=1))
    params = traverse(moved)
    params["ball.to_world"] = mi.Transform4f().translate([0, 0, 1.3]).scale(0.4)
    params.update()
    second = np.array(mi.render(moved, integrator=integrator, spp=4, seed=1))
    afresh = np.array(mi.render(build(1.3), integrator=mi.load_dict(mivol(max_depth=5)), spp=4, seed=1))
    assert np.abs(first - second).max() > 0.05
    np.testing.assert_array_equal(second, afresh)
