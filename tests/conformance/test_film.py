"""The image does not depend on the split of its samples, and equals Mitsuba's image for every film, filter, crop and sensor."""

from __future__ import annotations

import gc
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean, assert_same_spread, fresh
from scattering_scenes import cases

import scenes
from mivol.scene import plan
from mivol.transport.path import film
from mivol.transport.path.film import count_passes
from mivol.validate.moments import Moments
from scenes import box_of, camera, grid_volume, medium, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")

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


@pytest.mark.slow
@pytest.mark.statistical
def test_passes_of_stratified_samples_stay_stratified(monkeypatch):
    """A step across a pixel: n strata leave about n^-1/2 of the variance of n independent samples, whatever the passes."""
    grey = {}
    for kind in ("independent", "multijitter"):
        made = sensor_of(width=24, height=24)
        made["sampler"] = {"type": kind, "sample_count": 9}
        scene = mi.load_dict(parts(made))
        monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
        found = moments(scene, mi.load_dict({"type": "mivol", "max_depth": 1}), 9, 40)
        grey[kind] = Estimate(found.mean[..., 0], found.variance_of_mean[..., 0], found.n - 1)
    # 9^-1/2 is a third; passes that were not stratified together would leave 1.
    assert_same_spread(grey["multijitter"], grey["independent"], expected=1 / 3, high=0.75, what="strata")


@pytest.mark.slow
@pytest.mark.statistical
def test_pixels_are_not_correlated_between_passes(monkeypatch):
    """Each pass draws its own numbers: the variance of the mean falls as 1/passes."""
    scene = mi.load_dict(parts(sensor_of()))
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
    one, many = (moments(scene, integrator, spp, first, 64) for spp, first in ((1, 0), (4, 5000)))
    one, many = (Estimate(m.mean[..., 0], m.variance_of_mean[..., 0], m.n - 1) for m in (one, many))
    # The pixels at the edges bring some 700 degrees of freedom: each variance is known to 5 %; a repeated pass would give 1.
    assert_same_spread(many, one, expected=1 / 4, low=0.6 / 4, high=1.7 / 4, what="passes")


@pytest.mark.parametrize("layout", [film.SPREAD, film.TILED])
def test_samples_of_a_pixel_share_it_out(layout):
    """Of 12 samples, each cell of 3 x 4 holds one, in an order of its own in each tile or pixel."""
    # A box filter would count all samples of a pixel at its corner.
    samples = film.RenderSamples(mi.load_dict(sensor_of(rfilter="gaussian")), 5, 12, 1 << 20, layout)
    (rays,) = film.film_passes(samples)
    x, y = (np.array(v) for v in (rays.position.x, rays.position.y))
    pixel = np.floor(x).astype(int) + 12 * np.floor(y).astype(int)
    cell = np.floor(x % 1 * 3).astype(int) + 3 * np.floor(y % 1 * 4).astype(int)
    order = [cell[pixel == p] for p in range(144)]
    assert all(np.array_equal(np.sort(c), np.arange(12)) for c in order)
    assert len({tuple(c) for c in order}) == (9 if layout == film.TILED else 144)


def test_a_new_seed_compiles_nothing():
    """A kernel contains no seed: only the first render of a scene is compiled."""
    smoke = medium("heterogeneous", grid_volume("gridvolume", np.ones((4, 5, 6, 1), np.float32), PLACE), 0.5)
    scene = mi.load_dict({"type": "scene", "box": box_of(smoke, PLACE), "sky": sky(0.5), "sensor": sensor_of()})
    integrator, compiled = mi.load_dict({"type": "mivol", "max_depth": 2}), []
    for seed in (7, 1234, 99):
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.eval(mi.render(scene, integrator=integrator, spp=8, seed=seed))
            kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        compiled.append(sum(not k["cache_hit"] for k in kernels))
    assert compiled[1:] == [0, 0]


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
