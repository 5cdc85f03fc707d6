"""Camera paths of films: circles, paths through views and keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from photo_sets import look_at, ring
from refusals import assert_refused
from scipy.spatial.transform import Rotation

from mivol.photos import Camera, aim_camera, interpolate_cameras, intrinsics, project, turntable
from mivol.photos.camera_path import WIDE, HomeView, find_home_view
from mivol.photos.lens import Panorama

LIKE = Camera(intrinsics(90, 100, 30, 20), (64, 48), np.eye(4))
BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def cameras_of(poses: list[np.ndarray]) -> list[Camera]:
    """Return cameras like LIKE at the given poses."""
    return [Camera(LIKE.K, LIKE.size, pose) for pose in poses]


def test_aim_camera_centres_the_target_and_keeps_up() -> None:
    camera = aim_camera(LIKE, np.array([3.0, 1, 2]), np.array([0.5, 0, 0]), np.array([0, 0, 1]))
    np.testing.assert_allclose(project(camera, np.array([0.5, 0, 0]))[0], (32, 24), atol=1e-12)
    x, y = project(camera, np.array([0.5, 0, 0.1]))[0]
    assert x == pytest.approx(32, abs=1e-12) and y < 24
    assert camera.K[0, 0] == camera.K[1, 1] == 100
    assert_refused("along the upward direction", aim_camera, LIKE, np.array([0.0, 0, 2]), np.zeros(3), np.array([0, 0, 1]))


@pytest.mark.parametrize("middle", [(0, 0, 0), (5.0, -3.0, 2.0)])
def test_turntable_around_a_ring_is_the_ring(middle: tuple[float, ...]) -> None:
    """Photographs at distance 4 and height 1 around z give a path at the same distance and height, in equal steps."""
    poses = np.array(ring(12))
    poses[:, :3, 3] += middle
    found = turntable(cameras_of(list(poses)), BOX + middle, 5)
    places = np.array([camera.origin for camera in found]) - middle
    np.testing.assert_allclose(places[:, 2], 1, atol=1e-12)
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1]), 4, atol=1e-12)
    steps = np.diff(np.unwrap(np.arctan2(places[:, 1], places[:, 0])))
    np.testing.assert_allclose(np.abs(steps), 2 * np.pi / 5, atol=1e-12)
    for camera in found:
        np.testing.assert_allclose(project(camera, np.array(middle, float))[0], (32, 24), atol=1e-12)


def test_in_a_room_or_above_a_floor_films_and_first_views_aim_at_the_focus() -> None:
    """The middle of a room's box may lie anywhere, as of a table's and its floor, above which the cameras stand; a box that
    cameras stand around is looked at itself."""
    cameras, room, floor = cameras_of(ring(12)), np.array([[-9.0, -5, -3], [5, 9, 20]]), np.array([[-9.0, -5, -3], [5, 9, 0.5]])
    for camera in turntable(cameras, room, 5) + turntable(cameras, floor, 5):
        np.testing.assert_allclose(project(camera, np.zeros(3))[0], (32, 24), atol=1e-12)
    np.testing.assert_allclose(find_home_view(cameras, room).target, 0, atol=1e-12)
    small = np.array([[0.0, 0, 0], [2, 1, 1]])
    np.testing.assert_allclose(project(turntable(cameras, small, 5)[0], small.mean(axis=0))[0], (32, 24), atol=1e-12)
    outwards = cameras_of([pose @ np.diag([-1.0, 1, -1, 1]) for pose in ring(12)])
    np.testing.assert_allclose(project(turntable(outwards, room, 5)[0], room.mean(axis=0))[0], (32, 24), atol=1e-12)


def test_films_have_the_most_common_size() -> None:
    cameras = cameras_of(ring(4))
    cameras[0] = cameras[0].resized((8, 6))
    assert {camera.size for camera in turntable(cameras, BOX, 3)} == {LIKE.size}


def test_turntable_of_an_arc_swings_between_its_ends() -> None:
    """Photographs between azimuth 20 and 120: the path reaches both ends and stays between them."""
    azimuths = np.radians(np.linspace(20, 120, 6))
    poses = [look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 0.5])) for a in azimuths]
    found = turntable(cameras_of(poses), BOX, 40)
    angles = np.degrees([np.arctan2(camera.origin[1], camera.origin[0]) for camera in found])
    assert angles.min() == pytest.approx(20, abs=1e-3) and angles.max() == pytest.approx(120, abs=1e-3)


def test_a_path_between_views_passes_through_each_view() -> None:
    given = cameras_of(ring(4))
    found = interpolate_cameras(given, 7)
    for camera, wanted in zip(found[::2], given, strict=True):
        np.testing.assert_allclose(camera.to_world, wanted.to_world, atol=1e-9)
    np.testing.assert_allclose(interpolate_cameras(given[:2], 3)[2].to_world, given[1].to_world, atol=1e-9)
    assert_refused("found 1 cameras", interpolate_cameras, given[:1], 5)


def test_turntable_needs_a_common_upward_direction() -> None:
    turned = [pose @ np.diag([-1.0, -1, 1, 1]) for pose in ring(4)]
    assert_refused("common upward direction", turntable, cameras_of(ring(4) + turned), BOX, 4)


def test_the_first_view_is_upright_and_looks_at_the_box() -> None:
    """Cameras of a ring in a tilted world, one of them turned away from the middle: the others' up, and not that camera."""
    tilt = Rotation.from_rotvec([2.0, 0.3, -0.4]).as_matrix()
    poses = ring(5)
    poses[0] = look_at(poses[0][:3, 3], (0.0, 1.0, 0.5))
    cameras = []
    for k, pose in enumerate(poses):
        turned = np.eye(4)
        turned[:3] = tilt @ pose[:3]
        cameras.append(Camera(intrinsics(20, 20, 6, 4), (12, 8), turned, name=f"{k}"))
    view = find_home_view(cameras, np.array([[-1.0] * 3, [1.0] * 3]))
    np.testing.assert_allclose(view.up, tilt @ [0, 0, 1], atol=1e-6)  # the weight of the vertical image axes
    np.testing.assert_allclose(view.target, 0, atol=1e-9)
    assert not np.allclose(view.origin, cameras[0].origin)
    assert (view.size, view.scaled(120)) == ((12, 8), (120, 80))
    np.testing.assert_allclose(view.fov, 2 * np.degrees(np.arctan(6 / 20)))
    assert HomeView.from_numbers(view.numbers, "file") == view


def test_the_first_view_through_a_wide_lens_is_as_wide_as_a_plain_one() -> None:
    """A panorama sees all around; its first view has WIDE degrees."""
    cameras = [Camera(intrinsics(64 / (2 * np.pi), 48 / np.pi, 32, 24), (64, 48), pose, Panorama()) for pose in ring(4)]
    assert find_home_view(cameras, BOX).fov == WIDE


@pytest.mark.parametrize("numbers", [(1.0,) * 11, (np.nan,) * 12, (1.0,) * 9 + (0.0, 4.0, 4.0)])
def test_numbers_of_no_view_are_refused(numbers: tuple[float, ...]) -> None:
    assert_refused("found a first view of .* expected 12 numbers", HomeView.from_numbers, numbers, "file")
