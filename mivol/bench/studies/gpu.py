"""How good and how fast are hash grids and NeRFs on a GPU?

    mivol bench gpu --variant cuda_ad_rgb    # a quarter of an hour; the JSON names the card and the date
    mivol bench gpu --quick                  # a minute on any machine: the figures mean nothing

samples: rate of a hash grid with the sizes of the preset ``gpu``, forward and backward with all derivatives, at points along
rays, with its table in half and in single precision. hash, nerf: the chair of NeRF-synthetic (from MIVOL_DATA) at 800 pixels,
100 photographs, presets ``gpu`` with as many steps as fit into a time, judged by 25 test views over white. The figure shows the
middle view. Times are wall times without compilation and without reading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Stopwatch
from mivol.bench.harness.figures import new_figure, show_images
from mivol.bench.harness.study import AT_LEAST, Promise, Study, amount, ask, say_row
from mivol.bench.photo_fits import PhotoSize, find_photographs, prepare_fit_in_time
from mivol.fields.hash_grid import HashField
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.sampled_problem import PRESETS
from mivol.photos import rectify, survey_photos


@dataclass(frozen=True)
class GpuSize(PhotoSize):
    """Amount of work."""

    data: str = amount("chair", "still_life", "photographs: chair or still_life")
    edge: int = amount(800, 24, "longest edge of photographs and views [pixels]")
    preset: str = amount("gpu", "tiny", "preset of the models")
    hash_seconds: float = amount(180.0, 1.0, "wall time of the fit of a hash grid [s]")
    nerf_seconds: float = amount(480.0, 1.0, "wall time of the fit of a NeRF [s]")
    samples: int = amount(1 << 20, 1 << 12, "samples of a call")
    calls: int = amount(20, 2, "timed calls")


def measure_rate(size: GpuSize) -> dict:
    """How many samples a second does a hash grid take, forward and backward?"""
    single = HashField.random(PRESETS["hash"][size.preset].sizes, np.eye(4))
    count, rng = size.samples, np.random.default_rng(0)
    start = np.repeat(rng.random((3, -(-count // 32))), 32, axis=1)[:, :count]
    points = mi.Point3f(np.float32(0.9 * start + 0.003 * (np.arange(count) % 32)))
    directions = mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, count)
    by_sigma, by_colour = mi.Float(rng.normal(size=count)), mi.Color3f(rng.normal(size=(3, count)))
    dr.eval(points, directions, by_sigma, by_colour)
    rates = {}
    for precision in ("half", "single"):
        field, watch = replace(single, precision=precision), Stopwatch()

        def call(field: HashField = field) -> None:
            dr.eval(field.evaluate(points, directions).vjp(by_sigma, by_colour))
            dr.sync_thread()

        call()  # compiles
        with watch:
            for _ in range(size.calls):
                call()
        rates[precision] = size.calls * count / watch.seconds
        say_row(f"hash grid, {precision} precision", samples_per_second=rates[precision])
    return {"samples_per_second": rates, "card": name_card()}


def measure_fit(kind: str, size: GpuSize) -> dict:
    """Fit the photographs in a time, and judge the test views."""
    folder = find_photographs(size.data, size)
    if folder is None:
        return {}
    edge = max(survey_photos(folder, split="test").frames[0].camera.size)
    photos = {"background": "white", "judged": "test", "held_out": 0, "scale": min(size.edge / edge, 1.0)}
    seconds = size.hash_seconds if kind == "hash" else size.nerf_seconds
    prepared = prepare_fit_in_time(folder, photos, {"kind": kind, "preset": size.preset}, seconds, clock="seconds")
    watch = Stopwatch()
    fit = begin_fit(prepared.problem, prepared.problem.plan.optimizer, prepared.problem.plan.course())
    with watch:
        fit.complete()
    views = [rectify(view) for view in prepared.judged.views]
    middle = views[len(views) // 2]
    answer = {**prepared.score(views, ("psnr", "ssim")), "steps": prepared.steps, "seconds": watch.seconds}
    say_row(kind, **answer)
    return answer | {"card": name_card(), "view": prepared.show(middle), "photograph": middle.image}


def name_card() -> str:
    """The name of the graphics card, or of the back end without one."""
    if dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return mi.variant()
    facts = [path.read_text() for path in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))]
    return next((line.split(":", 1)[1].strip() for line in "\n".join(facts).splitlines() if line.startswith("Model:")), "a GPU")


def table(question: str, answer: dict) -> list[str]:
    """A row of the table of the docs."""
    if question == "samples":
        rates = answer["samples_per_second"].items()
        return [f"| hash grid, forward and backward, {k} | {v / 1e6:.1f} M samples/s | {answer['card']} |" for k, v in rates]
    if not answer:
        return []
    return [f"| {question} | {answer['psnr']:.2f} dB / {answer['ssim']:.3f} in {answer['seconds']:.0f} s | {answer['card']} |"]


def draw(answers: dict, path: Path) -> None:
    """The middle view of each fit beside its photograph."""
    fits = {name: answer for name, answer in answers.items() if "view" in answer}
    if not fits:
        return
    with new_figure(path, 3 * (1 + len(fits)), 3.2) as figure:
        images = {"photograph": next(iter(fits.values()))["photograph"]}
        images |= {f"{name}: {answer['psnr']:.1f} dB": answer["view"] for name, answer in fits.items()}
        show_images(list(figure.subplots(1, len(images))), images, fontsize=8)


QUESTIONS = {
    "samples": measure_rate,
    "hash": ask("How good is a hash grid of the chair at 800 pixels after three minutes?", measure_fit, "hash"),
    "nerf": ask("How good is a NeRF of the chair at 800 pixels after eight minutes?", measure_fit, "nerf"),
}
PROMISES = {
    "samples": [Promise("samples per second of a hash grid [M]", ("samples_per_second", "half"), AT_LEAST, 10, 1e-6)],
    "hash": [Promise("hash grid, chair at 800 pixels [dB]", ("psnr",), AT_LEAST, 34.5)],
    "nerf": [Promise("NeRF, chair at 800 pixels [dB]", ("psnr",), AT_LEAST, 31)],
}
STUDY = Study(__name__, __doc__, GpuSize, QUESTIONS, draw=draw, table=table, promises=PROMISES)
