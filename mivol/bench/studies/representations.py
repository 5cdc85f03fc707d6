"""Photographs as grids, hash grids and Gaussians: how good, how soon, how large, and how fast to show?

    mivol bench representations            # an hour on 2 cores; a part of it without the chair
    mivol bench representations --quick    # under a minute, small sizes: the figures mean nothing

The photographs of the still life (200 x 200 pixels; missing photographs are rendered to runs/photographs) and of the chair
(same size, from MIVOL_DATA, default ../shared/data) are fitted as ``mivol optimize`` does with the settings of the presets. The
test views judge the fits, over white. Minutes and pixels per second hold for a machine walking 25 M rays per second through the
tutorial's smoke. Memory is the largest memory of Dr.Jit, without the photographs. Grids are rendered with one ray per pixel;
Gaussians are splatted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.bars import say_row
from mivol.bench.harness.figures import new_figure, show_images
from mivol.bench.harness.study import Study, amount, ask
from mivol.bench.harness.timing import Stopwatch, race, ratio_of
from mivol.bench.photo_fits import PhotoSize, find_photographs, fit_photographs, prepare_fit
from mivol.bench.reference_walk import REFERENCE_RATE
from mivol.experiments import field_fit
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.networks import Network
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.sampled_problem import SampledProblem
from mivol.photos import survey_photos
from mivol.points import Gaussians, write_gaussians


@dataclass(frozen=True)
class RepresentationSize(PhotoSize):
    """Amount of work."""

    edge: int = amount(200, 48, "longest edge of photographs and views [pixels]")
    grids: tuple[int, ...] = amount((64, 128), (16,), "nodes along the longest edge of the grids")
    hash_grids: tuple[str, ...] = amount(("minute", "minutes"), ("tiny",), "presets of the fits of hash grids")
    gaussians: tuple[str, ...] = amount(("minute", "minutes"), ("minute",), "presets of the fits of Gaussians")
    effort: float = amount(1.0, 0.02, "factor on the steps of the presets")
    samples: int = amount(1 << 17, 1 << 12, "samples of a hash grid")
    rounds: int = amount(7, 2, "timed calls with these samples")


def measure(name: str, size: RepresentationSize) -> dict:
    """Fit the photographs of a data set as grids, hash grids and Gaussians."""
    folder = find_photographs(name, size)
    if folder is None:
        return {}
    fits = {f"grid, {n} nodes": {"field": {"longest": n, "effort": size.effort}} for n in size.grids}
    fits |= {
        f"hash grid, {preset}": {"field": {"kind": "hash", "preset": preset, "effort": size.effort}}
        for preset in size.hash_grids
    }
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
        ``processor_seconds`` and ``walk_rays_per_second``; ``held_mib``; ``file_mib``; ``count`` of nodes,
        numbers of a hash grid, or Gaussians; for the figure the middle view and its photograph.
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
    """Number of nodes, numbers of a hash grid, or Gaussians, and the size of their files [bytes]."""
    with TemporaryDirectory() as folder:
        if isinstance(problem, RadianceProblem | SampledProblem):
            field_fit.write_result(Path(folder), problem)
            is_grid = isinstance(problem, RadianceProblem)
            count = problem.field.rows if is_grid else problem.field.numbers
        else:
            cloud = Gaussians(**problem.cloud)
            write_gaussians(Path(folder) / "gaussians.ply", cloud)
            count = cloud.count
        return count, sum(path.stat().st_size for path in Path(folder).iterdir())


def measure_sample_rates(size: RepresentationSize) -> dict:
    """How many samples a second does a hash grid take, with all derivatives, beside Dr.Jit's own derivatives?

    Points lie along rays, as in a fit. The peer is ``drjit.hashgrid`` with networks of ``drjit.nn``, differentiated by Dr.Jit.
    Rates are samples per second of processor time and thread.
    """
    count, sizes = size.samples, HashSizes()
    rng = np.random.default_rng(0)
    start = np.repeat(rng.random((3, -(-count // 32))), 32, axis=1)[:, :count]
    points = mi.Point3f(np.float32(0.9 * start + 0.003 * (np.arange(count) % 32)))
    directions = mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, count)
    by_sigma, by_colour = mi.Float(rng.normal(size=count)), mi.Color3f(rng.normal(size=(3, count)))
    dr.eval(points, directions, by_sigma, by_colour)
    field = HashField.random(sizes, np.eye(4))
    growth = (sizes.finest / sizes.coarsest) ** (1 / (sizes.levels - 1))
    peer = HashGridEncoding(
        mi.Float,
        3,
        n_levels=sizes.levels,
        n_features_per_level=sizes.features,
        hashmap_size=sizes.features << sizes.log2_table,
        base_resolution=sizes.coarsest,
        per_level_scale=growth,
    )
    density, colours = mi.Float(field.density_weights), mi.Float(field.colour_weights)

    def differentiate_peer(_: int) -> list[mi.Float]:
        dr.enable_grad(peer.data, density, colours)
        geometry = Network.eval_lanes(sizes.density_network.pack(density), list(peer(points)))
        inputs = [*geometry, *dr.sh_eval(directions, sizes.degree)]
        raw = Network.eval_lanes(sizes.colour_network.pack(colours), inputs)
        rgb = mi.Color3f(*(dr.rcp(1 + dr.exp(-v)) for v in raw))
        dr.backward(dr.sum(by_sigma * dr.exp(geometry[0]) + dr.dot(by_colour, rgb)))
        return [dr.grad(peer.data), dr.grad(density), dr.grad(colours)]

    contestants = {
        "mivol": lambda _: list(field.evaluate(points, directions).vjp(by_sigma, by_colour).values()),
        "drjit.hashgrid": differentiate_peer,
    }
    timings = race(contestants, size.rounds)
    rates = {name: count / float(np.median(timing.processor)) for name, timing in timings.items()}
    for name, rate in rates.items():
        say_row(name, samples_per_processor_second=rate, on_2_cores=2 * rate)
    return {"rates": rates, "ratio": ratio_of(timings["drjit.hashgrid"], timings["mivol"], "processor")}


def draw(answers: dict, path: Path) -> None:
    """Plot PSNR against minutes, and show a judged view of each fit beside its photograph."""
    rows = [(question, answer) for question, answer in answers.items() if answer and question != "samples"]
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
    "samples": measure_sample_rates,
    "still_life": ask("What are the photographs of the still life as grids, hash grids and Gaussians?", measure, "still_life"),
    "chair": ask("What are the photographs of the chair as the same models, if its data is here?", measure, "chair"),
}
STUDY = Study(__name__, __doc__, RepresentationSize, QUESTIONS, draw=draw)
