"""Judged views as pictures: a few in full, the worst among them, and all others small, to be scrolled through."""

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
from mivol.validate.images import METRICS, ImageScore, fit_colours, score_image

__all__ = [
    "JudgedViews",
    "caption_of",
    "judge_colour_fitted",
    "rename_metrics",
    "said_of",
    "spread_over",
    "table_of_views",
    "write_view",
]

MANY = 32
"""Judged views from which the small ones are smaller: a page stays below some 20 MB."""

EDGES = 256, 128
"""Longest edge of a small picture [pixel], of few and of many views."""


def spread_over(count: int, shown: int) -> frozenset[int]:
    """Numbers of as many views as are to be shown, from the first to the last of so many."""
    return frozenset(np.linspace(0, count - 1, min(shown, count)).astype(int).tolist())


def caption_of(quality: ImageScore, fitted: float | None = None) -> str:
    """What is said beside a view: its metrics, and its PSNR [dB] where its colours are fitted to the photograph's first."""
    found = [said_as(name, value) for name, value in quality.values.items()]
    return ", ".join(found if fitted is None else [*found, f"{fitted:.2f} dB with its colours fitted"])


def said_as(metric: str, value: float) -> str:
    """A metric's name, value and unit."""
    label, _, unit = METRICS[metric].label.partition(" [")
    return f"{label} {value:.{METRICS[metric].digits}f} {unit.rstrip(']')}".rstrip()


@dataclass
class JudgedViews:
    """Pictures of judged views, written one by one as they are judged.

    Attributes:
        folder: of the run.
        space: of the photographs.
        count: of views that will be judged.
        shown: how many are kept in full beside the worst; 0: no pictures are written at all.
    """

    folder: Path
    space: str
    count: int
    shown: int
    _images: dict[int, list[Image]] = field(default_factory=dict, init=False)
    _psnr: dict[int, float] = field(default_factory=dict, init=False)
    _worst: tuple[Photo, int, NDArray, str] | None = field(default=None, init=False)

    def add(self, photo: Photo, image: NDArray, psnr: float, caption: str) -> None:
        """The next view.

        Args:
            photo: the photograph.
            image: the render (H, W, 3), in the photographs' space.
            psnr: [dB], by which the worst is known.
            caption: what is said beside it.
        """
        number = len(self._psnr)
        if self.shown:
            edge = None if number in spread_over(self.count, self.shown) else EDGES[self.count > MANY]
            self._images[number] = write_view(self.folder, photo, number, image, self.space, caption, edge)
            if psnr < min(self._psnr.values(), default=np.inf):
                self._worst = photo, number, image, caption
        self._psnr[number] = psnr

    def images(self) -> list[Image]:
        """What was written, for the record: the worst view first, in full, then the others in full, then those that are small,
        from the worst to the best."""
        if self._worst is None:
            return []
        photo, worst, image, caption = self._worst
        said = f"the worst of {self.count}: {caption}"
        self._images[worst] = write_view(self.folder, photo, worst, image, self.space, said)
        whole = [n for n in sorted(spread_over(self.count, self.shown)) if n != worst]
        small = sorted(self._images.keys() - {worst, *whole}, key=self._psnr.__getitem__)
        return [one for number in (worst, *whole, *small) for one in self._images[number]]


def write_view(
    folder: Path,
    photo: Photo,
    number: int,
    image: NDArray,
    space: str = "srgb",
    caption: str = "",
    edge: int | None = None,
) -> list[Image]:
    """A render beside its photograph, both as a screen shows them.

    Args:
        folder, photo, number: where, of what, and the number in the files' names.
        image: (H, W, 3), in ``space``.
        space: of both.
        caption: what is said beside them.
        edge: longest edge of what is written [pixel]: means of squares of pixels; None: as they are.
    """
    written = []
    for role, values in {"render": image, "reference": photo.image}.items():
        path = f"views/{number:03d}_{role}.png"
        codes = CONVERSIONS[space, "srgb"](np.clip(values, 0, 1))
        write_png(folder / path, CONVERSIONS["srgb", "linear"](codes if edge is None else _shrunk(codes, edge)))
        said = caption if role == "render" else ""
        small = edge is not None
        written.append(Image(path=path, role=role, view=photo.name, held_out=True, quantity=CODES, caption=said, small=small))
    return written


def _shrunk(image: NDArray, edge: int) -> NDArray:
    """Means of squares of pixels, as few as make the longest edge at most so long; what is left at the sides is cut."""
    step = -(-max(image.shape[:2]) // edge)
    rows, columns = (max(n // step, 1) for n in image.shape[:2])
    cut = image[: rows * step, : columns * step]
    return cut.reshape(rows, -1, columns, cut.shape[1] // columns, 3).mean(axis=(1, 3))


def said_of(views: Iterable[Photo]) -> str:
    """How many views are judged, and at which size."""
    sizes = [photo.camera.size for photo in views]
    width, height = sizes[0]
    size = f"{width} x {height} pixels" if set(sizes) == {sizes[0]} else "their own sizes"
    return f"{len(sizes)} view{'s' if len(sizes) > 1 else ''} at {size}"


def judge_colour_fitted(image: NDArray, photo: Photo, space: str) -> float:
    """PSNR [dB] of a view whose colours, as a screen shows them, were fitted to its photograph's."""
    shown, wanted = (CONVERSIONS[space, "srgb"](values) for values in (image, photo.image))
    return score_image(fit_colours(shown, wanted, photo.mask), wanted, mask=photo.mask).values["psnr"]


def table_of_views(camera: Camera, found: Sequence[ImageScore], fitted: Sequence[float] = ()) -> Table:
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


def rename_metrics(values: dict[str, float]) -> dict[str, float]:
    """Metrics by the names of :data:`mivol.report.record.QUANTITIES`."""
    return {("held_out_psnr" if name == "psnr" else name): value for name, value in values.items()}
