"""A fit of a hash grid to photographs: the fit of a field, with another model and plan.

Conventions. As for :mod:`mivol.experiments.field_fit`; there is no sky, no gains, and no volume for other programs, which
``mivol convert FILE grid.npz --to grid`` makes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from mivol.config import HashExperiment
from mivol.errors import MivolError
from mivol.experiments.field_fit import FieldFit, explain_wide_lenses, write_result
from mivol.experiments.run_folder import RunFolder
from mivol.fields.hash_grid import HashField
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem, check_memory
from mivol.optim.strategy import suggest_name
from mivol.photos import Photos, rectify
from mivol.report.record import PlanLine, Table


class HashFit(FieldFit):
    """A fit of a hash grid with small networks."""

    settings: HashExperiment
    problem: SampledProblem

    def make_plan(self, settings: HashExperiment) -> SampledPlan:
        return make_hash_plan(settings)

    def describe_run(self) -> dict[str, Any]:
        return {
            "method": f"a hash grid with small networks, fitted to photographs; preset {self.settings.field.preset}",
            "seeds": {"fit": self.settings.seed},
            "units": {"loss": "1"},
            "citations": ["mitsuba3", "drjit", "mueller_2022", "kingma_2015", "max_1995"],
        }

    def plan_fit(self) -> list[PlanLine]:
        self.batches = make_hash_batches(self.photos)
        return explain_hash_plan(self.plan, self.photos, self.batches)

    def make_problem(self) -> SampledProblem:
        return SampledProblem(self.batches, self.photos.box, self.plan, self.settings.seed)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        field = self.problem.field
        write_result(run.path, self.problem, white=self.photos.white, view=self.home_view)
        self.record.tables = [tabulate_hash_grid(field, (run.path / "field.npz").stat().st_size)]
        return {"numbers": float(count_numbers(field)), "samples": self.problem.samples_a_ray}

    def gains(self) -> None:
        return None


def make_hash_batches(photos: Photos) -> RayBatches:
    """The photographs in full size, undistorted if their lens has an image plane."""
    return RayBatches.from_photos([rectify(view) for view in photos.views], space=photos.space)


def make_hash_problem(plan: SampledPlan, photos: Photos, seed: int = 0) -> SampledProblem:
    """The fit of photographs with a box, before its first step."""
    return SampledProblem(make_hash_batches(photos), photos.box, plan, seed)


def count_numbers(field: HashField) -> int:
    """Number of fitted numbers of a hash grid."""
    return sum(math.prod(shape) for shape in field.shapes().values())


def tabulate_hash_grid(field: HashField, bytes_: int) -> Table:
    """Table of the levels and the size of a hash grid, whose file has ``bytes_``."""
    rows = [
        (str(k), " x ".join(map(str, level.cells)), str(level.rows), "each node" if level.is_dense else "hashed")
        for k, level in enumerate(field.encoding.levels)
    ]
    occupied = np.array(field.region.occupied).mean()
    title = f"Hash grid: {count_numbers(field)} numbers, file {bytes_ / 2**20:.2f} MiB, {occupied:.1%} of the cells occupied"
    return Table(title=title, head=("level", "cells", "rows", "nodes"), rows=tuple(rows))


def make_hash_plan(settings: HashExperiment) -> SampledPlan:
    """Return the preset of the settings, changed by the other settings.

    Raises:
        MivolError: an unknown preset, or sizes that contradict each other.
    """
    options = settings.field
    if options.preset not in PRESETS:
        raise MivolError(f'field.preset = "{options.preset}" is unknown: {suggest_name(options.preset, list(PRESETS))}')
    plan = PRESETS[options.preset]

    def given(*names: str) -> dict[str, Any]:
        return {name: getattr(options, name) for name in names if getattr(options, name) is not None}

    sizes = replace(plan.sizes, **given("levels", "features", "log2_table", "coarsest", "finest", "width"))
    steps = max(1, round(plan.steps * options.effort))
    return replace(plan, sizes=sizes, steps=steps, **given("samples", "cells"))


def explain_hash_plan(plan: SampledPlan, photos: Photos, batches: RayBatches) -> list[PlanLine]:
    """Return the choices of a plan with their reasons; memory is checked before the allocation.

    Raises:
        MivolError: more memory than available.
    """
    box, sizes = photos.box, plan.sizes
    edges = " x ".join(f"{edge:.4g}" for edge in box[1] - box[0])
    levels = sizes.place_levels(box[1] - box[0])
    numbers = sum(level.rows for level in levels) * sizes.features
    weights = sizes.density_network.size + sizes.colour_network.size
    behind = "alpha marks the object" if photos.views[0].alpha is not None else "photos.background"
    most = plan.cells * plan.samples_a_cell
    return [
        PlanLine(choice=f"{len(photos.views)} photographs, a box of {edges} [length]", reason=photos.survey.box_from),
        PlanLine(
            choice=f"{sizes.levels} levels of {sizes.coarsest} to {sizes.finest} cells, {sizes.features} features each",
            reason=f"{numbers} numbers in at most {1 << sizes.log2_table} rows a level, and {weights} weights of networks",
        ),
        PlanLine(
            choice=f"{plan.samples} samples a step, about {most:.0f} a ray at first",
            reason=f"{plan.samples_a_cell:g} along a cell of the map of occupied space, {plan.cells} cells an edge; "
            "the number of rays grows as the map empties",
        ),
        PlanLine(choice=f"{plan.steps} steps", reason="field.effort"),
        PlanLine(choice="no field behind the box", reason=behind),
        *explain_wide_lenses(photos),
        PlanLine(choice=f"rays end at a transmittance of {plan.stop:g}", reason="largest neglected share of the light"),
        PlanLine(choice=check_memory(plan, box, batches), reason="estimated before the allocation"),
    ]
