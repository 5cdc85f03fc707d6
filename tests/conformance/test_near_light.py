"""Light of emitters with a position, drawn at a distance of its own on every segment of a path in media."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from numpy.typing import NDArray
from refusals import assert_refused
from scattering_gradients import DENSITIES, GRID, assert_gradient, backward, gradients, weights
from scattering_scenes import (
    PLACE,
    aimed,
    assert_same_images,
    assert_twin,
    close_up,
    fog,
    mivol,
    moments,
    pencils,
    point,
    rough_grid,
    smoke,
    spot,
    volpath,
)

import scenes
from mivol.scene.explain import explain_scene
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.estimators.single_scattering import near_light
from mivol.transport.estimators.single_scattering.near_light import NearLighting
from mivol.transport.path.estimators import Settings
from mivol.validate.statistics import Moments
from scenes import ball_of, box_of, medium

SEGMENTS = {"near_light": "segments"}


def lamp(at: list[float] = (0, 0.4, 1.5), size: float = 0.6, radiance: float = 6.0) -> dict:
    """A square area light that shines towards the origin."""
    place = mi.ScalarTransform4f().look_at(list(at), [0, 0, 0], [0, 1, 0]).scale(size)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}


def floor() -> dict:
    place = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


# -- One scattering, against the twin ------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("media", "emitter"),
    [
        ("fog", lambda: point([0.3, -0.2, 0.35])),
        ("grid", lambda: point([0.3, -0.2, 0.35])),
        ("grid", lambda: spot([1.0, -2, 2.5], [0, 0, 0])),
    ],
    ids=["fog, point inside", "grid, point inside", "grid, spot"],
)
def test_one_scattering(flies, media, emitter):
    box, m = fog(1.5) if media == "fog" else smoke(rough_grid(1), 0.7, "own", PLACE, "hg", 0.4)
    shine, known = emitter()
    seen = pencils({"smoke": box, "emitter": shine}, *aimed(1, 8))
    top = twins.radiance([m], [known], seen.o, seen.d).max()
    assert_twin(seen, [m], [known], mivol(**SEGMENTS), 512, rounding=2e-5 * top)


@pytest.mark.slow_for("empty", "rough")
@pytest.mark.statistical
@pytest.mark.parametrize("density", ["empty", "half empty", "rough"])
def test_gradient_of_one_scattering(flies, density):
    """In empty voxels too, where no path collides: the probe of the segment samples them."""
    shine, known = point([0.4, 0.3, 1.3])
    box, m = smoke(np.float32(DENSITIES[density]()), 0.7, "own", PLACE, "hg", 0.4)
    seen = pencils({"smoke": box, "emitter": shine}, *aimed(1, 8))
    w, rows = weights(8)
    truth, _ = twins.radiance_gradient(m, [known], seen.o, seen.d, rows)
    assert_gradient(gradients(seen, GRID, w, 1024, SEGMENTS), truth[..., None], density, 0.1)


# -- Two scatterings of a lamp in an endless fog, against quadrature in float64 --------------------------------------------


def _first_order(r: NDArray, cosine: NDArray, sigma: float, nodes: int = 64) -> NDArray:
    """Light of a point of intensity 1 scattered once along rays that start at the distance r from it.

    ``cosine`` is that of the angle between the ray and the direction to the point. The substitution to the angle seen from the
    point removes 1 / d^2: with d^2 = h^2 + s^2, ds / d^2 is d theta / h. Isotropic phase function, albedo 1.
    """
    x, weight = np.polynomial.legendre.leggauss(nodes)
    h = r * np.sqrt(1 - cosine**2)
    low = -np.arctan2(r * cosine, h)
    half = 0.5 * (np.pi / 2 - low)
    theta = low[..., None] + half[..., None] * (x + 1)
    s = h[..., None] * np.tan(theta)
    path = s + (r * cosine)[..., None] + np.hypot(s, h[..., None])
    return sigma / (4 * np.pi) * (np.exp(-sigma * path) * weight).sum(axis=-1) * half / h


def _orders(h: float, away: float, sigma: float) -> tuple[float, float]:
    """The first two orders along an endless ray that passes the lamp at a distance h, after the length ``away``."""
    first = float(_first_order(np.array(np.hypot(h, away)), np.array(away / np.hypot(h, away)), sigma))
    x, weight = np.polynomial.legendre.leggauss(200)
    # The mean over directions: d cos = sin d phi, which cancels the 1 / sin of the first order.
    phi, dphi = 0.5 * np.pi * (x + 1), 0.5 * np.pi * weight
    # Two intervals of the ray, in the angle seen from the lamp: in front of the nearest point, and behind.
    low, total = -np.arctan2(away, h), 0.0
    for a, b in ((low, 0.0), (0.0, np.pi / 2)):
        theta, dtheta = a + 0.5 * (b - a) * (x + 1), 0.5 * (b - a) * weight
        t, r = away + h * np.tan(theta), h / np.cos(theta)
        inner = _first_order(r[:, None] + 0 * phi, np.cos(phi) + 0 * r[:, None], sigma)
        source = 0.5 * (inner * np.sin(phi) * dphi).sum(axis=1)
        total += float((np.exp(-sigma * t) * sigma * source * h / np.cos(theta) ** 2 * dtheta).sum())
    return first, total


def _lamp_in_fog(h: float, away: float, sigma: float, albedo: float = 1.0) -> mi.Scene:
    """A ray along x in an endless fog, which passes a lamp of intensity 1 at a distance h after the length ``away``."""
    parts = {"fog": scenes.medium("homogeneous", sigma, albedo), "lamp": point([away, h, 0], 1.0)[0]}
    sensor = scenes.pencil(np.zeros(3), np.array([1.0, 0, 0])) | {"medium": {"type": "ref", "id": "fog"}}
    return mi.load_dict({"type": "scene", **parts, "sensor": sensor})


@pytest.mark.statistical
def test_two_scatterings_in_an_endless_fog():
    """A lamp 0.7 beside the ray. The quadrature has converged: half as many nodes change it by less than 1e-10."""
    h, away, sigma = 0.7, 1.2, 0.5
    scene, truth = _lamp_in_fog(h, away, sigma), sum(_orders(h, away, sigma))
    found = moments(scene, mivol(max_depth=3), 1 << 15)
    found = replace(found, mean=found.mean[..., :1], m2=found.m2[..., :1])
    assert_same_mean(found, truth, rounding=1e-5 * truth, what="the first two orders")
    assert_precise(found, 0.01 * truth, what="the first two orders")


@pytest.mark.statistical
def test_the_derivative_by_an_endless_fog() -> None:
    """A scene without shapes has no size, and a radiance meter one ray for all lanes, which starts 9e-5 ahead of the sensor."""
    h, away, sigma, step = 0.7, 1.2, 0.5, 1e-3
    truth = (sum(_orders(h, away, sigma + step)) - sum(_orders(h, away, sigma - step))) / (2 * step)
    scene, integrator = _lamp_in_fog(h, away, sigma), mi.load_dict(mivol(max_depth=3))
    even = np.full((1, 1, 3), 1 / 3)
    values = [backward(scene, "fog.sigma_t.value.value", even, 1 << 14, fresh(s), integrator) for s in range(16)]
    found = Moments.from_values(np.reshape(values, (16, 1)))
    assert_same_mean(found, truth, rounding=1e-4 * truth, what="derivative")
    assert_precise(found, 0.02 * truth, what="derivative")


@pytest.mark.statistical
def test_a_radiance_meter_in_view_of_lit_fog() -> None:
    """The preview of near light gives each lane the only ray of the meter."""
    sensor = scenes.pencil(np.array([-3.0, 0.1, 0.2]), np.array([1.0, 0, 0]))
    scene = mi.load_dict({"type": "scene", "fog": fog(1.0, 0.8)[0], "lamp": point([0.2, 0.7, 1.8], 3.0)[0], "sensor": sensor})
    found, truth = moments(scene, mivol(max_depth=4), 1 << 10), moments(scene, volpath(max_depth=4), 1 << 12)
    assert_same_mean(found, truth, rounding=1e-4 * truth.mean, what="radiance")
    assert_precise(difference(found, truth), 0.1 * truth.mean, what="radiance")


# -- Any number of scatterings, against volpath ----------------------------------------------------------------------------


PLACES = {
    "lamp over a grid": lambda: {"smoke": smoke(rough_grid(1, 4.0), 0.8)[0], "lamp": lamp(), "floor": floor()},
    "peaked phase function": lambda: {"smoke": fog(1.5, 0.9, name="hg", g=0.8)[0], "lamp": lamp()},
    "colours": lambda: {
        "fog": box_of(medium("homogeneous", {"type": "rgb", "value": [0.25, 0.5, 1.0]}, 0.8), PLACE),
        "lamp": lamp(),
        "envmap": {"type": "envmap", "bitmap": mi.Bitmap(np.random.default_rng(1).random((4, 8, 3)).astype(np.float32))},
    },
    "a small lamp inside": lambda: {
        "fog": fog(1.0, 0.9)[0],
        "bulb": {"type": "sphere", "center": [0.3, -0.2, 0.2], "radius": 0.1, "emitter": {"type": "area", "radiance": 9.0}},
        "spot": spot([1.0, -2, 2.5], [0, 0, 0], 12.0, 40.0)[0],
        "mirror": {"type": "sphere", "center": [-0.5, 0.4, 0], "radius": 0.3, "bsdf": {"type": "plastic"}},
        "floor": floor(),
    },
    "two lamps inside": lambda: {
        "fog": fog(1.0, 0.9, name="hg", g=0.6)[0],
        "bulb": {"type": "sphere", "center": [0.3, -0.2, 0.2], "radius": 0.1, "emitter": {"type": "area", "radiance": 9.0}},
        "other": {"type": "sphere", "center": [-0.4, 0.3, -0.5], "radius": 0.15, "emitter": {"type": "area", "radiance": 4.0}},
        "floor": floor(),
    },
    "two lights, a ball": lambda: {
        "fog": ball_of(medium("homogeneous", 1.0, 0.8), (0, 0, 0), 1.0),
        "spot": spot([0.6, -0.4, 1.8], [0, 0, 0], 12.0, 40.0)[0],
        "lamp": lamp([1.6, 0.5, 0.3], 0.4, 8.0),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.random.default_rng(1).random((4, 8, 3)).astype(np.float32))},
        "floor": floor(),
    },
}


@pytest.mark.slow_for("colours", "two lights, a ball", "peaked phase function")
@pytest.mark.statistical
@pytest.mark.parametrize("place", PLACES)
def test_paths_have_the_mean_of_volpath(place):
    """Extended emitters are found in both ways, and emitters at infinity at collisions; each light counts once."""
    scene = close_up(PLACES[place](), res=8)
    assert_same_images(scene, (256, 1024), ours=mivol(max_depth=4, rr_depth=50, **SEGMENTS), stock=volpath(max_depth=4))


# -- Fireflies -------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("variant_rgb")
@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_no_light_comes_from_behind_a_wall(shape):
    """A lamp in a homogeneous medium, behind a wall through the medium. Flights that end in front know no wall."""
    bulb = {"type": "point", "position": [0, 0, -0.5], "intensity": 5.0}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)}
    fog = {"type": shape, "bsdf": {"type": "null"}, "interior": medium("homogeneous", 1.0, 0.9)}
    eye = scenes.camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), res=4)
    scene = mi.load_dict({"type": "scene", "fog": fog, "wall": wall, "bulb": bulb, "sensor": eye})
    assert not np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=4)), spp=64, seed=1)).any()


def test_samples_are_bounded():
    """In a homogeneous box, samples of a segment are at most e^-2 sigma_s I / (2 h) for a lamp at the distance h from the ray.

    At least half of the distances are drawn uniformly in the angle seen from the lamp, of at most pi, so their density is at
    least h / (2 pi d^2) at the distance d from the lamp. The phase function is 1 / (4 pi). The way from the box's face to the
    lamp has an optical depth of at least 2. For h below 0.05, at least 0.93 of the distances are drawn by the angle: the
    collisions' share is (1 - e^(-2 h) (1 - 2 h / 3)) / 2, since the angle is above 3.
    """
    n, sigma, intensity, albedo = 1 << 16, 2.0, 3.0, 0.7
    scene = close_up({"fog": fog(sigma, albedo)[0], "lamp": point([0, 0, 0], intensity)[0]})
    survey, settings = survey_scene(scene), Settings(max_depth=3)
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        media = build_media(scene, needs, make_plan(needs, settings), survey)
        h = mi.Float(np.geomspace(1e-2, 0.9, n))
        ray = mi.Ray3f(mi.Point3f(h, 0, -2), mi.Vector3f(0, 0, 1))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(fresh(1), n)
        on, near = dr.full(mi.Bool, True, n), NearLighting(DirectLighting(media), 0.0, [])
        segment = PathSegment(ray, media.medium_at(ray), mi.Spectrum(1), on, None, dr.zeros(mi.UInt32, n))
        light = near.estimate(segment, mi.Float(dr.inf), near.draw(sampler, on), False, on).light.value
    share = np.array(light.x, np.float64) * 2 * np.array(h, np.float64) / (sigma * albedo * intensity)
    # The sampler increases h^2 by 4e-12 of the squared distance to the origin of the ray, which is 2.2 at most.
    bound = np.exp(-sigma) * (1 + 4e-12 * 2.2**2 / 1e-2**2 / 2 + 1e-4)
    assert 0.4 * bound < share.max() <= bound
    assert share[np.array(h) < 0.05].max() <= 0.5 * bound / 0.93


def foggy_wall(*places: list[float]) -> mi.Scene:
    """A camera in a fog looks past lamps at a wall; no lamp is in view."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().look_at([4, 0, 0], [0, 0, 0], [0, 0, 1]).scale(6)}
    sensor = scenes.camera((0, 0, 0), (1, 0, 0), res=24, fov=45.0) | {"medium": {"type": "ref", "id": "fog"}}
    haze = medium("homogeneous", 0.2, 0.6) | {"id": "fog"}
    lamps = {f"lamp {k}": point(place, 10.0)[0] for k, place in enumerate(places)}
    return mi.load_dict({"type": "scene", "fog": haze, "wall": wall, **lamps, "sensor": sensor})


def largest_error(image: NDArray, truth: NDArray) -> float:
    return np.abs(image - truth).mean(axis=-1).max()


@pytest.mark.slow
def test_the_largest_error_falls_with_the_samples():
    """With any number of scatterings up to 7, no pixel keeps a firefly.

    Sixteen times the samples leave a quarter of an error of finite variance, also of the largest of 576 pixels, which spreads
    by some 15 %. By collisions alone, whose light has no finite variance, nearly all of the largest error stays.
    """
    scene, errors = foggy_wall([2.0, 0, 1.0]), {}
    for way in ("segments", "vertices"):
        integrator = mi.load_dict(mivol(max_depth=8, near_light=way))
        few, more, truth = (np.array(mi.render(scene, integrator=integrator, spp=n, seed=fresh(n))) for n in (16, 256, 4096))
        errors[way] = [largest_error(few, truth), largest_error(more, truth)]
    assert errors["segments"][1] < 0.4 * errors["segments"][0]
    assert errors["segments"][1] < 0.1 * errors["vertices"][1]


@pytest.mark.slow
def test_each_lamp_inside_has_a_share_of_all_directions(monkeypatch):
    """A direction that was drawn for one lamp and passes close by another one counts for both.

    If each vertex aims at one lamp only, such a direction has an unbounded weight: with 256 samples the largest error was 2.8
    times as large, which spreads by some 20 %.
    """
    scene, errors = foggy_wall([2.0, 0, 1.0], [2.0, 0.2, -1.1]), []
    truth = np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=8)), spp=4096, seed=fresh(1)))
    for count in (near_light.MAX_MIXED, 0):
        monkeypatch.setattr(near_light, "MAX_MIXED", count)
        image = mi.render(scene, integrator=mi.load_dict(mivol(max_depth=8)), spp=256, seed=fresh(256))
        errors.append(largest_error(np.array(image), truth))
    assert errors[0] < 0.6 * errors[1]


def test_paths_of_a_thick_medium_keep_their_light():
    """In a white ball around a lamp, most pixels of 256 samples show more than a hundredth of the light that leaves the ball.

    The ball has an optical radius of 30 and a mean cosine of 0.8. The mean image is I / pi = 1.3, the lamp's power over the
    surface. With shares at every vertex a path of n scatterings keeps its light with a probability of 0.6^n, and the median
    pixel showed 9e-4. Now it shows 0.05.
    """
    fog = medium("homogeneous", 30.0, 1.0, phase={"type": "hg", "g": 0.8})
    scene = close_up({"ball": ball_of(fog, [0, 0, 0], 1), "lamp": point([0, 0, 0], 4.0)[0]}, fov=30.0)
    image = mi.render(scene, integrator=mi.load_dict(mivol(max_depth=-1, rr_depth=1000)), spp=256, seed=fresh(256))
    assert np.median(np.array(image)) > 0.01 * 4 / np.pi


# -- The plan --------------------------------------------------------------------------------------------------------------


def _draws(parts: dict, **settings: object) -> tuple[bool, list[str]]:
    scene = close_up(parts, res=8)
    needs = find_needs(scene, scene.sensors()[0], survey_scene(scene))
    made = make_plan(needs, Settings(**{"max_depth": 4, **settings}))
    return made.draws_near_light, [c.reason for c in made.choices if c.subject == "near emitters"]


def test_the_plan_knows_where_emitters_are():
    grid = smoke(rough_grid(1))[0]
    draws, (why,) = _draws({"smoke": grid, "lamp": point([0.2, 0, 0])[0]})
    assert draws and "inside a medium" in why
    draws, (why,) = _draws({"smoke": grid, "lamp": point([0, 0, 9.0])[0]})
    assert not draws and "4 edge lengths away" in why
    assert _draws({"smoke": grid, "sky": scenes.sky()}) == (False, [])
    assert _draws({"smoke": grid, "lamp": point([0.2, 0, 0])[0]}, max_depth=2) == (False, [])
    assert _draws({"smoke": grid, "lamp": point([0.2, 0, 0])[0]}, near_light="vertices")[0] is False
    # A medium around another medium ends at its own shape, but a medium around a far shape may be anywhere.
    outer = {"type": "homogeneous", "sigma_t": 1.0, "id": "outer"}
    skin = ball_of({"type": "ref", "id": "outer"}, [0, 0, 0], 1)
    for x, is_inside in ((0.2, False), (9.0, True)):
        flesh = ball_of(medium("homogeneous", 2.0, 0.5), [x, 0, 0], 0.5) | {"exterior": {"type": "ref", "id": "outer"}}
        _, (why,) = _draws({"outer": outer, "skin": skin, "flesh": flesh, "lamp": point([0, 0, 9.0])[0]})
        assert ("inside a medium" in why) == is_inside
    assert _draws({"smoke": grid, "lamp": point([0, 0, 9.0])[0]}, near_light="segments")[0] is True


def test_a_preview_decides_for_emitters_close_by():
    """Half an edge above the smoke: explain says what the preview has found."""
    scene = close_up({"smoke": smoke(rough_grid(1))[0], "lamp": point([0, 0, 2.0])[0]}, res=8)
    text = explain_scene(scene, max_depth=4).text
    assert "0.5 edge lengths away from a medium; a distance on each segment reaches the same error" in text


@pytest.mark.parametrize(
    ("medium_of", "gain", "setting", "images", "derivatives"),
    [
        (lambda: smoke(rough_grid(1, 10.0))[0], 1.5, "auto", True, False),
        (lambda: smoke(rough_grid(1, 10.0))[0], 40.0, "auto", True, False),
        (lambda: smoke(rough_grid(1, 10.0))[0], 1.5, "segments", True, True),
        (lambda: smoke(rough_grid(1, 100.0))[0], 1.5, "auto", True, True),
        (lambda: smoke(rough_grid(1, 100.0))[0], 0.9, "auto", False, False),
        (lambda: fog(1.0)[0], 1.5, "auto", True, True),
    ],
    ids=["thin grid", "thin grid, large gain", "set", "dense grid", "dense grid, no gain", "homogeneous"],
)
def test_derivatives_have_a_choice_of_their_own(medium_of, gain, setting, images, derivatives):
    """Half an edge above a medium, with a measured gain: the plan, its words, and the estimators built by it."""
    scene = close_up({"body": medium_of(), "lamp": point([0, 0, 2.0])[0]}, res=8)
    survey, settings = survey_scene(scene), Settings(max_depth=4, near_light=setting)
    needs = replace(find_needs(scene, scene.sensors()[0], survey), near_gain=gain)
    made = make_plan(needs, settings)
    (choice,) = [c.choice for c in made.choices if c.subject == "near emitters"]
    assert (made.draws_near_light, made.near_light_in_derivatives) == (images, derivatives)
    assert ("in derivatives, lit at collisions" in choice) == (images != derivatives)
    with dr.suspend_grad():
        built = [build_estimators(scene, needs, made, settings, survey, for_images=on).near for on in (True, False)]
    assert [near is not None for near in built] == [images, derivatives]


@pytest.mark.parametrize(("setting", "words"), [("everywhere", "auto, segments or vertices is expected"), ("segments", "auto")])
def test_refusals(setting, words):
    """An unknown word, and segments where a boundary of glass hides all emitters."""
    glass = ball_of(medium("homogeneous", 1.0, 0.8), (0, 0, 0), 1.0) | {"bsdf": {"type": "dielectric"}}
    scene = close_up({"milk": glass, "lamp": lamp()}, res=8)
    assert_refused(words, scenes.render, scene, mivol(max_depth=4, near_light=setting), 1)


def _two_grids() -> dict:
    interior = {
        name: scenes.grid_volume("mivol_voxels", rough_grid(seed, 0.5), PLACE)
        for seed, name in enumerate(("sigma_a", "sigma_s"))
    }
    return box_of({"type": "mivol_medium", **interior}, PLACE)


BESIDE = np.diag([1.0, 1.0, 1.0, 1.0])
BESIDE[:3, 3] = 4, 0, 0


@pytest.mark.parametrize(
    ("parts", "settings", "points"),
    [
        (lambda: {"smoke": smoke(rough_grid(1))[0]}, {}, True),
        (lambda: {"smoke": smoke(np.repeat(rough_grid(1), 3, axis=-1), kind="own")[0]}, {}, True),
        (lambda: {"smoke": smoke(rough_grid(1, 10.0))[0]}, {}, False),
        (lambda: {"smoke": smoke(rough_grid(1))[0]}, {"shadows": "exact"}, False),
        (lambda: {"smoke": smoke(rough_grid(1))[0]}, {"near_light": "vertices"}, False),
        (lambda: {"smoke": smoke(rough_grid(1))[0], "fog": fog(0.2, to_world=BESIDE)[0]}, {}, False),
        (lambda: {"smoke": fog(0.2)[0]}, {}, False),
        (lambda: {"smoke": _two_grids()}, {}, False),
    ],
    ids=["thin", "rgb", "dense", "exact", "vertices", "two media", "homogeneous", "two grids"],
)
def test_where_points_take_the_place_of_cells(parts, settings, points):
    """In a single medium with an albedo and a thin grid; then no coarse grid is made. Shadows of derivatives are looked up."""
    scene = close_up({**parts(), "lamp": point([0.2, 0, 0])[0]}, res=8)
    survey, settings = survey_scene(scene), Settings(max_depth=4, **settings)
    needs = find_needs(scene, scene.sensors()[0], survey)
    made = make_plan(needs, settings)
    assert made.draws_points == points
    with dr.suspend_grad():
        built = [build_estimators(scene, needs, made, settings, survey, for_images=on) for on in (True, False)]
    for estimators in built:
        assert estimators.near is None or estimators.near.draws_points == points
    (part, *_) = built[0].media.bodies[0].view.parts
    assert part.lattice is None or (part.rough is None) == (points or built[0].near is None)
    assert [estimators.direct.looks_up for estimators in built] == [False, settings.shadows != "exact"]


@pytest.mark.parametrize("channels", [1, 3])
def test_a_grey_variant_looks_up_grey_grids_only(each_variant, channels):
    """It averages an rgb extinction, and the transmittance of the mean is not the mean transmittance."""
    values = np.repeat(rough_grid(1), channels, axis=-1)
    scene = close_up({"smoke": smoke(values, kind="own")[0], "lamp": point([0.2, 0, 0])[0]}, res=8)
    needs = find_needs(scene, scene.sensors()[0], survey_scene(scene))
    assert make_plan(needs, Settings(max_depth=4)).draws_points == (channels == 1 or each_variant.endswith("rgb"))
