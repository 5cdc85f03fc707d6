"""Direct light of emitters at a wall and at a point of smoke, attenuated by fog, against formulas on paper."""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.direct_lighting import (
    DirectLight,
    DirectLighting,
    DistantEmitterSample,
    power_heuristic,
)
from mivol.transport.estimators.lighting.emitters import EventSamples
from mivol.transport.estimators.lighting.shadow_rays import trace_shadow_ray
from mivol.transport.estimators.lighting.vertex import MediumVertex, SurfaceVertex
from mivol.transport.media.body import medium_interaction
from mivol.transport.traversal.rays import point_along
from scenes import box_of, camera, centred, media_of, medium, sky

ROUNDING = 16 * 2.0**-23
POWER, FAR, DEPTH = 3.0, 4.0, 0.5
KEY = "fog.interior_medium.sigma_t.value.value"


def scene(**emitters: dict) -> mi.Scene:
    """A wall at z = 0, lit on both sides, and fog of an optical depth of DEPTH between z = 1 and 2."""
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    fog = box_of(medium("mivol_medium", DEPTH), centred(np.diag([20.0, 20, 1]), (0, 0, 1.5)))
    return mi.load_dict({"type": "scene", "wall": wall, "fog": fog, "sensor": camera([0, -1, 9], [0, 0, 0]), **emitters})


def emitter(z: float = FAR, power: float = POWER) -> dict:
    return {"type": "point", "position": [0, 0, z], "intensity": power}


def sun_of(kind: str) -> dict:
    """An emitter at infinity."""
    if kind == "directional":
        return {"type": "directional", "direction": [0.3, 0.4, -1], "irradiance": 2.0}
    picture = np.random.default_rng(1).uniform(0.1, 2, (8, 16, 3)).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture)}


def at_wall(found: mi.Scene) -> tuple[DirectLighting, SurfaceVertex]:
    media = media_of(found)
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, -1))
    si = found.ray_intersect(ray)
    return DirectLighting(media), SurfaceVertex(media, si, si.bsdf(ray), mi.MediumPtr(None))


def test_a_wall_under_a_emitter():
    """reflectance / pi I / r^2 exp(-tau); 0 in an inactive lane."""
    direct, vertex = at_wall(scene(emitter=emitter()))
    with dr.suspend_grad():
        aim = direct.sample_emitter(vertex.interaction, mi.Point2f(0.5), mi.Bool(True))
        found, off = (direct.estimate_at_vertex(vertex, aim, False, mi.Bool(on)) for on in (True, False))
    # Rays start a little above the wall: 1e-5 of a scene of 20, and the emitter is that much nearer.
    assert np.array(found.value).ravel() == pytest.approx([0.5 / np.pi * POWER / FAR**2 * np.exp(-DEPTH)] * 3, rel=1e-3)
    assert found.on[0] and not off.on[0] and not np.array(off.value).any()


def test_a_point_of_a_medium_at_the_place_of_a_lamp_has_finite_light() -> None:
    """1 / r^2 is infinite there; a path passes a lamp as close as its digits tell with a chance of some 1e-8."""
    media = media_of(scene(emitter=emitter(1.5)))
    ray = mi.Ray3f(mi.Point3f(0, 0, 3), mi.Vector3f(0, 0, -1))
    mei = medium_interaction(ray, mi.Float64(1.5))
    mei.medium = media.medium_of(mi.UInt32(0), mi.Bool(True))
    direct, vertex = DirectLighting(media), MediumVertex(media, mei, point_along(ray, mi.Float64(1.5)))
    with dr.suspend_grad():
        aim = direct.sample_emitter(vertex.interaction, mi.Point2f(0.5), mi.Bool(True))
        found = direct.estimate_at_vertex(vertex, aim, False, mi.Bool(True))
    assert float(aim.direct.dist[0]) == 0
    assert not np.array(found.value).any() and not found.on[0]


@pytest.mark.parametrize("attached", [False, True])
def test_a_dark_sample_has_no_shadow_ray_in_images(attached, monkeypatch):
    """An emitter below the wall, whose light the wall does not scatter upwards; derivatives follow all rays."""
    module, lanes = sys.modules[DirectLighting.__module__], []

    def trace(media, start, medium, aim, active, *others):
        lanes.append(bool(active[0]))
        return trace_shadow_ray(media, start, medium, aim, active, *others)

    monkeypatch.setattr(module, "trace_shadow_ray", trace)
    for z in (FAR, -FAR):
        direct, vertex = at_wall(scene(emitter=emitter(z)))
        with dr.suspend_grad():
            aim = direct.sample_emitter(vertex.interaction, mi.Point2f(0.5), mi.Bool(True))
            found = direct.estimate_at_vertex(vertex, aim, attached, mi.Bool(True))
        assert bool(np.array(found.value).any()) is (z > 0)
    assert lanes == [True, attached]


def test_a_shadow_ray_has_the_derivative_of_its_optical_depth():
    """-1 for each unit of extinction in a slab of thickness 1, times the light, besides the derivatives tracked by Dr.Jit."""
    found = scene(emitter=emitter())
    params = mi.traverse(found)
    dr.enable_grad(params[KEY])
    dr.set_grad(params[KEY], 0.25)
    direct, vertex = at_wall(found)
    direct.media.start_tangent()
    tracked = mi.Spectrum(7)
    dr.enable_grad(tracked)
    dr.set_grad(tracked, 0.5)
    with dr.suspend_grad():
        aim = direct.sample_emitter(vertex.interaction, mi.Point2f(0.5), mi.Bool(True))
        sample = direct.estimate_at_vertex(vertex, aim, False, mi.Bool(True))

    def term() -> DirectLight:
        """In a lane that receives the light, and in one that does not."""
        return DirectLight(direct.media, sample.ray_segment, 2 * tracked, mi.Bool(True, False))

    seen = term()
    assert seen.is_replayed
    np.testing.assert_array_equal(np.array(seen.value), [[14, 0]] * 3)
    with dr.suspend_grad():
        tangent = np.array(seen.jvp())
    np.testing.assert_allclose(tangent, [[2 * 0.5 - 0.25 * 14, 0]] * 3, rtol=ROUNDING)
    direct.media.start_gradients()
    dr.set_grad(tracked, 0)
    again = term()
    with dr.suspend_grad():
        again.vjp(mi.Spectrum(1, 2, 3))
    assert np.array(direct.media.bodies[0].gradients[0]).sum() == pytest.approx(-14 * (1 + 2 + 3), rel=ROUNDING)
    assert np.array(dr.grad(tracked)).ravel().tolist() == [2, 4, 6]


def at_smoke(found: mi.Scene) -> tuple[DirectLighting, MediumVertex]:
    """A point at z = 3, with the fog's isotropic phase function, above the fog."""
    media = media_of(found)
    fog = media.bodies[0].view.medium
    mei = medium_interaction(mi.Ray3f(mi.Point3f(0, 0, 9), mi.Vector3f(0, 0, -1)), mi.Float(6), fog)
    return DirectLighting(media), MediumVertex(media, mei, mi.Point3d(mei.p))


def samples() -> EventSamples:
    u, uv = mi.Float(0.75), mi.Point2f(0.25, 0.125)
    return EventSamples(mi.UInt32(5), uv, u, uv, u, uv, u)


def test_a_point_of_smoke_under_two_emitters():
    """I / (4 pi r^2) of the chosen emitter, over its probability; the fog lies below."""
    found = scene(one=emitter(4.0, 3.0), two=emitter(5.0, 7.0))
    direct, vertex = at_smoke(found)
    assert len(direct.emitters.sampled) == 2 and not direct.emitters.samples_phase
    light, probabilities = {}, {}
    for u in np.linspace(0.01, 0.99, 25):
        chosen = direct.emitters.choose_emitter(mi.Ray3f(vertex.interaction.p, mi.Vector3f(0, 0, 1)), mi.Float(u))
        with dr.suspend_grad():
            (sample,) = direct.estimate_in_medium(vertex, chosen, samples(), False, mi.Bool(True))
        number = chosen.number[0]
        probabilities[number] = chosen.distribution.probability(chosen.number)[0]
        light[number] = np.array(sample.value).ravel()[0] * probabilities[number]
    np.testing.assert_allclose(sorted(light.values()), np.array([7 / 4, 3 / 1]) / (4 * np.pi), rtol=ROUNDING)
    assert sum(probabilities.values()) == pytest.approx(1, rel=ROUNDING)


def test_a_point_of_smoke_under_a_sky():
    """Directions come from the phase function alone: the radiance of the sky, for directions not hitting the wall."""
    direct, vertex = at_smoke(scene(sky=sky(0.7)))
    assert direct.emitters.samples_phase and not direct.emitters.sampled
    chosen = direct.emitters.choose_emitter(mi.Ray3f(vertex.interaction.p, mi.Vector3f(0, 0, 1)), mi.Float(0.5))
    upward = samples()
    with dr.suspend_grad():
        (sample,) = direct.estimate_in_medium(vertex, chosen, upward, False, mi.Bool(True))
    passed = np.exp(-DEPTH / abs(sample.ray_segment.ray.d.z[0])) if sample.ray_segment.ray.d.z[0] < 0 else 1.0
    np.testing.assert_allclose(np.array(sample.value).ravel(), [0.7 * passed] * 3, rtol=ROUNDING)


@pytest.mark.parametrize("kind", ["envmap", "directional"])
def test_a_sample_at_infinity_is_the_same_from_everywhere(kind):
    """Direction, density and light of a sample drawn far outside equal the values drawn at a point inside; the sample ends
    outside."""
    media = media_of(scene(emitter=sun_of(kind)))
    far, near = dr.zeros(mi.Interaction3f, 64), dr.zeros(mi.Interaction3f, 64)
    far.p, near.p = mi.Point3f(300, -200, 100), mi.Point3f(0.1, 0.2, 0.3)
    u, on = mi.Point2f(np.random.default_rng(0).uniform(size=(2, 64)).astype(np.float32)), dr.full(mi.Bool, True, 64)
    direct = DirectLighting(media)
    moved, drawn = (
        DistantEmitterSample.from_sample(direct.sample_emitter(far, u, on)).at_point(near),
        direct.sample_emitter(near, u, on),
    )
    for name in ("d", "pdf", "delta", "uv"):
        np.testing.assert_array_equal(np.array(getattr(moved.direct, name)), np.array(getattr(drawn.direct, name)))
    np.testing.assert_array_equal(np.array(moved.weight), np.array(drawn.weight))
    assert dr.all(mi.Bool(moved.has_alternative) == mi.Bool(drawn.has_alternative))
    ahead = np.array(moved.direct.p - near.p) / np.array(moved.direct.dist)
    np.testing.assert_allclose(ahead, np.array(drawn.direct.d), rtol=0, atol=4 * ROUNDING)
    box = media.scene.bbox()
    assert np.all(np.linalg.norm(np.array(moved.direct.p - box.center()), axis=0) > np.linalg.norm(box.extents()) / 2)


def test_weights_of_two_techniques_sum_to_1():
    """Densities of 1e-30 to 1e30, with squares beyond float32; each weight has four roundings."""
    a, b = 10 ** np.random.default_rng(1).uniform(-30, 30, (2, 1000)).astype(np.float32)
    total = np.array(power_heuristic(mi.Float(a), mi.Float(b))) + np.array(power_heuristic(mi.Float(b), mi.Float(a)))
    np.testing.assert_allclose(total, 1, atol=8 * 2.0**-24)


def test_values():
    """(a / b)^2 / (1 + (a / b)^2); 0 for a density of 0, and 1 if the other density is 0."""
    found = np.array(power_heuristic(mi.Float(3, 0, 0, 2), mi.Float(1, 1, 0, 0)))
    np.testing.assert_allclose(found, [0.9, 0, 0, 1], rtol=4 * 2.0**-24)
