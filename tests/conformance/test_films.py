"""Films of what was photographed: where their cameras stand, distances and normals as colours, and what a player gets."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from photo_sets import look_at, ring
from PIL import Image

from mivol.errors import MivolError
from mivol.photos import Camera, aim_camera, interpolate_cameras, intrinsics, pixel_centres, project, rays, turntable
from mivol.report import video
from mivol.report.pixel_scale import depth_pixels, normal_pixels, normals_from_depth
from mivol.report.video import film_suffix, write_video

LIKE = Camera(intrinsics(90, 100, 30, 20), (64, 48), np.eye(4))
BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def cameras_of(poses: list[np.ndarray]) -> list[Camera]:
    """Cameras like LIKE at poses."""
    return [Camera(LIKE.K, LIKE.size, pose) for pose in poses]


# -- Journeys -----------------------------------------------------------------------------------------------------


def test_facing_puts_the_target_in_the_middle_and_up_upwards() -> None:
    camera = aim_camera(LIKE, np.array([3.0, 1, 2]), np.array([0.5, 0, 0]), np.array([0, 0, 1]))
    np.testing.assert_allclose(project(camera, np.array([0.5, 0, 0]))[0], (32, 24), atol=1e-12)
    x, y = project(camera, np.array([0.5, 0, 0.1]))[0]
    assert x == pytest.approx(32, abs=1e-12) and y < 24
    assert camera.K[0, 0] == camera.K[1, 1] == 100
    with pytest.raises(MivolError, match="along the upward direction"):
        aim_camera(LIKE, np.array([0.0, 0, 2]), np.zeros(3), np.array([0, 0, 1]))


@pytest.mark.parametrize("middle", [(0, 0, 0), (5.0, -3.0, 2.0)])
def test_turntable_of_a_ring_is_the_ring(middle: tuple[float, ...]) -> None:
    """Cameras at distance 4 and height 1 about z: so are those of the turntable, in equal steps all around."""
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


def test_turntable_of_an_arc_swings_over_it() -> None:
    """Cameras over 100 degrees from azimuth 20 on: none of the film's lies outside, and both ends are reached."""
    azimuths = np.radians(np.linspace(20, 120, 6))
    poses = [look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 0.5])) for a in azimuths]
    found = turntable(cameras_of(poses), BOX, 40)
    angles = np.degrees([np.arctan2(camera.origin[1], camera.origin[0]) for camera in found])
    assert angles.min() == pytest.approx(20, abs=1e-3) and angles.max() == pytest.approx(120, abs=1e-3)


def test_a_way_between_views_goes_through_them() -> None:
    given = cameras_of(ring(4))
    found = interpolate_cameras(given, 7)
    for camera, wanted in zip(found[::2], given, strict=True):
        np.testing.assert_allclose(camera.to_world, wanted.to_world, atol=1e-9)
    np.testing.assert_allclose(interpolate_cameras(given[:2], 3)[2].to_world, given[1].to_world, atol=1e-9)
    with pytest.raises(MivolError, match="found 1 cameras"):
        interpolate_cameras(given[:1], 5)


def test_no_common_up() -> None:
    turned = [pose @ np.diag([-1.0, -1, 1, 1]) for pose in ring(4)]
    with pytest.raises(MivolError, match="common upward direction"):
        turntable(cameras_of(ring(4) + turned), BOX, 4)


# -- Distances and normals ----------------------------------------------------------------------------------------


def test_normals_of_a_sphere(artefacts: Path) -> None:
    camera = Camera(intrinsics(400, 400, 100, 80), (200, 160), look_at(np.array([3.0, -2, 1.5])))
    o, d = rays(camera, pixel_centres(camera.size))
    b = np.sum(o * d, axis=-1)
    with np.errstate(invalid="ignore"):
        distance = -b - np.sqrt(b**2 - np.sum(o * o, axis=-1) + 0.25)
    there = np.isfinite(distance)
    normals = normals_from_depth(distance, camera)
    inner = np.isfinite(normals).all(axis=-1) & (np.sum(normals * d, axis=-1) < -0.3)
    truth = 2 * (o + distance[..., None] * d)
    # Central differences of z = sqrt(1 - x^2) err by h^2/6 z''' = h^2/(2 z^5) in slope, h^2/(2 z^3) in angle: with pixels of
    # h = 3.4/400 on a radius of 1/2 and z = 0.3 it is 5.4e-3 along each axis, 7.6e-3 for both.
    assert inner.sum() > 5000
    np.testing.assert_allclose(normals[inner], truth[inner], atol=7.6e-3)
    depth = depth_pixels(distance, (2.5, 4.5))
    assert (depth[~there] == 255).all() and (depth[there] < 255).any(axis=-1).all()
    Image.fromarray(np.hstack([depth, normal_pixels(normals)])).save(artefacts / "sphere.png")


def test_colours_of_distances() -> None:
    distance = np.array([[1.0, 2, 3, np.inf], [1, 2, 3, 0]])
    found = depth_pixels(distance, (1, 3), np.array([[1, 1, 1, 1], [1, 0.5, 0, 1]]))
    brightness = found.astype(float).mean(axis=-1)
    assert brightness[0, 0] > brightness[0, 1] > brightness[0, 2]
    assert (found[0, 3] == 255).all() and (found[1, 2] == 255).all()
    np.testing.assert_array_equal(found[1, 3], found[1, 0])  # nearer than near is near
    np.testing.assert_allclose(found[1, 1], (found[0, 1] + 255.0) / 2, atol=1)
    np.testing.assert_array_equal(normal_pixels(np.array([[[0.0, 0, 1], [-1, 0, 0]]]))[0], [[128, 128, 255], [0, 128, 128]])
    for shape, span, message in (((3,), (0, 1), "give \\(height, width\\)"), ((2, 2), (1, 1), "give near below far")):
        with pytest.raises(MivolError, match=message):
            depth_pixels(np.ones(shape), span)
    with pytest.raises(MivolError, match="do not fit a camera"):
        normals_from_depth(np.ones((5, 5)), LIKE)


# -- Films --------------------------------------------------------------------------------------------------------


def frames(n: int = 6, height: int = 45, width: int = 33) -> list[np.ndarray]:
    """Grey ramps that get brighter, with an odd number of rows and columns."""
    ramp = np.linspace(0, 120, width)[None, :, None]
    return [np.broadcast_to(ramp + 20 * i, (height, width, 3)).astype(np.uint8) for i in range(n)]


def test_mp4_is_what_a_player_shows(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = write_video(tmp_path / "film.mp4", iter(frames()), fps=10)
    decode = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    told = subprocess.run(decode, capture_output=True, check=True)
    assert b"h264" in told.stderr and b"yuv420p" in told.stderr and b"34x46" in told.stderr and b"10 fps" in told.stderr
    shown = np.frombuffer(told.stdout, np.uint8).reshape(6, 46, 34, 3)
    for found, wanted in zip(shown, frames(), strict=True):
        # 8-bit YUV of limited range rounds by 1.2 codes, a constant rate factor of 18 loses about as much.
        np.testing.assert_allclose(found[:45, :33].astype(float), wanted, atol=6)
    assert not list(tmp_path.glob(".*"))


def test_gif_needs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with Image.open(write_video(tmp_path / "usual.gif", frames())) as film:
        assert film.info["duration"] == 40  # 25 frames a second
    path = write_video(tmp_path / "film.gif", frames(), fps=20)
    with Image.open(path) as film:
        assert film.n_frames == 6 and film.info["duration"] == 50
        film.seek(5)
        np.testing.assert_allclose(np.asarray(film.convert("RGB"), float), frames()[5], atol=4)
    with pytest.raises(MivolError, match="needs imageio-ffmpeg"):
        write_video(tmp_path / "film.mp4", frames())
    assert not (tmp_path / "film.mp4").exists()


def test_webp_needs_nothing_and_has_all_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path = write_video(tmp_path / "film.webp", frames(), fps=8)
    with Image.open(path) as film:
        assert film.format == "WEBP" and film.n_frames == 6
        film.seek(5)
        film.load()
        assert film.info["duration"] == 125
        # Lossy at quality 90: as far off as the rounding of 8-bit YUV and a quantiser of 2 to 3 codes leave a ramp.
        np.testing.assert_allclose(np.asarray(film.convert("RGB"), float), frames()[5], atol=6)


@pytest.mark.parametrize("module", [None, SimpleNamespace(get_ffmpeg_exe=Mock(side_effect=RuntimeError("No ffmpeg exe")))])
def test_films_without_ffmpeg_are_webp(module: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where its package is not installed, and where the package has no program for this machine."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", module)
    assert film_suffix() == ".webp"
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(get_ffmpeg_exe=Mock(return_value="ffmpeg")))
    assert film_suffix() == ".mp4"


def test_films_that_are_refused(tmp_path: Path) -> None:
    one = frames(1)[0]
    cases = [
        ("film.avi", [one], {}, ".mp4, .webp, .gif"),
        ("film.gif", [], {}, "at least one frame"),
        ("film.gif", [one, one[:-1]], {}, "frames of one size"),
        ("film.gif", [one / 255], {}, "frame 0 is float64"),
        ("film.gif", [one], {"fps": 0}, "0 frames per second"),
    ]
    for name, given, settings, message in cases:
        with pytest.raises(MivolError, match=message):
            write_video(tmp_path / name, given, **settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(3, 4), (2, 5), (3, 5), (2, 4)])
def test_frames_of_odd_sizes_repeat_their_last_row_and_column(shape: tuple[int, int]) -> None:
    frame = np.arange(shape[0] * shape[1] * 3, dtype=np.uint8).reshape(*shape, 3)
    found = video._pad_to_even(frame)
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge"))
