"""Gaussians fitted to photographs: from the settings of an experiment to a run folder, one call per arrow.

Conventions. ``metrics.jsonl`` has ``loss`` (that of a step's picture) and the PSNR of a fixed set of judged views now and then;
``gaussians.ply`` holds the Gaussians as published viewers read them, ``film/turntable.mp4`` (``.webp`` where there is no
ffmpeg) a camera path around them.
"""

from __future__ import annotations

from pathlib import Path

from mivol import config
from mivol.config import GaussianFit
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.film import plan_film
from mivol.experiments.gaussian_outputs import GaussianOutputs, compare
from mivol.experiments.gaussian_start import begin, make_gaussian_plan
from mivol.experiments.photo_data import boxed, notes, read_photos
from mivol.experiments.photo_fit import solve
from mivol.experiments.run_folder import BestIterate, FilesOfBest, RunFolder
from mivol.experiments.task import Task
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.points import Gaussians, write_gaussians
from mivol.report.page import write_page
from mivol.report.record import RunRecord

__all__ = ["gaussian_fit"]


def gaussian_fit(task: Task) -> Path:
    """Fit Gaussians to photographs; result and refusals as :func:`mivol.experiments.scene_fit.scene_fit`.

    Args:
        task: with a :class:`~mivol.config.GaussianFit`.
    """
    chosen: GaussianFit = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    asked = make_gaussian_plan(chosen)
    run = RunFolder(task.folder, new_record(task), task.resume)
    with run.at_work():
        with run.stage("photographs"):
            photos, judged = read_photos(chosen, task.base)
            photos = boxed(chosen, photos)
            film = plan_film(chosen.show, photos)
            begun = begin(chosen, photos, asked)
            run.record.plan, run.record.notes = begun.lines, [*notes(photos, judged), *film.notes]
            task.watcher.say([photos.describe(), *(f"{one.choice}: {one.reason}" for one in run.record.plan)])
        with run.stage("fit"):
            problem = begun.problem(chosen.seed)
            best = BestIterate(run, best_files(problem))
            fit = solve(task, run, problem, judged, best, compare)
        with run.stage("images and Gaussians"):
            GaussianOutputs(task, run, fit, photos, judged, film).write()
    page = write_page(task.folder)
    task.watcher.say([*best.says(), run.summary()])
    return page


def best_files(problem: GaussianProblem) -> FilesOfBest:
    """Where the best Gaussians lie beside the last ones."""
    name = "gaussians_best.ply"
    return FilesOfBest((name,), lambda folder: write_gaussians(folder / name, Gaussians(**problem.cloud)))


def new_record(task: Task) -> RunRecord:
    """The record of a run that begins."""
    chosen: GaussianFit = task.chosen
    relocates = make_gaussian_plan(chosen).control == "relocation"
    return RunRecord.new(
        chosen.title,
        method=f"3D Gaussians, splatted in tiles and fitted to photographs; preset {chosen.gaussians.preset}",
        config=config.resolved(chosen),
        command=task.command,
        seeds={"fit": chosen.seed},
        units={"loss": "1"},
        citations=["mitsuba3", "drjit", "kerbl_2023", "zwicker_2001", "wang_2004"] + ["kheradmand_2024"] * relocates,
    )
