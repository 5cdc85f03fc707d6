"""A method that solves a problem of line integrals, and where it stands.

Conventions. Each solver is a generator: it yields a :class:`State` per iteration for ever (or until nothing is left to gain),
so progress, checkpoints and stopping are the caller's. The arrays of a state are never written again, and
``run(problem, state=saved)`` continues as if it had not stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class State:
    """Where a solver stands after an iteration.

    Args:
        x: (n,) the field.
        iteration: iterations done.
        objective: value of what the solver minimises, at ``x``; for SIRT and OS-SART half the squared residual.
        residual_norm: ``|W^(1/2) (b - A x)|``; for OS-SART of the residuals as each subset met them, before its update.
        memory: what else the solver must know to go on.
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
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> State:
        """The state that :meth:`to_arrays` gave."""
        memory = {name.removeprefix("memory."): arrays[name] for name in arrays if name.startswith("memory.")}
        scalars = int(arrays["iteration"]), float(arrays["objective"]), float(arrays["residual_norm"])
        return cls(arrays["x"], *scalars, memory)


def takes_all(problem: object, **options: object) -> None:
    """The check of a method that has nothing to refuse."""


@dataclass(frozen=True)
class Solver:
    """A method: ``run(problem, state=None, **options)`` yields states.

    ``check(problem, **options)`` raises what ``run`` would raise in its first iteration, and computes nothing.
    """

    run: Callable[..., Iterator[State]]
    problem: type
    needs: str
    promises: str
    citation: str
    check: Callable[..., None] = takes_all
