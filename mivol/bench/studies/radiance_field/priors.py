"""What each prior of the preset for captures gains, on photographs that were held out of small fits."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mivol.bench.extinctions import DATA
from mivol.bench.harness.bars import say
from mivol.bench.studies.radiance_field.fits import held_out_psnr
from mivol.bench.studies.radiance_field.reconstruction import write_room
from mivol.bench.studies.radiance_field.size import Size
from mivol.experiments.field_plan import of_few, with_levels_needed
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo, Photos, load_photos, rectify

__all__ = ["WITHOUT", "ask_priors", "captures", "gain_of", "plan_of"]

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
"""A prior, or a choice, -> the plan without it."""


def plan_of(size: Size) -> RadiancePlan:
    """The preset for captures, of few photographs, at a small size."""
    preset, n = of_few(PRESETS["capture"]), size.prior_resolution
    stages = RadianceStage(n // 2, size.prior_steps // 3, 1, 8, 16), RadianceStage(n, size.prior_steps, 1, 8, 48)
    return replace(preset, stages=stages, exposure=False)


def captures(size: Size) -> dict[str, Photos]:
    """Photographs with the points of a reconstruction: of a procedural room and, where the data folder has it, of the fox."""
    with tempfile.TemporaryDirectory() as folder:
        made = write_room(Path(folder) / "room", 25, (size.prior_side, size.prior_side * 3 // 4))
        found = {"room": load_photos(made, box="middle")}
    path = DATA / "multiview" / "fox"
    if path.is_dir():
        found["fox"] = load_photos(path, largest=size.prior_side, box="middle")
    return found


def judge_plan(plan: RadiancePlan, photos: Sequence[Photo], box: np.ndarray, fold: int) -> float:
    """Mean PSNR [dB] of the photographs of a fold, of a fit to all others; the fold is the seed too."""
    kept = [photo for k, photo in enumerate(photos) if k % FOLDS != fold]
    fit = begin_radiance_fit(RayBatches.of(kept, (1,)), box, plan, fold)
    for _ in range(fit.course.iterations):
        fit.advance()
    field, sky = current_field(fit), fit.problem.sky
    return held_out_psnr(photos[fold::FOLDS], lambda camera: render_view(field, camera, sky).image)


def gain_of(with_it: Sequence[float], without: Sequence[float]) -> dict[str, float]:
    """Mean difference [dB] over folds, and its standard error."""
    apart = np.subtract(with_it, without)
    return {"gain": float(apart.mean()), "error": float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else np.nan}


def ask_priors(size: Size) -> dict:
    """How much worse is the preset for captures without each of its priors?"""
    answer = {}
    for name, loaded in captures(size).items():
        plan = with_levels_needed(plan_of(size), loaded)
        photos, box = [rectify(photo) for photo in loaded.views], loaded.box
        folds = range(size.prior_folds)
        whole = [judge_plan(plan, photos, box, fold) for fold in folds]
        answer[name] = {"psnr": whole, "priors": {}}
        say(f"  {name}, {len(photos)} photographs: {np.mean(whole):.2f} dB over {len(whole)} folds")
        for prior, without in WITHOUT.items():
            found = gain_of(whole, [judge_plan(without(plan), photos, box, fold) for fold in folds])
            answer[name]["priors"][prior] = found
            say(f"  {name}, {prior}: {found['gain']:+.2f} +- {found['error']:.2f} dB")
    return answer
