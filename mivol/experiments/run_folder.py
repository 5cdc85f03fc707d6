"""A run's folder while the run is at work: its record is kept true, and no other run writes into it.

Conventions. A run folder holds ``run.json``, ``metrics.jsonl``, ``checkpoint.npz``, ``report.html``, and in folders of their
own what came of the run: ``views/``, ``volumes/``, ``curves/``, and ``references/`` or ``film/``; a scan's
has a ``preview.png`` while it goes on. Every file is written whole.
What an earlier run recorded stays as it is until another one takes its first step; then it moves to ``earlier/``.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mivol.errors import MivolError
from mivol.files.atomic import disk_faults, lock_folder, remove_temporaries
from mivol.report import figures
from mivol.report.record import (
    METRICS,
    RECORD,
    RunRecord,
    append_metrics,
    find_quantity,
    read_metrics,
    read_record,
    rewind_metrics,
    write_record,
)

CHECKPOINT = "checkpoint.npz"
BEST = "best.npz"
EARLIER = "earlier"
KEPT = (RECORD, METRICS, CHECKPOINT, BEST, "report.html")
"""What is kept of an earlier run in the same folder, in ``earlier/``."""


class RunFolder:
    """A folder, made where it is not there, and the record of the run at work in it.

    Attributes:
        path: of the folder.
        record: what ``run.json`` will say.
        is_resumed: whether the run goes on from the folder's checkpoint.
    """

    def __init__(self, path: Path, record: RunRecord, is_resumed: bool = False) -> None:
        self.path, self.record, self.is_resumed = path, record, is_resumed
        self._has_begun = False
        path.mkdir(parents=True, exist_ok=True)

    @property
    def checkpoint(self) -> Path:
        """Where the run's checkpoint lies."""
        return self.path / CHECKPOINT

    @property
    def best(self) -> Path:
        """Where the run's best iterate lies."""
        return self.path / BEST

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Keep ``run.json`` true: "running" at first, "finished" or "stopped" in the end, with what stopped it.

        The record of an earlier run is left alone by a run that is refused before it begins.

        Raises:
            MivolError: another run is at work in the folder.
        """
        with lock_folder(self.path):
            remove_temporaries(self.path)
            if not self._holds_a_run():
                self._write()
            try:
                yield
            except BaseException as error:
                self.record.status = "stopped"
                self.record.notes += [f"stopped by: {error}"] if str(error) else []
                if self._has_begun:
                    with suppress(MivolError, OSError):
                        self._write()
                raise
            self.record.status = "finished"
            self._write()

    def begin(self, iteration: int) -> None:
        """From here on the folder is this run's: before its first step, when nothing can be refused any more.

        Args:
            iteration: the last one that a resumed run keeps the metrics of; a new run keeps none.
        """
        if self.is_resumed:
            rewind_metrics(self.path, iteration)
        else:
            self._put_away()
        self._write()

    def _holds_a_run(self) -> bool:
        """Whether an earlier run has taken a step or has finished here, or was being put away when a process was killed."""
        there = {name for name in KEPT if (self.path / name).exists()}
        if there != {RECORD}:
            return bool(there)
        with suppress(MivolError):
            return read_record(self.path).status == "finished"
        return False

    def _put_away(self) -> None:
        """Move what an earlier run recorded to ``earlier/``, so that the two are never mixed and neither is lost.

        The run is in the folder or in ``earlier/`` as a whole whenever the process is killed: it is there twice (hard links,
        where the file system knows them) before it goes here, its record first. Files without a record were put away before.
        """
        if self._has_begun:
            return
        coming, going = self.path / f".{EARLIER}.coming", self.path / f".{EARLIER}.going"
        for stale in (coming, going):
            shutil.rmtree(stale, ignore_errors=True)
        there = [name for name in KEPT if (self.path / name).exists()]
        if RECORD in there:
            self._copy_to_earlier(there, coming, going)
        for name in there:
            (self.path / name).unlink()

    def _copy_to_earlier(self, names: list[str], coming: Path, going: Path) -> None:
        """Make ``earlier/`` of these files in one rename, by way of two folders that are not there before or afterwards."""
        coming.mkdir()
        for name in names:
            try:
                os.link(self.path / name, coming / name)
            except OSError:
                shutil.copyfile(self.path / name, coming / name)
        if (self.path / EARLIER).exists():
            (self.path / EARLIER).rename(going)
        coming.rename(self.path / EARLIER)
        shutil.rmtree(going, ignore_errors=True)

    def _write(self) -> None:
        write_record(self.record, self.path)
        self._has_begun = True

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a part of the run."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.record.timings[name] = time.perf_counter() - start

    def make(self, *names: str) -> None:
        """Make folders in it.

        Raises:
            MivolError: what the system refuses (disk full, quota, permission ...).
        """
        for name in names:
            with disk_faults(self.path / name, "room for a folder"):
                (self.path / name).mkdir(exist_ok=True)

    def summary(self) -> str:
        """What was saved, in a line: the results of the record."""
        words = []
        for name, value in self.record.results.items():
            quantity = find_quantity(name, self.record.units)
            if value is not None:
                figure = f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"
                words.append(f"{quantity.label} {figure} {quantity.beside}".rstrip())
        return f"saved: {', '.join(words)}"

    def rewind(self, iteration: int) -> None:
        """Drop the metrics after an iteration, so that a resumed run says nothing twice."""
        rewind_metrics(self.path, iteration)

    def append(self, iteration: int, seconds: float, **values: float) -> None:
        """Add a row to the metrics."""
        append_metrics(self.path, iteration, seconds, **values)

    def write_curves(self) -> None:
        """Draw each number of the metrics against the iteration, as PNG."""
        self.make("curves")
        rows = read_metrics(self.path)
        names = {name for row in rows for name, value in row.items() if value is not None} - {"iteration", "seconds"}
        for name in sorted(names):
            figures.save_figure(figures.plot_curve(rows, name, units=self.record.units), self.path / "curves" / f"{name}.png")
