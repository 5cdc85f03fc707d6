"""Gaussians that show their colours in a scene: among surfaces, other media, glass, through any camera, and their derivatives.

The truth is the float64 twin, which sorts all Gaussians of a ray, along the very rays of the camera; of splatting it is the
splatter, in the limit of small Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_scenes import SIDE, boxed, camera_rays, cloud, pinhole, render, tensors_of
from refusals import assert_refused
from scipy.special import logit

from mivol.errors import MivolError
from mivol.experiments.script import explain
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS, GaussianField
from mivol.points import write_gaussians
from mivol.points.gaussians import Gaussians
from mivol.splatting import Splatter, to_tensors

pytestmark = pytest.mark.usefixtures("traced_balls")

ROUNDING = 1e-4
"""Of light in float32, relative to colours of at most 2: a depth of one Gaussian is known to 2e-5
(test_gaussian_extinction.py), and a ray meets a few dozen, whose errors add up as a random walk."""


def shown(gaussians: Gaussians, **more: object) -> dict:
    """A medium that shows them."""
    return {"type": "mivol_medium", "emission": tensors_of(gaussians, (*EXTINCTION_PARAMETERS, HARMONICS), **more)}


def twin(
    gaussians: Gaussians, rays: tuple, end: np.ndarray | float = np.inf, begin: np.ndarray | float = 0.0, space: str = "srgb"
) -> tuple[np.ndarray, np.ndarray]:
    """Light (rays, 3) and transmittance (rays,) of the twin."""
    o, d = rays
    span = tuple(np.broadcast_to(np.asarray(t, float), len(o)) for t in (begin, end))
    colour = oracle.colours(gaussians.harmonics.astype(np.float64), d, space)
    return oracle.composite(oracle.Cloud.of(gaussians), colour, rays, span)


def assert_as_twin(gaussians: Gaussians, found: mi.Scene, seed: int = 0, atol: float = ROUNDING, **space: str) -> np.ndarray:
    """A picture against the twin along the same rays; its light."""
    light, _ = twin(gaussians, camera_rays(found, seed), **space)
    np.testing.assert_allclose(render(found, seed=seed).reshape(-1, 3), light, rtol=ROUNDING, atol=atol)
    return light


# -- What is seen ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_composited_in_the_order_of_peaks(degree: int) -> None:
    """Before a sky, with the opacity as an AOV. Half of the colours are below 0 somewhere."""
    gaussians = cloud(40, degree=degree)
    for space in ("srgb", "linear"):
        found = boxed(shown(gaussians, space=space), sky={"type": "constant", "radiance": 0.8})
        seen = render(found, seed=3, aovs="alpha")
        light, T = twin(gaussians, camera_rays(found, 3), space=space)
        assert light.max() > 0.3 and T.min() < 0.05
        np.testing.assert_allclose(seen[..., :3].reshape(-1, 3), light + 0.8 * T[:, None], rtol=ROUNDING, atol=ROUNDING)
        np.testing.assert_allclose(seen[..., 3].ravel(), 1 - T, atol=ROUNDING)


def test_a_placement_turns_colours_with_the_cloud() -> None:
    gaussians = cloud(20)
    place = mi.ScalarTransform4f().translate([0.1, -0.2, 0.3]).rotate([0.6, 0, 0.8], 40).scale([0.8, 0.8, -0.8])
    found = boxed(shown(gaussians, to_world=place))
    o, d = camera_rays(found, 3)
    back = np.linalg.inv(np.array(place.matrix, np.float64))
    local = d @ back[:3, :3].T
    length = np.linalg.norm(local, axis=1, keepdims=True)
    light, _ = twin(gaussians, (o @ back[:3, :3].T + back[:3, 3], local / length))
    np.testing.assert_allclose(render(found, seed=3).reshape(-1, 3), light, rtol=ROUNDING, atol=ROUNDING)


def test_layers_behind_each_other_are_sorted_whatever_a_list_holds() -> None:
    """200 flat layers in two cells: a cell's list is read many times. Neighbours differ, so any swap shows."""
    rng, n = np.random.default_rng(0), 200
    z = rng.permutation(np.linspace(-0.45, 0.45, n))
    layers = Gaussians(
        np.stack([0 * z, 0 * z, z], axis=1),
        np.tile(np.log([3.0, 3.0, 0.001]), (n, 1)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full(n, logit(0.02)),
        rng.uniform(-1, 1, (n, 1, 3)),
    )
    assert_as_twin(layers, boxed(shown(layers)))


def test_of_equal_peaks_the_lower_number_is_in_front() -> None:
    """Eleven Gaussians in one place, opaque ones among them: red, then green, then nine blue ones."""
    n = 11
    harmonics = np.full((n, 1, 3), -2.0)
    harmonics[range(n), 0, [0, 1, *[2] * (n - 2)]] = 2.0
    same = np.zeros((n, 3)), np.full((n, 3), np.log(0.2)), np.tile([1.0, 0, 0, 0], (n, 1)), np.full(n, logit(0.7))
    gaussians = Gaussians(*same, harmonics)
    light = assert_as_twin(gaussians, boxed(shown(gaussians, space="linear")), space="linear")
    # With an opacity a, red has a, green a (1 - a) and blue at most (1 - a)^2: in this order where a > 1/2.
    red, green, blue = light[np.argmax(light[:, 0])]
    assert red > green > blue


def test_a_camera_may_stand_inside_and_look_anywhere() -> None:
    """At the middle of the cloud, 150 degrees wide: half of the Gaussians are behind it, and some across its place."""
    gaussians = cloud(40)
    wide = {"type": "perspective", "fov": 150.0, "near_clip": 1e-3}
    wide["to_world"] = mi.ScalarTransform4f()
    assert assert_as_twin(gaussians, boxed(shown(gaussians), wide), 5, 2 * ROUNDING).max() > 0.3


def test_extremes_are_drawn() -> None:
    """Opacities of 0 and 1 (which counts as 0.999), scales of 1e-6 and a camera far away."""
    gaussians = cloud(6)
    gaussians.opacity_logits[:3] = [np.inf, -np.inf, 60]
    gaussians.log_scales[3] = np.log(1e-6)
    assert_as_twin(gaussians, boxed(shown(gaussians)))


def test_a_surface_among_them_hides_what_is_behind_it() -> None:
    """A wall at z = 0 that shines, through the cloud; a Gaussian that it cuts shows its share in front of it."""
    gaussians = cloud(40)
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1.5), "light": {"type": "area", "radiance": 2.0}}
    medium = shown(gaussians)
    found = boxed(medium, wall=wall)
    rays = camera_rays(found, 1)
    light, T = twin(gaussians, rays, end=-rays[0][:, 2] / rays[1][:, 2])
    np.testing.assert_allclose(render(found, seed=1).reshape(-1, 3), light + 2 * T[:, None], rtol=ROUNDING, atol=ROUNDING)


def test_a_mirror_shows_their_other_side() -> None:
    """At z = -0.1, among them: what is in front of it, and what a ray meets on its way back, from where it is reflected."""
    gaussians = cloud(40)
    mirror = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -0.1]).scale(1.8),
        "bsdf": {"type": "conductor", "material": "none"},
    }
    found = boxed(shown(gaussians), mirror=mirror)
    o, d = camera_rays(found, 1)
    end = -(o[:, 2] + 0.1) / d[:, 2]
    light, T = twin(gaussians, (o, d), end=end)
    back, _ = twin(gaussians, (o + end[:, None] * d, d * [1, 1, -1]))
    assert back.max() > 0.1
    seen = render(found, depth=2, seed=1).reshape(-1, 3)
    np.testing.assert_allclose(seen, light + T[:, None] * back, rtol=ROUNDING, atol=2 * ROUNDING)


def test_other_media_dim_them_and_shine_through_them() -> None:
    """A glowing box in front of them and one behind, all emission and absorption: the sum by hand."""
    gaussians = cloud(20)
    boxes, spans = {}, {"front": (2.5, 3.0), "back": (-3.5, -2.5)}
    for name, (low, high) in spans.items():
        place = mi.ScalarTransform4f().translate([0, 0, (low + high) / 2]).scale([4, 4, (high - low) / 2])
        glow = {"type": "mivol_medium", "sigma_t": 0.7, "emission": 0.5}
        boxes[name] = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": glow}
    found = boxed(shown(gaussians), **boxes)
    o, d = camera_rays(found, 2)
    light, T = twin(gaussians, (o, d))
    own = {name: np.exp(-0.7 * (high - low) / -d[:, 2]) for name, (low, high) in spans.items()}
    glows = {name: 0.5 * (1 - rest) for name, rest in own.items()}
    expected = glows["front"][:, None] + own["front"][:, None] * (light + (T * glows["back"])[:, None])
    np.testing.assert_allclose(render(found, seed=2).reshape(-1, 3), expected, rtol=ROUNDING, atol=ROUNDING)


def test_they_are_seen_through_a_boundary_that_has_to_be_traced() -> None:
    gaussians = cloud(20)
    ball = {"type": "sphere", "radius": 3.0, "bsdf": {"type": "null"}, "interior": shown(gaussians)}
    assert_as_twin(gaussians, boxed({}, cloud=ball), 2)


def test_small_ones_look_as_splatted() -> None:
    """Splatting sorts by the depth of means, sees each from one direction, and takes its projection for affine: all three
    differ by the extent of a Gaussian over its distance to the others or to the camera, so a quarter of it leaves less than
    half."""
    gaussians, errors, side = cloud(60), [], 48
    camera, *along = pinhole(side, 4.0 * side, 5.0)
    for shrink in (1.0, 0.25, 0.0625):
        small = replace(gaussians, log_scales=gaussians.log_scales + np.float32(np.log(shrink)))
        splatter = Splatter(side, side, 2, low_pass=1e-6, least_alpha=1e-6)
        drawn = np.array(splatter.forward(to_tensors(small), camera, derivatives=False)[0])[..., :3].reshape(-1, 3)
        light, _ = twin(small, along, space="linear")
        errors.append(np.sqrt(((drawn - light) ** 2).mean() / (light**2).mean()))
    assert errors[0] < 0.3
    assert errors[1] < 0.5 * errors[0] and errors[2] < 0.5 * errors[1]


# -- Derivatives -------------------------------------------------------------------------------------------------------------


def every(found: mi.Scene) -> tuple[mi.SceneParameters, dict[str, str]]:
    """The parameters of the scene, with derivatives asked for of the Gaussians, and their keys by name."""
    params = mi.traverse(found)
    keys = {name: f"cloud.interior_medium.emission.{name}" for name in (*EXTINCTION_PARAMETERS, HARMONICS)}
    for key in keys.values():
        dr.enable_grad(params[key])
    params.update()
    return params, keys


@pytest.mark.parametrize("count", [1, 8, pytest.param(50, marks=pytest.mark.slow)])
def test_derivatives_by_every_parameter_are_finite_differences_of_the_twin(count: int) -> None:
    """Before a wall that cuts some of them, with order and cuts frozen; and forward mode is the transpose of reverse mode.

    A derivative sums 144 rays that cancel, each known to 1e-4 of the largest."""
    gaussians, rng = cloud(count, seed=3), np.random.default_rng(1)
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -0.1]).scale(2),
        "light": {"type": "area", "radiance": 0.7},
    }
    found = boxed(shown(gaussians), wall=wall)
    o, d = camera_rays(found, 5)
    span = np.zeros(len(o)), -(o[:, 2] + 0.1) / d[:, 2]
    cloud64, harmonics = oracle.Cloud.of(gaussians), gaussians.harmonics.astype(np.float64)
    frozen = oracle.order_of(cloud64, o, d), oracle.find_cut(cloud64, o, d, *span)
    weight = rng.normal(size=(len(o), 3))

    def value(of: oracle.Cloud, coefficients: np.ndarray) -> float:
        light, T = oracle.composite(of, oracle.colours(coefficients, d, "srgb"), (o, d), span, frozen)
        return float((weight * (light + 0.7 * T[:, None])).sum())

    params, keys = every(found)
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    by_pixel = mi.TensorXf(weight.reshape(SIDE, SIDE, 3).astype(np.float32))
    integrator.render_backward(found, params, by_pixel, seed=5, spp=1)
    gradients = {name: np.array(dr.grad(params[key]), np.float64) for name, key in keys.items()}
    along = 0.0
    for name, key in keys.items():
        change, step = rng.normal(size=gradients[name].shape), 1e-5
        if name == HARMONICS:
            moved = [value(cloud64, harmonics + s * step * change) for s in (1, -1)]
        else:
            moved = [value(cloud64.moved(name, s * step * change), harmonics) for s in (1, -1)]
        size = np.abs(gradients[name] * change).sum()
        assert (gradients[name] * change).sum() == pytest.approx((moved[0] - moved[1]) / (2 * step), abs=2e-4 * size), name
        assert size > 0.1
        dr.set_grad(params[key], mi.TensorXf(change.astype(np.float32)))
        along += (gradients[name] * change).sum()
    tangent = np.array(integrator.render_forward(found, params, seed=5, spp=1), np.float64)
    assert (tangent * weight.reshape(SIDE, SIDE, 3)).sum() == pytest.approx(along, rel=1e-4, abs=1e-3)


def test_derivatives_list_nothing_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Transport reads the numbers where they stand: a step of a fit lists Gaussians once, when it moves them."""
    found = boxed(shown(cloud(3)))
    params, _ = every(found)
    monkeypatch.setattr(GaussianField, "refresh", lambda self: pytest.fail("listed anew"))
    ones = mi.TensorXf(np.ones((SIDE, SIDE, 3), np.float32))
    mi.load_dict({"type": "mivol", "max_depth": 1}).render_backward(found, params, ones, spp=1)


def test_what_is_hidden_has_the_small_derivative_that_it_has() -> None:
    """Behind an optical depth of 28 (four opaque layers) the derivative by a colour is e^-28, and not a rounding error."""
    n = 5
    layers = Gaussians(
        np.stack([np.zeros(n), np.zeros(n), np.linspace(0.4, -0.4, n)], axis=1),
        np.tile(np.log([3.0, 3.0, 0.01]), (n, 1)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full(n, 40.0),
        np.full((n, 1, 3), 0.5),
    )
    found = boxed(shown(layers, space="linear"), {"type": "perspective", "fov": 0.01, "to_world": facing()})
    params, keys = every(found)
    ones = mi.TensorXf(np.ones((SIDE, SIDE, 3), np.float32))
    mi.load_dict({"type": "mivol", "max_depth": 1}).render_backward(found, params, ones, spp=1)
    by_colour = np.array(dr.grad(params[keys[HARMONICS]]))[:, 0, 0] / SIDE**2
    # 1e-3 of an optical depth of 7 each: 1 - 0.999 has four digits in float32.
    truth = oracle.harmonics_along(np.array([[0, 0, -1.0]]))[0, 0] * 0.999 * 1e-3 ** np.arange(n)
    np.testing.assert_allclose(by_colour, truth, rtol=1e-2)


def facing() -> mi.ScalarTransform4f:
    """A camera on the z axis that looks down."""
    return mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])


def test_a_swap_of_the_order_changes_a_picture_by_what_is_said() -> None:
    """Two discs that pass through each other's depth: the light jumps by alpha_1 alpha_2 |c_1 - c_2|, and by nothing else."""
    seen = []
    for gap in (-1e-4, 1e-4):
        pair = Gaussians(
            [[0, 0, 0], [0, 0, gap]],
            np.tile(np.log([2.0, 2.0, 0.05]), (2, 1)),
            np.tile([1.0, 0, 0, 0], (2, 1)),
            logit([0.6, 0.3]),
            np.array([[[1.0, 1, 1]], [[-1.0, -1, -1]]]),
        )
        found = boxed(shown(pair, space="linear"), {"type": "perspective", "fov": 0.01, "to_world": facing()})
        seen.append(render(found).mean())
    jump = 0.6 * 0.3 * 2 * oracle.harmonics_along(np.array([[0, 0, -1.0]]))[0, 0]
    assert seen[0] - seen[1] == pytest.approx(jump, rel=1e-3)


# -- Parameters, files and refusals ------------------------------------------------------------------------------------------


def test_a_file_is_its_tensors_and_an_update_recolours_them(tmp_path: Path) -> None:
    gaussians = cloud(5)
    write_gaussians(tmp_path / "cloud.ply", gaussians)
    given = render(boxed(shown(gaussians)))
    read = boxed({"type": "mivol_medium", "emission": {"type": "mivol_gaussians", "filename": str(tmp_path / "cloud.ply")}})
    np.testing.assert_array_equal(render(read), given)
    params = mi.traverse(read)
    params["cloud.interior_medium.emission.harmonics"] = mi.TensorXf(-gaussians.harmonics)
    params.update()
    other = boxed(shown(replace(gaussians, harmonics=-gaussians.harmonics)))
    np.testing.assert_allclose(render(read), render(other), rtol=1e-5)
    assert np.abs(render(read) - given).max() > 0.05


def test_a_blur_widens_each() -> None:
    """Round ones of standard deviation s become those of sqrt(s^2 + b^2); a to_world scales the blur with them."""
    gaussians = replace(cloud(8), log_scales=np.full((8, 3), np.log(0.09), np.float32))
    wide = replace(gaussians, log_scales=np.full((8, 3), np.log(0.15), np.float32))
    blurred = render(boxed(shown(gaussians, blur=0.12)))
    np.testing.assert_allclose(blurred, render(boxed(shown(wide))), rtol=1e-4, atol=1e-5)
    assert np.abs(blurred - render(boxed(shown(gaussians)))).max() > 0.05


def test_a_plan_says_what_is_done_with_them() -> None:
    text = explain(boxed(shown(cloud(5))))
    assert "grey extinction, 5 Gaussians, albedo 0" in text
    assert "in the order of their peaks along each ray" in text
    assert "because cloud: colours" in text


def test_what_they_cannot_be_is_refused_by_name() -> None:
    gaussians = shown(cloud(2))["emission"]
    plain = {name: value for name, value in gaussians.items() if name != HARMONICS}
    refused = {
        "beside a mivol_gaussians as its emission, which brings its own extinction; take it out": {
            "emission": gaussians,
            "sigma_t": 1.0,
        },
        "was given emission beside a sigma_t of mivol_gaussians; give the Gaussians as the emission": {
            "emission": 1.0,
            "sigma_t": gaussians,
        },
        "Gaussians without colours as its emission; give them harmonics": {"emission": plain},
        "a mivol_gaussians as emission_density; give it as sigma_t, with an albedo, to be lit, or as the emission": {
            "emission_density": gaussians,
            "sigma_t": 1.0,
        },
    }
    for sentence, medium in refused.items():
        with pytest.raises((MivolError, RuntimeError), match=sentence):
            mi.load_dict({"type": "mivol_medium", **medium})
    settings = ({"space": "cie"}, "space of the colours"), ({"blur": -1.0}, "the blur of Gaussians is -1; a finite")
    for setting, sentence in settings:
        with pytest.raises((MivolError, RuntimeError), match=sentence):
            mi.load_dict({**gaussians, **setting})
    assert_refused("aovs asks for depth: ask for tau and alpha only", render, boxed(shown(cloud(2))), aovs="depth")
