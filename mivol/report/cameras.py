"""The cameras of a data set as a picture: where they stand, what they see of, and the box.

Conventions. Colours say the split. A camera is its pinhole and the four edges of its field of view; the plan is seen from
above, where up is the axis of the world that is nearest to the cameras' mean upward direction.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mivol.photos import SPLITS, Frame, PhotoSurvey
from mivol.report.figures import FAINT, INK, SERIES, STYLE, save

__all__ = ["PARTS", "plot_cameras"]

EDGE = 0.12
"""Length of a drawn field of view, as a share of the median distance from the middle of the box."""

MOST_POINTS = 4000

PARTS = ("side", "plan")
"""Of the picture: from the side, and from above."""

WIDTH = 4.8
"""Of a part [inch]: its labels are read on a page of 390 pixels."""


def plot_cameras(survey: PhotoSurvey, path: str | Path | None = None, part: str | None = None) -> Figure:
    """Cameras, box and points from the side and from above.

    Args:
        survey: of :func:`mivol.photos.survey_photos`.
        path: written there (.svg, .png) if given.
        part: one of PARTS alone; None: both in one figure.

    Raises:
        MivolError: another suffix.
    """
    middle = survey.box.mean(axis=0)
    length = EDGE * float(np.median([np.linalg.norm(f.camera.origin - middle) for f in survey.frames]))
    up = int(np.argmax(np.abs(np.mean([f.camera.to_world[:3, 1] for f in survey.frames], axis=0))))
    lines = {split: np.concatenate([outline(f, length) for f in of]) for split, of in _by_split(survey).items()}
    with mpl.rc_context(STYLE):
        parts = PARTS if part is None else (part,)
        figure = Figure(figsize=(WIDTH * len(parts), WIDTH))
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(wspace=0.1)
        if "side" in parts:
            side = figure.add_subplot(1, len(parts), 1, projection="3d", computed_zorder=False)
            _draw_side(side, survey, lines, up)
        if "plan" in parts:
            above = figure.add_subplot(1, len(parts), len(parts))
            _draw_plan(above, survey, lines, up)
            beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
            above.legend(**beside if part is None else {"loc": "best"})
        if part is None:
            title = f"{survey.path.name}: {len(survey.frames)} cameras and the box"
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
    ends = local @ camera.to_world[:3, :3].T + camera.origin
    sides = [(camera.origin, end) for end in ends]
    return np.array(sides + [(ends[i], ends[(i + 1) % 4]) for i in range(4)])


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


def _draw_side(axes: Axes, survey: PhotoSurvey, lines: dict[str, NDArray], up: int) -> None:
    order = _order(up)
    for split, edges in lines.items():
        axes.plot(*_pen(edges)[order], color=_colour(split), linewidth=0.7, alpha=0.8)
    axes.plot(*_pen(box_edges(survey.box))[order], color=INK, linewidth=1.3)
    axes.scatter(*_points(survey)[:, order].T, s=0.3, color=FAINT, linewidths=0)
    everything = np.concatenate([*(edges.reshape(-1, 3) for edges in lines.values()), survey.box])[:, order]
    low, high = everything.min(axis=0), everything.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    for name, axis in zip(order, (axes.xaxis, axes.yaxis, axes.zaxis), strict=True):
        axis.set_label_text(f"{'xyz'[name]} [length]")
        axis.set_major_locator(MaxNLocator(4))
    axes.view_init(22, -60)


def _draw_plan(axes: Axes, survey: PhotoSurvey, lines: dict[str, NDArray], up: int) -> None:
    first, second, _ = _order(up)
    for split, edges in lines.items():
        axes.plot(*_pen(edges)[[first, second]], color=_colour(split), linewidth=0.7, alpha=0.8, label=split)
    axes.plot(*_pen(box_edges(survey.box))[[first, second]], color=INK, linewidth=1.3, label="box")
    axes.scatter(*_points(survey)[:, [first, second]].T, s=0.3, color=FAINT, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(title=f"from above ({'xyz'[up]} is up)", xlabel=f"{'xyz'[first]} [length]", ylabel=f"{'xyz'[second]} [length]")


def _order(up: int) -> list[int]:
    """Axes to the right, into the page and up, right-handed."""
    return [(up + 1) % 3, (up + 2) % 3, up]
