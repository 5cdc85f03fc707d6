#!/usr/bin/env python3
"""Density gradients of light that scatters once: how exact are they, and how much sooner than those of ``prbvolpath``?

    scripts/bench_gradients.py                        # about 10 minutes on 2 idle cores: all but the tutorial
    scripts/bench_gradients.py --only tutorial        # 5 minutes, nearly all of them in prbvolpath
    scripts/bench_gradients.py --quick                # a minute, small sizes: are our gradients right?

The derivatives are those with respect to the voxels of sigma_t [1/length]; albedo 0.75, ``max_depth`` 2 for all, stock scenes,
the box [-1, 1]^3, box filter, independent samples, pictures of 64 x 64 pixels (estimators: 24 x 24). Times are of warm calls.

smoke: the Mitsuba tutorial's smoke at its density (x 40), in constant light, and with HG g = 0.8 below a sun in a sky. Two
gradients: of a linear functional of the picture, its mean (a call of ``render_backward``), and of an L2 loss, the mean squared
difference to the picture of 0.7 of the density (a whole step: ``mi.render``, loss, ``dr.backward``). Both methods get the
samples that take the same processor time (a power of two per pixel) and run in turns, 8 rounds, every one with another seed;
printed is the sum over voxels of their variances over the 8 gradients, times the time: over the voxels with sigma_t >= 1 (the
bars), and over those between 0 and 1 and those at 0, where the ratio says little since ``prbvolpath`` is biased there. Beside
the ratio stands z: the derivative along sigma_t itself, summed over those voxels, in standard errors of its difference. If it
is beyond its bound for sigma_t >= 1 (false alarm in one run in 1000, Student's t), the ratio means nothing and the script ends
with status 1.

estimators: bias and variance of both estimators where they differ: density 0, half empty, thin, dense (16^3 voxels). The
derivative of the picture's mean along a fixed direction in the space of voxels (thin, dense: the density itself; density 0:
all voxels alike; half empty: the empty half) is compared with finite differences of mivol's pictures with common random
numbers: central of fourth order, or one-sided of third order where the density is 0. Both the differences and our derivative
are repeated until their means are known to 0.06 %. The bias is said in standard errors (of both together) and in percent;
0.5 % (with 3 standard errors to spare) and 3 standard errors are the bars for ours. Variance x time: summed over the voxels
of that direction, prbvolpath's over ours.

tutorial: the official Mitsuba tutorial on volume optimisation with ``max_depth`` 2 in the place of prbvolpath's default of 6,
else as published: 5 cameras on a half circle, 64 x 64, tent filter, constant light, density 0.002 x 40 in 16^3 voxels, Adam
with 0.02, 20 x 5 steps of 8 samples, resampled to 64^3, 20 x 5 steps of 64. prbvolpath and mivol run the same loop. The clock
runs during the steps only. After each iteration (of 5 steps) the image loss of the volume is measured apart, without noise in
the mean: the product of the errors of two independent renders by mivol, mean over pixels, summed over cameras. The references
are rendered by mivol (4096 samples) and compared with volpath's (z is printed), so that their noise decides nothing. Printed:
when mivol's volume has the image loss of prbvolpath's last one (the bar; and of its best one, which Adam leaves again for the
noise), and the errors of both densities (root mean square over that of the truth).

Prints JSON; writes bench_gradients.json and bench_gradients.png.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from contest import (
    AT_LEAST,
    AT_MOST,
    TUTORIAL_SCALE,
    Bench,
    Contestant,
    Timing,
    box_of,
    constant,
    describe,
    judge,
    perspective,
    plain_ticks,
    race,
    ratio_of,
    samples_for,
    say,
    scatters_once,
    smoke,
    sun_and_sky,
)
from mivol.report.figures import MARKERS, SERIES, STYLE, save
from mivol.validate.statistics import Moments, nrmse, z_bound, z_image

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ALBEDO = 0.75
OURS, STOCK = "mivol", "prbvolpath"
KEY = "box.interior_medium.sigma_t.data"
FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class Size:
    """How much work is done. Sides are in pixels, seconds are of one gradient, of all threads."""

    name: str = "full"
    rounds: int = 8
    side: int = 64
    seconds: float = 2.0
    table_rounds: int = 16
    table_side: int = 24
    table_seconds: float = 0.4
    table_res: int = 16
    difference_spp: int = 1024
    certain_percent: float = 0.06
    certain_seconds: float = 300.0
    reference_spp: int = 4096
    check_spp: int = 4
    loss_spp: int = 32
    resolutions: tuple[int, ...] = (16, 64)
    steps: tuple[int, ...] = (20, 20)
    step_spp: tuple[int, ...] = (8, 64)


FULL = Size()
QUICK = Size(
    name="quick",
    rounds=5,
    side=12,
    seconds=0.05,
    table_rounds=8,
    table_side=8,
    table_seconds=0.05,
    table_res=6,
    difference_spp=256,
    certain_percent=math.inf,
    reference_spp=256,
    check_spp=4,
    loss_spp=16,
    resolutions=(4, 8),
    steps=(2, 2),
    step_spp=(2, 4),
)

LIGHTS = {"constant light": constant, "HG 0.8, sun in a sky": sun_and_sky}
BARS = {"constant light": 60, "HG 0.8, sun in a sky": 30}


# -- Gradients -------------------------------------------------------------------------------------------------------------


@dataclass
class Subject:
    """A scene whose densities are differentiated, and an integrator made for it."""

    scene: mi.Scene
    name: str

    def __post_init__(self) -> None:
        self.params, self.integrator = mi.traverse(self.scene), scatters_once(self.name)

    def _collect(self, backward: Callable[[], None]) -> mi.Float:
        values = mi.TensorXf(self.params[KEY])
        dr.enable_grad(values)
        self.params[KEY] = values
        self.params.update()
        backward()
        gradient = dr.grad(self.params[KEY]).array
        dr.eval(gradient)
        dr.disable_grad(self.params[KEY])
        return gradient

    def of_mean(self, seed: int, spp: int) -> mi.Float:
        """The gradient of the picture's mean."""
        height, width = self.scene.sensors()[0].film().size()[::-1]
        ones = dr.full(mi.TensorXf, 1 / (3 * height * width), (height, width, 3))
        back = lambda: self.integrator.render_backward(self.scene, self.params, ones, seed=seed, spp=spp)  # noqa: E731
        return self._collect(back)

    def of_loss(self, target: mi.TensorXf, seed: int, spp: int) -> mi.Float:
        """The gradient of the mean squared difference to a target, picture and all."""

        def backward() -> None:
            picture = mi.render(self.scene, self.params, integrator=self.integrator, seed=seed, spp=spp)
            dr.backward(dr.mean(dr.square(picture - target), axis=None))

        return self._collect(backward)

    def mean(self, values: np.ndarray, seed: int, spp: int) -> float:
        """The picture's mean for other values (Z, Y, X)."""
        self.params[KEY] = mi.TensorXf(np.float32(values)[..., None])
        self.params.update()
        return float(np.mean(np.array(mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp), np.float64)))


def subjects(values: np.ndarray, side: int, light: Callable[[], dict]) -> dict[str, Subject]:
    """The same scene once for each integrator."""
    return {name: Subject(mi.load_dict(box_of(values, side, ALBEDO, **light())), name) for name in (OURS, STOCK)}


Step = Callable[[int, int], object]
"""Seed and samples per pixel to a gradient."""


def compete(steps: dict[str, Step], seconds: float, rounds: int) -> tuple[dict[str, Timing], dict[str, int]]:
    """Gradients in turns, with the samples that each can take in that time."""
    spp = {name: samples_for(step, seconds) for name, step in steps.items()}
    calls: dict[str, Contestant] = {
        name: lambda seed, step=step, n=spp[name], k=k: step(1000 * (k + 1) + seed, n)
        for k, (name, step) in enumerate(steps.items())
    }
    return race(calls, rounds, keep=True), spp


def along(timing: Timing, direction: np.ndarray) -> np.ndarray:
    """Derivatives along a direction (Z, Y, X), one for each round."""
    return np.array(timing.results, np.float64) @ direction.ravel().astype(np.float64)


def variance_over(timing: Timing, chosen: np.ndarray) -> float:
    """Sum of the variances of chosen voxels."""
    return float(Moments.of(np.array(timing.results)).variance[chosen.ravel()].sum())


def compare_means(a: np.ndarray, b: np.ndarray, comparisons: int) -> dict:
    """z of the means of two sets of independent values, its bound by Student's t, and the relative standard error."""
    a, b = Moments.of(a), Moments.of(b)
    va, vb = float(a.variance_of_mean), float(b.variance_of_mean)
    both = va**2 / (a.n - 1) + vb**2 / (b.n - 1)
    dof = (va + vb) ** 2 / both if both > 0 else math.inf
    return {
        "z": finite(z_image(a.mean, va, b.mean, vb)),
        "z_bound": float(z_bound(FALSE_ALARM, comparisons, dof)),
        "percent": finite(100 * (a.mean / b.mean - 1)),
        "standard_error_percent": finite(100 * math.sqrt(va + vb) / abs(b.mean)),
    }


def finite(x: float) -> float | None:
    """JSON has no infinity: where nothing is left to divide by, null."""
    return float(x) if np.isfinite(x) else None


# -- The smoke -------------------------------------------------------------------------------------------------------------


def measure_smoke(size: Size) -> dict:
    """How much sooner has mivol the same error in the density gradient of the smoke?"""
    found = smoke()
    answer = {"grid": describe(found)}
    regions = {
        "sigma_t >= 1": found.values >= 1,
        "0 < sigma_t < 1": (found.values > 0) & (found.values < 1),
        "sigma_t = 0": found.values == 0,
    }
    for light, parts in LIGHTS.items():
        target = picture_of(0.7 * found.values, size, parts)
        both = subjects(found.values, size.side, parts)
        functionals = {
            "mean": {name: s.of_mean for name, s in both.items()},
            "L2": {name: lambda seed, spp, s=s, target=target: s.of_loss(target, seed, spp) for name, s in both.items()},
        }
        answer[light] = {}
        for functional, steps in functionals.items():
            timings, spp = compete(steps, size.seconds, size.rounds)
            answer[light][functional] = outcome(timings, spp, regions, found.values, size.side)
            say(f"  {light}, {functional}: {said(answer[light][functional])}")
    return answer


def picture_of(values: np.ndarray, size: Size, parts: Callable[[], dict]) -> mi.TensorXf:
    """A picture without much noise."""
    scene = mi.load_dict(box_of(values, size.side, ALBEDO, **parts()))
    return mi.render(scene, integrator=scatters_once(OURS), seed=77, spp=size.difference_spp)


def outcome(timings: dict[str, Timing], spp: dict[str, int], regions: dict, values: np.ndarray, side: int) -> dict:
    """Times and, for each region, what variance x time and the means are."""
    slow, fast = timings[STOCK], timings[OURS]
    ratio = ratio_of(slow, fast)
    figures = {name: {"spp": spp[name]} | t.report(side * side * spp[name], "samples") for name, t in timings.items()}
    figures |= {"time": ratio, "processor_time": ratio_of(slow, fast, "processor")}
    for region, chosen in regions.items():
        a, b = variance_over(slow, chosen), variance_over(fast, chosen)
        direction = np.where(chosen, values if values[chosen].any() else 1.0, 0.0)
        figures[region] = {
            "voxels": int(chosen.sum()),
            "variance_x_time": a / b * ratio,
            **compare_means(along(fast, direction), along(slow, direction), 2 * len(LIGHTS)),
        }
    return figures


def said(figures: dict) -> str:
    """One line on a contest."""
    dense = figures["sigma_t >= 1"]
    rates = ", ".join(f"{name} {figures[name]['samples_per_second_median'] / 1e6:.3g}" for name in (OURS, STOCK))
    return (
        f"{dense['variance_x_time']:.0f}x, processor {figures['processor_time'] / figures['time']:.2f} (z {dense['z']:+.2f}, "
        f"{dense['percent']:+.2f} % +- {dense['standard_error_percent']:.2f}); M samples/s: {rates}"
    )


# -- Bias and variance -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Densities (Z, Y, X), a direction to change them in, and the step of a finite difference along it."""

    values: np.ndarray
    direction: np.ndarray
    step: float


def cases(res: int) -> dict[str, Case]:
    """Where estimators differ.

    A step h changes an optical depth x of a path by h x; it is at most 0.05 (density 0), 0.1 (half empty), 0.03 (thin) and 0.15
    (dense: for paths of x <= 3, which carry 95 % of the light), so that truncation is at most (h x)^4 / 30 = 0.002 % (central)
    or (h x)^3 / 4 = 0.025 % (one-sided).
    """
    rng = np.random.default_rng(1)
    noise = rng.uniform(0.5, 1.5, (res,) * 3)
    ones, left = np.ones((res,) * 3), np.broadcast_to(np.arange(res) < res // 2, (res,) * 3)
    return {
        "density 0": Case(0 * ones, ones, 0.01),
        "half empty": Case(np.where(left, 0, 4 * noise), np.where(left, 1.0, 0.0), 0.02),
        "thin": Case(0.05 * noise, 0.05 * noise, 0.1),
        "dense": Case(10 * noise, 10 * noise, 0.05),
    }


def difference(subject: Subject, case: Case, seed: int, spp: int) -> float:
    """A finite difference along the direction with common random numbers: central of fourth order, or one-sided of third."""
    v, h = case.direction, case.step
    central = (case.values[v > 0] > 0).all()
    weights = {-2: 0.5, -1: -4, 1: 4, 2: -0.5} if central else {0: -11, 1: 18, 2: -9, 3: 2}
    return sum(w * subject.mean(case.values + s * h * v, seed, spp) for s, w in weights.items()) / (6 * h)


def refine(found: np.ndarray, estimate: Callable[[int], float], size: Size) -> np.ndarray:
    """More independent estimates, each by its number, until their mean is known well enough or the (processor) time is up."""
    found, end = list(found), time.process_time() + size.certain_seconds
    while time.process_time() < end:
        m = Moments.of(np.array(found))
        if math.sqrt(m.variance_of_mean) <= size.certain_percent / 100 * abs(m.mean):
            break
        found.append(estimate(len(found)))
    return np.array(found)


def measure_estimators(size: Size) -> dict:
    """Bias and variance per estimator: free flight (prbvolpath) and ours, at density 0, half empty, thin and dense."""
    answer = {}
    for light, parts in LIGHTS.items():
        answer[light] = {}
        for name, case in cases(size.table_res).items():
            answer[light][name] = row = table_row(case, parts, size)
            say(f"  {light}, {name}: {said_of_row(row)}")
    return answer


def table_row(case: Case, parts: Callable[[], dict], size: Size) -> dict:
    """Both estimators in one case."""
    both = subjects(case.values.astype(np.float32), size.table_side, parts)
    timings, spp = compete({name: s.of_mean for name, s in both.items()}, size.table_seconds, size.table_rounds)
    derivatives = {name: along(timing, case.direction) for name, timing in timings.items()}
    v = case.direction.ravel()
    again = lambda k: float(np.array(both[OURS].of_mean(9000 + k, spp[OURS]), np.float64) @ v)  # noqa: E731
    derivatives[OURS] = refine(derivatives[OURS], again, size)
    differ = lambda k: difference(both[OURS], case, 5000 + k, size.difference_spp)  # noqa: E731
    truth = refine([differ(k) for k in range(size.table_rounds)], differ, size)
    m = Moments.of(truth)
    row = {"finite_difference": float(m.mean), "its_standard_error": float(np.sqrt(m.variance_of_mean))}
    chosen = case.direction > 0
    for name, timing in timings.items():
        found = compare_means(derivatives[name], truth, 2 * len(LIGHTS) * len(cases(2)))
        row[name] = {
            "derivative": float(derivatives[name].mean()),
            "bias_standard_errors": found["z"],
            "bias_percent": found["percent"],
            "known_to_percent": found["standard_error_percent"],
            "variance": variance_over(timing, chosen),
            "spp": spp[name],
            "seconds_median": timing.median,
        }
    a, b = row[STOCK]["variance"], row[OURS]["variance"]
    row["variance_x_time"] = finite(a / b * ratio_of(timings[STOCK], timings[OURS])) if b > 0 else None
    return row


def said_of_row(row: dict) -> str:
    """One line of the table."""
    parts = [f"finite difference {row['finite_difference']:.4g} +- {row['its_standard_error']:.1g}"]
    for name in (STOCK, OURS):
        r = row[name]
        parts.append(
            f"{name} {r['bias_percent']:+.2f} % ({r['bias_standard_errors']:+.1f} se of {r['known_to_percent']:.2f} %)"
        )
    return "; ".join(parts) + f"; variance x time {row['variance_x_time'] or math.nan:.3g}"


# -- The tutorial ----------------------------------------------------------------------------------------------------------


def half_circle(side: int, count: int = 5) -> list[mi.Sensor]:
    """The tutorial's cameras: y is up, 4 away, from -90 degrees on in steps of 36."""
    sensors = []
    for i in range(count):
        turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180.0 / count * i - 90.0)
        camera = perspective(side)
        camera["film"] = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "tent"}}
        camera["to_world"] = turn @ mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
        sensors.append(mi.load_dict(camera))
    return sensors


def upright(values: np.ndarray) -> np.ndarray:
    """The smoke with y up: the tutorial turns it by -90 degrees about x, (x, y, z) -> (x, z, -y)."""
    return np.ascontiguousarray(values.transpose(1, 0, 2)[::-1])


def at_voxels(values: np.ndarray, res: int) -> np.ndarray:
    """Values (Z, Y, X) read at the centres of res^3 voxels."""
    texture = mi.Texture3f(mi.TensorXf(np.ascontiguousarray(values[..., None])), wrap_mode=dr.WrapMode.Clamp)
    z, y, x = (mi.Float(c.ravel()) for c in np.meshgrid(*[(np.arange(res, dtype=np.float32) + 0.5) / res] * 3, indexing="ij"))
    return np.array(texture.eval(mi.Point3f(x, y, z))[0]).reshape((res,) * 3)


@dataclass
class Judge:
    """Measures volumes by pictures without bias, outside of any clock."""

    sensors: list[mi.Sensor]
    references: list[mi.TensorXf]
    truth: np.ndarray
    spp: int

    def loss(self, scene: mi.Scene, seed: int, integrator: mi.Integrator) -> float:
        """Image loss: mean squared difference, summed over cameras; two renders each, so that noise has no mean."""
        total = 0.0
        for k, (sensor, reference) in enumerate(zip(self.sensors, self.references, strict=True)):
            pair = [
                np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=self.spp, seed=seed + 100 * k + half))
                for half in (10_000, 20_000)
            ]
            total += float(np.mean((pair[0] - np.array(reference)) * (pair[1] - np.array(reference))))
        return total

    def density_error(self, values: np.ndarray) -> float:
        """Root mean square of the error over that of the truth, at the voxels of the finest grid."""
        return nrmse(at_voxels(values, self.truth.shape[0]), self.truth)


@dataclass
class Run:
    """A loop of the tutorial: seconds of its steps, image loss and density error after each iteration."""

    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    density_error: list[float] = field(default_factory=list)


def tutorial_scene(values: mi.TensorXf) -> dict:
    """The tutorial's scene around a grid of its own unit."""
    scene = box_of(np.zeros((2, 2, 2), np.float32), 4, ALBEDO, **constant())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(values)
    scene["box"]["interior"]["scale"] = TUTORIAL_SCALE
    return scene


def optimise(name: str, judge: Judge, size: Size) -> Iterator[Run]:
    """The tutorial's loop with one integrator: its state after each iteration of a step for each camera."""
    res = size.resolutions[0]
    scene = mi.load_dict(tutorial_scene(dr.full(mi.TensorXf, 0.002, (res, res, res, 1))))
    params, integrator, eye = mi.traverse(scene), scatters_once(name), scatters_once(OURS)
    opt = mi.ad.Adam(lr=0.02)
    opt[KEY] = params[KEY]
    params.update(opt)
    run, spent = Run(), np.zeros(2)

    def step(k: int, seed: int, spp: int) -> None:
        image = mi.render(scene, params, sensor=judge.sensors[k], integrator=integrator, spp=spp, seed=seed)
        dr.backward(dr.mean(dr.square(image - judge.references[k])))
        opt.step()
        opt[KEY] = dr.clip(opt[KEY], 1e-6, 1.0)
        params.update(opt)
        dr.eval(opt[KEY])

    for stage, (iterations, spp) in enumerate(zip(size.steps, size.step_spp, strict=True)):
        if stage:
            res = size.resolutions[stage]
            opt[KEY] = dr.resample(opt[KEY], shape=(res, res, res, 1), filter="linear")
            params.update(opt)
        for iteration in range(iterations):
            start = np.array([time.perf_counter(), time.process_time()])
            for k in range(len(judge.sensors)):
                step(k, iteration, spp)
            dr.sync_thread()
            spent += np.array([time.perf_counter(), time.process_time()]) - start
            run.seconds.append(float(spent[0]))
            run.processor.append(float(spent[1]))
            run.loss.append(judge.loss(scene, iteration + 1000 * stage, eye))
            run.density_error.append(judge.density_error(np.array(params[KEY])[..., 0]))
            yield run


def measure_tutorial(size: Size) -> dict:
    """When has mivol the image loss that prbvolpath ends with, in the official tutorial on volume optimisation?"""
    found = smoke()
    truth = upright(found.values / np.float32(TUTORIAL_SCALE))
    sensors = half_circle(size.side)
    scene = mi.load_dict(tutorial_scene(mi.TensorXf(truth[..., None])))
    ours = scatters_once(OURS)
    references = [mi.render(scene, sensor=s, integrator=ours, spp=size.reference_spp, seed=k) for k, s in enumerate(sensors)]
    dr.eval(references)
    judge_ = Judge(sensors, references, at_voxels(truth, size.resolutions[-1]), size.loss_spp)
    answer = {"grid": describe(found), "references": check_references(scene, sensors, references, size.check_spp)}
    for name in (OURS, STOCK):
        for _ in optimise(name, judge_, warm_up(size)):
            pass
    runs = {}
    for name in (OURS, STOCK):
        for run in optimise(name, judge_, size):
            runs[name] = run
            at = f"{run.seconds[-1]:7.1f} s (processor {run.processor[-1]:.1f})"
            say(f"  {name} {len(run.loss):3d}: {at}, loss {run.loss[-1]:.5f}, density {run.density_error[-1]:.3f}")
    return answer | finish(runs)


def warm_up(size: Size) -> Size:
    """One iteration of each stage with few samples: the kernels are there before the clock runs."""
    return Size(**{**vars(size), "steps": (1, 1), "step_spp": (1, 1)})


def check_references(scene: mi.Scene, sensors: list, references: list, spp: int) -> dict:
    """The references against volpath: 8 batches, the mean over all pixels and cameras."""
    volpath = scatters_once("volpath")

    def batch(b: int) -> float:
        images = [mi.render(scene, sensor=s, integrator=volpath, spp=spp, seed=100 * b + k) for k, s in enumerate(sensors)]
        return float(np.mean([np.array(image).mean() for image in images]))

    batches = [batch(b) for b in range(8)]
    ours = float(np.mean([np.array(r, np.float64).mean() for r in references]))
    m = Moments.of(np.array(batches))
    return {
        "mean": ours,
        "z_against_volpath": float(z_image(ours, 0.0, m.mean, m.variance_of_mean)),
        "z_bound": float(z_bound(FALSE_ALARM, 1, m.n - 1)),
        "relative_standard_error": float(np.sqrt(m.variance_of_mean) / ours),
    }


def finish(runs: dict[str, Run]) -> dict:
    """When ours reached the last loss of the other, and its lowest."""
    ends = {name: {"loss": run.loss[-1], "density_error": run.density_error[-1]} for name, run in runs.items()}
    theirs, ours = runs[STOCK], runs[OURS]
    return {
        "to_the_last_loss_of_prbvolpath": reach(ours, theirs, len(theirs.loss) - 1),
        "to_its_lowest_loss": reach(ours, theirs, int(np.argmin(theirs.loss))),
        "whole_schedule_is_faster": theirs.seconds[-1] / ours.seconds[-1],
        "ends": ends,
        "runs": {name: vars(run) for name, run in runs.items()},
    }


def reach(ours: Run, theirs: Run, at: int) -> dict:
    """When ours had the loss that the other had after an iteration."""
    found = {"loss": theirs.loss[at], "after_iterations": at + 1, "seconds_of_prbvolpath": theirs.seconds[at]}
    then = next((i for i, loss in enumerate(ours.loss) if loss <= theirs.loss[at]), None)
    if then is None:
        return found | {"mivol_after_iterations": None, "sooner": 0.0}
    return found | {
        "mivol_after_iterations": then + 1,
        "seconds_of_mivol": ours.seconds[then],
        "sooner": theirs.seconds[at] / ours.seconds[then],
        "sooner_by_processor_time": theirs.processor[at] / ours.processor[then],
        "density_errors": {OURS: ours.density_error[then], STOCK: theirs.density_error[at]},
    }


QUESTIONS = {"smoke": measure_smoke, "estimators": measure_estimators, "tutorial": measure_tutorial}


# -- Saying it -------------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[dict]:
    """The figures that have a bar, beside it."""
    return {"smoke": compare_smoke, "estimators": compare_estimators, "tutorial": compare_tutorial}[question](answer)


def compare_smoke(answer: dict) -> list[dict]:
    """Ratios, and z where they are said."""
    rows = []
    for light, bar in BARS.items():
        for functional, figures in answer[light].items():
            dense, what = figures["sigma_t >= 1"], f"gradient of {functional}, {light}"
            rows.append(judge(f"variance x time: {what}", dense["variance_x_time"], AT_LEAST, bar))
            rows.append(judge(f"|z|: {what}", abs(dense["z"]), AT_MOST, dense["z_bound"], aloud=False))
    return rows


def compare_estimators(answer: dict) -> list[dict]:
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


def compare_tutorial(answer: dict) -> list[dict]:
    """How much sooner."""
    return [judge("tutorial: how much sooner", answer["to_the_last_loss_of_prbvolpath"]["sooner"], AT_LEAST, 20)]


def draw(answers: dict, folder: Path) -> None:
    """A panel for each question that was asked."""
    panels = {"smoke": draw_smoke, "estimators": draw_estimators, "tutorial": draw_tutorial}
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5 * len(answers), 4))
        FigureCanvasAgg(figure)
        for axes, (question, answer) in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers.items(), strict=True):
            panels[question](axes, answer)
    save(figure, folder / "bench_gradients.png")


def draw_smoke(axes: mpl.axes.Axes, answer: dict) -> None:
    """Ratios beside their bars."""
    names = [(light, functional) for light in LIGHTS for functional in answer[light]]
    for row, (light, functional) in enumerate(reversed(names)):
        axes.semilogx([answer[light][functional]["sigma_t >= 1"]["variance_x_time"]], [row], MARKERS[0], color=SERIES[0])
        axes.plot([BARS[light]] * 2, [row - 0.3, row + 0.3], color=SERIES[0], linestyle="--")
    axes.set(yticks=range(len(names)), yticklabels=[f"{f}, {light}" for light, f in reversed(names)])
    axes.set(title="Gradient, voxels with sigma_t >= 1", xlabel="variance x time over prbvolpath's (line: the bar)")
    plain_ticks(axes.xaxis, "×")


def draw_estimators(axes: mpl.axes.Axes, answer: dict) -> None:
    """Bias of both, with three standard errors."""
    names = [(light, case) for light, table in answer.items() for case in table]
    for i, estimator in enumerate((OURS, STOCK)):
        rows = [answer[light][case][estimator] for light, case in reversed(names)]
        at = np.arange(len(names)) + 0.2 * (0.5 - i)
        bars = [3 * r["known_to_percent"] for r in rows]
        axes.errorbar([r["bias_percent"] for r in rows], at, xerr=bars, fmt=MARKERS[i], color=SERIES[i], label=estimator)
    axes.set_xscale("symlog", linthresh=1)
    axes.set(yticks=range(len(names)), yticklabels=[f"{case}, {light}" for light, case in reversed(names)])
    axes.set(title="Bias against finite differences", xlabel="bias [%], 3 standard errors")
    axes.legend()


def draw_tutorial(axes: mpl.axes.Axes, answer: dict) -> None:
    """Image loss against time."""
    for i, name in enumerate((OURS, STOCK)):
        run = answer["runs"][name]
        axes.loglog(run["seconds"], np.maximum(run["loss"], 1e-9), marker=MARKERS[i], markersize=3, color=SERIES[i], label=name)
    axes.set(title="Mitsuba's tutorial at depth 2", xlabel="time [s]", ylabel="image loss, without noise")
    axes.legend()


BENCH = Bench("bench_gradients", __doc__, QUESTIONS, (FULL, QUICK), compare, draw, unasked=("tutorial",))

if __name__ == "__main__":
    beyond = [row["figure"] for row in BENCH.main() if row["figure"].startswith("|z|") and not row["met"]]
    sys.exit(f"the means differ ({'; '.join(beyond)}): the ratios mean nothing" if beyond else 0)
