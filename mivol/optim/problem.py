r"""Problems: methods of a model with data, for the fit loop, optimizers and events.

.. math:: \min_u f(u), \qquad f(u) = \mathrm{loss}(x(u)) + \mathrm{energy}(x(u))

Conventions. ``u`` are the *reals*, tensors by the name of their parameter; the model maps reals to values ``x``. A scene with
images, a radiance field with rays of photographs, Gaussians with photographs, and a volume with projections are problems. A
network or a hash grid would be another subclass, and an event for changes of shape.

Iteration i depends on the reals, on the arrays of :meth:`Problem.pack`, and on i. All random numbers are a function of the
problem's seed and i.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, SupportsFloat, TypeAlias

import mitsuba as mi
import numpy as np

from mivol.optim.parameters import Parameter

Reals: TypeAlias = "dict[str, mi.TensorXf]"
"""The unknowns of an optimizer: a tensor for each parameter."""


class Problem(Protocol):
    """Methods for the fit loop.

    Attributes:
        safe_point: called between kernels, where an interrupt may raise; only state of the current call has changed.
    """

    safe_point: Callable[[], None]

    def initial_reals(self) -> Reals:
        """Reals of the model's present values."""

    def set_reals(self, reals: Reals) -> None:
        """Give the model the values of these reals."""

    def values(self) -> dict[str, mi.TensorXf]:
        """Values of the model by parameter."""

    @property
    def warning(self) -> Callable[[], str]:
        """Function that returns a sentence about the noise of the latest loss, or about slow steps, or ""; it may wait for the
        loss."""
        return str

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """Inputs of the next step beside the reals, as the nodes of a sparse field.

        State rebuilt by :meth:`unpack` is rebuilt here as well: a resumed run then equals an uninterrupted run.
        """
        return {}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Continue from the arrays of :meth:`pack`, with the reals of the same moment."""
        # Without a statement mypy counts the method as abstract, and refuses problems without state.
        return


class DifferentiableProblem(Problem, Protocol):
    """Additional methods for first-order optimizers."""

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[SupportsFloat | mi.Float, Reals]:
        """f(u) and the gradient. A loss of type ``mi.Float`` has width 1. The device may still compute a loss that is no
        ``float``.

        Args:
            reals: u.
            iteration: selects random numbers and the part of the data.
            views: number of views; 0 leaves the choice to the problem.
        """

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rate of each parameter in an iteration, in the unit of its reals."""

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """Project reals onto their domain after a step, and apply priors that act apart from the gradient.

        Args:
            reals: of the step; the problem may empty this dictionary, since its entries keep the gradient in memory.
            iteration: of the latest :meth:`loss_and_gradient`.
        """


Part: TypeAlias = "tuple[Any, ...]"
"""A part of a step, in plain Python: arguments of :meth:`DividedProblem.compute_part`."""

Divide: TypeAlias = "Callable[[DividedProblem, Reals, Sequence[Part]], dict[str, np.ndarray]]"
"""Computes parts of a step, perhaps in other processes, and adds their results as :func:`add_parts`."""


class DividedProblem(DifferentiableProblem, Protocol):
    """Additional methods of a problem whose step is a sum over parts, which several processes can compute.

    A part depends on the reals, on :meth:`step_state` and on itself only. Another process makes the problem from the fields of
    its class, and takes the state before it computes parts.

    Attributes:
        divide: computes the parts of a step; None computes the whole step at once in this process.
    """

    divide: Divide | None

    def compute_part(self, reals: Reals, *part: Any) -> Reals:
        """Contributions of a part to the step by name: the loss, derivatives by parameter, and statistics."""

    def step_state(self) -> dict[str, Any]:
        """What parts read beside the reals and the fields of the class; an object that changes is another object."""

    def take_step_state(self, state: dict[str, Any]) -> None:
        """Continue from the state of the same problem in another process."""


def add_parts(total: dict[str, np.ndarray], result: Mapping[str, np.ndarray]) -> None:
    """Add the results of a part to a sum, by name: float64 from the second summand on.

    Sums of float32 numbers in float64 are exact unless they differ by more than 2^29 over their count, so they do not depend on
    their order.
    """
    for name, value in result.items():
        total[name] = np.add(total[name], value, dtype=np.float64) if name in total else value


def to_arrays(tensors: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Tensors as NumPy arrays."""
    return {name: np.array(value) for name, value in tensors.items()}


def to_tensors(arrays: Mapping[str, np.ndarray]) -> Reals:
    """NumPy arrays as tensors of float32."""
    return {name: mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32)) for name, array in arrays.items()}


class BoundedProblem(DifferentiableProblem, Protocol):
    """Additional methods for L-BFGS: bounds of the reals, and the loss without derivatives.

    Attributes:
        parameters: the unknowns, with learning rates and bounds.
    """

    parameters: Sequence[Parameter]

    def loss_value(self, reals: Reals, iteration: int) -> float:
        """f(u)."""


class Linearization(Protocol):
    """A problem around one point u: r are residuals, W their weights, R the energy of the priors.

    Attributes:
        loss: f(u).
        gradient: J^T W r + R', by the reals.
    """

    loss: float
    gradient: Reals

    def curvature(self, direction: Reals) -> Reals:
        """(J^T W J + R'') direction."""


class LinearizableProblem(BoundedProblem, Protocol):
    """Additional methods for Gauss-Newton: products with the Jacobian J."""

    def check_linearizable(self) -> None:
        """Check that the loss is quadratic.

        Raises:
            MivolError: the loss is not quadratic.
        """

    def linearize(self, reals: Reals) -> Linearization:
        """The problem around ``reals``, with the same random numbers at each call."""


@dataclass(frozen=True)
class Refinement:
    """A change of a problem to other unknowns.

    Attributes:
        reals: of the new unknowns, for the same model.
        carry: maps tensors shaped like the old reals, as moments of an optimizer, to the new unknowns.
        derivative_factors: factor on derivatives by parameter; 1 for parameters without an entry.
        message: sentence for the log.
    """

    reals: Reals
    carry: Callable[[Reals], Reals]
    derivative_factors: dict[str, float] = field(default_factory=dict)
    message: str = ""


class StagedProblem(DifferentiableProblem, Protocol):
    """Additional members for :class:`~mivol.optim.events.CoarseToFine` and ``DropUnseen``.

    Attributes:
        stage: number of the current stage.
    """

    stage: int

    def refine(self, stage: int) -> Refinement:
        """Begin a stage, with the model at the latest reals; the problem has the stage's unknowns afterwards.

        The number of the current stage removes its unseen unknowns.
        """


class SparseProblem(StagedProblem, Protocol):
    """Additional method for :class:`~mivol.optim.events.UpdateOccupancy`."""

    def update_occupancy(self) -> None:
        """Update the list of cells that the next steps can skip without changing their result."""
