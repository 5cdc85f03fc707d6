"""Fits of photographs as ``mivol optimize`` makes them: quality of held-out views, time on the reference machine, memory.

Conventions. Times are processor time, converted to seconds of the machine of :mod:`mivol.bench.scenes`. The walk is
timed before and after each fit. Memory is the largest memory of Dr.Jit, without the photographs. Views are judged over white.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import config
from mivol.bench.harness.contests import Stopwatch
from mivol.bench.harness.study import Size, amount, say
from mivol.bench.scenes import CHECKOUT, DATA, measure_walk_rate, reference_seconds
from mivol.errors import MivolError
from mivol.experiments import gaussian_fit
from mivol.experiments.field_fit import adapt_plan, make_batches, make_radiance_plan
from mivol.experiments.gaussian_fit import make_gaussian_plan, start_gaussians
from mivol.experiments.octree_fit import adapt_octree_plan, find_preset, make_octree_plan
from mivol.experiments.photo_data import add_box, read_photos
from mivol.experiments.sampled_fit import make_sampled_plan, make_sampled_problem
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.octree_problem import OctreeProblem
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.sampled_problem import SampledProblem
from mivol.photos import Photo, Photos, rectify
from mivol.validate.metrics import ImageScore, average_scores, score_image

__all__ = [
    "FittedProblem",
    "TimedFit",
    "PhotoProblem",
    "PhotoSize",
    "find_data",
    "find_photographs",
    "fit_photographs",
    "load_photographer",
    "prepare_fit",
    "prepare_fit_in_time",
]

SCRIPT = CHECKOUT / "scenes" / "still_life" / "photographs.py"


PUBLIC = "chair", "fox"
"""Public data sets of photographs, read from MIVOL_DATA."""


def load_photographer() -> ModuleType:
    """Load the script that renders the photographs of the still life.

    Raises:
        MivolError: the script is missing, because mivol was installed without its checkout.
    """
    if not SCRIPT.is_file():
        raise MivolError(f"{SCRIPT} is missing; run this study in a checkout of mivol, which has the scene.")
    spec = importlib.util.spec_from_file_location("still_life", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def find_data(name: str) -> Path:
    """Folder of a data set of photographs in MIVOL_DATA.

    Raises:
        MivolError: the folder is missing.
    """
    folder = DATA / "multiview" / name
    if not folder.is_dir():
        raise MivolError(f"{folder} is missing: set MIVOL_DATA to the folder that holds multiview/{name}.")
    return folder


@dataclass(frozen=True)
class PhotoSize(Size):
    """Amount of work of fits of photographs."""

    photo_folder: str = amount("runs/photographs", "runs/quick_photographs", "folder of rendered photographs")
    photo_views: int = amount(75, 15, "number of rendered photographs")
    photo_side: int = amount(200, 48, "edge of rendered photographs [pixels]")
    photo_spp: int = amount(32, 2, "samples per pixel of rendered photographs")
    walk_side: int = amount(1024, 64, "the reference walk has the square of this number of rays")


def find_photographs(name: str, size: PhotoSize) -> Path | None:
    """Folder of a data set: chair or fox from MIVOL_DATA, or photographs of another scene, rendered if they are missing.

    Args:
        name: a word of ``PUBLIC``, or a scene of the still life's script.
        size: folder, number, edge and samples of rendered photographs.

    Returns:
        The folder; None if a public data set is missing, which is printed.
    """
    if name in PUBLIC:
        if (DATA / "multiview" / name).is_dir():
            return DATA / "multiview" / name
        say(f"  {name}: left out, its data is missing (MIVOL_DATA names the folder)")
        return None
    folder = Path(size.photo_folder) / name
    load_photographer().make(folder, size.photo_views, size.photo_side, size.photo_spp, name)
    return folder


FittedProblem = RadianceProblem | OctreeProblem | SampledProblem | GaussianProblem
"""A fit of photographs, by one of the models."""


@dataclass(frozen=True)
class PhotoProblem:
    """A fit before the first step.

    Attributes:
        problem: the fitted model.
        train, judged: photographs to fit and to judge by.
        steps: number of steps.
    """

    problem: FittedProblem
    train: Photos
    judged: Photos
    steps: int

    def show(self, photo: Photo) -> np.ndarray:
        """Render the view of a pinhole photograph (H, W, 3) over its background, or over the fitted sky."""
        if not isinstance(self.problem, GaussianProblem):
            return render_view(self.problem.field, photo.camera, self.problem.sky or photo.background).image
        return gaussian_fit.render_gaussians(self.problem, photo.camera, photo.background, self.problem.plan.low_pass)

    def score(self, views: Iterable[Photo], metrics: tuple[str, ...] = ("psnr",)) -> dict[str, float]:
        """Mean metrics of views."""
        return average_scores([self.judge(self.show(view), view, metrics) for view in map(rectify, views)]).values

    def judge(self, image: np.ndarray, view: Photo, metrics: tuple[str, ...] = ("psnr",)) -> ImageScore:
        """Compare an image with the photograph of the same view."""
        return score_image(image, view.image, space=self.judged.space, mask=view.mask, metrics=metrics)


def prepare_fit(
    folder: Path,
    photos: dict,
    settings: dict,
    seed: int = 0,
    adapt: Callable[[Any], Any] = lambda plan: plan,
    change: Callable[[Photos], Photos] = lambda photos: photos,
) -> PhotoProblem:
    """Read photographs and prepare their fit.

    Args:
        folder: folder of the photographs.
        photos: settings of the table ``photos``, besides the path.
        settings: the table ``field`` or ``gaussians``, by its name.
        seed: seed of the fit.
        adapt: changes the plan of a grid or of Gaussians, before it is adapted to the photographs.
        change: changes the photographs to fit, or their box.
    """
    tables = {"title": folder.name, "seed": seed, "photos": {"path": str(folder), **photos}, **settings}
    chosen = config.from_dict(tables)
    train, judged = read_photos(chosen, Path())
    train = change(add_box(chosen, train))
    if isinstance(chosen, config.FieldExperiment):
        plan = adapt_plan(adapt(make_radiance_plan(chosen)), train)
        problem = RadianceProblem(make_batches(plan, train), train.box, plan, seed)
        return PhotoProblem(problem, train, judged, sum(stage.steps for stage in plan.stages))
    if isinstance(chosen, config.OctreeExperiment):
        planned, _, batches = adapt_octree_plan(make_octree_plan(chosen), find_preset(chosen.field), train)
        return PhotoProblem(OctreeProblem(batches, train.box, planned, seed), train, judged, planned.steps)
    if isinstance(chosen, config.HashExperiment | config.NerfExperiment):
        problem = make_sampled_problem(make_sampled_plan(chosen), train, seed)
        return PhotoProblem(problem, train, judged, problem.plan.steps)
    begun = start_gaussians(chosen, train, adapt(make_gaussian_plan(chosen)))
    return PhotoProblem(begun.problem(seed), train, judged, begun.plan.steps)


TIMED_STEPS = 20
"""Steps that are timed before a fit in a given time; as many before them compile."""


def prepare_fit_in_time(folder: Path, photos: dict, field: dict, seconds: float, clock: str = "processor") -> PhotoProblem:
    """Prepare a fit of a field with as many steps as fit into a time, and with the whole course of its learning rates.

    Args:
        folder, photos: as of :func:`prepare_fit`.
        field: the table ``field``, without an effort.
        seconds: the time, without that of the timed steps.
        clock: attribute of a :class:`Stopwatch`: "processor" or "seconds".
    """
    pilot, watch = prepare_fit(folder, photos, {"field": field}), Stopwatch()
    begun = begin_fit(pilot.problem, pilot.problem.plan.optimizer, pilot.problem.plan.course())
    for timed in (False, True):
        with watch if timed else nullcontext():
            for _ in range(TIMED_STEPS):
                begun.advance()
    effort = seconds * TIMED_STEPS / getattr(watch, clock) / pilot.steps
    return prepare_fit(folder, photos, {"field": field | {"effort": effort}})


@dataclass(frozen=True)
class TimedFit:
    """A finished fit and its cost.

    Attributes:
        fit: the fit.
        processor: processor time of all threads [s].
        rate: rays per second that this machine walks.
        seconds: time on the reference machine [s].
        held: largest memory of Dr.Jit, without the photographs [bytes].
    """

    fit: Fit
    processor: float
    rate: float
    held: int

    @property
    def seconds(self) -> float:
        """Time on the reference machine [s]."""
        return reference_seconds(self.processor, self.rate)


def fit_photographs(problem: FittedProblem, walk_side: int) -> TimedFit:
    """Take all steps of a fit, and measure them.

    Args:
        problem: fit before the first step.
        walk_side: the reference walk has ``walk_side`` squared rays.
    """
    watch, rates = Stopwatch(), [measure_walk_rate(walk_side)]
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    fit = begin_fit(problem, problem.plan.optimizer, problem.plan.course())
    with watch:
        fit.complete()
    held = dr.detail.malloc_watermark(dr.backend_v(mi.Float)) - before
    rates.append(measure_walk_rate(walk_side))
    return TimedFit(fit, watch.processor, float(np.mean(rates)), held)
