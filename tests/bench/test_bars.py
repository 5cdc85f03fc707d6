"""Figures beside their bars: which are met, which are said, and which means differ."""

from __future__ import annotations

import json

import pytest

from mivol.bench.harness.bars import AT_LEAST, AT_MOST, judge, judge_agreement, means_that_differ


def test_a_bar_that_is_reached_is_met() -> None:
    assert [judge("x", value, AT_LEAST, 2.0)["met"] for value in (1.9, 2.0)] == [False, True]
    assert [judge("x", value, AT_MOST, 2.0)["met"] for value in (2.0, 2.1)] == [True, False]


def test_means_that_differ_are_named(capsys: pytest.CaptureFixture) -> None:
    """Either sign counts, and a difference without noise; a bar that is missed is none. Those that agree are not said."""
    rows = [judge_agreement("a", -1.0, 2.0), judge_agreement("b", -3.0, 2.0), judge_agreement("c", None, 2.0)]
    assert means_that_differ([*rows, judge("speed", 1.0, AT_LEAST, 9.0)]) == ["|z|: b", "|z|: c"]
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    said = capsys.readouterr().err
    assert "|z|: a" not in said
    assert "|z|: b: 3, bar at most 2: MISSED" in said
