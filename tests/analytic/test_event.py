"""The end of a segment (collision, surface or escape), and the direction in which the path continues."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, fresh

from mivol.transport.estimators.flights.free_flight import FreeFlight
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.vertex import MediumVertex, MixedVertex
from mivol.transport.estimators.segment import Collision, SegmentEstimate
from mivol.transport.estimators.single_scattering.near_light import AimedDirections
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.ray_intervals import SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.event import DirectionSamples, NextDirection, PathEvent, sample_next_direction
from mivol.transport.traversal.rays import point_along
from mivol.validate.statistics import Moments
from scenes import box_of, camera, centred, media_of, medium

WALL = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def segments(**shapes: dict) -> tuple[SceneMedia, mi.Ray3f, SegmentEnd]:
    """Three segments: towards the wall, beside the wall, and towards the wall in an inactive lane."""
    media = media_of(mi.load_dict({"type": "scene", "sensor": camera([0, -1, 4], [0, 0, 0]), **shapes}))
    ray = mi.Ray3f(mi.Point3f(mi.Float(0, 5, 0), 0, 2), mi.Vector3f(0, 0, -1), dr.inf, mi.Float(0, 0, 0), mi.Color0f())
    si, fog = media.scene.ray_intersect(ray), mi.MediumPtr(mi.load_dict({"type": "homogeneous"}))
    return media, ray, SegmentEnd(si, si.t, fog, 1.0)


def test_active_lanes_hit_the_surface():
    media, _, end = segments(wall=WALL)
    found = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None), mi.Bool(True, True, False))
    assert np.array(found.at_surface).tolist() == [True, False, False]
    assert not np.array(found.in_medium).any()
    # The distance is a float32 number of the tracer: one rounding.
    np.testing.assert_allclose(np.array(found.t), [2, np.inf, 2], rtol=np.finfo(np.float32).eps)
    vertex = found.vertex(media)
    assert vertex.medium is end.medium and vertex.interaction is end.si and vertex.media is media
    assert np.array(vertex.bsdf == mi.BSDFPtr(media.scene.shapes()[0].bsdf())).tolist() == [True, False, True]


def test_a_collision_comes_before_the_surface():
    """The first lane collides at 0.5; the others continue. The vertex belongs to the medium in the first lane only."""
    media, ray, end = segments(wall=WALL)
    t, on = mi.Float(0.5), mi.Bool(True, False, False)
    mei, place = medium_interaction(ray, t, end.medium), point_along(ray, t)
    hit = Collision(mei, place, mi.Spectrum(0.5), on, mi.Float64(t), mi.UInt32(0))
    found = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None, hit), mi.Bool(True, True, True))
    assert np.array(found.at_surface).tolist() == [False, False, True]
    assert np.array(found.in_medium).tolist() == [True, False, False]
    vertex = found.vertex(media)
    assert isinstance(vertex, MixedVertex)
    # The wall is met at z = 0, and the collision is 0.5 in front of the rays' origins.
    assert np.array(vertex.interaction.p.z).tolist()[::2] == [1.5, 0]


def test_without_surfaces_a_collision_has_a_medium_vertex():
    media, ray, end = segments(cloud=box_of(medium("homogeneous", 1.0, 0.5), np.eye(4)))
    mei, place = medium_interaction(ray, mi.Float(0.5), end.medium), point_along(ray, 0.5)
    hit = Collision(mei, place, mi.Spectrum(0.5), True, mi.Float64(0.5), mi.UInt32(0))
    vertex = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None, hit), mi.Bool(True)).vertex(media)
    assert isinstance(vertex, MediumVertex) and vertex.interaction is hit.mei


DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
MASK = {"type": "mask", "opacity": 0.25, "nested": DIFFUSE}
ROUNDING = 8 * 2.0**-23
G, ALBEDO = 0.5, 0.75
ENDLESS = 1e30
"""Length [length] of rays without an end, at least: Mitsuba's are as long as the largest float32."""


class FallingRays:
    """Rays falling from z = 2 on a rectangle in the plane z = 0, with ends 5 behind the rectangle."""

    def __init__(self, bsdf: dict, lights_media: bool = True) -> None:
        far = box_of(medium("homogeneous", 0.5, phase={"type": "hg", "g": G}), centred(np.eye(3), (0, 0, 50)))
        parts = {"wall": {"type": "rectangle", "bsdf": bsdf}, "far": far, "sensor": camera([0, -1, 4], [0, 0, 0])}
        media = media_of(mi.load_dict({"type": "scene", **parts}))
        self.fog = media.bodies[0].view.medium
        self.estimators = Estimators(DirectLighting(media), FreeFlight(media), Settings(), True, lights_media)
        zero = dr.zeros(mi.Float, 4)
        self.ray = mi.Ray3f(mi.Point3f(zero, 0, 2), mi.Vector3f(0, 0, -1), mi.Float(7), zero, mi.Color0f())

    def turn_many(self, u: np.ndarray, aimed: AimedDirections | None, in_medium: bool) -> NextDirection:
        """Directions of one lane for each column of three uniform random numbers, all of them colliding or none."""
        n = u.shape[1]
        ray = dr.gather(mi.Ray3f, self.ray, dr.zeros(mi.UInt32, n))
        mei, on = medium_interaction(ray, mi.Float(0.5), self.fog), dr.full(mi.Bool, in_medium, n)
        hit = Collision(mei, mi.Point3d(mei.p), mi.Spectrum(ALBEDO), on, mi.Float64(0.5), mi.UInt32(0))
        si = self.estimators.media.scene.ray_intersect(ray)
        event, numbers = PathEvent(si, si.t, mi.MediumPtr(self.fog), ~on, hit), [mi.Float(row) for row in u]
        with dr.suspend_grad():
            return sample_next_direction(
                self.estimators, ray, event, DirectionSamples(numbers[0], mi.Point2f(*numbers[1:]), aimed), mi.Bool(True)
            )

    def turn(self, in_medium: list[bool] | None, may_scatter: list[bool], component: list[float]) -> NextDirection:
        """Directions of four lanes; lanes ``in_medium`` have collided at the distance 0.5."""
        ray, si = self.ray, self.estimators.media.scene.ray_intersect(self.ray)
        on = mi.Bool([False] * 4 if in_medium is None else in_medium)
        mei, t = medium_interaction(ray, mi.Float(0.5), self.fog), mi.Float64(0.5)
        hit = None if in_medium is None else Collision(mei, mi.Point3d(mei.p), mi.Spectrum(ALBEDO), on, t, mi.UInt32(0))
        around = dr.select(dr.full(mi.Bool, True, 4), mi.MediumPtr(self.fog), None)
        event = PathEvent(si, si.t, around, ~on & si.is_valid(), hit)
        with dr.suspend_grad():
            return sample_next_direction(
                self.estimators, ray, event, DirectionSamples(mi.Float(component), mi.Point2f(0.3, 0.6)), mi.Bool(may_scatter)
            )


def test_a_diffuse_wall_scatters_paths_that_may_scatter():
    """The weight is the reflectance, and the density the cosine over pi; the new ray leaves the wall into the medium in front
    of it."""
    bench = FallingRays(DIFFUSE)
    turn = bench.turn(None, [True, True, False, True], [0.5] * 4)
    assert np.array(turn.on).tolist() == [True, True, False, True] and not np.array(turn.through).any()
    np.testing.assert_allclose(np.array(turn.weight)[:, 0], 0.5, rtol=ROUNDING)
    cosine = np.array(turn.ray.d.z)
    np.testing.assert_allclose(np.array(turn.pdf), cosine / np.pi, rtol=ROUNDING)
    assert np.all(cosine > 0) and not np.array(turn.delta).any() and np.all(np.array(turn.eta) == 1)
    assert np.all(np.array(turn.medium == mi.MediumPtr(bench.fog))) and np.all(np.array(turn.ray.maxt) > ENDLESS)
    assert np.all(np.array(turn.origin.p.z) == 0) and len(turn.factors) == 1


def test_a_mask_transmits_rays_without_deviation_at_any_depth():
    """Random numbers above the opacity pass; the ray keeps its direction and the rest of its length, also if it may not
    scatter."""
    turn = FallingRays(MASK).turn(None, [True, True, False, False], [0.9, 0.1, 0.9, 0.1])
    assert np.array(turn.through).tolist() == [True, False, True, False]
    assert np.array(turn.on).tolist() == [True, True, True, False]
    np.testing.assert_allclose(np.array(turn.ray.d)[:, [0, 2]], [[0, 0], [0, 0], [-1, -1]], atol=ROUNDING)
    length = np.array(turn.ray.maxt)
    assert length[::2].tolist() == [5, 5] and np.all(length[1::2] > ENDLESS)


@pytest.mark.parametrize("lights_media", [True, False])
def test_a_medium_scatters_paths_by_its_phase_function(lights_media):
    """The weight is the albedo; emitter samples find light from this direction too, unless all emitters are uniform."""
    bench = FallingRays(DIFFUSE, lights_media)
    turn = bench.turn([True] * 4, [True, True, False, True], [0.5] * 4)
    assert np.array(turn.on).tolist() == [True, True, False, True] and not np.array(turn.through).any()
    on, cosine = np.array(turn.on), -np.array(turn.ray.d.z)
    # Henyey-Greenstein sampled by the inverse of its distribution: the roundings of the cosine are those of the number.
    expected = (1 - G**2) / (1 + G**2 - 2 * G * cosine) ** 1.5 / (4 * np.pi)
    np.testing.assert_allclose(np.array(turn.pdf)[on], expected[on], rtol=1e-5)
    np.testing.assert_allclose(np.array(turn.weight)[:, on], ALBEDO, rtol=1e-5)
    assert np.all(np.array(turn.delta) != lights_media)
    assert np.all(np.array(turn.medium == mi.MediumPtr(bench.fog))[on]) and np.all(np.array(turn.ray.maxt) > ENDLESS)
    np.testing.assert_array_equal(np.array(turn.origin.p.z), 1.5)


def test_lanes_in_media_and_at_surfaces_scatter_together():
    """Each lane continues as it would alone, and the factors of both kinds are reported."""
    bench, numbers, may = FallingRays(DIFFUSE), [0.5] * 4, [True] * 4
    both = bench.turn([True, False, True, False], may, numbers)
    inside, outside = bench.turn([True] * 4, may, numbers), bench.turn(None, may, numbers)
    for lane, alone in enumerate((inside, outside, inside, outside)):
        for found, expected in ((both.ray.d, alone.ray.d), (both.weight, alone.weight), (both.origin.p, alone.origin.p)):
            np.testing.assert_array_equal(np.array(found)[:, lane], np.array(expected)[:, lane])
        assert np.array(both.pdf)[lane] == np.array(alone.pdf)[lane]
    assert len(both.factors) == 2 and np.array(both.on).all()


# -- Directions around a near emitter ------------------------------------------------------------------------------------


AXES = [0.3, -0.5, 0.8], [1.0, 0.2, 0.1], [-0.4, 0.6, 0.0]


def aimed_at(axes: Sequence[list[float]], shares: Sequence[float], u: np.ndarray) -> AimedDirections:
    """Directions around some axes, each drawn in the lanes in which ``u`` is in its share."""
    n = len(u)
    towards = [dr.normalize(mi.Vector3f(*axis)) + dr.zeros(mi.Float, n) for axis in axes]
    return AimedDirections(towards, [dr.full(mi.Float, share, n) for share in shares], mi.Float(u))


def test_aimed_directions_have_their_density():
    """The angle theta has the distribution 1 - (1 - theta / pi)^2; sin(theta) q(theta) 2 pi is its derivative."""
    u = np.linspace(0.05, 0.95, 91)
    aimed = aimed_at(AXES[:1], [0.4], u)
    d = aimed.draw(mi.Point2f(mi.Float(u), mi.Float(np.roll(u, 7))))
    theta, density = np.arccos(np.clip(np.array(dr.dot(d, aimed.axes[0]), np.float64), -1, 1)), aimed.pdf(aimed.axes[0], d)
    # Four roundings of a cosine of at most 1 move an angle of at least 0.079 by 4 x 2^-24 / 0.079 = 3e-6.
    np.testing.assert_allclose(theta, np.pi * (1 - np.sqrt(1 - u)), atol=1e-5)
    np.testing.assert_allclose(2 * np.pi * np.sin(theta) * np.array(density), 2 * (np.pi - theta) / np.pi**2, rtol=1e-3)
    mixed = np.array(aimed.mix(mi.Float(2.0), d))
    np.testing.assert_allclose(mixed, 0.6 * 2.0 + 0.4 * np.array(density), rtol=ROUNDING)


def test_each_emitter_has_its_share_of_the_directions():
    """Shares of 0.2, 0.1 and 0.15: a number picks an axis, and the density of a direction counts all of them."""
    u = np.linspace(0, 0.999, 200)
    aimed = aimed_at(AXES, [0.2, 0.1, 0.15], u)
    d = aimed.draw(mi.Point2f(dr.full(mi.Float, 1e-4, 200), 0.3))
    # Directions at an angle of 1.6e-4 from their axis; the axes are more than 0.5 apart.
    nearest = np.argmax([np.array(dr.dot(d, axis)) for axis in aimed.axes], axis=0)
    np.testing.assert_array_equal(nearest[u < 0.45], np.searchsorted([0.2, 0.3], u[u < 0.45], side="right"))
    np.testing.assert_array_equal(np.array(aimed.is_drawn), u < 0.45)
    own = sum(share * np.array(aimed.pdf(axis, d)) for axis, share in zip(aimed.axes, (0.2, 0.1, 0.15), strict=True))
    np.testing.assert_allclose(np.array(aimed.mix(mi.Float(2.0), d)), 0.55 * 2.0 + own, rtol=2 * ROUNDING)


def test_no_sample_of_an_aimed_direction_finds_much_light():
    """The light along a ray is in proportion to (pi - theta) / sin(theta), and its weight is at most f / (share q)."""
    theta = np.concatenate([np.geomspace(2e-6, 1, 100), np.linspace(1, np.pi - 1e-3, 100)])
    d = mi.Vector3f(mi.Float(np.sin(theta)), 0, mi.Float(np.cos(theta)))
    mixed = np.array(aimed_at([[0, 0, 1]], [0.4], theta).mix(mi.Float(1 / (4 * np.pi)), d), np.float64)
    assert ((np.pi - theta) / np.sin(theta) / mixed).max() < np.pi**3 / 0.4 * 1.001


SURFACES = {
    "diffuse": DIFFUSE,
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.5},
    "rough conductor": {"type": "roughconductor", "alpha": 0.5},
    "blend": {"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": {"type": "conductor"}},
}


@pytest.mark.statistical
@pytest.mark.parametrize("name", [*SURFACES, "medium"])
def test_aimed_directions_keep_the_reflected_light(name):
    """The mean of weight x (1 + d_x + d_z) is an integral over all directions of the BSDF or phase function."""
    bench, rng = FallingRays(SURFACES.get(name, DIFFUSE)), np.random.default_rng(fresh(3))
    found = []
    for shares in ([0.0, 0.0, 0.0], [0.2, 0.1, 0.1]):
        u = rng.random((4, 1 << 16))
        turn = bench.turn_many(u[:3], aimed_at(AXES, shares, u[3]), name == "medium")
        light = np.array(turn.weight, np.float64)[1] * (1 + np.array(turn.ray.d.x) + np.array(turn.ray.d.z))
        found.append(Moments.from_values(light[:, None]))
    assert_same_mean(*found, rounding=1e-5)
    assert_precise(found[0], 0.01)


@pytest.mark.parametrize(
    "bsdf", [MASK, {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.3}, {"type": "conductor"}]
)
def test_surfaces_that_transmit_or_mirror_draw_their_own_directions(bsdf):
    """Where a path transmits, it has another index of refraction; a mirror has one direction only."""
    bench, u = FallingRays(bsdf), np.random.default_rng(1).random((4, 64))
    alone, beside = (bench.turn_many(u[:3], aimed, False) for aimed in (None, aimed_at([[0, 0, 1]], [0.4], u[3])))
    for a, b in ((alone.ray.d, beside.ray.d), (alone.weight, beside.weight), (alone.pdf, beside.pdf), (alone.eta, beside.eta)):
        np.testing.assert_array_equal(np.array(a), np.array(b))
