"""Every kind of experiment, and the function that does it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mivol import config
from mivol.experiments.gaussian_fit import gaussian_fit
from mivol.experiments.photo_fit import photo_fit
from mivol.experiments.run_folder import CHECKPOINT
from mivol.experiments.scan_fit import scan_fit
from mivol.experiments.scene_fit import scene_fit
from mivol.experiments.task import Task
from mivol.optim import checkpoint

RUNS: dict[type, Callable[[Task], Path]] = {
    config.Experiment: scene_fit,
    config.Scan: scan_fit,
    config.FieldFit: photo_fit,
    config.GaussianFit: gaussian_fit,
}
"""What does an experiment, by the type of its settings."""


def run_experiment(task: Task) -> Path:
    """Do an experiment; the page.

    A run that is to be resumed is refused before anything of it is touched where its checkpoint is of other settings.

    Raises:
        MivolError: whatever is wrong with the settings, the data, the disk or the checkpoint.
        KeyboardInterrupt: stopped; what is there is kept, and ``task.resume`` continues.
    """
    if task.resume:
        checkpoint.check_settings(task.folder / CHECKPOINT, config.flat(config.resolved(task.chosen)))
    return RUNS[type(task.chosen)](task)
