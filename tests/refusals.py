"""Refusals, as mivol promises them: one sentence on one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mivol.errors import MivolError


def assert_refused(match: str, call: Callable[..., object], /, *arguments: Any, **settings: Any) -> None:
    """The call raises a :class:`MivolError` of one sentence, in which the pattern ``match`` is found."""
    with pytest.raises(MivolError, match=match, check=is_one_sentence):
        call(*arguments, **settings)


def is_one_sentence(error: MivolError) -> bool:
    """Whether the message of a refusal ends as a sentence does, on its first line."""
    return str(error).endswith((".", "?")) and "\n" not in str(error)
