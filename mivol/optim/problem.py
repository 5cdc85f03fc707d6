r"""What can be fitted: the questions that the loop, first-order optimisers and events ask of a model and its data.

.. math:: \min_u f(u), \qquad f(u) = \mathrm{loss}(x(u)) + \mathrm{energy}(x(u))

Conventions. ``u`` are the *reals*, tensors by the name of the parameter; ``x`` is what the model makes of them. A scene that is
compared with images, a radiance field that is compared with rays of photographs and a volume behind projections are problems;
a network, a hash grid or a set of Gaussians is one more class with these methods, and an event for whatever changes its shape.

What a problem answers in iteration i depends on the reals, what :meth:`Problem.pack` gives, and i; all its random numbers are a
function of its seed and i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import mitsuba as mi
import numpy as np

from mivol.optim.parameters import Parameter

Reals: TypeAlias = "dict[str, mi.TensorXf]"
"""What an optimiser moves: one tensor for each parameter."""


class Problem(Protocol):
    """What the loop asks of whatever is fitted.

    Attributes:
        safe_point: called between kernels, where a run may be stopped: nothing that outlives the call under way has changed.
    """

    safe_point: Callable[[], None]

    def initial_reals(self) -> Reals:
        """Where the fit begins: the reals of what the model holds now."""

    def set_reals(self, reals: Reals) -> None:
        """Let the model hold what these reals stand for."""

    def values(self) -> dict[str, mi.TensorXf]:
        """What the model holds now, by parameter."""

    def warning(self) -> str:
        """What a reader of the newest loss must know, in a sentence, or ""."""

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """What the next step depends on beside the reals: where a sparse field has nodes, for one.

        Whatever is found anew by :meth:`unpack` is found anew here too, or a resumed run would go on otherwise.
        """

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Continue from what :meth:`pack` gave, with the reals of the same moment."""


class DifferentiableProblem(Problem, Protocol):
    """What optimisers of first order ask for besides."""

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[float | mi.Float, Reals]:
        """f(u), a number or a Dr.Jit array of width 1 that is not waited for, and its gradient.

        Args:
            reals: u.
            iteration: which random numbers, and which part of the data.
            views: how many views are looked at; 0 leaves it to the problem.
        """

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rate of each parameter in an iteration, in the unit of its reals."""

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """What becomes of the reals of a step: on to their domain, and moved by priors that act apart from the gradient.

        Args:
            reals: of the step; the problem may take them out: while the dictionary holds them, the gradient is in memory.
            iteration: that of the newest :meth:`loss_and_gradient`.
        """


class BoundedProblem(DifferentiableProblem, Protocol):
    """Additional methods for L-BFGS: bounds of the reals, and the loss alone.

    Attributes:
        parameters: the unknowns, with learning rates and bounds.
    """

    parameters: Sequence[Parameter]

    def loss_value(self, reals: Reals, iteration: int) -> float:
        """f(u), without derivatives."""


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
    """How a problem goes over to other unknowns.

    Attributes:
        reals: of the new unknowns, for the same model.
        carry: what is known of the old unknowns, tensors shaped like their reals, to the new ones.
        derivative_factors: by how much derivatives become smaller, by parameter; 1 for those that are not named.
        message: a sentence for the log.
    """

    reals: Reals
    carry: Callable[[Reals], Reals]
    derivative_factors: dict[str, float] = field(default_factory=dict)
    message: str = ""


class StagedProblem(DifferentiableProblem, Protocol):
    """What :class:`~mivol.optim.events.CoarseToFine`, ``DropUnseen`` and ``UpdateOccupancy`` ask for besides."""

    def refine(self, stage: int) -> Refinement:
        """Begin a stage, with the model at the newest reals; the problem has the stage's unknowns from here on.

        The stage at work is begun again, without what is not seen.
        """

    def update_occupancy(self) -> None:
        """Look again for what can be left out of the next steps without changing them."""
