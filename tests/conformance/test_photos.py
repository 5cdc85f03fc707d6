"""Posed photographs: what is read is what was written, in the conventions that are said."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from photo_sets import edit, look_at, pixels, ring, write_blender
from PIL import Image

from mivol.errors import MivolError
from mivol.files import write_exr
from mivol.photos import Camera, intrinsics, load_photos, pixel_centres, project, rays, survey_photos
from mivol.photos.picture import decode_srgb, shrink

EPS = float(np.finfo(np.float32).eps)


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """Four training and two test views of 12 x 8 pixels with alpha."""
    return write_blender(tmp_path / "set")


# -- Rays ---------------------------------------------------------------------------------------------------------


def test_rays_of_corners_and_centre() -> None:
    """By hand: 90 degrees over 4 pixels, so fx = 2; the camera stands at (1, 2, 3) unrotated and looks along -z."""
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    camera = Camera(intrinsics(2, 2, 2, 1), (4, 2), pose)
    o, d = rays(camera, np.array([[2, 1], [0, 1], [4, 1], [2, 0]]))
    np.testing.assert_array_equal(o, np.tile([1, 2, 3], (4, 1)))
    root = math.sqrt(0.5)
    wanted = [[0, 0, -1], [-root, 0, -root], [root, 0, -root], [0, 1 / math.sqrt(5), -2 / math.sqrt(5)]]
    np.testing.assert_allclose(d, wanted, atol=1e-15)  # a few float64 roundings


def test_pixel_centres_lie_half_a_pixel_in() -> None:
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
    behind, negative = project(camera, o - d)
    assert np.isnan(behind).all() and (negative < 0).all()


def test_resized_camera_sees_the_same() -> None:
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
def test_alpha_over_a_background(blender: Path, background: object) -> None:
    view = load_photos(blender, background=background).views[2]
    stored = pixels(12, 8, 2) / 255
    colour = np.ones(3) if background == "white" else np.array(background)
    wanted = stored[..., :3] * stored[..., 3:] + (1 - stored[..., 3:]) * colour
    np.testing.assert_allclose(view.image, wanted, atol=4 * EPS)
    other = stored[..., :3] * stored[..., 3:] + (1 - stored[..., 3:]) * [1, 0, 0.5]
    np.testing.assert_allclose(view.over([1, 0, 0.5]), other, atol=8 * EPS)


def test_random_backgrounds_differ_between_views_and_follow_the_seed(blender: Path) -> None:
    colours = [view.background for view in load_photos(blender, background="random", seed=3).views]
    assert len({tuple(colour) for colour in colours}) == 4
    again = [view.background for view in load_photos(blender, background="random", seed=3).views]
    np.testing.assert_array_equal(colours, again)


def test_linear_on_request(blender: Path) -> None:
    view = load_photos(blender, background="black", space="linear").views[0]
    stored = pixels(12, 8, 0) / 255
    # The formula of IEC 61966-2-1, written again; 1e-6: float32 and a power.
    light = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)[..., :3]
    np.testing.assert_allclose(view.image, light * stored[..., 3:], atol=1e-6)


@pytest.mark.parametrize(("scale", "size"), [(0.5, (6, 4)), (0.25, (3, 2)), (0.4, (5, 3))])
def test_shrunk_by_exact_means_with_alpha(blender: Path, scale: float, size: tuple[int, int]) -> None:
    """Against a sum over the overlaps of all old with all new pixels; a transparent pixel's colour counts for nothing."""
    view = load_photos(blender, background="black", scale=scale).views[0]
    assert view.camera.size == size
    stored = pixels(12, 8, 0) / 255
    multiplied = stored[..., :3] * stored[..., 3:]
    wanted = np.einsum("ai,bj,ijc->abc", overlaps(8, size[1]), overlaps(12, size[0]), multiplied)
    np.testing.assert_allclose(view.image, wanted, atol=4 * EPS)
    np.testing.assert_allclose(rays(view.camera, np.zeros(2)), rays(survey_photos(blender).frames[0].camera, np.zeros(2)))


def overlaps(old: int, new: int) -> np.ndarray:
    """(new, old) share of each new cell that an old one covers."""
    edge = np.arange(new + 1)[:, None] * old / new
    low, high = np.maximum(edge[:-1], np.arange(old)), np.minimum(edge[1:], np.arange(old) + 1)
    return np.maximum(high - low, 0) * new / old


def test_shrink_keeps_the_mean() -> None:
    image = np.random.default_rng(1).random((7, 11, 3))
    assert shrink(image, (4, 5)).mean() == pytest.approx(image.mean(), abs=4 * EPS)


def test_missing_photographs_are_skipped_by_name(blender: Path) -> None:
    (blender / "train" / "r_1.png").unlink()
    photos = load_photos(blender, background="white")
    assert photos.skipped == ("./train/r_1",)
    assert [view.name for view in photos.views] == ["r_0.png", "r_2.png", "r_3.png"]
    assert "./train/r_1" in photos.text


def test_held_out_photographs_are_neither_trained_on_nor_lost(blender: Path) -> None:
    names = {
        split: [view.name for view in load_photos(blender, split=split, held_out=2, background="white").views]
        for split in ("train", "held_out")
    }
    assert names == {"train": ["r_1.png", "r_3.png"], "held_out": ["r_0.png", "r_2.png"]}
    named = load_photos(blender, split="held_out", held_out=["r_3.png"], background="white")
    assert [view.name for view in named.views] == ["r_3.png"]


def test_exr_is_linear_and_multiplied(tmp_path: Path) -> None:
    folder = write_blender(tmp_path / "set", train=2)
    values = np.random.default_rng(0).random((8, 12, 4), np.float32) * 2
    values[..., 3] = np.minimum(values[..., 3], 1)
    for i in range(2):
        (folder / "train" / f"r_{i}.png").unlink()
        write_exr(folder / "train" / f"r_{i}.exr", {"": values})
    photos = load_photos(folder, background="white")
    assert photos.space == "linear"
    np.testing.assert_allclose(photos.views[0].image, values[..., :3] + 1 - values[..., 3:], atol=4 * EPS)


def test_decode_inverts_the_curve_of_png() -> None:
    from mivol.files import encode_srgb

    code = np.arange(256) / 255
    # The standard's two branches meet to 1e-5 only, at code 0.04045, which no 8-bit value is.
    np.testing.assert_allclose(encode_srgb(decode_srgb(code)), code, atol=1e-9)


def test_box_of_cameras_about_a_sphere() -> None:
    """Many cameras about the origin share its ball of radius distance sin(half the angle), and little more."""
    from mivol.photos.region import focus_of, near_far_of, shared_box

    rng = np.random.default_rng(5)
    places = rng.normal(size=(200, 3))
    places *= 4 / np.linalg.norm(places, axis=1, keepdims=True)
    cameras = [Camera(intrinsics(100, 100, 40, 40), (80, 80), look_at(place)) for place in places]
    np.testing.assert_allclose(focus_of(cameras), 0, atol=1e-12)
    radius = 4 * math.sin(math.atan(0.4))  # 1.486
    box = shared_box(cameras)
    # The region is the ball's hull by planes, cut by 90 % of the views: a bound from both sides, one cell (1/32) included.
    assert (np.abs(box) > radius * (1 - 1 / 16)).all() and (np.abs(box) < 1.25 * radius).all()
    near, far = near_far_of(cameras, box)
    distances = [np.linalg.norm(np.clip(p, *box) - p) for p in places]
    assert near == pytest.approx(min(distances)) and far < 4 + np.linalg.norm(box, axis=1).max()


# -- What is refused ----------------------------------------------------------------------------------------------


def spoil(key: str, value: object) -> object:
    """A change of frame 1 of a JSON file."""
    return lambda table: table["frames"][1].__setitem__(key, value)


SHEARED = (np.array(ring(4)[1]) @ np.diag([1.01, 1, 1, 1])).tolist()
MIRRORED = (np.array(ring(4)[1]) @ np.diag([-1, 1, 1, 1])).tolist()
NAN = np.full((4, 4), np.nan).tolist()

BAD_FRAMES = {
    "not a rotation": ("transform_matrix", SHEARED, r"r_1: found a transform that is not a rotation: it is off by 0\.02"),
    "mirrored": ("transform_matrix", MIRRORED, "not a rotation: it mirrors"),
    "NaN": ("transform_matrix", NAN, "r_1: found a transform that holds NaN"),
    "no matrix": ("transform_matrix", "x", "no matrix"),
    "3 x 4": ("transform_matrix", np.eye(4)[:3].tolist(), r"shape \(3, 4\)"),
    "looks away": ("transform_matrix", look_at(np.array([4.0, 0, 0]), np.array([9.0, 0, 0])).tolist(), "away from the box"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_bad_frames_are_refused_in_a_sentence(blender: Path, case: str) -> None:
    key, value, message = BAD_FRAMES[case]
    edit(blender / "transforms_train.json", spoil(key, value))
    with pytest.raises(MivolError, match=message) as caught:
        load_photos(blender, background="white", box=[[-1] * 3, [1] * 3])
    assert str(caught.value).count("\n") == 0 and "expected" in str(caught.value)


def test_a_rotation_of_rounded_numbers_passes(blender: Path) -> None:
    """Six decimals are off by 3e-6; at 14 pixels of focal length that moves no pixel by 1e-4."""
    edit(blender / "transforms_train.json", spoil("transform_matrix", np.round(ring(4)[1], 6).tolist()))
    pose = load_photos(blender, background="white").views[1].camera.to_world[:3, :3]
    np.testing.assert_allclose(pose.T @ pose, np.eye(3), atol=1e-15)


def test_images_and_backgrounds_must_fit(blender: Path, tmp_path: Path) -> None:
    with pytest.raises(MivolError, match="image with alpha"):
        load_photos(blender)
    plain = write_blender(tmp_path / "plain", alpha=False)
    assert load_photos(plain).views[0].alpha is None
    with pytest.raises(MivolError, match="image without alpha"):
        load_photos(plain, background="white")
    with pytest.raises(MivolError, match="image without alpha"):
        load_photos(plain).views[0].over([1, 1, 1])


def test_a_set_without_images_is_refused(blender: Path) -> None:
    for file in (blender / "train").iterdir():
        file.unlink()
    with pytest.raises(MivolError, match=r"none of the 4 photographs that it names \(\./train/r_0 is the first\)"):
        load_photos(blender, background="white")


def test_a_damaged_image_is_refused(blender: Path) -> None:
    file = blender / "train" / "r_2.png"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(MivolError, match=r"r_2.png: found a damaged"):
        load_photos(blender, background="white")


def test_images_of_two_sizes_in_one_blender_set_are_refused(blender: Path) -> None:
    Image.fromarray(pixels(6, 4)).save(blender / "train" / "r_2.png")
    with pytest.raises(MivolError, match="6 x 4 pixels, expected 12 x 8"):
        load_photos(blender, background="white")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"split": "dev"}, "split: found"),
        ({"split": "val"}, "no photograph in the split val"),
        ({"scale": 2}, "scale: found 2"),
        ({"background": "pink"}, "background: found"),
        ({"background": (1, 2)}, "three finite numbers"),
        ({"space": "hsv"}, "space: found"),
        ({"held_out": 1}, "held_out: found 1"),
        ({"held_out": ["r_9.png"]}, 'no training photograph "r_9.png"'),
        ({"box": [[0, 0, 0], [0, 1, 1]]}, "low below high"),
    ],
)
def test_bad_settings_are_refused(blender: Path, settings: dict, message: str) -> None:
    with pytest.raises(MivolError, match=message):
        load_photos(blender, **{"background": "white", **settings})


def test_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(MivolError, match="no cameras"):
        load_photos(tmp_path)
    with pytest.raises(MivolError, match="nothing there"):
        load_photos(tmp_path / "absent")


# -- Real data ----------------------------------------------------------------------------------------------------


def test_chair(data_dir: Path) -> None:
    """The middle of the scene lies within the chair in every view; the 175 test images that are not there are named."""
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
