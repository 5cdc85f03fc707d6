"""``mivol explain`` and ``mivol convert`` on files of volumes."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from mivol.cli import main
from mivol.files import FORMATS, read_volume, write_volume

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


@pytest.mark.parametrize("target", ["b.vdb", "b.vol", "b.nrrd", "b.npz"])
def test_convert_keeps_values_and_place(tmp_path: Path, target: str) -> None:
    values = np.abs(np.nan_to_num(VALUES)) + 1
    write_volume(tmp_path / "a.nrrd", values, PLACE)
    assert run("convert", tmp_path / "a.nrrd", tmp_path / target) == 0
    volume = read_volume(tmp_path / target)
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.to_world, PLACE, atol=1e-12)


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
        ("a.st", bytes(208) + b"MAP " + bytes(812), "an MRC file", "name it .mrc"),
        ("a.m5", b"MATLAB 5.0 MAT-file", "a MATLAB file", "name it .mat"),
        ("a.lsm", b"II*\0" + bytes(8), "a TIFF file", "name it .tif"),
        ("a.raw", bytes(64), "raw bytes", ".nhdr or .mhd"),
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
