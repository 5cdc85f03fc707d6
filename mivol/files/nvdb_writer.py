"""Fog volumes of NanoVDB (``.nvdb``): dense or sparse grids, written as one block of memory.

Conventions. As in :mod:`mivol.files.nvdb`. Files have version 32.4 of the layout, no compression and no checksum. Nodes lie
level by level; each says the box and the range of its active values.
"""

from __future__ import annotations

import struct
from typing import Any, BinaryIO

import numpy as np

from mivol.files.nvdb import FACTS, GRID_HEAD, INNER, LAYOUTS, TREE_HEAD, Layout
from mivol.files.sparse_volume import EDGE, SparseVolumeData
from mivol.files.vdb_writer import Leaves, check_fog, cut_leaves, find_index_to_world

VERSION = 32 << 21 | 4 << 10

#: box, range and breadth first, among the flags of a grid.
FLAGS = 2 | 4 | 32

#: channels -> number of the type and of the class: fog volumes are grids of numbers, colours have no class.
TYPES = {1: (1, 2), 3: (6, 0)}


def write_nvdb(file: BinaryIO, values: np.ndarray | SparseVolumeData, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write a fog volume in float32, uncompressed: the grid ``density`` of numbers, or ``color`` of three channels.

    Voxels of the value 0 are off, and blocks of 8^3 such voxels take no space.

    Args, raises: as of :func:`mivol.files.vdb_writer.write_vdb`.
    """
    volume, name = check_fog(values, metadata, ".nvdb")
    write_nvdb_grids(file, {name: (volume, to_world)})


def write_nvdb_grids(file: BinaryIO, grids: dict[str, tuple[SparseVolumeData, np.ndarray]]) -> None:
    """Write several grids, each in a segment of its own, by their names."""
    for name, (volume, to_world) in grids.items():
        _write_segment(file, name, volume, to_world)


def _write_segment(file: BinaryIO, name: str, volume: SparseVolumeData, to_world: np.ndarray) -> None:
    kind, grid_class = TYPES[volume.channels]
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
    facts += struct.pack("<I4I3I2HI", len(text) + 1, *nodes, 1, 0, 0, 0, 0, 0, VERSION)
    assert len(facts) == FACTS
    head = b"NanoVDB0" + struct.pack("<Q2I2IQ", (1 << 64) - 1, VERSION, FLAGS, 0, 1, size) + text[:255].ljust(256, b"\0")
    head += _pack_map(matrix) + world_box + voxel + struct.pack("<2I", grid_class, kind)
    tree = struct.pack("<4Q6IQ", *offsets, *nodes, 0, 0, 0, count)
    file.write(struct.pack("<8sI2H", b"NanoVDB0", VERSION, 1, 0) + facts + text + b"\0")
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
