"""A stack of headerless slices: one file per z, each ``rows`` x ``columns`` numbers, x fastest.

Conventions. Nothing in such files says what they hold, so type, shape and spacing are the caller's; files are taken in
the order of the numbers in their names (slice.2 before slice.10), from z = 0 upwards.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import refusal
from mivol.files.volume import VolumeData, as_values, check_frame, frame_from_steps


def read_slices(
    folder: str | os.PathLike,
    *,
    shape: tuple[int, int],
    dtype: np.dtype | str,
    spacing: Sequence[float] = (1.0, 1.0, 1.0),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    pattern: str = "*",
    skip: int = 0,
) -> VolumeData:
    """Read a folder of raw slices as one volume.

    Args:
        folder: where they lie.
        shape: (rows, columns) = (Y, X) of each.
        dtype: NumPy type with its byte order, for instance "<u2".
        spacing: distance between voxel centres along x, y, z.
        origin: world position of the first voxel's centre.
        pattern: file names to take (shell pattern); there must be at least one.
        skip: bytes before the numbers in each file.

    Returns:
        The volume (files, rows, columns, 1).

    Raises:
        MivolError: no such folder or files, a file of another length, a spacing that flattens the box.

    Example:
        >>> read_slices("headsq", shape=(64, 64), dtype="<u2", spacing=(3.2, 3.2, 1.5), pattern="quarter.*")
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise refusal(folder, "no folder", "a folder of raw slices", "check the path")
    files = sorted((name for name in folder.glob(pattern) if name.is_file()), key=order_of_numbers)
    if not files:
        raise refusal(folder, f"no file that fits {pattern!r}", "at least one slice", "give another pattern")
    rows, columns = shape
    if min(rows, columns) < 1:
        raise refusal(folder, f"a slice shape of {shape}", "at least 1 x 1", "give (rows, columns)")
    slices = [source.elements(source.read_bytes(f), dtype, rows * columns, f, offset=skip) for f in files]
    values = as_values(np.stack(slices).reshape(len(files), rows, columns), folder)
    to_world = frame_from_steps((columns, rows, len(files)), np.diag(spacing), origin)
    check_frame(to_world, folder)
    meta = {
        "path": str(folder),
        "format": "slices",
        "dtype": str(np.dtype(dtype)),
        "space": None,
        "files": [f.name for f in files],
    }
    return VolumeData(values, to_world, meta)


def order_of_numbers(path: Path) -> tuple:
    """Numbers in a name compare as numbers: pieces alternate text, number, text ..."""
    return tuple(int(piece) if piece.isdigit() else piece for piece in re.split(r"(\d+)", path.name))
