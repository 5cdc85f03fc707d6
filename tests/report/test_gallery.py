"""Pictures of a page: their names, and how coarse ones are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol.report.gallery import Picture, film_of, plain_picture
from mivol.report.record import Image


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
def test_a_picture_is_called_by_its_caption_else_its_view_else_its_file(folder: Path, said: dict, name: str) -> None:
    found = plain_picture(folder, Image(path="ramp.npy", role="picture", **said))
    assert (found.name, found.width, found.height, found.aspect) == (name, 4, 3, 4 / 3)


@pytest.mark.parametrize(("name", "kind", "animated"), [("film.mp4", "video/mp4", False), ("film.gif", "image/gif", True)])
def test_a_film_is_called_by_its_caption_else_its_view(folder: Path, name: str, kind: str, animated: bool) -> None:
    caption, uri, is_image = film_of(folder, Image(path=name, role="film", caption="Round", view="v"))
    assert (caption, is_image) == ("Round", animated) and uri.startswith(f"data:{kind};base64,")
    assert film_of(folder, Image(path=name, role="film", view="v"))[0] == "v"


@pytest.mark.parametrize(("width", "height", "coarse"), [(320, 1, True), (1, 320, True), (321, 1, False), (1, 321, False)])
def test_pictures_of_320_pixels_and_less_are_coarse(width: int, height: int, coarse: bool) -> None:
    assert Picture("a", "", width, height, width / height).is_coarse == coarse
