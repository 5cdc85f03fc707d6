"""The best iterate of a fit, kept beside the last one: a fit that goes on too long makes its volume worse again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.experiments.run_folder import RunFolder
from mivol.optim import checkpoint
from mivol.report.record import QUANTITIES, read_metrics

JUDGES = {"nrmse": 1.0, "held_out_psnr": -1.0, "few_psnr": -1.0}
"""What an iterate is judged by: the first of these that is measured. Times the sign, smaller is better."""


@dataclass(frozen=True)
class FilesOfBest:
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

    def __init__(self, run: RunFolder, files: FilesOfBest | None = None) -> None:
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
