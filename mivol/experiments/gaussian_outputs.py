"""What a fit of Gaussians leaves in its folder: the Gaussians, judged views, a film, curves, results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mivol.config import GaussianFit
from mivol.experiments.camera_pictures import pictures_of_photos
from mivol.experiments.film import Film
from mivol.experiments.judged_views import JudgedViews, caption_of, said_of
from mivol.experiments.photo_outputs import judge_fitted, named, table_of_gains, table_of_views
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.task import Task
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import Fit
from mivol.photos import Camera, Photo, Photos, rectify
from mivol.points import Gaussians, write_gaussians
from mivol.report.record import Image, Table
from mivol.validate.images import Quality, judge, score

__all__ = ["GaussianOutputs", "compare", "picture_of"]

FILE = "gaussians.ply"


@dataclass(frozen=True)
class GaussianOutputs:
    """What is written of a fit of Gaussians.

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
    def problem(self) -> GaussianProblem:
        """The Gaussians that were found."""
        return self.fit.problem

    def write(self) -> None:
        """Write all, and put it and the results on record."""
        record, found = self.run.record, Gaussians(**self.problem.cloud)
        self.run.make("views", "film")
        write_gaussians(self.run.path / FILE, found)
        record.tables = [storage(found, (self.run.path / FILE).stat().st_size)]
        if self.problem.exposure is not None:
            record.tables.append(table_of_gains([view.name for view in self.photos.views], self.problem.exposure.table()))
        record.results = {
            "views": float(len(self.photos.views)),
            "iterations": float(self.fit.next_iteration),
            "gaussians": float(found.count),
        }
        if self.judged is not None:
            record.results |= self.write_judged()
        if self.film.cameras:
            record.images.append(self.write_film())
        record.images += pictures_of_photos(self.run.path, self.photos, self.judged)
        self.run.write_curves()

    def write_judged(self) -> dict[str, float]:
        """Judge all views, and keep them beside their photographs."""
        chosen: GaussianFit = self.task.chosen
        views, found, fitted = self.judged.views, [], []
        pictures = JudgedViews(self.run.path, self.judged.space, len(views), chosen.show.views)
        for photo in views:
            seen, quality = compare(self.problem, self.judged, photo, chosen.show.metrics)
            found.append(quality)
            if self.problem.exposure is not None:
                fitted.append(judge_fitted(seen, rectify(photo), self.judged.space))
            pictures.add(rectify(photo), seen, next(iter(quality.values.values())), caption_of(quality))
        self.run.record.images += pictures.images()
        self.run.record.judged = said_of(views)
        self.run.record.tables.append(table_of_views(views[0].camera, found, fitted))
        return named(score(found).values) | ({"psnr_colour_fitted": float(np.mean(fitted))} if fitted else {})

    def write_film(self) -> Image:
        """A camera's way past the Gaussians."""
        behind, low_pass = self.photos.views[0].background, self.problem.plan.low_pass_at(self.film.shrink)
        shown = lambda camera: picture_of(self.problem, camera, behind, low_pass)  # noqa: E731
        return self.film.write(self.run.path, shown, self.task.watcher)


def compare(problem: GaussianProblem, judged: Photos, photo: Photo, metrics: tuple[str, ...]) -> tuple[NDArray, Quality]:
    """A photograph's view of the Gaussians (H, W, 3), and how alike they are; what a lens distorts is rectified first."""
    photo = rectify(photo)
    seen = picture_of(problem, photo.camera, photo.background, problem.plan.low_pass)
    return seen, judge(seen, photo.image, space=judged.space, mask=photo.mask, metrics=metrics, name=photo.name)


def picture_of(problem: GaussianProblem, camera: Camera, behind: NDArray, low_pass: float) -> NDArray:
    """What a pinhole sees of the Gaussians, (H, W, 3) over a colour (3,)."""
    splatter = problem.splatter_for(camera.size, low_pass)
    seen = np.array(splatter.forward(problem.values(), camera, derivatives=False)[0])
    return seen[..., :3] + (1 - seen[..., 3:]) * np.asarray(behind, np.float32)


def storage(found: Gaussians, bytes_: int) -> Table:
    """What the Gaussians take, and what they are like."""
    opacity, scale = found.opacities(), found.scales()
    rows = (
        ("Gaussians", f"{found.count}"),
        ("harmonics", f"degree {found.degree}"),
        ("file", f"{bytes_ / 2**20:.2f} MiB"),
        ("opacity: median", f"{np.median(opacity):.3g}"),
        ("longest axis: median [length]", f"{np.median(scale.max(axis=1)):.3g}"),
        ("longest over shortest axis: median", f"{np.median(scale.max(axis=1) / scale.min(axis=1)):.3g}"),
    )
    return Table(title="What was found", head=("", ""), rows=rows)
