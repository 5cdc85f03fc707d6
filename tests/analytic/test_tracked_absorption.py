"""Light through fields of which no more than a majorant is known: means and derivatives against answers on paper.

Cameras look along one line: in a field of view of 0.01 degrees chords differ by 6e-4 to either side, and their mean by 1e-7.
"""

from __future__ import annotations

import bounded_ball
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean
from gaussian_scenes import cloud, tensors_of

from mivol.errors import MivolError
from mivol.experiments.script import explain
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS
from mivol.scene import plan

SIDE, SPP, SKY, SCALE = 12, 256, 0.8, 1.2
BATCHES = SIDE * SIDE
"""Pixels see the same line: each is a batch of SPP samples of a number between 0 and SKY, whose mean is nearly normal."""

pytestmark = pytest.mark.usefixtures("ball_plugin", "traced_balls")


@pytest.fixture
def ball_plugin(variant_rgb: str) -> None:
    bounded_ball.register()


def fog(sigma: float | list = 1.5, kind: str = "test_ball", **more: object) -> dict:
    ball = {"type": kind, "sigma": sigma, **more}
    return {"type": "mivol_medium", "sigma_t": ball, "scale": SCALE}


def shape(kind: str, medium: dict, **more: object) -> dict:
    return {"type": kind, "bsdf": {"type": "null"}, "interior": medium, **more}


def scene(origin: list, target: list, **shapes: dict) -> mi.Scene:
    sensor = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0.1, 0.2, 1]),
        "fov": 0.01,
        "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }
    return mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": SKY}, "sensor": sensor, **shapes})


def follow(found: mi.Scene, keys: tuple[str, ...], depth: int = 1, spp: int = SPP) -> tuple[np.ndarray, np.ndarray, dict]:
    """The image, its tangent for tangents of 1 of some parameters, and the gradient of a sum with random weights."""
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth})
    image = np.array(mi.render(found, integrator=integrator, spp=spp, seed=3))
    weight = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    params = mi.traverse(found)
    asked = [k for k, _ in params if k.endswith(keys)]
    for key in asked:
        dr.enable_grad(params[key])
    params.update()
    integrator.render_backward(found, params, mi.TensorXf(weight), seed=5, spp=spp)
    gradients = {key: np.array(dr.grad(params[key])).sum() for key in asked}
    for key in asked:
        dr.set_grad(params[key], 1)
    tangent = np.array(integrator.render_forward(found, params, seed=5, spp=spp))
    assert_transposed(tangent * weight, gradients)
    return image, tangent, gradients


def assert_transposed(terms: np.ndarray, gradients: dict) -> None:
    """Reverse and forward mode use the same numbers: their sums differ by rounding, 1e-5 of the sum of absolute values."""
    assert abs(sum(gradients.values()) - terms.sum()) < 1e-5 * np.abs(terms).sum()
    assert all(value != 0 for value in gradients.values())


def of_batches(values: np.ndarray) -> Estimate:
    """The mean of independent, identically distributed values."""
    return Estimate(values.mean(), values.var(ddof=1) / values.size, values.size - 1)


def check(found: np.ndarray, truth: float, what: str) -> None:
    """Compare the mean over batches (one channel) with the truth by Student's t."""
    assert_same_mean(of_batches(found), truth, what=what)


BOUNDARIES = {"a box": "cube", "a traced sphere": "sphere"}


@pytest.mark.statistical
@pytest.mark.parametrize("slack", [1.0, 3.0])
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("kind", ["test_ball", "strangers_ball"])
def test_beer_lambert_through_a_ball(kind: str, boundary: str, slack: float) -> None:
    """Rationale: exp(-sigma chord) is known, and the estimator does not know the chord. Expected: means and derivatives by the
    extinction agree. A loose majorant costs look-ups and changes no mean.

    Power: if the drawn point shares its random numbers with the transmittance, the derivative is off by 4 %, which is 12
    standard errors.
    """
    chord = 2 * np.sqrt(0.8**2 - 0.5**2)
    found = scene([0, -4, 0.5], [0, 0, 0.5], fog=shape(BOUNDARIES[boundary], fog(kind=kind, radius=0.8, slack=slack)))
    image, tangent, _ = follow(found, ("sigma_t.sigma",), spp=4 * SPP)
    seen = SKY * np.exp(-1.5 * SCALE * chord)
    check(image[..., 0], seen, "the radiance")
    check(tangent[..., 0], -SCALE * chord * seen, "the derivative by sigma")


@pytest.mark.statistical
def test_a_ball_that_glows() -> None:
    """With tau the optical depth of a chord, the light is SKY exp(-tau) + 3 (1 - exp(-tau)); means and derivatives agree."""
    chord = 2 * np.sqrt(0.8**2 - 0.5**2)
    found = scene([0, -4, 0.5], [0, 0, 0.5], fog=shape("cube", {**fog(radius=0.8), "emission": 3.0}))
    image, tangent, _ = follow(found, ("sigma_t.sigma",), spp=4 * SPP)
    passed = np.exp(-1.5 * SCALE * chord)
    check(image[..., 0], SKY * passed + 3 * (1 - passed), "the radiance")
    check(tangent[..., 0], SCALE * chord * (3 - SKY) * passed, "the derivative by sigma")


def flakes() -> dict:
    """Microflakes with one matrix everywhere."""
    S = mi.VolumeGrid(np.array([1, 0.3, 0.6, 0.1, 0, -0.1], np.float32).reshape(1, 1, 1, 6))
    return {"type": "sggx", "S": {"type": "gridvolume", "grid": S, "raw": True}}


@pytest.mark.statistical
def test_a_ball_of_microflakes() -> None:
    """Along y, tau has the factor sqrt(S_yy), which changes by half its inverse if all entries of S change by 1."""
    chord, area = 2 * np.sqrt(0.8**2 - 0.5**2), np.sqrt(0.3)
    ball = shape("cube", {**fog(radius=0.8), "phase": flakes()})
    image, tangent, gradients = follow(scene([0, -4, 0.5], [0, 0, 0.5], fog=ball), ("sigma_t.sigma", "S.data"), spp=4 * SPP)
    assert len(gradients) == 2
    seen = SKY * np.exp(-1.5 * SCALE * chord * area)
    check(image[..., 0], seen, "the radiance")
    check(tangent[..., 0], -SCALE * chord * (area + 1.5 * 0.5 / area) * seen, "the derivative by sigma and S")


@pytest.mark.statistical
def test_voxels_that_mitsuba_does_not_interpolate() -> None:
    """A row of voxels with the filter nearest, along the line of sight: tau is their mean times the length of the row."""
    values = np.random.default_rng(4).uniform(0.1, 1, (1, 7, 1, 1)).astype(np.float32)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "filter_type": "nearest", "raw": True}
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    medium = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": grid | {"to_world": place}, "scale": SCALE}
    image, tangent, _ = follow(scene([0, -4, 0], [0, 0, 0], fog=shape("cube", medium)), ("sigma_t.data",))
    seen = SKY * np.exp(-2 * SCALE * values.mean(dtype=np.float64))
    check(image[..., 0], seen, "the radiance")
    check(tangent[..., 0], -2 * SCALE * seen, "the derivative by all voxels together")


@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["test_ball", "strangers_ball"])
def test_colours_and_the_scale_of_the_medium(kind: str) -> None:
    """Each channel by itself, under a common majorant; the scale has a derivative like the field's own parameters."""
    sigma, chord = [0.3, 1.0, 2.0], 1.6
    found = scene([0, -4, 0], [0, 0, 0], fog=shape("cube", fog(sigma, kind, radius=0.8)))
    image, tangent, _ = follow(found, ("scale", "sigma"))
    for channel, own in enumerate(sigma):
        seen = SKY * np.exp(-own * SCALE * chord)
        check(image[..., channel], seen, f"the radiance of channel {channel}")
        check(tangent[..., channel], -(SCALE + own) * chord * seen, f"the derivative of channel {channel}")


@pytest.mark.statistical
def test_several_media_along_a_ray() -> None:
    """Two bounded media, in a box and in a traced boundary, beside a grid and a constant, which stay exact."""
    place = mi.ScalarTransform4f().translate([-0.5, 1.5, -0.5])
    grid = {"type": "mivol_voxels", "data": mi.TensorXf(np.full((4, 4, 4, 1), 0.5, np.float32)), "to_world": place}
    found = scene(
        [0, -8, 0], [0, 0, 0],
        one=shape("cube", fog(0.6, radius=0.7)),
        two=shape("sphere", fog(0.9, radius=0.4, centre=[0, -2, 0]), center=[0, -2, 0], radius=0.5),
        three=shape("cube", {"type": "mivol_medium", "sigma_t": grid}, to_world=place.translate(0.5).scale(0.5)),
        four=shape("sphere", {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.0}, center=[0, -4, 0], radius=0.5),
    )  # fmt: skip
    image, tangent, gradients = follow(found, ("sigma_t.sigma", "sigma_t.data", "sigma_t.value.value"))
    assert len(gradients) == 4
    seen = SKY * np.exp(-(0.6 * SCALE * 1.4 + 0.9 * SCALE * 0.8 + 0.5 + 0.4))
    check(image[..., 0], seen, "the radiance")
    check(tangent[..., 0], -(SCALE * 1.4 + SCALE * 0.8 + 1 + 1) * seen, "the derivative")


@pytest.mark.statistical
def test_a_boundary_that_is_entered_twice() -> None:
    """One medium in two spheres on a diagonal of the field's box. The nearer sphere lies in the box and beyond the ball, and
    each sphere has points of the derivative in proportion to its length."""
    diagonal = np.ones(3) / np.sqrt(3)
    medium = {**fog(1.1, radius=1.0), "id": "fog"}
    found = scene(
        list(-6 * diagonal), [0, 0, 0],
        far=shape("sphere", medium, radius=0.4),
        near=shape("sphere", {"type": "ref", "id": "fog"}, center=list(-1.35 * diagonal), radius=0.25),
    )  # fmt: skip
    image, tangent, _ = follow(found, ("sigma_t.sigma",))
    seen = SKY * np.exp(-1.1 * SCALE * 0.8)
    check(image[..., 0], seen, "the radiance")
    check(tangent[..., 0], -SCALE * 0.8 * seen, "the derivative")


COLOUR = (0.2, 0.8, 2.0)

BALLS = {
    "in front of a floor": lambda sigma, absorption: {"sigma_t": sigma},
    "scattering": lambda sigma, absorption: {"sigma_t": sigma, "albedo": 0.6},
    "of microflakes": lambda sigma, absorption: {"sigma_t": sigma, "albedo": 0.6, "phase": flakes()},
    "in a coloured fog": lambda sigma, absorption: {"sigma_a": absorption, "sigma_s": sigma},
    "in a coloured fog that glows": lambda sigma, absorption: {"sigma_a": absorption, "sigma_s": sigma, "emission": 0.3},
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", BALLS)
def test_a_ball_is_a_homogeneous_sphere(name: str, whole_paths: None) -> None:
    """In front of a floor, whose shadow rays meet the field as camera rays do; and scattering: images and derivatives by the
    extinction have the means of a homogeneous sphere in the ball's place, over two passes. Each channel of a coloured fog,
    which fills the sphere, has the means of a grey fog, whose flights have no weights."""
    place = mi.ScalarTransform4f().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(3)
    floor = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    parts, depth = ({"floor": floor}, 2) if name == "in front of a floor" else ({}, 4)
    emitter = {"type": "point", "position": [0.3, -2, 0.2], "intensity": 4.0}
    coloured = "coloured" in name
    coefficient = "sigma_s" if coloured else "sigma_t"

    def look(boundary: dict, sigma: dict | float, absorption: dict | float, value: str) -> tuple[np.ndarray, np.ndarray]:
        medium = {"type": "mivol_medium", "scale": SCALE, **BALLS[name](sigma, absorption)}
        found = scene([0, -4, 0.4], [0, 0, 0.2], fog=boundary | {"interior": medium}, emitter=emitter, **parts)
        return follow(found, (f"{coefficient}.{value}",), depth)[:2]

    sphere = shape("sphere", {}, radius=0.8)
    rgb = {"type": "rgb", "value": list(COLOUR)}
    ours = look(sphere if coloured else shape("cube", {}), fog(radius=0.8)["sigma_t"], rgb, "sigma")
    for channel in (0, 2) if coloured else (0,):
        truth = look(sphere, 1.5, COLOUR[channel], "value.value")
        for a, b, what in zip(ours, truth, ("the radiance", "the derivative"), strict=True):
            assert_same_mean(of_batches(a[..., channel]), of_batches(b[..., channel]), what=f"{what} of channel {channel}")


@pytest.mark.statistical
def test_several_passes_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient delivered by Dr.Jit in one pass is kept in the next."""
    monkeypatch.setitem(plan.PASS_RAYS, "llvm", SIDE * SIDE * SPP // 4)
    found = scene([0, -4, 0.5], [0, 0, 0.5], fog=shape("sphere", fog(radius=0.8)))
    _, tangent, _ = follow(found, ("sigma_t.sigma",))
    chord = 2 * np.sqrt(0.8**2 - 0.5**2)
    check(tangent[..., 0], -SCALE * chord * SKY * np.exp(-1.5 * SCALE * chord), "the derivative by sigma")


@pytest.mark.statistical
@pytest.mark.parametrize("more", [{"albedo": 0.5}, {"albedo": 0.6, "emission": 0.3}], ids=["scattering", "glowing"])
def test_each_channel_of_a_coloured_ball_is_a_grey_ball(more: dict) -> None:
    """Images, and derivatives by the extinction of a channel, of light that scatters up to three times."""
    sigma = [0.2, 0.8, 2.0]
    found = scene([0, -4, 0.4], [0, 0, 0.2], fog=shape("cube", {**fog(sigma, radius=0.8), **more}))
    ours = follow(found, ("sigma_t.sigma",), 4)
    for channel, value in enumerate(sigma):
        truth = follow(scene([0, -4, 0.4], [0, 0, 0.2], fog=shape("cube", {**fog(value, radius=0.8), **more})), ("sigma",), 4)
        for a, b, what in zip(ours[:2], truth[:2], ("the radiance", "the derivative"), strict=True):
            assert_same_mean(of_batches(a[..., channel]), of_batches(b[..., channel]), what=f"{what} of channel {channel}")


def test_colours_that_collide_beside_shining_gaussians_are_refused() -> None:
    light = {"type": "mivol_medium", "emission": tensors_of(cloud(3), (*EXTINCTION_PARAMETERS, HARMONICS))}
    fire = shape("cube", light, to_world=mi.ScalarTransform4f().translate([5, 0, 0]))
    found = scene([0, -4, 0], [0, 0, 0], fog=shape("cube", {**fog([1.0, 0.5, 2.0]), "albedo": 0.5}), fire=fire)
    sentence = "a medium of Gaussians shines, and the bounded field of fog is rgb: make it grey"
    with pytest.raises(MivolError, match=f"the medium in fog is a Ball, which is known at points only, .*{sentence}"):
        mi.render(found, integrator=mi.load_dict({"type": "mivol", "max_depth": 3}), spp=1)


def test_light_that_cannot_be_drawn_is_refused() -> None:
    found = scene([0, -4, 0], [0, 0, 0], fog=shape("cube", {**fog(), "albedo": 0.5, "emission": 1.0}))
    with pytest.raises(MivolError, match="media_light is 'drawn', and only a majorant of a medium is known"):
        mi.render(found, integrator=mi.load_dict({"type": "mivol", "max_depth": 3, "media_light": "drawn"}), spp=1)


def test_a_majorant_that_is_none_is_refused() -> None:
    found = scene([0, -4, 0], [0, 0, 0], fog=shape("cube", fog(slack=float("inf"))))
    with pytest.raises(MivolError, match="the majorant of sigma_t, a Ball, is inf; a finite number of at least 0 is expected"):
        mi.render(found, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=1)


def test_a_plan_is_explained_where_no_optical_depth_is_known() -> None:
    """The plan tells the error of single scattering by the optical depth, for media with a known optical depth."""
    text = explain(scene([0, -4, 0], [0, 0, 0], fog=shape("cube", {**fog(), "albedo": 0.5})), max_depth=2)
    assert "a bounded Ball" in text
    assert "max_depth 2 leaves out" not in text
