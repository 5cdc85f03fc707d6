"""Density gradients of light that scatters once or often: how exact are they, how much sooner than those of ``prbvolpath``?

    mivol bench gradients                        # about 10 minutes on 2 idle cores: all but the tutorial
    mivol bench gradients --only tutorial        # 5 minutes, nearly all of them in prbvolpath
    mivol bench gradients --only "deep smoke,deep cloud"      # 8 minutes: light that scatters up to five times
    mivol bench gradients --only "deep fine smoke"            # 8 minutes
    mivol bench gradients --only "deep tutorial"              # 15 minutes
    mivol bench gradients --only "deep estimators"            # an hour
    mivol bench gradients --quick                # a minute, small sizes: are mivol's gradients right?

Gradients are with respect to the voxels of sigma_t [1/length]. Albedo 0.75, ``max_depth`` 2 for all, stock scenes, the box
[-1, 1]^3, box filter, independent samples, 64 x 64 pixels (estimators: 24 x 24). Times are of warm calls.

smoke: the smoke of the Mitsuba tutorial at its density (x 40), in constant light, and with HG g = 0.8 below a sun in a sky. Two
gradients: of the mean of the image (a call of ``render_backward``), and of an L2 loss, the mean squared difference to the image
of 0.7 of the density (a whole step: ``mi.render``, loss, ``dr.backward``). Both integrators get the samples that take the same
processor time (a power of two per pixel) and run in turns, in 8 rounds with their own seeds. The study reports the sum over
voxels of the variances over the 8 gradients, times the processor time: over the voxels with sigma_t >= 1 (the bars), over
voxels between 0 and 1, and over voxels at 0. The last two ratios say little, because ``prbvolpath`` is biased there. Beside the
ratio stands z: the difference of the derivatives along sigma_t itself, summed over the same voxels, in standard errors. If z
exceeds its bound for sigma_t >= 1 (false alarm in one run in 1000, Student's t), the ratio is meaningless and the study ends
with status 1.

estimators: bias and variance of both integrators in four cases: density 0, half empty, thin, dense (16^3 voxels). The
derivative of the mean of the image along a fixed direction in the space of voxels (thin, dense: the density itself; density 0:
all voxels alike; half empty: the empty half) is compared with finite differences of mivol's images with common random numbers:
central of fourth order, or one-sided of third order for a density of 0. Differences and mivol's derivatives are repeated until
their means are known to 0.06 %, 750 times at most. The bias is reported in standard errors (of both together) and in percent.
The bars for mivol are 0.5 % (with 3 standard errors to spare) and 3 standard errors. Variance x time is summed over the voxels
of the direction: prbvolpath's over mivol's.

tutorial: Mitsuba's official tutorial on volume optimisation, with ``max_depth`` 2 in place of prbvolpath's default of 6 (see
:mod:`mivol.bench.studies.gradients.tutorial`). The study reports when mivol's volume reaches the image loss of prbvolpath's
last volume (the bar) and of its best volume, which Adam leaves again because of the noise.

deep smoke, deep cloud: as smoke, with ``max_depth`` 6; also in directional light, and in a cloud of a large-eddy simulation
with an albedo of 0.999, in 48 rounds, because the variance of prbvolpath has heavy tails there. deep fine smoke: the smoke
upsampled to 128^3. deep tutorial: the tutorial as published, with depth 6.

deep estimators: as estimators, with depth 6 and unlimited; also with a small emitter inside, and in a box of glass. Finite
differences of images with many scatterings would take days: one collision more or less changes a path, and this noise is
divided by the step. So the truth is a path tracer that carries the derivative forward and shares no code with the integrators
(:mod:`mivol.bench.studies.gradients.twin`). The sun stands alone before the camera, and the emitter inside is hidden from it:
in other lights, in-scattering and extinction nearly cancel. In glass with unlimited depth, one half is thin and not empty: no
mean is known if trapped light flies along an empty region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.contests import SEED_STRIDE, Contest, compare_means, compete, finite_or_none, mean_of_rounds
from mivol.bench.harness.figures import new_figure, plot_errors, plot_ratios
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Bar, Promise, Study, amount, ask, judge, judge_agreement, say_row
from mivol.bench.scenes import (
    ParameterGradient,
    StudyExtinction,
    constant_light,
    directional_light,
    emitter_inside,
    fine_smoke,
    glass_under_a_sky,
    les_cloud,
    smoke,
    square_error,
    sun_and_sky,
    sun_before_the_camera,
)
from mivol.bench.studies.gradients.tutorial import TutorialSize, measure_tutorial
from mivol.bench.studies.gradients.twin import INTEGRATORS, Light, Twin
from mivol.report.figures import MARKERS, SERIES
from mivol.validate.statistics import Estimate, Moments

DENSE = "sigma_t >= 1"
"""Region whose gradients are judged."""

CONSTANT, SUN, DIRECTIONAL = "constant light", "HG 0.8, sun in a sky", "HG 0.8, directional"

CONTESTS: dict[str, tuple[Callable[[], StudyExtinction], dict[str, Light]]] = {
    "smoke": (smoke, {CONSTANT: Light(constant_light, 60), SUN: Light(sun_and_sky, 30)}),
    "deep smoke": (
        smoke,
        {
            CONSTANT: Light(constant_light, 100, 6),
            SUN: Light(sun_and_sky, 100, 6),
            DIRECTIONAL: Light(directional_light, 35, 6),
        },
    ),
    "deep fine smoke": (lambda: fine_smoke(128), {CONSTANT: Light(constant_light, 40, 6), SUN: Light(sun_and_sky, 20, 6)}),
    "deep cloud": (les_cloud, {SUN: Light(sun_and_sky, 80, 6, 0.999, rounds=6)}),
}
"""Volumes and lights of the contests of variance x time, by question."""

DEEP_LIGHTS = {
    CONSTANT: Light(constant_light),
    "HG 0.8, sun before the camera": Light(sun_before_the_camera, samples_emitters=True),
    "emitter inside": Light(emitter_inside, samples_emitters=True, hidden=True),
    "glass": Light(glass_under_a_sky, traps_light=True),
}
"""Lights in which the derivative of the mean of an image does not nearly cancel, so its relative error is soon known. The
camera does not see the emitter inside: the few pixels of the emitter would have most of the noise."""

TABLES: dict[str, dict[str, Light]] = {
    "estimators": {CONSTANT: Light(constant_light), SUN: Light(sun_and_sky)},
    "deep estimators": {
        f"{name}, {'depth 6' if depth > 0 else 'unlimited'}": replace(light, depth=depth)
        for depth in (6, -1)
        for name, light in DEEP_LIGHTS.items()
    },
}
"""Lights in which integrators are compared with finite differences or with the twin, by question."""

TUTORIALS: dict[str, tuple[int, float, float | None]] = {"tutorial": (2, 20, None), "deep tutorial": (6, 60, 30)}
"""``max_depth`` of the tutorial; smallest ratio of times to prbvolpath's last loss, and to its lowest loss."""


@dataclass(frozen=True)
class GradientSize(TutorialSize):
    """Amount of work; the tutorial has its own part."""

    rounds: int = amount(8, 5, "gradients of each integrator")
    budget: float = amount(2.0, 0.05, "processor time of one gradient [s]")
    spp: int = amount(0, doc="samples per pixel of one gradient; 0: decided by the budget")
    table_rounds: int = amount(16, 8, "gradients of each integrator in the table of biases")
    table_side: int = amount(24, 8, "edge of the image of the table [pixels]")
    table_budget: float = amount(0.4, 0.05, "processor time of one gradient of the table [s]")
    table_spp: int = amount(0, doc="samples per pixel of one gradient of the table; 0: decided by the budget")
    table_res: int = amount(16, 6, "voxels along an edge of the table's grids")
    derivative_spp: int = amount(256, 64, "samples per pixel of mivol's derivatives in the table")
    difference_spp: int = amount(1024, 256, "samples per pixel of images of a difference, and of derivatives of the twin")
    certain_percent: float = amount(0.06, math.inf, "standard error of the means of the table [%]")
    most_estimates: int = amount(750, doc="largest number of estimates of such a mean")
    seed: int = amount(0, doc="seed of gradients and differences")


# -- Contests ---------------------------------------------------------------------------------------------------------------


def measure_contest(question: str, size: GradientSize) -> dict:
    """Compare variance x time in the regions of a volume, in each light."""
    make, lights = CONTESTS[question]
    volume = make()
    answer: dict = {"grid": str(volume)}
    for name, light in lights.items():
        scene, integrator = light.scene(0.7 * volume.values, size.side), light.integrator("mivol")
        target = mi.render(scene, integrator=integrator, seed=77, spp=size.difference_spp)
        both = light.gradients(volume.values, size.side)
        functionals = {
            "mean": {who: g.of_mean for who, g in both.items()},
            "L2": {who: partial(g.of_loss, square_error(target)) for who, g in both.items()},
        }
        answer[name] = {}
        for functional, methods in functionals.items():
            contest = compete(methods, size.rounds * light.rounds, size.budget, size.spp, seed=size.seed)
            answer[name][functional] = contest_figures(contest, volume.values, size.side, 2 * len(lights))
            dense = answer[name][functional][DENSE]
            say_row(f"{name}, {functional}", variance_x_time=dense["variance_x_time"], z=dense["z"])
    return answer


def contest_figures(contest: Contest, values: np.ndarray, side: int, comparisons: int) -> dict:
    """Times, and for each region of the volume the ratio of variance x time and the agreement of the means.

    Args:
        contest: gradients of both integrators.
        values: extinction (Z, Y, X).
        side: edge of the image [pixels].
        comparisons: number of comparisons that share the probability of a false alarm.
    """
    mivol, peer = INTEGRATORS
    times = contest.time_ratios(peer, mivol)
    figures: dict = {}
    for name in INTEGRATORS:
        spp = contest.spp[name, 1]
        figures[name] = {"spp": spp} | contest.timings[name, 1].report(side * side * spp, "samples")
    figures |= times
    regions = {DENSE: values >= 1, "0 < sigma_t < 1": (values > 0) & (values < 1), "sigma_t = 0": values == 0}
    for region, chosen in regions.items():
        if not chosen.any():
            continue
        a, b = (contest.variances(name)[chosen.ravel()].sum() for name in (peer, mivol))
        direction = np.where(chosen, values if values[chosen].any() else 1.0, 0.0)
        means = (mean_of_rounds(directional_derivatives(contest, name, direction)) for name in INTEGRATORS)
        figures[region] = {
            "voxels": int(chosen.sum()),
            "variance_x_time": float(a / b * times["processor_time"]),
            **compare_means(*means, comparisons),
        }
    return figures


def directional_derivatives(contest: Contest, name: str, direction: np.ndarray) -> np.ndarray:
    """Derivatives along a direction (Z, Y, X), one for each round."""
    return contest.results(name) @ direction.ravel().astype(np.float64)


# -- Tables of bias ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A density (Z, Y, X), a direction of change, and the step of a finite difference; step 0: the twin is the truth."""

    values: np.ndarray
    direction: np.ndarray
    step: float = 0.0


def make_cases(res: int) -> dict[str, Case]:
    """Cases with single scattering.

    A step h changes the optical depth x of a path by h x: at most 0.05 (density 0), 0.1 (half empty), 0.03 (thin) and 0.15
    (dense: for paths with x <= 3, which carry 95 % of the light). So the truncation error is at most (h x)^4 / 30 = 0.002 %
    (central) or (h x)^3 / 4 = 0.025 % (one-sided).
    """
    noise = np.random.default_rng(1).uniform(0.5, 1.5, (res,) * 3)
    ones, left = np.ones((res,) * 3), np.broadcast_to(np.arange(res) < res // 2, (res,) * 3)
    return {
        "density 0": Case(0 * ones, ones, 0.01),
        "half empty": Case(np.where(left, 0, 4 * noise), np.where(left, 1.0, 0.0), 0.02),
        "thin": Case(0.05 * noise, 0.05 * noise, 0.1),
        "dense": Case(10 * noise, 10 * noise, 0.05),
    }


THIN = 0.25
"""Extinction of the thin half, in which trapped light flies: a quarter of the mean of the other half [1/length]."""


def make_deep_cases(res: int, light: Light) -> dict[str, Case]:
    """Cases with many scatterings.

    First case: an empty half, along which the derivative is taken, beside an optical depth of about 1. Second case: an optical
    depth of about 6, with the derivative along the density itself. Both derivatives are far from 0 in all lights. For trapped
    light with unlimited depth the empty half is thin: distances l along an empty region have a density that falls only as
    1 / l^3, so the second moment of estimates has no bound.
    """
    noise = np.random.default_rng(1).uniform(0.5, 1.5, (res,) * 3)
    left = np.broadcast_to(np.arange(res) < res // 2, (res,) * 3)
    name, least = ("half thin", THIN) if light.traps_light and light.depth < 0 else ("half empty", 0.0)
    return {name: Case(np.where(left, least, noise), np.where(left, 1.0, 0.0)), "dense": Case(3 * noise, 3 * noise)}


def finite_difference(gradient: ParameterGradient, case: Case, seed: int, spp: int) -> float:
    """Finite difference along the direction with common random numbers: central of order 4, or one-sided of order 3."""
    v, h = case.direction, case.step
    central = (case.values[v > 0] > 0).all()
    weights = {-2: 0.5, -1: -4, 1: 4, 2: -0.5} if central else {0: -11, 1: 18, 2: -9, 3: 2}
    return sum(w * gradient.mean(case.values + s * h * v, seed, spp) for s, w in weights.items()) / (6 * h)


def estimate_truth(case: Case, light: Light, gradient: ParameterGradient, size: GradientSize) -> Callable[[int], float]:
    """Estimator of the true derivative, by its seed: finite differences of mivol's images, or the twin."""
    if case.step:
        return lambda seed: finite_difference(gradient, case, seed, size.difference_spp)
    twin = Twin(case.values, case.direction, size.table_side, light)
    return lambda seed: twin.derivative(seed, size.difference_spp)


def refine(values: Sequence[float], estimate: Callable[[int], float], percent: float, most: int) -> np.ndarray:
    """Add independent estimates until their mean is known well enough.

    Args:
        values: at least two estimates.
        estimate: number of an estimate -> the estimate.
        percent: wanted standard error of the mean [% of the mean].
        most: largest number of estimates.
    """
    values = list(values)
    while len(values) < most:
        m = Moments.from_values(np.array(values))
        if math.sqrt(m.variance_of_mean) <= percent / 100 * abs(m.mean):
            break
        values.append(estimate(len(values)))
    return np.array(values)


def measure_table(question: str, size: GradientSize) -> dict:
    """Compare both integrators with the truth, in each light and case."""
    lights, answer = TABLES[question], {}
    for name, light in lights.items():
        cases = make_cases(size.table_res) if light.depth == 2 else make_deep_cases(size.table_res, light)
        answer[name] = {}
        for label, case in cases.items():
            answer[name][label] = row = measure_row(case, light, size, len(lights) * len(cases))
            say_row(f"{name}, {label}", truth=row["truth"], **{who: row[who]["bias_percent"] for who in INTEGRATORS})
    return answer


def measure_row(case: Case, light: Light, size: GradientSize, rows: int = 1) -> dict:
    """Compare both integrators with the truth in one case; ``rows`` of the table share the probability of a false alarm."""
    gradients = light.gradients(case.values.astype(np.float32), size.table_side)
    methods = {name: g.of_mean for name, g in gradients.items()}
    contest = compete(methods, size.table_rounds, size.table_budget, size.table_spp, seed=size.seed)
    derivatives = {name: directional_derivatives(contest, name, case.direction) for name in INTEGRATORS}
    first, v = SEED_STRIDE * size.seed, case.direction.ravel()
    mivol, peer = INTEGRATORS
    estimate = estimate_truth(case, light, gradients[mivol], size)

    def repeat(estimate: Callable[[int], float]) -> np.ndarray:
        start = [estimate(k) for k in range(size.table_rounds)]
        return refine(start, estimate, size.certain_percent, size.most_estimates)

    def derivative(k: int) -> float:
        return float(np.array(gradients[mivol].of_mean(first + 9000 + k, size.derivative_spp), np.float64) @ v)

    derivatives[mivol] = repeat(derivative)
    truth = mean_of_rounds(repeat(lambda k: estimate(first + 5000 + k)))
    row: dict = {"truth": truth.mean, "its_standard_error": math.sqrt(truth.var)}
    for name in INTEGRATORS:
        row[name] = bias_figures(derivatives[name], truth, rows) | {
            "variance": float(contest.variances(name)[v > 0].sum()),
            "spp": contest.spp[name, 1],
            "seconds_median": contest.timings[name, 1].median,
        }
    a, b = row[peer]["variance"], row[mivol]["variance"]
    row["variance_x_time"] = finite_or_none(a / b * contest.time_ratios(peer, mivol)["processor_time"]) if b > 0 else None
    return row


def bias_figures(derivatives: np.ndarray, truth: Estimate, rows: int) -> dict:
    """Compare derivatives (rounds,) of one integrator with the truth."""
    agreement = compare_means(mean_of_rounds(derivatives), truth, 2 * rows)
    return {
        "derivative": float(derivatives.mean()),
        "bias_standard_errors": agreement["z"],
        "bias_percent": agreement["percent"],
        "known_to_percent": agreement["standard_error_percent"],
    }


# -- Bars and figure --------------------------------------------------------------------------------------------------------


PROMISES = {
    question: [
        Promise(
            f"variance x time: {question}, gradient of {{}}, {name}", (name, "*", DENSE, "variance_x_time"), AT_LEAST, light.bar
        )
        for name, light in lights.items()
    ]
    for question, (_, lights) in CONTESTS.items()
} | {
    question: [
        Promise(f"{question}: how much sooner at the {loss} loss", (key, "sooner"), AT_LEAST, bar)
        for loss, key, bar in (("last", "to_the_last_loss_of_prbvolpath", last), ("lowest", "to_its_lowest_loss", lowest))
        if bar is not None
    ]
    for question, (_, last, lowest) in TUTORIALS.items()
}


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means of contests, and the bias of mivol in tables."""
    if question in CONTESTS:
        parts = [(f"{f}, {name}", answer[name][f][DENSE]) for name in CONTESTS[question][1] for f in answer[name]]
        return [judge_agreement(f"{question}, gradient of {label}", d["z"], d["z_bound"]) for label, d in parts]
    rows = []
    for light, table in answer.items() if question in TABLES else ():
        for name, row in table.items():
            label, figures = f"{name}, {light}", row["mivol"]
            bound = abs(figures["bias_percent"]) + 3 * figures["known_to_percent"]
            rows.append(judge(f"bias and 3 standard errors [%]: {label}", bound, AT_MOST, 0.5, quiet=True))
            z = abs(figures["bias_standard_errors"])
            rows.append(judge(f"bias [standard errors]: {label}", z, AT_MOST, 3, quiet=True))
    return rows


def draw(answers: dict, path: Path) -> None:
    """Draw a panel for each question."""
    with new_figure(path, 5 * len(answers), 4) as figure:
        for axes, (question, answer) in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers.items(), strict=True):
            plot = plot_contest if question in CONTESTS else plot_table if question in TABLES else plot_tutorial
            plot(axes, question, answer)


def plot_contest(axes: Axes, question: str, answer: dict) -> None:
    """Plot ratios beside their bars."""
    lights = CONTESTS[question][1]
    ratios = {f"{f}, {name}": answer[name][f][DENSE]["variance_x_time"] for name in lights for f in answer[name]}
    plot_ratios(axes, list(ratios), {"mivol": list(ratios.values())}, [])
    bars = [light.bar for name, light in lights.items() for _ in answer[name]]
    axes.plot(bars, np.arange(len(bars))[::-1], "|", markersize=14, color=SERIES[0])
    axes.set(title=f"Gradient ({question}), voxels with {DENSE}", xlabel="variance x time over prbvolpath's (mark: the bar)")


def plot_table(axes: Axes, question: str, answer: dict) -> None:
    """Plot the bias of both integrators, with three standard errors."""
    names = [(light, case) for light, table in answer.items() for case in table]
    for i, integrator in enumerate(INTEGRATORS):
        rows = [answer[light][case][integrator] for light, case in reversed(names)]
        at = np.arange(len(names)) + 0.2 * (0.5 - i)
        errors = [3 * r["known_to_percent"] for r in rows]
        axes.errorbar([r["bias_percent"] for r in rows], at, xerr=errors, fmt=MARKERS[i], color=SERIES[i], label=integrator)
    axes.set_xscale("symlog", linthresh=1)
    axes.set(yticks=range(len(names)), yticklabels=[f"{case}, {light}" for light, case in reversed(names)])
    axes.set(title="Bias against the truth", xlabel="bias [%], 3 standard errors")
    axes.set_ylim(-0.5, len(names) + 0.3)
    axes.legend(loc="upper left", ncols=2)


def plot_tutorial(axes: Axes, question: str, answer: dict) -> None:
    """Plot image loss against time."""
    runs = answer["runs"]
    curves = {name: (runs[name]["seconds"], np.maximum(runs[name]["loss"], 1e-9)) for name in INTEGRATORS}
    plot_errors(axes, curves, markersize=3)
    axes.set(title=f"Mitsuba's tutorial at depth {TUTORIALS[question][0]}")
    axes.set(xlabel="time [s]", ylabel="image loss, without noise [radiance²]")
    axes.legend()


CONTEST = "How much sooner has mivol the same error in the density gradient"
TABLE = "How large are bias and variance of prbvolpath and mivol, at density 0 and above?"
TUTORIAL = "When does mivol have the image loss that prbvolpath ends with, in the official tutorial on volumes, at depth"
QUESTIONS = (
    {name: ask(f"{CONTEST} ({name})?", measure_contest, name) for name in CONTESTS}
    | {name: ask(TABLE, measure_table, name) for name in TABLES}
    | {name: ask(f"{TUTORIAL} {depth}?", measure_tutorial, depth) for name, (depth, *_) in TUTORIALS.items()}
)
ON_REQUEST = ("tutorial", "deep smoke", "deep fine smoke", "deep cloud", "deep estimators", "deep tutorial")
STUDY = Study(__name__, __doc__, GradientSize, QUESTIONS, compare, draw, on_request=ON_REQUEST, promises=PROMISES)
