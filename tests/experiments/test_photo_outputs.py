"""What a fit of photographs leaves in its folder, piece by piece."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mivol.experiments import field_fit, photo_fit, sampled_fit
from mivol.experiments.photo_fit import (
    EDGES,
    MANY,
    JudgedViews,
    describe_quality,
    describe_views,
    select_shown_views,
    write_view,
)
from mivol.fields.field_files import write_field
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.fields.sampled_field import Region
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume
from mivol.optim.photographs.field_view import FieldView
from mivol.photos import Camera, Photo, intrinsics
from mivol.threads import CallsAhead
from mivol.validate.metrics import ImageScore

RES = (3, 4, 5)
BOX_EDGES = (2.0, 1.0, 0.5)


def field(keep: np.ndarray | None = None) -> SphericalGrid:
    """Densities of 1 to 60, colours of degree 1."""
    sigma = 1 + np.arange(60.0).reshape(RES)
    return SphericalGrid.from_dense(sigma, np.zeros((*RES, 4, 3)), np.diag([*BOX_EDGES, 1.0]), keep)


@pytest.mark.parametrize(("model", "sizes"), [(HashField, HashSizes()), (NerfField, NerfSizes())])
def test_the_table_of_a_sampled_field(model, sizes):
    occupied = Region((1, 1, 1), np.eye(4), mi.UInt8([1, 1, 0, 0, 0, 0, 0, 0]), 0.1)
    sampled = replace(model.random(sizes, np.eye(4)), region=occupied)
    noun = {"hash": "Hash grid", "nerf": "NeRF"}[sampled.kind]
    table = sampled_fit.tabulate_field(sampled, 3 << 19)
    assert table.title == f"{noun}: {sampled.numbers} numbers, file 1.50 MiB, 25.0% of the cells occupied"
    assert (table.head, table.rows) == sampled.tabulate()


def camera(width: int = 4, height: int = 2) -> Camera:
    return Camera(intrinsics(width, height, width, height), (width, height), np.eye(4))


@pytest.mark.parametrize("kept", [60, 10])
def test_what_a_field_takes(tmp_path, kept):
    """60 nodes of a box: 4 and 16 bytes each; 4 (1 + 4 x 3) with harmonics of degree 1 in rows of 12."""
    sparse = field(None if kept == 60 else np.arange(60).reshape(RES) < kept)
    write_field(tmp_path / "field.npz", sparse)
    table = field_fit.tabulate_storage(sparse, tmp_path / "field.npz")
    assert table.head[0] == f"{kept} of 60 nodes are kept ({kept / 60:.1%})"
    rows = {name: each for name, _, each in table.rows}
    assert rows["every node: r, g, b and density of 8 bits"] == "4" and rows["every node: four numbers"] == "16"
    assert rows["every node: harmonics of degree 1"] == "52"
    assert rows["this field, in memory"] == f"{sparse.bytes / 60:.3g}"
    assert rows["this field, its file"] == f"{(tmp_path / 'field.npz').stat().st_size / 60:.3g}"
    # Two digits of a MiB say nothing of so few bytes; of a thousand times as many they do.
    big = SimpleNamespace(node_count=256**3, stored_nodes=lambda: range(2**20), degree=0, width=4, bytes=3 * 2**20)
    sizes = {name: size for name, size, _ in field_fit.tabulate_storage(big, tmp_path / "field.npz").rows}
    assert sizes["every node: four numbers"] == "256.00 MiB" and sizes["this field, in memory"] == "3.00 MiB"


def test_densities_are_written_for_other_programs(tmp_path):
    (tmp_path / "volumes").mkdir()
    found = field_fit.write_density(tmp_path, field(), 0)
    assert (found.path, found.role, found.size) == ("volumes/density.npz", "reconstruction", BOX_EDGES)
    for name in ("density.vol", "density.npz"):
        np.testing.assert_allclose(read_volume(tmp_path / "volumes" / name).values.ravel(), 1 + np.arange(60), rtol=1e-6)
    outer = field_fit.write_density(tmp_path, field(), 2)
    # A page puts together what has one caption: levels are volumes of their own.
    assert (outer.path, outer.caption) == ("volumes/density-level-2.npz", "level 2, of 4 times the extent")


def test_distance_and_normals_are_pictures(tmp_path):
    (tmp_path / "views").mkdir()
    seen = FieldView(np.zeros((2, 4, 3)), np.ones((2, 4)), np.full((2, 4), 1.5))
    found = field_fit.write_geometry(tmp_path, seen, camera(), (1.0, 2.0))
    assert [(i.path, i.role) for i in found] == [("views/distance.png", "picture"), ("views/normals.png", "picture")]
    assert [i.caption for i in found] == [
        "distance of the first held-out view: from light, 1 [length], to dark, 2 [length]",
        "normals of the first held-out view: x, y, z from -1 to 1 as red, green, blue",
    ]
    for image in found:
        assert np.array(Image.open(tmp_path / image.path)).shape == (2, 4, 3)


def test_judged_views_are_told_apart_the_worst_first():
    found = [ImageScore("a.jpg", {"psnr": 23.456, "ssim": 0.71234}), ImageScore("b.jpg", {"psnr": 9.0, "ssim": 0.5})]
    table = photo_fit.tabulate_views(camera(135, 240), found, [24.0, 12.345])
    assert table.title == "Held-out views, at 135 x 240 pixels, the worst first"
    assert table.rows == (("b.jpg", "9.00", "0.5000", "12.35"), ("a.jpg", "23.46", "0.7123", "24.00"))
    assert table.head[3] == "PSNR after colour correction [dB]"
    bare = photo_fit.tabulate_views(camera(135, 240), found)
    assert bare.head == table.head[:3] and bare.rows == tuple(row[:3] for row in table.rows)


def test_metrics_have_the_names_of_the_record():
    assert photo_fit.rename_metrics({"psnr": 30.0, "ssim": 0.9}) == {"held_out_psnr": 30.0, "ssim": 0.9}


def test_behind_a_field_is_its_sky_or_the_photographs_own_background():
    photo, sky = SimpleNamespace(background="white"), object()
    assert field_fit.find_background(SimpleNamespace(sky=None), photo) == "white"
    assert field_fit.find_background(SimpleNamespace(sky=sky), photo) is sky


# -- Judged views ------------------------------------------------------------------------------------------------------


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
    assert describe_quality(quality, 25.3) == "PSNR 24.13 dB, SSIM 0.7781, 25.30 dB after colour correction"
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
