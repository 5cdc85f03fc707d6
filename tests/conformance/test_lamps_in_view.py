"""Light has camera rays of its own where paths find it with noise: lamps in view, the light of media, and mirrors of glass."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean
from media_light_scenes import SCENES, met
from scattering_scenes import PLACE, assert_same_images, assert_same_whole, close_up, mivol, moments, rough_grid, volpath

from mivol.experiments.script import explain
from mivol.scene import choices, plan
from mivol.scene.survey import MirrorNoise, OwnRaysNoise
from mivol.threads import set_thread_count
from mivol.transport.path.estimators import Settings
from scenes import as_float32, ball_of, box_of, camera, grid_volume, medium, render, sky

RADIANCE = 8.0


def lamp(width: float, z: float = 1.5) -> dict:
    """A square above the fog that shines down, and to the camera above its lower edge."""
    place = mi.ScalarTransform4f().translate([0.2, 1.5, z]).rotate([1, 0, 0], 80).scale([width, width, 1])
    light = {"type": "area", "radiance": {"type": "uniform", "value": RADIANCE}}
    return {"type": "rectangle", "to_world": place, "emitter": light, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def room(width: float = 0.5, res: int = 12, spp: int = 16, **film: object) -> mi.Scene:
    """Fog before a grey wall, and a lamp that is seen over and through the fog."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(4)}
    sensor = camera([0, -5, 0.5], [0, 0, 0.3], res, fov=45)
    sensor["film"] |= film
    sensor["sampler"]["sample_count"] = spp
    fog = box_of(medium("homogeneous", 0.5, 0.8), PLACE)
    return mi.load_dict({"type": "scene", "fog": fog, "lamp": lamp(width), "wall": wall, "sensor": sensor})


@pytest.fixture
def own_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four rays for each path, whatever a preview says."""
    monkeypatch.setattr(plan, "choose_lamp_rays", lambda *_: (4, []))


@pytest.mark.statistical
@pytest.mark.parametrize(
    "film",
    [
        {},
        pytest.param({"rfilter": {"type": "gaussian"}, "pixel_format": "rgba"}, marks=pytest.mark.slow),
        {"rfilter": {"type": "tent"}, "sample_border": True, "crop_offset_x": 2, "crop_width": 9, "crop_height": 10},
    ],
    ids=["box", "gaussian", "crop"],
)
def test_means_are_those_of_volpath(own_rays: None, variant_rgb: str, film: dict) -> None:
    scene = room(**film)
    assert_same_images(scene, (32, 256), tile=3, ours=mivol(max_depth=4), stock=volpath(max_depth=4), precision=0.03)


def test_an_even_lamp_has_its_radiance_with_any_filter(own_rays: None, variant_rgb: str) -> None:
    """Rays of their own divide by their own filter weights: with those of the paths the image would be noisy."""
    scene = room(width=40.0, rfilter={"type": "gaussian"})
    scene_without_fog = mi.load_dict({"type": "scene", "lamp": lamp(40.0), "sensor": scene.sensors()[0]})
    image = render(scene_without_fog, mivol(max_depth=3), spp=8)
    # Sums of some 8 x 25 weights, in float32.
    np.testing.assert_allclose(image, RADIANCE, rtol=200 * 2.0**-24)


@pytest.mark.parametrize("spp", [6, 7])
def test_passes_and_paths_add_up(own_rays: None, variant_rgb: str, monkeypatch: pytest.MonkeyPatch, spp: int) -> None:
    """Several passes: of the paths, and of the rays of their own, which are four times as many."""
    scene = room(spp=spp)
    whole = render(scene, mivol(max_depth=3), spp)
    monkeypatch.setattr(plan, "PASS_RAYS", dict.fromkeys(plan.PASS_RAYS, 3 * 12 * 12))
    # The same numbers are summed in another order.
    np.testing.assert_allclose(render(scene, mivol(max_depth=3), spp), whole, rtol=64 * 2.0**-24, atol=1e-6)


def test_the_film_holds_what_is_returned(own_rays: None, variant_rgb: str) -> None:
    """Scripts write the film after a render."""
    scene = room()
    image = render(scene, mivol(max_depth=3, aovs="depth"), spp=4)
    assert image.shape[2] == 4
    held = np.array(scene.sensors()[0].film().bitmap(raw=False))
    np.testing.assert_array_equal(held[..., :3], image[..., :3])
    assert held[..., :3].max() > 0.5 * RADIANCE


# -- The choice -------------------------------------------------------------------------------------------------------------


def lamp_lines(scene: mi.Scene, depth: int = 4) -> str:
    return explain(scene, depth).partition("lamps in view")[2].partition("\n  images")[0]


def test_a_bright_lamp_in_view_gets_rays_of_its_own(variant_rgb: str) -> None:
    assert "camera rays of their own" in lamp_lines(room(res=48))


def test_nothing_is_measured_without_a_reason(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One path is all there is at depth 1; small images are rendered sooner than a preview; a sampler of the user stays."""
    assert not lamp_lines(room(res=48), depth=1)
    assert not lamp_lines(room(res=8))
    scene = room(res=48)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": 16})
    sensor = camera([0, -5, 0.5], [0, 0, 0.3], 48, fov=45) | {"sampler": sampler}
    assert not lamp_lines(mi.load_dict({"type": "scene", "fog": scene.shapes()[0], "lamp": lamp(0.5), "sensor": sensor}))
    assert not lamp_lines(mi.load_dict({"type": "scene", "fog": scene.shapes()[0], "sky": sky(), "sensor": sensor}))


class Facts:
    """Facts of a scene whose lamp was measured."""

    has_lamps, media, are_samples_independent, is_colour_film, film_samples = True, (), True, True, 1 << 20

    def __init__(self, edge: float, rest: float, spp: int) -> None:
        self.lamp_noise, self.spp = (edge, rest), spp


class Deep:
    scatterings, hide_emitters = 3, False


def test_the_number_of_rays_follows_noise_and_cost() -> None:
    """With 64 samples an edge of variance 8 e has e beside the rest's 1: (e k^-3/2 + 1) (1 + k / 20) is least at the k below.

    For e of 0.5, 1, 3 and 30 it is 1.28, 1.35, 1.59 and 2.64 at k of 4, 4, 8 and 16: gains of 1.18, 1.48, 2.5 and 12.
    """
    for edge, expected in ((0.0, 0), (0.5, 0), (1.0, 4), (3.0, 8), (30.0, 16)):
        edge *= 8
        assert choices.choose_lamp_rays(Facts(edge, 1.0, 64), Deep())[0] == expected


def test_a_black_picture_has_no_rays_of_its_own() -> None:
    assert choices.choose_lamp_rays(Facts(0.0, 0.0, 64), Deep())[0] == 0


def test_derivatives_do_not_change(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient walks its own paths, with the lamp in them. Two threads add in another order."""
    set_thread_count(1)
    key, found = "fog.interior_medium.sigma_t.value.value", []
    # A preview of near light leaves out what has rays of its own.
    ours = mivol(max_depth=3, near_light="vertices")
    for rays in (0, 4):
        monkeypatch.setattr(plan, "choose_lamp_rays", lambda *_, rays=rays: (rays, []))
        scene = room(res=6)
        params = mi.traverse(scene)
        dr.enable_grad(params[key])
        image = mi.render(scene, params, integrator=mi.load_dict(ours), spp=8, seed=1, seed_grad=2)
        dr.backward(dr.mean(image, axis=None))
        found.append(dr.grad(params[key])[0])
    assert found[0] == found[1] != 0


# -- The light of media -----------------------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["by itself", pytest.param("in fog", marks=pytest.mark.slow)])
def test_emission_along_rays_of_its_own_has_the_mean_of_paths(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Two rays for the 32 paths of a pixel, under a sky."""
    scene, found = close_up(SCENES[name]() | {"sky": sky(0.3)}, res=12), []
    for rays, spp in ((2, 32), (0, 128)):
        monkeypatch.setattr(plan, "choose_emission_rays", lambda *_, rays=rays: (rays, []))
        found.append(moments(scene, met(4), spp, first=1000 * rays))
    assert_same_mean(*found, tile=3, what="tiles")
    assert_same_whole(*found, precision=0.03)


def fire(background: float) -> mi.Scene:
    """A hot spot in a smoke that scatters little, before a sky."""
    light = as_float32(rough_grid(7, 3.0) ** 6)
    interior = medium("mivol_medium", 1.0, 0.3, emission=grid_volume("mivol_voxels", light, PLACE))
    return close_up({"fire": box_of(interior, PLACE), "sky": sky(background)}, res=96)


def emission_line(scene: mi.Scene, depth: int = 4) -> str:
    return explain(scene, depth).partition("emission in view")[2].partition("\n  shadows")[0]


def test_a_fire_in_view_gets_rays_of_its_own(variant_rgb: str) -> None:
    assert "camera rays of its own" in emission_line(fire(0.1))
    assert not emission_line(fire(0.1), depth=1)


def rays_of(paths: float, rest: float, rays: float, spp: int = 64, **more: object) -> int:
    facts = SimpleNamespace(emission_noise=OwnRaysNoise(paths, rest, rays), spp=spp)
    return choices.choose_emission_rays(facts, Settings(max_depth=4), "free_flight")[0]


def test_the_rays_of_an_emission_follow_noise_and_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """(v k^-3/2 + 1 / 64)(1 + k / 64) for a variance v of a ray and 1 of other light, over k of 4, 8, 16, 32, 64.

    v = .03 has .0206, .0191 and .0201 at 4, 8 and 16; v = .1 has .0225, .0215 and .0243 at 8, 16 and 32; v = 8 has .0897 and
    .0625 at 32 and 64.
    """
    monkeypatch.setattr(choices, "is_emission_noise_open", lambda *_: True)
    for v, expected in ((0.0, 4), (0.03, 8), (0.1, 16), (8.0, 64)):
        assert rays_of(100.0, 1.0, v) == expected
    assert rays_of(1.1, 1.0, 0.0) == 0
    assert rays_of(0.0, 0.0, 0.0) == 0
    assert rays_of(100.0, 1.0, 0.0, spp=4) == 1


# -- The light that glass mirrors -------------------------------------------------------------------------------------------


def aquarium(glass: dict, inside: bool = False, res: int = 12, **film: object) -> mi.Scene:
    """A ball of fog in glass before a small lamp, in a room with a floor and a dim sky; the camera is outside or inside."""
    place = mi.ScalarTransform4f().look_at(origin=[1, -3, 3], target=[0, 0, 0], up=[0, 0, 1]).scale(0.4)
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(5)}
    fog = medium("homogeneous", 0.7, 0.8)
    tank = ball_of(fog, (0, 0, 0), 1.0) | {"bsdf": glass}
    # Light is totally reflected at a ball's wall for rays that pass its middle at more than 1 / 1.5 of its radius.
    origin, target = ([0.1, -0.9, 0], [1, -0.5, 0.1]) if inside else ([0, -4, 0.6], [0, 0, 0])
    sensor = camera(origin, target, res, fov=80 if inside else 28)
    sensor["film"] |= film
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 3.0}}
    parts = {"tank": tank, "lamp": lamp, "floor": floor, "sky": sky(0.5)}
    if inside:
        parts |= {"fog": fog, "tank": tank | {"interior": {"type": "ref", "id": "fog"}}}
        parts = {"fog": parts.pop("fog"), **parts}
        sensor["medium"] = {"type": "ref", "id": "fog"}
    return mi.load_dict({"type": "scene", **parts, "sensor": sensor})


THIN, THICK = {"type": "thindielectric", "int_ior": 3.0}, {"type": "dielectric", "int_ior": 1.5}


@pytest.mark.statistical
@pytest.mark.parametrize("keeps", [False, True], ids=["own rays", "kept rays"])
@pytest.mark.parametrize(
    ("glass", "inside"),
    [(THIN, False), pytest.param(THICK, False, marks=pytest.mark.slow), pytest.param(THICK, True, marks=pytest.mark.slow)],
    ids=["thin", "thick", "total reflection"],
)
def test_mirrored_and_transmitted_light_add_up(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, glass: dict, inside: bool, keeps: bool
) -> None:
    """Four mirror rays for the 32 paths of a pixel, whose first glass transmits, or a kept ray a path, beside `volpath`."""
    monkeypatch.setattr(plan, "choose_mirror_rays", lambda *_: (0 if keeps else 4, keeps, []))
    scene, depth = aquarium(glass, inside), {"max_depth": 5}
    assert_same_images(scene, (32, 128), tile=3, ours=mivol(**depth), stock=volpath(**depth), precision=0.03)


@pytest.mark.statistical
def test_alpha_holds_what_thin_glass_mirrors(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball without fog before nothing: its alpha is the share that its two walls mirror, with and without mirror rays."""
    found = []
    for rays in (0, 4):
        monkeypatch.setattr(plan, "choose_mirror_rays", lambda *_, rays=rays: (rays, False, []))
        ball = ball_of(medium("homogeneous", 1e-4, 0.5), (0, 0, 0), 1.0) | {"bsdf": THIN}
        sensor = camera([0, -4, 0.6], [0, 0, 0], 8, fov=20)
        sensor["film"] |= {"pixel_format": "rgba"}
        scene = mi.load_dict({"type": "scene", "ball": ball, "lamp": lamp(0.5), "sensor": sensor})
        m = moments(scene, mivol(max_depth=4), 64, first=1000 * rays)
        found.append(replace(m, mean=m.mean[..., 3:], m2=m.m2[..., 3:]))
    assert 0.1 < found[1].mean.mean() < 0.9
    assert_same_whole(*found, precision=0.03)


def mirror_lines(scene: mi.Scene, depth: int = 4) -> str:
    return explain(scene, depth).partition("light mirrored by glass")[2].partition("\n  images")[0]


def test_a_bright_lamp_in_a_mirror_gets_rays_of_its_own(variant_rgb: str) -> None:
    """In the outer mirror of strong glass. Weak glass around fog has lamps in its inner mirrors too."""
    said = mirror_lines(aquarium(THIN, res=96))
    assert "camera rays of its own" in said or "a path keeps" in said


def test_nothing_else_counts_as_glass(variant_rgb: str) -> None:
    """No mirror is seen at depth 1. A mask on a mirror has the components of thin glass, and draws them otherwise."""
    assert not mirror_lines(aquarium(THIN, res=96), depth=1)
    assert not mirror_lines(aquarium({"type": "mask", "opacity": 0.3, "bsdf": {"type": "conductor"}}, res=96))


@pytest.mark.parametrize("of_gaussians", [False, True])
def test_gaussians_before_glass_shine_once(of_gaussians: bool) -> None:
    """Rays of mirrors leave out what media emit before the glass, but not the light of Gaussians, which is summed."""
    light = SimpleNamespace(emits=True, has_own_walk=of_gaussians)
    film = {"are_samples_independent": True, "is_colour_film": True, "film_samples": choices.MIN_LAMP_SAMPLES}
    facts = SimpleNamespace(has_glass=True, media=[light], **film)
    assert choices.is_mirror_noise_open(facts, Settings(max_depth=4), "free_flight") != of_gaussians


def test_the_mirror_rays_follow_noise_and_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """(v k^-3/2 + 1 / 64)(1 + k / 128) for a variance v of a ray and 1 of other light, over k of 4, 8, 16, 32, 64.

    v = .03 has .0200, .0180 and .0181 at 4, 8 and 16; v = .1 has .0213, .0193 and .0202 at 8, 16 and 32; v = 8 has .0748 and
    .0469 at 32 and 64.
    """
    monkeypatch.setattr(choices, "is_mirror_noise_open", lambda *_: True)

    def rays_of(paths: float, rays: float, kept: float = math.inf) -> tuple[int, bool]:
        facts = SimpleNamespace(mirror_noise=MirrorNoise(OwnRaysNoise(paths, 1.0, rays), kept), spp=64)
        return choices.choose_mirror_rays(facts, Settings(max_depth=4), "free_flight")[:2]

    for v, expected in ((0.0, 4), (0.03, 8), (0.1, 16), (8.0, 64)):
        assert rays_of(100.0, v) == (expected, False)
    assert rays_of(1.1, 0.0) == (0, False)
    # With 4 own rays, paths of the noise 2 are 2 / (1 + 4 / 128) times as fast as chance, and with kept rays 2 / (1.2 kept).
    assert rays_of(2.0, 0.0, 0.87) == (4, False)
    assert rays_of(2.0, 0.0, 0.85) == (0, True)
    assert rays_of(1.1, 0.0, 1.0) == (0, False)
