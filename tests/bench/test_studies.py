"""``mivol bench``: every study by its name, and what has changed since an older result."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_experiment import refused, run

from mivol.bench.harness import catalogue as studies
from mivol.bench.harness.study import Expected
from mivol.bench.studies import tomography
from mivol.errors import MivolError


def test_every_bench_is_a_study(capsys: pytest.CaptureFixture) -> None:
    """The scripts bench_*.py and the studies are the same."""
    scripts = {path.stem for path in (Path(__file__).parents[2] / "scripts").glob("bench_*.py")}
    assert {f"bench_{name}" for name in studies.STUDIES} == scripts
    assert run("bench") == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == list(studies.STUDIES)
    assert all("?" in line for line in said)


def write(path: Path, seconds: float, size: str = "quick") -> Path:
    walk = {"rate": 10.0, "cost": [seconds, 1.0], "on": True}
    path.write_text(json.dumps({"size": size, "seconds": 3.0, "machine": {"cores": 2}, "walk": walk}))
    return path


def test_changes_are_said_largest_first(tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study that stands in for the others: it writes a result where it is told to, and hears its flags."""

    class Study:
        BENCH = SimpleNamespace(expected=lambda argv: Expected({"size": "quick"}, ("walk", "run")))

        @staticmethod
        def main(argv: list[str]) -> int:
            ran.append(argv)
            assert argv[:2] == ["--quick", "--out"]
            write(Path(argv[2]) / "bench_depth.json", 4.0)
            return 0

    ran: list[list[str]] = []
    monkeypatch.setattr(importlib, "import_module", lambda name: Study)
    old = write(tmp_path / "old.json", 2.0)
    assert run("bench", "depth", "--quick", "--compare", old, "--out", tmp_path) == 0
    assert capsys.readouterr().err == "walk.cost.0: 2 -> 4 (x 2)\n"
    write(old, 4.1)
    assert run("bench", "depth", "--quick", "--compare", old, "--out", tmp_path) == 0
    assert "no figure has changed by 10% or more" in capsys.readouterr().err
    ran.clear()
    write(old, 2.0, "full")
    flags = ["bench", "depth", "--quick", "--compare", old, "--out", tmp_path]
    assert "of the size full and this one quick" in refused(capsys, *flags)
    old.write_text('{"size": "quick", "swim": {}}')
    assert "none of the questions of depth that are asked (walk, run)" in refused(capsys, *flags)
    assert ran == []


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert 'did you mean "depth"' in refused(capsys, "bench", "deph")
    for text in ("[1]", "{", "[" * 100000):
        (tmp_path / "old.json").write_text(text)
        with pytest.raises(MivolError, match="no result of a study"):
            studies.read_result(tmp_path / "old.json")


def test_the_largest_change_comes_first() -> None:
    before, now = {"size": "q", "a": 1.0, "b": 1.0, "c": 1.0, "d": 0.0}, {"size": "q", "a": 1.2, "b": 0.1, "c": 1.05, "d": 3.0}
    assert studies.changes(before, now) == ["b: 1 -> 0.1 (x 0.1)", "a: 1 -> 1.2 (x 1.2)"]


def test_the_runs_own_numbers_are_not_compared() -> None:
    """Machine, threads, load and bars say nothing of a result; the same words inside a question do."""
    own = {"machine": {"cores": 2}, "versions": {"a": 1}, "threads": 2, "load_before_and_after": [1], "seconds": 3, "bars": [4]}
    walk = {"seconds": 2.0, "on": True, "name": "x", "costs": [1, {"machine": 5}]}
    found = studies.numbers_in(own | {"walk": walk})
    assert found == [("walk.seconds", 2.0), ("walk.costs.0", 1.0), ("walk.costs.1.machine", 5.0)]


def test_tomography_says_what_it_writes(variant_rgb: str) -> None:
    """Its grid and its projections are its size; what it prints only cannot be compared."""
    for flags in (["--size", "32", "--views", "24"], ["--quick"]):
        found = tomography.expected(flags)
        assert found == ({"grid": [32, 32, 32], "projections": [24, 32, 32]}, ("nrmse",))
    for flags in (["--beside"], ["--only", "parts"]):
        with pytest.raises(MivolError, match="write no JSON"):
            tomography.expected(flags)


def test_wrong_flags_name_the_verb(capsys: pytest.CaptureFixture) -> None:
    """And not the script that would do the same."""
    for name in studies.STUDIES:
        with pytest.raises(SystemExit):
            run("bench", name, "--wrong")
        assert capsys.readouterr().err.startswith(f"usage: mivol bench {name} [-h]")
