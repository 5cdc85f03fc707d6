"""``mivol explain``: facts come first, whatever is refused; an experiment is explained with every check that its fit makes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused
from tiny_experiment import PHOTOS, SCENE, run, write_experiment

import mivol
from mivol import config
from mivol.experiments.kinds import explain_experiment
from mivol.files import write_volume


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_experiment(tmp_path)


def explained(capsys: pytest.CaptureFixture, *arguments: object) -> tuple[int, str]:
    """Exit code, and what was said."""
    code = run("explain", *arguments)
    return code, capsys.readouterr().out


def test_facts_come_before_a_refusal_of_the_plan(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Quadrature of many scatterings is refused; what the scene is made of is said all the same."""
    asked = SCENE.replace('"albedo" value="0"', '"albedo" value="0.5"').replace(
        '<string name="aovs" value="tau"/>', '<boolean name="deterministic" value="true"/>'
    )
    (folder / "scene.xml").write_text(asked)
    code, said = explained(capsys, folder / "scene.xml")
    assert code == 1
    facts, _, refusal = said.partition("refused\n")
    assert "optical depth at most" in facts
    assert "deterministic is set" in refusal


def test_facts_come_before_a_refusal_of_the_numbers(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """An albedo that is no number is refused by name; what Mitsuba itself knows is said before."""
    (folder / "scene.xml").write_text(SCENE.replace('"albedo" value="0"', '"albedo" value="nan"'))
    code, said = explained(capsys, folder / "scene.xml")
    assert code == 1
    facts, _, refusal = said.partition("refused\n")
    assert "cube" in facts
    assert "albedo" in refusal


def test_a_path_is_loaded_as_everywhere(variant_rgb, folder: Path) -> None:
    """What a script asks about by its path is refused in the words of the other verbs."""
    assert mivol.explain(folder / "scene.xml").startswith("facts\n")
    assert_refused(r"there is no scene file .*nowhere.xml", mivol.explain, folder / "nowhere.xml")


def test_a_medium_behind_an_opaque_surface_is_warned_of(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Mitsuba gives a shape without a BSDF a diffuse one, and the smoke in it is never seen."""
    assert "warning" not in explained(capsys, folder / "scene.xml")[1]
    (folder / "scene.xml").write_text(SCENE.replace('<bsdf type="null"/>', ""))
    said = explained(capsys, folder / "scene.xml")[1]
    assert "the medium of cube lies behind an opaque" in said
    (folder / "scene.xml").write_text(SCENE.replace('<bsdf type="null"/>', '<bsdf type="dielectric"/>'))
    assert "opaque" not in explained(capsys, folder / "scene.xml")[1]


def test_the_noise_that_is_asked_for_decides_which_depth_is_enough(
    variant_rgb, folder: Path, capsys: pytest.CaptureFixture
) -> None:
    """In a white smoke of optical depth 4 across, light that scattered often is missed at one pixel in ten thousand, and not at
    an error as large as the mean."""
    (folder / "scene.xml").write_text(SCENE.replace('"albedo" value="0"', '"albedo" value="0.9"'))
    write_volume(folder / "start.vol", np.full((2, 2, 2, 1), 2, np.float32))
    depths = {}
    for noise in ("1", "1e-4"):
        code, said = explained(capsys, folder / "scene.xml", "--noise", noise)
        assert code == 0
        found = re.search(r"max_depth (\d+|-1 \(no limit\)) is enough", said)
        assert found is not None
        depths[noise] = found[1]
    assert depths["1"] == "2"
    assert depths["1e-4"] != "2"


def test_an_experiment_is_explained_with_its_truth_in_the_scene(
    variant_rgb, folder: Path, capsys: pytest.CaptureFixture
) -> None:
    """The truth's largest value is below 3, in a box of diagonal 2 sqrt(3); the file's 0.25 would be a depth of 0.87."""
    code, said = explained(capsys, folder / "fit.toml")
    assert code == 0
    assert "3 of 8 x 8 pixels, 1 of them held out" in said
    assert "3 x 3 x 3 x 1, in [0, inf] 1/length, from 0.2" in said
    assert "facts and plan are for the true volume" in said
    depth = float(re.search(r"optical depth at most ([\d.]+)", said)[1])
    assert 2 < depth < 10.5  # 6 sqrt(3) = 10.39, told to three digits
    assert not (folder / "runs").exists()
    assert sorted(path.suffix for path in folder.iterdir()) == [".exr", ".exr", ".exr", ".toml", ".vol", ".xml"]


EXPLAIN_REFUSED = {
    "no such parameter": (['parameter.0.key="cube.none"'], "no parameter"),
    "a start outside its domain": (["parameter.0.start=-1.0"], "[0, 0, 0, 0] = -1"),
    "a view that is not there": (["reference.held_out=[7]"], "no view 7"),
    "files that do not fit": ([PHOTOS[1], "views.count=2"], "3 reference files for 2 views"),
    "an integrator that is not there": (['fit.integrator="mivoll"'], "mivoll"),
    "a scene that is not there": (['scene.file="none.xml"'], "no scene file"),
}


@pytest.mark.parametrize("case", EXPLAIN_REFUSED)
def test_explain_makes_the_checks_of_the_fit(variant_rgb, folder: Path, case: str) -> None:
    changes, sentence = EXPLAIN_REFUSED[case]
    said = explain_experiment(config.load(folder / "fit.toml", changes), folder)
    assert sentence in said.refusal
    assert said.text.startswith("experiment  tiny\n")


def test_a_scan_is_explained(variant_rgb, tmp_path: Path) -> None:
    scan = {
        "title": "head", "threads": 1, "held_out_every": 4, "scan": {"beam": "parallel", "views": 8, "detector": [1, 6]},
        "data": {"source": "shepp_logan"}, "grid": {"shape": [1, 6, 6], "voxel_size": 0.3}, "solve": {"iterations": 3},
    }  # fmt: skip
    said = explain_experiment(config.from_dict(scan), tmp_path)
    facts = "1 x 6 x 6 voxels of 0.3", "8 views of 1 x 6 pixels, parallel", "held out  2 views", "pcg, at most 3 iterations"
    for fact in facts:
        assert fact in said.text
    assert said.refusal == ""
    refused = explain_experiment(config.from_dict(scan | {"solve": {"name": "ml-tr"}}), tmp_path)
    assert "ml-tr needs counts" in refused.refusal
    assert "8 views" in refused.text
