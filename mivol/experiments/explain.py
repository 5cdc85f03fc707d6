"""What a fit would do, before it does anything: its data, what it looks for, its plan, and every check that it makes itself.

Conventions. A fit is begun as it would be, up to its first step; of a scene the derivative of a few views is taken by a sample
or two a pixel. What only the disk or the run folder can refuse is left to the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import msgspec
import numpy as np

from mivol import config
from mivol.config import Experiment, FieldFit, Files, GaussianFit, PhotoFit, Scan
from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.camera_pictures import survey_of
from mivol.experiments.field_plan import batches_of, choices, make_plan, suited
from mivol.experiments.film import plan_film
from mivol.experiments.gaussian_start import begin, make_gaussian_plan
from mivol.experiments.photo_data import boxed, read_photos
from mivol.experiments.projections import beam_of, fitted_views, held_out_views, make_data, make_grid
from mivol.experiments.references import (
    References,
    camera_of,
    check_truth,
    find_sensors,
    load_experiment_scene,
    make_truth,
    put,
    read_references,
)
from mivol.experiments.scan_fit import make_problem as make_scan_problem
from mivol.experiments.scan_fit import make_projector, make_solver, noise_of, settle
from mivol.experiments.scene_fit import make_integrator, make_problem, settle_depth
from mivol.experiments.solver_choice import check_grid, choose_storage
from mivol.experiments.start import make_starts
from mivol.experiments.task import Task
from mivol.optim.parameters import check_names
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.scenes.emissive_start import check_given_start
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.photos import Photos
from mivol.report.cameras import plot_cameras
from mivol.scene.explain import Explanation, examine
from mivol.tomography.filtered import check_directions

Say = Callable[[str], None]
"""Takes one line of facts."""


def explain_fit(chosen: Experiment | Scan | PhotoFit, base: Path, picture: Path | None = None) -> Explanation:
    """What a fit would do; nothing is fitted, and nothing written but a picture.

    Args:
        chosen: all settings.
        base: folder that the paths in them are relative to.
        picture: where the cameras of photographs and the boxes are drawn (.png, .svg); None: nowhere.

    Returns:
        Facts as far as they were found, and what is refused, where something is.
    """
    lines = [f"experiment  {chosen.title}"]
    try:
        if picture is not None and not isinstance(chosen, PhotoFit):
            raise MivolError(f"{picture} was asked for, and only cameras of photographs are drawn: leave out --output.")
        choose_back_end(chosen.variant, chosen.threads)
        drawing = {} if picture is None else {"picture": picture}
        found = KINDS[type(chosen)](chosen, base, lines.append, **drawing)
    except MivolError as error:
        return Explanation(tuple(lines), str(error))
    return Explanation((*lines, *found.lines), found.refusal)


def explain_scene_fit(chosen: Experiment, base: Path, say: Say) -> Explanation:
    """Views, parameters and scene; the scene holds the truth where one is known, else the start.

    Raises:
        MivolError: whatever :func:`mivol.experiments.scene_fit.scene_fit` refuses up to its first step.
    """
    loaded = load_experiment_scene(chosen, base)
    scene = loaded.scene
    sensors, held_out = find_sensors(chosen, scene)
    width, height = (int(n) for n in camera_of(sensors[0]).film().crop_size())
    said = f", {len(held_out)} of them held out" if held_out else ""
    say(f"  views     {len(sensors)} of {width} x {height} pixels{said}")
    truth = make_truth(chosen, base, scene)
    task, depth = settle_depth(Task(chosen, base, Path()), loaded, truth)
    chosen = task.chosen
    for line in depth:
        say(f"  depth     {line.choice}, because {line.reason}")
    check_names([sought.key for sought in chosen.parameter])
    starts = make_starts(chosen, base, scene)
    for start in starts:
        low, high = start.parameter.domain
        shape = " x ".join(map(str, start.value.shape))
        mean = float(np.mean(start.value))
        say(f"  sought    {start.parameter.name}: {shape}, in [{low:g}, {high:g}] {start.parameter.unit}, from {mean:.4g}")
    check_truth(chosen)
    is_known = isinstance(chosen.reference, Files)
    seen = read_references(chosen, base, loaded, sensors, held_out) if is_known else blank_references(sensors, held_out)
    rehearse(chosen, make_problem(few_samples(chosen), scene, make_integrator(chosen), starts, seen))
    params = mi.traverse(scene)
    for start in starts:
        put(params, start.parameter.name, start.value)
    if truth is not None:
        put(params, chosen.truth.key, truth)
    say(f"  holding   {'the truth' if truth is not None else 'the start'}, in what follows")
    return examine(scene, chosen.fit.max_depth, camera_of(sensors[0]))


def blank_references(sensors: Sequence[Any], held_out: frozenset[int]) -> References:
    """White pictures in the places of those that a fit would render."""
    seen = References(held_out)
    for sensor in sensors:
        width, height = camera_of(sensor).film().crop_size()
        seen.add(sensor, np.ones((int(height), int(width), 1 if "mono" in mi.variant() else 3)))
    return seen


MOST_SAMPLES = 2
"""Samples a pixel of the derivative that is taken to see whether there is one; a noisy loss takes pairs."""


def few_samples(chosen: Experiment) -> Experiment:
    """The experiment with fewer samples."""
    fit = msgspec.structs.replace(chosen.fit, spp=min(chosen.fit.spp, MOST_SAMPLES))
    return msgspec.structs.replace(chosen, fit=fit)


def rehearse(chosen: Experiment, problem: SceneProblem) -> None:
    """Begin a fit as far as nothing is fitted.

    Raises:
        MivolError: what the optimiser or a first step refuses, or a start that no emissive one can take the place of.
    """
    for sought in chosen.parameter:
        if sought.start_fit == "emission":
            check_given_start(sought.key, np.asarray(problem.values()[sought.key]))
    chosen.optimiser.begin(problem)
    problem.rehearse()


def explain_scan_fit(chosen: Scan, base: Path, say: Say) -> Explanation:
    """Projections, grid and solver.

    Raises:
        MivolError: whatever :func:`mivol.experiments.scan_fit.scan_fit` refuses before its first iteration.
    """
    grid = make_grid(chosen, base)
    edges = grid.voxel_size if len(set(grid.voxel_size)) > 1 else grid.voxel_size[:1]
    say(f"  grid      {' x '.join(map(str, grid.shape))} voxels of {' x '.join(f'{edge:g}' for edge in edges)}")
    check_grid(chosen, grid)
    data = make_data(chosen, base, grid)
    views, rows, columns = data.y.shape
    say(f"  scan      {views} views of {rows} x {columns} pixels, {beam_of(chosen)}")
    for note in data.notes:
        say(f"  data      {note}")
    kept = fitted_views(held_out_views(chosen, views), views)
    say(f"  held out  {views - len(kept)} views")
    chosen, lines = settle(chosen, data, grid, kept)
    projector = make_projector(chosen, data, grid)
    if chosen.solve.start == "filtered":
        check_directions(projector)
    # Back-projection alone takes longer than all else here.
    empty = msgspec.structs.replace(chosen.solve, start="empty")
    problem = make_scan_problem(msgspec.structs.replace(chosen, solve=empty), projector, data, kept)
    storage = choose_storage(chosen.solve, problem.linear_problem.A).line
    make_solver(chosen, noise_of(chosen, problem, data)).begin(problem)
    for line in (*lines, storage):
        say(f"  {line.choice}, because {line.reason}")
    if chosen.solve.tv:
        say(f"  total variation: {chosen.solve.tv:g} in units of the {chosen.solve.tv_unit}")
    return Explanation((f"  solver    {chosen.solve.name}, at most {chosen.solve.iterations} iterations",))


def explain_photo_fit(chosen: FieldFit, base: Path, say: Say, picture: Path | None = None) -> Explanation:
    """Photographs, boxes and plan.

    Raises:
        MivolError: whatever :func:`mivol.experiments.photo_fit.photo_fit` refuses before its first step.
    """
    asked = make_plan(chosen)
    photos, judged = read_photos(chosen, base)
    photos = boxed(chosen, photos)
    say(photos.describe())
    say(f"  judged by {0 if judged is None else len(judged.views)} photographs")
    for note in plan_film(chosen.show, photos).notes:
        say(f"  {note}")
    plan = suited(asked, photos)
    batches = batches_of(plan, photos)
    for one in choices(plan, photos, batches):
        say(f"  {one.choice}: {one.reason}")
    plan.optimizer.begin(RadianceProblem(batches, photos.box, plan, chosen.seed))
    return Explanation(drawn(photos, judged, plan.levels, picture))


def drawn(photos: Photos, judged: Photos | None, levels: int, picture: Path | None) -> tuple[str, ...]:
    """A line with the picture of cameras and boxes, where one is asked for."""
    if picture is None:
        return ()
    plot_cameras(survey_of(photos, judged, levels), picture)
    return (str(picture),)


def explain_gaussian_fit(chosen: GaussianFit, base: Path, say: Say, picture: Path | None = None) -> Explanation:
    """Photographs, where Gaussians begin, and plan.

    Raises:
        MivolError: whatever :func:`mivol.experiments.gaussian_fit.gaussian_fit` refuses before its first step.
    """
    asked = make_gaussian_plan(chosen)
    photos, judged = read_photos(chosen, base)
    photos = boxed(chosen, photos)
    say(photos.describe())
    say(f"  judged by {0 if judged is None else len(judged.views)} photographs")
    for note in plan_film(chosen.show, photos).notes:
        say(f"  {note}")
    begun = begin(chosen, photos, asked)
    for one in begun.lines:
        say(f"  {one.choice}: {one.reason}")
    begun.plan.optimizer.begin(begun.problem(chosen.seed))
    return Explanation(drawn(photos, judged, 1, picture))


KINDS = {
    config.Experiment: explain_scene_fit,
    config.Scan: explain_scan_fit,
    config.FieldFit: explain_photo_fit,
    config.GaussianFit: explain_gaussian_fit,
}
