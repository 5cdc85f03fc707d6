r"""Fields known at points, integrated by quadrature: AOVs, ``deterministic`` and moving emitters against float64 sums.

Tolerances. Two Gauss points in a piece of length L err by at most K L^2 times the variation of the slope inside, with
K = 0.0224 the largest value of the Peano kernel of order 2 (at a Gauss point: (1 - u)^2 / 2 - (1 - 2 u) / 2 with u = 0.2113).
A jump J costs at most 0.2887 L J. Float32 adds 1e-5.
"""

from __future__ import annotations

from dataclasses import dataclass

import bounded_ball
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean
from scattering_scenes import pencils

from mivol.errors import MivolError
from mivol.validate.statistics import Moments
from scenes import box_of, camera, medium

CELLS, LEVELS, SIZES = 6, 2, {"levels": 2, "coarsest": 2, "finest": 6, "log2_table": 12, "width": 8}
PEANO, JUMP, PIECE = 0.0224, 0.2887, np.sqrt(3) / (2 * CELLS)
KEY, LAMP = "box.interior_medium.sigma_t.", np.array([1.7, -0.9, 1.4])


def hash_grid(**more: object) -> dict:
    return {"type": "mivol_hash", "majorant": 6.0, "seed": 4, **SIZES, **more}


def parts(albedo: float = 0.0, emitter: dict | None = None, majorant: float = 6.0, **more: object) -> dict:
    """The unit cube of a hash grid."""
    box = box_of(medium("mivol_medium", hash_grid(majorant=majorant), albedo, **more), np.eye(4))
    return {"light": emitter or {"type": "constant"}, "box": box}


def with_values(scene: mi.Scene) -> mi.SceneParameters:
    """The parameters, with features of order 1 on the coarse level and a quarter of it on the fine one."""
    params, rng = mi.traverse(scene), np.random.default_rng(0)
    table = 2 * rng.normal(size=params[KEY + "table"].shape)
    table[27:] *= 0.25
    params[KEY + "table"] = mi.TensorXf(np.float32(table))
    params.update()
    return params


def view(integrator: dict, **more: object) -> tuple[mi.Scene, mi.SceneParameters]:
    """The cube before a camera of 4 x 4 pixels."""
    sensor = camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "mivol", **integrator}, "sensor": sensor, **parts(**more)})
    return scene, with_values(scene)


@dataclass
class Twin:
    """The same hash grid in float64, with all levels dense."""

    values: dict[str, np.ndarray]

    def sigma(self, x: np.ndarray) -> np.ndarray:
        """Extinction at points (..., 3)."""
        first, features = 0, []
        for cells in (2, CELLS):
            place = np.clip(x, 0, 1) * cells
            node = np.minimum(place.astype(int), cells - 1)
            total = 0.0
            for corner in np.ndindex(2, 2, 2):
                i, j, k = np.moveaxis(node + corner, -1, 0)
                share = np.prod(np.where(corner, place - node, 1 - (place - node)), axis=-1)
                total += share[..., None] * self.values["table"][first + i + (cells + 1) * (j + (cells + 1) * k)]
            features.append(total)
            first += (cells + 1) ** 3
        hidden = np.maximum(np.concatenate(features, axis=-1) @ self.values["weights_0"].T, 0)
        raw = (hidden @ self.values["weights_1"].T)[..., 0]
        return np.all((x >= 0) & (x <= 1), axis=-1) * 6 / (1 + np.exp(3 - raw))

    def along(self, o: np.ndarray, d: np.ndarray, end: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
        """Distances (n, count) in the cube of midpoints on rays, their spacing (n,), and the extinction there."""
        with np.errstate(divide="ignore"):
            a, b = -o / d, (1 - o) / d
        t0 = np.maximum(np.minimum(a, b).max(axis=-1), 0)
        t1 = np.maximum(np.minimum(np.maximum(a, b).min(axis=-1), end), t0)
        t = t0[:, None] + (t1 - t0)[:, None] * (np.arange(count) + 0.5) / count
        return t, (t1 - t0) / count, self.sigma(o[:, None] + t[..., None] * d[:, None])


def variation(f: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """Variation of the slope of samples (n, count)."""
    return np.abs(np.diff(f, n=2, axis=1)).sum(axis=1) / np.maximum(dt, 1e-12)


def twin_of(params: mi.SceneParameters) -> Twin:
    return Twin({name: np.array(params[KEY + name], np.float64) for name in ("table", "weights_0", "weights_1")})


RAYS = np.array([[0.2, 0.3, 0.9], [0.8, 0.45, 0.1], [0.5, 0.62, 0.4], [0.3, 0.9, 0.6]])
"""Points of the cube that rays from ``EYE`` pass."""

EYE = np.array([0.41, -2.0, 0.63])


def aim() -> tuple[np.ndarray, np.ndarray]:
    d = RAYS - EYE
    return EYE, d / np.linalg.norm(d, axis=1, keepdims=True)


def test_aovs_equal_sums_in_float64(variant_rgb: str) -> None:
    """Optical depth, opacity and expected depth."""
    seen = pencils(parts(), *aim())
    twin = twin_of(with_values(seen.scene))
    t, dt, sigma = twin.along(seen.o, seen.d, np.full(len(seen.o), np.inf), 4000)
    tau = sigma.sum(axis=1) * dt
    T = np.exp(-(np.cumsum(sigma, axis=1) - 0.5 * sigma) * dt[:, None])
    alpha, bound = 1 - np.exp(-tau), PEANO * PIECE**2 * variation(sigma, dt) + 1e-5
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": "tau,alpha,depth"})
    image = np.array(mi.render(seen.scene, integrator=integrator, spp=1))[0, :, 3:]
    assert tau.min() > 0.2 and bound.max() < 0.02
    assert (np.abs(image[:, 0] - tau) <= bound).all()
    assert (np.abs(image[:, 1] - alpha) <= bound).all()
    # The mean distance moves by at most the length of the ray times the relative error of its weights, in N and in alpha.
    assert (np.abs(image[:, 2] - (t * sigma * T).sum(axis=1) * dt / alpha) <= 2 * bound / alpha * np.ptp(t, axis=1)).all()


@pytest.mark.parametrize("name", ["table", "weights_0", "weights_1"])
def test_derivatives_of_aovs_equal_differences(variant_rgb: str, name: str) -> None:
    """Forward and reverse, along the gradient."""
    scene, params = view({"max_depth": 1, "aovs": "tau,alpha,depth"})
    value, weight = np.array(params[KEY + name]), np.random.default_rng(1).normal(size=(4, 4, 6)).astype(np.float32)
    weight[..., :3] = 0

    def mean() -> float:
        return float((np.array(mi.render(scene, spp=4, seed=2), np.float64) * weight).sum())

    dr.enable_grad(params[KEY + name])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, spp=4, seed=1, seed_grad=2) * mi.TensorXf(weight), axis=None))
    along = np.array(dr.grad(params[KEY + name]), np.float64)
    size = np.linalg.norm(along)
    params[KEY + name] = mi.TensorXf(value)
    dr.enable_grad(params[KEY + name])
    dr.set_grad(params[KEY + name], mi.TensorXf(np.float32(along / size)))
    params.update()
    tangent = scene.integrator().render_forward(scene, params, scene.sensors()[0], seed=2, spp=4)
    # Sums of the same products in float32, in another order.
    assert (np.array(tangent, np.float64) * weight).sum() == pytest.approx(size, rel=1e-4)
    h, ends = 3e-3, []
    for move in (h, -h):
        params[KEY + name] = mi.TensorXf(np.float32(value + move * along / size))
        params.update()
        ends.append(mean())
    # float32 errs by 1e-7 of sums of about 50, over 2 h; h^2 / 6 of a third derivative below the slope itself.
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(size, abs=1e-7 * 50 / h + h * size)


def test_scattered_light_without_noise_equals_a_sum_in_float64(variant_rgb: str) -> None:
    """``deterministic`` at depth 2 under a point light."""
    lamp = {"type": "point", "position": LAMP.tolist(), "intensity": 5.0}
    seen = pencils(parts(0.7, lamp), *aim())
    twin = twin_of(with_values(seen.scene))
    t, dt, sigma = twin.along(seen.o, seen.d, np.full(len(seen.o), np.inf), 600)
    x = (seen.o[:, None] + t[..., None] * seen.d[:, None]).reshape(-1, 3)
    away = LAMP - x
    r = np.linalg.norm(away, axis=1)
    _, step, shade = twin.along(x, away / r[:, None], r, 300)
    shadow, errs = shade.sum(axis=1) * step, PEANO * PIECE**2 * variation(shade, step)
    T = np.exp(-(np.cumsum(sigma, axis=1) - 0.5 * sigma) * dt[:, None])
    g = T * sigma * 0.7 * (5 * np.exp(-shadow) / r**2 / (4 * np.pi)).reshape(t.shape)
    truth = g.sum(axis=1) * dt
    image = np.array(
        mi.render(seen.scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 2, "deterministic": True}), spp=1)
    )
    # Twice the error of Gauss points, since the transmittance to them is found by the same points; and that of both depths.
    bound = 2 * PEANO * PIECE**2 * variation(g, dt) + (g * errs.reshape(t.shape)).sum(axis=1) * dt
    bound += truth * (PEANO * PIECE**2 * variation(sigma, dt) + 1e-5)
    assert (bound < 0.1 * truth).all()
    assert (np.abs(image[0, :, 0] - truth) <= bound).all()


def test_the_light_of_an_even_glow_is_its_opacity(variant_rgb: str) -> None:
    """``deterministic`` with an emission of 1 and no sky: each ray sees 1 - exp(-tau), whatever the extinction."""
    scene, _ = view({"max_depth": 1, "deterministic": True, "hide_emitters": True, "aovs": "alpha"}, emission=1.0)
    image = np.array(mi.render(scene, spp=1))
    assert image[..., 3].min() > 0.1
    np.testing.assert_allclose(image[..., 0], image[..., 3], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.statistical
def test_gradients_of_images_without_noise(variant_rgb: str) -> None:
    """By the place of the lamp and by weights: estimates of derivatives against differences of images without noise.

    The lamp moves across its distance to the cube, so that its shadows change most.
    """
    lamp = {"type": "point", "position": LAMP.tolist()}
    scene, params = view({"max_depth": 2, "deterministic": True}, albedo=0.7, emitter=lamp, majorant=40.0)
    keys, runs = ("light.position", KEY + "weights_1"), 12
    values = {key: np.array(params[key], np.float64) for key in keys}
    along = {key: np.ones_like(value) / np.sqrt(value.size) for key, value in values.items()}
    away = LAMP - 0.5
    upwards = np.cross(np.cross(away, [0, 0, 1]), away)
    along["light.position"] = (upwards / np.linalg.norm(upwards)).reshape(along["light.position"].shape)

    def put(key: str, value: np.ndarray) -> None:
        value = np.float32(value)
        params[key] = mi.Point3f(*map(float, value.ravel())) if key == "light.position" else mi.TensorXf(value)

    slopes = {}
    for key in keys:
        h, ends = 1e-2, []
        for move in (h, -h):
            put(key, values[key] + move * along[key])
            params.update()
            ends.append([np.array(mi.render(scene, spp=256, seed=k), np.float64).mean() for k in range(3)])
        put(key, values[key])
        slopes[key] = (np.array(ends[0]) - ends[1]) / (2 * h)
    drawn: dict = {key: [] for key in keys}
    for seed in range(runs):
        for key in keys:
            put(key, values[key])
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=1024, seed=seed, seed_grad=100 + seed), axis=None))
        for key in keys:
            drawn[key].append(float((np.array(dr.grad(params[key]), np.float64).reshape(along[key].shape) * along[key]).sum()))
    for key in keys:
        found, truth = np.array(drawn[key]), slopes[key].mean()
        moments = Moments(runs, found.mean(), ((found - found.mean()) ** 2).sum())
        # The slope of a shadow errs by the quadrature of a slope that jumps: by 0.9 % of its smallest component, where
        # cells lay beside the kinks (docs/notes/radiance_fields.md); halves between them err by a third of that or less.
        assert_same_mean(moments, truth, rounding=np.ptp(slopes[key]) + 0.005 * abs(truth), what=key)


def test_a_jump_is_integrated_to_a_part_of_a_cell(variant_rgb: str) -> None:
    """A ball of another package: its optical depth is sigma times the chord."""
    bounded_ball.register()
    ball = {"type": "strangers_ball", "sigma": [0.5, 1.0, 2.0], "radius": 0.8}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "mivol_medium", "sigma_t": ball}}
    o, d = np.array([[0.1, -4, 0.2], [0.3, -4, -0.4]]), np.array([0.0, 1.0, 0.0])
    seen = pencils({"sky": {"type": "constant"}, "cube": cube}, o, d)
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, "deterministic": True, "aovs": "tau.R,tau.G,tau.B"})
    image = np.array(mi.render(seen.scene, integrator=integrator, spp=1))[0]
    chord = 2 * np.sqrt(0.8**2 - seen.o[:, 0] ** 2 - seen.o[:, 2] ** 2)
    sigma, piece = np.array([0.5, 1.0, 2.0]), 1.6 / 128
    assert (np.abs(image[:, 3:] - sigma * chord[:, None]) <= 2 * JUMP * piece * sigma + 1e-5).all()
    np.testing.assert_allclose(image[:, :3], np.exp(-image[:, 3:]), rtol=1e-5)


def test_a_moving_lamp_beside_values_that_may_jump_is_refused(variant_rgb: str) -> None:
    bounded_ball.register()
    cube = box_of(medium("mivol_medium", {"type": "strangers_ball", "sigma": 1.0}, 0.5), np.eye(4))
    lamp = {"type": "point", "position": LAMP.tolist()}
    sensor = camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "mivol"}, "sensor": sensor, "light": lamp, "box": cube})
    params = mi.traverse(scene)
    dr.enable_grad(params["light.position"])
    with pytest.raises(MivolError, match="derivative of light.position was requested, which misses jumps of its values: use"):
        dr.backward(dr.mean(mi.render(scene, params, spp=1), axis=None))


def test_too_many_cells_for_quadrature_are_refused(variant_rgb: str) -> None:
    fine = box_of(medium("mivol_medium", hash_grid() | {"finest": 513, "log2_table": 6}, 0.0), np.eye(4))
    sensor = camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16)
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "sensor": sensor, "box": fine})
    with pytest.raises(
        MivolError, match="sigma_t has 513 cells along an axis .* at most 512: leave deterministic and aovs out"
    ):
        mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": "tau"}), spp=1)
