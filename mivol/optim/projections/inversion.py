"""Projections as a problem of the fit loop, with linear solvers as optimizers.

Conventions. A solver computes products of its operator that a gradient does not contain, so it runs its own iterations.
:func:`solve_with_drift` alternates between object and light drift (block descent): a few iterations of the solver explain
``b - drift``, then the drift is fitted to the remaining part of ``b``. Each turn lowers the joint weighted least squares.

References: :func:`mivol.tomography.preprocess.fit_light_drift`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mivol.errors import MivolError
from mivol.optim.optimizer import Optimizer, OptimizerRun
from mivol.optim.problem import Reals
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts, SolverState
from mivol.optim.projections.solvers import ALL_SOLVERS, DIRECT
from mivol.optim.strategy import setting
from mivol.tomography.preprocess import LightDrift, fit_light_drift

KEY = "x"
"""The name of the volume among values."""


@dataclass
class ProjectionProblem:
    """A volume behind projections.

    Attributes:
        linear_problem: what a solver minimises.
        x: (n,) what was found; None before the first step.
        times: (views,) when each was taken, where the light drifts; None where it does not.
        safe_point: called before each iteration.
    """

    linear_problem: LeastSquares | PoissonCounts
    x: np.ndarray | None = None
    times: np.ndarray | None = None
    safe_point: Callable[[], None] = lambda: None

    def initial_reals(self) -> Reals:
        """Nothing: a solver begins where its problem says."""
        return {}

    def set_reals(self, reals: Reals) -> None:
        """Take over what was found."""
        self.x = reals.get(KEY)

    def values(self) -> Reals:
        """What was found."""
        return {} if self.x is None else {KEY: self.x}

    def warning(self) -> str:
        """Nothing: projections are computed without noise."""
        return ""

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """Nothing: the solver's state is all there is."""
        return {}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Nothing to do."""


class LinearSolve(Optimizer, tag="solve"):
    """The iterations of a linear solver."""

    solver: Annotated[str, setting("1", "key of METHODS", min_length=1)] = "pcg"
    subsets: Annotated[int, setting("1", "subsets of views, for os-sart", ge=1)] = 10
    drift: Annotated[int, setting("iteration", "how often the drift of the light is fitted, where views have times", ge=0)] = 0
    relaxation: Annotated[float, setting("1", "of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, setting("1", "of the relaxation, a sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, setting("1", "key of mivol.tomography.ramp.WINDOWS, for fbp and fdk", min_length=1)] = "ram-lak"
    cutoff: Annotated[float, setting("1", "where the window ends, in parts of the Nyquist frequency", gt=0, le=1)] = 1.0
    stop_norm: Annotated[float, setting("1", "stop where the norm of the residual is at most this", ge=0)] = 0.0

    def options(self) -> dict[str, object]:
        """What is given to the solver."""
        if self.solver in DIRECT:
            return {"window": self.window, "cutoff": self.cutoff}
        steps = {"relaxation": self.relaxation, "decay": self.decay}
        return {"sart": steps, "os-sart": steps | {"n_subsets": self.subsets}}.get(self.solver, {})

    def begin(self, problem: ProjectionProblem) -> SolverRun:
        return SolverRun(self, problem)


class SolverRun(OptimizerRun):
    """State: that of the solver, whose arrays are never written again.

    Attributes:
        state: the newest; None before the first iteration.
    """

    def __init__(self, settings: LinearSolve, problem: ProjectionProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.state: SolverState | None = None
        self._go_on(None)

    def _go_on(self, state: SolverState | None) -> None:
        method = ALL_SOLVERS[self.settings.solver]
        problem, options = self.problem.linear_problem, self.settings.options()
        method.check(problem, **options)
        if self.problem.times is not None and self.settings.drift:
            self._states = solve_with_drift(method.run, problem, self.problem.times, self.settings.drift, state, **options)
        else:
            self._states = method.run(problem, state, **options)
        self._keep(state)

    def _keep(self, state: SolverState | None) -> None:
        self.state = state
        self.reals = {} if state is None else {KEY: state.x}
        if state is not None and state.residual_norm <= self.settings.stop_norm:
            self.stop_reason = "the residual is as small as the noise"

    def step(self, iteration: int, factor: float) -> float | None:
        """The solver's next iteration; what it minimises, after it.

        Raises:
            MivolError: the projections hold nothing, so that there is no first iteration.
        """
        self.problem.safe_point()
        state = next(self._states, None)
        if state is None:
            if self.state is None:
                raise MivolError("the projections hold nothing to reconstruct: all weights are 0, or all line integrals.")
            self.stop_reason = "no direction lowers the objective"
            return None
        self._keep(state)
        return state.objective

    def pack(self) -> dict[str, np.ndarray]:
        return {} if self.state is None else self.state.to_arrays()

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        self._go_on(SolverState.from_arrays(arrays) if arrays else None)


INNER = "inner."
"""Begins the names of what the solver itself must know."""


def solve_with_drift(
    run: Callable[..., Iterator[SolverState]],
    problem: LeastSquares,
    times: np.ndarray,
    every: int,
    state: SolverState | None = None,
    **options: object,
) -> Iterator[SolverState]:
    """Iterations of a solver with the drift fitted anew after ``every`` of them.

    Args:
        run: of a :class:`~mivol.optim.projections.linear_problems.Solver` of least squares.
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
