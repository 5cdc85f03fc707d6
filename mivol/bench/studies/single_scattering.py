"""Light that scatters once: how much sooner does mivol reach an error than Mitsuba's ``volpath`` and ``prbvolpath``?

    scripts/bench_single_scattering.py                    # 5 minutes on 2 idle cores
    scripts/bench_single_scattering.py --quick            # half a minute, small sizes: are the means the same?
    scripts/bench_single_scattering.py --only smoke       # one of the volumes

Four kinds of light in five volumes, albedo 0.75, all integrators with ``max_depth`` 2, through ``mi.render``, pictures of
64 x 64 pixels (point lights: 24 x 24) with a box filter and independent samples. The volumes fill [-1, 1]^3: the smoke of the
Mitsuba tutorial at its density (x 40); the same upsampled to 256^3, where an exact walk has five times the cells to cross and
delta tracking nothing more to do; a CT of 256^3, and threads in 512^3 that leave 99 % of it empty, both with the largest
extinction of the smoke, so that delta tracking has as many steps to take (and with empty outermost voxels: Mitsuba loses a skin
at a boundary); a cloud of a large-eddy simulation.

Equal error. The error of an unbiased estimate falls with the root of the time, so variance x time is a number of the method
alone. Each integrator gets the samples per pixel (a power of two) that take 0.8 s of processor time; then all render in turns,
warm, in 8 rounds, every render with another seed. Of the 8 images each pixel has its variance (mean over the channels); time is
the ratio of two renders of one round by processor time, which a busy machine moves less than the clock, median over the rounds.
Printed are

    variance x time, mean over pixels      ratio of the means of the variances, times the ratio of times
    variance x time, median over pixels    median of the ratios of the variances, times the ratio of times

The bar is on the first, but for point lights, near which the mean does not exist: there it is on the second, and the picture is
small, so that each pixel has samples enough to show the long tail of its variance (from 32 samples ``volpath`` seems to have
half the variance that it shows in 500). Only pixels that see the medium count (a mean optical depth above 0.01), and none
within a pixel and a half of an emitter inside it. A pixel in which the other integrator found no light in 8 images counts as a
ratio of 0. Beside each ratio stands what it is by the clock, as a share.

Equality. Beside every ratio stands z: the difference of the means over those pixels in standard errors, with the relative
standard error, which says how small a bias it could have seen. Where an emitter stands inside, most of the mean comes from
samples that are rare (through dense matter) or without bound (near the emitter), and no number of rounds makes it normal.
There the means of the same volume are compared after it was thinned to an optical depth of 1 at most, and truncated to pixels
beyond a quarter of the picture from the emitter. If any z of a run is beyond its bound by Student's t with effective degrees
of freedom (a false alarm in one run in 1000), the script ends with status 1: then the ratios mean nothing. Samples are camera
paths, per second of a warm render.

Prints JSON; writes bench_single_scattering.json and bench_single_scattering.png (error against time in the smoke, and the
ratios of all volumes). Data is read from MIVOL_DATA (default ../shared/data); where it is missing made-up fields take its
place, and the JSON says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.extinctions import (
    Extinction,
    as_dense_as_smoke,
    ct_scan,
    fine_smoke,
    les_cloud,
    smoke,
    threads_in_space,
)
from mivol.bench.harness.agreement import compare_means, mean_of_pixels, number
from mivol.bench.harness.bars import AT_LEAST, Bar, judge, judge_agreement, say
from mivol.bench.harness.figures import drawn, plain_ticks
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import Budget, Timing, race, ratio_of
from mivol.bench.scenes import box_scene, constant_light, of_depth, point_light, sun_and_sky
from mivol.report.figures import MARKERS, SERIES
from mivol.validate.moments import Moments

__all__ = [
    "BENCH",
    "FULL",
    "LIGHTS",
    "QUICK",
    "STOCK",
    "VOLUMES",
    "Light",
    "Size",
    "contend",
    "draw_errors",
    "main",
    "said",
]

ALBEDO = 0.75
OURS = "mivol"
STOCK = ("volpath", "prbvolpath")
SEEN = 0.01
"""Mean optical depth of a pixel from which on it counts."""

AT_EMITTER, TRUNCATED = 1.5, 0.25
"""Pixels so near to an emitter inside do not count [pixels], and are left out of the means compared [share of a side]."""


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        rounds: images of each integrator.
        most_pixels: along the side of a picture, at most.
        budget: samples of one render.
        levels: the samples are divided by these, for curves of error against time.
        fine_res, sparse_res: voxels along an edge of the fine volumes, and of the threads.
        seed: of all renders; another one gives independent images.
    """

    name: str = "full"
    rounds: int = 8
    most_pixels: int = 64
    budget: Budget = field(default=Budget(seconds=0.8))
    levels: tuple[int, ...] = (1, 4, 16)
    fine_res: int = 256
    sparse_res: int = 512
    seed: int = 0


FULL = Size()
QUICK = Size(name="quick", most_pixels=16, budget=Budget(seconds=0.02), levels=(1, 4), fine_res=48, sparse_res=64)


# -- Emitters and volumes -----------------------------------------------------------------------------------------------------


class Light(NamedTuple):
    """An emitter and a phase function.

    Attributes:
        parts: of the scene.
        bar: how many times sooner mivol has to be.
        by_pixel: judge the median over pixels, where the mean of their variances does not exist.
        side: of the picture [pixels].
        inside: where an emitter stands in the medium.
        albedo: of the medium.
        depth: ``max_depth`` of all integrators; -1 for no limit.
        peers: Mitsuba's integrators that take part.
        has_tails: where the means of no number of rounds are normal, so that they are compared in the thinned volume.
    """

    parts: Callable[[], dict]
    bar: float
    by_pixel: bool = False
    side: int = 64
    inside: tuple[float, float, float] | None = None
    albedo: float | tuple[float, ...] = ALBEDO
    depth: int = 2
    peers: tuple[str, ...] = STOCK
    has_tails: bool = False

    @property
    def average(self) -> str:
        """What the bar is on, over pixels."""
        return "median" if self.by_pixel else "mean"


INSIDE, NEAR = (0.3, -0.5, 0.2), (0.9, -1.3, 1.2)

LIGHTS = {
    "constant light": Light(constant_light, 50),
    "HG 0.8, sun in a sky": Light(sun_and_sky, 30),
    "point light inside": Light(lambda: point_light(INSIDE), 100, True, 24, INSIDE),
    "point light near": Light(lambda: point_light(NEAR), 100, True, 24),
}

VOLUMES: dict[str, Callable[[Size], Extinction]] = {
    "smoke": lambda _: smoke(),
    "fine smoke": lambda size: fine_smoke(size.fine_res),
    "CT": lambda size: as_dense_as_smoke(ct_scan(size.fine_res)),
    "threads": lambda size: as_dense_as_smoke(threads_in_space(size.sparse_res)),
    "cloud": lambda _: les_cloud(),
}


# -- Contests --------------------------------------------------------------------------------------------------------------


def contend(values: np.ndarray, light: Light, size: Size, levels: tuple[int, ...] = (1,)) -> dict:
    """Variance and time of each integrator, and what they mean for mivol.

    Args:
        values: (Z, Y, X) extinction of the box, or (3,) of a homogeneous medium in rgb.
        light: emitter and phase function.
        size: pixels, samples and rounds.
        levels: see ``Size.levels``; the first one, 1, is what ratios are of.
    """
    side = min(light.side, size.most_pixels)
    scene = mi.load_dict(box_scene(values, side, light.albedo, **light.parts()))
    timings, spp = render_in_turns(scene, size, levels, light)
    tau, away = optical_depths(without_surfaces(values, light, side)), pixels_from_emitter(scene, light, side)
    counts = (tau > SEEN) & (away > AT_EMITTER)
    figures = {"pixels_that_count": int(counts.sum())}
    for name in (OURS, *light.peers):
        figures[name] = [{"spp": spp[name, k]} | errors(timings[name, k], counts, spp[name, k]) for k in levels]
    compared, fair = timings, counts
    if light.inside is not None or light.has_tails:
        thinned = mi.load_dict(box_scene(values * np.float32(min(1, 1 / tau.max())), side, light.albedo, **light.parts()))
        compared, _ = render_in_turns(thinned, size, (1,), light)
        fair = (tau > SEEN) & (away > TRUNCATED * side)
    for name in light.peers:
        ratios = gain(timings[name, 1], timings[OURS, 1], counts)
        figures[f"mivol over {name}"] = ratios | difference(compared[name, 1], compared[OURS, 1], fair)
    return figures


def without_surfaces(values: np.ndarray, light: Light, side: int) -> mi.Scene:
    """The volume alone, in a boundary that neither bends nor reflects: rays see how much of it lies behind each pixel."""
    return mi.load_dict(box_scene(values, side, light.albedo))


def render_in_turns(scene: mi.Scene, size: Size, levels: tuple[int, ...], light: Light) -> tuple[dict, dict]:
    """Images of all integrators at all levels; timings and samples per pixel by (name, level)."""
    calls, spp = {}, {}
    for place, name in enumerate((OURS, *light.peers)):
        integrator = of_depth(name, light.depth)

        def render(seed: int, n: int, integrator: mi.Integrator = integrator, place: int = place) -> mi.TensorXf:
            return mi.render(scene, integrator=integrator, spp=n, seed=10_000 * size.seed + 1000 * place + seed)

        most = size.budget.samples(render)
        for level in levels:
            spp[name, level] = n = max(most // level, 1)
            calls[name, level] = lambda seed, render=render, n=n, level=level: render(seed + 100 * level, n)
    return race(calls, size.rounds, keep=True), spp


def optical_depths(scene: mi.Scene) -> np.ndarray:
    """Mean optical depth of each pixel (H, W)."""
    tau = mi.render(scene, integrator=mi.load_dict({"type": OURS, "max_depth": 1, "aovs": "tau"}), spp=64, seed=1)
    return np.array(tau)[..., 3]


def pixels_from_emitter(scene: mi.Scene, light: Light, side: int) -> np.ndarray:
    """How far each pixel (H, W) is from an emitter in the medium [pixels]; infinite where none stands in it."""
    if light.inside is None:
        return np.full((side, side), np.inf)
    seen = np.array(mi.Transform4f(scene.sensors()[0].world_transform()).inverse() @ mi.Point3f(light.inside)).ravel()
    # 45 degrees across the picture; the camera looks along z, x to the left.
    at = 0.5 - seen[:2] / seen[2] / (2 * math.tan(math.radians(22.5)))
    j, i = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5, indexing="ij")
    return np.hypot(i - side * at[0], j - side * at[1])


def errors(timing: Timing, counts: np.ndarray, spp: int) -> dict:
    """Mean, variance and time of one integrator's images."""
    m = Moments.of(np.array(timing.results))
    variance, mean = m.variance.mean(axis=-1)[counts], m.mean.mean(axis=-1)[counts]
    return {
        "mean": float(mean.mean()),
        "variance_mean_over_pixels": float(variance.mean()),
        "variance_median_over_pixels": float(np.median(variance)),
        "relative_error_mean_over_pixels": math.sqrt(variance.mean()) / float(mean.mean()),
        "relative_error_median_over_pixels": float(np.median(np.sqrt(variance)[mean > 0] / mean[mean > 0])),
        **timing.report(counts.size * spp, "samples"),
    }


def gain(slow: Timing, fast: Timing, counts: np.ndarray) -> dict:
    """How much more variance x time one needs."""
    a, b = (Moments.of(np.array(t.results)).variance.mean(axis=-1)[counts] for t in (slow, fast))
    time = ratio_of(slow, fast, "processor")
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pixel = np.median((a / b)[(a > 0) | (b > 0)])
    return {
        "time": ratio_of(slow, fast),
        "processor_time": time,
        "variance_x_time_mean_over_pixels": float(a.mean() / b.mean() * time),
        "variance_x_time_median_over_pixels": float(by_pixel * time),
    }


def difference(slow: Timing, fast: Timing, counts: np.ndarray) -> dict:
    """z of the means over those pixels, its bound, and the standard error relative to the mean of the slow one."""
    ours, theirs = (mean_of_pixels(np.array(t.results).mean(axis=-1)[:, counts]) for t in (fast, slow))
    found = compare_means(ours, theirs, len(VOLUMES) * len(LIGHTS) * len(STOCK))
    error = found["standard_error_percent"]
    return {
        "z": found["z"],
        "z_bound": found["z_bound"],
        "relative_standard_error": None if error is None else error / 100,
    }


def ask(volume: str) -> Callable[[Size], dict]:
    """The question about one volume."""

    def measure(size: Size) -> dict:
        found = VOLUMES[volume](size)
        answer = {"grid": str(found)}
        levels = size.levels if volume == "smoke" else (1,)
        for name, light in LIGHTS.items():
            answer[name] = contend(found.values, light, size, levels)
            say(f"  {name}: {said(answer[name])}")
        return answer

    measure.__doc__ = f"How much sooner has mivol the same error in the {volume}?"
    return measure


def said(figures: dict) -> str:
    """One line on a contest."""
    peers = [name.removeprefix("mivol over ") for name in figures if name.startswith("mivol over ")]
    rates = ", ".join(f"{name} {figures[name][0]['samples_per_second_median'] / 1e6:.3g}" for name in (OURS, *peers))
    gains = []
    for name in peers:
        g = figures[f"mivol over {name}"]
        gains.append(
            f"{name} {g['variance_x_time_mean_over_pixels']:.0f}x mean, {g['variance_x_time_median_over_pixels']:.0f}x median, "
            f"by the clock {g['time'] / g['processor_time']:.2f} of that "
            f"(z {number(g['z']):+.2f}, {number(g['relative_standard_error']):.1e})"
        )
    return f"{'; '.join(gains)}; M samples/s: {rates}"


QUESTIONS = {volume: ask(volume) for volume in VOLUMES}


# -- Saying it -------------------------------------------------------------------------------------------------------------


def compare(volume: str, answer: dict) -> list[Bar]:
    """Every ratio beside its bar, and every z beside its bound."""
    rows = []
    for name, light in LIGHTS.items():
        for stock in STOCK:
            g = answer[name][f"mivol over {stock}"]
            what, ratio = f"{volume}, {name}, {stock}", g[f"variance_x_time_{light.average}_over_pixels"]
            rows.append(judge(f"variance x time, {light.average}: {what}", ratio, AT_LEAST, light.bar))
            rows.append(judge_agreement(what, g["z"], g["z_bound"]))
    return rows


def draw(answers: dict, folder: Path) -> None:
    """Error against time in the first volume asked about; below, the ratios of all."""
    with drawn(folder / "bench_single_scattering.png", 13, 7.2) as figure:
        above, below = figure.subfigures(2, 1, height_ratios=(1, 0.9))
        volume = next(iter(answers))
        for axes, (name, light) in zip(above.subplots(1, len(LIGHTS)), LIGHTS.items(), strict=True):
            draw_errors(axes, answers[volume][name], light)
            axes.set_title(name)
        axes.legend()
        above.suptitle(f"{volume}, one scattering: error against time", x=0.01, ha="left", weight="bold")
        for axes, (name, light) in zip(below.subplots(1, len(LIGHTS), sharey=True), LIGHTS.items(), strict=True):
            draw_gains(axes, answers, name, light)
        below.suptitle("how much sooner mivol has the same error (line: the bar)", x=0.01, ha="left", weight="bold")


def draw_errors(axes: Axes, figures: dict, light: Light) -> None:
    """Error of a pixel against seconds."""
    for i, name in enumerate((OURS, *light.peers)):
        rows = figures[name]
        seconds = [row["seconds_median"] for row in rows]
        error = [row[f"relative_error_{light.average}_over_pixels"] for row in rows]
        axes.loglog(seconds, error, marker=MARKERS[i], color=SERIES[i], label=name)
    axes.set(xlabel="time [s], warm", ylabel=f"relative error of a pixel ({light.average})")
    plain_ticks(axes.xaxis, "")
    plain_ticks(axes.yaxis, "")


def draw_gains(axes: Axes, answers: dict, name: str, light: Light) -> None:
    """A row of points for each volume."""
    rows = np.arange(len(answers))[::-1]
    for i, stock in enumerate(STOCK, 1):
        gains = [answers[v][name][f"mivol over {stock}"][f"variance_x_time_{light.average}_over_pixels"] for v in answers]
        axes.semilogx(gains, rows, MARKERS[i], color=SERIES[i], label=stock)
    axes.axvline(light.bar, color=SERIES[0], linestyle="--", linewidth=1.2)
    axes.set(yticks=rows, yticklabels=list(answers), ylim=(-0.6, len(rows) - 0.4))
    axes.set_xlabel(f"variance x time ({light.average} over pixels)")
    plain_ticks(axes.xaxis, "×")


BENCH = Bench("bench_single_scattering", __doc__, QUESTIONS, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
