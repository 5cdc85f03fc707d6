"""Problems of line integrals and the state of their solvers: least squares, and the likelihood of counts.

Conventions. The operator A maps voxels (n,) to rays (m,), both flat; ``A.shape`` is (m, n). ``b`` are line integrals
(dimensionless), ``weights`` their inverse variances (0 excludes a ray), x the field (1/length). Vectors keep the operator's
dtype. Sums are float64 in a fixed order: a run is bitwise repeatable with a repeatable operator.

A solver is a generator. The generator yields a :class:`SolverState` per iteration, without end or until the minimum. The caller
controls progress, checkpoints and stopping. Arrays of a state are never overwritten, and ``run(problem, state=saved)``
continues an interrupted run.

References: Morozov 1966 (discrepancy principle).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from mivol.errors import MivolError


class Penalty(Protocol):
    """A convex penalty with a quadratic majoriser that touches the penalty at x."""

    def value(self, x: np.ndarray) -> float: ...
    def gradient(self, x: np.ndarray) -> np.ndarray: ...
    def curvature(self, x: np.ndarray, p: np.ndarray) -> float:
        """Second derivative of the majoriser at ``x``, along ``p``."""

    def separable(self, x: np.ndarray) -> np.ndarray:
        """Diagonal of a separable quadratic that majorises the majoriser."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimise ``1/2 |W^(1/2) (A x - b)|^2 + prior(x)``, over ``x >= 0`` if ``nonnegative``.

    Args:
        A: linear operator (m, n).
        b: (m,) line integrals, in a shape with m entries.
        weights: inverse variances of ``b``; None: 1.
        x0: start; None: 0.
        nonnegative: keep every voxel at or above 0.
        prior: optional penalty.
    """

    A: Any
    b: np.ndarray
    weights: np.ndarray | None = None
    x0: np.ndarray | None = None
    nonnegative: bool = False
    prior: Penalty | None = None

    def __post_init__(self) -> None:
        check_sizes(self.A, self.x0, b=self.b, weights=self.weights)
        if self.weights is not None and np.min(self.weights) < 0:
            raise MivolError("found a negative weight, expected inverse variances: set the weight of unused rays to 0.")


@dataclass(frozen=True, eq=False)
class PoissonCounts:
    """Maximise the likelihood of ``counts ~ Poisson(blank exp(-A x) + background)`` over ``x >= 0``, minus a prior.

    Args:
        A: linear operator (m, n) with entries >= 0.
        counts: (m,) numbers of quanta: detector readings over the gain.
        blank: quanta without an object, a number or (m,).
        background: expected quanta from other sources (dark, scatter), a number or (m,).
        x0: start, >= 0; None: 0.
        prior: optional penalty.
        used: (m,) whether a ray is used (dead and saturated pixels are not); None: all rays.
    """

    A: Any
    counts: np.ndarray
    blank: np.ndarray | float
    background: np.ndarray | float = 0.0
    x0: np.ndarray | None = None
    prior: Penalty | None = None
    used: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_sizes(self.A, self.x0, counts=self.counts, used=self.used)
        if np.min(self.counts) < 0 or np.min(self.blank) <= 0 or np.min(self.background) < 0:
            raise MivolError("found negative data or a blank of 0, expected counts >= 0, background >= 0 and blank > 0.")


def check_sizes(a: Any, x0: np.ndarray | None, **data: np.ndarray | None) -> None:
    """Check data for an operator.

    Raises:
        MivolError: another number of values than rays or voxels, or a nonfinite value.
    """
    m, n = a.shape
    for name, value in data.items():
        if value is None:
            continue
        if np.size(value) != m:
            raise MivolError(f"found {np.size(value)} values in '{name}', expected {m}, one for each ray of the operator.")
        if not np.isfinite(value).all():
            raise MivolError(
                f"found a value that is not finite in '{name}' at flat index {int(np.argmin(np.isfinite(value)))}: give "
                "unusable rays a weight of 0 and a finite value."
            )
    if x0 is not None and (np.size(x0) != n or not np.isfinite(x0).all()):
        raise MivolError(
            f"found a start of {np.size(x0)} values, expected {n} finite ones, one for each voxel of the operator."
        )


def flatten(a: np.ndarray, dtype: Any) -> np.ndarray:
    """An array as a vector."""
    return np.asarray(a, dtype).reshape(-1)


def start_field(a: Any, x0: np.ndarray | None) -> np.ndarray:
    """A copy of the start, or 0."""
    return np.zeros(a.shape[1], a.dtype) if x0 is None else flatten(x0, a.dtype).copy()


def flat_weights(problem: LeastSquares) -> np.ndarray | None:
    """Weights of rays (m,); None: 1."""
    return None if problem.weights is None else flatten(problem.weights, problem.A.dtype)


def apply_weights(weights: np.ndarray | None, v: np.ndarray) -> np.ndarray:
    """Weighted vector; None stands for weights of 1."""
    return v if weights is None else weights * v


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum in float64 in a fixed order, which BLAS does not guarantee."""
    return float(np.sum(a * b, dtype=np.float64))


def reciprocal(v: np.ndarray) -> np.ndarray:
    """1 / v; 0 for v below 1e-6 of the largest value: such rays and voxels are only grazed, and stay unchanged."""
    floor = 1e-6 * float(np.max(v, initial=0.0))
    return np.where(v > floor, 1.0 / np.where(v > floor, v, 1.0), 0.0).astype(v.dtype)


@dataclass(frozen=True, eq=False)
class SolverState:
    """State of a solver after an iteration.

    Args:
        x: (n,) the field.
        iteration: number of completed iterations.
        objective: minimised value at ``x``; for SIRT and OS-SART half the squared residual.
        residual_norm: ``|W^(1/2) (b - A x)|``; for OS-SART from the residuals of each subset before its update.
        memory: further arrays that the next iteration needs.
    """

    x: np.ndarray
    iteration: int
    objective: float
    residual_norm: float
    memory: dict[str, np.ndarray] = field(default_factory=dict)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of the state by name, for ``np.savez``."""
        scalars = {"iteration": self.iteration, "objective": self.objective, "residual_norm": self.residual_norm}
        arrays = {"x": self.x, **{name: np.asarray(value) for name, value in scalars.items()}}
        return arrays | {f"memory.{name}": value for name, value in self.memory.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> SolverState:
        """State from the arrays of :meth:`to_arrays`."""
        memory = {name.removeprefix("memory."): arrays[name] for name in arrays if name.startswith("memory.")}
        scalars = int(arrays["iteration"]), float(arrays["objective"]), float(arrays["residual_norm"])
        return cls(arrays["x"], *scalars, memory)


def accept_all(problem: object, **options: object) -> None:
    """The check of a solver without restrictions."""


@dataclass(frozen=True)
class Solver:
    """A solver: ``run(problem, state=None, **options)`` yields states.

    ``check(problem, **options)`` raises the errors of the first iteration of ``run``, without computing.
    """

    run: Callable[..., Iterator[SolverState]]
    problem: type
    needs: str
    promises: str
    citation: str
    check: Callable[..., None] = accept_all


UNWEIGHTED = ("sirt", "sart", "os-sart")
"""Solvers with an unweighted residual."""


def expected_residual_norm(problem: LeastSquares | PoissonCounts, solver: str) -> float:
    """The expected ``residual_norm`` of a solver at the true volume.

    The squares of a weighted residual ``r sqrt(w)``, and of Pearson's residual, have a mean of 1 for each used ray. Unweighted
    residuals have the mean ``sum 1 / w``.
    """
    if isinstance(problem, PoissonCounts):
        return float(np.sqrt(np.size(problem.counts) if problem.used is None else np.sum(problem.used)))
    if problem.weights is None:
        return float(np.sqrt(np.size(problem.b)))
    used = problem.weights[problem.weights > 0].astype(np.float64)
    return float(np.sqrt(np.sum(1.0 / used) if solver in UNWEIGHTED else used.size))
