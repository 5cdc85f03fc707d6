"""A run's folder while the run is at work: its record is kept true, and no other run writes into it.

Conventions. A run folder holds ``run.json``, ``metrics.jsonl``, ``checkpoint.npz``, ``report.html``, and in folders of their
own what came of the run: ``views/``, ``volumes/``, ``curves/``, and ``references/`` or ``film/``. Every file is written whole.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mivol.errors import MivolError
from mivol.report import figures
from mivol.report.record import RunRecord, append_metrics, read_metrics, rewind_metrics, write_record

CHECKPOINT = "checkpoint.npz"


class RunFolder:
    """A folder, made where it is not there, and the record of the run at work in it.

    Attributes:
        path: of the folder.
        record: what ``run.json`` will say.
    """

    def __init__(self, path: Path, record: RunRecord) -> None:
        self.path, self.record = path, record
        path.mkdir(parents=True, exist_ok=True)

    @property
    def checkpoint(self) -> Path:
        """Where the run's checkpoint lies."""
        return self.path / CHECKPOINT

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Keep ``run.json`` true: "running" at first, "finished" or "stopped" in the end, with what stopped it.

        Raises:
            MivolError: another run is at work in the folder.
        """
        with locked(self.path):
            write_record(self.record, self.path)
            try:
                yield
            except BaseException as error:
                self.record.status = "stopped"
                self.record.notes += [f"stopped by: {error}"] if str(error) else []
                with suppress(MivolError, OSError):
                    write_record(self.record, self.path)
                raise
            self.record.status = "finished"
            write_record(self.record, self.path)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a part of the run."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.record.timings[name] = time.perf_counter() - start

    def make(self, *names: str) -> None:
        """Make folders in it."""
        for name in names:
            (self.path / name).mkdir(exist_ok=True)

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
            figures.save(figures.plot_curve(rows, name), self.path / "curves" / f"{name}.png")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the system lets go of it however the process ends.

    Where the file system knows no locks (some network disks) nothing is held, and nothing is refused.

    Raises:
        MivolError: another process holds it.
    """
    held = os.open(folder, os.O_RDONLY)
    try:
        _lock(held, folder.name)
        yield
    finally:
        os.close(held)


def _lock(held: int, name: str) -> None:
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise MivolError(f'another run is at work in "{name}": wait for its end, or choose another folder.') from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise
