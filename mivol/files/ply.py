"""Stanford's ``.ply`` as tables: the elements of a file by name, in binary of either byte order or in text.

Own reader: plyfile is under the GPL.

Conventions. Elements follow the order of the header. The size of an element is computed from the header and compared with the
size of the file before memory is allocated. Properties are single numbers. The length of an element with lists (faces) is
unknown, so this element and all later elements are skipped; ``read_ply`` of :mod:`mivol.files.mesh` reads triangles.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal

POSITION = ("x", "y", "z")
"""Properties with the position of a vertex."""

LONGEST_HEADER = 1 << 16
"""Longest header [byte]; headers of published files have about 2000 bytes."""

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"float64": "f8"},
}
"""Name of a type, old or new -> NumPy type."""

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass
class Element:
    """An element of the header: its properties as (name, type), and whether a property is a list."""

    name: str
    count: int
    properties: list[tuple[str, str]]
    has_lists: bool = False


def is_ply(head: bytes) -> bool:
    """Return whether the first bytes are the start of a ``.ply``."""
    return re.match(rb"ply\r?\n", head) is not None


def read_layout(path: str | os.PathLike) -> dict[str, tuple[str, ...]]:
    """Read the property names of every element from the header.

    Raises:
        MivolError: another format, or an endless or inconsistent header.
    """
    with source.check_file(path).open("rb") as file:
        head, _ = _split(file.read(LONGEST_HEADER), path)
    return {element.name: tuple(name for name, _ in element.properties) for element in _header(head, path)[1]}


def read_comments(path: str | os.PathLike) -> list[str]:
    """Read the comments of the header.

    Raises:
        MivolError: another format, or an endless header.
    """
    with source.check_file(path).open("rb") as file:
        head, _ = _split(file.read(LONGEST_HEADER), path)
    return [line.removeprefix("comment ") for line in head.splitlines() if line.startswith("comment ")]


def read_tables(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read all elements before the first element with lists.

    Returns:
        A structured array (count,) by name of the element, with a field per property in the types and the order of the file.

    Raises:
        MivolError: another format, an endless or inconsistent header, missing bytes, or surplus bytes after the last element.
    """
    data = source.read_bytes(path)
    head, body = _split(data, path)
    form, elements = _header(head, path)
    return _text_tables(body, elements, path) if form == "ascii" else _binary_tables(body, elements, ORDERS[form], path)


def read_vertices(path: str | os.PathLike) -> np.ndarray:
    """Read the table of vertices, which must have x, y and z.

    Raises:
        MivolError: errors of :func:`read_tables`, no vertices, or no positions.
    """
    vertex = read_tables(path).get("vertex")
    if vertex is None or any(name not in vertex.dtype.names for name in POSITION):
        raise refusal(path, "no x, y, z of vertices", "a cloud of points", "convert the file")
    return vertex


def vertex_positions(vertex: np.ndarray) -> np.ndarray:
    """Return the positions (N, 3) of a table of vertices."""
    return np.stack([vertex[name] for name in POSITION], axis=1)


def write_table(file: BinaryIO, table: np.ndarray, comment: str = "") -> None:
    """Write an element ``vertex`` in little-endian binary.

    Args:
        file: binary file.
        table: structured array (count,) with fields of float32 and unsigned bytes.
        comment: comment line of the header, or empty.
    """
    kinds = {"float32": "float", "uint8": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment {comment}"] if comment else []),
        f"element vertex {len(table)}",
    ]
    lines += [f"property {kinds[table.dtype[name].name]} {name}" for name in table.dtype.names]
    file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
    file.write(table.astype(table.dtype.newbyteorder("<"), copy=False).tobytes())


def _split(data: bytes, path: object) -> tuple[str, bytes]:
    """The header without its last line, and the bytes after the header."""
    if not is_ply(data):
        raise refusal(path, f"first bytes {data[:8]!r}", "the first bytes of a PLY", "name another file")
    end = re.compile(rb"^end_header\r?\n", re.MULTILINE).search(data, 0, LONGEST_HEADER)
    if end is None:
        raise refusal(path, f"no end_header in the first {LONGEST_HEADER} bytes", "end_header", "copy or write the file again")
    return data[: end.start()].decode("ascii", errors="replace"), data[end.end() :]


def _header(text: str, path: object) -> tuple[str, list[Element]]:
    """The format and the elements of a header."""
    form, elements = "", []
    for line in text.splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, "1.0"] if kind in ORDERS and not form:
                form = kind
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count, re.ASCII):
                elements.append(Element(name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind]))
            case _:
                raise refusal(path, f"the line '{line}' in the header", "a line of a PLY 1.0", "write the file again")
    if not form:
        raise refusal(path, "a header without a format", "the line 'format binary_little_endian 1.0'", "write the file again")
    _check_names(elements, path)
    return form, elements


def _check_names(elements: list[Element], path: object) -> None:
    for names, group in [([e.name for e in elements], "elements"), *(([p for p, _ in e.properties], e.name) for e in elements)]:
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise refusal(path, f"{twice!r} twice among the {group}", "each name once", "write the file again")
    empty = next((e.name for e in elements if not e.properties and not e.has_lists), None)
    if empty is not None:
        raise refusal(path, f"the element {empty!r} without properties", "at least one property", "write the file again")


def _binary_tables(body: bytes, elements: list[Element], order: str, path: object) -> dict[str, np.ndarray]:
    tables, at = {}, 0
    for element in elements:
        if element.has_lists:
            return tables
        dtype = np.dtype([(name, order + kind) for name, kind in element.properties])
        end = at + element.count * dtype.itemsize
        _check_size(f"{len(body)} bytes", len(body) - end, f"{end} for {element.count} of {element.name!r}", path)
        tables[element.name] = np.frombuffer(body, dtype, element.count, at)
        at = end
    if at < len(body):
        raise refusal(path, f"{len(body) - at} bytes after the last element", "no more", "copy or write the file again")
    return tables


def _text_tables(body: bytes, elements: list[Element], path: object) -> dict[str, np.ndarray]:
    """The tables of a text file. Numbers are parsed as float64, which holds integers of 32 bits exactly."""
    words, tables, at = body.split(), {}, 0
    for element in elements:
        if element.has_lists:
            return tables
        width = len(element.properties)
        end = at + element.count * width
        _check_size(f"{len(words)} numbers", len(words) - end, f"{end} for {element.count} of {element.name!r}", path)
        rows = source.parse_numbers(b" ".join(words[at:end]), end - at, path).reshape(element.count, width)
        table = np.empty(element.count, [(name, kind) for name, kind in element.properties])
        for column, (name, kind) in zip(rows.T, element.properties, strict=True):
            if kind[0] != "f" and not np.array_equal(column, column.astype(kind)):
                raise refusal(path, f"{name!r} outside of its type {kind}", "numbers of this type", "write the file again")
            table[name] = column
        tables[element.name], at = table, end
    if at < len(words):
        raise refusal(path, f"{len(words) - at} numbers after the last element", "no more", "copy or write the file again")
    return tables


def _check_size(found: str, surplus: int, expected: str, path: object) -> None:
    if surplus < 0:
        raise refusal(path, found, f"at least {expected}, from the header", "the file is truncated: copy it again")
