"""Media along a ray: boundaries of all shapes, moved boundaries, instances, and media without an end."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_rate, fresh
from scattering_scenes import PLACE, assert_same_images, close_up, mivol, moments, point
from volpath_scenes import FOG, LEAK, RED, cube, floor, grid_in, lit, same, square, turn

import scenes
from mivol.transport.estimators.flights.free_flight import FreeFlight
from mivol.transport.estimators.scores import IMAGE
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.media.optical_depth import (
    integrate_optical_depth,
    jvp_optical_depth,
    segment_optical_depth,
    vjp_optical_depth,
)
from mivol.transport.media.ray_intervals import RaySegment, draw_uniform_point
from mivol.transport.traversal.random_numbers import seed_pcg32
from scenes import ball_of, box_of, centred, media_of, medium, rotation

pytestmark = pytest.mark.usefixtures("traced_balls")


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


# -- Homogeneous media are traced once ---------------------------------------------------------------------------------------

SIGMA = {"balls": 0.5, "box": 2.0}
CHORD = 2 * np.sqrt(0.5**2 - 0.3**2)
"""Length in a ball of radius 0.5 of a ray that passes 0.3 from its centre."""


def row_of_fogs(**more: dict) -> mi.Scene:
    """Balls and a box in a row along x; the ray of these tests passes 0.3 beside their centres."""
    fog, ref = medium("homogeneous", SIGMA["balls"], 0.8), {"type": "ref", "id": "fog"}
    box = box_of(medium("homogeneous", SIGMA["box"], 0.8), centred(np.eye(3), (3, 0, 0)))
    balls = {"a": ball_of(ref, (-1, 0, 0), 0.5), "b": ball_of(ref, (1, 0, 0), 0.5)}
    return close_up({"fog": fog, **balls, "box": box, "bulb": point([0, 0, 5])[0], **more}, res=1)


def along_the_row(n: int) -> mi.Ray3f:
    return mi.Ray3f(dr.full(mi.Point3f, 0, n) + mi.Point3f(-3, 0.3, 0), mi.Vector3f(1, 0, 0))


def test_optical_depths_of_homogeneous_media_follow_from_one_trace() -> None:
    """The lengths in media give depth and gradient of a ray whose boundaries are not traced again."""
    scene, on = row_of_fogs(), mi.Bool([True])
    media = media_of(scene)
    ray, nowhere = along_the_row(1), dr.zeros(mi.MediumPtr, 1)
    end, tau, passages = integrate_optical_depth(media, ray, nowhere, on)
    np.testing.assert_allclose(np.array(passages), [[2 * CHORD]], rtol=1e-5)
    truth = SIGMA["balls"] * 2 * CHORD + SIGMA["box"] * 1
    np.testing.assert_allclose(np.array(tau[0]), [truth], rtol=1e-5)
    segment, media.scene = RaySegment(ray, nowhere, end.t, passages=passages), None
    np.testing.assert_allclose(np.array(segment_optical_depth(media, segment, on)[0]), [truth], rtol=1e-5)
    media.start_gradients()
    vjp_optical_depth(media, segment, dr.full(mi.Spectrum, 1, 1), on)
    box, balls = (float(np.array(body.gradients[0]).sum()) for body in media.bodies)
    np.testing.assert_allclose([balls, box], [3 * 2 * CHORD, 3 * 1], rtol=1e-5)


def test_derivatives_by_the_medium_of_a_box_trace_no_boundary() -> None:
    """Only the box is differentiated: the boundaries of the balls are not traced again, along the ray or for a point of it."""
    media, on = media_of(row_of_fogs()), mi.Bool([True])
    segment = RaySegment(along_the_row(1), dr.zeros(mi.MediumPtr, 1), mi.Float(7))
    media.scene = media.tracer = None
    box, balls = media.bodies
    balls.follows = [False]
    media.start_gradients()
    vjp_optical_depth(media, segment, dr.full(mi.Spectrum, 1, 1), on)
    assert [float(np.array(body.gradients[0]).sum()) for body in (box, balls)] == pytest.approx([3, 0], rel=1e-5)
    box.has_tangent, box.tangents, balls.has_tangent, balls.tangents = [True], [mi.Float(4)], [False], [None]
    np.testing.assert_allclose(np.array(jvp_optical_depth(media, segment, on)), 4, rtol=1e-5)
    point = draw_uniform_point(media, segment, [box], mi.Float(0.25), on)
    assert [float(point.t[0]), float(point.length[0])] == pytest.approx([5.75, 1], rel=1e-5)


@pytest.mark.statistical
@pytest.mark.parametrize("wall", [None, 0.0, 2.2, 4.0])
def test_flights_end_at_the_first_collision_or_surface(wall: float | None) -> None:
    """Flights through balls and box, with a wall in front of some, among them or behind them: distances on paper."""
    place = turn().translate([wall or 0, 0, 0]).rotate([0, 1, 0], 90).scale(2)
    more = {} if wall is None else {"wall": {"type": "rectangle", "to_world": place, "bsdf": RED}}
    media, n = media_of(row_of_fogs(**more)), 1 << 12
    ray, on, seed = along_the_row(n), dr.full(mi.Bool, True, n), mi.Float((0.2 + 0.618 * fresh(0)) % 1)
    # The flight in the box is given: half of the light is left after log(2) / 2.
    samples, nowhere = (dr.full(mi.Float, 0.5, n), seed_pcg32(seed, n)), dr.zeros(mi.MediumPtr, n)
    segment = PathSegment(ray, nowhere, dr.full(mi.Spectrum, 1, n), on, samples, dr.zeros(mi.UInt32, n))
    found = FreeFlight(media).estimate(segment, IMAGE, on)
    hit, t = np.array(found.collision.on), np.array(found.collision.t)
    in_balls = [hit & (np.abs(t - middle) < CHORD / 2 + 1e-5) for middle in (2, 4)]
    in_box = hit & (np.abs(t - (5.5 + np.log(2) / SIGMA["box"])) < 1e-5)
    assert np.all(hit == in_balls[0] | in_balls[1] | in_box)
    survives = np.exp(-SIGMA["balls"] * CHORD)
    assert_rate(int(in_balls[0].sum()), n, 1 - survives)
    assert_rate(int(in_balls[1].sum()), n, 0 if wall == 0 else survives * (1 - survives))
    assert_rate(int(in_box.sum()), n, 0 if wall in (0, 2.2) else survives**2)
    passed = found.transmittance.shared.passed
    chords = sum(np.clip(np.array(passed.length) - (middle - CHORD / 2), 0, CHORD) for middle in (2, 4))
    np.testing.assert_allclose(np.array(passed.passages[0]), chords, atol=1e-5)
    if wall in (0, 2.2):
        assert np.all(np.array(found.end.si.is_valid())[~hit])
        np.testing.assert_allclose(np.array(found.end.t)[~hit], 3 + wall, rtol=1e-5)
