"""Conjugate gradients against dense algebra, each promise measured, on the float64 matrix of a small scan."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from small_scan import GRID, VIEWS, Views, problem_for, run

from mivol.optim.projections.linear_problems import LeastSquares
from mivol.optim.projections.smoothed_tv import SmoothedTV


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
        return (
            0.5 * np.sum(problem.weights * r * r) + prior.value(x),
            problem.A.T @ (problem.weights * r) + prior.gradient(x),
        )

    options = {"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-10}
    found = scipy.optimize.minimize(objective, np.zeros(GRID.size), jac=True, bounds=[(0, None)] * GRID.size, options=options)
    state = run("pcg", problem, 500)[-1]
    # Both minima are of one convex function; L-BFGS-B stops at about 1e-9 of it.
    assert state.objective == pytest.approx(found.fun, rel=1e-6)


def test_preconditioner_pays_where_voxels_count_differently(scan):
    """Voxels that rays feel 1 to 1000 times as strongly (as voxels of uneven size would be): Jacobi evens them out."""
    a, _, b = scan
    strength = 10.0 ** np.random.default_rng(0).uniform(0, 3, GRID.size)
    uneven = Views((a.matrix @ scipy.sparse.diags_array(strength)).tocsr(), VIEWS)
    left = {name: run(name, LeastSquares(uneven, b), 20)[-1].residual_norm for name in ("pcg", "cgls")}
    assert left["pcg"] < 0.5 * left["cgls"], left


def test_unseen_voxels_stay_where_they_started(scan):
    a, _, b = scan
    seen = np.asarray(abs(a.matrix).sum(0)).ravel() > 0
    masked = Views((a.matrix.tocsc() * np.where(np.arange(GRID.size) == 100, 0.0, 1.0)).tocsr(), VIEWS)
    state = run("pcg", LeastSquares(masked, b, x0=np.full(GRID.size, 0.25)), 5)[-1]
    assert seen.all()
    assert state.x[100] == 0.25
