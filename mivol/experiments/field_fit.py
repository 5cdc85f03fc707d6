"""A fit of a radiance field to photographs.

Conventions. The loss in ``metrics.jsonl`` is the mean squared error of a step's rays. ``field.npz`` is the field, ``sky.exr``
the fitted sky, and ``volumes/`` has the density for other programs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.config import FieldExperiment
from mivol.errors import MivolError
from mivol.experiments.fit_kind import Say
from mivol.experiments.photo_data import LEARNED
from mivol.experiments.photo_fit import MOTIONS, PhotoFit, describe_free_space, explain_photos, explain_stop, explain_time
from mivol.experiments.run_folder import BestFiles, RunFolder
from mivol.fields.field_files import write_field
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_exr, write_png, write_volume
from mivol.files.image_files import decode_srgb
from mivol.optim.photographs.field_view import FieldView, render_view
from mivol.optim.photographs.radiance_plan import (
    FEW_PHOTOGRAPHS,
    PRESETS,
    RadiancePlan,
    RadianceStage,
    check_memory,
    scale_longest,
)
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.optim.photographs.sampled_problem import SampledProblem
from mivol.optim.strategy import suggest_name
from mivol.photos import Camera, Photo, Photos, rectify
from mivol.photos.camera_path import HomeView
from mivol.photos.exposures import measure_exposures
from mivol.photos.photo_file import CONVERSIONS
from mivol.photos.region import FEWEST_POINTS, count_levels, median_distance, nested_boxes, points_in_box
from mivol.report.pixel_scale import depth_pixels, normal_pixels, normals_from_depth
from mivol.report.record import Image, PlanLine, Table, Volume
from mivol.validate.metrics import ImageScore, score_image


class FieldFit(PhotoFit):
    """A fit of density and spherical harmonics on a sparse grid.

    Attributes:
        batches: photographs in the sizes of the plan.
    """

    settings: FieldExperiment
    problem: RadianceProblem
    fits_colours = True
    steps = "recorded in the first step, then replayed; recorded anew once in 64 steps, for a new list of occupied cells"

    def make_plan(self, settings: FieldExperiment) -> RadiancePlan:
        return make_radiance_plan(settings)

    def describe_method(self) -> tuple[str, list[str]]:
        method = "a sparse grid of density and spherical harmonics, fitted to photographs; preset "
        return method + self.settings.field.preset, ["plenoxels_2022", "relu_fields_2022", "max_1995"]

    def load(self, say: Say) -> None:
        super().load(say)
        if self.photos.space == "linear":
            self.record.citations.append("mildenhall_2022")

    def plan_fit(self) -> list[PlanLine]:
        self.plan = adapt_plan(self.plan, self.photos)
        self.levels = self.plan.levels
        self.batches = make_batches(self.plan, self.photos)
        return explain_plan(self.plan, self.photos, self.batches)

    def make_problem(self) -> RadianceProblem:
        return RadianceProblem(self.batches, self.photos.box, self.plan, self.settings.seed)

    def best_files(self) -> BestFiles:
        names = ("field_best.npz", *(["sky_best.exr"] if self.problem.sky is not None else []))
        return BestFiles(names, lambda folder: write_result(folder, self.problem, "_best", self.photos.white, self.home_view))

    def judge(self, photo: Photo, metrics: tuple[str, ...]) -> tuple[FieldView, ImageScore]:
        return judge_view(self.problem, self.judged, photo, metrics)

    def film_frame(self, camera: Camera) -> NDArray:
        view = render_view(self.problem.field, camera, find_background(self.problem, self.photos.views[0]))
        return CONVERSIONS[self.photos.space, "srgb"](view.image)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        run.make("volumes")
        field, record = self.problem.field, self.record
        write_result(run.path, self.problem, white=self.photos.white, view=self.home_view)
        record.tables = [tabulate_storage(field, run.path / "field.npz")]
        record.volumes += [write_density(run.path, field.extract_level(number), number) for number in range(field.levels)]
        self.levels = field.levels
        return {"nodes": float(field.rows - (field.nodes is not None)), "bytes": field.bytes / 2**20}

    def gains(self) -> NDArray | None:
        return self.problem.exposure.table() if self.problem.has_gains else None

    def motions(self) -> NDArray | None:
        return None if self.problem.poses is None else self.problem.poses.table()

    def write_first_view(self, run: RunFolder, view: FieldView, photo: Photo) -> list[Image]:
        return write_geometry(run.path, view, photo.camera, self.judged.near_far)


def write_result(
    folder: Path, problem: RadianceProblem | SampledProblem, which: str = "", white: float = 1.0, view: HomeView | None = None
) -> None:
    """Write the field of a problem, and the fitted sky if present.

    Args:
        folder, problem, which: folder, problem, and a suffix of the file names.
        white: factor on the colours: the radiance of the value 1 in the fit.
        view: first view of the field, optional.
    """
    write_field(folder / f"field{which}.npz", problem.field.scale_colours(white), view=view)
    if problem.sky is not None:
        write_exr(folder / f"sky{which}.exr", {"": white * problem.sky.image()})


def judge_view(
    problem: RadianceProblem | SampledProblem, judged: Photos, photo: Photo, metrics: tuple[str, ...]
) -> tuple[FieldView, ImageScore]:
    """Render a photograph's view of the field; return the view and the errors."""
    view = render_view(problem.field, photo.camera, find_background(problem, photo))
    return view, score_image(view.image, photo.image, space=judged.space, mask=photo.mask, metrics=metrics, name=photo.name)


def find_background(problem: RadianceProblem | SampledProblem, photo: Photo) -> NDArray | Sky:
    """Return the background of a photograph: the fitted sky, or the photograph's own."""
    return photo.background if problem.sky is None else problem.sky


def tabulate_storage(field: SphericalGrid, path: Path) -> Table:
    """Table of the field's size, beside grids of the same box with all nodes."""
    nodes, kept = field.node_count, len(field.stored_nodes())
    kinds = {
        "every node: r, g, b and density of 8 bits": 4 * nodes,
        "every node: four numbers": 16 * nodes,
        f"every node: harmonics of degree {field.degree}": 4 * nodes * (1 + field.width),
        "this field, in memory": field.bytes,
        "this field, its file": path.stat().st_size,
    }
    rows = [(name, f"{size / 2**20:.2f} MiB", f"{size / nodes:.3g}") for name, size in kinds.items()]
    head = (f"{kept} of {nodes} nodes are kept ({kept / nodes:.1%})", "in all", "bytes a node of the box")
    return Table(title="Storage", head=head, rows=tuple(rows))


def write_density(folder: Path, field: SphericalGrid, level: int) -> Volume:
    """Write the extinction at the nodes of a level, for other programs; only outer levels have a number in their name."""
    raw, _ = field.to_dense()
    name = f"volumes/density{f'-level-{level}' if level else ''}"
    sigma = np.array(field.activation_function.value_and_slope(type(field.density)(raw.ravel()))[0]).reshape(*field.res, 1)
    write_volume(folder / f"{name}.vol", sigma, field.to_world)
    write_volume(folder / f"{name}.npz", sigma, field.to_world)
    size = tuple(float(edge) for edge in np.abs(np.diag(field.to_world)[:3]))
    caption = f"level {level}, of {2**level} times the extent" if level else ""
    return Volume(path=f"{name}.npz", role="reconstruction", size=size, caption=caption)


def write_geometry(folder: Path, view: FieldView, camera: Camera, near_far: tuple[float, float]) -> list[Image]:
    """Write distance and normals of a view as colours."""
    near, far = near_far
    normals = normals_from_depth(view.depth, camera)
    distances = f"from light, {near:.3g} [length], to dark, {far:.3g} [length]"
    pictures = {
        "distance": (depth_pixels(view.depth, near_far, view.opacity), distances),
        "normals": (normal_pixels(normals, view.opacity), "x, y, z from -1 to 1 as red, green, blue"),
    }
    written = []
    for name, (pixels, scale) in pictures.items():
        write_png(folder / f"views/{name}.png", decode_srgb(pixels / 255))
        caption = f"{name} of the first held-out view: {scale}"
        written.append(Image(path=f"views/{name}.png", role="picture", caption=caption))
    return written


# -- The plan --------------------------------------------------------------------------------------------------------------


GAINS = PlanLine(
    choice="gains of each photograph, if the photographs differ",
    reason="for cameras with automatic exposure; dropped after the first stage if the photographs agree",
)

KEPT_GAINS = PlanLine(
    choice="gains of each photograph",
    reason="common points differ in brightness from what the nearest photographs predict",
)

SMALLEST = 16
"""Shortest edge of a shrunk photograph [pixel]."""

FEWEST = 16
"""Smallest number of nodes along an edge in a preset, even if voxels are then smaller than pixels."""

FEWEST_STEPS = 230
"""Smallest number of steps of the last stage, if the preset has as many; earlier stages visit each pixel as often. With fewer
steps the field stays far from its optimum (12 photographs of wires, held-out views: 25.3 dB in 58 steps, 29.4 in 234, 29.0 in
300, and 27.6 with 300 steps in each stage)."""


def make_radiance_plan(settings: FieldExperiment) -> RadiancePlan:
    """Return the preset of the settings, changed by the other settings.

    Raises:
        MivolError: an unknown preset.
    """
    options = settings.field
    if options.preset not in PRESETS:
        raise MivolError(f'field.preset = "{options.preset}" is unknown: {suggest_name(options.preset, list(PRESETS))}')
    plan = set_background(PRESETS[options.preset], settings.photos.background)
    names = ("degree", "first_degree", "tv_density", "tv_sh", "sparsity", "matte", "depth", "sky", "beta", "exposure", "poses")
    given = {name: getattr(options, name) for name in names}
    plan = replace(plan, **{name: value for name, value in given.items() if value is not None})
    stages = [replace(stage, steps=max(1, round(stage.steps * options.effort))) for stage in plan.stages]
    plan = replace(plan, stages=tuple(stages), epochs=plan.epochs * options.effort)
    if options.degree is not None:
        plan = replace(plan, few_degree=None)
    if options.matte is not None:
        plan = replace(plan, few_matte=None)
    if options.levels is not None:
        plan = replace(plan, levels=options.levels, fewer_levels=False)
    return plan if options.longest is None else replace(plan.with_longest(options.longest), cubic=False)


def set_background(plan: RadiancePlan, background: str | tuple[float, float, float]) -> RadiancePlan:
    """Return the plan with or without a fitted background; an empty word keeps the preset's background."""
    if background == "":
        return plan
    names = LEARNED.get(background, ()) if isinstance(background, str) else ()
    return replace(plan, **{"sky": 0} | {name: getattr(PRESETS["capture"], name) for name in names})


def make_batches(plan: RadiancePlan, photos: Photos) -> RayBatches:
    """Return the photographs in the sizes of the plan, undistorted if their lens has an image plane."""
    return RayBatches.from_photos(
        [rectify(view) for view in photos.views], [one.shrink for one in plan.stages], space=photos.space
    )


def adapt_plan(plan: RadiancePlan, photos: Photos) -> RadiancePlan:
    """Adapt a plan to the photographs.

    A plan for cubes keeps the number of nodes in a box of other proportions; the voxels stay at least as large as the plan's
    voxels and as a pixel. Photographs shrink to the plan's number of pixels per voxel at the middle of the box. Stages take no
    more steps than their pixels justify. Few photographs get a lower degree. The nested boxes end at the first
    box with the reconstructed points and the cameras. Gains stay to the end if common points show that exposures differ.
    """
    cameras, box = [view.camera for view in photos.views], photos.box
    pixel = np.median([np.linalg.norm(camera.origin - box.mean(axis=0)) / camera.K[0, 0] for camera in cameras])
    least, pixels = min(min(camera.size) for camera in cameras), sum(math.prod(camera.size) for camera in cameras)
    edge = float((box[1] - box[0]).max())

    def suited_stage(stage: RadianceStage) -> RadianceStage:
        longest = stage.longest
        if plan.cubic:
            longest = max(longest, min(scale_longest(longest, box), int(edge / (plan.voxel * pixel))))
            longest = min(longest, max(int(edge / pixel), FEWEST))
        halvings = min(round(np.log2(edge / longest / (plan.voxel * pixel))), int(np.log2(least / SMALLEST)))
        return replace(stage, longest=longest, shrink=2 ** max(halvings, 0))

    def steps_an_epoch(stage: RadianceStage) -> float:
        return pixels / stage.shrink**2 / (min(stage.views, len(cameras)) * stage.tiles * TILE**2)

    if len(photos.views) < FEW_PHOTOGRAPHS:
        plan = adapt_to_few(plan)
    plan = keep_gains(reduce_levels(plan, photos), photos)
    stages = [suited_stage(stage) for stage in plan.stages]
    epochs = max(plan.epochs, FEWEST_STEPS / steps_an_epoch(stages[-1]))
    stages = [replace(stage, steps=max(1, int(min(stage.steps, epochs * steps_an_epoch(stage))))) for stage in stages]
    return replace(plan, stages=tuple(stages), cubic=False)


def adapt_to_few(plan: RadiancePlan) -> RadiancePlan:
    """Return the plan for fewer than ``FEW_PHOTOGRAPHS`` photographs."""
    degree = plan.degree if plan.few_degree is None else plan.few_degree
    matte = plan.matte if plan.few_matte is None else plan.few_matte
    return replace(plan, tv_every=1, degree=degree, matte=matte)


def keep_gains(plan: RadiancePlan, photos: Photos) -> RadiancePlan:
    """Return the plan, without the removal of gains if common points show that exposures differ.

    The gains after a short first stage tell too little: they are still small, whether exposures differ or not.
    """
    exposures = measure_exposures(photos.views) if plan.exposure else None
    return plan if exposures is None or not exposures.differ else replace(plan, agree=0.0)


def reduce_levels(plan: RadiancePlan, photos: Photos) -> RadiancePlan:
    """Return the plan with only the nested boxes around points and cameras; few points change nothing."""
    if not can_reduce_levels(plan, photos):
        return plan
    cameras = [view.camera for view in photos.views]
    return replace(plan, levels=count_levels(photos.box, photos.survey.points, cameras, plan.levels))


def can_reduce_levels(plan: RadiancePlan, photos: Photos) -> bool:
    """Return whether the plan lets enough reconstructed points set the number of levels."""
    points = photos.survey.points
    return plan.fewer_levels and points is not None and len(points) >= FEWEST_POINTS


def explain_plan(plan: RadiancePlan, photos: Photos, batches: RayBatches) -> list[PlanLine]:
    """Return the choices of a plan with their reasons."""
    box, origins = photos.box, np.array([view.camera.origin for view in photos.views])
    resolutions = ", ".join(str(stage.longest) for stage in plan.stages)
    width, height = photos.views[0].camera.size
    largest = nested_boxes(box, plan.levels)[-1]
    outer = " x ".join(f"{edge:.4g}" for edge in largest[1] - largest[0])
    holds = "no more than points and cameras need; " if can_reduce_levels(plan, photos) else ""
    outer_boxes = [
        PlanLine(
            choice=f"{plan.levels} nested boxes, the largest of {outer} [length]",
            reason=f"each box has twice the extent of the box before, for the surroundings; {holds}"
            f"{len(points_in_box(origins, box))} of {len(origins)} cameras stand in the innermost",
        )
    ]
    return [
        explain_photos(photos),
        *outer_boxes[: plan.levels > 1],
        *explain_points_outside(plan, photos),
        *explain_depths(plan, batches),
        *explain_near_cameras(plan, origins, box),
        *explain_free_space(plan, photos),
        *explain_wide_lenses(photos),
        PlanLine(choice=f"stages: {resolutions} nodes along the longest edge", reason="coarse first, to find empty space"),
        explain_steps(plan),
        explain_time(plan.minutes, "up to three times as long if matter fills the box"),
        explain_sizes(plan, (width, height)),
        explain_degree(plan, len(photos.views)),
        explain_background(plan, photos),
        *explain_gains(plan),
        *[MOTIONS][: plan.poses],
        explain_stop(plan.stop),
        PlanLine(choice=check_memory(plan, box, batches), reason="estimated before the allocation"),
    ]


def explain_points_outside(plan: RadiancePlan, photos: Photos) -> list[PlanLine]:
    """Return a line if reconstructed points lie outside the boxes."""
    points = photos.survey.points
    if points is None or (beyond := len(points) - len(points_in_box(points, nested_boxes(photos.box, plan.levels)[-1]))) == 0:
        return []
    box = "the largest box" if plan.levels > 1 else "the box"
    reason = f"they lie outside {box}, {'in the sky' if plan.sky else 'where the model is empty'}"
    return [PlanLine(choice=f"{beyond} of {len(points)} points of the reconstruction left out", reason=reason)]


def explain_depths(plan: RadiancePlan, batches: RayBatches) -> list[PlanLine]:
    """Return a line if reconstructed points give depths of rays."""
    point_count = sum(map(len, batches.points))
    choice = f"{point_count} points seen in photographs give the depths of rays, with a weight of {plan.depth:g}"
    return [PlanLine(choice=choice, reason="from a model of COLMAP; field.depth")] if plan.depth and point_count else []


def explain_near_cameras(plan: RadiancePlan, origins: np.ndarray, box: np.ndarray) -> list[PlanLine]:
    """Return a line if derivatives decrease towards cameras at ``origins``."""
    reach = plan.near_distance(origins, box)
    choice = f"derivatives nearer to a camera than {reach:.4g} [length] fall with the square of the distance"
    return [PlanLine(choice=choice, reason="otherwise matter grows in front of the lenses")] if reach else []


def explain_free_space(plan: RadiancePlan, photos: Photos) -> list[PlanLine]:
    """Return a line if nodes in free space stay empty."""
    cameras = [view.camera for view in photos.views]
    return [describe_free_space(cameras, median_distance(cameras, photos.box.mean(axis=0)))][: plan.free_space]


def explain_gains(plan: RadiancePlan) -> list[PlanLine]:
    """Return a line if photographs have gains."""
    return [GAINS if plan.agree else KEPT_GAINS][: plan.exposure]


def explain_degree(plan: RadiancePlan, photographs: int) -> PlanLine:
    """Return the degree of the harmonics, and whether the number of photographs set it."""
    is_few = plan.few_degree is not None and photographs < FEW_PHOTOGRAPHS
    why = f"; fewer than {FEW_PHOTOGRAPHS} photographs overfit higher degrees" if is_few else ""
    reason = f"{(plan.degree + 1) ** 2} numbers a colour and node{why}"
    first = f", {plan.degree_at(0)} in the first stage" if plan.degree_at(0) < plan.degree else ""
    return PlanLine(choice=f"harmonics of degree {plan.degree}{first}", reason=reason)


def explain_steps(plan: RadiancePlan) -> PlanLine:
    """Return the number of steps of the stages, and the bound on the steps."""
    steps = ", ".join(str(stage.steps) for stage in plan.stages)
    reason = "the preset's, times field.effort"
    if plan.epochs < math.inf:
        reason += f"; beyond {FEWEST_STEPS} steps, each pixel is used at most {plan.epochs:g} times, to avoid a fit of noise"
    return PlanLine(choice=f"steps of the stages: {steps}", reason=reason)


def explain_sizes(plan: RadiancePlan, stored_size: tuple[int, int]) -> PlanLine:
    """Return the sizes of the photographs in the stages; ``stored_size`` is their size in memory."""
    width, height = stored_size
    if all(stage.shrink == 1 for stage in plan.stages):
        reason = "their pixels are not much finer than voxels"
        return PlanLine(choice=f"photographs at {width} x {height} pixels in all stages", reason=reason)
    return PlanLine(
        choice=f"photographs shrunk by {', '.join(str(stage.shrink) for stage in plan.stages)} in these stages",
        reason=f"voxels of these stages are larger than finer pixels; memory holds the photographs at {width} x {height}",
    )


def explain_wide_lenses(photos: Photos) -> list[PlanLine]:
    """Return a line if the lens of photographs has no image plane."""
    kinds = [type(view.camera.distortion).__name__.lower() for view in photos.views if view.camera.distortion.is_wide]
    reason = "traced once for each lens and size, then looked up without resampling"
    return [PlanLine(choice=f"rays of {len(kinds)} {kinds[0]} photographs", reason=reason)] if kinds else []


def explain_background(plan: RadiancePlan, photos: Photos) -> PlanLine:
    """Return the choice of the background; for an assumed colour, the reason has the colour at the photographs' edges."""
    if plan.sky:
        return PlanLine(choice=f"a sky of {plan.sky} rows behind the box", reason="field.sky; fitted with the field")
    if photos.views[0].alpha is not None:
        return PlanLine(choice="nothing behind the box", reason="alpha marks the object")
    edges = [view.image[at] for view in photos.views for at in (0, -1, (slice(None), 0), (slice(None), -1))]
    edge_colour, assumed_colour = (
        "(" + ", ".join(f"{c:.2g}" for c in colour) + ")"
        for colour in (np.median(np.concatenate(edges), axis=0), photos.views[0].background)
    )
    reason = f'photos.background; the median at the edges of the photographs is {edge_colour}; "sky" would fit the background'
    return PlanLine(choice=f"the colour {assumed_colour} behind the box", reason=reason)
