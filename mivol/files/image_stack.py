"""Stacks of projections: TIFF (one file of many pages, or many files), NumPy and HDF5, as one array.

Conventions. (n, rows, cols) float32. A pattern (``scan_*.tif``) takes the files in the order of the numbers in their names.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mivol.files.formats import read_volume
from mivol.files.slices import order_of_numbers
from mivol.files.source import existing_file, refusal

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
    files = sorted(Path(path).parent.glob(Path(path).name), key=order_of_numbers)
    if not files or Path(path).is_dir():
        existing_file(path, in_a_folder=f'name a file in it, or a pattern of TIFF files: "{Path(path).name}/*.tif"')
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
        there = existing_file(file)
        try:
            with Image.open(there) as image:
                pages += [np.asarray(page, np.float32) for page in ImageSequence.Iterator(image)]
        except Exception as error:  # Pillow raises what its parser stumbles over: a TypeError where there is no width
            raise refusal(file, f"a damaged or foreign file ({error})", "TIFF", "copy it again") from error
    shapes = {page.shape for page in pages}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise refusal(files[0], f"images of shapes {sorted(shapes)[:3]}", "grey images of one size", "crop or convert them")
    return np.stack(pages)
