"""A fit of 3D Gaussians to photographs.

Conventions. The loss in ``metrics.jsonl`` is the loss of a step's image. ``gaussians.ply`` holds the Gaussians in the format
of published viewers. The first Gaussians stand at the points of a sparse reconstruction, or at random points that may hold
matter.

References: Kerbl et al. 2023, section 5.1 (first scales from the nearest neighbours, opacity 0.1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logit

from mivol.config import GaussianExperiment
from mivol.errors import MivolError
from mivol.experiments.fit_kind import Stages
from mivol.experiments.photo_fit import MOTIONS, PhotoFit, describe_free_space, explain_photos, explain_time
from mivol.experiments.run_folder import BestFiles, RunFolder
from mivol.optim.gaussians.density_control import CloudArrays
from mivol.optim.gaussians.gaussian_plan import CONTROLS, PRESETS, GaussianPlan, check_memory, scene_extent
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.photographs.radiance_plan import FEW_PHOTOGRAPHS
from mivol.optim.photographs.ray_batches import RayBatches, describe_size
from mivol.optim.strategy import suggest_name
from mivol.photos import Camera, Photo, Photos, project, rays, rectify
from mivol.photos.exposures import Exposures, measure_exposures
from mivol.photos.region import FEWEST_POINTS, count_views, is_free_space, points_in_box, viewing_distance
from mivol.points import Gaussians, write_gaussians
from mivol.points.gaussians import to_base_harmonics
from mivol.report.record import PlanLine, Table
from mivol.validate.metrics import ImageScore, score_image

FILE = "gaussians.ply"


class GaussianFit(PhotoFit):
    """A fit of 3D Gaussians.

    Attributes:
        begun: plan, photographs and Gaussians of the first step.
    """

    settings: GaussianExperiment
    problem: GaussianProblem
    stages = Stages("photographs", "fit", "images and Gaussians")
    steps = "recorded in the first step, then replayed; lists of tiles are sorted on the host in each step"

    @property
    def fits_colours(self) -> bool:
        """Whether the photographs have gains."""
        return self.problem.exposure is not None

    def make_plan(self, settings: GaussianExperiment) -> GaussianPlan:
        return make_gaussian_plan(settings)

    def describe_method(self) -> tuple[str, list[str]]:
        method = f"3D Gaussians, splatted in tiles and fitted to photographs; preset {self.settings.gaussians.preset}"
        relocates = self.plan.control == "relocation"
        return method, ["kerbl_2023", "zwicker_2001", "wang_2004"] + ["kheradmand_2024"] * relocates

    def plan_fit(self) -> list[PlanLine]:
        self.begun = start_gaussians(self.settings, self.photos, self.plan)
        self.plan = self.begun.plan
        return self.begun.lines

    def make_problem(self) -> GaussianProblem:
        return self.begun.problem(self.settings.seed)

    def best_files(self) -> BestFiles:
        name = "gaussians_best.ply"
        return BestFiles((name,), lambda folder: self.write_gaussians(folder / name))

    def write_gaussians(self, path: Path) -> Gaussians:
        """Write the Gaussians of the newest iterate with their first view, and return them."""
        gaussians = Gaussians(**self.problem.cloud)
        write_gaussians(path, gaussians, self.home_view)
        return gaussians

    def rectified(self, photo: Photo) -> Photo:
        return rectify(photo)

    def judge(self, photo: Photo, metrics: tuple[str, ...]) -> tuple[NDArray, ImageScore]:
        return judge_view(self.problem, self.judged, photo, metrics)

    def film_frame(self, camera: Camera) -> NDArray:
        low_pass = self.plan.low_pass_at(self.film.shrink)
        return render_gaussians(self.problem, camera, self.photos.views[0].background, low_pass)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        path = run.path / FILE
        gaussians = self.write_gaussians(path)
        self.record.tables = [tabulate_gaussians(gaussians, path.stat().st_size)]
        return {"gaussians": float(gaussians.count)}

    def gains(self) -> NDArray | None:
        return None if self.problem.exposure is None else self.problem.exposure.table()

    def motions(self) -> NDArray | None:
        return None if self.problem.motions is None else self.problem.motions * ([1] * 3 + [self.problem.extent] * 3)


def judge_view(problem: GaussianProblem, judged: Photos, photo: Photo, metrics: tuple[str, ...]) -> tuple[NDArray, ImageScore]:
    """Render a photograph's view of the Gaussians (H, W, 3), and score the view; lens distortion is removed first."""
    photo = rectify(photo)
    image = render_gaussians(problem, photo.camera, photo.background, problem.plan.low_pass)
    return image, score_image(image, photo.image, space=judged.space, mask=photo.mask, metrics=metrics, name=photo.name)


def render_gaussians(problem: GaussianProblem, camera: Camera, behind: NDArray, low_pass: float) -> NDArray:
    """Render the Gaussians through a pinhole, (H, W, 3), over a colour (3,)."""
    splatter = problem.splatter_for(camera.size, low_pass)
    rgba = np.array(splatter.forward(problem.values(), camera, derivatives=False)[0])
    return rgba[..., :3] + (1 - rgba[..., 3:]) * np.asarray(behind, np.float32)


def tabulate_gaussians(gaussians: Gaussians, bytes_: int) -> Table:
    """Table of the size and the typical shape of the Gaussians."""
    opacity, scale = gaussians.opacities(), gaussians.scales()
    rows = (
        ("Gaussians", f"{gaussians.count}"),
        ("harmonics", f"degree {gaussians.degree}"),
        ("file", f"{bytes_ / 2**20:.2f} MiB"),
        ("opacity: median", f"{np.median(opacity):.3g}"),
        ("longest axis: median [length]", f"{np.median(scale.max(axis=1)):.3g}"),
        ("longest over shortest axis: median", f"{np.median(scale.max(axis=1) / scale.min(axis=1)):.3g}"),
    )
    return Table(title="Fitted Gaussians", head=("", ""), rows=rows)


@dataclass(frozen=True)
class GaussianStart:
    """The start of a fit.

    Attributes:
        views: photographs, undistorted.
        plan: plan for photographs of this size.
        batches: photographs in the sizes of the plan.
        cloud: first Gaussians.
        lines: choices with their reasons.
    """

    views: tuple[Photo, ...]
    plan: GaussianPlan
    batches: RayBatches
    cloud: CloudArrays
    lines: list[PlanLine]

    def problem(self, seed: int) -> GaussianProblem:
        """Return the problem before the first step; ``seed`` draws the views and the places."""
        return GaussianProblem(self.batches, [view.camera for view in self.views], self.cloud, self.plan, seed)


def make_gaussian_plan(settings: GaussianExperiment) -> GaussianPlan:
    """Return the preset of the settings, changed by the other settings.

    Raises:
        MivolError: an unknown preset or density control.
    """
    options = settings.gaussians
    if options.preset not in PRESETS:
        raise MivolError(f'gaussians.preset = "{options.preset}" is unknown: {suggest_name(options.preset, list(PRESETS))}')
    if options.control is not None and options.control not in CONTROLS:
        raise MivolError(f'gaussians.control = "{options.control}" is unknown: {suggest_name(options.control, list(CONTROLS))}')
    given = {name: getattr(options, name) for name in ("start", "most", "control", "ssim")}
    overrides = {name: value for name, value in given.items() if value is not None}
    overrides |= {"mip": options.mip, "poses": options.poses, "exposure": bool(options.exposure)}
    plan = replace(PRESETS[options.preset], **overrides)
    if options.degree is not None:
        stages = [replace(stage, degree=min(stage.degree, options.degree)) for stage in plan.stages]
        plan = replace(plan, stages=(*stages[:-1], replace(stages[-1], degree=options.degree)))
    plan = plan.scaled(options.effort)
    return plan if options.views == 1 else plan.with_views(options.views)


def start_gaussians(settings: GaussianExperiment, photos: Photos, plan: GaussianPlan) -> GaussianStart:
    """Adapt the plan to the photographs, and place the first Gaussians; memory is checked before the allocation.

    Raises:
        MivolError: more memory than available, or no place for Gaussians.
    """
    views = tuple(rectify(view) for view in photos.views)
    longest = max(max(view.camera.size) for view in views)
    plan = plan.for_edge(longest)
    exposures = None
    is_capture = settings.photos.background == "" and any(view.alpha is None for view in views)
    if is_capture:
        plan = adapt_to_few(plan, len(views)) if settings.gaussians.degree is None else plan
        plan = replace(plan, reach=viewing_distance([view.camera for view in views], photos.box))
        exposures = measure_exposures(photos.views) if settings.gaussians.exposure is None else None
        plan = replace(plan, exposure=plan.exposure if exposures is None else exposures.differ)
    places, whence = find_start_points(photos, plan.start, settings.seed, is_capture)
    cloud = make_start_cloud(places, views, plan.stages[0].degree)
    if is_capture:
        behind = make_background_cloud(views, plan.stages[0].degree)
        cloud = {name: np.concatenate([array, behind[name]]) for name, array in cloud.items()}
        whence += f", {len(behind['means'])} on a sphere far behind them for the background"
    largest = max(view.camera.size[0] * view.camera.size[1] for view in views)
    if settings.gaussians.minutes is not None:
        plan = plan.in_minutes(settings.gaussians.minutes, largest)
    pixels = largest // min(s.shrink for s in plan.stages) ** 2
    channels = 4 if all(view.alpha is not None for view in views) else 3
    sizes = {stage.shrink for stage in plan.stages}
    taken = sum(view.image.size // 3 * channels // shrink**2 for view in views for shrink in sizes)
    memory = check_memory(replace(plan, start=len(cloud["means"])), taken, pixels)
    batches = RayBatches.from_photos(views, [stage.shrink for stage in plan.stages])
    lines = explain_plan(plan, photos, len(cloud["means"]), whence, memory, plan.minutes(largest), exposures)
    return GaussianStart(views, plan, batches, cloud, lines)


def adapt_to_few(plan: GaussianPlan, photographs: int) -> GaussianPlan:
    """Return the plan of a capture: harmonics of degree 1 at most for fewer than ``FEW_PHOTOGRAPHS`` photographs."""
    most = 1 if photographs < FEW_PHOTOGRAPHS else plan.degree
    return replace(plan, stages=tuple(replace(stage, degree=min(stage.degree, most)) for stage in plan.stages))


GAINS = PlanLine(choice="gains of each photograph", reason="for cameras with automatic exposure; with a prior towards 1")


def explain_gains(plan: GaussianPlan, exposures: Exposures | None) -> list[PlanLine]:
    """Return whether photographs have gains, if they do or if their exposures were measured."""
    if exposures is None:
        return [GAINS][: plan.exposure]
    facts = (
        f"points differ in brightness by {exposures.spread:.0%} between photographs, and by {exposures.unpredicted:.0%} from "
        "the prediction by the nearest photographs"
    )
    return [PlanLine(choice=f"{'' if plan.exposure else 'no '}gains of each photograph", reason=facts)]


def explain_plan(
    plan: GaussianPlan,
    photos: Photos,
    count: int,
    whence: str,
    memory: str,
    minutes: float,
    exposures: Exposures | None,
) -> list[PlanLine]:
    """Return the choices of the plan with their reasons."""
    stages = [f"{stage.steps} of {describe_size(stage.shrink)}, degree {stage.degree}" for stage in plan.stages]
    behind = "alpha marks the object" if photos.views[0].alpha is not None else "photos.background"
    background = PlanLine(choice="no Gaussians for the background", reason=behind)
    if plan.reach:
        background = describe_free_space([view.camera for view in photos.views], plan.reach)
    control = {
        "clone_split": "split or cloned at large gradients, removed if transparent (Kerbl et al. 2023)",
        "relocation": "transparent Gaussians move to opaque Gaussians (Kheradmand et al. 2024)",
    }[plan.control]
    views = "one photograph" if plan.views == 1 else f"{plan.views} photographs"
    return [
        explain_photos(photos),
        PlanLine(choice=f"{count} Gaussians at first", reason=whence),
        PlanLine(choice=f"up to {max(plan.most, count)} Gaussians", reason=control),
        PlanLine(choice=f"{plan.steps} steps: {'; '.join(stages)}", reason=f"small photographs first, {views} a step"),
        PlanLine(choice=f"loss: {1 - plan.ssim:g} L1 + {plan.ssim:g} (1 - SSIM)", reason="gaussians.ssim, or the preset's"),
        *explain_capture(plan, len(photos.views)),
        background,
        *explain_gains(plan, exposures),
        *[MOTIONS][: plan.poses],
        explain_time(minutes),
        PlanLine(choice=memory, reason="estimated before the allocation"),
    ]


def explain_capture(plan: GaussianPlan, photographs: int) -> list[PlanLine]:
    """Return the choices for a capture: the degree by the number of photographs, and the largest Gaussian."""
    why = (
        "the preset's" if photographs >= FEW_PHOTOGRAPHS else f"fewer than {FEW_PHOTOGRAPHS} photographs overfit higher degrees"
    )
    lines = [
        PlanLine(choice=f"harmonics of degree {plan.degree}", reason=why),
        PlanLine(
            choice=f"no scale above {plan.largest:g} of the cameras' extent, or of a Gaussian's distance from their middle",
            reason="larger ones cover other photographs; sky and walls far away need large ones",
        ),
    ]
    return lines[: 2 if plan.control == "clone_split" else 1] if plan.reach else []


# -- First Gaussians -------------------------------------------------------------------------------------------------------


OPACITY = 0.1
ROUNDS = 60
"""Maximum number of rounds; each draws as many points as requested, of which alpha rejects some."""

SHARE = 0.5
"""Share of the views whose images must contain a point."""


def find_start_points(photos: Photos, count: int, seed: int, has_surroundings: bool = False) -> tuple[np.ndarray, str]:
    """Initial positions (N, 3) [length], and a description of their source.

    The points of a reconstruction in the box, if it has enough; otherwise ``count`` random points in the box. With alpha, the
    random points avoid places that are transparent in some view. With surroundings, all points of the reconstruction are used,
    and ``count`` more points stand along random rays of the photographs, for what has no reconstructed points.

    Raises:
        MivolError: alpha leaves no part of the box.
    """
    rng = np.random.default_rng((seed, 1))
    points = photos.survey.points
    if points is not None and len(points) >= FEWEST_POINTS:
        places = points if has_surroundings else points_in_box(points, photos.box)
        whence = f"{len(places)} points of the reconstruction" + " in the box" * (not has_surroundings)
    elif any(view.alpha is None for view in photos.views):
        places, whence = rng.uniform(*photos.box, (count, 3)), f"{count} random points in the box"
    else:
        return _draw_matter(photos, count, rng)
    if not has_surroundings:
        return places, whence
    around = draw_surroundings(photos, count, rng)
    return np.concatenate([places, around]), f"{whence}, {len(around)} along random rays of the photographs"


def _draw_matter(photos: Photos, count: int, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Random points in the box that no view shows as transparent."""
    accepted = [np.zeros((0, 3))]
    for _ in range(ROUNDS):
        drawn = rng.uniform(*photos.box, (count, 3))
        accepted.append(drawn[_may_be_matter(photos.views, drawn)])
        if sum(map(len, accepted)) >= count:
            break
    points = np.concatenate(accepted)[:count]
    if len(points) < 4:
        raise MivolError("alpha leaves no part of the box that all views show as matter: check the box and the cameras.")
    return points, f"{len(points)} random points that no view shows as transparent"


SURROUNDINGS = 0.5, 8.0
"""Distances of random points from the photographs, with evenly distributed logarithms [median distance of the cameras]."""


def draw_surroundings(photos: Photos, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random points (N, 3) along rays of the photographs [length]; at most ``count``, outside free space."""
    cameras = [view.camera for view in photos.views]
    reach = viewing_distance(cameras, photos.box)
    chosen = rng.integers(0, len(cameras), count)
    places, distances = rng.uniform(0, 1, (count, 2)), np.exp(rng.uniform(*np.log(SURROUNDINGS), count))
    drawn = []
    for number, camera in enumerate(cameras):
        o, d = rays(camera, places[chosen == number] * camera.size)
        drawn.append(o + reach * distances[chosen == number, None] * d)
    points = np.concatenate(drawn)
    return points[~is_free_space(cameras, points, reach)]


BACKGROUND, DIRECTIONS, BACKGROUND_OPACITY = 9.0, 1600, 0.9
"""Gaussians behind everything: their distance from the cameras [extent], their number for all directions,
and their initial opacity."""


def make_background_cloud(views: Sequence[Photo], degree: int) -> CloudArrays:
    """Large Gaussians on a sphere around the cameras, in the directions that photographs see, with their mean colour.

    They show what lies behind all points: sky, walls, windows. Their scale is 0.7 of their distance from each other, so that
    they cover the sphere.

    Args:
        views: photographs.
        degree: of the harmonics.
    """
    cameras = [view.camera for view in views]
    # A spiral of equal steps along the axis has a point for each equal area of the sphere.
    index = np.arange(DIRECTIONS) + 0.5
    polar, turn = np.arccos(1 - 2 * index / DIRECTIONS), math.pi * (1 + math.sqrt(5)) * index
    unit = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    radius = BACKGROUND * scene_extent(cameras)
    places = np.mean([camera.origin for camera in cameras], axis=0) + radius * unit
    places = places[count_views(cameras, places) > 0]
    apart = radius * math.sqrt(4 * math.pi / DIRECTIONS)
    return _round_cloud(places, np.full(len(places), 0.7 * apart), BACKGROUND_OPACITY, views, degree)


def make_start_cloud(places: np.ndarray, views: Sequence[Photo], degree: int) -> CloudArrays:
    """Round Gaussians of opacity 0.1, scaled by the distances of three neighbours, with the mean colour of the views.

    Args:
        places: (N, 3), at least 4 positions [length].
        views: photographs for the colours.
        degree: of the harmonics.

    Raises:
        MivolError: fewer than 4 positions.
    """
    if len(places) < 4:
        raise MivolError(f"found {len(places)} initial points, expected at least 4 to derive the scales: give more points.")
    far = cKDTree(places).query(places, k=4)[0][:, 1:]
    # Coincident points would have no size, and no derivative of the size.
    scale = np.maximum(np.sqrt((far**2).mean(axis=1)), 1e-3 * np.median(far))
    return _round_cloud(places, scale, OPACITY, views, degree)


def _round_cloud(places: np.ndarray, scale: np.ndarray, opacity: float, views: Sequence[Photo], degree: int) -> CloudArrays:
    """Round Gaussians at places (N, 3), of scales (N,) [length] and one opacity, with the mean colour of the views."""
    harmonics = np.zeros((len(places), (degree + 1) ** 2, 3), np.float32)
    harmonics[:, 0] = to_base_harmonics(_mean_colour(views, places))
    quaternions = np.zeros((len(places), 4), np.float32)
    quaternions[:, 0] = 1
    return {
        "means": places.astype(np.float32),
        "log_scales": np.repeat(np.log(scale)[:, None], 3, axis=1).astype(np.float32),
        "quaternions": quaternions,
        "opacity_logits": np.full(len(places), logit(opacity), np.float32),
        "harmonics": harmonics,
    }


def _may_be_matter(views: Sequence[Photo], points: np.ndarray) -> np.ndarray:
    """Whether enough views contain each point (N, 3), and no view shows the point as transparent."""
    accepted = count_views([view.camera for view in views], points) >= SHARE * len(views)
    for view in views:
        visible, row, column = _look_up(view, points)
        accepted &= ~visible | (view.alpha[row, column] > 0)
    return accepted


def _mean_colour(views: Sequence[Photo], points: np.ndarray) -> np.ndarray:
    """(N, 3) mean colour over the views containing a point; grey without such views. Occlusion is ignored."""
    total, count = np.full((len(points), 3), 0.5), np.ones(len(points))
    for view in views:
        visible, row, column = _look_up(view, points)
        total[visible] += view.image[row, column][visible]
        count += visible
    return total / count[:, None]


def _look_up(view: Photo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a view contains points, and the pixel of each point (0, 0 outside the view)."""
    x, depth = project(view.camera, points)
    with np.errstate(invalid="ignore"):
        visible = (depth > 0) & ((x >= 0) & (x < view.camera.size)).all(axis=1)
    column, row = np.where(visible[:, None], x, 0).astype(int).T
    return visible, row, column
