#!/usr/bin/env python3
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
the ratio of two renders of one round, median over the rounds. Printed are

    variance x time, mean over pixels      ratio of the means of the variances, times the ratio of times
    variance x time, median over pixels    median of the ratios of the variances, times the ratio of times

The bar is on the first, but for point lights, near which the mean does not exist: there it is on the second, and the picture is
small, so that each pixel has samples enough to show the long tail of its variance (from 32 samples ``volpath`` seems to have
half the variance that it shows in 500). Only pixels that see the medium count (a mean optical depth above 0.01), and none
within a pixel and a half of a lamp inside it. A pixel in which the other integrator found no light in 8 images counts as a
ratio of 0. Beside the time on the wall stands that of the processors (``processor_time``), which a busy machine moves less.

Equality. Beside every ratio stands z: the difference of the means over those pixels in standard errors, with the relative
standard error, which says how small a bias it could have seen. If any z of a run is beyond its bound (a false alarm in one run
in 1000), the script ends with status 1: then the ratios mean nothing. Samples are camera paths, per second of a warm render.

Prints JSON; writes bench_single_scattering.json and bench_single_scattering.png (error against time in the smoke, and the
ratios of all volumes). Data is read from MIVOL_DATA (default ../shared/data); where it is missing made-up fields take its
place, and the JSON says so.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from contest import (
    AT_LEAST,
    AT_MOST,
    DATA,
    TUTORIAL_SCALE,
    Bench,
    Field,
    Timing,
    box_of,
    constant,
    ct_scan,
    describe,
    judge,
    made_up,
    plain_ticks,
    point,
    race,
    ratio_of,
    samples_for,
    say,
    scatters_once,
    smoke,
    sun_and_sky,
    threads_in_space,
)
from mivol.files import read_volume
from mivol.optim.events import upsample
from mivol.report.figures import MARKERS, SERIES, STYLE, save
from mivol.validate.statistics import Moments, z_bound, z_image

import matplotlib as mpl
import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ALBEDO = 0.75
OURS = "mivol"
STOCK = ("volpath", "prbvolpath")
FALSE_ALARM = 1e-3
"""Chance that a run in which all means agree is said not to."""


@dataclass(frozen=True)
class Size:
    """How much work is done. Seconds are of one render, of all threads; sides are in pixels; levels divide the samples."""

    name: str = "full"
    rounds: int = 8
    most_pixels: int = 64
    seconds: float = 0.8
    levels: tuple[int, ...] = (1, 4, 16)
    fine_res: int = 256
    sparse_res: int = 512


FULL = Size()
QUICK = Size(name="quick", most_pixels=16, seconds=0.02, levels=(1, 4), fine_res=48, sparse_res=64)


# -- Lamps and volumes -----------------------------------------------------------------------------------------------------


class Light(NamedTuple):
    """A lamp and a phase function; ``inside`` is where a lamp stands in the medium."""

    parts: Callable[[], dict]
    bar: float
    by_pixel: bool = False
    side: int = 64
    inside: tuple[float, float, float] | None = None


INSIDE, NEAR = (0.3, -0.5, 0.2), (0.9, -1.3, 1.2)


LIGHTS = {
    "constant light": Light(constant, 50),
    "HG 0.8, sun in a sky": Light(sun_and_sky, 30),
    "point light inside": Light(lambda: point(INSIDE), 100, True, 24, INSIDE),
    "point light near": Light(lambda: point(NEAR), 100, True, 24),
}


def fine_smoke(size: Size) -> Field:
    """The smoke, interpolated to a finer grid."""
    coarse = smoke()
    fine = upsample(mi.TensorXf(np.ascontiguousarray(coarse.values[..., None])), (size.fine_res,) * 3)
    return Field(np.array(fine)[..., 0], f"{coarse.origin}, upsampled")


def as_dense(found: Field) -> Field:
    """A field with the smoke's largest extinction, its outermost voxels empty.

    Mitsuba starts rays anew (1 + |p|) 9e-5 behind a boundary. A medium that touches it lacks that skin, which holds 2 % of
    the light at such an extinction (against quadrature in float64, which mivol agrees with).
    """
    values = np.pad(found.values[1:-1, 1:-1, 1:-1], 1)
    return Field(values * np.float32(smoke().values.max() / values.max()), f"{found.origin}, as dense as the smoke")


def cloud(_: Size) -> Field:
    """A cloud of a large-eddy simulation with the optical depth of its height, stretched to the box."""
    path = DATA / "clouds_les" / "rico32x37x26.txt"
    if not path.is_file():
        return made_up((26, 37, 32), TUTORIAL_SCALE)
    found = read_volume(path)
    height = np.linalg.norm(found.to_world[:3, 2])
    return Field(found.values[..., 0] * np.float32(height / 2), "LES cloud (RICO), stretched to a cube")


VOLUMES = {
    "smoke": lambda _: smoke(),
    "fine smoke": fine_smoke,
    "CT": lambda size: as_dense(ct_scan(size.fine_res)),
    "threads": lambda size: as_dense(threads_in_space(size.sparse_res)),
    "cloud": cloud,
}


# -- Contests --------------------------------------------------------------------------------------------------------------


def seeing(scene: mi.Scene, light: Light, side: int) -> np.ndarray:
    """Pixels that count (H, W): those that see the medium, not at a lamp in it."""
    tau = mi.render(scene, integrator=mi.load_dict({"type": OURS, "max_depth": 1, "aovs": "tau"}), spp=64, seed=1)
    counts = np.array(tau)[..., 3] > 0.01
    if light.inside is not None:
        away = np.array(mi.Transform4f(scene.sensors()[0].world_transform()).inverse() @ mi.Point3f(light.inside)).ravel()
        # 45 degrees across the picture; the camera looks along z, x to the left.
        at = 0.5 - away[:2] / away[2] / (2 * math.tan(math.radians(22.5)))
        j, i = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5, indexing="ij")
        counts &= np.hypot(i - side * at[0], j - side * at[1]) > 1.5
    return counts


def contend(values: np.ndarray, light: Light, size: Size, levels: tuple[int, ...]) -> dict:
    """Variance and time of each integrator, and what they mean for mivol."""
    side = min(light.side, size.most_pixels)
    scene = mi.load_dict(box_of(values, side, ALBEDO, **light.parts()))
    renders, samples = {}, {}
    for number, name in enumerate((OURS, *STOCK)):
        made = scatters_once(name)

        def render(seed: int, spp: int, made: mi.Integrator = made, number: int = number) -> mi.TensorXf:
            return mi.render(scene, integrator=made, spp=spp, seed=1000 * number + seed)

        samples[name] = samples_for(render, size.seconds)
        for level in levels:
            renders[name, level] = (render, max(samples[name] // level, 1))
    calls = {
        key: lambda seed, render=render, spp=spp, level=key[1]: render(seed + 100 * level, spp)
        for key, (render, spp) in renders.items()
    }
    timings = race(calls, size.rounds, keep=True)
    counts = seeing(scene, light, side)
    spp = {key: n for key, (_, n) in renders.items()}
    figures = {"pixels_that_count": int(counts.sum())}
    for name in (OURS, *STOCK):
        figures[name] = [{"spp": spp[name, level]} | errors(timings[name, level], counts, spp[name, level]) for level in levels]
    for name in STOCK:
        figures[f"mivol over {name}"] = gain(timings[name, 1], timings[OURS, 1], counts)
    return figures


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
    """How much more variance x time one needs, and whether the means agree."""
    a, b = (Moments.of(np.array(t.results)).variance.mean(axis=-1)[counts] for t in (slow, fast))
    time = ratio_of(slow, fast)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pixel = np.median((a / b)[(a > 0) | (b > 0)])
    return {
        "time": time,
        "processor_time": ratio_of(slow, fast, "processor"),
        "variance_x_time_mean_over_pixels": float(a.mean() / b.mean() * time),
        "variance_x_time_median_over_pixels": float(by_pixel * time),
        **difference(*(np.array(t.results).mean(axis=-1)[:, counts] for t in (slow, fast))),
    }


def difference(a: np.ndarray, b: np.ndarray) -> dict:
    """z of the means of two sets of rounds (rounds, pixels), and the standard error that it is measured in."""
    va, vb = error_of_mean(a), error_of_mean(b)
    return {
        "z": float(z_image(b.mean(), vb, a.mean(), va)),
        "z_bound": float(z_bound(FALSE_ALARM, len(VOLUMES) * len(LIGHTS) * len(STOCK))),
        "relative_standard_error": math.sqrt(va + vb) / float(a.mean()),
    }


def error_of_mean(rounds: np.ndarray) -> float:
    """Variance of the mean over rounds and pixels.

    Pixels with samples of their own tell it well, rounds tell it whatever pixels share (numbers, in a tile): the larger one.
    """
    alone = float(Moments.of(rounds).variance_of_mean.sum()) / rounds.shape[1] ** 2
    return max(alone, float(Moments.of(rounds.mean(axis=1)).variance_of_mean))


def ask(volume: str) -> Callable[[Size], dict]:
    """The question about one volume."""

    def measure(size: Size) -> dict:
        found = VOLUMES[volume](size)
        answer = {"grid": describe(found)}
        levels = size.levels if volume == "smoke" else (1,)
        for name, light in LIGHTS.items():
            answer[name] = contend(found.values, light, size, levels)
            say(f"  {name}: {said(answer[name])}")
        return answer

    measure.__doc__ = f"How much sooner has mivol the same error in the {volume}?"
    return measure


def said(figures: dict) -> str:
    """One line on a contest."""
    rates = ", ".join(f"{name} {figures[name][0]['samples_per_second_median'] / 1e6:.3g}" for name in (OURS, *STOCK))
    gains = []
    for name in STOCK:
        g = figures[f"mivol over {name}"]
        gains.append(
            f"{name} {g['variance_x_time_mean_over_pixels']:.0f}x mean, {g['variance_x_time_median_over_pixels']:.0f}x median, "
            f"processor {g['processor_time'] / g['time']:.2f} (z {g['z']:+.2f}, {g['relative_standard_error']:.1e})"
        )
    return f"{'; '.join(gains)}; M samples/s: {rates}"


QUESTIONS = {volume: ask(volume) for volume in VOLUMES}


# -- Saying it -------------------------------------------------------------------------------------------------------------


def compare(volume: str, answer: dict) -> list[dict]:
    """Every ratio beside its bar, and every z beside its bound."""
    rows = []
    for name, light in LIGHTS.items():
        kind = "median" if light.by_pixel else "mean"
        for stock in STOCK:
            g = answer[name][f"mivol over {stock}"]
            what, ratio = f"{volume}, {name}, {stock}", g[f"variance_x_time_{kind}_over_pixels"]
            rows.append(judge(f"variance x time, {kind}: {what}", ratio, AT_LEAST, light.bar))
            rows.append(judge(f"|z|: {what}", abs(g["z"]), AT_MOST, g["z_bound"], aloud=False))
    return rows


def draw(answers: dict, folder: Path) -> None:
    """Error against time in the first volume asked about; below, the ratios of all."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(13, 7.2))
        FigureCanvasAgg(figure)
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
    save(figure, folder / "bench_single_scattering.png")


def draw_errors(axes: mpl.axes.Axes, figures: dict, light: Light) -> None:
    """Error of a pixel against seconds."""
    kind = "median" if light.by_pixel else "mean"
    for i, name in enumerate((OURS, *STOCK)):
        rows = figures[name]
        seconds = [row["seconds_median"] for row in rows]
        error = [row[f"relative_error_{kind}_over_pixels"] for row in rows]
        axes.loglog(seconds, error, marker=MARKERS[i], color=SERIES[i], label=name)
    axes.set(xlabel="time [s], warm", ylabel=f"relative error of a pixel ({kind})")
    plain_ticks(axes.xaxis, "")
    plain_ticks(axes.yaxis, "")


def draw_gains(axes: mpl.axes.Axes, answers: dict, name: str, light: Light) -> None:
    """A row of points for each volume."""
    kind = "median" if light.by_pixel else "mean"
    rows = np.arange(len(answers))[::-1]
    for i, stock in enumerate(STOCK, 1):
        gains = [answers[v][name][f"mivol over {stock}"][f"variance_x_time_{kind}_over_pixels"] for v in answers]
        axes.semilogx(gains, rows, MARKERS[i], color=SERIES[i], label=stock)
    axes.axvline(light.bar, color=SERIES[0], linestyle="--", linewidth=1.2)
    axes.set(yticks=rows, yticklabels=list(answers), ylim=(-0.6, len(rows) - 0.4))
    axes.set_xlabel(f"variance x time ({kind} over pixels)")
    plain_ticks(axes.xaxis, "×")


BENCH = Bench("bench_single_scattering", __doc__, QUESTIONS, (FULL, QUICK), compare, draw)

if __name__ == "__main__":
    beyond = [row["figure"] for row in BENCH.main() if row["sense"] == AT_MOST and not row["met"]]
    sys.exit(f"the means differ ({'; '.join(beyond)}): the ratios mean nothing" if beyond else 0)
