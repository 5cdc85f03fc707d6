"""One door to files of Gaussians: the suffix chooses the format, and every number is looked at before it is handed on.

Here: :data:`GAUSSIAN_READERS` and :data:`GAUSSIAN_WRITERS` (suffix -> function), :func:`read_gaussians`,
:func:`write_gaussians`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from mivol.files.atomic import write_whole
from mivol.files.ply import read_layout, read_tables
from mivol.files.source import check_file, select_by_suffix
from mivol.points.gaussian_ply import is_compressed, parse_compressed_tables, parse_tables, write_gaussian_ply
from mivol.points.gaussians import Gaussians
from mivol.points.splat import read_ksplat, read_splat
from mivol.points.spz import read_spz

__all__ = ["GAUSSIAN_READERS", "GAUSSIAN_WRITERS", "is_gaussian_file", "read_gaussians", "write_gaussians"]


def _read_ply(path: Path) -> Gaussians:
    tables = read_tables(path)
    return (parse_compressed_tables if is_compressed(tables) else parse_tables)(tables, path)


#: suffix -> reader(path).
GAUSSIAN_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": _read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".ksplat": read_ksplat,
}

#: suffix -> writer(file, gaussians).
GAUSSIAN_WRITERS: dict[str, Callable[[BinaryIO, Gaussians], None]] = {".ply": write_gaussian_ply}


def is_gaussian_file(path: Path) -> bool:
    """Whether a file is of Gaussians: by its suffix, and a ``.ply`` by the properties that its header lists.

    Raises:
        MivolError: a ``.ply`` whose header cannot be read.
    """
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in GAUSSIAN_READERS
    return not {"opacity", "packed_position"}.isdisjoint(read_layout(path).get("vertex", ()))


def read_gaussians(path: str | os.PathLike) -> Gaussians:
    """Read Gaussians of any format in :data:`GAUSSIAN_READERS`.

    Raises:
        MivolError: missing, foreign, truncated or inconsistent file; a suffix that is not known; numbers that cannot be drawn,
            by the index of the first.

    Example:
        >>> read_gaussians("point_cloud.ply").degree
        3
    """
    path = check_file(path)
    return select_by_suffix(path, GAUSSIAN_READERS)(path).check(path)


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write Gaussians, whole or not at all; the suffix chooses the format (:data:`GAUSSIAN_WRITERS`).

    Raises:
        MivolError: a suffix that is not known, numbers that cannot be drawn, disk full.
    """
    path = Path(path)
    writer = select_by_suffix(path, GAUSSIAN_WRITERS)
    gaussians.check(path)
    write_whole(path, lambda file: writer(file, gaussians))
