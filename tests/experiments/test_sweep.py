"""A sweep: values on the command line, names of folders, what is run again, and the page of all."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from refusals import assert_refused
from tiny_experiment import PHOTOS, refused, run, write_experiment

from mivol.experiments import sweep as module
from mivol.experiments.sweep import Sweep, SweepRun, parse_over, plan_sweep, run_name, run_sweep
from mivol.report.page import SweepNews, SweepRow, write_sweep_page
from mivol.report.record import RunRecord, Table, write_record


def test_values_of_the_command_line() -> None:
    """Numbers, ranges with both ends, words, texts in TOML, and lists."""
    found = parse_over(["fit.spp=4,16", "seed=-1..1", "loss.name=l1,l2", 'a="x,y", "z"', "b=[1, 2], [3]", "c=0.5"])
    assert found == {
        "fit.spp": [4, 16], "seed": [-1, 0, 1], "loss.name": ["l1", "l2"], "a": ["x,y", "z"], "b": [[1, 2], [3]], "c": [0.5]
    }  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ([], "needs values to sweep over"),
        (["seed"], "has no values"),
        (["seed="], "has no values"),
        (["=1"], "has no values"),
        (["seed=3..1"], "is no range"),
        (["seed=0..99999"], "is no range"),
        (["seed=1,2,1"], "has the value 1 twice"),
        (["seed=1", "seed=2"], "names seed twice"),
        (["a=0..999", "b=0..999"], "make 1,000,000 runs"),
    ],
)
def test_wrong_values_are_refused(texts: list[str], reason: str) -> None:
    assert_refused(reason, parse_over, texts)


def test_names_of_run_folders() -> None:
    """Short, the same again, allowed on every disk, and different for settings of the same last part."""
    assert run_name({"fit.spp": 4, "seed": 0}) == "spp=4_seed=0"
    assert run_name({"parameter.0.lr": 0.1, "parameter.1.lr": 1e-30}) == "parameter.0.lr=0.1_parameter.1.lr=1e-30"
    assert run_name({"path": "../a b/c"}) == "path=..-a-b-c"
    long = run_name({"text": "x" * 300})
    assert len(long) == module.LONGEST_NAME
    assert long != run_name({"text": "x" * 299})


def test_combinations_are_checked_before_the_first_run(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = write_experiment(tmp_path) / "fit.toml"
    found = plan_sweep(path, ["fit.spp=2,4", "seed=0..1"], ["fit.iterations=7"])
    assert [run.name for run in found.runs] == ["spp=2_seed=0", "spp=2_seed=1", "spp=4_seed=0", "spp=4_seed=1"]
    assert [(run.settings.fit.spp, run.settings.seed) for run in found.runs] == [(2, 0), (2, 1), (4, 0), (4, 1)]
    assert {run.settings.fit.iterations for run in found.runs} == {7}
    assert len({run.digest for run in found.runs}) == 4
    assert "fit.spp = 0: expected" in refused(capsys, "sweep", path, "--over", "fit.spp=2,0", "-o", tmp_path / "sweep")
    assert not (tmp_path / "sweep").exists()


def make_execute(refuse: str = "", stop: str = "") -> tuple[module.Execute, list[str]]:
    """Runs that only write a record; the names of those that were started."""
    started: list[str] = []

    def execute(sweep: Sweep, runs: Iterator[SweepRun], tell: module.Tell) -> Iterator[tuple[SweepRun, str]]:
        for one in runs:
            started.append(one.name)
            if one.name == stop:
                raise KeyboardInterrupt
            (sweep.folder / one.name).mkdir(exist_ok=True)
            results = {"nrmse": 1.0 / one.settings.fit.spp}
            write_record(RunRecord.new("tiny", status="finished", results=results), sweep.folder / one.name)
            yield one, "the loss became nan." if one.name == refuse else ""

    return execute, started


def test_only_what_is_missing_runs_again(tmp_path: Path) -> None:
    """Stopped in the third run; then the rest; then nothing; other settings run again, and so does a folder that is gone."""
    path = write_experiment(tmp_path) / "fit.toml"

    def start(over: str, refuse: str = "", stop: str = "", changes: tuple[str, ...] = ()) -> list[str]:
        execute, started = make_execute(refuse, stop)
        run_sweep(plan_sweep(path, [over], changes, tmp_path / "sweep"), execute)
        return started

    with pytest.raises(KeyboardInterrupt):
        start("fit.spp=1,2,4", stop="spp=4")
    assert start("fit.spp=1,2,4", refuse="spp=4") == ["spp=4"]
    assert start("fit.spp=1,2,4,8") == ["spp=8"]
    (tmp_path / "sweep" / "spp=2" / "run.json").unlink()
    assert start("fit.spp=1,2,4,8") == ["spp=2"]
    assert start("fit.spp=1,2", changes=("fit.iterations=9",)) == ["spp=1", "spp=2"]
    rows = list(csv.DictReader((tmp_path / "sweep" / "sweep.csv").read_text().splitlines()))
    assert [(row["run"], row["status"], row["nrmse"]) for row in rows] == [
        ("spp=1", "finished", "1.0"),
        ("spp=2", "finished", "0.5"),
    ]
    assert json.loads((tmp_path / "sweep" / "sweep.json").read_text())["runs"]["spp=4"]["refused"] == "the loss became nan."


def test_two_sweeps_of_one_folder(tmp_path: Path) -> None:
    """The second is refused while the first runs."""
    found = plan_sweep(write_experiment(tmp_path) / "fit.toml", ["seed=0..1"], (), tmp_path / "sweep")

    def execute(sweep: Sweep, runs: Iterator[SweepRun], tell: module.Tell) -> Iterator[tuple[SweepRun, str]]:
        assert_refused('another run uses the folder "sweep"', run_sweep, found, make_execute()[0])
        yield from ()

    run_sweep(found, execute)


def test_page_of_a_sweep(tmp_path: Path) -> None:
    """A row a run with a link, refusals with their reason, a figure of each result against numbers, nothing loaded."""
    rows = [
        SweepRow("spp=1_seed=0", {"fit.spp": "1", "seed": "0"}, "finished", results={"nrmse": 0.5, "views": 2.0}),
        SweepRow("spp=8_seed=0", {"fit.spp": "8", "seed": "0"}, "finished", results={"nrmse": 0.25, "views": 2.0}),
        SweepRow("spp=8_seed=1", {"fit.spp": "8", "seed": "1"}, "refused", "the <loss> became nan."),
        SweepRow("spp=1_seed=1", {"fit.spp": "1", "seed": "1"}),
    ]
    text = write_sweep_page(tmp_path, "tiny", ["fit.spp", "seed"], rows).read_text()
    assert "3 of 4 runs have ended" in text
    assert 'href="spp%3D1_seed%3D0/report.html"' in text
    assert "the &lt;loss&gt; became nan." in text
    assert re.findall(r'aria-label="([^"]*)"', text) == ["nRMSE of the volume against fit.spp"]
    assert not re.search(r"(src|href)=\"https?:", text)


def test_page_of_a_sweep_under_way(tmp_path: Path) -> None:
    """Progress of the runs, lost workers and their table; a browser reads the page again until all runs have ended."""
    path = write_experiment(tmp_path) / "fit.toml"
    found, seen = plan_sweep(path, ["fit.spp=1,2"], (), tmp_path / "sweep"), []
    workers = Table(title="Workers: 1 worker", head=("host", "process"), rows=(("node7", "12"), ("node8", "lost")))

    def execute(sweep: Sweep, runs: Iterator[SweepRun], tell: module.Tell) -> Iterator[tuple[SweepRun, str]]:
        tell(SweepNews({"spp=1": "3 of 4"}, ("1 worker(s) were lost.",), workers, is_running=True))
        seen.append((sweep.folder / "sweep.html").read_text())
        yield next(runs), "too slow."

    page, refused = run_sweep(found, execute)
    for text in ("3 of 4", "running", "1 worker(s) were lost.", "node8", 'http-equiv="refresh"'):
        assert text in seen[0]
    assert 'http-equiv="refresh"' not in page.read_text()
    assert "node8" in page.read_text()
    assert refused == 1


@pytest.mark.slow
def test_a_sweep_in_turn(tmp_path: Path) -> None:
    """Without a cluster; a loss of pairs needs two samples, so one combination is refused, and the exit code says so."""
    path = write_experiment(tmp_path) / "fit.toml"
    changes = [*PHOTOS, "--set", 'loss={name="l2", pairs=true}', "--set", 'fit.integrator="prbvolpath"']
    assert run("sweep", path, "--over", "fit.spp=1,2", *changes, "-o", tmp_path / "sweep") == 1
    rows = list(csv.DictReader((tmp_path / "sweep" / "sweep.csv").read_text().splitlines()))
    assert [row["status"] for row in rows] == ["refused", "finished"]
    assert "pairs" in rows[0]["reason"]
    assert (tmp_path / "sweep" / "spp=2" / "report.html").is_file()
