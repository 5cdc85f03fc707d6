"""Events between the steps of a fit: refine the grid, write a checkpoint, measure the error.

Conventions. Before each iteration the fit applies the events that are ``due``. The returned messages go into the log.
Events of an iteration are applied in the given order, checkpoints first.
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
    """Attributes and methods of a fit for its events.

    Attributes:
        problem: the problem to minimise.
        run: the optimizer run, which owns the reals.
        next_iteration: the iteration after the event.
    """

    problem: Problem
    run: OptimizerRun
    next_iteration: int

    def save(self) -> None:
        """Write the checkpoint."""

    def evaluate(self) -> None:
        """Measure and record the errors."""


def upsample(field: mi.TensorXf, shape: tuple[int, int, int]) -> mi.TensorXf:
    """Resample a field to another resolution with the same total mass; new extrema come from the mass factor only.

    The field is interpolated linearly between voxel centres with clamped borders (weights >= 0: no overshoot), then multiplied
    by one factor per channel. The mass of a trilinear field with clamped borders is exactly the mean of its voxels times the
    volume of the box: each voxel's hat, with its border half, integrates to one cell.

    Args:
        field: (Z, Y, X, C), finite.
        shape: the new (Z, Y, X).

    Returns:
        (*shape, C). The mass of each channel equals the mass in ``field`` to float32 rounding. If linear interpolation leaves
        no
            mass (a checkerboard of both signs), the result is the interpolation itself.
    """
    fine = np.asarray(dr.resample(field, (*shape, field.shape[3]), filter="linear"), dtype=np.float64)
    mass = np.asarray(field, dtype=np.float64).mean(axis=(0, 1, 2))
    fine_mass = fine.mean(axis=(0, 1, 2))
    # Scales are per channel: an albedo may stand beside a density smaller by 1e15.
    largest = np.abs(fine).max(axis=(0, 1, 2), initial=0.0)
    factor = np.divide(mass, fine_mass, out=np.ones_like(mass), where=np.abs(fine_mass) > 1e-12 * largest)
    return mi.TensorXf((fine * factor).astype(np.float32))


class Event(Strategy, tag="event"):
    """An action between iterations."""

    def due(self, iteration: int) -> bool:
        """Whether the event happens before this iteration."""
        raise NotImplementedError

    def apply(self, fit: RunningFit) -> str:
        """Apply the event; the returned message, if not empty, goes into the log and the report."""
        raise NotImplementedError


class RegularEvent(Event, tag="regular_event"):
    """An event before each iteration whose number is a multiple of ``every``, the first iteration excepted."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)]

    def due(self, iteration: int) -> bool:
        return iteration > 0 and iteration % self.every == 0


def check_for_grids(count: int) -> None:
    """Check for a grid among the parameters.

    Raises:
        MivolError: no parameter is a grid.
    """
    if count == 0:
        raise MivolError("the event 'upsample' found no grid among the parameters: remove the event.")


class Upsample(Event, tag="upsample"):
    """Refine every grid. Large structures converge on a coarse grid in few cheap steps."""

    at: Annotated[tuple[int, ...], setting("iteration", "iterations before which the event happens")]
    factor: Annotated[int, setting("1", "new voxels per old voxel and axis", ge=2, le=8)] = 2

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
    """Begin the next stage of a problem: finer unknowns, and only around nonempty regions."""

    at: Annotated[tuple[int, ...], setting("iteration", "first iterations of the second stage, the third, ...")]

    def due(self, iteration: int) -> bool:
        return iteration in self.at

    def apply(self, fit: RunningFit) -> str:
        return _change_stage(fit, 1 + self.at.index(fit.next_iteration))


class DropUnseen(Event, tag="drop_unseen"):
    """Remove the unknowns of a stage that no view sees, to save time and memory."""

    at: Annotated[tuple[int, ...], setting("iteration", "iterations before which the event happens")]

    def due(self, iteration: int) -> bool:
        return iteration in self.at

    def apply(self, fit: RunningFit) -> str:
        return _change_stage(fit, fit.problem.stage)


def _change_stage(fit: RunningFit, stage: int) -> str:
    """Begin a stage, or begin the current stage again; returns the message.

    Dr.Jit keeps freed arrays for later arrays of the same size, rounded up to a power of two. The change of stage cannot reuse
    the arrays of the last steps, and the next steps cannot reuse the arrays of the change, so the
    cache is flushed before and after.
    """
    dr.flush_malloc_cache()
    fit.problem.set_reals(fit.run.reals)
    refinement = fit.problem.refine(stage)
    fit.run.refine(refinement)
    message = refinement.message
    del refinement  # it holds the old unknowns
    dr.flush_malloc_cache()
    return message


class AdaptBricks(Event, tag="adapt_bricks"):
    """Let bricks of sparse grids vanish where they are empty, and appear beside others where the gradient asks for them."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 20
    end: Annotated[int, setting("iteration", "iteration after the last application", ge=1)] = 1000
    threshold: Annotated[float, setting("1/length", "largest value of a brick that vanishes", ge=0)] = 0.0

    def due(self, iteration: int) -> bool:
        return 0 < iteration < self.end and iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        refinement = fit.problem.adapt_bricks(fit.run.reals, fit.next_iteration, self.threshold)
        fit.run.refine(refinement)
        return refinement.message


class UpdateOccupancy(RegularEvent, tag="update_occupancy"):
    """Let a problem update the list of cells that steps can skip without changing their result."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 64

    def apply(self, fit: RunningFit) -> str:
        fit.problem.set_reals(fit.run.reals)
        fit.problem.update_occupancy()
        return ""


class AlignCameras(RegularEvent, tag="align_cameras"):
    """Let a problem move the cameras of its photographs to where its model agrees better with them."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 25

    def apply(self, fit: RunningFit) -> str:
        fit.problem.set_reals(fit.run.reals)
        return fit.problem.align_cameras(fit.next_iteration)


class ControlDensity(Event, tag="control_density"):
    """Let a problem add Gaussians to poorly fitted regions and remove invisible Gaussians."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 100
    begin: Annotated[int, setting("iteration", "first iteration", ge=1)] = 500
    end: Annotated[int, setting("iteration", "iteration after the last application", ge=1)] = 15000

    def due(self, iteration: int) -> bool:
        return self.begin <= iteration < self.end and iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.problem.set_reals(fit.run.reals)
        refinement = fit.problem.control_density(fit.next_iteration)
        fit.run.refine(refinement)
        return refinement.message


class Checkpoint(RegularEvent, tag="checkpoint"):
    """Write all inputs of the next iteration."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 10

    def apply(self, fit: RunningFit) -> str:
        fit.save()
        return ""


class Evaluate(Event, tag="evaluate"):
    """Measure errors that the fit does not minimise: held-out views, error of the volume."""

    every: Annotated[int, setting("iteration", "interval between events", ge=1)] = 10

    def due(self, iteration: int) -> bool:
        return iteration % self.every == 0

    def apply(self, fit: RunningFit) -> str:
        fit.evaluate()
        return ""


EVENTS = make_table(Upsample, AdaptBricks, Checkpoint, Evaluate)
"""Events available in files; plans of photographs use the others."""


def checkpoints_first(events: tuple[Event, ...]) -> list[Event]:
    """Events in the given order, checkpoints first, with the state before the other events."""
    return sorted(events, key=lambda event: not isinstance(event, Checkpoint))
