"""OpenVDB (``.vdb``): named sparse grids, read into a dense box of voxels or into bricks.

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

import math
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.errors import MivolError
from mivol.files.npy import check_memory
from mivol.files.source import check_file, decompress, refusal, select_dataset
from mivol.files.volume import SparseVolumeData, VolumeData, allocate_bricks, frame_from_steps, to_values

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

#: types of grids of points.
POINTS = r"Tree_pt(dataidx|idx)32.*"

#: bits of a grid's compression.
ZIP, ACTIVE_VALUES, BLOSC = 1, 2, 4

#: log2 of the children or voxels along an edge of a node, from the root's children down to the leaves.
LEVELS = (5, 4, 3)

LEAF = 1 << LEVELS[-1]
"""Voxels along the edge of a leaf."""

BUFFER = 1 << 16
"""Bytes that are read from a file at once."""

MASK = LEAF**3 // 8
"""Bytes of the mask of a leaf."""

LEAVES_AT_ONCE = 2048
"""Leaves whose values are placed together: few calls of NumPy, and little memory beside the result."""

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
    with _open_file(path) as file:
        grid, name = _find_grid(_Stream(file, path.stat().st_size, path), dataset)
        values, low, active = grid.tree.read(name)
    values = to_values(grid.to_fog(values, path, name).transpose(2, 1, 0, 3), path)
    return VolumeData(values, grid.place(values.shape[2::-1], low), grid.describe(path, name, low, active))


def read_sparse_vdb(path: Path, dataset: str | None = None) -> SparseVolumeData:
    """Read a grid in its leaves, without the dense box.

    Args, raises: as of :func:`read_vdb`; a value outside of the tree that is not 0 makes every brick of the box a stored one.

    Returns:
        Values and placement as of :func:`read_vdb`; ``meta`` too.
    """
    with _open_file(path) as file:
        grid, name = _find_grid(_Stream(file, path.stat().st_size, path), dataset)
        if grid.to_fog(grid.tree.read_background(), path, name).any():
            volume = read_vdb(path, dataset)
            return replace(SparseVolumeData.from_dense(volume.values, volume.to_world), meta=volume.meta)
        values, places, low, high, active = grid.tree.read_bricks(name, lambda block: grid.to_fog(block, path, name))
    size = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
    offset = tuple(a % LEAF for a in low[::-1])
    return SparseVolumeData(values, places, size[::-1], grid.place(size, low), offset, grid.describe(path, name, low, active))


def name_grids(path: Path) -> list[str]:
    """The names of the grids of a file, as :func:`read_vdb` takes them.

    Raises:
        MivolError: a damaged or truncated file.
    """
    with _open_file(path) as file:
        return list(_name_all_grids(_Stream(file, path.stat().st_size, path)))


def _open_file(path: Path) -> BinaryIO:
    try:
        return check_file(path).open("rb", buffering=BUFFER)
    except PermissionError as error:
        raise refusal(path, "no permission to read it", "a readable file", "change its permissions") from error


def _name_all_grids(stream: _Stream) -> dict[str, _Descriptor]:
    """Read the head of a file; return its grids by name."""
    path = stream.path
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
    return _name_grids([_Descriptor.read(stream) for _ in range(stream.check_count(count))])


@dataclass
class _Stream:
    """A position in an open file, which must not be left. The file is not read as a whole: it may be as large as its volume."""

    file: BinaryIO
    size: int
    path: Path
    at: int = 0

    def take(self, count: int) -> bytes:
        # A large file has 100,000 leaves, and takes four pieces of each: no further call here.
        end = self.at + count
        if count < 0 or end > self.size:
            raise self._refusal(count)
        self.at = end
        return self.file.read(count)

    def skip(self, count: int) -> None:
        if count < 0 or self.at + count > self.size:
            raise self._refusal(count)
        self.at += count
        self.file.seek(self.at)

    def _refusal(self, count: int) -> MivolError:
        found = f"{self.size} bytes, where {count} more are announced at byte {self.at}"
        return refusal(self.path, found, "a whole file", "the file is truncated or damaged: copy it again")

    def unpack(self, codes: str) -> tuple:
        return struct.unpack("<" + codes, self.take(struct.calcsize("<" + codes)))

    def text(self) -> str:
        return self.take(self.unpack("I")[0]).decode("utf-8", errors="replace")

    def seek(self, at: int) -> None:
        self.at = 0
        self.skip(at)

    def check_count(self, count: int) -> int:
        """Refuse more items than bytes are left."""
        if count > self.size - self.at:
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


@dataclass
class _Grid:
    """A grid at the position of its tree.

    Attributes:
        tree: reader of its tree.
        facts: its metadata.
        index_to_world: matrix (4, 4) from indices to the world.
    """

    tree: _TreeReader
    facts: dict[str, Any]
    index_to_world: np.ndarray

    @property
    def is_level_set(self) -> bool:
        """Whether values are distances to a surface."""
        return self.facts.get("class") == "level set"

    def to_fog(self, values: np.ndarray, path: Path, name: str) -> np.ndarray:
        """The fog of a level set; other values as they are."""
        if not self.is_level_set:
            return values
        band = abs(float(self.tree.background[0]))
        if not band > 0:
            raise refusal(path, f"the level set {name!r} with a band of {band}", "a band above 0", "write the grid again")
        return np.clip(-values / band, 0, 1)

    def place(self, size: Any, low: Coord) -> np.ndarray:
        """The matrix (4, 4) from the unit cube of the box to the world."""
        steps = self.index_to_world[:3, :3]
        return frame_from_steps(size, steps, steps @ low + self.index_to_world[:3, 3])

    def describe(self, path: Path, name: str, low: Coord, active: int) -> dict[str, object]:
        """The facts of the grid, for ``meta``."""
        meta = {
            "path": str(path),
            "format": "vdb",
            "dtype": "float16" if self.tree.is_half else np.dtype(TYPES[self.tree.kind][0]).name,
            "space": None,
            "grid": name,
            "class": self.facts.get("class", "unknown"),
            "index_min": low,
            "active_voxels": active,
        }
        return meta | ({"band": abs(float(self.tree.background[0]))} if self.is_level_set else {})


def _find_grid(stream: _Stream, dataset: str | None) -> tuple[_Grid, str]:
    """Go to the tree of the chosen grid; return the grid and its name."""
    grids = _name_all_grids(stream)
    name = select_dataset(stream.path, dataset, list(grids))
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
    tree = _TreeReader(stream, kind, compression, owner.type.endswith("_HalfFloat"))
    return _Grid(tree, facts, index_to_world), name


def _parse_type(path: Path, name: str, descriptor: _Descriptor) -> str:
    if re.fullmatch(POINTS, descriptor.type):
        way_out = "rasterize them to a fog volume first, or choose another grid"
        raise refusal(path, f"the points {name!r} ({descriptor.type})", "a grid of voxels", way_out)
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
class Node:
    """A constant region (tile) or a leaf.

    Attributes:
        origin: index of its first voxel.
        edge: voxels along its edge.
        values: value of a tile (C,); None for a leaf, whose values follow later in the file.
        mask: active voxels of a leaf, a bit each; for a tile whether it is active.
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
        nodes, low, high, active = self._read_topology(name)
        shape = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
        dtype, components = TYPES[self.kind]
        check_memory(self.stream.path, math.prod([*map(int, shape), components]) * max(np.dtype(dtype).itemsize, 4))
        values = np.empty((*shape, components), dtype)
        values[:] = self.background
        for node in nodes:
            _paste(values, low, node, self._read_leaf(node) if node.values is None else node.values)
        return values, low, active

    def read_background(self) -> np.ndarray:
        """Read the value (C,) outside of the tree, and stay at the tree."""
        at = self.stream.at
        self.stream.skip(4)
        self.background = self._read_value()
        self.stream.seek(at)
        return self.background

    def read_bricks(
        self, name: str, convert: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, Coord, Coord, int]:
        """Read the tree in bricks, of which those of zeros are left out.

        Args:
            name: name of the grid.
            convert: function of the values of a leaf or a tile.

        Returns:
            values (bricks, z, y, x, C), the place (z, y, x) of each brick in ascending order, the indices of the first and the
            last active voxel, and the number of active voxels.
        """
        nodes, low, high, active = self._read_topology(name)
        first, last = (np.array(edge) // LEAF for edge in (low, high))
        leaves = [node for node in nodes if node.values is None]
        places = [np.array([node.origin for node in leaves], np.int64).reshape(-1, 3) // LEAF]
        tiles = [(node, _cut_tile(node, first, last)) for node in nodes if node.values is not None]
        tiles = [(node, cut) for node, cut in tiles if len(cut) and convert(node.values).any()]
        places = np.concatenate(places + [cut for _, cut in tiles]) - first
        components, spans = TYPES[self.kind][1], last - first + 1
        check_memory(self.stream.path, 4 * LEAF**3 * components * len(places))
        inside = ((places >= 0) & (places < spans)).all(axis=1)
        numbers = np.ravel_multi_index(np.clip(places, 0, spans - 1)[:, ::-1].T, spans[::-1])
        order = np.argsort(np.where(inside, numbers, spans.prod()), kind="stable")
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        values = allocate_bricks(len(order), components)
        held = np.zeros(len(order), bool)
        for begin in range(0, len(leaves), LEAVES_AT_ONCE):
            block = convert(self._read_leaves(leaves[begin : begin + LEAVES_AT_ONCE]))
            rows = rank[begin : begin + len(block)]
            values[rows] = block.reshape(-1, LEAF, LEAF, LEAF, components).transpose(0, 3, 2, 1, 4)
            held[rows] = block.any(axis=(1, 2))
        begin = len(leaves)
        for node, cut in tiles:
            rows = rank[begin : begin + len(cut)]
            values[rows], held[rows], begin = convert(node.values), True, begin + len(cut)
        held &= inside[order]
        # A grid of zeros keeps a brick: no array of a medium is empty.
        held[0] |= not held.any()
        places = places[order][:, ::-1].astype(np.int32)
        return (values, places, low, high, active) if held.all() else (values[held], places[held], low, high, active)

    def _read_topology(self, name: str) -> tuple[list[Node], Coord, Coord, int]:
        """Read the nodes, and the first and the last index and the number of the active voxels."""
        stream = self.stream
        if (buffers := stream.unpack("I")[0]) != 1:
            raise refusal(stream.path, f"{buffers} buffers a tree", "1", "write it again with OpenVDB 3 to 12")
        self.background = self._read_value()
        tiles, children = stream.unpack("2I")
        nodes = [self._read_root_tile() for _ in range(stream.check_count(tiles))]
        for _ in range(stream.check_count(children)):
            nodes += self._read_inner(stream.unpack("3i"), 0)
        low, high, active = _find_active_box(nodes)
        if not active:
            raise refusal(stream.path, f"no active voxel in the grid {name!r}", "at least one", "choose another grid")
        return nodes, low, high, active

    def _read_leaves(self, leaves: list[Node]) -> np.ndarray:
        """Read leaves (n, 512, C), x slowest; the values of those stored in the usual way are joined before they are placed."""
        stream, (dtype, components) = self.stream, TYPES[self.kind]
        values = np.empty((len(leaves), LEAF**3, components), dtype)
        values[:] = self.background
        plain, blocks = np.zeros(len(leaves), bool), []
        bits = _join_masks(leaves)
        masks, counts = np.unpackbits(bits, axis=1, bitorder="little").view(bool), np.bitwise_count(bits).sum(axis=1).tolist()
        joins = self.kind != "bool" and self.compression & ACTIVE_VALUES
        for k, (node, count) in enumerate(zip(leaves, counts, strict=True)):
            begin = stream.at
            if joins and stream.take(MASK + 1)[-1] == 0:
                plain[k] = True
                blocks.append(self._read_stored(count))
            else:
                stream.seek(begin)
                values[k] = self._read_leaf(node).reshape(LEAF**3, components)
        stored = np.frombuffer(b"".join(blocks), "<f2" if self.is_half else dtype).reshape(-1, components)
        # Numbers of voxels, not a mask: NumPy places by numbers six times as fast.
        values.reshape(-1, components)[np.flatnonzero(masks & plain[:, None])] = stored
        return values

    def _read_value(self) -> np.ndarray:
        dtype, components = TYPES[self.kind]
        return np.frombuffer(self.stream.take(np.dtype(dtype).itemsize * components), dtype)

    def _read_root_tile(self) -> Node:
        origin = self.stream.unpack("3i")
        value = self._read_value()
        return Node(origin, 1 << sum(LEVELS), value, self.stream.unpack("?")[0])

    def _read_inner(self, origin: Coord, level: int) -> Iterator[Node]:
        """Read the topology below an inner node: its active and its non-background tiles, and its leaves."""
        log2, below = LEVELS[level], sum(LEVELS[level + 1 :])
        count = 1 << 3 * log2
        has_child, is_on = self._read_mask(count), self._read_mask(count)
        values = self._read_values(count, is_on)
        matters = is_on | (values != self.background).any(axis=1)
        indices = np.flatnonzero(has_child | matters)
        places = _child_origins(origin, indices, log2, below)
        holds_leaves = level + 1 == len(LEVELS) - 1
        # The masks of the leaves of a node lie one after the other.
        masks = self.stream.take(MASK * int(np.count_nonzero(has_child))) if holds_leaves else b""
        at = 0
        for index, place, is_node in zip(indices.tolist(), places, has_child[indices].tolist(), strict=True):
            if not is_node:
                yield Node(place, 1 << below, values[index], bool(is_on[index]))
            elif not holds_leaves:
                yield from self._read_inner(place, level + 1)
            else:
                yield Node(place, LEAF, None, masks[at : at + MASK])
                at += MASK

    def _read_mask(self, count: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self.stream.take(count // 8), np.uint8), bitorder="little").astype(bool)

    def _read_leaf(self, node: Node) -> np.ndarray:
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
        data = self._read_stored(count)
        return np.frombuffer(data, "<f2" if self.is_half else dtype).astype(dtype).reshape(count, components)

    @cached_property
    def _bytes_of_value(self) -> int:
        dtype, components = TYPES[self.kind]
        return np.dtype("<f2" if self.is_half else dtype).itemsize * components

    def _read_stored(self, count: int) -> bytes:
        """Read the bytes of ``count`` stored values."""
        size, stream = self._bytes_of_value * count, self.stream
        if self.is_half and count == 0:
            data = b""  # OpenVDB writes no size for an empty block of half numbers, but one for other numbers
        elif self.compression & (ZIP | BLOSC):
            held = int.from_bytes(stream.take(8), "little", signed=True)
            # A negative number is the size of data that compression would have made longer.
            data = stream.take(-held) if held <= 0 else self._decompress(stream.take(held), size)
        else:
            data = stream.take(size)
        if len(data) != size:
            raise refusal(stream.path, f"a block of {len(data)} bytes", f"{size}", "the file is damaged: copy it again")
        return data

    def _decompress(self, data: bytes, size: int) -> bytes:
        if self.compression & BLOSC:
            return decompress_blosc(data, size, self.stream.path)
        return decompress(data, "zlib", size, self.stream.path)


def decompress_blosc(data: bytes, size: int, path: Path) -> bytes:
    """Decompress a frame of Blosc.

    Raises:
        MivolError: no package ``blosc``, or a damaged frame.
    """
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


def _child_origins(origin: Coord, indices: np.ndarray, log2: int, below: int) -> list[Coord]:
    last = (1 << log2) - 1
    steps = (indices >> 2 * log2, indices >> log2 & last, indices & last)
    return list(zip(*((start + (step << below)).tolist() for start, step in zip(origin, steps, strict=True)), strict=True))


def _find_active_box(nodes: list[Node]) -> tuple[Coord, Coord, int]:
    """First and last index of the active voxels, and their number."""
    tiles = [node for node in nodes if node.values is not None and node.mask]
    leaves = [node for node in nodes if node.values is None]
    lows = [np.array([node.origin for node in tiles], np.int64).reshape(-1, 3)]
    highs = [lows[0] + [[node.edge - 1] for node in tiles] if tiles else lows[0]]
    active = sum(node.edge**3 for node in tiles)
    for begin in range(0, len(leaves), LEAVES_AT_ONCE):
        some = leaves[begin : begin + LEAVES_AT_ONCE]
        # A byte of a mask is a row of voxels along z.
        rows, origins = _join_masks(some).reshape(-1, LEAF, LEAF), np.array([node.origin for node in some], np.int64)
        along_y, along_z = np.bitwise_or.reduce(rows, axis=1), np.bitwise_or.reduce(rows, axis=(1, 2))
        bits = np.unpackbits(along_z[:, None], axis=1, bitorder="little")
        spans = np.stack([rows.any(axis=2), along_y != 0, bits != 0], axis=1)
        filled = along_z != 0
        lows.append((origins + spans.argmax(axis=2))[filled])
        highs.append((origins + LEAF - 1 - spans[:, :, ::-1].argmax(axis=2))[filled])
        active += int(np.bitwise_count(rows).sum())
    if not active:
        return (0, 0, 0), (0, 0, 0), 0
    low, high = np.concatenate(lows).min(axis=0), np.concatenate(highs).max(axis=0)
    return tuple(map(int, low)), tuple(map(int, high)), active


def _join_masks(leaves: list[Node]) -> np.ndarray:
    """The masks of leaves, uint8 (n, 64)."""
    return np.frombuffer(b"".join([node.mask for node in leaves]), np.uint8).reshape(-1, MASK)


def _cut_tile(node: Node, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The places (n, 3) of the bricks of a tile between two bricks (x, y, z)."""
    begin = np.maximum(np.array(node.origin) // LEAF, first)
    end = np.minimum((np.array(node.origin) + node.edge) // LEAF, last + 1)
    return np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(begin, end, strict=True)), indexing="ij"), axis=-1).reshape(
        -1, 3
    )


def _paste(values: np.ndarray, low: Coord, node: Node, content: np.ndarray) -> None:
    """Copy the part of a node inside the box."""
    target, source = [], []
    for start, first, extent in zip(node.origin, low, values.shape, strict=False):
        begin, end = max(start - first, 0), min(start - first + node.edge, extent)
        if begin >= end:
            return
        target.append(slice(begin, end))
        source.append(slice(begin - start + first, end - start + first))
    values[tuple(target)] = content[tuple(source)] if content.ndim > 1 else content
