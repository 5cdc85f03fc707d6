"""NanoVDB files, written here byte by byte as the layout of version 32 says (Museth 2021), since no package writes them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from conformance.test_bad_files import refused

import mivol
from mivol.files import check_bricks, read_sparse_volume, read_volume

MATRIX = np.array([[0.5, 0, 0], [0, 0, 0.25], [0, -2.0, 0]])
SHIFT = np.array([1.0, 2.0, 3.0])
LOW, HIGH = (-3, 2, 5), (140, 9, 20)
"""Of the active voxels, (x, y, z)."""


def leaf_values(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 2, (8, 8, 8))


LEAVES = {(-8, 0, 0): leaf_values(1), (136, 0, 16): leaf_values(2)}
"""Origin: values (x, y, z)."""

TILE, TILE_VALUE = (0, 0, 8), 1.25
"""A constant region of 8^3 voxels."""


def mask_of(count: int, bits: list[int]) -> bytes:
    on = np.zeros(count, np.uint8)
    on[bits] = 1
    return np.packbits(on, bitorder="little").tobytes()


def grid(kind: int = 1, background: float = 0.0, grid_class: int = 2, scale: float = 1.0) -> bytes:
    """A grid of float (1) or double (2): two leaves and a tile in three lower nodes below two upper ones."""
    code, tile_at, root_size, leaf_size = {1: ("f", 20, 64, 2144), 2: ("d", 24, 96, 4224)}[kind]
    values_at = {1: 96, 2: 128}[kind]
    leaves = b""
    for origin, values in LEAVES.items():
        head = struct.pack("<3i4B", *origin, 7, 7, 7, 0) + b"\xff" * 64
        block = (values * scale).astype("<f4" if kind == 1 else "<f8").tobytes()
        leaves += head.ljust(values_at, b"\0") + block
    assert len(leaves) == 2 * leaf_size

    def inner(origin: tuple, children: int, size: int, table: int, child: list[int], on: list[int], value: float) -> bytes:
        entries = np.zeros((children**3, 8), np.uint8)
        entries[:, : 4 * kind] = np.frombuffer(struct.pack("<" + code, background), np.uint8)
        for k in on:
            entries[k, : 4 * kind] = np.frombuffer(struct.pack("<" + code, value), np.uint8)
        masks = mask_of(children**3, on) + mask_of(children**3, child)
        head = struct.pack("<6iQ", *origin, *origin, 0) + masks
        return (head.ljust(table, b"\0") + entries.tobytes()).ljust(size, b"\0")

    def place(origin: tuple, node: tuple, edge: int, children: int) -> int:
        x, y, z = ((a - b) // edge for a, b in zip(origin, node, strict=True))
        return (x * children + y) * children + z

    lower = b"".join(
        [
            inner((-8, 0, 0), 16, 33856, 1088, [place((-8, 0, 0), (-128, 0, 0), 8, 16)], [], 0),
            inner((0, 0, 8), 16, 33856, 1088, [], [place(TILE, (0, 0, 0), 8, 16)], TILE_VALUE * scale),
            inner((136, 0, 16), 16, 33856, 1088, [place((136, 0, 16), (128, 0, 0), 8, 16)], [], 0),
        ]
    )
    upper = inner((-8, 0, 0), 32, 270400, 8256, [place((-128, 0, 0), (-4096, 0, 0), 128, 32)], [], 0)
    upper += inner((0, 0, 8), 32, 270400, 8256, [0, place((128, 0, 0), (0, 0, 0), 128, 32)], [], 0)
    tiles = b""
    for origin in ((-4096, 0, 0), (0, 0, 0)):
        x, y, z = ((c & 0xFFFFFFFF) >> 12 for c in origin)
        tiles += (struct.pack("<QqI", x << 42 | y << 21 | z, 1, 0).ljust(tile_at, b"\0")).ljust(32, b"\0")
    root_head = struct.pack("<6iI", *LOW, *HIGH, 2).ljust(28 if kind == 1 else 32, b"\0") + struct.pack("<" + code, background)
    root = root_head.ljust(root_size, b"\0") + tiles
    at_root = 64
    at_upper = at_root + len(root)
    at_lower, at_leaves = at_upper + len(upper), at_upper + len(upper) + len(lower)
    tree = struct.pack("<4q3I3IQ", at_leaves, at_lower, at_upper, at_root, 2, 3, 2, 1, 0, 0, 0)
    place_map = struct.pack("<18f3ff", *18 * [0], *3 * [0], 0)
    place_map += struct.pack("<9d9d3dd", *MATRIX.ravel(), *9 * [0.0], *SHIFT, 1.0)
    body = tree + root + upper + lower + leaves
    size = 672 + len(body)
    head = b"NanoVDB1" + struct.pack("<QIIIIQ", 0, 32 << 21, 0, 0, 1, size) + b"\0" * 256 + place_map
    head += b"\0" * 72 + struct.pack("<II", grid_class, kind)
    return head.ljust(672, b"\0") + body


def file_of(grids: dict[str, bytes], codec: int = 0, magic: bytes = b"NanoVDB2", version: int = 32) -> bytes:
    """A segment of named grids."""
    facts, blocks = b"", b""
    for name, whole in grids.items():
        block = whole
        if codec == 1:
            short = zlib.compress(whole)
            block = struct.pack("<Q", len(short)) + short
        fact = struct.pack("<4Q2I", len(whole), len(block), 0, 0, 1, 2).ljust(136, b"\0") + struct.pack("<I", len(name) + 1)
        facts += (fact.ljust(168, b"\0") + struct.pack("<HHI", codec, 0, version << 21)) + name.encode() + b"\0"
        blocks += block
    return struct.pack("<8sIHH", magic, version << 21, len(grids), codec) + facts + blocks


def truth(scale: float = 1.0) -> np.ndarray:
    """The dense box (Z, Y, X) of the grid."""
    values = np.zeros((150, 32, 32))
    for origin, block in LEAVES.items():
        x, y, z = (o - a for o, a in zip(origin, (-8, 0, 0), strict=True))
        values[x : x + 8, y : y + 8, z : z + 8] = block[: 150 - x]
    values[8:16, 0:8, 8:16] = TILE_VALUE
    box = tuple(slice(a - o, b - o + 1) for a, b, o in zip(LOW, HIGH, (-8, 0, 0), strict=True))
    return (values[box].transpose(2, 1, 0) * scale).astype(np.float32)


@pytest.mark.parametrize(("codec", "kind", "magic"), [(0, 1, b"NanoVDB2"), (1, 1, b"NanoVDB0"), (1, 2, b"NanoVDB2")])
def test_values_and_places(tmp_path: Path, codec: int, kind: int, magic: bytes) -> None:
    path = tmp_path / "smoke.nvdb"
    path.write_bytes(file_of({"density": grid(kind)}, codec, magic))
    sparse, dense = read_sparse_volume(path), read_volume(path)
    assert np.array_equal(dense.values[..., 0], truth())
    assert np.array_equal(sparse.dense(), dense.values) and len(sparse.values) == 3
    check_bricks(sparse, name="smoke")
    assert np.allclose(dense.origin, MATRIX @ LOW + SHIFT, rtol=0, atol=1e-12)
    assert np.allclose(dense.steps, MATRIX, rtol=0, atol=1e-12)
    assert sparse.meta["grid"] == "density" and sparse.meta["class"] == "fog volume"


def test_a_grid_is_chosen_by_name(tmp_path: Path) -> None:
    path = tmp_path / "two.nvdb"
    path.write_bytes(file_of({"density": grid(), "heat": grid(scale=2.0)}) + file_of({"density": grid(scale=3.0)}))
    for name, scale in (("density", 1.0), ("heat", 2.0), ("density[1]", 3.0)):
        assert np.array_equal(read_volume(path, name).values[..., 0], truth(scale))
    with refused("found 3 arrays ('density', 'heat', 'density[1]')"):
        read_volume(path)


def test_a_level_set_becomes_a_fog(tmp_path: Path) -> None:
    """Distances of the leaves are 0.5 to 2 of a band of 4, negative inside."""
    path = tmp_path / "ball.nvdb"
    path.write_bytes(file_of({"ball": grid(background=4.0, grid_class=1, scale=-1.0)}))
    volume = read_volume(path)
    np.testing.assert_allclose(volume.values[..., 0], truth() / 4, rtol=1e-6)
    assert volume.meta["band"] == 4


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: file_of({"density": grid()})[:-100], "truncated"),
        (lambda: file_of({"density": grid()}, codec=2), "compressed with Blosc"),
        (lambda: file_of({"density": grid()}, version=29), "version 29"),
        (lambda: file_of({"density": grid(background=1.0)}), "the value 1 outside of the grid"),
        (lambda: file_of({"density": grid()[:636] + struct.pack("<I", 13) + grid()[640:]}), "type 13"),
        (lambda: file_of({"density": grid()}) + b"NanoVDB2", "truncated"),
    ],
    ids=["cut", "blosc", "version", "background", "type", "segment"],
)
def test_what_is_not_read_is_named(tmp_path: Path, data: object, words: str) -> None:
    path = tmp_path / "bad.nvdb"
    path.write_bytes(data())
    with refused(words):
        read_sparse_volume(path)


def test_a_plugin_reads_it(tmp_path: Path, variant_rgb: None) -> None:
    import mitsuba as mi

    path = tmp_path / "smoke.nvdb"
    path.write_bytes(file_of({"density": grid()}))
    volume = mi.load_dict({"type": "mivol_voxels", "filename": str(path), "use_grid_bbox": True, "storage": "sparse"})
    assert volume.mivol_bricks.count == 3 and "3 bricks" in mivol.files.formats.describe_volume(path)
