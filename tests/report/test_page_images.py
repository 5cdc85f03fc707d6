"""Pictures of a page: their names, and how coarse ones are told."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from mivol.files import write_png, write_volume
from mivol.files.image_files import decode_srgb
from mivol.report import pixel_scale
from mivol.report.page_images import LAYER_EDGE, LAYERS, PageImage, encode_film, encode_image, make_view_rows, make_volume_views
from mivol.report.record import Image, Volume


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.save(tmp_path / "ramp.npy", np.linspace(0, 1, 12).reshape(3, 4))
    (tmp_path / "film.mp4").write_bytes(b"mp4")
    (tmp_path / "film.gif").write_bytes(b"gif")
    return tmp_path


@pytest.mark.parametrize(
    ("said", "name"),
    [({"caption": "A ramp", "view": "v"}, "A ramp"), ({"view": "v"}, "v"), ({}, "ramp")],
    ids=["caption", "view", "file"],
)
def test_an_image_is_named_by_caption_view_or_file(folder: Path, said: dict, name: str) -> None:
    found = encode_image(folder, Image(path="ramp.npy", role="picture", **said))
    assert (found.name, found.width, found.height, found.aspect) == (name, 4, 3, 4 / 3)


@pytest.mark.parametrize(("name", "kind", "animated"), [("film.mp4", "video/mp4", False), ("film.gif", "image/gif", True)])
def test_a_film_is_named_by_caption_or_view(folder: Path, name: str, kind: str, animated: bool) -> None:
    caption, uri, is_image = encode_film(folder, Image(path=name, role="film", caption="Round", view="v"))
    assert (caption, is_image) == ("Round", animated) and uri.startswith(f"data:{kind};base64,")
    assert encode_film(folder, Image(path=name, role="film", view="v"))[0] == "v"


@pytest.mark.parametrize(("width", "height", "coarse"), [(320, 1, True), (1, 320, True), (321, 1, False), (1, 321, False)])
def test_images_up_to_320_pixels_show_their_pixels(width: int, height: int, coarse: bool) -> None:
    assert PageImage("a", "", width, height, width / height).is_coarse == coarse


@pytest.mark.parametrize(
    ("shape", "name", "aspect"),
    [((1, 8), "p", 8.0), ((1, 9), "p, stretched", 8.0), ((8, 1), "p", 1 / 8), ((90, 2), "p, stretched", 1 / 8)],
)
def test_an_image_of_few_rows_is_stretched(tmp_path: Path, shape: tuple, name: str, aspect: float) -> None:
    """Two rows of a detector of 640 columns would be one or two pixels high on a page."""
    np.save(tmp_path / "p.npy", np.zeros(shape))
    found = encode_image(tmp_path, Image(path="p.npy", role="picture"))
    assert (found.name, found.aspect, found.width, found.height) == (name, aspect, *shape[::-1])


def pixels(picture: PageImage) -> np.ndarray:
    return imread(io.BytesIO(base64.b64decode(picture.uri.partition(",")[2])))[..., :3]


def test_layers_show_truth_reconstruction_and_difference(tmp_path: Path) -> None:
    """From the lowest layer, the second axis up, each image on the scale of the middle slices."""
    truth, found = np.random.default_rng(0).random((2, 3, 4, 5, 1), np.float32)
    write_volume(tmp_path / "t.npz", truth)
    write_volume(tmp_path / "r.npz", found)
    (cut,) = make_volume_views(tmp_path, [Volume(path="t.npz", role="truth"), Volume(path="r.npz", role="reconstruction")])
    assert [layer["text"] for layer in cut.layers] == [f"z = {k} of 3" for k in (1, 2, 3)]
    scale = pixel_scale.shared_scale(*pixel_scale.middle_slices(truth).images.values())
    signed = pixel_scale.signed_scale(*pixel_scale.middle_slices(found - truth).images.values())
    for k, layer in enumerate(cut.layers):
        assert [p.name for p in layer["pictures"]] == ["Truth", "Reconstruction", "Difference"]
        wanted = [(truth, scale), (found, scale), (found - truth, signed)]
        for picture, (values, on) in zip(layer["pictures"], wanted, strict=True):
            assert np.array_equal(np.round(pixels(picture) * 255), pixel_scale.to_pixels(values[k, ::-1], on))


def test_large_volumes_show_few_layers_with_few_pixels(tmp_path: Path) -> None:
    """Each layer is the middle of its share of the height; a volume of one layer has no scrollable layers."""
    for name, shape in (("tall", (40, 3, LAYER_EDGE + 1)), ("flat", (1, 3, 3))):
        write_volume(tmp_path / f"{name}.npz", np.ones(shape, np.float32))
    tall, flat = (make_volume_views(tmp_path, [Volume(path=f"{n}.npz", role="reconstruction")])[0] for n in ("tall", "flat"))
    assert len(tall.layers) == LAYERS and flat.layers == []
    assert [layer["text"] for layer in tall.layers[:2]] == ["z = 2 of 40", "z = 4 of 40"]
    assert tall.layers[-1]["text"] == "z = 39 of 40"
    assert pixels(tall.layers[0]["pictures"][0]).shape == (2, LAYER_EDGE // 2 + 1, 3)


def test_8_bit_views_show_their_absolute_error(tmp_path: Path) -> None:
    """The error is averaged over RGB, and all views share its scale."""
    images = []
    for view, codes in {"a": (51, 102), "b": (102, 51)}.items():
        for role, code in zip(("reference", "render"), codes, strict=True):
            values = np.zeros((2, 2, 3))
            values[0, 0] = code / 255
            write_png(tmp_path / f"{view}_{role}.png", decode_srgb(values))
            images.append(Image(path=f"{view}_{role}.png", role=role, view=view, held_out=True, small=view == "b"))
    gallery = make_view_rows(tmp_path, images)
    assert [view.small for view in gallery.rows] == [False, True]
    (bar,) = gallery.bars
    assert bar.label == "|Render − reference|, mean over RGB [sRGB value]"
    for view in gallery.rows:
        assert [picture.name for picture in view.pictures] == ["Reference", "Render", "|Render − reference|"]
        error = pixels(view.pictures[2])
        assert error[0, 0, 0] > 0.99 and (error.reshape(-1, 3)[1:] == 0).all()
