"""Scenes as people build them: how much sooner has mivol the same error as Mitsuba, with the better of two samplers?

    mivol bench everyday                                     # 20 minutes on 2 idle cores
    mivol bench everyday --quick                             # 5 minutes, small images: do the means agree?
    mivol bench everyday --scenes tissue god_rays            # some of the scenes
    mivol bench everyday --only images --side 48 --spp 16    # a smaller question

Fifteen scenes (:mod:`mivol.bench.studies.everyday.scenes`): homogeneous and varying media in rooms, over floors, in glass and
in fog, with lamps inside and beside, each at the depth that its light needs. All methods take the same samples per pixel and
render in turns, in rounds with their own seeds. A ratio is variance x processor time of the peer over variance x processor time
of mivol; so a ratio of 10 means the same error in a tenth of the time.

images: mean variance over pixels and colours, over ``volpath`` with the better of its samplers ``independent`` and
``multijitter``. Beside the ratio stand the median pixel's ratio to the same peer, milliseconds of one image, and z: the
difference of the means in standard errors. If a z exceeds its bound (false alarm in one run in 1000, Student's t), the study
ends with status 1.

gradients: of the mean of the image, ``mi.render`` and ``dr.backward``, with respect to the density, or the albedo in
``coloured_albedo``; over ``prbvolpath``, with a quarter of the samples. The variance is the mean over the voxels with at least
0.3 of the largest value. z compares the derivatives along the logarithm of the parameter. It decides nothing here:
``prbvolpath`` is biased in some of these scenes, and the table shows where. A gradient of one number has
four times the rounds.

The pixel that shows a point lamp inside a medium has an infinite variance, whatever the integrator, since light falls as 1 / h
with the distance h of a ray. With 6 rounds, ratios of such scenes scatter by 10 times from run to run; use ``--rounds 24``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.bars import AT_LEAST, Bar, Promise, judge_agreement, say_row
from mivol.bench.harness.contests import (
    agreement_figures,
    compare_means,
    compete,
    finite_or_none,
    gain_figures,
    image_errors,
    mean_of_rounds,
    render_method,
)
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import Size, Study, amount
from mivol.bench.scenes import ParameterGradient
from mivol.bench.studies.everyday.scenes import SCENES, EverydayScene
from mivol.errors import MivolError
from mivol.optim.strategy import suggest_name
from mivol.report.figures import SERIES

SAMPLERS = {"volpath": "independent", "volpath, multijitter": "multijitter"}
"""Samplers of the peers of images."""

PEER = "prbvolpath"
MORE_ROUNDS = 4
"""Factor on the rounds of single-number gradients, whose variance 24 rounds measure only within a factor of 1.5."""

DENSE = 0.3
"""Voxels with at least this share of the largest value count."""


@dataclass(frozen=True)
class EverydaySize(Size):
    """Amount of work."""

    scenes: tuple[str, ...] = amount(tuple(SCENES), doc="scenes to measure")
    side: int = amount(96, 12, "edge of the image [pixels]")
    spp: int = amount(64, 4, "samples per pixel of one image")
    gradient_spp: int = amount(16, 1, "samples per pixel of one gradient")
    rounds: int = amount(6, 4, "images and gradients of each method")
    seed: int = amount(0, doc="seed of all renders")


def chosen_scenes(names: Sequence[str]) -> dict[str, EverydayScene]:
    """The scenes of the given names.

    Raises:
        MivolError: an unknown scene.
    """
    for name in names:
        if name not in SCENES:
            raise MivolError(f'there is no scene "{name}": {suggest_name(name, SCENES)}')
    return {name: SCENES[name] for name in names}


def measure_images(size: EverydaySize) -> dict:
    """How much sooner has an image of mivol the same error as one of volpath?"""
    return _measure_scenes(_contend_images, size)


def measure_gradients(size: EverydaySize) -> dict:
    """How much sooner does a gradient of mivol reach the error of prbvolpath?"""
    return _measure_scenes(_contend_gradients, size)


def _measure_scenes(contend: Callable[[EverydayScene, EverydaySize], dict], size: EverydaySize) -> dict:
    rows = {}
    for name, scene in chosen_scenes(size.scenes).items():
        rows[name] = row = contend(scene, size)
        say_row(name, ratio=row["ratio"], z=row["z"])
        dr.flush_malloc_cache()
    ratios = [row["ratio"] for row in rows.values() if row["ratio"]]
    return {"scenes": rows, "geometric_mean": float(np.exp(np.mean(np.log(ratios)))) if ratios else None}


def _contend_images(scene: EverydayScene, size: EverydaySize) -> dict:
    """Errors and times of all methods, and the figures of mivol over the better peer."""
    samplers = {"mivol": "independent"} | SAMPLERS
    methods = {
        name: render_method(scene.load(size.side, sampler, size.spp), scene.integrator(name.partition(",")[0]))
        for name, sampler in samplers.items()
    }
    contest = compete(methods, size.rounds, 0.0, size.spp, seed=size.seed)
    counts = np.ones((size.side,) * 2, bool)
    comparisons = len(size.scenes) * len(SAMPLERS)
    gains = {
        peer: gain_figures(contest, peer, "mivol", counts) | agreement_figures(contest, peer, "mivol", counts, comparisons)
        for peer in SAMPLERS
    }
    better = min(gains, key=lambda peer: gains[peer]["variance_x_time_mean_over_pixels"])
    errors = {name: image_errors(contest, name, 1, counts) for name in methods}
    return {
        **errors,
        **{f"mivol over {peer}": gain for peer, gain in gains.items()},
        "peer": better,
        "ratio": gains[better]["variance_x_time_mean_over_pixels"],
        "median_ratio": gains[better]["variance_x_time_median_over_pixels"],
        "milliseconds": {name: 1e3 * contest.timings[name, 1].median for name in (better, "mivol")},
        "means": {name: errors[name]["mean"] for name in (better, "mivol")},
        "z": max((gains[peer]["z"] for peer in SAMPLERS), key=lambda z: np.inf if z is None else abs(z)),
        "z_bound": gains[better]["z_bound"],
    }


def _contend_gradients(scene: EverydayScene, size: EverydaySize) -> dict:
    """Variances and times of the gradients of both integrators, and derivatives along the logarithm of the parameter."""
    gradients = {
        name: ParameterGradient(scene.load(size.side), scene.integrator(name), scene.parameter) for name in (PEER, "mivol")
    }
    methods = {name: partial(g.of_loss, _mean_of_image) for name, g in gradients.items()}
    values = np.array(gradients["mivol"].params[scene.parameter], np.float64).ravel()
    dense = values >= DENSE * values.max()
    rounds = size.rounds * (MORE_ROUNDS if values.size <= 3 else 1)
    contest = compete(methods, rounds, 0.0, size.gradient_spp, seed=size.seed)
    times = contest.time_ratios(PEER, "mivol")
    variances = {name: contest.variances(name).ravel()[dense] for name in methods}
    along = {name: mean_of_rounds(contest.results(name).reshape(rounds, -1) @ values) for name in methods}
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, median = variances[PEER].mean() / variances["mivol"].mean(), np.nanmedian(variances[PEER] / variances["mivol"])
    # A gradient that is always 0 is no result.
    ratios = {"ratio": ratio or np.nan, "median_ratio": median}
    return {
        "variance": {name: float(v.mean()) for name, v in variances.items()},
        **{name: finite_or_none(ratio * times["processor_time"]) for name, ratio in ratios.items()},
        "milliseconds": {name: 1e3 * contest.timings[name, 1].median for name in methods},
        "means": {name: mean.mean for name, mean in along.items()},
        "standard_errors": {name: mean.var**0.5 for name, mean in along.items()},
        **times,
        **compare_means(along["mivol"], along[PEER], len(size.scenes)),
    }


def _mean_of_image(image: mi.TensorXf) -> mi.Float:
    return dr.mean(image, axis=None)


# -- Bars, table and figure -------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means of images."""
    rows = [(name, peer, row[f"mivol over {peer}"]) for name, row in answer["scenes"].items() for peer in SAMPLERS
            if question == "images"]  # fmt: skip
    return [judge_agreement(f"{name}, {peer}", figures["z"], figures["z_bound"]) for name, peer, figures in rows]


def promise(question: str, bars: dict[str, float | None], mean: float) -> list[Promise]:
    """Bars on the ratios of scenes, and on the geometric mean of the measured scenes."""
    label = f"variance x time, {question}"
    ratios = [Promise(f"{label}: {name}", ("scenes", name, "ratio"), AT_LEAST, bar) for name, bar in bars.items() if bar]
    return [*ratios, Promise(f"{label}: geometric mean", ("geometric_mean",), AT_LEAST, mean)]


PROMISES = {
    "images": promise("images", {name: scene.image_bar for name, scene in SCENES.items()}, 8),
    "gradients": promise("gradients", {name: scene.gradient_bar for name, scene in SCENES.items()}, 5),
}


def tabulate(question: str, answer: dict) -> list[str]:
    """A row for each scene."""
    lines = [
        f"| {question} | ratio | median | peer | ms, peer / mivol | mean, peer / mivol | z |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in answer["scenes"].items():
        ratios = " | ".join("none" if row[key] is None else f"{row[key]:.2f}" for key in ("ratio", "median_ratio"))
        times = " / ".join(f"{t:.0f}" for t in row["milliseconds"].values())
        means = " / ".join(f"{mean:.4g}" for mean in row["means"].values())
        z = "none" if row["z"] is None else f"{row['z']:+.1f}{'' if abs(row['z']) <= row['z_bound'] else ' (differs)'}"
        lines.append(f"| {name} | {ratios} | {next(iter(row['means']))} | {times} | {means} | {z} |")
    mean = answer["geometric_mean"]
    return [*lines, f"| geometric mean | {'none' if mean is None else f'{mean:.2f}'} | | | | | |"]


def draw(answers: dict, path: Path) -> None:
    """A panel for each question: a bar for the ratio of each scene, from the strongest to the weakest."""
    rows = max(len(answer["scenes"]) for answer in answers.values())
    with new_figure(path, 6.4 * len(answers), 1.2 + 0.3 * rows) as figure:
        for axes, (question, answer) in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers.items(), strict=True):
            _plot_bars(axes, {name: row["ratio"] for name, row in answer["scenes"].items() if row["ratio"]})
            axes.set(title=question, xlabel=f"variance x time of {'volpath' if question == 'images' else PEER} over mivol")


def _plot_bars(axes: Axes, ratios: dict[str, float]) -> None:
    """Horizontal bars that begin at a ratio of 1, on a logarithmic axis."""
    names = sorted(ratios, key=ratios.__getitem__)
    values = np.array([ratios[name] for name in names])
    bars = axes.barh(names, values - 1, left=1, color=[SERIES[0] if v >= 1 else SERIES[1] for v in values])
    axes.bar_label(bars, [f"{v:.2g}×" if v < 100 else f"{v:.0f}×" for v in values], padding=2)
    axes.axvline(1, color="black", linewidth=1)
    low, high = min([*values, 1]), max([*values, 1])
    margin = max(2.0, (high / low) ** 0.15)  # room for the labels
    axes.set(xscale="log", xlim=(low / margin, high * margin))
    use_plain_ticks(axes.xaxis, "×")


QUESTIONS = {"images": measure_images, "gradients": measure_gradients}
STUDY = Study(__name__, __doc__, EverydaySize, QUESTIONS, compare, draw, tabulate, promises=PROMISES)
