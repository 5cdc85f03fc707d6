"""Gradients of single scattering and the float64 twin's differences, for tests of several modules."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, fresh
from scattering_scenes import Pencils, mivol, rough_grid

from mivol.scene import render_tasks
from mivol.validate.statistics import Moments

GRID = "smoke.interior_medium.sigma_t.data"
BATCHES = 16


def watched(scene: mi.Scene, key: str) -> tuple[mi.SceneParameters, object]:
    """A parameter whose derivatives are asked for, as an optimizer does it: stock textures make copies of the variable."""
    params = mi.traverse(scene)
    variable = type(params[key])(params[key])
    dr.enable_grad(variable)
    params[key] = variable
    params.update()
    return params, variable


def note_ways(monkeypatch: pytest.MonkeyPatch, *names: str) -> list[str]:
    """A list to which functions of :mod:`mivol.scene.render_tasks` with these names add their names when they are called."""
    ways: list[str] = []
    for name in names:
        real = getattr(render_tasks, name)
        monkeypatch.setattr(render_tasks, name, lambda *args, name=name, real=real: ways.append(name) or real(*args))
    return ways


def vjp(scene: mi.Scene, key: str, w: np.ndarray, spp: int, seed: int, integrator: mi.Integrator) -> np.ndarray:
    """J^T w: the derivative of <w, image>, by `mi.render`; `seed` is that of the derivatives."""
    params, variable = watched(scene, key)
    image = mi.render(scene, params, integrator=integrator, spp=1, spp_grad=spp, seed=seed + 10_000, seed_grad=seed)
    dr.backward(dr.sum(image * mi.TensorXf(np.asarray(w, dtype=np.float32))))
    gradient = np.array(dr.grad(variable), dtype=np.float64)
    release(scene, key, variable)
    return gradient


def backward(scene: mi.Scene, key: str, w: np.ndarray, spp: int, seed: int, integrator: mi.Integrator) -> np.ndarray:
    """J^T w, by the integrator's own pass."""
    params, variable = watched(scene, key)
    integrator.render_backward(scene, params, mi.TensorXf(np.asarray(w, dtype=np.float32)), seed=seed, spp=spp)
    found = np.array(dr.grad(variable), dtype=np.float64)
    release(scene, key, variable)
    return found


def forward(scene: mi.Scene, key: str, v: np.ndarray | float, spp: int, seed: int, integrator: mi.Integrator) -> np.ndarray:
    """J v with the same random numbers."""
    params, variable = watched(scene, key)
    kind = type(variable)
    dr.set_grad(variable, kind(np.asarray(v, dtype=np.float32)) if np.ndim(v) else kind(float(v)))
    found = np.array(integrator.render_forward(scene, params, seed=seed, spp=spp), dtype=np.float64)
    release(scene, key, variable)
    return found


def along(scene: mi.Scene, key: str, v: np.ndarray | float, integrator: mi.Integrator, spp: int) -> Estimate:
    """The derivative of the mean of an image of 8 x 8 pixels along v, from independent reverse passes."""
    w = np.full((8, 8, 3), 1 / 192)
    found = [np.sum(backward(scene, key, w, spp, fresh(k), integrator) * v) for k in range(BATCHES)]
    return Estimate.from_result(Moments.from_values(np.array(found)[:, None]))


def upper_half(scene: mi.Scene, key: str) -> np.ndarray | float:
    """A random direction that changes the upper half of a grid; light of both halves may nearly cancel. 1 for a number."""
    shape = np.shape(mi.traverse(scene)[key])
    if len(shape) < 4:
        return 1.0
    v = np.random.default_rng(2).uniform(0.5, 1.5, shape)
    v[: shape[0] // 2] = 0
    return v


def assert_transposed(there: np.ndarray, back: np.ndarray, rounding: float = 1e-4) -> None:
    """The terms of <J v, w> and of <v, J^T w> of one seed have one sum, and not 0: the same terms in another order.

    Of some 1000 paths of ten terms each, summed in float32; they are of both signs, so the sum of sizes counts.
    """
    assert np.sum(there) == pytest.approx(np.sum(back), abs=rounding * max(np.abs(there).sum(), np.abs(back).sum()))
    assert np.sum(there) != 0


def assert_each_transposed(
    scene: mi.Scene, keys: list[str], integrator: mi.Integrator, spp: int, seed: int, rounding: float = 1e-4
) -> None:
    """<J v, w> = <v, J^T w> for each parameter of a scene of 8 x 8 pixels, with the same random numbers.

    Each pass follows all parameters, and v is 0 for all but one: one kernel of each mode serves all of them.
    """
    followed = {key: watched(scene, key)[1] for key in keys}
    rng, w = np.random.default_rng(2), np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3))
    along = {key: rng.uniform(0.5, 1.5, np.shape(value)) for key, value in followed.items()}
    integrator.render_backward(scene, mi.traverse(scene), mi.TensorXf(w.astype(np.float32)), seed=seed, spp=spp)
    back = {key: np.array(dr.grad(value), dtype=np.float64) for key, value in followed.items()}
    params = mi.traverse(scene)
    for chosen in keys:
        for key in keys:
            tangent = type(params[key])((along[key] * (key == chosen)).astype(np.float32))
            dr.make_opaque(tangent)
            dr.set_grad(params[key], tangent)  # a map copies what it is given
        there = np.array(integrator.render_forward(scene, params, seed=seed, spp=spp), dtype=np.float64)
        assert_transposed(there * w, back[chosen] * along[chosen], rounding)
    for key, value in followed.items():
        release(scene, key, value)


def release(scene: mi.Scene, key: str, parameter: object) -> None:
    """No derivatives any more."""
    params = mi.traverse(scene)
    params[key] = dr.detach(parameter)
    params.update()


def weights(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A gradient image (1, n, 3), and what each ray weighs where the channels are equal."""
    w = np.random.default_rng(seed).uniform(0.5, 1.5, (1, n, 3))
    return w, w[0].sum(axis=1)


def gradients(seen: Pencils, key: str, w: np.ndarray, spp: int, settings: dict | None = None) -> np.ndarray:
    """J^T w of independent passes, (BATCHES, ...)."""
    integrator = mi.load_dict(mivol(**(settings or {})))
    return np.stack([vjp(seen.scene, key, w, spp, fresh(seed), integrator) for seed in range(BATCHES)])


def assert_gradient(found: np.ndarray, truth: np.ndarray, what: str, precision: float = 0.02, rounding: float = 2e-5) -> None:
    """Each entry, and the sum of all weighted by numbers in [0.5, 1.5].

    `rounding` is a share of the largest entry (or of the sum), `precision` what the standard error of the sum may be of the
    sum of sizes.
    """
    truth = np.broadcast_to(truth, found.shape[1:])
    v = np.random.default_rng(4).uniform(0.5, 1.5, truth.shape)
    axes = tuple(range(1, found.ndim))
    for each, exact in ((found, truth), (np.sum(found * v, axis=axes, keepdims=True)[:, 0], np.sum(truth * v)[None])):
        m, exact = Moments.from_values(each.reshape(BATCHES, -1)), exact.ravel()
        top = np.abs(exact).max()
        assert_same_mean(m, exact, rounding=rounding * top, what=what)
    assert_precise(m, precision * np.sum(np.abs(truth * v)), what=what)


def twin_difference(at: Callable[[float], float], x: float, h: float = 1e-4) -> float:
    return (at(x + h) - at(x - h)) / (2 * h)


DENSITIES = {
    "empty": lambda: 0.0 * rough_grid(1),
    "half empty": lambda: rough_grid(1) * (np.arange(6) < 3)[None, None, :, None],
    "thin": lambda: 1e-3 * rough_grid(1),
    "flat": lambda: np.full((3, 4, 2, 1), 0.7),
    "rough": lambda: rough_grid(1),
    "dense": lambda: rough_grid(1, 12.0),
}
