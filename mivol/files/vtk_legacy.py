"""Legacy VTK (``.vtk``): a text header, then ``STRUCTURED_POINTS`` arrays as text or big-endian bytes, x fastest.

Own reader: meshio 5.3 turns images into meshes of hexahedra.

Conventions. ``ORIGIN`` is the first point. Point arrays give voxel centres; cell arrays (one element fewer along each axis)
have their centres half a step inside. Arrays are read in order: SCALARS, VECTORS, and the members of FIELD. Reading stops at
the first unknown array.

Reference: VTK file formats, docs.vtk.org, "Simple legacy formats".
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, to_values

MAGIC = b"# vtk DataFile"

TYPES: dict[str, str] = {
    "char": ">i1",
    "unsigned_char": ">u1",
    "short": ">i2",
    "unsigned_short": ">u2",
    "int": ">i4",
    "unsigned_int": ">u4",
    "long": ">i8",
    "unsigned_long": ">u8",
    "vtktypeint64": ">i8",
    "vtktypeuint64": ">u8",
    "float": ">f4",
    "double": ">f8",
}


class _Cursor:
    """A position in the file, which holds lines of text and runs of numbers."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at, self.binary = data, path, 0, False

    def line(self) -> list[str]:
        """Return the words of the next line that is not blank; [] at the end of the file."""
        while self.at < len(self.data):
            text, newline, _ = self.data[self.at : self.at + 4096].partition(b"\n")
            self.at += len(text) + len(newline)
            words = text.decode("ascii", errors="replace").split()
            if words:
                return words
        return []

    def take(self, kind: str, count: int) -> np.ndarray:
        """Return the next ``count`` numbers of a VTK type."""
        if kind.lower() not in TYPES:
            raise refusal(self.path, f"the type {kind}", f"one of {', '.join(TYPES)}", "convert it to float first")
        dtype = np.dtype(TYPES[kind.lower()])
        if not self.binary:
            return self._take_text(count)
        block = self.data[self.at : self.at + count * dtype.itemsize]
        self.at += len(block)
        return source.parse_elements(block, dtype, count, self.path)

    def _take_text(self, count: int) -> np.ndarray:
        words = self.data[self.at :].split(None, count)
        self.at = len(self.data) - len(words[count]) if len(words) > count else len(self.data)
        return source.parse_numbers(b" ".join(words[:count]), count, self.path)

    def skip_metadata(self) -> None:
        """Skip the lines up to the next blank line."""
        end = self.data.find(b"\n\n", self.at)
        self.at = len(self.data) if end < 0 else end + 2


def read_vtk(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array of a legacy ``.vtk``: ``dataset``, or the only array.

    Raises:
        MivolError: another kind of data set, a missing key, an unknown type, or a truncated array.
    """
    cursor = _Cursor(source.read_bytes(path), path)
    keys = _head(cursor)
    points = source.parse_integers(" ".join(keys.get("DIMENSIONS", [])), 3, path, "DIMENSIONS")
    arrays = _arrays(cursor, points)
    name = select_dataset(path, dataset, list(arrays))
    array, is_cell = arrays[name]
    size = [number - is_cell for number in points]
    steps = np.diag(_floats(keys, path, "SPACING", "ASPECT_RATIO"))
    origin = _floats(keys, path, "ORIGIN") + steps.sum(axis=1) * (0.5 if is_cell else 0.0)
    meta = {
        "path": str(path),
        "format": "vtk",
        "dtype": str(array.dtype),
        "space": None,
        "dataset": name,
        "centering": "cell" if is_cell else "point",
    }
    values = to_values(array.reshape(*size[::-1], -1), path)
    return VolumeData(values, frame_from_steps(size, steps, origin), meta)


def _head(cursor: _Cursor) -> dict[str, list[str]]:
    """The keys before the first section of arrays, where the cursor stops."""
    cursor.line()
    cursor.at = cursor.data.find(b"\n", cursor.at) + 1
    mode = " ".join(cursor.line()).upper()
    if mode not in ("ASCII", "BINARY"):
        raise refusal(cursor.path, f"the mode {mode[:40]!r}", "ASCII or BINARY in the third line", "write the file again")
    cursor.binary = mode == "BINARY"
    keys: dict[str, list[str]] = {}
    section = cursor.at
    while (words := cursor.line()) and words[0].upper() not in SECTIONS:
        keys[words[0].upper()] = words[1:]
        section = cursor.at
    if not words:
        raise refusal(cursor.path, "no POINT_DATA or CELL_DATA", "a section of arrays", "the file is truncated: copy it again")
    cursor.at = section
    found = " ".join(keys.get("DATASET", ["none"]))
    if found.upper() != "STRUCTURED_POINTS":
        raise refusal(cursor.path, f"the data set {found}", "STRUCTURED_POINTS", "resample it to an image first")
    return keys


def _floats(keys: dict[str, list[str]], path: Path, *names: str) -> np.ndarray:
    """The three numbers under the first existing key of ``names``."""
    name = next((name for name in names if name in keys), names[0])
    return source.parse_reals(" ".join(keys.get(name, [])), 3, path, name)


def _arrays(cursor: _Cursor, points: list[int]) -> dict[str, tuple[np.ndarray, bool]]:
    """name -> (flat numbers, whether on cells), from the cursor at a section to the first unknown word."""
    arrays: dict[str, tuple[np.ndarray, bool]] = {}
    while words := cursor.line():
        key = words[0].upper()
        if key in SECTIONS:
            is_cell = SECTIONS[key]
            size = [number - is_cell for number in points]
            count = size[0] * size[1] * size[2]
            if min(size) < 1 or words[1:] != [str(count)]:
                raise refusal(cursor.path, f"{' '.join(words)} for DIMENSIONS {points}", f"{key} {count}", "correct the header")
        elif key == "METADATA":
            cursor.skip_metadata()
        elif key in ARRAYS:
            for name, array in ARRAYS[key](cursor, words, count).items():
                arrays.setdefault(name, (array, is_cell))
        else:
            break
    return arrays


def _scalars(cursor: _Cursor, words: list[str], count: int) -> dict[str, np.ndarray]:
    name, kind, components = _words(cursor, [*words, "1"][1:4], 3)
    table = cursor.at
    if (cursor.line() or [""])[0].upper() != "LOOKUP_TABLE":
        cursor.at = table
    return {name: cursor.take(kind, count * _whole(cursor, components))}


def _vectors(cursor: _Cursor, words: list[str], count: int) -> dict[str, np.ndarray]:
    name, kind = _words(cursor, words[1:], 2)
    return {name: cursor.take(kind, count * 3)}


def _field(cursor: _Cursor, words: list[str], count: int) -> dict[str, np.ndarray]:
    arrays = {}
    for _ in range(_whole(cursor, words[-1])):
        line = cursor.line()
        if line[:1] == ["METADATA"]:
            cursor.skip_metadata()
            line = cursor.line()
        name, components, tuples, kind = _words(cursor, line, 4)
        if tuples != str(count):
            raise refusal(cursor.path, f"{tuples} tuples in {name!r}", f"{count}", "correct the header")
        arrays[name] = cursor.take(kind, count * _whole(cursor, components))
    return arrays


def _words(cursor: _Cursor, words: list[str], count: int) -> list[str]:
    if len(words) != count:
        raise refusal(cursor.path, f"the line {' '.join(words)!r}", f"{count} words", "write the file again")
    return words


def _whole(cursor: _Cursor, word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise refusal(cursor.path, f"{word!r}", "a whole number above 0", "write the file again")
    return int(word)


#: section of a file -> whether its arrays belong to cells.
SECTIONS: dict[str, bool] = {"POINT_DATA": False, "CELL_DATA": True}

#: first word of an array -> reader from cursor, words of the line and number of elements to flat numbers by name.
ARRAYS: dict[str, Callable[[_Cursor, list[str], int], dict[str, np.ndarray]]] = {
    "SCALARS": _scalars,
    "VECTORS": _vectors,
    "NORMALS": _vectors,
    "FIELD": _field,
}
