"""Stacks of projections: TIFF (one file of many pages, or many files), NumPy and HDF5, as one array.

Conventions. (n, rows, cols) float32. A pattern (``scan_*.tif``) takes the files in the order of the numbers in their names.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.formats import read_volume
from mivol.files.source import check_file, refusal
from mivol.files.volume import VolumeData, check_frame, frame_from_steps, to_values

TIFF = (".tif", ".tiff")


def read_stack(path: str | os.PathLike, dataset: str | None = None) -> np.ndarray:
    """Read projections.

    Args:
        path: a TIFF, .npy, .npz or HDF5 file, or a pattern of TIFF files.
        dataset: which array of an .npz or HDF5 file.

    Returns:
        (n, rows, cols) float32.

    Raises:
        MivolError: no such file, not such a stack, images of several sizes, numbers that are not finite.
    """
    files = sorted(Path(path).parent.glob(Path(path).name), key=natural_order)
    if not files or Path(path).is_dir():
        check_file(path, in_a_folder=f'name a file in it, or a pattern of TIFF files: "{Path(path).name}/*.tif"')
    if files[0].suffix.lower() in TIFF:
        stack = read_images(files)
    elif len(files) > 1:
        raise refusal(path, f"{len(files)} files", "one, or a pattern of TIFF files", "name one of them")
    else:
        stack = read_volume(files[0], dataset).values[..., 0]
    check_finite(path, stack)
    return stack


def check_finite(path: str | os.PathLike, stack: np.ndarray) -> None:
    """Refuse readings that are no finite numbers.

    Raises:
        MivolError: how many, and where the first is.
    """
    bad = ~np.isfinite(stack)
    if bad.any():
        where = tuple(map(int, np.argwhere(bad)[0]))
        raise refusal(
            path,
            f"{int(bad.sum())} pixels that are not finite, the first at (view, row, column) = {where}",
            "finite numbers",
            "write 0 there: a reading of 0 has weight 0",
        )


def read_images(files: list[Path]) -> np.ndarray:
    """All pages of TIFF files, one after the other.

    Returns:
        (n, rows, cols) float32.

    Raises:
        MivolError: as :func:`read_stack`.
    """
    from PIL import Image, ImageSequence

    pages = []
    for file in files:
        there = check_file(file)
        try:
            with Image.open(there) as image:
                pages += [np.asarray(page, np.float32) for page in ImageSequence.Iterator(image)]
        except Exception as error:  # Pillow raises what its parser stumbles over: a TypeError where there is no width
            raise refusal(file, f"a damaged or foreign file ({error})", "TIFF", "copy it again") from error
    shapes = {page.shape for page in pages}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise refusal(files[0], f"images of shapes {sorted(shapes)[:3]}", "grey images of one size", "crop or convert them")
    return np.stack(pages)


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
    files = sorted((name for name in folder.glob(pattern) if name.is_file()), key=natural_order)
    if not files:
        raise refusal(folder, f"no file that fits {pattern!r}", "at least one slice", "give another pattern")
    rows, columns = shape
    if min(rows, columns) < 1:
        raise refusal(folder, f"a slice shape of {shape}", "at least 1 x 1", "give (rows, columns)")
    slices = [source.parse_elements(source.read_bytes(f), dtype, rows * columns, f, offset=skip) for f in files]
    values = to_values(np.stack(slices).reshape(len(files), rows, columns), folder)
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


def natural_order(path: Path) -> tuple:
    """Numbers in a name compare as numbers: pieces alternate text, number, text ..."""
    return tuple(int(piece) if piece.isdigit() else piece for piece in re.split(r"(\d+)", path.name))
