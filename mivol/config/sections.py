"""Settings that several kinds of experiments share, and the base class of the tables of a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec

from mivol.optim.strategy import setting, suggest_name

INFINITY = math.inf

AUTO = "auto"
"""Value of settings chosen by mivol."""

Count = Annotated[int, msgspec.Meta(ge=1)]
"""Number of voxels or pixels along an edge."""

Depth = Annotated[int, msgspec.Meta(ge=-1)]
"""Length of the longest path, as Mitsuba's ``volpath`` counts it; -1 for no limit."""

Size = tuple[Count, Count, Count]
Vector = tuple[float, float, float]
Title = Annotated[str, setting("1", "heading of the report", min_length=1)]
Variant = Annotated[str, setting("1", "Mitsuba variant", min_length=1)]
Seed = Annotated[int, setting("1", "root of the fit's random numbers", ge=0)]
Threads = Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)]
Output = Annotated[str, setting("path", "run folder, relative to the working directory", min_length=1)]
HeldOut = Annotated[tuple[int, ...], setting("view", "indices of views that are evaluated but not fitted")]
DetectorSize = Annotated[tuple[Count, Count], setting("pixel", "(rows, columns) of computed projections")]
CheckpointSteps = Annotated[int, setting("step", "steps between two checkpoints", ge=1)]


def check_word(word: str, known: Sequence[str] | dict[str, Any], subject: str) -> None:
    """Refuse an unknown word, and offer the nearest known word.

    Raises:
        ValueError: with the word.
    """
    if word not in known:
        raise ValueError(f'unknown {subject} "{word}": {suggest_name(word, list(known))}'.rstrip("."))


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file."""
