"""The gain of each prior of the preset for captures, by photographs held out of small fits."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol.bench.extinctions import DATA
from mivol.bench.harness.bars import say_row
from mivol.bench.harness.study import amount
from mivol.bench.studies.radiance_field.fields import FieldSize
from mivol.bench.studies.radiance_field.fits import held_out_psnr
from mivol.bench.studies.radiance_field.room import write_room
from mivol.experiments.field_plan import adapt_to_few, reduce_levels
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo, Photos, load_photos, rectify

__all__ = ["WITHOUT", "PriorSize", "load_captures", "mean_gain", "measure_priors", "small_plan"]

FOLDS = 5
"""A fold holds out every fifth photograph."""

WITHOUT: dict[str, Callable[[RadiancePlan], RadiancePlan]] = {
    "total variation of the density": lambda plan: replace(plan, tv_density=0.0),
    "total variation of the colours": lambda plan: replace(plan, tv_sh=0.0),
    "gradients that fall near a camera": lambda plan: replace(plan, near=0.0),
    "no decay of what goes with the direction": lambda plan: replace(plan, matte=PRESETS["capture"].matte),
    "distances of a model's points": lambda plan: replace(plan, depth=0.0),
    "degree 1 and not 2": lambda plan: replace(plan, degree=2),
    "degree 1 from the first stage on, not raised from 0": lambda plan: replace(plan, first_degree=0),
}
"""A prior, or another choice -> the plan without it."""


@dataclass(frozen=True)
class PriorSize(FieldSize):
    """Amount of work of the question about priors."""

    prior_side: int = amount(80, 16, "longest edge of the photographs for priors [pixels]")
    prior_resolution: int = amount(32, 16, "nodes along an edge in the last stage of fits for priors")
    prior_steps: int = amount(180, 6, "steps of the last stage of fits for priors")
    prior_folds: int = amount(5, 1, "number of folds")


def small_plan(size: PriorSize) -> RadiancePlan:
    """The preset for captures with few photographs, at a small size."""
    preset, n = adapt_to_few(PRESETS["capture"]), size.prior_resolution
    stages = RadianceStage(n // 2, size.prior_steps // 3, 1, 8, 16), RadianceStage(n, size.prior_steps, 1, 8, 48)
    return replace(preset, stages=stages, exposure=False)


def load_captures(size: PriorSize) -> dict[str, Photos]:
    """Photographs with the points of a reconstruction: the procedural room, and the fox if the data folder has it."""
    with tempfile.TemporaryDirectory() as folder:
        room = write_room(Path(folder) / "room", 25, (size.prior_side, size.prior_side * 3 // 4))
        captures = {"room": load_photos(room, box="middle")}
    path = DATA / "multiview" / "fox"
    if path.is_dir():
        captures["fox"] = load_photos(path, largest=size.prior_side, box="middle")
    return captures


def judge_plan(plan: RadiancePlan, photos: Sequence[Photo], box: np.ndarray, fold: int) -> float:
    """Mean PSNR of the photographs of a fold, from a fit to all others [dB]; the fold is also the seed."""
    train = [photo for k, photo in enumerate(photos) if k % FOLDS != fold]
    fit = begin_radiance_fit(RayBatches.from_photos(train, (1,)), box, plan, fold)
    for _ in range(fit.course.iterations):
        fit.advance()
    field, sky = current_field(fit), fit.problem.sky
    return held_out_psnr(photos[fold::FOLDS], lambda camera: render_view(field, camera, sky).image)


def mean_gain(with_prior: Sequence[float], without: Sequence[float]) -> dict[str, float | None]:
    """Mean difference over folds [dB], and its standard error; one fold has no error."""
    gains = np.subtract(with_prior, without)
    error = float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else None
    return {"gain": float(gains.mean()), "error": error}


def measure_priors(size: PriorSize) -> dict:
    """How much worse is the preset for captures without each of its priors?"""
    answer = {}
    for name, capture in load_captures(size).items():
        plan = reduce_levels(small_plan(size), capture)
        photos, box = [rectify(photo) for photo in capture.views], capture.box
        folds = range(size.prior_folds)
        whole = [judge_plan(plan, photos, box, fold) for fold in folds]
        answer[name] = {"psnr": whole, "priors": {}}
        say_row(f"{name}, {len(photos)} photographs", psnr=float(np.mean(whole)), folds=len(whole))
        for prior, remove in WITHOUT.items():
            gain = mean_gain(whole, [judge_plan(remove(plan), photos, box, fold) for fold in folds])
            answer[name]["priors"][prior] = gain
            say_row(f"{name}, {prior}", **gain)
    return answer
