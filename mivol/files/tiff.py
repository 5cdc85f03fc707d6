"""Volumes in TIFF through tifffile: a file of pages, or a folder with a file for each slice; written as one BigTIFF.

Conventions. A page is a slice of one z, from z = 0 upwards; its rows are y, its columns x. The files of a folder follow the
numbers in their names: slice.2 before slice.10. Distances of voxels come from the metadata of ImageJ or OME. Without them,
voxels are unit cubes, because the resolution of plain TIFF is that of a printer. The centre of the first voxel is 0.

Reference: docs.openmicroscopy.org/ome-model, "OME-TIFF specification".
"""

from __future__ import annotations

import glob
import logging
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from mivol.errors import MivolError
from mivol.files.atomic import disk_faults, write_whole
from mivol.files.npy import check_memory
from mivol.files.source import check_file, refusal, refuse_dataset, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, is_upright, split_frame, to_values

TIFF = (".tif", ".tiff")

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "micron": 1e-6, "nm": 1e-9, "Å": 1e-10, "A": 1e-10}
"""Units of length in files [m]."""


def is_tiff(head: bytes) -> bool:
    """Whether the first bytes are those of TIFF or BigTIFF."""
    return head[:4] in MAGICS


def read_tiff(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a file of pages, or a folder of slices.

    Args:
        path: file or folder.
        dataset: in a folder of several kinds of images, the name of one with "#" for its numbers (``slice_#.tif``).

    Raises:
        MivolError: a damaged file, a compression without its decoder, images of several sizes, or several axes besides z.
    """
    if path.is_file():
        refuse_dataset(path, dataset)
        array, spacing, unit, notes = _read_pages(path)
        return _volume(path, array, spacing, unit, notes)
    groups = {group.name: group.files for group in group_images(path)}
    files = groups[select_dataset(path, dataset, list(groups))]
    first, spacing, unit, notes = _read_pages(files[0])
    if len(files) == 1:
        return _volume(path, first, spacing, unit, notes)
    if len(first) > 1:
        raise refusal(path, f"{len(files)} files of {len(first)} slices or more", "one slice a file", "name one of the files")
    check_memory(path, len(files) * first.nbytes)
    values = np.empty((len(files), *first.shape[1:]), first.dtype)
    for k, file in enumerate(files):
        one = _read_pages(file)[0]
        if (one.shape, one.dtype) != (first.shape, first.dtype):
            found = f"{file.name} of shape {one.shape[1:3]} and type {one.dtype}"
            raise refusal(path, found, f"{first.shape[1:3]} and {first.dtype} as {files[0].name}", "move it out of the folder")
        values[k] = one[0]
    return _volume(path, values, spacing, unit, (*notes, f"{len(files)} files are the slices from z = 0 upwards."))


def write_tiff(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a BigTIFF of OME, a float32 page a slice; ``metadata["unit"]`` is the unit, the identity means no place.

    Raises:
        MivolError: a placement other than distances of voxels, which the format cannot hold.
    """
    from tifffile import TiffWriter

    steps, origin = split_frame(values.shape[2::-1], to_world)
    is_placed = not np.array_equal(to_world, np.eye(4))
    if is_placed and not (is_upright(steps) and np.allclose(origin, 0, atol=1e-9 * steps.max())):
        raise refusal(
            "write_volume", "a place for a TIFF file", "distances of voxels alone", "write .nrrd, or remove the place"
        )
    unit = str(metadata.get("unit"))
    unit = {"um": "µm", "A": "Å"}.get(unit, unit if unit in METRES else "reference frame")
    named: dict[str, Any] = {"axes": "ZYXS" if values.shape[3] > 1 else "ZYX"}
    if is_placed:
        named |= {f"PhysicalSize{axis}": float(size) for axis, size in zip("XYZ", np.diag(steps), strict=True)}
        named |= {f"PhysicalSize{axis}Unit": unit for axis in "XYZ"}
    stored = values if values.shape[3] > 1 else values[..., 0]
    with TiffWriter(file, bigtiff=True, ome=True) as writer:
        writer.write(stored, photometric="minisblack", planarconfig="contig" if values.shape[3] > 1 else None, metadata=named)


class TiffSlices:
    """A folder of TIFF files, a float32 slice each, that is written a few slices at a time.

    Args:
        path: folder; created.
        shape: (Z, Y, X).
    """

    def __init__(self, path: Path, shape: tuple[int, int, int]) -> None:
        self.path, self.digits = path, max(4, len(str(shape[0])))
        with disk_faults(path, "room for a folder"):
            path.mkdir(exist_ok=True)

    def write(self, first: int, values: np.ndarray) -> None:
        """Write slices (n, Y, X) from z = ``first`` on, each file whole or not at all."""
        from tifffile import imwrite

        for k, image in enumerate(np.asarray(values, np.float32)):
            name = self.path / f"slice_{first + k:0{self.digits}}.tif"
            write_whole(name, lambda file, image=image: imwrite(file, image, photometric="minisblack"))


def _volume(path: Path, array: np.ndarray, spacing: np.ndarray, unit: str, notes: tuple[str, ...]) -> VolumeData:
    meta = {"path": str(path), "format": "tiff", "dtype": str(array.dtype), "space": None, "unit": unit, "notes": notes}
    values = to_values(array, path)
    return VolumeData(values, frame_from_steps(values.shape[2::-1], np.diag(spacing), np.zeros(3)), meta)


# -- Pages -----------------------------------------------------------------------------------------------------------------


@contextmanager
def _guarded(path: Path) -> Iterator[None]:
    """Refuse what tifffile cannot read: its parsers raise errors of many classes, and log what they repair."""
    log = logging.getLogger("tifffile")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    except (MivolError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        if "imagecodecs" in reason:
            way_out = 'install it: pip install "mivol[lab]"'
            raise refusal(path, f"a compressed file ({reason})", "an installed imagecodecs", way_out) from error
        raise refusal(path, f"a damaged TIFF file ({reason})", "a whole TIFF file", "copy it again") from error
    finally:
        log.setLevel(level)


def _read_pages(path: Path) -> tuple[np.ndarray, np.ndarray, str, tuple[str, ...]]:
    """Values (Z, Y, X) or (Z, Y, X, C), distances of voxels along x, y, z, their unit, and notes."""
    from tifffile import TiffFile

    size = check_file(path).stat().st_size
    with _guarded(path), TiffFile(path) as file:
        # Pages that name each other in a circle are counted without a hang, and listed for ever.
        if not len(file.pages):
            raise refusal(path, "no page", "a whole TIFF file", "copy it again")
        series = file.series
        if len(series) != 1:
            listed = ", ".join(str(one.shape) for one in series[:4])
            raise refusal(path, f"{len(series)} images of different kinds ({listed})", "pages of one size", "split the file")
        check_memory(path, int(np.prod(series[0].shape, dtype=object)) * max(4, series[0].dtype.itemsize))
        for page in file.pages:
            spans = zip(page.dataoffsets, page.databytecounts, strict=True)
            if any(count == 0 or offset + count > size for offset, count in spans):
                raise refusal(path, "pages that the file does not hold", "a whole TIFF file", "copy it again")
        array, notes = _order_axes(path, series[0].asarray(), series[0].axes)
        spacing, unit = _spacing(path, file)
    return array, spacing, unit, notes


def _order_axes(path: Path, array: np.ndarray, axes: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """The array with the axes (Z, Y, X) or (Z, Y, X, C)."""
    channel = [k for k, axis in enumerate(axes) if axis in "SC"]
    depth = [k for k, axis in enumerate(axes) if axis not in "YXSC"]
    long = [k for k in depth if array.shape[k] > 1]
    if sorted(axis for axis in axes if axis in "YX") != ["X", "Y"] or len(channel) > 1 or len(long) > 1:
        raise refusal(
            path, f"the axes {axes} of shape {array.shape}", "y, x, at most one more and channels", "extract a volume"
        )
    order = [*depth, axes.index("Y"), axes.index("X"), *channel]
    array = array.transpose(order)
    array = array.reshape(-1, *array.shape[len(depth) :])
    notes = ("the frames in time are the slices.",) if long and axes[long[0]] == "T" else ()
    return array, notes


def _spacing(path: Path, file: Any) -> tuple[np.ndarray, str]:
    """Distances of voxels along x, y, z, and their unit; unit cubes of "voxel" if the file has none."""
    page = file.pages[0]
    if file.is_ome:
        pixels = next((node for node in ElementTree.fromstring(file.ome_metadata).iter() if node.tag.endswith("}Pixels")), None)
        sizes = [pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"] if pixels is not None else []
        if any(sizes):
            units = [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
            factors = [METRES.get(unit, 1.0) / METRES.get(units[0], 1.0) for unit in units]
            lengths = np.array([float(size or 1) for size in sizes]) * factors
            return _checked(path, lengths), {"µm": "um", "Å": "A", "reference frame": "unknown"}.get(units[0], units[0])
    if file.is_imagej:
        known = file.imagej_metadata or {}
        across = [page.tags[name].value if name in page.tags else (1, 1) for name in ("XResolution", "YResolution")]
        lengths = [below / above for above, below in across]
        unit = str(known.get("unit", "voxel")).replace("\\u00B5", "µ")
        spacing = _checked(path, np.array([*lengths, float(known.get("spacing", 1.0))]))
        return spacing, {"µm": "um", "micron": "um", "pixel": "voxel"}.get(unit, unit)
    return np.ones(3), "voxel"


def _checked(path: Path, spacing: np.ndarray) -> np.ndarray:
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise refusal(path, f"distances of voxels {spacing.tolist()}", "three numbers above 0", "correct the metadata")
    return spacing


# -- Folders ---------------------------------------------------------------------------------------------------------------


class ImageGroup(NamedTuple):
    """Images whose names differ in their numbers: a name with "#" for numbers, and the files."""

    name: str
    files: list[Path]

    @property
    def words(self) -> set[str]:
        """Words of the name, in lower case: "refHST" has two, and "i0" is one."""
        name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", self.name.rpartition(".")[0]).lower()
        return set(re.findall(r"i0|[a-z]+", name.replace("#", "0")))

    @property
    def size(self) -> int:
        """Size of all files [byte]."""
        return sum(file.stat().st_size for file in self.files)

    def pattern(self) -> str:
        """The pattern that finds these files and no others.

        Raises:
            MivolError: no such pattern.
        """
        first = self.files[0]
        if len(self.files) == 1:
            return str(first)
        name, folder = glob.escape(first.name), first.parent
        begin = glob.escape(os.path.commonprefix([file.name for file in self.files]))  # noqa: RUF071, characters are meant
        for pattern in (re.sub(r"\d+", "*", name), re.sub(r"\d+", "[0-9]*", name), f"{begin}*{first.suffix}"):
            if sorted(folder.glob(pattern)) == sorted(self.files):
                return str(folder / pattern)
        raise refusal(folder, f"other images between {first.name} and its like", "one folder a kind", "move them apart")


def group_images(folder: Path, suffixes: tuple[str, ...] = TIFF) -> list[ImageGroup]:
    """Group the images of a folder and of the folders in it by their names without numbers; the largest groups first."""
    groups: dict[str, list[Path]] = {}
    inner = [entry for entry in folder.iterdir() if entry.is_dir()]
    for file in (file for place in (folder, *inner) for file in place.iterdir()):
        if file.suffix.lower() in suffixes:
            groups.setdefault(re.sub(r"\d+", "#", str(file.relative_to(folder))), []).append(file)
    found = [ImageGroup(name, sorted(files, key=natural_order)) for name, files in groups.items()]
    return sorted(found, key=lambda group: -group.size)


def natural_order(path: Path) -> tuple:
    """Return a sort key that compares numbers in a name as numbers."""
    return tuple(int(piece) if piece.isdigit() else piece for piece in re.split(r"(\d+)", path.name))
