"""A run that nobody watches does the same as one that is watched."""

from __future__ import annotations

from pathlib import Path

from mivol import config
from mivol.experiments.runs import run_experiment
from mivol.experiments.task import Nobody, Task

SCAN = {
    "title": "unwatched",
    "threads": 1,
    "scan": {"beam": "parallel", "views": 4, "detector": [1, 6], "pitch": 0.5},
    "data": {"source": "shepp_logan"},
    "grid": {"shape": [1, 6, 6], "voxel_size": 0.33333333},
    "solve": {"name": "pcg", "iterations": 2},
}


def test_a_run_needs_nobody_who_watches(variant_rgb: str, tmp_path: Path) -> None:
    assert list(Nobody().track([3, 4], "items")) == [3, 4]
    page = run_experiment(Task(config.from_dict(SCAN), tmp_path, tmp_path / "run"))
    assert page == tmp_path / "run" / "report.html"
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2
