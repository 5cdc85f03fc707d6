"""Fog volumes of OpenVDB (``.vdb``): dense or sparse grids, written as trees of leaves.

Conventions. As in :mod:`mivol.files.vdb`. Files have version 224 of the format.
"""

from __future__ import annotations

import struct
import uuid
import zlib
from typing import Any, BinaryIO

import numpy as np

from mivol.files.source import refusal
from mivol.files.sparse_volume import SparseVolumeData
from mivol.files.vdb import ACTIVE_VALUES, LEAF, LEVELS, MAGIC, ZIP, Coord, Node, find_active_box


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
    names = {1: ("float", "density"), 3: ("vec3s", "color")}
    volume = values if isinstance(values, SparseVolumeData) else SparseVolumeData.from_dense(values)
    channels = volume.channels
    if channels not in names:
        way_out = "write one file for each channel, or a .npz"
        raise refusal("write_volume", f"{channels} channels for a .vdb file", "1 or 3", way_out)
    if rest := set(metadata) - {"grid"}:
        found = f"metadata {', '.join(sorted(rest))} for a .vdb file"
        raise refusal("write_volume", found, "at most the key grid", "write .npz, or remove the metadata")
    if not volume.values.any():
        raise refusal("write_volume", "nothing but zeros for a .vdb file", "a voxel with another value", "write .npz")
    kind, name = names[channels]
    name = str(metadata.get("grid", name))
    leaves = _cut_leaves(volume)
    topology, blocks = _pack_tree(leaves, channels)
    low, high, count = find_active_box([Node(origin, LEAF, None, _pack_mask(mask)) for origin, (mask, _) in leaves.items()])
    facts = [
        ("name", "string", name.encode()),
        ("class", "string", b"fog volume"),
        ("file_bbox_min", "vec3i", struct.pack("<3i", *low)),
        ("file_bbox_max", "vec3i", struct.pack("<3i", *high)),
        ("file_voxel_count", "int64", struct.pack("<q", count)),
    ]
    grid = struct.pack("<I", ZIP | ACTIVE_VALUES) + _pack_metadata(facts) + _pack_transform(volume, to_world)
    head = MAGIC + struct.pack("<3I?", 224, 10, 0, True) + str(uuid.uuid4()).encode()
    head += _pack_metadata([("creator", "string", b"mivol")]) + struct.pack("<I", 1)
    head += _pack_text(name) + _pack_text(f"Tree_{kind}_5_4_3") + _pack_text("")
    begin = len(head) + 24
    after_topology = begin + len(grid) + len(topology)
    file.write(head + struct.pack("<3q", begin, after_topology, after_topology + len(blocks)) + grid + topology + blocks)


def _cut_leaves(volume: SparseVolumeData) -> dict[Coord, tuple[np.ndarray, np.ndarray]]:
    """The leaves with a value other than 0: origin (x, y, z) -> (mask, values), both of 8^3 voxels, x slowest."""
    leaves = {}
    for place, block in zip(volume.bricks, volume.values, strict=True):
        values = np.ascontiguousarray(block.transpose(2, 1, 0, 3), "<f4")
        mask = (values != 0).any(axis=3)
        if mask.any():
            leaves[tuple(LEAF * int(k) for k in place[::-1])] = (mask, values)
    return leaves


def _pack_tree(leaves: dict[Coord, tuple[np.ndarray, np.ndarray]], channels: int) -> tuple[bytes, bytes]:
    """The topology of a tree with these leaves, and their values in the same order."""
    topology, blocks = [struct.pack("<I", 1), bytes(4 * channels)], []

    def add_leaf(origin: Coord) -> None:
        mask, values = leaves[origin]
        packed = _pack_mask(mask)
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


def _pack_mask(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


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


def _pack_transform(volume: SparseVolumeData, to_world: np.ndarray) -> bytes:
    """The matrix from indices to the world, as OpenVDB multiplies it: rows from the left. Index 0 is the first of a brick."""
    steps = to_world[:3, :3] / np.asarray(volume.shape[::-1])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = steps, to_world[:3, 3] + steps @ (0.5 - np.array(volume.offset[::-1]))
    return _pack_text("AffineMap") + struct.pack("<16d", *matrix.T.ravel())
