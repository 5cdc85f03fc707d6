"""Pictures of judged views: which are kept in full, which are small, what is said beside them, and their order."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mivol.experiments.photo_fit import (
    EDGES,
    MANY,
    JudgedViews,
    describe_quality,
    describe_views,
    select_shown_views,
    write_view,
)
from mivol.photos import Camera, Photo, intrinsics
from mivol.threads import CallsAhead
from mivol.validate.metrics import ImageScore


def photo(name: str, width: int = 4, height: int = 2, value: float = 0.6) -> Photo:
    camera = Camera(intrinsics(width, height, width, height), (width, height), np.eye(4))
    return Photo(name, np.full((height, width, 3), value, np.float32), None, None, camera, np.zeros(3))


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def test_a_view_stands_beside_its_photograph(tmp_path: Path) -> None:
    """Both as sRGB, clipped; on record as held out, what is said of it beside the render."""
    (tmp_path / "views").mkdir()
    found = write_view(tmp_path, photo("emitter"), 7, np.full((2, 4, 3), [1.5, 0.4, -1]), caption="said")
    assert [(i.path, i.role, i.view, i.held_out, i.quantity, i.caption, i.small) for i in found] == [
        ("views/007_render.png", "render", "emitter", True, "sRGB value", "said", False),
        ("views/007_reference.png", "reference", "emitter", True, "sRGB value", "", False),
    ]
    pixels = [pixels_of(tmp_path / image.path)[0, 0].tolist() for image in found]
    assert pixels == [[255, 102, 0], [153, 153, 153]]


def test_small_views_are_means_of_squares(tmp_path: Path) -> None:
    """7 x 5 pixels with an edge of at most 3: squares of 3, of which 2 x 1 fit; a checker has the means 4 and 5 ninths."""
    (tmp_path / "views").mkdir()
    checker = np.indices((5, 7)).sum(axis=0) % 2
    found = write_view(tmp_path, photo("a", 7, 5), 0, np.repeat(checker[..., None], 3, axis=2).astype(float), edge=3)
    assert all(image.small for image in found)
    pixels = pixels_of(tmp_path / found[0].path)
    assert pixels[..., 0].tolist() == [[round(255 * 4 / 9), round(255 * 5 / 9)]]


@pytest.mark.parametrize(("count", "shown", "numbers"), [(7, 3, {0, 3, 6}), (2, 5, {0, 1}), (4, 1, {0}), (3, 0, set())])
def test_views_in_full_are_spread_over_all(count: int, shown: int, numbers: set[int]) -> None:
    assert select_shown_views(count, shown) == numbers


def test_the_worst_is_shown_first_and_in_full(tmp_path: Path) -> None:
    """Of five, the first and the last in full, beside the second, the worst; the others small, from bad to good."""
    (tmp_path / "views").mkdir()
    views = JudgedViews(tmp_path, "srgb", 5, 2)
    for name, psnr in zip("abcde", (25.0, 20.0, 30.0, 22.0, 26.0), strict=True):
        views.add(photo(name, 600, 300), np.zeros((300, 600, 3)), psnr, f"{psnr:g} dB")
    images = views.images()
    renders = [image for image in images if image.role == "render"]
    assert [image.view for image in renders] == ["b", "a", "e", "d", "c"]
    assert [image.small for image in renders] == [False, False, False, True, True]
    assert [image.caption for image in renders[:2]] == ["the worst of 5: 20 dB", "25 dB"]
    sizes = [pixels_of(tmp_path / image.path).shape[1::-1] for image in renders]
    assert sizes == [(600, 300)] * 3 + [(200, 100)] * 2
    assert len(images) == 2 * len(renders)


def test_many_views_are_smaller_and_none_are_written_where_none_are_asked_for(tmp_path: Path) -> None:
    (tmp_path / "views").mkdir()
    many, none = JudgedViews(tmp_path, "srgb", MANY + 1, 1), JudgedViews(tmp_path, "srgb", 2, 0)
    for views in (many, none):
        for psnr in (20.0, 21.0):
            views.add(photo("a", 2 * EDGES[0], 4), np.zeros((4, 2 * EDGES[0], 3)), psnr, "")
    assert none.images() == []
    assert pixels_of(tmp_path / many.images()[-1].path).shape == (1, EDGES[1], 3)


def test_what_is_said_of_views() -> None:
    quality = ImageScore("a", {"psnr": 24.126, "ssim": 0.7781})
    assert describe_quality(quality, 25.3) == "PSNR 24.13 dB, SSIM 0.7781, 25.30 dB after a fit of the colours"
    assert describe_quality(quality) == "PSNR 24.13 dB, SSIM 0.7781"
    assert describe_views([photo("a")] * 3) == "3 views at 4 x 2 pixels"
    assert describe_views([photo("a")]) == "1 view at 4 x 2 pixels"
    assert describe_views([photo("a"), photo("b", 6)]) == "2 views at their own sizes"


def test_calls_go_ahead_of_their_results() -> None:
    """The caller goes on while a call waits, up to two calls ahead; calls keep their order, and an error reaches the caller."""
    calls, gate, order = CallsAhead(), threading.Event(), []

    def work(number: int) -> int:
        assert gate.wait(60)
        order.append(number)
        return 1 // (3 - number)

    first, second = calls.submit(work, 0), calls.submit(work, 1)
    assert not first.done() and not second.done()
    gate.set()
    assert [calls.submit(work, number).result() for number in (2,)] == [1]
    calls.submit(work, 3)
    calls.submit(work, 4)
    with pytest.raises(ZeroDivisionError):
        calls.submit(work, 5)
    assert (first.result(), second.result()) == (0, 0) and order[:4] == [0, 1, 2, 3]


def test_at_most_two_calls_wait() -> None:
    calls, gate = CallsAhead(), threading.Event()
    waiting = [calls.submit(gate.wait, 60) for _ in range(2)]
    threading.Timer(0.05, gate.set).start()
    calls.submit(gate.wait, 60)
    assert waiting[0].done()
