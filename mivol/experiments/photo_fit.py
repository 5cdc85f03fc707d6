"""Common part of the fits of photographs to any model.

Conventions. ``metrics.jsonl`` has the loss of a step and, at some steps, the PSNR of a fixed set of judged views. Films are
``film/turntable.mp4``, or ``.webp`` without ffmpeg.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mivol.config import PhotoExperiment
from mivol.experiments.film import plan_film
from mivol.experiments.fit_kind import Evaluation, FitKind, RunContext, Say, Stages
from mivol.experiments.judged_views import (
    JudgedViews,
    describe_quality,
    describe_views,
    judge_colour_fitted,
    rename_metrics,
    tabulate_views,
)
from mivol.experiments.photo_data import add_box, describe_photos, read_photos
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Course, Fit
from mivol.optim.optimizer import Optimizer
from mivol.optim.photographs.field_view import FieldView
from mivol.photos import Camera, Photo
from mivol.photos.camera_path import HomeView, find_home_view
from mivol.report.cameras import draw_photo_cameras, plot_cameras, survey_all_cameras
from mivol.report.record import Image, PlanLine, Table
from mivol.scene.explain import Explanation
from mivol.validate.metrics import ImageScore, average_scores


class PhotoFit(FitKind):
    """A fit of a model to photographs.

    Attributes:
        plan: stages, steps and rates of the fit.
        photos: photographs to fit, with their box.
        judged: held-out photographs; may be None.
        film: cameras of the film.
        levels: nested boxes of the model.
        fits_colours: whether judged views also have a PSNR with their colours fitted to the photographs'.
    """

    stages = Stages("photographs", "fit", "images and volumes")
    levels: int = 1
    fits_colours: bool
    plan: Any
    settings: PhotoExperiment

    def __init__(self, context: RunContext) -> None:
        self.plan = self.make_plan(context.settings)
        super().__init__(context)

    @abstractmethod
    def make_plan(self, settings: Any) -> Any:
        """Return the preset of the settings, changed by the other settings.

        Raises:
            MivolError: an unknown preset.
        """

    @abstractmethod
    def plan_fit(self) -> list[PlanLine]:
        """Adapt the plan to the photographs; return the choices with reasons."""

    def load(self, say: Say) -> None:
        photos, self.judged = read_photos(self.settings, self.context.base)
        self.photos = add_box(self.settings, photos)
        say(self.photos.describe())
        say(f"  judged by {0 if self.judged is None else len(self.judged.views)} photographs")
        self.film = plan_film(self.settings.show, self.photos)
        for note in self.film.notes:
            say(f"  {note}")
        self.record.plan = self.plan_fit()
        self.record.notes = [*describe_photos(self.photos, self.judged), *self.film.notes]
        for line in self.record.plan:
            say(f"  {line.choice}: {line.reason}")

    @property
    def home_view(self) -> HomeView:
        """The first view that files of the model keep."""
        return find_home_view([view.camera for view in self.photos.views], self.photos.box)

    def announcement(self) -> list[str]:
        return [self.photos.describe(), *(f"{line.choice}: {line.reason}" for line in self.record.plan)]

    def optimizer(self) -> Optimizer:
        return self.plan.optimizer

    def course(self) -> Course:
        return self.plan.course(Checkpoint(every=self.settings.checkpoint_every))

    def digests(self) -> dict[str, str]:
        return {"photos": self.problem.batches.digest()}

    def evaluate(self, fit: Fit) -> Evaluation | None:
        if fit.next_iteration % self.settings.show.every and fit.next_iteration != self.plan.steps:
            return None
        self.problem.set_reals(fit.run.reals)
        return Evaluation(self.judge_few())

    def judge_few(self) -> dict[str, float]:
        """Return the mean PSNR [dB] of a fixed, evenly spread subset of the judged views.

        The name is ``held_out_psnr`` if the subset has all judged views, otherwise ``few_psnr``.
        """
        if self.judged is None:
            return {}
        views = self.judged.views
        count = min(self.settings.show.judged or len(views), len(views))
        numbers = np.linspace(0, len(views) - 1, count).round().astype(int)
        values = [self.judge(views[number], ("psnr",))[1].values["psnr"] for number in numbers]
        return {"held_out_psnr" if count == len(views) else "few_psnr": float(np.mean(values))}

    def finish(self, fit: Fit, run: RunFolder) -> None:
        self.record.notes += fit.log

    # -- Outputs ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def judge(self, photo: Photo, metrics: tuple[str, ...]) -> tuple[FieldView | NDArray, ImageScore]:
        """Return a photograph's view of the model, and the metrics between both."""

    @abstractmethod
    def film_frame(self, camera: Camera) -> NDArray:
        """Return a view of the model for the film: code values (H, W, 3)."""

    @abstractmethod
    def write_model(self, run: RunFolder) -> dict[str, float]:
        """Write the files of the model, and record tables and volumes; return results on the size of the model."""

    @abstractmethod
    def gains(self) -> NDArray | None:
        """Return the fitted gains of the photographs (photographs, 3); None without gains."""

    def rectified(self, photo: Photo) -> Photo:
        """Return the photograph to compare with a view of the model."""
        return photo

    def write_first_view(self, run: RunFolder, view: FieldView | NDArray, photo: Photo) -> list[Image]:
        """Write more images of the first judged view."""
        return []

    def write_outputs(self, fit: Fit, run: RunFolder, best: BestIterate) -> None:
        record = self.record
        run.make("views", "film")
        sizes = self.write_model(run)
        gains = self.gains()
        if gains is not None:
            record.tables.append(tabulate_gains([view.name for view in self.photos.views], gains))
        record.results = {"views": float(len(self.photos.views)), "iterations": float(fit.next_iteration), **sizes}
        if self.judged is not None:
            record.results |= self.write_judged(run)
        if self.film.cameras:
            record.images.append(self.film.write(run.path, self.film_frame, self.context.progress))
        record.images += draw_photo_cameras(run.path, self.photos, self.judged, self.levels)
        run.write_curves()

    def write_judged(self, run: RunFolder) -> dict[str, float]:
        """Judge all views, and write the views beside the photographs; return the means of the metrics."""
        views, space, show = self.judged.views, self.judged.space, self.settings.show
        qualities, fitted, first = [], [], []
        pictures = JudgedViews(run.path, space, len(views), show.views)
        for number, photo in enumerate(views):
            photo = self.rectified(photo)
            view, quality = self.judge(photo, show.metrics)
            image = view if isinstance(view, np.ndarray) else view.image
            qualities.append(quality)
            if self.fits_colours:
                fitted.append(judge_colour_fitted(image, photo, space))
            psnr = quality.values.get("psnr", fitted[-1] if fitted else next(iter(quality.values.values())))
            pictures.add(photo, image, psnr, describe_quality(quality, fitted[-1] if fitted else None))
            if number == 0:
                first = self.write_first_view(run, view, photo)
        self.record.images += [*pictures.images(), *first]
        self.record.judged = describe_views(views)
        self.record.tables.append(tabulate_views(views[0].camera, qualities, fitted))
        means = rename_metrics(average_scores(qualities).values)
        return means | ({"psnr_colour_fitted": float(np.mean(fitted))} if fitted else {})

    # -- Explain ---------------------------------------------------------------------------------------------------

    def rehearse(self, say: Say) -> Explanation:
        self.optimizer().begin(self.make_problem())
        return Explanation(())

    def draw_cameras(self, path: Path) -> None:
        """Draw the photographs' cameras and the boxes of the model into an image."""
        plot_cameras(survey_all_cameras(self.photos, self.judged, self.levels), path)


def tabulate_gains(names: Sequence[str], gains: NDArray) -> Table:
    """Table of the gains (photographs, 3) of the photographs, with the gains farthest from 1 first."""
    far = np.argsort(-np.abs(np.log(gains)).max(axis=1), kind="stable")
    rows = [(names[k], *(f"{gain:.3f}" for gain in gains[k])) for k in far]
    head = ("photograph", "red", "green", "blue")
    return Table(title="Gains of the photographs: exposure and white balance", head=head, rows=tuple(rows))
