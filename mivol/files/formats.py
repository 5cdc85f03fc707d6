"""The table of volume formats, and the functions that read and write every format in it.

The suffix selects the format, and the first bytes must agree; DICOM is known by its contents, in folders and under any suffix.
A new format is a reader module and an entry in :data:`FORMATS` (and in :data:`WRITERS`); messages and docs read the tables. A
stack of headerless slices has no format: :func:`mivol.files.read_slices` reads it with facts from the caller.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.display import format_point
from mivol.errors import MivolError
from mivol.files import (
    dicom,
    hdf5,
    metaimage,
    mrc,
    netcdf,
    nifti,
    npy,
    nrrd,
    nvdb,
    raw,
    renderer_grids,
    tiff,
    vdb,
    vdb_writer,
    vtk,
    zarr,
)
from mivol.files.atomic import write_whole
from mivol.files.source import check_file, refusal, refuse_dataset
from mivol.files.volume import SparseVolumeData, VolumeData, check_frame, frame_from_steps, is_upright, to_values

#: Number of first bytes that identify a format.
HEAD = 4096


@dataclasses.dataclass(frozen=True)
class VolumeFormat:
    """A format of volume files.

    Attributes:
        name: name for people.
        recognise: test of the first ``HEAD`` bytes of a file.
        read: reader of a file; its second argument selects an array by name.
    """

    name: str
    recognise: Callable[[bytes], bool]
    read: Callable[[Path, str | None], VolumeData]


def _starts_with(magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


def _is_metaimage(head: bytes) -> bool:
    return re.search(rb"(?m)^\s*(NDims|DimSize|ObjectType)\s*=", head) is not None


_METAIMAGE = VolumeFormat("MetaImage", _is_metaimage, metaimage.read_metaimage)
_NRRD = VolumeFormat("NRRD", _starts_with(nrrd.MAGIC), nrrd.read_nrrd)
_HDF5 = VolumeFormat("HDF5", _starts_with(hdf5.MAGIC), hdf5.read_hdf5)
_NETCDF = VolumeFormat("NetCDF", netcdf.is_netcdf, netcdf.read_netcdf)
_MRC = VolumeFormat("MRC", mrc.is_mrc, mrc.read_mrc)
_DICOM = VolumeFormat("DICOM", dicom.is_dicom, dicom.read_dicom)
_TIFF = VolumeFormat("TIFF", tiff.is_tiff, tiff.read_tiff)
_ZARR = VolumeFormat("Zarr", lambda head: False, zarr.read_zarr)
_LES = VolumeFormat("LES cloud text", renderer_grids.is_les, renderer_grids.read_les)

#: suffix -> format; a longer suffix is tried first.
FORMATS: dict[str, VolumeFormat] = {
    ".vol": VolumeFormat("Mitsuba grid", _starts_with(renderer_grids.VOL_MAGIC), renderer_grids.read_vol),
    ".npy": VolumeFormat("NumPy array", _starts_with(npy.NPY_MAGIC), npy.read_npy),
    ".npz": VolumeFormat("NumPy archive", _starts_with(npy.NPZ_MAGIC), npy.read_npz),
    ".nrrd": _NRRD,
    ".nhdr": _NRRD,
    ".mhd": _METAIMAGE,
    ".mha": _METAIMAGE,
    ".nii": VolumeFormat("NIfTI", nifti.is_nifti, nifti.read_nifti),
    ".nii.gz": VolumeFormat("gzip-compressed NIfTI", nifti.is_nifti_gz, nifti.read_nifti),
    ".vti": VolumeFormat("VTK XML image", lambda head: b"<VTKFile" in head, vtk.read_vti),
    ".vtk": VolumeFormat("legacy VTK", _starts_with(vtk.MAGIC), vtk.read_vtk),
    ".vdb": VolumeFormat("OpenVDB", vdb.is_vdb, vdb.read_vdb),
    ".nvdb": VolumeFormat("NanoVDB", nvdb.is_nvdb, nvdb.read_nvdb),
    ".pbrt": VolumeFormat("pbrt volumegrid", renderer_grids.is_pbrt, renderer_grids.read_pbrt),
    ".csv": _LES,
    ".txt": _LES,
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".nc": _NETCDF,
    ".nc4": _NETCDF,
    ".cdf": _NETCDF,
    ".mrc": _MRC,
    ".map": _MRC,
    ".rec": _MRC,
    ".st": _MRC,
    ".ali": _MRC,
    ".dcm": _DICOM,
    ".mat": VolumeFormat("MATLAB", _starts_with(hdf5.MATLAB_MAGIC), hdf5.read_matlab),
    ".tif": _TIFF,
    ".tiff": _TIFF,
    ".zarr": _ZARR,
}

RAW_BYTES = "raw bytes"

#: name of a kind of file without a reader here -> (test of the first ``HEAD`` bytes, way out).
ARCHIVE, FILM = "a packed archive", "a video"
"""Files that phones export, which other verbs take or which have to be unpacked."""

UNREAD: dict[str, tuple[Callable[[bytes], bool], str]] = {
    "an MRC file": (mrc.is_mrc, "name it .mrc"),
    "a DICOM file": (dicom.is_dicom, "describe or convert it by mivol explain and mivol convert"),
    "a NetCDF file": (_starts_with(netcdf.CLASSIC[:3]), "name it .nc"),
    "a MATLAB file": (_starts_with(b"MATLAB"), "name it .mat"),
    "an HDF5 file": (_starts_with(hdf5.MAGIC), "name a volume .h5; explain and optimize find the data of a scan"),
    "a TIFF file": (tiff.is_tiff, "name it .tif, or the folder of a scan for explain and optimize"),
    "a file of a Zeiss (Xradia) scanner": (
        _starts_with(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"),
        "export projections, references and angles as TIFF and text, and name their folder",
    ),
    ARCHIVE: (
        lambda head: head.startswith((b"PK\x03\x04", b"7z\xbc\xaf", b"Rar!")) or head[257:262] == b"ustar",
        "unpack it, and name its folder",
    ),
    "a file compressed by gzip": (_starts_with(b"\x1f\x8b"), "unpack it (gunzip)"),
    "a FITS file": (_starts_with(b"SIMPLE  ="), "write its array as .npy (astropy.io.fits) or as TIFF"),
    FILM: (
        lambda head: (head[4:8] == b"ftyp" and head[8:11] != b"hei") or head.startswith((b"\x1aE\xdf\xa3", b"RIFF")),
        "mivol poses FILE finds the cameras of its frames",
    ),
    RAW_BYTES: (
        lambda head: b"\0" in head,
        "say size and type by --shape and --dtype (shape= and dtype= in Python), or in a file .nhdr, .mhd or .toml beside them",
    ),
}

#: suffix -> writer(file, values, to_world, metadata).
WRITERS: dict[str, Callable[[BinaryIO, np.ndarray, np.ndarray, dict[str, Any]], None]] = {
    ".vol": renderer_grids.write_vol,
    ".npy": npy.write_npy,
    ".npz": npy.write_npz,
    ".nrrd": nrrd.write_nrrd,
    ".vdb": vdb_writer.write_vdb,
    ".nvdb": vdb_writer.write_nvdb,
    ".mhd": metaimage.write_metaimage,
    ".mha": metaimage.write_metaimage,
    ".nii": nifti.write_nifti,
    ".vti": vtk.write_vti,
    ".mrc": mrc.write_mrc,
    ".tif": tiff.write_tiff,
    ".tiff": tiff.write_tiff,
}

#: suffix -> writer(path, values, to_world, metadata) of a folder.
FOLDER_WRITERS: dict[str, Callable[[Path, np.ndarray, np.ndarray, dict[str, Any]], None]] = {".zarr": zarr.write_zarr}

#: suffix -> writer without compression.
STORED_WRITERS = {**WRITERS, ".npz": npy.write_npz_stored}

#: name of a frame -> placement of the unit cube: as in the header, or the identity (as Mitsuba's gridvolume by default).
FRAMES: dict[str, Callable[[VolumeData], np.ndarray]] = {
    "file": lambda volume: volume.to_world,
    "unit": lambda volume: np.eye(4),
}


def read_volume(
    path: str | os.PathLike,
    dataset: str | None = None,
    *,
    frame: str = "file",
    shape: Sequence[int] | None = None,
    dtype: np.dtype | str | None = None,
) -> VolumeData:
    """Read a volume of any format in :data:`FORMATS`.

    Args:
        path: file; the suffix selects the format, and the first bytes must agree. The folder, or a file, of a DICOM series;
            a folder of TIFF slices, or a Zarr.
        dataset: name of the array in a file of several arrays (.npz, .vti, .vtk, .vdb, .nvdb, .h5, .nc, LES text); number or
            ``SeriesInstanceUID`` of a DICOM series; name of the slices, with "#" for numbers, in a folder of several kinds.
        frame: key of :data:`FRAMES`: "file" places the volume as in the header and refuses a degenerate box, "unit" puts the
            volume on the unit cube.
        shape, dtype: voxels (Z, Y, X) and type of raw bytes, which have no header. Raw bytes with a file .nhdr, .mhd or .toml
            beside them need neither.

    Returns:
        Values, placement and facts. NaN, Inf and negative numbers are kept; :func:`mivol.files.check_volume` refuses them.

    Raises:
        MivolError: a missing, empty, foreign, truncated or inconsistent file; an unknown suffix or type; a degenerate box.

    Example:
        >>> read_volume("tooth.nrrd").values.shape
        (161, 94, 103, 1)
    """
    path = Path(path)
    kind = _find_format(path, shape, dtype)
    return _read_placed(path, kind.read, dataset, frame)


def _read_placed(path: Path, read: Callable, dataset: str | None, frame: str) -> Any:
    """Read a volume by ``read``, and place it."""
    if frame not in FRAMES:
        raise refusal("read_volume", f"frame={frame!r}", f"one of {', '.join(FRAMES)}", "choose one")
    try:
        volume = read(path, dataset)
    except MemoryError as error:
        way_out = "crop or coarsen the volume, or correct its header"
        raise refusal(path, "more voxels than memory holds", "a smaller volume", way_out) from error
    to_world = FRAMES[frame](volume)
    check_frame(to_world, path)
    return dataclasses.replace(volume, to_world=to_world, meta={**volume.meta, "frame": frame})


SPARSE_READERS: dict[str, Callable[[Path, str | None], SparseVolumeData]] = {
    ".vdb": vdb.read_sparse_vdb,
    ".nvdb": nvdb.read_sparse_nvdb,
}
"""suffix -> reader of a format that is sparse itself."""


def is_sparse_file(path: str | os.PathLike) -> bool:
    """Whether the suffix of a file names a sparse format."""
    return str(path).lower().endswith(tuple(SPARSE_READERS))


def read_sparse_volume(path: str | os.PathLike, dataset: str | None = None, *, frame: str = "file") -> SparseVolumeData:
    """Read a volume in bricks of 8^3 voxels. A format that is sparse itself never makes a dense array.

    Args:
        path, dataset, frame: as of :func:`read_volume`.

    Returns:
        The bricks with a value other than 0, their placement and facts. Voxels elsewhere are 0.

    Raises:
        MivolError: as :func:`read_volume`.

    Example:
        >>> read_sparse_volume("smoke.vdb").values.shape
        (2844, 8, 8, 8, 1)
    """
    if not is_sparse_file(path):
        volume = read_volume(path, dataset, frame=frame)
        return dataclasses.replace(SparseVolumeData.from_dense(volume.values, volume.to_world), meta=volume.meta)
    path = Path(path)
    _find_format(path)
    return _read_placed(path, SPARSE_READERS[_find_suffix(path, SPARSE_READERS)], dataset, frame)


def write_volume(
    path: str | os.PathLike,
    values: np.ndarray | SparseVolumeData,
    to_world: np.ndarray | None = None,
    *,
    metadata: Mapping[str, object] | None = None,
    compress: bool = True,
) -> None:
    """Write a volume, whole or not at all; the suffix selects the format (:data:`WRITERS`).

    Args:
        path: destination.
        values: real numbers (Z, Y, X) or (Z, Y, X, C), stored as float32; or a sparse volume, which stays sparse in a
            ``.vdb`` and a ``.nvdb``.
        to_world: unit cube to world (4, 4), by default the identity, or the place of the sparse volume. A ``.vol``
            holds an axis-aligned box, a ``.mrc`` too, a ``.tif`` voxel sizes alone, a ``.npy`` no box.
        metadata: facts in the types of JSON, for ``.npz`` and ``.nrrd``; "space" names the frame ("RAS", "LPS") there and in
            ``.nii`` and ``.mha``, "unit" the unit of ``.nii``, ``.nrrd``, ``.tif`` and ``.zarr``.
        compress: whether a ``.npz`` is compressed; writing without compression is about ten times faster.

    Raises:
        MivolError: an unknown suffix, values or a placement outside the format, or a full disk.
    """
    path = Path(path)
    suffix = _find_suffix(path, WRITERS | FOLDER_WRITERS)
    if isinstance(values, SparseVolumeData):
        to_world = values.to_world if to_world is None else to_world
        values = values if suffix in SPARSE_READERS else values.dense()
    else:
        values = to_values(values, path)
    to_world = np.eye(4) if to_world is None else np.array(to_world, np.float64)
    check_frame(to_world, path)
    if suffix in FOLDER_WRITERS:
        FOLDER_WRITERS[suffix](path, values, to_world, dict(metadata or {}))
        return
    writer = (WRITERS if compress else STORED_WRITERS)[suffix]
    write_whole(path, lambda file: writer(file, values, to_world, dict(metadata or {})))


GRID_WRITERS = {".vdb": vdb_writer.write_vdb_grids, ".nvdb": vdb_writer.write_nvdb_grids}
"""suffix -> writer of several grids in one file."""


def write_grids(path: str | os.PathLike, grids: Mapping[str, VolumeData | SparseVolumeData]) -> None:
    """Write named grids into one ``.vdb`` or ``.nvdb``, whole or not at all.

    Args:
        path: destination.
        grids: volumes of one or three channels by name, each at its own place and of its own resolution; at least one.

    Raises:
        MivolError: another suffix, no grid, or a volume that :func:`write_volume` refuses.

    Example:
        >>> write_grids("fire.vdb", {"density": soot, "temperature": heat})
    """
    path = Path(path)
    suffix = _find_suffix(path, GRID_WRITERS)
    if not grids:
        raise refusal(path, "no grid", "at least one", "give volumes by name")
    packed = {}
    for name, volume in grids.items():
        values = volume if isinstance(volume, SparseVolumeData) else to_values(volume.values, path)
        check_frame(volume.to_world, f"{path}, {name}")
        packed[name] = (vdb_writer.check_fog(values, {"grid": name}, suffix)[0], np.asarray(volume.to_world, np.float64))
    write_whole(path, lambda file: GRID_WRITERS[suffix](file, packed))


# -- Files of volumes alone ----------------------------------------------------------------------------------------------

SHARED_SUFFIXES = (".npy", ".npz", ".csv", ".txt")
"""Suffixes of volumes and of other contents: points, radiance fields, tables."""


VOLUME_SUFFIXES = tuple(suffix for suffix in FORMATS if suffix not in SHARED_SUFFIXES)
"""Suffixes of volumes alone."""


def is_volume(path: Path) -> bool:
    """Whether a suffix belongs to volumes alone, an ``.npy`` has three axes or more, a file of another suffix is DICOM or raw
    with a header, or a folder holds DICOM or TIFF.
    """
    if path.is_dir():
        return zarr.is_zarr(path) or _is_dicom_folder(path) or bool(tiff.group_images(path))
    if path.name.lower().endswith(VOLUME_SUFFIXES) or _is_nameless_dicom(path):
        return True
    if path.suffix.lower() == ".npy" and path.is_file():
        return npy.count_axes(path) > 2
    if not path.is_file() or path.name.lower().endswith(tuple(FORMATS)):
        return False
    return raw.find_header(path) is not None or bool(raw.read_layout(path))


LARGEST_DENSE = 1 << 28
"""Size of a sparse volume as a dense array [bytes] up to which its voxels are described one by one."""


GRID_NAMES = {".vdb": vdb.name_grids, ".nvdb": nvdb.name_grids}
"""suffix -> names of the grids of a file."""


def describe_volume(path: Path, dataset: str | None = None, **layout: Any) -> str:
    """Describe a volume in a few lines: size, values, place, and numbers that no medium takes.

    Without a name, each grid of a file of several grids is described; a grid that is no volume is named with the reason.

    Args:
        path, dataset: as of :func:`read_volume`.
        layout: ``shape`` and ``dtype`` of raw bytes.

    Raises:
        MivolError: as :func:`read_volume`.
    """
    is_sparse = is_sparse_file(path)
    if is_sparse and not layout and dataset is None and len(names := _name_grids(path)) > 1:
        return "\n".join(_describe_grid(path, name) for name in names)
    volume = read_sparse_volume(path, dataset) if is_sparse else read_volume(path, dataset, **layout)
    # Statistics of a large sparse volume count the voxels of its bricks, and 0 outside.
    is_whole = not is_sparse or volume.dense_bytes <= LARGEST_DENSE
    values = volume.dense() if is_sparse and is_whole else volume.values
    finite = np.isfinite(values)
    size = " x ".join(str(n) for n in volume.size)
    channels, voxels = values.shape[-1], math.prod(map(int, volume.size))
    memory = f"{voxels * channels * 4 / 2**20:.3g} MiB in memory"
    if is_sparse:
        memory += f", {volume.values.nbytes / 2**20:.3g} MiB in {len(volume.values)} bricks"
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ volume.to_world[:3].T
    is_turned = np.count_nonzero(volume.to_world[:3, :3]) > 3
    array = volume.meta.get("grid") or volume.meta.get("dataset")
    dtype = volume.meta.get("dtype", "float32")
    lines = [
        f"{path}: {_find_format(path, **layout).name}" + (f", array {array!r}" if array else ""),
        f"voxels (x, y, z): {size}, {channels} channel{'s' if channels > 1 else ''} of {dtype}, {memory}",
        f"box: {format_point(corners.min(axis=0))} to {format_point(corners.max(axis=0))}"
        + (" around the turned axes" if is_turned else "")
        + f"; voxel {format_point(volume.spacing)}"
        + (f" {volume.meta['unit']}" if volume.meta.get("unit") in tiff.METRES else ""),
    ]
    if finite.any():
        inside = values[finite]
        # Voxels outside of all bricks are 0.
        total = voxels * channels - np.count_nonzero(~finite)
        shares = f"mean {inside.sum(dtype=np.float64) / total:.4g}, {100 * (1 - np.count_nonzero(inside) / total):.3g} % are 0"
        low, high = (min(inside.min(), 0), max(inside.max(), 0)) if not is_whole else (inside.min(), inside.max())
        lines.append(f"values: {low:.4g} to {high:.4g}, {shares}")
        if negative := np.count_nonzero(inside < 0):
            lines.append(f"{negative} values are below 0: no extinction, albedo or emission takes them")
    if not finite.all():
        lines.append(f"{np.count_nonzero(~finite)} values are NaN or Inf: no medium takes them")
    return "\n".join([*lines, *(f"assumed: {note}" for note in volume.meta.get("notes", ()))])


def _name_grids(path: Path) -> list[str]:
    """The names of the grids of a sparse file."""
    _find_format(path)
    return GRID_NAMES[_find_suffix(path, GRID_NAMES)](path)


def _describe_grid(path: Path, name: str) -> str:
    """Describe one of several grids, or say why it is no volume."""
    try:
        return describe_volume(path, name)
    except MivolError as error:
        return str(error)


def convert_volume(source: Path, target: Path, dataset: str | None = None, **layout: Any) -> str:
    """Write a volume in another format; its values and place are kept.

    Args:
        source, target: files; a folder may be the source.
        dataset: as of :func:`read_volume`; without a name, a ``.vdb`` or ``.nvdb`` keeps all grids in another one.
        layout: ``shape`` and ``dtype`` of raw bytes.

    Returns:
        A line that describes the written file and what it does not hold, and a line for each assumption about the source.

    Raises:
        MivolError: as :func:`read_volume` and :func:`write_volume`.
    """
    suffix = _find_suffix(target, WRITERS | FOLDER_WRITERS)
    # Between two formats that are sparse themselves, no dense array is made.
    is_sparse = not layout and suffix in SPARSE_READERS and is_sparse_file(source)
    if is_sparse and dataset is None and len(names := _name_grids(source)) > 1:
        return _convert_grids(source, target, names)
    volume = read_sparse_volume(source, dataset) if is_sparse else read_volume(source, dataset, **layout)
    place, lost = _keep_place(suffix, volume)
    facts = {"space": volume.meta["space"]} if volume.meta.get("space") else {}
    if facts and suffix not in (".npz", ".nrrd", ".mhd", ".mha", ".nii"):
        lost.insert(0, f"the frame {facts.pop('space')}")
    unit = str(volume.meta.get("unit") or "")
    if suffix in (".nii", ".nrrd", ".tif", ".tiff", ".zarr", ".npz"):
        facts |= {"unit": unit} if unit else {}
        if suffix == ".nii" and unit in tiff.METRES and unit not in nifti.UNITS.values():
            lost.append(f"the unit {unit}")
    elif suffix == ".mrc" and unit in tiff.METRES:  # lengths in MRC are in angstrom
        place = np.diag([*[tiff.METRES[unit] / tiff.METRES["A"]] * 3, 1.0]) @ place
    elif unit in tiff.METRES:
        lost.append(f"the unit {unit}")
    if suffix in SPARSE_READERS and "grid" in volume.meta:
        facts["grid"] = str(volume.meta["grid"]).partition("[")[0]
    if np.dtype(str(volume.meta.get("dtype", "float32")).replace("text", "float32")).name in WIDE_TYPES:
        lost.append(f"{volume.meta['dtype']} (numbers are rounded to float32)")
    if volume.meta.get("class") == "level set":
        lost.append("the distances of the level set (its fog is written)")
    write_volume(target, volume if is_sparse else volume.values, place, metadata=facts)
    size = " x ".join(str(n) for n in volume.size)
    line = f"{target}: {size} voxels" + (f"; {suffix} does not hold {' and '.join(lost)}" if lost else "")
    return "\n".join([line, *(f"assumed: {note}" for note in volume.meta.get("notes", ()))])


def _convert_grids(source: Path, target: Path, names: Sequence[str]) -> str:
    """Write all grids of a file; a line says what is lost, and a line for each grid that is no volume why it is left out."""
    grids, left_out = {}, []
    for name in names:
        try:
            grids[name] = read_sparse_volume(source, name)
        except MivolError as error:
            left_out.append(error)
    if not grids:
        raise left_out[0]
    write_grids(target, grids)
    lost = [f"{' and '.join(found)} of {name}" for name, grid in grids.items() if (found := _name_losses(grid))]
    line = f"{target}: {', '.join(grids)}" + (f"; {target.suffix} does not hold {', '.join(lost)}" if lost else "")
    return "\n".join([line, *(f"left out: {error}" for error in left_out)])


def _name_losses(volume: VolumeData | SparseVolumeData) -> list[str]:
    """Names of what reading a volume has changed."""
    lost = []
    if np.dtype(str(volume.meta["dtype"]).replace("text", "float32")).name in WIDE_TYPES:
        lost.append(f"{volume.meta['dtype']} (numbers are rounded to float32)")
    if volume.meta.get("class") == "level set":
        lost.append("the distances of the level set (its fog is written)")
    return lost


WIDE_TYPES = ("float64", "int32", "uint32", "int64", "uint64")
"""Types of numbers on disk that float32 does not hold exactly."""


def _keep_place(suffix: str, volume: VolumeData | SparseVolumeData) -> tuple[np.ndarray, list[str]]:
    """The part of a placement that a format holds, and names of the lost parts."""
    place, lost = volume.to_world, []
    if suffix not in (".npy", ".mrc", ".tif", ".tiff") or np.array_equal(place, np.eye(4)):
        return place, lost
    if suffix == ".npy":
        return np.eye(4), ["the place"]
    steps, origin = volume.steps, volume.origin
    if not is_upright(steps):
        lost.append("the directions of the axes")
    if suffix != ".mrc" and not np.allclose(origin, 0, atol=1e-9 * volume.spacing.max()):
        lost.append("the origin")
    return frame_from_steps(volume.size, np.diag(volume.spacing), origin if suffix == ".mrc" else np.zeros(3)), lost


def check_has_reader(path: Path) -> None:
    """Refuse binary data whose suffix is neither in :data:`FORMATS` nor a suffix of scenes or experiments.

    Raises:
        MivolError: as :func:`refuse_unread`.
    """
    is_known = path.name.lower().endswith((*FORMATS, ".xml", ".toml")) or not path.is_file()
    if not is_known and _find_unread(path) is not None:
        raise refuse_unread(path)


def refuse_unread(path: Path) -> MivolError:
    """Return the error that names the contents of a file without a reader, the volumes that are read, and a way out."""
    found = _find_unread(path)
    suffix = f"the suffix {path.suffix!r}"
    if found is None:
        return refusal(path, suffix, f"one of {', '.join(FORMATS)}", "convert the file or correct its name")
    expected = "a folder of photographs or a model" if found in (ARCHIVE, FILM) else f"a volume of {', '.join(FORMATS)}"
    return refusal(path, f"{found} with {suffix}", expected, UNREAD[found][1])


def _find_format(path: Path, shape: Sequence[int] | None = None, dtype: np.dtype | str | None = None) -> VolumeFormat:
    """The format of a folder, of DICOM or raw bytes with any other suffix, or of a suffix with which the first bytes agree."""
    if shape is not None or dtype is not None:
        return _raw_format(check_file(path), shape, dtype)
    if zarr.is_zarr(path):
        return _ZARR
    if path.is_dir() and _is_dicom_folder(path):
        return _DICOM
    if path.is_dir() and tiff.group_images(path):
        return _TIFF
    check_file(path)
    if not path.name.lower().endswith(tuple(FORMATS)):
        if _is_nameless_dicom(path):
            return _DICOM
        if header := raw.find_header(path):
            named = FORMATS[header.suffix]
            return VolumeFormat(f"raw bytes by {header.name}", named.recognise, lambda _, dataset: named.read(header, dataset))
        if layout := raw.read_layout(path):
            return VolumeFormat("raw bytes by a TOML file", lambda _: True, lambda file, _: raw.read_raw(file, **layout))
        raise refuse_unread(path)
    suffix = _find_suffix(path, FORMATS)
    head = _read_head(path)
    if not FORMATS[suffix].recognise(head):
        raise _wrong_format(path, suffix, head)
    return FORMATS[suffix]


def _raw_format(path: Path, shape: Sequence[int] | None, dtype: np.dtype | str | None) -> VolumeFormat:
    if path.name.lower().endswith(tuple(FORMATS)):
        name = FORMATS[_find_suffix(path, FORMATS)].name
        raise refusal(path, f"shape or dtype for {name}", "raw bytes without a header", "leave them out")
    if shape is None or dtype is None:
        raise refusal(path, "only one of shape and dtype", "both", 'add the other, as shape "64,64,64" and dtype "uint16"')

    def read(path: Path, dataset: str | None) -> VolumeData:
        refuse_dataset(path, dataset)
        return raw.read_raw(path, shape, dtype)

    return VolumeFormat("raw bytes", lambda head: True, read)


def _is_dicom_folder(path: Path) -> bool:
    return any(True for _ in dicom.find_dicom(path))


def _is_nameless_dicom(path: Path) -> bool:
    """Whether a file with a suffix of no other format is DICOM: scanners write names such as IM0001."""
    return not path.name.lower().endswith(tuple(FORMATS)) and path.is_file() and dicom.is_dicom(_read_head(path))


def _read_head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD)


def _find_unread(path: Path) -> str | None:
    if path.suffix.lower() in raw.SUFFIXES:
        return RAW_BYTES
    if path.name.lower().endswith((".tar.gz", ".tgz")):
        return ARCHIVE
    head = _read_head(path)
    return next((name for name, (recognise, _) in UNREAD.items() if recognise(head)), None)


def _find_suffix(path: Path, table: Mapping[str, Any]) -> str:
    name = path.name.lower()
    for suffix in table:
        if name.endswith(suffix):
            return suffix
    raise refusal(path, f"the suffix {path.suffix!r}", f"one of {', '.join(table)}", "convert the file or correct its name")


def _wrong_format(path: Path, suffix: str, head: bytes) -> Exception:
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
        f"the first bytes of {kind.name} (by the suffix {suffix})",
        "the file is damaged or has another format: name another file",
    )
