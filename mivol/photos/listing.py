"""What a data set says it has: one entry for each photograph, before any pixel is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.photos.camera import Camera

__all__ = ["UNLISTED", "Entry", "Listing"]

UNLISTED = "in no list"
"""The split of photographs that a data set's own lists leave out."""


@dataclass(frozen=True)
class Entry:
    """A photograph that a data set names.

    Attributes:
        name: as the data set calls it.
        file: where it should lie.
        camera: from its (width, height) in pixels.
        split: "train", "test", "val" or ``UNLISTED``.
        size: (width, height) that the file of cameras says [pixel]; None: all of the split have one size.
        mask: where its mask should lie, if it has one.
        points: (K, 3) those of a sparse reconstruction that were found in it [length]; None where that is not known.
    """

    name: str
    file: Path
    camera: Callable[[tuple[int, int]], Camera]
    split: str = "train"
    size: tuple[int, int] | None = None
    mask: Path | None = None
    points: np.ndarray | None = None


@dataclass(frozen=True)
class Listing:
    """All photographs that a data set names, and the points it knows.

    Attributes:
        entries: in its order.
        points: (N, 3) points of a sparse reconstruction [length], or None.
    """

    entries: list[Entry]
    points: np.ndarray | None = None
