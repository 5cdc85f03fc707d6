"""Figures of cameras and scanners around their box, from the side and from above, and the page after a search for poses.

Conventions. The colour shows the split. A camera is drawn as its pinhole with the four edges of its field of view. The up axis
is the world axis, of either sign, nearest to the mean upward direction of the cameras. Of nested boxes, the side view and the
plan show the boxes up to the farthest camera; a third panel shows all boxes.

Scanners. A small pyramid marks a view. The pyramid of a point source opens towards the detector, like the pyramid of a camera;
the apex of a pyramid of parallel light points in the direction of the light. A few detectors are drawn at their true size.
"""

from __future__ import annotations

import base64
import html
import itertools
import math
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mivol.files import write_whole_text
from mivol.optim.scenes.views import View
from mivol.photos import SPLITS, PhotoFrame, Photos, PhotoSurvey, survey_photos
from mivol.photos.poses import Poses
from mivol.photos.region import nested_boxes, points_in_box
from mivol.report.figures import FAINT, INK, SERIES, STYLE, save_figure
from mivol.report.record import Image
from mivol.scene.sensors import find_media_box, to_camera
from mivol.tomography.geometry import FlatDetector, VoxelGrid

EDGE = 0.12
"""Length of a drawn field of view [median distance of the cameras from the centre of the box]."""

MOST_POINTS = 4000
"""Largest number of drawn points of a reconstruction."""

LOW = 0.15
"""Share of the longest edge of the side view below which an edge has room for one tick only."""

PARTS = ("side", "plan")
"""Panels of the figure: the side view, and the plan from above."""

FAR = "far"
"""Panel of every nested box from above, if the other panels leave some out."""

WIDTH = 4.8
"""Width of a panel [inch], whose labels stay legible on a page of 390 pixels."""


ZOOM = 0.88
"""Longest edge of the side view over that of a cube which fills the panel; leaves room for the label of the up axis."""

FITTED, HELD_OUT = "fitted view", "held-out view"

LABELS = {"train": FITTED, "held_out": HELD_OUT, "val": "validation view", "test": "test view"}
"""Split -> label in the legend."""


class Strokes(NamedTuple):
    """Edges (N, 2, 3) of a colour, with a label for the legend."""

    label: str
    colour: str
    edges: NDArray


class Arrangement(NamedTuple):
    """The content of a figure.

    Attributes:
        strokes: cameras, or source and detector of a scanner.
        box: low and high corner (2, 3) of the innermost box [length].
        points: points (N, 3) of a reconstruction inside the largest box [length].
        up: index of the up axis of the world.
        levels: number of nested boxes.
        is_down: whether up is the negative direction of that axis.
    """

    strokes: list[Strokes]
    box: NDArray
    points: NDArray
    up: int
    levels: int = 1
    is_down: bool = False

    @property
    def near(self) -> int:
        """Number of nested boxes up to the first box holding all strokes; ``levels`` if no box holds all strokes."""
        ends = np.concatenate([strokes.edges.reshape(-1, 3) for strokes in self.strokes])
        boxes = nested_boxes(self.box, self.levels)
        return next((n for n, box in enumerate(boxes, 1) if len(points_in_box(ends, box)) == len(ends)), self.levels)

    @property
    def parts(self) -> tuple[str, ...]:
        """Panels of the figure: ``PARTS``, and ``FAR`` if ``PARTS`` do not show all boxes."""
        return PARTS if self.near == self.levels else (*PARTS, FAR)


def list_parts(survey: PhotoSurvey) -> tuple[str, ...]:
    """Return the panels of the figure of a data set."""
    return arrange_cameras(survey).parts


def plot_cameras(survey: PhotoSurvey, path: str | Path | None = None, part: str | None = None) -> Figure:
    """Plot cameras, boxes and points from the side and from above.

    Args:
        survey: result of :func:`mivol.photos.survey_photos`.
        path: file to write (.svg or .png), optional.
        part: panel of :func:`list_parts`; by default all panels in a single figure.

    Raises:
        MivolError: another suffix.
    """
    boxes = "the box" if survey.levels == 1 else f"{survey.levels} nested boxes"
    return plot_arrangement(
        arrange_cameras(survey), f"{survey.path.name}: {len(survey.frames)} cameras and {boxes}", path, part
    )


def arrange_cameras(survey: PhotoSurvey) -> Arrangement:
    """Arrange the cameras of a data set around their box, with a colour per split."""
    middle = survey.box.mean(axis=0)
    length = EDGE * float(np.median([np.linalg.norm(f.camera.origin - middle) for f in survey.frames]))
    mean_up = np.mean([f.camera.to_world[:3, 1] for f in survey.frames], axis=0)
    up = int(np.argmax(np.abs(mean_up)))
    strokes = [
        Strokes(LABELS[split], _colour(split), np.concatenate([frustum_edges(f, length) for f in frames]))
        for split, frames in _by_split(survey).items()
    ]
    return Arrangement(strokes, survey.box, _points(survey), up, survey.levels, bool(mean_up[up] < 0))


def plot_arrangement(arranged: Arrangement, title: str, path: str | Path | None, part: str | None) -> Figure:
    """Plot an arrangement from the side and from above.

    Args:
        arranged: content of the figure.
        title: title of the whole figure.
        path: file to write (.svg or .png), optional.
        part: one panel of ``PARTS`` or ``FAR``; by default all panels in a single figure.

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


def frustum_edges(frame: PhotoFrame, length: float) -> NDArray:
    """Return the edges (8, 2, 3) of a camera's field of view, ``length`` long along its axis; 90 degrees of a wide lens."""
    camera = frame.camera
    corners = np.array([[0, 0], [camera.size[0], 0], camera.size, [0, camera.size[1]]]) - camera.K[:2, 2]
    across = np.sign(corners) if camera.distortion.is_wide else corners / camera.K[[0, 1], [0, 1]]
    local = np.column_stack([across * [1, -1], -np.ones(4)]) * length
    return pyramid(camera.origin, local @ camera.to_world[:3, :3].T + camera.origin)


def pyramid(apex: NDArray, ends: NDArray) -> NDArray:
    """Return the edges (8, 2, 3) from an apex (3,) to four corners (4, 3), then the edges between the corners."""
    return np.concatenate([[(apex, end) for end in ends], rectangle(ends)])


def rectangle(corners: NDArray) -> NDArray:
    """Return the edges (4, 2, 3) between four corners (4, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def box_edges(box: NDArray) -> NDArray:
    """Return the edges (12, 2, 3) of a box (2, 3)."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    pairs = [(a, b) for a, b in itertools.combinations(corners, 2) if np.abs(a - b).sum() == 1]
    return np.array(pairs) * (box[1] - box[0]) + box[0]


def _polyline(edges: NDArray) -> NDArray:
    """One polyline (3, 3 N) through edges (N, 2, 3), interrupted by NaN between them."""
    gaps = np.full((len(edges), 1, 3), np.nan)
    return np.concatenate([edges, gaps], axis=1).reshape(-1, 3).T


def _by_split(survey: PhotoSurvey) -> dict[str, list[PhotoFrame]]:
    splits = {split: [frame for frame in survey.frames if frame.split == split] for split in SPLITS}
    return {split: frames for split, frames in splits.items() if frames}


def _colour(split: str) -> str:
    return dict(zip(SPLITS, SERIES, strict=False))[split]


def _points(survey: PhotoSurvey) -> NDArray:
    if survey.points is None:
        return np.empty((0, 3))
    points = points_in_box(survey.points, nested_boxes(survey.box, survey.levels)[-1])
    return points[:: max(1, len(points) // MOST_POINTS)]


def _draw_side(axes: Axes, arranged: Arrangement) -> None:
    order, boxes = _figure_axes(arranged.up), nested_boxes(arranged.box, arranged.near)
    for strokes in arranged.strokes:
        axes.plot(*_polyline(strokes.edges)[order], color=strokes.colour, linewidth=0.7, alpha=0.8)
    for number, box in enumerate(boxes):
        axes.plot(*_polyline(box_edges(box))[order], **_box_style(number))
    everything = np.concatenate([*(strokes.edges.reshape(-1, 3) for strokes in arranged.strokes), boxes[-1]])
    # A 3D plot of matplotlib is not clipped at its frame.
    points = points_in_box(arranged.points, np.array([everything.min(axis=0), everything.max(axis=0)]))
    axes.scatter(*points[:, order].T, s=0.3, color=FAINT, linewidths=0)
    everything = everything[:, order]
    low, high = everything.min(axis=0), everything.max(axis=0)
    # With up along a negative axis, both the upright and a horizontal axis are reversed, which is a half turn and no mirror.
    turned = (lambda k: (high[k], low[k])) if arranged.is_down else (lambda k: (low[k], high[k]))
    axes.set(xlim=(low[0], high[0]), ylim=turned(1), zlim=turned(2))
    # Matplotlib fixes the diagonal of the plot: a flat plot is wider than a cube, and its labels leave the figure.
    edges = (high - low) / (high - low).max()
    axes.set_box_aspect(edges, zoom=ZOOM * np.linalg.norm(edges) / math.sqrt(3))
    for k, (name, axis) in enumerate(zip(order, (axes.xaxis, axes.yaxis, axes.zaxis), strict=True)):
        axis.set_label_text(f"{'xyz'[name]} [length]")
        axis.set_major_locator(MaxNLocator(4 if high[k] - low[k] > LOW * (high - low).max() else 1, min_n_ticks=1))
    axes.view_init(22, -60)


def _draw_plan(axes: Axes, arranged: Arrangement, levels: int) -> None:
    """Draw the plan with the first ``levels`` boxes."""
    first, second, up = _figure_axes(arranged.up)
    for strokes in arranged.strokes:
        line = _polyline(strokes.edges)[[first, second]]
        axes.plot(*line, color=strokes.colour, linewidth=0.7, alpha=0.8, label=strokes.label)
    boxes = nested_boxes(arranged.box, levels)
    for number, box in enumerate(boxes):
        label = ("box" if levels == 1 else "innermost box") if number == 0 else "larger boxes" if number == 1 else None
        axes.plot(*_polyline(box_edges(box))[[first, second]], **_box_style(number), label=label)
    points = points_in_box(arranged.points, boxes[-1])[:, [first, second]]
    axes.scatter(*points.T, s=0.3, color=FAINT, linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    view = "from above" if levels == arranged.near else "all boxes from above"
    if arranged.is_down:
        axes.invert_yaxis()
    sign = "-" if arranged.is_down else ""
    axes.set(title=f"{view} ({sign}{'xyz'[up]} is up)", xlabel=f"{'xyz'[first]} [length]", ylabel=f"{'xyz'[second]} [length]")


def _box_style(number: int) -> dict:
    """Line style of a nested box."""
    return {"color": INK, "linewidth": 1.3 if number == 0 else 0.6}


def _figure_axes(up: int) -> list[int]:
    """World axes to the right, into the page and up, right-handed."""
    return [(up + 1) % 3, (up + 2) % 3, up]


# -- Scanners --------------------------------------------------------------------------------------------------------------


MOST_VIEWS = 60
"""Largest number of drawn views, for fitted and for held-out views."""

DETECTORS = 8
"""Number of drawn detectors."""

BEAM_REACH = 1.5
"""Distance from the centre of the voxels to both ends of a drawn parallel beam [radius of the voxels]."""

MARKER_WIDTH = 0.2
"""Half the width of a marker of parallel light divided by its length."""

DETECTOR, FIRST = "detector of some views", "beam of the first view"


class Beams(NamedTuple):
    """The corners (views, 4, 3) of the beams at their start and at the detector [length]."""

    begins: NDArray
    ends: NDArray


def plot_scanner(
    geometry: FlatDetector, grid: VoxelGrid, held_out: NDArray, path: str | Path | None = None, part: str | None = None
) -> Figure:
    """Plot sources, detectors and the box of the voxels from the side and from above.

    Args:
        geometry: geometry of the views.
        grid: voxels.
        held_out: indices of the held-out views.
        path: file to write (.svg or .png), optional.
        part: panel of :data:`mivol.report.cameras.PARTS`; by default both panels in a single figure.

    Raises:
        MivolError: another suffix.
    """
    count = geometry.shape[0]
    strokes = [
        Strokes(label, colour, make_markers(geometry, views, grid))
        for label, colour, views in zip((FITTED, HELD_OUT), SERIES, select_views(count, held_out), strict=False)
        if len(views)
    ]
    drawn = make_beams(geometry, _evenly_spaced(np.arange(count), DETECTORS), grid)
    strokes += [
        Strokes(DETECTOR, SERIES[2], np.concatenate([rectangle(corners) for corners in drawn.ends])),
        Strokes(FIRST, FAINT, np.stack([drawn.begins[0], drawn.ends[0]], axis=1)),
    ]
    up = int(np.argmax(np.abs(geometry.panels().along_v.mean(axis=0))))
    box = np.asarray(grid.centre) + np.outer([-0.5, 0.5], grid.extent)
    arranged = Arrangement(strokes, box, np.empty((0, 3)), up)
    return plot_arrangement(arranged, f"{count} views and the box of the voxels", path, part)


def select_views(count: int, held_out: NDArray) -> tuple[NDArray, NDArray]:
    """Return the indices of the drawn views: evenly spread over the fitted views, and over the held-out views."""
    return _evenly_spaced(np.setdiff1d(np.arange(count), held_out), MOST_VIEWS), _evenly_spaced(
        np.asarray(held_out, int), MOST_VIEWS
    )


def _evenly_spaced(indices: NDArray, most: int) -> NDArray:
    return indices if len(indices) <= most else indices[np.arange(most) * len(indices) // most]


def make_beams(geometry: FlatDetector, views: NDArray, grid: VoxelGrid) -> Beams:
    """Return the beams of some views; the corners of the detector follow its outline."""
    panels = geometry.panels(views)
    _, rows, columns = geometry.shape
    pixels = np.array([(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)])
    corners = panels.corner[:, None] + pixels[:, :1] * panels.along_u[:, None] + pixels[:, 1:] * panels.along_v[:, None]
    source = panels.source[:, None]
    if not geometry.whole_lines:
        return Beams(np.broadcast_to(source, corners.shape), corners)
    # The source of a parallel beam is its direction, and its detector lies in the plane of the axis.
    middle, reach = source * (source @ np.asarray(grid.centre))[..., None], BEAM_REACH * grid.radius * source
    return Beams(corners + middle - reach, corners + middle + reach)


def make_markers(geometry: FlatDetector, views: NDArray, grid: VoxelGrid) -> NDArray:
    """Return the edges (8 views, 2, 3) of a pyramid for each view; ``EDGE`` sets its length."""
    begins, ends = make_beams(geometry, views, grid)
    apex, along = begins.mean(axis=1, keepdims=True), (ends - begins).mean(axis=1, keepdims=True)
    length = EDGE * np.median(np.linalg.norm(apex[:, 0] - grid.centre, axis=1))
    if not geometry.whole_lines:
        base = apex + (ends - apex) * length / np.linalg.norm(along, axis=2, keepdims=True)
    else:
        panels = geometry.panels(views)
        sides = [
            MARKER_WIDTH * length * side / np.linalg.norm(side, axis=1, keepdims=True)
            for side in (panels.along_u, panels.along_v)
        ]
        base = apex + np.stack([a * sides[0] + b * sides[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)
        apex = apex + length * panels.source[:, None]
    return np.concatenate([pyramid(tip, corners) for tip, corners in zip(apex[:, 0], base, strict=True)])


# -- Pictures of a run -----------------------------------------------------------------------------------------------------


CAPTIONS = {"side": "Cameras, and the box of the matter", "plan": "View from above", "far": "All nested boxes from above"}


def draw_photo_cameras(folder: Path, photos: Photos, judged: Photos | None, levels: int = 1) -> list[Image]:
    """Draw the photographs' cameras and the boxes of the model.

    Args:
        folder: run folder.
        photos: photographs to fit.
        judged: held-out photographs; may be None.
        levels: nested boxes of the model.
    """
    return _pictures(folder, survey_all_cameras(photos, judged, levels))


def survey_all_cameras(photos: Photos, judged: Photos | None, levels: int) -> PhotoSurvey:
    """Survey of fitted and held-out photographs, with the nested boxes of a fit."""
    frames = photos.survey.frames + (() if judged is None else judged.survey.frames)
    return replace(photos.survey, frames=frames, levels=levels)


def draw_view_cameras(folder: Path, scene: mi.Scene, views: Mapping[str, Sequence[View]]) -> list[Image]:
    """Draw the cameras of a scene's views around the box of its media; without pinhole cameras nothing is drawn.

    Args:
        folder: run folder.
        scene: the scene.
        views: views by key of ``mivol.photos.SPLITS``.
    """
    frames = tuple(
        PhotoFrame(Path(view.name), to_camera(view.sensor, view.name), split)
        for split, of in views.items()
        for view in of
        if view.sensor.class_name() == "PerspectiveCamera"
    )
    if not frames:
        return []
    return _pictures(folder, PhotoSurvey(folder, "a scene", frames, (), find_media_box(scene), "about its media", (0.0, 0.0)))


def draw_scanner(folder: Path, geometry: FlatDetector, grid: VoxelGrid, held_out: NDArray) -> list[Image]:
    """Draw sources and detectors of a scanner around the voxels.

    Args:
        folder: run folder.
        geometry: geometry of the scan.
        grid: the voxels.
        held_out: indices of the held-out views.
    """
    for part in PARTS:
        plot_scanner(geometry, grid, held_out, folder / f"scanner_{part}.png", part)
    count = geometry.shape[0]
    drawn = sum(map(len, select_views(count, held_out)))
    title = "Directions of the light" if geometry.whole_lines else "Positions of the source"
    captions = {
        "side": f"{title} in {f'{drawn} of ' * (drawn < count)}{count} views, some detectors, and the box of the voxels",
        "plan": CAPTIONS["plan"],
    }
    return [Image(path=f"scanner_{part}.png", role="picture", caption=captions[part]) for part in PARTS]


def _pictures(folder: Path, survey: PhotoSurvey) -> list[Image]:
    parts = list_parts(survey)
    for part in parts:
        plot_cameras(survey, folder / f"cameras_{part}.png", part)
    return [Image(path=f"cameras_{part}.png", role="picture", caption=CAPTIONS[part]) for part in parts]


# -- Page after a search for poses ------------------------------------------------------------------------------------------


PAGE = "poses.html"

PAGE_STYLE = (
    "body{font:16px sans-serif;max-width:60em;margin:2em auto;padding:0 1em}img{width:100%}pre{background:#eee;padding:.7em}"
)


def write_poses_page(folder: Path, poses: Poses) -> Path:
    """Write ``poses.html`` into the folder of the photographs, with everything in it.

    Raises:
        MivolError: a full disk, or a model that the reader refuses.
    """
    with tempfile.TemporaryDirectory() as place:
        plot_cameras(survey_photos(folder), Path(place) / "cameras.png")
        picture = base64.b64encode((Path(place) / "cameras.png").read_bytes()).decode()
    name = shlex.quote(str(folder))
    rows = [
        ("photographs with a pose", f"{len(poses.posed)} of {len(poses.posed) + len(poses.unposed)}"),
        ("mean reprojection error", f"{poses.error:.2f} pixels"),
        ("points", str(poses.points)),
        ("cameras (lens and size)", str(poses.cameras)),
        ("without a pose", ", ".join(poses.unposed) or "none"),
        ("pairs of photographs that contradict the poses", f"{poses.against[0]} of {poses.against[1]}"),
        ("damaged, or copies of others", ", ".join(poses.left_out) or "none"),
        ("in separate models", ", ".join(", ".join(names) for names in poses.others) or "none"),
    ]
    table = "".join(f"<tr><th align=left>{html.escape(head)}</th><td>{html.escape(cell)}</td></tr>" for head, cell in rows)
    doubt = html.escape(poses.describe_doubt())
    text = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Poses of {html.escape(folder.name)}</title>'
        f"<style>{PAGE_STYLE}</style></head><body><h1>Poses of {html.escape(folder.name)}</h1><table>{table}</table>"
        f"<p><b>{doubt}</b></p>"
        "<p>The cameras, with the box of a fit. An error above 1.5 pixels is a sign of blur, or of a subject that moved. The "
        "cameras should stand where you took the photographs. If they do not, sides of the subject that look alike were taken "
        "for the same side: put things that differ beside each, and photograph it again.</p>"
        f'<img alt="cameras" src="data:image/png;base64,{picture}"><p>Next:</p>'
        f"<pre>mivol view {html.escape(name)}\nmivol optimize --as gaussians {html.escape(name)}</pre></body></html>\n"
    )
    write_whole_text(folder / PAGE, text)
    return folder / PAGE
