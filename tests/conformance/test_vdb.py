"""OpenVDB files: one written by OpenVDB 10.0.1, our own, and both libraries on each other's files.

``openvdb_10.vdb.gz`` holds the grids of :data:`GRIDS`, written by Debian's ``python3-openvdb`` with Blosc: single voxels,
a filled region (which makes active tiles), values truncated to half, a level set by ``createLevelSetSphere``. Values are
compared exactly, because all of them are float32 or half. ``openvdb_10_types.vdb.gz`` was written by OpenVDB 10.0.1 in C++:
five voxels and a filled region in every other type of grid, a frustum, and points.
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
from scattering_scenes import pencils

import mivol
from mivol.files import SparseVolumeData, check_bricks, read_sparse_volume, read_volume, vdb, write_volume
from mivol.files.formats import convert_volume
from scenes import sky

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


@pytest.fixture(scope="module")
def types_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vdb") / "openvdb_10_types.vdb"
    path.write_bytes(gzip.decompress((Path(__file__).parent / "openvdb_10_types.vdb.gz").read_bytes()))
    return path


FIVE = np.arange(5.0)[:, None]
TYPED = {
    "double": (1 / (FIVE + 3), 2.5),
    "doubleh": ((1 / (FIVE + 3)).astype(np.float16), 2.5),
    "int32": (100 * FIVE - 7, 11),
    "int64": (2 ** (FIVE + 8), 12),
    "bool": (0 * FIVE + 1, 1),
    "vec3d": (np.column_stack([FIVE, -FIVE, 0.1 * FIVE + 1]), (1, 2, 3)),
    "vec3h": (np.column_stack([FIVE, -FIVE, np.float32(0.1) * FIVE + 1]).astype(np.float16), (1, 2, 3)),
    "vec3i": (np.column_stack([FIVE, -FIVE, FIVE + 1]), (1, 2, 3)),
}
"""Name: values of the voxels (3 i - 6, i % 2, 2 - i), value of the region from (8, 8, 8) to (23, 15, 15)."""


@pytest.mark.parametrize("name", TYPED)
def test_a_type_of_values(types_file: Path, name: str) -> None:
    volume, (values, tile) = read_volume(types_file, name), TYPED[name]
    expected = np.zeros((18, 16, 30, values.shape[1]), np.float32)
    expected[10:, 8:, 14:] = tile
    x, y, z = np.array([(3 * i - 6, i % 2, 2 - i) for i in range(5)]).T
    expected[z + 2, y, x + 6] = values.astype(np.float32)
    np.testing.assert_array_equal(volume.values, expected)
    np.testing.assert_array_equal(read_sparse_volume(types_file, name).dense(), expected)
    np.testing.assert_allclose(volume.origin, [1 - 3, 2, 3 - 1], rtol=0, atol=1e-13)
    assert volume.meta["active_voxels"] == 5 + 16 * 8 * 8


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("points", "the points 'points' (Tree_ptdataidx32_5_4_3)"),
        ("mask", "the grid 'mask' of type Tree_mask_5_4_3"),
        ("frustum", "the transform NonlinearFrustumMap"),
    ],
)
def test_what_no_volume_can_be_is_named(types_file: Path, name: str, words: str) -> None:
    for read in (read_volume, read_sparse_volume):
        with refused(words):
            read(types_file, name)


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


LAYERS = {(0, 0): 14.0, (7, 7): 14.0 + 2 - 0.25}
"""Voxel (y, z) of a row along x: the sum of its 24 values: 8 in a tile of 1, 8 in a tile of 0.5 that is off, 8 of the value
outside, 0.25, of which the last is 2 in the last row."""


@pytest.mark.parametrize("storage", ["dense", "sparse"])
def test_light_through_tiles_and_background(tmp_path: Path, storage: str) -> None:
    """Beer and Lambert: the optical depth of a row is the sum of its voxels times their edge, the outer half voxels included.

    ``openvdb_10_background.vdb.gz`` is of OpenVDB 10.0.1: index x runs along y of the world in steps of 0.25, y along x in
    steps of 0.5, z against z in steps of 1, from (1, 2, 3).
    """
    path = tmp_path / "a.vdb"
    path.write_bytes(gzip.decompress((Path(__file__).parent / "openvdb_10_background.vdb.gz").read_bytes()))
    place = read_volume(path).to_world
    grid = {"type": "mivol_voxels", "filename": str(path), "use_grid_bbox": True, "storage": storage}
    box = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f(place) @ mi.ScalarTransform4f().scale(0.5).translate(1),
        "bsdf": {"type": "null"},
        "interior": {"type": "mivol_medium", "sigma_t": grid, "albedo": 0.0},
    }
    begins = [(1 + 0.5 * y, -2.0, 3.0 - z) for y, z in LAYERS]
    seen = pencils({"box": box, "sky": sky(1.0)}, np.array(begins), np.array([[0.0, 1, 0]]))
    light = np.array(mi.render(seen.scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=1))[0, :, 0]
    np.testing.assert_allclose(-np.log(light), 0.25 * np.array(list(LAYERS.values())), rtol=1e-5)
    # Half a voxel outside of the last centre the value is that of the voxel, and beyond there is vacuum.
    edges = np.array([(1 - 0.499 * 0.5, -2, 3), (1 - 0.501 * 0.5, -2, 3), (1 + 7.499 * 0.5, -2, 3), (1 + 7.501 * 0.5, -2, 3)])
    seen = pencils({"box": box, "sky": sky(1.0)}, edges, np.array([[0.0, 1, 0]]))
    light = np.array(mi.render(seen.scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=1))[0, :, 0]
    np.testing.assert_allclose(-np.log(light), [3.5, 0, 3.5, 0], rtol=1e-5, atol=1e-7)


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


# -- OpenVDB as oracle: Debian's python3-openvdb, in a process of the system's Python -------------------------------------


def run_openvdb(script: str, *arguments: object) -> None:
    python = shutil.which("python3", path="/usr/bin")
    if python is None or subprocess.run([python, "-c", "import pyopenvdb"], capture_output=True).returncode:
        pytest.skip("no python3-openvdb (sudo apt install python3-openvdb)")
    subprocess.run([python, "-c", script, *map(str, arguments)], check=True)


MAKE_GRIDS = """import sys, numpy, pyopenvdb
rng, grids, truth = numpy.random.default_rng(int(sys.argv[1])), [], {}
for k in range(int(sys.argv[2])):
    background = 0.0 if k % 3 else float(rng.normal())
    colour = k % 4 == 3
    grid = pyopenvdb.Vec3SGrid([background] * 3) if colour else pyopenvdb.FloatGrid(background)
    value = (lambda: tuple(rng.normal(size=3))) if colour else (lambda: float(rng.normal()))
    access, far = grid.getAccessor(), 3000 if k % 5 == 4 else 40
    for _ in range(30):
        access.setValueOn(tuple(map(int, rng.integers(-20, 20, 3))), value())
        access.setValueOff(tuple(map(int, rng.integers(-20, 20, 3))), value())
    access.setValueOn(tuple(map(int, rng.integers(0, far, 1))) + (5, -3), (numpy.nan,) * 3 if colour else numpy.nan)
    low = rng.integers(-30, 10, 3)
    grid.fill(tuple(map(int, low)), tuple(map(int, low + rng.integers(1, 40, 3))), value(), True)
    grid.fill(tuple(map(int, low - 20)), tuple(map(int, low + 3)), value(), False)
    colour or grid.prune()
    grid.saveFloatAsHalf = k % 7 == 6
    matrix = numpy.eye(4)
    kind = k % 6
    if kind == 0:
        grid.transform = pyopenvdb.createLinearTransform(0.37)
    else:
        matrix[:3, :3] = numpy.diag(rng.uniform(0.1, 3, 3) * rng.choice([-1, 1], 3) if kind < 3 else [1, 1, 1])
        matrix[:3, :3] += rng.normal(size=(3, 3)) / 5 if kind > 3 else 0
        matrix[3, :3] = rng.normal(size=3) if kind % 2 else 0
        grid.transform = pyopenvdb.createLinearTransform(matrix.tolist())
    grid.name = "twice" if k % 8 == 7 else f"grid{k}"
    grids.append(grid)
grids.append(pyopenvdb.createLevelSetSphere(1.3, center=(0.2, 0, 5), voxelSize=0.2, halfWidth=3))
grids[-1].name = "ball"
pyopenvdb.write(sys.argv[3], grids=grids)
# Half numbers, the places of the grids, and the order of equal names are those of the file.
for k, grid in enumerate(pyopenvdb.readAll(sys.argv[3])[0]):
    low, high = grid.evalActiveVoxelBoundingBox()
    shape = [b - a + 1 for a, b in zip(low, high)] + ([3] if "Vec" in type(grid).__name__ else [])
    values = numpy.zeros(shape, numpy.float32)
    grid.copyToArray(values, ijk=low)
    indices = rng.uniform(-50, 50, (20, 3))
    truth[f"values {k}"], truth[f"low {k}"], truth[f"name {k}"] = values, low, grid.name
    truth[f"active {k}"], truth[f"background {k}"] = grid.activeVoxelCount(), grid.background
    truth[f"indices {k}"], truth[f"places {k}"] = indices, [grid.transform.indexToWorld(tuple(i)) for i in indices]
numpy.savez(sys.argv[4], **truth)"""


@pytest.mark.slow
def test_values_and_places_are_those_of_openvdb(tmp_path: Path) -> None:
    """Random grids: tiles on and off, values of inactive voxels, backgrounds, NaN, half, colours, equal names, boxes up to 3000
    voxels wide, and every kind of linear transform. Values to the bit; places to a rounding of float64."""
    run_openvdb(MAKE_GRIDS, 0, 24, tmp_path / "a.vdb", tmp_path / "a.npz")
    truth, seen = np.load(tmp_path / "a.npz"), []
    for k in range(25):
        plain = str(truth[f"name {k}"])
        seen.append(plain)
        name = plain + (f"[{seen.count(plain) - 1}]" if seen.count(plain) > 1 else "")
        volume = read_volume(tmp_path / "a.vdb", name)
        values = truth[f"values {k}"]
        values = values.reshape(*values.shape[:3], -1).transpose(2, 1, 0, 3)
        if plain == "ball":
            values = np.clip(-values / truth[f"background {k}"].astype(np.float32), 0, 1)
        np.testing.assert_array_equal(volume.values, values)
        np.testing.assert_array_equal(read_sparse_volume(tmp_path / "a.vdb", name).dense(), values)
        low, indices, places = truth[f"low {k}"], truth[f"indices {k}"], truth[f"places {k}"]
        assert volume.meta["index_min"] == tuple(low) and volume.meta["active_voxels"] == truth[f"active {k}"]
        local = (indices - low + 0.5) / volume.size
        found = local @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
        # A product and four sums round in each, of terms that are at most box and origin.
        scale = np.abs(volume.to_world[:3]).sum(axis=1).max() * max(1, np.abs(local).max())
        np.testing.assert_allclose(found, places, rtol=0, atol=16 * 2.0**-53 * scale)
    assert seen.count("twice") == 3 and "ball" in seen


@pytest.mark.slow
def test_openvdb_reads_what_we_write(tmp_path: Path) -> None:
    """The values, the box and the transform, of a file of ours and of one that ``mivol convert`` made of a ``.nvdb``."""
    rng = np.random.default_rng(0)
    script = """import sys, numpy, pyopenvdb
grid = pyopenvdb.readAll(sys.argv[1])[0][0]
low, high = grid.evalActiveVoxelBoundingBox()
shape = [b - a + 1 for a, b in zip(low, high)] + ([3] if "Vec" in type(grid).__name__ else [])
values = numpy.zeros(shape, numpy.float32)
grid.copyToArray(values, ijk=low)
corners = [grid.transform.indexToWorld(c) for c in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]]
numpy.savez(sys.argv[2], values=values, low=low, corners=corners)"""
    for channels, source in ((1, "a.vdb"), (3, "a.vdb"), (1, "a.nvdb")):
        values = (rng.normal(size=(20, 30, 140, channels)) * (rng.random((20, 30, 140, 1)) < 0.1)).astype(np.float32)
        values[0, 0, 0] = values[-1, -1, -1] = 1
        to_world = np.eye(4)
        to_world[:3] += rng.normal(size=(3, 4)) / 4
        write_volume(tmp_path / source, values, to_world)
        if source != "a.vdb":
            convert_volume(tmp_path / source, tmp_path / "a.vdb")
        run_openvdb(script, tmp_path / "a.vdb", tmp_path / "a.npz")
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
