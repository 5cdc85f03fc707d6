"""The fit from its first iteration to its last: steps, events, history, and a clean stop at any moment.

Conventions. What happens in iteration i is a function of the problem, the optimiser's state and i alone; the state is
saved before an iteration or, on Ctrl-C and SIGTERM, as it was before the iteration that was cut short. A resumed run
therefore equals an uninterrupted one: bit for bit with one Dr.Jit thread, to about 1e-5 with several, whose float sums
have no fixed order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi

from mivol.errors import MivolError
from mivol.optim import checkpoint
from mivol.optim.events import Event, in_order
from mivol.optim.interrupt import Stop
from mivol.optim.optimisers import Optimiser, Run
from mivol.optim.problem import Problem
from mivol.optim.schedules import Constant, Schedule
from mivol.threads import check_one_thread

KEPT = ("next", "events_done", "history", "measures", "log", "warned", "seconds")
"""What a checkpoint keeps of a fit beside the run and its fingerprint."""


@dataclass
class Fit:
    """A fit at work, or done.

    Attributes:
        problem: what is minimised.
        run: the optimiser at work, with the reals.
        next: the next iteration.
        events_done: how many of its events have been applied.
        history: one record (iteration, loss, seconds) per iteration.
        measures: one record (iteration, seconds, ...) per evaluation.
        log: what the events said, and what the noise of renders does to the loss, once.
        warned: whether it has been said.
        seconds: time spent, interruptions not counted.
        measure: what ``evaluate`` calls: errors by name.
        path: the checkpoint.
        fingerprint: what the run depends on.
    """

    problem: Problem
    run: Run
    next: int = 0
    events_done: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    measures: list[dict[str, float]] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    warned: bool = False
    seconds: float = 0.0
    measure: Callable[[Problem], dict[str, float]] | None = None
    path: Path | None = None
    fingerprint: dict[str, Any] = field(default_factory=dict)

    def values(self) -> dict[str, mi.TensorXf]:
        """What was found, by parameter; the scene holds it too."""
        self.problem.set(self.run.reals)
        return self.problem.values()

    def evaluate(self) -> None:
        """Measure now, and remember."""
        if self.measure is None:
            return
        self.problem.set(self.run.reals)
        self.measures.append({"iteration": self.next, "seconds": self.seconds, **self.measure(self.problem)})

    def newest_errors(self) -> dict[str, float]:
        """What was measured last, without when; none before the first evaluation."""
        newest = self.measures[-1] if self.measures else {}
        return {name: value for name, value in newest.items() if name not in ("iteration", "seconds")}

    def save(self) -> None:
        """Write the checkpoint, where there is a place for one."""
        if self.path is None:
            return
        checkpoint.write(self.path, self.run.pack(), {name: getattr(self, name) for name in (*KEPT, "fingerprint")})

    def restore(self) -> None:
        """Continue from the checkpoint.

        Raises:
            MivolError: there is none, or it is of another run.
        """
        arrays, about = checkpoint.read(self.path, self.fingerprint)
        self.run.unpack(arrays)
        for name in KEPT:
            setattr(self, name, about[name])


def reconstruct(
    problem: Problem,
    optimiser: Optimiser,
    iterations: int,
    *,
    schedule: Schedule | None = None,
    events: Sequence[Event] = (),
    measure: Callable[[Problem], dict[str, float]] | None = None,
    observer: Callable[[Fit], None] = lambda fit: None,
    path: Path | None = None,
    fingerprint: dict[str, Any] | None = None,
    resume: bool = False,
) -> Fit:
    """Fit a scene to its views.

    Args:
        problem: scene, views, parameters, loss; the scene holds the start and, afterwards, the result.
        optimiser: one of OPTIMISERS.
        iterations: at most so many.
        schedule: factor on the learning rate; constant by default.
        events: what happens between iterations.
        measure: errors by name, for ``evaluate``.
        observer: called after each iteration (progress bars).
        path: checkpoint file; None writes none.
        fingerprint: what the result depends on, by name, JSON values.
        resume: continue from ``path``.

    Raises:
        MivolError: a loss that is not finite, or a checkpoint of another run.
        Interrupted: Ctrl-C or SIGTERM; the checkpoint has been written.

    Example:
        >>> fit = reconstruct(Problem(scene, views, [Parameter("medium.sigma_t.data", domain=(0, 50))]), Adam(), 100)
    """
    check_one_thread()
    fit = Fit(problem, optimiser.begin(problem), measure=measure, path=path, fingerprint=fingerprint or {})
    if resume:
        fit.restore()
    with Stop() as stop:
        problem.safe_point = stop.check
        try:
            while fit.next < iterations and not fit.run.finished:
                _iterate(fit, iterations, schedule or Constant(), in_order(tuple(events)))
                observer(fit)
                stop.check()
            if measure is not None:
                fit.evaluate()
        except KeyboardInterrupt:
            fit.save()
            raise
        finally:
            problem.safe_point = lambda: None
    fit.problem.set(fit.run.reals)
    return fit


def _iterate(fit: Fit, iterations: int, schedule: Schedule, events: list[Event]) -> None:
    """The events of an iteration, then its step; nothing counts as done before it is."""
    for number, event in enumerate(events):
        if number >= fit.events_done and event.due(fit.next):
            said = event.apply(fit)
            fit.log += [f"iteration {fit.next}: {said}"] if said else []
            fit.events_done = number + 1
    started = time.perf_counter()
    loss = fit.run.step(fit.next, schedule.factor(fit.next, iterations))
    if not math.isfinite(loss):
        raise MivolError(f"the loss became {loss} in iteration {fit.next}: lower the learning rate, or bound the parameters.")
    fit.seconds += time.perf_counter() - started
    _warn(fit)
    fit.history.append({"iteration": fit.next, "loss": loss, "seconds": fit.seconds})
    fit.next, fit.events_done = fit.next + 1, 0


def _warn(fit: Fit) -> None:
    """Say once how much of the loss is the noise of renders, as soon as that is notable."""
    said = "" if fit.warned else fit.problem.warning()
    if said:
        fit.log.append(f"iteration {fit.next}: {said}")
        fit.warned = True
