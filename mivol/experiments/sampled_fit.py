"""A fit of a hash grid or a NeRF to photographs: the fit of a field, with another model and plan.

Conventions. As for :mod:`mivol.experiments.field_fit`; there is no sky, no gains, and no volume for other programs, which
``mivol convert FILE grid.npz --to grid`` makes.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from mivol.config import HashExperiment, NerfExperiment
from mivol.errors import MivolError
from mivol.experiments.field_fit import FieldFit, explain_wide_lenses, write_result
from mivol.experiments.photo_fit import explain_photos, explain_stop, explain_time
from mivol.experiments.run_folder import RunFolder
from mivol.fields.hash_grid import HashField
from mivol.fields.sampled_field import SampledField
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem, check_memory
from mivol.optim.strategy import suggest_name
from mivol.photos import Photos, rectify
from mivol.report.record import PlanLine, Table

METHODS = {"hash": "a hash grid with small networks", "nerf": "a coordinate network (NeRF)"}
"""The model of a fit, by the kind of the field."""

CITATIONS = {"hash": ["mueller_2022"], "nerf": ["nerf_2020", "mueller_2022"]}
"""Sources by the kind of the field; the map of occupied cells follows Müller et al."""


class SampledFit(FieldFit):
    """A fit of a field that is known at points."""

    settings: HashExperiment | NerfExperiment
    problem: SampledProblem
    steps = "traced in each step, because the number of samples changes"

    def make_plan(self, settings: HashExperiment | NerfExperiment) -> SampledPlan:
        return make_sampled_plan(settings)

    def describe_method(self) -> tuple[str, list[str]]:
        kind = self.settings.field.kind
        method = f"{METHODS[kind]}, fitted to photographs; preset {self.settings.field.preset}"
        return method, [*CITATIONS[kind], "kingma_2015", "max_1995"]

    def plan_fit(self) -> list[PlanLine]:
        self.batches = make_sampled_batches(self.photos)
        return explain_sampled_plan(self.plan, self.photos, self.batches)

    def make_problem(self) -> SampledProblem:
        return SampledProblem(self.batches, self.photos.box, self.plan, self.settings.seed)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        field = self.problem.field
        write_result(run.path, self.problem, white=self.photos.white, view=self.home_view)
        self.record.tables = [tabulate_field(field, (run.path / "field.npz").stat().st_size)]
        return {"numbers": float(field.numbers), "samples": self.problem.samples_a_ray}

    def gains(self) -> None:
        return None

    def motions(self) -> None:
        return None


def make_sampled_batches(photos: Photos) -> RayBatches:
    """The photographs in full size, undistorted if their lens has an image plane."""
    return RayBatches.from_photos([rectify(view) for view in photos.views], space=photos.space)


def make_sampled_problem(plan: SampledPlan, photos: Photos, seed: int) -> SampledProblem:
    """The fit of photographs with a box, before the first step."""
    return SampledProblem(make_sampled_batches(photos), photos.box, plan, seed)


def tabulate_field(field: SampledField, bytes_: int) -> Table:
    """Table of the parts and the size of a field, whose file has ``bytes_``."""
    head, rows = field.tabulate()
    occupied, noun = np.array(field.region.occupied).mean(), field.noun[0].upper() + field.noun[1:]
    title = f"{noun}: {field.numbers} numbers, file {bytes_ / 2**20:.2f} MiB, {occupied:.1%} of the cells occupied"
    return Table(title=title, head=head, rows=rows)


def make_sampled_plan(settings: HashExperiment | NerfExperiment) -> SampledPlan:
    """Return the preset of the settings, changed by the other settings.

    Raises:
        MivolError: an unknown preset, or sizes that contradict each other.
    """
    options = settings.field
    presets = PRESETS[options.kind]
    if options.preset not in presets:
        raise MivolError(f'field.preset = "{options.preset}" is unknown: {suggest_name(options.preset, list(presets))}')
    plan = presets[options.preset]

    def given(*names: str) -> dict[str, Any]:
        return {name: getattr(options, name) for name in names if getattr(options, name, None) is not None}

    sizes = replace(plan.sizes, **given(*(field.name for field in fields(plan.sizes))))
    steps = max(1, round(plan.steps * options.effort))
    return replace(plan, sizes=sizes, steps=steps, **given("samples", "cells", "precision"))


def explain_table(plan: SampledPlan, box: np.ndarray) -> list[PlanLine]:
    """Return the precision and the memory of the table of a hash grid; nothing of a NeRF."""
    if plan.model is not HashField:
        return []
    numbers = plan.sizes.count_numbers(box[1] - box[0]) - plan.sizes.weights
    half = plan.precision == "half"
    size = numbers * (2 if half else 4) / 2**20
    why = "the fit steps float32 values, and rounds them for rays" if half else 'field.precision = "half" takes half of it'
    return [PlanLine(choice=f"{plan.precision} precision: rays read a table of {size:.1f} MiB", reason=why)]


def explain_sampled_plan(plan: SampledPlan, photos: Photos, batches: RayBatches) -> list[PlanLine]:
    """Return the choices of a plan with their reasons; memory is checked before the allocation.

    Raises:
        MivolError: more memory than available.
    """
    box = photos.box
    model, numbers = plan.sizes.describe(box[1] - box[0])
    behind = "alpha marks the object" if photos.views[0].alpha is not None else "photos.background"
    most = plan.cells * plan.samples_a_cell
    spacing = f"{plan.samples_a_cell:g} along a cell of the map of occupied cells, with {plan.cells} cells an edge"
    why = f"{spacing}; the number of rays grows as the map empties"
    if first := getattr(plan.sizes, "coarse", 0):
        most = 2 * first + plan.sizes.fine
        why = f"the coarse network takes {first}, the fine one these and {plan.sizes.fine} more (field.coarse, field.fine)"
    return [
        explain_photos(photos),
        PlanLine(choice=model, reason=numbers),
        *explain_table(plan, box),
        PlanLine(
            choice=f"{plan.samples} samples a step, about {most:.0f} a ray at first",
            reason=why,
        ),
        PlanLine(choice=f"{plan.steps} steps", reason="the preset's, times field.effort"),
        explain_time(plan.minutes),
        PlanLine(choice="no field behind the box", reason=behind),
        *explain_wide_lenses(photos),
        explain_stop(plan.stop),
        PlanLine(choice=check_memory(plan, box, batches), reason="estimated before the allocation"),
    ]
