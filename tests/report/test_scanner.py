"""The picture of a scanner: sources, beams and detectors stand where the rays of the projector run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mivol.experiments.camera_pictures import draw_scanner
from mivol.report.cameras import EDGE
from mivol.report.scanner import BEAM_REACH, DETECTORS, MARKER_WIDTH, MOST_VIEWS, plot_scanner, select_views
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import PanelViews

ANGLES = np.arange(12) * np.pi / 6
GRID = VoxelGrid((4, 6, 8), 0.5, (1.0, 2.0, -0.5))
CONE = ConeBeam(ANGLES, (5, 7), 6.0, 9.0, (0.5, 0.25), axis_offset=0.3, detector_offset=(0.2, -0.1))
PARALLEL = ParallelBeam(ANGLES, (5, 7), (0.5, 0.25), axis_offset=0.3)
HELD_OUT = np.array([1, 7])
SPLITS = {"fitted view": np.setdiff1d(np.arange(12), HELD_OUT), "held-out view": HELD_OUT}
SOME = np.arange(DETECTORS) * 12 // DETECTORS
LABELS = ["fitted view", "held-out view", "detector of some views", "beam of the first view", "box"]


def strokes_of(figure: Figure) -> dict[str, NDArray]:
    """Edges (N, 2, 3) by the labels of the legend, as they are drawn from the side, where z is up."""
    side, plan = figure.axes
    pens = [np.array(line.get_data_3d()).T.reshape(-1, 3, 3)[:, :2] for line in side.lines]
    for line, pen in zip(plan.lines, pens, strict=True):
        np.testing.assert_array_equal(np.array(line.get_data()).T.reshape(-1, 3, 2)[:, :2], pen[:, :, :2])
    return dict(zip([line.get_label() for line in plan.lines], pens, strict=True))


def directions(views: NDArray) -> NDArray:
    """(views, 3) which way the middle of the beam runs."""
    return np.stack([-np.sin(ANGLES[views]), np.cos(ANGLES[views]), 0 * views], axis=1)


def corners(geometry: ConeBeam | ParallelBeam, views: NDArray, depth: NDArray) -> NDArray:
    """(views, 4, 3) where the corners of the detector lie, found by rays alone: rays of pixel centres meet the plane that is so
    deep along the beam, and the corners are half a pixel beyond the outermost of these points."""
    o, d = geometry.rays(views)
    along = directions(views)[:, None, None]
    points = o + d * ((depth[:, None, None] - (o * along).sum(3)) / (d * along).sum(3))[..., None]
    for axis in (1, 2):
        first, second, last, before = (np.take(points, k, axis) for k in (0, 1, -1, -2))
        points = np.stack([1.5 * first - 0.5 * second, 1.5 * last - 0.5 * before], axis=axis)
    return points[:, [0, 0, 1, 1], [0, 1, 1, 0]]


def around(places: NDArray) -> NDArray:
    """Edges (views, 4, 2, 3) from each corner (views, 4, 3) to the next."""
    return np.stack([places, np.roll(places, -1, axis=1)], axis=2)


def test_a_point_source_opens_towards_its_detector() -> None:
    """Each pyramid starts at the common origin of the rays of its view, and its edges run to the corners of the detector. Its
    length along the axis is EDGE of the median distance of the sources from the voxels."""
    found = strokes_of(plot_scanner(CONE, GRID, HELD_OUT))
    assert list(found) == LABELS
    for label, views in SPLITS.items():
        sources, ends = CONE.rays(views)[0][:, 0, 0], corners(CONE, views, np.full(len(views), 3.0))
        length = EDGE * np.median(np.linalg.norm(sources - GRID.centre, axis=1))
        axis = np.linalg.norm(ends.mean(axis=1) - sources, axis=1)
        tips = sources[:, None] + (ends - sources[:, None]) * (length / axis)[:, None, None]
        pyramids = found[label].reshape(len(views), 8, 2, 3)
        np.testing.assert_allclose(pyramids[:, :4, 0], np.repeat(sources[:, None], 4, axis=1), atol=1e-12)
        np.testing.assert_allclose(pyramids[:, :4, 1], tips, atol=1e-12)
        np.testing.assert_allclose(pyramids[:, 4:], around(tips), atol=1e-12)
    some = corners(CONE, SOME, np.full(len(SOME), 3.0))
    np.testing.assert_allclose(found["detector of some views"].reshape(-1, 4, 2, 3), around(some), atol=1e-12)
    first = np.stack([np.repeat(CONE.rays([0])[0][0, :1, 0], 4, axis=0), some[0]], axis=1)
    np.testing.assert_allclose(found["beam of the first view"], first, atol=1e-12)
    box = found["box"].reshape(-1, 3)
    np.testing.assert_allclose([box.min(axis=0), box.max(axis=0)], [[-1, 0.5, -1.5], [3, 3.5, 0.5]])


def test_parallel_light_points_along_its_rays() -> None:
    """Markers are BEAM_REACH radii in front of the centre of the voxels, detectors equally far behind it."""
    found = strokes_of(plot_scanner(PARALLEL, GRID, HELD_OUT))
    assert list(found) == LABELS
    away, centre = BEAM_REACH * GRID.radius, np.array(GRID.centre)
    for label, views in SPLITS.items():
        along = directions(views)
        begins = corners(PARALLEL, views, along @ centre - away).mean(axis=1)
        length = EDGE * np.median(np.linalg.norm(begins - centre, axis=1))
        pyramids = found[label].reshape(len(views), 8, 2, 3)
        np.testing.assert_allclose(pyramids[:, :4, 0], np.repeat((begins + length * along)[:, None], 4, axis=1), atol=1e-12)
        base = pyramids[:, :4, 1] - begins[:, None]
        np.testing.assert_allclose(base.mean(axis=1), 0, atol=1e-12)
        np.testing.assert_allclose(base @ along[..., None], 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(base, axis=2), np.sqrt(2) * MARKER_WIDTH * length)
    along = directions(SOME)
    some = corners(PARALLEL, SOME, along @ centre + away)
    np.testing.assert_allclose(found["detector of some views"].reshape(-1, 4, 2, 3), around(some), atol=1e-12)
    begin = corners(PARALLEL, SOME[:1], along[:1] @ centre - away)[0]
    np.testing.assert_allclose(found["beam of the first view"], np.stack([begin, some[0]], axis=1), atol=1e-12)


def test_up_is_along_the_columns_of_the_detector() -> None:
    """A table of views that rotates about x; without held-out views their label is missing."""
    u, w = (
        np.stack([np.zeros(12), *pair], axis=1)
        for pair in ((np.cos(ANGLES), np.sin(ANGLES)), (-np.sin(ANGLES), np.cos(ANGLES)))
    )
    table = np.column_stack([-6 * w, 3 * w, 0.25 * u, np.tile([0.5, 0, 0], (12, 1))])
    side, plan = plot_scanner(PanelViews(table, (5, 7)), GRID, np.arange(0)).axes
    assert plan.get_title(loc="left") == "from above (x is up)" and side.get_zlabel() == "x [length]"
    assert [line.get_label() for line in plan.lines] == [label for label in LABELS if label != "held-out view"]


@pytest.mark.parametrize(("count", "every"), [(MOST_VIEWS, 5), (10 * MOST_VIEWS, 2)])
def test_drawn_views_are_evenly_spread(count: int, every: int) -> None:
    """Of many views, including the first of each kind."""
    held_out = np.arange(0, count, every)
    for shown, kind in zip(select_views(count, held_out), (np.setdiff1d(np.arange(count), held_out), held_out), strict=True):
        assert len(shown) == min(len(kind), MOST_VIEWS)
        assert shown[0] == kind[0] and np.isin(shown, kind).all()
        assert np.ptp(np.diff(shown)) <= every
        assert kind[-1] - shown[-1] < 2 * count / len(shown)


def test_captions_state_the_number_of_drawn_views(tmp_path: Path) -> None:
    """A source and parallel light have different captions."""
    images = draw_scanner(tmp_path, CONE, GRID, HELD_OUT)
    assert [(i.path, i.role) for i in images] == [("scanner_side.png", "picture"), ("scanner_plan.png", "picture")]
    assert images[0].caption == "Positions of the source in 12 views, some detectors, and the box of the voxels"
    many = ParallelBeam(np.arange(100.0), (5, 7))
    (first, _) = draw_scanner(tmp_path, many, GRID, HELD_OUT)
    assert first.caption.startswith(f"Directions of the light in {MOST_VIEWS + 2} of 100 views")
    assert all((tmp_path / image.path).is_file() for image in images)


def test_a_flat_side_view_has_one_vertical_tick() -> None:
    """The labels of more ticks would overlap."""
    slices = VoxelGrid((1, 6, 8), (0.5, 0.5, 0.01))
    side, _ = plot_scanner(ParallelBeam(ANGLES, (1, 7), (0.01, 0.5)), slices, np.arange(0)).axes
    ticks = [
        [low <= at <= high for at in axis.get_majorticklocs()]
        for axis, (low, high) in ((side.xaxis, side.get_xlim()), (side.zaxis, side.get_zlim()))
    ]
    assert sum(ticks[0]) > 2 >= sum(ticks[1])
