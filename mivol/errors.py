"""What mivol refuses, it refuses with one sentence: what was found, what was expected, the way out."""

from __future__ import annotations


class MivolError(ValueError):
    """An input that mivol cannot use; the message is one sentence for the person who gave it."""
