"""``mivol_hash`` as the extinction of a medium: images and gradients against quadrature, and refused parameters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import ball
from false_alarms import assert_precise, assert_same_mean

from mivol.fields.field_files import write_field
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.optim.photographs.sampled_problem import find_region
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import Settings
from mivol.validate.statistics import Moments
from scenes import box_of, camera, medium

SIZES = {"levels": 3, "log2_table": 7, "coarsest": 2, "finest": 8, "width": 8}
RUNS = 12
KEY = "box.interior_medium.sigma_t."


def hash_grid(**more: object) -> dict:
    """An untrained hash grid."""
    return {"type": "mivol_hash", "majorant": 8.0, "seed": 4, **SIZES, **more}


def scene(
    max_depth: int = 2, albedo: float = 0.0, volume: dict | None = None, emission: dict | None = None, **more: object
) -> mi.Scene:
    """The unit cube in white light: a pixel is the transmittance of the cube, if nothing scatters."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": max_depth},
            "sensor": camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16),
            "light": {"type": "constant"},
            "box": box_of(
                medium("mivol_medium", volume or hash_grid(**more), albedo) | ({"emission": emission} if emission else {}),
                np.eye(4),
            ),
        }
    )


def with_values(scene: mi.Scene) -> mi.SceneParameters:
    """The parameters, with features of order 1."""
    params = mi.traverse(scene)
    rng = np.random.default_rng(0)
    params[KEY + "table"] = mi.TensorXf(8 * rng.normal(size=params[KEY + "table"].shape).astype(np.float32))
    params.update()
    return params


def quadrature(scene: mi.Scene, samples: int = 100, pixels: int = 32) -> float:
    """Mean transmittance of rays through the film, by midpoints, for the present values."""
    sensor, field = scene.sensors()[0], scene.shapes()[0].interior_medium().volumes["sigma_t"].mivol_extinction
    number = dr.arange(mi.UInt32, pixels * pixels)
    at = mi.Point2f((number % pixels + 0.5) / pixels, (number // pixels + 0.5) / pixels)
    ray, _ = sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    # Not its t: a spawned ray begins a little behind the surface.
    length = dr.dot(scene.ray_intersect(hit.spawn_ray(ray.d)).p - hit.p, ray.d)
    tau = dr.zeros(mi.Float, pixels * pixels)
    for k in range(samples):
        tau += length / samples * field.eval(hit.p + ray.d * length * ((k + 0.5) / samples), ray.d, mi.Bool(True))[0]
        dr.eval(tau)
    return float(np.mean(np.exp(-np.array(tau, np.float64))))


def moments(values: list[float]) -> Moments:
    found = np.array(values)
    return Moments(len(found), found.mean(), ((found - found.mean()) ** 2).sum())


@pytest.mark.slow
@pytest.mark.statistical
def test_images_equal_quadrature(variant_rgb: str) -> None:
    """A cube that absorbs, in white light."""
    box = scene()
    with_values(box)
    truth = quadrature(box)
    assert 0.1 < truth < 0.7
    means = [float(dr.mean(mi.render(box, spp=32, seed=seed), axis=None).array[0]) for seed in range(RUNS)]
    # Midpoints of 100 steps and of 32 x 32 pixels: 4e-4.
    assert_same_mean(moments(means), truth, rounding=4e-4, what="transmittances")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", ["table", "weights_0", "weights_1"])
def test_gradients_equal_quadrature(variant_rgb: str, name: str) -> None:
    """The slope of the mean pixel along the direction of one estimate of the gradient, in which the slope is largest."""
    box = scene()
    params, key = with_values(box), KEY + name
    value = np.array(params[key])
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(box, params, spp=512, seed=999), axis=None))
    along = np.array(dr.grad(params[key]))
    along /= np.linalg.norm(along)
    h, ends = 1e-2, []
    for step in (h, -h):
        params[key] = mi.TensorXf(value + np.float32(step) * along)
        params.update()
        ends.append(quadrature(box))
    slopes = []
    for seed in range(RUNS):
        params[key] = mi.TensorXf(value)
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(box, params, spp=128, seed=seed), axis=None))
        slopes.append(float((np.array(dr.grad(params[key]), np.float64) * along).sum()))
    slope = (ends[0] - ends[1]) / (2 * h)
    # Quadrature rounds by 2^-24 / h of the mean pixel; central differences err by h^2 / 6 of a third derivative, below the
    # slope itself.
    assert_precise(moments(slopes), 0.1 * abs(slope), what=f"slopes by {name}")
    assert_same_mean(moments(slopes), slope, rounding=1e-5 + 0.01 * abs(slope), what=f"slopes by {name}")


@pytest.mark.slow
def test_a_step_along_the_gradient_of_scattered_light_lowers_the_loss(variant_rgb: str) -> None:
    """Through multiple scattering: ten steps towards the image of another hash grid at least halve the squared error."""
    target, box = (scene(6, 0.8) for _ in range(2))
    with_values(target)
    reference = mi.render(target, spp=4096, seed=99)
    params = mi.traverse(box)
    names = [KEY + name for name in ("table", "weights_0", "weights_1")]
    optimizer = mi.ad.Adam(lr=0.05, params={name: params[name] for name in names})
    errors = []
    for step in range(11):
        params.update(optimizer)
        errors.append(float(dr.mean(dr.square(mi.render(box, spp=1024, seed=7) - reference), axis=None).array[0]))
        image = mi.render(box, params, spp=256, seed=step)
        dr.backward(dr.mean(dr.square(image - reference), axis=None))
        optimizer.step()
    assert errors[-1] < 0.5 * errors[0], errors


def emitting_scene(max_depth: int, **more: object) -> tuple[mi.Scene, mi.SceneParameters]:
    """The cube glows and scatters, before white light."""
    box = scene(max_depth, 0.6, emission={"type": "rgb", "value": [0.7, 0.4, 0.2]}, **more)
    return box, with_values(box)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("max_depth", [1, 4])
def test_emission_of_points_equals_that_of_nodes(variant_rgb: str, max_depth: int) -> None:
    """Images, and slopes along the gradient by the weights, of a glowing cube: at points, and at 64 nodes along an edge."""
    names = [KEY + name for name in ("table", "weights_0", "weights_1")]
    boxes = [emitting_scene(max_depth), emitting_scene(max_depth, nodes=64)]

    def gradients(box: mi.Scene, params: mi.SceneParameters, spp: int, seed: int) -> np.ndarray:
        for name in names:
            params[name] = mi.TensorXf(dr.detach(params[name]))
            dr.enable_grad(params[name])
        params.update()
        dr.backward(dr.mean(mi.render(box, params, spp=spp, seed=seed), axis=None))
        return np.concatenate([np.array(dr.grad(params[name]), np.float64).ravel() for name in names])

    along = gradients(*boxes[1], 256, 999)
    along /= np.linalg.norm(along)
    means, slopes = [], []
    for number, (box, params) in enumerate(boxes):
        seeds = [100 * number + k for k in range(RUNS)]
        means.append(moments([float(dr.mean(mi.render(box, spp=128, seed=k), axis=None).array[0]) for k in seeds]))
        slopes.append(moments([float(gradients(box, params, 128, k) @ along) for k in seeds]))
    # With max_depth 1 and equal seeds, 128 nodes change the image by 1.2e-4 and the slope by 4.5e-4, where 64 instead of 32
    # change them by 1e-5 and 2.2e-3. An error of the order of a cell squared is 4/3 of the first change.
    assert_same_mean(*means, rounding=4 / 3 * 1.2e-4, what="images of a glowing cube")
    assert_same_mean(*slopes, rounding=4 / 3 * 4.5e-4, what="slopes of a glowing cube")


def differentiate(box: mi.Scene, params: mi.SceneParameters, key: str, step: float) -> tuple[float, float]:
    """Derivative of the mean of an image along its gradient by a parameter, and a central difference of ``step``."""
    value = np.array(params[key])
    dr.enable_grad(params[key])
    params.update()
    # Derivatives take the rays of the second seed, and so do the differences.
    dr.backward(dr.mean(mi.render(box, params, spp=4, seed=1, seed_grad=2), axis=None))
    along = np.array(dr.grad(params[key]), np.float64)
    h, ends = step / np.linalg.norm(along), []
    for move in (h, -h):
        params[key] = mi.TensorXf(np.float32(value + move * along))
        params.update()
        ends.append(float(dr.mean(mi.render(box, spp=4, seed=2), axis=None).array[0]))
    return float((along**2).sum()), (ends[0] - ends[1]) / (2 * h)


def test_nodes_hold_the_values_of_the_network(variant_rgb: str) -> None:
    """With ``nodes``, the grid follows the tensors, and derivatives of an image reach them: against differences."""
    box = scene(nodes=5)
    params = with_values(box)
    at_points = scene()
    with_values(at_points)
    network = at_points.shapes()[0].interior_medium().volumes["sigma_t"].mivol_extinction
    z, y, x = np.meshgrid(*[(np.arange(5) + 0.5) / 5] * 3, indexing="ij")
    p = mi.Point3f(*(mi.Float(np.float32(v.ravel())) for v in (x, y, z)))
    nodes = np.array(params[KEY + "data"]).ravel()
    assert np.allclose(nodes, np.array(network.eval(p, None, mi.Bool(True))[0]), rtol=1e-5)
    assert nodes.std() > 0.5
    # Absorption is exact along fixed rays. float32 errs by 1e-7 of a difference of 4e-4, kinks of the network by less than 1 %.
    steepest, difference = differentiate(box, params, KEY + "table", 0.01)
    assert difference == pytest.approx(steepest, rel=0.01)


SKY, LAMP = {"type": "constant"}, {"type": "point", "position": [2.0, -1.0, 2.0]}

ESTIMATORS = {
    "absorption": (SKY, {"max_depth": 1}, {}),
    "emission": (SKY, {"max_depth": 1}, {"emission": 0.5}),
    "single_scattering": (LAMP, {"max_depth": 2}, {}),
    "scattering_quadrature": (LAMP, {"max_depth": 2, "deterministic": True}, {}),
    "free_flight": (LAMP, {"max_depth": 4}, {"emission": 0.5}),
}
"""An emitter, settings, and what the medium has besides, by the estimator of a segment."""


@pytest.mark.parametrize("name", ESTIMATORS)
def test_each_estimator_has_derivatives_by_the_weights(variant_rgb: str, name: str) -> None:
    """With ``nodes``, gradients by the tensors are those by equal voxels, handed on through the network by Dr.Jit."""
    emitter, settings, more = ESTIMATORS[name]

    def show(volume: dict) -> mi.Scene:
        parts = {"sensor": camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16), "light": emitter}
        box = box_of(medium("mivol_medium", volume, 0.6, **more), np.eye(4))
        return mi.load_dict({"type": "scene", "integrator": {"type": "mivol", **settings}, **parts, "box": box})

    def differentiate(params: mi.SceneParameters, names: list[str], loss: Callable[[], mi.TensorXf]) -> list[np.ndarray]:
        for key in names:
            params[key] = mi.TensorXf(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.sum(loss(), axis=None))
        return [np.array(dr.grad(params[key])) for key in names]

    box, names, data = show(hash_grid(nodes=5)), [KEY + n for n in ("table", "weights_0", "weights_1")], KEY + "data"
    params = with_values(box)
    voxels = show({"type": "mivol_voxels", "data": mi.TensorXf(np.array(params[data]))})
    assert make_plan(find_needs(voxels, voxels.sensors()[0], survey_scene(voxels)), Settings(**settings)).segment == name
    found = differentiate(params, names, lambda: mi.render(box, params, spp=4, seed=1))
    own = mi.traverse(voxels)
    (by_voxels,) = differentiate(own, [data], lambda: mi.render(voxels, own, spp=4, seed=1))
    expected = differentiate(params, names, lambda: params[data] * mi.TensorXf(by_voxels))
    for ours, theirs in zip(found, expected, strict=True):
        # The same products in another order of float32 sums.
        np.testing.assert_allclose(ours, theirs, atol=1e-5 * np.abs(theirs).max())
        assert theirs.any()


@pytest.mark.parametrize("kind", ["hash", "nerf"])
def test_a_fitted_network_is_an_extinction_by_its_weights(variant_rgb: str, tmp_path: Path, kind: str) -> None:
    """``mivol_network``: the density of a file at nodes, and derivatives of an image by the weights, against differences."""
    if kind == "hash":
        sizes = HashSizes(levels=2, log2_table=8, coarsest=2, finest=4, width=8, geometry=2)
        field, name = HashField.random(sizes, np.eye(4), seed=1), "density_weights"
    else:
        sizes = NerfSizes(depth=2, width=8, skip=0, place=2, direction=1, branch=4)
        field, name = NerfField.random(sizes, np.eye(4), seed=1), "weights"
    values = {key: value * (2e3 if key == "table" else 1) for key, value in field.parameters().items()}
    write_field(tmp_path / "f.npz", find_region(field.with_parameters(values), 4))
    box = scene(volume={"type": "mivol_network", "filename": str(tmp_path / "f.npz"), "nodes": 6})
    params, key = mi.traverse(box), KEY + name
    nodes = np.array(params[KEY + "data"])
    assert nodes.shape == (6, 6, 6, 1) and nodes.std() > 0.01 * nodes.mean() > 0
    # As above: float32 errs by 1e-7 of a difference of more than 1e-3.
    steepest, difference = differentiate(box, params, key, 0.02)
    assert difference == pytest.approx(steepest, rel=0.01)


def test_a_network_needs_a_file_of_one(variant_rgb: str, tmp_path: Path) -> None:
    with pytest.raises((RuntimeError, ValueError), match="given no filename"):
        mi.load_dict({"type": "mivol_network"})
    write_field(tmp_path / "grid.npz", ball())
    with pytest.raises((RuntimeError, ValueError), match="is a SphericalGrid, a hash grid or a NeRF is expected"):
        mi.load_dict({"type": "mivol_network", "filename": str(tmp_path / "grid.npz")})


@pytest.mark.parametrize("name", ["albedo", "emission", "emission_density"])
def test_values_at_points_are_an_extinction_only(variant_rgb: str, name: str) -> None:
    """At points, another coefficient is refused; at nodes, it is a grid, whatever the numbers of its table."""
    own = {"type": "mivol_hash", "majorant": 0.9, **SIZES}
    with pytest.raises((RuntimeError, ValueError), match=f"HashDensity, whose values are known at points only, as {name}"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": 1.0, name: own})
    given = medium("mivol_medium", 1.0, 0.0) | {name: {**own, "nodes": 4}}
    box = mi.load_dict(
        {"type": "scene", "integrator": {"type": "mivol"}, "sensor": camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16)}
        | {"light": {"type": "constant"}, "box": box_of(given, np.eye(4))}
    )
    assert np.isfinite(np.array(mi.render(box, spp=1))).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"majorant": -1.0}, "the bound -1 of a mivol_hash"),
        ({"features": 3}, "features = 3, expected 1, 2, 4 or 8"),
        ({"weights_0": np.zeros((8, 6), np.float32)}, "given weights_0; all of table, weights_0, weights_1 or none"),
        (
            {"table": np.zeros((5, 2), np.float32), "weights_0": np.zeros((8, 6)), "weights_1": np.zeros((1, 8))},
            r"table of the shape \(5, 2\); \(280, 2\) is expected",
        ),
        (
            {"table": np.zeros((280, 2)), "weights_0": np.full((8, 6), np.nan), "weights_1": np.zeros((1, 8))},
            "weights_0 with values that are not finite",
        ),
        ({"depth": 3}, "unreferenced|depth"),
        ({"nodes": 0}, "given 0 nodes along its longest edge"),
    ],
)
def test_parameters_that_contradict_are_refused(variant_rgb: str, change: dict, said: str) -> None:
    given = {name: mi.TensorXf(np.float32(v)) if isinstance(v, np.ndarray) else v for name, v in change.items()}
    with pytest.raises((RuntimeError, ValueError), match=said):
        mi.load_dict({"type": "mivol_hash", "majorant": 3.0, **SIZES, **given})


def test_a_majorant_is_asked_for(variant_rgb: str) -> None:
    with pytest.raises((RuntimeError, ValueError), match="given no majorant"):
        mi.load_dict({"type": "mivol_hash"})
