"""Legacy VTK (``.vtk``): a text header, then ``STRUCTURED_POINTS`` arrays as text or big-endian bytes, x fastest.

Conventions. ``ORIGIN`` is the first point; point arrays give voxel centres, cell arrays (one fewer along each axis)
have theirs half a step in. Arrays are read in order: SCALARS, VECTORS, and the members of FIELD; what follows an array
that is not known is not read.

Reference: VTK file formats, docs.vtk.org, "Simple legacy formats".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import choose, refusal
from mivol.files.volume import VolumeData, as_values, frame_from_steps

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
    """A place in the file: lines of text, then runs of numbers."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at, self.binary = data, path, 0, False

    def line(self) -> list[str]:
        """Words of the next line that has any; [] at the end of the file."""
        while self.at < len(self.data):
            text, newline, _ = self.data[self.at : self.at + 4096].partition(b"\n")
            self.at += len(text) + len(newline)
            words = text.decode("ascii", errors="replace").split()
            if words:
                return words
        return []

    def take(self, kind: str, count: int) -> np.ndarray:
        """The next ``count`` numbers of a VTK type."""
        if kind.lower() not in TYPES:
            raise refusal(self.path, f"the type {kind}", f"one of {', '.join(TYPES)}", "convert it to float first")
        dtype = np.dtype(TYPES[kind.lower()])
        if not self.binary:
            return self._take_text(count)
        block = self.data[self.at : self.at + count * dtype.itemsize]
        self.at += len(block)
        return source.elements(block, dtype, count, self.path)

    def _take_text(self, count: int) -> np.ndarray:
        words = self.data[self.at :].split(None, count)
        self.at = len(self.data) - len(words[count]) if len(words) > count else len(self.data)
        return source.numbers(b" ".join(words[:count]), count, self.path)

    def skip_metadata(self) -> None:
        """Pass over lines up to the next blank one."""
        end = self.data.find(b"\n\n", self.at)
        self.at = len(self.data) if end < 0 else end + 2


def read_vtk(path: Path, dataset: str | None = None) -> VolumeData:
    """Read one array of a legacy ``.vtk``: ``dataset``, else the first.

    Raises:
        MivolError: another kind of data set, a key missing, a type that is not known, or a truncated array.
    """
    cursor = _Cursor(source.read_bytes(path), path)
    cursor.line()
    cursor.at = cursor.data.find(b"\n", cursor.at) + 1
    mode = " ".join(cursor.line()).upper()
    if mode not in ("ASCII", "BINARY"):
        raise refusal(path, f"the mode {mode[:40]!r}", "ASCII or BINARY in the third line", "write the file again")
    cursor.binary = mode == "BINARY"
    keys = _keys(cursor)
    cells = "CELL_DATA" in keys
    points = [int(number) for number in _floats(keys, path, "DIMENSIONS")]
    size = [max(number - 1, 0) for number in points] if cells else points
    count = size[0] * size[1] * size[2]
    promised = [int(number) for number in keys["CELL_DATA" if cells else "POINT_DATA"][:1]]
    if min(size) < 1 or promised != [count]:
        raise refusal(path, f"{promised} elements for DIMENSIONS {points}", f"{[count]}", "correct the header")
    arrays = _arrays(cursor, count, dataset)
    name = choose(path, next(iter(arrays), None) if dataset is None else dataset, list(arrays))
    steps = np.diag(_floats(keys, path, "SPACING", "ASPECT_RATIO"))
    origin = np.array(_floats(keys, path, "ORIGIN")) + steps.sum(axis=1) * (0.5 if cells else 0.0)
    meta = {"path": str(path), "format": "vtk", "dtype": str(arrays[name].dtype), "space": None, "dataset": name}
    values = as_values(arrays[name].reshape(*size[::-1], -1), path)
    return VolumeData(values, frame_from_steps(size, steps, origin), meta)


def _keys(cursor: _Cursor) -> dict[str, list[str]]:
    keys: dict[str, list[str]] = {}
    while not {"POINT_DATA", "CELL_DATA"} & keys.keys():
        words = cursor.line()
        if not words:
            raise refusal(
                cursor.path, "no POINT_DATA or CELL_DATA", "one in the header", "the file is truncated: copy it again"
            )
        keys[words[0].upper()] = words[1:]
    if [word.upper() for word in keys.get("DATASET", [])] != ["STRUCTURED_POINTS"]:
        found = " ".join(keys.get("DATASET", ["none"]))
        raise refusal(cursor.path, f"the data set {found}", "STRUCTURED_POINTS", "resample it to an image first")
    return keys


def _floats(keys: dict[str, list[str]], path: Path, *names: str) -> list[float]:
    for name in names:
        if name in keys:
            try:
                values = [float(word) for word in keys[name]]
            except ValueError:
                values = []
            if len(values) != 3:
                raise refusal(path, f"'{name} {' '.join(keys[name])}'", "3 numbers", "correct the header")
            return values
    raise refusal(path, f"no {names[0]}", "one in the header", "correct the header")


def _arrays(cursor: _Cursor, count: int, wanted: str | None) -> dict[str, np.ndarray]:
    """Arrays by name (flat), up to the wanted one or the first."""
    arrays: dict[str, np.ndarray] = {}
    while not arrays or (wanted is not None and wanted not in arrays):
        words = cursor.line()
        key = words[0].upper() if words else ""
        if key == "SCALARS" and len(words) >= 3:
            table = cursor.at
            if (cursor.line() or [""])[0].upper() != "LOOKUP_TABLE":
                cursor.at = table
            arrays[words[1]] = cursor.take(words[2], count * (int(words[3]) if len(words) > 3 else 1))
        elif key in ("VECTORS", "NORMALS") and len(words) >= 3:
            arrays[words[1]] = cursor.take(words[2], count * 3)
        elif key == "FIELD" and len(words) == 3:
            for _ in range(int(words[2])):
                name, components, tuples, kind = (cursor.line() + [""] * 4)[:4]
                if name.upper() == "METADATA":
                    cursor.skip_metadata()
                    name, components, tuples, kind = (cursor.line() + [""] * 4)[:4]
                if tuples != str(count):
                    raise refusal(cursor.path, f"{tuples!r} tuples in {name!r}", f"{count}", "correct the header")
                arrays[name] = cursor.take(kind, count * int(components))
        elif key == "METADATA":
            cursor.skip_metadata()
        else:
            break
    return arrays
