"""The outputs of a scene fit: views beside their references, volumes, images, curves and results.

Conventions. ``views/`` has one OpenEXR file per view, with the layers ``reference`` and ``standard_error`` (of the difference,
if the reference's is known) beside the render, and PNGs. ``volumes/`` has ``.vol`` and ``.npz``. ``images/`` has fitted
textures and skies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mivol.config import SceneExperiment, Sought
from mivol.experiments.camera_pictures import draw_view_cameras
from mivol.experiments.film import film_of_volume
from mivol.experiments.references import References
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.start import box_edges, find_unit, grid_to_world
from mivol.files import write_exr, write_png, write_volume
from mivol.optim.loop import Fit
from mivol.optim.parameters import GRID
from mivol.optim.scenes.views import FINAL, View, derive_seed
from mivol.report.record import Image, Volume
from mivol.scene_graph import traverse
from mivol.validate.moments import BATCHES, Moments


@dataclass(frozen=True)
class SceneOutputs:
    """Outputs of a scene fit.

    Attributes:
        settings: settings of the experiment.
        run: run folder with the record.
        fit: the finished fit.
        references: the references.
        truth: true volume, if known.
        best: the best iterate.
    """

    settings: SceneExperiment
    run: RunFolder
    fit: Fit
    references: References
    truth: np.ndarray | None
    best: BestIterate

    def write(self) -> None:
        """Write images, volumes and curves, and record the files and the results."""
        record, fit = self.run.record, self.fit
        self.run.make("views", "volumes")
        for number, view in enumerate((*self.references.fitted, *self.references.held_out)):
            record.images += self.write_view(view, number)
        for parameter in self.settings.parameter:
            record.volumes += self.write_grid(parameter)
            record.images += self.write_image(parameter.key)
        views = {"train": self.references.fitted, "held_out": self.references.held_out}
        record.images += draw_view_cameras(self.run.path, fit.problem.scene, views)
        self.run.write_curves()
        record.results = {
            **fit.latest_errors(),
            "loss": fit.history[-1]["loss"],
            "iterations": float(fit.next_iteration),
            "views": float(len(self.references.fitted)),
            "fit_seconds": fit.seconds,
        }

    def render_last(self, view: View, number: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Render a view; return the image and the standard error of the difference from the reference, or None if the
        standard error of the reference is unknown.

        The render's own noise counts. At the edge of a lit region, the render may see light missed by the reference. The
        noise of the render is then the larger part. The estimate uses ``BATCHES`` renders of at least one sample.
        """
        render, spp = self.fit.problem.render, self.settings.fit.spp_shown or self.settings.fit.spp
        seed, error = (self.settings.seed, 0, number, FINAL), self.references.standard_errors.get(view.name)
        if error is None:
            return np.asarray(render(view.sensor, derive_seed(*seed), spp)), None
        share = math.ceil(spp / BATCHES)
        batches = Moments.from_batches(render(view.sensor, derive_seed(*seed, batch), share) for batch in range(BATCHES))
        return batches.mean.astype(np.float32), np.sqrt(np.square(error) + batches.variance_of_mean).astype(np.float32)

    def write_view(self, view: View, number: int) -> list[Image]:
        """Write a render beside the reference."""
        stem = f"views/{view.name.replace(' ', '_')}"
        image, error = self.render_last(view, number)
        reference = np.asarray(view.reference)
        parts = {"render": ("", image), "reference": ("reference", reference)}
        if error is not None:
            parts["standard error"] = "standard_error", error
        planes = {key: plane for part in parts.values() for key, plane in to_exr_layer(*part).items()}
        write_exr(self.run.path / f"{stem}.exr", planes)
        write_png(self.run.path / f"{stem}.png", image)
        write_png(self.run.path / f"{stem}_reference.png", reference)
        about = {"view": view.name, "held_out": any(view is other for other in self.references.held_out)}
        return [Image(path=f"{stem}.exr", role=role, layer=layer_name(*part), **about) for role, part in parts.items()]

    def write_grid(self, parameter: Sought) -> list[Volume]:
        """Write a fitted grid as .npz and .vol at the place in the scene, and as a film, and the truth if known.

        A .vol holds only boxes along the axes. For a rotated grid, the .vol has the unit cube; the scene has the transform.
        """
        value = np.asarray(self.fit.values()[parameter.key])
        if value.ndim != GRID:
            return []
        place = grid_to_world(parameter.key, self.fit.problem.scene)
        is_along_axes = np.array_equal(place[:3, :3], np.diag(np.abs(np.diagonal(place)[:3])))
        quantity = next((word for word in ("sigma_t", "sigma_a", "sigma_s", "albedo") if word in parameter.key), "value")
        grids = {"reconstruction": value}
        if self.truth is not None and self.settings.truth.key == parameter.key:
            grids["truth"] = self.truth
        volumes = []
        unit = find_unit(parameter)
        for role, grid in grids.items():
            stem = f"volumes/{parameter.key.replace('.', '_')}_{role}"
            write_volume(self.run.path / f"{stem}.vol", grid, place if is_along_axes else np.eye(4))
            write_volume(self.run.path / f"{stem}.npz", grid, place, metadata={"key": parameter.key, "unit": unit})
            about = {"quantity": quantity, "unit": unit, "size": box_edges(place), "caption": parameter.key}
            volumes.append(Volume(path=f"{stem}.npz", role=role, **about))
        self.run.record.images += film_of_volume(self.run, value, box_edges(place), "y", quantity)
        if not self.best.is_newest:
            stem = f"volumes/{parameter.key.replace('.', '_')}_best"
            write_volume(self.run.path / f"{stem}.npz", self.best.read()[parameter.key], place)
        return volumes

    def write_image(self, key: str) -> list[Image]:
        """Write a fitted image (texture, sky) as .exr of linear values and as .png.

        Mitsuba's ``envmap`` repeats a column at either side of the input. The output has no repeated columns, since another
        ``envmap`` would add new ones.
        """
        value = np.asarray(self.fit.values()[key])
        if value.ndim != 3 or value.shape[2] not in (1, 3):
            return []
        is_sky = traverse(self.fit.problem.scene).properties[key][2].class_name() == "EnvironmentMapEmitter"
        image = value[:, 1:-1] if is_sky else value
        self.run.make("images")
        stem = f"images/{key.replace('.', '_')}"
        write_exr(self.run.path / f"{stem}.exr", to_exr_layer("", image))
        write_png(self.run.path / f"{stem}.png", image)
        return [Image(path=f"{stem}.png", role="picture", caption=f"fitted {key}; linear values are in {stem}.exr")]


def to_exr_layer(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of an image (height, width, 1 or 3) as an OpenEXR layer."""
    return {layer: image} if image.shape[2] == 3 else {layer_name(layer, image): image[..., 0]}


def layer_name(layer: str, image: np.ndarray) -> str:
    """Name of a layer in the record; single channels have a name of their own."""
    return layer if image.shape[2] == 3 else f"{layer}.Y".lstrip(".")
