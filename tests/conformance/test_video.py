"""Frames of a video: the sharp ones, where the camera moved; what is no such video is refused."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageFilter
import pytest
from refusals import assert_refused
from scipy.ndimage import gaussian_filter, map_coordinates

from mivol.cli import main
from mivol.experiments.film import write_video
from mivol.photos import video

pytest.importorskip("imageio_ffmpeg")
# imageio-ffmpeg leaves the pipes of its program to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

FPS = 8
"""Frames a second of the films: with two frames kept a second, each piece has four frames."""


def wall() -> np.ndarray:
    """Blocks of random greys, 96 x 400."""
    blocks = np.random.default_rng(0).integers(0, 255, (24, 100), np.uint8)
    return np.repeat(np.kron(blocks, np.ones((4, 4), np.uint8))[..., None], 3, axis=2)


def view(shift: int, blur: float = 0.0) -> np.ndarray:
    """The wall from a place, 96 x 128."""
    image = PIL.Image.fromarray(wall()[:, shift : shift + 128])
    return np.asarray(image.filter(PIL.ImageFilter.GaussianBlur(blur)))


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Six seconds: two of a walk, two at rest, two of a walk; the second frame of each four is sharp, the others blurred."""
    shifts = [*range(0, 64, 4), *[64] * 16, *range(64, 128, 4)]
    frames = [view(shift, 0.0 if number % 4 == 1 else 2.0) for number, shift in enumerate(shifts)]
    return write_video(tmp_path / "walk.mp4", frames, fps=FPS)


def test_sharp_frames_of_a_moving_camera_are_kept(film: Path) -> None:
    """12 pieces; of the four at rest only the first has moved since the one before. The next one has moved by 3 %, which shows
    no depth of a flat wall."""
    said: list[str] = []
    folder = video.extract_frames(film, say=said.append)
    files = sorted((folder / "images").iterdir())
    assert (
        folder == film.with_suffix("")
        and len(files) == 8
        and said == [f"{folder / 'images'}: 8 sharp frames of 6 s; 4 without motion or parallax are left out"]
    )
    kept = [np.asarray(PIL.Image.open(file)) for file in files]
    blurred = video.sharpness(view(0, 2.0))
    assert min(video.sharpness(image) for image in kept) > 4 * blurred
    assert np.abs(kept[1].astype(int) - view(20)).mean() < 12  # the sharp frame of the second piece, after compression


def test_films_of_a_phone_are_turned_upright(film: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A phone that is held upright stores its film lying, with a turn in the header. Nothing is said of it."""
    import imageio_ffmpeg

    turned = film.with_name("turned.mp4")
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-display_rotation", "90", "-i", str(film)]
    subprocess.run([*program, "-c", "copy", str(turned)], check=True)
    _, first = (sorted((video.extract_frames(each) / "images").iterdir())[0] for each in (film, turned))
    lying = np.asarray(PIL.Image.open(film.with_suffix("") / "images" / first.name)).astype(int)
    upright = np.asarray(PIL.Image.open(first))
    assert upright.shape == (128, 96, 3) and np.abs(np.rot90(lying) - upright).mean() < 2
    assert not caplog.records


def test_frames_are_not_taken_twice(film: Path) -> None:
    folder = video.extract_frames(film)
    before = {file: file.stat().st_mtime_ns for file in (folder / "images").iterdir()}
    said: list[str] = []
    video.extract_frames(film, say=said.append)
    assert {file: file.stat().st_mtime_ns for file in (folder / "images").iterdir()} == before
    assert "the frames that are there are used" in said[0]


def test_a_shift_is_measured() -> None:
    # Blocks enter and leave the picture, so the shift is known to half a pixel only.
    grey = wall()[:, :, 0].astype(np.float32)
    assert video.measure_shift(grey[:, :128], grey[:, 12:140]) == pytest.approx(12 / 128, abs=0.5 / 128)
    assert video.measure_shift(grey[:, :128], grey[:, :128]) == pytest.approx(0, abs=1e-9)


def see_two_planes(turn: float, step: float, noise: float) -> np.ndarray:
    """A picture (144, 256) of a textured wall and a square before it, from a camera that turned [radian] and stepped."""
    rng = np.random.default_rng(0)
    walls = [sum(s * gaussian_filter(rng.normal(size=(400, 400)), s, mode="wrap") for s in (1, 2, 4)) for _ in range(2)]
    y, x = np.meshgrid((np.arange(144) - 71.5) / 256, (np.arange(256) - 127.5) / 256, indexing="ij")
    c, s = np.cos(turn), np.sin(turn)
    d = np.stack([x / 0.9, y / 0.9, np.ones_like(x)], axis=-1) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    image = np.zeros(x.shape)
    for depth, wall, half in ((3.0, walls[0], np.inf), (1.5, walls[1], 0.35)):
        p = depth * d[..., :2] / d[..., 2:] + np.array([step, 0])
        seen = map_coordinates(wall, [80 * p[..., 1] % 400, 80 * p[..., 0] % 400], order=1, mode="grid-wrap")
        image = np.where((np.abs(p) < half).all(axis=-1), seen, image)
    return (40 * image + noise * np.random.default_rng(int(1e3 * (turn + step))).normal(size=image.shape)).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_a_turn_shows_no_depth_and_a_step_does(noise: float) -> None:
    """The turns shift the picture as far as the steps, up to just below the shift from which any frame is kept."""
    first = see_two_planes(0.0, 0.0, noise)
    for turn in (0.02, 0.05, 0.08):
        frame = see_two_planes(turn, 0.0, noise)
        assert video.MOTION < video.measure_shift(first, frame) < video.FAR and not video.shows_more(first, frame)
    for step in (0.05, 0.1, 0.2):
        frame = see_two_planes(0.0, step, noise)
        assert video.MOTION < video.measure_shift(first, frame) < video.FAR and video.shows_more(first, frame)
    assert video.shows_more(first, see_two_planes(0.15, 0.0, noise))


def test_what_gives_no_photographs_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = write_video(tmp_path / "still.mp4", [view(0)] * 24, fps=FPS)
    assert_refused("1 frame between which the camera moved, of 6 pieces", video.extract_frames, still)
    assert list(tmp_path.iterdir()) == [still]
    (tmp_path / "text.mp4").write_text("no video")
    assert_refused(r"text\.mp4: found no video that ffmpeg reads", video.extract_frames, tmp_path / "text.mp4")
    assert_refused("found no file", video.extract_frames, tmp_path / "none.mp4")
    assert_refused("--fps 0", video.extract_frames, still, rate=0)
    monkeypatch.setattr(video, "LONGEST", 1.0)
    assert_refused("cut it", video.extract_frames, still)


def test_a_rate_is_for_videos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    assert main(["poses", str(tmp_path), "--fps", "2"]) == 1
    assert "--fps is for videos" in capsys.readouterr().err
