"""Captures of unbounded places before they are fitted: their box, the size at which they are held, and their settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from capture_photos import DISTANCE, SIZE, cameras, capture, write_capture
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.photos import Camera, intrinsics, load_photos, project, rays, survey_photos
from mivol.photos.camera import Motions, align_camera, move_camera
from mivol.photos.lens import Panorama
from mivol.photos.region import (
    FEWEST_VIEWS,
    MIDDLE,
    count_levels,
    find_free_distances,
    is_free_space,
    middle_box,
    nested_boxes,
    points_in_box,
    shared_box,
    viewing_distance,
)
from mivol.validate.metrics import fit_colours, score_image


def test_the_middle_box_is_a_cube_around_the_focus() -> None:
    """Cameras at one distance from the origin, their focus: half the edge is a share of the distance."""
    box = middle_box(cameras(9))
    np.testing.assert_allclose(box, MIDDLE * DISTANCE * np.array([[-1.0] * 3, [1.0] * 3]), atol=1e-9)
    far = [*cameras(9), *(Camera(c.K, c.size, _moved(c, 30.0)) for c in cameras(2))]
    # Two that stand elsewhere do not move the median.
    np.testing.assert_allclose(middle_box(far), box, atol=1e-9)


def test_the_middle_box_of_a_tele_lens_is_what_its_frames_share() -> None:
    """At five times the focal length frames share less than 0.45 of the distance; cameras that look around share nothing."""
    tele = [Camera(intrinsics(96, 96, 16, 12), SIZE, c.to_world, name=c.name) for c in cameras(9)]
    box, shared = middle_box(tele), shared_box(tele)
    half = (box[1] - box[0]) / 2
    np.testing.assert_allclose(half, (shared[1] - shared[0]).max() / 2, rtol=1e-12)
    # The frame is at most 1/6 of the distance from its middle to its edge, and three cells of the search wider.
    assert 1 / 8 * DISTANCE < half[0] < 1.25 / 6 * DISTANCE * 2**0.5 < MIDDLE * DISTANCE
    around = [Camera(c.K, c.size, _moved(c, -0.3)) for c in cameras(9)]
    reach = np.median([np.linalg.norm(c.origin) for c in around])
    np.testing.assert_allclose(middle_box(around), MIDDLE * reach * np.array([[-1.0] * 3, [1.0] * 3]), atol=1e-9)
    assert shared_box(around) is None


def test_the_viewing_distance_does_not_follow_far_points() -> None:
    """A box of points around a room has its middle elsewhere; parallel cameras have only the box."""
    room = np.array([[-10.0, -10, -10], [90, 50, 30]])
    assert viewing_distance(cameras(9), room) == pytest.approx(DISTANCE, rel=1e-9)
    parallel = [
        Camera(c.K, c.size, np.vstack([np.hstack([np.eye(3), [[k], [0], [0]]]), [0, 0, 0, 1]]), name=c.name)
        for k, c in enumerate(cameras(3))
    ]
    middle = room.mean(axis=0)
    assert viewing_distance(parallel, room) == pytest.approx(np.linalg.norm(middle - [1, 0, 0]), rel=1e-9)


@pytest.mark.parametrize(("focal", "within"), [(96.0, 1.0), (48.0, 1.0), (19.2, 0.35 * 19.2 / 16), (6.4, 0.25)])
def test_free_space_is_near_a_camera_and_seen_by_few(focal: float, within: float) -> None:
    """Against the definition, point by point. Half the longer edge is 16 pixels. Cameras at one place see the same points."""
    all_cameras = [Camera(intrinsics(focal, focal, 16, 12), SIZE, c.to_world, name=c.name) for c in cameras(7)]
    points = np.random.default_rng(3).uniform(-1.3 * DISTANCE, 1.3 * DISTANCE, (400, 3))

    def sees(camera: Camera, point: np.ndarray) -> bool:
        (x, y), depth = project(camera, point)
        return bool(depth > 0 and 0 <= x <= SIZE[0] and 0 <= y <= SIZE[1])

    nearest = np.array([min(np.linalg.norm(c.origin - p) for c in all_cameras) for p in points]) / DISTANCE
    count = np.array([sum(sees(c, p) for c in all_cameras) for p in points])
    free = (nearest < 0.25) | ((nearest < within) & (count < FEWEST_VIEWS))
    np.testing.assert_array_equal(is_free_space(all_cameras, points, DISTANCE), free)
    assert 0 < free.mean() < 0.9 and (free & (nearest > 0.25)).any() == (within > 0.25)
    ahead = all_cameras[0].origin + 0.3 * DISTANCE * all_cameras[0].forward[None]
    assert is_free_space(all_cameras[:1] * (FEWEST_VIEWS - 1), ahead, DISTANCE).all() == (within > 0.3)
    assert not is_free_space(all_cameras[:1] * FEWEST_VIEWS, ahead, DISTANCE).any()


def test_free_space_of_wide_lenses_is_close_to_the_lens() -> None:
    wide = [Camera(c.K, c.size, c.to_world, Panorama()) for c in cameras(3)]
    assert find_free_distances(wide, DISTANCE) == (0.25 * DISTANCE, 0.25 * DISTANCE)


def test_nested_boxes_hold_nearly_all_points_and_the_cameras() -> None:
    """One of 100 points may be an outlier: here 2 of 200. The other points fill a box of half the length along one axis."""
    box = np.array([[-1.0, -1, -0.5], [1, 1, 0.5]]) + 3
    assert [b.tolist() for b in nested_boxes(box, 3)] == [box.tolist(), (2 * box - 3).tolist(), (4 * box - 9).tolist()]
    wild = np.array([[500.0, 0, 0], [0, 0, 999]])
    inside = [_at([3, 3, 3])]
    for reach, levels in ((0.4, 1), (0.99, 1), (1.01, 2), (1.99, 2), (2.01, 3), (7.9, 4), (8.1, 5), (40, 5)):
        points = np.concatenate([np.tile([3.0, 3, 3 + 0.5 * reach], (99, 1)), np.tile([3 - reach / 2, 3, 3], (199, 1)), wild])
        assert count_levels(box, points, inside, 5) == levels, reach
        # A camera at half the distance asks for as many boxes as a point.
        assert count_levels(box, np.array([[3.0, 3, 3]]), [_at([3, 3, 3 + 0.25 * reach])], 5) == levels, reach
    assert count_levels(box, np.array([[3.0, 3, 3]]), inside, 5) == 1
    assert count_levels(box, np.array([[3.0, 3, 3]]), [*inside * 199, _at([3, 3, 30])], 5) == 1
    points = np.concatenate([box, box + np.array([0, 0, 0.01]), box - np.array([0, 0, 0.01])])
    np.testing.assert_array_equal(points_in_box(points, box), [*box, points[2], points[5]])


def _at(place: list[float]) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = place
    return Camera(intrinsics(9, 9, 4, 4), (8, 8), pose)


def _moved(camera: Camera, distance: float) -> np.ndarray:
    pose = camera.to_world.copy()
    pose[:3, 3] = -distance * camera.forward
    return pose


def test_cameras_at_their_focus_have_no_middle_box() -> None:
    turned = [Camera(intrinsics(9, 9, 4, 4), (8, 8), _moved(camera, 0.0)) for camera in cameras(4)]
    assert_refused("cameras that all stand in one place", middle_box, turned)


def test_largest_limits_the_size_of_photographs(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "photos", 3)
    small = load_photos(folder, split="all", largest=16, box="middle")
    assert [view.image.shape for view in small.views] == [(12, 16, 3)] * 3
    assert small.views[0].camera.K[0, 0] == pytest.approx(cameras(1)[0].K[0, 0] / 2)
    np.testing.assert_allclose(small.box, middle_box([view.camera for view in small.views]), atol=1e-6)
    assert "median distance" in small.survey.box_from
    # A limit above what there is enlarges nothing, and scale still holds.
    assert load_photos(folder, split="all", largest=900).views[0].image.shape[1] == SIZE[0]
    assert load_photos(folder, split="all", largest=900, scale=0.5).views[0].image.shape[1] == SIZE[0] // 2


def test_too_large_photographs_are_refused_before_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_capture(tmp_path / "photos", 4)
    pixels = SIZE[0] * SIZE[1]
    # 64 bytes a pixel of the one that is read, 24 of each that is kept: at scale 0.5 a quarter of these.
    limit = 64 * pixels + 24 * pixels * 4 // 4
    assert len(load_photos(folder, split="all", scale=0.5, limit=limit).views) == 4
    monkeypatch.setattr("mivol.photos.dataset.read_photo", lambda *_: pytest.fail("a photograph was read"))
    with pytest.raises(MivolError, match=r"found 4 photographs of about .* at scale 1, .* free memory, .*; use scale=0.5\."):
        load_photos(folder, split="all", limit=limit)
    with pytest.raises(MivolError, match="a single photograph is too large"):
        load_photos(folder, split="all", scale=0.1, limit=60 * pixels)  # what is kept would fit


def test_an_unknown_word_for_a_box_is_refused(tmp_path: Path) -> None:
    assert_refused('"edge"', survey_photos, write_capture(tmp_path / "photos", 3), box="edge")


def test_the_colours_of_a_view_are_fitted_a_channel_at_a_time() -> None:
    """A render of another exposure and tint is the photograph once its colours are fitted; a mask takes pixels out."""
    photo = capture(1)[0].image.astype(np.float64)
    other = np.clip((photo - [0.05, 0.0, 0.1]) / [0.9, 1.3, 1.2], 0, 1)
    assert score_image(other, photo).values["psnr"] < 25
    # Where nothing was clipped the channels are linear in each other; 8 bits are left of the error.
    fine = ((other > 0) & (other < 1)).all(axis=-1)
    fitted = fit_colours(other, photo, fine)
    np.testing.assert_allclose(fitted[fine], photo[fine], atol=1e-9)
    spoilt = np.where(fine[..., None], photo, 0.0)
    np.testing.assert_allclose(fit_colours(other, spoilt, fine), fitted, atol=1e-12)


def test_a_preset_brings_what_captures_need_and_the_file_overrides_it() -> None:
    raw = {"title": "a", "photos": {"path": "p"}, "field": {"preset": "capture"}}
    plain = config.from_dict(raw)
    assert (plain.photos.largest, plain.photos.box, plain.show.views) == (240, "middle", 64)
    own = config.from_dict(raw | {"photos": {"path": "p", "largest": 99}, "show": {"views": 2}})
    assert (own.photos.largest, own.photos.box, own.show.views) == (99, "middle", 2)
    other = config.from_dict(raw | {"field": {"preset": "cpu"}})
    assert (other.photos.largest, other.photos.box, other.show.views) == (None, "found", 4)


def test_a_folder_of_photographs_is_an_experiment(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = write_capture(tmp_path / "my photographs", 3)
    made = config.of_photographs(folder, "grid", "capture", ["field.longest=16"])
    assert (made.title, made.photos.path, made.field.longest, made.photos.box) == ("my photographs", str(folder), 16, "middle")
    assert config.of_photographs(folder).gaussians.preset == "minute"
    assert main(["optimize", "--preset", "capture", str(folder)]) == 1
    assert "--preset capture is a preset of --as grid" in capsys.readouterr().err
    (tmp_path / "fit.toml").write_text("")
    assert main(["optimize", "--preset", "cpu", str(tmp_path / "fit.toml")]) == 1
    assert "its tables [gaussians] or [field] name model and preset" in capsys.readouterr().err


def test_motions_stay_as_small_as_expected_where_images_do_not_tell() -> None:
    """Linear differences with noise, two columns almost alike: the step ends where the error and the prior balance.

    At the minimum of ``|r|^2 + w |m|^2``, with w of the step before, the gradient ``J^T r + w m`` is 0. Rounding in float64 is
    far below a millionth of its parts.
    """
    rng = np.random.default_rng(3)
    slopes, wanted = rng.standard_normal((2, 40, 6)), rng.standard_normal((2, 6))
    slopes[:, :, 5] = slopes[:, :, 4] + 1e-3 * slopes[:, :, 5]
    noise = rng.standard_normal((2, 40))

    def error(motion: np.ndarray) -> np.ndarray:
        return np.einsum("cni,ci->cn", slopes, motion - wanted) + noise

    free, found = Motions.none(2), Motions.none(2)
    for _ in range(12):
        free, found = free.improve(error), found.improve(error, expected=3.0)
    residual = error(found.motion)
    weight = (residual**2).mean(axis=1, keepdims=True) / 3.0**2
    parts = np.einsum("cni,cn->ci", slopes, residual), weight * found.motion
    assert np.abs(parts[0] + parts[1]).max() < 1e-6 * np.abs(parts[1]).max()
    assert np.abs(found.motion).max() < 6 < 60 < np.abs(free.motion).max()
    assert (error(free.motion) ** 2).sum() < (residual**2).sum()


def test_a_pose_is_aligned_to_its_photograph() -> None:
    """A coloured floor from a pose that is off by about two pixels: a tenth of the error is left, and a right pose stays.

    The renders are exact and smooth over several pixels, so least squares end near the truth. A turn and a shift that look
    alike stay mixed, so images are compared and not poses.
    """
    K, size = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), (64, 48)
    true = Camera(K, size, np.block([[np.eye(3), np.array([[0.1], [-0.2], [3.0]])], [np.zeros((1, 3)), np.ones((1, 1))]]))

    def render(camera: Camera) -> np.ndarray:
        o, d = rays(camera, np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1))
        x = o - d * o[..., 2:] / d[..., 2:]
        return 0.5 + 0.5 * np.sin(4 * x[..., [0, 1, 0]] + 3 * x[..., [1, 0, 0]] * [1, 1, 0])

    image = render(true)
    wrong = move_camera(true, np.array([0.02, -0.025, 0.03]), np.array([0.04, 0.05, -0.06]))
    before = np.sqrt(np.mean((render(wrong) - image) ** 2))
    after = np.sqrt(np.mean((render(align_camera(render, wrong, image, None, 3.0)) - image) ** 2))
    assert after < 0.1 * before
    assert np.allclose(align_camera(render, true, image, None, 3.0).to_world, true.to_world, atol=1e-12)


def test_a_motion_turns_about_the_cameras_place() -> None:
    """A quarter turn about z takes x to y; the place moves by the shift alone."""
    camera = Camera(intrinsics(50, 50, 8, 8), (16, 16), np.eye(4))
    moved = move_camera(camera, np.array([0, 0, np.pi / 2]), np.array([1.0, 2, 3]))
    assert np.allclose(moved.to_world, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
