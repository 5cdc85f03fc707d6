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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.files.atomic import disk_faults, lock_folder, remove_temporaries
from mivol.optim import checkpoint
from mivol.report import figures
from mivol.report.record import (
    METRICS,
    QUANTITIES,
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
            MivolError: another run uses the folder.
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
                words.append(f"{quantity.label} {figure} {quantity.symbol}".rstrip())
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


JUDGES = {"nrmse": 1.0, "held_out_psnr": -1.0, "few_psnr": -1.0}
"""What an iterate is judged by: the first of these that is measured. Times the sign, smaller is better."""


@dataclass(frozen=True)
class BestFiles:
    """Files of their own format that hold the best iterate, where parameters alone do not say what it is.

    Attributes:
        names: relative to the run folder.
        write: writes them to the folder, of the newest iterate.
    """

    names: tuple[str, ...]
    write: Callable[[Path], None]


class BestIterate:
    """The iterate that was judged best so far, and the newest one.

    Attributes:
        run: the folder; ``best.npz`` in it says which iterate is best and holds its values by parameter, and a resumed run
            goes on from there.
        files: that hold the best iterate beside ``best.npz``; None for none.
        judge: what it is judged by, a key of ``JUDGES``; "" before the first judgement, and where nothing is measured.
        iteration: of the best one.
        value: of the best one.
        newest: value of the newest one.
    """

    def __init__(self, run: RunFolder, files: BestFiles | None = None) -> None:
        self.files = files
        self.run, self.judge, self.iteration, self.value, self.newest = run, "", 0, 0.0, 0.0

    def restore(self) -> None:
        """Go on from what is there, where the run is resumed and something is."""
        if self.run.is_resumed and self.run.best.exists():
            about = checkpoint.read(self.run.best, {})[1]
            self.judge, self.iteration, self.value = about["judge"], about["iteration"], about["value"]
            told = [row[self.judge] for row in read_metrics(self.run.path) if row.get(self.judge) is not None]
            self.newest = told[-1] if told else self.value

    def see(self, iteration: int, errors: Mapping[str, float], values: Mapping[str, Any] | None = None) -> None:
        """Judge an iterate, and keep it where it is the best so far.

        Args:
            iteration: how many steps have been taken.
            errors: what was measured of it, by name; without one of ``JUDGES`` it is not judged.
            values: arrays by parameter; None where ``files`` hold all.
        """
        judge = next((name for name in JUDGES if np.isfinite(errors.get(name, np.nan))), "")
        if not judge:
            return
        self.newest = errors[judge]
        if judge == self.judge and JUDGES[judge] * (self.newest - self.value) >= 0:
            return
        self.judge, self.iteration, self.value = judge, iteration, self.newest
        if self.files is not None:  # first, so that best.npz never speaks of files that are not there yet
            self.files.write(self.run.path)
        about = {"judge": judge, "iteration": iteration, "value": self.value, "fingerprint": {}}
        checkpoint.write(self.run.best, {name: np.array(value) for name, value in (values or {}).items()}, about)

    @property
    def is_newest(self) -> bool:
        """Whether no iterate was better than the newest one."""
        return not self.judge or self.newest == self.value

    def read(self) -> dict[str, np.ndarray]:
        """The best iterate, by parameter."""
        return checkpoint.read(self.run.best, {})[0]

    def settle(self) -> None:
        """Remove the files of an iterate that is the last one as well, or of another run: once a fit is done."""
        if self.files is not None and self.is_newest:
            for name in self.files.names:
                (self.run.path / name).unlink(missing_ok=True)

    def says(self) -> list[str]:
        """A sentence where the fit has become worse since."""
        if self.is_newest:
            return []
        quantity = QUANTITIES[self.judge]
        best, last = (f"{value:.4g} {quantity.unit}".strip() for value in (self.value, self.newest))
        where = f"{self.run.best.name} and volumes/*_best.npz" if self.files is None else " and ".join(self.files.names)
        verb = "holds" if self.files is not None and len(self.files.names) == 1 else "hold"
        return [
            f"{quantity.label} was best at iteration {self.iteration}, {best}, and is {last} at the end: "
            f"{where} {verb} that iterate, all else is of the last."
        ]
