"""The phase functions of the media of a scene, beside Mitsuba's own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.body import medium_interaction
from mivol.transport.media.scene_media import SceneMedia
from scenes import box_of, camera, centred, media_of, medium, refused, sky

LOBES = {
    "even": {"type": "isotropic"},
    "forward": {"type": "hg", "g": 0.5},
    "back": {"type": "hg", "g": -0.3},
    "air": {"type": "rayleigh"},
}
N = 1000
ERROR = 2e-6
"""Relative error of both Henyey-Greenstein densities: 6e-7 of ours, and 1e-6 of Mitsuba's at g = 0.5, whose sum
1 + g^2 + 2 g cos has a rounding error of 1.2e-7 beside a smallest value of 0.25, to the power 3/2."""


def fogs(*names: str) -> SceneMedia:
    boxes = {
        name: box_of(medium("homogeneous", 1.0, 0.5, phase=LOBES[name]), centred(np.eye(3), (2.0 * k, 0, 0)))
        for k, name in enumerate(names)
    }
    parts = {**boxes, "sky": sky(), "sensor": camera([0, -4, 0], [0, 0, 0])}
    return media_of(mi.load_dict({"type": "scene", **parts}))


def points(media: SceneMedia) -> mi.MediumInteraction3f:
    """Points of all media in turn, seen along a slanted ray."""
    d = dr.normalize(mi.Vector3f(0.3, -0.5, 0.8)) + dr.zeros(mi.Float, N)
    mei = medium_interaction(mi.Ray3f(mi.Point3f(0), d), mi.Float(1), media.bodies[0].view.medium)
    lane = dr.arange(mi.UInt32, N) % len(media.bodies)
    mei.medium = media.medium_of(lane, dr.full(mi.Bool, True, N))
    return mei


def directions(seed: int) -> mi.Vector3f:
    rows = np.random.default_rng(seed).normal(size=(3, N))
    return mi.Vector3f(*(rows / np.linalg.norm(rows, axis=0)))


KINDS = [["even"], ["forward"], ["air"], ["even", "forward"], ["forward", "back"], ["even", "forward", "back", "air"]]


@pytest.mark.parametrize("names", KINDS, ids="-".join)
def test_values_and_densities_are_those_of_mitsuba(names):
    media, d, on = fogs(*names), directions(1), dr.full(mi.Bool, True, N)
    mei = points(media)
    value, pdf = mei.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, d, on)
    np.testing.assert_allclose(np.array(media.phases.eval(mei, d, on)), np.array(value), rtol=ERROR)
    np.testing.assert_allclose(np.array(media.phases.pdf(mei, d, on)), np.array(pdf), rtol=ERROR)


@pytest.mark.parametrize("names", KINDS, ids="-".join)
def test_samples_have_their_density(names):
    """Directions are unit vectors with the density of the phase function; inactive lanes have weight and density 0."""
    media, u = fogs(*names), np.random.default_rng(2).random((3, N))
    mei, on = points(media), dr.arange(mi.UInt32, N) < N // 2
    wo, weight, pdf = media.phases.sample(mei, mi.Float(u[0]), mi.Point2f(*u[1:]), on)
    density = media.phases.pdf(mei, wo, on)
    np.testing.assert_allclose(np.array(dr.norm(wo))[: N // 2], 1, rtol=1e-6)
    # A direction has an error of 1e-7, and a density changes by 3 g / (1 - g)^2 = 6 of itself a unit of the cosine.
    np.testing.assert_allclose(np.array(pdf), np.array(density), rtol=1e-5)
    np.testing.assert_allclose(np.array(weight)[:, : N // 2], 1, rtol=1e-5)
    assert not np.array(weight)[:, N // 2 :].any() and not np.array(pdf)[N // 2 :].any()


def test_mean_cosines_are_g():
    """Of 500 strata of one number, the mean of the cosine is exact to the width of a stratum: 2 / 500."""
    media = fogs("forward", "back")
    u = mi.Point2f((mi.Float(dr.arange(mi.UInt32, N) // 2) + 0.5) / (N / 2), 0.25)
    mei = points(media)
    wo, _, _ = media.phases.sample(mei, mi.Float(0.5), u, dr.full(mi.Bool, True, N))
    cosine = -np.array(dr.dot(wo, mei.wi))
    for lane, body in enumerate(media.bodies):
        assert cosine[lane::2].mean() == pytest.approx(body.view.asymmetry[0], abs=4e-3)


def test_the_derivative_by_g_is_that_of_its_medium():
    """d p / d g in lanes of one fog only; nothing flows to the other fog."""
    media, d = fogs("forward", "back"), directions(3)
    one, other = (mi.traverse(body.view.medium)["phase_function.g"] for body in media.bodies)
    dr.enable_grad(one, other)
    for body, g in zip(media.bodies, (one, other), strict=True):
        body.view.asymmetry = g
    mei, is_first = points(media), dr.arange(mi.UInt32, N) % 2 == 0
    dr.backward(dr.sum(dr.select(is_first, media.phases.eval(mei, d, mi.Bool(True)).x, 0)))
    g, cosine = one[0], -np.array(dr.dot(d, mei.wi), np.float64)[::2]
    D = 1 + g * g - 2 * g * cosine
    slope = (-2 * g * D**-1.5 - 3 * (1 - g * g) * (g - cosine) * D**-2.5) / (4 * np.pi)
    assert dr.grad(one)[0] == pytest.approx(slope.sum(), abs=1e-5 * np.abs(slope).sum())
    assert dr.grad(other)[0] == 0


@pytest.mark.parametrize("g", [1.0, -1.2, float("nan")])
def test_a_mean_cosine_out_of_reach_is_refused(g):
    """Mitsuba takes it, and renders anything."""
    box = box_of(medium("homogeneous", 1.0, 0.5, phase=LOBES["forward"]), np.eye(4))
    scene = mi.load_dict({"type": "scene", "fog": box, "sky": sky(), "sensor": camera([0, -4, 0], [0, 0, 0], 4)})
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "mivol", "max_depth": 3})
    dr.eval(mi.render(scene, integrator=integrator, spp=1))
    params["fog.interior_medium.phase_function.g"] = mi.Float(g)
    params.update()
    with refused(
        "phase_function.g of the medium in fog is .*a mean cosine between -1 and 1 is expected: clip it after each step"
    ):
        dr.eval(mi.render(scene, integrator=integrator, spp=1))
