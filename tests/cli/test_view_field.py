"""``mivol render`` of a radiance field: from where one likes, over the sky beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from mivol.cli import main
from mivol.experiments.render import make_camera
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field, write_field
from mivol.fields.sky import read_sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_exr, write_exr
from mivol.files.image_files import decode_srgb
from mivol.photos import project
from mivol.photos.camera_path import HomeView

Y0 = 0.28209479177387814


@pytest.fixture
def field(variant_rgb: str, tmp_path: Path) -> Path:
    """An opaque cube from -1 to 1 of the codes (0.9, 0.5, 0.1)."""
    sh = np.broadcast_to((np.array([0.9, 0.5, 0.1]) - 0.5) / Y0, (4, 4, 4, 1, 3))
    place = np.diag([2.0, 2, 2, 1])
    place[:3, 3] = -1
    write_field(tmp_path / "field.npz", SphericalGrid.from_dense(np.full((4, 4, 4), 500.0), sh, place), half=False)
    return tmp_path / "field.npz"


def test_a_field_is_seen_from_where_one_likes(field: Path, capsys: pytest.CaptureFixture) -> None:
    """The cube fills the middle of the picture; the sky is behind it where there is one, and black where there is none."""
    view = ["--look-at", "0", "-4", "0", "0", "0", "0", "--fov", "60", "--size", "32", "24"]
    images = []
    for colour in (None, 0.25):
        if colour is not None:
            write_exr(field.with_name("sky.exr"), {"": np.full((4, 8, 3), colour, np.float32)})
        assert main(["render", str(field), *view, "-o", str(field.with_name("view.exr"))]) == 0
        channels, _ = read_exr(field.with_name("view.exr"))
        images.append(np.stack([channels[name] for name in "RGB"], axis=-1))
    assert images[0].shape == (24, 32, 3)
    for image, behind in zip(images, (0.0, 0.25), strict=True):
        # Codes as the light they stand for; an extinction of 500 leaves nothing, a few roundings stay.
        np.testing.assert_allclose(image[12, 16], decode_srgb(np.array([0.9, 0.5, 0.1])), atol=1e-5)
        np.testing.assert_allclose(image[0, 0], decode_srgb(np.array([behind] * 3)), atol=1e-5)
    # The face at distance 3 is 2 wide: 2 / 3 of the focal length of 16 / tan(30) pixels, 18.5 of them.
    assert abs((images[0][12, :, 0] > 0.1).sum() - 18.5) <= 1
    assert str(field.with_name("view.exr")) in capsys.readouterr().out


def test_a_field_keeps_its_first_view(field: Path, tmp_path: Path) -> None:
    """The kept camera looks at a corner with -y up: its picture and the scene's are those of the same camera by hand."""
    view = HomeView((0.0, -1.0, 0.0), (0.0, -1.0, -4.0), (1.0, -1.0, 0.0), 40.0, (8, 4))
    write_field(field, read_field(field), half=False, view=view)
    assert read_field_view(field) == view
    pictures = []
    by_hand = ["--look-at", "0", "-1", "-4", "1", "-1", "0", "--fov", "40", "--size", "640", "320"]
    for options in ([], [*by_hand], [*by_hand, "--up", "0", "0.5", "0"]):
        assert main(["render", str(field), *options, "-o", str(tmp_path / "view.exr")]) == 0
        pictures.append(read_exr(tmp_path / "view.exr")[0]["R"])
    assert pictures[0].shape == (320, 640) and pictures[0].max() > 0.5
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_allclose(pictures[2], pictures[0][::-1, ::-1], atol=1e-6)
    assert main(["export", str(field), str(tmp_path / "scene.xml")]) == 0
    text = (tmp_path / "scene.xml").read_text()
    for said in ('origin="0, -1, -4" target="1, -1, 0" up="0, -1, 0"', 'name="fov" value="40"', 'name="height" value="240"'):
        assert said in text
    assert read_field_view(tmp_path / "scene-field.npz") == view


def test_the_camera_stands_where_it_is_told() -> None:
    camera = make_camera([1.0, 2.0, 3.0, 4.0, 2.0, 3.0], [0.0, 0.0, 1.0], 90.0, (40, 20))
    np.testing.assert_allclose(camera.origin, [1, 2, 3])
    # What it looks at is in the middle, upwards is up, and 45 degrees to the left is the edge.
    at, depth = project(camera, np.array([[4.0, 2, 3], [4.0, 2, 4], [4.0, 5, 3]]))
    np.testing.assert_allclose(depth, 3, atol=1e-9)
    np.testing.assert_allclose(at, [[20, 10], [20, 10 - 20 / 3], [0, 10]], atol=1e-9)


@pytest.mark.parametrize(
    ("up", "fov", "size", "says"),
    [
        ([0.0, 0.0, 1.0], 180.0, (4, 4), "is no camera"),
        ([0.0, 0.0, np.nan], 50.0, (4, 4), "is no camera"),
        ([0.0, 0.0, 1.0], 50.0, (0, 4), "is no camera"),
        ([1.0, 0.0, 0.0], 50.0, (4, 4), "upward direction"),
    ],
    ids=["angle", "number", "size", "up"],
)
def test_cameras_that_cannot_be_are_refused(up: list[float], fov: float, size: tuple[int, int], says: str) -> None:
    assert_refused(says, make_camera, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], up, fov, size)


def test_what_is_no_field_has_its_own_cameras(field: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["render", str(field), "-o", str(tmp_path / "a.png")]) == 1
    assert "keeps no camera, as the field of a fit to photographs does: give --look-at" in capsys.readouterr().err
    assert main(["render", "scene.xml", "--look-at", *"123456", "-o", str(tmp_path / "a.png")]) == 1
    assert "is for a field, points or a volume" in capsys.readouterr().err
    write_exr(tmp_path / "sky.exr", {"": np.zeros((4, 4, 3), np.float32)})
    assert_refused("is no sky", read_sky, tmp_path / "sky.exr")
