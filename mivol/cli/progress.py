"""Progress of a run on the terminal: messages, bars, loss, errors and remaining time.

Conventions. The run's own thread draws between iterations. If the error output is no terminal, each evaluation prints one line.
Log messages of a fit (a refined grid, noise in the loss) are printed at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mivol.optim.loop import Fit
from mivol.report.record import QUANTITIES, Quantity, join_channels

T = TypeVar("T")


class TerminalProgress:
    """A :class:`mivol.experiments.fit_kind.Progress` on the error output.

    Attributes:
        note: clause behind the errors of a fit, as the workers of a cluster.
    """

    note: Callable[[], str] = staticmethod(lambda: "")

    def say(self, lines: Sequence[str]) -> None:
        """Print lines."""
        console = Console(stderr=True)
        for line in lines:
            console.print(line, soft_wrap=True, highlight=False, markup=False)

    def track(self, items: Sequence[T], label: str) -> Iterator[T]:
        """Yield the items with a progress bar; without a terminal, print a line at the end."""
        console, start = Console(stderr=True), time.monotonic()
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=console, auto_refresh=False, disable=not console.is_terminal) as bar:
            task = bar.add_task(label, total=len(items))
            for item in items:
                bar.refresh()
                yield item
                bar.advance(task)
            bar.refresh()
        if not console.is_terminal:
            console.print(f"{label}: {len(items)} in {time.monotonic() - start:.1f} s", soft_wrap=True)

    def watch(self, iterations: int) -> Display:
        """Return a progress bar of the iterations, with the newest loss and errors."""
        return Display(iterations, self.note)


def figures(fit: Fit, note: str = "") -> str:
    """Describe the newest loss and errors, and add a note."""
    known = [(value, QUANTITIES.get(name, Quantity(name))) for name, value in fit.latest_errors().items()]
    errors = join_channels((f"{value:.4g}", quantity.unit, quantity.label) for value, quantity in known)
    words = [f"{label} {numbers} {unit}".rstrip() for numbers, unit, label in errors]
    return ", ".join([f"loss {fit.history[-1]['loss']:.4g}", *words, *filter(None, [note])])


class Display:
    """Context manager to call after each iteration."""

    def __init__(self, iterations: int, note: Callable[[], str] = lambda: "") -> None:
        self.note = note
        self.console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        self.bar = Progress(*columns, console=self.console, auto_refresh=False, disable=not self.console.is_terminal)
        self.iterations = iterations
        self.printed = 0
        self.logged = 0
        self.drawn = 0.0
        self.newest: Fit | None = None

    def __enter__(self) -> Display:
        self.bar.start()
        self.task = self.bar.add_task("fit", total=self.iterations)
        return self

    def __exit__(self, *exception: object) -> None:
        if self.newest is not None:  # measured once more since the last call
            self.bar.update(self.task, completed=self.newest.next_iteration, description=figures(self.newest, self.note()))
        self.bar.refresh()
        self.bar.stop()
        if self.newest is not None and not self.console.is_terminal:
            fit = self.newest
            self.console.print(
                f"{fit.next_iteration} iterations in {fit.seconds:.1f} s: {figures(fit, self.note())}", soft_wrap=True
            )

    def __call__(self, fit: Fit) -> None:
        """Draw at most ten times a second; print new log messages above the bar."""
        self.newest = fit
        for line in fit.log[self.logged :]:
            self.console.print(line, soft_wrap=True, highlight=False, markup=False)
        self.logged = len(fit.log)
        # Figures wait for the newest loss: read only to be shown.
        if self.console.is_terminal:
            if time.monotonic() - self.drawn > 0.1:
                self.bar.update(self.task, completed=fit.next_iteration, description=figures(fit, self.note()))
                self.bar.refresh()
                self.drawn = time.monotonic()
        elif len(fit.evaluations) > self.printed:
            self.console.print(
                f"iteration {fit.next_iteration} of {self.iterations}: {figures(fit, self.note())}", soft_wrap=True
            )
            self.printed = len(fit.evaluations)
