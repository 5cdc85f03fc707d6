"""The light of lamps behind smooth glass: its direction and its dimming in closed form, and its mean beside paths by chance."""

from __future__ import annotations

import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import assert_same_images, mivol, moments, volpath

from mivol.experiments.script import explain
from mivol.scene import choices, plan, previews
from mivol.scene.needs import find_needs
from mivol.scene.survey import RefractedNoise, survey_scene
from mivol.transport.estimators.lighting.bright_map import MapReading
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.refracted_light import RefractedLighting, RefractedSamples, VertexBeforeGlass
from mivol.transport.path.estimators import Settings
from mivol.transport.traversal.rays import FineRay
from scenes import camera, media_of, medium, sky

IOR, RADIANCE = 1.5, 8.0


@pytest.fixture
def draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vertices draw directions through glass, whatever a preview says."""
    monkeypatch.setattr(plan, "choose_refracted_light", lambda *_: (True, []))


def glass(ior: float = IOR, outside: float = 1.0) -> dict:
    return {"type": "dielectric", "int_ior": ior, "ext_ior": outside}


def lamp(size: float, p: tuple[float, float, float] = (0.6, -0.8, 2.4), radiance: float = RADIANCE) -> dict:
    """A square that shines on the origin."""
    place = mi.ScalarTransform4f().look_at(origin=list(p), target=[0, 0, 0], up=[0, 1, 0.2]).scale(size)
    light = {"type": "area", "radiance": {"type": "uniform", "value": radiance}}
    return {"type": "rectangle", "to_world": place, "emitter": light, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def box(half: tuple[float, float, float], z: float = 0.0) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([0, 0, z]).scale(list(half))


def floor(z: float) -> dict:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, z]).scale(1.2)}


def fog(sigma_t: float = 2.0) -> dict:
    return medium("homogeneous", sigma_t, 0.9)


def sun_in_a_map(width: float = 8.0) -> dict:
    """An even sky with a soft sun of this angle [degrees] above the camera."""
    theta, phi = np.pi * (np.arange(32)[:, None] + 0.5) / 32, 2 * np.pi * (np.arange(64) + 0.5) / 64
    d = np.stack(np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), axis=-1)
    angle = np.degrees(np.arccos(np.clip(d @ [0.48, 0.6, 0.64], -1, 1)))
    radiance = 0.2 + 60 * np.exp(-0.5 * (angle / width) ** 2)
    pixels = np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": turn}


SCENES = {
    "ball": lambda: {"ball": {"type": "sphere", "bsdf": glass(), "interior": fog()}, "lamp": lamp(0.5)},
    "two lamps and a floor in a tank": lambda: {
        "tank": {"type": "cube", "to_world": box((0.9, 0.9, 0.9)), "bsdf": glass(1.33), "interior": fog(1.0)},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.7]).scale(0.6)},
        "lamp": lamp(0.5),
        "other": lamp(0.3, (-2, 0.5, 1)),
        "sky": sky(0.05),
    },
    "glass with holes beside a glass bead": lambda: {
        "ball": {"type": "sphere", "bsdf": {"type": "mask", "opacity": 0.5, "glass": glass()}, "interior": fog()},
        "bead": {"type": "sphere", "radius": 0.2, "center": [0, -1.3, 0], "bsdf": glass()},
        "lamp": lamp(1.5),
    },
    "a ball in a glass ball": lambda: {
        "outer": {"type": "sphere", "radius": 1.1, "bsdf": glass()},
        "inner": {"type": "sphere", "radius": 0.9, "bsdf": glass(1.33, IOR), "interior": fog()},
        "lamp": lamp(0.5),
    },
    "a tank under a sun": lambda: {
        "tank": {"type": "cube", "to_world": box((0.9, 0.9, 0.9)), "bsdf": glass(1.33), "interior": fog()},
        "sun": sun_in_a_map(),
    },
    "a lamp and a sun": lambda: {
        "ball": {"type": "sphere", "bsdf": glass(), "interior": fog()},
        "lamp": lamp(0.5, radiance=30.0),
        "sun": sun_in_a_map(),
    },
    "fog behind a pane": lambda: {
        "pane": {"type": "cube", "to_world": box((1.5, 1.5, 0.05), 1.3), "bsdf": glass()},
        "fog": {"type": "sphere", "radius": 0.8, "bsdf": {"type": "null"}, "interior": fog()},
        "floor": floor(-0.9),
        "lamp": lamp(0.4),
    },
}


def load(name: str, res: int = 12) -> mi.Scene:
    return mi.load_dict({"type": "scene", **SCENES[name](), "sensor": camera([0, -4, 1.2], [0, 0, 0], res, fov=36)})


@pytest.mark.statistical
@pytest.mark.parametrize("name", SCENES)
def test_means_are_those_of_chance(draws: None, variant_rgb: str, name: str) -> None:
    """Both ways of meeting a lamp add up, also where the path ends at its last depth."""
    depth = {"max_depth": 7, "rr_depth": 4}
    assert_same_images(load(name), (128, 1024), tile=3, ours=mivol(**depth), stock=volpath(**depth), precision=0.02)


def test_a_small_lamp_has_less_noise(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chance meets a lamp of 0.008 of all directions, and directions through the glass do at each vertex: 5 to 20 times less
    variance with these seeds, of which a third is asked."""
    noise = []
    for draws in (False, True):
        monkeypatch.setattr(plan, "choose_refracted_light", lambda *_, draws=draws: (draws, []))
        scene = {"ball": {"type": "sphere", "bsdf": glass(), "interior": fog()}, "lamp": lamp(0.2)}
        scene = mi.load_dict({"type": "scene", **scene, "sensor": camera([0, -4, 1.2], [0, 0, 0], 16, fov=24)})
        noise.append(moments(scene, mivol(max_depth=6), 64, 8).variance_of_mean.mean())
    assert noise[1] < noise[0] / 3


# -- Closed forms --------------------------------------------------------------------------------------------------------


def estimator(parts: dict, depth: int = 8) -> RefractedLighting:
    aside = {"type": "sphere", "center": [9, 0, 0], "bsdf": {"type": "null"}, "interior": fog()}
    scene = mi.load_dict({"type": "scene", **parts, "aside": aside, "sensor": camera([0, -4, 0], [0, 0, 0], 4)})
    return RefractedLighting(DirectLighting(media_of(scene)), depth)


def at(*p: float) -> mi.Interaction3f:
    it = dr.zeros(mi.Interaction3f, 1)
    it.p = mi.Point3f(*p)
    return it


def far_lamp(degrees: float) -> dict:
    angle = math.radians(degrees)
    return lamp(1.0, (1e4 * math.sin(angle), 0, 1e4 * math.cos(angle)))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 75.0])
def test_the_axis_follows_snell(variant_rgb: str, degrees: float) -> None:
    """From inside of a slab to a lamp so far away that the step is exact: float32 knows the direction to 1e-6."""
    lighting = estimator({"slab": {"type": "cube", "to_world": box((50, 50, 1)), "bsdf": glass()}, "lamp": far_lamp(degrees)})
    axis, g = lighting._aim(at(0, 0, 0), mi.UInt32(0), mi.Bool(True))
    sine = math.sin(math.radians(degrees)) / IOR
    # The lamp is seen from the face of the slab, 1 below 1e4.
    np.testing.assert_allclose(np.ravel(axis), [sine, 0, math.sqrt(1 - sine**2)], atol=2e-4)
    step = 2 * math.sin(0.5 * (math.radians(degrees) - math.asin(sine)))
    assert float(g[0]) == pytest.approx(1 - max(0.7 * math.hypot(step, math.sqrt(2) * 1e-4), 2e-3), abs=1e-3)


def test_a_lamp_behind_the_face_has_a_straight_axis(variant_rgb: str) -> None:
    """From the side of the lamp, total reflection leaves no bent way into the glass and out of its side."""
    lighting = estimator({"ball": {"type": "sphere", "bsdf": glass()}, "lamp": lamp(0.1, (0, 0, 3))})
    axis, _ = lighting._aim(at(0, 0, 0.2), mi.UInt32(0), mi.Bool(True))
    np.testing.assert_allclose(np.ravel(axis), [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("z", "depth", "limit", "expected"),
    [
        (0.0, 1, 8, IOR**2 * 0.96),  #       out of the glass: R = ((n - 1) / (n + 1))^2 = 0.04, and radiance grows by n^2
        (-2.0, 1, 8, 0.96**2),  #            through both faces
        (0.0, 1, 3, IOR**2 * 0.96),  #       the face is event 2 of at most 2
        (0.0, 2, 3, 0.0),  #                 and here the third
        (-2.0, 1, 3, 0.0),
        (2.0, 1, 8, 0.0),  #                 no glass lies ahead: emitter samples find this light
    ],
)
def test_glass_dims_the_light_by_fresnel(variant_rgb: str, z: float, depth: int, limit: int, expected: float) -> None:
    slab = {"type": "cube", "to_world": box((50, 50, 1)), "bsdf": glass()}
    lighting = estimator({"slab": slab, "lamp": lamp(0.3, (0, 0, 5))}, limit)
    ray = FineRay.from_point(mi.Point3d(0, 0, z), mi.Vector3f(0, 0, 1), at(0, 0, z))
    follow = lighting._follow(ray, mi.MediumPtr(None), mi.UInt32(0), mi.UInt32(depth), mi.UInt32(7), mi.Bool(True))
    np.testing.assert_allclose(np.ravel(follow), RADIANCE * expected, rtol=1e-5)


def test_light_of_another_lamp_does_not_count(variant_rgb: str) -> None:
    slab = {"type": "cube", "to_world": box((50, 50, 1)), "bsdf": glass()}
    lighting = estimator({"slab": slab, "above": lamp(0.3, (0, 0, 5)), "below": lamp(0.3, (0, 0, -5))})
    ray = FineRay.from_point(mi.Point3d(0, 0, 0), mi.Vector3f(0, 0, 1), at(0, 0, 0))
    found = [
        lighting._follow(ray, mi.MediumPtr(None), mi.UInt32(k), mi.UInt32(1), mi.UInt32(7), mi.Bool(True)) for k in range(2)
    ]
    assert sorted(float(L[0][0]) > 0 for L in found) == [False, True]


ISOTROPIC = 1 / (4 * math.pi)


def peak(g: float) -> float:
    """Density of the lobe along its axis [1/sr]."""
    return ISOTROPIC * (1 + g) / (1 - g) ** 2


def test_both_ways_share_the_light_by_their_densities(variant_rgb: str) -> None:
    """Along the axis out of a slab, with one lamp: light over p + q where a direction is drawn, and p / (p + q) by chance."""
    slab = {"type": "cube", "to_world": box((50, 50, 1)), "bsdf": glass()}
    lighting = estimator({"slab": slab, "lamp": lamp(2.5, (0, 0, 5))})
    radius = float(lighting.lamps.ball(mi.UInt32(0))[1][0])
    q = peak(1 - 0.7 * radius / 5)
    vertex = SimpleNamespace(
        interaction=at(0, 0, 0),
        eval_and_pdf=lambda d, on: (mi.Spectrum(ISOTROPIC), mi.Float(ISOTROPIC)),
        leave=lambda p: (mi.Point3d(0, 0, 0), mi.MediumPtr(None)),
    )
    # Numbers of 1 draw the angle 0.
    samples = RefractedSamples(mi.Float(0.5), mi.Point2f(1, 0.5), mi.UInt32(7))
    drawn = lighting.estimate(vertex, samples, mi.UInt32(1), mi.Bool(True))
    np.testing.assert_allclose(np.ravel(drawn), ISOTROPIC * RADIANCE * IOR**2 * 0.96 / (ISOTROPIC + q), rtol=2e-3)
    emitter = mi.EmitterPtr(lighting.lamps.sampled[0])
    no, yes = mi.Bool(False), mi.Bool(True)

    def weight(transmitted: mi.Bool, mirrored: mi.Bool, emitter: mi.EmitterPtr = emitter) -> float:
        before = VertexBeforeGlass(at(0, 0, 0), mi.Vector3f(0, 0, 1), mi.Float(ISOTROPIC), transmitted, mirrored)
        return float(lighting.weigh_path(before, emitter, yes)[0])

    assert weight(yes, no) == pytest.approx(ISOTROPIC / (ISOTROPIC + q), rel=2e-3)
    assert weight(no, no) == weight(yes, yes) == weight(yes, no, mi.EmitterPtr(None)) == 1


@pytest.mark.parametrize("lamps", [0, 2])
def test_the_focus_of_a_map_counts_as_a_lamp(variant_rgb: str, lamps: int) -> None:
    """The map has half of the choices beside lamps, and the last number."""
    parts = {"ball": {"type": "sphere", "bsdf": glass()}, "sun": sun_in_a_map(), "a": lamp(0.3), "b": lamp(0.3, (-2, 1, 1))}
    parts = {name: part for name, part in parts.items() if lamps or name not in ("a", "b")}
    fog_aside = {"type": "sphere", "center": [9, 0, 0], "bsdf": {"type": "null"}, "interior": fog()}
    scene = mi.load_dict({"type": "scene", **parts, "aside": fog_aside, "sensor": camera([0, -4, 0], [0, 0, 0], 4)})
    direct = DirectLighting(media_of(scene), bright=MapReading().follow(scene).table)
    lighting = RefractedLighting.of_lamps(direct, 8)
    u = (dr.arange(mi.Float, 1000) + 0.5) / 1000
    it = dr.zeros(mi.Interaction3f, 1000)
    chosen = np.array(lighting._choose(it, u))
    share = [float(lighting._probability(it, mi.UInt32(k))[0]) for k in range(lamps + 1)]
    np.testing.assert_allclose(np.bincount(chosen, minlength=lamps + 1) / 1000, share, atol=2e-3)
    assert share[-1] == (0.5 if lamps else 1.0)
    number, known = lighting._number_of(mi.EmitterPtr(scene.environment()))
    assert (int(number[0]), bool(known[0])) == (lamps, True)
    # The map was turned by 90 degrees about x. Its rows of pixels are pi / 32 apart.
    axis, g = lighting._aim(at(0, 0, 0), mi.UInt32(lamps), mi.Bool(True))
    assert float(g[0]) == pytest.approx(1 - 0.7 * float(direct.bright.focus[3]), rel=1e-3)
    np.testing.assert_allclose(np.ravel(axis), [0.48, -0.64, 0.6], atol=np.pi / 64)


def test_nothing_is_drawn_without_lamps(variant_rgb: str) -> None:
    parts = {"ball": {"type": "sphere", "bsdf": glass(), "interior": fog()}, "sky": sky(1.0)}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": camera([0, -4, 0], [0, 0, 0], 4)})
    assert RefractedLighting.of_lamps(DirectLighting(media_of(scene)), 8) is None


def test_a_map_with_gradients_is_met_by_chance(draws: None, variant_rgb: str) -> None:
    """Its pixels are not read then."""
    scene = load("a tank under a sun", res=4)
    params = mi.traverse(scene)
    dr.enable_grad(params["sun.data"])
    assert np.mean(mi.render(scene, params, integrator=mi.load_dict(mivol(max_depth=4)), spp=4)) > 0.05


def test_mirrors_and_glass_are_told_apart() -> None:
    mi.set_variant("llvm_ad_rgb")
    first = VertexBeforeGlass.none(2)
    assert list(first.was_mirrored) == [True, True] and list(first.was_transmitted) == [False, False]
    clear = VertexBeforeGlass(first.interaction, first.d, first.pdf, mi.Bool(False, False), mi.Bool(False, False))
    for mirrors in (False, True):
        after = clear.at_specular(mi.Bool(True, False), mi.Bool(mirrors, mirrors))
        assert list(after.was_mirrored) == [mirrors, False]
        assert list(after.was_transmitted) == [not mirrors, False]


@pytest.mark.parametrize("name", ["ball", "fog behind a pane"])
def test_the_glass_counts_as_events(draws: None, variant_rgb: str, name: str) -> None:
    """Into the ball, a scattering and out again, or a scattering and the two faces of the pane, are three events: depth 4."""
    scene = mi.load_dict({"type": "scene", **SCENES[name](), "sensor": camera([0, -4, 0.5], [0, 0, 0], 8, fov=10)})
    dark, lit = (np.asarray(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=d)), spp=64)) for d in (3, 4))
    assert np.median(lit) > 0
    assert not dark.any()


def test_derivatives_meet_lamps_by_chance(draws: None, variant_rgb: str) -> None:
    scene, settings = load("ball"), Settings(max_depth=5)
    survey = survey_scene(scene)
    needs = find_needs(scene, scene.sensors()[0], survey)
    made = [plan.build_estimators(scene, needs, plan.make_plan(needs, settings), settings, survey, k) for k in (False, True)]
    assert made[0].refracted is None
    assert made[1].refracted.depth_limit == 5


# -- The choice ------------------------------------------------------------------------------------------------------------


def facts(**changed: object) -> SimpleNamespace:
    film = {"are_samples_independent": True, "is_colour_film": True, "film_samples": choices.MIN_LAMP_SAMPLES}
    return SimpleNamespace(**{"has_glass": True, "has_lamps": True, "emitters": (), **film, **changed})


def test_a_preview_needs_glass_lamps_and_samples() -> None:
    def is_open(depth: int = 3, segment: str = "free_flight", **changed: object) -> bool:
        return choices.is_refracted_light_open(facts(**changed), Settings(max_depth=depth), segment)

    assert is_open()
    for name in ("has_glass", "has_lamps", "are_samples_independent", "is_colour_film"):
        assert not is_open(**{name: False})
    assert is_open(has_lamps=False, emitters=("EnvironmentMapEmitter",))
    assert not is_open(depth=2)
    assert not is_open(segment="absorption")
    assert not is_open(film_samples=choices.MIN_LAMP_SAMPLES - 1)


def test_light_that_chance_missed_counts_as_noise() -> None:
    """Samples of 1 and 3 in turns have the variance 4 / 3 in pairs of pixels; black ones miss a mean of 2 in 8 samples."""
    drawn = np.tile([1.0, 3.0], (2, 2))
    assert previews.compare_refracted(drawn, drawn) == RefractedNoise(pytest.approx(4 / 3), pytest.approx(4 / 3))
    missed = previews.compare_refracted(0 * drawn, drawn)
    assert missed == RefractedNoise(pytest.approx(8 * 4 - 4 * 4 / 3), pytest.approx(4 / 3))


@pytest.mark.parametrize(("gain", "expected"), [(1.19, False), (1.21, True)])
def test_the_gain_counts_the_time_of_directions(gain: float, expected: bool) -> None:
    noise = RefractedNoise(by_chance=2.2 * gain, drawn=1.0)
    draws, (choice,) = choices.choose_refracted_light(facts(refracted_noise=noise), Settings(max_depth=4), "free_flight")
    assert draws == expected
    assert f"the same error {gain:.2g} times as fast" in choice.reason
    unknown = choices.choose_refracted_light(facts(refracted_noise=None), Settings(max_depth=4), "free_flight")
    assert unknown == (False, [])


@pytest.mark.parametrize("name", ["fog behind a pane", "a tank under a sun"])
def test_explain_tells_how_lamps_behind_glass_are_met(variant_rgb: str, name: str) -> None:
    said = explain(load(name, res=96), 6).partition("lamps behind glass")[2].partition("\n  images")[0]
    assert "drawn through the glass" in said


def test_small_images_measure_nothing(variant_rgb: str) -> None:
    assert "lamps behind glass" not in explain(load("fog behind a pane", res=8), 6)
