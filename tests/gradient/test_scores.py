"""Derivatives of images: forward against reverse, both against finite differences, through every film and depth."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import cases

import scenes
from mivol.scene import plan
from scenes import box_of, camera, grid_volume, medium, sky

pytestmark = pytest.mark.usefixtures("two_threads")

GRID = "box.interior_medium.sigma_t.data"
PLACE = scenes.centred(2 * np.eye(3))
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
GREEN = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.6, 0.3]}}


def values(channels: int = 1) -> np.ndarray:
    """A rough grid, nowhere near 0, so that a finite difference cannot leave the domain."""
    return np.random.default_rng(3).uniform(0.2, 2.0, (5, 4, 6, channels)).astype(np.float32)


def build(
    channels: int = 1, rfilter: str = "box", crop: bool = False, kind: str = "mivol_medium", lit: bool = True
) -> mi.Scene:
    """A volume with a ball in it over a floor, under an emitter and a sky."""
    volume = "mivol_voxels" if kind == "mivol_medium" else "gridvolume"
    parts = {
        "type": "scene",
        "box": box_of(medium(kind, grid_volume(volume, values(channels), PLACE), scale=1.5), PLACE),
        "sky": sky(0.3),
        "sensor": camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=10, fov=45.0),
    }
    if lit:
        turn = mi.ScalarTransform4f
        parts["floor"] = {
            "type": "rectangle",
            "bsdf": RED,
            "to_world": turn().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(5),
        }
        parts["ball"] = {"type": "sphere", "radius": 0.4, "bsdf": GREEN}
        parts["emitter"] = {
            "type": "rectangle",
            "to_world": turn().translate([0, 3, 0]).rotate([1, 0, 0], 90),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        }
    film = parts["sensor"]["film"]
    film["rfilter"] = {"type": rfilter}
    if crop:
        film |= {"crop_width": 5, "crop_height": 3, "crop_offset_x": 2, "crop_offset_y": 4}
    return mi.load_dict(parts)


def jvp(scene: mi.Scene, integrator: mi.Integrator, key: str, v: np.ndarray, seed: int, spp: int) -> np.ndarray:
    """J v: the derivative of the image along v."""
    params = mi.traverse(scene)
    kind = type(params[key])
    dr.enable_grad(params[key])
    dr.set_grad(params[key], kind(v.astype(np.float32)))
    image = np.array(integrator.render_forward(scene, params, seed=seed, spp=spp), dtype=np.float64)
    dr.disable_grad(params[key])
    return image


def vjp(scene: mi.Scene, integrator: mi.Integrator, key: str, w: np.ndarray, seed: int, spp: int) -> np.ndarray:
    """J^T w: the derivative of <w, image>."""
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    integrator.render_backward(scene, params, mi.TensorXf(w.astype(np.float32)), seed=seed, spp=spp)
    gradient = np.array(dr.grad(params[key]), dtype=np.float64)
    dr.disable_grad(params[key])
    return gradient


def image(scene: mi.Scene, integrator: mi.Integrator, seed: int, spp: int) -> np.ndarray:
    return np.array(integrator.render(scene, seed=seed, spp=spp), dtype=np.float64)


CASES = {
    "depth 1": {"depth": 1},
    "depth 2": {"depth": 2},
    "depth 4, wide filter": {"depth": 4, "rfilter": "gaussian"},
    "no limit, crop": {"depth": -1, "crop": True},
    "rgb, depth 2": {"depth": 2, "channels": 3},
    "stock, depth 3, crop, wide filter": {"depth": 3, "kind": "heterogeneous", "crop": True, "rfilter": "gaussian"},
    "no surface": {"depth": 6, "lit": False},
}


@pytest.mark.slow_for("depth 4, wide filter-4", "no limit, crop-4", "stock, depth 3, crop, wide filter-4")
@pytest.mark.parametrize("passes", [pytest.param(1, marks=pytest.mark.slow), 4])
@pytest.mark.parametrize("name", cases(CASES, ["depth 1", "depth 2", "rgb, depth 2", "no surface"]))
def test_forward_against_reverse(name, passes, monkeypatch):
    """<J v, w> = <v, J^T w> with the same random numbers: no step size at all, whatever the film and the passes."""
    case = dict(CASES[name])
    integrator = mi.load_dict({"type": "mivol", "max_depth": case.pop("depth")})
    scene = build(**case)
    rng = np.random.default_rng(1)
    spp = 4
    shape = image(scene, integrator, 0, spp).shape
    if passes > 1:
        monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
    v, w = rng.uniform(size=values(case.get("channels", 1)).shape), rng.uniform(size=shape)
    jv = jvp(scene, integrator, GRID, v, 7, spp)
    jtw = vjp(scene, integrator, GRID, w, 7, spp)
    # Float32 sums of 100 pixels and 120 voxels, each to 6e-8 of its size: 1e-6 leaves a factor of ten.
    assert abs((jv * w).sum() - (jtw * v).sum()) <= 1e-6 * np.abs(jv).sum()
    assert np.abs(jv).max() > 0.01


@pytest.mark.slow_for("no limit, crop", "rgb, depth 2")
@pytest.mark.parametrize("name", cases(CASES, ["depth 1", "depth 2"]))
def test_reverse_against_finite_differences(name):
    """Central differences with common random numbers; error h^2 f'''/6 plus rounding 1e-7/h."""
    case = dict(CASES[name])
    integrator = mi.load_dict({"type": "mivol", "max_depth": case.pop("depth")})
    scene = build(**case)
    params = mi.traverse(scene)
    start = values(case.get("channels", 1))
    rng = np.random.default_rng(2)
    v = rng.uniform(size=start.shape)
    h = 0.02

    def at(x: np.ndarray) -> np.ndarray:
        params[GRID] = mi.TensorXf(x.astype(np.float32))
        params.update()
        return image(scene, integrator, 11, 8)

    far, near = at(start + h * v), at(start - h * v)
    at(start)
    jv = jvp(scene, integrator, GRID, v, 11, 8)
    # Along v a pixel is a sum of exp(-a h) with a <= 7 (the mean of v times 1.5 times paths up to 9 long): h^2 a^3 / 6 L is
    # 0.023 L at the very worst, 1e-3 L at the mean; rounding adds 2e-7 / 0.02 = 1e-5 L.
    assert np.abs((far - near) / (2 * h) - jv).max() <= 4e-3 * np.abs(jv).max()


OTHERS = [
    ("box.interior_medium.scale", 2),
    ("sky.radiance.value", 1),
    ("emitter.emitter.radiance.value", 2),
    ("floor.bsdf.reflectance.value", 2),
    ("floor.bsdf.reflectance.value", 4),
    ("sky.radiance.value", 3),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "depth"), cases(OTHERS, [("floor.bsdf.reflectance.value", 2), ("sky.radiance.value", 1), ("sky.radiance.value", 3)])
)
def test_other_parameters_against_finite_differences(key, depth):
    """The scale of a medium, the radiance of emitters and the colour of surfaces have their derivatives too."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth, "rr_depth": 100})
    scene = build()
    params = mi.traverse(scene)
    kind = type(params[key])
    start = kind(params[key])  # a copy: the parameter itself is about to change in place
    h = 0.02

    def at(x: object) -> np.ndarray:
        params[key] = kind(x)
        params.update()
        return image(scene, integrator, 5, 16)

    difference = (at(start + h) - at(start - h)) / (2 * h)
    at(start)
    w = np.random.default_rng(4).uniform(size=difference.shape)
    gradient = vjp(scene, integrator, key, w, 5, 16)
    one = np.ones(np.array(start).shape)
    jv = jvp(scene, integrator, key, one, 5, 16)
    # Radiance enters linearly, reflectance as a polynomial of degree 3, the scale as exp(-a h), a <= 6: h^2 a^2 / 6 = 2.4e-3.
    # BSDF sampling follows the reflectance only through its colour, not its direction, so the same paths are compared.
    assert np.abs(difference - jv).max() <= 5e-3 * np.abs(difference).max() + 1e-4
    assert abs(gradient.sum() - (difference * w).sum()) <= 5e-3 * np.abs(difference * w).sum()
    assert np.abs(difference).max() > 0.01


def test_gradient_where_prbvolpath_has_none():
    """Albedo 0 and density equal to the majorant: the gradient is -L times the row of A, where stock says 0."""
    place = PLACE
    flat = np.full((2, 2, 2, 1), 0.5, dtype=np.float32)
    scene = mi.load_dict(
        {
            "type": "scene",
            "box": box_of(medium("heterogeneous", grid_volume("gridvolume", flat, place)), place),
            "sky": sky(),
            "sensor": scenes.pencil((0.1, 0.2, 5.0), (0.0, 0.0, -1.0)),
        }
    )
    integrator = mi.load_dict({"type": "mivol"})
    gradient = vjp(scene, integrator, GRID, np.ones((1, 1, 3)), 0, 1)
    # Three channels, each with d/dsigma_k sum = -T times the chord of 2; float32 sums of a few numbers.
    assert gradient.sum() == pytest.approx(-3 * 2 * np.exp(-1.0), rel=2e-6)


def test_replay_counts_down_to_zero():
    """The adjoint passes all the light by that the render found: what is left is rounding."""
    from mivol.scene.needs import find_needs
    from mivol.scene.plan import build_estimators
    from mivol.scene.survey import survey_scene
    from mivol.transport.estimators.scores import Primal, Replay
    from mivol.transport.path.estimators import Settings
    from mivol.transport.path.walk import walk_path

    scene = build()
    sensor = scene.sensors()[0]
    settings = Settings(max_depth=5)
    survey = survey_scene(scene)
    needs = find_needs(scene, sensor, survey)
    estimators = build_estimators(scene, needs, plan.make_plan(needs, settings), settings, survey, for_images=False)
    sampler = sensor.sampler().clone()
    n = 2000
    position = mi.Point2f(np.random.default_rng(0).uniform(size=(2, n)).astype(np.float32))
    ray, _ = sensor.sample_ray(0, 0, position, mi.Point2f(0.5))
    with dr.suspend_grad():
        sampler.seed(3, n)
        L = walk_path(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, n)))[0].L
        dr.eval(L)
        sampler.seed(3, n)
        estimators.media.start_gradients()
        left = walk_path(estimators, sampler, ray, Replay(L, dr.zeros(mi.Spectrum, n)))[0].L
    # Five additions and subtractions of float32 numbers of the size of L.
    assert np.abs(np.array(left)).max() <= 1e-6 * np.abs(np.array(L)).max()
    # Some paths find more than the sky's 0.3.
    assert np.array(L).max() > 0.4
