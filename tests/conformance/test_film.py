"""The image does not depend on the split of its samples, and equals Mitsuba's image for every film, filter, crop and sensor."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import (
    Estimate,
    assert_precise,
    assert_same_mean,
    assert_same_spread,
    assert_within,
    difference,
    fresh,
    over_pixels,
)
from scattering_scenes import cases

import scenes
from mivol.scene import plan, session
from mivol.transport.path import film
from mivol.transport.path.film import count_passes
from mivol.validate.statistics import Moments
from scenes import box_of, camera, grid_volume, medium, sky

PLACE = scenes.centred(2 * np.eye(3))


def parts(sensor: dict) -> dict:
    """A volume in front of a bright wall hiding half of the sky."""
    values = np.random.default_rng(5).uniform(0, 2, (4, 5, 6, 1)).astype(np.float32)
    return {
        "type": "scene",
        "box": box_of(medium("heterogeneous", grid_volume("gridvolume", values, PLACE)), PLACE),
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0.5, 0, -2]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}},
        },
        "sky": sky(0.5),
        "sensor": sensor,
    }


def sensor_of(kind: str = "perspective", rfilter: str = "box", **film: object) -> dict:
    made = camera((0.3, 0.2, 4.0), (0.0, 0.0, 0.0), res=12, fov=40.0)
    made["type"] = kind
    made["film"] |= {"rfilter": {"type": rfilter}, **film}
    if kind == "thinlens":
        made |= {"aperture_radius": 0.2, "focus_distance": 4.0}
    if kind == "orthographic":
        del made["fov"]
        made["to_world"] = made["to_world"] @ mi.ScalarTransform4f().scale([1.5, 1.5, 1])
    return made


def moments(scene: mi.Scene, integrator: mi.Integrator, spp: int, first: int, batches: int = 12) -> Moments:
    """Mean and its variance over independent images."""
    images = [np.array(mi.render(scene, integrator=integrator, spp=spp, seed=fresh(first + seed))) for seed in range(batches)]
    return Moments.from_values(np.stack(images))


CAMERAS = {
    "perspective": sensor_of,
    "gaussian filter": lambda: sensor_of(rfilter="gaussian"),
    "lanczos filter": lambda: sensor_of(rfilter="lanczos"),
    "crop": lambda: sensor_of(rfilter="gaussian", crop_width=7, crop_height=5, crop_offset_x=3, crop_offset_y=2),
    "border": lambda: sensor_of(rfilter="gaussian", sample_border=True),
    "thin lens": lambda: sensor_of("thinlens"),
    "orthographic": lambda: sensor_of("orthographic"),
    "rgba": lambda: sensor_of(pixel_format="rgba"),
    "luminance": lambda: sensor_of(pixel_format="luminance"),
}


@pytest.mark.slow_for("crop", "luminance", "thin lens")
@pytest.mark.statistical
@pytest.mark.parametrize(
    "name", cases(CAMERAS, ["perspective", "gaussian filter", "lanczos filter", "orthographic", "rgba", "border"])
)
def test_same_image_as_volpath(name):
    """Batch means of both, 12 batches of 64 samples: the stock integrator is the reference for film and sensor."""
    scene = mi.load_dict(parts(CAMERAS[name]()))
    ours = moments(scene, mi.load_dict({"type": "mivol", "max_depth": 1}), 64, 0)
    stock = moments(scene, mi.load_dict({"type": "volpath", "max_depth": 1}), 64, 500)
    assert ours.mean.shape == stock.mean.shape
    # Stock measures media from spawned rays, 1e-4 of a length further on: at sigma 2 it lets 2e-4 more through.
    assert_same_mean(ours, stock, rounding=6e-4, what=name)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    "kind", cases(["independent", "stratified", "multijitter", "ldsampler"], ["independent", "stratified", "ldsampler"])
)
def test_split_into_passes(kind, monkeypatch):
    """4 passes of one sample have the mean of one pass of 4 samples."""
    made = sensor_of(rfilter="gaussian")
    made["sampler"] = {"type": kind, "sample_count": 4}
    scene = mi.load_dict(parts(made))
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    whole = moments(scene, integrator, 4, 0, 16)
    monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
    assert count_passes(scene.sensors()[0], 4, 1) == 4
    split = moments(scene, integrator, 4, 900, 16)
    assert_same_mean(whole, split, rounding=1e-5, what=kind)


def draw_independently(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let films draw independent numbers in place of spread points."""

    def independent(pixel: mi.Vector2i, seed: mi.UInt32, sample: mi.UInt32, count: mi.UInt32) -> mi.Sampler:
        sampler = mi.load_dict({"type": "independent"})
        # The first sample of the first pixel is the first of the pass.
        sampler.seed(seed[0] + (sample[0] << 16), dr.width(sample))
        return sampler

    monkeypatch.setattr(film.SpreadSampler, "of_pixels", independent)


@pytest.mark.slow
@pytest.mark.statistical
def test_passes_of_stratified_samples_stay_stratified(monkeypatch):
    """A step across a pixel: n strata leave about n^-1/2 of the variance of n independent samples, whatever the passes."""
    grey = {}
    draw_independently(monkeypatch)
    for kind in ("independent", "multijitter"):
        made = sensor_of(width=24, height=24)
        made["sampler"] = {"type": kind, "sample_count": 9}
        scene = mi.load_dict(parts(made))
        monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
        found = moments(scene, mi.load_dict({"type": "mivol", "max_depth": 1}), 9, 40)
        grey[kind] = Estimate(found.mean[..., 0], found.variance_of_mean[..., 0], found.n - 1)
    # 9^-1/2 is a third; passes that were not stratified together would leave 1.
    assert_same_spread(grey["multijitter"], grey["independent"], expected=1 / 3, high=0.75, what="strata")


def points(sensor: dict, spp: int, pass_rays: int, seed: int = 5) -> dict[tuple[int, int], np.ndarray]:
    """The numbers (samples, 8) of each pixel of the film: on the film, and those of a path; as their bits."""
    found = {}
    for rays in film.film_passes(film.RenderSamples(mi.load_dict(sensor), seed, spp, pass_rays)):
        draws = (*rays.position, rays.sampler.next_lead(), *rays.sampler.next_2d(), rays.sampler.next_1d())
        state = np.array(rays.sampler.next_state())
        values = np.stack([np.array(x).view(np.uint32) for x in draws] + [state], axis=-1)
        for x, y, row in zip(*(np.floor(np.array(v)).astype(int) for v in rays.position), values, strict=True):
            found.setdefault((x, y), []).append(row)
    return {pixel: np.array(rows) for pixel, rows in found.items()}


def test_neither_passes_nor_a_crop_change_the_points_of_a_pixel():
    """To the last bit, in passes of 4 and of 2 samples a pixel, and in a crop; of another seed all numbers differ."""
    whole = points(sensor_of(rfilter="gaussian"), 12, 1 << 20)
    crop = {"crop_width": 7, "crop_height": 5, "crop_offset_x": 3, "crop_offset_y": 2}
    assert len(whole) == 144 and len(points(sensor_of(rfilter="gaussian", **crop), 12, 1 << 20)) == 35
    for made, pass_rays in (
        ({}, 4 * 144),
        ({}, 2 * 144),
        (crop, 1 << 20),
        (crop, 35),
        (crop | {"sample_border": True}, 1 << 20),
    ):
        found = points(sensor_of(rfilter="gaussian", **made), 12, pass_rays)
        inside = found.keys() & whole.keys()
        assert len(inside) >= 35
        assert all(np.array_equal(found[pixel], whole[pixel]) for pixel in inside)
    other = points(sensor_of(rfilter="gaussian"), 12, 1 << 20, seed=6)
    assert not any((other[pixel] == whole[pixel]).any() for pixel in whole)


def test_an_image_of_given_rays_is_that_of_the_sensor():
    """Each ray where the sensor sends it: of passes of 2 samples a pixel, and of light with 2 and 3 rays a pixel of its own."""

    def colour(rays: film.CameraRays) -> mi.Spectrum:
        return mi.Spectrum(*(2 + rays.ray.d))

    lights = [film.LightOfOwnRays(count, colour) for count in (2, 3)]
    samples = film.RenderSamples(mi.load_dict(sensor_of("thinlens", "gaussian")), mi.UInt32(5), 4, 2 * 144)
    given = replace(samples, given=iter(film.sample_rays(samples, [2, 3])))
    found, truth = (
        np.array(film.render_on_film(one, [], lambda rays: (colour(rays), mi.Float(1), []), lights)) for one in (given, samples)
    )
    np.testing.assert_array_equal(found, truth)
    assert next(given.given, None) is None and truth.std() > 0


def test_the_samples_of_a_pixel_are_a_net():
    """Of 16 samples, the cells of 4 x 4, 2 x 8 and 16 x 1 hold one each, in every pixel and in its own order."""
    samples = film.RenderSamples(mi.load_dict(sensor_of(rfilter="gaussian")), 5, 16, 4 * 144)
    position = np.concatenate([np.array(rays.position).T.reshape(144, 4, 2) for rays in film.film_passes(samples)], axis=1) % 1
    for shape in ((4, 4), (2, 8), (16, 1)):
        cell = np.floor(position * shape).astype(int) @ (1, shape[0])
        assert np.array_equal(np.sort(cell), np.broadcast_to(np.arange(16), (144, 16)))
        assert len({tuple(c) for c in cell}) > 100


@pytest.mark.parametrize("kind", ["multijitter", "stratified", "orthogonal", "ldsampler"])
def test_a_sampler_of_the_scene_is_honoured(kind):
    """Positions on the film are the first numbers of that sampler."""
    sensor = mi.load_dict(sensor_of(rfilter="gaussian") | {"sampler": {"type": kind, "sample_count": 9}})
    (rays,) = film.film_passes(film.RenderSamples(sensor, 5, 0, 1 << 20))
    sampler = sensor.sampler().clone()
    sampler.set_samples_per_wavefront(sampler.sample_count())
    sampler.seed(5, dr.width(rays.ray))
    np.testing.assert_allclose(np.array(rays.position) % 1, np.array(sampler.next_2d()), atol=2.0**-20)


def floor_in_smoke(res: int = 8) -> mi.Scene:
    """A floor under a panel of light, and smoke beside it; the camera looks at both."""
    smoke = medium("heterogeneous", grid_volume("gridvolume", np.full((3, 3, 3, 1), 0.7, np.float32), PLACE), 0.6)
    look, T = mi.ScalarTransform4f().look_at, mi.ScalarTransform4f
    made = camera((3.0, 3.0, 5.0), (1.6, 0.0, -1.0), res=res, fov=50.0)
    light = {"type": "rectangle", "to_world": look([2, 0, 4], [2, 0, 0], [0, 1, 0]), "emitter": {"type": "area"}}
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1.001]).scale(8.0)}
    return mi.load_dict({"type": "scene", "box": box_of(smoke, PLACE), "light": light, "floor": floor, "sensor": made})


@pytest.mark.statistical
def test_spread_points_keep_the_mean(monkeypatch):
    """Of free flights and surfaces: 16 images of 64 pixels, beside as many of independent numbers."""
    scene, integrator = floor_in_smoke(), mi.load_dict({"type": "mivol", "max_depth": 4})
    spread = moments(scene, integrator, 32, 0, 16)

    draw_independently(monkeypatch)
    truth = moments(scene, integrator, 32, 7000, 16)
    assert_same_mean(spread, truth, tile=4, what="tiles")
    assert_same_mean(over_pixels(spread), over_pixels(truth), what="all pixels")
    assert_precise(difference(over_pixels(spread), over_pixels(truth)), 0.02 * over_pixels(truth).mean, what="all pixels")


@pytest.mark.statistical
def test_the_error_of_a_floor_falls_faster_than_by_chance():
    """Light of a panel on a floor, in pixels so small that it depends on the two numbers of the emitter, and on the two of the
    BSDF: directions that meet the panel or miss it, a step. Of 16 times as many samples a variance of 16^-1.5 is left;
    independent numbers would leave 1/16.
    """
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(8.0)}
    look = mi.ScalarTransform4f().look_at
    light = {"type": "rectangle", "to_world": look([2, 0, 4], [2, 0, 0], [0, 1, 0]), "emitter": {"type": "area"}}
    made = camera((3.0, 3.0, 5.0), (1.6, 0.0, -1.0), res=8, fov=2.0)
    scene = mi.load_dict({"type": "scene", "light": light, "floor": floor, "sensor": made})
    integrator = mi.load_dict({"type": "mivol", "max_depth": 2})
    few, many = (moments(scene, integrator, spp, first, 16) for spp, first in ((16, 0), (256, 3000)))
    share = many.variance_of_mean[..., 0].mean() / few.variance_of_mean[..., 0].mean()
    # 64 pixels of 16 images bring at least 200 degrees of freedom, and F(200, 200) exceeds 64/24
    # with a chance of 6e-12.
    assert_within(share, 1 / 24, chance=6e-12, what="share of the variance")


@pytest.mark.statistical
def test_seeds_are_not_correlated():
    """The errors of two seeds in each of 64 pixels have no common part, nor do those of neighbouring pixels."""
    scene, integrator = floor_in_smoke(), mi.load_dict({"type": "mivol", "max_depth": 4})
    images = np.stack([np.array(mi.render(scene, integrator=integrator, spp=4, seed=fresh(s)))[..., 0] for s in range(64)])
    error = images - images.mean(axis=0)
    # Errors from the mean of 64 images have a correlation of -1/63.
    share = np.sum(error[::2] * error[1::2], axis=0) + np.sum(error**2, axis=0) / 2 / 63
    beside = error[:, :, ::2] * error[:, :, 1::2]
    assert_same_mean(Moments.from_values(share.reshape(-1, 1)), 0, what="seeds")
    assert_same_mean(Moments.from_values(beside.mean(axis=(1, 2))[:, None]), 0, what="pixels")


def test_a_new_seed_compiles_nothing(monkeypatch):
    """A kernel contains no seed: only the first render of a scene is compiled, if renders are traced in every call."""
    monkeypatch.setattr(session, "find_unrecorded", lambda *_: "every call is traced")
    smoke = medium("heterogeneous", grid_volume("gridvolume", np.ones((4, 5, 6, 1), np.float32), PLACE), 0.5)
    scene = mi.load_dict({"type": "scene", "box": box_of(smoke, PLACE), "sky": sky(0.5), "sensor": sensor_of()})
    integrator, seen = mi.load_dict({"type": "mivol", "max_depth": 2}), []
    for seed in (7, 1234, 99):
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.eval(mi.render(scene, integrator=integrator, spp=8, seed=seed))
            # Not by cache hits: a cache on disk holds the kernels of earlier runs.
            seen.append({k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT})
    assert seen[0] and seen[1] | seen[2] <= seen[0]


def test_batch_sensor():
    """Several cameras in one film."""
    one, two = sensor_of(), sensor_of()
    two["to_world"] = mi.ScalarTransform4f().look_at([2, 3, 1], [0, 0, 0], [0, 1, 0])
    film = one["film"] | {"width": 24}
    for made in (one, two):
        del made["film"], made["sampler"]
    batch = {"type": "batch", "a": one, "b": two, "film": film, "sampler": {"type": "independent"}}
    scene = mi.load_dict(parts(batch))
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    ours = np.array(mi.render(scene, integrator=integrator, spp=64))
    alone = np.array(mi.render(mi.load_dict(parts(sensor_of())), integrator=integrator, spp=64))
    # 144 pixels with a standard deviation below 1 of 64 samples each: the mean is known to 0.01.
    assert abs(ours[:, :12].mean() - alone.mean()) < 0.05
    assert abs(ours[:, 12:].mean() - alone.mean()) > 0.05


def test_many_views_share_their_kernels():
    """A second camera of the same size compiles nothing."""
    import drjit as dr

    integrator = mi.load_dict({"type": "mivol", "max_depth": 2})
    scene = mi.load_dict(parts(sensor_of()))
    places = [mi.ScalarTransform4f().look_at([k, 1, 4], [0, 0, 0], [0, 1, 0]) for k in range(3)]
    views = [mi.load_dict(sensor_of() | {"to_world": place}) for place in places]
    mi.render(scene, integrator=integrator, sensor=views[0], spp=2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed, view in enumerate(views[1:]):
            dr.eval(mi.render(scene, integrator=integrator, sensor=view, spp=2, seed=seed))
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(k["cache_hit"] for k in kernels)


def test_a_scene_that_holds_its_integrator_is_freed():
    """The integrator must not hold the scene: Mitsuba counts references, and traces each call of a medium, emitter or BSDF for
    every object left over (fits were 20 times slower after 80 scenes).
    """
    scene = mi.load_dict(parts(sensor_of()) | {"integrator": {"type": "mivol", "max_depth": 2}})
    mi.render(scene, spp=1)
    integrator = weakref.ref(scene.integrator())
    del scene
    gc.collect()
    assert integrator() is None


def test_one_integrator_on_two_scenes():
    """The same integrator, used on two scenes, keeps nothing of the first (prbvolpath does: 5.4 times too dark)."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    full = mi.load_dict(parts(sensor_of()))
    bare = parts(sensor_of())
    del bare["box"]
    bare = mi.load_dict(bare)
    fresh = np.array(mi.render(bare, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=4))
    mi.render(full, integrator=integrator, spp=4)
    assert np.array_equal(np.array(mi.render(bare, integrator=integrator, spp=4)), fresh)
