"""``mivol explain`` and ``mivol reference -s all`` on posed photographs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from capture_photos import write_capture
from photo_sets import write_blender, write_colmap
from PIL import Image
from tiny_experiment import write_experiment

from mivol.cli import main
from mivol.photos import survey_photos
from mivol.report.cameras import box_edges, frustum_edges, plot_cameras

SCENE = """<scene version="3.0.0">
    <emitter type="constant"/>
    <sensor type="perspective"><transform name="to_world"><lookat origin="0, 1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
            <string name="pixel_format" value="rgb"/></film></sensor>
    <sensor type="perspective"><transform name="to_world"><lookat origin="4, 1, 0" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
            <string name="pixel_format" value="rgb"/></film></sensor>
</scene>"""


def test_explain_says_what_there_is_and_draws_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_blender(tmp_path / "set")
    (folder / "train" / "r_1.png").unlink()
    picture = tmp_path / "cameras.png"
    assert main(["explain", str(folder), "-o", str(picture)]) == 0
    said = capsys.readouterr().out
    facts = ("Blender (NeRF)", "5 photographs (3 train, 2 test)", "12 x 8 pixels", "focal length 14.19", "box (", "(near)")
    for fact in (*facts, "skipped 1 missing photographs: ./train/r_1", str(picture)):
        assert fact in said
    with Image.open(picture) as image:
        assert image.size[0] > 1000


def test_explain_says_what_alpha_means_for_a_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whose box a fit then takes, where not every photograph can be cut out; a set of both kinds is refused after its facts."""
    note = "a fit takes the box around the opaque pixels"
    cut, plain = (write_blender(tmp_path / name, alpha=name == "cut") for name in ("cut", "plain"))
    assert main(["explain", str(cut)]) == main(["explain", str(plain)]) == 0
    with_alpha, without = capsys.readouterr().out.split(f"{plain}: ")
    assert note in with_alpha
    assert "photos.background" in with_alpha
    assert "alpha" not in without
    (plain / "train" / "r_1.png").write_bytes((cut / "train" / "r_1.png").read_bytes())
    assert main(["explain", str(plain)]) == 1
    said = capsys.readouterr()
    assert "6 photographs" in said.out
    assert "expected alpha in all photographs or in none" in said.err


def test_explain_says_what_a_fit_would_do_and_draws_its_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the command of the fit, without a file; what is held out is drawn too."""
    folder, picture = write_capture(tmp_path / "photos", 9), tmp_path / "cameras.png"
    assert main(["explain", str(folder), "-o", str(picture)]) == 0
    with Image.open(picture) as image:
        plain = image.size
    assert "--preset capture" in capsys.readouterr().out
    few = ["--as", "grid", "--preset", "capture", "--set", "field.longest=16"]
    assert main(["explain", *few, str(folder), "-o", str(picture)]) == 0
    said = capsys.readouterr().out
    for fact in (
        "judged by 2 photographs",
        "steps: recorded in the first step",
        "5 nested boxes",
        "cameras stand in the innermost",
        "16 nodes",
        str(picture),
    ):
        assert fact in said
    with Image.open(picture) as image:
        assert image.size == (plain[0] // 2 * 3, plain[1])


def test_explain_draws_the_cameras_of_a_fit_of_gaussians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_capture(tmp_path / "photos", 9)
    (tmp_path / "fit.toml").write_text('title = "a"\n[photos]\npath = "photos"\n[gaussians]\npreset = "tiny"\n')
    assert main(["explain", str(tmp_path / "fit.toml"), "-o", str(tmp_path / "cameras.png")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == str(tmp_path / "cameras.png") and any("Gaussians at first" in line for line in said)
    assert (tmp_path / "cameras.png").is_file()


REFUSED = {
    "a scene with a preset": (["--preset", "cpu", "scene.xml"], "scene.xml holds none: leave them out"),
    "a scene with settings": (["--set", "field.sky=8", "scene.xml"], "--set is for fits, and .*scene.xml is not a fit"),
    "an experiment with a preset": (["--preset", "cpu", "fit.toml"], "name model and preset"),
    "a picture of no cameras": (["fit.toml", "-o", "cameras.png"], "only cameras of photographs are drawn"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_explain_refuses_what_does_not_go_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    arguments, sentence = REFUSED[name]
    monkeypatch.chdir(tmp_path)
    write_experiment(tmp_path)
    assert main(["explain", *arguments]) == 1
    said = capsys.readouterr()
    assert re.search(sentence, said.out + said.err)
    assert not (tmp_path / "cameras.png").exists()


def test_explain_draws_nothing_that_was_not_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_colmap(tmp_path / "hall", points=np.random.default_rng(0).normal(size=(200, 3)))
    monkeypatch.chdir(tmp_path)
    assert main(["explain", str(folder)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["hall"]


def test_explain_refuses_a_folder_without_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", str(tmp_path)]) == 1
    assert "found no photographs and no cameras, expected photographs with cameras of Blender (NeRF)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "head", "way_out"),
    [
        ("scan.r3d", b"PK\x03\x04", "unpack it, and name its folder"),
        ("a.7z", b"7z\xbc\xaf\x27\x1c", "unpack it, and name its folder"),
        ("a.tar", b"a.jpg" + bytes(252) + b"ustar", "unpack it, and name its folder"),
        ("a.tar.gz", b"\x1f\x8b", "unpack it, and name its folder"),
        ("a.mp4", b"\0\0\0\x20ftypisom", "mivol poses FILE finds"),
        ("a.webm", b"\x1aE\xdf\xa3", "mivol poses FILE finds"),
    ],
)
def test_exports_of_phones_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, head: bytes, way_out: str
) -> None:
    (tmp_path / name).write_bytes(head + bytes(64))
    for verb, *more in (["optimize"], ["explain"], ["export", str(tmp_path / "a.xml")]):
        assert main([verb, str(tmp_path / name), *more]) == 1
        assert way_out in capsys.readouterr().err


def test_drawn_cameras_lie_in_the_world(tmp_path: Path) -> None:
    """Every line of a camera begins at it or ends on its field of view, which opens towards what it looks at."""
    frame = survey_photos(write_blender(tmp_path / "set")).frames[0]
    edges = frustum_edges(frame, 0.5)
    np.testing.assert_allclose(edges[:4, 0], np.tile(frame.camera.origin, (4, 1)))
    np.testing.assert_allclose((edges[:4, 1] - frame.camera.origin) @ frame.camera.forward, 0.5)
    lengths = np.ptp(box_edges(np.array([[0, 0, 0], [1, 2, 3]])), axis=1).sum(axis=1)
    assert sorted(lengths) == [1] * 4 + [2] * 4 + [3] * 4


def test_picture_shows_all_splits(tmp_path: Path, artefacts: Path) -> None:
    survey = survey_photos(write_blender(tmp_path / "set"), held_out=2)
    figure = plot_cameras(survey, artefacts / "cameras.png")
    labels = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert labels == ["fitted view", "held-out view", "test view", "box"]


def test_reference_of_all_sensors_is_a_data_set(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    output = ["-m", variant_rgb, "-s", "all", "--max-depth", "1", "--spp", "32", "-o"]
    assert main(["reference", str(tmp_path / "scene.xml"), *output, str(tmp_path / "set")]) == 0
    assert "view_000.exr" in capsys.readouterr().out
    survey = survey_photos(tmp_path / "set")
    assert len(survey.frames) == 2
    np.testing.assert_allclose(survey.frames[1].camera.origin, [4, 1, 0], atol=1e-6)
    assert main(["reference", str(tmp_path / "scene.xml"), *output, str(tmp_path / "one.exr")]) == 1
    assert "name a folder" in capsys.readouterr().err
