"""Light that scatters once: how much sooner does mivol reach an error than Mitsuba's ``volpath`` and ``prbvolpath``?

    mivol bench single_scattering                    # 5 minutes on 2 idle cores
    mivol bench single_scattering --quick            # half a minute, small sizes: are the means the same?
    mivol bench single_scattering --only smoke       # one of the volumes

Four lights in five volumes, albedo 0.75, ``max_depth`` 2 for all integrators, ``mi.render``, 64 x 64 pixels (point lights:
24 x 24), box filter, independent samples. The volumes fill [-1, 1]^3:

- smoke: the Mitsuba tutorial's smoke at its density (x 40).
- fine smoke: the same smoke upsampled to 256^3. An exact walk crosses five times the cells; delta tracking takes as many steps.
- CT: a CT scan of 256^3. threads: 512^3 voxels, 99 % of them empty. Both have the largest extinction of the smoke, so delta
  tracking takes as many steps. Their outermost voxels are empty, because Mitsuba loses a skin at a boundary.
- cloud: a cloud of a large-eddy simulation.

Variance x time. The error of an unbiased estimate falls with the square root of the time, so variance x time depends on the
method alone. Each integrator gets the samples per pixel (a power of two) that take 0.8 s of processor time. All render in
turns, warm, in 8 rounds with their own seeds. The 8 images give the variance of each pixel (mean over the channels). The time
ratio is the median over the rounds of the ratio of processor times. The study reports

    variance x time, mean over pixels      ratio of the mean variances, times the ratio of times
    variance x time, median over pixels    median of the ratios of variances, times the ratio of times

The bar is on the first figure. Near a point light the mean variance does not exist, so for point lights the bar is on the
median. Their image is small, so that each pixel has enough samples to show the long tail of its variance (``volpath`` seems to
have half its variance at 32 samples compared with 500). Only pixels with a mean optical depth above 0.01 count, and no pixel
within 1.5 pixels of an emitter inside the medium. If the other integrator returns 0 in all 8 images of a pixel, the ratio of
this pixel counts as 0. Beside each ratio stands the ratio by wall clock, as a share of the ratio by processor time.

Agreement. Beside every ratio stands z: the difference of the means over these pixels in standard errors, with the relative
standard error, which is the smallest bias that z would show. With an emitter inside, most of the mean comes from rare or
unbounded samples, and no number of rounds makes the mean normal. Then the means are compared in the same volume thinned to an
optical depth of 1 at most, over pixels farther than a quarter of the image from the emitter. If a z exceeds its bound by
Student's t with effective degrees of freedom (false alarm in one run in 1000), the study ends with status 1: the ratios are
meaningless. Sample rates are camera paths per second of a warm render.

The figure shows error against time in the smoke and the ratios of all volumes. Data comes from MIVOL_DATA (default
../shared/data). Without the data, made-up fields take its place, and the JSON records this.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.contests import BudgetSize, agreement_figures, contest_images, gain_figures, image_errors
from mivol.bench.harness.figures import new_figure, plot_errors, plot_ratios, use_plain_ticks
from mivol.bench.harness.study import AT_LEAST, Bar, Promise, Study, amount, ask, judge_agreement, say_row
from mivol.bench.scenes import (
    StudyExtinction,
    as_dense_as_smoke,
    box_scene,
    constant_light,
    ct_scan,
    fine_smoke,
    les_cloud,
    make_integrator,
    point_light,
    smoke,
    sun_and_sky,
    threads_in_space,
)

ALBEDO = 0.75
PEERS = ("volpath", "prbvolpath")
MIN_TAU = 0.01
"""Smallest mean optical depth of a pixel that counts."""

LONGER = 16.0
"""Factor on the processor time of a render if the errors have heavy tails."""

EMITTER_PIXELS, EMITTER_SHARE = 1.5, 0.25
"""Pixels closer than this to an emitter inside do not count [pixels], and are left out of the means [share of a side]."""


@dataclass(frozen=True)
class ContestSize(BudgetSize):
    """Amount of work of the contests of images."""

    max_pixels: int = amount(64, 16, "largest edge of an image [pixels]")
    side: int = amount(0, doc="edge of all images [pixels]; 0: decided by the light and by max_pixels")
    fine_res: int = amount(256, 48, "voxels along an edge of the fine volumes")
    sparse_res: int = amount(512, 64, "voxels along an edge of the threads")


class Light(NamedTuple):
    """An emitter, a phase function, and the terms of its contest.

    Attributes:
        parts: makes the parts of the scene.
        bar: smallest ratio of variance x time.
        by_pixel: judge the median over pixels, because the mean variance does not exist.
        side: edge of the image [pixels].
        inside: position of an emitter in the medium.
        albedo: albedo of the medium.
        depth: ``max_depth`` of all integrators; -1: unlimited.
        peers: integrators of Mitsuba.
        has_tails: errors have heavy tails: renders take longer, and means, which no number of rounds makes normal, are compared
            in the thinned volume.
    """

    parts: Callable[[], dict]
    bar: float
    by_pixel: bool = False
    side: int = 64
    inside: tuple[float, float, float] | None = None
    albedo: float | tuple[float, ...] = ALBEDO
    depth: int = 2
    peers: tuple[str, ...] = PEERS
    has_tails: bool = False

    @property
    def average(self) -> str:
        """Average over pixels for the bar."""
        return "median" if self.by_pixel else "mean"

    @property
    def ratio_key(self) -> str:
        """Key of the judged figure."""
        return f"variance_x_time_{self.average}_over_pixels"


INSIDE, NEAR = (0.3, -0.5, 0.2), (0.9, -1.3, 1.2)

LIGHTS = {
    "constant light": Light(constant_light, 50),
    "HG 0.8, sun in a sky": Light(sun_and_sky, 30),
    "point light inside": Light(lambda: point_light(INSIDE), 100, True, 24, INSIDE),
    "point light near": Light(lambda: point_light(NEAR), 100, True, 24),
}

VOLUMES: dict[str, Callable[[ContestSize], StudyExtinction]] = {
    "smoke": lambda _: smoke(),
    "fine smoke": lambda size: fine_smoke(size.fine_res),
    "CT": lambda size: as_dense_as_smoke(ct_scan(size.fine_res)),
    "threads": lambda size: as_dense_as_smoke(threads_in_space(size.sparse_res)),
    "cloud": lambda _: les_cloud(),
}


COMPARISONS = len(VOLUMES) * len(LIGHTS) * len(PEERS)
"""Means that a whole run compares."""


# -- Contests ---------------------------------------------------------------------------------------------------------------


def contest_volume(
    name: str, make: Callable[[ContestSize], StudyExtinction], lights: dict[str, Light], size: ContestSize
) -> dict:
    """Let all integrators contend in a volume, in each of its lights; the smoke has curves of error against time."""
    volume = make(size)
    answer: dict = {"grid": str(volume)}
    for light_name, light in lights.items():
        answer[light_name] = contend(volume.values, light, size, size.levels if name == "smoke" else (1,))
    return answer


def contend(values: np.ndarray, light: Light, size: ContestSize, levels: tuple[int, ...] = (1,)) -> dict:
    """Measure variance, time and mean of each integrator, and the gain of mivol.

    Args:
        values: extinction of the box: (Z, Y, X), or (3,) for a homogeneous rgb medium [1/length].
        light: emitter and phase function.
        size: pixels, samples and rounds.
        levels: divisors of the samples; ratios are of the first one, 1.
    """
    if light.has_tails:
        size = replace(size, budget=LONGER * size.budget)
    side = size.side or min(light.side, size.max_pixels)
    scene = mi.load_dict(box_scene(values, side, light.albedo, **light.parts()))
    integrators = {name: make_integrator(name, light.depth) for name in ("mivol", *light.peers)}
    contest = contest_images(scene, integrators, size, levels)
    tau, distance = pixel_depths(values, light, side), emitter_distances(scene, light, side)
    counts = (tau > MIN_TAU) & (distance > EMITTER_PIXELS)
    answer: dict = {"pixels_that_count": int(counts.sum())}
    for name in integrators:
        answer[name] = [image_errors(contest, name, level, counts) for level in levels]
    compared, fair = contest, counts
    if light.inside is not None or light.has_tails:
        thinned = mi.load_dict(box_scene(values * np.float32(min(1, 1 / tau.max())), side, light.albedo, **light.parts()))
        compared = contest_images(thinned, integrators, size)
        fair = (tau > MIN_TAU) & (distance > EMITTER_SHARE * side)
    for name in light.peers:
        gain = gain_figures(contest, name, "mivol", counts) | agreement_figures(compared, name, "mivol", fair, COMPARISONS)
        answer[f"mivol over {name}"] = gain
        say_row(f"mivol over {name}", **{key: gain[key] for key in (light.ratio_key, "z", "relative_standard_error")})
    return answer


def pixel_depths(values: np.ndarray, light: Light, side: int) -> np.ndarray:
    """Mean optical depth of each pixel (H, W), seen without surfaces that bend or reflect rays."""
    scene = mi.load_dict(box_scene(values, side, light.albedo))
    image = mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": "tau"}), spp=64, seed=1)
    return np.array(image)[..., 3]


def emitter_distances(scene: mi.Scene, light: Light, side: int) -> np.ndarray:
    """Distance of each pixel (H, W) to the emitter in the medium [pixels]; infinite without such an emitter."""
    if light.inside is None:
        return np.full((side, side), np.inf)
    position = np.array(mi.Transform4f(scene.sensors()[0].world_transform()).inverse() @ mi.Point3f(light.inside)).ravel()
    # The image is 45 degrees wide; the sensor looks along z, with x to the left.
    at = 0.5 - position[:2] / position[2] / (2 * math.tan(math.radians(22.5)))
    j, i = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5, indexing="ij")
    return np.hypot(i - side * at[0], j - side * at[1])


# -- Bars and figure --------------------------------------------------------------------------------------------------------


def contest_study(
    module: str,
    doc: str | None,
    volumes: dict[str, Callable[[ContestSize], StudyExtinction]],
    contests: dict[str, dict[str, Light]],
    judged: tuple[str, ...],
    draw: Callable[[dict, Path], None],
) -> Study:
    """A study with a question for each volume, and with bars on the ratios to the ``judged`` integrators."""
    text = "How much sooner has mivol the same error in the {}?"
    questions = {name: ask(text.format(name), contest_volume, name, make, contests[name]) for name, make in volumes.items()}
    promises = {
        volume: [
            Promise(
                f"variance x time, {light.average}: {volume}, {name}, {peer}",
                (name, f"mivol over {peer}", light.ratio_key),
                AT_LEAST,
                light.bar,
            )
            for name, light in lights.items()
            for peer in judged
        ]
        for volume, lights in contests.items()
    }

    def compare(volume: str, answer: dict) -> list[Bar]:
        pairs = [(name, peer) for name, light in contests[volume].items() for peer in light.peers]
        found = [(f"{volume}, {name}, {peer}", answer[name][f"mivol over {peer}"]) for name, peer in pairs]
        return [judge_agreement(label, figures["z"], figures["z_bound"]) for label, figures in found]

    return Study(module, doc, ContestSize, questions, compare, draw, promises=promises)


def draw(answers: dict, path: Path) -> None:
    """Plot error against time in the first volume; below, the ratios of all volumes."""
    with new_figure(path, 13, 7.2) as figure:
        above, below = figure.subfigures(2, 1, height_ratios=(1, 0.9))
        volume = next(iter(answers))
        for axes, (name, light) in zip(above.subplots(1, len(LIGHTS)), LIGHTS.items(), strict=True):
            plot_contest(axes, answers[volume][name], light)
            axes.set_title(name)
        axes.legend()
        above.suptitle(f"{volume}, one scattering: error against time", x=0.01, ha="left", weight="bold")
        for axes, (name, light) in zip(below.subplots(1, len(LIGHTS), sharey=True), LIGHTS.items(), strict=True):
            ratios = {peer: [answers[v][name][f"mivol over {peer}"][light.ratio_key] for v in answers] for peer in PEERS}
            plot_ratios(axes, list(answers), ratios, [light.bar], first=1)
            axes.set(xlabel=f"variance x time ({light.average} over pixels)", ylim=(-0.6, len(answers) - 0.4))
        below.suptitle("how much sooner mivol has the same error (line: the bar)", x=0.01, ha="left", weight="bold")


def plot_contest(axes: Axes, figures: dict, light: Light) -> None:
    """Plot the relative error of a pixel against time."""
    key = f"relative_error_{light.average}_over_pixels"
    curves = {
        name: ([row["seconds_median"] for row in figures[name]], [row[key] for row in figures[name]])
        for name in ("mivol", *light.peers)
    }
    plot_errors(axes, curves)
    axes.set(xlabel="time [s], warm", ylabel=f"relative error of a pixel ({light.average})")
    use_plain_ticks(axes.xaxis)
    use_plain_ticks(axes.yaxis)


STUDY = contest_study(__name__, __doc__, VOLUMES, dict.fromkeys(VOLUMES, LIGHTS), PEERS, draw)
