"""What a fit would do, before it does anything: its data, what it looks for, its plan, and every check that it makes itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import msgspec
import numpy as np

from mivol import config
from mivol.config import Experiment, FieldFit, Files, GaussianFit, PhotoFit, Scan
from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.experiments.depth import settle_depth
from mivol.experiments.film import plan_film
from mivol.experiments.gaussian_start import begin, make_gaussian_plan
from mivol.experiments.photo_data import boxed, read_photos
from mivol.experiments.photo_plan import batches_of, choices, make_plan, shrunk
from mivol.experiments.projections import beam_of, fitted_views, held_out_views, make_data, make_grid
from mivol.experiments.references import camera_of, find_sensors, load_experiment_scene, read_references
from mivol.experiments.scan_fit import make_problem as make_scan_problem
from mivol.experiments.scan_fit import settle
from mivol.experiments.scan_storage import choose_storage
from mivol.experiments.scene_fit import make_integrator
from mivol.experiments.start import make_start
from mivol.experiments.task import Task
from mivol.experiments.truth import check_truth, make_truth, put
from mivol.optim.parameters import check_names
from mivol.scene.explain import Explanation, examine
from mivol.tomography.filtered import check_directions
from mivol.tomography.projector import Projector
from mivol.tomography.supersampling import subdivide

Say = Callable[[str], None]
"""Takes one line of facts."""


def explain_fit(chosen: Experiment | Scan | PhotoFit, base: Path) -> Explanation:
    """What a fit would do; nothing is rendered, fitted or written.

    Args:
        chosen: all settings.
        base: folder that the paths in them are relative to.

    Returns:
        Facts as far as they were found, and what is refused, where something is.
    """
    lines = [f"experiment  {chosen.title}"]
    try:
        choose_back_end(chosen.variant, chosen.threads)
        found = KINDS[type(chosen)](chosen, base, lines.append)
    except MivolError as error:
        return Explanation(tuple(lines), str(error))
    return Explanation((*lines, *found.lines), found.refusal)


def explain_scene_fit(chosen: Experiment, base: Path, say: Say) -> Explanation:
    """Views, parameters and scene; the scene holds the truth where one is known, else the start.

    Raises:
        MivolError: whatever :func:`mivol.experiments.scene_fit.scene_fit` refuses before its first render.
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
    make_integrator(chosen)
    check_names([sought.key for sought in chosen.parameter])
    starts = [make_start(sought, base, scene) for sought in chosen.parameter]
    for start in starts:
        low, high = start.parameter.domain
        shape = " x ".join(map(str, start.value.shape))
        mean = float(np.mean(start.value))
        say(f"  sought    {start.parameter.name}: {shape}, in [{low:g}, {high:g}] {start.parameter.unit}, from {mean:.4g}")
    check_truth(chosen)
    if isinstance(chosen.reference, Files):
        read_references(chosen, base, loaded, sensors, held_out)
    params = mi.traverse(scene)
    for start in starts:
        put(params, start.parameter.name, start.value)
    if truth is not None:
        put(params, chosen.truth.key, truth)
    say(f"  holding   {'the truth' if truth is not None else 'the start'}, in what follows")
    return examine(scene, chosen.fit.max_depth, camera_of(sensors[0]))


def explain_scan_fit(chosen: Scan, base: Path, say: Say) -> Explanation:
    """Projections, grid and solver.

    Raises:
        MivolError: whatever :func:`mivol.experiments.scan_fit.scan_fit` refuses before its first iteration.
    """
    grid = make_grid(chosen, base)
    edges = grid.voxel_size if len(set(grid.voxel_size)) > 1 else grid.voxel_size[:1]
    say(f"  grid      {' x '.join(map(str, grid.shape))} voxels of {' x '.join(f'{edge:g}' for edge in edges)}")
    data = make_data(chosen, base, grid)
    views, rows, columns = data.y.shape
    say(f"  scan      {views} views of {rows} x {columns} pixels, {beam_of(chosen)}")
    for note in data.notes:
        say(f"  data      {note}")
    kept = fitted_views(held_out_views(chosen, views), views)
    say(f"  held out  {views - len(kept)} views")
    chosen, lines = settle(chosen, data, grid, kept)
    projector = Projector(data.geometry, subdivide(grid, chosen.solve.supersampling, data.geometry))
    if chosen.solve.start == "filtered":
        check_directions(projector)
    # Back-projection alone takes longer than all else here.
    empty = msgspec.structs.replace(chosen.solve, start="empty")
    problem = make_scan_problem(msgspec.structs.replace(chosen, solve=empty), projector, data, kept)
    storage = choose_storage(chosen.solve, problem.linear_problem.A).line
    for line in (*lines, storage):
        say(f"  {line.choice}, because {line.reason}")
    if chosen.solve.tv:
        say(f"  total variation: {chosen.solve.tv:g} in units of the {chosen.solve.tv_unit}")
    return Explanation((f"  solver    {chosen.solve.name}, at most {chosen.solve.iterations} iterations",))


def explain_photo_fit(chosen: FieldFit, base: Path, say: Say) -> Explanation:
    """Photographs, box and plan.

    Raises:
        MivolError: whatever :func:`mivol.experiments.photo_fit.photo_fit` refuses before its first step.
    """
    asked = make_plan(chosen)
    photos, judged = read_photos(chosen, base)
    photos = boxed(chosen, photos)
    say(photos.text)
    say(f"  judged by {0 if judged is None else len(judged.views)} photographs")
    for note in plan_film(chosen.show, photos).notes:
        say(f"  {note}")
    plan = shrunk(asked, photos)
    return Explanation(tuple(f"  {one.choice}: {one.reason}" for one in choices(plan, photos, batches_of(plan, photos))))


def explain_gaussian_fit(chosen: GaussianFit, base: Path, say: Say) -> Explanation:
    """Photographs, where Gaussians begin, and plan.

    Raises:
        MivolError: whatever :func:`mivol.experiments.gaussian_fit.gaussian_fit` refuses before its first step.
    """
    asked = make_gaussian_plan(chosen)
    photos, judged = read_photos(chosen, base)
    photos = boxed(chosen, photos)
    say(photos.text)
    say(f"  judged by {0 if judged is None else len(judged.views)} photographs")
    for note in plan_film(chosen.show, photos).notes:
        say(f"  {note}")
    begun = begin(chosen, photos, asked)
    return Explanation(tuple(f"  {one.choice}: {one.reason}" for one in begun.lines))


KINDS = {
    config.Experiment: explain_scene_fit,
    config.Scan: explain_scan_fit,
    config.FieldFit: explain_photo_fit,
    config.GaussianFit: explain_gaussian_fit,
}
