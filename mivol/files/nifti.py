"""NIfTI-1 and NIfTI-2 in one file (``.nii``, ``.nii.gz``): a binary header, then the numbers, x fastest.

Own reader: nibabel 5.4 (13 MB, 0.4 s to import) reads the test files, but accepts files longer than their header says, reads
complex numbers and names no sizes in its errors.

Conventions. The world frame is RAS (x to the right, y forwards, z up). The placement is the sform if its code is above 0, else
the qform (quaternion, pixdim, qfac), else the voxel sizes. Stored numbers are scaled by ``scl_slope`` and ``scl_inter`` unless
the slope is 0. One axis after the third may be longer than 1 and becomes the channels.

Reference: nifti.nimh.nih.gov, nifti1.h and nifti2.h.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_steps, split_frame, to_values, turn_frame

TYPES: dict[int, str] = {
    2: "u1",
    4: "i2",
    8: "i4",
    16: "f4",
    64: "f8",
    256: "i1",
    512: "u2",
    768: "u4",
    1024: "i8",
    1280: "u8",
    128: "3u1",
}

UNITS: dict[int, str] = {0: "unknown", 1: "m", 2: "mm", 3: "um"}


class Layout(NamedTuple):
    """The header of a version of the format.

    Attributes:
        size: length [byte], which is also the first number of the header.
        magic: magic bytes.
        magic_at: offset of the magic bytes [byte].
        fields: name -> (struct code, byte offset).
    """

    size: int
    magic: bytes
    magic_at: int
    fields: dict[str, tuple[str, int]]


#: length of the header -> layout.
LAYOUTS: dict[int, Layout] = {
    348: Layout(
        348,
        b"n+1\0",
        344,
        {
            "dim": ("8h", 40),
            "datatype": ("h", 70),
            "pixdim": ("8f", 76),
            "vox_offset": ("f", 108),
            "scale": ("2f", 112),
            "units": ("B", 123),
            "codes": ("2h", 252),
            "quaternion": ("6f", 256),
            "srow": ("12f", 280),
        },
    ),
    540: Layout(
        540,
        b"n+2\0",
        4,
        {
            "dim": ("8q", 16),
            "datatype": ("h", 12),
            "pixdim": ("8d", 104),
            "vox_offset": ("q", 168),
            "scale": ("2d", 176),
            "units": ("i", 500),
            "codes": ("2i", 344),
            "quaternion": ("6d", 352),
            "srow": ("12d", 400),
        },
    ),
}

#: Largest offset of the data [byte]. Extensions before the data are text, so a gigabyte means a damaged number.
LARGEST_OFFSET = 2**30


def is_nifti(head: bytes) -> bool:
    """Return whether the first bytes are a NIfTI header of either version and byte order."""
    return _layout(head) is not None


def is_nifti_gz(head: bytes) -> bool:
    """Return whether the first bytes are a NIfTI header in gzip."""
    return head[:2] == b"\x1f\x8b" and is_nifti(_peek(head))


def read_nifti(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a single-file NIfTI.

    Raises:
        MivolError: a truncated file, numbers that are not real, or several time steps.
    """
    refuse_dataset(path, dataset)
    data = source.read_bytes(path)
    head = _peek(data) if data[:2] == b"\x1f\x8b" else data
    layout, order = _layout(head)
    fields = {name: struct.unpack_from(order + code, head, at) for name, (code, at) in layout.fields.items()}
    size, extra = _sizes(fields["dim"], path)
    dtype, parts = _dtype(fields["datatype"][0], order, path)
    stored = _stored(data, fields["vox_offset"][0], layout.size, dtype, [parts, *size, extra], path)
    grid = stored.reshape(extra, *size[::-1], parts).transpose(1, 2, 3, 0, 4).reshape(*size[::-1], extra * parts)
    slope, intercept = fields["scale"]
    if np.isfinite(slope) and slope != 0 and (slope, intercept) != (1, 0) and parts == 1:
        grid = grid * np.float64(slope) + (intercept if np.isfinite(intercept) else 0.0)
    steps, origin, form = _place(fields)
    meta = {
        "path": str(path),
        "format": "nifti",
        "dtype": str(dtype),
        "space": "RAS",
        "place": form,
        "unit": UNITS.get(fields["units"][0] & 7, "unknown"),
    }
    return VolumeData(to_values(grid, path), frame_from_steps(size, steps, origin), meta)


def write_nifti(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write NIfTI-1 of float32 in RAS by an sform; a placement without ``metadata["space"]`` counts as RAS.

    Raises:
        MivolError: more than 32,767 voxels or channels along an axis.
    """
    *shape, channels = values.shape
    size = shape[::-1]
    if max(*size, channels) > np.iinfo(np.int16).max:
        raise refusal("write_volume", f"a size of {size}", "at most 32767 along an axis in NIfTI", "write .nrrd")
    steps, origin = split_frame(size, turn_frame(to_world, metadata.get("space"), "RAS"))
    unit = {name: code for code, name in UNITS.items()}.get(str(metadata.get("unit")), 0)
    layout = LAYOUTS[348]
    numbers = {
        "dim": (5 if channels > 1 else 3, *size, 1, channels, 1, 1),
        "datatype": (16,),
        "pixdim": (1.0, *np.linalg.norm(steps, axis=0), 1.0, 1.0, 1.0, 1.0),
        "vox_offset": (352.0,),
        "scale": (1.0, 0.0),
        "units": (unit,),
        "codes": (0, 1),
        "srow": tuple(np.column_stack([steps, origin]).ravel()),
    }
    head = bytearray(352)
    struct.pack_into("<i", head, 0, layout.size)
    struct.pack_into("<h", head, 72, 32)  # bits of a number
    struct.pack_into("4s", head, layout.magic_at, layout.magic)
    for name, value in numbers.items():
        code, at = layout.fields[name]
        struct.pack_into("<" + code, head, at, *value)
    file.write(head)
    file.write(np.ascontiguousarray(values.transpose(3, 0, 1, 2), "<f4").data)


def _stored(data: bytes, offset: float, header: int, dtype: np.dtype, shape: list[int], path: Path) -> np.ndarray:
    """The flat numbers of ``shape``, from ``offset`` or the end of the header, whichever comes later."""
    if not 0 <= offset <= LARGEST_OFFSET:
        raise refusal(path, f"vox_offset {offset}", f"0 to {LARGEST_OFFSET}", "correct the header")
    first, count = max(int(offset), header), math.prod(shape)
    if data[:2] == b"\x1f\x8b":
        data = source.decompress(data, "gzip", first + count * dtype.itemsize, path)
    return source.parse_elements(data, dtype, count, path, offset=first)


def _peek(data: bytes) -> bytes:
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, 544)
    except zlib.error:
        return b""


def _layout(head: bytes) -> tuple[Layout, str] | None:
    for order in "<>":
        layout = LAYOUTS.get(struct.unpack_from(order + "i", head)[0]) if len(head) >= 4 else None
        if layout and len(head) >= layout.size and head[layout.magic_at :].startswith(layout.magic):
            return layout, order
    return None


def _sizes(dim: tuple[int, ...], path: Path) -> tuple[list[int], int]:
    """Voxels along x, y, z, and the product of the other axes, at most one of them longer than 1."""
    rank = dim[0]
    sizes = [int(number) for number in dim[1 : rank + 1]] if 1 <= rank <= 7 else []
    sizes += [1] * (3 - len(sizes))
    if rank not in range(1, 8) or min(sizes) < 1 or sum(number > 1 for number in sizes[3:]) > 1:
        raise refusal(path, f"dim {list(dim)}", "3 sizes above 0 and at most one more axis", "extract one volume")
    return sizes[:3], math.prod(sizes[3:])


def _dtype(code: int, order: str, path: Path) -> tuple[np.dtype, int]:
    if code not in TYPES:
        raise refusal(path, f"datatype {code}", f"a real type ({', '.join(map(str, TYPES))})", "convert it to float32 first")
    return (np.dtype("u1"), 3) if TYPES[code] == "3u1" else (np.dtype(order + TYPES[code]), 1)


def _place(fields: dict[str, tuple]) -> tuple[np.ndarray, np.ndarray, str]:
    """Steps (3, 3), the centre of the first voxel (3,), and the name of their form."""
    pixdim = np.array(fields["pixdim"], np.float64)
    qform, sform = fields["codes"]
    if sform > 0:
        affine = np.array(fields["srow"], np.float64).reshape(3, 4)
        return affine[:, :3], affine[:, 3], "sform"
    if qform > 0:
        *quaternion, x, y, z = fields["quaternion"]
        spacing = pixdim[1:4] * (1, 1, -1 if pixdim[0] < 0 else 1)
        return rotation(*quaternion) * spacing, np.array([x, y, z], np.float64), "qform"
    return np.diag(pixdim[1:4]), np.zeros(3), "pixdim"


def rotation(b: float, c: float, d: float) -> np.ndarray:
    """Return the rotation (3, 3) of the unit quaternion (a, b, c, d), whose a >= 0 NIfTI does not store."""
    a = np.sqrt(max(0.0, 1 - (b * b + c * c + d * d)))
    return np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
