"""Films: where the camera goes, how long a film is, what a player decodes, and projections of a rotating volume."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from photo_sets import ring
from PIL import Image
from refusals import assert_refused

from mivol.config import ShowSettings
from mivol.errors import MivolError
from mivol.experiments import film
from mivol.experiments import film as film_module
from mivol.experiments.film import FEWEST_LAYERS, Film, film_of_volume, film_suffix, plan_film, volume_frames, write_video
from mivol.experiments.run_folder import RunFolder
from mivol.photos import Camera, intrinsics
from mivol.report.page import write_page
from mivol.report.record import RunRecord, write_record

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def photos(poses: list[np.ndarray], size: tuple[int, int] = (64, 32)) -> SimpleNamespace:
    cameras = [Camera(intrinsics(50, 50, size[0] / 2, size[1] / 2), size, pose) for pose in poses]
    return SimpleNamespace(views=[SimpleNamespace(camera=camera) for camera in cameras], box=BOX)


def origins(film: Film) -> np.ndarray:
    return np.array([camera.origin for camera in film.cameras])


def test_a_film_goes_around_through_or_past() -> None:
    """A ring of four at a distance of 4 and a height of 1."""
    seen = photos(ring(4))
    around = plan_film(ShowSettings(frames=6), seen)
    assert around.way == "turntable" and len(around.cameras) == 6
    np.testing.assert_allclose(np.hypot(*origins(around)[:, :2].T), 4, atol=1e-9)
    through = plan_film(ShowSettings(frames=7, way="views"), seen)
    np.testing.assert_allclose(origins(through)[::2], [view.camera.origin for view in seen.views], atol=1e-9)
    keys = ((3.0, 0.0, 1.0, 0.0, 0.0, 0.0), (0.0, 3.0, 2.0, 0.0, 0.0, 1.0), (-3.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    past = plan_film(ShowSettings(frames=5, way="keyframes", keyframes=keys), seen)
    np.testing.assert_allclose(origins(past)[::2], np.array(keys)[:, :3], atol=1e-9)
    for camera, key in zip(past.cameras[::2], keys, strict=True):
        ahead = np.array(key[3:]) - key[:3]
        np.testing.assert_allclose(-camera.to_world[:3, 2], ahead / np.linalg.norm(ahead), atol=1e-9)
        assert camera.to_world[2, 1] > 0
    assert plan_film(ShowSettings(frames=0), seen).cameras == ()


@pytest.mark.parametrize(
    ("given", "expected", "shrink"), [((64, 32), (64, 32), 1), ((1024, 512), (256, 128), 4), ((2048, 1), (256, 1), 8)]
)
def test_films_are_small(given: tuple[int, int], expected: tuple[int, int], shrink: float) -> None:
    found = plan_film(ShowSettings(frames=3), photos(ring(4), given))
    assert {camera.size for camera in found.cameras} == {expected} and found.shrink == shrink


def test_what_nobody_asked_for_is_left_out_with_a_note() -> None:
    """Half of the photographs upside down: no way around; one alone: no way through. Keyframes were asked for."""
    upset = [*ring(4), *(pose @ np.diag([-1.0, -1, 1, 1]) for pose in ring(4))]
    keys = ((3.0, 0.0, 1.0, 0.0, 0.0, 0.0), (0.0, 3.0, 2.0, 0.0, 0.0, 1.0))
    cases = ((ShowSettings(), upset, "without a common upward direction"), (ShowSettings(way="views"), ring(1), "1 cameras"))
    for show, poses, words in cases:
        found = plan_film(show, photos(poses))
        (note,) = found.notes
        assert not found.cameras and note.startswith("There is no film: ") and words in note
    assert_refused("without a common upward direction", plan_film, ShowSettings(way="keyframes", keyframes=keys), photos(upset))
    down = ((0.0, 0.0, 3.0, 0.0, 0.0, 0.0), (0.0, 0.0, 4.0, 0.0, 0.0, 1.0))
    with pytest.raises(MivolError, match="a view along the upward direction"):
        plan_film(ShowSettings(way="keyframes", keyframes=down), photos(ring(4)))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"way": "keyframes"}, "0 keyframes were given: at least 2"),
        ({"keyframes": ((0.0,) * 6,) * 2}, 'beside way = "turntable"'),
    ],
)
def test_keyframes_and_their_way_belong_together(settings: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ShowSettings(**settings)


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_a_film_is_four_seconds_long(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, suffix: str) -> None:
    """Its pictures as bytes; where it is no mp4 the way to one is said."""
    films, said = [], []
    progress = SimpleNamespace(say=said.extend, track=lambda items, what: iter(items))
    monkeypatch.setattr(film_module, "film_suffix", lambda: suffix)
    monkeypatch.setattr(film_module, "write_video", lambda path, frames, fps: films.append((path, list(frames), fps)))
    picture = lambda camera: np.array([[[-1.0, 0.125 * camera, 2.0]]])  # noqa: E731
    image = Film(tuple(range(8)), "views").write(tmp_path, picture, progress)
    ((path, frames, fps),) = films
    assert path == tmp_path / f"film/views{suffix}" and fps == 2
    assert [frame.tolist() for frame in frames] == [[[[0, round(0.125 * 255 * k), 255]]] for k in range(8)]
    assert frames[0].dtype == np.uint8
    assert (image.path, image.role, image.caption) == (f"film/views{suffix}", "film", "8 views through the photographs' places")
    assert said == ([] if suffix == ".mp4" else [film_module.NO_FFMPEG_NOTE])


def frames(n: int = 6, height: int = 45, width: int = 33) -> list[np.ndarray]:
    """Return grey ramps of increasing brightness with odd numbers of rows and columns."""
    ramp = np.linspace(0, 120, width)[None, :, None]
    return [np.broadcast_to(ramp + 20 * i, (height, width, 3)).astype(np.uint8) for i in range(n)]


def test_a_player_decodes_the_frames_of_an_mp4(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = write_video(tmp_path / "film.mp4", iter(frames()), fps=10)
    decode = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    assert (
        b"h264" in decoded.stderr
        and b"yuv420p" in decoded.stderr
        and b"34x46" in decoded.stderr
        and b"10 fps" in decoded.stderr
    )
    images = np.frombuffer(decoded.stdout, np.uint8).reshape(6, 46, 34, 3)
    for image, frame in zip(images, frames(), strict=True):
        # 8-bit YUV of limited range rounds by 1.2 codes; a constant rate factor of 18 loses about the same.
        np.testing.assert_allclose(image[:45, :33].astype(float), frame, atol=6)
    assert not list(tmp_path.glob(".*"))


def test_a_gif_needs_no_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with Image.open(write_video(tmp_path / "usual.gif", frames())) as film:
        assert film.info["duration"] == 40  # 25 frames a second
    path = write_video(tmp_path / "film.gif", frames(), fps=20)
    with Image.open(path) as film:
        assert film.n_frames == 6 and film.info["duration"] == 50
        film.seek(5)
        np.testing.assert_allclose(np.asarray(film.convert("RGB"), float), frames()[5], atol=4)
    assert_refused("needs imageio-ffmpeg", write_video, tmp_path / "film.mp4", frames())
    assert not (tmp_path / "film.mp4").exists()


def test_a_webp_needs_no_ffmpeg_and_has_all_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path = write_video(tmp_path / "film.webp", frames(), fps=8)
    with Image.open(path) as film:
        assert film.format == "WEBP" and film.n_frames == 6
        film.seek(5)
        film.load()
        assert film.info["duration"] == 125
        # Lossy at quality 90: 8-bit YUV rounds, and the quantiser has steps of 2 to 3 codes.
        np.testing.assert_allclose(np.asarray(film.convert("RGB"), float), frames()[5], atol=6)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the memory of a process is read from /proc")
@pytest.mark.parametrize("suffix", film.FILM_WRITERS)
def test_memory_does_not_hold_the_frames_of_a_film(tmp_path: Path, suffix: str) -> None:
    """160 frames have 66 MB as Pillow holds them."""
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    used = []

    def render() -> Iterator[np.ndarray]:
        for number in range(160):
            frame = np.full((320, 320, 3), 100, np.uint8)
            frame[number] = 200
            used.append(int(re.search(r"RssAnon:\s+(\d+)", Path("/proc/self/status").read_text()).group(1)) / 1024)
            yield frame

    write_video(tmp_path / f"film{suffix}", render())
    assert used[-1] - used[10] < 16


@pytest.mark.parametrize("module", [None, SimpleNamespace(get_ffmpeg_exe=Mock(side_effect=RuntimeError("No ffmpeg exe")))])
def test_films_without_ffmpeg_are_webp(module: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package, and with a package that has no program for the machine."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", module)
    assert film_suffix() == ".webp"
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(get_ffmpeg_exe=Mock(return_value="ffmpeg")))
    assert film_suffix() == ".mp4"


def test_invalid_films_are_refused(tmp_path: Path) -> None:
    one = frames(1)[0]
    cases = [
        ("film.avi", [one], {}, ".mp4, .webp, .gif"),
        ("film.gif", [], {}, "at least one frame"),
        ("film.gif", [one, one[:-1]], {}, "frames of one size"),
        ("film.gif", [one / 255], {}, "frame 0 is float64"),
        ("film.gif", [one], {"fps": 0}, "0 frames per second"),
    ]
    for name, given, settings, message in cases:
        assert_refused(message, write_video, tmp_path / name, given, **settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(3, 4), (2, 5), (3, 5), (2, 4)])
def test_frames_of_odd_sizes_repeat_their_last_row_and_column(shape: tuple[int, int]) -> None:
    frame = np.arange(shape[0] * shape[1] * 3, dtype=np.uint8).reshape(*shape, 3)
    padded = film._pad_to_even(frame)
    assert padded.flags.c_contiguous
    np.testing.assert_array_equal(padded, np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge"))


SIDE = 16


def one_voxel(z: int, y: int, x: int) -> np.ndarray:
    values = np.zeros((SIDE, SIDE, SIDE, 1), np.float32)
    values[z, y, x] = 3.0
    return values


def brightest(frame: np.ndarray) -> tuple[float, float]:
    """Return the centroid (row, column) of the light as shares of the frame from its upper left corner."""
    grey = frame[..., 0].astype(float)
    rows, columns = np.indices(grey.shape) + 0.5
    return (grey * rows).sum() / grey.sum() / grey.shape[0], (grey * columns).sum() / grey.sum() / grey.shape[1]


@pytest.mark.parametrize("upright", ["y", "z"])
def test_a_voxel_circles_the_upright_axis(upright: str) -> None:
    """A voxel 5.5 voxels off the axis swings by 5.5 voxels to both sides; 3 of 16 layers are above it.

    Frames are 23 = ceil(16 sqrt(2)) rays wide. 8 bits and 8 pixels per ray resolve a tenth of a voxel.
    """
    low, middle = SIDE - 4, SIDE // 2
    values = one_voxel(low, middle, middle + 5) if upright == "z" else one_voxel(middle, low, middle + 5)
    frames, _ = volume_frames(values, (1.0, 1.0, 1.0), upright, count=8)
    centroids = np.array([brightest(frame) for frame in frames])
    np.testing.assert_allclose(centroids[:, 0], 3.5 / SIDE, atol=0.1 / SIDE)
    rays = math.ceil(SIDE * math.sqrt(2))
    offsets = (centroids[:, 1] - 0.5) * rays
    assert np.ptp(offsets) == pytest.approx(2 * 5.5, abs=0.2)
    np.testing.assert_allclose(offsets[:4], -offsets[4:], atol=0.1)


def test_white_is_the_longest_path_through_a_box() -> None:
    """A box of ones, 1 x 2 x 4: its longest horizontal path is sqrt(5), less up to a voxel at both ends."""
    values = np.ones((64, 32, 16, 1), np.float32)
    frames, white = volume_frames(values, (1.0, 2.0, 4.0), "z", count=64)
    assert math.sqrt(5) - 2 / 16 < white < math.sqrt(5) + 0.01
    height, width = frames[0].shape[:2]
    assert height / width == pytest.approx(4 / (math.ceil(16 * math.sqrt(5)) / 16), rel=0.01)


def test_thin_and_empty_volumes_have_no_film() -> None:
    flat = np.ones((FEWEST_LAYERS - 1, 20, 20, 1))
    assert volume_frames(flat, (1, 1, 1), "z") == ([], 0.0)
    assert volume_frames(np.zeros((20, 20, 20, 1)), (1, 1, 1), "z") == ([], 0.0)


def test_large_volumes_are_averaged_in_blocks() -> None:
    """200 voxels along z become 67 means of three, the last of two; the integral across stays the same."""
    values = np.ones((200, 8, 8, 1), np.float32)
    _, white = volume_frames(values, (1.0, 1.0, 1.0), "z", count=1)
    assert white == pytest.approx(volume_frames(values[:50], (1.0, 1.0, 1.0), "z", count=1)[1], rel=1e-6)


def test_the_page_contains_the_film(tmp_path: Path) -> None:
    record = RunRecord.new("a volume")
    run = RunFolder(tmp_path, record)
    record.images += film_of_volume(run, one_voxel(4, 5, 6), (1.0, 1.0, 1.0), "z", "sigma_t")
    write_record(record, tmp_path)
    page = write_page(tmp_path).read_text()
    assert "data:image/webp;base64" in page
    assert "[sigma_t times length]" in page
