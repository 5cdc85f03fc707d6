"""Steps of a fit to images of a scene over the workers of a cluster: blocks of views as work.

Conventions. The owner has the whole problem, and takes the steps. A worker has the scene, the references and a copy of the
problem. It receives the real numbers of a step with the numbers of its blocks, and adds their derivatives in float64.
A sum of float32 numbers in float64 is exact unless they differ by more than 2^29 over their count. So the gradient does not
depend on which worker has which block, and neither do losses, which are added in the order of the blocks.

A block has a few views side by side, and depends on the views only. A fit alone puts more views side by side, so it draws other
random numbers than a fit on a cluster; both minimise the same function.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import msgspec
import numpy as np

from mivol import config
from mivol.cluster.packages import SceneSource, decode_sensor, encode_sensor, open_scene, share_scene
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.reference import complete_on
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.experiments.fit_kind import FitKind
from mivol.experiments.references import to_sensor
from mivol.experiments.scene_fit import SceneFit, make_integrator
from mivol.files.fetch import PREFIX, resolve_path
from mivol.optim.problem import Reals
from mivol.optim.scenes.scene_problem import Linearization, SceneProblem, draw_views
from mivol.optim.scenes.views import ADJOINT, PRIMAL, RenderBatch, View, count_pixels, make_batches, make_single_batches
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


def open_problem(place: Workplace, digest: str) -> SceneProblem:
    """The problem of an input in this worker, made at the first call."""

    def make() -> SceneProblem:
        content = place.kept[digest]
        settings = config.from_dict(content["settings"])
        scene = open_scene(place, content["scene"]).scene
        sensors = [decode_sensor(sensor) for sensor in content["sensors"]]
        looks = [scene.sensors()[sensor] if isinstance(sensor, int) else to_sensor(sensor) for sensor in sensors]
        views = [
            View(name, look, mi.TensorXf(image))
            for name, look, image in zip(content["names"], looks, content["references"], strict=True)
        ]
        options = {"spp": settings.fit.spp, "samples_per_pass": settings.fit.samples_per_pass, "seed": settings.seed}
        problem = SceneProblem(scene, views, content["parameters"], make_integrator(settings), settings.loss, **options)
        problem.batches = make_blocks(views, problem.spp)
        return problem

    return place.made(f"problem {digest}", make)


@dataclass
class Answer:
    """What a worker computed for its blocks.

    Attributes:
        losses: loss and noise by the number of the block.
        gradients: sum over the blocks of derivatives by the values, float64; empty for losses only.
        noisy: whether images hold noise of sampled light.
    """

    losses: dict[int, tuple[float, float]]
    gradients: dict[str, np.ndarray]
    noisy: bool


def compute_blocks(
    place: Workplace,
    digest: str,
    what: str,
    reals: dict[str, np.ndarray],
    iteration: int,
    numbers: Sequence[int],
    chosen: Sequence[int] | None = None,
    tangents: dict[str, np.ndarray] | None = None,
) -> Answer:
    """Compute losses and derivatives of blocks in a worker.

    Args:
        place: the worker.
        digest: content hash of the problem.
        what: LOSS, GRADIENT, LINEARIZATION or CURVATURE.
        reals: real numbers by parameter.
        iteration: selects the random numbers; 0 around a linearization.
        numbers: numbers of the blocks.
        chosen: numbers of the views of this step, each a block; None: all views.
        tangents: direction by the scene's values, for CURVATURE.
    """
    problem = open_problem(place, digest)
    batches = problem.batches if chosen is None else make_single_batches([problem.views[index] for index in chosen])
    problem.set_reals(to_tensors(reals))
    n_views, answer = sum(batch.n_views for batch in batches), Answer({}, {}, problem.noisy)
    images: dict[int, mi.TensorXf] = {}
    if what == CURVATURE:
        direction = to_tensors(tangents)
        images = {n: problem.jvp(batches[n].sensor, direction, problem.seed_for(0, n, PRIMAL)) for n in numbers}
        problem.set_reals(to_tensors(reals))
    for number in numbers:
        batch, seed = batches[number], problem.seed_for(iteration, number, PRIMAL)
        if what == CURVATURE:
            share = batch.n_views / n_views / len(images[number].array)
            problem.vjp(batch.sensor, problem.loss.weight(batch.reference) * images[number] * share, seed)
        else:
            compared = problem.compare(batch, seed, n_views)
            answer.losses[number] = compared.loss, compared.noise
            if what != LOSS:
                own = seed if what == LINEARIZATION and not problem.noisy else problem.seed_for(iteration, number, ADJOINT)
                problem.vjp(batch.sensor, compared.adjoint, own)
        if what != LOSS:
            add_gradients(answer.gradients, problem)
    return answer


def add_gradients(total: dict[str, np.ndarray], problem: SceneProblem) -> None:
    """Add the derivatives of one block in float64, and clear them in the scene."""
    for name, gradient in problem.gradients().items():
        values = np.asarray(gradient, dtype=np.float64)
        total[name] = total[name] + values if name in total else values
        dr.clear_grad(problem.params[name])


def to_tensors(arrays: dict[str, np.ndarray]) -> Reals:
    """NumPy arrays as tensors."""
    return {name: mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32)) for name, array in arrays.items()}


# -- In the owner ------------------------------------------------------------------------------------------------------------


class SharedSceneProblem(SceneProblem):
    """A problem whose losses and gradients are computed by workers; everything else stays in this process.

    Attributes:
        pool: workers.
        digest, scene_digest: content hashes of the problem and the scene in the workers.
    """

    pool: Pool
    digest: str
    scene_digest: str

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[float, Reals]:
        """f(u) and its gradient, as :meth:`SceneProblem.loss_and_gradient`."""
        chosen = draw_views(iteration, len(self.views), views, self.seed) if views else None
        answer = self.ask(GRADIENT, reals, iteration, chosen)
        energy, gradients = self.through_priors_and_maps(reals, to_tensors(answer.gradients))
        return self.take_losses(answer) + energy, gradients

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
    ) -> Answer:
        """Let the workers compute all blocks, and add their answers.

        Raises:
            MivolError: a refusal of a worker, or as :meth:`mivol.cluster.pool.Pool.run`.
        """
        count = len(self.batches if chosen is None else chosen)
        parts = min(count, len(self.pool.workers))
        sent = {name: np.array(value) for name, value in reals.items()}
        along = None if tangents is None else {name: np.array(value) for name, value in tangents.items()}
        needs = self.scene_digest, self.digest
        units = [
            Unit(part, compute_blocks, (self.digest, what, sent, iteration, range(part, count, parts), chosen, along), needs)
            for part in range(parts)
        ]
        answers = dict(self.pool.run(units, ahead=1, check=self.safe_point))
        losses = {number: found for answer in answers.values() for number, found in answer.losses.items()}
        total: dict[str, np.ndarray] = {}
        for part in sorted(answers):
            for name, gradient in answers[part].gradients.items():
                total[name] = total[name] + gradient if name in total else gradient
        return Answer(losses, total, answers[0].noisy)

    def take_losses(self, answer: Answer) -> float:
        """Sum of the blocks' losses in their order, stored with the noise for :meth:`warning`."""
        self.noisy = answer.noisy
        losses, noises = zip(*(answer.losses[number] for number in sorted(answer.losses)), strict=True)
        self.newest_loss = math.fsum(losses), math.nan if self.noisy and self.spp == 1 else math.fsum(noises)
        return self.newest_loss[0]


class SharedLinearization(Linearization):
    """A scene's problem around one point u, with images differentiated by workers."""

    problem: SharedSceneProblem

    def differentiate_images(self) -> tuple[float, Reals]:
        """Loss of the images, and its derivative by the values."""
        answer = self.problem.ask(LINEARIZATION, self.reals, 0)
        return self.problem.take_losses(answer), to_tensors(answer.gradients)

    def curve_images(self, direction: Reals) -> Reals:
        """J^T W J direction, for a direction of the values."""
        return to_tensors(self.problem.ask(CURVATURE, self.reals, 0, tangents=direction).gradients)


class ClusterDistribution:
    """A :class:`mivol.experiments.fit_kind.Distribution` over a pool.

    Attributes:
        pool: workers.
        show: receives the progress of references in a line.
    """

    def __init__(self, pool: Pool, show: Callable[[str], None] = lambda line: None) -> None:
        self.pool, self.show = pool, show

    def make_problem(self, kind: FitKind) -> SceneProblem:
        """The problem of a fit to images of a scene.

        Raises:
            MivolError: another kind of fit.
        """
        check_settings(kind.settings)
        settings = kind.settings
        alone = kind.make_problem()
        scene = share_scene(self.pool, self._source(kind), kind.loaded)
        fitted = [sensor for index, sensor in enumerate(kind.sensors) if index not in kind.held_out]
        content = {
            "scene": scene,
            "settings": config.resolved(settings),
            "sensors": [encode_sensor(kind.loaded.scene, sensor) for sensor in fitted],
            "names": [view.name for view in alone.views],
            "references": [np.array(view.reference) for view in alone.views],
            "parameters": list(alone.parameters),
        }
        digest = hashlib.sha256(scene.encode() + config_bytes(content["settings"]) + repr(content["sensors"]).encode())
        for image in content["references"]:
            digest.update(image.tobytes())
        size = sum(image.nbytes for image in content["references"])
        problem = SharedSceneProblem(
            alone.scene,
            alone.views,
            alone.parameters,
            alone.integrator,
            alone.loss,
            alone.spp,
            alone.samples_per_pass,
            alone.seed,
        )
        problem.batches = make_blocks(alone.views, alone.spp)
        problem.set_reals(problem.initial_reals())
        problem.pool, problem.digest, problem.scene_digest = self.pool, digest.hexdigest(), scene
        self.pool.share(problem.digest, content, size)
        return problem

    def complete_references(self, kind: FitKind) -> Complete:
        """The function that renders the references of a fit to images of a scene, which show the truth if it is known.

        Raises:
            MivolError: another kind of fit.
        """
        check_settings(kind.settings)
        key = getattr(kind.settings.truth, "key", "")
        values = {} if kind.truth is None else {key: kind.truth}
        return complete_on(self.pool, share_scene(self.pool, self._source(kind, values), kind.loaded), self.show)

    def notes(self) -> list[str]:
        """Where the fit ran, and what was lost."""
        count = len(self.pool.workers)
        where = f"The gradients were computed by {count} worker{'s' * (count != 1)} of a cluster."
        return [where, *self.pool.describe_losses()]

    def _source(self, kind: SceneFit, values: dict[str, np.ndarray] | None = None) -> SceneSource:
        settings, base = kind.settings, kind.context.base
        defines = {
            key: str(resolve_path(base, value)) if isinstance(value, str) and value.startswith(PREFIX) else value
            for key, value in settings.scene.define.items()
        }
        return SceneSource(base / settings.scene.file, defines, (), values or {})


def config_bytes(settings: dict[str, Any]) -> bytes:
    """Settings as bytes for a hash."""
    return msgspec.json.encode(config.flat(settings), order="sorted")


def check_settings(settings: config.Experiment) -> None:
    """Refuse experiments whose steps run in one process only.

    Raises:
        MivolError: with what a cluster can do for them.
    """
    if not isinstance(settings, config.SceneExperiment):
        raise MivolError(
            f'"{settings.title}" is no fit to images of a scene, and only those run their steps on a cluster: leave out '
            "--cluster, or let mivol sweep run several such fits on it."
        )
