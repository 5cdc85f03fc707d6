"""What stands about a box, as a picture: the cameras of a data set, or the source and the detector of a scanner.

Conventions. Colours say the split. A camera is its pinhole and the four edges of its field of view; the plan is seen from
above, where up is the axis of the world that is nearest to the cameras' mean upward direction. Of nested boxes the first two
parts show those that reach as far as what stands about them, and a third part shows all.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mivol.photos import SPLITS, PhotoFrame, PhotoSurvey
from mivol.photos.region import nested_boxes, points_in_box
from mivol.report.figures import FAINT, INK, SERIES, STYLE, save_figure

__all__ = [
    "EDGE",
    "FAR",
    "PARTS",
    "Arrangement",
    "Strokes",
    "list_parts",
    "plot_arrangement",
    "plot_cameras",
    "pyramid",
    "rectangle",
]

EDGE = 0.12
"""Length of a drawn field of view, as a share of the median distance from the middle of the box."""

MOST_POINTS = 4000

LOW = 0.15
"""Of the longest edge of what is drawn from the side: an edge that is shorter has no room for more than one tick."""

PARTS = ("side", "plan")
"""Of the picture: from the side, and from above."""

FAR = "far"
"""The part that shows all of nested boxes from above, where the others do not."""

WIDTH = 4.8
"""Of a part [inch]: its labels are read on a page of 390 pixels."""


class Strokes(NamedTuple):
    """Edges (N, 2, 3) of one colour, as they are called in the legend."""

    label: str
    colour: str
    edges: NDArray


class Arrangement(NamedTuple):
    """What is drawn.

    Attributes:
        strokes: cameras, or what else stands about the box.
        box: (2, 3) its low and high corner [length].
        points: (N, 3) in it, or in the largest of the boxes.
        up: which axis of the world is up.
        levels: nested boxes, the first of which is ``box``.
    """

    strokes: list[Strokes]
    box: NDArray
    points: NDArray
    up: int
    levels: int = 1

    @property
    def near(self) -> int:
        """How many of the boxes it takes to hold all that stands about them; all of them where none does."""
        ends = np.concatenate([strokes.edges.reshape(-1, 3) for strokes in self.strokes])
        boxes = nested_boxes(self.box, self.levels)
        return next((n for n, box in enumerate(boxes, 1) if len(points_in_box(ends, box)) == len(ends)), self.levels)

    @property
    def parts(self) -> tuple[str, ...]:
        """Of the picture: ``PARTS``, and ``FAR`` where these do not show all boxes."""
        return PARTS if self.near == self.levels else (*PARTS, FAR)


def list_parts(survey: PhotoSurvey) -> tuple[str, ...]:
    """The parts of the picture of a data set."""
    return arrangement_of(survey).parts


def plot_cameras(survey: PhotoSurvey, path: str | Path | None = None, part: str | None = None) -> Figure:
    """Cameras, boxes and points from the side and from above.

    Args:
        survey: of :func:`mivol.photos.survey_photos`.
        path: written there (.svg, .png) if given.
        part: one of :func:`list_parts` alone; None: all of them in one figure.

    Raises:
        MivolError: another suffix.
    """
    boxes = "the box" if survey.levels == 1 else f"{survey.levels} nested boxes"
    return plot_arrangement(arrangement_of(survey), f"{survey.path.name}: {len(survey.frames)} cameras and {boxes}", path, part)


def arrangement_of(survey: PhotoSurvey) -> Arrangement:
    """The cameras of a data set about their box, a colour a split."""
    middle = survey.box.mean(axis=0)
    length = EDGE * float(np.median([np.linalg.norm(f.camera.origin - middle) for f in survey.frames]))
    up = int(np.argmax(np.abs(np.mean([f.camera.to_world[:3, 1] for f in survey.frames], axis=0))))
    strokes = [
        Strokes(split, _colour(split), np.concatenate([outline(f, length) for f in of]))
        for split, of in _by_split(survey).items()
    ]
    return Arrangement(strokes, survey.box, _points(survey), up, survey.levels)


def plot_arrangement(arranged: Arrangement, title: str, path: str | Path | None = None, part: str | None = None) -> Figure:
    """An arrangement from the side and from above.

    Args:
        arranged: what is drawn.
        title: of a figure of all parts.
        path: written there (.svg, .png) if given.
        part: one of PARTS, or FAR, alone; None: all that it takes in one figure.

    Raises:
        MivolError: another suffix.
    """
    with mpl.rc_context(STYLE):
        parts = arranged.parts if part is None else (part,)
        figure = Figure(figsize=(WIDTH * len(parts), WIDTH))
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(wspace=0.1)
        for number, name in enumerate(parts, 1):
            if name == "side":
                _draw_side(figure.add_subplot(1, len(parts), number, projection="3d", computed_zorder=False), arranged)
            else:
                levels = arranged.levels if name == FAR else arranged.near
                _draw_plan(figure.add_subplot(1, len(parts), number), arranged, levels)
        if part in ("plan", FAR):
            figure.legend(loc="outside lower left", ncols=2)
        if part is None:
            figure.axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
            figure.suptitle(title, x=0.01, ha="left", weight="bold")
    if path is not None:
        save_figure(figure, path)
    return figure


def outline(frame: PhotoFrame, length: float) -> NDArray:
    """(8, 2, 3) the edges of a camera's field of view, ``length`` long along its axis; of a wide lens 90 degrees of it."""
    camera = frame.camera
    corners = np.array([[0, 0], [camera.size[0], 0], camera.size, [0, camera.size[1]]]) - camera.K[:2, 2]
    across = np.sign(corners) if camera.distortion.is_wide else corners / camera.K[[0, 1], [0, 1]]
    local = np.column_stack([across * [1, -1], -np.ones(4)]) * length
    return pyramid(camera.origin, local @ camera.to_world[:3, :3].T + camera.origin)


def pyramid(apex: NDArray, ends: NDArray) -> NDArray:
    """(8, 2, 3) the edges from an apex (3,) to four corners (4, 3), then those around."""
    return np.concatenate([[(apex, end) for end in ends], rectangle(ends)])


def rectangle(corners: NDArray) -> NDArray:
    """(4, 2, 3) the edges around four corners (4, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def box_edges(box: NDArray) -> NDArray:
    """(12, 2, 3) the edges of a box (2, 3)."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    pairs = [(a, b) for a, b in itertools.combinations(corners, 2) if np.abs(a - b).sum() == 1]
    return np.array(pairs) * (box[1] - box[0]) + box[0]


def _pen(edges: NDArray) -> NDArray:
    """(3, 3 N) one line through edges (N, 2, 3), lifted between them."""
    lifted = np.full((len(edges), 1, 3), np.nan)
    return np.concatenate([edges, lifted], axis=1).reshape(-1, 3).T


def _by_split(survey: PhotoSurvey) -> dict[str, list[PhotoFrame]]:
    found = {split: [frame for frame in survey.frames if frame.split == split] for split in SPLITS}
    return {split: frames for split, frames in found.items() if frames}


def _colour(split: str) -> str:
    return dict(zip(SPLITS, SERIES, strict=False))[split]


def _points(survey: PhotoSurvey) -> NDArray:
    if survey.points is None:
        return np.empty((0, 3))
    points = points_in_box(survey.points, nested_boxes(survey.box, survey.levels)[-1])
    return points[:: max(1, len(points) // MOST_POINTS)]


def _draw_side(axes: Axes, arranged: Arrangement) -> None:
    order, boxes = _order(arranged.up), nested_boxes(arranged.box, arranged.near)
    for strokes in arranged.strokes:
        axes.plot(*_pen(strokes.edges)[order], color=strokes.colour, linewidth=0.7, alpha=0.8)
    for number, box in enumerate(boxes):
        axes.plot(*_pen(box_edges(box))[order], **_line_of(number))
    everything = np.concatenate([*(strokes.edges.reshape(-1, 3) for strokes in arranged.strokes), boxes[-1]])
    # Of three dimensions matplotlib cuts nothing off at the frame.
    points = points_in_box(arranged.points, np.array([everything.min(axis=0), everything.max(axis=0)]))
    axes.scatter(*points[:, order].T, s=0.3, color=FAINT, linewidths=0)
    everything = everything[:, order]
    low, high = everything.min(axis=0), everything.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    for k, (name, axis) in enumerate(zip(order, (axes.xaxis, axes.yaxis, axes.zaxis), strict=True)):
        axis.set_label_text(f"{'xyz'[name]} [length]")
        axis.set_major_locator(MaxNLocator(4 if high[k] - low[k] > LOW * (high - low).max() else 1, min_n_ticks=1))
    axes.view_init(22, -60)


def _draw_plan(axes: Axes, arranged: Arrangement, levels: int) -> None:
    """From above, with so many of the boxes."""
    first, second, up = _order(arranged.up)
    for strokes in arranged.strokes:
        pen = _pen(strokes.edges)[[first, second]]
        axes.plot(*pen, color=strokes.colour, linewidth=0.7, alpha=0.8, label=strokes.label)
    boxes = nested_boxes(arranged.box, levels)
    for number, box in enumerate(boxes):
        label = ("box" if levels == 1 else "innermost box") if number == 0 else "larger boxes" if number == 1 else None
        axes.plot(*_pen(box_edges(box))[[first, second]], **_line_of(number), label=label)
    shown = points_in_box(arranged.points, boxes[-1])[:, [first, second]]
    axes.scatter(*shown.T, s=0.3, color=FAINT, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    what = "from above" if levels == arranged.near else "all boxes from above"
    axes.set(title=f"{what} ({'xyz'[up]} is up)", xlabel=f"{'xyz'[first]} [length]", ylabel=f"{'xyz'[second]} [length]")


def _line_of(number: int) -> dict:
    """How a nested box is drawn."""
    return {"color": INK, "linewidth": 1.3 if number == 0 else 0.6}


def _order(up: int) -> list[int]:
    """Axes to the right, into the page and up, right-handed."""
    return [(up + 1) % 3, (up + 2) % 3, up]
