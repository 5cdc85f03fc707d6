"""Runs of a sweep over the workers of a cluster: a whole fit is a piece of work.

Conventions. A worker runs a fit in a folder of its own and returns the files; the owner alone writes into the folder of the
sweep. An interrupted fit returns its checkpoint, which goes to a worker again. A fit of a lost worker begins again, with the
same result. Paths stay as the experiment has them, relative to a copy of its folder in the worker. Public data (``data:NAME``)
are read where the worker runs.
"""

from __future__ import annotations

import shutil
import textwrap
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

from mivol import config
from mivol.cluster.packages import find_experiment_files, map_paths, open_bundle, pack_files, place_below
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.kinds import run_experiment
from mivol.experiments.run_folder import EARLIER, KEPT
from mivol.experiments.sweep import Execute, Sweep, SweepRun, Tell, is_fault_of_disk
from mivol.files.atomic import disk_faults, lock_folder
from mivol.optim.interrupt import Interrupted, InterruptGuard
from mivol.optim.loop import Fit
from mivol.report.page import SweepNews
from mivol.report.record import RECORD

T = TypeVar("T")

SECONDS_BETWEEN_LINES = 1.0
"""Interval between two lines about the progress of all workers."""

LONGEST_LINE = 40
"""Characters of the progress of a run among that of others."""

SECONDS_TO_STOP = 30.0
"""Time for the workers to return their checkpoints after Ctrl-C."""

FINISHED, REFUSED, INTERRUPTED = "finished", "refused", "interrupted"


class WorkerProgress:
    """A :class:`mivol.experiments.fit_kind.Progress` that a worker keeps for the owner, and that stops a fit at its request."""

    def __init__(self, place: Workplace) -> None:
        self.place = place

    def say(self, lines: Sequence[str]) -> None:
        """Keep the last line."""
        self.place.says = textwrap.shorten(lines[-1], LONGEST_LINE, placeholder="...") if lines else self.place.says

    def track(self, items: Sequence[T], label: str) -> Iterator[T]:
        """Yield the items, and keep their number."""
        for number, item in enumerate(items):
            self._note(f"{label} {number} of {len(items)}")
            yield item

    def watch(self, iterations: int) -> AbstractContextManager[Callable[[Fit], None]]:
        """Keep the number of the iteration."""
        return nullcontext(lambda fit: self._note(f"{fit.next_iteration} of {iterations}"))

    def _note(self, line: str) -> None:
        self.place.says = line
        if self.place.is_stopped:
            raise Interrupted


def run_fit(
    place: Workplace, bundle: str, settings: dict[str, Any], base: str, kept: Mapping[str, bytes], command: str
) -> tuple[str, str, dict[str, bytes]]:
    """Run a fit in a worker.

    Args:
        place: the worker.
        bundle: content hash of the experiment's files.
        settings: all settings, as dicts and lists.
        base: folder of the experiment at the owner.
        kept: files of an interrupted run, to continue from.
        command: command line, for the record.

    Returns:
        FINISHED, REFUSED or INTERRUPTED, the reason of a refusal, and the compressed files of the run folder.
    """
    inputs = open_bundle(place, bundle)
    folder = inputs.parent / f"fit-{time.monotonic_ns()}"
    folder.mkdir()
    try:
        for name, content in kept.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(zlib.decompress(content))
        home = place_below(inputs, base)
        home.mkdir(parents=True, exist_ok=True)

        def move(key: str, name: str) -> str:
            return str(place_below(inputs, name)) if Path(name).is_absolute() else name

        moved = map_paths(config.from_dict(settings), move)
        outcome = FINISHED, ""
        try:
            run_experiment(RunContext(moved, home, folder, bool(kept), WorkerProgress(place), command))
        except KeyboardInterrupt:
            outcome = INTERRUPTED, ""
        except MivolError as error:
            if is_fault_of_disk(error):
                raise MivolError(f"in the temporary folder of a worker: {error}") from None
            outcome = REFUSED, str(error)
        return *outcome, read_files(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def read_files(folder: Path) -> dict[str, bytes]:
    """Compressed files below a folder, by relative name; temporaries are left out."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(".part")]
    return {path.relative_to(folder).as_posix(): zlib.compress(path.read_bytes(), 1) for path in files}


def write_run(target: Path, files: Mapping[str, bytes], continues: bool) -> None:
    """Replace a run folder by returned files. Another run that stood there is moved to its ``earlier/``.

    A killed process leaves the old folder or the new one, and a hidden folder beside them.

    Args:
        target: run folder.
        files: compressed contents by relative name.
        continues: whether the files continue the run that stands there.

    Raises:
        MivolError: another run uses the folder, or a disk error.
    """
    coming, going = target.with_name(f".{target.name}.coming"), target.with_name(f".{target.name}.going")
    for stale in (coming, going):
        shutil.rmtree(stale, ignore_errors=True)
    with disk_faults(target, "room for the files of a run", "; the same command runs it again"):
        for name, content in files.items():
            (coming / name).parent.mkdir(parents=True, exist_ok=True)
            (coming / name).write_bytes(zlib.decompress(content))
        if not target.exists():
            coming.rename(target)
            return
        with lock_folder(target):
            if not continues and (target / RECORD).exists():
                (coming / EARLIER).mkdir(exist_ok=True)
                for name in (name for name in KEPT if (target / name).exists()):
                    shutil.copyfile(target / name, coming / EARLIER / name)
            target.rename(going)
            coming.rename(target)
    shutil.rmtree(going, ignore_errors=True)


def run_on(pool: Pool, show: Callable[[str], None] = lambda line: None) -> Execute:
    """The function that runs combinations on workers.

    Args:
        pool: workers.
        show: receives the progress of all workers in a line.
    """

    def execute(sweep: Sweep, runs: Iterator[SweepRun], tell: Tell) -> Iterator[tuple[SweepRun, str]]:
        with InterruptGuard() as stop:
            yield from _SweepOnPool(pool, sweep, show, stop, tell).execute(runs)

    return execute


class _SweepOnPool:
    """A sweep under way."""

    def __init__(self, pool: Pool, sweep: Sweep, show: Callable[[str], None], stop: InterruptGuard, tell: Tell) -> None:
        self.pool, self.sweep, self.show, self.stop, self.tell = pool, sweep, show, stop, tell
        self.shown = self.stopped_at = 0.0
        self.ended = 0

    def execute(self, runs: Iterator[SweepRun]) -> Iterator[tuple[SweepRun, str]]:
        sent: dict[str, tuple[SweepRun, bool]] = {}

        def units() -> Iterator[Unit]:
            for run in runs:
                if self.stopped_at:
                    return
                sent[run.name], unit = self._unit(run)
                yield unit

        for name, (outcome, reason, files) in self.pool.run(units(), ahead=1, check=self._check):
            run, continues = sent[name]
            if outcome != REFUSED:
                write_run(self.sweep.folder / name, files, continues)
            self.ended += 1
            self.tell(self._news({}))
            if outcome != INTERRUPTED:
                yield run, reason
        if self.stopped_at:
            raise Interrupted

    def _unit(self, run: SweepRun) -> tuple[tuple[SweepRun, bool], Unit]:
        """A combination as work; its files are packed when a worker is free for it."""
        context = self.sweep.context(run)
        bundle = pack_files(find_experiment_files(run.settings, self.sweep.base))
        digest = self.pool.share(bundle.digest, {"files": bundle.files}, bundle.size)
        continues = context.resume and not has_absolute_paths(run.settings)
        kept = read_files(context.folder) if continues else {}
        args = (digest, config.list_all_settings(run.settings), str(self.sweep.base.absolute()), kept, self.sweep.command)
        return (run, continues), Unit(run.name, run_fit, args, (digest,))

    def _check(self) -> None:
        """Show the progress, and answer Ctrl-C: workers stop, and their checkpoints are waited for."""
        now = time.monotonic()
        if self.stop.is_requested and not self.stopped_at:
            self.stopped_at = now
            self.pool.stop_work()
        if self.stopped_at and now - self.stopped_at > SECONDS_TO_STOP:
            raise Interrupted
        if now - self.shown > SECONDS_BETWEEN_LINES:
            self.shown = now
            progress = self.pool.collect_progress(0.2)
            lines = [f"{name}: {line}" for name, line in progress.items() if line]
            self.show(", ".join([self.pool.describe(), f"{self.ended} runs ended", *lines]))
            self.tell(self._news(progress))

    def _news(self, progress: dict[str, str]) -> SweepNews:
        under_way = {unit.key: "" for worker in self.pool.workers.values() for unit in worker.units.values()}
        return SweepNews(under_way | progress, tuple(self.pool.describe_losses()), self.pool.tabulate(), is_running=True)


def has_absolute_paths(settings: config.Experiment) -> bool:
    """Whether a path of the settings is absolute: it differs between workers then, and their checkpoints do."""
    given: list[str] = []
    map_paths(settings, lambda key, name: given.append(name) or name)
    return any(Path(name).is_absolute() for name in given)
