"""Volumes in TIFF: pages and folders of slices written by tifffile and Pillow, read back equal, and our own files."""

from __future__ import annotations

import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from refusals import assert_refused

from mivol.cli import main
from mivol.files import read_volume, write_volume
from mivol.files.volume import frame_from_steps

VALUES = np.arange(24, dtype=np.uint16).reshape(2, 3, 4) * 2711


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.mark.parametrize("compression", [None, "zlib", "lzw", "zstd", "packbits"])
@pytest.mark.parametrize("dtype", ["u1", "u2", ">u2", "i2", "f4", "f8", "u4"])
def test_pages_are_slices(tmp_path: Path, compression: str | None, dtype: str) -> None:
    """By tifffile with its own metadata or none, as BigTIFF or not: the pages are the slices."""
    if compression not in (None, "zlib"):
        pytest.importorskip("imagecodecs")
    values = (VALUES % 251).astype(dtype)
    for metadata, big in (({}, False), (None, True)):
        tifffile.imwrite(
            tmp_path / "a.tif", values, compression=compression, bigtiff=big, metadata=metadata, photometric="minisblack"
        )
        volume = read_volume(tmp_path / "a.tif")
        np.testing.assert_array_equal(volume.values[..., 0], values)
        np.testing.assert_array_equal(volume.to_world, frame_from_steps((4, 3, 2), np.eye(3), np.zeros(3)))
    assert volume.meta["unit"] == "voxel"


def test_pages_by_pillow(tmp_path: Path) -> None:
    pages = [Image.fromarray(page) for page in VALUES]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:], compression="tiff_deflate", dpi=(72, 72))
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    np.testing.assert_array_equal(volume.spacing, (1, 1, 1))


def test_voxel_sizes_of_imagej_and_ome(tmp_path: Path) -> None:
    """ImageJ has pixels per unit as a ratio of integers, exact here."""
    tifffile.imwrite(
        tmp_path / "a.tif", VALUES, imagej=True, resolution=(4, 2), metadata={"spacing": 1.5, "unit": "um", "axes": "ZYX"}
    )
    sizes = {"PhysicalSizeX": 0.25, "PhysicalSizeY": 500, "PhysicalSizeYUnit": "nm", "PhysicalSizeZ": 1.5}
    tifffile.imwrite(tmp_path / "b.ome.tif", VALUES, ome=True, photometric="minisblack", metadata={"axes": "ZYX", **sizes})
    for name in ("a.tif", "b.ome.tif"):
        volume = read_volume(tmp_path / name)
        np.testing.assert_allclose(volume.spacing, (0.25, 0.5, 1.5), rtol=1e-12)
        assert volume.meta["unit"] == "um"


def test_channels_are_last_and_time_is_named(tmp_path: Path) -> None:
    values = np.arange(72, dtype=np.uint8).reshape(2, 3, 3, 4)
    tifffile.imwrite(tmp_path / "a.tif", values, imagej=True, metadata={"axes": "ZCYX"})
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif").values, np.moveaxis(values, 1, 3))
    tifffile.imwrite(tmp_path / "t.tif", VALUES, imagej=True, metadata={"axes": "TYX"})
    volume = read_volume(tmp_path / "t.tif")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    assert volume.meta["notes"] == ("the frames in time are the slices.",)
    tifffile.imwrite(tmp_path / "z.tif", values, imagej=True, metadata={"axes": "TZYX"})
    assert_refused(r"the axes TZYX of shape \(2, 3, 3, 4\)", read_volume, tmp_path / "z.tif")


@pytest.mark.parametrize("channels", [1, 3])
def test_written_files_are_big_tiff_with_a_float_page_a_slice(tmp_path: Path, channels: int) -> None:
    values = np.random.default_rng(1).normal(size=(2, 3, 4, channels)).astype(np.float32)
    place = frame_from_steps((4, 3, 2), np.diag((0.5, 0.25, 2)), np.zeros(3))
    write_volume(tmp_path / "a.tif", values, place, metadata={"unit": "mm"})
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.is_bigtiff
        assert len(file.pages) == 2
        np.testing.assert_array_equal(file.asarray(), values.squeeze())
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.to_world, place, atol=1e-12)
    assert volume.meta["unit"] == "mm"


def write_slices(folder: Path, name: str = "slice_{}.tif", **more: object) -> Path:
    """Slices 9 to 11 of a volume, whose names are in another order than their numbers."""
    folder.mkdir(exist_ok=True)
    for k in range(3):
        tifffile.imwrite(folder / name.format(9 + k), VALUES[0] + k, **more)
    return folder


def test_a_folder_of_slices(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Without flats, darks and angles it is a volume for explain; several kinds of images are chosen by name."""
    folder = write_slices(tmp_path / "s")
    expected = np.stack([VALUES[0] + k for k in range(3)])
    np.testing.assert_array_equal(read_volume(folder).values[..., 0], expected)
    assert run("explain", folder) == 0
    said = capsys.readouterr().out
    assert "s: TIFF\nvoxels (x, y, z): 4 x 3 x 3" in said
    assert "assumed: 3 files are the slices from z = 0 upwards." in said
    assert said.endswith("mivol optimize takes it as a scan, mivol explain does so with --set\n")
    run("explain", folder, "--set", "data.reading=intensity")
    assert "voxels (x, y, z)" not in capsys.readouterr().out
    tifffile.imwrite(folder / "overview.tif", np.zeros((9, 9), np.uint8))
    assert run("convert", folder, tmp_path / "a.nrrd") == 1
    assert "2 arrays ('slice_#.tif', 'overview.tif')" in capsys.readouterr().err
    assert run("convert", folder, tmp_path / "a.nrrd", "--dataset", "slice_#.tif") == 0
    np.testing.assert_array_equal(read_volume(tmp_path / "a.nrrd").values[..., 0], expected)


@pytest.mark.parametrize("name", ["flat_1.tif", "dark_1.tif", "angles.txt"])
def test_flats_darks_or_angles_make_a_folder_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture, name: str) -> None:
    folder = write_slices(tmp_path / "s")
    if name.endswith(".tif"):
        shutil.copy(folder / "slice_9.tif", folder / name)
    else:
        (folder / name).write_text("0\n60\n120\n")
    run("explain", folder)
    said = capsys.readouterr()
    assert "found: " in said.out or "found no flats" in said.err
    assert ": TIFF\nvoxels" not in said.out


@pytest.mark.parametrize(
    ("fault", "found"),
    [
        (lambda folder: tifffile.imwrite(folder / "slice_10.tif", VALUES[0, :2]), r"slice_10.tif of shape \(2, 4\)"),
        (lambda folder: tifffile.imwrite(folder / "slice_10.tif", VALUES[0].astype("f4")), "slice_10.tif .* type float32"),
        (
            lambda folder: tifffile.imwrite(folder / "slice_9.tif", VALUES, photometric="minisblack"),
            "3 files of 2 slices or more",
        ),
        (lambda folder: (folder / "slice_10.tif").write_bytes(b"II*\0"), "slice_10.tif: found a damaged TIFF file"),
        (lambda folder: (folder / "slice_10.tif").write_bytes(b""), "slice_10.tif: found an empty file"),
    ],
)
def test_slices_that_do_not_fit_are_named(tmp_path: Path, fault, found: str) -> None:
    folder = write_slices(tmp_path / "s")
    fault(folder)
    assert_refused(found, read_volume, folder)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_truncated_file_is_refused(tmp_path: Path, compression: str | None) -> None:
    """The directories of tifffile's own order lie before the pages that are cut off."""
    tifffile.imwrite(tmp_path / "a.tif", np.arange(6000, dtype="u2").reshape(2, 50, 60), compression=compression)
    data = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(data[:-40])
    assert_refused("TIFF", read_volume, tmp_path / "a.tif")


def test_a_page_without_bytes_is_refused(tmp_path: Path) -> None:
    """tifffile reads zeros where the length of a strip (tag 279) is 0."""
    tifffile.imwrite(tmp_path / "a.tif", VALUES[0] + 1, metadata=None)
    data = (tmp_path / "a.tif").read_bytes()
    at = re.search(struct.pack("<H", 279) + rb"[\x03\x04]\x00\x01\x00\x00\x00", data).end()
    (tmp_path / "a.tif").write_bytes(data[:at] + bytes(4) + data[at + 4 :])
    assert_refused("pages that the file does not hold", read_volume, tmp_path / "a.tif")


def test_bad_voxel_sizes_and_kinds_are_named(tmp_path: Path) -> None:
    sizes = {f"PhysicalSize{axis}": -1.0 for axis in "XYZ"}
    tifffile.imwrite(tmp_path / "a.tif", VALUES, ome=True, photometric="minisblack", metadata={"axes": "ZYX", **sizes})
    assert_refused(r"distances of voxels \[-1.0", read_volume, tmp_path / "a.tif")
    with tifffile.TiffWriter(tmp_path / "b.tif") as writer:
        writer.write(VALUES[0])
        writer.write(VALUES[0, :2])
    assert_refused("2 images of different kinds", read_volume, tmp_path / "b.tif")
