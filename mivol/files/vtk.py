"""VTK's regular grids, x fastest after the component: XML images (``.vti``), and legacy files (``.vtk``).

Own readers: the vtk toolkit reads these formats, but no small library. meshio 5.3 does not read the first, and turns images of
the second into meshes of hexahedra.

Conventions. Point arrays give voxel centres. Cell arrays have one element fewer along each axis, and their centres are half a
step inside.

XML. ``Origin`` is the point of index (0, 0, 0); the first point of the piece is ``Direction`` times spacing times the start of
the extent away. Numbers are text, base64 or raw bytes. A block starts with its length (``header_type``), a compressed block
with the number of blocks, the block size, the size of the last block and the packed sizes.

Legacy. A text header, then ``STRUCTURED_POINTS`` arrays as text or big-endian bytes. ``ORIGIN`` is the first point. Arrays are
read in order: SCALARS, VECTORS, and the members of FIELD. Reading stops at the first unknown array.

Reference: VTK file formats, docs.vtk.org, "XML file formats" and "Simple legacy formats".
"""

from __future__ import annotations

import base64
import binascii
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, split_frame, to_values

TYPES: dict[str, str] = {
    "Int8": "i1",
    "UInt8": "u1",
    "Int16": "i2",
    "UInt16": "u2",
    "Int32": "i4",
    "UInt32": "u4",
    "Int64": "i8",
    "UInt64": "u8",
    "Float32": "f4",
    "Float64": "f8",
}

COMPRESSORS: dict[str, str] = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}

ORDERS: dict[str, str] = {"LittleEndian": "<", "BigEndian": ">"}

#: function from n to the next n decoded bytes of a block.
Take = Callable[[int], bytes]


def read_vti(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array of a ``.vti``: ``dataset``, by default the active scalars or the only array.

    Raises:
        MivolError: other data than an image, several pieces, an unknown compressor or type, or inconsistent sizes.
    """
    root, appended, encoding = _document(source.read_bytes(path), path)
    image = root.find("ImageData")
    if root.tag != "VTKFile" or root.get("type") != "ImageData" or image is None:
        raise refusal(path, f"VTK data of type {root.get('type')}", "ImageData", "convert it to an image first")
    pieces = image.findall("Piece")
    if len(pieces) != 1:
        raise refusal(path, f"{len(pieces)} pieces", "one piece", "write the file again in one piece")
    words = pieces[0].get("Extent") or image.get("WholeExtent", "")
    extent = np.array(source.parse_integers(words, 6, path, "Extent")).reshape(3, 2)
    node, is_cell = _array(pieces[0], dataset, path)
    size = (extent[:, 1] - extent[:, 0] + (0 if is_cell else 1)).tolist()
    if min(size) < 1:
        raise refusal(path, f"the extent {extent.ravel().tolist()}", "at least one voxel", "write the file again")
    (channels,) = source.parse_integers(node.get("NumberOfComponents", "1"), 1, path, "NumberOfComponents")
    if channels < 1:
        raise refusal(path, f"{channels} components", "at least 1", "write the file again")
    stored = _decode(node, root, appended, encoding, size[0] * size[1] * size[2] * channels, path)
    steps, origin = _place(image, extent[:, 0] + (0.5 if is_cell else 0.0), path)
    meta = {
        "path": str(path),
        "format": "vti",
        "dtype": str(stored.dtype),
        "space": None,
        "dataset": node.get("Name"),
        "centering": "cell" if is_cell else "point",
    }
    values = to_values(stored.reshape(*size[::-1], channels), path)
    return VolumeData(values, frame_from_steps(size, steps, origin), meta)


def write_vti(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write an array "values" of float32 at points, as appended raw bytes."""
    nz, ny, nx, channels = values.shape
    steps, origin = split_frame((nx, ny, nz), to_world)
    spacing = np.linalg.norm(steps, axis=0)
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    placed = f'Origin="{_words(origin)}" Spacing="{_words(spacing)}" Direction="{_words((steps / spacing).ravel())}"'
    head = (
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" {placed}>\n<Piece Extent="{extent}">\n<PointData Scalars="values">\n'
        f'<DataArray type="Float32" Name="values" NumberOfComponents="{channels}" format="appended" offset="0"/>\n'
        '</PointData>\n</Piece>\n</ImageData>\n<AppendedData encoding="raw">_'
    )
    file.write(head.encode() + np.array(values.nbytes, "<u8").tobytes())
    file.write(np.ascontiguousarray(values, "<f4").data)
    file.write(b"</AppendedData>\n</VTKFile>\n")


def _words(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _document(data: bytes, path: Path) -> tuple[ElementTree.Element, bytes, str]:
    """The XML without the appended data (raw bytes are not XML), the data after its underscore, and the encoding."""
    appended, encoding = b"", "raw"
    tag = re.search(rb"<AppendedData([^>]*)>\s*_", data)
    if tag:
        attribute = re.search(rb"encoding\s*=\s*[\"'](\w+)[\"']", tag.group(1))
        encoding = attribute.group(1).decode() if attribute else "raw"
        appended, data = data[tag.end() :], data[: tag.start()] + b"</VTKFile>"
    try:
        return ElementTree.fromstring(data), appended, encoding
    except ElementTree.ParseError as error:
        way_out = "the file is truncated: copy it again"
        raise refusal(path, f"broken XML ({error})", "a complete VTKFile element", way_out) from error


def _array(piece: ElementTree.Element, dataset: str | None, path: Path) -> tuple[ElementTree.Element, bool]:
    """The element of the array, and whether the array belongs to cells."""
    arrays: dict[str, tuple[ElementTree.Element, bool]] = {}
    active = None
    for kind in ("PointData", "CellData"):
        for group in piece.findall(kind):
            active = active or group.get("Scalars")
            for node in group.findall("DataArray"):
                arrays.setdefault(node.get("Name", ""), (node, kind == "CellData"))
    return arrays[select_dataset(path, active if dataset is None and active in arrays else dataset, list(arrays))]


def _place(image: ElementTree.Element, first: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    spacing = source.parse_reals(image.get("Spacing", "1 1 1"), 3, path, "Spacing")
    origin = source.parse_reals(image.get("Origin", "0 0 0"), 3, path, "Origin")
    direction = source.parse_reals(image.get("Direction", "1 0 0 0 1 0 0 0 1"), 9, path, "Direction")
    steps = direction.reshape(3, 3) * spacing
    return steps, origin + steps @ first


def _decode(
    node: ElementTree.Element, root: ElementTree.Element, appended: bytes, encoding: str, count: int, path: Path
) -> np.ndarray:
    order = ORDERS.get(root.get("byte_order", "LittleEndian"))
    if node.get("type") not in TYPES or order is None:
        raise refusal(
            path,
            f"type {node.get('type')} in byte order {root.get('byte_order')}",
            "a number type, little or big endian",
            "write the file again with Float32",
        )
    dtype = np.dtype(TYPES[node.get("type")]).newbyteorder(order)
    kind = node.get("format")
    if kind == "ascii":
        return source.parse_numbers(node.text or "", count, path).astype(dtype)
    if kind == "binary":
        stream, coded = "".join((node.text or "").split()).encode(), "base64"
    elif kind == "appended":
        (offset,) = source.parse_integers(node.get("offset", ""), 1, path, "offset")
        stream, coded = appended[max(offset, 0) :], encoding
    else:
        raise refusal(path, f"the format {kind!r}", "ascii, binary or appended", "write the file again")
    if coded not in STREAMS:
        raise refusal(path, f"the encoding {coded!r}", " or ".join(STREAMS), "write the file again")
    header_type = root.get("header_type", "UInt32")
    if header_type not in HEADER_TYPES:
        raise refusal(path, f"the header_type {header_type}", " or ".join(HEADER_TYPES), "write the file again")
    word = np.dtype(HEADER_TYPES[header_type]).newbyteorder(order)
    block = _block(STREAMS[coded](stream, path), word, root.get("compressor"), count * dtype.itemsize, path)
    return source.parse_elements(block, dtype, count, path)


def _block(take: Take, word: np.dtype, compressor: str | None, promised: int, path: Path) -> bytes:
    """The bytes of an array, behind its length or its table of packed blocks."""

    def words(n: int) -> list[int]:
        return np.frombuffer(take(n * word.itemsize), word).tolist()

    if not compressor:
        (length,) = words(1)
        if length != promised:
            raise refusal(path, f"a block of {length} bytes", f"{promised} (from the extent)", "write the file again")
        return take(length)
    if compressor not in COMPRESSORS:
        raise refusal(path, f"the compressor {compressor}", " or ".join(COMPRESSORS), "write it again with zlib")
    blocks, size, last = words(3)
    if not blocks:
        return b""
    if (blocks - 1) * size + (last or size) != promised:
        found = f"{blocks} blocks of {size} bytes with {last} in the last"
        raise refusal(path, found, f"{promised} bytes (from the extent)", "write the file again")
    packed = words(blocks)
    codec = COMPRESSORS[compressor]
    return b"".join(source.decompress(take(length), codec, size, path) for length in packed)


def _broken(path: Path) -> Exception:
    return refusal(path, "a block that breaks off", "all of its bytes", "the file is truncated: copy it again")


def _raw(stream: bytes, path: Path) -> Take:
    position = 0

    def take(count: int) -> bytes:
        nonlocal position
        if position + count > len(stream):
            raise _broken(path)
        position += count
        return stream[position - count : position]

    return take


def _base64(stream: bytes, path: Path) -> Take:
    """Decode base64 in whole groups of four characters.

    VTK encodes the length and the bytes of an uncompressed block in the same run, and the table of a compressed block in a
    separate run; other writers also pad the length. Padding ends a run: its group gives one or two bytes instead of three, so
    bytes of the next run are never read together with the previous run.
    """
    position, held = 0, b""

    def take(count: int) -> bytes:
        nonlocal position, held
        characters = -(-max(count - len(held), 0) // 3) * 4
        chunk = stream[position : position + characters]
        position += characters
        try:
            data = held + base64.b64decode(chunk, validate=True)
        except (binascii.Error, ValueError) as error:
            raise refusal(path, "characters that are not base64", "base64 data", "copy the file again") from error
        if len(data) < count:
            raise _broken(path)
        held = data[count:]
        return data[:count]

    return take


#: encoding -> constructor of a decoder.
STREAMS: dict[str, Callable[[bytes, Path], Take]] = {"raw": _raw, "base64": _base64}

#: type of block lengths -> NumPy type.
HEADER_TYPES: dict[str, str] = {"UInt32": "u4", "UInt64": "u8"}


# -- Legacy files ------------------------------------------------------------------------------------------------------

MAGIC = b"# vtk DataFile"

LEGACY_TYPES: dict[str, str] = {
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
        if kind.lower() not in LEGACY_TYPES:
            raise refusal(self.path, f"the type {kind}", f"one of {', '.join(LEGACY_TYPES)}", "convert it to float first")
        dtype = np.dtype(LEGACY_TYPES[kind.lower()])
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
    name, kind, components = _check_words(cursor, [*words, "1"][1:4], 3)
    table = cursor.at
    if (cursor.line() or [""])[0].upper() != "LOOKUP_TABLE":
        cursor.at = table
    return {name: cursor.take(kind, count * _whole(cursor, components))}


def _vectors(cursor: _Cursor, words: list[str], count: int) -> dict[str, np.ndarray]:
    name, kind = _check_words(cursor, words[1:], 2)
    return {name: cursor.take(kind, count * 3)}


def _field(cursor: _Cursor, words: list[str], count: int) -> dict[str, np.ndarray]:
    arrays = {}
    for _ in range(_whole(cursor, words[-1])):
        line = cursor.line()
        if line[:1] == ["METADATA"]:
            cursor.skip_metadata()
            line = cursor.line()
        name, components, tuples, kind = _check_words(cursor, line, 4)
        if tuples != str(count):
            raise refusal(cursor.path, f"{tuples} tuples in {name!r}", f"{count}", "correct the header")
        arrays[name] = cursor.take(kind, count * _whole(cursor, components))
    return arrays


def _check_words(cursor: _Cursor, words: list[str], count: int) -> list[str]:
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
