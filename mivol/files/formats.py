"""One door to every volume file: the suffix chooses the format, the first bytes must agree.

Here: :data:`FORMATS` (suffix -> how to recognise and read it), :data:`GAUSSIAN_WRITERS`, :data:`FRAMES`, :func:`read_volume`,
:func:`write_volume`. A stack of headerless slices needs facts that no file holds: :func:`mivol.files.read_slices`.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import hdf5, les, metaimage, nifti, npy, nrrd, pbrt, vol, vti, vtk_legacy
from mivol.files.atomic import write_whole
from mivol.files.source import check_file, refusal
from mivol.files.volume import VolumeData, check_frame, to_values

#: How many first bytes a format is recognised by.
HEAD = 4096


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of file: its name for people, a test of its first bytes, its reader."""

    name: str
    recognise: Callable[[bytes], bool]
    read: Callable[[Path, str | None], VolumeData]


def _begins(magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


def _is_metaimage(head: bytes) -> bool:
    return re.search(rb"(?m)^\s*(NDims|DimSize|ObjectType)\s*=", head) is not None


_METAIMAGE = Format("MetaImage", _is_metaimage, metaimage.read_metaimage)
_NRRD = Format("NRRD", _begins(nrrd.MAGIC), nrrd.read_nrrd)
_HDF5 = Format("HDF5", _begins(hdf5.MAGIC), hdf5.read_hdf5)
_LES = Format("LES cloud text", les.is_les, les.read_les)

#: suffix -> format; a longer suffix is tried first.
FORMATS: dict[str, Format] = {
    ".vol": Format("Mitsuba grid", _begins(vol.MAGIC), vol.read_vol),
    ".npy": Format("NumPy array", _begins(npy.NPY_MAGIC), npy.read_npy),
    ".npz": Format("NumPy archive", _begins(npy.NPZ_MAGIC), npy.read_npz),
    ".nrrd": _NRRD,
    ".nhdr": _NRRD,
    ".mhd": _METAIMAGE,
    ".mha": _METAIMAGE,
    ".nii": Format("NIfTI", nifti.is_nifti, nifti.read_nifti),
    ".nii.gz": Format("gzip-compressed NIfTI", nifti.is_nifti_gz, nifti.read_nifti),
    ".vti": Format("VTK XML image", lambda head: b"<VTKFile" in head, vti.read_vti),
    ".vtk": Format("legacy VTK", _begins(vtk_legacy.MAGIC), vtk_legacy.read_vtk),
    ".pbrt": Format("pbrt volumegrid", pbrt.is_pbrt, pbrt.read_pbrt),
    ".csv": _LES,
    ".txt": _LES,
    ".h5": _HDF5,
    ".hdf5": _HDF5,
}

#: suffix -> writer(file, values, to_world, metadata).
WRITERS: dict[str, Callable[[BinaryIO, np.ndarray, np.ndarray, dict[str, Any]], None]] = {
    ".vol": vol.write_vol,
    ".npy": npy.write_npy,
    ".npz": npy.write_npz,
    ".nrrd": nrrd.write_nrrd,
}

#: suffix -> writer that does not compress.
STORED_WRITERS = {**WRITERS, ".npz": npy.write_npz_stored}

#: where the unit cube goes: as the file's header says, or nowhere (as stock gridvolume without use_grid_bbox).
FRAMES: dict[str, Callable[[VolumeData], np.ndarray]] = {
    "file": lambda volume: volume.to_world,
    "unit": lambda volume: np.eye(4),
}


def read_volume(path: str | os.PathLike, dataset: str | None = None, *, frame: str = "file") -> VolumeData:
    """Read a volume of any format in :data:`FORMATS`.

    Args:
        path: its suffix chooses the format, its first bytes must agree.
        dataset: which array, where a file holds several (.npz, .vti, .vtk, .h5, LES text).
        frame: a key of :data:`FRAMES`: "file" takes the place from the header and refuses a degenerate one, "unit"
            ignores it and leaves the volume on the unit cube.

    Returns:
        Values, place and facts. NaN, Inf and negative numbers are kept: :func:`check_volume` refuses them.

    Raises:
        MivolError: missing, empty, foreign, truncated or inconsistent file; a suffix or type that is not known; a
            degenerate place.

    Example:
        >>> read_volume("tooth.nrrd").values.shape
        (161, 94, 103, 1)
    """
    path = check_file(path)
    if frame not in FRAMES:
        raise refusal("read_volume", f"frame={frame!r}", f"one of {', '.join(FRAMES)}", "choose one of those")
    suffix = _suffix(path, FORMATS)
    kind = FORMATS[suffix]
    with path.open("rb") as file:
        head = file.read(HEAD)
    if not kind.recognise(head):
        raise _foreign(path, suffix, head)
    try:
        volume = kind.read(path, dataset)
    except MemoryError as error:
        raise refusal(
            path, "more voxels than memory holds", "a volume that fits", "crop or coarsen it, or correct its header"
        ) from error
    to_world = FRAMES[frame](volume)
    check_frame(to_world, path)
    return dataclasses.replace(volume, to_world=to_world, meta={**volume.meta, "frame": frame})


def write_volume(
    path: str | os.PathLike,
    values: np.ndarray,
    to_world: np.ndarray | None = None,
    *,
    metadata: Mapping[str, object] | None = None,
    compress: bool = True,
) -> None:
    """Write a volume, whole or not at all; the suffix chooses the format (:data:`GAUSSIAN_WRITERS`).

    Args:
        path: destination.
        values: real numbers (Z, Y, X) or (Z, Y, X, C); stored as float32.
        to_world: unit cube to world (4, 4); the identity if None. ``.vol`` holds axis-aligned boxes, ``.npy`` none.
        metadata: JSON-friendly facts, for ``.npz`` and ``.nrrd``; "space" names the frame ("RAS", "LPS").
        compress: ``.npz`` only; without it about ten times faster.

    Raises:
        MivolError: a suffix that is not known, values or a place that the format cannot hold, disk full.
    """
    path = Path(path)
    writer = (WRITERS if compress else STORED_WRITERS)[_suffix(path, WRITERS)]
    values = to_values(values, path)
    to_world = np.eye(4) if to_world is None else np.array(to_world, np.float64)
    check_frame(to_world, path)
    write_whole(path, lambda file: writer(file, values, to_world, dict(metadata or {})))


def _suffix(path: Path, table: Mapping[str, Any]) -> str:
    name = path.name.lower()
    for suffix in table:
        if name.endswith(suffix):
            return suffix
    raise refusal(path, f"the suffix {path.suffix!r}", f"one of {', '.join(table)}", "convert the file or correct its name")


def _foreign(path: Path, suffix: str, head: bytes) -> Exception:
    kind = FORMATS[suffix]
    for other, candidate in FORMATS.items():
        if candidate is not kind and candidate.recognise(head):
            return refusal(
                path,
                f"a {candidate.name} file (by its first bytes)",
                f"{kind.name} (by the suffix {suffix})",
                f"rename it to {other} or name another file",
            )
    return refusal(
        path,
        f"first bytes {head[:8]!r}",
        f"those of {kind.name} (by the suffix {suffix})",
        "the file is damaged or of another kind: name another one",
    )
