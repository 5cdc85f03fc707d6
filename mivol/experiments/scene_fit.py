"""A scene fitted to images of it: from the settings of an experiment to a run folder, one call per arrow."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import msgspec
import numpy as np

from mivol import config
from mivol.config import AUTO, Experiment, Rendered
from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.references import (
    References,
    camera_of,
    check_truth,
    find_references,
    holding,
    load_experiment_scene,
    make_truth,
    put,
)
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.scene_outputs import SceneOutputs
from mivol.experiments.start import Start, make_starts, place_of
from mivol.experiments.task import Task
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import upsample
from mivol.optim.loop import Course, Fit, begin_fit
from mivol.optim.parameters import check_names
from mivol.optim.scenes.emissive_start import find_emissive_start
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import HELD_OUT, RenderBatch, derive_seed, make_batches
from mivol.report.page import write_page
from mivol.report.record import PlanLine, RunRecord
from mivol.scene.depth_preview import measure_depths
from mivol.scene.load import LoadedScene
from mivol.scene.needs import find_needs
from mivol.scene.plan import Plan, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS, Settings
from mivol.validate.metrics import nrmse, psnr


def scene_fit(task: Task) -> Path:
    """Fit a scene to its views.

    References are cached by what they show, so that another fit of the same views renders none.

    Args:
        task: with an :class:`~mivol.config.Experiment`.

    Returns:
        The page.

    Raises:
        MivolError: whatever is wrong with the settings, the scene, the references or the disk.
        KeyboardInterrupt: stopped; what is there is kept, and ``task.resume`` continues.
    """
    chosen: Experiment = task.chosen
    choose_back_end(chosen.variant, chosen.threads)
    run = RunFolder(task.folder, new_record(task), task.resume)
    with run.at_work():
        with run.stage("scene"):
            loaded = load_experiment_scene(chosen, task.base)
            truth = make_truth(chosen, task.base, loaded.scene)
            task, depth = settle_depth(task, loaded, truth)
            chosen = task.chosen
            integrator = make_integrator(chosen)
            check_names([sought.key for sought in chosen.parameter])
            starts = make_starts(chosen, task.base, loaded.scene)
            check_truth(chosen)
        with run.stage("references"):
            seen = find_references(task, loaded, truth)
        with run.stage("fit"):
            problem = make_problem(chosen, loaded.scene, integrator, starts, seen)
            run.record.units = units(chosen, problem)
            run.record.notes += improve_starts(task, run, problem)
            made = plan_of(chosen, problem)
            run.record.plan = depth + lines_of(made)
            run.record.citations += cited(made, run.record.citations)
            best = BestIterate(run)
            fit = solve(task, run, loaded, problem, SceneErrors(chosen, seen, truth), best)
        with run.stage("images and volumes"):
            SceneOutputs(chosen, run, fit, seen, truth, best).write()
    page = write_page(task.folder)
    task.watcher.say([*best.says(), run.summary()])
    return page


def new_record(task: Task) -> RunRecord:
    """The record of a run that begins."""
    chosen: Experiment = task.chosen
    priors = [prior for sought in chosen.parameter for prior in sought.prior]
    strategies = [chosen.optimiser, chosen.loss, *priors]
    sought = ", ".join(sought.key for sought in chosen.parameter)
    emission = ["nimier_david_2022"] if any(sought.start_fit for sought in chosen.parameter) else []
    return RunRecord.new(
        chosen.title,
        method=f"{chosen.fit.integrator}, {chosen.optimiser.label()} on {chosen.loss.label()}; looked for: {sought}",
        config=config.resolved(chosen),
        command=task.command,
        seeds={"fit": chosen.seed, "references": getattr(chosen.reference, "seed", 0)},
        citations=["mitsuba3", "drjit", *emission, *dict.fromkeys(key for s in strategies for key in s.cites)],
    )


def plan_of(chosen: Experiment, problem: SceneProblem) -> Plan | None:
    """The plan of mivol's integrator for this scene; other integrators have none."""
    if chosen.fit.integrator != "mivol":
        return None
    needs = find_needs(problem.scene, problem.batches[0].sensor, survey_scene(problem.scene))
    return make_plan(needs, Settings(max_depth=chosen.fit.max_depth))


def lines_of(plan: Plan | None) -> list[PlanLine]:
    """The choices of a plan, with their reasons."""
    return [] if plan is None else [PlanLine(choice=f"{c.about}: {c.choice}", reason=c.reason) for c in plan.choices]


def cited(plan: Plan | None, known: Sequence[str]) -> list[str]:
    """What the estimator of a plan cites beside ``known`` keys."""
    return [] if plan is None else [key for key in SEGMENT_ESTIMATORS[plan.segment].cites if key not in known]


def make_integrator(chosen: Experiment) -> mi.Integrator:
    """The integrator of the fit.

    Raises:
        MivolError: Mitsuba has none of that name, or it refuses its settings.
    """
    name = chosen.fit.integrator
    try:
        return mi.load_dict({"type": name, "max_depth": chosen.fit.max_depth})
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise MivolError(f'fit.integrator = "{name}" cannot be loaded ({reason}): "mivol" is the usual one.') from None


def make_problem(
    chosen: Experiment, scene: mi.Scene, integrator: mi.Integrator, starts: Sequence[Start], seen: References
) -> SceneProblem:
    """The problem of an experiment, with the scene at its start."""
    params = mi.traverse(scene)
    for start in starts:
        put(params, start.parameter.name, start.value)
    settings = {"spp": chosen.fit.spp, "samples_per_pass": chosen.fit.samples_per_pass, "seed": chosen.seed}
    parameters = [start.parameter for start in starts]
    problem = SceneProblem(scene, seen.fitted, parameters, integrator, chosen.loss, **settings)
    problem.set_reals(problem.initial_reals())
    return problem


def improve_starts(task: Task, run: RunFolder, problem: SceneProblem) -> list[str]:
    """Put emissive starts into the scene where they are asked for; what was found, in sentences.

    A run that goes on from a checkpoint has its values from there.
    """
    chosen: Experiment = task.chosen
    asked = [sought.key for sought in chosen.parameter if sought.start_fit == "emission"]
    if task.resume and run.checkpoint.exists():
        return []
    notes = []
    for key in asked:
        found = find_emissive_start(problem, key, place_of(key, problem.scene), chosen.optimiser, chosen.seed)
        put(problem.params, key, found.value)
        problem.set_reals(problem.initial_reals())
        notes.append(f"{key} {found.text}")
    task.watcher.say(notes)
    return notes


def solve(
    task: Task, run: RunFolder, loaded: LoadedScene, problem: SceneProblem, measure: SceneErrors, best: BestIterate
) -> Fit:
    """Fit the scene to its views; the metrics grow by a line an iteration, and the best iterate is kept."""
    chosen: Experiment = task.chosen
    course = Course(chosen.fit.iterations, chosen.schedule, chosen.event)
    digests = {"scene": loaded.content_hash, "references": measure.seen.digest()}
    store = CheckpointFile(run.checkpoint, digests | config.flat(config.resolved(chosen)), task.resume)

    def judge(problem: SceneProblem) -> dict[str, float]:
        errors = measure(problem)
        best.see(fit.next_iteration, errors, problem.values())
        return errors

    def observe(fit: Fit) -> None:
        write_metrics(run, fit)
        watch(fit)

    fit = begin_fit(problem, chosen.optimiser, course, measure=judge, checkpoint=store)
    best.restore()
    run.begin(fit.next_iteration - 1)
    with task.watcher.watch(chosen.fit.iterations) as watch:
        fit.complete(observe)
    append_last(run, fit)
    return fit


def write_metrics(run: RunFolder, fit: Fit) -> None:
    """One line for the iteration that has just ended, with what was measured before it."""
    last = fit.history[-1]
    measured = fit.latest_errors() if fit.evaluations and fit.evaluations[-1]["iteration"] == last["iteration"] else {}
    run.append(last["iteration"], last["seconds"], loss=last["loss"], **measured)


def append_last(run: RunFolder, fit: Fit) -> None:
    """What was measured after the last iteration, once however often a run that is done is resumed."""
    run.rewind(fit.next_iteration - 1)
    if fit.evaluations and fit.evaluations[-1]["iteration"] == fit.next_iteration and len(fit.evaluations[-1]) > 2:
        run.append(**fit.evaluations[-1])


class SceneErrors:
    """What a fit does not minimise: PSNR of held-out views, the error of the volume where the truth is known, and what is
    found of parameters that are few numbers."""

    def __init__(self, chosen: Experiment, seen: References, truth: np.ndarray | None) -> None:
        self.seen, self.truth = seen, truth
        self.batches = make_batches(seen.held_out, chosen.fit.samples_per_pass) if seen.held_out else []
        self.key = chosen.truth.key if chosen.truth else ""
        self.spp = chosen.fit.spp_shown or chosen.fit.spp

    def __call__(self, problem: SceneProblem) -> dict[str, float]:
        errors: dict[str, float] = {}
        if self.batches:
            errors["held_out_psnr"] = float(np.mean([value for batch in self.batches for value in self.psnr(problem, batch)]))
        if self.truth is not None and self.key in problem.values():
            found = problem.values()[self.key]
            if tuple(found.shape) != self.truth.shape:
                found = upsample(found, self.truth.shape[:3])
            errors["nrmse"] = nrmse(np.asarray(found), self.truth)
        return errors | numbers(problem)

    def psnr(self, problem: SceneProblem, batch: RenderBatch) -> list[float]:
        """PSNR [dB] of each view of a batch, of what the scene holds now."""
        image = np.asarray(problem.render(batch.sensor, derive_seed(problem.seed, 0, 0, HELD_OUT), self.spp))
        pairs = zip(np.split(image, batch.n_views, 1), np.split(np.asarray(batch.reference), batch.n_views, 1), strict=True)
        return [psnr(render, reference) for render, reference in pairs]


def numbers(problem: SceneProblem) -> dict[str, float]:
    """Each number of the parameters that are no grids or images, by key and place, as the scene holds it now."""
    values = {name: np.asarray(value) for name, value in problem.values().items() if value.ndim == 1}
    return {f"{name}[{i}]": float(x) for name, value in values.items() for i, x in enumerate(value)}


def units(chosen: Experiment, problem: SceneProblem) -> dict[str, str]:
    """Units of the loss and of each of those numbers."""
    known = {parameter.name: parameter.unit for parameter in problem.parameters}
    return {"loss": chosen.loss.unit} | {name: known[name.rpartition("[")[0]] for name in numbers(problem)}


def settle_depth(task: Task, loaded: LoadedScene, truth: np.ndarray | None) -> tuple[Task, list[PlanLine]]:
    """Put a number in the place of ``max_depth = "auto"``.

    The depth is measured from the first view, in the scene that renders the references. Where the references are files and the
    truth is not known, nothing can be measured, and paths have no limit.

    Returns:
        The task with a number, and why it is that one; the task itself where it has one.
    """
    chosen: Experiment = task.chosen
    if chosen.fit.max_depth != AUTO:
        return task, []
    if truth is None and not isinstance(chosen.reference, Rendered):
        depth, reason = -1, "the references are files, and what they show is not known"
    else:
        with nullcontext() if truth is None else holding(loaded.scene, chosen.truth.key, truth):
            sensor = camera_of(next(iter(chosen.views.sensors(loaded.scene))))
            answer = measure_depths(loaded.scene, sensor, Settings(), chosen.fit.noise)
        depth, reason = answer.depth, answer.reason
    fit = msgspec.structs.replace(chosen.fit, max_depth=depth)
    settled = replace(task, chosen=msgspec.structs.replace(chosen, fit=fit))
    return settled, [PlanLine(choice=f"max_depth: {depth}", reason=reason)]
