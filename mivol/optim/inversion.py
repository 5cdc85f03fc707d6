"""Projections as a problem of the loop, and the linear solvers as its optimisers.

Conventions. A solver needs more of its problem than a gradient (the operator and its transpose, whose products it shares out),
so it takes its iterations itself; the loop brings events, history, checkpoints and a clean stop. Vectors stay in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mivol.errors import MivolError
from mivol.optim.drifting_light import with_drift
from mivol.optim.linear_problems import LeastSquares, PoissonCounts
from mivol.optim.optimiser import Optimiser, Run
from mivol.optim.problem import Reals
from mivol.optim.solver import State
from mivol.optim.solvers import DIRECT, METHODS
from mivol.optim.strategy import of

KEY = "x"
"""The name of the volume among values."""


@dataclass
class Inversion:
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

    def start(self) -> Reals:
        """Nothing: a solver begins where its problem says."""
        return {}

    def set(self, reals: Reals) -> None:
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


class Solve(Optimiser, tag="solve"):
    """The iterations of a linear solver."""

    solver: Annotated[str, of("1", "key of METHODS", min_length=1)] = "pcg"
    subsets: Annotated[int, of("1", "subsets of views, for os-sart", ge=1)] = 10
    drift: Annotated[int, of("iteration", "how often the drift of the light is fitted, where views have times", ge=0)] = 0
    relaxation: Annotated[float, of("1", "of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, of("1", "of the relaxation, a sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, of("1", "key of mivol.tomography.ramp.WINDOWS, for fbp and fdk", min_length=1)] = "ram-lak"
    cutoff: Annotated[float, of("1", "where the window ends, in parts of the Nyquist frequency", gt=0, le=1)] = 1.0
    stop_norm: Annotated[float, of("1", "stop where the norm of the residual is at most this", ge=0)] = 0.0

    def options(self) -> dict[str, object]:
        """What is given to the solver."""
        if self.solver in DIRECT:
            return {"window": self.window, "cutoff": self.cutoff}
        steps = {"relaxation": self.relaxation, "decay": self.decay}
        return {"sart": steps, "os-sart": steps | {"n_subsets": self.subsets}}.get(self.solver, {})

    def begin(self, problem: Inversion) -> SolverRun:
        return SolverRun(self, problem)


class SolverRun(Run):
    """State: that of the solver, whose arrays are never written again.

    Attributes:
        state: the newest; None before the first iteration.
    """

    def __init__(self, settings: Solve, problem: Inversion) -> None:
        super().__init__(problem)
        self.settings = settings
        self.state: State | None = None
        self._go_on(None)

    def _go_on(self, state: State | None) -> None:
        method = METHODS[self.settings.solver]
        problem, options = self.problem.linear_problem, self.settings.options()
        method.check(problem, **options)
        if self.problem.times is not None and self.settings.drift:
            self._states = with_drift(method.run, problem, self.problem.times, self.settings.drift, state, **options)
        else:
            self._states = method.run(problem, state, **options)
        self._keep(state)

    def _keep(self, state: State | None) -> None:
        self.state = state
        self.reals = {} if state is None else {KEY: state.x}
        if state is not None and state.residual_norm <= self.settings.stop_norm:
            self.finished = "the residual is as small as the noise"

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
            self.finished = "no direction lowers the objective"
            return None
        self._keep(state)
        return state.objective

    def pack(self) -> dict[str, np.ndarray]:
        return {} if self.state is None else self.state.to_arrays()

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        self._go_on(State.from_arrays(arrays) if arrays else None)
