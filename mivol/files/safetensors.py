"""Arrays by name in the format of safetensors: weights of networks, without pickled code.

Own reader: the package safetensors 0.8 cannot read BF16 into NumPy.

A file is the length of its header (8 bytes, little endian), the header (JSON: name -> dtype, shape, first and last byte), and
the numbers.

Reference: the format's description at https://github.com/huggingface/safetensors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.atomic import write_whole
from mivol.files.source import check_file

__all__ = ["read_safetensors", "write_safetensors"]

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
