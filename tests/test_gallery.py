"""The gallery of the site: its page and pictures are those of scripts/gallery.py, small, and made without public data."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from script_modules import load

from mivol.files import write_png, write_volume
from mivol.report.record import Image as Shown
from mivol.report.record import RunRecord, Volume, write_record

MOST = 80_000
"""Bytes of a picture."""


@pytest.fixture(scope="module")
def gallery() -> ModuleType:
    return load("gallery")


def test_page_and_pictures_are_there(gallery: ModuleType) -> None:
    """docs/gallery.md is made by scripts/gallery.py --write, its pictures by --draw."""
    assert gallery.main([]) == 0
    files = {path.name: path for path in gallery.PICTURES.iterdir()}
    assert set(files) == {f"{name}.jpg" for name in gallery.ENTRIES}
    assert {name: path.stat().st_size for name, path in files.items() if path.stat().st_size > MOST} == {}


def test_a_missing_picture_and_an_old_page_are_said(
    gallery: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(gallery, "PAGE", tmp_path / "gallery.md")
    assert gallery.main([]) == 1 and "run it with --write" in capsys.readouterr().err
    monkeypatch.setattr(gallery, "PICTURES", tmp_path)
    assert gallery.main(["--write"]) == 1
    said = capsys.readouterr().err
    assert "--draw demo" in said and "--write" not in said


def test_an_example_is_run_without_public_data(gallery: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it writes becomes a JPEG of HEIGHT pixels."""
    ran = []

    def run(words: list[str], *, env: dict[str, str], **how: object) -> None:
        ran.append(words[1:])
        assert not Path(env["MIVOL_DATA"]).exists() and env["MIVOL_CACHE"] == env["MIVOL_DATA"]
        write_png(tmp_path / "runs" / "knot" / "knot.png", np.full((20, 40, 3), 0.5))

    monkeypatch.setattr(gallery.subprocess, "run", run)
    monkeypatch.setattr(gallery, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(gallery, "PICTURES", tmp_path / "pictures")
    with Image.open(gallery.draw("knot")) as made:
        assert (made.format, made.size) == ("JPEG", (2 * gallery.HEIGHT, gallery.HEIGHT))
    assert [words[0] for words in ran] == ["scenes/knot/render.py"] and ran[0][-1] == str(tmp_path / "runs" / "knot")


def test_runs_are_compared_with_what_was_seen_and_true(gallery: ModuleType, tmp_path: Path) -> None:
    """A view that was held out beside its render, and a slice xz of the truth beside the reconstruction."""
    for name, value in {"a": 0.2, "b": 0.8}.items():
        write_png(tmp_path / f"{name}.png", np.full((4, 6, 3), value))
        write_volume(tmp_path / f"{name}.npz", np.full((2, 3, 4, 1), value, np.float32))
    images = [Shown(path=f"{n}.png", role=r, view="v", held_out=True) for n, r in (("a", "reference"), ("b", "render"))]
    volumes = [Volume(path=f"{n}.npz", role=r, size=(4.0, 3.0, 2.0)) for n, r in (("a", "truth"), ("b", "reconstruction"))]
    write_record(RunRecord.new("Run", images=images, volumes=volumes), tmp_path)
    found = gallery.compared(tmp_path)
    assert [image.size for image in found] == [(6, 4), (6, 4), (4, 2), (4, 2)]
    assert found[0].getpixel((0, 0))[0] < found[1].getpixel((0, 0))[0]
    # On the truth's scale both slices are white; a difference has a colour.
    assert [image.getpixel((0, 0)) for image in found[2:]] == 2 * [(255, 255, 255)]
    widths = [gallery.HEIGHT * image.width // image.height for image in found]
    assert gallery.joined(found).size == (sum(widths) + 3 * gallery.HEIGHT // 30, gallery.HEIGHT)
