"""What a fit of photographs leaves in its folder: the field, judged views, distance and normals, a film, curves, results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.config import FieldFit
from mivol.experiments.camera_pictures import pictures_of_photos
from mivol.experiments.film import Film
from mivol.experiments.judged_views import JudgedViews, caption_of, said_of
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.task import Task
from mivol.fields.field_files import write_field
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_exr, write_png, write_volume
from mivol.optim.loop import Fit
from mivol.optim.photographs.field_view import FieldView, render_view
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Camera, Photo, Photos
from mivol.photos.photo_file import SPACES, decode_srgb
from mivol.report.pixel_scale import depth_pixels, normal_pixels, normals_from_depth
from mivol.report.record import Image, Table, Volume
from mivol.validate.images import METRICS, Quality, colour_fitted, judge, score


@dataclass(frozen=True)
class PhotoOutputs:
    """What is written of a fit of photographs.

    Attributes:
        task: the experiment.
        run: where it is written, and the record that lists it.
        fit: the fit, done.
        photos: what was fitted.
        judged: what it is judged by; None for nothing.
        film: where its camera goes.
    """

    task: Task
    run: RunFolder
    fit: Fit
    photos: Photos
    judged: Photos | None
    film: Film

    @property
    def problem(self) -> RadianceProblem:
        """The field that was found."""
        return self.fit.problem

    def write(self) -> None:
        """Write all, and put it and the results on record."""
        folder, record, field = self.run.path, self.run.record, self.problem.field
        self.run.make("views", "volumes", "film")
        save_found(folder, self.problem, white=self.photos.white)
        record.tables = [storage(field, folder / "field.npz")]
        if self.problem.has_gains:
            record.tables.append(table_of_gains([view.name for view in self.photos.views], self.problem.exposure.table()))
        record.volumes += [write_density(folder, field.extract_level(number), number) for number in range(field.levels)]
        record.results = {
            "views": float(len(self.photos.views)),
            "iterations": float(self.fit.next_iteration),
            "nodes": float(field.rows - (field.nodes is not None)),
            "bytes": field.bytes / 2**20,
        }
        if self.judged is not None:
            record.results |= self.write_judged()
        if self.film.cameras:
            record.images.append(self.write_film())
        record.images += pictures_of_photos(folder, self.photos, self.judged, field.levels)
        self.run.write_curves()

    def write_judged(self) -> dict[str, float]:
        """Judge all views, and keep them beside their photographs, with distance and normals of the first."""
        chosen: FieldFit = self.task.chosen
        views, found, geometry, fitted = self.judged.views, [], [], []
        pictures = JudgedViews(self.run.path, self.judged.space, len(views), chosen.show.views)
        for number, photo in enumerate(views):
            seen, quality = compare(self.problem, self.judged, photo, chosen.show.metrics)
            found.append(quality)
            fitted.append(judge_fitted(seen.image, photo, self.judged.space))
            psnr = quality.values.get("psnr", fitted[-1])
            pictures.add(photo, seen.image, psnr, caption_of(quality, fitted[-1]))
            if number == 0:
                geometry = write_geometry(self.run.path, seen, photo.camera, self.judged.near_far)
        self.run.record.images += [*pictures.images(), *geometry]
        self.run.record.judged = said_of(views)
        self.run.record.tables.append(table_of_views(views[0].camera, found, fitted))
        return named(score(found).values) | {"psnr_colour_fitted": float(np.mean(fitted))}

    def write_film(self) -> Image:
        """A camera's way through the field."""
        background = behind(self.problem, self.photos.views[0])
        to_codes = SPACES[self.photos.space, "srgb"]
        shown = lambda camera: to_codes(render_view(self.problem.field, camera, background).image)  # noqa: E731
        return self.film.write(self.run.path, shown, self.task.watcher)


def save_found(folder: Path, problem: RadianceProblem, which: str = "", white: float = 1.0) -> None:
    """The field that a problem holds, and its sky where there is one, with a word in their names.

    Args:
        folder, problem, which: where, what, and the word.
        white: by what colours are multiplied: the radiance for which 1 stood in the fit.
    """
    write_field(folder / f"field{which}.npz", problem.field.scale_colours(white))
    if problem.sky is not None:
        write_exr(folder / f"sky{which}.exr", {"": white * problem.sky.image()})


def compare(problem: RadianceProblem, judged: Photos, photo: Photo, metrics: tuple[str, ...]) -> tuple[FieldView, Quality]:
    """A photograph's view of the field, and how alike they are."""
    seen = render_view(problem.field, photo.camera, behind(problem, photo))
    asked = {"space": judged.space, "mask": photo.mask, "metrics": metrics, "name": photo.name}
    return seen, judge(seen.image, photo.image, **asked)


def judge_fitted(image: NDArray, photo: Photo, space: str) -> float:
    """PSNR [dB] of a view whose colours, as a screen shows them, were fitted to its photograph's."""
    shown, wanted = (SPACES[space, "srgb"](values) for values in (image, photo.image))
    return judge(colour_fitted(shown, wanted, photo.mask), wanted, mask=photo.mask).values["psnr"]


def table_of_views(camera: Camera, found: Sequence[Quality], fitted: Sequence[float] = ()) -> Table:
    """Every judged view with its own figures, the worst one first.

    Args:
        camera: of the first view, whose size is said.
        found: the metrics of each.
        fitted: PSNR [dB] of each with its colours fitted to the photograph's; none: it is not said.
    """
    metrics = list(found[0].values)
    head = ("view", *(METRICS[name].label for name in metrics))
    rows = [(one.name, *(f"{one.values[name]:.{METRICS[name].digits}f}" for name in metrics)) for one in found]
    if fitted:
        head += ("PSNR [dB], colours fitted to the photograph's",)
        rows = [(*row, f"{value:.2f}") for row, value in zip(rows, fitted, strict=True)]
    rows.sort(key=lambda row: float(row[1]))
    width, height = camera.size
    return Table(title=f"Judged views, at {width} x {height} pixels, the worst first", head=head, rows=tuple(rows))


def table_of_gains(names: Sequence[str], gains: NDArray) -> Table:
    """By what the field's colours were multiplied for each photograph (photographs, 3), those far from 1 first."""
    far = np.argsort(-np.abs(np.log(gains)).max(axis=1), kind="stable")
    rows = [(names[k], *(f"{gain:.3f}" for gain in gains[k])) for k in far]
    head = ("photograph", "red", "green", "blue")
    return Table(title="Gains of the photographs: exposure and white balance", head=head, rows=tuple(rows))


def named(values: dict[str, float]) -> dict[str, float]:
    """Metrics by the names of :data:`mivol.report.record.QUANTITIES`."""
    return {("held_out_psnr" if name == "psnr" else name): value for name, value in values.items()}


def behind(problem: RadianceProblem, photo: Photo) -> NDArray | Sky:
    """What a photograph shows where nothing is."""
    return photo.background if problem.sky is None else problem.sky


def storage(field: SphericalGrid, path: Path) -> Table:
    """What the field takes, beside grids of the same box that keep every node."""
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
    return Table(title="What it takes", head=head, rows=tuple(rows))


def write_density(folder: Path, field: SphericalGrid, level: int) -> Volume:
    """The extinction at the nodes of a level, as a grid that other programs read; the innermost has no number."""
    raw, _ = field.to_dense()
    name = f"volumes/density{f'-level-{level}' if level else ''}"
    sigma = np.array(field.activation_function.value_and_slope(type(field.density)(raw.ravel()))[0]).reshape(*field.res, 1)
    write_volume(folder / f"{name}.vol", sigma, field.to_world)
    write_volume(folder / f"{name}.npz", sigma, field.to_world)
    size = tuple(float(edge) for edge in np.abs(np.diag(field.to_world)[:3]))
    said = f"level {level}, of {2**level} times the extent" if level else ""
    return Volume(path=f"{name}.npz", role="reconstruction", size=size, caption=said)


def write_geometry(folder: Path, seen: FieldView, camera: Camera, near_far: tuple[float, float]) -> list[Image]:
    """Distance and normals of a view as colours."""
    near, far = near_far
    normals = normals_from_depth(seen.depth, camera)
    distances = f"from light, {near:.3g} [length], to dark, {far:.3g} [length]"
    pictures = {
        "distance": (depth_pixels(seen.depth, near_far, seen.opacity), distances),
        "normals": (normal_pixels(normals, seen.opacity), "x, y, z from -1 to 1 as red, green, blue"),
    }
    written = []
    for name, (pixels, scale) in pictures.items():
        write_png(folder / f"views/{name}.png", decode_srgb(pixels / 255))
        caption = f"{name} of the first judged view: {scale}"
        written.append(Image(path=f"views/{name}.png", role="picture", caption=caption))
    return written
