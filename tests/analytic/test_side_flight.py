r"""Side flights from the middle of a ball of fog under a sun, against quadrature.

Everything depends on the cosine c of the angle to the sun: with the densities p of the phase function and q of the lobe, and
the length s(t, c) of the shadow ray from the distance t,

.. math:: L = \alpha^2 E\, 2\pi \int_{-1}^1 \frac{q}{m + q}\, p\, p \int_0^R \sigma e^{-\sigma (t + s)}\,dt\,dc

The path itself draws its directions with the density m: p mixed with a wider lobe about the sun.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, difference, fresh, over_pixels
from oracle_phase import gauss, hg
from scattering_scenes import close_up, mivol, rough_grid, smoke

from mivol.scene import plan
from mivol.scene.needs import find_needs
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.flights.free_flight import FreeFlight
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting, DistantEmitterSample
from mivol.transport.estimators.scores import IMAGE
from mivol.transport.estimators.segment import Collision
from mivol.transport.media.body import medium_interaction
from mivol.transport.path import side_flight
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.side_flight import (
    AIMED_SHARE,
    SideFlightSamples,
    aim_at_emitter,
    estimate_side_flight,
    weigh_emitter_sample,
)
from mivol.transport.traversal.random_numbers import draw_state
from mivol.validate.statistics import Moments
from scenes import ball_of, camera, media_of, medium

N, G, LOBE, SIGMA, ALBEDO, SUN = 1 << 16, 0.6, 0.8, 0.7, 0.9, 2.0


def middle() -> tuple[Estimators, Collision]:
    """Collisions in the middle of a ball of radius 1, of rays travelling towards the sun."""
    fog = medium("homogeneous", SIGMA, ALBEDO, phase={"type": "hg", "g": G})
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": SUN}
    scene = mi.load_dict({"type": "scene", "fog": ball_of(fog, (0, 0, 0), 1.0), "sun": sun,
                          "sensor": camera([0, -1, 4], [0, 0, 0])})  # fmt: skip
    media = media_of(scene)
    estimators = Estimators(DirectLighting(media), FreeFlight(media), Settings(), False, True, mi.Float(LOBE))
    o = mi.Point3f(dr.zeros(mi.Float, N), 0, -0.5)
    ray = mi.Ray3f(o, mi.Vector3f(0, 0, 1), dr.inf, dr.zeros(mi.Float, N), mi.Color0f())
    mei = medium_interaction(ray, mi.Float(0.5), media.scene.shapes()[0].interior_medium())
    on, body = dr.full(mi.Bool, True, N), dr.zeros(mi.UInt32, N)
    hit = Collision(mei, mi.Point3d(mei.p), mi.Spectrum(ALBEDO), on, mi.Float64(0.5), body)
    return estimators, hit


def of_cosine(c: np.ndarray, g: float) -> np.ndarray:
    return hg(1 - c, 1 + c, g)


@pytest.mark.statistical
def test_light_at_the_end_of_a_side_flight(monkeypatch):
    monkeypatch.setattr(side_flight, "AIMED_SHARE", 0.8)  # a larger share, to be seen in the mean
    estimators, hit = middle()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(fresh(1), N)
    samples = SideFlightSamples(sampler.next_2d(), (sampler.next_1d(), draw_state(sampler)), None)
    with dr.suspend_grad():
        aim = DistantEmitterSample.from_sample(estimators.direct.sample_emitter(hit.mei, mi.Point2f(0.5), hit.on))
        beta, on = mi.Spectrum(0.5, 1, 1), dr.arange(mi.UInt32, N) > 0
        aimed = aim_at_emitter(estimators, aim, beta, mi.Float(0), on)
        found = estimate_side_flight(estimators, hit, beta, mi.UInt32(0), aim, aimed, samples, IMAGE, on)
    value = np.array(found.light.value, np.float64)
    (c, wc), (t, wt) = gauss(64), gauss(64)
    t, wt = 0.5 * (t + 1), 0.5 * wt
    s = -t * c[:, None] + np.sqrt(1 - t**2 * (1 - c[:, None] ** 2))
    inner = (SIGMA * np.exp(-SIGMA * (t + s))) @ wt
    p, q = of_cosine(c, G), of_cosine(c, LOBE)
    mixed = 0.2 * p + 0.8 * of_cosine(c, LOBE**2)
    exact = ALBEDO**2 * SUN * 2 * np.pi * np.sum(wc * q / (mixed + q) * p * p * inner)
    # The ball is traced: its surface is known to 1e-5, and one lane of all is off.
    assert_same_mean(
        Moments.from_values(value.T), exact * np.array([0.5, 1, 1]), rounding=(1e-5 + 1 / N) * exact, what="the light"
    )
    assert not value[:, 0].any()


def test_the_next_vertex_counts_by_the_balance_heuristic():
    """The weight is p / (p + q) in lanes with a side flight, 1 in others; the next vertex takes the emitter sample."""
    estimators, hit = middle()
    c = np.linspace(-1, 1, N)
    wo = mi.Vector3f(mi.Float(np.sqrt(1 - c**2)), 0, mi.Float(c))
    sample = DistantEmitterSample.from_sample(estimators.direct.sample_emitter(hit.mei, mi.Point2f(0.5), hit.on))
    aim = weigh_emitter_sample(estimators, sample, wo, mi.Float(of_cosine(c, G)), dr.arange(mi.UInt32, N) > 9)
    expected = of_cosine(c, G) / (of_cosine(c, G) + of_cosine(c, LOBE))
    # The cosine is rounded to 2^-24 twice, and the relative slope of HG by it is 3 g / (1 - g)^2 = 60 at most.
    np.testing.assert_allclose(np.array(aim.weight)[10:], expected[10:], rtol=60 * 2.0**-23)
    assert np.all(np.array(aim.weight)[:10] == 1) and aim.sample is sample


@pytest.mark.parametrize(
    ("beta", "even", "share"), [(0.5, 0, AIMED_SHARE), (1.0, 0, AIMED_SHARE), (1.0, 0.75, AIMED_SHARE / 4), (1.01, 0, 0.0)]
)
def test_directions_are_aimed_while_the_throughput_is_low(beta, even, share):
    """A share of the directions lies in a lobe about the sun, less beside an even sky; a path whose throughput has grown draws
    none."""
    estimators, hit = middle()
    estimators = replace(estimators, even_share=mi.Float(even))
    sample = DistantEmitterSample.from_sample(estimators.direct.sample_emitter(hit.mei, mi.Point2f(0.5), hit.on))
    u = (np.arange(N) + 0.5) / N
    aimed = aim_at_emitter(estimators, sample, mi.Spectrum(0.1, beta, 0.2), mi.Float(u), dr.arange(mi.UInt32, N) > 9)
    np.testing.assert_array_equal(np.array(aimed.is_drawn)[10:], u[10:] < np.float32(share))
    assert not np.array(aimed.is_drawn)[:10].any()
    d = aimed.draw(mi.Point2f(mi.Float(u), 0.3))
    c = np.array(d.z, np.float64)
    # The share of directions with a cosine below c is u. Its slope by c is at most (1 - g^2) / (2 (1 - g)^3) < 7, and c
    # has some roundings of 2^-24.
    g = LOBE**2
    below = (1 - g * g) / (2 * g) * (1 / np.sqrt(1 + g * g - 2 * g * c) - 1 / (1 + g))
    np.testing.assert_allclose(below, u, atol=7 * 8 * 2.0**-24)
    p = of_cosine(c, G)
    mixed = np.array(aimed.mix(mi.Float(p), d), np.float64)
    np.testing.assert_allclose(mixed[10:], ((1 - share) * p + share * of_cosine(c, LOBE**2))[10:], rtol=1e-4)


@pytest.mark.parametrize("sky", [0.0, 0.6])
def test_an_even_sky_has_its_share_of_the_light(sky):
    """4 pi times its radiance, beside the irradiance of the sun; means of the colours."""
    even = {"sky": {"type": "constant", "radiance": sky}} if sky else {}
    scene = close_up({"smoke": smoke(rough_grid(7), 0.9, name="hg", g=0.8)[0], "sun": small.sun([0.3, 0.2, -1.0])[0], **even})
    irradiance = np.mean(np.array(mi.traverse(scene)["sun.irradiance.value"], np.float64))
    survey, settings = survey_scene(scene), Settings(max_depth=3)
    needs = find_needs(scene, scene.sensors()[0], survey)
    made = plan.build_estimators(scene, needs, plan.make_plan(needs, settings), settings, survey, True)
    light = 4 * np.pi * sky
    # Some ten roundings of sums and squares of float32.
    assert float(made.even_share[0]) == pytest.approx(light / (light + irradiance), rel=16 * 2.0**-24)


# -- Images ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow_for("sun")
@pytest.mark.statistical
@pytest.mark.parametrize("lit", small.cases(["sun", "sky", "even sky"], slow=("sky", "even sky")))
def test_side_flights_keep_the_mean(lit, monkeypatch):
    """The same mean with and without side flights."""
    image = mi.Bitmap(np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 4)
    sun, sky = small.sun([0.3, 0.2, -1.0])[0], {"type": "envmap", "bitmap": image}
    far = {"sun": [sun], "sky": [sky], "even sky": [sun, {"type": "constant", "radiance": 0.2}]}[lit]
    emitters = {f"far_{k}": emitter for k, emitter in enumerate(far)}
    scene = close_up({"smoke": smoke(rough_grid(7, 6.0), 0.9, name="hg", g=0.8)[0], **emitters}, res=8)
    with_them = over_pixels(small.moments(scene, mivol(max_depth=5), 256))
    monkeypatch.setattr(plan, "choose_side_flights", lambda *_: (None, []))
    without = over_pixels(small.moments(scene, mivol(max_depth=5), 256, first=500))
    assert_same_mean(with_them, without, rounding=1e-6, what="radiance")
    assert_precise(difference(with_them, without), 0.03 * without.mean, what="radiance")


@pytest.mark.parametrize(
    ("g", "emitter", "depth", "flies"),
    [(0.8, "sun", 3, True), (0.8, "sun", 2, False), (0.3, "sun", 3, False), (0.8, "point", 3, False)],
)
def test_a_plan_takes_them_where_they_pay(g, emitter, depth, flies):
    """The plan needs peaked phase functions, two scattering events, and emitters at infinity."""
    shine = small.sun([0.3, 0.2, -1.0])[0] if emitter == "sun" else small.point([1.5, 1, 2.0])[0]
    scene = close_up({"smoke": smoke(rough_grid(7), 0.9, name="hg", g=g)[0], "emitter": shine}, res=2)
    made = plan.make_plan(find_needs(scene, scene.sensors()[0], survey_scene(scene)), Settings(max_depth=depth))
    assert (made.side_flight_cosine is not None) == flies
    if flies:
        # Means of 4096 samples: 1 / 64 of the spread of the cosine, which is below 1.
        assert made.side_flight_cosine == pytest.approx(g, abs=0.02)


@pytest.mark.statistical
def test_a_medium_without_an_end_has_no_side_flights():
    """Light of a sun crosses twice the radius of the scene in Mitsuba, as seen from each point; a side flight would see it from
    the point before. (With side flights the image is a third brighter.)"""
    fog = {**medium("homogeneous", 0.25, 0.9, phase={"type": "hg", "g": 0.6}), "id": "fog"}
    sun = {"type": "directional", "direction": [1, 0.3, -0.7], "irradiance": SUN}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)}
    sensor = {**camera([0, -1.8, 1], [0, 1, 0.6], res=16, fov=70), "fog": {"type": "ref", "id": "fog"}}
    scene = mi.load_dict({"type": "scene", "fog": fog, "sun": sun, "floor": floor, "sensor": sensor})
    small.assert_same_images(scene, spp=(64, 128), ours=mivol(max_depth=3), stock=small.volpath(max_depth=3))
