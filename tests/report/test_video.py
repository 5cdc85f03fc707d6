"""Films: what a player decodes, and projections of a turning volume."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from mivol.errors import MivolError
from mivol.experiments.film import film_of_volume
from mivol.experiments.run_folder import RunFolder
from mivol.report import video
from mivol.report.page import write_page
from mivol.report.record import RunRecord, write_record
from mivol.report.video import FEWEST_LAYERS, film_suffix, volume_frames, write_video


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
    with pytest.raises(MivolError, match="needs imageio-ffmpeg"):
        write_video(tmp_path / "film.mp4", frames())
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
        with pytest.raises(MivolError, match=message):
            write_video(tmp_path / name, given, **settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(3, 4), (2, 5), (3, 5), (2, 4)])
def test_frames_of_odd_sizes_repeat_their_last_row_and_column(shape: tuple[int, int]) -> None:
    frame = np.arange(shape[0] * shape[1] * 3, dtype=np.uint8).reshape(*shape, 3)
    padded = video._pad_to_even(frame)
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
