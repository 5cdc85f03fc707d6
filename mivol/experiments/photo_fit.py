"""A radiance field fitted to photographs: from the settings of an experiment to a run folder, one call per arrow.

Conventions. ``metrics.jsonl`` has ``loss`` (mean squared error of a step's rays) and the metrics of one judged view now and
then; ``field.npz`` is the field, ``film/turntable.mp4`` (``.webp`` where there is no ffmpeg) a camera path around it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import drjit as dr

from mivol import config
from mivol.config import FieldFit
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.photo_data import boxed, notes, read_photos
from mivol.experiments.photo_outputs import PhotoOutputs, compare, named
from mivol.experiments.photo_plan import choices, make_plan, shrunk
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.task import Task
from mivol.optim import checkpoint
from mivol.optim.radiance_fit import RadianceFit
from mivol.optim.radiance_views import Views
from mivol.photos import Photos, rectified
from mivol.report.page import write_page
from mivol.report.record import RunRecord


def photo_fit(task: Task) -> Path:
    """Fit a radiance field to photographs; result and refusals as :func:`mivol.experiments.scene_fit.scene_fit`.

    Args:
        task: with a :class:`~mivol.config.FieldFit`.
    """
    chosen: FieldFit = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    asked = make_plan(chosen)
    run = RunFolder(task.folder, new_record(chosen))
    with run.at_work():
        with run.stage("photographs"):
            photos, judged = read_photos(chosen, task.base)
            photos = boxed(chosen, photos)
            plan = shrunk(asked, photos)
            views = Views.of([rectified(view) for view in photos.views], [stage.shrink for stage in plan.stages])
            run.record.plan, run.record.notes = choices(plan, photos, views), notes(photos)
            task.watcher.say([photos.text, *(f"{one.choice}: {one.reason}" for one in run.record.plan)])
        with run.stage("fit"):
            fit = solve(task, run, RadianceFit(views, photos.box, plan, chosen.seed), judged)
        with run.stage("images and volumes"):
            PhotoOutputs(task, run, fit, photos, judged).write()
    return write_page(task.folder)


def new_record(chosen: FieldFit) -> RunRecord:
    """The record of a run that begins."""
    return RunRecord.new(
        chosen.title,
        method=f"a sparse grid of density and spherical harmonics, fitted to photographs; preset {chosen.field.preset}",
        config=config.resolved(chosen),
        command="mivol optimize",
        seeds={"fit": chosen.seed},
        citations=["mitsuba3", "drjit", "plenoxels_2022", "relu_fields_2022", "max_1995"],
    )


def solve(task: Task, run: RunFolder, fit: RadianceFit, judged: Photos | None) -> RadianceFit:
    """All steps, with metrics and checkpoints.

    Raises:
        MivolError: a checkpoint of another run.
    """
    chosen: FieldFit = task.chosen
    fingerprint = {"photos": fit.views.digest(), **config.flat(config.resolved(chosen))}
    path = run.checkpoint
    if task.resume:
        fit.restore(*checkpoint.read(path, fingerprint))
    run.rewind(fit.step)

    def keep() -> None:
        arrays, about = fit.pack()
        checkpoint.write(path, arrays, {**about, "fingerprint": fingerprint})

    started = time.perf_counter() - fit.seconds
    try:
        for loss in task.watcher.track(Steps(fit), "steps"):
            fit.seconds = time.perf_counter() - started
            if fit.step % chosen.show.every == 0 or fit.step == fit.plan.steps:
                run.append(fit.step, fit.seconds, loss=loss, **look(chosen, fit, judged))
            if fit.step % chosen.checkpoint_every == 0:
                keep()
    finally:
        if fit.field is not None:
            keep()
    return fit


class Steps:
    """The steps that are left of a fit, each with its mean squared error; their number is known."""

    def __init__(self, fit: RadianceFit) -> None:
        self.fit, self.left = fit, max(fit.plan.steps - fit.step, 0)

    def __len__(self) -> int:
        return self.left

    def __iter__(self) -> Iterator[float]:
        for _ in range(len(self)):
            yield float(dr.mean(self.fit.advance())[0])


def look(chosen: FieldFit, fit: RadianceFit, judged: Photos | None) -> dict[str, float]:
    """How well one judged view is seen, another one each time."""
    if judged is None:
        return {}
    photo = judged.views[fit.step // chosen.show.every % len(judged.views)]
    return named(compare(chosen, fit, judged, photo)[1].values)
