"""Gaussians in a scene: what rays lose in them, what they scatter and what shadows they cast, and what is refused.

The truth of absorption is the float64 twin, along the very rays of the camera; that of scattering is Mitsuba's volpath, which
tracks against a majorant of the same extinction and shares no estimator with mivol.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, fresh
from gaussian_scenes import SIDE, boxed, camera_rays, cloud, pinhole, render, tensors_of

from mivol.errors import MivolError
from mivol.experiments.script import explain
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS
from mivol.points import write_gaussians
from mivol.points.gaussians import Gaussians
from mivol.splatting import Splatter, to_tensors

SKY, SCALE = 0.8, 1.3

POINT = {"type": "point", "position": [1.5, 2.0, 2.5], "intensity": 10.0}


def volume(gaussians: Gaussians, **more: object) -> dict:
    return tensors_of(gaussians, EXTINCTION_PARAMETERS, **more)


def scene(sigma_t: dict, albedo: object = 0.0, emitter: dict | None = None, fov: float = 25.0, **medium: object) -> mi.Scene:
    inside = {"type": "mivol_medium", "sigma_t": sigma_t, "albedo": albedo, "scale": SCALE, **medium}
    light = emitter or {"type": "constant", "radiance": SKY}
    return boxed(inside, {"type": "perspective", "fov": fov}, light=light)


# -- Absorption --------------------------------------------------------------------------------------------------------------


def test_light_behind_is_dimmed_as_the_twin_says() -> None:
    """A ``tau`` AOV of each pixel, and the sky through it; a to_world moves and turns all of them."""
    gaussians = cloud(20)
    turned = mi.ScalarTransform4f().translate([0.1, -0.2, 0.3]).rotate([0.6, 0, 0.8], 40)
    place = np.array(turned.matrix, np.float64)
    for to_world, move in ((None, np.eye(4)), (turned, place)):
        found = scene(volume(gaussians, **({} if to_world is None else {"to_world": to_world})))
        seen = render(found, seed=3, aovs="tau,alpha")
        tau = seen[..., 3].ravel()
        o, d = camera_rays(found, 3)
        back = np.linalg.inv(move)
        local = o @ back[:3, :3].T + back[:3, 3], d @ back[:3, :3].T
        truth = SCALE * oracle.optical_depth(oracle.Cloud.of(gaussians), *local, np.zeros(len(o)), np.full(len(o), np.inf))
        assert truth.max() > 1
        # Places in a box of 4 are known to 5e-7, 6e-6 of the smallest scale, and a depth changes by at most 4 of it.
        np.testing.assert_allclose(tau, truth, rtol=5e-5, atol=5e-5)
        np.testing.assert_allclose(seen[..., 0].ravel(), SKY * np.exp(-truth), rtol=2e-4)
        np.testing.assert_allclose(seen[..., 4].ravel(), 1 - np.exp(-truth), atol=5e-5)


def test_a_picture_has_derivatives_by_every_parameter() -> None:
    """Finite differences of the twin along the same rays; reverse and forward mode agree."""
    gaussians, rng = cloud(4), np.random.default_rng(1)
    found = scene(volume(gaussians))
    o, d = camera_rays(found, 5)
    t0, t1 = np.zeros(len(o)), np.full(len(o), np.inf)
    twin = oracle.Cloud.of(gaussians)
    cut = oracle.find_cut(twin, o, d, t0, t1)
    weight = rng.normal(size=len(o))
    value = lambda c: SKY * weight @ np.exp(-SCALE * oracle.optical_depth(c, o, d, t0, t1, cut))  # noqa: E731
    integrator, params = mi.load_dict({"type": "mivol", "max_depth": 1}), mi.traverse(found)
    keys = {name: f"cloud.interior_medium.sigma_t.{name}" for name in EXTINCTION_PARAMETERS}
    for key in keys.values():
        dr.enable_grad(params[key])
    params.update()
    by_pixel = np.repeat((weight / 3).reshape(SIDE, SIDE, 1), 3, axis=2)
    integrator.render_backward(found, params, mi.TensorXf(by_pixel.astype(np.float32)), seed=5, spp=1)
    found_by = {name: np.array(dr.grad(params[key]), np.float64) for name, key in keys.items()}
    along = 0.0
    for name, key in keys.items():
        change = rng.normal(size=found_by[name].shape)
        step = 1e-5
        truth = (value(twin.moved(name, step * change)) - value(twin.moved(name, -step * change))) / (2 * step)
        # Each of the 144 rays has a derivative that is known to 1e-4 of the largest.
        assert (found_by[name] * change).sum() == pytest.approx(truth, rel=1e-3, abs=1e-3), name
        dr.set_grad(params[key], mi.TensorXf(change.astype(np.float32)))
        along += (found_by[name] * change).sum()
    tangent = np.array(integrator.render_forward(found, params, seed=5, spp=1), np.float64)
    assert (tangent * by_pixel).sum() == pytest.approx(along, rel=1e-4)


def test_what_rays_lose_is_what_small_splats_hide() -> None:
    """Splatting takes the projection of a Gaussian for affine over its extent. With s = extent over distance the alphas of both
    differ by about s, and by half as much for half of it; the low-pass filter is made small."""
    gaussians, errors = cloud(30, degree=0), []
    for shrink in (0.5, 0.25, 0.125):
        log_scales = gaussians.log_scales + np.float32(np.log(shrink))
        small = replace(gaussians, means=gaussians.means * np.float32(shrink), log_scales=log_scales)
        camera, o, d = pinhole(SIDE, 8.0 * SIDE / shrink, 8.0)
        splatter = Splatter(SIDE, SIDE, 0, low_pass=1e-6, least_alpha=1e-6)
        drawn = np.array(splatter.forward(to_tensors(small), camera, derivatives=False)[0])[..., 3]
        tau = oracle.optical_depth(oracle.Cloud.of(small), o, d, np.zeros(len(o)), np.full(len(o), np.inf))
        assert drawn.max() > 0.8
        errors.append(np.abs(drawn.ravel() + np.expm1(-tau)).max())
    assert errors[0] < 0.1
    assert errors[1] < 0.65 * errors[0]
    # What is cut at 4 standard deviations, 3e-4 of each of a few, is left.
    assert errors[2] < 0.65 * errors[1] + 1e-3


# -- Scattering --------------------------------------------------------------------------------------------------------------


def test_they_dim_a_medium_that_shines_behind_them() -> None:
    """A glowing slab behind absorbing Gaussians, with the derivative by their opacities: both by hand."""
    gaussians, glow = cloud(8), {"type": "mivol_medium", "sigma_t": 0.7, "emission": 0.5}
    slab = mi.ScalarTransform4f().translate([0, 0, -3]).scale([6, 6, 0.5])
    found = scene(volume(gaussians), emitter={"type": "cube", "to_world": slab, "bsdf": {"type": "null"}, "interior": glow})
    o, d = camera_rays(found, 3)
    shines = 0.5 * -np.expm1(0.7 / d[:, 2])
    span, twin = (np.zeros(len(o)), np.full(len(o), np.inf)), oracle.Cloud.of(gaussians)
    value = lambda c: shines * np.exp(-SCALE * oracle.optical_depth(c, o, d, *span, oracle.find_cut(twin, o, d, *span)))  # noqa: E731
    np.testing.assert_allclose(render(found, seed=3)[..., 0].ravel(), value(twin), rtol=2e-4)
    params, key = mi.traverse(found), "cloud.interior_medium.sigma_t.opacity_logits"
    dr.enable_grad(params[key])
    params.update()
    ones = mi.TensorXf(np.full((SIDE, SIDE, 3), 1 / 3, np.float32))
    mi.load_dict({"type": "mivol", "max_depth": 1}).render_backward(found, params, ones, seed=3, spp=1)
    step = np.full(gaussians.count, 1e-5)
    truth = (value(twin.moved("opacity_logits", step)) - value(twin.moved("opacity_logits", -step))).sum() / 2e-5
    assert np.array(dr.grad(params[key])).sum() == pytest.approx(truth, rel=1e-3)


def test_white_gaussians_in_a_furnace_cannot_be_seen() -> None:
    """Any extinction, whatever it depends on, that scatters all light: each path brings the sky home."""
    image = render(scene(volume(cloud(20)), albedo=1.0), depth=-1, spp=4, rr_depth=1000)
    np.testing.assert_allclose(image, SKY, rtol=1e-5)


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize(("depth", "light"), [(2, POINT), (3, POINT), (-1, None)])
def test_scattered_light_and_shadows_are_those_of_volpath(depth: int, light: dict | None) -> None:
    """Rationale: delta tracking of the same extinction by Mitsuba. Expected: the mean of each third of the picture.

    Pictures are independent, and a third of one is a batch of 48 pixels and 16 samples each.
    """
    gaussians, batches = cloud(12), 32
    found = scene(volume(gaussians), 0.8, light)
    stock = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": 1000})
    ours = np.array([render(found, depth, 16, fresh(k), rr_depth=1000) for k in range(batches)])
    theirs = np.array([np.array(mi.render(found, integrator=stock, spp=16, seed=fresh(batches + k))) for k in range(batches)])
    for third in range(3):
        both = []
        for pictures in (ours, theirs):
            means = pictures[:, 4 * third : 4 * third + 4, :, 0].mean(axis=(1, 2))
            both.append(Estimate(means.mean(), means.var(ddof=1) / batches, batches - 1))
        assert_same_mean(*both, what=f"third {third}")
        assert_precise(both[0], 0.02 * both[1].mean, what=f"third {third}")


def lit_by_hand(gaussians: Gaussians, o: np.ndarray, d: np.ndarray) -> float:
    """Light of ``POINT`` that is scattered once towards the origin of a ray, by Gauss quadrature in 32 pieces of it."""
    u, weight = np.polynomial.legendre.leggauss(16)
    edges = np.linspace(2.5, 7.5, 33)
    half = 0.5 * (edges[1] - edges[0])
    t = (0.5 * (edges[1:] + edges[:-1])[:, None] + half * u).ravel()
    p, light, twin = o + t[:, None] * d, np.array(POINT["position"]), oracle.Cloud.of(gaussians)
    ways, start = (np.broadcast_to(v, p.shape) for v in (d, o))
    away = np.linalg.norm(light - p, axis=1)
    sigma = SCALE * oracle.extinction(twin, p, ways).sum(axis=1)
    tau = oracle.optical_depth(twin, start, ways, np.zeros(len(p)), t)
    tau = tau + oracle.optical_depth(twin, p, (light - p) / away[:, None], np.zeros(len(p)), away)
    arrives = POINT["intensity"] * np.exp(-SCALE * tau) / (4 * np.pi * away**2)
    return float(np.tile(weight * half, 32) @ (sigma * arrives))


@pytest.mark.statistical
def test_one_scattering_and_its_shadow_are_those_of_the_twin() -> None:
    """Gaussians shadow each other. In a field of view of 0.01 degrees all pixels see one line, and each is a batch of 64 paths;
    quadrature errs by 1e-4, which is what a cut at 4 standard deviations leaves of an extinction."""
    gaussians, albedo = cloud(6), 0.8
    found = scene(volume(gaussians), albedo, POINT, fov=0.01)
    o, d = (rays.mean(axis=0) for rays in camera_rays(found, 3))
    truth = albedo * lit_by_hand(gaussians, o, d / np.linalg.norm(d))
    assert truth > 0.01
    seen = render(found, 2, 64, fresh(1))[..., 0]
    estimate = Estimate(seen.mean(), seen.var(ddof=1) / seen.size, seen.size - 1)
    assert_same_mean(estimate, truth, rounding=1e-4 * truth, what="radiance")
    assert_precise(estimate, 0.02 * truth, what="radiance")


# -- Parameters, files and refusals ------------------------------------------------------------------------------------------


def test_a_file_is_its_tensors_and_an_update_moves_them(tmp_path: Path) -> None:
    gaussians = cloud(5)
    write_gaussians(tmp_path / "cloud.ply", gaussians)
    given = render(scene(volume(gaussians)))
    read = scene({"type": "mivol_gaussians", "filename": str(tmp_path / "cloud.ply")})
    np.testing.assert_array_equal(render(read), given)
    params = mi.traverse(read)
    params["cloud.interior_medium.sigma_t.means"] = mi.TensorXf(gaussians.means + np.float32(0.2))
    params.update()
    moved = replace(gaussians, means=gaussians.means + np.float32(0.2))
    np.testing.assert_allclose(render(read), render(scene(volume(moved))), rtol=1e-5)
    assert np.abs(render(read) - given).max() > 0.05


def test_a_plan_says_what_is_done_with_them() -> None:
    text = explain(scene(volume(cloud(5)), 0.5, POINT), max_depth=2)
    assert "grey extinction, 5 Gaussians, scatters" in text
    assert "cloud is made of Gaussians" in text
    assert "exact, one flight in each Gaussian along a ray" in text
    # (albedo 0.50, optical depth ...): the mean over lines through the cube.
    assert "max_depth 2 leaves out" in text


def test_what_needs_the_cells_of_a_grid_is_refused_by_name() -> None:
    sentence = "aovs asks for depth: ask for tau and alpha only"
    with pytest.raises(MivolError, match=f"the medium in cloud is made of 5 Gaussians .* and {sentence}.* to a grid"):
        render(scene(volume(cloud(5))), aovs="depth")


def test_the_derivative_by_the_place_of_a_lamp_is_refused() -> None:
    found = scene(volume(cloud(2)), 0.5, POINT)
    params, integrator = mi.traverse(found), mi.load_dict({"type": "mivol", "max_depth": 2})
    dr.enable_grad(params["light.position"])
    params.update()
    with pytest.raises(MivolError, match=r"the derivative of light.position was requested: use finite differences"):
        integrator.render_backward(found, params, mi.TensorXf(np.ones((SIDE, SIDE, 3), np.float32)), spp=1)


def test_gaussians_are_a_sigma_t_and_nothing_else() -> None:
    gaussians = volume(cloud(2))
    assert mi.load_dict(gaussians).channel_count() == 1
    for wrong in ({"sigma_t": 1.0, "albedo": gaussians}, {"sigma_a": 0.1, "sigma_s": gaussians}):
        with pytest.raises((MivolError, RuntimeError), match="a mivol_gaussians as .*; give it as sigma_t, with an albedo"):
            mi.load_dict({"type": "mivol_medium", **wrong})
    for sources in ({}, {"filename": "a.ply", "means": gaussians["means"]}, {"means": gaussians["means"]}):
        with pytest.raises(
            (MivolError, RuntimeError), match="mivol_gaussians was given .*; give filename, or means, log_scales"
        ):
            mi.load_dict({"type": "mivol_gaussians", **sources})
