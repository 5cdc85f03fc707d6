"""Volumes of electron microscopes (MRC2014), read by the package mrcfile.

Conventions. Lengths are in angstrom. The position of the centre of the first voxel is the header's ``origin``; if that is 0, it
is ``nxstart, nystart, nzstart`` times the voxel size. Without a voxel size in the header, voxels become unit cubes, and a
note says so.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files.source import check_file, read_columns, refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_steps, is_upright, split_frame, to_values

#: Place of the word ``MAP`` in the header [byte].
MAGIC_OFFSET = 208


def is_mrc(head: bytes) -> bool:
    """Whether the first bytes are the header of an MRC file."""
    return head[MAGIC_OFFSET : MAGIC_OFFSET + 3] == b"MAP"


def read_mrc(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a volume or a stack of images; the axes of the header (``mapc, mapr, maps``) become (Z, Y, X).

    Raises:
        MivolError: no mrcfile, a damaged file, several volumes, axes that are no permutation, or numbers that are not real.
    """
    refuse_dataset(path, dataset)
    check_file(path)
    try:
        import mrcfile
    except ImportError as error:
        raise refusal(
            path, "an MRC file but no mrcfile", "an installed mrcfile", 'install it: pip install "mivol[lab]"'
        ) from error
    try:
        with mrcfile.open(path, mode="r") as file:
            header, stored, voxel = file.header.copy(), file.data.copy(), file.voxel_size.copy()
    except (ValueError, OverflowError) as error:
        raise refusal(path, f"a damaged MRC file ({error})", "a whole MRC file", "copy or write it again") from error
    if stored.ndim == 4:
        raise refusal(path, f"{len(stored)} volumes", "one volume", "write one of them to a file of its own")
    axes = [int(header[name]) for name in ("mapc", "mapr", "maps")]
    if sorted(axes) != [1, 2, 3]:
        raise refusal(path, f"the axes {axes}", "1, 2 and 3 in any order", "correct mapc, mapr and maps in the header")
    grid = stored.transpose([2 - axes.index(axis) for axis in (3, 2, 1)]) if stored.ndim == 3 else stored
    values = to_values(grid, path)
    spacing = np.array([voxel[name] for name in "xyz"], np.float64)
    has_spacing = bool(np.any(spacing))
    spacing = spacing if has_spacing else np.ones(3)
    origin = np.array([header.origin[name] for name in "xyz"], np.float64)
    if not origin.any():
        starts = [int(header[name]) for name in ("nxstart", "nystart", "nzstart")]
        origin = spacing * [starts[axes.index(axis)] for axis in (1, 2, 3)]
    meta = {
        "path": str(path),
        "format": "mrc",
        "dtype": str(stored.dtype),
        "space": None,
        "unit": "A" if has_spacing else "voxel",
        "notes": () if has_spacing else ("the header has a voxel size of 0: a voxel counts as 1.",),
    }
    return VolumeData(values, frame_from_steps(values.shape[2::-1], np.diag(spacing), origin), meta)


TILT_ANGLES = (".rawtlt", ".tlt", ".mdoc")
"""Suffixes of files with the angles of a tilt series, in the order in which they are taken."""


def find_tilt_angles(series: Path) -> Path | None:
    """The file of angles beside a tilt series: ``a.rawtlt``, ``a.tlt``, ``a.mdoc`` or ``a.mrc.mdoc`` of ``a.mrc``."""
    names = [f"{stem}{suffix}" for suffix in TILT_ANGLES for stem in (series.stem, series.name)]
    return next((series.parent / name for name in names if (series.parent / name).is_file()), None)


def read_tilt_angles(path: Path) -> np.ndarray:
    """Read the angles (views,) of a tilt series [degree]: a number a line, or ``TiltAngle`` in the sections of a ``.mdoc``.

    Raises:
        MivolError: no file, no angle, or text that is no number.
    """
    if path.suffix.lower() != ".mdoc":
        return read_columns(path, 1)[:, 0]
    text = check_file(path).read_text(encoding="utf-8", errors="replace")
    sections = re.findall(r"(?ms)^\[ZValue\s*=\s*(\d+)\](.*?)(?=^\[|\Z)", text)
    found = {int(number): re.search(r"(?m)^TiltAngle\s*=\s*(\S+)\s*$", body) for number, body in sections}
    try:
        angles = np.array([float(found[number].group(1)) for number in range(len(found))])
    except (KeyError, AttributeError, ValueError):
        angles = np.empty(0)
    if not len(angles) or not np.isfinite(angles).all():
        raise refusal(path, f"{len(sections)} sections ZValue", "a number TiltAngle in each, from 0 upwards", "correct it")
    return angles


def write_mrc(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write MRC2014 of float32 with the numbers of the placement as lengths; no package is needed.

    Raises:
        MivolError: several channels, or axes that are turned against the world's.
    """
    nz, ny, nx, channels = values.shape
    steps, origin = split_frame((nx, ny, nz), to_world)
    if channels > 1:
        raise refusal("write_volume", f"{channels} channels for an MRC file", "one", "write .nrrd, or one channel a file")
    if not is_upright(steps):
        raise refusal("write_volume", "turned axes for an MRC file", "axes of the world", "write .nrrd, or remove the place")
    head = bytearray(1024)
    struct.pack_into("<10i", head, 0, nx, ny, nz, 2, 0, 0, 0, nx, ny, nz)
    struct.pack_into("<6f", head, 40, *(np.diag(steps) * (nx, ny, nz)), 90, 90, 90)
    struct.pack_into("<3i", head, 64, 1, 2, 3)
    struct.pack_into("<3fi", head, 76, values.min(), values.max(), values.mean(dtype=np.float64), 1)
    struct.pack_into("<i", head, 108, 20141)
    struct.pack_into("<3f4s4B", head, 196, *origin, b"MAP ", 0x44, 0x44, 0, 0)
    struct.pack_into("<f", head, 216, values.std(dtype=np.float64))
    file.write(head)
    file.write(np.ascontiguousarray(values, "<f4").data)
