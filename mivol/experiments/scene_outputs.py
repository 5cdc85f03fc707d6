"""What a fit of a scene leaves in its folder: each view beside its reference, volumes, images, curves and results.

Conventions. ``views/`` has one OpenEXR file a view, with the layers ``reference`` and ``standard_error`` (of their difference,
where that of the reference is known) beside the render, and PNGs; ``volumes/`` has ``.vol`` and ``.npz``; ``images/`` has
textures and skies that were looked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.config import SceneExperiment, Sought
from mivol.experiments.camera_pictures import pictures_of_views
from mivol.experiments.film import film_of_volume
from mivol.experiments.references import References
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.start import edges_of, place_of, unit_of
from mivol.files import write_exr, write_png, write_volume
from mivol.optim.loop import Fit
from mivol.optim.parameters import GRID
from mivol.optim.scenes.views import FINAL, View, derive_seed
from mivol.report.record import Image, Volume
from mivol.validate.moments import BATCHES, Moments


@dataclass(frozen=True)
class SceneOutputs:
    """What is written of a fit of a scene.

    Attributes:
        chosen: the experiment's settings.
        run: where it is written, and the record that lists it.
        fit: the fit, done.
        seen: the references.
        truth: the true volume, where known.
        best: the best iterate, where it is not the last.
    """

    chosen: SceneExperiment
    run: RunFolder
    fit: Fit
    seen: References
    truth: np.ndarray | None
    best: BestIterate

    def write(self) -> None:
        """Write images, volumes and curves, and put them and the results on record."""
        record, fit = self.run.record, self.fit
        self.run.make("views", "volumes")
        for number, view in enumerate((*self.seen.fitted, *self.seen.held_out)):
            record.images += self.write_view(view, number)
        for sought in self.chosen.parameter:
            record.volumes += self.write_grid(sought)
            record.images += self.write_image(sought.key)
        views = {"train": self.seen.fitted, "held_out": self.seen.held_out}
        record.images += pictures_of_views(self.run.path, fit.problem.scene, views)
        self.run.write_curves()
        record.results = {
            **fit.latest_errors(),
            "loss": fit.history[-1]["loss"],
            "iterations": float(fit.next_iteration),
            "views": float(len(self.seen.fitted)),
            "fit_seconds": fit.seconds,
        }

    def render_last(self, view: View, number: int) -> tuple[np.ndarray, np.ndarray | None]:
        """The render of a view, and the standard error of its difference from the reference; None where only one is known.

        The render's own noise counts: where no path of the reference saw a light that the render did see, at the edge of
        what is lit, it is the larger part. It is known from ``BATCHES`` renders of a sample or more.
        """
        render, spp = self.fit.problem.render, self.chosen.fit.spp_shown or self.chosen.fit.spp
        seed, error = (self.chosen.seed, 0, number, FINAL), self.seen.standard_errors.get(view.name)
        if error is None:
            return np.asarray(render(view.sensor, derive_seed(*seed), spp)), None
        share = math.ceil(spp / BATCHES)
        batches = Moments.of_each(render(view.sensor, derive_seed(*seed, batch), share) for batch in range(BATCHES))
        return batches.mean.astype(np.float32), np.sqrt(np.square(error) + batches.variance_of_mean).astype(np.float32)

    def write_view(self, view: View, number: int) -> list[Image]:
        """One view: the render beside its reference."""
        stem = f"views/{view.name.replace(' ', '_')}"
        image, error = self.render_last(view, number)
        reference = np.asarray(view.reference)
        parts = {"render": ("", image), "reference": ("reference", reference)}
        if error is not None:
            parts["standard error"] = "standard_error", error
        planes = {key: plane for part in parts.values() for key, plane in named(*part).items()}
        write_exr(self.run.path / f"{stem}.exr", planes)
        write_png(self.run.path / f"{stem}.png", image)
        write_png(self.run.path / f"{stem}_reference.png", reference)
        about = {"view": view.name, "held_out": any(view is other for other in self.seen.held_out)}
        return [Image(path=f"{stem}.exr", role=role, layer=layer_of(*part), **about) for role, part in parts.items()]

    def write_grid(self, sought: Sought) -> list[Volume]:
        """A parameter that is a grid, as .npz and .vol where it lies in the scene, and as a film; the truth beside it.

        A .vol has room for boxes along the axes only: of a turned grid it holds the unit cube, which the scene places.
        """
        value = np.asarray(self.fit.values()[sought.key])
        if value.ndim != GRID:
            return []
        place = place_of(sought.key, self.fit.problem.scene)
        is_along_axes = np.array_equal(place[:3, :3], np.diag(np.abs(np.diagonal(place)[:3])))
        quantity = next((word for word in ("sigma_t", "sigma_a", "sigma_s", "albedo") if word in sought.key), "value")
        grids = {"reconstruction": value}
        if self.truth is not None and self.chosen.truth.key == sought.key:
            grids["truth"] = self.truth
        found = []
        unit = unit_of(sought)
        for role, grid in grids.items():
            stem = f"volumes/{sought.key.replace('.', '_')}_{role}"
            write_volume(self.run.path / f"{stem}.vol", grid, place if is_along_axes else np.eye(4))
            write_volume(self.run.path / f"{stem}.npz", grid, place, metadata={"key": sought.key, "unit": unit})
            about = {"quantity": quantity, "unit": unit, "size": edges_of(place), "caption": sought.key}
            found.append(Volume(path=f"{stem}.npz", role=role, **about))
        self.run.record.images += film_of_volume(self.run, value, edges_of(place), "y", quantity)
        if not self.best.is_newest:
            stem = f"volumes/{sought.key.replace('.', '_')}_best"
            write_volume(self.run.path / f"{stem}.npz", self.best.read()[sought.key], place)
        return found

    def write_image(self, key: str) -> list[Image]:
        """A parameter that is an image (texture, sky), as .exr of linear values and .png.

        Mitsuba's ``envmap`` repeats a column at either side of what it was given, which another ``envmap`` would do again.
        """
        value = np.asarray(self.fit.values()[key])
        if value.ndim != 3 or value.shape[2] not in (1, 3):
            return []
        is_sky = mi.traverse(self.fit.problem.scene).properties[key][2].class_name() == "EnvironmentMapEmitter"
        image = value[:, 1:-1] if is_sky else value
        self.run.make("images")
        stem = f"images/{key.replace('.', '_')}"
        write_exr(self.run.path / f"{stem}.exr", named("", image))
        write_png(self.run.path / f"{stem}.png", image)
        return [Image(path=f"{stem}.png", role="picture", caption=f"{key} as found, in {stem}.exr")]


def named(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of an image (height, width, 1 or 3), as an OpenEXR layer."""
    return {layer: image} if image.shape[2] == 3 else {layer_of(layer, image): image[..., 0]}


def layer_of(layer: str, image: np.ndarray) -> str:
    """What a record calls a layer: single channels have a name of their own."""
    return layer if image.shape[2] == 3 else f"{layer}.Y".lstrip(".")
