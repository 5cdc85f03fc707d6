"""Where the source and the detector of a scanner stand about the voxels, as a picture.

Conventions. A small pyramid stands for a view: of a point source it opens towards the detector, as that of a camera does; of
parallel light its tip says which way the light goes. Colours say which views were fitted. A few detectors
are drawn in their true size.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mivol.report.cameras import EDGE, Arrangement, Strokes, plot_arrangement, pyramid, rectangle
from mivol.report.figures import FAINT, SERIES
from mivol.tomography.geometry import FlatDetector, VoxelGrid

__all__ = ["MOST_VIEWS", "plot_scanner", "select_views"]

MOST_VIEWS = 60
"""That are drawn of those that were fitted, and of those held out."""

DETECTORS = 8
"""That are drawn."""

AWAY = 1.5
"""Radii of the voxels from their middle to where parallel light is drawn to begin and to end: along a beam it has no place."""

HEAD = 0.2
"""Half the width of a tip of parallel light over its length."""

FITTED, HELD_OUT, DETECTOR, FIRST = "fitted view", "held-out view", "detector of some views", "beam of the first view"


class Beams(NamedTuple):
    """Four corners of the beam of each view, (views, 4, 3) each [length], where it begins and on the detector."""

    begins: NDArray
    ends: NDArray


def plot_scanner(
    geometry: FlatDetector, grid: VoxelGrid, held_out: NDArray, path: str | Path | None = None, part: str | None = None
) -> Figure:
    """Sources, detectors and the box of the voxels, from the side and from above.

    Args:
        geometry: of the scanner, with all views.
        grid: the voxels.
        held_out: numbers of the views that were not fitted.
        path: written there (.svg, .png) if given.
        part: one of :data:`mivol.report.cameras.PARTS` alone; None: both in one figure.

    Raises:
        MivolError: another suffix.
    """
    count = geometry.shape[0]
    strokes = [
        Strokes(label, colour, make_markers(geometry, views, grid))
        for label, colour, views in zip((FITTED, HELD_OUT), SERIES, select_views(count, held_out), strict=False)
        if len(views)
    ]
    some = make_beams(geometry, _spread(np.arange(count), DETECTORS), grid)
    strokes += [
        Strokes(DETECTOR, SERIES[2], np.concatenate([rectangle(corners) for corners in some.ends])),
        Strokes(FIRST, FAINT, np.stack([some.begins[0], some.ends[0]], axis=1)),
    ]
    up = int(np.argmax(np.abs(geometry.panels().along_v.mean(axis=0))))
    box = np.asarray(grid.centre) + np.outer([-0.5, 0.5], grid.extent)
    arranged = Arrangement(strokes, box, np.empty((0, 3)), up)
    return plot_arrangement(arranged, f"{count} views and the box of the voxels", path, part)


def select_views(count: int, held_out: NDArray) -> tuple[NDArray, NDArray]:
    """Numbers of the views that are drawn, spread evenly over those that were fitted and over those held out."""
    return _spread(np.setdiff1d(np.arange(count), held_out), MOST_VIEWS), _spread(np.asarray(held_out, int), MOST_VIEWS)


def _spread(numbers: NDArray, most: int) -> NDArray:
    return numbers if len(numbers) <= most else numbers[np.arange(most) * len(numbers) // most]


def make_beams(geometry: FlatDetector, views: NDArray, grid: VoxelGrid) -> Beams:
    """Beams of some views, with the corners of the detector in turn."""
    panels = geometry.panels(views)
    _, rows, columns = geometry.shape
    places = np.array([(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)])
    corners = panels.corner[:, None] + places[:, :1] * panels.along_u[:, None] + places[:, 1:] * panels.along_v[:, None]
    source = panels.source[:, None]
    if not geometry.whole_lines:
        return Beams(np.broadcast_to(source, corners.shape), corners)
    # The source of parallel light is its direction, and its detector stands in the plane of the axis.
    middle, reach = source * (source @ np.asarray(grid.centre))[..., None], AWAY * grid.radius * source
    return Beams(corners + middle - reach, corners + middle + reach)


def make_markers(geometry: FlatDetector, views: NDArray, grid: VoxelGrid) -> NDArray:
    """(8 views, 2, 3) a pyramid for each view, as long as EDGE of the median distance from the middle of the voxels."""
    begins, ends = make_beams(geometry, views, grid)
    apex, along = begins.mean(axis=1, keepdims=True), (ends - begins).mean(axis=1, keepdims=True)
    length = EDGE * np.median(np.linalg.norm(apex[:, 0] - grid.centre, axis=1))
    if not geometry.whole_lines:
        base = apex + (ends - apex) * length / np.linalg.norm(along, axis=2, keepdims=True)
    else:
        panels = geometry.panels(views)
        sides = [
            HEAD * length * side / np.linalg.norm(side, axis=1, keepdims=True) for side in (panels.along_u, panels.along_v)
        ]
        base = apex + np.stack([a * sides[0] + b * sides[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)
        apex = apex + length * panels.source[:, None]
    return np.concatenate([pyramid(tip, corners) for tip, corners in zip(apex[:, 0], base, strict=True)])
