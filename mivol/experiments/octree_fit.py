"""A fit of an octree to photographs: the fit of a grid, a hash grid or a NeRF, its octree, and a fit of the leaves, in one run.

Conventions. As for :mod:`mivol.experiments.field_fit`; ``field.npz`` is the octree. ``stages/`` has the grid and its octree
before the fit of the leaves, each with its quality, time and size on the page. There is no sky and there are no gains.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mivol.config import OctreeExperiment, OctreeSettings, flatten_settings
from mivol.display import format_duration
from mivol.errors import MivolError
from mivol.experiments.field_conversion import describe_leaves, describe_speed
from mivol.experiments.field_fit import FieldFit, adapt_plan, explain_plan, make_batches, set_background, write_result
from mivol.experiments.fit_kind import Say
from mivol.experiments.run_folder import FIRST_CHECKPOINT, RunFolder
from mivol.experiments.sampled_fit import SampledFit, explain_sampled_plan, make_sampled_problem
from mivol.fields.field_files import read_field, write_field
from mivol.fields.octree import Octree
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_whole
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.octree_building import OctreeRecipe, build_octree, build_octree_of_points
from mivol.optim.photographs.octree_problem import LeafPlan, OctreePlan, OctreeProblem
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan
from mivol.optim.photographs.ray_batches import RayBatches, describe_size
from mivol.optim.photographs.sampled_problem import PRESETS as PRESETS_OF_NETWORKS
from mivol.optim.photographs.sampled_problem import SampledPlan
from mivol.photos import Photos
from mivol.report.record import PlanLine, Table
from mivol.scene.explain import Explanation
from mivol.validate.metrics import score_image

STAGES = "grid", "octree", "octree, its leaves fitted"
"""Names of the stages on the page."""

STAGE_ROWS = "stages.json"
"""File in ``stages/`` with the rows of the finished stages."""

NETWORKS = {"hash": "minute", "nerf": "minutes"}
"""Networks that ``field.start`` names, the first level of a template of two, and their presets without ``field.preset``."""

GRID_PRESET = "cpu"
"""Preset of the grid without ``field.preset``."""


AnyField = SphericalGrid | Octree | SampledField
"""A field at which an octree can begin."""


class OctreeFit(FieldFit):
    """A fit of an octree.

    Attributes:
        stage_rows: name, PSNR, time and size of each finished stage.
        network: the fitted hash grid or NeRF, if ``field.start`` asks for one.
        fitted: time of the fit of this network [s].
    """

    settings: OctreeExperiment
    problem: OctreeProblem
    network: SampledField | None = None
    fitted: float = 0.0
    steps = "of the grid recorded in the first step, then replayed; of the leaves traced in each step"

    def make_plan(self, settings: OctreeExperiment) -> OctreePlan:
        return make_octree_plan(settings)

    def describe_method(self) -> tuple[str, list[str]]:
        preset = find_preset(self.settings.field)
        start = self.settings.field.start or f"a grid, preset {preset}"
        if start in NETWORKS:
            start = f"a {make_network_plan(self.settings).model.noun}, preset {preset}"
        method = f"an octree of harmonics from {start}, its leaves fitted to photographs"
        return method, ["plenoctrees_2021", "plenoxels_2022", "max_1995"]

    def plan_fit(self) -> list[PlanLine]:
        self.plan, grid, self.batches = adapt_octree_plan(self.plan, find_preset(self.settings.field), self.photos)
        leaves = self.plan.leaves
        steps = PlanLine(
            choice=f"{leaves.steps} steps of the octree, {describe_size(leaves.shrink)}",
            reason=f"field.steps times field.effort; leaves stay in place; about {format_duration(60 * leaves.minutes)} more",
        )
        size = "half a voxel" if not self.plan.recipe.depth else f"a cube's edge over 2^{self.plan.recipe.depth}"
        built = PlanLine(
            choice=f"leaves of {size}, dropped if they weigh below {self.plan.recipe.keep_weight:g} in every pixel",
            reason=f"field.keep_weight; eight become one if no pixel changes by more than {self.plan.recipe.tolerance:g}",
        )
        if self.plan.grid is None:
            self.steps = SampledFit.steps
            first = [PlanLine(choice=f"begins at {self.settings.field.start}", reason="field.start")]
            if self.settings.field.start in NETWORKS:
                first = explain_sampled_plan(make_network_plan(self.settings), self.photos, self.batches)
            return [*first, built, steps]
        return [*explain_plan(grid, self.photos, self.batches), built, steps]

    def render_data(self, run: RunFolder) -> None:
        """Fit the hash grid or the NeRF at which the octree begins; a resumed run reads it, or goes on with its fit."""
        self.stage_rows: list[tuple[str, ...]] = []
        self.clock = 0.0
        if self.settings.field.start not in NETWORKS:
            return
        run.make("stages")
        path, kept = run.path / "stages" / f"{self.settings.field.start}.npz", run.path / "stages" / STAGE_ROWS
        plan = make_network_plan(self.settings)
        if run.is_resumed and path.is_file() and kept.is_file():
            self.network = read_start(path, self.photos.space, self.photos.white)
            self.fitted = float(json.loads(kept.read_text())[0][-1])
            self.record.timings[plan.model.noun] = self.fitted
            return
        with run.stage(plan.model.noun):
            self.fit_network(run, plan, path)

    def fit_network(self, run: RunFolder, plan: SampledPlan, path: Path) -> None:
        """Fit the hash grid or the NeRF, and write it to ``path``."""
        problem = make_sampled_problem(plan, self.photos, self.settings.seed)
        first, fingerprint = run.path / FIRST_CHECKPOINT, flatten_settings(run.record.config)
        fingerprint["photos"] = problem.batches.digest()
        store = CheckpointFile(first, fingerprint, run.is_resumed and first.is_file())
        course = plan.course(Checkpoint(every=self.settings.checkpoint_every))
        fit = begin_fit(problem, plan.optimizer, course, checkpoint=store)
        with self.context.progress.watch(plan.steps) as show:
            fit.complete(show)
        self.clock = self.fitted = fit.seconds
        write_field(path, problem.field.scale_colours(self.photos.white), view=self.home_view)
        self.network = read_start(path, self.photos.space, self.photos.white)
        self.add_stage(run, self.network.noun, self.network, path)
        cells = np.array(self.network.region.occupied)
        count, size = f"{int(cells.sum())} of {len(cells)} cells", f"{len(cells) / 8 / 2**20:.3g}"
        self.stage_rows.append(("its occupied cells", count, "-", "-", size, f"{self.clock:.0f}"))

    def make_problem(self) -> OctreeProblem:
        self.built, self.start = 0.0, self.network
        box, plan = self.photos.box, self.plan
        if plan.grid is not None:
            return OctreeProblem(self.batches, box, plan, self.settings.seed)
        if self.start is None:
            path = self.context.base / self.settings.field.start
            if not path.exists():
                raise MivolError(f'field.start: found no file {path}, expected a field (.npz), "hash" or "nerf": give one.')
            self.start = read_start(path, self.photos.space, self.photos.white)
        begun = time.perf_counter()
        if isinstance(self.start, Octree):
            tree = self.start
        elif isinstance(self.start, SampledField):
            degree = 2 if self.settings.field.degree is None else self.settings.field.degree
            tree = build_octree_of_points(self.start, self._view_rays, plan.recipe, degree)
        else:
            tree = build_octree(self.start, self._view_rays, plan.recipe)
        self.built = self.fitted + time.perf_counter() - begun
        return OctreeProblem(self.batches, box, plan, self.settings.seed, tree)

    def _view_rays(self) -> Any:
        return (self.batches.all_pixels(self.plan.leaves.shrink, v).rays for v in range(len(self.batches.origins)))

    def prepare(self, run: RunFolder) -> None:
        run.make("stages")

        def report(name: str, field: SphericalGrid | Octree) -> str:
            return self.add_stage(run, name, field)

        self.problem.report = report
        kept = run.path / "stages" / STAGE_ROWS
        if run.is_resumed and kept.is_file():
            self.stage_rows = [tuple(row) for row in json.loads(kept.read_text())]
        elif self.start is not None:
            if isinstance(self.start, SphericalGrid):
                self.add_stage(run, STAGES[0], self.start)
            elif isinstance(self.start, SampledField) and self.network is None:
                self.add_stage(run, self.start.noun, self.start)
            self.clock = self.built
            self.add_stage(run, STAGES[1], self.problem.tree)

    def finish(self, fit: Fit, run: RunFolder) -> None:
        super().finish(fit, run)
        (run.path / FIRST_CHECKPOINT).unlink(missing_ok=True)

    def add_stage(self, run: RunFolder, name: str, field: AnyField, path: Any = None) -> str:
        """Write the field of a stage, and note its quality, time and size; returns a clause for the log."""
        if path is None:
            path = run.path / "stages" / f"{name}.npz"
            write_field(path, field.scale_colours(self.photos.white), view=self.home_view)
        written = read_field(path)  # as it is read: rounded values
        count = describe_parts(field)
        psnr = self.mean_psnr(written.scale_colours(1 / self.photos.white))
        size = path.stat().st_size
        held = 4 * field.numbers if isinstance(field, SampledField) else field.bytes
        quality = "-" if psnr is None else f"{psnr:.2f}"
        self.stage_rows.append((name, count, quality, f"{size / 2**20:.2f}", f"{held / 2**20:.3g}", f"{self.clock:.0f}"))
        write_whole(run.path / "stages" / STAGE_ROWS, lambda file: file.write(json.dumps(self.stage_rows).encode()))
        return f"{name}: {quality} dB, {count}, a file of {size / 2**20:.2f} MiB, after {self.clock:.0f} s"

    def mean_psnr(self, field: AnyField) -> float | None:
        """Mean PSNR [dB] of the judged views; None without such views."""
        if self.judged is None:
            return None
        scores: list[float] = []
        for photo in self.judged.views:
            image = render_view(field, photo.camera, photo.background).image
            score = score_image(image, photo.image, space=self.judged.space, mask=photo.mask, metrics=("psnr",))
            scores.append(score.values["psnr"])
        return float(np.mean(scores))

    def after_step(self, fit: Fit, run: RunFolder, best: Any) -> None:
        self.clock = self.built + fit.seconds
        super().after_step(fit, run, best)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        tree = self.problem.tree
        write_result(run.path, self.problem, white=self.photos.white, view=self.home_view)
        self.add_stage(run, STAGES[2], tree, run.path / "field.npz")
        self.record.tables = [tabulate_stages(self.stage_rows, tree)]
        grid = run.path / "stages" / f"{STAGES[0]}.npz"
        if grid.is_file():
            self.record.notes.append(f"Speed: {describe_speed(tree, read_field(grid), 'the grid')}.")
        return {"leaves": float(tree.leaves), "bytes": tree.bytes / 2**20}

    def gains(self) -> None:
        return None

    def motions(self) -> None:
        return None

    def rehearse(self, say: Say) -> Explanation:
        if self.settings.field.start not in NETWORKS:
            return super().rehearse(say)
        plan = make_network_plan(self.settings)
        plan.optimizer.begin(make_sampled_problem(plan, self.photos, self.settings.seed))
        return Explanation(())


def describe_parts(field: AnyField) -> str:
    """Leaves, nodes or numbers of a field, with the word."""
    if isinstance(field, Octree):
        return f"{field.leaves} leaves"
    return f"{field.numbers} numbers" if isinstance(field, SampledField) else f"{len(field.stored_nodes())} nodes"


def find_preset(options: OctreeSettings) -> str:
    """The preset of the fit's first model: of the network that ``field.start`` names, or of the grid.

    Raises:
        MivolError: an unknown preset.
    """
    preset = options.preset or NETWORKS.get(options.start, GRID_PRESET)
    known = PRESETS_OF_NETWORKS.get(options.start, PRESETS)
    if preset not in known:
        model = f"{options.start} network" if options.start in NETWORKS else "grid"
        raise MivolError(f'field.preset = "{preset}" is no preset of the {model}: choose one of {", ".join(known)}.')
    return preset


def make_network_plan(settings: OctreeExperiment) -> SampledPlan:
    """The plan of the hash grid or the NeRF that ``field.start`` names."""
    plan = PRESETS_OF_NETWORKS[settings.field.start][find_preset(settings.field)]
    return replace(plan, steps=max(1, round(plan.steps * settings.field.effort)))


def adapt_octree_plan(plan: OctreePlan, preset: str, photos: Photos) -> tuple[OctreePlan, RadiancePlan, RayBatches]:
    """Adapt a plan to the photographs.

    Returns:
        The plan; the plan of its grid, or of a grid of the preset for a plan that begins at a field; and the photographs.
        Presets that only networks have take the grid of ``GRID_PRESET``.
    """
    grid = adapt_plan(plan.grid or PRESETS.get(preset, PRESETS[GRID_PRESET]), photos)
    last = grid.stages[-1]
    leaves = replace(plan.leaves, shrink=last.shrink, views=last.views, tiles=last.tiles, matte=grid.matte)
    stages = (*(grid.stages if plan.grid else ()), last)
    batches = make_batches(replace(grid, stages=stages), photos)
    return replace(plan, grid=grid if plan.grid else None, leaves=leaves), grid, batches


def tabulate_stages(rows: list[tuple[str, ...]], tree: Octree) -> Table:
    """Table of the finished stages of a run."""
    head = ("stage", "size", "PSNR of the held-out views, from the file [dB]", "file [MiB]", "memory [MiB]", "time [s]")
    return Table(title=f"Stages of the octree ({describe_leaves(tree)})", head=head, rows=tuple(rows))


def read_start(path: Any, space: str, white: float) -> AnyField:
    """Read the field at which a fit begins.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`, nested levels, or colours of another space.
    """
    field = read_field(path)
    if field.space != space:
        raise MivolError(
            f"{path} has colours in {field.space} and the photographs are {space}: set photos.space to the field's."
        )
    return field.scale_colours(1 / white)


def make_octree_plan(settings: OctreeExperiment) -> OctreePlan:
    """Return the plan of the settings.

    Raises:
        MivolError: an unknown preset, or one with nested boxes or a fitted background.
    """
    options = settings.field
    grid = set_background(PRESETS.get(find_preset(options), PRESETS[GRID_PRESET]), settings.photos.background)
    if grid.levels > 1 or grid.sky:
        raise MivolError(
            "an octree has one box and a known background, and nested boxes or a fitted sky were asked for: "
            "choose preset cpu and a colour for photos.background."
        )
    stages = tuple(replace(stage, steps=max(1, round(stage.steps * options.effort))) for stage in grid.stages)
    grid = replace(grid, stages=stages, epochs=grid.epochs * options.effort)
    if options.degree is not None:
        grid = replace(grid, degree=options.degree, few_degree=None)
    if options.longest is not None:
        grid = replace(grid.with_longest(options.longest), cubic=False)
    recipe = OctreeRecipe(options.depth or 0, options.keep_weight, options.tolerance)
    leaves = LeafPlan(steps=max(1, math.ceil(options.steps * options.effort)))
    return OctreePlan(None if options.start else grid, recipe, leaves, grid.random_background)
