"""Writers of volumes for other programs: values and place come back, through our readers and the programs' own libraries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from mivol.cli import main
from mivol.files import WRITERS, read_volume, write_volume
from mivol.files.volume import frame_from_steps

SIZE = (4, 3, 2)
TURNED = frame_from_steps(SIZE, np.array([[0, -0.5, 0], [0.25, 0, 0], [0, 0, 2]]), (1, -2, 3))
UPRIGHT = frame_from_steps(SIZE, np.diag((0.25, 0.5, 2)), (1, -2, 3))
TURNING = (".mha", ".vti", ".nii")
"""Formats that hold turned axes; every number of TURNED is exact in float32, which NIfTI and MRC store."""


def values(channels: int = 1) -> np.ndarray:
    return np.random.default_rng(channels).normal(size=(2, 3, 4, channels)).astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("suffix", TURNING)
def test_values_and_place_come_back(tmp_path: Path, suffix: str, channels: int) -> None:
    write_volume(tmp_path / f"a{suffix}", values(channels), TURNED)
    volume = read_volume(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(volume.values, values(channels))
    np.testing.assert_allclose(volume.to_world, TURNED, atol=1e-12)


FACTS: dict[str, dict] = {
    ".vol": {"format": "vol", "encoding": 1},
    ".npy": {"format": "npy"},
    ".npz": {"format": "npz", "dataset": "values", "metadata": {}},
    ".nrrd": {"format": "nrrd"},
    ".vdb": {"format": "vdb", "grid": "density", "class": "fog volume", "index_min": (0, 0, 0), "active_voxels": 24},
    ".nvdb": {"format": "nvdb", "grid": "density", "class": "fog volume", "index_min": (0, 0, 0)},
    ".mhd": {"format": "metaimage", "space": "LPS"},
    ".mha": {"format": "metaimage", "space": "LPS"},
    ".nii": {"format": "nifti", "space": "RAS", "place": "sform", "unit": "unknown"},
    ".vti": {"format": "vti", "dataset": "values", "centering": "point"},
    ".mrc": {"format": "mrc", "unit": "A", "notes": ()},
    ".tif": {"format": "tiff"},
    ".tiff": {"format": "tiff"},
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_reader_says_what_it_found(tmp_path: Path, suffix: str) -> None:
    has_place = suffix not in (".npy", ".tif", ".tiff")
    write_volume(tmp_path / f"a{suffix}", values(), *([UPRIGHT] if has_place else []))
    meta = read_volume(tmp_path / f"a{suffix}").meta
    expected = {"path": str(tmp_path / f"a{suffix}"), "dtype": "float32", "space": None, "frame": "file"} | FACTS[suffix]
    assert {key: meta[key] for key in expected} == expected


@pytest.mark.parametrize("suffix", [".mha", ".nii"])
@pytest.mark.parametrize("space", ["RAS", "LPS", "LAS"])
def test_the_frame_becomes_that_of_the_format(tmp_path: Path, suffix: str, space: str) -> None:
    """A corner in RAS is the same in both files."""
    write_volume(tmp_path / "a.nrrd", values(), TURNED, metadata={"space": space})
    assert main(["convert", str(tmp_path / "a.nrrd"), str(tmp_path / f"a{suffix}")]) == 0
    volume = read_volume(tmp_path / f"a{suffix}")
    assert volume.meta["space"] == {".mha": "LPS", ".nii": "RAS"}[suffix]
    signs = {"RAS": (1, 1, 1, 1), "LPS": (-1, -1, 1, 1), "LAS": (-1, 1, 1, 1)}
    change = np.diag(np.multiply(signs[space], signs[volume.meta["space"]]).astype(float))
    np.testing.assert_allclose(volume.to_world, change @ TURNED, atol=1e-12)


def test_mrc_is_read_by_mrcfile(tmp_path: Path) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    write_volume(tmp_path / "a.mrc", values(), UPRIGHT)
    assert mrcfile.validate(tmp_path / "a.mrc")
    with mrcfile.open(tmp_path / "a.mrc") as file:
        np.testing.assert_array_equal(file.data, values()[..., 0])
        assert file.voxel_size.tolist() == (0.25, 0.5, 2.0)
        assert file.header.origin.tolist() == (1, -2, 3)
    np.testing.assert_allclose(read_volume(tmp_path / "a.mrc").to_world, UPRIGHT, atol=1e-12)


def test_a_voxel_size_of_0_is_said(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(tmp_path / "a.mrc") as file:
        file.set_data(values()[..., 0])
    assert main(["explain", str(tmp_path / "a.mrc")]) == 0
    assert "assumed: the header has a voxel size of 0: a voxel counts as 1." in capsys.readouterr().out
    np.testing.assert_array_equal(read_volume(tmp_path / "a.mrc").spacing, (1, 1, 1))


@pytest.mark.parametrize(
    ("suffix", "lost"), [(".nii", "the unit A"), (".mha", "the unit A"), (".nrrd", ""), (".mrc", ""), (".zarr", "")]
)
def test_convert_says_which_unit_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture, suffix: str, lost: str) -> None:
    """MRC has angstrom, which NIfTI does not know."""
    write_volume(tmp_path / "a.mrc", values())
    assert main(["convert", str(tmp_path / "a.mrc"), str(tmp_path / f"b{suffix}")]) == 0
    said = capsys.readouterr().out
    assert f"{suffix} does not hold {lost}\n" in said if lost else "does not hold" not in said
    assert (read_volume(tmp_path / f"b{suffix}").meta.get("unit") == "A") == (not lost)


def test_lengths_become_angstrom_in_mrc(tmp_path: Path) -> None:
    place = np.diag([4.0, 6.0, 8.0, 1.0])
    place[:3, 3] = 1, 2, 3
    write_volume(tmp_path / "a.nrrd", values(), place, metadata={"unit": "um"})
    assert main(["convert", str(tmp_path / "a.nrrd"), str(tmp_path / "b.mrc")]) == 0
    volume = read_volume(tmp_path / "b.mrc")
    np.testing.assert_allclose(volume.to_world[:3], 1e4 * place[:3], rtol=1e-6)
    assert volume.meta["unit"] == "A"


@pytest.mark.parametrize(
    ("suffix", "lost"),
    [
        (".tif", "the frame LPS and the directions of the axes and the origin"),
        (".mrc", "the frame LPS and the directions of the axes"),
        (".npy", "the frame LPS and the place"),
        (".vti", "the frame LPS"),
        (".mha", ""),
        (".nii", ""),
    ],
)
def test_convert_says_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture, suffix: str, lost: str) -> None:
    write_volume(tmp_path / "a.nrrd", values(), TURNED, metadata={"space": "LPS"})
    assert main(["convert", str(tmp_path / "a.nrrd"), str(tmp_path / f"b{suffix}")]) == 0
    said = capsys.readouterr().out
    assert f"{suffix} does not hold {lost}\n" in said if lost else "does not hold" not in said
    volume = read_volume(tmp_path / f"b{suffix}")
    np.testing.assert_array_equal(volume.values, values())
    if suffix != ".npy":
        np.testing.assert_allclose(volume.spacing, (0.25, 0.5, 2), rtol=1e-12)


@pytest.mark.parametrize("source", [".nrrd", ".mha", ".nii", ".vti", ".mrc", ".tif"])
@pytest.mark.parametrize("target", WRITERS)
def test_every_format_becomes_every_other(tmp_path: Path, source: str, target: str) -> None:
    write_volume(tmp_path / f"a{source}", values(), frame_from_steps(SIZE, np.diag((0.25, 0.5, 2)), np.zeros(3)))
    assert main(["convert", str(tmp_path / f"a{source}"), str(tmp_path / f"b{target}")]) == 0
    volume = read_volume(tmp_path / f"b{target}")
    np.testing.assert_array_equal(volume.values, values())
    np.testing.assert_allclose(volume.spacing, (1 / 4, 1 / 3, 1 / 2) if target == ".npy" else (0.25, 0.5, 2), rtol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "shape", "place", "found"),
    [
        (".tif", (2, 3, 4, 1), UPRIGHT, "a place for a TIFF file"),
        (".mrc", (2, 3, 4, 1), TURNED, "turned axes for an MRC file"),
        (".mrc", (2, 3, 4, 3), UPRIGHT, "3 channels for an MRC file"),
        (".nii", (1, 1, 40000, 1), UPRIGHT, "at most 32767"),
    ],
)
def test_what_a_format_does_not_hold_is_refused(
    tmp_path: Path, suffix: str, shape: tuple, place: np.ndarray, found: str
) -> None:
    assert_refused(found, write_volume, tmp_path / f"a{suffix}", np.zeros(shape, np.float32), place)
    assert not any(tmp_path.iterdir())
