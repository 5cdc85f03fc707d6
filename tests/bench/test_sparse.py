"""Study of sparse grids: bars, table, and the answers of small sizes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol.bench.studies import sparse


def rates(dense: float, skipped: float, own: float) -> dict:
    return {
        sparse.EVERY_CELL: dense,
        sparse.DENSE: skipped,
        "sparse": own,
        "sparse over dense": own / skipped,
    }


def test_bars_and_table() -> None:
    row = {"camera order": rates(1e6, 4e6, 6e6), "random order": rates(1e6, 2e6, 1e6), "default over dense": 0.866}
    walk = {"threads": row, "smoke": row}
    answers = {
        "read": {"skipped": sparse.MISSING},
        "walk": walk,
        "memory": {
            "held_bytes": {"all": 219e6},
            "peak_bytes": {"gradient": 950e6},
            "fit_over_medium": {"fit": 5.1, "fit by Adam": 7},
            "held_over_bricks": 1.03,
            "first_picture": {"both": 2.0},
        },
        "picture": {"mivol over volpath": {"variance_x_time_mean_over_pixels": 12, "z": 0.3, "z_bound": 4.0}},
        "fit": {"time": 0.4, "memory": 0.2},
    }
    met = [bar["met"] for name, a in answers.items() for bar in sparse.STUDY.bars(name, a)]
    assert met == [False, False, True, False, False, False, True, True, True, True, True]
    assert sparse.tabulate("walk", {"threads": row, "smoke": {"skipped": sparse.MISSING}})[2:] == [
        "| threads | 1.00 / 1.00 | 4.00 / 2.00 | 6.00 / 1.00 | 1.50 / 0.50 |",
        f"| smoke | skipped: {sparse.MISSING} | | | |",
    ]
    assert sparse.tabulate("read", answers["read"]) == [f"| read | skipped: {sparse.MISSING} |"]


@pytest.mark.slow
def test_answers(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of the eight tasks whose memory is measured, one runs in a process of its own here, as all do for users."""
    in_new_process = sparse.in_new_process

    def measure(path: Path, side: int, task: str) -> dict:
        is_first = (path.stem, task) == ("cloud", "medium")
        return in_new_process(path, side, task) if is_first else sparse.measure_child(str(path), str(side), task)

    monkeypatch.setattr(sparse, "in_new_process", measure)
    monkeypatch.setattr(sparse, "DATA", tmp_path)
    size = sparse.SparseSize.quick()
    answers = sparse.STUDY.answer(list(sparse.QUESTIONS), size)
    assert answers["read"] == answers["walk"]["smoke"] == {"skipped": sparse.MISSING}
    assert answers["walk"]["cloud"]["bricks"] == answers["memory"]["bricks"]
    assert answers["memory"]["held_bytes"]["data"] == answers["memory"]["bytes_of_bricks"]
    assert [b["met"] for b in answers["bars"] if b["figure"].startswith("|z|")] == [True]
    assert answers["fit"]["sparse"]["log"] and answers["fit"]["memory"] < 1
