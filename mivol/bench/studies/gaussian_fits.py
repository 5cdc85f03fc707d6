"""Fits of Gaussians to the chair of NeRF-synthetic: decibels of its test views after minutes of a machine of a given rate.

Conventions. Minutes are processor time over that of a walk of rays in the same process, times what this walk takes on the
machine that walks ``WALK`` rays a second: other work on the machine moves them little. Photographs and judged views are means
over squares of the pixels in the files; PSNR is the mean over views, over white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import Stopwatch
from mivol.errors import MivolError
from mivol.optim.gaussians.gaussian_plan import PRESETS, GaussianPlan
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.gaussians.gaussian_start import find_start_points, make_start_cloud
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo, Photos, load_photos
from mivol.points import Gaussians
from mivol.splatting import Splatter, to_tensors
from mivol.validate import images

__all__ = ["Fitted", "asked_of", "fit_and_judge", "fitted", "photographs", "psnr_of"]


@dataclass(frozen=True)
class Fitted:
    """What is fitted.

    Attributes:
        preset: a name in ``PRESETS``.
        effort: factor on its steps.
        scale: of photographs and judged views, of the files' width.
        seeds: a fit for each.
    """

    preset: str
    effort: float
    scale: float
    seeds: tuple[int, ...]


def fit_and_judge(folder: Path, asked: Fitted, seconds_of_walk: float, reference_seconds: float) -> dict:
    """Fit photographs once a seed, and judge by the test views that are there.

    Args:
        folder: of photographs with alpha, and of a split "test".
        asked: what is fitted.
        seconds_of_walk: processor time of the walk here [s].
        reference_seconds: what it takes on the machine of the minutes, of both cores together [s].

    Returns:
        By seed PSNR [dB], minutes, Gaussians; and what was asked.

    Raises:
        MivolError: no such folder.
    """
    photos, plan = photographs(folder, asked), asked_of(asked)
    judged = load_photos(folder, split="test", scale=asked.scale, background="white", space="srgb").views
    found = {}
    for seed in asked.seeds:
        watch = Stopwatch()
        with watch:
            problem = fitted(photos, plan, seed)
        minutes = watch.processor / seconds_of_walk * reference_seconds / 60
        psnr = psnr_of(Gaussians(**problem.cloud), judged, plan)
        say(f"  {asked.preset} x {asked.effort:g}, seed {seed}: {psnr:.2f} dB in {minutes:.2f} minutes")
        found[str(seed)] = {"psnr": psnr, "minutes": minutes, "gaussians": len(problem.cloud["means"])}
    width, height = judged[0].camera.size
    return {"pixels": [width, height], "views": len(judged), "steps": plan.steps, "seeds": found}


def photographs(folder: Path, asked: Fitted) -> Photos:
    """The photographs that are fitted, over white, with the box about what alpha shows.

    Raises:
        MivolError: no such folder.
    """
    if not folder.is_dir():
        raise MivolError(f"{folder} is not there: set MIVOL_DATA to the folder that holds multiview/chair.")
    photos = load_photos(folder, split="train", scale=asked.scale, background="white", space="srgb")
    return replace(photos, survey=replace(photos.survey, box=photos.silhouette_box()))


def asked_of(asked: Fitted) -> GaussianPlan:
    """The preset with the steps that are asked for."""
    return PRESETS[asked.preset].scaled(asked.effort)


def fitted(photos: Photos, plan: GaussianPlan, seed: int) -> GaussianProblem:
    """A fit of photographs by a plan, done."""
    plan = plan.for_edge(max(photos.views[0].camera.size))
    places, _ = find_start_points(photos, plan.start, seed)
    batches = RayBatches.of(photos.views, [stage.shrink for stage in plan.stages])
    start = make_start_cloud(places, photos.views, plan.stages[0].degree)
    problem = GaussianProblem(batches, [view.camera for view in photos.views], start, plan, seed)
    reconstruct(problem, plan.optimizer, plan.course())
    return problem


def psnr_of(cloud: Gaussians, judged: Sequence[Photo], plan: GaussianPlan) -> float:
    """Mean PSNR [dB] of Gaussians against photographs of one size, with the filter of the plan at that size."""
    settings = {"low_pass": plan.low_pass, "compensated": plan.mip}
    splatter, reals = Splatter(*judged[0].camera.size, cloud.degree, **settings), to_tensors(cloud)
    qualities = []
    for photo in judged:
        seen = np.array(splatter.forward(reals, photo.camera, derivatives=False)[0])
        picture = seen[..., :3] + (1 - seen[..., 3:]) * photo.background
        qualities.append(images.judge(picture, photo.image, space="srgb", metrics=("psnr",)))
    return float(images.score(qualities).values["psnr"])
