"""How fast are a radiance field's rays and their derivatives, and how much sooner is a fit done, beside Mitsuba's tutorial?

    scripts/bench_radiance_field.py                     # an hour on 2 idle cores, most of it in photographs and the peer
    scripts/bench_radiance_field.py --only step,memory  # 6 minutes
    scripts/bench_radiance_field.py --only photographs  # 40 minutes, a third of them for one fit
    scripts/bench_radiance_field.py --quick             # under two minutes, small sizes: its times mean nothing

The peer is :mod:`mivol.bench.studies.radiance_field.peer`: uniform steps over textures. Fields: a thin shell, a fog that fills
the box, and a fitted scene (the chair of NeRF's synthetic scenes from MIVOL_DATA, fitted here for a minute; without data, views
of a made-up object, and the JSON says so). All are 128^3 nodes of harmonics of degree 2 in [-1, 1]^3.

step: forward and backward, the same 65,536 rays for both, in turns; ratios of processor time (which other work on the machine
moves least), with the clock's beside them. camera: the pixels of one view; pixels: drawn at random from 8 views, as the
tutorial's loader draws them; any: random origins and directions. The first two share pinholes, so their harmonics are summed
once a node and pinhole, and that is counted. Rays of the third share nothing: each reads 28 numbers at every corner, from
anywhere in memory, and carries those of a face on to the next cell; they are sorted first, which is counted.

memory: the most that Dr.Jit held during a gradient step, for N and 4 N rays: what a ray costs is its own state.

locality: fits of 64^3 nodes from 24 views of the fitted scene, with rays of tiles of 4 x 4 pixels (what a fit does) and with as
many rays of single pixels drawn at random from the same views: time a step, and held-out PSNR after as many steps.

fit: 7 views of 256 x 256 pixels rendered of each field over black. The peer does as the tutorial does: 4 stages of doubling
resolution up to 128^3, 105 steps each, one view a step. Ours has 3 stages to the same resolution, in the last as many rays a
step as a view has pixels, from all views, and otherwise what every fit has. The mean PSNR of 4 views between them is followed,
every 7 steps of either, the clock stopped while it is measured; kernels are compiled before. Printed is the peer's time over
ours to the best PSNR that the peer reaches.

priors: the preset for captures at a small size, as it is and without each of its priors, on a procedural room and on the fox of
MIVOL_DATA: mean PSNR of the photographs of each fold, of fits to the others, and what a prior gains over the folds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.bars import AT_LEAST, AT_MOST, Bar, judge
from mivol.bench.harness.figures import drawn, plain_ticks
from mivol.bench.harness.study import Bench
from mivol.bench.studies.radiance_field.fits import ask_fit, ask_locality
from mivol.bench.studies.radiance_field.photographs import ask_photographs, bars_of
from mivol.bench.studies.radiance_field.priors import ask_priors
from mivol.bench.studies.radiance_field.size import FULL, QUICK, Size
from mivol.bench.studies.radiance_field.steps import ask_memory, ask_step
from mivol.report.figures import MARKERS, SERIES

__all__ = ["BENCH", "FULL", "QUICK", "Size", "main"]

QUESTIONS = {
    "step": ask_step,
    "memory": ask_memory,
    "locality": ask_locality,
    "fit": ask_fit,
    "photographs": ask_photographs,
    "priors": ask_priors,
}

STEP_BARS = {"camera": 8, "pixels": 4, "any": 4}
"""How many times the peer's rays a second there must be, for each order of the rays."""


def compare(question: str, answer: dict) -> list[Bar]:
    """The figures that have a bar."""
    if question == "memory":
        return [judge("bytes a ray beyond the grid's", answer["bytes_per_ray"], AT_MOST, 512)]
    if question in ("locality", "priors"):
        return []
    if question == "photographs":
        return bars_of(answer)
    if question == "fit":
        return [judge(f"{name}: time to the same PSNR", a["ratio"], AT_LEAST, 10) for name, a in answer.items()]
    return [
        judge(f"{name}: {kind} rays, forward and backward", a[kind]["ratio_of_processor_time"], AT_LEAST, bar)
        for name, a in answer.items()
        for kind, bar in STEP_BARS.items()
    ]


def draw(answers: dict, folder: Path) -> None:
    """A panel for each question that has a picture, and one for each field of the fits."""
    panels = [(PANELS[question], answer) for question, answer in answers.items() if question in PANELS]
    panels += [(draw_fit, {name: answer}) for name, answer in answers.get("fit", {}).items()]
    with drawn(folder / "bench_radiance_field.png", 4.2 * max(len(panels), 1), 3.6) as figure:
        for number, (panel, answer) in enumerate(panels, 1):
            panel(figure.add_subplot(1, len(panels), number), answer)


def draw_step(axes: Axes, answer: dict) -> None:
    """How many times the peer's rays a second, for each order of the rays."""
    rows = np.arange(len(answer))[::-1]
    for i, (kind, bar) in enumerate(STEP_BARS.items()):
        ratios = [a[kind]["ratio_of_processor_time"] for a in answer.values()]
        axes.semilogx(ratios, rows, MARKERS[i], color=SERIES[i], label=f"{kind} rays" if kind != "pixels" else "random pixels")
        axes.axvline(bar, color=SERIES[i], linestyle="--", linewidth=1.2)
    axes.set(yticks=rows, yticklabels=list(answer), ylim=(-0.6, len(rows) + 0.5))
    axes.set(title="Rays a second over the peer's", xlabel="forward and backward (lines: the bars)")
    plain_ticks(axes.xaxis, "×")
    axes.legend(loc="upper left")


def draw_memory(axes: Axes, answer: dict) -> None:
    """Peak of a step for two numbers of rays."""
    axes.bar(("rays", "4 x rays"), np.array(answer["peak_bytes"]) / 2**20, 0.5, color=SERIES[0])
    axes.axhline(answer["field_bytes"] / 2**20, color=SERIES[1], linestyle="--", linewidth=1.2, label="the field")
    axes.set(title=f"{answer['bytes_per_ray']:.0f} bytes a ray", ylabel="peak of a step [MiB]")
    axes.legend()


def draw_locality(axes: Axes, answer: dict) -> None:
    """What a step takes, and where as many steps end."""
    for i, (name, a) in enumerate(answer.items()):
        axes.plot(1e3 * a["processor_seconds"] / a["steps"], a["psnr"], MARKERS[i], color=SERIES[i], label=name)
    axes.set(title="Tiles and single pixels", xlabel="processor time of a step [ms]", ylabel="held-out PSNR [dB]")
    axes.margins(0.4)
    axes.legend()


def draw_fit(axes: Axes, answer: dict) -> None:
    """Held-out views against time."""
    ((name, curves),) = answer.items()
    for i, (who, label) in enumerate((("ours", "mivol"), ("peer", "tutorial's method"))):
        axes.semilogx(*zip(*curves[who], strict=True), marker=MARKERS[i], markersize=3, color=SERIES[i], label=label)
    axes.axhline(curves["peer_psnr"], color=SERIES[1], linestyle="--", linewidth=1.2, label="its best")
    axes.set(title=f"{name}, 7 views", xlabel="time [s]", ylabel="held-out PSNR [dB]")
    axes.legend()


PANELS = {"step": draw_step, "memory": draw_memory, "locality": draw_locality}

BENCH = Bench("bench_radiance_field", __doc__, QUESTIONS, FULL, QUICK, compare, draw, unasked=("photographs",))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
