"""Mitsuba's official tutorial on volume optimisation, run by mivol and by ``prbvolpath``.

The tutorial as published, at a given ``max_depth``: 5 cameras on a half circle, 64 x 64 pixels, tent filter, constant light,
initial density 0.002 x 40 in 16^3 voxels, Adam with a rate of 0.02, 20 x 5 steps with 8 samples per pixel, then resampling to
64^3 voxels and 20 x 5 steps with 64 samples. Both integrators run the same loop, and only steps are timed. After each iteration
(5 steps) the image loss of the volume is measured without noise in its mean: the product of the errors of two independent
renders by mivol, mean over the pixels, sum over the cameras. The references are rendered by mivol (4096 samples) and compared
with volpath's (z is reported), so their noise decides nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Stopwatch, compare_means, mean_of_rounds
from mivol.bench.harness.study import Size, amount, say_row
from mivol.bench.scenes import DENSITY, TUTORIAL_SCALE, box_scene, constant_light, make_integrator, perspective, smoke
from mivol.bench.studies.gradients.twin import ALBEDO, INTEGRATORS
from mivol.validate.metrics import nrmse
from mivol.validate.statistics import Estimate


@dataclass(frozen=True)
class TutorialSize(Size):
    """Amount of work of the tutorial."""

    side: int = amount(64, 12, "edge of the images [pixels]")
    reference_spp: int = amount(4096, 256, "samples per pixel of the tutorial's references")
    check_spp: int = amount(4, doc="samples per pixel of references by volpath")
    loss_spp: int = amount(32, 16, "samples per pixel of the images for the loss")
    resolutions: tuple[int, ...] = amount((16, 64), (4, 8), "voxels along an edge in the stages of the tutorial")
    steps: tuple[int, ...] = amount((20, 20), (2, 2), "iterations of the stages")
    step_spp: tuple[int, ...] = amount((8, 64), (2, 4), "samples per pixel of the stages")


def half_circle(side: int) -> list[mi.Sensor]:
    """The five cameras of the tutorial: y is up, distance 4, from -90 degrees in steps of 36 degrees."""
    sensors = []
    for angle in range(-90, 90, 36):
        turn = mi.ScalarTransform4f().rotate([0, 1, 0], angle)
        camera = perspective(side)
        camera["film"] = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "tent"}}
        camera["to_world"] = turn @ mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
        sensors.append(mi.load_dict(camera))
    return sensors


def turn_upright(values: np.ndarray) -> np.ndarray:
    """Turn the smoke so that y is up: the tutorial rotates it by -90 degrees about x, (x, y, z) -> (x, z, -y)."""
    return np.ascontiguousarray(values.transpose(1, 0, 2)[::-1])


def resample(values: np.ndarray, res: int) -> np.ndarray:
    """Read values (Z, Y, X) at the centres of res^3 voxels."""
    texture = mi.Texture3f(mi.TensorXf(np.ascontiguousarray(values[..., None])), wrap_mode=dr.WrapMode.Clamp)
    z, y, x = (mi.Float(c.ravel()) for c in np.meshgrid(*[(np.arange(res, dtype=np.float32) + 0.5) / res] * 3, indexing="ij"))
    return np.array(texture.eval(mi.Point3f(x, y, z))[0]).reshape((res,) * 3)


@dataclass
class Judge:
    """Measures the error of a volume, outside of any clock.

    Attributes:
        sensors, references: cameras and their images.
        truth: density at the voxels of the finest grid (Z, Y, X).
        spp: samples per pixel of renders for the loss.
    """

    sensors: list[mi.Sensor]
    references: list[mi.TensorXf]
    truth: np.ndarray
    spp: int

    def loss(self, scene: mi.Scene, seed: int, integrator: mi.Integrator) -> float:
        """Mean squared difference, summed over cameras; the product of two renders has no noise in its mean."""
        total = 0.0
        for k, (sensor, reference) in enumerate(zip(self.sensors, self.references, strict=True)):
            a, b = (
                np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=self.spp, seed=seed + 100 * k + half))
                for half in (10_000, 20_000)
            )
            total += float(np.mean((a - np.array(reference)) * (b - np.array(reference))))
        return total

    def density_error(self, values: np.ndarray) -> float:
        """Root mean square error over the root mean square of the truth, at the voxels of the finest grid."""
        return nrmse(resample(values, self.truth.shape[0]), self.truth)


@dataclass
class Run:
    """Seconds, image loss and density error of one loop, after each iteration."""

    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    density_error: list[float] = field(default_factory=list)


def tutorial_scene(values: mi.TensorXf) -> dict:
    """The scene of the tutorial around a grid in the unit of the file."""
    scene = box_scene(np.zeros((2, 2, 2), np.float32), 4, ALBEDO, **constant_light())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(values)
    scene["box"]["interior"]["scale"] = TUTORIAL_SCALE
    return scene


def optimize(name: str, depth: int, judge: Judge, size: TutorialSize) -> Iterator[Run]:
    """Run the loop of the tutorial with one integrator; yields its curves after each iteration."""
    res = size.resolutions[0]
    scene = mi.load_dict(tutorial_scene(dr.full(mi.TensorXf, 0.002, (res, res, res, 1))))
    params, integrator, judging = mi.traverse(scene), make_integrator(name, depth), make_integrator("mivol", depth)
    opt = mi.ad.Adam(lr=0.02)
    opt[DENSITY] = params[DENSITY]
    params.update(opt)
    run, watch = Run(), Stopwatch()

    def step(k: int, seed: int, spp: int) -> None:
        image = mi.render(scene, params, sensor=judge.sensors[k], integrator=integrator, spp=spp, seed=seed)
        dr.backward(dr.mean(dr.square(image - judge.references[k])))
        opt.step()
        opt[DENSITY] = dr.clip(opt[DENSITY], 1e-6, 1.0)
        params.update(opt)
        dr.eval(opt[DENSITY])

    for stage, (iterations, spp) in enumerate(zip(size.steps, size.step_spp, strict=True)):
        if stage:
            opt[DENSITY] = dr.resample(opt[DENSITY], shape=(*(size.resolutions[stage],) * 3, 1), filter="linear")
            params.update(opt)
        for iteration in range(iterations):
            with watch:
                for k in range(len(judge.sensors)):
                    step(k, iteration, spp)
            run.seconds.append(watch.seconds)
            run.processor.append(watch.processor)
            run.loss.append(judge.loss(scene, iteration + 1000 * stage, judging))
            run.density_error.append(judge.density_error(np.array(params[DENSITY])[..., 0]))
            yield run


def measure_tutorial(depth: int, size: TutorialSize) -> dict:
    """Run both loops, and compare their curves."""
    grid = smoke()
    truth = turn_upright(grid.values / np.float32(TUTORIAL_SCALE))
    sensors = half_circle(size.side)
    scene = mi.load_dict(tutorial_scene(mi.TensorXf(truth[..., None])))
    integrator = make_integrator("mivol", depth)
    references = [
        mi.render(scene, sensor=sensor, integrator=integrator, spp=size.reference_spp, seed=k)
        for k, sensor in enumerate(sensors)
    ]
    dr.eval(references)
    judge = Judge(sensors, references, resample(truth, size.resolutions[-1]), size.loss_spp)
    checked = check_references(scene, sensors, references, make_integrator("volpath", depth), size.check_spp)
    # One iteration of each stage with few samples compiles all kernels before the clock runs.
    warm_up = replace(size, steps=(1,) * len(size.steps), step_spp=(1,) * len(size.steps))
    for name in INTEGRATORS:
        list(optimize(name, depth, judge, warm_up))
    runs = {}
    for name in INTEGRATORS:
        for run in optimize(name, depth, judge, size):
            runs[name] = run
            latest = {"seconds": run.seconds[-1], "loss": run.loss[-1], "density_error": run.density_error[-1]}
            say_row(f"{name} {len(run.loss):3d}", **latest)
    return {"grid": str(grid), "references": checked} | compare_runs(runs)


def check_references(scene: mi.Scene, sensors: list, references: list, volpath: mi.Integrator, spp: int) -> dict:
    """Compare the mean of the references with 8 batches of renders by volpath."""

    def batch(b: int) -> float:
        images = [mi.render(scene, sensor=s, integrator=volpath, spp=spp, seed=100 * b + k) for k, s in enumerate(sensors)]
        return float(np.mean([np.array(image).mean() for image in images]))

    mean = float(np.mean([np.array(r, np.float64).mean() for r in references]))
    agreement = compare_means(Estimate(mean, 0.0, math.inf), mean_of_rounds(np.array([batch(b) for b in range(8)])), 1)
    error = agreement["standard_error_percent"]
    return {
        "mean": mean,
        "z_against_volpath": agreement["z"],
        "z_bound": agreement["z_bound"],
        "relative_standard_error": None if error is None else error / 100,
    }


def compare_runs(runs: dict[str, Run]) -> dict:
    """Times at which mivol reaches the last loss and the lowest loss of prbvolpath."""
    fast, slow = (runs[name] for name in INTEGRATORS)
    return {
        "to_the_last_loss_of_prbvolpath": time_to_loss(fast, slow, len(slow.loss) - 1),
        "to_its_lowest_loss": time_to_loss(fast, slow, int(np.argmin(slow.loss))),
        "whole_schedule_is_faster": slow.seconds[-1] / fast.seconds[-1],
        "ends": {name: {"loss": run.loss[-1], "density_error": run.density_error[-1]} for name, run in runs.items()},
        "runs": {name: vars(run) for name, run in runs.items()},
    }


def time_to_loss(fast: Run, slow: Run, at: int) -> dict:
    """Time at which mivol reaches the loss of prbvolpath after iteration ``at``."""
    figures = {"loss": slow.loss[at], "after_iterations": at + 1, "seconds_of_prbvolpath": slow.seconds[at]}
    then = next((i for i, loss in enumerate(fast.loss) if loss <= slow.loss[at]), None)
    if then is None:
        return figures | {"mivol_after_iterations": None, "sooner": 0.0}
    return figures | {
        "mivol_after_iterations": then + 1,
        "seconds_of_mivol": fast.seconds[then],
        "sooner": slow.seconds[at] / fast.seconds[then],
        "sooner_by_processor_time": slow.processor[at] / fast.processor[then],
        "density_errors": dict(zip(INTEGRATORS, (fast.density_error[then], slow.density_error[at]), strict=True)),
    }
