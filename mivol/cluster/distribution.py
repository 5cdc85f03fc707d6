"""Fits on a cluster: which parts of each kind of fit the workers compute, and steps over images of a scene in blocks of views.

Conventions. Steps of scenes and of photographs are sums over views; a scan has products with A and the transpose, sums over
blocks of views. The rest of a run stays in the owner's process: it has the whole problem, and takes the steps. A worker
has the inputs and a copy of the problem (:mod:`mivol.cluster.steps`). Losses are added in the order of the blocks.

A block has a few views side by side, and depends on the views only. A fit alone puts more views side by side, so it draws other
random numbers than a fit on a cluster; both minimise the same function.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import config
from mivol.cluster.packages import SceneSource, decode_sensor, encode_sensor, open_scene, share_scene
from mivol.cluster.pool import Pool
from mivol.cluster.reference import ReferencePage, complete_on
from mivol.cluster.steps import Steps, StepTimes, share_problem, share_projector
from mivol.cluster.workplace import Workplace
from mivol.experiments.fit_kind import FitKind
from mivol.experiments.references import to_sensor
from mivol.experiments.scan_fit import ScanFit
from mivol.experiments.scene_fit import SceneFit, make_integrator
from mivol.files.fetch import PREFIX, resolve_path
from mivol.optim.problem import Part, Problem, Reals, add_parts, to_arrays, to_tensors
from mivol.optim.scenes.render_noise import RenderLoss, ViewLoss
from mivol.optim.scenes.scene_problem import SceneLinearization, SceneProblem, draw_views
from mivol.optim.scenes.views import ADJOINT, PRIMAL, RenderBatch, View, count_pixels, make_batches, make_single_batches
from mivol.report.record import Table
from mivol.validate.reference import Complete

BLOCK_SAMPLES = 1 << 18
"""Samples of a block at most, unless a view has more. Tracing and launching a kernel takes about 10 ms, whatever its size, and
this many samples of a path of six segments about 40 ms on one core."""

LOSS, GRADIENT, LINEARIZATION, CURVATURE = "loss", "gradient", "linearization", "curvature"
"""What a worker computes for its blocks."""


def make_blocks(views: Sequence[View], spp: int) -> list[RenderBatch]:
    """Blocks of neighbouring views, a function of the views and their samples only; two blocks at least."""
    pixels = count_pixels(views[0].sensor)
    together = max(1, min(BLOCK_SAMPLES // (pixels * spp), math.ceil(len(views) / 2)))
    return make_batches(views, together * pixels)


# -- In the worker -----------------------------------------------------------------------------------------------------------


class SceneTwin:
    """The problem of a fit to images in a worker; a part is (number of the block, iteration, numbers of the chosen views)."""

    def __init__(self, problem: SceneProblem) -> None:
        self.problem = problem

    def take_state(self, state: dict[str, Any]) -> None:
        self.problem.unpack(state, {})

    def compute(self, what: str, arrays: Sequence[dict[str, np.ndarray]], parts: Sequence[Part]) -> dict[str, np.ndarray]:
        problem, reals, total = self.problem, to_tensors(arrays[0]), {}
        chosen = parts[0][2]
        batches = problem.batches if chosen is None else make_single_batches([problem.views[index] for index in chosen])
        problem.set_reals(reals)
        n_views, images = sum(batch.n_views for batch in batches), {}
        if what == CURVATURE:
            direction = to_tensors(arrays[1])
            images = {n: problem.jvp(batches[n].sensor, direction, problem.seed_for(0, n, PRIMAL)) for n, *_ in parts}
            problem.set_reals(reals)
        for number, iteration, _ in parts:
            batch, seed = batches[number], problem.seed_for(iteration, number, PRIMAL)
            if what == CURVATURE:
                share = batch.n_views / n_views / len(images[number].array)
                problem.vjp(batch.sensor, problem.loss.weight(batch.reference) * images[number] * share, seed)
            else:
                compared = problem.compare(batch, seed, n_views)
                total[f"{LOSS}/{number:06d}"] = np.array([compared.loss, compared.noise, problem.noisy])
                if what != LOSS:
                    own = seed if what == LINEARIZATION and not problem.noisy else problem.seed_for(iteration, number, ADJOINT)
                    problem.vjp(batch.sensor, compared.adjoint, own)
            if what != LOSS:
                add_parts(total, to_arrays(problem.gradients()))
                for name in problem.gradients():
                    dr.clear_grad(problem.params[name])
        return total


def make_scene_twin(place: Workplace, content: dict[str, Any]) -> SceneTwin:
    """The twin of a fit to images from its scene, settings, sensors and references."""
    settings = config.from_dict(content["settings"])
    scene = open_scene(place, content["scene"]).scene
    sensors = [decode_sensor(sensor) for sensor in content["sensors"]]
    looks = [scene.sensors()[sensor] if isinstance(sensor, int) else to_sensor(sensor) for sensor in sensors]
    views = [
        View(name, look, mi.TensorXf(image))
        for name, look, image in zip(content["names"], looks, content["references"], strict=True)
    ]
    options = {"spp": settings.fit.spp, "samples_per_pass": settings.fit.samples_per_pass, "seed": settings.seed}
    problem = SceneProblem(scene, views, content["parameters"], make_integrator(settings, scene), settings.loss, **options)
    problem.batches = make_blocks(views, problem.spp)
    return SceneTwin(problem)


# -- In the owner ------------------------------------------------------------------------------------------------------------


class SharedSceneProblem(SceneProblem):
    """A problem whose losses and gradients are computed by workers; the rest stays in this process.

    Attributes:
        steps: sends blocks to workers.
    """

    steps: Steps

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[float, Reals]:
        """f(u) and the gradient, as :meth:`SceneProblem.loss_and_gradient`."""
        chosen = draw_views(iteration, len(self.views), views, self.seed) if views else None
        found = self.ask(GRADIENT, reals, iteration, chosen)
        loss = self.take_losses(found)
        energies, gradients = self.through_priors_and_maps(reals, to_tensors(found))
        return loss + math.fsum(float(energy[0]) for energy in energies), gradients

    def loss_value(self, reals: Reals, iteration: int) -> float:
        """f(u), without derivatives."""
        return self.take_losses(self.ask(LOSS, reals, iteration)) + self.energy(reals)

    def linearize(self, reals: Reals) -> SharedLinearization:
        """The problem around ``reals``, with the random numbers of iteration 0."""
        return SharedLinearization(self, reals)

    def ask(
        self,
        what: str,
        reals: Reals,
        iteration: int,
        chosen: Sequence[int] | None = None,
        tangents: Reals | None = None,
    ) -> dict[str, np.ndarray]:
        """Let the workers compute all blocks; returns derivatives by the values, and losses by block.

        Args:
            what: LOSS, GRADIENT, LINEARIZATION or CURVATURE.
            reals: real numbers by parameter.
            iteration: selects the random numbers; 0 around a linearization.
            chosen: numbers of the views of this step, each a block; None: all views.
            tangents: direction by the scene's values, for CURVATURE.

        Raises:
            MivolError: a refusal of a worker, or as :meth:`mivol.cluster.pool.Pool.run`.
        """
        if self.sparse:
            self.steps.share_state(self.pack(reals))
        count = len(self.batches if chosen is None else chosen)
        arrays = [to_arrays(one) for one in (reals, tangents) if one is not None]
        parts = [(number, iteration, chosen) for number in range(count)]
        return self.steps.compute(what, arrays, parts, self.safe_point)

    def take_losses(self, found: dict[str, np.ndarray]) -> float:
        """Take the blocks' losses out; returns their sum, stored with the noise for :meth:`warning`."""
        names = sorted(name for name in found if name.startswith(f"{LOSS}/"))
        losses, noises, noisy = zip(*(found.pop(name).tolist() for name in names), strict=True)
        self.noisy = bool(noisy[0])
        views = [ViewLoss(mi.Float(loss), mi.Float(noise), 1.0) for loss, noise in zip(losses, noises, strict=True)]
        self.newest_loss = RenderLoss(views, is_noise_known=not (self.noisy and self.spp == 1))
        return math.fsum(losses)


class SharedLinearization(SceneLinearization):
    """A scene's problem around one point u, with images differentiated by workers."""

    problem: SharedSceneProblem

    def differentiate_images(self) -> tuple[float, Reals]:
        """Loss of the images, and the derivative by the values."""
        found = self.problem.ask(LINEARIZATION, self.reals, 0)
        return self.problem.take_losses(found), to_tensors(found)

    def curve_images(self, direction: Reals) -> Reals:
        """J^T W J direction, for a direction of the values."""
        return to_tensors(self.problem.ask(CURVATURE, self.reals, 0, tangents=direction))


def share_scene_problem(pool: Pool, kind: SceneFit) -> SharedSceneProblem:
    """The problem of a fit to images of a scene, whose steps workers compute.

    Raises:
        MivolError: inputs larger than half of the memory of a worker.
    """
    settings, alone = kind.settings, kind.make_problem()
    scene = share_scene(pool, make_source(kind), kind.loaded)
    fitted = [sensor for index, sensor in enumerate(kind.sensors) if index not in kind.held_out]
    content = {
        "scene": scene,
        "settings": config.list_all_settings(settings),
        "sensors": [encode_sensor(kind.loaded.scene, sensor) for sensor in fitted],
        "names": [view.name for view in alone.views],
        "references": [np.array(view.reference) for view in alone.views],
        "parameters": list(alone.parameters),
    }
    options = alone.integrator, alone.loss, alone.spp, alone.samples_per_pass, alone.seed
    problem = SharedSceneProblem(alone.scene, alone.views, alone.parameters, *options)
    problem.batches = make_blocks(alone.views, alone.spp)
    problem.set_reals(problem.initial_reals())
    problem.steps = Steps(pool, make_scene_twin, content, (scene,))
    return problem


def make_source(kind: SceneFit, values: dict[str, np.ndarray] | None = None) -> SceneSource:
    """The scene file of a fit as workers load it.

    Args:
        kind: the fit.
        values: values of parameters to set after loading, by key.
    """
    settings, base = kind.settings, kind.context.base
    defines = {
        key: str(resolve_path(base, value)) if isinstance(value, str) and value.startswith(PREFIX) else value
        for key, value in settings.scene.define.items()
    }
    return SceneSource(base / settings.scene.file, defines, (), values or {})


# -- The parts of a fit that workers compute ---------------------------------------------------------------------------------


class ClusterDistribution:
    """A :class:`mivol.experiments.fit_kind.Distribution` over a pool.

    Attributes:
        pool: workers.
        show: receives the progress of references in a line.
        times: of the steps, once the fit has a problem.
    """

    def __init__(self, pool: Pool, show: Callable[[str], None] = lambda line: None) -> None:
        self.pool, self.show, self.times = pool, show, StepTimes()

    def make_problem(self, kind: FitKind) -> Problem:
        """The problem of a fit, whose steps workers compute.

        Raises:
            MivolError: inputs larger than half of the memory of a worker.
        """
        if isinstance(kind, SceneFit):
            problem = share_scene_problem(self.pool, kind)
            self.times = problem.steps.times
        elif isinstance(kind, ScanFit):
            kind.projector = share_projector(self.pool, kind.projector)
            self.times = kind.projector.steps.times
            problem = kind.make_problem()
        else:
            problem = kind.make_problem()
            self.times = share_problem(self.pool, problem).times
        return problem

    def complete_references(self, kind: SceneFit) -> Complete:
        """The function that renders the references of a fit to images of a scene, which show the truth if it is known; its page
        stands in the folder of the references."""
        key = getattr(kind.settings.truth, "key", "")
        values = {} if kind.truth is None else {key: kind.truth}
        scene = share_scene(self.pool, make_source(kind, values), kind.loaded)
        page = ReferencePage(self.pool, kind.context.folder / "references", f"References of {kind.settings.title}")
        return complete_on(self.pool, scene, self.show, page)

    def describe(self) -> str:
        """The workers and the time of a step, in a line; only the workers before the first step."""
        return ", ".join([self.pool.describe(), *([self.times.describe()] if self.times.steps else [])])

    def tables(self) -> list[Table]:
        """The workers and what they did."""
        return [self.pool.tabulate()]

    def notes(self) -> list[str]:
        """Where the fit ran, and what was lost."""
        count = len(self.pool.workers)
        where = f"{count} worker{'s' * (count != 1)} of a cluster computed the steps: {self.times.describe()}."
        return [where, *self.pool.describe_losses()]
