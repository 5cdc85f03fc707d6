"""Iterative solvers against formulas and SciPy: conjugate gradients, SIRT and ordered subsets, ML-TR."""

from __future__ import annotations

import io
import weakref
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from small_scan import GRID, VIEWS, Views, problem_for, run

from mivol.cite import list_citations
from mivol.optim.projections import iterative, linear_problems
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.iterative import _Counts
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts, SmoothedTV, SolverState, last_state


@pytest.mark.parametrize("name", ["sirt", "os-sart"])
def test_algebraic_methods_recover_consistent_data(scan, name):
    a, truth, b = scan
    options = {"n_subsets": 6, "decay": 1.0} if name == "os-sart" else {}
    states = run(name, LeastSquares(a, b, nonnegative=True), 150, **options)
    error = np.linalg.norm(states[-1].x - truth) / np.linalg.norm(truth)
    assert error < {"sirt": 0.10, "os-sart": 0.02}[name]
    assert states[-1].residual_norm < 1e-2 * states[0].residual_norm


def test_sirt_step_matches_the_formula(scan):
    a, _, b = scan
    dense = a.matrix.toarray()
    used = (np.arange(len(b)) % 5 > 0).astype(float)
    problem = LeastSquares(a, b, weights=3 * used)
    first, second = run("sirt", problem, 2, relaxation=0.7)
    length = dense.sum(1)
    rays = np.where(length > 0, used / np.where(length > 0, length, 1), 0)
    voxels = 1 / (dense.T @ used)
    expected = first.x + 0.7 * voxels * (dense.T @ (rays * (b - dense @ first.x)))
    # Rays that only graze the grid (length below 1e-6 of the longest) are left out by the solver: none here.
    np.testing.assert_allclose(second.x, expected, atol=1e-12)


def test_one_subset_of_os_sart_is_sirt_and_many_are_faster(scan):
    a, truth, b = scan
    problem = LeastSquares(a, b)
    sirt, one = run("sirt", problem, 3)[-1], run("os-sart", problem, 3, n_subsets=1, decay=1.0)[-1]
    np.testing.assert_array_equal(sirt.x, one.x)
    many = run("os-sart", problem, 3, n_subsets=8)[-1]
    assert np.linalg.norm(many.x - truth) < 0.8 * np.linalg.norm(sirt.x - truth)


def test_sart_takes_a_view_at_a_time(scan):
    """Andersen and Kak's update is that of ordered subsets of one view each."""
    a, _, b = scan
    problem = LeastSquares(a, b)
    each, all_views = run("sart", problem, 2, relaxation=0.5)[-1], run("os-sart", problem, 2, n_subsets=24, relaxation=0.5)[-1]
    np.testing.assert_array_equal(each.x, all_views.x)


def test_pcg_is_scipys_cg_on_the_normal_equations(scan):
    """Same matrix, same Jacobi-like preconditioner, same iterates, until rounding tells (after 10 steps)."""
    problem = problem_for("pcg", scan)
    a, w = problem.A.matrix, scipy.sparse.diags_array(problem.weights)
    normal = (a.T @ w @ a).tocsr()
    jacobi = scipy.sparse.diags_array(1 / (normal @ np.ones(GRID.size)))
    x, _ = scipy.sparse.linalg.cg(normal, a.T @ (w @ problem.b), rtol=0.0, maxiter=8, M=jacobi)
    np.testing.assert_allclose(run("pcg", problem, 8)[-1].x, x, atol=1e-10)


def test_cgls_is_the_krylov_minimum(scan):
    """Expected: after k steps the least residual over span{A^T b, (A^T A) A^T b, ...}, which a QR of the
    basis gives directly.

    Why it catches: a wrong beta or alpha is still descent, but no longer this minimum. k = 5 keeps the basis' condition
    below 1e10, so the QR's minimum has 5 digits.
    """
    a, _, b = scan
    k, basis = 5, [a.T @ b]
    for _ in range(k - 1):
        basis.append(a.T @ (a @ basis[-1]))
        basis[-1] /= np.linalg.norm(basis[-1])
    q, _ = np.linalg.qr(np.array(basis).T)
    coefficients, *_ = np.linalg.lstsq(np.array(a @ q), b, rcond=None)
    state = run("cgls", LeastSquares(a, b), k)[-1]
    np.testing.assert_allclose(state.x, q @ coefficients, atol=1e-5 * np.abs(state.x).max())


def test_pcg_nonnegative_meets_the_kkt_conditions(scan):
    """Against Lawson and Hanson's active sets (SciPy), and x >= 0, gradient >= 0, x gradient = 0."""
    a, _, b = scan
    rng = np.random.default_rng(1)
    problem = LeastSquares(a, b + 0.1 * rng.normal(size=b.shape), nonnegative=True)
    states = run("pcg", problem, 600)
    reference = scipy.optimize.nnls(a.matrix.toarray(), problem.b)
    x = states[-1].x
    assert x.min() >= 0
    assert states[-1].residual_norm == pytest.approx(reference[1], rel=1e-8)
    np.testing.assert_allclose(x, reference[0], atol=2e-3 * x.max())
    gradient = -(a.T @ (problem.b - a @ x))
    assert gradient.min() > -1e-5 * np.abs(a.T @ problem.b).max()


@pytest.mark.parametrize("nonnegative", [False, True])
@pytest.mark.parametrize("with_prior", [False, True])
def test_pcg_objective_never_rises(scan, nonnegative, with_prior):
    """The promise of the table; and what is yielded is the objective at x (1e-10: float64 sums of 500 terms)."""
    prior = SmoothedTV(GRID.shape, 0.05, 0.1, GRID.voxel_size) if with_prior else None
    problem = problem_for("pcg", scan, prior=prior, nonnegative=nonnegative)
    states = run("pcg", problem, 60)
    objective = np.array([s.objective for s in states])
    assert (np.diff(objective) <= 1e-12 * objective[0]).all()
    r = problem.b - problem.A @ states[-1].x
    expected = 0.5 * np.sum(problem.weights * r * r) + (prior.value(states[-1].x) if prior else 0)
    assert objective[-1] == pytest.approx(expected, rel=1e-10)
    if nonnegative:
        assert min(s.x.min() for s in states) >= 0


def test_pcg_with_prior_reaches_the_minimum_that_lbfgs_finds(scan):
    prior = SmoothedTV(GRID.shape, 0.05, 0.3, GRID.voxel_size)
    problem = problem_for("pcg", scan, prior=prior, nonnegative=True)

    def objective(x):
        r = problem.A @ x - problem.b
        gradient = problem.A.T @ (problem.weights * r)
        prior.add_derivatives(x, gradient, None)
        return 0.5 * np.sum(problem.weights * r * r) + prior.value(x), gradient

    options = {"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-10}
    found = scipy.optimize.minimize(objective, np.zeros(GRID.size), jac=True, bounds=[(0, None)] * GRID.size, options=options)
    state = run("pcg", problem, 500)[-1]
    # Both minima are of one convex function; L-BFGS-B stops at about 1e-9 of it.
    assert state.objective == pytest.approx(found.fun, rel=1e-6)


def test_a_projected_step_costs_one_projection(scan):
    """24 views, three of which give the length before the projection; each step of this scan leaves the domain."""
    a, _, b = scan
    views = []

    class Counting(Views):
        def __matmul__(self, x: np.ndarray) -> np.ndarray:
            views.append(self.n_views)
            return super().__matmul__(x)

        def subset(self, some: np.ndarray) -> Counting:
            return Counting(super().subset(some).matrix, len(some))

    rng = np.random.default_rng(1)
    problem = LeastSquares(Counting(a.matrix, a.n_views), b + 0.1 * rng.normal(size=b.shape), nonnegative=True)
    run("pcg", problem, 10)
    sums_and_start = 2 * a.n_views
    assert sum(views) == sums_and_start + 10 * (a.n_views + 3)


def test_preconditioner_helps_unequal_voxels(scan):
    """Voxels that rays feel 1 to 1000 times as strongly (as voxels of uneven size would be): Jacobi evens them out."""
    a, _, b = scan
    strength = 10.0 ** np.random.default_rng(0).uniform(0, 3, GRID.size)
    uneven = Views((a.matrix @ scipy.sparse.diags_array(strength)).tocsr(), VIEWS)
    left = {name: run(name, LeastSquares(uneven, b), 20)[-1].residual_norm for name in ("pcg", "cgls")}
    assert left["pcg"] < 0.5 * left["cgls"], left


def test_voxels_without_rays_keep_their_start(scan):
    a, _, b = scan
    seen = np.asarray(abs(a.matrix).sum(0)).ravel() > 0
    masked = Views((a.matrix.tocsc() * np.where(np.arange(GRID.size) == 100, 0.0, 1.0)).tocsr(), VIEWS)
    state = run("pcg", LeastSquares(masked, b, x0=np.full(GRID.size, 0.25)), 5)[-1]
    assert seen.all()
    assert state.x[100] == 0.25


@pytest.mark.parametrize("background", [0.0, 5.0])
def test_ml_tr_objective_never_rises_on_low_counts(scan, background):
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


def test_ml_tr_gradient_vanishes_at_the_end(scan):
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


def test_unused_rays_have_no_effect(scan):
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


def test_ml_tr_uses_its_prior(scan):
    """Its share of the objective is lowered too: the fit that knows it ends lower than the one that does not."""
    prior = SmoothedTV(GRID.shape, 2000.0, 0.3, GRID.voxel_size)
    problem = problem_for("ml-tr", scan, prior=prior)
    told = run("ml-tr", problem, 40)[-1]
    untold = run("ml-tr", problem_for("ml-tr", scan), 40)[-1]
    assert told.objective < untold.objective + prior.value(untold.x) - 1


def test_parabola_meets_the_likelihood_at_0():
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


@pytest.mark.parametrize("name", SOLVERS)
def test_saved_state_continues_bit_for_bit(scan, name):
    """Through a file, in the middle of a run; the arrays of earlier states are untouched by later iterations."""
    options = {"nonnegative": True} if name == "pcg" else {}
    problem = problem_for(name, scan, **options)
    whole = run(name, problem, 9)
    copy = whole[3].x.copy()
    file = io.BytesIO()
    np.savez(file, **whole[3].to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        saved = SolverState.from_arrays(dict(arrays))
    rest = run(name, problem, 5, state=saved)
    np.testing.assert_array_equal(whole[3].x, copy)
    for a, b in zip(whole[4:], rest, strict=True):
        assert a.iteration == b.iteration
        assert a.objective == b.objective
        np.testing.assert_array_equal(a.x, b.x)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_field_alone_continues(scan, name):
    """Without memory: conjugate gradients begin anew and go further down; the others depend on the field only, to the bit."""
    problem = problem_for(name, scan)
    whole = run(name, problem, 6)
    rest = run(name, problem, 3, state=replace(whole[2], memory={}))
    assert [state.iteration for state in rest] == [4, 5, 6]
    if name in ("cgls", "pcg"):
        assert rest[-1].objective < rest[0].objective < whole[2].objective
    else:
        np.testing.assert_array_equal(rest[-1].x, whole[-1].x)


def test_only_the_last_state_is_kept():
    """States of a few fields each would add up; the generator of this test keeps none."""
    alive: weakref.WeakSet[SolverState] = weakref.WeakSet()

    def states():
        for iteration in range(1, 6):
            # The one that the caller still holds while it asks for the next.
            assert len(alive) <= 1
            state = SolverState(np.zeros(1), iteration, 0.0, 0.0)
            alive.add(state)
            yield state
            del state

    assert last_state(states(), 4).iteration == 4
    assert last_state(iter(()), 4) is None


@pytest.mark.parametrize("name", SOLVERS)
def test_solver_explains_the_data(scan, name):
    """Every entry of the table, same contract: the residual falls, iterations count, x keeps its dtype."""
    states = run(name, problem_for(name, scan), 20)
    assert [s.iteration for s in states] == list(range(1, 21))
    assert states[-1].residual_norm < states[0].residual_norm
    assert states[-1].x.dtype == np.float64
    assert SOLVERS[name].promises
    assert list_citations(SOLVERS[name].cites)


def test_a_direction_that_ascends_gives_way_to_the_scaled_gradient(scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """The step is that of the same volume without a memory of directions."""
    prior = SmoothedTV(GRID.shape, 0.05, 0.3, GRID.voxel_size)
    problem = problem_for("pcg", scan, nonnegative=True, prior=prior)
    state = run("pcg", problem, 3)[-1]
    expected = run("pcg", problem, 1, state=replace(state, memory={}))[-1]
    descend, asked = iterative._descend, []

    def refuse_first(*given: object) -> object:
        asked.append(given)
        return None if len(asked) == 1 else descend(*given)

    monkeypatch.setattr(iterative, "_descend", refuse_first)
    found = run("pcg", problem, 1, state=state)[-1]
    assert len(asked) == 2 and np.abs(found.x - expected.x).max() < 1e-10
    assert np.abs(found.x - state.x).max() > 1e-4


def test_every_block_of_a_step_stays_nonnegative(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear_problems, "BLOCK", 2)
    x = np.ones(5)
    assert [iterative._stays_nonnegative(x, -1.0001, np.arange(5) == k) for k in (0, 3, 4, 5)] == [False, False, False, True]
