"""The phase functions of the media of a scene, beside Mitsuba's own."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.body import medium_interaction
from mivol.transport.media.phases import HenyeyGreenstein, Microflakes, read_phase
from mivol.transport.media.scene_media import SceneMedia
from scenes import box_of, camera, centred, grid_volume, media_of, medium, refused, sky

WHOLE = centred(20 * np.eye(3))
"""A box around all media."""
TABLE = {"type": "tabphase", "values": "0.2, 0.1, 0.5, 0.3, 1.5"}


def flakes() -> dict:
    matrix = np.float32([0.3, 0.5, 0.7, 0.05, 0.02, -0.03]).reshape(1, 1, 1, 6)
    return {"type": "sggx", "S": grid_volume("gridvolume", matrix, WHOLE)}


def blend(weight: object, first: dict, second: dict) -> dict:
    return {"type": "blendphase", "weight": weight, "a": first, "b": second}


def mixed() -> dict:
    weight = grid_volume("gridvolume", np.random.default_rng(5).uniform(0, 1, (2, 3, 2, 1)), WHOLE)
    return blend(weight, blend(0.4, TABLE, {"type": "rayleigh"}), {"type": "mivol_hg", "g": 0.5})


LOBES: dict[str, Callable[[], dict]] = {
    "even": lambda: {"type": "isotropic"},
    "forward": lambda: {"type": "hg", "g": 0.5},
    "back": lambda: {"type": "hg", "g": -0.3},
    "air": lambda: {"type": "rayleigh"},
    "table": lambda: TABLE,
    "flakes": flakes,
    "blend": lambda: blend(0.3, {"type": "hg", "g": 0.5}, {"type": "hg", "g": -0.3}),
    "other": lambda: blend(0.6, {"type": "hg", "g": 0.2}, {"type": "hg", "g": 0.4}),
    "mixed": mixed,
}
N = 1000
ERROR = 6e-6
"""Relative error of densities. Henyey-Greenstein: 6e-7 of ours, and 1e-6 of Mitsuba's at g = 0.5, whose sum 1 + g^2 + 2 g cos
has a rounding error of 1.2e-7 beside a smallest value of 0.25, to the power 3/2. Microflakes: |S|^(3/2) / (w^T adj(S) w)^2 / A,
of sums of nine products, 9 * 2^-24 * (3/2 + 2 + 1/2) = 2e-6 in each of both, and half of that for their terms of another sign.
Tables: a cosine is off by 1e-7, and the table rises by 4.5 of its least value in 0.5."""


def fogs(*names: str) -> SceneMedia:
    boxes = {
        name: box_of(medium("homogeneous", 1.0, 0.5, phase=LOBES[name]()), centred(np.eye(3), (2.0 * k, 0, 0)))
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


KINDS = [
    *([name] for name in LOBES),
    ["even", "forward"],
    ["forward", "back", "table"],
    ["blend", "even", "other"],
    list(LOBES),
]


@pytest.mark.parametrize("names", KINDS, ids="-".join)
def test_values_and_densities_are_those_of_mitsuba(names):
    media, d, on = fogs(*names), directions(1), dr.full(mi.Bool, True, N)
    mei = points(media)
    value, pdf = mei.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, d, on)
    np.testing.assert_allclose(np.array(media.phases.eval(mei, d, on)), np.array(value), rtol=ERROR)
    # Directions of microflakes are uniform.
    is_even = np.array([isinstance(body.phase, Microflakes) for body in media.bodies])[np.arange(N) % len(names)]
    density = np.where(is_even, 1 / (4 * np.pi), np.array(pdf))
    np.testing.assert_allclose(np.array(media.phases.pdf(mei, d, on)), density, rtol=ERROR)


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
    np.testing.assert_allclose(np.array(weight * pdf), np.array(media.phases.eval(mei, wo, on)), rtol=1e-5, atol=1e-8)
    assert not np.array(weight)[:, N // 2 :].any() and not np.array(pdf)[N // 2 :].any()


@pytest.mark.parametrize("name", LOBES)
def test_mean_cosines_of_samples(name):
    """Beside the mean over the sphere. Both points are lattices, of three and of two dimensions."""
    media, k = fogs(name), dr.arange(mi.Float, N) + 0.5
    mei, on = points(media), dr.full(mi.Bool, True, N)
    x, y = (k * step - dr.floor(k * step) for step in (0.7548776662, 0.5698402910))
    wo, weight, _ = media.phases.sample(mei, k / N, mi.Point2f(x, y), on)
    even = mi.warp.square_to_uniform_sphere(mi.Point2f(k / N, x))
    truth = media.phases.eval(mei, even, on).x * 4 * dr.pi * dr.dot(even, mei.wi)
    assert abs(float(dr.mean(weight.x * dr.dot(wo, mei.wi))[0] - dr.mean(truth)[0])) < N ** (-2 / 3)


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("forward", "g"),
        ("table", "values"),
        ("flakes", "S.data"),
        ("blend", "weight.value.value"),
        ("mixed", "weight.data"),
        ("mixed", "phase_0.weight.value.value"),
        ("mixed", "phase_0.phase_0.values"),
        ("mixed", "phase_1.g"),
    ],
)
def test_derivatives_are_those_of_mitsuba(name, key):
    boxed = fogs(name).bodies[0].view.medium.phase_function()
    params, found, d = mi.traverse(boxed), [], directions(3)
    for is_ours in (True, False):
        params[key] = type(params[key])(dr.detach(params[key]))
        dr.enable_grad(params[key])
        params.update()
        mei = points(fogs(name))
        phase = read_phase(boxed).prepare() if is_ours else boxed
        given = (mei, d) if is_ours else (mi.PhaseFunctionContext(None), mei, d)
        value = phase.eval_pdf(*given, dr.full(mi.Bool, True, N))[0].x
        dr.backward(dr.sum(value * mi.Float(np.linspace(0.5, 1.5, N))))
        found.append(np.array(dr.ravel(dr.grad(params[key]))))
    # Sums of N terms of both signs, each with the error of a density.
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-4 * np.abs(found[1]).max())
    assert np.abs(found[1]).max() > 0


def test_the_derivative_by_g_is_that_of_its_medium():
    """d p / d g in lanes of one fog only; nothing flows to the other fog."""
    media, d = fogs("forward", "back"), directions(3)
    one, other = (mi.traverse(body.view.medium)["phase_function.g"] for body in media.bodies)
    dr.enable_grad(one, other)
    for body, g in zip(media.bodies, (one, other), strict=True):
        body.phase = HenyeyGreenstein(g)
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
    box = box_of(medium("homogeneous", 1.0, 0.5, phase=LOBES["forward"]()), np.eye(4))
    scene = mi.load_dict({"type": "scene", "fog": box, "sky": sky(), "sensor": camera([0, -4, 0], [0, 0, 0], 4)})
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "mivol", "max_depth": 3})
    dr.eval(mi.render(scene, integrator=integrator, spp=1))
    params["fog.interior_medium.phase_function.g"] = mi.Float(g)
    params.update()
    with refused(
        "phase_function.g of the medium in fog is .*a mean cosine between -1 and 1 is expected: clip it after each step"
    ):
        dr.eval(mi.render(scene, integrator=integrator, spp=1))
