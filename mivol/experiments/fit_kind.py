"""Interface of a kind of fit. A common skeleton runs and explains all kinds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

from mivol import config
from mivol.experiments.run_folder import BestFiles, BestIterate, RunFolder
from mivol.optim.loop import Course, Fit, Measure
from mivol.optim.optimizer import Optimizer
from mivol.optim.problem import Problem
from mivol.report.record import Image, RunRecord, Table
from mivol.scene.explain import Explanation
from mivol.validate.reference import Complete

T = TypeVar("T")

Say = Callable[[str], None]
"""Receives a line of facts."""


class Progress(Protocol):
    """Shows how a run proceeds: on a terminal, in a notebook, or nowhere."""

    def say(self, lines: Sequence[str]) -> None:
        """Show sentences about the run."""

    def track(self, items: Sequence[T], label: str) -> Iterator[T]:
        """Yield the items, and show the number of finished items."""

    def watch(self, iterations: int) -> AbstractContextManager[Callable[[Fit], None]]:
        """Return the function to call after each iteration of a fit with at most ``iterations``."""


class NullProgress:
    """Progress without a display."""

    def say(self, lines: Sequence[str]) -> None:
        """Show nothing."""

    def track(self, items: Sequence[T], label: str) -> Iterator[T]:
        """Yield the items."""
        return iter(items)

    def watch(self, iterations: int) -> AbstractContextManager[Callable[[Fit], None]]:
        """Return a function without effect."""
        return nullcontext(lambda fit: None)


class Distribution(Protocol):
    """Computes parts of a run on the workers of a cluster."""

    def make_problem(self, kind: FitKind) -> Problem:
        """Return the problem of a fit whose steps are computed by workers."""

    def complete_references(self, kind: FitKind) -> Complete:
        """Return the function that renders the references of a fit."""

    def describe(self) -> str:
        """Return the workers and their speed in a line."""

    def notes(self) -> list[str]:
        """Return sentences about the workers, for the record, at the end of the fit."""

    def tables(self) -> list[Table]:
        """Return tables about the workers, for the record, at the end of the run."""


@dataclass(frozen=True)
class RunContext:
    """An experiment to run, with folders and display.

    Attributes:
        settings: all settings of the experiment.
        base: folder from which relative paths in the settings start.
        folder: run folder; created if missing.
        resume: whether to continue from the folder's checkpoint.
        progress: display of the run's progress.
        command: command line, for the record; empty for a run from Python.
        notes: how the settings came about, for the report.
        distribution: computes parts of the run on workers; None: everything in this process.
    """

    settings: config.Experiment
    base: Path
    folder: Path
    resume: bool = False
    progress: Progress = field(default_factory=NullProgress)
    command: str = ""
    notes: tuple[str, ...] = ()
    distribution: Distribution | None = None


class Stages(NamedTuple):
    """Names of the timed stages of a run, as listed in the record."""

    load: str
    fit: str
    write: str


class Evaluation(NamedTuple):
    """Errors of the newest iterate by name, and the arrays for ``best.npz``; None if files hold the iterate."""

    errors: dict[str, float]
    values: dict[str, Any] | None = None


class FitKind(ABC):
    """An experiment of a kind, from the settings to the contents of the run folder.

    :func:`mivol.experiments.kinds.run_experiment` and :func:`~mivol.experiments.kinds.explain_experiment` call the methods in
    the order in which they stand here. A new kind is a subclass and an entry of :data:`mivol.experiments.kinds.KINDS`.

    Attributes:
        stages: names of the timed stages.
        first_row: number of the first row in ``metrics.jsonl``: 1 if a row counts the steps taken, 0 if a row has the index of
            the step.
        has_live_page: whether the report page is also written while the fit runs, without a cluster.
        context: the experiment to run.
        settings: settings of the experiment; ``load`` puts values in place of "auto".
        record: content of ``run.json``; the recorded settings stay as given.
        problem: the fitted model and the data; set after ``make_problem``.
        measure: errors of the model at the ``evaluate`` events of the course; None means the method ``evaluate``.

    Raises:
        MivolError: settings that are invalid for all data.
    """

    stages: ClassVar[Stages]
    first_row: ClassVar[int] = 1
    has_live_page: ClassVar[bool] = False
    problem: Problem
    measure: Measure | None = None

    def __init__(self, context: RunContext) -> None:
        self.context = context
        self.settings: Any = context.settings
        about = self.describe_run()
        self.record = RunRecord.new(
            self.settings.title, config=config.list_all_settings(self.settings), command=context.command, **about
        )

    @abstractmethod
    def describe_run(self) -> dict[str, Any]:
        """Return method, seeds, citations and units for the record: keywords of :meth:`RunRecord.new`."""

    @abstractmethod
    def load(self, say: Say) -> None:
        """Load the data and plan the fit; put plan and notes on record.

        Args:
            say: receives the facts printed by ``mivol explain``.

        Raises:
            MivolError: unreadable data, or data without a fit.
        """

    # -- Run -------------------------------------------------------------------------------------------------------

    def announcement(self) -> list[str]:
        """Return the lines to show before the fit."""
        return []

    def render_data(self, run: RunFolder) -> None:  # noqa: B027  (most kinds have none)
        """Compute data too costly for ``mivol explain``."""

    @abstractmethod
    def make_problem(self) -> Problem:
        """Return the problem before the first step."""

    def best_files(self) -> BestFiles | None:
        """Return the files of the best iterate; None if ``best.npz`` holds the whole iterate."""
        return None

    def prepare(self, run: RunFolder) -> None:  # noqa: B027
        """Improve the start of the problem; put the rest of the plan on record."""

    @abstractmethod
    def optimizer(self) -> Optimizer:
        """Return the optimizer of the problem.

        Raises:
            MivolError: settings in conflict with the data.
        """

    @abstractmethod
    def course(self) -> Course:
        """Return iterations, schedule and events of the fit."""

    @abstractmethod
    def digests(self) -> dict[str, str]:
        """Return hashes of the data. A resumed run must have the same hashes."""

    def live_images(self, run: RunFolder) -> list[Image]:
        """Pictures of the page while the fit runs, beside those on record; their files are written."""
        return []

    def begin(self, run: RunFolder) -> None:  # noqa: B027
        """Write what a viewer shows before the first model, once the folder belongs to the run."""

    def evaluate(self, fit: Fit) -> Evaluation | None:
        """Evaluate the newest iterate; None if no evaluation is due."""
        return None

    def after_step(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        """If an evaluation is due, add a row to the metrics and keep the best iterate."""
        evaluation = self.evaluate(fit)
        if evaluation is not None:
            best.see(fit.next_iteration, *evaluation)
            run.append(fit.next_iteration, fit.seconds, loss=fit.history[-1]["loss"], **evaluation.errors)
            self.show(run, fit, evaluation)

    def show(self, run: RunFolder, fit: Fit, evaluation: Evaluation) -> None:  # noqa: B027
        """Write a preview of the newest iterate into the run folder."""

    @abstractmethod
    def finish(self, fit: Fit, run: RunFolder) -> None:
        """Put notes and results of the fit on record."""

    @abstractmethod
    def write_outputs(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        """Write images, volumes and curves, and record the files and the results."""

    # -- Explain ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def rehearse(self, say: Say) -> Explanation:
        """Begin the fit up to the first step, and write nothing; return the remaining facts.

        Raises:
            MivolError: settings or data refused by the first step.
        """
