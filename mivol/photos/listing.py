"""The list of a data set: an entry for each photograph, before any pixel is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera

UNLISTED = "in no list"
"""Split of the photographs outside the lists of the data set."""


@dataclass(frozen=True)
class Entry:
    """A photograph in the list of a data set.

    Attributes:
        name: name in the data set.
        file: path of the image, which may be missing.
        camera: function from (width, height) [pixel] to the camera.
        split: "train", "test", "val" or ``UNLISTED``.
        size: (width, height) in the file of cameras [pixel]; by default all photographs of the split have the same size.
        mask: path of the mask, optional.
        points: points (K, 3) of a sparse reconstruction visible in the photograph [length], if known.
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
    """The photographs and points of a data set.

    Attributes:
        entries: photographs in the order of the data set.
        points: points (N, 3) of a sparse reconstruction [length], if known.
    """

    entries: list[Entry]
    points: np.ndarray | None = None


def check_points(rows: np.ndarray, file: Path, way_out: str) -> None:
    """Refuse points (N, 3 or more) with a number that is not finite.

    Raises:
        MivolError: names the first bad point.
    """
    if not np.isfinite(rows).all():
        number = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise refusal(file, f"point {number} at {rows[number, :3].tolist()}", "finite numbers", way_out)
