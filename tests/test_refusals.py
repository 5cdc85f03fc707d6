"""Refusals: the check itself."""

from __future__ import annotations

import pytest
from refusals import is_one_sentence

from mivol.errors import MivolError


@pytest.mark.parametrize("message", ["a.vol: found nothing", "two lines.\nThe second.", 'pip install "mivol"'])
def test_what_is_no_sentence_is_seen(message: str) -> None:
    assert not is_one_sentence(MivolError(message))
    assert is_one_sentence(MivolError("a.vol: found nothing, expected a volume; write it again."))
