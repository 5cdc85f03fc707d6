"""``mivol explain`` and ``mivol convert`` on files of volumes."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from mivol.cli import main
from mivol.files import FORMATS, VolumeData, read_volume, write_grids, write_volume

CONFORMANCE = Path(__file__).parents[1] / "conformance"
PLACE = np.array([[4.0, 0, 0, -1], [0, 3, 0, 2], [0, 0, 2, 5], [0, 0, 0, 1]])
VALUES = np.array([0, 0, 0.25, -1, 2, 4, np.nan, 8], np.float32).reshape(2, 2, 2, 1)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_explain_describes_a_volume(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_volume(tmp_path / "a.nrrd", VALUES, PLACE)
    assert run("explain", tmp_path / "a.nrrd") == 0
    text = capsys.readouterr().out
    assert "NRRD" in text and "2 x 2 x 2, 1 channel of float32" in text
    assert "box: (-1, 2, 5) to (3, 5, 7); voxel (2, 1.5, 1)" in text
    assert "values: -1 to 8, mean 1.893, 28.6 % are 0" in text  # 13.25 / 7, 2 / 7
    assert "1 values are below 0" in text and "1 values are NaN or Inf" in text


def test_an_array_of_three_axes_is_a_volume(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """And one of two axes a cloud of points."""
    np.save(tmp_path / "a.npy", np.ones((2, 3, 3), np.float32))
    assert run("explain", tmp_path / "a.npy") == 0 and "voxels (x, y, z): 3 x 3 x 2" in capsys.readouterr().out
    np.save(tmp_path / "a.npy", np.ones((2, 3), np.float32))
    assert run("explain", tmp_path / "a.npy") == 0 and "2 points" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".vdb", ".nvdb"])
def test_verbs_take_a_file_of_several_grids(tmp_path: Path, capsys: pytest.CaptureFixture, suffix: str) -> None:
    """Each grid is described, and kept in another file of grids; a picture needs the name of one."""
    path, soot = tmp_path / f"a{suffix}", VolumeData(np.full((3, 3, 3, 1), 0.5, np.float32), PLACE)
    write_grids(path, {"density": soot, "flame": VolumeData(np.full((5, 4, 3, 3), 2, np.float32), PLACE)})
    assert run("explain", path) == 0
    text = capsys.readouterr().out
    assert "array 'density'\nvoxels (x, y, z): 3 x 3 x 3, 1 channel" in text
    assert "array 'flame'\nvoxels (x, y, z): 3 x 4 x 5, 3 channels" in text
    for target in ("b.vdb", "b.nvdb"):
        assert run("convert", path, tmp_path / target) == 0
        assert capsys.readouterr().out.strip().endswith(f"{target}: density, flame")
        np.testing.assert_array_equal(read_volume(tmp_path / target, "flame").values, np.full((5, 4, 3, 3), 2))
        np.testing.assert_allclose(read_volume(tmp_path / target, "density").to_world, PLACE, atol=1e-12)
    assert run("convert", path, tmp_path / "b.vol") == 1
    assert "2 arrays" in capsys.readouterr().err
    shown = ("-o", tmp_path / "a.exr", "--spp", 1, "--size", 8, 6)
    assert run("render", path, *shown) == 1
    assert "2 arrays ('density', 'flame'), expected a single array; name one by --dataset" in capsys.readouterr().err
    assert run("render", path, "--dataset", "density", *shown) == 0
    scene = tmp_path / "a.xml"
    scene.write_text('<scene version="3.0.0"/>')
    assert run("render", scene, "--dataset", "density") == 1
    assert "--dataset names an array of a volume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "target"),
    [("a.nrrd", f"b{suffix}") for suffix in (".vdb", ".vol", ".nrrd", ".npz")]
    + [("a.npz", f"b{suffix}") for suffix in (".vdb", ".nvdb", ".vti")],
)
def test_convert_keeps_values_and_place(tmp_path: Path, source: str, target: str) -> None:
    """Fits write ``.npz``; Blender, Houdini and ParaView read others."""
    values = np.abs(np.nan_to_num(VALUES)) + 1
    write_volume(tmp_path / source, values, PLACE)
    assert run("convert", tmp_path / source, tmp_path / target) == 0
    volume = read_volume(tmp_path / target)
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.to_world, PLACE, atol=1e-12)


SPATIAL = (".vdb", ".nvdb", ".vol", ".nrrd", ".mhd", ".vti")
"""Formats of volumes with a place that are written."""


@pytest.mark.parametrize("source", SPATIAL)
def test_formats_convert_into_each_other(tmp_path: Path, capsys: pytest.CaptureFixture, source: str) -> None:
    """Values to the bit. A ``.vol`` holds its corners in float32; NaN and negative numbers pass as well."""
    values = np.where(np.isnan(VALUES), VALUES, VALUES + 3)
    write_volume(tmp_path / f"a{source}", values, PLACE)
    for target in SPATIAL:
        assert run("convert", tmp_path / f"a{source}", tmp_path / f"b{target}") == 0
        lost = capsys.readouterr().out.partition("does not hold ")[2].strip()
        assert lost == ("the frame LPS" if source == ".mhd" != target and target != ".nrrd" else "")
        volume = read_volume(tmp_path / f"b{target}")
        np.testing.assert_array_equal(volume.values, values)
        np.testing.assert_allclose(volume.to_world, PLACE, rtol=0, atol=1e-12)
    write_volume(tmp_path / f"a{source}", np.repeat(values, 3, axis=3) * np.float32([1, 2, 3]))
    for target in SPATIAL:
        assert run("convert", tmp_path / f"a{source}", tmp_path / f"c{target}") == 0
        np.testing.assert_array_equal(read_volume(tmp_path / f"c{target}").values[..., 2], 3 * values[..., 0])


def test_convert_leaves_out_grids_that_are_no_volumes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Of OpenVDB's own file: types of numbers, and masks, a frustum and points."""
    file = tmp_path / "a.vdb"
    file.write_bytes(gzip.decompress((CONFORMANCE / "openvdb_10_types.vdb.gz").read_bytes()))
    assert run("convert", file, tmp_path / "b.nvdb") == 0
    first, *left_out = capsys.readouterr().out.strip().splitlines()
    assert "float64 (numbers are rounded to float32) of double" in first
    assert len(left_out) == 3 and all(line.startswith("left out: ") for line in left_out)
    assert "the grid 'mask'" in left_out[0] and "NonlinearFrustumMap" in left_out[1] and "the points 'points'" in left_out[2]
    for name in ("double", "int32"):
        values = [read_volume(path, name).values for path in (file, tmp_path / "b.nvdb")]
        np.testing.assert_array_equal(*values)


def test_convert_says_what_is_rounded_and_clipped(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Numbers wider than float32, and the distances of a level set (of OpenVDB's own file)."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one"] = np.ones((2, 3, 4))
    assert run("convert", tmp_path / "a.h5", tmp_path / "a.vdb") == 0
    assert ".vdb does not hold float64 (numbers are rounded to float32)" in capsys.readouterr().out
    packed = CONFORMANCE / "openvdb_10.vdb.gz"
    (tmp_path / "b.vdb").write_bytes(gzip.decompress(packed.read_bytes()))
    assert run("convert", tmp_path / "b.vdb", tmp_path / "b.nvdb", "--dataset", "ball") == 0
    assert ".nvdb does not hold the distances of the level set (its fog is written)" in capsys.readouterr().out
    assert read_volume(tmp_path / "b.nvdb", "ball").values.max() == 1


@pytest.mark.slow
def test_vtk_reads_what_we_write(tmp_path: Path) -> None:
    """ParaView's library: values, and places by its matrix from indices to the world."""
    pytest.importorskip("vtk")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    rng = np.random.default_rng(0)
    values, place = rng.normal(size=(4, 5, 6, 3)).astype(np.float32), np.eye(4)
    place[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * [6, 10, 2]
    place[:3, 3] = 1, 2, 3
    write_volume(tmp_path / "a.nvdb", values, place)
    assert run("convert", tmp_path / "a.nvdb", tmp_path / "a.vti") == 0
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "a.vti"))
    reader.Update()
    image = reader.GetOutput()
    np.testing.assert_array_equal(vtk_to_numpy(image.GetPointData().GetScalars()).reshape(values.shape), values)
    matrix = image.GetIndexToPhysicalMatrix()
    found = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    volume = read_volume(tmp_path / "a.nvdb")
    np.testing.assert_allclose(found[:3, :3], volume.steps, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], volume.origin, rtol=0, atol=1e-12)


def test_convert_says_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_volume(tmp_path / "a.nrrd", VALUES, PLACE, metadata={"space": "LPS"})
    assert run("convert", tmp_path / "a.nrrd", tmp_path / "b.npy") == 0
    assert ".npy does not hold the frame LPS and the place" in capsys.readouterr().out
    np.testing.assert_array_equal(read_volume(tmp_path / "b.npy").values, VALUES)


def test_an_array_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one"], file["two"] = VALUES[..., 0], 2 * VALUES[..., 0]
    assert run("explain", tmp_path / "a.h5") == 1
    assert "2 arrays ('one', 'two')" in capsys.readouterr().err
    assert run("explain", tmp_path / "a.h5", "--dataset", "two") == 0
    assert "values: -2 to 16" in capsys.readouterr().out
    assert run("convert", tmp_path / "a.h5", tmp_path / "b.vdb", "--dataset", "two") == 0
    np.testing.assert_array_equal(read_volume(tmp_path / "b.vdb").values, 2 * VALUES)


@pytest.mark.parametrize("words", [("explain",), ("convert", "b.vdb")])
def test_a_dataset_of_something_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture, words: tuple) -> None:
    (tmp_path / "a.xml").write_text("<scene/>")
    assert run(words[0], tmp_path / "a.xml", *words[1:], "--dataset", "two") == 1
    assert "is no volume: leave it out" in capsys.readouterr().err


def test_flags_of_points_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_volume(tmp_path / "a.vdb", VALUES)
    assert run("convert", tmp_path / "a.vdb", tmp_path / "b.nrrd", "--resolution", 3) == 1
    assert "--to, --resolution and --box are for points" in capsys.readouterr().err


def test_a_file_that_is_no_volume_lists_the_formats(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_volume(tmp_path / "a.vdb", VALUES)
    assert run("convert", tmp_path / "a.vdb", tmp_path / "b.png") == 1
    error = capsys.readouterr().err
    assert "the suffix '.png'" in error and ".vdb" in error
    assert ".vdb" in FORMATS


@pytest.mark.parametrize(
    ("name", "head", "found", "way_out"),
    [
        ("a.map3", bytes(208) + b"MAP " + bytes(812), "an MRC file", "name it .mrc"),
        ("a.m5", b"MATLAB 5.0 MAT-file", "a MATLAB file", "name it .mat"),
        ("a.lsm", b"II*\0" + bytes(8), "a TIFF file", "name it .tif"),
        ("a.h5.gz", b"\x1f\x8b\x08\x00", "a file compressed by gzip", "unpack it (gunzip)"),
        ("a.fits", b"SIMPLE  =                    T", "a FITS file", "as .npy (astropy.io.fits)"),
        ("a.txrm", bytes.fromhex("d0cf11e0a1b11ae1") + bytes(8), "a file of a Zeiss (Xradia) scanner", "as TIFF and text"),
        ("a.raw", bytes(64), "raw bytes", ".nhdr, .mhd or .toml"),
    ],
)
@pytest.mark.parametrize("words", [("explain",), ("render",), ("optimize",), ("convert", "b.vol")])
def test_a_file_without_a_reader_is_named_by_its_contents(
    tmp_path: Path, capsys: pytest.CaptureFixture, words: tuple, name: str, head: bytes, found: str, way_out: str
) -> None:
    (tmp_path / name).write_bytes(head)
    assert run(words[0], tmp_path / name, *(tmp_path / word for word in words[1:])) == 1
    error = capsys.readouterr().err
    assert f"found {found} with the suffix" in error and "expected a volume of .vol, .npy" in error
    assert way_out in error and error.count("\n") == 1


@pytest.mark.parametrize("axes", [(1, 2, 3), (3, 1, 2)])
@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.uint16, np.float16, np.float32])
def test_mrc_is_read_as_by_mrcfile(tmp_path: Path, axes: tuple[int, ...], dtype: type) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    stored = np.arange(24).reshape(2, 3, 4).astype(dtype)
    with mrcfile.new(tmp_path / "a.mrc") as file:
        file.set_data(stored)
        file.set_volume()
        file.header.mapc, file.header.mapr, file.header.maps = axes
        file.voxel_size = (1, 2, 4)
        file.header.nxstart, file.header.nystart, file.header.nzstart = 5, 6, 7
    volume = read_volume(tmp_path / "a.mrc")
    expected = stored if axes == (1, 2, 3) else np.moveaxis(stored, 2, 0)  # (s, r, c) is (y, x, z) for axes 3, 1, 2
    np.testing.assert_array_equal(volume.values[..., 0], expected)
    np.testing.assert_array_equal(volume.spacing, [1, 2, 4])
    starts = [5, 6, 7] if axes == (1, 2, 3) else [6, 7, 5]
    np.testing.assert_array_equal(volume.to_world[:3, 3], np.array([1, 2, 4]) * (np.array(starts) - 0.5))


def test_mrc_refusals_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mrc").write_bytes(bytes(208) + b"MAP " + bytes(812))
    monkeypatch.setitem(sys.modules, "mrcfile", None)
    assert run("explain", tmp_path / "a.mrc") == 1
    error = capsys.readouterr().err
    assert 'pip install "mivol[lab]"' in error and error.count("\n") == 1
