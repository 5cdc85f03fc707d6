"""A radiance field fitted to photographs: from the settings of an experiment to a run folder, one call per arrow.

Conventions. ``metrics.jsonl`` has ``loss`` (mean squared error of a step's rays) and the PSNR of a fixed set of judged views
now and then; ``field.npz`` is the field, ``film/turntable.mp4`` (``.webp`` where there is no ffmpeg) a camera path around it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mivol import config
from mivol.config import FieldFit, PhotoFit
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.field_plan import batches_of, choices, make_plan, suited
from mivol.experiments.film import plan_film
from mivol.experiments.photo_data import boxed, notes, read_photos
from mivol.experiments.photo_outputs import PhotoOutputs, compare, save_found
from mivol.experiments.run_folder import BestIterate, FilesOfBest, RunFolder
from mivol.experiments.task import Task
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Photos
from mivol.report.page import write_page
from mivol.report.record import RunRecord
from mivol.validate.images import Quality


def photo_fit(task: Task) -> Path:
    """Fit a radiance field to photographs; result and refusals as :func:`mivol.experiments.scene_fit.scene_fit`.

    Args:
        task: with a :class:`~mivol.config.FieldFit`.
    """
    chosen: FieldFit = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    asked = make_plan(chosen)
    run = RunFolder(task.folder, new_record(task), task.resume)
    with run.at_work():
        with run.stage("photographs"):
            photos, judged = read_photos(chosen, task.base)
            photos = boxed(chosen, photos)
            film = plan_film(chosen.show, photos)
            plan = suited(asked, photos)
            batches = batches_of(plan, photos)
            if photos.space == "linear":
                run.record.citations.append("mildenhall_2022")
            run.record.plan, run.record.notes = choices(plan, photos, batches), [*notes(photos, judged), *film.notes]
            task.watcher.say([photos.describe(), *(f"{one.choice}: {one.reason}" for one in run.record.plan)])
        with run.stage("fit"):
            problem = RadianceProblem(batches, photos.box, plan, chosen.seed)
            best = BestIterate(run, best_files(problem, photos.white))
            fit = solve(task, run, problem, judged, best)
        with run.stage("images and volumes"):
            PhotoOutputs(task, run, fit, photos, judged, film).write()
    page = write_page(task.folder)
    task.watcher.say([*best.says(), run.summary()])
    return page


def new_record(task: Task) -> RunRecord:
    """The record of a run that begins."""
    chosen: FieldFit = task.chosen
    return RunRecord.new(
        chosen.title,
        method=f"a sparse grid of density and spherical harmonics, fitted to photographs; preset {chosen.field.preset}",
        config=config.resolved(chosen),
        command=task.command,
        seeds={"fit": chosen.seed},
        units={"loss": "1"},
        citations=["mitsuba3", "drjit", "plenoxels_2022", "relu_fields_2022", "max_1995"],
    )


def best_files(problem: RadianceProblem, white: float) -> FilesOfBest:
    """Where the best field lies beside the last one, with its sky where there is one, in the photographs' radiance."""
    names = ("field_best.npz", *(["sky_best.exr"] if problem.sky is not None else []))
    return FilesOfBest(names, lambda folder: save_found(folder, problem, "_best", white))


def solve(
    task: Task,
    run: RunFolder,
    problem: Any,
    judged: Photos | None,
    best: BestIterate,
    compare: Callable[..., tuple[Any, Quality]] = compare,
) -> Fit:
    """All steps, with metrics and checkpoints; the best iterate is kept.

    Args:
        task, run: the experiment and its folder.
        problem: a :class:`RadianceProblem` or a :class:`~mivol.optim.gaussians.gaussian_problem.GaussianProblem`.
        judged: what the curve shows; None for nothing.
        best: the best iterate so far.
        compare: as :func:`mivol.experiments.photo_outputs.compare`, of that problem.

    Raises:
        MivolError: a checkpoint of another run, or photographs that show nothing in the box.
    """
    chosen: PhotoFit = task.chosen
    plan, every = problem.plan, chosen.show.every
    store = CheckpointFile(
        run.checkpoint, {"photos": problem.batches.digest(), **config.flat(config.resolved(chosen))}, task.resume
    )
    fit = begin_fit(problem, plan.optimizer, plan.course(Checkpoint(every=chosen.checkpoint_every)), checkpoint=store)
    best.restore()
    run.begin(fit.next_iteration)
    with task.watcher.watch(plan.steps) as watch:

        def observe(fit: Fit) -> None:
            if fit.next_iteration % every == 0 or fit.next_iteration == plan.steps:
                problem.set_reals(fit.run.reals)
                errors = judge_few(chosen, problem, judged, compare)
                best.see(fit.next_iteration, errors)
                run.append(fit.next_iteration, fit.seconds, loss=fit.history[-1]["loss"], **errors)
            watch(fit)

        fit.complete(observe)
    best.settle()
    run.record.notes += fit.log + best.says()
    return fit


def judge_few(
    chosen: PhotoFit, problem: Any, judged: Photos | None, compare: Callable[..., tuple[Any, Quality]] = compare
) -> dict[str, float]:
    """Mean PSNR of a fixed set of judged views, spread evenly over them: the points of a curve can be compared.

    It is called that of the held-out views where it is that of all of them only.
    """
    if judged is None:
        return {}
    count = min(chosen.show.judged or len(judged.views), len(judged.views))
    numbers = np.linspace(0, len(judged.views) - 1, count).round().astype(int)
    found = [compare(problem, judged, judged.views[number], ("psnr",))[1].values["psnr"] for number in numbers]
    return {"held_out_psnr" if count == len(judged.views) else "few_psnr": float(np.mean(found))}
