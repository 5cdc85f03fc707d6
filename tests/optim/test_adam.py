"""Adam against its own formulas in float64, through restarts, replaced values and refinements."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.optim.first_order import Adam
from mivol.optim.problem import Refinement

pytestmark = pytest.mark.usefixtures("variant_rgb")


class Given:
    """Two parameters with derivatives that are drawn, and a bound from below for one of them."""

    def __init__(self, size: float = 1.0) -> None:
        self.size, self.asked = size, []

    def initial_reals(self) -> dict[str, mi.TensorXf]:
        return {"a": mi.TensorXf(np.full((2, 3), 0.5, np.float32)), "b": mi.TensorXf(np.full(4, 2.0, np.float32))}

    def slopes(self, iteration: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(iteration)
        return {"a": np.float32(self.size * rng.normal(size=(2, 3))), "b": np.float32(-3 * self.size * rng.uniform(size=4))}

    def loss_and_gradient(self, reals: dict, iteration: int, views: int) -> tuple[float, dict]:
        self.asked.append((iteration, views))
        return 7.0 + iteration, {name: mi.TensorXf(array) for name, array in self.slopes(iteration).items()}

    def learning_rates(self, iteration: int) -> dict[str, float]:
        return {"a": 0.1 / (1 + iteration), "b": 0.02}

    def after_step(self, reals: dict, iteration: int) -> dict:
        return {"a": mi.TensorXf(np.maximum(np.array(reals["a"]), 0.45))}


class Twin:
    """Kingma and Ba 2015, section 2 (both corrections in the rate), of slopes over the largest one of the first step."""

    def __init__(self, settings: Adam, problem: Given) -> None:
        self.s, self.problem, self.count, self.scale = settings, problem, 0, 0.0
        self.x = {name: np.array(value, np.float64) for name, value in problem.initial_reals().items()}
        self.m = {name: np.zeros_like(value) for name, value in self.x.items()}
        self.v = {name: np.zeros_like(value) for name, value in self.x.items()}

    def step(self, iteration: int, factor: float) -> None:
        slopes = self.problem.slopes(iteration)
        self.scale = self.scale or max(np.abs(g).max() for g in slopes.values()) or 1.0
        self.count += 1
        for name, rate in self.problem.learning_rates(iteration).items():
            g = slopes[name] / self.scale
            self.m[name] = self.s.beta_1 * self.m[name] + (1 - self.s.beta_1) * g
            self.v[name] = self.s.beta_2 * self.v[name] + (1 - self.s.beta_2) * g**2
            corrected = np.sqrt(1 - self.s.beta_2**self.count) / (1 - self.s.beta_1**self.count)
            self.x[name] = self.x[name] - rate * factor * corrected * self.m[name] / (np.sqrt(self.v[name]) + self.s.epsilon)
        self.x["a"] = np.maximum(self.x["a"], 0.45)


SETTINGS = Adam(beta_1=0.8, beta_2=0.95, epsilon=0.05, views=3)


def assert_same(run: object, twin: Twin) -> None:
    """Steps of at most 0.1, each with some ten roundings of float32."""
    for name, value in twin.x.items():
        np.testing.assert_allclose(np.array(run.reals[name]), value, rtol=0, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("size", [1.0, 1e-9, 1e6])
def test_steps_are_those_of_the_paper(size: float) -> None:
    """Derivatives count relative to the largest of the first step, whatever their unit."""
    problem = Given(size)
    run, twin = SETTINGS.begin(problem), Twin(SETTINGS, problem)
    for iteration in range(4):
        assert run.step(iteration, 0.7) == 7.0 + iteration
        twin.step(iteration, 0.7)
        assert_same(run, twin)
    assert problem.asked == [(k, 3) for k in range(4)]


def test_a_restored_run_goes_on() -> None:
    problem = Given()
    run, twin = SETTINGS.begin(problem), Twin(SETTINGS, problem)
    for iteration in range(2):
        run.step(iteration, 1.0)
        twin.step(iteration, 1.0)
    again = SETTINGS.begin(problem)
    again.unpack(run.pack())
    for iteration in range(2, 4):
        again.step(iteration, 1.0)
        twin.step(iteration, 1.0)
    assert_same(again, twin)


def test_without_a_derivative_nothing_moves() -> None:
    run = SETTINGS.begin(Given(0.0))
    run.step(0, 1.0)
    assert run.scale == 1.0
    np.testing.assert_array_equal(np.array(run.reals["b"]), np.full(4, 2.0, np.float32))


def test_another_value_begins_anew() -> None:
    """What was learnt of it is dropped, its count too, and derivatives are measured by the next ones."""
    problem = Given()
    run = SETTINGS.begin(problem)
    run.step(0, 1.0)
    run.replace("b", mi.TensorXf(np.full(4, 2.0, np.float32)))
    assert run.scale == 0.0
    twin = Twin(SETTINGS, problem)
    run.step(1, 1.0)
    twin.step(1, 1.0)
    np.testing.assert_allclose(np.array(run.reals["b"]), twin.x["b"], rtol=0, atol=2e-6)


def test_moments_are_carried_through_a_refinement() -> None:
    """Rows are repeated; derivatives of a number that now stands for half of what it did are half, their squares a quarter."""
    problem = Given()
    run, twin = SETTINGS.begin(problem), Twin(SETTINGS, problem)
    run.step(0, 1.0)
    twin.step(0, 1.0)

    def carry(tensors: dict) -> dict:
        return {name: mi.TensorXf(np.repeat(np.array(value), 2, axis=0)) for name, value in tensors.items()}

    run.refine(Refinement(carry(run.reals), carry, {"a": 0.5}, "says"))
    for of in (twin.x, twin.m, twin.v):
        for name in of:
            of[name] = np.repeat(of[name], 2, axis=0)
    twin.m["a"], twin.v["a"] = twin.m["a"] / 2, twin.v["a"] / 4
    slopes = problem.slopes
    problem.slopes = lambda k: {name: np.repeat(value, 2, axis=0) for name, value in slopes(k).items()}
    run.step(1, 1.0)
    twin.step(1, 1.0)
    assert_same(run, twin)
