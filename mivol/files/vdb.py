"""OpenVDB (``.vdb``): named sparse grids, read into a dense box of voxels and written as fog volumes.

Own reader: ``tinyvdb`` 0.9 returns 21,005 of the 1,049,275 voxels of OpenVDB's sample smoke without an error, and OpenVDB
itself is not on PyPI.

Conventions. A grid is a tree: a root, two levels of inner nodes with 32^3 and 16^3 children, and leaves of 8^3 voxels, x
slowest. An inactive voxel has a value too, mostly the background. The box of all active voxels becomes the volume. The centre
of voxel (i, j, k) lies at the world position of its index. A level set (distance to a surface, negative inside) becomes a fog
that rises from 0 at the surface to 1 at the depth of its narrow band, as OpenVDB's ``sdfToFogVolume`` does.

Reference: Museth 2013, "VDB: High-resolution sparse volumes with dynamic topology"; the file format in versions 222 to 225, as
OpenVDB 3 to 12 writes it.
"""

from __future__ import annotations

import re
import struct
import uuid
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files.npy import check_memory
from mivol.files.source import decompress, read_bytes, refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, to_values

MAGIC = b" BDV\0\0\0\0"

#: first and last version of the format that are read.
VERSIONS = (222, 225)

#: type of a grid's values -> (number type, components).
TYPES: dict[str, tuple[str, int]] = {
    "float": ("<f4", 1),
    "double": ("<f8", 1),
    "half": ("<f2", 1),
    "int32": ("<i4", 1),
    "int64": ("<i8", 1),
    "bool": ("?", 1),
    "vec3s": ("<f4", 3),
    "vec3d": ("<f8", 3),
    "vec3i": ("<i4", 3),
}

#: type of a metadata value -> struct codes; strings are decoded, other types skipped.
METADATA = {"bool": "?", "int32": "i", "int64": "q", "float": "f", "double": "d", "vec3i": "3i", "vec3s": "3f", "vec3d": "3d"}

#: bits of a grid's compression.
ZIP, ACTIVE_VALUES, BLOSC = 1, 2, 4

#: log2 of the children or voxels along an edge of a node, from the root's children down to the leaves.
LEVELS = (5, 4, 3)

LEAF = 1 << LEVELS[-1]
"""Voxels along the edge of a leaf."""

Coord = tuple[int, int, int]


# -- Reading -------------------------------------------------------------------------------------------------------------


def is_vdb(head: bytes) -> bool:
    """Whether the first bytes are OpenVDB's."""
    return head.startswith(MAGIC)


def read_vdb(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a grid as a dense volume, the box of its active voxels.

    Args:
        path: file.
        dataset: name of the grid; ``name[1]`` is the second grid of a name. None for a file of one grid.

    Returns:
        Values and placement; ``meta`` holds ``grid``, ``class``, the first index ``index_min``, ``active_voxels``, and for a
        level set the width ``band`` of its narrow band [length].

    Raises:
        MivolError: a damaged or truncated file, another version, points or other types of values, a grid without active voxels,
            a projective transform, a box beyond memory, or Blosc data without the package ``blosc``.
    """
    stream = _Stream(read_bytes(path), path)
    stream.skip(len(MAGIC))
    version = stream.unpack("I")[0]
    if not VERSIONS[0] <= version <= VERSIONS[1]:
        expected = f"{VERSIONS[0]} to {VERSIONS[1]}"
        raise refusal(path, f"version {version} of OpenVDB's format", expected, "write it again with OpenVDB 3 to 12")
    stream.skip(8)
    if not stream.unpack("?")[0]:
        raise refusal(path, "grids without offsets", "a file with offsets", "write it again by a program that can seek")
    stream.skip(36)
    _read_metadata(stream)
    count = stream.unpack("I")[0]
    grids = _name_grids([_Descriptor.read(stream) for _ in range(stream.check_count(count))])
    name = select_dataset(path, dataset, list(grids))
    return _read_grid(stream, grids, name)


@dataclass
class _Stream:
    """A position in the bytes of a file, which must not be left."""

    data: bytes
    path: Path
    at: int = 0

    def take(self, count: int) -> bytes:
        if count < 0 or self.at + count > len(self.data):
            found = f"{len(self.data)} bytes, where {count} more are announced at byte {self.at}"
            raise refusal(self.path, found, "a whole file", "the file is truncated or damaged: copy it again")
        self.at += count
        return self.data[self.at - count : self.at]

    def skip(self, count: int) -> None:
        self.take(count)

    def unpack(self, codes: str) -> tuple:
        return struct.unpack("<" + codes, self.take(struct.calcsize("<" + codes)))

    def text(self) -> str:
        return self.take(self.unpack("I")[0]).decode("utf-8", errors="replace")

    def seek(self, at: int) -> None:
        self.at = 0
        self.skip(at)

    def check_count(self, count: int) -> int:
        """Refuse more items than bytes are left."""
        if count > len(self.data) - self.at:
            raise refusal(self.path, f"{count} items announced at byte {self.at}", "a sound header", "copy the file again")
        return count


@dataclass
class _Descriptor:
    """The entry of a grid in the head of a file: type, parent of an instance, and offset."""

    name: str
    type: str
    parent: str
    at: int

    @classmethod
    def read(cls, stream: _Stream) -> _Descriptor:
        """Read a descriptor, and go behind the grid that follows it."""
        name, kind, parent = stream.text(), stream.text(), stream.text()
        begin, _, end = stream.unpack("3q")
        stream.seek(end)
        return cls(name, kind, parent, begin)


def _name_grids(descriptors: list[_Descriptor]) -> dict[str, _Descriptor]:
    """Name the grids: several grids of a name get numbers, as in ``density[1]``."""
    grids: dict[str, _Descriptor] = {}
    for each in descriptors:
        plain = each.name.split("\x1e")[0]
        number = sum(other.name.split("\x1e")[0] == plain for other in grids.values())
        grids[f"{plain}[{number}]" if number else plain] = each
    return grids


def _read_metadata(stream: _Stream) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    for _ in range(stream.check_count(stream.unpack("I")[0])):
        name, kind, size = stream.text(), stream.text(), stream.unpack("I")[0]
        data = stream.take(size)
        if kind == "string":
            facts[name] = data.decode("utf-8", errors="replace")
        elif kind in METADATA and struct.calcsize("<" + METADATA[kind]) == size:
            values = struct.unpack("<" + METADATA[kind], data)
            facts[name] = values if len(values) > 1 else values[0]
    return facts


def _read_grid(stream: _Stream, grids: dict[str, _Descriptor], name: str) -> VolumeData:
    path, descriptor = stream.path, grids[name]
    kind = _parse_type(path, name, descriptor)
    compression, facts, index_to_world = _read_grid_head(stream, descriptor)
    owner = descriptor
    if descriptor.parent:
        # An instance has its own transform and the tree of another grid.
        owner = next((each for each in grids.values() if each.name == descriptor.parent and not each.parent), None)
        if owner is None:
            raise refusal(path, f"an instance of {descriptor.parent!r}", "the grid of that name", "write the file again")
        kind = _parse_type(path, name, owner)
        compression = _read_grid_head(stream, owner)[0]
    is_half = owner.type.endswith("_HalfFloat")
    tree = _TreeReader(stream, kind, compression, is_half)
    values, low, active = tree.read(name)
    is_level_set = facts.get("class") == "level set"
    steps = index_to_world[:3, :3]
    meta = {
        "path": str(path),
        "format": "vdb",
        "dtype": "float16" if is_half else np.dtype(TYPES[kind][0]).name,
        "space": None,
        "grid": name,
        "class": facts.get("class", "unknown"),
        "index_min": low,
        "active_voxels": active,
    }
    if is_level_set:
        band = abs(float(tree.background[0]))
        if not band > 0:
            raise refusal(path, f"the level set {name!r} with a band of {band}", "a band above 0", "write the grid again")
        values, meta["band"] = np.clip(-values / band, 0, 1), band
    values = to_values(values.transpose(2, 1, 0, 3), path)
    origin = steps @ low + index_to_world[:3, 3]
    return VolumeData(values, frame_from_steps(values.shape[2::-1], steps, origin), meta)


def _parse_type(path: Path, name: str, descriptor: _Descriptor) -> str:
    match = re.fullmatch(r"Tree_(\w+?)_5_4_3(_HalfFloat)?", descriptor.type)
    if match is None or match[1] not in TYPES:
        expected = f"a tree 5, 4, 3 of {', '.join(TYPES)}"
        raise refusal(path, f"the grid {name!r} of type {descriptor.type}", expected, "convert the grid, or choose another one")
    return match[1]


def _read_grid_head(stream: _Stream, descriptor: _Descriptor) -> tuple[int, dict[str, Any], np.ndarray]:
    """Go to a grid; return its compression, its metadata and the matrix from indices to the world (4, 4)."""
    stream.seek(descriptor.at)
    compression = stream.unpack("I")[0]
    return compression, _read_metadata(stream), _read_transform(stream)


def _read_transform(stream: _Stream) -> np.ndarray:
    kind, matrix = stream.text(), np.eye(4)
    if kind in ("ScaleMap", "UniformScaleMap"):
        # The scale, and four vectors that follow from it.
        matrix[:3, :3] = np.diag(stream.unpack("15d")[:3])
    elif kind in ("ScaleTranslateMap", "UniformScaleTranslateMap"):
        numbers = stream.unpack("18d")
        matrix[:3, :3], matrix[:3, 3] = np.diag(numbers[3:6]), numbers[:3]
    elif kind == "TranslationMap":
        matrix[:3, 3] = stream.unpack("3d")
    elif kind in ("AffineMap", "UnitaryMap"):
        # OpenVDB multiplies rows from the left.
        matrix = np.reshape(stream.unpack("16d"), (4, 4)).T
    else:
        raise refusal(stream.path, f"the transform {kind}", "an affine transform", "resample the grid to equal voxels")
    return matrix


@dataclass
class _Node:
    """A constant region (tile) or a leaf.

    Attributes:
        origin: index of its first voxel.
        edge: voxels along its edge.
        values: value of a tile (C,); None for a leaf, whose values follow later in the file.
        mask: active voxels (8, 8, 8) of a leaf; for a tile whether it is active.
    """

    origin: Coord
    edge: int
    values: np.ndarray | None
    mask: Any


@dataclass
class _TreeReader:
    """A reader of one tree.

    Attributes:
        stream: position at the tree.
        kind: key of ``TYPES``.
        compression: bits of the grid's compression.
        is_half: whether blocks of values are stored as float16.
        background: value of all voxels outside the tree (C,).
    """

    stream: _Stream
    kind: str
    compression: int
    is_half: bool
    background: np.ndarray = field(default_factory=lambda: np.zeros(1))

    def read(self, name: str) -> tuple[np.ndarray, Coord, int]:
        """Read the tree; return values (X, Y, Z, C), the index of the first voxel, and the number of active voxels."""
        stream = self.stream
        if (buffers := stream.unpack("I")[0]) != 1:
            raise refusal(stream.path, f"{buffers} buffers a tree", "1", "write it again with OpenVDB 3 to 12")
        self.background = self._read_value()
        tiles, children = stream.unpack("2I")
        nodes = [self._read_root_tile() for _ in range(stream.check_count(tiles))]
        for _ in range(stream.check_count(children)):
            nodes += self._read_inner(stream.unpack("3i"), 0)
        low, high, active = _active_box(nodes)
        if not active:
            raise refusal(stream.path, f"no active voxel in the grid {name!r}", "at least one", "choose another grid")
        shape = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
        dtype, components = TYPES[self.kind]
        check_memory(stream.path, int(np.prod([*map(int, shape), components])) * max(np.dtype(dtype).itemsize, 4))
        values = np.empty((*shape, components), dtype)
        values[:] = self.background
        for node in nodes:
            _paste(values, low, node, self._read_leaf(node) if node.values is None else node.values)
        return values, low, active

    def _read_value(self) -> np.ndarray:
        dtype, components = TYPES[self.kind]
        return np.frombuffer(self.stream.take(np.dtype(dtype).itemsize * components), dtype)

    def _read_root_tile(self) -> _Node:
        origin = self.stream.unpack("3i")
        value = self._read_value()
        return _Node(origin, 1 << sum(LEVELS), value, self.stream.unpack("?")[0])

    def _read_inner(self, origin: Coord, level: int) -> Iterator[_Node]:
        """Read the topology below an inner node: its active and its non-background tiles, and its leaves."""
        log2, below = LEVELS[level], sum(LEVELS[level + 1 :])
        count = 1 << 3 * log2
        has_child, is_on = self._read_mask(count), self._read_mask(count)
        values = self._read_values(count, is_on)
        matters = is_on | (values != self.background).any(axis=1)
        for index in np.flatnonzero(has_child | matters):
            place = _child_origin(origin, int(index), log2, below)
            if not has_child[index]:
                yield _Node(place, 1 << below, values[index], bool(is_on[index]))
            elif level + 1 < len(LEVELS) - 1:
                yield from self._read_inner(place, level + 1)
            else:
                yield _Node(place, LEAF, None, self._read_mask(LEAF**3).reshape(LEAF, LEAF, LEAF))

    def _read_mask(self, count: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self.stream.take(count // 8), np.uint8), bitorder="little").astype(bool)

    def _read_leaf(self, node: _Node) -> np.ndarray:
        mask = self._read_mask(LEAF**3)
        if self.kind == "bool":
            # The origin of the leaf, then a bit for each value.
            self.stream.skip(12)
            values = self._read_mask(LEAF**3)[:, None]
        else:
            values = self._read_values(LEAF**3, mask)
        return values.reshape(LEAF, LEAF, LEAF, -1)

    def _read_values(self, count: int, is_on: np.ndarray) -> np.ndarray:
        """Read the values (count, C) of a node; those that are off may be left out of the file."""
        # 0: off is the background; 1: minus the background; 2: one other value; 3: a mask selects the background or its minus;
        # 4: the background or another value; 5: two other values; 6: all values are stored.
        how = self.stream.unpack("B")[0]
        if how > 6:
            raise refusal(self.stream.path, f"a block of kind {how}", "0 to 6", "the file is damaged: copy it again")
        first, second = (-self.background if self.kind != "bool" else ~self.background), self.background
        if how == 0:
            first = self.background
        if how in (2, 4, 5):
            first = self._read_value()
        if how == 5:
            second = self._read_value()
        selected = self._read_mask(count) if how in (3, 4, 5) else np.zeros(count, bool)
        if how == 6 or not self.compression & ACTIVE_VALUES:
            return self._read_block(count)
        values = np.where(selected[:, None], second, first)
        values[is_on] = self._read_block(int(np.count_nonzero(is_on)))
        return values

    def _read_block(self, count: int) -> np.ndarray:
        """Read ``count`` stored values (count, C)."""
        dtype, components = TYPES[self.kind]
        stored = "<f2" if self.is_half else dtype
        size, stream = np.dtype(stored).itemsize * components * count, self.stream
        if self.is_half and count == 0:
            data = b""  # OpenVDB writes no size for an empty block of half numbers, but one for other numbers
        elif self.compression & (ZIP | BLOSC):
            held = stream.unpack("q")[0]
            # A negative number is the size of data that compression would have made longer.
            data = stream.take(-held) if held <= 0 else self._decompress(stream.take(held), size)
        else:
            data = stream.take(size)
        if len(data) != size:
            raise refusal(stream.path, f"a block of {len(data)} bytes", f"{size}", "the file is damaged: copy it again")
        return np.frombuffer(data, stored).astype(dtype).reshape(count, components)

    def _decompress(self, data: bytes, size: int) -> bytes:
        if self.compression & BLOSC:
            return _decompress_blosc(data, size, self.stream.path)
        return decompress(data, "zlib", size, self.stream.path)


def _decompress_blosc(data: bytes, size: int, path: Path) -> bytes:
    try:
        import blosc
    except ImportError:
        way_out = 'pip install "mivol[vdb]", or write the file with zip compression'
        raise refusal(path, "data compressed with Blosc", "the package blosc", way_out) from None
    # The head of a frame holds the sizes of its content and of itself; the package trusts both.
    sizes = struct.unpack("<4xI4xI", data[:16]) if len(data) >= 16 else (0, 0)
    if sizes != (size, len(data)):
        raise refusal(path, f"a Blosc frame of {sizes} bytes", f"{(size, len(data))}", "the file is damaged: copy it again")
    try:
        return blosc.decompress(data)
    except blosc.blosc_extension.error as error:
        raise refusal(path, f"damaged Blosc data ({error})", "a sound frame", "copy the file again") from error


def _child_origin(origin: Coord, index: int, log2: int, below: int) -> Coord:
    last = (1 << log2) - 1
    steps = (index >> 2 * log2, index >> log2 & last, index & last)
    return tuple(start + (step << below) for start, step in zip(origin, steps, strict=True))


def _active_box(nodes: list[_Node]) -> tuple[Coord, Coord, int]:
    """First and last index of the active voxels, and their number."""
    lows, highs, active = [], [], 0
    for node in nodes:
        if node.values is not None:
            if node.mask:
                lows.append(node.origin)
                highs.append(tuple(start + node.edge - 1 for start in node.origin))
                active += node.edge**3
        elif node.mask.any():
            spans = [np.flatnonzero(node.mask.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
            lows.append(tuple(start + int(span[0]) for start, span in zip(node.origin, spans, strict=True)))
            highs.append(tuple(start + int(span[-1]) for start, span in zip(node.origin, spans, strict=True)))
            active += int(np.count_nonzero(node.mask))
    if not active:
        return (0, 0, 0), (0, 0, 0), 0
    return tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True))), active


def _paste(values: np.ndarray, low: Coord, node: _Node, content: np.ndarray) -> None:
    """Copy the part of a node inside the box."""
    target, source = [], []
    for start, first, extent in zip(node.origin, low, values.shape, strict=False):
        begin, end = max(start - first, 0), min(start - first + node.edge, extent)
        if begin >= end:
            return
        target.append(slice(begin, end))
        source.append(slice(begin - start + first, end - start + first))
    values[tuple(target)] = content[tuple(source)] if content.ndim > 1 else content


# -- Writing -------------------------------------------------------------------------------------------------------------


def write_vdb(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a fog volume in float32, compressed by zip: the grid ``density`` of numbers, or ``color`` of three channels.

    Voxels of the value 0 are off, and blocks of 8^3 such voxels take no space.

    Args:
        file: destination.
        values: float32 (Z, Y, X, 1) or (Z, Y, X, 3).
        to_world: unit cube to world (4, 4).
        metadata: ``grid``: another name of the grid. Nothing else can be held.

    Raises:
        MivolError: another number of channels, other metadata, or nothing but zeros, which no reader can place.
    """
    names = {1: ("float", "density"), 3: ("vec3s", "color")}
    channels = values.shape[3]
    if channels not in names:
        way_out = "write one file for each channel, or a .npz"
        raise refusal("write_volume", f"{channels} channels for a .vdb file", "1 or 3", way_out)
    if rest := set(metadata) - {"grid"}:
        found = f"metadata {', '.join(sorted(rest))} for a .vdb file"
        raise refusal("write_volume", found, "at most the key grid", "write .npz, or remove the metadata")
    if not values.any():
        raise refusal("write_volume", "nothing but zeros for a .vdb file", "a voxel with another value", "write .npz")
    kind, name = names[channels]
    name = str(metadata.get("grid", name))
    leaves = _cut_leaves(np.ascontiguousarray(values.transpose(2, 1, 0, 3), "<f4"))
    topology, blocks = _pack_tree(leaves, channels)
    low, high, count = _active_box([_Node(origin, LEAF, None, mask) for origin, (mask, _) in leaves.items()])
    facts = [
        ("name", "string", name.encode()),
        ("class", "string", b"fog volume"),
        ("file_bbox_min", "vec3i", struct.pack("<3i", *low)),
        ("file_bbox_max", "vec3i", struct.pack("<3i", *high)),
        ("file_voxel_count", "int64", struct.pack("<q", count)),
    ]
    grid = struct.pack("<I", ZIP | ACTIVE_VALUES) + _pack_metadata(facts) + _pack_transform(values.shape[2::-1], to_world)
    head = MAGIC + struct.pack("<3I?", 224, 10, 0, True) + str(uuid.uuid4()).encode()
    head += _pack_metadata([("creator", "string", b"mivol")]) + struct.pack("<I", 1)
    head += _pack_text(name) + _pack_text(f"Tree_{kind}_5_4_3") + _pack_text("")
    begin = len(head) + 24
    after_topology = begin + len(grid) + len(topology)
    file.write(head + struct.pack("<3q", begin, after_topology, after_topology + len(blocks)) + grid + topology + blocks)


def _cut_leaves(values: np.ndarray) -> dict[Coord, tuple[np.ndarray, np.ndarray]]:
    """The leaves (X, Y, Z, C) with a value other than 0: origin -> (mask, values), both of 8^3 voxels."""
    size = values.shape[:3]
    padded = np.zeros((*(-(-n // LEAF) * LEAF for n in size), values.shape[3]), values.dtype)
    padded[tuple(slice(n) for n in size)] = values
    counts = [n // LEAF for n in padded.shape[:3]]
    cut = padded.reshape(counts[0], LEAF, counts[1], LEAF, counts[2], LEAF, -1).transpose(0, 2, 4, 1, 3, 5, 6)
    masks = (cut != 0).any(axis=-1)
    return {
        tuple(LEAF * int(k) for k in index): (masks[tuple(index)], cut[tuple(index)])
        for index in np.argwhere(masks.any(axis=(3, 4, 5)))
    }


def _pack_tree(leaves: dict[Coord, tuple[np.ndarray, np.ndarray]], channels: int) -> tuple[bytes, bytes]:
    """The topology of a tree with these leaves, and their values in the same order."""
    topology, blocks = [struct.pack("<I", 1), bytes(4 * channels)], []

    def add_leaf(origin: Coord) -> None:
        mask, values = leaves[origin]
        packed = np.packbits(mask.ravel(), bitorder="little").tobytes()
        topology.append(packed)
        blocks.append(packed + b"\0" + _pack_block(values[mask].tobytes()))

    def add_children(origins: list[Coord], level: int) -> None:
        """Add the inner nodes of a level that hold these leaves: masks of children and tiles, then each child."""
        log2, below = LEVELS[level], sum(LEVELS[level + 1 :])
        children: dict[int, list[Coord]] = {}
        for origin in origins:
            x, y, z = (c >> below & (1 << log2) - 1 for c in origin)
            children.setdefault(x << 2 * log2 | y << log2 | z, []).append(origin)
        has_child = np.zeros(1 << 3 * log2, bool)
        has_child[list(children)] = True
        # No tile is on, so no value of a tile follows.
        topology.append(
            np.packbits(has_child, bitorder="little").tobytes() + bytes(has_child.size // 8) + b"\0" + _pack_block(b"")
        )
        for index in sorted(children):
            if level + 1 < len(LEVELS) - 1:
                add_children(children[index], level + 1)
            else:
                add_leaf(children[index][0])

    roots: dict[Coord, list[Coord]] = {}
    for origin in leaves:
        roots.setdefault(tuple(c >> sum(LEVELS) << sum(LEVELS) for c in origin), []).append(origin)
    topology.append(struct.pack("<2I", 0, len(roots)))
    for root in sorted(roots):
        topology.append(struct.pack("<3i", *root))
        add_children(roots[root], 0)
    return b"".join(topology), b"".join(blocks)


def _pack_block(data: bytes) -> bytes:
    short = zlib.compress(data) if data else data
    if len(short) < len(data):
        return struct.pack("<q", len(short)) + short
    return struct.pack("<q", -len(data)) + data


def _pack_text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _pack_metadata(facts: list[tuple[str, str, bytes]]) -> bytes:
    entries = [_pack_text(name) + _pack_text(kind) + struct.pack("<I", len(data)) + data for name, kind, data in facts]
    return struct.pack("<I", len(entries)) + b"".join(entries)


def _pack_transform(size: Any, to_world: np.ndarray) -> bytes:
    """The matrix from indices to the world, as OpenVDB multiplies it: rows from the left."""
    steps = to_world[:3, :3] / np.asarray(size)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = steps, to_world[:3, 3] + steps.sum(axis=1) / 2
    return _pack_text("AffineMap") + struct.pack("<16d", *matrix.T.ravel())
