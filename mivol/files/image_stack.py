"""Stacks of images as one array: projections in TIFF, NumPy or HDF5, and headerless slices of a volume.

Conventions. A stack is float32 (n, rows, columns). A pattern (``scan_*.tif``) takes the files in the order of the numbers in
their names: slice.2 before slice.10.
"""

from __future__ import annotations

import logging
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files import source
from mivol.files.dicom_views import has_views, read_views, survey_dicom_views
from mivol.files.formats import read_volume
from mivol.files.source import check_file, refusal
from mivol.files.tiff import TIFF, natural_order
from mivol.files.volume import VolumeData, check_frame, frame_from_steps, to_values

ALL = slice(None)
"""All rows."""

DETECTOR_IMAGES = (".edf", ".his")
"""Suffixes of images of detectors; EDF is read by the package fabio."""

IMAGES = (*TIFF, *DETECTOR_IMAGES)
"""Suffixes of images of which a pattern takes several."""


def read_stack(path: str | os.PathLike, dataset: str | None = None, rows: slice = ALL) -> np.ndarray:
    """Read projections.

    Args:
        path: TIFF, EDF, HIS, MRC, .npy, .npz or HDF5 file, a pattern of TIFF, EDF or HIS files, or DICOM views (a file, or the
            folder of a file a view), which have their lowest row first.
        dataset: name of the array in an .npz or HDF5 file.
        rows: rows of the images. Other rows are not read from uncompressed TIFF and ``.npy``.

    Returns:
        Projections (n, rows, columns), float32.

    Raises:
        MivolError: no file, another format, images of different sizes, or numbers that are not finite.
    """
    if has_views(Path(path)):
        return read_views(path, rows)
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
    if has_views(Path(path)):
        views = survey_dicom_views(path)
        return len(views.frames), *views.pixels
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
            "replace them by 0, or in line integrals by 99: such pixels have weight 0",
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
    pages: list[np.ndarray] = []
    shapes: dict[tuple[int, ...], Path] = {}
    for file in files:
        found = _read_pages(file, rows)
        for page in found:
            shapes.setdefault(page.shape, file)
        pages += found
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        other = list(shapes.values())[:2][-1]
        raise refusal(other, f"images of shapes {sorted(shapes)[:3]}", "grey images of one size", "crop or convert them")
    return np.stack(pages)


def _read_pages(file: Path, rows: slice) -> list[np.ndarray]:
    """Pages or frames (rows, columns), float32, of a file."""
    from PIL import ImageSequence

    check_file(file)
    if file.suffix.lower() in DETECTOR_IMAGES:
        return list(_read_detector_images(file)[:, rows])
    if rows != ALL and (mapped := _map_pages(file)) is not None:
        # A copy, so that the file is not mapped any more: the pages of many mapped files count as memory of the process.
        return list(np.array(mapped[:, rows], np.float32))
    with _opened(file) as image:
        return [np.asarray(page, np.float32)[rows] for page in ImageSequence.Iterator(image)]


MOST_AXES = 9
"""Axes that a header of EDF may name."""

HIS_TYPES = {0: np.dtype("u1"), 2: np.dtype("<u2"), 3: np.dtype("<u4")}
"""Numbers of a frame by the type in its header."""


def _read_his(file: Path) -> np.ndarray:
    """Frames (n, rows, columns), float32, of a sequence of a Hamamatsu camera: each after a header of 64 bytes and a comment.

    fabio reads the first frame only, so mivol reads the sequence itself.

    Raises:
        MivolError: a damaged file, or frames of different sizes.
    """
    data, place, frames = file.read_bytes(), 0, []
    while place < len(data):
        head = data[place : place + 64]
        if len(head) < 64 or head[:2] != b"IM":
            raise refusal(
                file, f"no frame at byte {place}", 'a header of 64 bytes that begins with "IM"', "copy the file again"
            )
        comment, columns, rows, _, _, kind = struct.unpack("<6H", head[2:14])
        if kind not in HIS_TYPES or not rows * columns:
            found = f"{rows} x {columns} pixels of type {kind} in frame {len(frames)}"
            raise refusal(file, found, "pixels of the types 0, 2 or 3", "copy the file again")
        first, size = place + 64 + comment, rows * columns * HIS_TYPES[kind].itemsize
        if first + size > len(data):
            raise refusal(file, f"{len(data)} bytes, which end in frame {len(frames)}", "whole frames", "copy the file again")
        frames.append(np.frombuffer(data, HIS_TYPES[kind], rows * columns, first).reshape(rows, columns).astype(np.float32))
        place = first + size
    if len({frame.shape for frame in frames}) != 1:
        found = f"frames of {len({frame.shape for frame in frames})} sizes"
        raise refusal(file, found, "frames of one size", "split the file")
    return np.stack(frames)


def _read_detector_images(file: Path) -> np.ndarray:
    """Frames (n, rows, columns), float32, of an EDF or HIS file.

    Raises:
        MivolError: no fabio for EDF, or a damaged file.
    """
    if file.suffix.lower() == ".his":
        return _read_his(file)
    frames = _read_edf(file, lambda frame: np.asarray(frame.data))
    if len({frame.shape for frame in frames}) != 1 or frames[0].ndim != 2 or frames[0].dtype.kind not in "uif":
        found = f"frames of shapes {[frame.shape for frame in frames[:3]]} and type {frames[0].dtype}"
        raise refusal(file, found, "grey frames of one size", "copy the file again")
    return np.stack(frames).astype(np.float32)


def _read_edf(file: Path, read: Callable[[Any], Any]) -> list[Any]:
    """What ``read`` returns for each of fabio's frames of an EDF file.

    Raises:
        MivolError: no fabio, or a damaged file.
    """
    try:
        import fabio
    except ImportError as error:
        found = f"an image in {file.suffix[1:].upper()} but no fabio"
        raise refusal(file, found, "an installed fabio", 'install it: pip install "mivol[lab]"') from error
    # fabio walks to the highest axis that a header names, however high.
    highest = max((int(n[:18]) for n in re.findall(rb"(?i)dim_(\d+)", file.read_bytes())), default=0)
    if highest > MOST_AXES:
        found, expected = f"a header that names the axis Dim_{highest}", f"Dim_1 to Dim_{MOST_AXES} at most"
        raise refusal(file, found, expected, "copy the file again")
    log = logging.getLogger("fabio")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with fabio.open(str(file)) as image:
            # getframe of a file with a single frame opens the file of that number beside it.
            return [read(image)] if image.nframes == 1 else [read(image.getframe(k)) for k in range(image.nframes)]
    except Exception as error:  # fabio's parsers raise errors of many classes
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        way_out = "copy the file again"
        raise refusal(file, f"a damaged or foreign file ({reason})", file.suffix[1:].upper(), way_out) from error
    finally:
        log.setLevel(level)


ANGLE_WORDS = "theta", "rot", "angle", "omega"
"""Parts of the names of motors that turn a sample."""


def read_header_angles(path: str | os.PathLike) -> tuple[str, np.ndarray] | None:
    """Name and angles (views,) [degree] of the motor that turns the sample, from the headers of EDF files.

    A header has a motor as a key, or in the lists ``motor_mne`` and ``motor_pos`` of the ESRF.

    Args:
        path: EDF file, or a pattern of EDF files.

    Returns:
        None without EDF, or if no motor or several motors with the name of a rotation move from view to view.

    Raises:
        MivolError: as :func:`read_stack`.
    """
    files = _find_files(path)
    if any(file.suffix.lower() != ".edf" for file in files):
        return None
    heads = [_read_motors(head) for file in files for head in _read_edf(file, lambda frame: dict(frame.header))]
    names = [name for name in heads[0] if any(word in name.lower() for word in ANGLE_WORDS)]
    tables = {name: np.array([head.get(name, np.nan) for head in heads]) for name in names}
    moving = {name: angles for name, angles in tables.items() if np.isfinite(angles).all() and np.ptp(angles) > 0}
    return next(iter(moving.items())) if len(moving) == 1 else None


def _read_motors(head: dict[str, Any]) -> dict[str, float]:
    """Numbers in an EDF header by name."""
    listed = zip(str(head.get("motor_mne", "")).split(), str(head.get("motor_pos", "")).split(), strict=False)
    numbers = {}
    for name, text in (*head.items(), *listed):
        with suppress(ValueError):
            numbers[name] = float(text)
    return numbers


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """A TIFF file, opened by Pillow."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is truncated is refused below
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
