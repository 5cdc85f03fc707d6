"""Solving in turns with the drift of the light since the flats were taken: block descent on object and drift.

A few iterations of a solver explain what they can of ``b - drift``; the drift is then fitted to what is left of ``b``, and the
solver begins anew from the volume that it has. Each turn lowers the joint weighted least squares.

References: :func:`mivol.tomography.preprocess.fit_light_drift`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from mivol.optim.linear_problems import LeastSquares
from mivol.optim.solver import State
from mivol.tomography.preprocess import LightDrift, fit_light_drift

INNER = "inner."
"""Begins the names of what the solver itself must know."""


def with_drift(
    run: Callable[..., Iterator[State]],
    problem: LeastSquares,
    times: np.ndarray,
    every: int,
    state: State | None = None,
    **options: object,
) -> Iterator[State]:
    """Iterations of a solver with the drift fitted anew after ``every`` of them.

    Args:
        run: of a :class:`~mivol.optim.solver.Solver` of least squares.
        problem: its ``A`` is a projector, its ``b`` and ``weights`` are (views, rows, cols).
        times: (views,) when each was taken, best about 0.
        every: iterations of one turn.
        state: where to go on; all that a turn knows is in its memory.
        options: of the solver.

    Yields:
        States of the solver, with the drift (``offset``, ``slope``) in their memory.
    """
    done, turn, inner = 0, 0, None
    drift = LightDrift(*np.zeros((2, *problem.b.shape[1:])))
    if state is not None:
        memory = dict(state.memory)
        drift = LightDrift(memory.pop("offset"), memory.pop("slope"))
        done, turn = state.iteration, int(memory.pop("turn"))
        own = {name.removeprefix(INNER): value for name, value in memory.items()}
        inner = replace(state, iteration=turn, memory=own)
    while True:
        states = run(replace(problem, b=problem.b - drift.eval(times)), inner, **options)
        for inner in itertools.islice(states, every - turn):
            done, turn = done + 1, turn + 1
            memory = {INNER + name: value for name, value in inner.memory.items()}
            about = {"offset": drift.offset, "slope": drift.slope, "turn": np.asarray(turn)}
            yield replace(inner, iteration=done, memory=memory | about)
        if inner is None:
            return
        drift = fit_drift(problem, inner.x, times)
        problem, inner, turn = replace(problem, x0=inner.x), None, 0


def fit_drift(problem: LeastSquares, x: np.ndarray, times: np.ndarray) -> LightDrift:
    """The drift that explains best what the volume ``x`` does not."""
    left = problem.b - (problem.A @ np.reshape(x, -1)).reshape(problem.b.shape)
    return fit_light_drift(left, problem.weights, times)
