"""The fit from its first iteration to its last: steps, events, history, and a clean stop at any moment.

Conventions. What happens in iteration i is a function of the problem, the optimizer's state and i alone; the state is
saved before an iteration or, on Ctrl-C and SIGTERM, as it was before the iteration that was cut short. A resumed run
therefore equals an uninterrupted one: bit for bit with one Dr.Jit thread, to about 1e-5 with several, whose float sums
have no fixed order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi

from mivol.errors import MivolError
from mivol.files.notebook import pairs_html
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Event, checkpoints_first
from mivol.optim.interrupt import InterruptGuard
from mivol.optim.optimizer import Optimizer, OptimizerRun
from mivol.optim.problem import Problem
from mivol.optim.schedules import Constant, Schedule
from mivol.shown import curve_html
from mivol.threads import check_one_thread

SAVED_FIELDS = ("next_iteration", "events_done", "history", "evaluations", "log", "has_warned", "seconds")
"""What a checkpoint keeps of a fit beside the run and the problem."""

Measure = Callable[[Problem], dict[str, float]]
"""Errors by name, of what a problem holds."""


@dataclass(frozen=True)
class Course:
    """What a fit goes through.

    Attributes:
        iterations: at most so many.
        schedule: factor on the learning rates.
        events: what happens between iterations.
    """

    iterations: int
    schedule: Schedule = field(default_factory=Constant)
    events: tuple[Event, ...] = ()


@dataclass(repr=False)
class Fit:
    """A fit at work, or done.

    Attributes:
        problem: what is minimised.
        run: the optimizer at work, with the reals.
        course: what the fit goes through.
        measure: what ``evaluate`` calls; None measures nothing.
        checkpoint: where the checkpoint lies; None keeps none.
        next_iteration: the next iteration.
        events_done: how many of its events have been applied.
        history: one record (iteration, loss, seconds) per iteration.
        evaluations: one record (iteration, seconds, ...) per evaluation.
        log: what the events said, and what the noise of renders does to the loss, once.
        has_warned: whether it has been said.
        seconds: time spent, interruptions not counted.
    """

    problem: Problem
    run: OptimizerRun
    course: Course
    measure: Measure | None = None
    checkpoint: CheckpointFile | None = None
    next_iteration: int = 0
    events_done: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    evaluations: list[dict[str, float]] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    has_warned: bool = False
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self._events = checkpoints_first(self.course.events)
        if self.checkpoint is not None and self.checkpoint.resume:
            self.restore()

    def __repr__(self) -> str:
        newest = {**({"loss": self.history[-1]["loss"]} if self.history else {}), **self.latest_errors()}
        figures = "".join(f", {name} {value:.4g}" for name, value in newest.items())
        return f"Fit({self.next_iteration} of {self.course.iterations} iterations in {self.seconds:.1f} s{figures})"

    def _repr_html_(self) -> str:
        """For notebooks: the loss against the iteration and, where the problem can show them, views of what was found."""
        pictures = getattr(self.problem, "pictures", None)
        shown = ""
        if pictures is not None:
            self.problem.set_reals(self.run.reals)
            shown = pairs_html(pictures())
        return curve_html([row["loss"] for row in self.history], repr(self)) + shown

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to do."""
        return self.next_iteration >= self.course.iterations or bool(self.run.stop_reason)

    def values(self) -> dict[str, mi.TensorXf]:
        """What was found, by parameter; the problem's model holds it too."""
        self.problem.set_reals(self.run.reals)
        return self.problem.values()

    def evaluate(self) -> None:
        """Measure now, and remember."""
        if self.measure is None:
            return
        self.problem.set_reals(self.run.reals)
        self.evaluations.append({"iteration": self.next_iteration, "seconds": self.seconds, **self.measure(self.problem)})

    def latest_errors(self) -> dict[str, float]:
        """What was measured last, without when; none before the first evaluation."""
        newest = self.evaluations[-1] if self.evaluations else {}
        return {name: value for name, value in newest.items() if name not in ("iteration", "seconds")}

    # -- Steps --------------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """The events of the next iteration, then its step; nothing counts as done before it is.

        Raises:
            MivolError: the loss is not finite.
        """
        for number, event in enumerate(self._events):
            if number >= self.events_done and event.due(self.next_iteration):
                self._apply(event)
                self.events_done = number + 1
        started = time.perf_counter()
        loss = self.run.step(self.next_iteration, self.course.schedule.factor(self.next_iteration, self.course.iterations))
        if loss is None:
            return
        loss = _number(loss)
        if not math.isfinite(loss):
            raise MivolError(
                f"the loss became {loss} in iteration {self.next_iteration}: lower the learning rate, or bound the parameters."
            )
        self.seconds += time.perf_counter() - started
        self._warn()
        self.history.append({"iteration": self.next_iteration, "loss": loss, "seconds": self.seconds})
        self.next_iteration, self.events_done = self.next_iteration + 1, 0

    def complete(self, observer: Callable[[Fit], None] = lambda fit: None) -> Fit:
        """Take all steps that are left; what was found is in the problem's model and, where there is one, in the store.

        Raises:
            MivolError: as :meth:`advance`.
            Interrupted: Ctrl-C or SIGTERM; the checkpoint has been written.
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
            except KeyboardInterrupt:
                self.save()
                raise
            finally:
                self.problem.safe_point = lambda: None
        self.problem.set_reals(self.run.reals)
        self.save()
        return self

    def _apply(self, event: Event) -> None:
        says = event.apply(self)
        self.log += [f"iteration {self.next_iteration}: {says}"] if says else []

    def _warn(self) -> None:
        """Say once how much of the loss is the noise of renders, as soon as that is notable."""
        says = "" if self.has_warned else self.problem.warning()
        if says:
            self.log.append(f"iteration {self.next_iteration}: {says}")
            self.has_warned = True

    # -- On disk ------------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the checkpoint, where there is a place for one."""
        if self.checkpoint is None:
            return
        problem = {f"problem/{name}": array for name, array in self.problem.pack(self.run.reals).items()}
        about = {name: getattr(self, name) for name in SAVED_FIELDS}
        self.checkpoint.write(self.run.pack() | problem, {**about, "iterations": self.course.iterations})

    def restore(self) -> None:
        """Continue from the checkpoint.

        Raises:
            MivolError: there is none, or it is of another run.
        """
        arrays, about = self.checkpoint.read()
        self.run.unpack(arrays)
        problem = {name.removeprefix("problem/"): arrays[name] for name in arrays if name.startswith("problem/")}
        self.problem.unpack(problem, self.run.reals)
        for name in SAVED_FIELDS:
            setattr(self, name, about[name])
        planned, now = about["iterations"], self.course.iterations
        if planned < now and not isinstance(self.course.schedule, Constant):
            self.log.append(
                f"iteration {self.next_iteration}: the schedule was planned for {planned} iterations and continues for {now}; "
                f"one uninterrupted run of {now} iterations gives another result"
            )


def _number(loss: float | mi.Float) -> float:
    """A loss that may still be on its way through Dr.Jit's queue."""
    return float(loss[0]) if isinstance(loss, mi.Float) else float(loss)


def begin_fit(
    problem: Problem,
    optimizer: Optimizer,
    course: Course | int,
    *,
    measure: Measure | None = None,
    checkpoint: CheckpointFile | None = None,
) -> Fit:
    """A fit before its first step, or where its checkpoint has it; arguments as :func:`reconstruct`.

    Raises:
        MivolError: an optimizer that begins no :class:`mivol.optim.optimizer.OptimizerRun`.
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
    """Fit a model to what was seen.

    Args:
        problem: model, data and parameters; the model holds the start and, afterwards, the result.
        optimizer: one of OPTIMISERS.
        course: iterations, schedule and events, or the number of iterations only.
        measure: errors by name, for ``evaluate``.
        observer: called after each iteration (progress bars).
        checkpoint: file, and whether to continue from it; None keeps none.

    Raises:
        MivolError: a loss that is not finite, or a checkpoint of another run.
        Interrupted: Ctrl-C or SIGTERM; the checkpoint has been written.

    Example:
        >>> problem = SceneProblem(scene, views, [Parameter("medium.sigma_t.data", domain=(0, 50))])
        >>> fit = reconstruct(problem, Adam(), 100)
    """
    return begin_fit(problem, optimizer, course, measure=measure, checkpoint=checkpoint).complete(observer)
