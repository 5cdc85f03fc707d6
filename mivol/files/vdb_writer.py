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
from mivol.files.vdb import ACTIVE_VALUES, LEAF, LEVELS, MAGIC, ZIP, Coord

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
