"""Light that Gaussians show where light scatters: along free flights, through fog, on floors, with derivatives.

The truth is a furnace, and exact compositing (:mod:`tests.conformance.test_gaussian_radiance` holds it against the float64
twin): fog that scatters a ten-millionth of its light is followed by free flights, and looks as fog that scatters none.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, fresh
from scattering_gradients import assert_transposed
from scipy.special import logit

from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS
from mivol.points.gaussians import CONSTANT_HARMONIC
from mivol.validate.statistics import Estimate, Moments

pytestmark = pytest.mark.usefixtures("traced_balls")

SIDE, BATCHES = 8, 16

ALMOST_NONE = 1e-7
"""An albedo for which flights are made, and no scattered light is seen."""


def gaussians(white: bool = False) -> dict:
    """Ten Gaussians, well inside a cube of edge 2; ``white`` Gaussians have the radiance 1."""
    rng = np.random.default_rng(0)
    tensors = {
        "means": rng.uniform(-0.4, 0.4, (10, 3)),
        "log_scales": np.log(rng.uniform(0.08, 0.2, (10, 3))),
        "quaternions": rng.normal(size=(10, 4)),
        "opacity_logits": logit(rng.uniform(0.4, 0.9, 10)),
        HARMONICS: np.full((10, 1, 3), 0.5 / CONSTANT_HARMONIC) if white else 0.6 * rng.normal(size=(10, 4, 3)),
    }
    tensors = {name: mi.TensorXf(value.astype(np.float32)) for name, value in tensors.items()}
    medium = {"type": "mivol_medium", "emission": {"type": "mivol_gaussians", "space": "linear", **tensors}}
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}


def scene(albedo: float, nested: bool, white: bool = False, sigma_t: object = 0.4) -> mi.Scene:
    """Gaussians over a floor under a sky, with fog in front of them, or around them in a traced boundary."""
    cloud, fog = gaussians(white), {"type": "mivol_medium", "id": "fog", "sigma_t": sigma_t, "albedo": albedo}
    place, look = mi.ScalarTransform4f(), mi.ScalarTransform4f().look_at([0.5, 0.4, 6], [0, 0, 0], [0, 1, 0])
    if nested:
        bank = {"type": "cube", "to_world": place.scale(2), "bsdf": {"type": "null"}, "interior": fog}
        cloud["exterior"] = {"type": "ref", "id": "fog"}
    else:
        slab = place.translate([0, 0, 2]).scale([2, 2, 0.5])
        bank = {"type": "cube", "to_world": slab, "bsdf": {"type": "null"}, "interior": fog}
    floor = place.translate([0, -2.5, 0]).rotate([1, 0, 0], -90).scale(3)
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "bank": bank,
            "cloud": cloud,
            "sky": {"type": "constant", "radiance": 1.0 if white else 0.3},
            "floor": {
                "type": "rectangle",
                "to_world": floor,
                "bsdf": {"type": "diffuse", "reflectance": 1.0 if white else 0.5},
            },
            "sensor": {"type": "perspective", "fov": 22.0, "to_world": look, "film": film, "sampler": {"type": "independent"}},
        }
    )


def integrator(depth: int) -> mi.Integrator:
    return mi.load_dict({"type": "mivol", "max_depth": depth, "rr_depth": 1000})


def pictures(found: mi.Scene, depth: int, spp: int, first: int) -> Moments:
    """Batches of renders."""
    how = integrator(depth)
    drawn = [np.array(mi.render(found, integrator=how, spp=spp, seed=fresh(first + k))) for k in range(BATCHES)]
    return over_tiles(np.array(drawn))


def over_tiles(drawn: np.ndarray) -> Moments:
    """Batches (n, 2, 2, 3) of means over the quarters of pictures."""
    half = SIDE // 2
    return Moments.from_values(drawn.reshape(len(drawn), 2, half, 2, half, 3).mean(axis=(2, 4)))


@pytest.mark.statistical
@pytest.mark.parametrize("nested", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_everything_in_a_furnace_has_its_radiance(nested: bool) -> None:
    """White Gaussians with the radiance of the sky emit as much as they absorb; fog and floor lose nothing."""
    found = pictures(scene(1.0, nested, white=True), -1, 32, 0)
    assert_same_mean(found, 1.0, what="radiance")
    assert_precise(found, 0.05, what="radiance")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("nested", [False, True])
def test_flights_bring_the_light_that_is_composited(nested: bool) -> None:
    """The Gaussians light the floor too, so both images are Monte Carlo estimates."""
    flown, exact = (pictures(scene(albedo, nested), 2, 64, 100 * k) for k, albedo in enumerate((ALMOST_NONE, 0.0)))
    assert_same_mean(flown, exact, what="radiance")
    assert_precise(flown, 0.05, what="radiance")


def followed(found: mi.Scene) -> dict[str, object]:
    """The parameters of Gaussians and fog, with derivatives enabled."""
    params = mi.traverse(found)
    keys = [f"cloud.interior_medium.emission.{name}" for name in (*EXTINCTION_PARAMETERS, HARMONICS)]
    keys += [key for key in params.keys() if key.endswith("sigma_t.value.value")]  # noqa: SIM118
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    return {key: params[key] for key in keys}


def backward(found: mi.Scene, values: dict, weight: np.ndarray, depth: int, spp: int, seed: int) -> dict[str, np.ndarray]:
    for value in values.values():
        dr.set_grad(value, 0)
    integrator(depth).render_backward(found, mi.traverse(found), mi.TensorXf(weight.astype(np.float32)), seed=seed, spp=spp)
    return {key: np.array(dr.grad(value), np.float64) for key, value in values.items()}


@pytest.mark.slow
@pytest.mark.parametrize("nested", [True])
def test_forward_is_the_transpose_of_reverse(nested: bool, whole_paths: None) -> None:
    found, rng, seed = scene(0.8, nested), np.random.default_rng(1), fresh(7)
    values, w = followed(found), rng.uniform(0.5, 1.5, (SIDE, SIDE, 3))
    back = backward(found, values, w, 4, 8, seed)
    v = {key: rng.uniform(0.5, 1.5, np.shape(value)) for key, value in back.items()}
    for key, value in values.items():
        change = v[key].astype(np.float32)
        dr.set_grad(value, type(value)(change) if change.ndim else float(change))
    there = np.array(integrator(4).render_forward(found, mi.traverse(found), seed=seed, spp=8), np.float64)
    terms = np.array([np.sum(back[key] * v[key]) for key in back])
    assert (np.abs(terms) > 1e-3).all()
    assert_transposed(there * w, np.concatenate([np.ravel(back[key] * v[key]) for key in back]))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("nested", [False])
def test_derivatives_are_those_of_what_is_composited(nested: bool) -> None:
    """Derivative of the sum of all pixels along one change of all parameters; compositing gives the exact one, with the same
    floor."""
    rng, found = np.random.default_rng(2), []
    weight = np.full((SIDE, SIDE, 3), 1 / 192)
    change: dict[str, np.ndarray] = {}
    for number, albedo in enumerate((ALMOST_NONE, 0.0)):
        place = scene(albedo, nested)
        values = followed(place)
        sums = []
        for k in range(BATCHES):
            by_key = backward(place, values, weight, 2, 64, fresh(500 * number + k))
            for key, value in by_key.items():
                change.setdefault(key, np.abs(rng.normal(size=np.shape(value))))
            sums.append([np.sum(by_key[key] * change[key]) for key in by_key])
        found.append(Estimate.from_result(Moments.from_values(np.array(sums))))
    flown, exact = found
    assert_same_mean(flown, exact, what="derivative by each kind of parameter")
    assert_precise(flown, np.maximum(0.15 * np.abs(exact.mean), 2e-3), what="derivative")
