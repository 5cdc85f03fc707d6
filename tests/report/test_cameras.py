"""Pictures of cameras and scanners: up stays up, right-handed, and every line lies where its camera or ray runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from photo_sets import write_blender
from scipy.spatial.transform import Rotation
from tiny_experiment import SCENE, write_experiment

from mivol.photos import Camera, PhotoSurvey, survey_photos
from mivol.photos.survey import PhotoFrame
from mivol.report import cameras
from mivol.report.cameras import (
    BEAM_REACH,
    DETECTORS,
    EDGE,
    FAR,
    LABELS,
    MARKER_WIDTH,
    MOST_POINTS,
    MOST_VIEWS,
    PARTS,
    WIDTH,
    draw_scanner,
    frustum_edges,
    list_parts,
    plot_cameras,
    plot_scanner,
    select_views,
)
from mivol.report.figures import INK
from mivol.scene.sensors import find_media_box
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import PanelViews

TURNS = {"x": [0, 90, 0], "y": [-90, 0, 0], "z": [0, 0, 0], "-y": [90, 0, 0]}
"""Angles about x, y and z that take z to an axis."""


def turned(survey: PhotoSurvey, up: str) -> PhotoSurvey:
    """The cameras and the box with another axis of the world upwards."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", TURNS[up], degrees=True).as_matrix()
    frames = tuple(replace(f, camera=replace(f.camera, to_world=pose @ f.camera.to_world)) for f in survey.frames)
    corners = survey.box @ pose[:3, :3].T
    return replace(survey, frames=frames, box=np.array([corners.min(axis=0), corners.max(axis=0)]))


@pytest.fixture
def survey(tmp_path: Path) -> PhotoSurvey:
    found = survey_photos(write_blender(tmp_path / "set"), held_out=2)
    return replace(found, box=np.array([[-1.0, -2.0, -3.0], [1.5, 2.5, 3.5]]))


@pytest.mark.parametrize(("up", "order"), [("x", (1, 2, 0)), ("y", (2, 0, 1)), ("z", (0, 1, 2)), ("-y", (2, 0, 1))])
def test_up_is_vertical_and_the_axes_are_right_handed(survey: PhotoSurvey, up: str, order: tuple[int, int, int]) -> None:
    """Cameras on a ring around the up axis: vertical in the side view, and the plan shows the other axes.

    With -y up, the values of y and of a horizontal axis fall: a half turn.
    """
    stands = turned(survey, up)
    side, plan = plot_cameras(stands).axes
    assert [side.get_xlabel(), side.get_ylabel(), side.get_zlabel()] == [f"{'xyz'[k]} [length]" for k in order]
    assert plan.get_title(loc="left") == f"from above ({up} is up)"
    assert (plan.get_xlabel(), plan.get_ylabel()) == tuple(f"{'xyz'[k]} [length]" for k in order[:2])
    assert np.linalg.det(np.eye(3)[list(order)]) == 1
    is_down = up.startswith("-")
    ends = (side.get_xlim(), side.get_ylim(), side.get_zlim(), plan.get_xlim(), plan.get_ylim())
    assert [low > high for low, high in ends] == [False, is_down, is_down, False, is_down]
    cameras = np.array([frame.camera.origin for frame in stands.frames])
    drawn = {line.get_label(): np.array(line.get_data()).T for line in plan.lines}
    lifted = {label: np.array(line.get_data_3d()).T for label, line in zip(drawn, side.lines, strict=True)}
    for split in ("train", "held_out", "test"):
        own = cameras[[frame.split == split for frame in stands.frames]]
        begins = drawn[LABELS[split]].reshape(len(own), 8, 3, 2)[:, :4, 0]
        np.testing.assert_allclose(begins, np.repeat(own[:, None, order[:2]], 4, axis=1))
        np.testing.assert_allclose(
            lifted[LABELS[split]].reshape(len(own), 8, 3, 3)[:, :4, 0], np.repeat(own[:, None, order], 4, axis=1)
        )
    for found, axes in ((drawn["box"], order[:2]), (lifted["box"], order)):
        edges = found.reshape(12, 3, len(axes))
        assert np.isnan(edges[:, 2]).all()
        # The turn of the box is rounded by 2^-53 a term.
        np.testing.assert_allclose(edges[:, :2].min(axis=(0, 1)), stands.box[0][list(axes)])
        np.testing.assert_allclose(edges[:, :2].max(axis=(0, 1)), stands.box[1][list(axes)])


def test_the_side_view_has_equal_scales(survey: PhotoSurvey) -> None:
    """A unit has the same length along each axis, and all strokes lie inside."""
    side, plan = plot_cameras(survey).axes
    limits = np.array([side.get_xlim(), side.get_ylim(), side.get_zlim()]).T
    drawn = np.concatenate([np.array(line.get_data_3d()).T for line in side.lines])
    np.testing.assert_allclose(limits, [np.nanmin(drawn, axis=0), np.nanmax(drawn, axis=0)])
    # Of three dimensions matplotlib tells the proportions of the drawn box in this attribute alone.
    ratios = side._box_aspect / np.ptp(limits, axis=0)
    np.testing.assert_allclose(ratios / ratios[0], 1)
    assert plan.get_aspect() == 1


@pytest.mark.parametrize("part", PARTS)
def test_a_panel_can_stand_alone(survey: PhotoSurvey, part: str) -> None:
    """On a page the panels are stacked, because a figure of both would be too small."""
    (alone,) = plot_cameras(survey, part=part).axes
    both = plot_cameras(survey).axes[PARTS.index(part)]
    assert (alone.name, len(alone.lines)) == (both.name, len(both.lines))
    assert alone.get_subplotspec().get_geometry()[:2] == (1, 1)
    assert alone.figure.get_size_inches().tolist() == [WIDTH, WIDTH]


def test_edges_of_a_view_go_through_the_corners_of_its_film() -> None:
    """A camera at (1, 2, 3) that looks along -z: its corner (u, v) is at ((u - cx) / fx, (cy - v) / fy, -1)."""
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    camera = Camera(np.array([[20.0, 0, 7], [0, 10, 3], [0, 0, 1]]), (12, 8), pose)
    edges = frustum_edges(PhotoFrame(Path("a.png"), camera, "train"), 2.0)
    corners = np.array([1, 2, 3]) + 2 * np.array([[-0.35, 0.3, -1], [0.25, 0.3, -1], [0.25, -0.5, -1], [-0.35, -0.5, -1]])
    np.testing.assert_allclose(edges[:4], np.stack([np.tile([1.0, 2, 3], (4, 1)), corners], axis=1))
    np.testing.assert_allclose(edges[4:], np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))


def test_views_are_drawn_as_long_as_the_cameras_are_far(survey: PhotoSurvey) -> None:
    """Along its axis a view is EDGE of the median distance from the middle of the box."""
    plan = plot_cameras(survey).axes[1]
    middle = survey.box.mean(axis=0)
    length = EDGE * np.median([np.linalg.norm(frame.camera.origin - middle) for frame in survey.frames])
    first = next(frame for frame in survey.frames if frame.split == "train")
    own = np.array(plan.lines[0].get_data()).T.reshape(-1, 8, 3, 2)[0]
    np.testing.assert_allclose(own[:, :2], frustum_edges(first, length)[:, :, :2])


@pytest.mark.parametrize(("many", "shown"), [(MOST_POINTS - 1, MOST_POINTS - 1), (3 * MOST_POINTS, MOST_POINTS)])
def test_points_in_the_box_are_shown_up_to_a_number(survey: PhotoSurvey, many: int, shown: int) -> None:
    """One point lies outside on each side of the box; the others are on its faces and within."""
    grid = np.linspace(survey.box[0], survey.box[1], many)
    beyond = [survey.box[k] + (2 * k - 1) * step for k in (0, 1) for step in np.eye(3)]
    side, plan = plot_cameras(replace(survey, points=np.concatenate([grid, beyond]))).axes
    points = np.asarray(plan.collections[0].get_offsets())
    np.testing.assert_allclose(points, grid[:: many // shown, :2])
    np.testing.assert_allclose(np.transpose(side.collections[0]._offsets3d), grid[:: many // shown])


CUBE = np.array([[-1.5] * 3, [1.5] * 3])
"""Cameras stand 4 away from its middle, on a ring 1 above it, and look inwards: the second box does not hold them, the third
(6 to each side) does."""


def edges_of(axes: Axes) -> list[float]:
    """Half the edge of each box that is drawn from above."""
    return [float(np.nanmax(line.get_xdata())) for line in axes.lines if line.get_color() == INK]


def test_a_third_panel_shows_all_nested_boxes(survey: PhotoSurvey) -> None:
    """The first panels show the boxes up to the farthest camera. Each panel shows the points inside its boxes."""
    points = np.array([[0.0, 0, 0], [5.0, 0, 0], [20, 0, 0], [30, 0, 0]])
    nested = replace(survey, box=CUBE, levels=5, points=points)
    side, plan, far = plot_cameras(nested).axes
    assert list_parts(nested) == (*PARTS, FAR) and list_parts(survey) == PARTS
    assert (edges_of(plan), edges_of(far)) == ([1.5, 3, 6], [1.5, 3, 6, 12, 24])
    assert [line.get_linewidth() for line in far.lines[-5:]] == [1.3, 0.6, 0.6, 0.6, 0.6]
    assert far.get_title(loc="left").startswith("all boxes") and plan.get_title(loc="left").startswith("from above")
    assert [len(axes.collections[0].get_offsets()) for axes in (plan, far)] == [2, 3]
    assert len(side.collections[0]._offsets3d[0]) == 2 and side.get_xlim() == (-6, 6)
    shown = [text.get_text() for text in far.get_legend().get_texts()]
    assert shown[-2:] == ["innermost box", "larger boxes"] and nested.path.name in plan.figure.get_suptitle()
    assert "5 nested boxes" in plan.figure.get_suptitle()
    (alone,) = plot_cameras(nested, part=FAR).axes
    assert edges_of(alone) == edges_of(far) and len(alone.figure.legends) == 1


def test_a_third_panel_is_unnecessary_for_few_boxes(survey: PhotoSurvey) -> None:
    """Two boxes hold no camera, three boxes hold all: in both cases the first panels show every box."""
    for levels in (2, 3):
        found = replace(survey, box=CUBE, levels=levels)
        assert list_parts(found) == PARTS and len(edges_of(plot_cameras(found).axes[1])) == levels


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[PhotoSurvey, Path, str]]:
    """What is drawn, and where."""
    found: list = []
    monkeypatch.setattr(cameras, "plot_cameras", lambda *given: found.append(given))
    return found


def test_cameras_that_judge_are_drawn_too(tmp_path: Path, drawn: list) -> None:
    """In the box that was fitted in; one picture from the side and one from above."""
    write_blender(tmp_path / "set")
    train, test = (survey_photos(tmp_path / "set", split=split) for split in ("train", "test"))
    photos, judged = (SimpleNamespace(survey=survey) for survey in (train, test))
    images = cameras.draw_photo_cameras(tmp_path, photos, judged)
    assert [(i.path, i.role) for i in images] == [("cameras_side.png", "picture"), ("cameras_plan.png", "picture")]
    assert all(i.caption for i in images)
    assert [(path.name, part) for _, path, part in drawn] == [("cameras_side.png", "side"), ("cameras_plan.png", "plan")]
    for survey, _, _ in drawn:
        assert survey.frames == train.frames + test.frames and survey.box is train.box
    drawn.clear()
    cameras.draw_photo_cameras(tmp_path, photos, None)
    assert drawn[0][0].frames == train.frames


def test_pinholes_of_a_scene_are_drawn_about_its_media(variant_rgb, tmp_path: Path, drawn: list) -> None:
    write_experiment(tmp_path)
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    flat = mi.load_dict({"type": "orthographic"})
    views = [SimpleNamespace(name=name, sensor=sensor) for name, sensor in (("a", scene.sensors()[0]), ("b", flat))]
    images = cameras.draw_view_cameras(tmp_path, scene, {"train": [views[0]], "held_out": views})
    survey = drawn[0][0]
    assert [(f.camera.name, f.split) for f in survey.frames] == [("a", "train"), ("a", "held_out")] and len(images) == 2
    np.testing.assert_allclose(survey.frames[0].camera.origin, [0, 1, 4], atol=1e-6)
    assert 'origin="0, 1, 4"' in SCENE
    np.testing.assert_array_equal(survey.box, find_media_box(scene))
    assert cameras.draw_view_cameras(tmp_path, scene, {"train": views[1:]}) == []


ANGLES = np.arange(12) * np.pi / 6
GRID = VoxelGrid((4, 6, 8), 0.5, (1.0, 2.0, -0.5))
CONE = ConeBeam(ANGLES, (5, 7), 6.0, 9.0, (0.5, 0.25), axis_offset=0.3, detector_offset=(0.2, -0.1))
PARALLEL = ParallelBeam(ANGLES, (5, 7), (0.5, 0.25), axis_offset=0.3)
HELD_OUT = np.array([1, 7])
SPLITS = {"fitted view": np.setdiff1d(np.arange(12), HELD_OUT), "held-out view": HELD_OUT}
SOME = np.arange(DETECTORS) * 12 // DETECTORS
SCANNER_LABELS = ["fitted view", "held-out view", "detector of some views", "beam of the first view", "box"]


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
    assert list(found) == SCANNER_LABELS
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
    assert list(found) == SCANNER_LABELS
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
    assert [line.get_label() for line in plan.lines] == [label for label in SCANNER_LABELS if label != "held-out view"]


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
