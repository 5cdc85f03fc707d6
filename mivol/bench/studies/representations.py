"""Photographs as grids and as Gaussians: how good, how soon, how large, and how fast to show?

    mivol bench representations            # 10 minutes on 2 cores; a quarter of it without the chair
    mivol bench representations --quick    # under a minute, small sizes: the figures mean nothing

The photographs of the still life (200 x 200 pixels; missing photographs are rendered to runs/photographs) and of the chair
(same size, from MIVOL_DATA, default ../shared/data) are fitted as ``mivol optimize`` does with the settings of the presets. The
test views judge the fits, over white. Minutes and pixels per second hold for a machine walking 25 M rays per second through the
tutorial's smoke. Memory is the largest memory of Dr.Jit, without the photographs. A grid is rendered with one ray per pixel;
Gaussians are splatted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.bars import say_row
from mivol.bench.harness.figures import new_figure, show_images
from mivol.bench.harness.study import Study, amount, ask
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.photo_fits import PhotoSize, find_photographs, fit_photographs, prepare_fit
from mivol.bench.reference_walk import REFERENCE_RATE
from mivol.experiments import field_fit
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import survey_photos
from mivol.points import Gaussians, write_gaussians


@dataclass(frozen=True)
class RepresentationSize(PhotoSize):
    """Amount of work."""

    edge: int = amount(200, 48, "longest edge of photographs and views [pixels]")
    grids: tuple[int, ...] = amount((64, 128), (16,), "nodes along the longest edge of the grids")
    gaussians: tuple[str, ...] = amount(("minute", "minutes"), ("minute",), "presets of the fits of Gaussians")
    effort: float = amount(1.0, 0.02, "factor on the steps of the presets")


def measure(name: str, size: RepresentationSize) -> dict:
    """Fit the photographs of a data set as grids and as Gaussians."""
    folder = find_photographs(name, size)
    if folder is None:
        return {}
    fits = {f"grid, {n} nodes": {"field": {"longest": n, "effort": size.effort}} for n in size.grids}
    fits |= {f"Gaussians, {preset}": {"gaussians": {"preset": preset, "effort": size.effort}} for preset in size.gaussians}
    answer = {}
    for label, settings in fits.items():
        answer[label] = figures = fit_and_judge(folder, settings, size)
        say_row(label, **{key: figures[key] for key in ("psnr", "minutes", "file_mib")})
    return answer


def fit_and_judge(folder: Path, settings: dict, size: RepresentationSize) -> dict:
    """Fit a folder of photographs, and measure.

    Returns:
        ``psnr`` [dB] and ``ssim`` of the test views; ``minutes`` and ``shown_pixels_per_second`` of the reference machine;
        ``processor_seconds`` and ``walk_rays_per_second``; ``held_mib``; ``file_mib``; ``count`` of nodes or Gaussians; for
        the figure the middle view and its photograph.
    """
    edge = max(survey_photos(folder, split="test").frames[0].camera.size)
    photos = {"background": "white", "judged": "test", "held_out": 0, "scale": min(size.edge / edge, 1.0)}
    prepared = prepare_fit(folder, photos, settings)
    done = fit_photographs(prepared.problem, size.walk_side)
    watch, views, images = Stopwatch(), prepared.judged.views, []
    prepared.show(views[0])  # compiles
    with watch:
        for view in views:
            images.append(prepared.show(view))
    pixels = len(views) * views[0].camera.size[0] * views[0].camera.size[1]
    middle = len(views) // 2
    count, file_bytes = store(prepared.problem)
    return {
        **prepared.score(views, ("psnr", "ssim")),
        "minutes": done.seconds / 60,
        "processor_seconds": done.processor,
        "walk_rays_per_second": done.rate,
        "shown_pixels_per_second": pixels / watch.processor * dr.thread_count() * REFERENCE_RATE / done.rate,
        "held_mib": done.held / 2**20,
        "file_mib": file_bytes / 2**20,
        "count": count,
        "view": images[middle],
        "photograph": views[middle].image,
    }


def store(problem: object) -> tuple[int, int]:
    """Number of nodes or Gaussians, and the size of their files [bytes]."""
    with TemporaryDirectory() as folder:
        if isinstance(problem, RadianceProblem):
            field_fit.write_result(Path(folder), problem)
            count = problem.field.rows
        else:
            cloud = Gaussians(**problem.cloud)
            write_gaussians(Path(folder) / "gaussians.ply", cloud)
            count = cloud.count
        return count, sum(path.stat().st_size for path in Path(folder).iterdir())


def draw(answers: dict, path: Path) -> None:
    """Plot PSNR against minutes, and show a judged view of each fit beside its photograph."""
    rows = [(question, answer) for question, answer in answers.items() if answer]
    if not rows:
        return
    columns = 2 + max(len(answer) for _, answer in rows)
    with new_figure(path, 2.6 * columns, 2.9 * len(rows)) as figure:
        for line, (question, answer) in zip(figure.subplots(len(rows), columns, squeeze=False), rows, strict=True):
            for name, figures in answer.items():
                line[0].plot(figures["minutes"], figures["psnr"], "o", label=name)
            line[0].set(xlabel="time [min]", ylabel="PSNR [dB]")
            line[0].xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            line[0].set_title(question)
            line[0].legend(fontsize=7)
            images = {"photograph": next(iter(answer.values()))["photograph"]}
            images |= {f"{name}: {figures['psnr']:.1f} dB": figures["view"] for name, figures in answer.items()}
            show_images(line[1:], images, fontsize=8)


QUESTIONS = {
    "still_life": ask("What are the photographs of the still life as grids and as Gaussians?", measure, "still_life"),
    "chair": ask("What are the photographs of the chair as grids and as Gaussians, if its data is here?", measure, "chair"),
}
STUDY = Study(__name__, __doc__, RepresentationSize, QUESTIONS, draw=draw)
