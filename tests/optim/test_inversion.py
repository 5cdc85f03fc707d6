"""Linear solvers in the fit loop, and the fit of a drifting light."""

from __future__ import annotations

import itertools
import weakref

import numpy as np
import pytest
from refusals import assert_refused
from small_scan import VIEWS, Views, run

from mivol.optim.loop import Course, reconstruct
from mivol.optim.projections.inversion import (
    SOLVERS,
    DriftFit,
    LinearSolve,
    ProjectionProblem,
    solve_with_light,
    update_light,
)
from mivol.optim.projections.linear_problems import LeastSquares, SolverState
from mivol.tomography.preprocess import LightDrift
from mivol.tomography.rings import PixelGains


def inversion(scan: tuple[Views, np.ndarray, np.ndarray], **more: object) -> ProjectionProblem:
    return ProjectionProblem(LeastSquares(scan[0], scan[2]), **more)


def test_problem_stores_the_volume(scan):
    problem = inversion(scan)
    assert (problem.values(), problem.initial_reals(), problem.warning()) == ({}, {}, "")
    found = np.arange(3.0)
    problem.set_reals({"x": found})
    assert problem.values()["x"] is found
    assert problem.pack({"x": found}) == {} and problem.unpack({}, {"x": found}) is None


@pytest.mark.parametrize("name", ["pcg", "os-sart"])
def test_steps_match_the_solver(scan, name):
    """And a run that goes on from what was stored takes the same ones, also before the first; each begins at a safe point."""
    safe = []
    problem = inversion(scan, safe_point=lambda: safe.append(1))
    settings = LinearSolve(solver=name, subsets=6)
    options = {"n_subsets": 6} if name == "os-sart" else {}
    expected = run(name, problem.linear_problem, 4, **options)
    first = settings.begin(problem)
    assert first.pack() == {}
    first.unpack(first.pack())
    assert [first.step(k, 1.0) for k in range(2)] == [s.objective for s in expected[:2]]
    second = settings.begin(problem)
    second.unpack(first.pack())
    assert [second.step(k, 1.0) for k in (2, 3)] == [s.objective for s in expected[2:]]
    np.testing.assert_array_equal(second.reals["x"], expected[3].x)
    assert len(safe) == 4


def test_nothing_to_reconstruct_is_refused(scan):
    empty = ProjectionProblem(LeastSquares(scan[0], scan[2], weights=np.zeros(len(scan[2]))))
    assert_refused("so nothing to reconstruct", LinearSolve().begin(empty).step, 0, 1.0)


def test_converged_solver_has_a_stop_reason():
    """One voxel and one ray: the second step has no direction that lowers the objective."""
    one = ProjectionProblem(LeastSquares(Views(np.array([[2.0]]), 1), np.array([4.0])))
    solving = LinearSolve().begin(one)
    objectives = [solving.step(k, 1.0) for k in range(3)]
    assert solving.reals["x"] == pytest.approx([2.0]) and objectives[-1] is None
    assert solving.stop_reason == "no direction lowers the objective"


def test_defaults():
    assert (LinearSolve().solver, LinearSolve().subsets) == ("pcg", 10)


def test_fit_ends_when_the_solver_converges(variant_rgb):
    """Before the iterations that it was given are done; what did not happen is not in its history.

    Two measurements of one number contradict each other, so that a residual is left where no direction lowers it.
    """
    one = ProjectionProblem(LeastSquares(Views(np.array([[1.0], [1.0]]), 1), np.array([1.0, 3.0])))
    fit = reconstruct(one, LinearSolve(), Course(iterations=9))
    assert 1 <= fit.next_iteration < 9 and len(fit.history) == fit.next_iteration and fit.is_done
    assert one.values()["x"] == pytest.approx([2.0])


TIMES = np.linspace(-1.0, 1.0, VIEWS)


@pytest.fixture
def drifting(scan):
    """The small scan with stripes of 0.1 that fade over the scan; its problem, and the truth."""
    a, truth, b = scan
    columns = b.size // VIEWS
    stripes = 0.1 * np.random.default_rng(2).normal(size=(1, columns))
    y = b.reshape(VIEWS, 1, columns) + stripes + 0.5 * TIMES[:, None, None] * stripes
    return LeastSquares(a, y, np.ones_like(y), nonnegative=True), truth


NO_LIGHT = LightDrift(np.zeros(1), np.zeros(1))


def states_of(problem, n, state=None, solver="pcg"):
    return list(itertools.islice(solve_with_light(SOLVERS[solver].run, problem, DriftFit(TIMES), 5, state), n))


def test_turn_alternates_solver_and_drift(drifting):
    """The first turn is the solver's own; the second is a new one on what the drift leaves, from the volume that it has."""
    problem, _ = drifting
    states = states_of(problem, 7)
    own = list(itertools.islice(SOLVERS["pcg"].run(problem), 5))
    assert [s.iteration for s in states] == list(range(1, 8))
    np.testing.assert_array_equal(states[4].x, own[4].x)
    drift = update_light(problem, DriftFit(TIMES), NO_LIGHT, own[4].x)
    target = LeastSquares(problem.A, problem.b - drift.eval(TIMES), problem.weights, own[4].x, nonnegative=True)
    np.testing.assert_array_equal(states[6].x, list(itertools.islice(SOLVERS["pcg"].run(target), 2))[-1].x)


@pytest.mark.parametrize("solver", ["pcg", "sirt"])
def test_a_resumed_run_knows_the_light(drifting, solver):
    """It goes on from the middle of a turn, with the light that was fitted before, to the last bit."""
    problem, _ = drifting
    states = states_of(problem, 12, solver=solver)
    resumed = states_of(problem, 5, SolverState.from_arrays(states[6].to_arrays()), solver)
    assert states[6].memory["offset"].any()
    for one, other in zip(states[7:], resumed, strict=True):
        assert (one.iteration, one.residual_norm) == (other.iteration, other.residual_norm)
        np.testing.assert_array_equal(one.x, other.x)


def test_without_drift_the_solver_goes_on(scan):
    """Noise and constant stripes: every volume is that of the solver alone, also when the run is resumed between two fits."""
    a, _, b = scan
    rng, columns = np.random.default_rng(3), b.size // VIEWS
    y = b.reshape(VIEWS, 1, columns) + 0.05 * rng.normal(size=columns) + 0.02 * rng.normal(size=(VIEWS, 1, columns))
    problem = LeastSquares(a, y, np.ones_like(y), nonnegative=True)
    alone, states = list(itertools.islice(SOLVERS["pcg"].run(problem), 12)), states_of(problem, 12)
    resumed = states_of(problem, 5, SolverState.from_arrays(states[6].to_arrays()))
    for found in (states, [*states[:7], *resumed]):
        for one, other in zip(alone, found, strict=True):
            assert one.iteration == other.iteration
            np.testing.assert_array_equal(one.x, other.x)


def test_object_is_recovered_despite_drift(drifting):
    """Of the joint least squares every turn lowers the residual; the object comes nearer to the truth than without."""
    problem, truth = drifting
    states = states_of(problem, 40)
    ends = [states[k].residual_norm for k in (4, 9, 14, 19, 24, 29, 34, 39)]
    assert (np.diff(ends) < 0).all()
    alone = list(itertools.islice(SOLVERS["pcg"].run(problem), 40))[-1]
    assert np.linalg.norm(states[-1].x - truth) < 0.8 * np.linalg.norm(alone.x - truth)


@pytest.mark.parametrize("cut", [2, 5, 7])
def test_saved_drift_state_continues_bit_for_bit(drifting, cut):
    """In the middle of a turn and at its end."""
    problem, _ = drifting
    whole = states_of(problem, 12)
    saved = SolverState.from_arrays({name: np.array(value) for name, value in whole[cut - 1].to_arrays().items()})
    rest = states_of(problem, 12 - cut, saved)
    for a, b in zip(whole[cut:], rest, strict=True):
        assert a.iteration == b.iteration
        np.testing.assert_array_equal(a.x, b.x)


def test_eliminated_gains_are_those_of_the_joint_minimum(scan):
    """Expected: the volume of dense least squares with the offsets as further unknowns, whose penalty is o^T pinv(K) o and
    infinite for straight lines. Volumes are compared by the residual that the offsets leave, which both minimise.
    """
    a, _, b = scan
    columns, rng = a.shape[0] // VIEWS, np.random.default_rng(5)
    weights = rng.uniform(0.5, 2.0, (VIEWS, 1, columns))
    y = b.reshape(weights.shape) + 0.02 * rng.normal(size=columns) + 0.01 * rng.normal(size=weights.shape)
    gains = PixelGains(weights, 9.0)
    state = run("pcg", LeastSquares(a, y, weights, gains=gains), 2000)[-1]
    second = np.diff(np.eye(columns), 2, axis=0)
    # o = D^T q meets no straight line, and o^T K^-1 o = q^T q / stiffness.
    middle, stiffness = np.median(weights.sum((0, 1))), (9 / (2 * np.pi)) ** 4
    offsets = np.tile(second.T, (VIEWS, 1))
    root = np.sqrt(weights.reshape(-1))[:, None]
    joint = np.block([
        [root * a.matrix.toarray(), root * offsets],
        [np.zeros((columns - 2, a.shape[1])), np.sqrt(middle / stiffness) * np.eye(columns - 2)],
    ])  # fmt: skip
    wanted = np.linalg.lstsq(joint, np.append(root[:, 0] * y.reshape(-1), np.zeros(columns - 2)), rcond=None)[0]
    left = joint @ wanted - np.append(root[:, 0] * y.reshape(-1), np.zeros(columns - 2))
    assert state.residual_norm == pytest.approx(np.linalg.norm(left), rel=1e-6)
    found = gains.fit(y - (a @ state.x).reshape(y.shape))[0]
    np.testing.assert_allclose(found, second.T @ wanted[a.shape[1] :], atol=1e-4)


def test_the_first_volume_is_let_go(scan) -> None:
    """It is as large as the state, and no later step reads it."""
    a, _, b = scan
    x0 = np.full(a.shape[1], 0.25)
    kept, problem = weakref.ref(x0), ProjectionProblem(LeastSquares(a, b, x0=x0, nonnegative=True))
    solve = LinearSolve(solver="pcg").begin(problem)
    del x0
    solve.step(0, 1.0)
    assert kept() is None and problem.linear_problem.x0 is None
    assert solve.step(1, 1.0) < np.sum(b**2) / 2
