"""When has mivol the image loss that prbvolpath ends with, in Mitsuba's official tutorial on volume optimisation?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TUTORIAL_SCALE, smoke
from mivol.bench.harness.agreement import compare_means, mean_of_rounds
from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.scenes import box_scene, constant_light, of_depth, perspective
from mivol.bench.studies.gradients.size import ALBEDO, OURS, STOCK, TUTORIALS, Size
from mivol.bench.studies.gradients.subject import KEY
from mivol.validate.metrics import nrmse
from mivol.validate.statistics import Estimate

__all__ = ["Run", "at_voxels", "finish", "ask_tutorial", "upright"]


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
    scene = box_scene(np.zeros((2, 2, 2), np.float32), 4, ALBEDO, **constant_light())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(values)
    scene["box"]["interior"]["scale"] = TUTORIAL_SCALE
    return scene


def optimise(name: str, depth: int, judge: Judge, size: Size) -> Iterator[Run]:
    """The tutorial's loop with one integrator: its state after each iteration of a step for each camera."""
    res = size.resolutions[0]
    scene = mi.load_dict(tutorial_scene(dr.full(mi.TensorXf, 0.002, (res, res, res, 1))))
    params, integrator, eye = mi.traverse(scene), of_depth(name, depth), of_depth(OURS, depth)
    opt = mi.ad.Adam(lr=0.02)
    opt[KEY] = params[KEY]
    params.update(opt)
    run, watch = Run(), Stopwatch()

    def step(k: int, seed: int, spp: int) -> None:
        image = mi.render(scene, params, sensor=judge.sensors[k], integrator=integrator, spp=spp, seed=seed)
        dr.backward(dr.mean(dr.square(image - judge.references[k])))
        opt.step()
        opt[KEY] = dr.clip(opt[KEY], 1e-6, 1.0)
        params.update(opt)
        dr.eval(opt[KEY])

    for stage, (iterations, spp) in enumerate(zip(size.steps, size.step_spp, strict=True)):
        if stage:
            opt[KEY] = dr.resample(opt[KEY], shape=(*(size.resolutions[stage],) * 3, 1), filter="linear")
            params.update(opt)
        for iteration in range(iterations):
            with watch:
                for k in range(len(judge.sensors)):
                    step(k, iteration, spp)
            run.seconds.append(watch.seconds)
            run.processor.append(watch.processor)
            run.loss.append(judge.loss(scene, iteration + 1000 * stage, eye))
            run.density_error.append(judge.density_error(np.array(params[KEY])[..., 0]))
            yield run


def ask_tutorial(question: str) -> Callable[[Size], dict]:
    """The question at one depth."""
    depth, *_ = TUTORIALS[question]

    def measure(size: Size) -> dict:
        return measure_tutorial(depth, size)

    measure.__doc__ = (
        f"When has mivol the image loss that prbvolpath ends with, in the official tutorial on volumes, at depth {depth}?"
    )
    return measure


def measure_tutorial(depth: int, size: Size) -> dict:
    """Both loops, and when the faster one is where the other ends."""
    found = smoke()
    truth = upright(found.values / np.float32(TUTORIAL_SCALE))
    sensors = half_circle(size.side)
    scene = mi.load_dict(tutorial_scene(mi.TensorXf(truth[..., None])))
    ours = of_depth(OURS, depth)
    references = [mi.render(scene, sensor=s, integrator=ours, spp=size.reference_spp, seed=k) for k, s in enumerate(sensors)]
    dr.eval(references)
    judge = Judge(sensors, references, at_voxels(truth, size.resolutions[-1]), size.loss_spp)
    checked = check_references(scene, sensors, references, of_depth("volpath", depth), size.check_spp)
    answer = {"grid": str(found), "references": checked}
    for name in (OURS, STOCK):
        for _ in optimise(name, depth, judge, warm_up(size)):
            pass
    runs = {}
    for name in (OURS, STOCK):
        for run in optimise(name, depth, judge, size):
            runs[name] = run
            at = f"{run.seconds[-1]:7.1f} s (processor {run.processor[-1]:.1f})"
            say(f"  {name} {len(run.loss):3d}: {at}, loss {run.loss[-1]:.5f}, density {run.density_error[-1]:.3f}")
    return answer | finish(runs)


def warm_up(size: Size) -> Size:
    """One iteration of each stage with few samples: the kernels are there before the clock runs."""
    return replace(size, steps=(1,) * len(size.steps), step_spp=(1,) * len(size.steps))


def check_references(scene: mi.Scene, sensors: list, references: list, volpath: mi.Integrator, spp: int) -> dict:
    """The references against volpath: 8 batches, the mean over all pixels and cameras."""

    def batch(b: int) -> float:
        images = [mi.render(scene, sensor=s, integrator=volpath, spp=spp, seed=100 * b + k) for k, s in enumerate(sensors)]
        return float(np.mean([np.array(image).mean() for image in images]))

    ours = float(np.mean([np.array(r, np.float64).mean() for r in references]))
    found = compare_means(Estimate(ours, 0.0, math.inf), mean_of_rounds(np.array([batch(b) for b in range(8)])), 1)
    error = found["standard_error_percent"]
    return {
        "mean": ours,
        "z_against_volpath": found["z"],
        "z_bound": found["z_bound"],
        "relative_standard_error": None if error is None else error / 100,
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
