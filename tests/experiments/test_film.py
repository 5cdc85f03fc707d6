"""Films of fits of photographs: where the camera goes, how large and how long they are, and when there is none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from photo_sets import ring

from mivol.config import ShowSettings
from mivol.errors import MivolError
from mivol.experiments import film as film_module
from mivol.experiments.film import Film, plan_film
from mivol.photos import Camera, intrinsics

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
    with pytest.raises(MivolError, match="without a common upward direction"):
        plan_film(ShowSettings(way="keyframes", keyframes=keys), photos(upset))
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
