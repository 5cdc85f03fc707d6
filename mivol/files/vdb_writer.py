"""Fog volumes, dense or sparse, written as OpenVDB (``.vdb``, trees of leaves) and NanoVDB (``.nvdb``, one block of memory).

Conventions. As in :mod:`mivol.files.vdb` and :mod:`mivol.files.nvdb`. OpenVDB: version 224 of the format. NanoVDB: version
32.4 of the layout, no compression and no checksum. Nodes lie level by level; each says the box and the range of its
active values.
"""

from __future__ import annotations

import struct
import uuid
import zlib
from typing import Any, BinaryIO

import numpy as np

from mivol.files.nvdb import FACTS, GRID_HEAD, INNER, LAYOUTS, TREE_HEAD, Layout
from mivol.files.source import refusal
from mivol.files.vdb import ACTIVE_VALUES, LEAF, LEVELS, MAGIC, ZIP, Coord
from mivol.files.volume import EDGE, SparseVolumeData

#: channels -> type of a grid's values.
TYPES = {1: "float", 3: "vec3s"}


def write_vdb(file: BinaryIO, values: np.ndarray | SparseVolumeData, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a fog volume in float32, compressed by zip: the grid ``density`` of numbers, or ``color`` of three channels.

    Voxels of the value 0 are off, and blocks of 8^3 such voxels take no space.

    Args:
        file: destination.
        values: float32 (Z, Y, X, 1) or (Z, Y, X, 3), or a sparse volume, whose bricks become leaves.
        to_world: unit cube to world (4, 4).
        metadata: ``grid``: another name of the grid. Nothing else can be held.

    Raises:
        MivolError: another number of channels, other metadata, or nothing but zeros, which no reader can place.
    """
    volume, name = check_fog(values, metadata, ".vdb")
    write_vdb_grids(file, {name: (volume, to_world)})


def write_vdb_grids(file: BinaryIO, grids: dict[str, tuple[SparseVolumeData, np.ndarray]]) -> None:
    """Write several grids; each volume and its placement (4, 4) as of :func:`write_vdb`, by the name of the grid."""
    head = MAGIC + struct.pack("<3I?", 224, 10, 0, True) + str(uuid.uuid4()).encode()
    head += _pack_metadata([("creator", "string", b"mivol")]) + struct.pack("<I", len(grids))
    file.write(head)
    at = len(head)
    for name, (volume, to_world) in grids.items():
        grid, topology, blocks = _pack_grid(name, volume, to_world)
        descriptor = _pack_text(name) + _pack_text(f"Tree_{TYPES[volume.channels]}_5_4_3") + _pack_text("")
        begin = at + len(descriptor) + 24
        after_topology = begin + len(grid) + len(topology)
        at = after_topology + len(blocks)
        file.write(descriptor + struct.pack("<3q", begin, after_topology, at) + grid + topology + blocks)


def _pack_grid(name: str, volume: SparseVolumeData, to_world: np.ndarray) -> tuple[bytes, bytes, bytes]:
    """Head, topology and values of a grid."""
    leaves = cut_leaves(volume)
    topology, blocks = _pack_tree(leaves, volume.channels)
    low, high = leaves.low.min(axis=0), leaves.high.max(axis=0)
    facts = [
        ("name", "string", name.encode()),
        ("class", "string", b"fog volume" if volume.channels == 1 else b"unknown"),
        ("file_bbox_min", "vec3i", struct.pack("<3i", *low)),
        ("file_bbox_max", "vec3i", struct.pack("<3i", *high)),
        ("file_voxel_count", "int64", struct.pack("<q", int(np.count_nonzero(leaves.masks)))),
    ]
    transform = _pack_transform(find_index_to_world(volume, to_world))
    return struct.pack("<I", ZIP | ACTIVE_VALUES) + _pack_metadata(facts) + transform, topology, blocks


def check_fog(values: np.ndarray | SparseVolumeData, metadata: dict[str, Any], suffix: str) -> tuple[SparseVolumeData, str]:
    """The bricks of a volume, and the name of its grid.

    Raises:
        MivolError: what a format with ``suffix`` cannot hold, as of :func:`write_vdb`.
    """
    names = {1: "density", 3: "color"}
    volume = values if isinstance(values, SparseVolumeData) else SparseVolumeData.from_dense(values)
    channels = volume.channels
    if channels not in names:
        way_out = "write one file for each channel, or a .npz"
        raise refusal("write_volume", f"{channels} channels for a {suffix} file", "1 or 3", way_out)
    if rest := set(metadata) - {"grid"}:
        found = f"metadata {', '.join(sorted(rest))} for a {suffix} file"
        raise refusal("write_volume", found, "at most the key grid", "write .npz, or remove the metadata")
    if not volume.values.any():
        raise refusal("write_volume", f"nothing but zeros for a {suffix} file", "a voxel with another value", "write .npz")
    return volume, str(metadata.get("grid", names[channels]))


class Leaves:
    """The leaves with a value other than 0; such voxels are active.

    Attributes:
        origins: index (x, y, z) of the first voxel of each leaf, int64 (n, 3).
        values: float32 (n, 512, C), x slowest.
        masks: active voxels (n, 512).
        low, high: first and last index of the active voxels (n, 3).
        minimum, maximum: range of the active values (n, C).
    """

    def __init__(self, origins: np.ndarray, values: np.ndarray) -> None:
        masks = (values != 0).any(axis=2)
        held = masks.any(axis=1)
        self.origins, self.values, self.masks = origins[held], values[held], masks[held]
        boxes = self.masks.reshape(-1, LEAF, LEAF, LEAF)
        spans = np.stack([boxes.any(axis=axes) for axes in ((2, 3), (1, 3), (1, 2))], axis=1)
        self.low = self.origins + spans.argmax(axis=2)
        self.high = self.origins + LEAF - 1 - spans[:, :, ::-1].argmax(axis=2)
        inactive = ~self.masks[..., None]
        self.minimum = np.where(inactive, np.float32(np.inf), self.values).min(axis=1)
        self.maximum = np.where(inactive, np.float32(-np.inf), self.values).max(axis=1)

    def sort(self, order: np.ndarray) -> None:
        """Bring the leaves into another order."""
        for name, array in vars(self).items():
            setattr(self, name, array[order])


def cut_leaves(volume: SparseVolumeData) -> Leaves:
    """The leaves of a volume."""
    values = volume.values.astype("<f4").transpose(0, 3, 2, 1, 4).reshape(-1, LEAF**3, volume.channels)
    return Leaves(LEAF * volume.bricks[:, ::-1].astype(np.int64), values)


def _pack_tree(leaves: Leaves, channels: int) -> tuple[bytes, bytes]:
    """The topology of a tree with these leaves, and their values in the same order."""
    topology, blocks = [struct.pack("<I", 1), bytes(4 * channels)], []
    rows = {tuple(origin): row for row, origin in enumerate(leaves.origins.tolist())}

    def add_leaf(origin: Coord) -> None:
        mask = leaves.masks[rows[origin]]
        packed = np.packbits(mask, bitorder="little").tobytes()
        topology.append(packed)
        blocks.append(packed + b"\0" + _pack_block(leaves.values[rows[origin]][mask].tobytes()))

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
    for origin in rows:
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


def find_index_to_world(volume: SparseVolumeData, to_world: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) from indices to the world. Index 0 is the first voxel of the first brick."""
    steps = to_world[:3, :3] / np.asarray(volume.shape[::-1])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = steps, to_world[:3, 3] + steps @ (0.5 - np.array(volume.offset[::-1]))
    return matrix


def _pack_transform(matrix: np.ndarray) -> bytes:
    """The matrix from indices to the world, as OpenVDB multiplies it: rows from the left."""
    return _pack_text("AffineMap") + struct.pack("<16d", *matrix.T.ravel())


# -- NanoVDB -----------------------------------------------------------------------------------------------------------

NANOVDB_VERSION = 32 << 21 | 4 << 10

#: box, range and breadth first, among the flags of a grid.
FLAGS = 2 | 4 | 32

#: channels -> number of the type and of the class: fog volumes are grids of numbers, colours have no class.
NANOVDB_TYPES = {1: (1, 2), 3: (6, 0)}


def write_nvdb(file: BinaryIO, values: np.ndarray | SparseVolumeData, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a fog volume in float32, uncompressed: the grid ``density`` of numbers, or ``color`` of three channels.

    Voxels of the value 0 are off, and blocks of 8^3 such voxels take no space.

    Args, raises: as of :func:`write_vdb`.
    """
    volume, name = check_fog(values, metadata, ".nvdb")
    write_nvdb_grids(file, {name: (volume, to_world)})


def write_nvdb_grids(file: BinaryIO, grids: dict[str, tuple[SparseVolumeData, np.ndarray]]) -> None:
    """Write several grids, each in a segment of its own, by their names."""
    for name, (volume, to_world) in grids.items():
        _write_segment(file, name, volume, to_world)


def _write_segment(file: BinaryIO, name: str, volume: SparseVolumeData, to_world: np.ndarray) -> None:
    kind, grid_class = NANOVDB_TYPES[volume.channels]
    layout, leaves = LAYOUTS[kind], cut_leaves(volume)
    levels = _stack_levels(leaves)
    offsets, size = _place_levels(layout, levels)
    low, high = leaves.low.min(axis=0), leaves.high.max(axis=0)
    count = int(np.count_nonzero(leaves.masks))
    matrix = find_index_to_world(volume, to_world)
    nodes = [len(level.origins) for level in levels]
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low + 1) + low
    corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
    world_box = np.stack([corners.min(axis=0), corners.max(axis=0)]).astype("<f8").tobytes()
    voxel = np.linalg.norm(matrix[:3, :3], axis=0).astype("<f8").tobytes()

    text = name.encode()
    box = struct.pack("<6i", *low, *high)
    facts = struct.pack("<4Q2I", size, size, _hash_name(text), count, kind, grid_class) + world_box + box + voxel
    facts += struct.pack("<I4I3I2HI", len(text) + 1, *nodes, 1, 0, 0, 0, 0, 0, NANOVDB_VERSION)
    assert len(facts) == FACTS
    head = (
        b"NanoVDB0" + struct.pack("<Q2I2IQ", (1 << 64) - 1, NANOVDB_VERSION, FLAGS, 0, 1, size) + text[:255].ljust(256, b"\0")
    )
    head += _pack_map(matrix) + world_box + voxel + struct.pack("<2I", grid_class, kind)
    tree = struct.pack("<4Q6IQ", *offsets, *nodes, 0, 0, 0, count)
    file.write(struct.pack("<8sI2H", b"NanoVDB0", NANOVDB_VERSION, 1, 0) + facts + text + b"\0")
    file.write(head.ljust(GRID_HEAD, b"\0") + tree + _pack_root(layout, levels[2], box, offsets))
    file.write(_pack_inner(layout, 2, levels, offsets).data)
    file.write(_pack_inner(layout, 1, levels, offsets).data)
    file.write(_pack_leaves(layout, leaves).data)


class _Level:
    """The nodes of a level below their parents, in the order of the file.

    Attributes:
        origins: index of the first voxel of each node (n, 3).
        parents: row of the parent of each node.
        low, high: box of its active voxels (n, 3).
        minimum, maximum: range of its active values (n, C).
    """

    def __init__(self, origins: np.ndarray, below: Leaves | _Level, rows: np.ndarray) -> None:
        self.origins, self.parents = origins, np.zeros(len(origins), np.int64)
        begins = np.flatnonzero(np.diff(rows, prepend=-1))
        self.low, self.high = np.minimum.reduceat(below.low, begins), np.maximum.reduceat(below.high, begins)
        self.minimum = np.minimum.reduceat(below.minimum, begins)
        self.maximum = np.maximum.reduceat(below.maximum, begins)


def _stack_levels(leaves: Leaves) -> list[Leaves | _Level]:
    """Leaves, lower and upper nodes; the leaves are sorted in place, parent by parent."""
    edges = [edge * children for children, edge in INNER]
    keys = [(leaves.origins // edge)[:, axis] for edge in (EDGE, *edges) for axis in (2, 1, 0)]
    leaves.sort(np.lexsort(keys))
    levels: list[Leaves | _Level] = [leaves]
    for edge in edges:
        below = levels[-1]
        origins = below.origins // edge * edge
        is_first = np.ones(len(origins), bool)
        is_first[1:] = (np.diff(origins, axis=0) != 0).any(axis=1)
        below.parents = np.cumsum(is_first) - 1
        levels.append(_Level(origins[is_first], below, below.parents))
    return levels


def _place_levels(layout: Layout, levels: list[Leaves | _Level]) -> tuple[tuple[int, ...], int]:
    """Offsets of leaves, lower and upper nodes and the root from the head of the tree, and the size of the grid."""
    root = TREE_HEAD
    upper = root + layout.root + layout.tile * len(levels[2].origins)
    lower = upper + layout.inner(INNER[1][0]) * len(levels[2].origins)
    leaf = lower + layout.inner(INNER[0][0]) * len(levels[1].origins)
    return (leaf, lower, upper, root), GRID_HEAD + leaf + layout.leaf() * len(levels[0].origins)


def _pack_root(layout: Layout, uppers: _Level, box: bytes, offsets: tuple[int, ...]) -> bytes:
    root = bytearray(layout.root)
    root[:28] = box + struct.pack("<I", len(uppers.origins))
    at = layout.background + layout.value
    for value in (uppers.minimum.min(axis=0), uppers.maximum.max(axis=0)):
        root[at : at + layout.value] = value.tobytes()
        at += layout.value
    tiles = []
    # A key holds the bits of z, y and x above those of an upper node, as unsigned numbers of 32 bits.
    keys = (uppers.origins & 0xFFFFFFFF) >> 12
    numbers = [int(x) << 42 | int(y) << 21 | int(z) for x, y, z in keys]
    for row in np.argsort(numbers):
        child = offsets[2] + layout.inner(INNER[1][0]) * int(row) - offsets[3]
        tiles.append(struct.pack("<Qq", numbers[row], child).ljust(layout.tile, b"\0"))
    return bytes(root) + b"".join(tiles)


def _pack_inner(layout: Layout, level: int, levels: list[Leaves | _Level], offsets: tuple[int, ...]) -> np.ndarray:
    """The bytes (nodes, size) of a level of inner nodes."""
    (children, edge), nodes, below = INNER[level - 1], levels[level], levels[level - 1]
    size, count = layout.inner(children), len(nodes.origins)
    packed = np.zeros((count, size), np.uint8)
    _set(packed, 0, np.concatenate([nodes.low, nodes.high], axis=1).astype("<i4"))
    steps = (below.origins - nodes.origins[below.parents]) // edge
    places = np.ravel_multi_index(steps.T, (children,) * 3)
    has_child = np.zeros((count, children**3), bool)
    has_child[below.parents, places] = True
    bits, at = children**3 // 8, 32
    _set(packed, at + bits, np.packbits(has_child, axis=1, bitorder="little"))
    _set(packed, at + 2 * bits, np.concatenate([nodes.minimum, nodes.maximum], axis=1))
    below_size = layout.leaf() if level == 1 else layout.inner(INNER[level - 2][0])
    begins = offsets[level] + size * below.parents
    ways = offsets[level - 1] + below_size * np.arange(len(below.origins)) - begins
    columns = layout.table(children) + layout.entry * places
    packed[below.parents[:, None], columns[:, None] + np.arange(8)] = ways.astype("<i8")[:, None].view(np.uint8)
    return packed


def _pack_leaves(layout: Layout, leaves: Leaves) -> np.ndarray:
    packed = np.zeros((len(leaves.origins), layout.leaf()), np.uint8)
    _set(packed, 0, leaves.low.astype("<i4"))
    packed[:, 12:15] = leaves.high - leaves.low
    packed[:, 15] = 2  # The box is known.
    _set(packed, 16, np.packbits(leaves.masks, axis=1, bitorder="little"))
    _set(packed, 80, np.concatenate([leaves.minimum, leaves.maximum], axis=1))
    _set(packed, layout.values, leaves.values.reshape(len(packed), -1))
    return packed


def _set(packed: np.ndarray, at: int, values: np.ndarray) -> None:
    """Write the bytes of the rows of an array."""
    content = np.ascontiguousarray(values).view(np.uint8)
    packed[:, at : at + content.shape[1]] = content


def _pack_map(matrix: np.ndarray) -> bytes:
    """The map from indices to the world and its inverse, in float and in double."""
    inverse = np.linalg.inv(matrix[:3, :3])
    numbers = [*matrix[:3, :3].ravel(), *inverse.ravel(), *matrix[:3, 3], 1.0]
    return struct.pack("<22f", *numbers) + struct.pack("<22d", *numbers)


def _hash_name(text: bytes) -> int:
    """The number by which a reader finds a grid of a name."""
    key = 0
    for byte in text:
        key = (key * 67 + byte + (key >> 56)) & (1 << 64) - 1
    return key
