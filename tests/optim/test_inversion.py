"""A linear solver as a problem and an optimiser of the loop: what it hands over, what it stores, and where it ends."""

from __future__ import annotations

import numpy as np
import pytest
from small_scan import Views, run

from mivol.errors import MivolError
from mivol.optim.loop import Course, reconstruct
from mivol.optim.projections.inversion import LinearSolve, ProjectionProblem
from mivol.optim.projections.linear_problems import LeastSquares


def inversion(scan: tuple[Views, np.ndarray, np.ndarray], **more: object) -> ProjectionProblem:
    return ProjectionProblem(LeastSquares(scan[0], scan[2]), **more)


def test_a_problem_keeps_what_was_found(scan):
    problem = inversion(scan)
    assert (problem.values(), problem.initial_reals(), problem.warning()) == ({}, {}, "")
    found = np.arange(3.0)
    problem.set_reals({"x": found})
    assert problem.values()["x"] is found
    assert problem.pack({"x": found}) == {} and problem.unpack({}, {"x": found}) is None


@pytest.mark.parametrize("name", ["pcg", "os-sart"])
def test_steps_are_those_of_the_solver(scan, name):
    """And a run that goes on from what was stored takes the same ones; each begins at a safe point."""
    safe = []
    problem = inversion(scan, safe_point=lambda: safe.append(1))
    settings = LinearSolve(solver=name, subsets=6)
    options = {"n_subsets": 6} if name == "os-sart" else {}
    expected = run(name, problem.linear_problem, 4, **options)
    first = settings.begin(problem)
    assert first.pack() == {}
    assert [first.step(k, 1.0) for k in range(2)] == [s.objective for s in expected[:2]]
    second = settings.begin(problem)
    second.unpack(first.pack())
    assert [second.step(k, 1.0) for k in (2, 3)] == [s.objective for s in expected[2:]]
    np.testing.assert_array_equal(second.reals["x"], expected[3].x)
    assert len(safe) == 4


def test_nothing_to_reconstruct_is_refused(scan):
    empty = ProjectionProblem(LeastSquares(scan[0], scan[2], weights=np.zeros(len(scan[2]))))
    with pytest.raises(MivolError, match="so nothing to reconstruct"):
        LinearSolve().begin(empty).step(0, 1.0)


def test_a_solver_that_has_arrived_says_so():
    """One voxel and one ray: the second step has no direction that lowers the objective."""
    one = ProjectionProblem(LeastSquares(Views(np.array([[2.0]]), 1), np.array([4.0])))
    solving = LinearSolve().begin(one)
    objectives = [solving.step(k, 1.0) for k in range(3)]
    assert solving.reals["x"] == pytest.approx([2.0]) and objectives[-1] is None
    assert solving.stop_reason == "no direction lowers the objective"


def test_defaults():
    assert (LinearSolve().solver, LinearSolve().subsets) == ("pcg", 10)


def test_a_fit_ends_where_its_solver_has_arrived(variant_rgb):
    """Before the iterations that it was given are done; what did not happen is not in its history.

    Two measurements of one number contradict each other, so that a residual is left where no direction lowers it.
    """
    one = ProjectionProblem(LeastSquares(Views(np.array([[1.0], [1.0]]), 1), np.array([1.0, 3.0])))
    fit = reconstruct(one, LinearSolve(), Course(iterations=9))
    assert 1 <= fit.next_iteration < 9 and len(fit.history) == fit.next_iteration and fit.is_done
    assert one.values()["x"] == pytest.approx([2.0])
