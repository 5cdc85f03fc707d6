"""Stacks of images as one array: projections in TIFF, NumPy or HDF5, and headerless slices of a volume.

Conventions. A stack is float32 (n, rows, columns). A pattern (``scan_*.tif``) takes the files in the order of the numbers in
their names: slice.2 before slice.10.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files import source
from mivol.files.formats import read_volume
from mivol.files.source import check_file, refusal
from mivol.files.tiff import TIFF, natural_order
from mivol.files.volume import VolumeData, check_frame, frame_from_steps, to_values

ALL = slice(None)
"""All rows."""

DETECTOR_IMAGES = (".edf", ".his")
"""Suffixes of images of detectors, read by the package fabio."""

IMAGES = (*TIFF, *DETECTOR_IMAGES)
"""Suffixes of images of which a pattern takes several."""


def read_stack(path: str | os.PathLike, dataset: str | None = None, rows: slice = ALL) -> np.ndarray:
    """Read projections.

    Args:
        path: TIFF, EDF, HIS, MRC, .npy, .npz or HDF5 file, or a pattern of TIFF, EDF or HIS files.
        dataset: name of the array in an .npz or HDF5 file.
        rows: rows of the images. Other rows are not read from uncompressed TIFF and ``.npy``.

    Returns:
        Projections (n, rows, columns), float32.

    Raises:
        MivolError: no file, another format, images of different sizes, or numbers that are not finite.
    """
    files = _find_files(path)
    if files[0].suffix.lower() in IMAGES:
        stack = read_images(files, rows)
    elif rows != ALL and (mapped := _map_array(files[0])) is not None:
        stack = np.array(mapped[:, rows], np.float32)
    else:
        stack = read_volume(files[0], dataset).values[..., 0][:, rows]
    check_finite(path, stack)
    return stack


def stack_shape(path: str | os.PathLike, dataset: str | None = None) -> tuple[int, int, int]:
    """Size (n, rows, columns) of a stack. Uncompressed TIFF and ``.npy`` are not read.

    Args, raises: as :func:`read_stack`.
    """
    files = _find_files(path)
    if files[0].suffix.lower() in DETECTOR_IMAGES:
        frames = _read_detector_images(files[0])
        return len(files) * len(frames), *frames.shape[1:]
    if files[0].suffix.lower() in TIFF:
        with _opened(files[0]) as image:
            return len(files) * getattr(image, "n_frames", 1), image.height, image.width
    mapped = _map_array(files[0])
    return (read_volume(files[0], dataset).values if mapped is None else mapped).shape[:3]


def _find_files(path: str | os.PathLike) -> list[Path]:
    files = sorted(Path(path).parent.glob(Path(path).name), key=natural_order)
    if not files or Path(path).is_dir():
        check_file(path, in_a_folder=f'name a file in it, or a pattern of TIFF files: "{Path(path).name}/*.tif"')
    if len(files) > 1 and files[0].suffix.lower() not in IMAGES:
        raise refusal(path, f"{len(files)} files", "one file, or a pattern of TIFF files", "name one of the files")
    return files


def check_finite(path: str | os.PathLike, stack: np.ndarray) -> None:
    """Refuse readings that are not finite.

    Raises:
        MivolError: states their number and the index of the first.
    """
    bad = ~np.isfinite(stack)
    if bad.any():
        first = tuple(map(int, np.argwhere(bad)[0]))
        raise refusal(
            path,
            f"{int(bad.sum())} pixels that are not finite, the first at (view, row, column) = {first}",
            "finite numbers",
            "replace them by 0: a reading of 0 has weight 0",
        )


def read_images(files: list[Path], rows: slice = ALL) -> np.ndarray:
    """Read the pages of TIFF files, or the frames of EDF and HIS files.

    Args:
        files: files.
        rows: rows of the images.

    Returns:
        Pages (n, rows, columns), float32.

    Raises:
        MivolError: errors of :func:`read_stack`.
    """
    from PIL import ImageSequence

    pages = []
    for file in files:
        check_file(file)
        if file.suffix.lower() in DETECTOR_IMAGES:
            pages += list(_read_detector_images(file)[:, rows])
            continue
        if rows != ALL and (mapped := _map_pages(file)) is not None:
            # A copy, so that the file is not mapped any more: the pages of many mapped files count as memory of the process.
            pages += list(np.array(mapped[:, rows], np.float32))
            del mapped
            continue
        with _opened(file) as image:
            pages += [np.asarray(page, np.float32)[rows] for page in ImageSequence.Iterator(image)]
    shapes = {page.shape for page in pages}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise refusal(files[0], f"images of shapes {sorted(shapes)[:3]}", "grey images of one size", "crop or convert them")
    return np.stack(pages)


def _read_detector_images(file: Path) -> np.ndarray:
    """Frames (n, rows, columns), float32, of an EDF or HIS file.

    Raises:
        MivolError: no fabio, or a damaged file.
    """
    try:
        import fabio
    except ImportError as error:
        found = f"an image in {file.suffix[1:].upper()} but no fabio"
        raise refusal(file, found, "an installed fabio", 'install it: pip install "mivol[lab]"') from error
    log = logging.getLogger("fabio")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with fabio.open(str(file)) as image:
            # getframe of a file with a single frame opens the file of that number beside it.
            several = (np.asarray(image.getframe(k).data) for k in range(image.nframes))
            frames = [np.asarray(image.data)] if image.nframes == 1 else list(several)
        if len({frame.shape for frame in frames}) != 1 or frames[0].ndim != 2 or frames[0].dtype.kind not in "uif":
            raise ValueError(f"frames of shapes {[frame.shape for frame in frames[:3]]}")
    except Exception as error:  # fabio's parsers raise errors of many classes
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        way_out = "copy the file again"
        raise refusal(file, f"a damaged or foreign file ({reason})", file.suffix[1:].upper(), way_out) from error
    finally:
        log.setLevel(level)
    return np.stack(frames).astype(np.float32)


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """A TIFF file, opened by Pillow."""
    from PIL import Image

    try:
        with Image.open(file) as image:
            yield image
    except Exception as error:  # Pillow raises errors of its parser, such as a TypeError without a width
        raise refusal(file, f"a damaged or foreign file ({error})", "TIFF", "copy the file again") from error


def _map_pages(file: Path) -> np.ndarray | None:
    """Pages (n, rows, columns) of an uncompressed TIFF file, on the disk; None for other files."""
    from tifffile import memmap

    try:
        pages = memmap(file, mode="r")
    except Exception:  # compressed, damaged or in pieces: Pillow reads or refuses the file
        return None
    return pages.reshape(-1, *pages.shape[-2:]) if pages.ndim in (2, 3) and pages.dtype.kind in "uif" else None


def _map_array(file: Path) -> np.ndarray | None:
    """The array (n, rows, columns) of an ``.npy`` file, on the disk; None for other files."""
    if file.suffix.lower() != ".npy":
        return None
    with suppress(ValueError, OSError):
        mapped = np.load(file, mmap_mode="r")
        if mapped.ndim == 3 and mapped.dtype.kind in "uif":
            return mapped
    return None


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
    """Read a folder of headerless slices as a volume: a file for each z from 0 upwards, x fastest.

    Args:
        folder: folder of the files.
        shape: (rows, columns) = (Y, X) of a slice.
        dtype: NumPy type with its byte order, for instance "<u2".
        spacing: distance between voxel centres along x, y, z [length].
        origin: centre of the first voxel in the world [length].
        pattern: shell pattern of the file names, with at least one match.
        skip: bytes before the numbers of each file.

    Returns:
        The volume (files, rows, columns, 1).

    Raises:
        MivolError: no folder or file, a file of another length, or a spacing that flattens the box.

    Example:
        >>> read_slices("headsq", shape=(64, 64), dtype="<u2", spacing=(3.2, 3.2, 1.5), pattern="quarter.*")
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise refusal(folder, "no folder", "a folder of raw slices", "check the path")
    files = sorted((name for name in folder.glob(pattern) if name.is_file()), key=natural_order)
    if not files:
        raise refusal(folder, f"no file matching {pattern!r}", "at least one slice", "give another pattern")
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
