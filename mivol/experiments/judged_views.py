"""Held-out views of a fit of photographs: metrics, tables and images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mivol.files import write_png
from mivol.photos import Camera, Photo
from mivol.photos.photo_file import CONVERSIONS
from mivol.report.record import CODES, Image, Table
from mivol.validate.metrics import METRICS, ImageScore, fit_colours, score_image

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
    return ", ".join(metrics if fitted is None else [*metrics, f"{fitted:.2f} dB after a fit of the colours"])


def format_metric(metric: str, value: float) -> str:
    """Name, value and unit of a metric."""
    label, _, unit = METRICS[metric].label.partition(" [")
    return f"{label} {value:.{METRICS[metric].digits}f} {unit.rstrip(']')}".rstrip()


@dataclass
class JudgedViews:
    """Images of judged views, written view by view.

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
    _images: dict[int, list[Image]] = field(default_factory=dict, init=False)
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
            self._images[number] = write_view(self.folder, photo, number, image, self.space, caption, edge)
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
        self._images[worst] = write_view(self.folder, photo, worst, image, self.space, worst_caption)
        whole = [n for n in sorted(select_shown_views(self.count, self.shown)) if n != worst]
        small = sorted(self._images.keys() - {worst, *whole}, key=self._psnr.__getitem__)
        return [one for number in (worst, *whole, *small) for one in self._images[number]]


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


def tabulate_views(camera: Camera, scores: Sequence[ImageScore], fitted: Sequence[float] = ()) -> Table:
    """Table of the judged views with their metrics, the worst view first.

    Args:
        camera: camera of the first view, for the size in the title.
        scores: metrics of each view.
        fitted: PSNR [dB] of each view after colour correction; may be empty.
    """
    metrics = list(scores[0].values)
    head = ("view", *(METRICS[name].label for name in metrics))
    rows = [(one.name, *(f"{one.values[name]:.{METRICS[name].digits}f}" for name in metrics)) for one in scores]
    if fitted:
        head += ("PSNR [dB], colours fitted to the photograph's",)
        rows = [(*row, f"{value:.2f}") for row, value in zip(rows, fitted, strict=True)]
    rows.sort(key=lambda row: float(row[1]))
    width, height = camera.size
    return Table(title=f"Judged views, at {width} x {height} pixels, the worst first", head=head, rows=tuple(rows))


def rename_metrics(values: dict[str, float]) -> dict[str, float]:
    """Metrics by the names of :data:`mivol.report.record.QUANTITIES`."""
    return {("held_out_psnr" if name == "psnr" else name): value for name, value in values.items()}
