"""``mivol bench``: every study by its name, and the changes since an older result."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_experiment import refused, run

from mivol.bench.harness import catalogue
from mivol.errors import MivolError


def test_every_module_is_a_study(capsys: pytest.CaptureFixture) -> None:
    """The list has a question for each study, and wrong options are refused in the name of the verb."""
    assert run("bench") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == catalogue.study_names()
    assert len(lines) > 12 and all("?" in line for line in lines)
    for name in catalogue.study_names():
        study = catalogue.load_study(name)
        assert study.name == name and set(study.on_request) < set(study.questions)
        assert all(question.__doc__ for question in study.questions.values())
        with pytest.raises(SystemExit):
            run("bench", name, "--wrong")
        assert capsys.readouterr().err.startswith(f"usage: mivol bench {name} [-h]")


def write(path: Path, seconds: float, size: str = "quick") -> Path:
    walk = {"rate": 10.0, "cost": [seconds, 1.0], "on": True}
    path.write_text(json.dumps({"size": size, "seconds": 3.0, "machine": {"cores": 2}, "walk": walk}))
    return path


def test_changes_since_an_older_result(tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study that writes a fixed result. A result of another size or of other questions is refused before any measurement."""
    runs = []

    class FixedStudy:
        stem = "new"

        def parse(self, argv: list[str]) -> SimpleNamespace:
            return SimpleNamespace(size=SimpleNamespace(name="quick"), only=("walk", "run"), out=tmp_path)

        def run(self, argv: list[str]) -> int:
            runs.append(argv)
            write(tmp_path / "new.json", 4.0)
            return 0

    monkeypatch.setattr(catalogue, "load_study", lambda name: FixedStudy())
    old = write(tmp_path / "old.json", 2.0)
    options = ["bench", "depth", "--quick", "--compare", old, "--lines", "8"]
    assert run(*options) == 0
    assert capsys.readouterr().err == "walk.cost.0: 2 -> 4 (x 2)\n"
    write(old, 4.1)
    assert run(*options) == 0
    assert "no figure has changed by 10% or more" in capsys.readouterr().err
    assert runs == [["--quick", "--lines", "8"]] * 2
    write(old, 2.0, "full")
    assert "the size of the older result is full, and the size of this run is quick" in refused(capsys, *options)
    old.write_text('{"size": "quick", "swim": {}}')
    assert "answers no question of depth in this run (walk, run)" in refused(capsys, *options)
    assert len(runs) == 2


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert 'did you mean "depth"' in refused(capsys, "bench", "deph")
    for text in ("[1]", "{", "[" * 100000):
        (tmp_path / "old.json").write_text(text)
        with pytest.raises(MivolError, match="not the result of a study"):
            catalogue.read_result(tmp_path / "old.json")


def test_the_largest_change_comes_first() -> None:
    """Numbers of the machine and of the run are not compared; the same words inside a question are."""
    before, now = {"size": "q", "a": 1.0, "b": 1.0, "c": 1.0, "d": 0.0}, {"size": "q", "a": 1.2, "b": 0.1, "c": 1.05, "d": 3.0}
    assert catalogue.find_changes(before, now) == ["b: 1 -> 0.1 (x 0.1)", "a: 1 -> 1.2 (x 1.2)"]
    own = {"machine": {"cores": 2}, "versions": {"a": 1}, "threads": 2, "load_before_and_after": [1], "seconds": 3, "bars": [4]}
    walk = {"seconds": 2.0, "on": True, "name": "x", "costs": [1, {"machine": 5}]}
    numbers = catalogue.numbers_in(own | {"walk": walk})
    assert numbers == [("walk.seconds", 2.0), ("walk.costs.0", 1.0), ("walk.costs.1.machine", 5.0)]
