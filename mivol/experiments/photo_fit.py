"""Common part of the fits of photographs to any model, with the metrics, tables and images of held-out views.

Conventions. ``metrics.jsonl`` has the loss of a step and, at some steps, the PSNR of a fixed set of judged views. Films are
``film/turntable.mp4``, or ``.webp`` without ffmpeg.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mivol.config import PhotoExperiment
from mivol.display import format_duration
from mivol.experiments.film import plan_film
from mivol.experiments.fit_kind import Evaluation, FitKind, RunContext, Say, Stages
from mivol.experiments.photo_data import add_box, describe_photos, read_photos
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.files import write_png
from mivol.optim.events import Checkpoint
from mivol.optim.loop import Course, Fit
from mivol.optim.optimizer import Optimizer
from mivol.optim.photographs.field_view import FieldView
from mivol.photos import Camera, Photo, Photos
from mivol.photos.camera import align_camera
from mivol.photos.camera_path import HomeView, find_home_view
from mivol.photos.photo_file import CONVERSIONS
from mivol.photos.region import FEWEST_VIEWS, find_free_distances, viewing_distance
from mivol.report.cameras import draw_photo_cameras, plot_cameras, survey_all_cameras
from mivol.report.record import CODES, Image, PlanLine, Table
from mivol.scene.explain import Explanation
from mivol.threads import CallsAhead
from mivol.validate.metrics import METRICS, ImageScore, average_scores, fit_colours, score_image

MANY = 32
"""Number of judged views above which small images are smaller, to keep a page below about 20 MB."""

EDGES = 256, 128
"""Longest edge of a small image [pixel], for few and for many views."""


def select_shown_views(count: int, shown: int) -> frozenset[int]:
    """Indices of the views shown in full, from the first to the last view."""
    return frozenset(np.linspace(0, count - 1, min(shown, count)).astype(int).tolist())


def describe_quality(quality: ImageScore, fitted: float | None = None) -> str:
    """Caption of a view: metrics, and the PSNR [dB] after colour correction if given."""
    metrics = [format_metric(name, value) for name, value in quality.values.items()]
    return ", ".join(metrics if fitted is None else [*metrics, f"{fitted:.2f} dB after colour correction"])


def format_metric(metric: str, value: float) -> str:
    """Name, value and unit of a metric."""
    label, _, unit = METRICS[metric].label.partition(" [")
    return f"{label} {value:.{METRICS[metric].digits}f} {unit.rstrip(']')}".rstrip()


@dataclass
class JudgedViews:
    """Images of judged views, written view by view, each while the next is rendered.

    Attributes:
        folder: run folder.
        space: colour space of the photographs.
        count: number of judged views.
        shown: number of views in full beside the worst; 0 writes no images.
    """

    folder: Path
    space: str
    count: int
    shown: int
    _images: dict[int, Callable[[], list[Image]]] = field(default_factory=dict, init=False)
    _calls: CallsAhead = field(default_factory=CallsAhead, init=False)
    _psnr: dict[int, float] = field(default_factory=dict, init=False)
    _worst: tuple[Photo, int, NDArray, str] | None = field(default=None, init=False)

    def add(self, photo: Photo, image: NDArray, psnr: float, caption: str) -> None:
        """Add the next view.

        Args:
            photo: the photograph.
            image: the render (H, W, 3), in the photographs' colour space.
            psnr: PSNR [dB], which decides on the worst view.
            caption: caption of the view.
        """
        number = len(self._psnr)
        if self.shown:
            edge = None if number in select_shown_views(self.count, self.shown) else EDGES[self.count > MANY]
            given = self.folder, photo, number, image, self.space, caption, edge
            self._images[number] = self._calls.submit(write_view, *given).result
            if psnr < min(self._psnr.values(), default=np.inf):
                self._worst = photo, number, image, caption
        self._psnr[number] = psnr

    def images(self) -> list[Image]:
        """Return the written images for the record: the worst view in full, the other views in full, then the small views, the
        worst first."""
        if self._worst is None:
            return []
        photo, worst, image, caption = self._worst
        worst_caption = f"the worst of {self.count}: {caption}"
        images = {number: result() for number, result in self._images.items()}
        images[worst] = write_view(self.folder, photo, worst, image, self.space, worst_caption)
        whole = [n for n in sorted(select_shown_views(self.count, self.shown)) if n != worst]
        small = sorted(images.keys() - {worst, *whole}, key=self._psnr.__getitem__)
        return [one for number in (worst, *whole, *small) for one in images[number]]


def write_view(
    folder: Path, photo: Photo, number: int, image: NDArray, space: str = "srgb", caption: str = "", edge: int | None = None
) -> list[Image]:
    """Write a render beside the photograph, both tone-mapped for a screen.

    Args:
        folder, photo, number: run folder, photograph, and number in the file names.
        image: render (H, W, 3) in ``space``.
        space: colour space of both.
        caption: caption of the view.
        edge: longest edge of the written images [pixel], by means of squares of pixels; None means the full size.
    """
    written = []
    for role, values in {"render": image, "reference": photo.image}.items():
        path = f"views/{number:03d}_{role}.png"
        codes = CONVERSIONS[space, "srgb"](np.clip(values, 0, 1))
        write_png(folder / path, CONVERSIONS["srgb", "linear"](codes if edge is None else _shrunk(codes, edge)))
        text = caption if role == "render" else ""
        small = edge is not None
        written.append(Image(path=path, role=role, view=photo.name, held_out=True, quantity=CODES, caption=text, small=small))
    return written


def _shrunk(image: NDArray, edge: int) -> NDArray:
    """Means of squares of pixels, the smallest squares with a longest edge of at most ``edge``; incomplete squares are cut."""
    step = -(-max(image.shape[:2]) // edge)
    rows, columns = (max(n // step, 1) for n in image.shape[:2])
    cut = image[: rows * step, : columns * step]
    return cut.reshape(rows, -1, columns, cut.shape[1] // columns, 3).mean(axis=(1, 3))


def describe_views(views: Iterable[Photo]) -> str:
    """Number and size of the judged views."""
    sizes = [photo.camera.size for photo in views]
    width, height = sizes[0]
    size = f"{width} x {height} pixels" if set(sizes) == {sizes[0]} else "their own sizes"
    return f"{len(sizes)} view{'s' if len(sizes) > 1 else ''} at {size}"


def judge_colour_fitted(image: NDArray, photo: Photo, space: str) -> float:
    """PSNR [dB] of a view after a fit of the view's colours to the photograph, for screen colours."""
    render_codes, photo_codes = (CONVERSIONS[space, "srgb"](values) for values in (image, photo.image))
    return score_image(fit_colours(render_codes, photo_codes, photo.mask), photo_codes, mask=photo.mask).values["psnr"]


def tabulate_views(
    camera: Camera, scores: Sequence[ImageScore], fitted: Sequence[float] = (), aligned: Sequence[float] = ()
) -> Table:
    """Table of the judged views with their metrics, the worst view first.

    Args:
        camera: camera of the first view, for the size in the title.
        scores: metrics of each view.
        fitted: PSNR [dB] of each view after colour correction; may be empty.
        aligned: PSNR [dB] of each view after an alignment of the view's pose; may be empty.
    """
    metrics = list(scores[0].values)
    head = ("view", *(METRICS[name].label for name in metrics))
    rows = [(one.name, *(f"{one.values[name]:.{METRICS[name].digits}f}" for name in metrics)) for one in scores]
    more = {"PSNR after colour correction [dB]": fitted, "PSNR after alignment of the pose [dB]": aligned}
    for label, values in more.items():
        if values:
            head += (label,)
            rows = [(*row, f"{value:.2f}") for row, value in zip(rows, values, strict=True)]
    rows.sort(key=lambda row: float(row[1]))
    width, height = camera.size
    return Table(title=f"Held-out views, at {width} x {height} pixels, the worst first", head=head, rows=tuple(rows))


def explain_photos(photos: Photos) -> PlanLine:
    """Return the number of photographs and the size of the box, with the origin of the box."""
    edges = " x ".join(f"{edge:.4g}" for edge in photos.box[1] - photos.box[0])
    return PlanLine(choice=f"{len(photos.views)} photographs, a box of {edges} [length]", reason=photos.survey.box_from)


def explain_time(minutes: float, reason: str = "the number of steps is fixed") -> PlanLine:
    """Return the time of a fit on the reference machine, and a reason why it may differ."""
    return PlanLine(choice=f"about {format_duration(60 * minutes)}", reason=f"on two idle cores; {reason}")


def explain_stop(transmittance: float) -> PlanLine:
    """Return the transmittance at which rays end."""
    reason = "they lose at most this share of the light"
    return PlanLine(choice=f"rays end at a transmittance of {transmittance:g}", reason=reason)


def describe_free_space(cameras: Sequence[Camera], reach: float) -> PlanLine:
    """Line on the free space of cameras at the median distance ``reach`` [length]."""
    clear, within = find_free_distances(cameras, reach)
    return PlanLine(
        choice=f"no matter nearer to a camera than {clear:.4g} [length], nor nearer than {within:.4g} where fewer than "
        f"{FEWEST_VIEWS} photographs look",
        reason="fog there explains one photograph and covers the others; less for wide lenses",
    )


MOTIONS = PlanLine(
    choice="cameras move with the fit",
    reason="for poses that are off by a pixel or more; held-out photographs are judged as they are, and after an alignment",
)


def rename_metrics(values: dict[str, float]) -> dict[str, float]:
    """Metrics by the names of :data:`mivol.report.record.QUANTITIES`."""
    return {("held_out_psnr" if name == "psnr" else name): value for name, value in values.items()}


class PhotoFit(FitKind):
    """A fit of a model to photographs.

    Attributes:
        plan: stages, steps and rates of the fit.
        photos: photographs to fit, with their box.
        judged: held-out photographs; may be None.
        film: cameras of the film.
        levels: nested boxes of the model.
        fits_colours: whether judged views also have a PSNR with their colours fitted to the photographs'.
        steps: how the kernels of steps are made.
    """

    stages = Stages("photographs", "fit", "images and volumes")
    levels: int = 1
    fits_colours: bool
    steps: ClassVar[str]
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

    def describe_run(self) -> dict[str, Any]:
        method, sources = self.describe_method()
        return {
            "method": method,
            "seeds": {"fit": self.settings.seed},
            "units": {"loss": "1"},
            "citations": ["mitsuba3", "drjit", *sources],
        }

    @abstractmethod
    def describe_method(self) -> tuple[str, list[str]]:
        """Return the method in a line, and its sources as keys of :data:`mivol.cite.CITATIONS`."""

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
        say(f"  steps: {self.steps}")

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

    def begin(self, run: RunFolder) -> None:
        photos = self.settings.photos
        run.write_photographs(self.context.base / photos.path, photos.held_out, photos.fold)

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

    def show(self, run: RunFolder, fit: Fit, evaluation: Evaluation) -> None:
        # Judged iterates are written as the best ones; without judged views, the newest stands in their files for viewers.
        files = self.best_files()
        if files is not None and not evaluation.errors:
            files.write(run.path)

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

    def motions(self) -> NDArray | None:
        """Return the motions of the cameras in the fit (photographs, 6): rotation vectors about their positions, in the axes of
        the world [rad], and translations [length]; None if cameras stay. Judged views then also have a PSNR with their
        own poses aligned.
        """
        return None

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
        motions = self.motions()
        if motions is not None:
            record.tables.append(tabulate_motions([view.name for view in self.photos.views], motions))
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
        qualities, fitted, aligned, first, refines_poses = [], [], [], [], self.motions() is not None
        pictures = JudgedViews(run.path, space, len(views), show.views)
        for number, photo in enumerate(views):
            photo = self.rectified(photo)
            view, quality = self.judge(photo, show.metrics)
            image = view if isinstance(view, np.ndarray) else view.image
            qualities.append(quality)
            if self.fits_colours:
                fitted.append(judge_colour_fitted(image, photo, space))
            if refines_poses:
                aligned.append(self.judge(self.align(photo), ("psnr",))[1].values["psnr"])
            psnr = quality.values.get("psnr", fitted[-1] if fitted else next(iter(quality.values.values())))
            pictures.add(photo, image, psnr, describe_quality(quality, fitted[-1] if fitted else None))
            if number == 0:
                first = self.write_first_view(run, view, photo)
        self.record.images += [*pictures.images(), *first]
        self.record.judged = describe_views(views)
        self.record.tables.append(tabulate_views(views[0].camera, qualities, fitted, aligned))
        means = rename_metrics(average_scores(qualities).values)
        more = {"psnr_colour_fitted": fitted, "psnr_aligned": aligned}
        return means | {name: float(np.mean(values)) for name, values in more.items() if values}

    def align(self, photo: Photo) -> Photo:
        """Return a judged photograph with the pose that shows the model most like the photograph."""

        def render(camera: Camera) -> NDArray:
            view, _ = self.judge(replace(photo, camera=camera), ())
            return view if isinstance(view, np.ndarray) else view.image

        distance = viewing_distance([view.camera for view in self.photos.views], self.photos.box)
        return replace(photo, camera=align_camera(render, photo.camera, photo.image, photo.mask, distance))

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


def tabulate_motions(names: Sequence[str], motions: NDArray) -> Table:
    """Table of the motions of the photographs' cameras (:meth:`PhotoFit.motions`), the farthest turn first."""
    turns, shifts = np.degrees(np.linalg.norm(motions[:, :3], axis=1)), np.linalg.norm(motions[:, 3:], axis=1)
    rows = [(names[k], f"{turns[k]:.3f}", f"{shifts[k]:.3g}") for k in np.argsort(-turns, kind="stable")]
    return Table(
        title="Motions of the cameras in the fit", head=("photograph", "turn [degree]", "shift [length]"), rows=tuple(rows)
    )
