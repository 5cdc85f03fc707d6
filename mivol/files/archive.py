"""The one way in which archives of NumPy arrays (``.npz``) are opened: what they would take is counted before it is taken.

Conventions. An archive is a ZIP of ``.npy`` members. Only numbers, truth values and text are read, never Python objects. The
size of each array follows from its header and must be that of its member; all of them must fit into the memory that is free.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.machine import available_memory

__all__ = ["DAMAGE", "check_memory", "read_archive"]

KINDS = "biufU"
"""Kinds of NumPy types that are read: truth values, whole and real numbers, text."""

DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, EOFError, SyntaxError, NotImplementedError, RecursionError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, RuntimeError, UnicodeError, OSError),
)
"""What the parsers of ZIP and of array headers raise on bytes that are not theirs."""


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive, by name.

    Raises:
        FileNotFoundError: there is no such file.
        MivolError: no whole archive, arrays of objects, sizes that contradict each other, or more than the free memory holds.
    """
    try:
        with path.open("rb") as file:
            if file.read(6) == b"\x93NUMPY":
                raise refusal(path, "one array (.npy)", "an archive of arrays (.npz)", "rename the file to .npy")
            with zipfile.ZipFile(file) as archive:
                members = {one.filename.removesuffix(".npy"): one for one in archive.infolist() if not one.is_dir()}
                check_memory(path, sum(one.file_size for one in members.values()))
                return {name: _array(path, archive, name, one) for name, one in members.items()}
    except (MivolError, FileNotFoundError):
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split()).rstrip(".")[:200] or type(error).__name__
        raise refusal(path, f"a damaged archive ({reason})", "a whole .npz", "write or copy it again") from error


def check_memory(path: Path, size: int) -> None:
    """Refuse what would not fit into the free memory.

    Raises:
        MivolError: with both sizes.
    """
    free = available_memory()
    if free is not None and size > free:
        raise refusal(
            path, f"arrays of {size / 2**30:.1f} GiB", f"at most the free memory, {free / 2**30:.1f} GiB", "free some"
        )


def _array(path: Path, archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        shape, order, dtype, header = _header(file)
        found = f"an array {name[:80]!r} of type {dtype}"
        if dtype.kind not in KINDS:
            found = f"Python objects in {name[:80]!r}" if dtype.hasobject else found
            raise refusal(path, found, "numbers, truth values or text", "convert it, and save again")
        size = math.prod(shape) * dtype.itemsize
        if header + size != member.file_size or any(n < 0 for n in shape):
            said = f"{found} and shape {shape} in {member.file_size} bytes"
            raise refusal(path, said, f"{header + size} bytes", "write the file again")
        values = np.frombuffer(file.read(size), dtype)
    return values.reshape(shape, order="F" if order else "C").copy()


def _header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, whether columns come first, type, and the bytes that the header takes."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"version {version} of an array header")
    shape, order, dtype = read[version](file, max_header_size=10000)
    return shape, order, dtype, file.tell()
