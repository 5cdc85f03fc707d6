"""One scene, four models of light: how do the errors of images and gradients fall with time, for mivol and for Mitsuba?

    scripts/bench_ladder.py              # 3 minutes on 2 idle cores
    scripts/bench_ladder.py --quick      # small sizes, for CI

The smoke of the Mitsuba tutorial (or a made-up one, and the JSON says so) under a sky: it absorbs; it absorbs and emits; it
scatters once below a sun (albedo 0.75, HG 0.8, ``max_depth`` 2); it scatters up to five times (6). The grid is the same, and so
is what is differentiated: the density. Images by ``volpath``, gradients of an image's mean by ``prbvolpath``; Mitsuba 3.9 has
no media that emit. Every method gets 1/16, 1/4 and all of the samples that take 0.8 s of processor time, in turns, 8 rounds.
Drawn is the error of a pixel over the mean radiance, and of a voxel of sigma_t >= 1 over the root mean square of the gradient.

Prints JSON; writes bench_ladder.json and bench_ladder.png.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.extinctions import smoke
from mivol.bench.harness.agreement import compare_means, mean_of_rounds
from mivol.bench.harness.bars import Bar, judge_agreement, say
from mivol.bench.harness.figures import drawn, plain_ticks
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import Budget, Timing, race
from mivol.bench.scenes import box_scene, constant_light, of_depth, sun_and_sky
from mivol.bench.studies.gradients.subject import Subject
from mivol.report.figures import MARKERS, SERIES
from mivol.validate.moments import Moments

__all__ = ["BENCH", "RUNGS", "Rung", "Size", "climb", "main"]

OURS = "mivol"


@dataclass(frozen=True)
class Rung:
    """A model of light.

    Attributes:
        parts: of the scene.
        albedo: of the medium.
        depth: ``max_depth``.
        emits: the medium has a source function of 1, which Mitsuba's own media have not.
    """

    parts: Callable[[], dict]
    albedo: float
    depth: int
    emits: bool = False

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        """The box around extinctions (Z, Y, X)."""
        parts = box_scene(values, side, self.albedo, **self.parts())
        if self.emits:
            medium = parts["box"]["interior"]
            medium |= {"type": "mivol_medium", "emission": {"type": "constvolume", "value": 1.0}}
        return mi.load_dict(parts)

    def rivals(self, stock: str) -> tuple[str, ...]:
        """Who renders it."""
        return (OURS,) if self.emits else (OURS, stock)


RUNGS = {
    "absorption": Rung(constant_light, 0.0, 2),
    "emission": Rung(lambda: {"emitter": {"type": "constant", "radiance": 0.2}}, 0.0, 2, True),
    "single scattering": Rung(sun_and_sky, 0.75, 2),
    "multiple scattering": Rung(sun_and_sky, 0.75, 6),
}
"""Models, each of which knows all that the one before knows but for the emission."""


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        rounds: images and gradients of each method.
        side: of the picture [pixels].
        budget: samples of one render.
        levels: the samples are divided by these.
    """

    name: str = "full"
    rounds: int = 8
    side: int = 64
    budget: Budget = field(default=Budget(seconds=0.8))
    levels: tuple[int, ...] = (1, 4, 16)


FULL = Size()
QUICK = Size(name="quick", side=12, rounds=4, budget=Budget(seconds=0.05), levels=(1, 4))


def climb(size: Size) -> dict:
    """How do the errors of images and gradients fall with time, in four models of one scene?"""
    found = smoke()
    answer: dict = {"grid": str(found)}
    for name, rung in RUNGS.items():
        answer[name] = {"image": _image(rung, found.values, size), "gradient": _gradient(rung, found.values, size)}
        say(f"  {name}: {said(answer[name])}")
    return answer


Step = Callable[[int, int], object]
"""Seed and samples per pixel to an image or a gradient."""


def _image(rung: Rung, values: np.ndarray, size: Size) -> dict:
    """Errors of pixels against time, and the picture."""
    scene = rung.scene(values, size.side)
    steps: dict[str, Step] = {}
    for name in rung.rivals("volpath"):
        integrator = of_depth(name, rung.depth)
        steps[name] = lambda seed, spp, integrator=integrator: mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    timings = _race(steps, size)
    figures, level = _figures(timings, size, np.ones(size.side**2 * 3, bool), np.mean)
    # A picture to be looked at, for the figure only.
    return figures | {"picture": level.reshape(size.side, size.side, 3)}


def _gradient(rung: Rung, values: np.ndarray, size: Size) -> dict:
    """Errors of voxels against time."""
    steps: dict[str, Step] = {}
    for name in rung.rivals("prbvolpath"):
        steps[name] = Subject(rung.scene(values, size.side), of_depth(name, rung.depth)).of_mean
    return _figures(_race(steps, size), size, (values >= 1).ravel(), _root_mean_square)[0]


def _root_mean_square(values: np.ndarray) -> float:
    return math.sqrt(np.square(values).mean())


def _race(steps: dict[str, Step], size: Size) -> dict[tuple[str, int], Timing]:
    """Every method at every level, in turns."""
    calls = {}
    for place, (name, step) in enumerate(steps.items()):
        most = size.budget.samples(step)
        for level in size.levels:
            first, spp = 100_000 * (place + 1) + 1000 * level, max(most // level, 1)
            calls[name, level] = lambda number, step=step, first=first, spp=spp: step(first + number, spp)
    return race(calls, size.rounds, keep=True)


def _figures(
    timings: dict[tuple[str, int], Timing], size: Size, counts: np.ndarray, scale: Callable[[np.ndarray], float]
) -> tuple[dict, np.ndarray]:
    """Errors over the scale of mivol's mean, the agreement of the means, and that mean."""
    moments = {key: Moments.of(np.array(t.results).reshape(size.rounds, -1)) for key, t in timings.items()}
    mean = moments[OURS, 1].mean
    unit = scale(mean[counts])
    figures: dict = {}
    for (name, level), timing in timings.items():
        error = math.sqrt(moments[name, level].variance[counts].mean()) / unit
        figures.setdefault(name, []).append({"level": level, "seconds_median": timing.median, "relative_error": error})
    whole = {name: np.array(timings[name, 1].results).reshape(size.rounds, -1)[:, counts].sum(axis=1) for name in figures}
    for name in whole.keys() - {OURS}:
        figures["agreement"] = compare_means(mean_of_rounds(whole[OURS]), mean_of_rounds(whole[name]), 6)
        slow, fast = (figures[n][0] for n in (name, OURS))
        error = slow["relative_error"] / fast["relative_error"]
        figures["variance_x_time"] = error**2 * slow["seconds_median"] / fast["seconds_median"]
    return figures, mean


def said(figures: dict) -> str:
    """One line on a rung."""
    return "; ".join(
        f"{what} {figures[what]['variance_x_time']:.0f}x" if "variance_x_time" in figures[what] else f"{what} alone"
        for what in ("image", "gradient")
    )


def compare(question: str, answer: dict) -> list[Bar]:
    """The means of both methods."""
    rows = []
    for name in RUNGS:
        for what in ("image", "gradient"):
            if (z := answer[name][what].get("agreement")) is not None:
                rows.append(judge_agreement(f"{what}, {name}", z["z"], z["z_bound"]))
    return rows


def draw(answers: dict, folder: Path) -> None:
    """A column for each model: its picture, and the errors of images and gradients. Low, as the README has room for it."""
    (answer,) = answers.values()
    with drawn(folder / "bench_ladder.png", 2.2 * len(RUNGS), 4.2) as figure:
        rows = figure.subplots(3, len(RUNGS), height_ratios=(1, 1.1, 1.1))
        for k, name in enumerate(RUNGS):
            picture, image, gradient = (row[k] for row in rows)
            pixels = answer[name]["image"]["picture"]
            picture.imshow(np.clip(pixels / np.quantile(pixels, 0.99), 0, 1) ** (1 / 2.2), interpolation="nearest")
            picture.set_axis_off()
            picture.set_title(name, loc="center")
            _draw_errors(image, answer[name]["image"], "volpath")
            _draw_errors(gradient, answer[name]["gradient"], "prbvolpath")
            gradient.set_xlabel("time [s], warm")
        for axes, what in zip(rows[1:, 0], ("image", "gradient"), strict=True):
            axes.set_ylabel(f"error of {what} [1]")
            axes.legend()


def _draw_errors(axes: Axes, figures: dict, stock: str) -> None:
    for i, name in enumerate((OURS, stock)):
        if name in figures:
            seconds, error = ([row[key] for row in figures[name]] for key in ("seconds_median", "relative_error"))
            axes.loglog(seconds, error, marker=MARKERS[i], color=SERIES[i], label=name)
    plain_ticks(axes.xaxis, "")
    plain_ticks(axes.yaxis, "")


BENCH = Bench("bench_ladder", __doc__, {"ladder": climb}, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
