"""What happens to a fit besides its steps: refine the grid, write a checkpoint, measure the error.

Conventions. An event is asked before each iteration whether it is ``due`` and, if so, applied; what it says, if anything,
goes into the log. Events of one iteration are applied in the order given, checkpoints first. EVENTS lists them.
"""

from __future__ import annotations

from typing import Annotated, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.optimizer import OptimizerRun
from mivol.optim.problem import Problem
from mivol.optim.strategy import Strategy, make_table, setting


class RunningFit(Protocol):
    """What an event may know and do of a fit.

    Attributes:
        problem: what is minimised.
        run: the optimiser at work, with the reals.
        next_iteration: the iteration that comes after the event.
    """

    problem: Problem
    run: OptimizerRun
    next_iteration: int

    def save(self) -> None:
        """Write the checkpoint."""

    def evaluate(self) -> None:
        """Measure, and remember."""


def upsample(field: mi.TensorXf, shape: tuple[int, int, int]) -> mi.TensorXf:
    r"""A field on a grid of another resolution, with the same total mass and no new extremum but by the mass's factor.

    Linear interpolation of the voxel centres with clamped borders (weights >= 0: no overshoot), then all values times
    one factor per channel. The mass of a trilinear field with clamped borders is the mean of its voxels times the
    volume of its box, exactly: each voxel's hat, with its border half, integrates to one cell.

    Args:
        field: (Z, Y, X, C), finite.
        shape: the new (Z, Y, X).

    Returns:
        (*shape, C). The mass of each channel is that of ``field`` to float32 rounding; where linear interpolation
        leaves no mass at all (a checkerboard of both signs), the interpolation itself.
    """
    fine = np.asarray(dr.resample(field, (*shape, field.shape[3]), filter="linear"), dtype=np.float64)
    mass = np.asarray(field, dtype=np.float64).mean(axis=(0, 1, 2))
    found = fine.mean(axis=(0, 1, 2))
    # Of each channel by its own values: an albedo may stand beside a density that is 1e15 times as small.
    largest = np.abs(fine).max(axis=(0, 1, 2), initial=0.0)
    factor = np.divide(mass, found, out=np.ones_like(mass), where=np.abs(found) > 1e-12 * largest)
    return mi.TensorXf((fine * factor).astype(np.float32))


class Event(Strategy, tag="event"):
    """Something that happens between iterations."""

    def due(self, iteration: int) -> bool:
        """Whether it happens before this iteration."""
        raise NotImplementedError

    def apply(self, fit: RunningFit) -> str:
        """Let it happen; what a reader of the report must know, or ""."""
        raise NotImplementedError


def check_for_grids(count: int) -> None:
    """Refuse to refine parameters of which none is a grid.

    Raises:
        MivolError: there are none.
    """
    if count == 0:
        raise MivolError("upsample found no grid among the parameters: take the event out.")


class Upsample(Event, tag="upsample"):
    """Refine every grid: coarse first, since large structures converge there in few cheap steps."""

    at: Annotated[tuple[int, ...], setting("iteration", "before which iterations")]
    factor: Annotated[int, setting("1", "new voxels per old one and axis", ge=2, le=8)] = 2

    def due(self, iteration: int) -> bool:
        return iteration in self.at

    def apply(self, fit: RunningFit) -> str:
        shapes = [self._refine(fit, p) for p in fit.problem.parameters if fit.run.reals[p.name].ndim == 4]
        check_for_grids(len(shapes))
        return "refined to " + ", ".join(" x ".join(str(n) for n in shape) for shape in shapes)

    def _refine(self, fit: RunningFit, parameter: object) -> tuple[int, int, int]:
        value = parameter.from_reals(fit.run.reals[parameter.name])
        shape = tuple(n * self.factor for n in value.shape[:3])
        fit.run.replace(parameter.name, parameter.project(parameter.to_reals(upsample(dr.detach(value), shape))))
        return shape


class CoarseToFine(Event, tag="coarse_to_fine"):
    """Begin the next stage of a problem that has stages: finer unknowns, and only where something was found."""

    at: Annotated[tuple[int, ...], setting("iteration", "before which the second stage begins, the third, ...")]

    def due(self, iteration: int) -> bool:
        return iteration in self.at

    def apply(self, fit: RunningFit) -> str:
        return _go_over(fit, 1 + self.at.index(fit.next_iteration))


class DropUnseen(Event, tag="drop_unseen"):
    """Go on without the unknowns of a stage that nothing sees: what is left takes less time and memory."""

    at: Annotated[tuple[int, ...], setting("iteration", "before which iterations")]

    def due(self, iteration: int) -> bool:
        return iteration in self.at

    def apply(self, fit: RunningFit) -> str:
        return _go_over(fit, fit.problem.stage)


def _go_over(fit: RunningFit, stage: int) -> str:
    """Begin a stage, or the one at work anew; what it says.

    Dr.Jit keeps arrays that were let go for others of their size, rounded up to a power of two. Those of the last steps are of
    no use to what comes between, nor those to the next steps.
    """
    dr.flush_malloc_cache()
    fit.problem.set_reals(fit.run.reals)
    refinement = fit.problem.refine(stage)
    fit.run.refine(refinement)
    says = refinement.message
    del refinement  # holds the old unknowns
    dr.flush_malloc_cache()
    return says


class UpdateOccupancy(Event, tag="update_occupancy"):
    """Let a problem look again for what the next steps can leave out without a change: cells that have become empty."""

    every: Annotated[int, setting("iteration", "how often", ge=1)] = 64

    def due(self, iteration: int) -> bool:
        return iteration > 0 and iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.problem.set_reals(fit.run.reals)
        fit.problem.update_occupancy()
        return ""


class ControlDensity(Event, tag="control_density"):
    """Let a problem have more Gaussians where the pictures need them, and fewer where nobody sees them."""

    every: Annotated[int, setting("iteration", "how often", ge=1)] = 100
    begin: Annotated[int, setting("iteration", "before which it is first done", ge=1)] = 500
    end: Annotated[int, setting("iteration", "from which on it is not done", ge=1)] = 15000

    def due(self, iteration: int) -> bool:
        return self.begin <= iteration < self.end and iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.problem.set_reals(fit.run.reals)
        refinement = fit.problem.control_density(fit.next_iteration)
        fit.run.refine(refinement)
        return refinement.message


class Checkpoint(Event, tag="checkpoint"):
    """Write everything that the next iteration depends on."""

    every: Annotated[int, setting("iteration", "how often", ge=1)] = 10

    def due(self, iteration: int) -> bool:
        return iteration > 0 and iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.save()
        return ""


class Evaluate(Event, tag="evaluate"):
    """Measure what the fit does not minimise: held-out views, error of the volume."""

    every: Annotated[int, setting("iteration", "how often", ge=1)] = 10

    def due(self, iteration: int) -> bool:
        return iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.evaluate()
        return ""


EVENTS = make_table(Upsample, Checkpoint, Evaluate)
"""Events that a file can name."""

PLAN_EVENTS = make_table(CoarseToFine, DropUnseen, UpdateOccupancy, ControlDensity)
"""Events of the plans of radiance fields and Gaussians."""


def checkpoints_first(events: tuple[Event, ...]) -> list[Event]:
    """Checkpoints first, so that they hold the state before the others."""
    return sorted(events, key=lambda event: not isinstance(event, Checkpoint))
