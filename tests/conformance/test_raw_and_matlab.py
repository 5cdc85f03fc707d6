"""Raw bytes by size and type or by a header beside them, and arrays of MATLAB of both kinds of files."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from refusals import assert_refused
from volume_files import meta_head, nrrd_head, numbered

from mivol.cli import main
from mivol.files import read_volume

VALUES = numbered()[..., 0]


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.mark.parametrize("dtype", ["uint16", "<i2", ">u2", "float32", ">f8", "u1"])
def test_raw_bytes(tmp_path: Path, capsys: pytest.CaptureFixture, dtype: str) -> None:
    kind = np.dtype(dtype)
    (tmp_path / "a.raw").write_bytes(VALUES.astype(kind if kind.byteorder == ">" else kind.newbyteorder("<")).tobytes())
    volume = read_volume(tmp_path / "a.raw", shape=(2, 3, 4), dtype=dtype)
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    np.testing.assert_array_equal((volume.spacing, volume.origin), ((1, 1, 1), (0, 0, 0)))
    assert run("convert", tmp_path / "a.raw", tmp_path / "b.nrrd", "--shape", "2,3,4", "--dtype", dtype) == 0
    np.testing.assert_array_equal(read_volume(tmp_path / "b.nrrd").values[..., 0], VALUES)
    assert run("explain", tmp_path / "a.raw", "--shape", "2,3,4", "--dtype", dtype) == 0
    assert "a.raw: raw bytes\nvoxels (x, y, z): 4 x 3 x 2" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["a.nhdr", "a.raw.nhdr", "a.mhd"])
def test_a_header_beside_raw_bytes_is_found(tmp_path: Path, capsys: pytest.CaptureFixture, name: str) -> None:
    """A header that names another file is none; two headers are refused."""
    (tmp_path / "a.raw").write_bytes(VALUES.astype("<f4").tobytes())
    other = "b.nhdr" if name != "a.nhdr" else "b.mhd"
    (tmp_path / other).write_text("ElementDataFile = a.raw")
    head = nrrd_head(numbered(), **{"data file": "a.raw"}).encode() if "nhdr" in name else meta_head(numbered(), data="a.raw")
    (tmp_path / name).write_bytes(head)
    volume = read_volume(tmp_path / "a.raw")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    np.testing.assert_allclose(volume.spacing, (1.5, 2, 2.5))
    assert run("explain", tmp_path / "a.raw") == 0
    assert f"raw bytes by {name}\n" in capsys.readouterr().out
    (tmp_path / "a.raw.mhd").write_text("ElementDataFile = a.raw")
    assert_refused("2 headers", read_volume, tmp_path / "a.raw")
    (tmp_path / "a.raw.mhd").unlink()
    (tmp_path / name).write_bytes(head.replace(b"a.raw", b"c.raw"))
    assert_refused("found raw bytes with", read_volume, tmp_path / "a.raw")


@pytest.mark.parametrize("name", ["a.toml", "a.raw.toml"])
def test_a_toml_file_beside_raw_bytes_is_found(tmp_path: Path, capsys: pytest.CaptureFixture, name: str) -> None:
    """Size, type and place; a TOML file without size and type, such as an experiment, is none."""
    (tmp_path / "a.raw").write_bytes(VALUES.astype(">i2").tobytes())
    (tmp_path / name).write_text('title = "a scan of some shape and dtype"')
    assert_refused("in a file .nhdr, .mhd or .toml beside them", read_volume, tmp_path / "a.raw")
    layout = 'shape = [2, 3, 4]\ndtype = ">i2"\nspacing = [0.5, 1, 2]\norigin = [3, 4, 5]\nunit = "mm"\n'
    (tmp_path / name).write_text(layout)
    volume = read_volume(tmp_path / "a.raw")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    np.testing.assert_allclose((volume.spacing, volume.origin), ((0.5, 1, 2), (3, 4, 5)))
    assert volume.meta["unit"] == "mm"
    assert run("explain", tmp_path / "a.raw") == 0
    said = capsys.readouterr().out
    assert "raw bytes by a TOML file\n" in said and "voxel (0.5, 1, 2) mm\n" in said
    assert run("convert", tmp_path / "a.raw", tmp_path / "b.zarr") == 0
    assert read_volume(tmp_path / "b.zarr").meta["unit"] == "mm"
    for wrong, said in (
        (layout.replace("0.5", ".5"), "found invalid TOML"),
        (layout + "voxel = 3\n", "found voxel = 3, expected shape ="),
        (layout.replace("4]", '"4"]'), r"found shape = \[2, 3, '4'\]"),
        (layout.replace("[3, 4, 5]", "[3, 4]"), "expected three numbers"),
        (layout.replace("0.5", "0"), "degenerate box"),
    ):
        (tmp_path / name).write_text(wrong)
        assert_refused(said, read_volume, tmp_path / "a.raw")


@pytest.mark.parametrize(
    ("shape", "dtype", "found"),
    [
        ("2,3,5", "f4", r"found 96 bytes, expected 120 bytes \(2 x 3 x 5 numbers of 4 bytes\)"),
        ("2,3,4", "int15", "found the type 'int15'"),
        ("2,3,4", "O", "found the type 'O'"),
        ("2,3,4", "c8", "found the type 'c8'"),
        ("6,4", "f4", r"found the shape \(6, 4\)"),
        ("0,3,4", "f4", r"found the shape \(0, 3, 4\)"),
        ("2,x,4", "f4", "--shape: found '2,x,4', expected Z,Y,X"),
        ("2,3,4", None, "only one of shape and dtype"),
        (None, "f4", "only one of shape and dtype"),
    ],
)
def test_wrong_sizes_and_types_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture, shape: str | None, dtype: str | None, found: str
) -> None:
    (tmp_path / "a.raw").write_bytes(VALUES.astype("<f4").tobytes())
    flags = (["--shape", shape] if shape else []) + (["--dtype", dtype] if dtype else [])
    assert run("explain", tmp_path / "a.raw", *flags) == 1
    error = capsys.readouterr().err
    assert re.search(found, error), error
    assert error.count("\n") == 1


@pytest.mark.parametrize("verb", ["explain", "convert", "optimize"])
def test_raw_bytes_without_a_size_are_told_the_flags(tmp_path: Path, capsys: pytest.CaptureFixture, verb: str) -> None:
    """Even if no byte is 0, as in text."""
    (tmp_path / "a.raw").write_bytes(b"\xff" * 96)
    assert run(verb, tmp_path / "a.raw", *([tmp_path / "b.nrrd"] * (verb == "convert"))) == 1
    assert "found raw bytes with the suffix '.raw'" in (error := capsys.readouterr().err)
    assert "--shape and --dtype" in error


def test_a_shape_of_another_format_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    assert_refused("shape or dtype for NumPy array", read_volume, tmp_path / "a.npy", shape=(2, 3, 4), dtype="f4")


def write_hdf5(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """As MATLAB 7.3 writes: its axes reversed, after a block of 512 bytes that says so."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array.T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")


@pytest.mark.parametrize("write", [write_hdf5, scipy.io.savemat], ids=["7.3", "5"])
def test_arrays_of_matlab(tmp_path: Path, capsys: pytest.CaptureFixture, write) -> None:
    """Rows, columns, slices of MATLAB are y, x, z; one array is read without a name."""
    rows_columns_slices = np.moveaxis(VALUES, 0, 2)
    several = np.stack([rows_columns_slices, 2 * rows_columns_slices], axis=3)
    write(tmp_path / "one.mat", {"mu": rows_columns_slices, "angles": np.zeros((1, 5))})
    np.testing.assert_array_equal(read_volume(tmp_path / "one.mat").values[..., 0], VALUES)
    write(tmp_path / "two.mat", {"mu": rows_columns_slices, "both": several})
    np.testing.assert_array_equal(read_volume(tmp_path / "two.mat", "both").values, np.stack([VALUES, 2 * VALUES], axis=3))
    assert run("explain", tmp_path / "two.mat") == 1
    assert "2 arrays (" in capsys.readouterr().err
    assert run("convert", tmp_path / "two.mat", tmp_path / "a.nrrd", "--dataset", "mu") == 0


def test_bad_files_of_matlab_are_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"mu": np.moveaxis(VALUES, 0, 2)})
    data = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "a.mat").write_bytes(data[:-60])
    assert_refused("a damaged MATLAB file", read_volume, tmp_path / "a.mat")
    scipy.io.savemat(tmp_path / "a.mat", {"mu": np.moveaxis(VALUES, 0, 2) * 1j})
    assert_refused("complex", read_volume, tmp_path / "a.mat")
