"""OpenVDB files: one written by OpenVDB 10.0.1, our own, and both libraries on each other's files.

``openvdb_10.vdb.gz`` holds the grids of :data:`GRIDS`, written by Debian's ``python3-openvdb`` with Blosc: single voxels,
a filled region (which makes active tiles), values truncated to half, a level set by ``createLevelSetSphere``. Values are
compared exactly, because all of them are float32 or half.
"""

from __future__ import annotations

import gzip
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conformance.test_bad_files import refused
from hypothesis import given, settings
from hypothesis import strategies as st

import mivol
from mivol.files import SparseVolumeData, check_bricks, read_sparse_volume, read_volume, vdb, write_volume

PLACED = np.array([[0.5, 0, 0, 1], [0, 0, -0.5, 2], [0, 0.25, 0, 3], [0, 0, 0, 1]])
"""Index to world of the first grid: x of the index runs along x, y along z, z against y."""


def _density() -> np.ndarray:
    """The first grid (X, Y, Z), whose first voxel has the index (-9, 0, 0)."""
    values = np.zeros((33, 24, 24), np.float32)
    for i, j, k in [(-9, 2, 3), (-1, 0, 0), (0, 0, 0), (7, 9, 4), (20, 3, 1)]:
        values[i + 9, j, k] = 1 + (i + 2 * j + 4 * k) % 7 / 8
    values[17:, 8:, 8:] = 2.5
    return values[..., None]


def _few(shape: tuple[int, ...], voxels: dict[tuple[int, int, int], object]) -> np.ndarray:
    values = np.zeros(shape, np.float32)
    for index, value in voxels.items():
        values[index] = value
    return values


GRIDS: dict[str, tuple[np.ndarray, tuple[int, int, int]]] = {
    "density": (_density(), (-9, 0, 0)),
    "density[1]": (_few((2, 1, 1, 1), {(0, 0, 0): -4, (1, 0, 0): 0.5}), (1, 2, 3)),
    "half": (_few((6, 1, 1, 1), {(0, 0, 0): np.float16(0.1), (5, 0, 0): 2}), (0, 0, 0)),
    "mask": (_few((3, 2, 1, 1), {(0, 0, 0): 1, (2, 1, 0): 1}), (0, 0, 0)),
    "color": (_few((2, 1, 3, 3), {(0, 0, 0): (1, 2, 3), (1, 0, 2): (-4, 5, 6)}), (0, 0, 0)),
}
"""Name: values (X, Y, Z, C), index of the first voxel."""


@pytest.fixture(scope="module")
def openvdb_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vdb") / "openvdb_10.vdb"
    path.write_bytes(gzip.decompress((Path(__file__).parent / "openvdb_10.vdb.gz").read_bytes()))
    return path


# -- A file of OpenVDB ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_of_openvdb(openvdb_file: Path, name: str) -> None:
    values, first = GRIDS[name]
    volume = read_volume(openvdb_file, name)
    np.testing.assert_array_equal(volume.values, values.transpose(2, 1, 0, 3))
    index_to_world = PLACED if name == "density" else np.eye(4)
    np.testing.assert_allclose(volume.origin, index_to_world[:3, :3] @ first + index_to_world[:3, 3], atol=1e-13)
    np.testing.assert_allclose(volume.steps, index_to_world[:3, :3], atol=1e-13)
    assert volume.meta["index_min"] == first


def test_a_level_set_becomes_a_fog(openvdb_file: Path) -> None:
    """Ball of radius 1, voxels of 0.5, band of 2 voxels: 1 at a depth of 1. OpenVDB stores distances in float32."""
    volume = read_volume(openvdb_file, "ball")
    z, y, x = np.indices(volume.values.shape[:3]) * 0.5 - 1.5
    depth = 1 - np.sqrt(x**2 + y**2 + z**2)
    np.testing.assert_allclose(volume.values[..., 0], np.clip(depth, 0, 1), atol=2 * np.finfo(np.float32).eps)
    assert volume.meta["band"] == 1


@pytest.mark.parametrize("name", [*GRIDS, "ball"])
def test_bricks_hold_what_the_dense_box_holds(openvdb_file: Path, name: str) -> None:
    """Tiles, values of inactive voxels, the fog of a level set, and boxes that begin inside of a leaf."""
    dense, sparse = read_volume(openvdb_file, name), read_sparse_volume(openvdb_file, name)
    assert np.array_equal(sparse.dense(), dense.values)
    assert np.array_equal(sparse.to_world, dense.to_world) and sparse.meta == dense.meta
    check_bricks(sparse, name=name, minimum=None)
    assert sparse.values.any(axis=(1, 2, 3, 4)).all()


def test_bricks_never_need_the_dense_box(tmp_path: Path) -> None:
    """Two voxels 4 million voxels apart: the dense box would have 2^66 voxels."""
    path, values = tmp_path / "far.vdb", np.zeros((2, 8, 8, 8, 1), np.float32)
    values[0, 0, 0, 0], values[1, 7, 7, 7] = 1, 2
    far = SparseVolumeData(values, np.array([[0, 0, 0], [2**19 - 1] * 3], np.int32), (2**22,) * 3, np.eye(4))
    write_volume(path, far)
    with refused("expected at most the free memory"):
        read_volume(path)
    found = read_sparse_volume(path)
    assert found.shape == far.shape and np.array_equal(found.values, values) and np.array_equal(found.bricks, far.bricks)
    assert np.allclose(found.to_world, np.eye(4), rtol=0, atol=1e-9)


def test_a_sparse_volume_is_written_as_its_dense_twin(tmp_path: Path) -> None:
    values = np.zeros((9, 20, 17, 1), np.float32)
    values[8, 19, 16] = values[0, 3, 5] = 1
    place = np.array([[2.0, 0, 0.5, 1], [0, 3, 0, -2], [0, 0, 4, 0.5], [0, 0, 0, 1]])
    write_volume(tmp_path / "dense.vdb", values, place)
    whole = SparseVolumeData.from_dense(np.pad(values, ((3, 0), (1, 0), (6, 0), (0, 0))), place)
    cut = SparseVolumeData(whole.values, whole.bricks, (9, 20, 17), place, (3, 1, 6))
    write_volume(tmp_path / "sparse.vdb", cut)
    truth = read_volume(tmp_path / "dense.vdb")
    for found in (read_volume(tmp_path / "sparse.vdb"), read_sparse_volume(tmp_path / "sparse.vdb")):
        assert np.array_equal(found.dense() if isinstance(found, SparseVolumeData) else found.values, truth.values)
        assert np.allclose(found.to_world, truth.to_world, rtol=0, atol=1e-12)
    write_volume(tmp_path / "sparse.npz", cut)
    assert np.array_equal(read_volume(tmp_path / "sparse.npz").values, values)


def test_a_grid_is_chosen_by_name(openvdb_file: Path) -> None:
    with refused("7 arrays", "'density[1]'", "dataset="):
        read_volume(openvdb_file)
    with refused("no array 'densty'", "did you mean 'density'"):
        read_volume(openvdb_file, "densty")
    with refused("no active voxel", "'empty'"):
        read_volume(openvdb_file, "empty")


@pytest.mark.usefixtures("variant_rgb")
def test_a_plugin_names_the_grid(openvdb_file: Path) -> None:
    text = f"""<scene version="3.0.0"><shape type="cube"><medium name="interior" type="mivol_medium">
        <volume name="sigma_t" type="mivol_voxels"><string name="filename" value="{openvdb_file}"/>
        <string name="grid" value="half"/></volume></medium></shape></scene>"""
    data = mi.traverse(mi.load_string(text))
    (key,) = (name for name in data.properties if name.endswith("sigma_t.data"))
    np.testing.assert_array_equal(np.ravel(data[key]), np.ravel(GRIDS["half"][0]))


def test_the_sample_of_openvdb(data_dir: Path) -> None:
    """OpenVDB's own smoke in half: facts that OpenVDB 10 states, and the sum of its 1,049,275 active voxels in float64."""
    volume = read_volume(data_dir / "volumes_vdb" / "smoke.vdb")
    assert volume.meta["active_voxels"] == 1_049_275
    assert volume.values.shape == (112, 222, 111, 1)
    assert volume.values.max() == np.float32(5.7148438)
    assert volume.values.sum(dtype=np.float64) == pytest.approx(171499.69552135468, rel=1e-12)
    np.testing.assert_allclose(volume.spacing, 1 / 2.1, rtol=1e-12)


# -- Our own files -------------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3]), st.tuples(*[st.integers(1, 20)] * 3), st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, seed: int, channels: int, shape: tuple[int, int, int], share: float) -> None:
    """The box of the voxels other than 0 comes back, at its place in the world; NaN and negative numbers too."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(*shape, channels)).astype(np.float32) * (rng.random((*shape, 1)) < share)
    values[tuple(rng.integers(shape))] = np.nan
    to_world = np.eye(4)
    to_world[:3] += rng.normal(size=(3, 4)) / 4
    path = tmp_path_factory.mktemp("vdb") / "a.vdb"
    write_volume(path, values, to_world)
    volume = read_volume(path)
    on = np.argwhere((values != 0).any(axis=-1))
    low, high = on.min(axis=0), on.max(axis=0) + 1
    np.testing.assert_array_equal(volume.values, values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))])
    steps = to_world[:3, :3] / np.array(shape[::-1])
    np.testing.assert_allclose(volume.steps, steps, rtol=0, atol=1e-13)
    np.testing.assert_allclose(volume.origin, to_world[:3, 3] + steps @ (low[::-1] + 0.5), rtol=0, atol=1e-12)


def test_empty_space_takes_no_space(tmp_path: Path) -> None:
    """Two voxels far apart: two leaves, and their nodes' masks (4 KiB and 512 B for children and for tiles, two of each)."""
    values = np.zeros((300, 300, 300), np.float32)
    values[0, 0, 0] = values[299, 299, 299] = 1
    write_volume(tmp_path / "a.vdb", values)
    assert (tmp_path / "a.vdb").stat().st_size < 2 * 2 * (4096 + 512) + 2000
    np.testing.assert_array_equal(read_volume(tmp_path / "a.vdb").values[..., 0], values)


@pytest.mark.slow
def test_openvdb_reads_what_we_write(tmp_path: Path) -> None:
    """Debian's python3-openvdb as oracle: the values, the box and the transform."""
    python = shutil.which("python3", path="/usr/bin")
    if python is None or subprocess.run([python, "-c", "import pyopenvdb"], capture_output=True).returncode:
        pytest.skip("no python3-openvdb (sudo apt install python3-openvdb)")
    rng = np.random.default_rng(0)
    for channels in (1, 3):
        values = (rng.normal(size=(20, 30, 140, channels)) * (rng.random((20, 30, 140, 1)) < 0.1)).astype(np.float32)
        values[0, 0, 0] = values[-1, -1, -1] = 1
        to_world = np.eye(4)
        to_world[:3] += rng.normal(size=(3, 4)) / 4
        write_volume(tmp_path / "a.vdb", values, to_world)
        script = """import sys, numpy, pyopenvdb
grid = pyopenvdb.readAll(sys.argv[1])[0][0]
low, high = grid.evalActiveVoxelBoundingBox()
shape = [b - a + 1 for a, b in zip(low, high)] + ([3] if "Vec" in type(grid).__name__ else [])
values = numpy.zeros(shape, numpy.float32)
grid.copyToArray(values, ijk=low)
corners = [grid.transform.indexToWorld(c) for c in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]]
numpy.savez(sys.argv[2], values=values, low=low, corners=corners)"""
        subprocess.run([python, "-c", script, tmp_path / "a.vdb", tmp_path / "a.npz"], check=True)
        found, volume = np.load(tmp_path / "a.npz"), read_volume(tmp_path / "a.vdb")
        read = found["values"].reshape(*found["values"].shape[:3], channels).transpose(2, 1, 0, 3)
        np.testing.assert_array_equal(read, values)
        np.testing.assert_array_equal(found["low"], volume.meta["index_min"])
        np.testing.assert_allclose(found["corners"][0], volume.origin, atol=1e-13)
        np.testing.assert_allclose(found["corners"][1:] - found["corners"][0], volume.steps.T, atol=1e-13)


# -- Bad files -----------------------------------------------------------------------------------------------------------


def test_a_file_cut_anywhere_is_refused(openvdb_file: Path, tmp_path: Path) -> None:
    data = openvdb_file.read_bytes()
    for size in np.random.default_rng(0).integers(1, len(data) - 1, 60):
        (tmp_path / "a.vdb").write_bytes(data[:size])
        with refused():
            read_volume(tmp_path / "a.vdb", "half")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (struct.pack("<I", 224), struct.pack("<I", 219), "version 219"),
        (b"Tree_float_5_4_3_HalfFloat", b"Tree_ptdataidx32_5_4_3____", "Tree_ptdataidx32"),
        (b"UniformScaleMap", b"NonlinearFrustu", "the transform NonlinearFrustu"),
    ],
)
def test_what_is_not_read_is_named(openvdb_file: Path, tmp_path: Path, old: bytes, new: bytes, words: str) -> None:
    data = openvdb_file.read_bytes()
    assert old in data
    (tmp_path / "a.vdb").write_bytes(data.replace(old, new))
    with refused(words):
        read_volume(tmp_path / "a.vdb", "half")


def test_blosc_is_named_where_it_is_missing(openvdb_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "blosc", None)
    with refused("Blosc", 'pip install "mivol[vdb]"'):
        read_volume(openvdb_file, "half")


@pytest.mark.parametrize(
    ("values", "metadata", "words"),
    [
        (np.ones((2, 2, 2, 2)), {}, "2 channels"),
        (np.zeros((2, 2, 2)), {}, "nothing but zeros"),
        (np.ones((2, 2, 2)), {"space": "RAS"}, "metadata space"),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path: Path, values: np.ndarray, metadata: dict, words: str) -> None:
    with refused(words):
        mivol.write_volume(tmp_path / "a.vdb", values, metadata=metadata)
    assert not (tmp_path / "a.vdb").exists()


def test_a_name_of_the_grid(tmp_path: Path) -> None:
    write_volume(tmp_path / "a.vdb", np.ones((2, 2, 2)), metadata={"grid": "temperature"})
    assert read_volume(tmp_path / "a.vdb", "temperature").meta["grid"] == "temperature"
    assert vdb.is_vdb((tmp_path / "a.vdb").read_bytes())
