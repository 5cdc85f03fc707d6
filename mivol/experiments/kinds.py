"""Kinds of experiments: run an experiment, or explain an experiment.

Conventions. ``explain`` begins a fit up to the first step. After that, only the disk and the run folder can refuse the fit.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from mivol import config
from mivol.back_end import choose_back_end
from mivol.errors import MivolError
from mivol.experiments.field_fit import FieldFit
from mivol.experiments.fit_kind import Distribution, FitKind, RunContext
from mivol.experiments.gaussian_fit import GaussianFit
from mivol.experiments.octree_fit import OctreeFit
from mivol.experiments.photo_fit import PhotoFit
from mivol.experiments.run_folder import SECONDS_BETWEEN_PAGES, BestIterate, RunFolder, find_checkpoint
from mivol.experiments.sampled_fit import SampledFit
from mivol.experiments.scan_fit import ScanFit
from mivol.experiments.scene_fit import SceneFit
from mivol.experiments.slab_scan import explain_slabs, run_slabs
from mivol.optim import checkpoint
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.problem import Problem
from mivol.report.page import write_page
from mivol.report.record import write_record
from mivol.scene.explain import Explanation

KINDS: dict[type, type[FitKind]] = {
    config.SceneExperiment: SceneFit,
    config.ScanExperiment: ScanFit,
    config.FieldExperiment: FieldFit,
    config.HashExperiment: SampledFit,
    config.NerfExperiment: SampledFit,
    config.OctreeExperiment: OctreeFit,
    config.GaussianExperiment: GaussianFit,
}
"""Kind of an experiment by the type of the settings."""


def run_experiment(context: RunContext) -> Path:
    """Run an experiment, and write the run folder.

    The settings of a checkpoint are compared before a resumed run changes the folder.

    Returns:
        The report page.

    Raises:
        MivolError: invalid settings, data or checkpoint, or a disk error.
        KeyboardInterrupt: Ctrl-C; finished work is kept, and ``context.resume`` continues.
    """
    settings = context.settings
    if getattr(settings, "slabs", None) is not None:
        return run_slabs(context)
    if context.resume:
        checkpoint.check_settings(find_checkpoint(context.folder), config.flatten_settings(config.list_all_settings(settings)))
    choose_back_end(settings.variant, settings.threads)
    kind = KINDS[type(settings)](context)
    kind.record.notes += context.notes
    run = RunFolder(context.folder, kind.record, context.resume)
    with LivePage(kind, run, context.distribution) as page, run.at_work():
        with run.stage(kind.stages.load):
            kind.load(lambda line: None)
            context.progress.say(kind.announcement())
        kind.render_data(run)
        with run.stage(kind.stages.fit):
            workers = context.distribution
            kind.problem = kind.make_problem() if workers is None else workers.make_problem(kind)
            best = BestIterate(run, kind.best_files())
            kind.prepare(run)
            fit = complete_fit(kind, run, best, page.show)
            run.record.notes += best.says() + ([] if workers is None else workers.notes())
        with run.stage(kind.stages.write):
            kind.write_outputs(fit, run, best)
            run.record.tables += [] if workers is None else workers.tables()
            run.remove_newest()
    written = write_page(context.folder)
    context.progress.say([*best.says(), run.summary()])
    return written


MOST_SHARE_OF_PAGES, FIRST_PAGE = 0.02, 1.0
"""Largest share of the time of a fit that its pages take while it runs, and the time that the first page is expected to take
[s]."""


class LivePage:
    """The page of a fit while it runs: curves so far, progress, pictures of the kind, and a table of the workers. Without a
    cluster, only long fits of kinds with ``has_live_page`` have one; other pages are written at the end."""

    def __init__(self, kind: FitKind, run: RunFolder, workers: Distribution | None) -> None:
        self.kind, self.run, self.workers = kind, run, workers
        self.has_page, self.due = False, time.monotonic() + (SECONDS_BETWEEN_PAGES if workers is None else 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, fault: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """The page of a stopped run says so, and a browser does not read it again."""
        if fault is not None and self.has_page:
            with suppress(MivolError, OSError):
                write_page(self.run.path)

    def show(self, fit: Fit, iterations: int) -> None:
        """Write record and page, if they are due."""
        start = time.monotonic()
        if start < self.due or not self._is_worth_a_page(fit, iterations):
            return
        record, workers = self.run.record, self.workers
        said = f"{fit.next_iteration} of {iterations} iterations" + (f", {workers.describe()}" if workers else "")
        shown = msgspec.structs.replace(
            record,
            timings=record.timings | {self.kind.stages.fit: fit.seconds},
            notes=[said, *record.notes],
            tables=[*record.tables, *(workers.tables() if workers else ())],
            images=[*record.images, *self.kind.live_images(self.run)],
        )
        write_record(shown, self.run.path)
        write_page(self.run.path)
        self.has_page, end = True, time.monotonic()
        self.due = end + max(SECONDS_BETWEEN_PAGES, (end - start) / MOST_SHARE_OF_PAGES)

    def _is_worth_a_page(self, fit: Fit, iterations: int) -> bool:
        """Whether the fit has a page while it runs; a short fit without a cluster ends before a page would help."""
        if self.workers is not None or self.has_page:
            return True
        expected = fit.seconds * iterations / max(fit.next_iteration, 1)
        return self.kind.has_live_page and MOST_SHARE_OF_PAGES * expected >= FIRST_PAGE


def complete_fit(
    kind: FitKind, run: RunFolder, best: BestIterate, tell: Callable[[Fit, int], None] = lambda fit, iterations: None
) -> Fit:
    """Take all steps of a fit, with metrics and checkpoints, and keep the best iterate.

    Args:
        kind: the fit, with its problem.
        run: its folder.
        best: keeps the best iterate.
        tell: called after each step, with the number of iterations.

    Raises:
        MivolError: a checkpoint of another run, settings refused by the optimizer, or an infinite or NaN loss.
        KeyboardInterrupt: Ctrl-C; the checkpoint has been written.
    """
    course, context = kind.course(), kind.context
    goes_on = context.resume and run.checkpoint == find_checkpoint(run.path)
    store = CheckpointFile(run.checkpoint, kind.digests() | config.flatten_settings(run.record.config), goes_on)

    def measure(problem: Problem) -> dict[str, float]:
        errors = kind.measure(problem)
        best.see(fit.next_iteration, errors, problem.values())
        return errors

    def observe(fit: Fit) -> None:
        kind.after_step(fit, run, best)
        show(fit)
        tell(fit, course.iterations)

    is_measured = kind.measure is not None
    fit = begin_fit(kind.problem, kind.optimizer(), course, measure=measure if is_measured else None, checkpoint=store)
    best.restore()
    run.begin(fit.next_iteration + kind.first_row - 1)
    kind.begin(run)
    with context.progress.watch(course.iterations) as show:
        fit.complete(observe)
    best.settle()
    kind.finish(fit, run)
    return fit


def explain_experiment(settings: config.Experiment, base: Path, picture: Path | None = None) -> Explanation:
    """Describe the steps of an experiment, and make the same checks as a run.

    Args:
        settings: all settings.
        base: folder from which relative paths in the settings start.
        picture: image file (.png, .svg) for the cameras of photographs and the boxes; may be None.

    Returns:
        Facts about the experiment, and the reason of a refusal.
    """
    lines = [f"experiment  {settings.title}"]
    kind = KINDS[type(settings)]
    try:
        if picture is not None and not issubclass(kind, PhotoFit):
            raise MivolError(f"--output {picture}: only cameras of photographs are drawn, so leave out --output.")
        choose_back_end(settings.variant, settings.threads)
        if getattr(settings, "slabs", None) is not None:
            rest = explain_slabs(settings, base, lines.append)
            return Explanation((*lines, *rest.lines))
        fit = kind(RunContext(settings, base, Path()))
        fit.load(lines.append)
        rest = fit.rehearse(lines.append)
        if isinstance(fit, PhotoFit) and picture is not None:
            fit.draw_cameras(picture)
            lines.append(str(picture))
    except MivolError as error:
        return Explanation(tuple(lines), str(error))
    return Explanation((*lines, *rest.lines), rest.refusal)
