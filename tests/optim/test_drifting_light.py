"""Object and drift of the light in turns: what is found, and that a turn that was cut short goes on as it was."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from small_scan import VIEWS

from mivol.optim.projections.inversion import fit_drift, solve_with_drift
from mivol.optim.projections.linear_problems import LeastSquares, SolverState
from mivol.optim.projections.solvers import SOLVERS

TIMES = np.linspace(-1.0, 1.0, VIEWS)


@pytest.fixture
def drifting(scan):
    """The small scan with stripes of 0.1 that fade over the scan; its problem, and the truth."""
    a, truth, b = scan
    columns = b.size // VIEWS
    stripes = 0.1 * np.random.default_rng(2).normal(size=(1, columns))
    y = b.reshape(VIEWS, 1, columns) + stripes + 0.5 * TIMES[:, None, None] * stripes
    return LeastSquares(a, y, np.ones_like(y), nonnegative=True), truth


def states_of(problem, n, state=None):
    return list(itertools.islice(solve_with_drift(SOLVERS["pcg"].run, problem, TIMES, 5, state), n))


def test_a_turn_is_the_solver_and_then_the_drift(drifting):
    """The first turn is the solver's own; the second is a new one on what the drift leaves, from the volume that it has."""
    problem, _ = drifting
    states = states_of(problem, 7)
    own = list(itertools.islice(SOLVERS["pcg"].run(problem), 5))
    assert [s.iteration for s in states] == list(range(1, 8))
    np.testing.assert_array_equal(states[4].x, own[4].x)
    drift = fit_drift(problem, own[4].x, TIMES)
    target = LeastSquares(problem.A, problem.b - drift.eval(TIMES), problem.weights, own[4].x, nonnegative=True)
    np.testing.assert_array_equal(states[6].x, list(itertools.islice(SOLVERS["pcg"].run(target), 2))[-1].x)


def test_the_object_is_found_behind_the_drift(drifting):
    """Of the joint least squares every turn lowers the residual; the object comes nearer to the truth than without."""
    problem, truth = drifting
    states = states_of(problem, 40)
    ends = [states[k].residual_norm for k in (4, 9, 14, 19, 24, 29, 34, 39)]
    assert (np.diff(ends) < 0).all()
    alone = list(itertools.islice(SOLVERS["pcg"].run(problem), 40))[-1]
    assert np.linalg.norm(states[-1].x - truth) < 0.8 * np.linalg.norm(alone.x - truth)


@pytest.mark.parametrize("cut", [2, 5, 7])
def test_a_saved_state_goes_on_bit_for_bit(drifting, cut):
    """In the middle of a turn and at its end."""
    problem, _ = drifting
    whole = states_of(problem, 12)
    saved = SolverState.from_arrays({name: np.array(value) for name, value in whole[cut - 1].to_arrays().items()})
    rest = states_of(problem, 12 - cut, saved)
    for a, b in zip(whole[cut:], rest, strict=True):
        assert a.iteration == b.iteration
        np.testing.assert_array_equal(a.x, b.x)
