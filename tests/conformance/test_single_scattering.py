"""Light that turns once, seen by cameras: every emitter, phase function and boundary against stock `volpath` at depth 2.

Each comparison is Student's t over tiles of pixels and over the whole image, 8 independent renders of each integrator
(tests/false_alarms.py). Volpath is a judge where it is right (tests/analytic judges where it is not); where the extinction
differs between channels it renders one channel at a time. Its shadow rays leave each boundary 1e-4 of a length further on
than they should: `rounding` of 1e-4 of the radiance covers that.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import (
    Estimate,
    assert_apart,
    assert_precise,
    assert_same_mean,
    assert_same_spread,
    difference,
    fresh,
    over_pixels,
)
from scattering_scenes import PLACE, assert_same_images, close_up, mivol, moments, point, rough_grid, smoke, volpath
from volpath_scenes import BARE, FOG, LEAK, RED, area, behind_a_mask, cube, floor, grid_in, lit, same, square, turn

import scenes
from mivol.validate.reference import render_reference
from mivol.validate.statistics import Moments
from scenes import as_float32, ball_of, box_of, centred, grid_volume, medium, rotation

# -- Boundaries, media, places of the camera -------------------------------------------------------------------------


TURNED = as_float32(centred(1.4 * rotation([1, 2, 3], 0.7)))
BALL = {"type": "sphere", "radius": 0.9, **BARE}


def two_media() -> dict:
    upper, lower = (centred(np.diag([1.8, 1.8, 0.8]), (0, 0, z)) for z in (0.45, -0.45))
    box = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.9, "phase": {"type": "rayleigh"}}
    return {"upper": grid_in(cube(upper), to_world=upper), "lower": box_of(box, lower)}


def crossing_media() -> dict:
    """Two balls side by side, one of each kind, crossed by the rays and their shadows."""
    ink = {"type": "homogeneous", "sigma_t": 1.5, "albedo": {"type": "rgb", "value": [0.1, 0.5, 0.9]}}
    right = centred(1.2 * np.eye(3), (0.6, 0, 0))
    return {
        "ink": ball_of(ink, (-0.6, 0, 0), 0.5),
        "smoke": grid_in({"type": "sphere", "center": [0.6, 0, 0], "radius": 0.6, **BARE}, to_world=right),
    }


def surfaces() -> dict:
    """A ball in the volume, a floor below and a screen above: lit through the volume, and shading it."""
    return {
        "smoke": grid_in(cube(PLACE)),
        "ball": {"type": "sphere", "radius": 0.4, "center": [0.2, -0.1, -0.3], "bsdf": RED},
        "floor": {"type": "rectangle", "to_world": turn().translate([0, 0, -1.1]).scale(2.5), "bsdf": {"type": "diffuse"}},
        "screen": square(0.9, -0.6, 1.2, 0.3, (1.6, -1.3, 1.7)) | {"bsdf": {"type": "twosided", "nested": RED}},
    }


def mirrors() -> dict:
    """At depth 2 a mirror shows emitters and the sky through the volume, not light scattered by the volume."""
    mirror = {"type": "rectangle", "to_world": turn().translate([0, 0, -0.7]).scale(0.8), "bsdf": {"type": "conductor"}}
    return {"smoke": grid_in(cube(PLACE)), "mirror": mirror, "emitter": area(-0.5, 2.0, 2.0)}


PLACES = {
    "albedo grid in a homogeneous": lambda: {
        "fog": box_of(medium("homogeneous", 0.8, grid_volume("gridvolume", rough_grid(9, 1.0, (3, 2, 7)), PLACE)), PLACE)
    },
    "constvolume": lambda: {"fog": box_of(medium("heterogeneous", {"type": "constvolume", "value": 1.0}, 0.8), np.eye(4))},
    "scaled": lambda: {"smoke": grid_in(cube(PLACE), scale=2.5)},
    "scaled, own": lambda: {"smoke": grid_in(cube(PLACE), "own", scale=2.5)},
    "turned": lambda: {"smoke": grid_in(cube(TURNED), to_world=TURNED)},
    "turned, own": lambda: {"smoke": grid_in(cube(TURNED), "own", to_world=TURNED)},
    "ball smaller than its grid": lambda: {"smoke": grid_in(BALL)},
    "box smaller than its grid": lambda: {"smoke": grid_in(cube(centred(1.3 * rotation([0, 0, 1], 0.4))))},
    "box larger than its grid": lambda: {"smoke": grid_in(cube(centred(2.2 * np.eye(3))), to_world=centred(1.5 * np.eye(3)))},
    "ball larger than its grid": lambda: {"smoke": grid_in(BALL, to_world=centred(np.eye(3)))},
    "two boxes": two_media,
    "two balls": crossing_media,
    "surfaces": surfaces,
    "mirrors": mirrors,
    "mask": behind_a_mask,
}


FAST_PLACES = ("turned", "two balls", "surfaces")


@pytest.mark.slow_for("surfaces", "two balls")
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(PLACES, [name for name in PLACES if name not in FAST_PLACES]))
def test_places(name):
    same(lit(PLACES[name]()))


@pytest.mark.statistical
@pytest.mark.slow
def test_fog_without_an_end_by_quadrature_and_its_derivatives():
    """Quadrature gives the mean of Monte Carlo; the derivative by the density, in forward mode and by differences of images
    without noise.
    """
    parts = {"fog": FOG, **floor(), "bulb": point([0.3, 0.2, 1.5], 4.0)[0]}
    sensor = scenes.camera((1.5, -1.2, 1.0), (0, 0, 0), res=6, fov=40.0) | {"medium": {"type": "ref", "id": "fog"}}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
    params, key = mi.traverse(scene), "fog.sigma_t.value.value"
    quiet = mi.load_dict(mivol(deterministic=True))

    def picture(sigma: float, spp: int, seed: int = 0) -> float:
        params[key] = mi.Float(sigma)
        params.update()
        return float(np.array(mi.render(scene, integrator=quiet, spp=spp, seed=seed)).mean(dtype=np.float64))

    seeds = [fresh(s) for s in range(16)]
    drawn = Moments.from_values(np.array([scenes.render(scene, mivol(), 512, s).mean(dtype=np.float64) for s in seeds]))
    # Both know a pixel by some of its rays only.
    known = Moments.from_values(np.array([picture(0.3, 64, s) for s in seeds]))
    assert_same_mean(drawn, known, rounding=1e-3 * float(drawn.mean), what="pictures")
    assert_precise(difference(drawn, known), 0.005 * float(drawn.mean), what="pictures")
    slope = Moments.from_values(np.array([(picture(0.33, 64, s) - picture(0.27, 64, s)) / 0.06 for s in seeds]))
    params[key] = mi.Float(0.3)
    dr.enable_grad(params[key])
    params.update()
    found = []
    for seed in seeds:
        image = mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=256, seed=seed)
        dr.set_grad(params[key], 0)
        dr.backward(dr.mean(image, axis=None))
        found.append(float(dr.grad(params[key])[0]))
    found = Moments.from_values(np.array(found))
    # 1 % for the difference's own curvature
    assert_same_mean(found, slope, rounding=0.01 * abs(float(slope.mean)), what="slopes")
    assert_precise(difference(found, slope), 0.05 * abs(float(slope.mean)), what="slopes")


def _world(unit: float) -> dict:
    """A ball of fog in a ball of haze above a wooden ball, in lengths of ``unit``."""
    place = turn().scale(unit)
    haze = medium("homogeneous", 0.5 / unit, 0.6)
    fog_in_it = {"type": "sphere", "to_world": place @ turn().scale(0.3), "bsdf": {"type": "null"}, "exterior": haze}
    eye = place @ turn().look_at([0.5, 0.4, 1.0], [0, 0, 0], [0, 1, 0]) @ turn().scale(1 / unit)
    return {
        "type": "scene",
        "outer": {"type": "sphere", "to_world": place @ turn().scale(0.4), "bsdf": {"type": "null"}, "interior": haze},
        "inner": fog_in_it | {"interior": medium("homogeneous", 4.0 / unit, 0.8)},
        "wood": {"type": "sphere", "to_world": place @ turn().translate([0, -0.6, 0]).scale(0.15)},
        "sky": {"type": "constant"},
        "sensor": scenes.camera((0, 0, 1), (0, 0, 0), res=8, fov=60.0) | {"to_world": eye, "near_clip": 1e-2 * unit},
    }


@pytest.mark.slow_for("0.0078125")
@pytest.mark.parametrize("unit", [2.0**-7, 2.0**-14])
def test_scenes_of_any_size(unit):
    """Another unit of length gives the same image. Mitsuba starts rays 1e-4 behind a surface, for any size of the scene."""
    big, small_one = (
        np.array(mi.render(mi.load_dict(_world(u)), integrator=mi.load_dict(mivol()), spp=64)) for u in (1.0, unit)
    )
    # A power of two changes no rounding but that of Mitsuba's own constants (a few float32 eps of each of 64 samples).
    np.testing.assert_allclose(small_one, big, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.statistical
def test_hidden_emitters():
    """hide_emitters removes the emitters from the image, and not their light on the smoke."""
    parts = {"smoke": smoke(rough_grid(5))[0], "emitter": area(0.0, 2.0, 0.0, size=1.0), "sky": scenes.sky(0.5)}
    image, _ = same(parts, ours=mivol(hide_emitters=True), stock=volpath(hide_emitters=True))
    shown = moments(close_up(parts), mivol(), 32, 2)
    assert shown.mean.max() > 4 > image.mean.max() > 0.01


@pytest.mark.statistical
@pytest.mark.slow
def test_a_medium_that_asks_for_no_emitter_sampling():
    """sample_emitters = false changes the sampling of the sky's light, and not its amount."""
    plain = grid_in(cube(PLACE))
    quiet = grid_in(cube(PLACE), sample_emitters=False)
    sky = scenes.sky(0.7)
    a, b = (moments(close_up({"smoke": p, "sky": sky}), mivol(), 32) for p in (plain, quiet))
    small.assert_same_whole(a, b)
    assert_same_images(close_up({"smoke": quiet, "sky": sky}), rounding=LEAK)


# -- Extinction in rgb: volpath one channel at a time ----------------------------------------------------------------


def channel_by_channel(build, spp: int, batches: int = 16) -> Moments:
    """Volpath's mean of each channel, from a grey scene of its own made by `build(c)`."""
    alone = [moments(close_up(build(c)), volpath(), spp, batches, first=1000 * (c + 1)) for c in range(3)]
    mean, m2 = (np.stack([getattr(m, k)[..., c] for c, m in enumerate(alone)], axis=-1) for k in ("mean", "m2"))
    return Moments(batches, mean, m2)


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("ratio", [(2.0, 6.0, 9.0), (0.02, 1.0, 0.0)])
@pytest.mark.parametrize("kind", small.KINDS)
def test_rgb_extinction(kind, ratio):
    values = rough_grid(6, 1.0)
    medium_type, volume_type = small.KINDS[kind]
    emitters = {"bulb": point([1.6, -1.3, 1.7])[0], "sky": scenes.sky(0.3)}

    def parts(sigma_t):
        grid = grid_volume(volume_type, as_float32(sigma_t), PLACE)
        return {"smoke": box_of(medium(medium_type, grid, 0.8, phase={"type": "hg", "g": 0.3}), PLACE), **emitters}

    ours = moments(close_up(parts(values * np.array(ratio))), mivol(), 64)
    judge = channel_by_channel(lambda c: parts(values * ratio[c]), 64)
    assert_same_mean(ours, judge, tile=4, rounding=LEAK, what="tiles")
    small.assert_same_whole(ours, judge, rounding=LEAK)


# -- Depth, and what is refused --------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.slow
def test_depth_2_is_one_turn():
    """Depth 1 is the background alone; depth 2 adds single scattering only: dense smoke of albedo 1 stays below 1. Hard case
    46.
    """
    box, _ = smoke(rough_grid(7, 12.0), albedo=1.0)
    scene = close_up({"smoke": box, "sky": scenes.sky(1.0)})
    two, _ = assert_same_images(scene, rounding=LEAK)
    orders = moments(scene, mivol(max_depth=1), 16), two, moments(scene, volpath(max_depth=4), 16)
    one, two, deeper = (Estimate(*(x[0] for x in over_pixels(m))) for m in orders)
    # Measured once: 0.07, 0.33 and 0.56.
    assert_apart(two, one, expected=0.26, what="one turn and none")
    assert_apart(deeper, two, expected=0.23, what="four turns and one")


# -- Samplers, recordings, variants --------------------------------------------------------------------------------------


SAMPLERS = ("stratified", "multijitter", "orthogonal", "ldsampler")
SPREAD = {"stratified": (2.83, 1.6, np.inf), "orthogonal": (0.5, 0.0, 0.8), "ldsampler": (1.86, 1.3, np.inf)}
"""Variance over the variance of the default's points, a mean over 96 seeds, and its bounds. `multijitter` leaves 1.23, too near
1 for so few renders."""


@pytest.mark.slow_for("multijitter")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.cases(SAMPLERS, [name for name in SAMPLERS if name != "multijitter"]))
def test_samplers(kind):
    """A scene's own sampler draws its own numbers: they have the mean of the default's points, and another noise.

    Thin smoke in front of a sky varying over a pixel: most noise is due to the position in the pixel, which good samplers
    stratify.
    """
    spp = 49 if kind == "orthogonal" else 64
    sky = np.random.default_rng(3).uniform(0, 1, (8, 16, 1)) ** 4 * np.ones(3)
    parts = {"smoke": smoke(0.2 * rough_grid(1), name="hg", g=0.4)[0]}
    parts["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))}
    found = {}
    for sampler in ("independent", kind):
        sensor = scenes.camera((1.5, -2.5, 1.2), (0, 0, 0), res=8, fov=40.0)
        sensor["sampler"] = {"type": sampler, "sample_count": spp}
        # Ratios spread by 8 % over 16 renders: of that, `ldsampler` is 4 standard deviations from the bound, and 6 over 32.
        batches = 32 if kind == "ldsampler" else 16
        found[sampler] = moments(mi.load_dict({"type": "scene", **parts, "sensor": sensor}), mivol(), spp, batches)
    small.assert_same_whole(found["independent"], found[kind], precision=0.02)
    if kind in SPREAD:
        grey = [Estimate(m.mean[..., 0], m.variance_of_mean[..., 0], m.n - 1) for m in (found[kind], found["independent"])]
        expected, low, high = SPREAD[kind]
        assert_same_spread(*grey, expected=expected, low=low, high=high, what=kind)


@pytest.mark.slow_for("own")
@pytest.mark.parametrize("kind", small.KINDS)
def test_recordings(kind):
    """A function recorded by dr.freeze gives the image of an ordinary render, also after values have changed."""
    if kind == "own":
        scenes.skip_recorded_grids_on_a_gpu()
    parts = {"smoke": smoke(rough_grid(1), kind=kind, name="hg", g=0.4)[0], "bulb": point([1.5, -1.2, 1.6])[0]}
    scene, integrator = close_up({**parts, "sky": scenes.sky(0.3)}, res=8), mi.load_dict(mivol())
    params, key = mi.traverse(scene), "smoke.interior_medium.sigma_t.data"

    def shoot(scene: mi.Scene, integrator: mi.Integrator, seed: mi.UInt32) -> mi.TensorXf:
        return mi.render(scene, integrator=integrator, spp=4, seed=seed)

    frozen = dr.freeze(shoot)
    for call in range(4):
        params[key] = scenes.tensor(rough_grid(1) * (1 + 0.5 * call))
        params.update()
        image, replayed = (np.array(f(scene, integrator, mi.UInt32(call))) for f in (shoot, frozen))
        assert np.allclose(replayed, image, rtol=1e-5, atol=1e-7)
    assert frozen.n_recordings < 4


@pytest.mark.slow
@pytest.mark.statistical
def test_a_mono_variant():
    """One channel, compared with volpath in the same variant."""
    mi.set_variant("llvm_ad_mono")
    sensor = scenes.camera((1.5, -2.5, 1.2), (0, 0, 0), res=16, fov=40.0)
    sensor["film"]["pixel_format"] = "luminance"
    parts = lit({"smoke": grid_in(cube(PLACE), "own")})
    assert_same_images(mi.load_dict({"type": "scene", **parts, "sensor": sensor}), channels=1, rounding=LEAK)


# -- Scenes of a stranger --------------------------------------------------------------------------------------------

STRANGERS = (
    "test_homo_area_light", "test_homo_obj_inside_medium", "test_surf_area_light", "test_hetero_sigmat",
    "test_hetero_spectral_sigmat_no_scattering", "test_homo_null_envmap",
)  # fmt: skip


@pytest.mark.statistical
@pytest.mark.filterwarnings("ignore:the heterogeneous medium inside", "ignore:the medium inside")
@pytest.mark.slow
@pytest.mark.parametrize("name", STRANGERS)
def test_scenes_of_a_stranger(two_threads, name, data_dir, tmp_path):
    """The scenes of Mitsuba's own tests of volumetric integrators, at depth 2, rendered by the reference tool: each channel
    alone for an rgb extinction.
    """
    folder = data_dir / "scenes" / "mitsuba-data" / "tests" / "scenes" / "participating_media"
    file, settings = folder / f"{name}_volpath.xml", {"res": "16"}
    how = {"max_depth": 2, "max_spp": 1024, "rr_depth": 100, "accept_doubts": True, "progress": False}
    judge = render_reference(file, tmp_path / "judge.exr", overrides=settings, **how)
    image = moments(mi.load_file(str(file), **settings), mivol(), 32)
    known = Estimate(judge.mean, judge.variance, judge.batches - 1)
    assert_same_mean(image, known, tile=4, rounding=1e-3 * judge.mean.max(), what=name)
