"""Density gradients of light that scatters once or often: how exact are they, how much sooner than those of ``prbvolpath``?

    scripts/bench_gradients.py                        # about 10 minutes on 2 idle cores: all but the tutorial
    scripts/bench_gradients.py --only tutorial        # 5 minutes, nearly all of them in prbvolpath
    scripts/bench_gradients.py --only "deep smoke,deep cloud"      # 8 minutes: light that scatters up to five times
    scripts/bench_gradients.py --only "deep fine smoke"            # 8 minutes
    scripts/bench_gradients.py --only "deep tutorial"              # 15 minutes
    scripts/bench_gradients.py --only "deep estimators"            # an hour
    scripts/bench_gradients.py --quick                # a minute, small sizes: are our gradients right?

The derivatives are those with respect to the voxels of sigma_t [1/length]; albedo 0.75, ``max_depth`` 2 for all, stock scenes,
the box [-1, 1]^3, box filter, independent samples, pictures of 64 x 64 pixels (estimators: 24 x 24). Times are of warm calls.

smoke: the Mitsuba tutorial's smoke at its density (x 40), in constant light, and with HG g = 0.8 below a sun in a sky. Two
gradients: of a linear functional of the picture, its mean (a call of ``render_backward``), and of an L2 loss, the mean squared
difference to the picture of 0.7 of the density (a whole step: ``mi.render``, loss, ``dr.backward``). Both methods get the
samples that take the same processor time (a power of two per pixel) and run in turns, 8 rounds, every one with another seed;
printed is the sum over voxels of their variances over the 8 gradients, times the processor time: over the voxels with
sigma_t >= 1 (the bars), and over those between 0 and 1 and those at 0, where the ratio says little since ``prbvolpath`` is
biased there. Beside the ratio stands z: the derivative along sigma_t itself, summed over those voxels, in standard errors of
its difference. If it is beyond its bound for sigma_t >= 1 (false alarm in one run in 1000, Student's t), the ratio means
nothing and the script ends with status 1.

estimators: bias and variance of both estimators where they differ: density 0, half empty, thin, dense (16^3 voxels). The
derivative of the picture's mean along a fixed direction in the space of voxels (thin, dense: the density itself; density 0:
all voxels alike; half empty: the empty half) is compared with finite differences of mivol's pictures with common random
numbers: central of fourth order, or one-sided of third order where the density is 0. Both the differences and our derivative
are repeated until their means are known to 0.06 %, 750 times at most. The bias is said in standard errors (of both together)
and in percent; 0.5 % (with 3 standard errors to spare) and 3 standard errors are the bars for ours. Variance x time: summed
over the voxels of that direction, prbvolpath's over ours.

tutorial: the official Mitsuba tutorial on volume optimisation with ``max_depth`` 2 in the place of prbvolpath's default of 6,
else as published: 5 cameras on a half circle, 64 x 64, tent filter, constant light, density 0.002 x 40 in 16^3 voxels, Adam
with 0.02, 20 x 5 steps of 8 samples, resampled to 64^3, 20 x 5 steps of 64. prbvolpath and mivol run the same loop. The clock
runs during the steps only. After each iteration (of 5 steps) the image loss of the volume is measured apart, without noise in
the mean: the product of the errors of two independent renders by mivol, mean over pixels, summed over cameras. The references
are rendered by mivol (4096 samples) and compared with volpath's (z is printed), so that their noise decides nothing. Printed:
when mivol's volume has the image loss of prbvolpath's last one (the bar; and of its best one, which Adam leaves again for the
noise), and the errors of both densities (root mean square over that of the truth).

deep smoke, deep cloud: as smoke, at ``max_depth`` 6; also in directional light, and a cloud of a large-eddy simulation with an
albedo of 0.999, in 48 rounds: the variance of prbvolpath has heavy tails there. deep fine smoke: the smoke upsampled to 128^3.
deep tutorial: the tutorial as published, at depth 6.

deep estimators: as estimators, at depth 6 and unlimited; also with a small emitter inside, and in a box of glass. Finite
differences of pictures in which paths scatter often would take days: a collision more or less changes a path, and that noise is
divided by the step. So the truth is a path tracer of the bench's own, which carries the derivative forward and shares no code
with the integrators (mivol.bench.studies.gradients.twin). The sun is alone and stands before the camera, the emitter inside is
hidden from it: elsewhere what scatters in and what is taken away nearly cancel. In glass, unlimited, the half that is empty
elsewhere is thin: no mean is known where caught light runs along emptiness.

Prints JSON; writes bench_gradients.json and bench_gradients.png.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.bars import AT_LEAST, AT_MOST, Bar, judge, judge_agreement
from mivol.bench.harness.figures import drawn, plain_ticks
from mivol.bench.harness.study import Bench
from mivol.bench.studies.gradients.bias import ask_table
from mivol.bench.studies.gradients.size import CONTESTS, FULL, OURS, QUICK, STOCK, TABLES, TUTORIALS, Size
from mivol.bench.studies.gradients.tutorial import ask_tutorial
from mivol.bench.studies.gradients.variance import ask_contest
from mivol.report.figures import MARKERS, SERIES

__all__ = ["BENCH", "FULL", "QUICK", "Size", "main"]

QUESTIONS = (
    {question: ask_contest(question) for question in CONTESTS}
    | {question: ask_table(question) for question in TABLES}
    | {question: ask_tutorial(question) for question in TUTORIALS}
)


def compare(question: str, answer: dict) -> list[Bar]:
    """The figures that have a bar, beside it."""
    if question in CONTESTS:
        return compare_contest(question, answer)
    return compare_estimators(answer) if question in TABLES else compare_tutorial(question, answer)


def compare_contest(question: str, answer: dict) -> list[Bar]:
    """Ratios, and z where they are said."""
    rows = []
    for name, light in CONTESTS[question][1].items():
        for functional, figures in answer[name].items():
            dense, what = figures["sigma_t >= 1"], f"{question}, gradient of {functional}, {name}"
            rows.append(judge(f"variance x time: {what}", dense["variance_x_time"], AT_LEAST, light.bar))
            rows.append(judge_agreement(what, dense["z"], dense["z_bound"]))
    return rows


def compare_estimators(answer: dict) -> list[Bar]:
    """Our bias."""
    rows = []
    for light, table in answer.items():
        for name, row in table.items():
            what = f"{name}, {light}"
            bound = abs(row[OURS]["bias_percent"]) + 3 * row[OURS]["known_to_percent"]
            rows.append(judge(f"bias and 3 standard errors [%]: {what}", bound, AT_MOST, 0.5, aloud=False))
            rows.append(
                judge(f"bias [standard errors]: {what}", abs(row[OURS]["bias_standard_errors"]), AT_MOST, 3, aloud=False)
            )
    return rows


def compare_tutorial(question: str, answer: dict) -> list[Bar]:
    """How much sooner."""
    _, last, lowest = TUTORIALS[question]
    rows = [judge(f"{question}: how much sooner", answer["to_the_last_loss_of_prbvolpath"]["sooner"], AT_LEAST, last)]
    if not math.isnan(lowest):
        sooner = answer["to_its_lowest_loss"]["sooner"]
        rows.append(judge(f"{question}: how much sooner at the lowest loss", sooner, AT_LEAST, lowest))
    return rows


def draw(answers: dict, folder: Path) -> None:
    """A panel for each question that was asked."""
    with drawn(folder / "bench_gradients.png", 5 * len(answers), 4) as figure:
        for axes, (question, answer) in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers.items(), strict=True):
            if question in CONTESTS:
                draw_contest(axes, question, answer)
            elif question in TABLES:
                draw_estimators(axes, answer)
            else:
                draw_tutorial(axes, question, answer)


def draw_contest(axes: Axes, question: str, answer: dict) -> None:
    """Ratios beside their bars."""
    lights = CONTESTS[question][1]
    names = [(light, functional) for light in lights for functional in answer[light]]
    for row, (light, functional) in enumerate(reversed(names)):
        axes.semilogx([answer[light][functional]["sigma_t >= 1"]["variance_x_time"]], [row], MARKERS[0], color=SERIES[0])
        axes.plot([lights[light].bar] * 2, [row - 0.3, row + 0.3], color=SERIES[0], linestyle="--")
    axes.set(yticks=range(len(names)), yticklabels=[f"{f}, {light}" for light, f in reversed(names)])
    axes.set(title=f"Gradient ({question}), voxels with sigma_t >= 1")
    axes.set(xlabel="variance x time over prbvolpath's (line: the bar)")
    plain_ticks(axes.xaxis, "×")


def draw_estimators(axes: Axes, answer: dict) -> None:
    """Bias of both, with three standard errors."""
    names = [(light, case) for light, table in answer.items() for case in table]
    for i, estimator in enumerate((OURS, STOCK)):
        rows = [answer[light][case][estimator] for light, case in reversed(names)]
        at = np.arange(len(names)) + 0.2 * (0.5 - i)
        bars = [3 * r["known_to_percent"] for r in rows]
        axes.errorbar([r["bias_percent"] for r in rows], at, xerr=bars, fmt=MARKERS[i], color=SERIES[i], label=estimator)
    axes.set_xscale("symlog", linthresh=1)
    axes.set(yticks=range(len(names)), yticklabels=[f"{case}, {light}" for light, case in reversed(names)])
    axes.set(title="Bias against the truth", xlabel="bias [%], 3 standard errors")
    axes.set_ylim(-0.5, len(names) + 0.3)
    axes.legend(loc="upper left", ncols=2)


def draw_tutorial(axes: Axes, question: str, answer: dict) -> None:
    """Image loss against time."""
    for i, name in enumerate((OURS, STOCK)):
        run = answer["runs"][name]
        axes.loglog(run["seconds"], np.maximum(run["loss"], 1e-9), marker=MARKERS[i], markersize=3, color=SERIES[i], label=name)
    axes.set(title=f"Mitsuba's tutorial at depth {TUTORIALS[question][0]}")
    axes.set(xlabel="time [s]", ylabel="image loss, without noise [radiance²]")
    axes.legend()


UNASKED = ("tutorial", "deep smoke", "deep fine smoke", "deep cloud", "deep estimators", "deep tutorial")

BENCH = Bench("bench_gradients", __doc__, QUESTIONS, FULL, QUICK, compare, draw, unasked=UNASKED)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
