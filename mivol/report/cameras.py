"""What stands about a box, as a picture: the cameras of a data set, or the source and the detector of a scanner.

Conventions. Colours say the split. A camera is its pinhole and the four edges of its field of view; the plan is seen from
above, where up is the axis of the world that is nearest to the cameras' mean upward direction.
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

from mivol.photos import SPLITS, Frame, PhotoSurvey
from mivol.report.figures import FAINT, INK, SERIES, STYLE, save

__all__ = ["EDGE", "PARTS", "Stage", "Strokes", "plot_cameras", "plot_stage", "pyramid", "rectangle"]

EDGE = 0.12
"""Length of a drawn field of view, as a share of the median distance from the middle of the box."""

MOST_POINTS = 4000

LOW = 0.15
"""Of the longest edge of what is drawn from the side: an edge that is shorter has no room for more than one tick."""

PARTS = ("side", "plan")
"""Of the picture: from the side, and from above."""

WIDTH = 4.8
"""Of a part [inch]: its labels are read on a page of 390 pixels."""


class Strokes(NamedTuple):
    """Edges (N, 2, 3) of one colour, as they are called in the legend."""

    label: str
    colour: str
    edges: NDArray


class Stage(NamedTuple):
    """What is drawn.

    Attributes:
        strokes: cameras, or what else stands about the box.
        box: (2, 3) its low and high corner [length].
        points: (N, 3) in it.
        up: which axis of the world is up.
    """

    strokes: list[Strokes]
    box: NDArray
    points: NDArray
    up: int


def plot_cameras(survey: PhotoSurvey, path: str | Path | None = None, part: str | None = None) -> Figure:
    """Cameras, box and points from the side and from above.

    Args:
        survey: of :func:`mivol.photos.survey_photos`.
        path: written there (.svg, .png) if given.
        part: one of PARTS alone; None: both in one figure.

    Raises:
        MivolError: another suffix.
    """
    return plot_stage(stage_of(survey), f"{survey.path.name}: {len(survey.frames)} cameras and the box", path, part)


def stage_of(survey: PhotoSurvey) -> Stage:
    """The cameras of a data set about their box, a colour a split."""
    middle = survey.box.mean(axis=0)
    length = EDGE * float(np.median([np.linalg.norm(f.camera.origin - middle) for f in survey.frames]))
    up = int(np.argmax(np.abs(np.mean([f.camera.to_world[:3, 1] for f in survey.frames], axis=0))))
    strokes = [
        Strokes(split, _colour(split), np.concatenate([outline(f, length) for f in of]))
        for split, of in _by_split(survey).items()
    ]
    return Stage(strokes, survey.box, _points(survey), up)


def plot_stage(stage: Stage, title: str, path: str | Path | None = None, part: str | None = None) -> Figure:
    """A stage from the side and from above.

    Args:
        stage: what is drawn.
        title: of a figure of both parts.
        path: written there (.svg, .png) if given.
        part: one of PARTS alone; None: both in one figure.

    Raises:
        MivolError: another suffix.
    """
    with mpl.rc_context(STYLE):
        parts = PARTS if part is None else (part,)
        figure = Figure(figsize=(WIDTH * len(parts), WIDTH))
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(wspace=0.1)
        if "side" in parts:
            _draw_side(figure.add_subplot(1, len(parts), 1, projection="3d", computed_zorder=False), stage)
        if "plan" in parts:
            above = figure.add_subplot(1, len(parts), len(parts))
            _draw_plan(above, stage)
        if part == "plan":
            figure.legend(loc="outside lower left", ncols=2)
        if part is None:
            above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
            figure.suptitle(title, x=0.01, ha="left", weight="bold")
    if path is not None:
        save(figure, path)
    return figure


def outline(frame: Frame, length: float) -> NDArray:
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


def _by_split(survey: PhotoSurvey) -> dict[str, list[Frame]]:
    found = {split: [frame for frame in survey.frames if frame.split == split] for split in SPLITS}
    return {split: frames for split, frames in found.items() if frames}


def _colour(split: str) -> str:
    return dict(zip(SPLITS, SERIES, strict=False))[split]


def _points(survey: PhotoSurvey) -> NDArray:
    if survey.points is None:
        return np.empty((0, 3))
    inside = ((survey.points >= survey.box[0]) & (survey.points <= survey.box[1])).all(axis=1)
    points = survey.points[inside]
    return points[:: max(1, len(points) // MOST_POINTS)]


def _draw_side(axes: Axes, stage: Stage) -> None:
    order = _order(stage.up)
    for strokes in stage.strokes:
        axes.plot(*_pen(strokes.edges)[order], color=strokes.colour, linewidth=0.7, alpha=0.8)
    axes.plot(*_pen(box_edges(stage.box))[order], color=INK, linewidth=1.3)
    axes.scatter(*stage.points[:, order].T, s=0.3, color=FAINT, linewidths=0)
    everything = np.concatenate([*(strokes.edges.reshape(-1, 3) for strokes in stage.strokes), stage.box])[:, order]
    low, high = everything.min(axis=0), everything.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    for k, (name, axis) in enumerate(zip(order, (axes.xaxis, axes.yaxis, axes.zaxis), strict=True)):
        axis.set_label_text(f"{'xyz'[name]} [length]")
        axis.set_major_locator(MaxNLocator(4 if high[k] - low[k] > LOW * (high - low).max() else 1, min_n_ticks=1))
    axes.view_init(22, -60)


def _draw_plan(axes: Axes, stage: Stage) -> None:
    first, second, up = _order(stage.up)
    for strokes in stage.strokes:
        pen = _pen(strokes.edges)[[first, second]]
        axes.plot(*pen, color=strokes.colour, linewidth=0.7, alpha=0.8, label=strokes.label)
    axes.plot(*_pen(box_edges(stage.box))[[first, second]], color=INK, linewidth=1.3, label="box")
    axes.scatter(*stage.points[:, [first, second]].T, s=0.3, color=FAINT, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(title=f"from above ({'xyz'[up]} is up)", xlabel=f"{'xyz'[first]} [length]", ylabel=f"{'xyz'[second]} [length]")


def _order(up: int) -> list[int]:
    """Axes to the right, into the page and up, right-handed."""
    return [(up + 1) % 3, (up + 2) % 3, up]
