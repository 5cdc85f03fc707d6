"""The fit loop: steps, events, history, and a clean stop at any moment.

Conventions. Iteration i depends on the problem, the optimizer's state and i only. A checkpoint holds the state before an
iteration; Ctrl-C and SIGTERM save the state before the interrupted iteration. A resumed run therefore equals an uninterrupted
run: bit for bit with one Dr.Jit thread, to about 1e-5 with several threads, whose float sums have no fixed order.

Losses of quick steps are read several steps late: the host prepares the next step while the device computes. Losses of slow
steps are read at once, so that the arrays of several steps do not pile up.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import SupportsFloat

import mitsuba as mi

from mivol.display import curve_html
from mivol.errors import MivolError, WorkersLost
from mivol.files.image_files import pairs_html
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Event, checkpoints_first
from mivol.optim.interrupt import InterruptGuard
from mivol.optim.optimizer import Constant, Optimizer, OptimizerRun, Schedule
from mivol.optim.problem import Problem
from mivol.threads import check_one_thread

SAVED_FIELDS = ("next_iteration", "events_done", "history", "evaluations", "log", "has_warned", "seconds")
"""Fields of a fit in a checkpoint, beside the arrays of the optimizer run and the problem."""

QUICK_STEP = 0.02
"""Time of a step [s] up to which losses are read late."""

MAX_UNREAD = 8
"""Most steps whose losses have not been read."""

Measure = Callable[[Problem], dict[str, float]]
"""Error measures of the problem's model, by name."""


@dataclass(frozen=True)
class Course:
    """Iterations of a fit, their schedule, and the events between iterations.

    Attributes:
        iterations: maximum number of iterations.
        schedule: factor on the learning rates.
        events: events between iterations.
    """

    iterations: int
    schedule: Schedule = field(default_factory=Constant)
    events: tuple[Event, ...] = ()


@dataclass(repr=False)
class Fit:
    """A fit in progress or a completed fit.

    Attributes:
        problem: the problem to minimise.
        run: the optimizer run, which owns the reals.
        course: iterations, schedule and events.
        measure: error measures for :meth:`evaluate`; None measures nothing.
        checkpoint: file of the checkpoint; None writes no checkpoint.
        next_iteration: number of the next iteration, which equals the number of completed iterations.
        events_done: number of applied events of the next iteration.
        read_history: records (iteration, loss, seconds) of the iterations whose losses have been read. The property ``history``
            reads the others first, and waits for them.
        evaluations: records (iteration, seconds, ...) of the evaluations.
        log: messages of events, and a message about the noise of renders in the loss.
        has_warned: whether the log holds the message of :meth:`Problem.warning` or of :meth:`OptimizerRun.warning`.
        seconds: time of the iterations [s], without interruptions; up to the last loss that was read.
    """

    problem: Problem
    run: OptimizerRun
    course: Course
    measure: Measure | None = None
    checkpoint: CheckpointFile | None = None
    next_iteration: int = 0
    events_done: int = 0
    read_history: list[dict[str, float]] = field(default_factory=list)
    evaluations: list[dict[str, float]] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    has_warned: bool = False
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self._events = checkpoints_first(self.course.events)
        self._unread: list[_Unread] = []
        self._begun, self._step_seconds = 0.0, math.inf
        if self.checkpoint is not None and self.checkpoint.resume:
            self.restore()

    def __repr__(self) -> str:
        latest = {**({"loss": self.history[-1]["loss"]} if self.history else {}), **self.latest_errors()}
        figures = "".join(f", {name} {value:.4g}" for name, value in latest.items())
        return f"Fit({self.next_iteration} of {self.course.iterations} iterations in {self.seconds:.1f} s{figures})"

    def _repr_html_(self) -> str:
        """Show the loss against the iteration in a notebook, with views of the result if the problem has images."""
        images = getattr(self.problem, "images", None)
        views = ""
        if images is not None:
            self.problem.set_reals(self.run.reals)
            views = pairs_html(images())
        return curve_html([row["loss"] for row in self.history], repr(self)) + views

    @property
    def history(self) -> list[dict[str, float]]:
        """Records (iteration, loss, seconds) of all iterations; waits for the newest losses.

        Raises:
            MivolError: as :meth:`read_losses`.
        """
        self.read_losses()
        return self.read_history

    @history.setter
    def history(self, records: list[dict[str, float]]) -> None:
        self.read_history = records

    @property
    def is_done(self) -> bool:
        """Whether no iteration remains or the optimizer has stopped."""
        return self.next_iteration >= self.course.iterations or bool(self.run.stop_reason)

    def values(self) -> dict[str, mi.TensorXf]:
        """Values of the result by parameter; the problem's model holds the same values afterwards."""
        self.problem.set_reals(self.run.reals)
        return self.problem.values()

    def evaluate(self) -> None:
        """Measure and record the errors."""
        if self.measure is None:
            return
        self.read_losses()
        self.problem.set_reals(self.run.reals)
        self.evaluations.append({"iteration": self.next_iteration, "seconds": self.seconds, **self.measure(self.problem)})

    def latest_errors(self) -> dict[str, float]:
        """Errors of the last evaluation by name; empty before the first evaluation."""
        latest = self.evaluations[-1] if self.evaluations else {}
        return {name: value for name, value in latest.items() if name not in ("iteration", "seconds")}

    # -- Steps --------------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Apply the events of the next iteration, then take its step. An interrupted step changes nothing.

        Raises:
            MivolError: the loss of this step, or of an earlier one that was not read yet, is not finite.
        """
        for number, event in enumerate(self._events):
            if number >= self.events_done and event.due(self.next_iteration):
                self._apply(event)
                self.events_done = number + 1
        if not self._unread:
            self._begun = time.perf_counter()
        loss = self.run.step(self.next_iteration, self.course.schedule.factor(self.next_iteration, self.course.iterations))
        if loss is None:
            return
        seconds = self.seconds + time.perf_counter() - self._begun
        self._unread.append(_Unread(self.next_iteration, loss, seconds, self.problem.warning))
        self.next_iteration, self.events_done = self.next_iteration + 1, 0
        if isinstance(loss, float) or self._step_seconds > QUICK_STEP or len(self._unread) == MAX_UNREAD:
            self.read_losses()

    def read_losses(self) -> None:
        """Wait for the losses of the newest steps, and record them.

        Raises:
            MivolError: a loss is not finite.
        """
        if not self._unread:
            return
        unread, self._unread = self._unread, []
        for step in unread:
            loss = float(step.loss[0]) if isinstance(step.loss, mi.Float) else float(step.loss)
            if not math.isfinite(loss):
                raise MivolError(
                    f"the loss became {loss} in iteration {step.iteration}: lower the learning rate, or bound the parameters."
                )
            self._warn(step)
            self.read_history.append({"iteration": step.iteration, "loss": loss, "seconds": step.seconds})
        passed = time.perf_counter() - self._begun
        self._step_seconds = passed / len(unread)
        self.seconds += passed
        self.read_history[-1]["seconds"] = self.seconds

    def complete(self, observer: Callable[[Fit], None] = lambda fit: None) -> Fit:
        """Take all remaining steps. The problem's model and the checkpoint hold the result afterwards.

        Raises:
            MivolError: as :meth:`advance`.
            WorkersLost: no worker of a cluster goes on; the checkpoint is written.
            Interrupted: Ctrl-C or SIGTERM; the checkpoint is written.
        """
        check_one_thread()
        with InterruptGuard() as stop:
            self.problem.safe_point = stop.check
            try:
                while not self.is_done:
                    before = self.next_iteration
                    self.advance()
                    if self.next_iteration > before:
                        observer(self)
                    stop.check()
                self.evaluate()
            except (KeyboardInterrupt, WorkersLost):
                self.save()
                raise
            finally:
                self.problem.safe_point = lambda: None
        self.problem.set_reals(self.run.reals)
        self.save()
        return self

    def _apply(self, event: Event) -> None:
        self.read_losses()
        message = event.apply(self)
        self.log += [f"iteration {self.next_iteration}: {message}"] if message else []

    def _warn(self, step: _Unread) -> None:
        """Log once that the noise of renders makes up a large share of the loss, or that steps are slow."""
        message = "" if self.has_warned else step.warning() or self.run.warning()
        if message:
            self.log.append(f"iteration {step.iteration}: {message}")
            self.has_warned = True

    # -- On disk ------------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the checkpoint, if the fit has a file."""
        if self.checkpoint is None:
            return
        self.read_losses()
        problem = {f"problem/{name}": array for name, array in self.problem.pack(self.run.reals).items()}
        fields = {name: getattr(self, name) for name in SAVED_FIELDS}
        self.checkpoint.write(self.run.pack() | problem, {**fields, "iterations": self.course.iterations})

    def restore(self) -> None:
        """Continue from the checkpoint.

        Raises:
            MivolError: the file is missing, belongs to another run, or was written by another version of mivol.
        """
        arrays, saved = self.checkpoint.read()
        missing = [name for name in SAVED_FIELDS if name not in saved]
        if missing:
            raise MivolError(
                f"{self.checkpoint.path} holds no {missing[0]}: another version of mivol wrote it; run without --resume."
            )
        self.run.unpack(arrays)
        problem = {name.removeprefix("problem/"): arrays[name] for name in arrays if name.startswith("problem/")}
        self.problem.unpack(problem, self.run.reals)
        for name in SAVED_FIELDS:
            setattr(self, name, saved[name])
        planned, now = saved["iterations"], self.course.iterations
        if planned < now and not isinstance(self.course.schedule, Constant):
            self.log.append(
                f"iteration {self.next_iteration}: the schedule was planned for {planned} iterations and continues for {now}; "
                f"one uninterrupted run of {now} iterations gives another result"
            )


@dataclass
class _Unread:
    """A step whose loss has not been read.

    Attributes:
        iteration: number of the step.
        loss: perhaps still computed by the device.
        seconds: time of the fit when the step was launched [s].
        warning: tells the noise of the loss in words, or returns "".
    """

    iteration: int
    loss: SupportsFloat | mi.Float
    seconds: float
    warning: Callable[[], str]


def begin_fit(
    problem: Problem,
    optimizer: Optimizer,
    course: Course | int,
    *,
    measure: Measure | None = None,
    checkpoint: CheckpointFile | None = None,
) -> Fit:
    """A fit before the first step, or at its checkpoint; arguments as :func:`reconstruct`.

    Raises:
        MivolError: the optimizer starts no :class:`mivol.optim.optimizer.OptimizerRun`.
    """
    course = course if isinstance(course, Course) else Course(course)
    run = optimizer.begin(problem)
    if not isinstance(run, OptimizerRun):
        raise MivolError(
            f"{type(optimizer).__name__}.begin returned a {type(run).__name__}, expected a mivol.optim.optimizer.OptimizerRun: "
            "derive the run from that class, with reals and a method step."
        )
    return Fit(problem, run, course, measure, checkpoint)


def reconstruct(
    problem: Problem,
    optimizer: Optimizer,
    course: Course | int,
    *,
    measure: Measure | None = None,
    observer: Callable[[Fit], None] = lambda fit: None,
    checkpoint: CheckpointFile | None = None,
) -> Fit:
    """Fit a model to images, photographs or projections.

    Args:
        problem: model, data and parameters; the model holds the start and, afterwards, the result.
        optimizer: of OPTIMIZERS, or an adapter of a Mitsuba optimizer.
        course: iterations, schedule and events, or the number of iterations only.
        measure: error measures by name, for evaluations.
        observer: called after each iteration (progress bars).
        checkpoint: file of the checkpoint, and whether to resume; None writes no checkpoint.

    Raises:
        MivolError: a loss that is not finite, or a checkpoint of another run.
        Interrupted: Ctrl-C or SIGTERM; the checkpoint is written.

    Example:
        >>> problem = SceneProblem(scene, views, [Parameter("medium.sigma_t.data", domain=(0, 50))])
        >>> fit = reconstruct(problem, Adam(), 100)
    """
    return begin_fit(problem, optimizer, course, measure=measure, checkpoint=checkpoint).complete(observer)
