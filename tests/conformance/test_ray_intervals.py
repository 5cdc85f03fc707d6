"""Media along a ray: boundaries of all shapes, moved boundaries, instances, and media without an end."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from scattering_scenes import PLACE, assert_same_images, close_up, mivol, moments, point
from volpath_scenes import FOG, LEAK, RED, cube, floor, grid_in, lit, same, square, turn

import scenes
from scenes import ball_of, box_of, centred, medium, rotation

pytestmark = pytest.mark.usefixtures("variant_rgb")


def walls(**more: object) -> dict:
    """Six walls facing the inside of a room, from -2 to 2."""
    tilts = [([1, 0, 0], 0), ([1, 0, 0], 180), ([1, 0, 0], 90), ([1, 0, 0], -90), ([0, 1, 0], 90), ([0, 1, 0], -90)]
    place = [turn().rotate(*tilt).translate([0, 0, -2]).scale(2) for tilt in tilts]
    return {f"wall{k}": {"type": "rectangle", "to_world": p, "bsdf": {"type": "diffuse"}, **more} for k, p in enumerate(place)}


def instances(interior: dict) -> dict:
    """Two balls of the same kind."""
    places = [turn().translate([0.4, 0, 0]), turn().translate([-0.7, 0.1, 0])]
    balls = {f"ball{k}": {"type": "instance", "to_world": p, "of": {"type": "ref", "id": "kind"}} for k, p in enumerate(places)}
    return {"kind": {"type": "shapegroup", "ball": ball_of(interior, (0, 0, 0), 0.5)}, **balls}


INSIDE = {
    "fog without an end": lambda fog: floor(),
    "fog around a ball": lambda fog: {"ball": ball_of(medium("homogeneous", 2.0, 0.8), (0, 0, 0), 0.6) | {"exterior": fog}},
    "a room": lambda fog: {**walls(exterior=fog), "ball": {"type": "sphere", "radius": 0.4, "bsdf": RED}},
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("where", small.cases(INSIDE, [name for name in INSIDE if name != "a room"]))
def test_media_that_fill_no_shape_of_their_own(where):
    """Around the camera, around shapes, and between walls: a homogeneous medium without a boundary has no end."""
    ref = {"type": "ref", "id": "fog"}
    parts = {"fog": FOG, **INSIDE[where](ref), "bulb": point([0.3, 0.2, 1.5], 4.0)[0]}
    sensor = scenes.camera((1.5, -1.2, 1.0), (0, 0, 0), res=16, fov=40.0)
    scene = mi.load_dict({"type": "scene", **parts, "sensor": sensor | {"medium": ref}})
    assert_same_images(scene, rounding=LEAK, precision=0.02)
    if where == "a room":
        silent = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
        small.assert_same_whole(moments(silent, mivol(), 32), moments(scene, mivol(), 32, first=500), precision=0.02)


@pytest.mark.slow
@pytest.mark.statistical
def test_fog_in_a_room_that_is_open_on_one_side():
    """Rectangles bound the fog, a null rectangle among them; each wall has its own BSDF, so Mitsuba does not merge walls into
    a mesh.
    """
    ref, placed = {"type": "ref", "id": "fog"}, walls(exterior={"type": "ref", "id": "fog"})
    for k, name in enumerate(placed):
        placed[name]["bsdf"] = {"type": "diffuse", "reflectance": 0.2 + 0.1 * k}
    # The second wall is the one at z = 2: the opening, whose normal shows inwards.
    placed["wall1"]["bsdf"] = {"type": "null"}
    emitter = square(0, 0.5, -1.9, 0.5, (0, 0.5, 5)) | {"emitter": {"type": "area", "radiance": 5.0}, "exterior": ref}
    sensor = scenes.camera((0.6, -0.4, 7.0), (0, 0, 0), res=16, fov=40.0)
    scene = mi.load_dict({"type": "scene", "fog": FOG, **placed, "emitter": emitter, "sensor": sensor})
    assert {s.class_name() for s in scene.shapes()} == {"Rectangle"}
    assert_same_images(scene, rounding=5 * LEAK, precision=0.02)  # of the emitter's radiance, the brightest there is


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.cases(["homogeneous", "grid"], ["grid"]))
def test_media_in_instances(kind):
    interior = medium("homogeneous", 2.0, 0.8) if kind == "homogeneous" else grid_in({})["interior"]
    same(lit(instances(interior)))


@pytest.mark.slow
@pytest.mark.statistical
def test_boundaries_that_are_moved():
    """An integrator that has rendered a scene notices that its box was moved, turned and moved back; volpath is the judge."""
    fog = box_of(medium("homogeneous", 1.0, 0.8), centred(0.5 * np.eye(3), (0, 0, 1.6)))
    scene = close_up(lit({"smoke": grid_in(cube(PLACE)), "fog": fog}))
    ours, params = mi.load_dict(mivol()), mi.traverse(scene)
    first = np.array(mi.render(scene, integrator=ours, spp=16))
    key = "smoke.vertex_positions"
    there = np.array(params[key]).reshape(-1, 3)
    for change in (lambda p: 0.6 * p + [0.2, 0, 0], lambda p: p @ rotation([0, 0, 1], 0.4).T):
        params[key] = mi.Float(change(there).astype(np.float32).ravel())
        params.update()
        assert_same_images(scene, rounding=LEAK, ours=ours)
    params[key] = mi.Float(there.ravel())
    params.update()
    # A GPU adds the samples of a pixel in no fixed order.
    rtol = 0 if mi.variant().startswith("llvm") else 1e-6
    np.testing.assert_allclose(np.array(mi.render(scene, integrator=ours, spp=16)), first, rtol=rtol)
