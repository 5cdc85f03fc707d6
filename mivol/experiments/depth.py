"""The path depth of a fit whose ``fit.max_depth`` is auto: measured in the scene that the references show."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import msgspec
import numpy as np

from mivol.config import AUTO, Experiment, Rendered
from mivol.experiments.references import camera_of
from mivol.experiments.task import Task
from mivol.experiments.truth import holding
from mivol.report.record import PlanLine
from mivol.scene.depth_preview import measure_depths
from mivol.scene.load import LoadedScene
from mivol.transport.path.estimators import Settings

__all__ = ["settle_depth"]


def settle_depth(task: Task, loaded: LoadedScene, truth: np.ndarray | None) -> tuple[Task, list[PlanLine]]:
    """Put a number in the place of ``max_depth = "auto"``.

    The depth is measured from the first view, in the scene that renders the references. Where the references are files and the
    truth is not known, nothing can be measured, and paths have no limit.

    Returns:
        The task with a number, and why it is that one; the task itself where it has one.
    """
    chosen: Experiment = task.chosen
    if chosen.fit.max_depth != AUTO:
        return task, []
    if truth is None and not isinstance(chosen.reference, Rendered):
        depth, reason = -1, "the references are files, and what they show is not known"
    else:
        with nullcontext() if truth is None else holding(loaded.scene, chosen.truth.key, truth):
            sensor = camera_of(next(iter(chosen.views.sensors(loaded.scene))))
            answer = measure_depths(loaded.scene, sensor, Settings(), chosen.fit.noise)
        depth, reason = answer.depth, answer.reason
    fit = msgspec.structs.replace(chosen.fit, max_depth=depth)
    settled = replace(task, chosen=msgspec.structs.replace(chosen, fit=fit))
    return settled, [PlanLine(choice=f"max_depth: {depth}", reason=reason)]
