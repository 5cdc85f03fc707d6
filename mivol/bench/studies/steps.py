"""How long does a step of an optimisation take beside its kernels, in a loop that a user writes?

    mivol bench steps                                        # half a minute on 2 idle cores
    mivol bench steps --quick                                # ten seconds, two scenes, few steps
    mivol bench steps --scenes tutorial god_rays --sides 16 64 --spp 1 16

A step sets a parameter, calls ``params.update()``, and renders an image; with a gradient it also calls ``dr.backward`` on a
loss of the image. The loop with ``mivol`` and the loop with ``prbvolpath`` differ in the name of the integrator only. They take
turns. On the smallest film kernels take no time, so a step shows the work of the host: tracing, or the replay of a recording.

The scene ``tutorial`` is the smoke of the Mitsuba tutorial under a sky at depth 6; the others are those of the study
``everyday``.

Milliseconds are wall times: medians over the steps after the first ``WARM`` ones, in which both integrators compile. A ratio is
the time of ``prbvolpath`` over the time of mivol, without regard to their noise (``mivol bench everyday`` compares errors).
Launches are kernels, copies and fills of one step.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import smoke
from mivol.bench.harness.bars import AT_LEAST, Bar, judge, say_row
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import Question, Size, Study, amount, ask
from mivol.bench.scenes import box_scene
from mivol.bench.studies.everyday import chosen_scenes
from mivol.bench.studies.everyday.scenes import EverydayScene
from mivol.report.figures import SERIES

PEER = "prbvolpath"
TUTORIAL = EverydayScene(
    lambda side: box_scene(smoke().values, side, albedo=0.8), 6, 1.0, None, "box.interior_medium.sigma_t.data"
)
"""The scene ``tutorial``."""

WARM = 3
"""Steps before the timing."""


@dataclass(frozen=True)
class StepsSize(Size):
    """Amount of work."""

    scenes: tuple[str, ...] = amount(
        ("smoke_sun_map", "smoke_on_floor", "smoke_point_inside", "god_rays", "tissue", "jade_null_sun"),
        ("smoke_on_floor", "jade_null_sun"),
        "tutorial, and scenes of the study everyday",
    )
    sides: tuple[int, ...] = amount((4, 16, 64), (4,), "edges of the image [pixels]")
    spp: tuple[int, ...] = amount((1,), doc="samples per pixel of a step")
    steps: int = amount(15, 3, "steps of each integrator")


class _Loop:
    """A user's loop over one scene with one integrator."""

    def __init__(self, scene: EverydayScene, name: str, side: int, spp: int) -> None:
        self.scene, self.key, self.spp = scene.load(side), scene.parameter, spp
        self.integrator, self.params = scene.integrator(name), mi.traverse(self.scene)
        self.start = type(self.params[self.key])(self.params[self.key])
        self.count = 0

    def step(self, differentiates: bool) -> None:
        """Put another value, render, and differentiate on request."""
        self.count += 1
        value = type(self.start)(self.start * (1 - 1e-4 * self.count))
        if differentiates:
            dr.enable_grad(value)
        self.params[self.key] = value
        self.params.update()
        image = mi.render(self.scene, self.params, integrator=self.integrator, spp=self.spp, seed=self.count)
        if differentiates:
            dr.backward(dr.mean(image, axis=None))
            dr.eval(dr.grad(self.params[self.key]))
        dr.eval(image)
        dr.sync_thread()


def measure_steps(differentiates: bool, size: StepsSize) -> dict:
    """Time steps of both integrators in each scene and for each film."""
    rows = {}
    scenes = chosen_scenes([name for name in size.scenes if name != "tutorial"])
    if "tutorial" in size.scenes:
        scenes["tutorial"] = TUTORIAL
    for name, scene in scenes.items():
        for side, spp in itertools.product(size.sides, size.spp):
            row = _contend({who: _Loop(scene, who, side, spp) for who in (PEER, "mivol")}, size, differentiates)
            rows[f"{name}, {side}^2 x {spp}"] = row
            say_row(f"{name}, {side}^2 x {spp}", ratio=row["ratio"], milliseconds=row["milliseconds"]["mivol"])
    return {"rows": rows, "least_ratio": min(row["ratio"] for row in rows.values())}


def _contend(loops: dict[str, _Loop], size: StepsSize, differentiates: bool) -> dict:
    seconds: dict[str, list[float]] = {name: [] for name in loops}
    for loop in loops.values():
        for _ in range(WARM):
            loop.step(differentiates)
    for _ in range(size.steps):
        for name, loop in loops.items():
            seconds[name].append(_time(loop.step, differentiates))
    ratios = np.divide(seconds[PEER], seconds["mivol"])
    return {
        "milliseconds": {name: 1e3 * float(np.median(s)) for name, s in seconds.items()},
        "ratio": float(np.median(ratios)),
        "launches": {name: count_launches(lambda loop=loop: loop.step(differentiates)) for name, loop in loops.items()},
    }


def _time(step: Callable[[bool], None], differentiates: bool) -> float:
    start = time.perf_counter()
    step(differentiates)
    return time.perf_counter() - start


def count_launches(call: Callable[[], None]) -> int:
    """Number of kernels, copies and fills launched by a call."""
    dr.sync_thread()
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        call()
        dr.sync_thread()
        return len(dr.kernel_history())


def compare(question: str, answer: dict) -> list[Bar]:
    """No step may take longer than the step of the peer."""
    return [judge(f"{question}: least ratio of times", answer["least_ratio"], AT_LEAST, 1.0)]


def table(question: str, answer: dict) -> list[str]:
    """A line for each scene and film."""
    lines = [f"| scene, film | {PEER} [ms] | mivol [ms] | ratio | launches |", "|---|---|---|---|---|"]
    for name, row in answer["rows"].items():
        ms, launches = row["milliseconds"], row["launches"]
        counts = f"{launches[PEER]} / {launches['mivol']}"
        lines.append(f"| {name} | {ms[PEER]:.3g} | {ms['mivol']:.3g} | {row['ratio']:.3g} | {counts} |")
    return lines


def draw(answers: dict, path: Path) -> None:
    """Milliseconds of both integrators in each row."""
    with new_figure(path, 6.4 * len(answers), 4.2) as figure:
        panels = np.atleast_1d(figure.subplots(1, len(answers)))
        for axes, (question, answer) in zip(panels, answers.items(), strict=True):
            for who, colour in zip((PEER, "mivol"), SERIES, strict=False):
                values = [row["milliseconds"][who] for row in answer["rows"].values()]
                axes.plot(values, np.arange(len(values)), "o", color=colour, label=who)
            axes.set_yticks(np.arange(len(answer["rows"])), list(answer["rows"]), fontsize=7)
            axes.set(xscale="log", xlabel="wall time of a step [ms]", title=question)
            use_plain_ticks(axes.xaxis)
        panels[0].legend()


QUESTIONS: dict[str, Question] = {
    "images": ask("How long does a step with an image take?", measure_steps, False),
    "gradients": ask("How long does a step with an image and its gradient take?", measure_steps, True),
}

STUDY = Study(__name__, __doc__, StepsSize, QUESTIONS, compare, draw, table)
