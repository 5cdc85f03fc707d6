"""Posed photographs are read as written, in the documented conventions."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from photo_sets import (
    COLMAP_CAMERAS,
    colmap_pose,
    edit,
    look_at,
    pixels,
    png_of_16_bits,
    ring,
    write_blender,
    write_colmap,
    write_transforms,
)
from PIL import Image
from refusals import assert_refused
from scipy.spatial.transform import Rotation

from mivol import photos
from mivol.errors import MivolError
from mivol.experiments.photo_data import describe_photos
from mivol.files import write_exr
from mivol.files.image_files import decode_srgb
from mivol.photos import (
    Camera,
    Lens,
    Photo,
    distort,
    intrinsics,
    load_photos,
    pixel_centres,
    project,
    rays,
    rectify,
    region,
    survey_photos,
    undistort,
)
from mivol.photos.photo_file import read_photo, read_photo_header

EPS = float(np.finfo(np.float32).eps)


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """A data set of four training and two test views of 12 x 8 pixels with alpha."""
    return write_blender(tmp_path / "set")


# -- Rays ---------------------------------------------------------------------------------------------------------


def test_rays_of_corners_and_centre() -> None:
    """90 degrees over 4 pixels give fx = 2; the camera stands at (1, 2, 3) without rotation and looks along -z."""
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    camera = Camera(intrinsics(2, 2, 2, 1), (4, 2), pose)
    o, d = rays(camera, np.array([[2, 1], [0, 1], [4, 1], [2, 0]]))
    np.testing.assert_array_equal(o, np.tile([1, 2, 3], (4, 1)))
    root = math.sqrt(0.5)
    expected = [[0, 0, -1], [-root, 0, -root], [root, 0, -root], [0, 1 / math.sqrt(5), -2 / math.sqrt(5)]]
    np.testing.assert_allclose(d, expected, atol=1e-15)  # a few float64 roundings


def test_pixel_centres_are_half_a_pixel_inside() -> None:
    centres = pixel_centres((3, 2))
    assert centres.shape == (2, 3, 2)
    np.testing.assert_array_equal(centres[1, 2], (2.5, 1.5))


def test_project_inverts_rays() -> None:
    camera = Camera(intrinsics(50, 60, 31, 22), (64, 48), look_at(np.array([3.0, -2, 1])))
    pixel = pixel_centres(camera.size)
    o, d = rays(camera, pixel)
    back, depth = project(camera, o + 2.5 * d)
    np.testing.assert_allclose(back, pixel, atol=1e-11)  # 64 pixels, 1e-16 each, over a few operations
    assert (depth > 0).all() and (depth <= 2.5).all()
    near, depth = project(camera, o + 1e-3 * d)
    np.testing.assert_allclose(near, pixel, atol=1e-8)  # a distance of 4 less its 1e-3 loses 12 of 53 bits
    assert (depth > 0).all() and (depth <= 1e-3).all()
    assert np.isnan(project(camera, camera.origin)[0]).all()
    behind, negative = project(camera, o - d)
    assert np.isnan(behind).all() and (negative < 0).all()


def test_a_resized_camera_has_the_same_rays() -> None:
    camera = Camera(intrinsics(50, 50, 31, 22), (64, 48), look_at(np.array([3.0, -2, 1])))
    half = camera.resized((32, 24))
    np.testing.assert_allclose(rays(half, np.array([8.0, 6.0]))[1], rays(camera, np.array([16.0, 12.0]))[1], atol=1e-15)


# -- Blender ------------------------------------------------------------------------------------------------------


def test_blender_splits_cameras_and_pixels(blender: Path) -> None:
    photos = load_photos(blender, background="black")
    assert [view.name for view in photos.views] == ["r_0.png", "r_1.png", "r_2.png", "r_3.png"]
    camera = photos.views[1].camera
    assert camera.size == (12, 8)
    # tan(0.4) = 6 pixels / fx; the principal point is the middle.
    np.testing.assert_allclose(camera.K, intrinsics(6 / math.tan(0.4), 6 / math.tan(0.4), 6, 4), rtol=1e-14)
    np.testing.assert_allclose(camera.to_world, ring(4)[1], atol=1e-15)
    stored = pixels(12, 8, 1) / 255
    np.testing.assert_allclose(photos.views[1].alpha, stored[..., 3], atol=EPS)
    np.testing.assert_allclose(photos.views[1].image, stored[..., :3] * stored[..., 3:], atol=EPS)
    assert photos.space == "srgb"
    assert len(load_photos(blender, split="test", background="black").views) == 2


@pytest.mark.parametrize("background", ["white", (0.2, 0.5, 0.9)])
def test_alpha_blends_over_a_background(blender: Path, background: object) -> None:
    view = load_photos(blender, background=background).views[2]
    stored = pixels(12, 8, 2) / 255
    colour = np.ones(3) if background == "white" else np.array(background)
    expected = stored[..., :3] * stored[..., 3:] + (1 - stored[..., 3:]) * colour
    np.testing.assert_allclose(view.image, expected, atol=4 * EPS)
    other = stored[..., :3] * stored[..., 3:] + (1 - stored[..., 3:]) * [1, 0, 0.5]
    np.testing.assert_allclose(view.over([1, 0, 0.5]), other, atol=8 * EPS)


def test_random_backgrounds_depend_on_view_and_seed(blender: Path) -> None:
    colours = [view.background for view in load_photos(blender, background="random", seed=3).views]
    assert np.shape(colours) == (4, 3) and len({tuple(colour) for colour in colours}) == 4
    again = [view.background for view in load_photos(blender, background="random", seed=3).views]
    np.testing.assert_array_equal(colours, again)


def test_codes_become_linear_on_request(blender: Path) -> None:
    view = load_photos(blender, background="black", space="linear").views[0]
    stored = pixels(12, 8, 0) / 255
    # The formula of IEC 61966-2-1, written again; 1e-6: float32 and a power.
    light = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)[..., :3]
    np.testing.assert_allclose(view.image, light * stored[..., 3:], atol=1e-6)


@pytest.mark.parametrize(("scale", "size"), [(0.5, (6, 4)), (0.25, (3, 2)), (0.4, (5, 3))])
def test_photographs_shrink_by_exact_means(blender: Path, scale: float, size: tuple[int, int]) -> None:
    """Compared with sums over the overlaps of all old and new pixels; transparent pixels have no weight."""
    view = load_photos(blender, background="black", scale=scale).views[0]
    assert view.camera.size == size
    stored = pixels(12, 8, 0) / 255
    multiplied = stored[..., :3] * stored[..., 3:]
    expected = np.einsum("ai,bj,ijc->abc", overlaps(8, size[1]), overlaps(12, size[0]), multiplied)
    np.testing.assert_allclose(view.image, expected, atol=4 * EPS)
    np.testing.assert_allclose(rays(view.camera, np.zeros(2)), rays(survey_photos(blender).frames[0].camera, np.zeros(2)))


def overlaps(old: int, new: int) -> np.ndarray:
    """Return the share (new, old) of each new cell covered by an old cell."""
    edge = np.arange(new + 1)[:, None] * old / new
    low, high = np.maximum(edge[:-1], np.arange(old)), np.minimum(edge[1:], np.arange(old) + 1)
    return np.maximum(high - low, 0) * new / old


def test_missing_photographs_are_skipped_and_listed(blender: Path) -> None:
    (blender / "train" / "r_1.png").unlink()
    photos = load_photos(blender, background="white")
    assert photos.skipped == ("./train/r_1",)
    assert [view.name for view in photos.views] == ["r_0.png", "r_2.png", "r_3.png"]
    assert "./train/r_1" in photos.describe()
    assert describe_photos(photos)[-1] == "1 listed photographs are missing: ./train/r_1 ..."


def test_held_out_photographs_leave_the_training_split(blender: Path) -> None:
    names = {
        split: [view.name for view in load_photos(blender, split=split, held_out=2, background="white").views]
        for split in ("train", "held_out")
    }
    assert names == {"train": ["r_1.png", "r_3.png"], "held_out": ["r_0.png", "r_2.png"]}
    folds = [load_photos(blender, split="held_out", held_out=3, fold=k, background="white").views for k in range(3)]
    assert [[view.name for view in views] for views in folds] == [["r_0.png", "r_3.png"], ["r_1.png"], ["r_2.png"]]
    assert_refused("count folds from 0", load_photos, blender, held_out=3, fold=3)
    named = load_photos(blender, split="held_out", held_out=["r_3.png"], background="white")
    assert [view.name for view in named.views] == ["r_3.png"]


def test_exr_is_linear_and_multiplied(tmp_path: Path) -> None:
    folder = write_blender(tmp_path / "set", train=2)
    values = np.random.default_rng(0).random((8, 12, 4), np.float32) * 2
    values[..., 3] = np.minimum(values[..., 3], 1)
    values[0, 0, 3] = 0  # emission without opacity stays
    for i in range(2):
        (folder / "train" / f"r_{i}.png").unlink()
        write_exr(folder / "train" / f"r_{i}.exr", {"": values})
    photos = load_photos(folder, background="white")
    assert photos.space == "linear"
    np.testing.assert_allclose(photos.views[0].image, values[..., :3] + 1 - values[..., 3:], atol=4 * EPS)


def test_decode_inverts_the_curve_of_png() -> None:
    from mivol.files import encode_srgb

    code = np.arange(256) / 255
    # The two branches of the standard differ by 1e-5 at code 0.04045, which is no 8-bit value.
    np.testing.assert_allclose(encode_srgb(decode_srgb(code)), code, atol=1e-9)


def test_shared_box_of_cameras_around_a_sphere() -> None:
    """Many cameras around the origin share its ball of radius distance sin(half the angle), and little more."""
    rng = np.random.default_rng(5)
    places = rng.normal(size=(200, 3))
    places *= 4 / np.linalg.norm(places, axis=1, keepdims=True)
    cameras = [Camera(intrinsics(100, 100, 40, 40), (80, 80), look_at(place)) for place in places]
    np.testing.assert_allclose(region.find_focus(cameras), 0, atol=1e-12)
    radius = 4 * math.sin(math.atan(0.4))  # 1.486
    box = region.shared_box(cameras)
    # The planes of 90 % of the views bound the region from both sides, up to one cell (1/32).
    assert (np.abs(box) > radius * (1 - 1 / 16)).all() and (np.abs(box) < 1.25 * radius).all()
    near, far = region.near_and_far(cameras, box)
    distances = [np.linalg.norm(np.clip(p, *box) - p) for p in places]
    assert near == pytest.approx(min(distances)) and far < 4 + np.linalg.norm(box, axis=1).max()


# -- transforms.json ----------------------------------------------------------------------------------------------

LENS = {"k1": 0.06, "k2": -0.03, "k3": 0.004, "k4": 0.001, "p1": -0.002, "p2": 0.003}


def through_lens(x: np.ndarray, y: np.ndarray, k: list[float], p: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate OpenCV's formula in polar form, independent of the code: radial growth plus tangential shift."""
    r = np.hypot(x, y)
    grown = r + sum(c * r ** (2 * i + 3) for i, c in enumerate(k))
    cos, sin = np.divide(x, r, where=r > 0, out=np.ones_like(r)), np.divide(y, r, where=r > 0, out=np.zeros_like(r))
    dx = 2 * p[0] * x * y + p[1] * (r**2 + 2 * x**2)
    dy = p[0] * (r**2 + 2 * y**2) + 2 * p[1] * x * y
    return grown * cos + dx, grown * sin + dy


def test_transforms_intrinsics_of_file_and_frame(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20.0, "fl_y": 21.0, "cx": 5.5, "cy": 4.5, "aabb_scale": 4, **LENS})
    edit(folder / "transforms.json", spoil("fl_x", 30.0))
    views = load_photos(folder).views
    np.testing.assert_array_equal(views[0].camera.K, intrinsics(20, 21, 5.5, 4.5))
    np.testing.assert_array_equal(views[1].camera.K, intrinsics(30, 21, 5.5, 4.5))
    assert views[0].camera.distortion == Lens(**LENS)


@pytest.mark.parametrize(
    ("settings", "K"),
    [
        ({"fl_x": 20}, intrinsics(20, 20, 6, 4)),
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.5}, intrinsics(6 / math.tan(0.5), 4 / math.tan(0.25), 6, 4)),
        ({"fl_x": 20, "camera_angle_x": 1.0}, intrinsics(20, 20, 6, 4)),
        ({"camera_angle_y": 0.5}, intrinsics(4 / math.tan(0.25), 4 / math.tan(0.25), 6, 4)),
    ],
)
def test_intrinsics_from_partial_settings(tmp_path: Path, settings: dict, K: np.ndarray) -> None:
    folder = write_transforms(tmp_path / "set", settings)
    np.testing.assert_allclose(load_photos(folder).views[0].camera.K, K, rtol=1e-14)


@pytest.mark.parametrize("angle", [-1.0, 0.0, 3.15, 60.0])
def test_invalid_angles_of_view_are_refused(tmp_path: Path, angle: float) -> None:
    """60 is an angle in degrees; the tangent of 60 radians would give a negative or arbitrary focal length."""
    folder = write_transforms(tmp_path / "set", {"camera_angle_x": angle})
    assert_refused(f"camera_angle_x = {angle:g}, expected an angle between 0 and pi", load_photos, folder)


@pytest.mark.parametrize("prefix", ["", "./", "../set/"])
def test_lists_of_splits_accept_every_spelling_of_a_path(tmp_path: Path, prefix: str) -> None:
    """A test view stays a test view with another spelling of its path; views outside all lists are not trained on."""
    names = [f"{prefix}images/{n:04d}.png" for n in (0, 1, 2)]
    folder = write_transforms(tmp_path / "set", {"fl_x": 20, "train_filenames": names, "test_filenames": names[2:]})
    assert [view.name for view in load_photos(folder).views] == ["0000.png", "0001.png"]
    assert [view.name for view in load_photos(folder, split="test").views] == ["0002.png"]
    assert "4 photographs (2 train, 1 test, 1 in no list)" in survey_photos(folder).describe()


PLY = "ply\nformat ascii 1.0\nelement vertex {}\n{}end_header\n{}"
PLACES = "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar red\n"


def test_transforms_with_points_in_the_frame_of_the_cameras(tmp_path: Path) -> None:
    """nerfstudio's ``ply_file_path``, written on Windows; without the key the survey has no points."""
    points = np.random.default_rng(0).normal(size=(300, 3)).round(4)
    folder = write_transforms(tmp_path / "set", {"fl_x": 20, "ply_file_path": "sparse\\sparse_pc.ply"})
    (folder / "sparse").mkdir()
    rows = "".join("{} {} {} 7\n".format(*point) for point in points)
    (folder / "sparse" / "sparse_pc.ply").write_text(PLY.format(300, PLACES, rows))
    found = survey_photos(folder)
    np.testing.assert_array_equal(found.points, points.astype(np.float32))
    assert "points" in found.box_from
    assert survey_photos(write_transforms(tmp_path / "other", {"fl_x": 20})).points is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (3, None, "transforms.json: found ply_file_path = 3"),
        ("none.ply", None, "ply_file_path = 'none.ply', a missing file, expected a file of points; add the file, or remove"),
        ("a.ply", PLY.format(1, "property float x\n", "1\n"), "a.ply: found no x, y, z of vertices"),
        ("a.ply", PLY.format(2, PLACES, "1 2 3 7\n1 nan 3 7\n"), "a.ply: found point 1 at .*nan"),
    ],
)
def test_invalid_points_are_refused(tmp_path: Path, name: object, text: str | None, message: str) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20, "ply_file_path": name})
    if text is not None:
        (folder / str(name)).write_text(text)
    assert_refused(message, survey_photos, folder)


def test_paths_with_backslashes_are_found(tmp_path: Path) -> None:
    """A data set written on Windows: frames and lists with backslashes name the same files."""
    folder = write_transforms(tmp_path / "set", {"fl_x": 20, "test_filenames": ["images\\0002.png"]})
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace("images/", "images\\\\"))
    assert [view.name for view in load_photos(folder, split="test").views] == ["0002.png"]
    assert len(load_photos(folder).views) == 3


def test_black_pixels_of_a_mask_are_ignored(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20})
    mask = np.full((8, 12), 255, np.uint8)
    mask[:, :3] = 0
    Image.fromarray(mask).save(folder / "mask.png")
    edit(folder / "transforms.json", spoil("mask_path", "mask.png"))
    views = load_photos(folder).views
    assert views[0].mask is None
    np.testing.assert_array_equal(views[1].mask, mask > 0)
    half = load_photos(folder, scale=0.5).views[1]
    np.testing.assert_array_equal(half.mask, np.arange(6) >= np.full((4, 1), 2))  # the pixel over columns 2 and 3 is lost
    Image.fromarray(mask[:4]).save(folder / "mask.png")
    assert_refused(r"a mask of 12 x 4, expected 12 x 8", load_photos, folder)
    (folder / "mask.png").unlink()
    assert_refused("expected the mask of", load_photos, folder)


def test_written_cameras_are_read_unchanged(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20.0, "fl_y": 21.0, "cx": 5.5, "cy": 4.5, **LENS})
    cameras = {f"images/{f.file.name}": f.camera for f in survey_photos(folder).frames}
    photos.write_transforms(folder / "transforms.json", cameras, test=["images/0001.png"])
    again = survey_photos(folder)
    assert [frame.split for frame in again.frames] == ["train", "test", "train", "train"]
    for frame, camera in zip(again.frames, cameras.values(), strict=True):
        np.testing.assert_array_equal(frame.camera.K, camera.K)
        np.testing.assert_allclose(frame.camera.to_world, camera.to_world, atol=1e-15)
        assert frame.camera.distortion == camera.distortion


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"camera_model": "PINHOLE", "k1": 0.1}, "a PINHOLE with k1 = 0.1, expected no distortion"),
        ({"k1": float("nan")}, "distortion"),
        ({"fl_x": "long"}, "fl_x = 'long'"),
        ({"fl_x": 0}, "focal lengths 0"),
        ({"cx": float("nan")}, r"a principal point \(nan, 4\)"),
        ({"test_filenames": 7}, "test_filenames = 7, expected a list of the names of files"),
        ({"w": 12.5}, "w = 12.5"),
        ({"w": 36, "h": 24}, r"0000.png: found 12 x 8 pixels, expected 36 x 24 pixels as the file of cameras, or 1/2"),
        ({"k1": -3.0}, "a lens whose image folds back"),
    ],
)
def test_bad_cameras_are_refused(tmp_path: Path, settings: dict, message: str) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20, **settings})
    assert_refused(message, load_photos, folder)


def test_transforms_without_focal_length_frames_or_json_are_refused(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {})
    assert_refused("no focal length", load_photos, folder)
    file = folder / "transforms.json"
    edit(file, lambda table: table.__setitem__("frames", []))
    assert_refused("no list of frames", load_photos, file)
    file.write_text("{")
    assert_refused("not JSON", load_photos, file)


# -- The lens -----------------------------------------------------------------------------------------------------


def test_lens_against_the_polar_formula() -> None:
    lens = Lens(**LENS)
    x, y = np.random.default_rng(2).uniform(-0.8, 0.8, (2, 100))
    expected = through_lens(x, y, [lens.k1, lens.k2, lens.k3, lens.k4], [lens.p1, lens.p2])
    np.testing.assert_allclose(distort(lens, np.stack([x, y], -1)), np.stack(expected, -1), atol=1e-15)


def test_undistort_inverts_distort() -> None:
    lens = Lens(**LENS)
    xy = np.random.default_rng(3).uniform(-0.8, 0.8, (500, 2))
    np.testing.assert_allclose(undistort(lens, distort(lens, xy)), xy, atol=2e-12)  # Newton stops at 1e-12


def test_points_beyond_the_fold_are_refused() -> None:
    """r - r^3 / 3 grows up to r = 1, to 2/3. Points beyond have an original on the other branch, which is invalid."""
    lens = Lens(k1=-1 / 3)
    assert lens.fold == pytest.approx(1)
    assert undistort(lens, np.array([0.66, 0]))[0] < 1
    for beyond in np.linspace(0.67, 3, 20):
        assert_refused("folds back", undistort, lens, np.array([beyond, 0]))
    camera = Camera(intrinsics(10, 10, 5, 5), (10, 10), np.eye(4), lens)
    assert np.isnan(project(camera, np.array([1.1, 0, -1]))[0]).all()


def test_a_rectified_photograph_equals_the_view_of_a_pinhole() -> None:
    """An image that is linear in the direction has the same values for the pinhole wherever the photograph has pixels."""
    bent = Camera(intrinsics(40, 42, 31, 22), (64, 48), np.eye(4), Lens(**LENS))
    photo = Photo("p", linear_picture(bent), np.ones((48, 64), np.float32), None, bent, np.zeros(3, np.float32))
    flat = rectify(photo)
    assert not flat.camera.distortion and flat.camera.K[0, 0] == flat.camera.K[1, 1] == 42
    inner = np.s_[4:-4, 4:-4]
    # Linear interpolation of a function with second derivative c over a pixel: c/8 a dimension; measured 2e-5 here.
    np.testing.assert_allclose(flat.image[inner], linear_picture(flat.camera)[inner], atol=1e-4)
    assert 0.9 < flat.mask.mean() < 1
    np.testing.assert_allclose(flat.alpha, 1)
    assert rectify(flat) is flat
    # A masked pixel masks exactly the new pixels that it contributes to.
    assert np.array_equal(rectify(dataclasses.replace(photo, mask=np.ones((48, 64), bool))).mask, flat.mask)
    mask = np.ones((48, 64), bool)
    mask[20, 40] = False
    lost = np.argwhere(flat.mask & ~rectify(dataclasses.replace(photo, mask=mask)).mask)
    assert 1 <= len(lost) <= 9 and np.ptp(lost, axis=0).max() <= 2
    back = project(bent, np.array([(lost[:, 1].mean() + 0.5 - 31) / 42, -(lost[:, 0].mean() + 0.5 - 22) / 42, -1.0]))[0]
    np.testing.assert_allclose(back, (40.5, 20.5), atol=1)


def linear_picture(camera: Camera) -> np.ndarray:
    """Return an image (H, W, 3) that is linear over the plane in front of the camera."""
    d = rays(camera, pixel_centres(camera.size))[1]
    x, y = d[..., 0] / -d[..., 2], d[..., 1] / -d[..., 2]
    return np.stack([0.5 + 0.3 * x, 0.5 - 0.2 * y, 0.5 + 0.1 * x + 0.1 * y], -1).astype(np.float32)


# -- COLMAP -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["bin", "txt"])
@pytest.mark.parametrize("model", COLMAP_CAMERAS)
def test_colmap_cameras_project_as_in_its_manual(tmp_path: Path, model: str, encoding: str) -> None:
    folder = write_colmap(tmp_path / "set", model, encoding)
    views = load_photos(folder, box=[[-1] * 3, [1] * 3]).views
    assert [view.name for view in views] == [f"a view {i}.png" for i in range(4)]
    named = dict(zip(NAMES[model], COLMAP_CAMERAS[model], strict=True))
    fx, fy = named.get("fx", named.get("f")), named.get("fy", named.get("f"))
    cloud = np.random.default_rng(4).uniform(-1, 1, (30, 3))
    for view, pose in zip(views, ring(4), strict=True):
        q, t = colmap_pose(pose)
        local = Rotation.from_quat(q[[1, 2, 3, 0]]).apply(cloud) + t
        lens = [named.get("k1", 0), named.get("k2", 0)], [named.get("p1", 0), named.get("p2", 0)]
        x, y = through_lens(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2], *lens)
        pixel, depth = project(view.camera, cloud)
        np.testing.assert_allclose(pixel, np.stack([fx * x + named["cx"], fy * y + named["cy"]], -1), atol=1e-11)
        np.testing.assert_allclose(depth, local[:, 2], atol=1e-13)
        o, d = rays(view.camera, pixel)
        distance = np.linalg.norm(cloud - o, axis=1)
        np.testing.assert_allclose(o + distance[:, None] * d, cloud, atol=1e-10)


NAMES = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


def test_photographs_with_wrong_poses_are_left_out_and_named(tmp_path: Path) -> None:
    """A camera turned around by a wrong pose; three of eight are too many to go on, and so is one beside a given box."""
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (100, 3))
    folder = write_colmap(tmp_path, encoding="txt", n=8, points=points)
    images = folder / "sparse" / "0" / "images.txt"

    def turn_around(name: str) -> None:
        lines = images.read_text().splitlines()
        at = next(k for k, line in enumerate(lines) if line.endswith(name))
        number, w, x, y, z, tx, ty, tz, *rest = lines[at].split(" ")
        turned = (-float(y), float(z), float(w), -float(x), -float(tx), float(ty), -float(tz))
        lines[at] = " ".join([number, *map(str, turned), *rest])
        images.write_text("\n".join(lines) + "\n")

    turn_around("a view 3.png")
    survey = survey_photos(folder)
    assert [frame.file.name for frame in survey.frames] == [f"a view {k}.png" for k in range(8) if k != 3]
    assert "left out: a view 3.png, which by their poses look away" in survey.describe()
    assert_refused("1 of 8 cameras looking away from the box", survey_photos, folder, box=survey.box)
    turn_around("a view 5.png")
    turn_around("a view 6.png")
    assert_refused("3 of 8 cameras looking away from the box", survey_photos, folder)


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_the_box_of_colmap_points_excludes_outliers(tmp_path: Path, encoding: str) -> None:
    rng = np.random.default_rng(6)
    cloud = np.concatenate([rng.uniform(-1, 1, (990, 3)), rng.uniform(50, 90, (5, 3)), rng.uniform(-90, -50, (5, 3))])
    survey = survey_photos(write_colmap(tmp_path / "set", "PINHOLE", encoding, points=cloud))
    np.testing.assert_array_equal(survey.points, cloud)
    # The 1st and 99th percentiles of uniform numbers lie within 0.05 of +-0.99 (5 standard deviations), plus 5 % of 2.
    np.testing.assert_allclose(survey.box, [[-1.08] * 3, [1.08] * 3], atol=0.06)
    assert "1000 points" in survey.describe()


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_colmap_points_belong_to_their_photographs(tmp_path: Path, encoding: str) -> None:
    """Tracks use image ids, which run backwards through the views; a photograph without tracks has no points."""
    cloud, tracks = np.random.default_rng(6).normal(size=(5, 3)), [(2, 3), (2,), (), (3, 2, 3), (2,)]
    folder = write_colmap(tmp_path / "set", "PINHOLE", encoding, points=cloud, tracks=tracks)
    named = {frame.file.name: frame for frame in survey_photos(folder, box=[[-9] * 3, [9] * 3]).frames}
    np.testing.assert_array_equal(named["a view 1.png"].points, cloud[[0, 1, 3, 4]])
    np.testing.assert_array_equal(named["a view 2.png"].points, cloud[[0, 3, 3]])
    assert named["a view 0.png"].points is None
    views = {view.name: view for view in load_photos(folder, box=[[-9] * 3, [9] * 3]).views}
    np.testing.assert_array_equal(views["a view 2.png"].points, named["a view 2.png"].points)


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_colmap_points_without_a_position_are_refused(tmp_path: Path, encoding: str) -> None:
    folder = write_colmap(tmp_path / "set", "PINHOLE", encoding, points=np.array([[0.0, 0, 0], [1, np.nan, 2]]))
    assert_refused(rf"points3D.{encoding}: found .*nan", survey_photos, folder, box=[[-9] * 3, [9] * 3])


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_colmap_points_are_optional(tmp_path: Path, encoding: str) -> None:
    folder = write_colmap(tmp_path / "set", "PINHOLE", encoding)
    (folder / "sparse" / "0" / f"points3D.{encoding}").unlink()
    assert survey_photos(folder).points is None


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_unknown_colmap_cameras_are_refused(tmp_path: Path, encoding: str) -> None:
    with pytest.raises(MivolError, match="the camera model FULL_OPENCV, expected one of SIMPLE_PINHOLE"):
        load_photos(write_colmap(tmp_path / "set", "FULL_OPENCV", encoding))


@pytest.mark.parametrize(("file", "cut"), [("cameras.bin", 20), ("images.bin", 100), ("images.bin", 76), ("points3D.bin", 30)])
def test_truncated_colmap_files_are_refused(tmp_path: Path, file: str, cut: int) -> None:
    folder = write_colmap(tmp_path / "set", points=np.zeros((3, 3)))
    path = folder / "sparse" / "0" / file
    path.write_bytes(path.read_bytes()[:cut])
    assert_refused(f"{file}: found .* truncated", load_photos, folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras.txt", "7 OPENCV 64 48 50.0", "7 OPENCV 64 48", "camera 7"),
        ("cameras.txt", "7 OPENCV", "x OPENCV", "the number 'x'"),
        ("images.txt", " 7 a view 2", " 8 a view 2", "camera 8 of a view 2.png"),
        ("images.txt", " 7 a view 2.png", "", "expected id, quaternion"),
    ],
)
def test_invalid_colmap_text_is_refused(tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
    folder = write_colmap(tmp_path / "set", encoding="txt")
    path = folder / "sparse" / "0" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert_refused(message, load_photos, folder)


def test_colmap_from_the_folder_of_the_model(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "set")
    assert len(load_photos(folder / "sparse" / "0").views) == len(load_photos(folder).views) == 4


def test_colmap_masks_and_wrong_size(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "set")
    (folder / "masks").mkdir()
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(folder / "masks" / "a view 1.png.png")
    views = load_photos(folder).views
    assert views[0].mask is None and not views[1].mask.any()
    Image.fromarray(pixels(32, 20)).save(folder / "images" / "a view 2.png")
    assert_refused("a view 2.png: found 32 x 20 pixels, expected 64 x 48", load_photos, folder)


# -- Boxes -------------------------------------------------------------------------------------------------------


def test_silhouette_box_tightly_contains_the_subject() -> None:
    """An ellipsoid seen by 12 cameras with exact outlines."""
    radii = np.array([0.5, 0.3, 0.4])
    cameras, alphas = [], []
    for place in np.random.default_rng(8).normal(size=(12, 3)):
        camera = Camera(intrinsics(150, 150, 64, 64), (128, 128), look_at(4 * place / np.linalg.norm(place)))
        o, d = rays(camera, pixel_centres(camera.size))
        o, d = o / radii, d / radii
        hit = np.sum(o * d, -1) ** 2 >= np.sum(d * d, -1) * (np.sum(o * o, -1) - 1)
        cameras.append(camera)
        alphas.append(hit.astype(np.float32))
    box = region.silhouette_box(cameras, alphas, region.shared_box(cameras))
    assert (box[0] <= -radii).all() and (box[1] >= radii).all()
    # Two cells of the second search, each 1/40 of at most twice the thing, and the hull of 12 views around it.
    assert (np.abs(box) < 1.3 * radii + 0.05).all()


def test_silhouette_box_searches_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each search projects all cells to every view: first the whole box, then the box found."""
    camera = Camera(intrinsics(16, 16, 8, 8), (16, 16), look_at(np.array([0.0, -4, 0])))
    searched, count = [], region.count_views
    monkeypatch.setattr(region, "count_views", lambda cameras, cells: searched.append(len(cells)) or count(cameras, cells))
    region.silhouette_box([camera], [np.ones((16, 16), np.float32)], np.array([[-1.0] * 3, [1.0] * 3]))
    assert searched == [region.SILHOUETTE_CELLS**3] * 2


def test_a_cell_is_kept_for_the_outermost_pixel_of_its_sphere() -> None:
    """Only one point of the sphere is visible, 8 pixels from the centre.

    A pinhole would show it at most 7 pixels away; the lens magnifies by 1 + 3 k r^2 = 1.24.
    """
    camera = Camera(intrinsics(100, 100, 64, 4), (128, 8), np.eye(4), Lens(k1=0.35))
    cell, radius = np.array([48.0, 0.0, -100.0]), 5.0
    edge = cell + radius * np.array([1.0, 0, 0.48]) / np.hypot(1, 0.48)
    (place, end), _ = project(camera, np.array([cell, edge]))
    assert int(end[0]) - int(place[0]) == 8
    alpha = np.zeros((8, 128), np.float32)
    alpha[int(end[1]), int(end[0])] = 1
    assert len(region._opaque_cells(camera, alpha, cell[None], radius)) == 1


def test_parallel_cameras_have_no_focus(blender: Path) -> None:
    def same(table: dict) -> None:
        for frame in table["frames"]:
            frame["transform_matrix"] = ring(4)[0].tolist()

    edit(blender / "transforms_train.json", same)
    assert_refused("cameras that all look in one direction", load_photos, blender, background="white")
    assert load_photos(blender, background="white", box=[[-1] * 3, [1] * 3]).survey.box_from == "as given"


# -- Refusals -----------------------------------------------------------------------------------------------------


def spoil(key: str, value: object) -> object:
    """Return a change of frame 1 of a JSON file."""
    return lambda table: table["frames"][1].__setitem__(key, value)


SHEARED = (np.array(ring(4)[1]) @ np.diag([1.01, 1, 1, 1])).tolist()
MIRRORED = (np.array(ring(4)[1]) @ np.diag([-1, 1, 1, 1])).tolist()
NAN = np.full((4, 4), np.nan).tolist()

BAD_FRAMES = {
    "not a rotation": ("transform_matrix", SHEARED, r"r_1: found a transform that is not a rotation: it is off by 0\.02"),
    "mirrored": ("transform_matrix", MIRRORED, "not a rotation: it mirrors"),
    "NaN": ("transform_matrix", NAN, "r_1: found a transform with NaN"),
    "no matrix": ("transform_matrix", "x", "not a matrix"),
    "2 x 4": ("transform_matrix", np.eye(4)[:2].tolist(), r"shape \(2, 4\)"),
    "mask without a name": ("mask_path", 5, r"r_1: found mask_path = 5, expected the name of a file"),
    "looks away": ("transform_matrix", look_at(np.array([4.0, 0, 0]), np.array([9.0, 0, 0])).tolist(), "away from the box"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_invalid_frames_are_refused_in_a_sentence(blender: Path, case: str) -> None:
    key, value, message = BAD_FRAMES[case]
    edit(blender / "transforms_train.json", spoil(key, value))
    with pytest.raises(MivolError, match=message) as caught:
        load_photos(blender, background="white", box=[[-1] * 3, [1] * 3])
    assert str(caught.value).count("\n") == 0 and "expected" in str(caught.value)


def test_a_rounded_rotation_is_accepted(blender: Path) -> None:
    """Six decimals are off by 3e-6, which moves no pixel by 1e-4 at 14 pixels of focal length."""
    edit(blender / "transforms_train.json", spoil("transform_matrix", np.round(ring(4)[1], 6).tolist()))
    pose = load_photos(blender, background="white").views[1].camera.to_world[:3, :3]
    np.testing.assert_allclose(pose.T @ pose, np.eye(3), atol=1e-15)


def test_a_background_needs_alpha_and_alpha_is_over_white(blender: Path, tmp_path: Path) -> None:
    np.testing.assert_array_equal(load_photos(blender).views[0].background, [1, 1, 1])
    assert "transparent pixels show (1, 1, 1)" in load_photos(blender).describe()
    plain = write_blender(tmp_path / "plain", alpha=False)
    assert load_photos(plain).views[0].alpha is None
    assert_refused("image without alpha", load_photos, plain, background="white")
    assert_refused("image without alpha", load_photos(plain).views[0].over, [1, 1, 1])


@pytest.mark.parametrize("suffix", ["webp", "tif", "bmp"])
def test_photographs_with_other_suffixes_are_found(tmp_path: Path, suffix: str) -> None:
    folder, image = write_transforms(tmp_path / "set", {"fl_x": 20.0}), pixels(12, 8, 5, alpha=False)
    Image.fromarray(image).save(folder / f"other.{suffix}", lossless=True)
    edit(folder / "transforms.json", spoil("file_path", f"other.{suffix}"))
    read = load_photos(folder)
    assert not read.skipped
    np.testing.assert_array_equal(np.round(read.views[1].image * 255), image)


def test_a_data_set_without_images_is_refused(blender: Path) -> None:
    for file in (blender / "train").iterdir():
        file.unlink()
    assert_refused(r"none of the 4 listed photographs \(the first is \./train/r_0\)", load_photos, blender, background="white")


def test_a_damaged_image_is_refused(blender: Path) -> None:
    file = blender / "train" / "r_2.png"
    file.write_bytes(file.read_bytes()[:60])
    assert_refused(r"r_2.png: found a damaged", load_photos, blender, background="white")


def test_blender_images_of_two_sizes_are_refused(blender: Path) -> None:
    Image.fromarray(pixels(6, 4)).save(blender / "train" / "r_2.png")
    assert_refused("6 x 4 pixels, expected 12 x 8", load_photos, blender, background="white")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"split": "dev"}, "split: found"),
        ({"split": "val"}, "no photograph in the split val"),
        ({"scale": 2}, "scale: found 2"),
        ({"background": "pink"}, "background: found"),
        ({"background": (1, 2)}, "three finite numbers"),
        ({"space": "hsv"}, "space: found"),
        ({"stored": "hsv"}, "stored: found"),
        ({"held_out": 1}, "held_out: found 1"),
        ({"held_out": ["r_9.png"]}, 'no training photograph "r_9.png"'),
        ({"box": [[0, 0, 0], [0, 1, 1]]}, "low below high"),
    ],
)
def test_invalid_settings_are_refused(blender: Path, settings: dict, message: str) -> None:
    assert_refused(message, load_photos, blender, **{"background": "white", **settings})


def test_no_data_set(tmp_path: Path) -> None:
    assert_refused("no cameras", load_photos, tmp_path)
    assert_refused("nothing there", load_photos, tmp_path / "absent")


# -- Real data ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_chair(data_dir: Path) -> None:
    """The centre of the scene is opaque in every view; the 175 missing test images are listed."""
    chair = data_dir / "multiview" / "chair"
    survey = survey_photos(chair)
    assert len(survey.frames) == 125 and len(survey.skipped) == 175
    photos = load_photos(chair, split="test", scale=0.25, background="white")
    for view in photos.views:
        x, y = project(view.camera, np.zeros(3))[0]
        assert view.alpha[int(y), int(x)] > 0
        corners = np.concatenate([view.image[0, 0], view.image[-1, -1]])
        np.testing.assert_array_equal(corners, 1)
    assert (photos.box[0] < -1).all() and (photos.box[1] > 1).all()


def test_fox(data_dir: Path) -> None:
    """25 of 67 photographs exist; the ray of each pixel projects back to the pixel."""
    survey = survey_photos(data_dir / "multiview" / "fox")
    assert len(survey.frames) == 25 and len(survey.skipped) == 42
    assert survey.skipped[0] == "images/0002.jpg" and "images/0002.jpg" in survey.describe()
    for frame in survey.frames[::8]:
        pixel = pixel_centres(frame.camera.size)[::37, ::31]
        o, d = rays(frame.camera, pixel)
        np.testing.assert_allclose(project(frame.camera, o + 3 * d)[0], pixel, atol=1e-8)  # the focal length times 1e-12


def test_fox_photographs_agree_on_the_end_of_a_stalk(data_dir: Path) -> None:
    """The end of a stalk on the wallpaper, located by eye to a pixel in two photographs: its rays meet within two pixels.

    Mirrored in x or y the rays miss by 110 to 190 pixels.
    """
    cameras = {frame.file.name: frame.camera for frame in survey_photos(data_dir / "multiview" / "fox").frames}
    (o1, d1), (o2, d2) = rays(cameras["0001.jpg"], [681, 1163]), rays(cameras["0042.jpg"], [834.4, 1208.1])
    across = np.cross(d1, d2) / np.linalg.norm(np.cross(d1, d2))
    t1, t2, gap = np.linalg.solve(np.stack([d1, -d2, across], axis=1), o2 - o1)
    assert min(t1, t2) > 0
    assert abs(gap) / min(t1, t2) * 1375 < 2


@pytest.mark.parametrize("channels", [3, 4])
def test_png_of_16_bits_is_read_at_full_depth(tmp_path: Path, channels: int) -> None:
    """Pillow alone keeps the high byte, with steps of 1/255. Here only float32 rounds."""
    codes = np.random.default_rng(3).integers(0, 65536, (3, 5, channels), np.uint16)
    (tmp_path / "a.png").write_bytes(png_of_16_bits(codes))
    colour, alpha = read_photo(tmp_path / "a.png", "srgb")
    expected = codes / 65535
    if channels == 4:
        np.testing.assert_allclose(alpha, expected[..., 3], rtol=2e-7)
        expected = expected[..., :3] * expected[..., 3:]
    np.testing.assert_allclose(colour, expected, rtol=4e-7)


def test_grey_png_of_16_bits_is_read_at_full_depth(tmp_path: Path) -> None:
    codes = np.arange(15, dtype=np.uint16).reshape(3, 5) * 4001
    Image.fromarray(codes).save(tmp_path / "a.png")
    colour, alpha = read_photo(tmp_path / "a.png", "srgb")
    assert alpha is None
    np.testing.assert_allclose(colour, np.repeat(codes[..., None] / 65535, 3, axis=2), rtol=2e-7)


def rotate_by_exif(folder: Path, orientation: int) -> None:
    """Set the EXIF orientation of all photographs."""
    for file in folder.rglob("*.png"):
        with Image.open(file) as image:
            tags = image.getexif()
            tags[0x0112] = orientation
            image.save(file, exif=tags)


def test_photographs_rotated_by_exif(tmp_path: Path) -> None:
    """Stored or upright, as the size of the cameras shows; refused without a size."""
    write_transforms(tmp_path, {"fl_x": 10.0, "cx": 6.0, "cy": 4.0})
    rotate_by_exif(tmp_path, 6)
    stored = load_photos(tmp_path).views[0]
    assert stored.camera.size == (12, 8)
    edit(tmp_path / "transforms.json", lambda table: table.update(w=8.0, h=12.0))
    upright = load_photos(tmp_path)
    assert "4 photographs are turned by their EXIF orientation" in upright.describe()
    np.testing.assert_array_equal(upright.views[0].image, np.rot90(stored.image, -1))
    edit(tmp_path / "transforms.json", lambda table: (table.pop("w"), table.pop("h")))
    assert_refused("EXIF orientation 6, by which viewers turn", load_photos, tmp_path)


def test_a_half_turn_by_exif_is_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path, {"fl_x": 10.0, "w": 12, "h": 8})
    rotate_by_exif(tmp_path, 3)
    assert_refused("EXIF orientation 3, by which viewers turn", load_photos, tmp_path)


@pytest.mark.parametrize("background", [None, "white"])
def test_mixed_alpha_has_one_refusal(tmp_path: Path, background: str | None) -> None:
    """With and without a background the sentence is the same and names both kinds."""
    write_blender(tmp_path, alpha=True)
    file = tmp_path / "train" / "r_0.png"
    with Image.open(file) as image:
        image.convert("RGB").save(file)
    assert_refused(r"found alpha here but not in r_0\.png", load_photos, tmp_path, background=background)


def test_a_test_view_in_the_training_split_is_refused(tmp_path: Path) -> None:
    """By its file, and by pose and bytes under another name; reading the training split still works."""
    write_blender(tmp_path, alpha=False)
    edit(tmp_path / "transforms_test.json", lambda table: table["frames"][0].update(file_path="./train/r_1"))
    assert_refused(r"also fitted as \./train/r_1", load_photos, tmp_path, split="test")
    assert len(load_photos(tmp_path, split="train").views) == 4
    fitted = json.loads((tmp_path / "transforms_train.json").read_text())["frames"][2] | {"file_path": "./test/r_9"}
    edit(tmp_path / "transforms_test.json", lambda table: table["frames"].__setitem__(0, fitted))
    (tmp_path / "test" / "r_9.png").write_bytes((tmp_path / "train" / "r_2.png").read_bytes())
    assert_refused(r"also fitted as \./train/r_2", load_photos, tmp_path, split="test")


def test_other_pixels_at_the_pose_of_a_training_view_are_judged(tmp_path: Path) -> None:
    """Pixels make the difference: both files have one size and one date."""
    write_blender(tmp_path, alpha=False)
    fitted = json.loads((tmp_path / "transforms_train.json").read_text())["frames"][2] | {"file_path": "./test/r_9"}
    edit(tmp_path / "transforms_test.json", lambda table: table["frames"].__setitem__(0, fitted))
    for file, level in ((tmp_path / "train" / "r_2.png", 80), (tmp_path / "test" / "r_9.png", 90)):
        Image.new("RGB", (12, 8), (level,) * 3).save(file, compress_level=0)
        os.utime(file, (0, 0))
    assert load_photos(tmp_path, split="test").views[0].image.max() == np.float32(90 / 255)


def test_an_empty_file_of_colmap_points_is_valid(tmp_path: Path) -> None:
    """COLMAP's manual creates an empty points3D.txt for known poses ("Reconstruct sparse/dense model from known poses")."""
    write_colmap(tmp_path, encoding="txt")
    (tmp_path / "sparse/0/points3D.txt").write_bytes(b"")
    photos = load_photos(tmp_path)
    assert "% of 4 cameras" in photos.survey.box_from


def test_photographs_of_unlimited_size_are_surveyed(tmp_path: Path) -> None:
    """180 million pixels: Pillow alone refuses such images; here the memory limit refuses their pixels."""
    write_transforms(tmp_path, {"fl_x": 1e4, "w": 15000, "h": 12000}, n=1)
    (file,) = tmp_path.rglob("*.png")
    Image.new("1", (15000, 12000)).save(file)
    assert read_photo_header(file).size == (15000, 12000)
    assert_refused("GiB", load_photos, tmp_path, box=[[-1, -1, -1], [1, 1, 1]], limit=1 << 30)
