"""The picture of a set's cameras: what is up stays up, right-handed, and every line lies where its camera says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from photo_sets import write_blender
from scipy.spatial.transform import Rotation

from mivol.photos import Camera, PhotoSurvey, survey_photos
from mivol.photos.survey import PhotoFrame
from mivol.report.cameras import EDGE, FAR, LABELS, MOST_POINTS, PARTS, WIDTH, list_parts, outline, plot_cameras
from mivol.report.figures import INK

TURNS = {"x": [0, 90, 0], "y": [-90, 0, 0], "z": [0, 0, 0]}
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


@pytest.mark.parametrize(("up", "order"), [("x", (1, 2, 0)), ("y", (2, 0, 1)), ("z", (0, 1, 2))])
def test_up_is_vertical_and_the_axes_are_right_handed(survey: PhotoSurvey, up: str, order: tuple[int, int, int]) -> None:
    """Cameras on a ring around the up axis: vertical in the side view, and the plan shows the other axes."""
    stands = turned(survey, up)
    side, plan = plot_cameras(stands).axes
    assert [side.get_xlabel(), side.get_ylabel(), side.get_zlabel()] == [f"{'xyz'[k]} [length]" for k in order]
    assert plan.get_title(loc="left") == f"from above ({up} is up)"
    assert (plan.get_xlabel(), plan.get_ylabel()) == tuple(f"{'xyz'[k]} [length]" for k in order[:2])
    assert np.linalg.det(np.eye(3)[list(order)]) == 1
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
    edges = outline(PhotoFrame(Path("a.png"), camera, "train"), 2.0)
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
    np.testing.assert_allclose(own[:, :2], outline(first, length)[:, :, :2])


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
