"""Figures beside their bars: met bars, printed bars, and means that differ."""

from __future__ import annotations

import json

import pytest

from mivol.bench.harness.bars import AT_LEAST, AT_MOST, find_disagreements, judge, judge_agreement, say_row


def test_a_bar_that_is_reached_is_met() -> None:
    assert [judge("x", value, AT_LEAST, 2.0)["met"] for value in (1.9, 2.0)] == [False, True]
    assert [judge("x", value, AT_MOST, 2.0)["met"] for value in (2.0, 2.1)] == [True, False]


def test_means_that_differ_are_named(capsys: pytest.CaptureFixture) -> None:
    """Either sign counts, and so does a difference without noise; a missed bar does not. Means that agree are not printed."""
    rows = [judge_agreement("a", -1.0, 2.0), judge_agreement("b", -3.0, 2.0), judge_agreement("c", None, 2.0)]
    assert find_disagreements([*rows, judge("speed", 1.0, AT_LEAST, 9.0)]) == ["|z|: b", "|z|: c"]
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    printed = capsys.readouterr().err
    assert "|z|: a" not in printed
    assert "|z|: b: 3, bar at most 2: MISSED" in printed


def test_rows_of_progress_have_three_digits(capsys: pytest.CaptureFixture) -> None:
    say_row("smoke", variance_x_time=61.63, z=None)
    assert capsys.readouterr().err == "  smoke: variance x time 61.6, z none\n"
