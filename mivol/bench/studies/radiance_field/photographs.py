"""What photographs become with the settings that every fit has: held-out views, time, memory, and what one step takes.

Conventions. Seconds are of processor time, shared out among the threads, of a machine that walks ``WALK`` rays a second through
the tutorial's smoke on all of them: the walk is timed before and after each fit, by processor time too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import config
from mivol.bench.extinctions import DATA, smoke
from mivol.bench.harness.bars import AT_LEAST, AT_MOST, Bar, judge, say
from mivol.bench.harness.timing import Stopwatch, race
from mivol.bench.studies.optical_depth.work import Work, camera_rays
from mivol.bench.studies.points import WALK
from mivol.bench.studies.radiance_field.size import PhotoFit, Size
from mivol.bench.studies.still_life import photographer
from mivol.experiments.field_plan import batches_of, make_plan, suited
from mivol.experiments.photo_data import boxed, read_photos
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import estimate_bytes
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Photo
from mivol.validate import images

__all__ = ["Finished", "ask_photographs", "bars_of", "finished", "photographs_of"]

LEAST = {
    "chair at 128": [("psnr", AT_LEAST, 30.2), ("seconds", AT_MOST, 60), ("step_milliseconds", AT_MOST, 70)],
    "chair at 256": [("psnr", AT_LEAST, 31.3), ("seconds", AT_MOST, 300), ("held_gib", AT_MOST, 1.5)],
    "chair, fine": [("psnr", AT_LEAST, 32.0), ("seconds", AT_MOST, 1200), ("held_gib", AT_MOST, 16)],
}
"""Figures that have a bar, by fit."""

ROUNDS = 8
"""Steps, and walks, of which the median is taken."""


def ask_photographs(size: Size) -> dict:
    """What do held-out views look like, after how long, and what does a fit hold?"""
    answer = {}
    for asked in size.photo_fits:
        folder = photographs_of(asked.name, size)
        if folder is None:
            say(f"  {asked.name}: left out, its data is not here (MIVOL_DATA names the folder)")
            continue
        found = answer[str(asked)] = fitted(folder, asked, size)
        say(f"  {asked}: {found['psnr']:.2f} dB, {found['seconds']:.0f} s, {found['counted_gib']:.2f} GiB")
    return answer


def photographs_of(name: str, size: Size) -> Path | None:
    """The folder of a data set, made where it can be; None where it is neither here nor can be made."""
    if name == "chair":
        folder = DATA / "multiview" / "chair"
        return folder if folder.is_dir() else None
    photographer().make(size.photo_folder / name, size.photo_views, size.photo_side, size.photo_spp, name)
    return size.photo_folder / name


def fitted(folder: Path, asked: PhotoFit, size: Size) -> dict:
    """Fit a data set as ``mivol optimize`` does, and measure.

    Returns:
        ``psnr`` [dB] and ``ssim`` of the test views, ``train_psnr`` of some that were fitted; ``seconds`` as the module says,
        ``processor_seconds``, ``walk_rays_per_second``; ``step_milliseconds`` of processor time, of the last stage, and its
        ``step_rays``; ``counted_gib`` by the plan for the rows kept, and ``held_gib`` by Dr.Jit, both beyond the photographs.
    """
    photos = {"path": str(folder), "background": "white", "judged": "test", "held_out": 0}
    field = {"preset": asked.preset, "effort": asked.effort}
    chosen = config.from_dict({"title": folder.name, "photos": photos, "field": field})
    shown, judged = read_photos(chosen, Path())
    shown = boxed(chosen, shown)
    plan = make_plan(chosen)
    plan = suited(plan if asked.longest is None else plan.with_longest(asked.longest), shown)
    problem = RadianceProblem(batches_of(plan, shown), shown.box, plan)
    done, last = finished(problem, size.walk_side), plan.stages[-1]
    return {
        **seen(problem, judged.views),
        "train_psnr": seen(problem, shown.views[:: max(1, len(shown.views) // 8)])["psnr"],
        "seconds": done.seconds,
        "processor_seconds": done.processor,
        "walk_rays_per_second": done.rate,
        "step_milliseconds": 1e3 * step_seconds(done.fit),
        "step_rays": 16 * min(last.views, len(shown.views)) * last.tiles,
        "rows": problem.field.rows,
        "counted_gib": estimate_bytes(plan, last, shown.box, problem.field.rows) / 2**30,
        "held_gib": done.held / 2**30,
    }


@dataclass(frozen=True)
class Finished:
    """A fit that is over.

    Attributes:
        fit: the fit.
        processor: time of all threads [s].
        rate: rays a second that the machine walks.
        seconds: as the module says.
        held: most bytes that Dr.Jit held, beyond what was there before.
    """

    fit: Fit
    processor: float
    rate: float
    held: int

    @property
    def seconds(self) -> float:
        """Of the fit, as the module says."""
        return self.processor / dr.thread_count() * self.rate / WALK


def finished(problem: RadianceProblem | GaussianProblem, walk_side: int) -> Finished:
    """Take all steps of a fit, and measure them."""
    watch, walked = Stopwatch(), [walk_rate(walk_side)]
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    backend = dr.backend_v(mi.Float)
    before = dr.detail.malloc_watermark(backend)
    fit = begin_fit(problem, problem.plan.optimizer, problem.plan.course())
    with watch:
        fit.complete()
    held = dr.detail.malloc_watermark(backend) - before
    walked.append(walk_rate(walk_side))
    return Finished(fit, watch.processor, float(np.mean(walked)), held)


def seen(problem: RadianceProblem, views: tuple[Photo, ...]) -> dict[str, float]:
    """PSNR and SSIM of views, each a mean over them."""
    shown = [render_view(problem.field, view.camera, view.background).image for view in views]
    pairs = zip(shown, views, strict=True)
    return images.score([images.judge(a, b.image, space="srgb", metrics=("psnr", "ssim")) for a, b in pairs]).values


def step_seconds(fit: Fit) -> float:
    """Processor time of a step more, the median of a few [s]; the fit is over, and its reals are dropped."""
    run, times = fit.run, []
    for number in range(ROUNDS):
        with Stopwatch() as watch:
            run.step(fit.next_iteration + number, 1.0)
            dr.sync_thread()
        times.append(watch.processor)
    return float(np.median(times))


def walk_rate(side: int) -> float:
    """Rays a second through the tutorial's smoke on all threads, by processor time; there are ``side`` squared of them."""
    work = Work(smoke().values, *camera_rays(side))
    walk = race({"walk": work.tau()}, ROUNDS)["walk"]
    return work.n * dr.thread_count() / float(np.median(walk.processor))


def bars_of(answer: dict) -> list[Bar]:
    """The figures that have a bar."""
    return [
        judge(f"{fit}: {figure}", answer[fit][figure], sense, bar)
        for fit, bars in LEAST.items()
        if fit in answer
        for figure, sense, bar in bars
    ]
