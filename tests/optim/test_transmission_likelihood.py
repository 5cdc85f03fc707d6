"""Maximum likelihood of counts: the likelihood never falls, and its slope vanishes where the solver ends."""

from __future__ import annotations

import numpy as np
import pytest
from small_scan import GRID, Views, problem_for, run

from mivol.optim.projections.iterative import _Counts
from mivol.optim.projections.linear_problems import PoissonCounts
from mivol.optim.projections.smoothed_tv import SmoothedTV


@pytest.mark.parametrize("background", [0.0, 5.0])
def test_ml_tr_never_rises_even_on_poor_counts(scan, background):
    """The promise of the optimum curvature: 20 quanta a ray at most, from a start twice too dense.

    Why it catches: there the blank is gone, the Newton curvature mu is near 0 and its step far too long.
    """
    a, truth, b = scan
    rng = np.random.default_rng(3)
    counts = rng.poisson(20 * np.exp(-8 * b) + background).astype(float)
    prior = SmoothedTV(GRID.shape, 0.01, 0.3, GRID.voxel_size)
    problem = PoissonCounts(a, counts, 20.0, background, x0=16 * truth, prior=prior)
    expected = 20.0 * np.exp(-(a @ problem.x0)) + background
    start = np.sum(expected - counts * np.log(expected)) + prior.value(problem.x0)
    objective = np.array([start] + [s.objective for s in run("ml-tr", problem, 60)])
    assert (np.diff(objective) <= 1e-12 * abs(objective[0])).all()
    assert objective[-1] < objective[0] - 1


def test_ml_tr_gradient_vanishes_where_it_ends(scan):
    """Maximum likelihood: for x > 0 the derivative by central differences is 0."""
    problem = problem_for("ml-tr", scan)
    state = run("ml-tr", problem, 1500)[-1]

    def objective(x):
        expected = problem.blank * np.exp(-(problem.A @ x)) + problem.background
        return np.sum(expected - problem.counts * np.log(expected))

    assert objective(state.x) == pytest.approx(state.objective, rel=1e-12)
    step = 1e-4
    slopes = []
    for j in np.argsort(state.x)[-20:]:
        e = np.eye(GRID.size)[j] * step
        slopes.append((objective(state.x + e) - objective(state.x - e)) / (2 * step))
    at_start = np.abs(problem.A.T @ (problem.counts - problem.blank - problem.background)).max()
    # Linear convergence: the slopes fall by 1e-3 within 1500 iterations (2e-4 reached).
    assert np.abs(slopes).max() < 1e-3 * at_start


def test_rays_without_light_keep_ml_tr_finite(scan):
    """Half the rays count 0 quanta: no logarithm of a count, so nothing is lost and nothing is infinite. Hard case 39."""
    a, _, b = scan
    counts = np.where(np.arange(len(b)) % 2 == 0, 0.0, 500 * np.exp(-b))
    states = run("ml-tr", PoissonCounts(a, counts, 500.0), 30)
    assert np.isfinite([s.objective for s in states]).all()
    assert np.isfinite(states[-1].x).all()


def test_rays_that_are_not_used_are_as_if_they_were_not_there(scan):
    """Any count may stand at a dead pixel: volume, likelihood and residual are those of the other rays alone."""
    a, _, b = scan
    rng = np.random.default_rng(5)
    counts, used = rng.poisson(500 * np.exp(-b)).astype(float), rng.random(len(b)) > 0.2
    spoilt = np.where(used, counts, 1e4)
    without = run("ml-tr", PoissonCounts(Views(a.matrix[used], 1), counts[used], 500.0, 2.0), 5)[-1]
    found = run("ml-tr", PoissonCounts(a, spoilt, 500.0, 2.0, used=used), 5)[-1]
    # The same sums in another order: rounding of float64, amplified by five steps.
    np.testing.assert_allclose(found.x, without.x, rtol=1e-9, atol=1e-12)
    assert found.objective == pytest.approx(without.objective, rel=1e-12)
    assert found.residual_norm == pytest.approx(without.residual_norm, rel=1e-10)


def test_a_prior_is_followed(scan):
    """Its share of the objective is lowered too: the fit that knows it ends lower than the one that does not."""
    prior = SmoothedTV(GRID.shape, 2000.0, 0.3, GRID.voxel_size)
    problem = problem_for("ml-tr", scan, prior=prior)
    told = run("ml-tr", problem, 40)[-1]
    untold = run("ml-tr", problem_for("ml-tr", scan), 40)[-1]
    assert told.objective < untold.objective + prior.value(untold.x) - 1


def test_the_parabola_of_a_ray_meets_its_likelihood_where_there_is_nothing():
    """h(l) - l h'(l) + l^2 c / 2 = h(0), the optimum curvature; at l = 0 it is h''(0)."""
    y, blank, background = np.array([3.0, 40.0, 0.0]), np.array([50.0, 60.0, 70.0]), np.array([2.0, 0.0, 5.0])
    counts = _Counts(y, blank, background, None)
    line = np.array([0.7, 0.2, 1.5])

    def h(at: np.ndarray) -> np.ndarray:
        expected = blank * np.exp(-at) + background
        return expected - y * np.log(expected)

    step = 1e-6
    slope = (h(line + step) - h(line - step)) / (2 * step)
    np.testing.assert_allclose(counts.slope(line), slope, rtol=1e-7, atol=1e-7)
    c = counts.optimum_curvature(line)
    expected = 2 * (h(0 * line) - h(line) + line * slope) / line**2
    np.testing.assert_allclose(c, np.maximum(expected, 0), rtol=1e-6, atol=1e-6)
    at_zero = blank * (1 - y * background / (blank + background) ** 2)
    np.testing.assert_allclose(counts.optimum_curvature(0 * line), at_zero, rtol=1e-12)


def test_iterations_are_counted(scan):
    assert [state.iteration for state in run("ml-tr", problem_for("ml-tr", scan), 3)] == [1, 2, 3]
