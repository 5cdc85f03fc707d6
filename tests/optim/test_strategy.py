"""Suggestions for misspelt names of strategies."""

from __future__ import annotations

import pytest

from mivol.optim.strategy import suggest_name


@pytest.mark.parametrize(
    ("word", "way_out"), [("adm", 'did you mean "adam"?'), ("qqqq", "known are: adam, lbfgs."), ("", "known are: adam, lbfgs.")]
)
def test_suggestions_for_misspelt_names(word: str, way_out: str) -> None:
    assert suggest_name(word, ["lbfgs", "adam"]) == way_out
