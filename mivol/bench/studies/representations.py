"""What do the same photographs become as grids and as Gaussians: how good, how soon, how large, how fast to show?

    scripts/bench_representations.py            # 10 minutes on 2 cores; a quarter of it without the chair
    scripts/bench_representations.py --quick    # under a minute, small sizes: its figures mean nothing

The still life's photographs (200 x 200 pixels, made where they are missing, in runs/photographs) and, where MIVOL_DATA
(default ../shared/data) has it, the chair's at the same size are fitted as ``mivol optimize`` does with the presets' settings,
and judged by the test views, over white. Minutes and pixels a second are of processor time, shared out among the threads, of a
machine that walks 25 M rays a second through the tutorial's smoke. Memory is what Dr.Jit held at most, beyond the photographs.
A view is that of a pinhole, of one ray, or one splatted picture, a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
import numpy as np
from matplotlib.ticker import MaxNLocator

from mivol import config
from mivol.bench.harness.bars import Bar, say
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.studies.points import WALK
from mivol.bench.studies.radiance_field.photographs import finished, photographs_of
from mivol.bench.studies.radiance_field.size import FULL as PHOTOGRAPHS
from mivol.bench.studies.radiance_field.size import QUICK as QUICK_PHOTOGRAPHS
from mivol.bench.studies.radiance_field.size import Size as PhotoSize
from mivol.config import FieldExperiment, GaussianExperiment
from mivol.experiments import field_fit, gaussian_fit
from mivol.experiments.field_plan import batches_of, make_plan, suited
from mivol.experiments.gaussian_fit import begin, make_gaussian_plan
from mivol.experiments.photo_data import boxed, read_photos
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Photo, Photos, survey_photos
from mivol.points import Gaussians, write_gaussians
from mivol.validate import images

__all__ = ["BENCH", "FULL", "QUICK", "Size", "main"]


@dataclass(frozen=True)
class Size:
    """How much is fitted.

    Attributes:
        name: for the JSON.
        photographs: of data sets that are made, and the walk.
        edge: longest edge of photographs and views [pixels].
        grids: nodes along the longest edge of the grids.
        gaussians: presets of the fits of Gaussians.
        effort: share of the presets' steps.
    """

    name: str = "full"
    photographs: PhotoSize = PHOTOGRAPHS
    edge: int = 200
    grids: tuple[int, ...] = (64, 128)
    gaussians: tuple[str, ...] = ("minute", "minutes")
    effort: float = 1.0


FULL = Size()
QUICK = Size("quick", QUICK_PHOTOGRAPHS, 48, (16,), ("minute",), 0.02)


@dataclass(frozen=True)
class Found:
    """What photographs have become.

    Attributes:
        show: a photograph -> what its camera sees, (H, W, 3).
        write: writes it into a folder.
        count: nodes, or Gaussians.
    """

    show: Callable[[Photo], np.ndarray]
    write: Callable[[Path], None]
    count: int


def measure_still_life(size: Size) -> dict:
    """What do the still life's photographs become?"""
    return _measure("still_life", size)


def measure_chair(size: Size) -> dict:
    """What do the chair's photographs become, where they are here?"""
    return _measure("chair", size)


def _measure(name: str, size: Size) -> dict:
    folder = photographs_of(name, size.photographs)
    if folder is None:
        say(f"  {name}: left out, its data is not here (MIVOL_DATA names the folder)")
        return {}
    asked = {f"grid, {n} nodes": {"field": {"longest": n, "effort": size.effort}} for n in size.grids}
    asked |= {f"Gaussians, {preset}": {"gaussians": {"preset": preset, "effort": size.effort}} for preset in size.gaussians}
    answer = {}
    for what, settings in asked.items():
        answer[what] = found = _fit_and_judge(folder, settings, size)
        say(f"  {what}: {found['psnr']:.2f} dB, {found['minutes']:.2f} minutes, {found['file_mib']:.1f} MiB")
    return answer


def _fit_and_judge(folder: Path, settings: dict, size: Size) -> dict:
    """Fit a folder of photographs as ``mivol optimize`` does with these settings, and measure.

    Returns:
        ``psnr`` [dB] and ``ssim`` of the test views; ``minutes`` and ``shown_pixels_per_second`` as the module says;
        ``processor_seconds`` and ``walk_rays_per_second``; ``held_mib``; ``file_mib``; ``count`` of nodes or Gaussians; for
        the figure the middle view and its photograph.
    """
    photos = {"path": str(folder), "background": "white", "judged": "test", "held_out": 0}
    edge = max(survey_photos(folder, split="test").frames[0].camera.size)
    photos["scale"] = min(size.edge / edge, 1.0)
    chosen = config.from_dict({"title": folder.name, "photos": photos, **settings})
    shown, judged = read_photos(chosen, Path())
    shown = boxed(chosen, shown)
    fitted = _fit_grid if isinstance(chosen, FieldExperiment) else _fit_gaussians
    problem, result = fitted(chosen, shown)
    done = finished(problem, size.photographs.walk_side)
    found, watch, views = result(), Stopwatch(), judged.views
    found.show(views[0])  # compiles
    pictures = []
    with watch:
        for photo in views:
            pictures.append(found.show(photo))
    pairs = zip(pictures, views, strict=True)
    values = images.score([images.judge(a, b.image, space="srgb", metrics=("psnr", "ssim")) for a, b in pairs]).values
    with TemporaryDirectory() as place:
        found.write(Path(place))
        bytes_ = sum(path.stat().st_size for path in Path(place).iterdir())
    pixels = len(views) * views[0].camera.size[0] * views[0].camera.size[1]
    middle = len(views) // 2
    return {
        **values,
        "minutes": done.seconds / 60,
        "processor_seconds": done.processor,
        "walk_rays_per_second": done.rate,
        "shown_pixels_per_second": pixels / watch.processor * dr.thread_count() * WALK / done.rate,
        "held_mib": done.held / 2**20,
        "file_mib": bytes_ / 2**20,
        "count": found.count,
        "view": pictures[middle],
        "photograph": views[middle].image,
    }


def _fit_grid(chosen: FieldExperiment, photos: Photos) -> tuple[RadianceProblem, Callable[[], Found]]:
    """The fit of a grid, and what it has found once it is over."""
    plan = suited(make_plan(chosen), photos)
    problem = RadianceProblem(batches_of(plan, photos), photos.box, plan)

    def found() -> Found:
        return Found(
            lambda photo: render_view(problem.field, photo.camera, photo.background).image,
            lambda folder: field_fit.save_found(folder, problem),
            problem.field.rows,
        )

    return problem, found


def _fit_gaussians(chosen: GaussianExperiment, photos: Photos) -> tuple[GaussianProblem, Callable[[], Found]]:
    """The fit of Gaussians, and what it has found once it is over."""
    begun = begin(chosen, photos, make_gaussian_plan(chosen))
    problem = begun.problem(chosen.seed)
    low_pass = begun.plan.low_pass

    def found() -> Found:
        cloud = Gaussians(**problem.cloud)
        return Found(
            lambda photo: gaussian_fit.picture_of(problem, photo.camera, photo.background, low_pass),
            lambda folder: write_gaussians(folder / "gaussians.ply", cloud),
            cloud.count,
        )

    return problem, found


def compare(question: str, answer: dict) -> list[Bar]:
    """No figure has a bar here: those of one representation alone have theirs in its own bench."""
    return []


def draw(answers: dict, folder: Path) -> None:
    """PSNR against minutes, and a judged view of each beside its photograph."""
    rows = [(question, answer) for question, answer in answers.items() if answer]
    if not rows:
        return
    columns = 2 + max(len(answer) for _, answer in rows)
    with drawn(folder / "bench_representations.png", 2.6 * columns, 2.9 * len(rows)) as figure:
        for line, (question, answer) in zip(figure.subplots(len(rows), columns, squeeze=False), rows, strict=True):
            for name, found in answer.items():
                line[0].plot(found["minutes"], found["psnr"], "o", label=name)
            line[0].set_xlabel("time [min]")
            line[0].xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            line[0].set_ylabel("PSNR [dB]")
            line[0].set_title(question)
            line[0].legend(fontsize=7)
            pictures = {"photograph": next(iter(answer.values()))["photograph"]}
            pictures |= {f"{name}: {found['psnr']:.1f} dB": found["view"] for name, found in answer.items()}
            for axis in line[1:]:
                axis.set_axis_off()
            for axis, (title, picture) in zip(line[1:], pictures.items(), strict=False):
                axis.imshow(np.clip(picture, 0, 1))
                axis.set_title(title, fontsize=8)


QUESTIONS = {"still_life": measure_still_life, "chair": measure_chair}
BENCH = Bench("bench_representations", __doc__, QUESTIONS, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
