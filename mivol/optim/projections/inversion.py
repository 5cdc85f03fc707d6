"""Projections as a problem of the fit loop, with linear solvers as optimizers; the solvers by name.

Conventions. Iterative solvers take any operator with ``@`` and ``.T``. Filtered back-projection, in the same form, needs the
geometry of the scan. It bridges pixels of weight 0, ignores all other weights, and clips nothing. A solver needs products with
the operator beyond a gradient, and therefore runs separate iterations. :func:`solve_with_light` alternates between object and
light: a few iterations of the solver explain ``b - light``, then the light is fitted to the remaining part of ``b``.

References: :func:`mivol.tomography.rings.fit_drift_above_chance`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np

from mivol.errors import MivolError
from mivol.optim.optimizer import Optimizer, OptimizerRun
from mivol.optim.problem import Problem, Reals
from mivol.optim.projections.iterative import (
    cgls,
    check_sweeps,
    ordered_subsets_sart,
    projected_cg,
    sart,
    sirt,
    transmission_likelihood,
)
from mivol.optim.projections.linear_problems import (
    LeastSquares,
    PoissonCounts,
    Solver,
    SolverState,
    apply_weights,
    dot,
    flat_weights,
    flatten,
)
from mivol.optim.strategy import setting
from mivol.tomography.filtered import check_circle, check_parallel, feldkamp, filtered_backprojection
from mivol.tomography.preprocess import LightDrift, interpolate_gaps
from mivol.tomography.projector import Projector
from mivol.tomography.rings import fit_drift_above_chance

FilteredBackprojection = Callable[[Projector, np.ndarray, str, float], np.ndarray]


def fbp(
    problem: LeastSquares, state: SolverState | None = None, window: str = "ram-lak", cutoff: float = 1.0
) -> Iterator[SolverState]:
    """:func:`~mivol.tomography.filtered.filtered_backprojection` of a parallel beam, as a single state."""
    return _backproject_once(filtered_backprojection, problem, state, window, cutoff)


def fdk(
    problem: LeastSquares, state: SolverState | None = None, window: str = "ram-lak", cutoff: float = 1.0
) -> Iterator[SolverState]:
    """:func:`~mivol.tomography.filtered.feldkamp` of a circular cone beam, as a single state."""
    return _backproject_once(feldkamp, problem, state, window, cutoff)


def check_fbp(problem: LeastSquares, **options: object) -> None:
    """Check that :func:`fbp` can solve a problem.

    Raises:
        MivolError: a prior, another beam, or missing directions.
    """
    check_prior(problem)
    check_parallel(problem.A)


def check_fdk(problem: LeastSquares, **options: object) -> None:
    """Check that :func:`fdk` can solve a problem.

    Raises:
        MivolError: a prior, another trajectory than a circle, or missing directions.
    """
    check_prior(problem)
    check_circle(problem.A)


def check_prior(problem: LeastSquares) -> None:
    """Check that a problem has no prior, which a direct method cannot use.

    Raises:
        MivolError: a prior.
    """
    if problem.prior is not None:
        raise MivolError("found a prior with filtered back-projection, expected none: use pcg, or a window and a cutoff.")


def _backproject_once(
    method: FilteredBackprojection, problem: LeastSquares, state: SolverState | None, window: str, cutoff: float
) -> Iterator[SolverState]:
    a = problem.A
    check_prior(problem)
    if state is not None:
        return
    y = np.asarray(problem.b, float).reshape(a.projection_shape)
    if problem.weights is not None:
        y = interpolate_gaps(y, np.reshape(problem.weights, a.projection_shape))
    x = method(a, y, window, cutoff).reshape(-1)
    r = flatten(problem.b, a.dtype) - a @ x
    norm2 = dot(r, apply_weights(flat_weights(problem), r))
    yield SolverState(x, 1, norm2 / 2, float(np.sqrt(norm2)))


SOLVERS: dict[str, Solver] = {
    "pcg": Solver(
        projected_cg,
        LeastSquares,
        promises="the objective never rises; without bounds and prior, the least error in the energy norm at each step",
        cites=("hestenes_1952", "erdogan_1999"),
    ),
    "cgls": Solver(
        cgls,
        LeastSquares,
        promises="the least residual over the Krylov space of each iteration; early stopping regularises",
        cites=("hestenes_1952",),
    ),
    "sirt": Solver(
        sirt,
        LeastSquares,
        promises="converges to a least-squares solution weighted by 1 / (ray length)",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "sart": Solver(
        sart,
        LeastSquares,
        promises="the fastest first sweeps; a limit cycle on inconsistent data, which relaxation and decay shrink",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "os-sart": Solver(
        ordered_subsets_sart,
        LeastSquares,
        promises="n_subsets times SIRT's progress at first; a limit cycle on inconsistent data, which decay shrinks",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "ml-tr": Solver(
        transmission_likelihood,
        PoissonCounts,
        promises="the negative log-likelihood never rises; x >= 0; takes no logarithm of counts",
        cites=("nuyts_1998", "erdogan_1999"),
    ),
}
"""Iterative solvers by name. ``run(problem, state=None, **options)``."""

DIRECT: dict[str, Solver] = {
    "fbp": Solver(
        fbp,
        LeastSquares,
        promises="exact for many views without noise; linear, so values below 0 remain",
        cites=("kak_1988",),
        check=check_fbp,
    ),
    "fdk": Solver(
        fdk,
        LeastSquares,
        promises="exact in the source's plane for many views without noise; linear, so values below 0 remain",
        cites=("feldkamp_1984", "parker_1982"),
        check=check_fdk,
    ),
}
"""Direct solvers by name. ``run(problem, state=None, window=..., cutoff=...)``; the problem's operator is a projector."""

ALL_SOLVERS: dict[str, Solver] = SOLVERS | DIRECT
"""Solvers available in files."""


# -- The problem -------------------------------------------------------------------------------------------------------

KEY = "x"
"""Name of the volume among the values."""


class LightFit(Protocol):
    """Unknowns of the light beside the volume.

    Attributes:
        times: (views,) times at which a :class:`LightDrift` is evaluated.
    """

    times: np.ndarray

    def update(self, light: LightDrift, residual: np.ndarray, weights: np.ndarray) -> LightDrift:
        """Fit the light to ``residual`` = b - A x (views, rows, cols), from the light of the last turn."""
        ...


@dataclass(frozen=True, eq=False)
class DriftFit:
    """Offset and slope of each pixel beyond chance; ``times`` preferably centred at 0."""

    times: np.ndarray

    def update(self, light: LightDrift, residual: np.ndarray, weights: np.ndarray) -> LightDrift:
        return fit_drift_above_chance(residual, weights, self.times)


@dataclass
class ProjectionProblem(Problem):
    """A volume and its projections. The state of the solver is complete, so there is nothing to pack.

    Attributes:
        linear_problem: the problem of line integrals.
        x: (n,) the reconstructed volume; None before the first step.
        light: unknowns of the light; None: it is known.
        safe_point: called before each iteration.
        read_finished: reads the volume (n,) from which the checkpoint of a finished run continues.
    """

    linear_problem: LeastSquares | PoissonCounts
    x: np.ndarray | None = None
    light: LightFit | None = None
    safe_point: Callable[[], None] = lambda: None
    read_finished: Callable[[], np.ndarray] | None = None

    def initial_reals(self) -> Reals:
        """An empty dictionary: the solver takes its start from the problem of line integrals."""
        return {}

    def set_reals(self, reals: Reals) -> None:
        """Store the volume."""
        self.x = reals.get(KEY)

    def values(self) -> Reals:
        """The reconstructed volume."""
        return {} if self.x is None else {KEY: self.x}


class LinearSolve(Optimizer, tag="solve"):
    """The iterations of a linear solver."""

    solver: Annotated[str, setting("1", "key of ALL_SOLVERS", min_length=1)] = "pcg"
    subsets: Annotated[int, setting("1", "subsets of views, for os-sart", ge=1)] = 10
    drift: Annotated[int, setting("iteration", "interval between fits of the light; 0: never", ge=0)] = 0
    relaxation: Annotated[float, setting("1", "relaxation of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, setting("1", "factor on the relaxation per sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, setting("1", "key of mivol.tomography.filtered.WINDOWS, for fbp and fdk", min_length=1)] = "ram-lak"
    cutoff: Annotated[float, setting("1", "end of the window, as a share of the Nyquist frequency", gt=0, le=1)] = 1.0
    stop_norm: Annotated[float, setting("1", "stop at this norm of the residual", ge=0)] = 0.0

    def options(self) -> dict[str, object]:
        """Options of the solver."""
        if self.solver in DIRECT:
            return {"window": self.window, "cutoff": self.cutoff}
        steps = {"relaxation": self.relaxation, "decay": self.decay}
        return {"sart": steps, "os-sart": steps | {"n_subsets": self.subsets}}.get(self.solver, {})

    def begin(self, problem: ProjectionProblem) -> SolverRun:
        return SolverRun(self, problem)


class SolverRun(OptimizerRun):
    """State: the solver's state, whose arrays are never overwritten.

    Attributes:
        state: the latest state; None before the first iteration.
        is_left_to_outputs: whether checkpoints leave out the volume and the solver's memory, because the run is finished.
    """

    is_left_to_outputs = False

    def __init__(self, settings: LinearSolve, problem: ProjectionProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.state: SolverState | None = None
        self._resume(None)

    def _resume(self, state: SolverState | None) -> None:
        solver = ALL_SOLVERS[self.settings.solver]
        problem, options = self.problem.linear_problem, self.settings.options()
        solver.check(problem, **options)
        if self.problem.light is not None and self.settings.drift:
            self._states = solve_with_light(solver.run, problem, self.problem.light, self.settings.drift, state, **options)
        else:
            self._states = solver.run(problem, state, **options)
        self._store(state)

    def _store(self, state: SolverState | None) -> None:
        self.state = state
        self.reals = {} if state is None else {KEY: state.x}
        if state is not None and state.residual_norm <= self.settings.stop_norm:
            self.stop_reason = "the residual is as small as the noise"

    def step(self, iteration: int, factor: float) -> float | None:
        """Take the solver's next iteration; returns the objective after the iteration.

        Raises:
            MivolError: no data, and no possible iteration.
        """
        self.problem.safe_point()
        state = next(self._states, None)
        if state is None:
            if self.state is None:
                raise MivolError("found only weights or line integrals of 0, so nothing to reconstruct: check the data.")
            self.stop_reason = "no direction lowers the objective"
            return None
        if self.problem.linear_problem.x0 is not None:  # a field that no later step reads
            self.problem.linear_problem = replace(self.problem.linear_problem, x0=None)
        self._store(state)
        return state.objective

    def pack(self) -> dict[str, np.ndarray]:
        if self.state is None:
            return {}
        if not self.is_left_to_outputs:
            return self.state.to_arrays()
        light = {name: self.state.memory[name] for name in LIGHT if name in self.state.memory}
        arrays = replace(self.state, memory=light).to_arrays()
        del arrays[KEY]
        return arrays

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        if arrays and KEY not in arrays:
            arrays = {**arrays, KEY: self.problem.read_finished()}
        self._resume(SolverState.from_arrays(arrays) if arrays else None)


LIGHT = ("offset", "slope", "turn")
"""Names of the light in the memory of :func:`solve_with_light`."""

INNER = "inner."
"""Prefix for the names of the solver's own memory."""


def solve_with_light(
    run: Callable[..., Iterator[SolverState]],
    problem: LeastSquares,
    light: LightFit,
    every: int,
    state: SolverState | None,
    **options: object,
) -> Iterator[SolverState]:
    """Iterations of a solver, with a new fit of the light after every ``every`` iterations.

    The solver begins anew on what a fitted light leaves. Without any light it goes on, as if the light were known.

    Args:
        run: of a least-squares :class:`~mivol.optim.projections.linear_problems.Solver`.
        problem: ``A`` is a projector, ``b`` and ``weights`` are (views, rows, cols).
        light: unknowns of the light.
        every: iterations between two fits.
        state: state to resume from, with its memory.
        options: options of the solver.

    Yields:
        States of the solver, with the light (``offset``, ``slope``) in their memory.
    """
    done, turn, inner = 0, 0, None
    drift = LightDrift(*np.zeros((2, *problem.b.shape[1:])))
    if state is not None:
        memory = dict(state.memory)
        drift = LightDrift(memory.pop("offset"), memory.pop("slope"))
        done, turn = state.iteration, int(memory.pop("turn"))
        own = {name.removeprefix(INNER): value for name, value in memory.items()}
        inner = replace(state, iteration=turn, memory=own)
    states = run(replace(problem, b=problem.b - drift.eval(light.times)), inner, **options)
    while True:
        found = None if turn and turn % every == 0 else next(states, None)
        if found is None:
            if not turn:
                return
            last, drift = drift, update_light(problem, light, drift, inner.x)
            if any(part.any() for part in (last.offset, last.slope, drift.offset, drift.slope)):
                problem, turn = replace(problem, x0=inner.x), 0
                states = run(replace(problem, b=problem.b - drift.eval(light.times)), None, **options)
            found = next(states, None)
            if found is None:
                return
        inner, done, turn = found, done + 1, turn + 1
        memory = {INNER + name: value for name, value in inner.memory.items()}
        drift_memory = {"offset": drift.offset, "slope": drift.slope, "turn": np.asarray(turn)}
        yield replace(inner, iteration=done, memory=memory | drift_memory)


def update_light(problem: LeastSquares, light: LightFit, last: LightDrift, x: np.ndarray) -> LightDrift:
    """The light fitted to the residual of the volume ``x``, from the light of the last turn."""
    residual = problem.b - (problem.A @ np.reshape(x, -1)).reshape(problem.b.shape)
    return light.update(last, residual, problem.weights)
