"""A fit of scene parameters to images of the scene.

Conventions. References are cached by content, and another fit of the same views uses the cache. A row of the metrics has the
index of a step, and errors measured before the step; the last row has the errors of the result.

Outputs. ``views/`` has one OpenEXR file per view, with the layers ``reference`` and ``standard_error`` (of the difference, if
the reference's is known) beside the render, and PNGs. ``volumes/`` has ``.vol`` and ``.npz``. ``images/`` has fitted textures
and skies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import msgspec
import numpy as np

from mivol.config import AUTO, Files, Rendered, SceneExperiment, Sought
from mivol.errors import MivolError
from mivol.experiments.film import film_of_volume
from mivol.experiments.fit_kind import FitKind, Say, Stages
from mivol.experiments.references import (
    References,
    check_truth,
    find_references,
    find_sensors,
    hold_values,
    load_experiment_scene,
    make_truth,
    read_references,
    set_parameter,
    to_sensor,
)
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.start import (
    Start,
    box_edge_lengths,
    check_given_start,
    find_emissive_start,
    grid_to_world,
    make_starts,
)
from mivol.files import write_exr, write_png, write_volume
from mivol.optim.events import upsample
from mivol.optim.loop import Course, Fit
from mivol.optim.optimizer import Optimizer
from mivol.optim.parameters import GRID, check_names, find_parameter_kind
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import FINAL, HELD_OUT, RenderBatch, View, derive_seed, make_batches
from mivol.report.cameras import draw_view_cameras
from mivol.report.pixel_scale import is_preview_due
from mivol.report.record import Image, PlanLine, Volume, read_metrics
from mivol.scene.explain import Explanation, describe_light, explain_scene, read_integrator_settings
from mivol.scene.load import LoadedScene
from mivol.scene.needs import find_needs
from mivol.scene.plan import Plan, make_plan
from mivol.scene.previews import find_sufficient_depth
from mivol.scene.survey import survey_scene
from mivol.scene_graph import traverse
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS, Settings
from mivol.validate.metrics import nrmse, psnr
from mivol.validate.statistics import BATCHES, Moments

REHEARSAL_SPP = 2
"""Largest number of samples per pixel in the derivative taken by ``mivol explain``; a noisy loss needs pairs."""


class SceneFit(FitKind):
    """A fit of scene parameters; ``mivol explain`` describes the scene with the truth, or with the first values if unknown.

    Attributes:
        loaded: scene of the experiment.
        sensors, held_out: sensors of the views, and the indices of the held-out views.
        truth: true volume (Z, Y, X, C); None if unknown.
        depth_plan: the choice of "auto" for ``fit.max_depth``.
        starts: parameters and their first values.
        integrator: integrator of the renders.
        references: images of the views.
        n_rows: number of rows in the metrics; None before the first step.
    """

    n_rows: int | None = None
    stages = Stages("scene", "fit", "images and volumes")
    first_row = 0
    settings: SceneExperiment
    problem: SceneProblem

    def describe_run(self) -> dict[str, Any]:
        settings = self.settings
        priors = [prior for parameter in settings.parameter for prior in parameter.prior]
        strategies = [settings.optimizer, settings.loss, *priors]
        keys = ", ".join(parameter.key for parameter in settings.parameter)
        emission = ["nimier_david_2022"] if any(parameter.start_fit for parameter in settings.parameter) else []
        names = f"optimizer {settings.optimizer.label()}, loss {settings.loss.label()}"
        method = f"{settings.fit.integrator}, {names}; parameter: {keys}"
        return {
            "method": method,
            "seeds": {"fit": settings.seed, "references": getattr(settings.reference, "seed", 0)},
            "citations": ["mitsuba3", "drjit", *emission, *dict.fromkeys(key for s in strategies for key in s.cites)],
        }

    def load(self, say: Say) -> None:
        self.loaded = load_experiment_scene(self.settings, self.context.base)
        scene = self.loaded.scene
        self.sensors, self.held_out = find_sensors(self.settings, scene)
        width, height = (int(n) for n in to_sensor(self.sensors[0]).film().crop_size())
        held_out = f", {len(self.held_out)} of them held out" if self.held_out else ""
        say(f"  views     {len(self.sensors)} of {width} x {height} pixels{held_out}")
        self.truth = make_truth(self.settings, self.context.base, scene)
        self.settings, self.depth_plan = resolve_depth(self.settings, self.loaded, self.truth)
        for line in self.depth_plan:
            say(f"  depth     {line.choice}, because {line.reason}")
        check_names([parameter.key for parameter in self.settings.parameter])
        self.starts = make_starts(self.settings, self.context.base, scene)
        for start in self.starts:
            say(f"  parameter {describe_start(start)}")
        check_truth(self.settings)
        self.integrator = make_integrator(self.settings, self.loaded.scene)

    def render_data(self, run: RunFolder) -> None:
        with run.stage("references"):
            workers = self.context.distribution
            complete = None if workers is None else workers.complete_references(self)
            self.references = find_references(
                self.context, self.settings, self.loaded, self.truth, self.sensors, self.held_out, complete
            )

    def make_problem(self) -> SceneProblem:
        return make_problem(self.settings, self.loaded.scene, self.integrator, self.starts, self.references)

    def prepare(self, run: RunFolder) -> None:
        self.measure = SceneErrors(self.settings, self.references, self.truth)
        self.record.units = find_units(self.settings, self.problem)
        self.record.notes += self.improve_starts(run)
        plan = plan_renders(self.settings, self.problem)
        self.record.plan = list(self.depth_plan)
        if plan is not None:
            self.record.plan += [PlanLine(choice=f"{c.subject}: {c.choice}", reason=c.reason) for c in plan.choices]
            cites = SEGMENT_ESTIMATORS[plan.segment].cites
            self.record.citations += [key for key in cites if key not in self.record.citations]

    def improve_starts(self, run: RunFolder) -> list[str]:
        """Fit emissive starts for parameters with ``start_fit = "emission"``; return notes on the starts.

        A resumed run takes the values from the checkpoint.
        """
        if self.context.resume and run.checkpoint.exists():
            return []
        notes = []
        for parameter in self.settings.parameter:
            if parameter.start_fit == "emission":
                place = grid_to_world(parameter.key, self.problem.scene)
                start = find_emissive_start(self.problem, parameter.key, place, self.settings.optimizer, self.settings.seed)
                set_parameter(self.problem.params, parameter.key, start.value)
                self.problem.set_reals(self.problem.initial_reals())
                notes.append(f"{parameter.key} {start.description}")
        self.context.progress.say(notes)
        return notes

    def optimizer(self) -> Optimizer:
        return self.settings.optimizer

    def course(self) -> Course:
        return Course(self.settings.fit.iterations, self.settings.schedule, self.settings.event)

    def digests(self) -> dict[str, str]:
        return {"scene": self.loaded.content_hash, "references": self.references.digest()}

    def after_step(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        self.append_rows(fit, fit.read_history, run)
        if is_preview_due(fit.next_iteration, self.settings.fit.iterations):
            self.show_volume(run)

    def append_rows(self, fit: Fit, records: list[dict[str, float]], run: RunFolder) -> None:
        """Add rows for the newest records of a fit, with the errors measured before their steps."""
        if self.n_rows is None:
            self.n_rows = len(read_metrics(run.path))
        new, self.n_rows = records[self.n_rows :], len(records)
        # At most one evaluation a record.
        errors = {evaluation["iteration"]: evaluation for evaluation in fit.evaluations[-len(new) - 1 :]} if new else {}
        for record in new:
            run.append(**{**errors.get(record["iteration"], {}), **record})

    def show_volume(self, run: RunFolder) -> None:
        """Write the first fitted grid for a viewer; a fit of other parameters has none."""
        for name, value in self.problem.values().items():
            if len(value.shape) == 4 and name not in self.problem.sparse:
                run.write_newest(np.array(value), grid_to_world(name, self.problem.scene))
                return

    def finish(self, fit: Fit, run: RunFolder) -> None:
        self.append_rows(fit, fit.history, run)
        # Once, however often a finished run is resumed.
        run.rewind(fit.next_iteration - 1)
        if fit.evaluations and fit.evaluations[-1]["iteration"] == fit.next_iteration and len(fit.evaluations[-1]) > 2:
            run.append(**fit.evaluations[-1])
        if self.references.held_out:
            self.record.notes.append(
                f"PSNR is the mean over all held-out views ({len(self.references.held_out)}) at each point of the curve; the "
                "peak is the largest value of each reference."
            )
        self.record.notes += fit.log + ([f"stopped early: {fit.run.stop_reason}"] if fit.run.stop_reason else [])

    def write_outputs(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        SceneOutputs(self.settings, run, fit, self.references, self.truth, best).write()

    def rehearse(self, say: Say) -> Explanation:
        settings, scene = self.settings, self.loaded.scene
        if isinstance(settings.reference, Files):
            self.references = read_references(settings, self.context.base, self.loaded, self.sensors, self.held_out)
        else:
            self.references = make_white_references(self.sensors, self.held_out)
        spp = min(settings.fit.spp, REHEARSAL_SPP)
        cheap = msgspec.structs.replace(settings, fit=msgspec.structs.replace(settings.fit, spp=spp))
        problem = make_problem(cheap, scene, self.integrator, self.starts, self.references)
        for parameter in settings.parameter:
            if parameter.start_fit == "emission":
                check_given_start(parameter.key, np.asarray(problem.values()[parameter.key]))
        settings.optimizer.begin(problem)
        problem.rehearse()
        params = traverse(scene)
        for start in self.starts:
            set_parameter(params, start.parameter.name, start.value)
        if self.truth is not None:
            set_parameter(params, settings.truth.key, self.truth)
        say(f"  values    facts and plan are for {'the true volume' if self.truth is not None else 'the first values'}")
        return explain_scene(scene, settings.fit.max_depth, to_sensor(self.sensors[0]))


def resolve_depth(
    settings: SceneExperiment, loaded: LoadedScene, truth: np.ndarray | None
) -> tuple[SceneExperiment, list[PlanLine]]:
    """Put a number in place of ``max_depth = "auto"`` or of an absent ``max_depth``.

    An absent depth is the depth of the scene's integrator. ``auto`` is measured from the first view, in the scene that renders
    the references. If the references are files and the truth is unknown, nothing can be measured, and paths have no limit.

    Returns:
        Settings with a number, and the reason; unchanged settings if ``max_depth`` is a number.
    """
    if settings.fit.max_depth is None:
        depth, reason = read_integrator_settings(loaded.scene).max_depth, "set by the scene's integrator"
    elif settings.fit.max_depth != AUTO:
        return settings, []
    elif truth is None and not isinstance(settings.reference, Rendered):
        depth, reason = -1, "the references are files of an unknown volume"
    else:
        with nullcontext() if truth is None else hold_values(loaded.scene, settings.truth.key, truth):
            sensor = to_sensor(next(iter(settings.views.sensors(loaded.scene))))
            answer = find_sufficient_depth(loaded.scene, sensor, Settings(), settings.fit.noise)
        depth, reason = answer.depth, answer.reason
    fit = msgspec.structs.replace(settings.fit, max_depth=depth)
    return msgspec.structs.replace(settings, fit=fit), [PlanLine(choice=f"max_depth: {depth}", reason=reason)]


def describe_start(start: Start) -> str:
    """Name, shape, domain and mean of a parameter's first value."""
    low, high = start.parameter.domain
    shape = " x ".join(map(str, start.value.shape))
    mean = float(np.mean(start.value))
    return f"{start.parameter.name}: {shape}, in [{low:g}, {high:g}] {start.parameter.unit}, from {mean:.4g}"


def make_integrator(settings: SceneExperiment, scene: mi.Scene) -> mi.Integrator:
    """Load the integrator of the fit, which hides emitters where the scene's integrator does.

    Raises:
        MivolError: an unknown integrator, or settings refused by the integrator.
    """
    name = settings.fit.integrator
    try:
        return mi.load_dict({"type": name, **describe_light(scene, settings.fit.max_depth)})
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise MivolError(f'fit.integrator = "{name}" cannot be loaded ({reason}): choose "mivol", the default.') from None


def make_white_references(sensors: Sequence[Any], held_out: frozenset[int]) -> References:
    """White images in place of rendered references."""
    references = References(held_out)
    for sensor in sensors:
        width, height = to_sensor(sensor).film().crop_size()
        references.add(sensor, np.ones((int(height), int(width), 1 if "mono" in mi.variant() else 3)))
    return references


def make_problem(
    settings: SceneExperiment, scene: mi.Scene, integrator: mi.Integrator, starts: Sequence[Start], references: References
) -> SceneProblem:
    """Make the problem of an experiment, and put the starts into the scene."""
    params = traverse(scene)
    for start in starts:
        set_parameter(params, start.parameter.name, start.value)
    options = {"spp": settings.fit.spp, "samples_per_pass": settings.fit.samples_per_pass, "seed": settings.seed}
    parameters = [start.parameter for start in starts]
    problem = SceneProblem(scene, references.fitted, parameters, integrator, settings.loss, **options)
    problem.set_reals(problem.initial_reals())
    return problem


def plan_renders(settings: SceneExperiment, problem: SceneProblem) -> Plan | None:
    """Return the plan of mivol's integrator for the scene; None with another integrator."""
    if settings.fit.integrator != "mivol":
        return None
    needs = find_needs(problem.scene, problem.batches[0].sensor, survey_scene(problem.scene))
    return make_plan(needs, Settings(**describe_light(problem.scene, settings.fit.max_depth)))


class SceneErrors:
    """Errors outside the loss of a fit.

    These are the PSNR of held-out views, the error of the volume if the truth is known, and the values of parameters of few
    numbers.
    """

    def __init__(self, settings: SceneExperiment, references: References, truth: np.ndarray | None) -> None:
        self.truth = truth
        self.batches = make_batches(references.held_out, settings.fit.samples_per_pass) if references.held_out else []
        self.key = settings.truth.key if settings.truth else ""
        self.spp = settings.fit.spp_shown or settings.fit.spp

    def __call__(self, problem: SceneProblem) -> dict[str, float]:
        errors: dict[str, float] = {}
        if self.batches:
            errors["held_out_psnr"] = float(np.mean([value for batch in self.batches for value in self.psnr(problem, batch)]))
        if self.truth is not None and self.key in problem.values():
            volume = problem.values()[self.key]
            if tuple(volume.shape) != self.truth.shape:
                volume = upsample(volume, self.truth.shape[:3])
            errors["nrmse"] = nrmse(np.asarray(volume), self.truth)
        return errors | scalar_values(problem)

    def psnr(self, problem: SceneProblem, batch: RenderBatch) -> list[float]:
        """PSNR [dB] of each view of a batch, rendered from the current scene."""
        image = np.asarray(problem.render(batch.sensor, derive_seed(problem.seed, 0, 0, HELD_OUT), self.spp))
        pairs = zip(np.split(image, batch.n_views, 1), np.split(np.asarray(batch.reference), batch.n_views, 1), strict=True)
        return [psnr(render, reference) for render, reference in pairs]


def scalar_values(problem: SceneProblem) -> dict[str, float]:
    """Current numbers of the parameters without a grid or an image, by key and index."""
    values = {name: np.asarray(value) for name, value in problem.values().items() if value.ndim == 1}
    return {f"{name}[{i}]": float(x) for name, value in values.items() for i, x in enumerate(value)}


def find_units(settings: SceneExperiment, problem: SceneProblem) -> dict[str, str]:
    """Units of the loss and of :func:`scalar_values`."""
    known = {parameter.name: parameter.unit for parameter in problem.parameters}
    return {"loss": settings.loss.unit} | {name: known[name.rpartition("[")[0]] for name in scalar_values(problem)}


# -- Outputs ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneOutputs:
    """Outputs of a scene fit.

    Attributes:
        settings: settings of the experiment.
        run: run folder with the record.
        fit: the finished fit.
        references: the references.
        truth: true volume, if known.
        best: the best iterate.
    """

    settings: SceneExperiment
    run: RunFolder
    fit: Fit
    references: References
    truth: np.ndarray | None
    best: BestIterate

    def write(self) -> None:
        """Write images, volumes and curves, and record the files and the results."""
        record, fit = self.run.record, self.fit
        self.run.make("views", "volumes")
        for number, view in enumerate((*self.references.fitted, *self.references.held_out)):
            record.images += self.write_view(view, number)
        for parameter in self.settings.parameter:
            record.volumes += self.write_grid(parameter)
            record.images += self.write_image(parameter.key)
        views = {"train": self.references.fitted, "held_out": self.references.held_out}
        record.images += draw_view_cameras(self.run.path, fit.problem.scene, views)
        self.run.write_curves()
        record.results = {
            **fit.latest_errors(),
            "loss": fit.history[-1]["loss"],
            "iterations": float(fit.next_iteration),
            "views": float(len(self.references.fitted)),
            "fit_seconds": fit.seconds,
        }

    def render_last(self, view: View, number: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Render a view; return the image and the standard error of the difference from the reference, or None if the
        standard error of the reference is unknown.

        The render's own noise counts. At the edge of a lit region, the render may see light missed by the reference. The
        noise of the render is then the larger part. The estimate uses ``BATCHES`` renders of at least one sample.
        """
        render, spp = self.fit.problem.render, self.settings.fit.spp_shown or self.settings.fit.spp
        seed, error = (self.settings.seed, 0, number, FINAL), self.references.standard_errors.get(view.name)
        if error is None:
            return np.asarray(render(view.sensor, derive_seed(*seed), spp)), None
        share = math.ceil(spp / BATCHES)
        batches = Moments.from_batches(render(view.sensor, derive_seed(*seed, batch), share) for batch in range(BATCHES))
        return batches.mean.astype(np.float32), np.sqrt(np.square(error) + batches.variance_of_mean).astype(np.float32)

    def write_view(self, view: View, number: int) -> list[Image]:
        """Write a render beside the reference."""
        stem = f"views/{view.name.replace(' ', '_')}"
        image, error = self.render_last(view, number)
        reference = np.asarray(view.reference)
        parts = {"render": ("", image), "reference": ("reference", reference)}
        if error is not None:
            parts["standard error"] = "standard_error", error
        planes = {key: plane for part in parts.values() for key, plane in to_exr_layer(*part).items()}
        write_exr(self.run.path / f"{stem}.exr", planes)
        write_png(self.run.path / f"{stem}.png", image)
        write_png(self.run.path / f"{stem}_reference.png", reference)
        about = {"view": view.name, "held_out": any(view is other for other in self.references.held_out)}
        return [Image(path=f"{stem}.exr", role=role, layer=layer_name(*part), **about) for role, part in parts.items()]

    def write_grid(self, parameter: Sought) -> list[Volume]:
        """Write a fitted grid as .npz and .vol at the place in the scene, and as a film, and the truth if known.

        A .vol holds only boxes along the axes. For a rotated grid, the .vol has the unit cube; the scene has the transform.
        """
        value = np.asarray(self.fit.values()[parameter.key])
        if value.ndim != GRID:
            return []
        place = grid_to_world(parameter.key, self.fit.problem.scene)
        is_along_axes = np.array_equal(place[:3, :3], np.diag(np.abs(np.diagonal(place)[:3])))
        quantity = next((word for word in ("sigma_t", "sigma_a", "sigma_s", "albedo") if word in parameter.key), "value")
        grids = {"reconstruction": value}
        if self.truth is not None and self.settings.truth.key == parameter.key:
            grids["truth"] = self.truth
        volumes = []
        unit = parameter.unit or find_parameter_kind(parameter.key).unit
        for role, grid in grids.items():
            stem = f"volumes/{parameter.key.replace('.', '_')}_{role}"
            write_volume(self.run.path / f"{stem}.vol", grid, place if is_along_axes else np.eye(4))
            write_volume(self.run.path / f"{stem}.npz", grid, place, metadata={"key": parameter.key, "unit": unit})
            about = {"quantity": quantity, "unit": unit, "size": box_edge_lengths(place), "caption": parameter.key}
            volumes.append(Volume(path=f"{stem}.npz", role=role, **about))
        self.run.record.images += film_of_volume(self.run, value, box_edge_lengths(place), "y", quantity)
        if not self.best.is_newest:
            stem = f"volumes/{parameter.key.replace('.', '_')}_best"
            write_volume(self.run.path / f"{stem}.npz", self.best.read()[parameter.key], place)
        return volumes

    def write_image(self, key: str) -> list[Image]:
        """Write a fitted image (texture, sky) as .exr of linear values and as .png.

        Mitsuba's ``envmap`` repeats a column at either side of the input. The output has no repeated columns, since another
        ``envmap`` would add new ones.
        """
        value = np.asarray(self.fit.values()[key])
        if value.ndim != 3 or value.shape[2] not in (1, 3):
            return []
        is_sky = traverse(self.fit.problem.scene).properties[key][2].class_name() == "EnvironmentMapEmitter"
        image = value[:, 1:-1] if is_sky else value
        self.run.make("images")
        stem = f"images/{key.replace('.', '_')}"
        write_exr(self.run.path / f"{stem}.exr", to_exr_layer("", image))
        write_png(self.run.path / f"{stem}.png", image)
        return [Image(path=f"{stem}.png", role="picture", caption=f"fitted {key}; linear values are in {stem}.exr")]


def to_exr_layer(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of an image (height, width, 1 or 3) as an OpenEXR layer."""
    return {layer: image} if image.shape[2] == 3 else {layer_name(layer, image): image[..., 0]}


def layer_name(layer: str, image: np.ndarray) -> str:
    """Name of a layer in the record; single channels have a name of their own."""
    return layer if image.shape[2] == 3 else f"{layer}.Y".lstrip(".")
