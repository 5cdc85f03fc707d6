"""``mivol optimize``: an experiment from its TOML to its run folder, one call per arrow.

Conventions. A run folder holds ``run.json``, ``metrics.jsonl``, ``checkpoint.npz``, ``references/``, ``views/`` (one
OpenEXR per view with layers: the render, ``reference`` and ``standard_error``; and PNGs), ``volumes/`` (``.vol`` and
``.npz``), ``curves/`` and ``report.html``. Every file is written whole. References are cached by what they show, so that
another fit of the same views renders none.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mivol import config
from mivol.cli.progress import Display, tracked
from mivol.cli.rendering import set_threads, set_variant
from mivol.config import Experiment, Files, Sought
from mivol.errors import MivolError
from mivol.fields.procedural import make_procedural
from mivol.files import layers, read_exr, read_volume, write_exr, write_png, write_volume
from mivol.optim.events import upsample
from mivol.optim.loop import Fit, reconstruct
from mivol.optim.parameters import GRID, Parameter, as_tensor, check_names, find, like
from mivol.optim.problem import Problem, seed_of
from mivol.optim.shots import Shot, View, check_sizes, make_shots
from mivol.report import figures
from mivol.report.page import write_page
from mivol.report.record import Choice, Image, RunRecord, Volume, append_metrics, read_metrics, rewind_metrics, write_record
from mivol.scene.load import LoadedScene, load_scene
from mivol.scene.needs import find_needs, survey_scene
from mivol.scene.plan import make_plan
from mivol.threads import check_one_thread
from mivol.transport.medium import place_of_grid
from mivol.transport.path import Settings
from mivol.validate.reference import ReferenceResult, read_reference, render_reference
from mivol.validate.statistics import nrmse, psnr

CHECKPOINT = "checkpoint.npz"
HELD_OUT, FINAL = 2, 3  # purposes of random numbers, beside PRIMAL and ADJOINT


@dataclass
class Seen:
    """What was seen of the scene.

    Attributes:
        fitted: views that the fit sees.
        held_out: views that it does not.
        standard_errors: of the references, by view, where known.
    """

    fitted: list[View] = field(default_factory=list)
    held_out: list[View] = field(default_factory=list)
    standard_errors: dict[str, np.ndarray] = field(default_factory=dict)

    def digest(self) -> str:
        """SHA-256 of all references."""
        h = hashlib.sha256()
        for view in (*self.fitted, *self.held_out):
            h.update(np.ascontiguousarray(view.reference).tobytes())
        return h.hexdigest()


def run(chosen: Experiment, base: Path, folder: Path, *, resume: bool = False) -> Path:
    """Do an experiment.

    Args:
        chosen: all settings.
        base: folder that its paths are relative to.
        folder: run folder, made where it is not there.
        resume: continue from its checkpoint.

    Returns:
        The page.

    Raises:
        MivolError: whatever is wrong with the settings, the scene, the references or the disk.
        KeyboardInterrupt: stopped; what is there is kept, and ``resume`` continues.
    """
    check_one_thread()
    set_variant(chosen.variant)
    set_threads(chosen.threads)
    folder.mkdir(parents=True, exist_ok=True)
    record = new_record(chosen)
    with recorded(record, folder):
        with stage(record, "scene"):
            loaded = load_scene(base / chosen.scene.file, chosen.scene.define)
            truth = make_truth(chosen, base, loaded.scene)
            integrator = make_integrator(chosen)
            check_names([sought.key for sought in chosen.parameter])
            starts = [make_start(sought, base, loaded.scene) for sought in chosen.parameter]
            check_truth(chosen)
        with stage(record, "references"):
            seen = references(chosen, base, folder, loaded, truth)
        with stage(record, "fit"):
            problem = pose(chosen, loaded.scene, integrator, starts, seen)
            record.plan = choices(chosen, problem)
            fit = solve(chosen, folder, loaded, problem, seen, truth, resume)
        with stage(record, "images and volumes"):
            write_outputs(chosen, folder, record, fit, seen, truth)
    return write_page(folder)


@contextmanager
def recorded(record: RunRecord, folder: Path) -> Iterator[None]:
    """Keep ``run.json`` true: "running" at first, "finished" or "stopped" in the end, with what stopped it."""
    write_record(record, folder)
    try:
        yield
    except BaseException as error:
        record.status = "stopped"
        record.notes += [f"stopped by: {error}"] if str(error) else []
        with suppress(MivolError, OSError):
            write_record(record, folder)
        raise
    record.status = "finished"
    write_record(record, folder)


@contextmanager
def stage(record: RunRecord, name: str) -> Iterator[None]:
    """Time a part of the run."""
    start = time.perf_counter()
    try:
        yield
    finally:
        record.timings[name] = time.perf_counter() - start


def new_record(chosen: Experiment) -> RunRecord:
    """The record of a run that begins."""
    priors = [prior for sought in chosen.parameter for prior in sought.prior]
    strategies = [chosen.optimiser, chosen.loss, *priors]
    sought = ", ".join(sought.key for sought in chosen.parameter)
    return RunRecord.new(
        chosen.title,
        method=f"{chosen.fit.integrator}, {chosen.optimiser.label()} on {chosen.loss.label()}; looked for: {sought}",
        config=config.resolved(chosen),
        command="mivol optimize",
        seeds={"fit": chosen.seed, "references": getattr(chosen.reference, "seed", 0)},
        citations=["mitsuba3", "drjit", *dict.fromkeys(key for s in strategies for key in s.cites)],
    )


def choices(chosen: Experiment, problem: Problem) -> list[Choice]:
    """The plan of mivol's integrator for this scene, with its reasons; other integrators have none."""
    if chosen.fit.integrator != "mivol":
        return []
    needs = find_needs(problem.scene, problem.shots[0].sensor, survey_scene(problem.scene))
    made = make_plan(needs, Settings(max_depth=chosen.fit.max_depth))
    return [Choice(choice=f"{c.about}: {c.choice}", reason=c.reason) for c in made.choices]


# -- What is known ------------------------------------------------------------------------------------------------


def make_truth(chosen: Experiment, base: Path, scene: mi.Scene) -> np.ndarray | None:
    """The true volume (Z, Y, X, C), where the experiment knows one.

    Raises:
        MivolError: its key is not in the scene, or its file cannot be read.
    """
    if chosen.truth is None:
        return None
    find(chosen.truth.key, mi.traverse(scene))
    if chosen.truth.file:
        return read_volume(base / chosen.truth.file).values
    wanted = chosen.truth
    return make_procedural(wanted.procedural, wanted.shape, wanted.seed, wanted.peak)


def check_truth(chosen: Experiment) -> None:
    """Refuse a truth that nobody looks for: the references would show it and the renders what the scene holds.

    Raises:
        MivolError: with its key.
    """
    if chosen.truth is not None and chosen.truth.key not in [sought.key for sought in chosen.parameter]:
        raise MivolError(
            f"truth.key is {chosen.truth.key}, which is no parameter of the fit, so the references would show another volume "
            "than the renders: look for it too, or put what is known into the scene (scene.define) and take the truth out."
        )


@contextmanager
def holding(scene: mi.Scene, key: str, values: np.ndarray) -> Iterator[None]:
    """The scene with other values of one parameter, for a while."""
    params = mi.traverse(scene)
    before = type(params[key])(params[key])
    put(params, key, values)
    try:
        yield
    finally:
        params[key] = before
        params.update()


def put(params: mi.SceneParameters, key: str, values: np.ndarray) -> None:
    """Set a parameter, in the type that the scene gives it."""
    params[key] = like(mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32)), params[key])
    params.update()


def references(chosen: Experiment, base: Path, folder: Path, loaded: LoadedScene, truth: np.ndarray | None) -> Seen:
    """What was seen from each view: rendered (or found in the cache), or read from files.

    Raises:
        MivolError: no views, held-out views that are not there, files that do not fit.
    """
    sensors = list(chosen.views.sensors(loaded.scene))
    more = list(chosen.held_out.sensors(loaded.scene)) if chosen.held_out is not None else []
    check_held_out(chosen.reference.held_out, len(sensors))
    held_out = (*chosen.reference.held_out, *range(len(sensors), len(sensors) + len(more)))
    sensors += more
    check_sizes({f"view {index}": camera_of(sensor) for index, sensor in enumerate(sensors)})
    if isinstance(chosen.reference, Files):
        return read_files(chosen.reference, base, loaded, sensors, held_out)
    if truth is None:
        return render_views(chosen, folder, loaded, sensors, held_out)
    with holding(loaded.scene, chosen.truth.key, truth):
        return render_views(chosen, folder, load_scene(loaded.scene), sensors, held_out)


def camera_of(sensor: dict | mi.Sensor) -> mi.Sensor:
    """What a rig gives, as a sensor."""
    return mi.load_dict(dict(sensor)) if isinstance(sensor, dict) else sensor


def check_held_out(held_out: Sequence[int], count: int) -> None:
    """Refuse views to hold out that are not there, and a split that leaves nothing to fit.

    Raises:
        MivolError: with the number.
    """
    wrong = next((i for i in held_out if not 0 <= i < count), None)
    if wrong is not None:
        raise MivolError(f"found no view {wrong} to hold out, there are {count}: count from 0 in reference.held_out.")
    if len(set(held_out)) == count:
        raise MivolError(f"all {count} views are held out, expected one to fit: shorten reference.held_out.")


def render_views(
    chosen: Experiment, folder: Path, loaded: LoadedScene, sensors: Sequence[Any], held_out: Sequence[int]
) -> Seen:
    """References by Mitsuba's path tracer."""
    wanted, cache, seen = chosen.reference, folder / "references", Seen()
    cache.mkdir(exist_ok=True)
    for index, sensor in enumerate(tracked(sensors, "references")):
        made = render_reference(
            loaded, cache, max_depth=chosen.fit.max_depth, target_se=wanted.standard_error or None,
            max_spp=wanted.spp, sensor=sensor, seed=wanted.seed, progress=False,
        )  # fmt: skip
        add_view(seen, index, sensor, made.mean, standard_error(made), held_out)
    return seen


def standard_error(made: ReferenceResult) -> np.ndarray:
    """Of each pixel's mean, with room for what was never sampled.

    Where n samples of a pixel all saw the light, their variance is 0, but an event of probability 1/n may have been
    missed: (brightest pixel / n)^2 is added to the variance.
    """
    return np.sqrt(made.variance + (made.mean.max() / made.spp) ** 2)


def read_files(wanted: Files, base: Path, loaded: LoadedScene, sensors: Sequence[Any], held_out: Sequence[int]) -> Seen:
    """References from OpenEXR files; those that mivol wrote must be of the scene that they are said to be of.

    Raises:
        MivolError: another number of files than views, or a file of another scene.
    """
    if len(wanted.paths) != len(sensors):
        raise MivolError(f"found {len(wanted.paths)} reference files for {len(sensors)} views: give one for each.")
    of = load_scene(base / wanted.scene).content_hash if wanted.scene else loaded.content_hash
    seen = Seen()
    for index, (name, sensor) in enumerate(zip(wanted.paths, sensors, strict=True)):
        channels, header = read_exr(base / name)
        if "mivol_reference" in header:
            made = read_reference(base / name, of)
            add_view(seen, index, sensor, made.mean, standard_error(made), held_out)
        else:
            add_view(seen, index, sensor, layers(channels)[""][..., :3], None, held_out)
    return seen


def add_view(seen: Seen, index: int, sensor: Any, mean: np.ndarray, error: np.ndarray | None, held_out: Sequence[int]) -> None:
    """Sort a view in."""
    view = View(f"view {index}", camera_of(sensor), mi.TensorXf(np.ascontiguousarray(mean, dtype=np.float32)))
    (seen.held_out if index in held_out else seen.fitted).append(view)
    if error is not None:
        seen.standard_errors[view.name] = error


# -- The fit ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Start:
    """A parameter and its first value."""

    parameter: Parameter
    value: np.ndarray


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


def make_start(sought: Sought, base: Path, scene: mi.Scene) -> Start:
    """A parameter and where it starts; the scene is not changed.

    Raises:
        MivolError: no such parameter, a start outside its domain, a file that cannot be read.
    """
    params = mi.traverse(scene)
    now = as_tensor(params[find(sought.key, params)])
    # A copy: the scene may give the memory behind a view to another tensor when its parameter changes.
    value = np.array(now)
    if now.ndim < GRID and (sought.shape or sought.start_file):
        raise MivolError(
            f"{sought.key} is no grid of voxels but has the shape {now.shape}: give start, and neither shape nor start_file."
        )
    if sought.start_file:
        value = read_volume(base / sought.start_file).values
    elif sought.start is not None:
        shape = (*sought.shape, now.shape[3]) if sought.shape else now.shape
        value = np.full(shape, start_of(sought, shape), dtype=np.float32)
    extent = edges_of(place_of(sought.key, scene))[::-1] if value.ndim >= GRID else (1.0, 1.0, 1.0)
    parameter = Parameter(sought.key, sought.unit, sought.domain, sought.map, sought.lr, extent, sought.prior)
    parameter.to_reals(mi.TensorXf(np.ascontiguousarray(value)))
    return Start(parameter, value)


def place_of(key: str, scene: mi.Scene) -> np.ndarray:
    """Where the grid of a parameter lies: the (4, 4) map of the unit cube to the world."""
    return place_of_grid(mi.traverse(scene).properties[key][2])


def edges_of(place: np.ndarray) -> tuple[float, float, float]:
    """Lengths (x, y, z) of the edges of a grid's box."""
    return tuple(float(edge) for edge in np.linalg.norm(place[:3, :3], axis=0))


def start_of(sought: Sought, shape: Sequence[int]) -> Any:
    """The start that the experiment gives: one number, or one for each of the last axis.

    Raises:
        MivolError: another count of numbers.
    """
    given = np.size(sought.start)
    if given not in (1, shape[-1]):
        raise MivolError(f"{sought.key} starts from {given} numbers and has {shape[-1]}: give one for all, or one for each.")
    return sought.start


def pose(chosen: Experiment, scene: mi.Scene, integrator: mi.Integrator, starts: Sequence[Start], seen: Seen) -> Problem:
    """The problem of an experiment, with the scene at its start."""
    params = mi.traverse(scene)
    for start in starts:
        put(params, start.parameter.name, start.value)
    wanted, parameters = chosen.fit, [start.parameter for start in starts]
    problem = Problem(scene, seen.fitted, parameters, integrator, chosen.loss, wanted.spp, wanted.samples_per_pass, chosen.seed)
    problem.set(problem.start())
    return problem


def solve(
    chosen: Experiment, folder: Path, loaded: LoadedScene, problem: Problem, seen: Seen, truth: np.ndarray | None,
    resume: bool,
) -> Fit:  # fmt: skip
    """Fit the scene to its views; the metrics grow by a line an iteration."""
    wanted = chosen.fit
    with Display(wanted.iterations) as display:

        def observe(fit: Fit) -> None:
            if not display.begun:
                rewind_metrics(folder, fit.next - 2)
            write_metrics(folder, fit)
            display(fit)

        fit = reconstruct(
            problem, chosen.optimiser, wanted.iterations, schedule=chosen.schedule, events=chosen.event,
            measure=Measure(seen.held_out, truth, chosen), observer=observe, path=folder / CHECKPOINT,
            fingerprint={"scene": loaded.content_hash, "references": seen.digest(), **config.flat(config.resolved(chosen))},
            resume=resume,
        )  # fmt: skip
    fit.save()
    append_last(folder, fit)
    return fit


def numbers(problem: Problem) -> dict[str, float]:
    """Each number of the parameters that are no grids or images, by key and place, as the scene holds it now."""
    values = {name: np.asarray(value) for name, value in problem.values().items() if value.ndim == 1}
    return {f"{name}[{i}]": float(x) for name, value in values.items() for i, x in enumerate(value)}


class Measure:
    """What a fit does not minimise: PSNR of held-out views, the error of the volume where the truth is known, and what is
    found of parameters that are few numbers."""

    def __init__(self, held_out: list[View], truth: np.ndarray | None, chosen: Experiment) -> None:
        self.shots = make_shots(held_out, chosen.fit.samples_per_pass) if held_out else []
        self.truth = truth
        self.key = chosen.truth.key if chosen.truth else ""
        self.spp = chosen.fit.spp_shown or chosen.fit.spp

    def __call__(self, problem: Problem) -> dict[str, float]:
        errors: dict[str, float] = {}
        if self.shots:
            errors["held_out_psnr"] = float(np.mean([value for shot in self.shots for value in self.psnr(problem, shot)]))
        if self.truth is not None and self.key in problem.values():
            found = problem.values()[self.key]
            if tuple(found.shape) != self.truth.shape:
                found = upsample(found, self.truth.shape[:3])
            errors["nrmse"] = nrmse(np.asarray(found), self.truth)
        return errors | numbers(problem)

    def psnr(self, problem: Problem, shot: Shot) -> list[float]:
        """PSNR [dB] of each view of a shot, of what the scene holds now."""
        image = np.asarray(problem.render(shot.sensor, seed_of(problem.seed, 0, 0, HELD_OUT), self.spp))
        pairs = zip(np.split(image, shot.n_views, 1), np.split(np.asarray(shot.reference), shot.n_views, 1), strict=True)
        return [psnr(render, reference) for render, reference in pairs]


def write_metrics(folder: Path, fit: Fit) -> None:
    """One line for the iteration that has just ended, with what was measured before it."""
    last = fit.history[-1]
    measured = fit.measures[-1] if fit.measures and fit.measures[-1]["iteration"] == last["iteration"] else {}
    append_metrics(folder, last["iteration"], last["seconds"], loss=last["loss"], **errors_of(measured))


def errors_of(measured: dict[str, float]) -> dict[str, float]:
    """The errors of a record of ``Fit.measures``, without when they were measured."""
    return {name: value for name, value in measured.items() if name not in ("iteration", "seconds")}


def append_last(folder: Path, fit: Fit) -> None:
    """What was measured after the last iteration, once however often a run that is done is resumed."""
    rewind_metrics(folder, fit.next - 1)
    if fit.measures and fit.measures[-1]["iteration"] == fit.next and len(fit.measures[-1]) > 2:
        append_metrics(folder, **fit.measures[-1])


# -- What came of it ----------------------------------------------------------------------------------------------


def write_outputs(chosen: Experiment, folder: Path, record: RunRecord, fit: Fit, seen: Seen, truth: np.ndarray | None) -> None:
    """Images, volumes, curves, results."""
    for name in ("views", "volumes", "curves"):
        (folder / name).mkdir(exist_ok=True)
    record.notes += fit.log + ([f"stopped early: {fit.run.finished}"] if fit.run.finished else [])
    for number, view in enumerate((*seen.fitted, *seen.held_out)):
        record.images += write_view(chosen, folder, fit.problem, view, seed_of(chosen.seed, 0, number, FINAL), seen)
    for sought in chosen.parameter:
        record.volumes += write_grid(chosen, folder, sought, fit, truth)
        record.images += write_image(folder, sought.key, fit)
    write_curves(folder)
    record.results = {
        **errors_of((fit.measures or [{}])[-1]),
        "loss": fit.history[-1]["loss"],
        "iterations": float(fit.next),
        "views": float(len(seen.fitted)),
        "fit_seconds": fit.seconds,
    }


def write_view(chosen: Experiment, folder: Path, problem: Problem, view: View, seed: int, seen: Seen) -> list[Image]:
    """One view: the render beside its reference."""
    stem = f"views/{view.name.replace(' ', '_')}"
    image = np.asarray(problem.render(view.sensor, seed, chosen.fit.spp_shown or None))
    reference = np.asarray(view.reference)
    error = seen.standard_errors.get(view.name)
    parts = {"render": ("", image), "reference": ("reference", reference)}
    if error is not None:
        parts["standard error"] = "standard_error", error
    write_exr(folder / f"{stem}.exr", {key: plane for part in parts.values() for key, plane in named(*part).items()})
    write_png(folder / f"{stem}.png", image)
    write_png(folder / f"{stem}_reference.png", reference)
    held_out = any(view is other for other in seen.held_out)
    return [
        Image(path=f"{stem}.exr", role=role, view=view.name, held_out=held_out, layer=layer_of(*part))
        for role, part in parts.items()
    ]


def named(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of an image (height, width, 1 or 3), as an OpenEXR layer."""
    return {layer: image} if image.shape[2] == 3 else {layer_of(layer, image): image[..., 0]}


def layer_of(layer: str, image: np.ndarray) -> str:
    """What a record calls a layer: single channels have a name of their own."""
    return layer if image.shape[2] == 3 else f"{layer}.Y".lstrip(".")


def write_grid(chosen: Experiment, folder: Path, sought: Sought, fit: Fit, truth: np.ndarray | None) -> list[Volume]:
    """A parameter that is a grid, as .npz and .vol where it lies in the scene; the truth beside it.

    A .vol has room for boxes along the axes only: of a turned grid it holds the unit cube, which the scene places.
    """
    value = np.asarray(fit.values()[sought.key])
    if value.ndim != GRID:
        return []
    place = place_of(sought.key, fit.problem.scene)
    is_along_axes = np.array_equal(place[:3, :3], np.diag(np.abs(np.diagonal(place)[:3])))
    quantity = next((word for word in ("sigma_t", "sigma_a", "sigma_s", "albedo") if word in sought.key), "value")
    grids = {"reconstruction": value}
    if truth is not None and chosen.truth.key == sought.key:
        grids["truth"] = truth
    found = []
    for role, grid in grids.items():
        stem = f"volumes/{sought.key.replace('.', '_')}_{role}"
        write_volume(folder / f"{stem}.vol", grid, place if is_along_axes else np.eye(4))
        write_volume(folder / f"{stem}.npz", grid, place, metadata={"key": sought.key, "unit": sought.unit})
        about = {"quantity": quantity, "unit": sought.unit, "size": edges_of(place), "caption": sought.key}
        found.append(Volume(path=f"{stem}.npz", role=role, **about))
    return found


def write_image(folder: Path, key: str, fit: Fit) -> list[Image]:
    """A parameter that is an image (texture, sky), as .exr of linear values and .png.

    Mitsuba's ``envmap`` repeats a column at either side of what it was given, which another ``envmap`` would do again.
    """
    value = np.asarray(fit.values()[key])
    if value.ndim != 3 or value.shape[2] not in (1, 3):
        return []
    is_sky = mi.traverse(fit.problem.scene).properties[key][2].class_name() == "EnvironmentMapEmitter"
    image = value[:, 1:-1] if is_sky else value
    (folder / "images").mkdir(exist_ok=True)
    stem = f"images/{key.replace('.', '_')}"
    write_exr(folder / f"{stem}.exr", named("", image))
    write_png(folder / f"{stem}.png", image)
    return [Image(path=f"{stem}.png", role="picture", caption=f"{key} as found, in {stem}.exr")]


def write_curves(folder: Path) -> None:
    """Each number of the metrics against the iteration, as PNG."""
    rows = read_metrics(folder)
    names = {name for row in rows for name, value in row.items() if value is not None} - {"iteration", "seconds"}
    for name in sorted(names):
        figures.save(figures.plot_curve(rows, name), folder / "curves" / f"{name}.png")
