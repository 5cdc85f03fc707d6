"""Examples that come with mivol: listed, copied, run, with a stand-in where public data is not there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from tiny_experiment import SCENE, refused, run, write_experiment

import mivol
from mivol import config
from mivol.experiments import examples
from mivol.experiments.examples import EXAMPLES, ProceduralData, examples_folder
from mivol.experiments.fit_kind import NullProgress
from mivol.experiments.references import load_experiment_scene
from mivol.files import read_volume
from mivol.files.fetch import DATA

SHORT = ["--set", "solve.iterations=1", "--set", "grid.shape=[4,4,4]", "--set", "scan.views=4", "--set", "scan.detector=[4,4]"]


@pytest.fixture(autouse=True)
def nothing_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that holds no public data."""
    monkeypatch.delenv("MIVOL_DATA", raising=False)
    monkeypatch.setenv("MIVOL_CACHE", str(tmp_path / "cache"))


def test_examples_are_listed_and_are_there(capsys: pytest.CaptureFixture) -> None:
    """Each experiment of the scenes is an example."""
    assert run("demo") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(EXAMPLES)
    assert {path.parent.name for path in examples_folder().glob("*/fit.toml")} <= set(EXAMPLES)
    assert all((example.source(name) / example.file).is_file() for name, example in EXAMPLES.items())
    assert 'did you mean "smoke"' in refused(capsys, "demo", "smok")


def test_an_example_is_copied_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("demo", "demo", "--into", tmp_path / "mine") == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "mine" / "fit.toml")
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {
        path.name for path in (examples_folder() / "demo").iterdir()
    }
    assert "exists and is not an empty folder" in refused(capsys, "demo", "demo", "--into", tmp_path / "mine")


def test_a_copy_stands_by_itself(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It names nothing that lay beside it, its runs are those of the folder where its scripts write, its commands name it."""
    monkeypatch.chdir(tmp_path)
    named = set()
    for name in EXAMPLES:
        into = examples.copy_example(name, Path("copies") / name).parent
        texts = {path: path.read_text() for path in into.rglob("*") if path.suffix in (".toml", ".xml", ".md")}
        assert not [path for path, text in texts.items() if "../" in text]
        named |= {word for text in texts.values() for word in re.findall(r"copies/[\w/]+\.(?:py|toml)", text)}
        if (into / "scene.xml").exists() and name != "lamp":  # whose scene names the data
            mivol.load_scene(into / "scene.xml")
    assert {"copies/smoke/fit.toml", "copies/still_life/photographs.py"} <= named
    assert [word for word in sorted(named) if not Path(word).is_file()] == []
    photographs = config.load(Path("copies/still_life/fit.toml")).photos.path
    assert Path(photographs) == tmp_path / "runs" / "still_life" / "photographs"


def test_an_example_is_copied_whole_or_not_at_all(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fills up at the second file: nothing is left, one sentence is said, and the next try ends well."""
    copy = examples.shutil.copyfile

    def full(source: Path, target: Path) -> None:
        copy(source, target)
        assert (target.parent / "README.md").is_file()
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(examples.shutil, "copyfile", full)
        assert "found no space left on the disk" in refused(capsys, "demo", "demo", "--into", tmp_path / "mine")
    assert not (tmp_path / "mine").exists()
    assert run("demo", "demo", "--into", tmp_path / "mine") == 0


def test_two_examples_may_share_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The Gaussians are of the still life's photographs."""
    assert run("demo", "gaussians", "--into", tmp_path / "mine") == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "mine" / "gaussians.toml")
    assert (tmp_path / "mine" / "photographs.py").is_file()


def test_compiled_files_stay_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of folders in an example's own are copied as well, and what Python compiled of them is not."""
    for name in ("fit.toml", "data/a.vol", "data/__pycache__/a.pyc", "__pycache__/b.pyc"):
        path = tmp_path / "scenes" / "demo" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    monkeypatch.setattr(examples, "examples_folder", lambda: tmp_path / "scenes")
    into = examples.copy_example("demo", tmp_path / "mine").parent
    found = {str(path.relative_to(into)): path.read_text() for path in into.rglob("*") if path.is_file()}
    assert found == {name: name for name in ("fit.toml", "data/a.vol")}


def test_an_example_runs(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("demo", "shepp_logan", "-o", tmp_path / "run", *SHORT) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "run" / "report.html")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["config"]["grid"]["shape"] == [4, 4, 4]
    assert record["command"].startswith("mivol demo shepp_logan")


@pytest.mark.parametrize(
    ("given", "changes", "folder"),
    [
        (None, (), "runs/still_life"),
        (None, ("output=mine/one",), "mine/one"),
        (None, ("title=output",), "runs/still_life"),
        (None, (" output = 'runs/here'",), "runs/here"),
        (Path("told"), ("output=mine/one",), "told"),
    ],
)
def test_where_an_example_runs(
    monkeypatch: pytest.MonkeyPatch, given: Path | None, changes: tuple[str, ...], folder: str
) -> None:
    """-o, else --set output=..., else runs/NAME; what it needs is made there."""
    made: list[Path] = []
    monkeypatch.setattr(examples, "prepare", lambda name, example, source, folder, progress: made.append(folder) or [])
    monkeypatch.setattr(examples, "run_experiment", lambda task: task.folder)
    assert examples.run_example("still_life", given, changes=changes) == made[0] == Path(folder)


def test_a_wrong_change_of_an_example_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "output" in refused(capsys, "demo", "lamp", "--set", "output=3")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow_for("lamp", "smoke", "white_smoke")
@pytest.mark.parametrize("name", [name for name, example in EXAMPLES.items() if isinstance(example.stand_in, ProceduralData)])
def test_a_stand_in_takes_the_place_of_public_data(tmp_path: Path, name: str) -> None:
    """Where the data is not there the settings name a seeded volume of its shape; where it is, they are left alone."""
    example, told = EXAMPLES[name], []
    progress = NullProgress()
    progress.say = told.extend
    source = examples_folder() / name
    changes = examples.prepare(name, example, source, tmp_path / "run", progress)
    assert "a procedural volume replaces it" in told[0]
    chosen = config.load(source / "fit.toml", changes)
    setting = chosen.truth.file if example.stand_in.setting == "truth.file" else chosen.scene.define["volume"]
    values = read_volume(setting, frame="unit").values
    assert values.shape == (*example.stand_in.shape, 1)
    assert 0.3 * example.stand_in.peak < values.max() <= example.stand_in.peak
    there = tmp_path / "cache" / DATA[example.stand_in.data].path
    there.parent.mkdir(parents=True)
    there.touch()
    assert examples.prepare(name, example, source, tmp_path / "run", progress) == []


def test_readings_are_made_before_an_example_that_fits_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its script writes into the run folder, once, and the settings name what it wrote."""
    calls = []

    def make(path: Path, arguments: list[str]) -> None:
        calls.append(path.name)
        Path(arguments[-1]).mkdir()
        (Path(arguments[-1]) / "truth.npz").touch()

    monkeypatch.setattr(examples, "run_script", make)
    source = examples_folder() / "bonsai"
    for _ in range(2):
        changes = examples.prepare("bonsai", EXAMPLES["bonsai"], source, tmp_path / "run", NullProgress())
    chosen = config.load(source / "fit.toml", changes)
    assert calls == ["scan.py"]
    named = (chosen.scan.file, chosen.data.file, chosen.data.flats, chosen.data.darks)
    assert named == tuple(str(tmp_path / "run" / "scan" / n) for n in ("panels.txt", "readings.npy", "flats.npy", "darks.npy"))


@pytest.mark.slow
def test_an_example_of_a_public_scan_runs_without_it(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Computed projections take the place of measured ones, which is said; the slices are found all the same."""
    short = ["--set", "scan.detector=[2,48]", "--set", "scan.pitch=0.041666667", "--set", "scan.views=45"]
    short += ["--set", "grid.shape=[2,48,48]", "--set", "grid.voxel_size=0.041666667", "--set", "solve.iterations=8"]
    assert run("demo", "tooth", "-o", tmp_path / "run", *short) == 0
    assert '"tooth_projections" is not on this machine: exact projections of a phantom' in capsys.readouterr().err
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    # 1 is that of an empty volume.
    assert record["results"]["nrmse"] < 0.5


def test_a_define_may_name_public_data(variant_rgb: str, tmp_path: Path) -> None:
    """The scene of an experiment finds a set in the cache by its name."""
    folder = write_experiment(tmp_path)
    there = tmp_path / "cache" / DATA["smoke"].path
    there.parent.mkdir(parents=True)
    (folder / "start.vol").rename(there)
    scene = SCENE.replace('value="start.vol"', 'value="$volume"')
    default = '<default name="volume" value="none.vol"/>'
    (folder / "scene.xml").write_text(scene.replace("<integrator", f"{default}<integrator", 1))
    chosen = config.load(folder / "fit.toml", ['scene.define={volume="data:smoke"}'])
    assert len(load_experiment_scene(chosen, folder).scene.shapes()) == 1


def test_data_is_listed_with_licence_and_size(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the verb passes on what was asked for."""
    assert run("fetch") == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == len(DATA)
    assert all("MiB; licence: " in line for line in said)
    monkeypatch.setattr("mivol.files.fetch.fetch_data", lambda data, into: Path(into) / data.path)
    assert run("fetch", "tooth", "--into", "here") == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str(Path("here/ct_mri/tooth.nrrd"))
    assert "licence: BSD-3-Clause" in printed.err
    assert 'did you mean "tooth"' in refused(capsys, "fetch", "tuth")
