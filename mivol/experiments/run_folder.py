"""The folder of a run: record, metrics and best iterate, protected from other runs.

Conventions. A run folder holds ``run.json``, ``metrics.jsonl``, ``checkpoint.npz``, ``report.html`` and folders of results:
``views/``, ``volumes/``, ``curves/``, ``references/``, ``film/``. A running reconstruction also writes ``preview.png``. Every
file is written atomically. The files of an earlier run move to ``earlier/`` when a new run takes its first step.
"""

from __future__ import annotations

import json
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
from mivol.files import write_volume, write_whole_text
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
    join_channels,
    read_metrics,
    read_record,
    rewind_metrics,
    write_record,
)

CHECKPOINT = "checkpoint.npz"
FIRST_CHECKPOINT = "stages/checkpoint.npz"
"""The checkpoint of a fit before the run's own: that of the network at which an octree begins."""
BEST = "best.npz"
EARLIER = "earlier"
KEPT = (RECORD, METRICS, CHECKPOINT, BEST, "report.html")
"""Files moved to ``earlier/``."""

SECONDS_BETWEEN_PAGES = 5.0
"""Interval between two pages of a run under way on a cluster."""


def find_checkpoint(folder: Path) -> Path:
    """The newest checkpoint of a run: its own, or ``FIRST_CHECKPOINT`` if only that exists."""
    own, first = folder / CHECKPOINT, folder / FIRST_CHECKPOINT
    return first if first.is_file() and not own.is_file() else own


class RunFolder:
    """A folder, created if missing, with the record of a run.

    Attributes:
        path: path of the folder.
        record: content of ``run.json``.
        is_resumed: whether the run continues from the folder's checkpoint.
    """

    def __init__(self, path: Path, record: RunRecord, is_resumed: bool = False) -> None:
        self.path, self.record, self.is_resumed = path, record, is_resumed
        self._has_begun = False
        path.mkdir(parents=True, exist_ok=True)

    @property
    def checkpoint(self) -> Path:
        """Path of the checkpoint."""
        return self.path / CHECKPOINT

    @property
    def best(self) -> Path:
        """Path of the best iterate."""
        return self.path / BEST

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Keep ``run.json`` up to date: "running" first, "finished" or "stopped" in the end, with the reason of the stop.

        A run refused before the first step leaves the record of an earlier run unchanged.

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
        """Take over the folder before the first step, after the last check.

        Args:
            iteration: last iteration with metrics kept by a resumed run; a new run keeps no metrics.
        """
        if self.is_resumed:
            rewind_metrics(self.path, iteration)
        else:
            self._put_away()
        self._write()

    def _holds_a_run(self) -> bool:
        """Whether the folder has an earlier run with a step or an end, or a run whose move was interrupted."""
        present = {name for name in KEPT if (self.path / name).exists()}
        if present != {RECORD}:
            return bool(present)
        with suppress(MivolError):
            return read_record(self.path).status == "finished"
        return False

    def _put_away(self) -> None:
        """Move the files of an earlier run to ``earlier/``. Runs are never mixed or lost.

        If the process is killed, the earlier run is complete in the folder or in ``earlier/``: the files are copied first (by
        hard links if the file system has them), then removed, the record first. Files without a record have been moved before.
        """
        if self._has_begun:
            return
        coming, going = self.path / f".{EARLIER}.coming", self.path / f".{EARLIER}.going"
        for stale in (coming, going):
            shutil.rmtree(stale, ignore_errors=True)
        present = [name for name in KEPT if (self.path / name).exists()]
        if RECORD in present:
            self._copy_to_earlier(present, coming, going)
        for name in present:
            (self.path / name).unlink()
        self.remove_newest()

    def _copy_to_earlier(self, names: list[str], coming: Path, going: Path) -> None:
        """Make ``earlier/`` of these files by a single rename, with two temporary folders."""
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
        """Measure the time of a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.record.timings[name] = time.perf_counter() - start

    def make(self, *names: str) -> None:
        """Create subfolders.

        Raises:
            MivolError: a disk error (disk full, quota, permission ...).
        """
        for name in names:
            with disk_faults(self.path / name, "room for a folder"):
                (self.path / name).mkdir(exist_ok=True)

    def summary(self) -> str:
        """Return the results of the record and the time of its stages in a line."""
        results = []
        for name, value in self.record.results.items():
            quantity = find_quantity(name, self.record.units)
            if value is not None:
                figure = f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"
                results.append((figure, quantity.symbol, quantity.label))
        words = [f"{label} {figure} {symbol}".rstrip() for figure, symbol, label in join_channels(results)]
        times = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in self.record.timings.items())
        return f"result: {', '.join(words)}" + (f" ({times})" if times else "")

    def rewind(self, iteration: int) -> None:
        """Remove the metrics after an iteration, to keep a resumed run from repeating rows."""
        rewind_metrics(self.path, iteration)

    def append(self, iteration: int, seconds: float, **values: float) -> None:
        """Add a row to the metrics."""
        append_metrics(self.path, iteration, seconds, **values)

    def write_newest(self, values: np.ndarray, to_world: np.ndarray) -> None:
        """Write the volume of the newest iterate for a viewer, with at most ``NEWEST_EDGE`` voxels along an edge.

        Args:
            values: (Z, Y, X) or (Z, Y, X, C).
            to_world: (4, 4) map of the unit cube to the world.
        """
        step = -(-max(values.shape[:3]) // NEWEST_EDGE)
        write_volume(self.path / NEWEST, np.ascontiguousarray(values[::step, ::step, ::step]), to_world)

    def write_photographs(self, path: Path, held_out: int, fold: int) -> None:
        """Write where the photographs of a fit are, from the run folder on, for a viewer."""
        try:
            named = os.path.relpath(path, self.path)
        except ValueError:  # another drive
            named = path.resolve()
        text = json.dumps({"path": Path(named).as_posix(), "held_out": held_out, "fold": fold})
        write_whole_text(self.path / PHOTOGRAPHS, text)

    def remove_newest(self) -> None:
        """Remove the volume for viewers, once the outputs of the run are written."""
        (self.path / NEWEST).unlink(missing_ok=True)

    def write_curves(self) -> None:
        """Plot each number of the metrics against the iteration, as PNG."""
        self.make("curves")
        rows = read_metrics(self.path)
        names = {name for row in rows for name, value in row.items() if value is not None} - {"iteration", "seconds"}
        for name in sorted(names):
            figures.save_figure(figures.plot_curve(rows, name, units=self.record.units), self.path / "curves" / f"{name}.png")


NEWEST = "newest.npz"
"""The volume for viewers; it goes when a run begins anew or ends."""

PHOTOGRAPHS = "photographs.json"
"""Where the photographs of a fit are: ``path`` from the run folder on, and which photographs judge the fit."""

NEWEST_EDGE = 128
"""Longest edge of the volume for viewers [voxel]: of larger ones every second, third, ... voxel is written."""

JUDGES = {"nrmse": 1.0, "held_out_psnr": -1.0, "few_psnr": -1.0}
"""Errors to compare iterates, in order of preference. Smaller is better after multiplication by the sign."""


@dataclass(frozen=True)
class BestFiles:
    """Files of the best iterate, for problems whose parameters do not hold all of the model.

    Attributes:
        names: paths relative to the run folder.
        write: function writing the current model into a folder.
    """

    names: tuple[str, ...]
    write: Callable[[Path], None]


class BestIterate:
    """The best iterate so far, and the error of the newest iterate.

    Attributes:
        run: run folder; its ``best.npz`` has the best iterate, with which a resumed run continues.
        files: more files of the best iterate; may be None.
        judge: name of the judging error, a key of ``JUDGES``; "" before the first comparison, and without an error.
        iteration: iteration of the best iterate.
        value: error of the best iterate.
        newest: error of the newest iterate.
    """

    def __init__(self, run: RunFolder, files: BestFiles | None = None) -> None:
        self.files = files
        self.run, self.judge, self.iteration, self.value, self.newest = run, "", 0, 0.0, 0.0

    def restore(self) -> None:
        """Continue from the best iterate in the folder, if the run is resumed."""
        if self.run.is_resumed and self.run.best.exists():
            about = checkpoint.read(self.run.best, {})[1]
            self.judge, self.iteration, self.value = about["judge"], about["iteration"], about["value"]
            earlier_errors = [row[self.judge] for row in read_metrics(self.run.path) if row.get(self.judge) is not None]
            self.newest = earlier_errors[-1] if earlier_errors else self.value

    def see(self, iteration: int, errors: Mapping[str, float], values: Mapping[str, Any] | None = None) -> None:
        """Judge an iterate, and keep the best.

        Args:
            iteration: number of steps taken.
            errors: errors by name; an iterate without an error of ``JUDGES`` is not judged.
            values: arrays by parameter; None if ``files`` hold the iterate.
        """
        judge = next((name for name in JUDGES if np.isfinite(errors.get(name, np.nan))), "")
        if not judge:
            return
        self.newest = errors[judge]
        if judge == self.judge and JUDGES[judge] * (self.newest - self.value) >= 0:
            return
        self.judge, self.iteration, self.value = judge, iteration, self.newest
        if self.files is not None:  # first: best.npz must not name files before they exist
            self.files.write(self.run.path)
        about = {"judge": judge, "iteration": iteration, "value": self.value, "fingerprint": {}}
        checkpoint.write(self.run.best, {name: np.array(value) for name, value in (values or {}).items()}, about)

    @property
    def is_newest(self) -> bool:
        """Whether the newest iterate is the best."""
        return not self.judge or self.newest == self.value

    def read(self) -> dict[str, np.ndarray]:
        """Read the best iterate, by parameter."""
        return checkpoint.read(self.run.best, {})[0]

    def settle(self) -> None:
        """After the fit, remove the files of the best iterate if the last iterate is the best."""
        if self.files is not None and self.is_newest:
            for name in self.files.names:
                (self.run.path / name).unlink(missing_ok=True)

    def says(self) -> list[str]:
        """Return a sentence if an earlier iterate was better than the last."""
        if self.is_newest:
            return []
        quantity = QUANTITIES[self.judge]
        best, last = (f"{value:.4g} {quantity.unit}".strip() for value in (self.value, self.newest))
        where = f"{self.run.best.name} and volumes/*_best.npz" if self.files is None else " and ".join(self.files.names)
        verb = "holds" if self.files is not None and len(self.files.names) == 1 else "hold"
        return [
            f"{quantity.label} was best at iteration {self.iteration}, {best}, and is {last} at the end: "
            f"{where} {verb} the best iterate, all other files hold the last iterate."
        ]
