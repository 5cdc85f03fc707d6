"""Files of Gaussians: the tables of formats, and one function to read and one to write any of them.

A new format is one reader and one line in :data:`GAUSSIAN_READERS`. Every number is checked before Gaussians are returned.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

from mivol.files.atomic import write_whole
from mivol.files.ply import read_comments, read_layout, read_tables
from mivol.files.source import check_file, parse_reals, refusal, select_by_suffix
from mivol.photos.camera_path import HomeView
from mivol.points.compact_files import read_ksplat, read_splat, read_spz, write_ksplat, write_splat, write_spz
from mivol.points.gaussian_gltf import read_gaussian_glb, write_gaussian_glb
from mivol.points.gaussian_page import write_gaussian_page
from mivol.points.gaussian_ply import is_compressed, parse_compressed_tables, parse_tables, write_gaussian_ply
from mivol.points.gaussians import Gaussians
from mivol.points.sog import read_sog, write_sog


def _read_ply(path: Path) -> Gaussians:
    tables = read_tables(path)
    return (parse_compressed_tables if is_compressed(tables) else parse_tables)(tables, path)


GAUSSIAN_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": _read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".ksplat": read_ksplat,
    ".sog": read_sog,
    ".glb": read_gaussian_glb,
}
"""Suffix -> reader(path)."""

GAUSSIAN_WRITERS: dict[str, Callable[[BinaryIO, Gaussians], None]] = {
    ".ply": write_gaussian_ply,
    ".spz": write_spz,
    ".splat": write_splat,
    ".ksplat": write_ksplat,
    ".sog": write_sog,
    ".glb": write_gaussian_glb,
    ".html": write_gaussian_page,
}
"""Suffix -> writer(file, gaussians). A ``.html`` is a page that shows the Gaussians; it is not read."""


def is_gaussian_file(path: Path) -> bool:
    """Whether a file holds Gaussians: by its suffix, and for a ``.ply`` by the properties in its header.

    Raises:
        MivolError: a ``.ply`` with an unreadable header.
    """
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in GAUSSIAN_READERS
    return not {"opacity", "packed_position"}.isdisjoint(read_layout(path).get("vertex", ()))


def read_gaussians(path: str | os.PathLike) -> Gaussians:
    """Read Gaussians in any format of :data:`GAUSSIAN_READERS`.

    Raises:
        MivolError: a missing, foreign, truncated or inconsistent file, an unknown suffix, or numbers that no renderer can draw
            (the message names the first index).

    Example:
        >>> read_gaussians("point_cloud.ply").degree
        3
    """
    path = check_file(path)
    return select_by_suffix(path, GAUSSIAN_READERS)(path).check(path)


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians, view: HomeView | None = None) -> None:
    """Write Gaussians, whole or not at all; the suffix selects the format (:data:`GAUSSIAN_WRITERS`).

    Args:
        path: destination.
        gaussians: contents.
        view: first view; a ``.ply`` keeps it as a comment, a ``.html`` begins with it, other formats leave it out.

    Raises:
        MivolError: an unknown suffix, numbers that no renderer can draw, or a full disk.
    """
    path = Path(path)
    writer = select_by_suffix(path, GAUSSIAN_WRITERS)
    if path.name.lower().endswith(".compressed.ply"):
        raise refusal(path, "a name for PlayCanvas' compressed .ply, which is read only", "another", "write a .sog or an .spz")
    gaussians.check(path)
    if view is not None and writer is write_gaussian_page:
        writer = partial(write_gaussian_page, view=view)
    if view is not None and writer is write_gaussian_ply:
        comment = " ".join([VIEW_COMMENT, *(f"{number:.9g}" for number in view.numbers)])
        writer = partial(write_gaussian_ply, comment=comment)
    write_whole(path, lambda file: writer(file, gaussians))


VIEW_COMMENT = "mivol_view"
"""First word of the comment with the first view in a ``.ply``."""


def read_gaussian_view(path: Path) -> HomeView | None:
    """Read the first view in a file of Gaussians; None without a view.

    Raises:
        MivolError: a ``.ply`` with an unreadable header, or numbers of no camera.
    """
    if path.suffix.lower() != ".ply":
        return None
    words = next((comment.split() for comment in read_comments(path) if comment.startswith(f"{VIEW_COMMENT} ")), None)
    if words is None:
        return None
    return HomeView.from_numbers(parse_reals(" ".join(words[1:]), len(words) - 1, path, VIEW_COMMENT), path)
