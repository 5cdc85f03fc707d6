"""Arrays in files: NumPy's ``.npy`` (one array) and ``.npz`` (arrays by name, with placement), and ``.safetensors``.

Own checks before NumPy's reader, which allocates whatever an archive claims.

Conventions. Grids are (Z, Y, X) or (Z, Y, X, C). A ``.npz`` of mivol holds ``values`` (float32), ``to_world`` (float64, 4x4)
and ``metadata`` (a 0-d string of JSON). Any other ``.npz`` is read by the name of an array and placed on the unit cube. Only
numbers, truth values and text are read, never Python objects. :func:`read_archive` compares the
size of each array in its header with the size of the member, and the sum of the sizes with the free memory.

A file of safetensors holds weights of networks, without pickled code: the length of its header (8 bytes, little endian), the
header (JSON: name -> dtype, shape, first and last byte), and the numbers. Own reader: the package safetensors 0.8 cannot read
BF16 into NumPy. Reference: https://github.com/huggingface/safetensors.
"""

from __future__ import annotations

import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.errors import MivolError
from mivol.files.atomic import write_whole
from mivol.files.source import check_file, refusal, refuse_dataset, select_dataset
from mivol.files.volume import VolumeData, to_values
from mivol.machine import available_memory

__all__ = [
    "DAMAGE",
    "KINDS",
    "NPY_MAGIC",
    "NPZ_MAGIC",
    "NUMBER_TYPES",
    "check_arrays",
    "check_memory",
    "count_axes",
    "read_archive",
    "read_npy",
    "read_npz",
    "read_safetensors",
    "write_npy",
    "write_npz",
    "write_npz_stored",
    "write_safetensors",
]

NPY_MAGIC = b"\x93NUMPY"
NPZ_MAGIC = b"PK\x03\x04"


def read_npy(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array, on the unit cube because the format stores no placement."""
    refuse_dataset(path, dataset)
    array = _load_array(path)
    return VolumeData(to_values(array, path), np.eye(4), _meta(path, "npy", array))


def read_npz(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array of an archive: ``dataset``, by default ``values`` or the only array of rank 3 or 4."""
    arrays = read_archive(path)
    grids = [name for name, array in arrays.items() if array.ndim in (3, 4)]
    name = select_dataset(path, "values" if dataset is None and "values" in grids else dataset, grids)
    meta = _meta(path, "npz", arrays[name]) | {"dataset": name}
    to_world = np.eye(4)
    if "to_world" in arrays:
        to_world = _frame(arrays["to_world"], path)
    if "metadata" in arrays:
        meta["metadata"] = _metadata(arrays["metadata"], path)
        meta |= {"space": meta["metadata"].get("space"), "unit": str(meta["metadata"].get("unit", ""))}
    return VolumeData(to_values(arrays[name], path), to_world, meta)


def write_npy(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write the values only.

    Raises:
        MivolError: a placement or metadata, which the format cannot hold.
    """
    if metadata or not np.array_equal(to_world, np.eye(4)):
        raise refusal("write_volume", "to_world or metadata for a .npy file", "the values only", "write .npz, or remove both")
    # numpy.save bypasses the file object (ndarray.tofile) and loses the error of the system when the disk is full.
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
    file.write(values.data)


def write_npz(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write ``values``, ``to_world`` and ``metadata`` (JSON), compressed."""
    np.savez_compressed(file, allow_pickle=False, values=values, to_world=to_world, metadata=np.array(json.dumps(metadata)))


def write_npz_stored(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a ``.npz`` without compression: larger, and about ten times faster than :func:`write_npz`."""
    np.savez(file, allow_pickle=False, values=values, to_world=to_world, metadata=np.array(json.dumps(metadata)))


def _load_array(path: Path) -> np.ndarray:
    """Load an array; every error of NumPy's parsers means a damaged file."""
    try:
        with path.open("rb") as file:
            return np.load(file, allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        if "allow_pickle=False" in reason:
            raise refusal(path, "Python objects", "numbers", "convert them to float32 and save again") from error
        way_out = "the file is truncated: copy or write it again"
        raise refusal(path, f"a damaged NumPy file ({reason})", "a complete file", way_out) from error


def _meta(path: Path, kind: str, array: np.ndarray) -> dict[str, Any]:
    return {"path": str(path), "format": kind, "dtype": str(array.dtype), "space": None}


def _frame(array: np.ndarray, path: Path) -> np.ndarray:
    if array.shape != (4, 4) or array.dtype.kind not in "iuf":
        raise refusal(
            path, f"to_world of shape {array.shape} and type {array.dtype}", "4x4 real numbers", "write the file again"
        )
    return array.astype(np.float64)


def _metadata(array: np.ndarray, path: Path) -> dict[str, Any]:
    try:
        metadata = json.loads(array.item() if array.ndim == 0 else "")
    except (TypeError, ValueError) as error:
        raise refusal(path, "metadata that is not JSON", "a 0-d string of JSON", "write the file again") from error
    if not isinstance(metadata, dict):
        raise refusal(path, "metadata that is not a JSON object", "an object", "write the file again")
    return metadata


KINDS = "biufU"
"""Allowed kinds of NumPy types: truth values, integers, real numbers and text."""

DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, EOFError, SyntaxError, NotImplementedError, RecursionError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, RuntimeError, UnicodeError, OSError),
)
"""Errors of the parsers of ZIP files and array headers for foreign bytes."""


def count_axes(path: Path) -> int:
    """Number of axes of an array; 0 for a damaged or foreign file."""
    with suppress(*DAMAGE), path.open("rb") as file:
        return len(_read_array_header(file)[0])
    return 0


def read_archive(path: Path, only: str | None = None) -> dict[str, np.ndarray]:
    """Read arrays of an archive by name: every array, or the named array if present.

    Raises:
        FileNotFoundError: a missing file.
        MivolError: a damaged archive, arrays of objects, contradictory sizes, or more data than the free memory holds.
    """
    try:
        with path.open("rb") as file:
            if file.read(6) == b"\x93NUMPY":
                raise refusal(path, "one array (.npy)", "an archive of arrays (.npz)", "rename the file to .npy")
            with zipfile.ZipFile(file) as archive:
                members = {m.filename.removesuffix(".npy"): m for m in archive.infolist() if not m.is_dir()}
                members = {name: member for name, member in members.items() if only in (None, name)}
                check_memory(path, sum(member.file_size for member in members.values()))
                return {name: _read_member(path, archive, name, member) for name, member in members.items()}
    except (MivolError, FileNotFoundError):
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split()).rstrip(".")[:200] or type(error).__name__
        raise refusal(path, f"a damaged archive ({reason})", "a complete .npz", "write or copy it again") from error


NUMBER_TYPES = {"f": "float", "i": "int", "u": "uint", "b": "bool", "U": "text"}
"""NumPy's kinds of types, in words."""


def check_arrays(name: str, arrays: dict[str, np.ndarray], expected: dict[str, tuple[str, tuple | None]]) -> None:
    """Check types, shapes and numbers of arrays.

    Args:
        name: file name, for error messages.
        arrays: contents of an archive; only arrays in ``expected`` are checked, and they may be missing.
        expected: array -> allowed kinds of NumPy types, and its shape; None allows any shape.

    Raises:
        MivolError: another type or shape, or values that are not finite.
    """
    for key, (kinds, shape) in expected.items():
        array = arrays.get(key)
        if array is None:
            continue
        if array.dtype.kind not in kinds or (shape is not None and array.shape != shape):
            wanted = " or ".join(NUMBER_TYPES[kind] for kind in kinds) + ("" if shape is None else f" and shape {shape}")
            found = f"{key} of type {array.dtype} and shape {array.shape}"
            raise MivolError(f"{name} holds {found}; type {wanted} is expected: write it again.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise MivolError(
                f"{name} holds {key} with values that are not finite; finite numbers are expected: write it again."
            )


def check_memory(path: Path, size: int) -> None:
    """Refuse arrays larger than the free memory.

    Raises:
        MivolError: states both sizes.
    """
    free = available_memory()
    if free is not None and size > free:
        expected = f"at most the free memory, {free / 2**30:.1f} GiB"
        raise refusal(path, f"arrays of {size / 2**30:.1f} GiB", expected, "free some memory")


def _read_member(path: Path, archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        shape, order, dtype, header = _read_array_header(file)
        found = f"an array {name[:80]!r} of type {dtype}"
        if dtype.kind not in KINDS:
            found = f"Python objects in {name[:80]!r}" if dtype.hasobject else found
            raise refusal(path, found, "numbers, truth values or text", "convert it, and save again")
        size = math.prod(shape) * dtype.itemsize
        if header + size != member.file_size or any(n < 0 for n in shape):
            found += f" and shape {shape} in {member.file_size} bytes"
            raise refusal(path, found, f"{header + size} bytes", "write the file again")
        values = np.frombuffer(file.read(size), dtype)
    return values.reshape(shape, order="F" if order else "C").copy()


def _read_array_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, Fortran order, type, and length of the header [byte]."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version} of an array header")
    shape, order, dtype = readers[version](file, max_header_size=10000)
    return shape, order, dtype, file.tell()


# -- Safetensors -------------------------------------------------------------------------------------------------------

TYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "|u1"}
"""NumPy types of the format's words; BF16 is the upper half of a float32."""

LARGEST_HEADER = 100_000_000
"""Bytes; the format's own limit."""


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file; BF16 as float32.

    Raises:
        MivolError: no such file, a header that is none, or arrays that lie outside of the file or have an unknown type.
    """
    data = check_file(path).read_bytes()
    length = int.from_bytes(data[:8], "little") if len(data) >= 8 else LARGEST_HEADER
    try:
        if length > min(LARGEST_HEADER, len(data) - 8):
            raise ValueError
        header = json.loads(data[8 : 8 + length])
        header.pop("__metadata__", None)
        entries = {name: (v["dtype"], tuple(map(int, v["shape"])), *v["data_offsets"]) for name, v in header.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise MivolError(f"{path} has no header of safetensors: export the weights again, or give an .npz.") from None
    return {name: _read_array(path, name, entry, data[8 + length :]) for name, entry in entries.items()}


def _read_array(path: Path, name: str, entry: tuple, numbers: bytes) -> np.ndarray:
    kind, shape, first, last = entry
    if kind not in (*TYPES, "BF16"):
        raise MivolError(f"{path} has {name} of the type {kind}; {', '.join(TYPES)} or BF16 is expected: export it as F32.")
    size = 2 if kind == "BF16" else np.dtype(TYPES[kind]).itemsize
    if not (0 <= first <= last <= len(numbers) and last - first == size * math.prod(shape)):
        raise MivolError(
            f"{path} has {name} in bytes {first} to {last} of {len(numbers)}, against its shape {shape}: export it again."
        )
    if kind == "BF16":
        upper = np.frombuffer(numbers[first:last], "<u2").astype(np.uint32) << 16
        return upper.view(np.float32).reshape(shape)
    return np.frombuffer(numbers[first:last], TYPES[kind]).reshape(shape)


def write_safetensors(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write float32 arrays by name."""
    header, parts, first = {}, [], 0
    for name, array in arrays.items():
        part = np.ascontiguousarray(array, "<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(np.shape(array)), "data_offsets": [first, first + len(part)]}
        parts.append(part)
        first += len(part)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)  # the numbers begin at a multiple of 8 bytes
    write_whole(path, lambda file: file.write(b"".join([len(text).to_bytes(8, "little"), text, *parts])))
