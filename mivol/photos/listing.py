"""What a data set says it has: one entry for each photograph, before any pixel is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera

__all__ = ["UNLISTED", "Entry", "Listing", "check_points"]

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


def check_points(rows: np.ndarray, file: Path, way_out: str) -> None:
    """Refuse points (N, 3 or more) of which some number is not finite.

    Raises:
        MivolError: by the first of them.
    """
    if not np.isfinite(rows).all():
        number = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise refusal(file, f"point {number} at {rows[number, :3].tolist()}", "finite numbers", way_out)
