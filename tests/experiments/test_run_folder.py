"""The folder of a run: one run at a time, and a record that says how it ended."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol.errors import MivolError
from mivol.experiments.run_folder import RunFolder
from mivol.report.record import RunRecord, read_record


def folder(path: Path) -> RunFolder:
    return RunFolder(path / "run", RunRecord.new("a run"))


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    """Rationale: two runs in one folder would mix their metrics. Expected: the second is refused before it writes anything,
    and the folder is free again when the first has ended, however it ended."""
    first, second = folder(tmp_path), folder(tmp_path)
    second.record.title = "another run"
    with pytest.raises(KeyError), first.at_work():
        with pytest.raises(MivolError, match='another run is at work in "run"'), second.at_work():
            pass
        assert read_record(first.path).title == "a run"
        raise KeyError
    with second.at_work():
        assert read_record(first.path).title == "another run"


def test_the_record_says_what_stopped_a_run(tmp_path: Path) -> None:
    run = folder(tmp_path)
    with pytest.raises(MivolError), run.at_work():
        assert read_record(run.path).status == "running"
        raise MivolError("the disk is full")
    record = read_record(run.path)
    assert (record.status, record.notes) == ("stopped", ["stopped by: the disk is full"])
    with folder(tmp_path).at_work():
        pass
    assert read_record(run.path).status == "finished"
