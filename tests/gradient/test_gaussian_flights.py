"""Derivatives of light that scatters in Gaussians: forward against reverse, a furnace, and differences of renders."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from scattering_gradients import BATCHES, assert_transposed, release, watched
from scattering_scenes import close_up, mivol, point
from scipy.special import logit

import scenes
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS
from mivol.validate.statistics import Estimate, Moments

INSIDE = "cloud.interior_medium."

PARAMETERS = {name: f"{INSIDE}sigma_t.{name}" for name in EXTINCTION_PARAMETERS} | {"scale": INSIDE + "scale"}


def parts(albedo: float, **lights: dict) -> dict:
    """Five Gaussians well inside of a cube of edge 3.6, and lights."""
    rng = np.random.default_rng(0)
    tensors = {
        "means": rng.uniform(-0.4, 0.4, (5, 3)),
        "log_scales": np.log(rng.uniform(0.15, 0.3, (5, 3))),
        "quaternions": rng.normal(size=(5, 4)),
        "opacity_logits": logit(rng.uniform(0.4, 0.9, 5)),
    }
    sigma_t = {"type": "mivol_gaussians", **{k: mi.TensorXf(v.astype(np.float32)) for k, v in tensors.items()}}
    medium = {
        "type": "mivol_medium",
        "sigma_t": sigma_t,
        "albedo": albedo,
        "scale": 1.2,
        "phase": {"type": "mivol_hg", "g": 0.3},
    }
    place = mi.ScalarTransform4f().scale(1.8)
    return {"cloud": {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}, **lights}


def backward(scene: mi.Scene, w: np.ndarray, spp: int, seed: int, integrator: mi.Integrator) -> dict[str, np.ndarray]:
    """J^T w of each parameter, by one pass of the integrator."""
    variables = {name: watched(scene, key)[1] for name, key in PARAMETERS.items()}
    weight = mi.TensorXf(np.asarray(w, dtype=np.float32))
    integrator.render_backward(scene, mi.traverse(scene), weight, seed=seed, spp=spp)
    found = {name: np.array(dr.grad(variable), dtype=np.float64) for name, variable in variables.items()}
    for name, variable in variables.items():
        release(scene, PARAMETERS[name], variable)
    return found


def forward(scene: mi.Scene, v: dict[str, np.ndarray], spp: int, seed: int, integrator: mi.Integrator) -> np.ndarray:
    """J v of all parameters, with the same random numbers."""
    variables = {name: watched(scene, key)[1] for name, key in PARAMETERS.items()}
    for name, variable in variables.items():
        change = np.asarray(v[name], dtype=np.float32)
        dr.set_grad(variable, type(variable)(change) if change.ndim else float(change))
    found = np.array(integrator.render_forward(scene, mi.traverse(scene), seed=seed, spp=spp), dtype=np.float64)
    for name, variable in variables.items():
        release(scene, PARAMETERS[name], variable)
    return found


def test_gaussians_without_a_tangent_stand_beside_a_medium_with_one(whole_paths: None) -> None:
    """The tangent by the fog's scale is the same whether the Gaussians have no tangent or a tangent of 0, with one seed.

    With no tangent the Gaussians are not walked; with a tangent of 0 each adds an exact 0.
    """
    fog = {"type": "mivol_medium", "sigma_t": {"type": "constvolume", "value": 0.8}, "albedo": 0.7, "scale": 1.0}
    place = mi.ScalarTransform4f().translate([0, 0, 2.4]).scale([1.8, 1.8, 0.5])
    slab = {"slab": {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": fog}}
    scene = close_up(parts(0.8, sky=scenes.sky(0.3)) | slab, res=6)
    integrator, tangents = mi.load_dict(mivol(max_depth=4)), []
    for keys in (["slab.interior_medium.scale"], ["slab.interior_medium.scale", PARAMETERS["opacity_logits"]]):
        variables = {key: watched(scene, key)[1] for key in keys}
        dr.set_grad(variables[keys[0]], 1.0)
        tangents.append(np.array(integrator.render_forward(scene, mi.traverse(scene), seed=3, spp=8)))
        for key, variable in variables.items():
            release(scene, key, variable)
    assert np.abs(tangents[0]).max() > 0
    # Float32 sums of the same terms: 8 samples and at most 4 segments, each rounded to 6e-8 of the largest term.
    np.testing.assert_allclose(*tangents, rtol=0, atol=32 * 6e-8 * 30 * np.abs(tangents[0]).max())


@pytest.mark.slow
def test_forward_is_the_transpose_of_reverse(whole_paths: None) -> None:
    scene = close_up(parts(0.8, bulb=point([1.7, -0.6, 2.4])[0], sky=scenes.sky(0.3)), res=8)
    integrator, seed = mi.load_dict(mivol(max_depth=5, rr_depth=3)), fresh(5)
    w = np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3))
    back = backward(scene, w, 16, seed, integrator)
    v = {name: np.random.default_rng(2).uniform(0.5, 1.5, np.shape(value)) for name, value in back.items()}
    there = forward(scene, v, 16, seed, integrator)
    terms = np.array([np.sum(back[name] * v[name]) for name in back])
    assert (terms != 0).all()
    assert_transposed(there * w, np.concatenate([np.ravel(back[name] * v[name]) for name in back]))


@pytest.mark.slow
def test_a_white_furnace_has_no_derivative() -> None:
    """No place, turn, size or opacity of white Gaussians is seen in light that is the same from everywhere."""
    scene = close_up(parts(1.0, sky=scenes.sky(1.0)), res=8)
    integrator, plain = mi.load_dict(mivol(max_depth=-1, rr_depth=100)), mi.load_dict(mivol(max_depth=1))
    found, dimmed = (backward(scene, np.ones((8, 8, 3)), 16, fresh(3), i) for i in (integrator, plain))
    for name in PARAMETERS:
        assert np.abs(found[name]).max() <= 1e-5 * np.abs(dimmed[name]).max(), name


@pytest.mark.slow
@pytest.mark.statistical
def test_all_parameters_by_differences() -> None:
    """Along a change of all of them; renders of both signs share their random numbers, which takes some of the noise.

    The truncation of a central difference is h^2/6 of the third derivative. By a whitened place of 1 a Gaussian's third
    derivative is of the size of the first; a change of h = 0.02 is at most 0.02 / 0.15 of that, so 3e-3 of the derivative.
    """
    scene, integrator, h = close_up(parts(0.8, bulb=point([1.7, -0.6, 2.4])[0]), res=8), mi.load_dict(mivol(max_depth=3)), 0.02
    params, rng = mi.traverse(scene), np.random.default_rng(6)
    start = {name: np.array(params[PARAMETERS[name]], dtype=np.float64) for name in EXTINCTION_PARAMETERS}
    # Opacities and sizes all grow, so that their changes do not cancel.
    v = {
        name: (np.abs if value.ndim == 1 or name == "log_scales" else np.array)(rng.normal(size=value.shape))
        for name, value in start.items()
    }
    w = np.full((8, 8, 3), 1 / 192)
    found, truth = [], []
    for k in range(BATCHES):
        by_name = backward(scene, w, 512, fresh(k), integrator)
        found.append(sum(np.sum(by_name[name] * v[name]) for name in EXTINCTION_PARAMETERS))
        both = []
        for sign in (1, -1):
            for name in EXTINCTION_PARAMETERS:
                params[PARAMETERS[name]] = mi.TensorXf((start[name] + sign * h * v[name]).astype(np.float32))
            params.update()
            both.append(scenes.render(scene, integrator, 1 << 12, seed=fresh(900 + k)).astype(np.float64).mean())
        truth.append((both[0] - both[1]) / (2 * h))
        for name in EXTINCTION_PARAMETERS:
            params[PARAMETERS[name]] = mi.TensorXf(start[name].astype(np.float32))
        params.update()
    found, truth = (Estimate.from_result(Moments.from_values(np.array(values)[:, None])) for values in (found, truth))
    assert_same_mean(found, truth, rounding=5e-3 * np.abs(truth.mean), what="derivative")
    assert_precise(difference(found, truth), 0.03 * np.abs(truth.mean), what="derivative")
