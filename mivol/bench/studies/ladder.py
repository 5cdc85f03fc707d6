"""One scene, four models of light: how do the errors of images and gradients fall with time, for mivol and for Mitsuba?

    mivol bench ladder              # 3 minutes on 2 idle cores
    mivol bench ladder --quick      # small sizes, for CI

The smoke of the Mitsuba tutorial (or a made-up smoke, and the JSON records this) under a sky, in four models: absorption;
absorption and emission; single scattering below a sun (albedo 0.75, HG 0.8, ``max_depth`` 2); multiple scattering
(``max_depth`` 6). The grid is the same in all models, and gradients are with respect to its density. Mitsuba renders images by
``volpath`` and gradients of the mean of an image by ``prbvolpath``; Mitsuba 3.9 has no media that emit. Each method gets 1/16,
1/4 and all of the samples that take 0.8 s of processor time, in turns, in 8 rounds. The figure shows the error of a pixel over
the mean radiance, and the error of a voxel with sigma_t >= 1 over the root mean square of the gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.contests import BudgetSize, Contest, Method, compare_means, compete, contest_images, mean_of_rounds
from mivol.bench.harness.figures import new_figure, plot_errors, use_plain_ticks
from mivol.bench.harness.study import Bar, Study, amount, judge_agreement, say_row
from mivol.bench.scenes import ParameterGradient, box_scene, constant_light, make_integrator, smoke, sun_and_sky
from mivol.validate.statistics import Moments


@dataclass(frozen=True)
class LadderSize(BudgetSize):
    """Amount of work."""

    rounds: int = amount(8, 4, "images and gradients of each method")
    side: int = amount(64, 12, "edge of the image [pixels]")
    budget: float = amount(0.8, 0.05, "processor time of one render [s]")


@dataclass(frozen=True)
class Model:
    """A model of light.

    Attributes:
        parts: makes the parts of the scene.
        albedo: albedo of the medium.
        depth: ``max_depth``.
        emits: the medium has a source function of 1; Mitsuba has no emitting medium.
    """

    parts: Callable[[], dict]
    albedo: float
    depth: int
    emits: bool = False

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        """The box around an extinction (Z, Y, X)."""
        parts = box_scene(values, side, self.albedo, **self.parts())
        if self.emits:
            medium = parts["box"]["interior"]
            medium |= {"type": "mivol_medium", "emission": {"type": "constvolume", "value": 1.0}}
        return mi.load_dict(parts)

    def integrators(self, peer: str) -> dict[str, mi.Integrator]:
        """Integrators of the model: mivol, and the peer if Mitsuba has such media."""
        return {name: make_integrator(name, self.depth) for name in (("mivol",) if self.emits else ("mivol", peer))}


MODELS = {
    "absorption": Model(constant_light, 0.0, 2),
    "emission": Model(lambda: {"emitter": {"type": "constant", "radiance": 0.2}}, 0.0, 2, True),
    "single scattering": Model(sun_and_sky, 0.75, 2),
    "multiple scattering": Model(sun_and_sky, 0.75, 6),
}
"""Models; each contains the effects of the one before, except for the emission."""


def measure(size: LadderSize) -> dict:
    """How do the errors of images and gradients fall with time, in four models of one scene?"""
    grid, measures = smoke(), {"image": measure_image, "gradient": measure_gradient}
    answer: dict = {"grid": str(grid)}
    for name, model in MODELS.items():
        answer[name] = {kind: run(model, grid.values, size) for kind, run in measures.items()}
        say_row(name, **{kind: figures.get("variance_x_time") for kind, figures in answer[name].items()})
    return answer


def measure_image(model: Model, values: np.ndarray, size: LadderSize) -> dict:
    """Errors of pixels against time, and the image."""
    contest = contest_images(model.scene(values, size.side), model.integrators("volpath"), size, size.levels)
    figures, mean = error_figures(contest, np.ones(size.side**2 * 3, bool), np.mean)
    return figures | {"picture": mean.reshape(size.side, size.side, 3)}  # for the figure only


def measure_gradient(model: Model, values: np.ndarray, size: LadderSize) -> dict:
    """Errors of voxels against time."""
    methods: dict[str, Method] = {
        name: ParameterGradient(model.scene(values, size.side), integrator).of_mean
        for name, integrator in model.integrators("prbvolpath").items()
    }
    contest = compete(methods, size.rounds, size.budget, size.spp, levels=size.levels, seed=size.seed)
    return error_figures(contest, (values >= 1).ravel(), root_mean_square)[0]


def root_mean_square(values: np.ndarray) -> float:
    """Root mean square."""
    return math.sqrt(np.square(values).mean())


def error_figures(contest: Contest, counts: np.ndarray, scale: Callable[[np.ndarray], float]) -> tuple[dict, np.ndarray]:
    """Errors relative to the scale of mivol's mean, the gain of mivol, and this mean.

    Args:
        contest: results of mivol and perhaps of a peer.
        counts: mask of the counted numbers (n,).
        scale: counted mean values -> scale of the errors.

    Returns:
        Rows of each method, ``agreement`` and ``variance_x_time`` of a contest with a peer; and the mean of mivol (n,).
    """
    results = {key: contest.results(*key).reshape(len(t.results), -1) for key, t in contest.timings.items()}
    mean = results["mivol", 1].mean(axis=0)
    unit = scale(mean[counts])
    figures: dict = {}
    for (name, level), timing in contest.timings.items():
        error = math.sqrt(Moments.from_values(results[name, level]).variance[counts].mean()) / unit
        figures.setdefault(name, []).append({"level": level, "seconds_median": timing.median, "relative_error": error})
    for peer in list(figures)[1:]:
        sums = (mean_of_rounds(results[name, 1][:, counts].sum(axis=1)) for name in ("mivol", peer))
        figures["agreement"] = compare_means(*sums, 6)
        slow, fast = (figures[name][0] for name in (peer, "mivol"))
        error = slow["relative_error"] / fast["relative_error"]
        figures["variance_x_time"] = error**2 * slow["seconds_median"] / fast["seconds_median"]
    return figures, mean


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means."""
    pairs = [(f"{kind}, {name}", answer[name][kind].get("agreement")) for name in MODELS for kind in ("image", "gradient")]
    return [judge_agreement(label, found["z"], found["z_bound"]) for label, found in pairs if found is not None]


def draw(answers: dict, path: Path) -> None:
    """A column for each model: its image, the errors of images and of gradients. The figure is low, to fit into the README."""
    (answer,) = answers.values()
    with new_figure(path, 2.2 * len(MODELS), 4.2) as figure:
        rows = figure.subplots(3, len(MODELS), height_ratios=(1, 1.1, 1.1))
        for k, name in enumerate(MODELS):
            panel, image, gradient = (row[k] for row in rows)
            pixels = answer[name]["image"]["picture"]
            panel.imshow(np.clip(pixels / np.quantile(pixels, 0.99), 0, 1) ** (1 / 2.2), interpolation="nearest")
            panel.set_axis_off()
            panel.set_title(name, loc="center")
            plot_model(image, answer[name]["image"], "volpath")
            plot_model(gradient, answer[name]["gradient"], "prbvolpath")
            gradient.set_xlabel("time [s], warm")
        for axes, kind in zip(rows[1:, 0], ("image", "gradient"), strict=True):
            axes.set_ylabel(f"error of {kind} [1]")
            axes.legend()


def plot_model(axes: Axes, figures: dict, peer: str) -> None:
    """Plot error against time of mivol and of the peer, if the peer took part."""
    curves = {
        name: tuple([row[key] for row in figures[name]] for key in ("seconds_median", "relative_error"))
        for name in ("mivol", peer)
        if name in figures
    }
    plot_errors(axes, curves)
    use_plain_ticks(axes.xaxis)
    use_plain_ticks(axes.yaxis)


STUDY = Study(__name__, __doc__, LadderSize, {"ladder": measure}, compare, draw)
