"""Every solver of the table: it explains the data, and a saved state continues bit for bit."""

from __future__ import annotations

import io

import numpy as np
import pytest
from small_scan import problem_for, run

from mivol.optim.projections.linear_problems import SolverState
from mivol.optim.projections.solvers import SOLVERS


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
def test_solver_explains_the_data(scan, name):
    """Every entry of the table, same contract: the residual falls, iterations count, x keeps its dtype."""
    states = run(name, problem_for(name, scan), 20)
    assert [s.iteration for s in states] == list(range(1, 21))
    assert states[-1].residual_norm < states[0].residual_norm
    assert states[-1].x.dtype == np.float64
    assert all((SOLVERS[name].needs, SOLVERS[name].promises, SOLVERS[name].citation))
