"""Adam and RMSprop against float64 formulas, through restarts, replaced values and refinements."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.optim.first_order import LARGEST, LONGEST_MEMORY, Adam, RMSprop, descend, from_halves, to_halves
from mivol.optim.optimizer import SCHEDULES, Constant, Cosine, Exponential, Step
from mivol.optim.problem import Refinement


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
def test_adam_steps_match_the_paper(size: float) -> None:
    """Derivatives count relative to the largest of the first step, whatever their unit."""
    problem = Given(size)
    run, twin = SETTINGS.begin(problem), Twin(SETTINGS, problem)
    for iteration in range(4):
        assert run.step(iteration, 0.7) == 7.0 + iteration
        twin.step(iteration, 0.7)
        assert_same(run, twin)
    assert problem.asked == [(k, 3) for k in range(4)]


def test_restored_run_continues() -> None:
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


def test_zero_gradient_moves_nothing() -> None:
    run = SETTINGS.begin(Given(0.0))
    run.step(0, 1.0)
    assert run.scale == 1.0
    np.testing.assert_array_equal(np.array(run.reals["b"]), np.full(4, 2.0, np.float32))


def test_replaced_value_resets_the_moments() -> None:
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


def test_refinement_carries_moments_over() -> None:
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


def test_rmsprop_steps_match_the_formula(variant_rgb: str) -> None:
    """Three steps against NumPy in float64: the first moves by the rate itself, for its square is its own mean."""
    rng = np.random.default_rng(0)
    slopes, x, mean = rng.normal(size=(3, 8)), rng.normal(size=8), np.zeros(8)
    values, squares = mi.Float(x.astype(np.float32)), mi.Float(np.zeros(8, np.float32))
    for k, g in enumerate(slopes):
        values, squares = descend(values, squares, mi.Float(g.astype(np.float32)), 0.1, 0.9)
        mean = g**2 if k == 0 else 0.9 * mean + 0.1 * g**2
        x = x - 0.1 * g / np.sqrt(mean)
        # Steps of at most 0.32 with a relative rounding of a few float32 ulp each (rsqrt: 2^-22).
        np.testing.assert_allclose(np.array(values), x, atol=3 * 0.32 * 2**-20)
        np.testing.assert_allclose(np.array(squares), mean, rtol=4 * 2**-23)


def test_zero_derivative_keeps_value_and_mean(variant_rgb: str) -> None:
    """Number 0 was never touched, number 1 was and is not now, number 2 is: only that one changes."""
    values, squares = mi.Float(1, 2, 3), mi.Float(0, 4, 4)
    moved, known = descend(values, squares, mi.Float(0, 0, 2), 0.5, 0.9)
    assert np.array(moved).tolist() == [1, 2, 2.5]
    assert np.array(known).tolist() == [0, 4, 4]


def test_halves_survive_conversion_to_means_and_back(variant_rgb: str) -> None:
    """What was held is held again as it was, so what has no derivative is not worn away; 0 stays 0."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16)
    means = from_halves(mi.TensorXf16(halves))
    known = np.array(means)
    assert known[0] == 0 and (np.diff(known) > 0).all() and np.isfinite(known).all()
    assert (np.array(to_halves(means)) == halves).all()


def test_means_in_halves_are_accurate_to_a_fifth_of_a_percent(variant_rgb: str) -> None:
    """Half a unit in the last of 11 bits, four times; the roundings of float32 add less than 2^-19."""
    means = np.geomspace(1e-24, 1e12, 20001).astype(np.float32)
    found = np.array(from_halves(to_halves(mi.TensorXf(means)))) / means.astype(np.float64)
    assert np.abs(found - 1).max() < (1 + 2**-11) ** 4 - 1 + 2**-19
    largest = np.array(to_halves(mi.TensorXf(np.float32([1e20, 3e38]))))
    assert (largest == LARGEST).all()


def test_means_in_halves_follow(variant_rgb: str) -> None:
    """With the longest memory a mean goes from 100 to 1 as derivatives do, but for the 2^-9 / (1 - memory) of it by which
    rounding can hold it; with a hundred times that memory it would not move at all, and longer ones are refused."""

    def after(memory: float) -> float:
        held = to_halves(mi.TensorXf([100.0], (1,)))
        for _ in range(1000):
            held = to_halves(mi.TensorXf(descend(mi.Float(0), from_halves(held).array, mi.Float(1), 0.1, memory)[1], (1,)))
        return float(from_halves(held).array[0])

    assert after(LONGEST_MEMORY) == pytest.approx(1, rel=2**-9 / (1 - LONGEST_MEMORY) * 1.1)
    assert after(1 - (1 - LONGEST_MEMORY) / 100) == pytest.approx(100, rel=2**-9)
    with pytest.raises(MivolError, match=r"found memory = 0.999 with half = true, expected at most 0.98"):
        RMSprop(memory=0.999, half=True).begin(None)


# -- Schedules ---------------------------------------------------------------------------------------------------------


def test_schedules_begin_at_1_and_end_at_their_final_value() -> None:
    n = 41
    chosen = [Constant(), Cosine(final=0.2), Step(at=(0.5, 0.9), ratio=0.1), Exponential(final=0.01, delay=10)]
    assert {schedule.label() for schedule in chosen} == set(SCHEDULES)
    factors = np.array([[s.factor(i, n) for i in range(n)] for s in chosen])
    assert np.allclose(factors[:, 0], 1.0)
    assert np.allclose(factors[:, -1], [1.0, 0.2, 0.01, 0.01])
    assert np.all(np.diff(factors, axis=1) <= 1e-12)
    assert np.isclose(factors[1, 20], 0.6)
    assert np.allclose(factors[3, [10, 25]], [1.0, 0.1])
    assert np.allclose(factors[2, [20, 21]], [1.0, 0.1])
