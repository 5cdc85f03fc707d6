"""Names of strategies: the nearest is offered, or all of them."""

from __future__ import annotations

import pytest

from mivol.optim.strategy import suggest_name


@pytest.mark.parametrize(
    ("word", "way_out"), [("adm", 'did you mean "adam"?'), ("qqqq", "known are: adam, lbfgs."), ("", "known are: adam, lbfgs.")]
)
def test_a_way_out(word: str, way_out: str) -> None:
    assert suggest_name(word, ["lbfgs", "adam"]) == way_out
