"""L-BFGS and its line search: inverse Hessian, stored pairs, and failed searches."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.optim.second_order import Lbfgs, LbfgsRun, apply_inverse_hessian, search_line


class Bowl:
    """1/2 (x - c)^T A (x - c) in float64, of one parameter with bounds; each call of the loss is counted."""

    def __init__(self, n: int = 4, low: float = -10.0, high: float = 10.0) -> None:
        rng = np.random.default_rng(3)
        half = rng.normal(size=(n, n))
        self.A, self.c = half @ half.T + np.eye(n), rng.uniform(0.2, 0.8, n)
        bounds = (low, high)
        self.parameters = [SimpleNamespace(name="x", lr=0.5, bounds=lambda: bounds)]
        self.worse = 0.0

    def initial_reals(self) -> dict[str, mi.TensorXf]:
        return {"x": mi.TensorXf(np.full(len(self.c), 0.1, np.float32))}

    def _value(self, x: np.ndarray) -> float:
        return 0.5 * (x - self.c) @ self.A @ (x - self.c)

    def loss_value(self, reals: dict, seed: int) -> float:
        return self._value(np.array(reals["x"], np.float64)) + self.worse

    def loss_and_gradient(self, reals: dict, seed: int) -> tuple[float, dict]:
        x = np.array(reals["x"], np.float64)
        return self._value(x), {"x": mi.TensorXf((self.A @ (x - self.c)).astype(np.float32))}


def dense_product(g: np.ndarray, steps: list, changes: list) -> np.ndarray:
    """The same by matrices: Nocedal and Wright 2006, Eqs. 7.16 and 7.20."""
    s, y = steps[-1], changes[-1]
    H = np.eye(len(g)) * (s @ y) / (y @ y)
    for s, y in zip(steps, changes, strict=True):
        rho = 1 / (s @ y)
        V = np.eye(len(g)) - rho * np.outer(y, s)
        H = V.T @ H @ V + rho * np.outer(s, s)
    return H @ g


def test_two_loops_are_the_product_with_the_inverse_hessian() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(6, 6))
    steps = list(rng.normal(size=(4, 6)))
    changes = [(half @ half.T + np.eye(6)) @ s for s in steps]
    g = rng.normal(size=6)
    given = g.copy()
    wanted = dense_product(g, steps, changes)
    np.testing.assert_allclose(apply_inverse_hessian(g, steps, changes), wanted, rtol=1e-9)
    np.testing.assert_array_equal(g, given)
    # A pair that the bounds have left without curvature says nothing.
    nothing = np.zeros(6)
    np.testing.assert_allclose(
        apply_inverse_hessian(g, [*steps, nothing, steps[0]], [*changes, nothing, -changes[0]]), wanted, rtol=1e-9
    )
    np.testing.assert_allclose(apply_inverse_hessian(g, [], []), g / np.abs(g).max(), rtol=1e-15)
    np.testing.assert_array_equal(apply_inverse_hessian(nothing, [], []), nothing)


def test_lbfgs_steps_match_dense_matrices() -> None:
    """The run is followed in float64 from what it met: the first step has the size 1 in units of the rate, the next ones go
    along -H g of the pairs that are remembered, the newest of them last; reals are float32, so 1e-5 of a step."""
    problem = Bowl()
    run = Lbfgs(memory=2).begin(problem)
    met, steps, changes = [], [], []
    for iteration in range(5):
        x = np.array(run.reals["x"], np.float64)
        loss = run.step(iteration, 1.0)
        assert loss == pytest.approx(problem._value(x), rel=1e-12)
        g = np.float32(problem.A @ (x - problem.c)).astype(np.float64)
        met.append((x / 0.5, 0.5 * g))
        if iteration:
            steps, changes = [*steps, met[-1][0] - met[-2][0]][-2:], [*changes, met[-1][1] - met[-2][1]][-2:]
        np.testing.assert_allclose(run.steps, steps, atol=1e-6)
        np.testing.assert_allclose(run.changes, changes, atol=1e-6)
        u, h = met[-1]
        p = -h / np.abs(h).max() if not iteration else -dense_product(h, steps, changes)
        alpha = next(a for a in 0.5 ** np.arange(10.0) if problem._value(0.5 * (u + a * p)) <= loss + 1e-4 * a * (h @ p))
        np.testing.assert_allclose(np.array(run.reals["x"]), 0.5 * (u + alpha * p), atol=2e-6)
        np.testing.assert_array_equal(run.last[0], u)
    assert np.abs(np.array(run.reals["x"]) - problem.c).max() < 0.05


@pytest.mark.parametrize("factor", [0.25, 0.1])
def test_a_rate_shortens_a_step(factor: float) -> None:
    """The first step has the size of ``factor`` in units of the rate, 0.5."""
    run = Lbfgs().begin(Bowl())
    run.step(0, factor)
    assert np.abs(np.array(run.reals["x"]) - 0.1).max() == pytest.approx(0.5 * factor, rel=1e-6)


def test_bounds_are_met_and_kept() -> None:
    """Entries that lie at their bound and press against it stay there; the others go to the minimum between the bounds."""
    problem = Bowl(low=0.05, high=0.5)
    run = Lbfgs().begin(problem)
    for iteration in range(30):
        run.step(iteration, 1.0)
    x = np.array(run.reals["x"], np.float64)
    g, at = problem.A @ (x - problem.c), np.isclose(x, 0.5)
    assert at.any() and (x <= 0.5).all() and (g[at] < 0).all()
    assert np.abs(g[~at]).max() < 1e-3


def test_failed_search_drops_the_pairs_once_and_then_stops() -> None:
    """Where no step lowers the loss, pairs may be to blame: they are forgotten; without pairs there is nothing left."""
    problem = Bowl()
    run = Lbfgs().begin(problem)
    for iteration in range(3):
        run.step(iteration, 1.0)
    before = np.array(run.reals["x"])
    assert run.stop_reason == "" and len(run.steps) == 2
    problem.worse = 1e9
    run.step(3, 1.0)
    assert (run.stop_reason, run.steps, run.changes, run.last) == ("", [], [], None)
    assert "last" not in run.pack() and run.pack()["pairs"].shape == (2, 0)
    run.step(4, 1.0)
    assert run.stop_reason == "no step lowers the loss"
    np.testing.assert_array_equal(np.array(run.reals["x"]), before)


def test_pairs_without_curvature_are_not_remembered() -> None:
    run = LbfgsRun(Lbfgs(memory=3), Bowl())
    s, y = np.array([1.0, 0, 0, 0]), np.array([1e-11, 1.0, 0, 0])
    assert run._remember(s, y) == ([], [])
    run.last = np.zeros(4), np.zeros(4)
    assert run._remember(s, y) == ([], [])
    assert run._remember(s, -s) == ([], [])
    (kept,), (change,) = run._remember(s, 10 * y + 1e-9 * s)
    np.testing.assert_array_equal((kept, change), (s, 10 * y + 1e-9 * s))


def test_another_value_and_a_restored_run() -> None:
    run, other = (Lbfgs().begin(Bowl()) for _ in range(2))
    for iteration in range(3):
        run.step(iteration, 1.0)
    other.unpack(run.pack())
    for one in (run, other):
        one.step(3, 1.0)
    np.testing.assert_array_equal(np.array(run.reals["x"]), np.array(other.reals["x"]))
    run.replace("x", mi.TensorXf(np.full(4, 0.3, np.float32)))
    assert (run.steps, run.changes, run.last) == ([], [], None)
    np.testing.assert_array_equal(np.array(run.reals["x"]), np.full(4, 0.3, np.float32))
    fresh = Lbfgs().begin(Bowl())
    fresh.unpack(run.pack())
    assert fresh.last is None


OPEN = SimpleNamespace(project=lambda x: x)


@pytest.mark.parametrize(("limit", "alpha"), [(1.0, 1.0), (0.3, 0.25), (2.0**-9, 2.0**-9), (2.0**-9.5, 0.0)])
def test_steps_are_halved_nine_times_at_most(limit: float, alpha: float) -> None:
    """The first step that is no longer than what lowers the value; none where even 2^-9 is too long."""

    def value(x: np.ndarray) -> float:
        return -x[0] if x[0] <= limit else 1.0

    new, found = search_line(value, OPEN, np.zeros(1), 0.0, np.array([-1.0]), np.ones(1))
    assert (found, new.tolist()) == (alpha, [alpha])


def test_steps_satisfy_armijos_rule() -> None:
    """By 1e-4 of it: exactly that much is enough."""
    x, g, p = np.zeros(1), np.array([-1.0]), np.ones(1)
    assert search_line(lambda x: -1e-4 * x[0], OPEN, x, 0.0, g, p)[1] == 1.0
    assert search_line(lambda x: -0.9e-4 * x[0], OPEN, x, 0.0, g, p)[1] == 0.0


def test_steps_are_projected() -> None:
    new, alpha = search_line(
        lambda x: -x[0], SimpleNamespace(project=lambda x: np.minimum(x, 0.5)), np.zeros(1), 0.0, -np.ones(1), np.ones(1)
    )
    assert (new.tolist(), alpha) == ([0.5], 1.0)
