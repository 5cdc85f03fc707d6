"""Solvers against dense algebra, each promise of the table measured, on the float64 matrix of a small scan."""

from __future__ import annotations

import io
import itertools

import numpy as np
import oracle_projector
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg

from mivol.errors import MivolError
from mivol.optim.linear_problems import LeastSquares, PoissonCounts
from mivol.optim.smoothed_tv import SmoothedTV
from mivol.optim.solver import State
from mivol.optim.solvers import SOLVERS
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan

N, VIEWS = 16, 24
GRID = VoxelGrid((1, N, N), (2 / N, 2 / N, 1.0), centre=(0.0, 0.0, -0.25))
BEAM = ParallelBeam(np.arange(VIEWS) * np.pi / VIEWS, (1, N + 4), 2 / N, detector_offset=(-0.25, 0.0))


class Views:
    """A matrix that knows which rows belong to which view."""

    def __init__(self, matrix, n_views: int):
        self.matrix, self.n_views = matrix, n_views
        self.shape, self.dtype = matrix.shape, matrix.dtype

    def __matmul__(self, x):
        return self.matrix @ x

    @property
    def T(self):
        return self.matrix.T

    def subset(self, views):
        rows = np.arange(self.shape[0]).reshape(self.n_views, -1)[views].reshape(-1)
        return Views(self.matrix[rows], len(views))


@pytest.fixture(scope="module")
def scan():
    """Operator, truth, and exact line integrals of the truth's voxels."""
    a = Views(oracle_projector.system_matrix(BEAM, GRID), VIEWS)
    truth = shepp_logan().voxelise(GRID, 8).astype(float).reshape(-1)
    return a, truth, a @ truth


def run(name: str, problem, n: int, state: State | None = None, **options) -> list[State]:
    return list(itertools.islice(SOLVERS[name].run(problem, state=state, **options), n))


def problem_for(name: str, scan, seed: int = 0, prior=None, **options):
    """A noisy problem of the kind that the solver wants; two sizes of weights, some rays unused."""
    a, _, b = scan
    rng = np.random.default_rng(seed)
    if SOLVERS[name].problem is PoissonCounts:
        counts = rng.poisson(2000 * np.exp(-b) + 30).astype(float)
        return PoissonCounts(a, counts, 2000.0, 30.0, prior=prior)
    weights = rng.choice([0.0, 1.0, 4.0], size=b.shape)
    return LeastSquares(a, b + 0.02 * rng.normal(size=b.shape), weights, prior=prior, **options)


# -- Conjugate gradients ---------------------------------------------------------------------------------------------


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


# -- Algebraic -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sirt", "os-sart"])
def test_algebraic_methods_recover_consistent_data(scan, name):
    a, truth, b = scan
    options = {"n_subsets": 6, "decay": 1.0} if name == "os-sart" else {}
    states = run(name, LeastSquares(a, b, nonnegative=True), 150, **options)
    error = np.linalg.norm(states[-1].x - truth) / np.linalg.norm(truth)
    assert error < {"sirt": 0.10, "os-sart": 0.02}[name]
    assert states[-1].residual_norm < 1e-2 * states[0].residual_norm


def test_sirt_step_is_its_formula(scan):
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


# -- Counts ----------------------------------------------------------------------------------------------------------


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


# -- All -------------------------------------------------------------------------------------------------------------


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
        saved = State.from_arrays(dict(arrays))
    rest = run(name, problem, 5, state=saved)
    np.testing.assert_array_equal(whole[3].x, copy)
    for a, b in zip(whole[4:], rest, strict=True):
        assert a.iteration == b.iteration
        assert a.objective == b.objective
        np.testing.assert_array_equal(a.x, b.x)


@pytest.mark.parametrize("name", SOLVERS)
def test_solver_explains_the_data(scan, name):
    """Every entry of the table, same contract: the residual falls, iterations count, x keeps its dtype."""
    states = run(name, problem_for(name, scan), 20)
    assert [s.iteration for s in states] == list(range(1, 21))
    assert states[-1].residual_norm < states[0].residual_norm
    assert states[-1].x.dtype == np.float64
    assert all((SOLVERS[name].needs, SOLVERS[name].promises, SOLVERS[name].citation))


def test_prior_derivatives_and_majorisers():
    """Gradient against differences; the majoriser lies above the penalty, and its separable form above that."""
    shape, rng = (4, 5, 6), np.random.default_rng(5)
    prior = SmoothedTV(shape, 0.7, 0.4, (1.0, 0.5, 2.0))
    x, p = rng.normal(size=(2, 120))
    h = 1e-6
    slope = (prior.value(x + h * p) - prior.value(x - h * p)) / (2 * h)
    assert prior.gradient(x) @ p == pytest.approx(slope, rel=1e-7)
    for scale in (0.01, 0.3, 3.0):
        d = scale * p
        bound = prior.value(x) + prior.gradient(x) @ d + 0.5 * prior.curvature(x, d)
        assert prior.value(x + d) <= bound + 1e-12
        assert prior.curvature(x, d) <= prior.separable(x) @ (d * d) + 1e-12


def test_total_variation_of_a_step_is_its_area_times_height():
    """delta -> 0: a step of height 3 across an area of 5 x 4 voxels of 0.5 x 2 (y, z) has TV 3 * 5 * 0.5 * 4 * 2."""
    x = np.zeros((4, 5, 6))
    x[:, :, 3:] = 3.0
    prior = SmoothedTV(x.shape, 1.0, 1e-9, (1.0, 0.5, 2.0))
    assert prior.value(x.reshape(-1)) == pytest.approx(3 * 5 * 0.5 * 4 * 2, rel=1e-8)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda a, b: LeastSquares(a, b[:-1]), "expected 480, one for each ray"),
        (lambda a, b: LeastSquares(a, np.where(np.arange(480) == 7, np.nan, b)), "'b' at flat index 7"),
        (lambda a, b: LeastSquares(a, b, -np.ones_like(b)), "negative weight"),
        (lambda a, b: LeastSquares(a, b, x0=np.zeros(3)), "one for each voxel"),
        (lambda a, b: PoissonCounts(a, b - 10, 5.0), "counts >= 0"),
        (lambda a, b: run("os-sart", LeastSquares(a, b), 1, n_subsets=99), "99 subsets of 24 views"),
        (lambda a, b: run("os-sart", LeastSquares(a, b), 1, relaxation=2.0), "relaxation 2.0"),
        (lambda a, b: run("sirt", LeastSquares(a, b, prior=SmoothedTV(GRID.shape, 1.0, 1.0)), 1), "use pcg or ml-tr"),
    ],
)
def test_unusable_problems_are_refused_in_a_sentence(scan, build, sentence):
    with pytest.raises(MivolError, match=sentence):
        build(scan[0], scan[2])
