"""Figures of a scanner: sources and detectors around the box of the voxels.

Conventions. A small pyramid marks a view. The pyramid of a point source opens towards the detector, like the pyramid of a
camera; the apex of a pyramid of parallel light points in the direction of the light. The colour shows whether a view was
fitted. A few detectors are drawn at their true size.
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

MOST_VIEWS = 60
"""Largest number of drawn views, for fitted and for held-out views."""

DETECTORS = 8
"""Number of drawn detectors."""

BEAM_REACH = 1.5
"""Distance from the centre of the voxels to both ends of a drawn parallel beam [radius of the voxels]."""

MARKER_WIDTH = 0.2
"""Half the width of a marker of parallel light divided by its length."""

FITTED, HELD_OUT, DETECTOR, FIRST = "fitted view", "held-out view", "detector of some views", "beam of the first view"


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
