"""NanoVDB files: made here byte by byte as the layout of version 32 says (Museth 2021), made by NanoVDB, and our own.

``nanovdb_32.nvdb.gz`` holds grids that NanoVDB 32.4.2 wrote: of six types by its ``GridBuilder``, of four quantised types and
with Blosc and zip by ``nanovdb_convert``. All have five voxels, (3 i - 6, i % 2, 2 - i) for i = 0 to 4.
"""

from __future__ import annotations

import gzip
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
from conformance.test_bad_files import refused
from hypothesis import given, settings
from hypothesis import strategies as st

import mivol
from mivol.files import SparseVolumeData, check_bricks, read_sparse_volume, read_volume, write_volume

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
        (lambda: file_of({"density": grid()}, codec=2), "announced at byte"),
        (lambda: file_of({"density": grid()}, version=29), "version 29"),
        (lambda: file_of({"density": grid(background=1.0)}), "the value [1.0] outside of the grid"),
        (lambda: file_of({"density": grid()[:636] + struct.pack("<I", 19) + grid()[640:]}), "type index of NanoVDB's"),
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


# -- Files of NanoVDB ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def nanovdb_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("nvdb") / "nanovdb_32.nvdb"
    path.write_bytes(gzip.decompress((Path(__file__).parent / "nanovdb_32.nvdb.gz").read_bytes()))
    return path


COUNTED = np.arange(1, 6, dtype=np.float32)[:, None]
TENTHS = np.float32(0.1) * COUNTED
WRITTEN = {
    **dict.fromkeys(("float", "double", "int32", "int64"), COUNTED),
    **{name: np.column_stack([COUNTED, 0 * COUNTED + 2, 0 * COUNTED + 3]) for name in ("vec3f", "vec3d")},
    **dict.fromkeys(("fp4", "fp8", "fp16", "fpN", "blosc", "zip"), TENTHS),
}
"""Name of the grid: values (5, C). Each of the two leaves is quantised between its own extremes, 0 and the largest tenth."""


@pytest.mark.parametrize("name", WRITTEN)
def test_a_grid_of_nanovdb(nanovdb_file: Path, name: str) -> None:
    volume = read_volume(nanovdb_file, name)
    x, y, z = np.array([(3 * i - 6, i % 2, 2 - i) for i in range(5)]).T
    found = volume.values[z + 2, y, x + 6]
    # fpN keeps half a step of its codes of 1 to 16 bits, the others hit these numbers; a product and a sum round twice.
    tolerance = {"fpN": 1e-2, **dict.fromkeys(("fp4", "fp8", "fp16"), 2**-24 + 2**-17)}.get(name, 0)
    np.testing.assert_allclose(found, WRITTEN[name], rtol=0, atol=tolerance)
    assert np.count_nonzero(volume.values.any(axis=3)) == 5
    np.testing.assert_allclose(volume.origin, np.array([1, 2, 3]) + 0.5 * np.array([-6, 0, -2]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(volume.steps, 0.5 * np.eye(3), rtol=0, atol=1e-12)


# -- Our own files -------------------------------------------------------------------------------------------------------


def make_patches(seed: int, channels: int, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Values (Z, Y, X, C) of which half are 0, with a NaN and full corners, and a place."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(*shape, channels)).astype(np.float32) * (rng.random((*shape, 1)) < 0.5)
    values[0, 0, 0] = values[-1, -1, -1] = 1
    values[tuple(rng.integers(shape))] = np.nan
    to_world = np.eye(4)
    to_world[:3] += rng.normal(size=(3, 4)) / 4
    return values, to_world


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3]), st.tuples(*[st.integers(1, 20)] * 3))
@settings(max_examples=15, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, seed: int, channels: int, shape: tuple[int, int, int]) -> None:
    values, to_world = make_patches(seed, channels, shape)
    path = tmp_path_factory.mktemp("nvdb") / "a.nvdb"
    write_volume(path, values, to_world)
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.to_world, to_world, rtol=0, atol=1e-12)


def test_leaves_far_apart(tmp_path: Path) -> None:
    """Voxels in several lower and upper nodes, whose order in the file is that of their places."""
    path, values = tmp_path / "far.nvdb", np.zeros((5, 8, 8, 8, 1), np.float32)
    values[:, 3, 4, 5, 0] = [1, 2, 3, 4, 5]
    places = np.array([[0, 0, 0], [0, 0, 16], [0, 520, 1], [7, 0, 1100], [1200, 513, 2]], np.int32)
    far = SparseVolumeData(values, places, (9608, 4168, 8808), np.eye(4))
    write_volume(path, far, metadata={"grid": "heat"})
    found = read_sparse_volume(path, "heat")
    origin = (places - found.bricks)[0]
    assert np.array_equal(found.bricks, places - origin) and found.values.max() == 5 and np.count_nonzero(found.values) == 5
    assert np.array_equal(found.values.max(axis=(1, 2, 3, 4)), [1, 2, 3, 4, 5])


def test_the_head_of_a_file_is_nanovdbs(nanovdb_file: Path, tmp_path: Path) -> None:
    """Facts by which other programs find a grid: the hash of its name, its type, and its boxes in the world and in voxels."""
    values = np.zeros((5, 2, 13, 1), np.float32)
    for i in range(5):
        values[4 - i, i % 2, 3 * i] = i + 1
    place = np.diag([6.5, 1, 2.5, 1])
    place[:3, 3] = np.array([1, 2, 3]) - 0.25
    write_volume(tmp_path / "a.nvdb", values, place, metadata={"grid": "float"})
    ours, theirs = (path.read_bytes()[16 : 16 + 176] for path in (tmp_path / "a.nvdb", nanovdb_file))
    assert ours[16:36] == theirs[16:36]  # hash, active voxels, type
    box = np.frombuffer(theirs[40:88], "<f8").reshape(2, 3) + 0.5 * np.array([6, 0, 2])  # our indices begin at 0
    np.testing.assert_allclose(np.frombuffer(ours[40:88], "<f8").reshape(2, 3), box, rtol=0, atol=1e-12)
    assert np.array_equal(np.frombuffer(ours[88:112], "<i4"), [0, 0, 0, 12, 1, 4])


@pytest.mark.slow
@pytest.mark.parametrize("channels", [1, 3])
def test_nanovdb_takes_what_we_write(tmp_path: Path, channels: int) -> None:
    """NanoVDB's own validation, and OpenVDB's file of the same values, converted by NanoVDB."""
    if shutil.which("nanovdb_validate") is None:
        pytest.skip("no nanovdb_validate (sudo apt install libnanovdb-tools)")
    values, to_world = make_patches(0, channels, (20, 30, 140))
    values = np.nan_to_num(values)
    for name in ("a.nvdb", "a.vdb"):
        write_volume(tmp_path / name, values, to_world)
    for words in ("nanovdb_validate a.nvdb", "nanovdb_convert a.vdb b.nvdb", "nanovdb_convert a.nvdb b.vdb"):
        done = subprocess.run(words.split(), cwd=tmp_path, check=True, capture_output=True, text=True)
        assert "fail" not in (done.stdout + done.stderr).lower()
    np.testing.assert_array_equal(read_volume(tmp_path / "b.vdb").values, values)  # its transform is transposed: not compared
    both = [read_volume(tmp_path / name) for name in ("a.nvdb", "b.nvdb")]
    np.testing.assert_array_equal(both[0].values, values)
    np.testing.assert_array_equal(both[1].values, values)
    np.testing.assert_allclose(both[0].to_world, both[1].to_world, rtol=0, atol=1e-12)


def test_a_long_name_has_the_hash_of_nanovdb(tmp_path: Path) -> None:
    """The number is that of NanoVDB 32.4.2; a reader finds no grid of another number."""
    write_volume(tmp_path / "a.nvdb", np.ones((1, 1, 1)), metadata={"grid": "temperature_of_the_flame"})
    assert struct.unpack_from("<Q", (tmp_path / "a.nvdb").read_bytes(), 32) == (15057899901529382897,)
