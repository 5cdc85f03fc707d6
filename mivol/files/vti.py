"""VTK's XML image (``.vti``): arrays on a regular grid, x fastest after the component; text, base64 or raw bytes.

Own reader: the vtk toolkit reads this format, but no small library; meshio 5.3 does not.

Conventions. ``Origin`` is the point of index (0, 0, 0); the first point of the piece is ``Direction`` times spacing times the
start of the extent away. Point arrays give voxel centres. Cell arrays have one element fewer along each axis, and their centres
are half a step inside. A block starts with its length (``header_type``), a compressed block with the number of blocks, the
block size, the size of the last block and the packed sizes.

Reference: VTK file formats, docs.vtk.org, "XML file formats".
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
