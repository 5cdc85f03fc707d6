"""A fit of a radiance field to photographs.

Conventions. The loss in ``metrics.jsonl`` is the mean squared error of a step's rays. ``field.npz`` is the field, ``sky.exr``
the fitted sky, and ``volumes/`` has the density for other programs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mivol.config import FieldExperiment
from mivol.experiments.field_plan import adapt_plan, explain_plan, make_batches, make_plan
from mivol.experiments.fit_kind import Say
from mivol.experiments.photo_fit import PhotoFit
from mivol.experiments.run_folder import BestFiles, RunFolder
from mivol.fields.field_files import write_field
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_exr, write_png, write_volume
from mivol.optim.photographs.field_view import FieldView, render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Camera, Photo, Photos
from mivol.photos.photo_file import CONVERSIONS, decode_srgb
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

    def make_plan(self, settings: FieldExperiment) -> RadiancePlan:
        return make_plan(settings)

    def describe_run(self) -> dict[str, Any]:
        preset = self.settings.field.preset
        return {
            "method": f"a sparse grid of density and spherical harmonics, fitted to photographs; preset {preset}",
            "seeds": {"fit": self.settings.seed},
            "units": {"loss": "1"},
            "citations": ["mitsuba3", "drjit", "plenoxels_2022", "relu_fields_2022", "max_1995"],
        }

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
        return BestFiles(names, lambda folder: write_result(folder, self.problem, "_best", self.photos.white))

    def judge(self, photo: Photo, metrics: tuple[str, ...]) -> tuple[FieldView, ImageScore]:
        return judge_view(self.problem, self.judged, photo, metrics)

    def film_frame(self, camera: Camera) -> NDArray:
        view = render_view(self.problem.field, camera, find_background(self.problem, self.photos.views[0]))
        return CONVERSIONS[self.photos.space, "srgb"](view.image)

    def write_model(self, run: RunFolder) -> dict[str, float]:
        run.make("volumes")
        field, record = self.problem.field, self.record
        write_result(run.path, self.problem, white=self.photos.white)
        record.tables = [tabulate_storage(field, run.path / "field.npz")]
        record.volumes += [write_density(run.path, field.extract_level(number), number) for number in range(field.levels)]
        self.levels = field.levels
        return {"nodes": float(field.rows - (field.nodes is not None)), "bytes": field.bytes / 2**20}

    def gains(self) -> NDArray | None:
        return self.problem.exposure.table() if self.problem.has_gains else None

    def write_first_view(self, run: RunFolder, view: FieldView, photo: Photo) -> list[Image]:
        return write_geometry(run.path, view, photo.camera, self.judged.near_far)


def write_result(folder: Path, problem: RadianceProblem, which: str = "", white: float = 1.0) -> None:
    """Write the field of a problem, and the fitted sky if present.

    Args:
        folder, problem, which: folder, problem, and a suffix of the file names.
        white: factor on the colours: the radiance of the value 1 in the fit.
    """
    write_field(folder / f"field{which}.npz", problem.field.scale_colours(white))
    if problem.sky is not None:
        write_exr(folder / f"sky{which}.exr", {"": white * problem.sky.image()})


def judge_view(
    problem: RadianceProblem, judged: Photos, photo: Photo, metrics: tuple[str, ...]
) -> tuple[FieldView, ImageScore]:
    """Render a photograph's view of the field; return the view and the errors."""
    view = render_view(problem.field, photo.camera, find_background(problem, photo))
    return view, score_image(view.image, photo.image, space=judged.space, mask=photo.mask, metrics=metrics, name=photo.name)


def find_background(problem: RadianceProblem, photo: Photo) -> NDArray | Sky:
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
        caption = f"{name} of the first judged view: {scale}"
        written.append(Image(path=f"views/{name}.png", role="picture", caption=caption))
    return written
