"""Every file format: bytes made by hand, round trips, atomic writes, and real files.

Values are compared exactly: every format here stores float32 or small integers, which float32 holds exactly. Places are
compared to 1e-12 relative to their size (a few float64 roundings of numbers below 100), or to float32 rounding (1e-6)
for files that store float32.
"""

from __future__ import annotations

import errno
import io
import json
import os
import stat
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import volume_files as made
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from refusals import assert_refused

from mivol import files
from mivol.errors import MivolError
from mivol.files import formats

#: what the hand-made files with spacing (1.5, 2, 2.5) and first centre (10, 20, 30) must give for 4 x 3 x 2 voxels.
PLACE = np.array([[6, 0, 0, 9.25], [0, 6, 0, 19], [0, 0, 5, 28.75], [0, 0, 0, 1]])

#: types and byte orders that the hand-made files of binary formats are tried in.
TYPES = [("u1", "<"), ("i2", ">"), ("i2", "<"), ("u2", "<"), ("f4", ">"), ("f4", "<"), ("f8", ">"), ("f8", "<")]


def read(folder: Path, name: str, data: bytes, **options: object) -> files.VolumeData:
    (folder / name).write_bytes(data)
    return files.read_volume(folder / name, **options)


def assert_volume(volume: files.VolumeData, values: np.ndarray, place: np.ndarray = PLACE, tol: float = 1e-12) -> None:
    assert volume.values.dtype == np.float32
    assert volume.values.flags.c_contiguous
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.to_world, place, rtol=tol, atol=100 * tol)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
@pytest.mark.parametrize("suffix", ["nrrd", "mha", "nii", "vti"])
def test_every_type_of_numbers(tmp_path: Path, suffix: str, dtype: str) -> None:
    """Large values with the sign of the type: another width or sign would change them. float32 holds each exactly."""
    make = {"nrrd": made.nrrd, "mha": made.mha, "nii": partial(made.nifti, sform=SFORM), "vti": made.vti}[suffix]
    bits, small = 8 * int(dtype[1]), made.numbered() // 4
    whole = np.float32(2.0 ** (bits - 2)) + small * np.float32(2.0 ** max(bits - 10, 0))
    values = {"i": -whole, "u": 2 * whole, "f": small / 3}[dtype[0]]
    np.testing.assert_array_equal(read(tmp_path, f"a.{suffix}", make(values, dtype=dtype)).values, values)


# -- Mitsuba .vol ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3])
def test_vol_by_hand(tmp_path: Path, channels: int) -> None:
    values = made.numbered(channels=channels)
    volume = read(tmp_path, "a.vol", made.vol(values))
    assert_volume(volume, values, files.frame_from_box((-1, -2, -3), (3, 4, 5)))
    np.testing.assert_allclose(volume.spacing, (1, 2, 4))
    np.testing.assert_allclose(volume.origin, (-0.5, -1, -1))


def test_vol_encodings(tmp_path: Path) -> None:
    """float16 holds these integers exactly; uint8 255 stands for 1, rounded once by the product in float32."""
    values = made.numbered()
    np.testing.assert_array_equal(read(tmp_path, "h.vol", made.vol(values, encoding=2)).values, values)
    coded = read(tmp_path, "b.vol", made.vol(values, encoding=3)).values
    np.testing.assert_allclose(coded, values / 255, rtol=2 * np.finfo(np.float32).eps)


def test_vol_is_written_byte_for_byte(tmp_path: Path) -> None:
    values = made.numbered(channels=3)
    files.write_volume(tmp_path / "a.vol", values, files.frame_from_box((-1, -2, -3), (3, 4, 5)))
    assert (tmp_path / "a.vol").read_bytes() == made.vol(values)


@pytest.mark.parametrize("channels", [1, 3])
def test_vol_agrees_with_mitsuba(tmp_path: Path, variant_rgb: str, channels: int) -> None:
    """Stock gridvolume shows voxel (x, y, z) of a mivol file at to_world((i + .5)/N), and mivol reads Mitsuba's file.

    gridvolume interpolates in float32: at a voxel centre the fraction is off by at most a few float32 roundings of the
    world position (|p| < 8, voxels of 1 or more), times the largest difference of neighbours (64).
    """
    import mitsuba as mi

    values = made.numbered(channels=channels)
    place = files.frame_from_box((-1, -2, -3), (3, 4, 5))
    files.write_volume(tmp_path / "ours.vol", values, place)
    loaded = mi.load_dict({"type": "gridvolume", "filename": str(tmp_path / "ours.vol"), "use_grid_bbox": True, "raw": True})
    tolerance = 8 * np.finfo(np.float32).eps * 8 * 64
    for z, y, x in np.ndindex(values.shape[:3]):
        it = mi.Interaction3f()
        it.p = mi.Point3f(place[:3, :3] @ ((np.array([x, y, z]) + 0.5) / (4, 3, 2)) + place[:3, 3])
        seen = loaded.eval_1(it) if channels == 1 else loaded.eval_3(it)
        np.testing.assert_allclose(np.array(seen).ravel(), values[z, y, x], atol=tolerance)
    mi.VolumeGrid(mi.TensorXf(values)).write(str(tmp_path / "theirs.vol"))
    assert_volume(files.read_volume(tmp_path / "theirs.vol"), values, np.eye(4))


# -- NumPy ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["u1", ">i2", "<f2", ">f4", "f8", "?"])
def test_npy_types(tmp_path: Path, dtype: str) -> None:
    values = made.numbered() % 2 if dtype == "?" else made.numbered()
    np.save(tmp_path / "a.npy", np.asfortranarray(values[..., 0].astype(dtype)))
    assert_volume(files.read_volume(tmp_path / "a.npy"), values, np.eye(4))


def test_foreign_npz_by_array_name(tmp_path: Path) -> None:
    values = made.numbered(channels=3)
    np.savez(tmp_path / "a.npz", rho=values, mask=values[..., 0] > 3, axis=np.arange(3))
    assert_volume(files.read_volume(tmp_path / "a.npz", "rho"), values, np.eye(4))
    np.testing.assert_array_equal(files.read_volume(tmp_path / "a.npz", "mask").values[..., 0], values[..., 0] > 3)


# -- NRRD -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
def test_nrrd_by_hand(tmp_path: Path, encoding: str) -> None:
    values = made.numbered()
    for dtype, order in TYPES:
        volume = read(tmp_path, "a.nrrd", made.nrrd(values, dtype=dtype, order=order, encoding=encoding))
        assert_volume(volume, values)
        assert volume.meta["space"] == "LPS"


def test_nrrd_channels_first_or_last(tmp_path: Path) -> None:
    values = made.numbered(channels=3)
    assert_volume(read(tmp_path, "first.nrrd", made.nrrd(values)), values)
    head = made.nrrd_head(values, sizes="4 3 2 3", space_directions="(1.5,0,0) (0,2,0) (0,0,2.5) none") + "\n"
    planes = [number for c in range(3) for number in made.in_order(values[..., c : c + 1])]
    assert_volume(read(tmp_path, "last.nrrd", head.encode() + made.packed(planes, "f4")), values)


@pytest.mark.parametrize(
    ("field", "units", "unit"),
    [
        ("space units", '"mm" "mm" "mm"', "mm"),
        ("units", '"um" "um" "um"', "um"),
        ("space units", '"mm" "mm" "s"', None),
        ("units", '"" "" ""', None),
    ],
)
def test_nrrd_units(tmp_path: Path, field: str, units: str, unit: str | None) -> None:
    """One unit of all three axes."""
    assert read(tmp_path, "a.nrrd", made.nrrd(made.numbered(), **{field: units})).meta["unit"] == unit


def test_nrrd_rotated(tmp_path: Path) -> None:
    """x points along world y, y along -x, with a shear in z."""
    values = made.numbered()
    volume = read(tmp_path, "a.nrrd", made.nrrd(values, space_directions="(0,1.5,0) (-2,0,0) (1,0,2.5)"))
    np.testing.assert_allclose(volume.steps, [[0, -2, 1], [1.5, 0, 0], [0, 0, 2.5]], atol=1e-12)
    np.testing.assert_allclose(volume.origin, (10, 20, 30))


def test_nrrd_without_a_space(tmp_path: Path) -> None:
    """Spacings only; axis mins of cells are the border, half a voxel before the first centre."""
    plain = {"space": "", "space_directions": "", "space_origin": "", "spacings": "1.5 2 2.5"}
    volume = read(tmp_path, "a.nrrd", made.nrrd(made.numbered(), **plain))
    np.testing.assert_allclose((volume.spacing, volume.origin), ((1.5, 2, 2.5), (0, 0, 0)), atol=1e-12)
    volume = read(tmp_path, "b.nrrd", made.nrrd(made.numbered(), **plain, axis_mins="9.25 19 28.75"))
    assert_volume(volume, made.numbered())
    # NaN is an unknown number: a step of 1, and a centre at 0.
    plain["spacings"] = "1.5 nan 2.5"
    volume = read(tmp_path, "c.nrrd", made.nrrd(made.numbered(), **plain, axis_mins="9.25 19 nan"))
    np.testing.assert_allclose((volume.spacing, volume.origin), ((1.5, 1, 2.5), (10, 19.5, 0)), atol=1e-12)


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_nrrd_detached(tmp_path: Path, encoding: str) -> None:
    """The line skip precedes decompression, the byte skip follows it."""
    values = made.numbered()
    body = b"\1\2\3" + made.packed(made.in_order(values), "i2", ">")
    (tmp_path / "data").write_bytes(b"one line\nanother\n" + made.PACK[encoding](body))
    head = made.nrrd_head(values, dtype="i2", order=">", encoding=encoding, line_skip="2", byte_skip="3")
    assert_volume(read(tmp_path, "a.nhdr", (head + "data file: data\n").encode()), values)


def test_nrrd_byte_skip_from_the_end(tmp_path: Path) -> None:
    values = made.numbered()
    (tmp_path / "data").write_bytes(b"of any length" + made.packed(made.in_order(values), "f4"))
    head = made.nrrd_head(values, byte_skip="-1") + "datafile: data\n"
    assert_volume(read(tmp_path, "a.nhdr", head.encode()), values)


def test_a_too_long_nrrd_is_refused(tmp_path: Path) -> None:
    """Only a negative byte skip counts from the end."""
    assert_refused("longer than its header says", read, tmp_path, "a.nrrd", made.nrrd(made.numbered()) + b"and more")


@pytest.mark.parametrize("names", ["LIST\nslice-0\nslice-1\n", "slice-%d 0 1 1\n"])
def test_nrrd_slices(tmp_path: Path, names: str) -> None:
    values = made.numbered()
    for z in range(2):
        (tmp_path / f"slice-{z}").write_bytes(made.packed(made.in_order(values[z : z + 1]), "f4"))
    assert_volume(read(tmp_path, "a.nhdr", (made.nrrd_head(values) + "data file: " + names).encode()), values)


# -- MetaImage ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keys", [{}, {"CompressedData": "True"}, {"BinaryData": "False"}], ids=["raw", "zlib", "text"])
def test_metaimage_by_hand(tmp_path: Path, keys: dict[str, str]) -> None:
    values = made.numbered(channels=3)
    for dtype, order in TYPES:
        volume = read(tmp_path, "a.mha", made.mha(values, dtype=dtype, order=order, **keys))
        assert_volume(volume, values)
        assert volume.meta["space"] == "LPS"


def test_metaimage_rows_of_the_matrix_are_the_axes(tmp_path: Path) -> None:
    """Axis x points along world y, y along -x: the transposed matrix would give y along +x."""
    volume = read(tmp_path, "a.mha", made.mha(made.numbered(), TransformMatrix="0 1 0 -1 0 0 0 0 1"))
    np.testing.assert_allclose(volume.steps, [[0, -2, 0], [1.5, 0, 0], [0, 0, 2.5]], atol=1e-12)
    np.testing.assert_allclose(volume.origin, (10, 20, 30))


@pytest.mark.parametrize("names", ["data", "LIST\nslice-0\nslice-1", "slice-%d 0 1 1"])
@pytest.mark.parametrize("head", ["0", "5", "-1"])
def test_metaimage_detached(tmp_path: Path, names: str, head: str) -> None:
    values = made.numbered()
    skip = b"\7" * (5 if head != "0" else 0)
    (tmp_path / "data").write_bytes(skip + made.packed(made.in_order(values), "f4"))
    for z in range(2):
        (tmp_path / f"slice-{z}").write_bytes(skip + made.packed(made.in_order(values[z : z + 1]), "f4"))
    assert_volume(read(tmp_path, "a.mhd", made.meta_head(values, data=names, HeaderSize=head)), values)


# -- NIfTI ----------------------------------------------------------------------------------------------------------

SFORM = [1.5, 0, 0, 10, 0, 2, 0, 20, 0, 0, 2.5, 30]


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("channels", [1, 3])
def test_nifti_by_hand(tmp_path: Path, version: int, name: str, channels: int) -> None:
    values = made.numbered(channels=channels)
    for dtype, order in TYPES:
        data = made.nifti(values, dtype=dtype, order=order, version=version, sform=SFORM)
        volume = read(tmp_path, name, made.PACK["gzip" if name.endswith("gz") else "raw"](data))
        assert_volume(volume, values)
        assert (volume.meta["space"], volume.meta["unit"]) == ("RAS", "mm")


@pytest.mark.parametrize("axis", [4, 5, 6, 7])
def test_nifti_channels_on_every_further_axis(tmp_path: Path, axis: int) -> None:
    values = made.numbered(channels=3)
    assert_volume(read(tmp_path, "a.nii", made.nifti(values, sform=SFORM, axis=axis)), values)


def test_nifti_qform_is_a_quaternion(tmp_path: Path) -> None:
    """A quarter turn about z is (a, b, c, d) = (r, 0, 0, r), r = sqrt(1/2): x runs along y, y along -x; qfac flips z."""
    data = made.nifti(made.numbered(), version=2, qform=[0, 0, np.sqrt(0.5), 10, 20, 30], pixdim=(-1.0, 1.5, 2.0, 2.5))
    volume = read(tmp_path, "a.nii", data)
    np.testing.assert_allclose(volume.steps, [[0, -2, 0], [1.5, 0, 0], [0, 0, -2.5]], atol=1e-12)
    np.testing.assert_allclose(volume.origin, (10, 20, 30))


def test_nifti_sform_comes_before_qform(tmp_path: Path) -> None:
    data = made.nifti(made.numbered(), sform=SFORM, qform=[0, 0, 1, 0, 0, 0])
    assert_volume(read(tmp_path, "a.nii", data), made.numbered())


def test_nifti_scale(tmp_path: Path) -> None:
    """Slope and intercept are exact binary numbers; a slope of 0 means no scaling."""
    data = made.nifti(made.numbered(), dtype="i2", sform=SFORM, scale=(0.5, -3))
    assert_volume(read(tmp_path, "a.nii", data), made.numbered() * 0.5 - 3)
    data = made.nifti(made.numbered(), dtype="i2", sform=SFORM, scale=(0, 7))
    assert_volume(read(tmp_path, "b.nii", data), made.numbered())


def test_nifti_colours(tmp_path: Path) -> None:
    values = made.numbered(channels=3)
    head = made.nifti(values[..., :1], sform=SFORM, code=128, dtype="u1")[:352]
    assert_volume(read(tmp_path, "a.nii", head + made.packed(made.in_order(values), "u1")), values)


def test_ras_and_lps_agree(tmp_path: Path) -> None:
    """The same head in NIfTI and in MetaImage has the same placement in the same frame."""
    ras = read(tmp_path, "a.nii", made.nifti(made.numbered(), version=2, sform=SFORM))
    lps = read(tmp_path, "a.mha", made.mha(made.numbered(), Offset="-10 -20 30", TransformMatrix="-1 0 0 0 -1 0 0 0 1"))
    np.testing.assert_allclose(files.to_space(lps, "RAS").to_world, ras.to_world, atol=1e-12)
    assert np.abs(lps.to_world - ras.to_world).max() > 1


# -- VTK ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow_for("ascii-lzma", "base64-lzma", "inline-lzma")
@pytest.mark.parametrize("compressor", [None, "zlib", "lzma"])
@pytest.mark.parametrize("mode", ["ascii", "inline", "base64", "raw"])
def test_vti_by_hand(tmp_path: Path, compressor: str | None, mode: str) -> None:
    values = made.numbered(channels=3)
    for header_type in ("UInt32", "UInt64"):
        for dtype, order in TYPES:
            data = made.vti(values, dtype=dtype, order=order, header_type=header_type, compressor=compressor, mode=mode)
            assert_volume(read(tmp_path, "a.vti", data), values)


@pytest.mark.parametrize("header_type", ["UInt32", "UInt64"])
def test_vti_with_separately_padded_lengths(tmp_path: Path, header_type: str) -> None:
    values = made.numbered()
    data = made.vti(values, mode="inline", split=True, header_type=header_type)
    assert_volume(read(tmp_path, "a.vti", data), values)


def test_vti_placement(tmp_path: Path) -> None:
    """The extent starts at (2, -1, 5); its first point is origin + direction @ (spacing * first); cells lie half a step in."""
    turned = {"direction": "0 -1 0 1 0 0 0 0 1", "first": (2, -1, 5)}
    volume = read(tmp_path, "a.vti", made.vti(made.numbered(), **turned))
    np.testing.assert_allclose(volume.steps, [[0, -2, 0], [1.5, 0, 0], [0, 0, 2.5]], atol=1e-12)
    np.testing.assert_allclose(volume.origin, (10 + 2, 20 + 3, 30 + 12.5))
    assert volume.meta["centering"] == "point"
    volume = read(tmp_path, "b.vti", made.vti(made.numbered(), cells=True, **turned))
    assert volume.meta["centering"] == "cell"
    np.testing.assert_array_equal(volume.values, made.numbered())
    np.testing.assert_allclose(volume.origin, (10 + 2 - 1, 20 + 3 + 0.75, 30 + 12.5 + 1.25))


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
@pytest.mark.parametrize("kind", ["SCALARS", "VECTORS", "FIELD"])
def test_legacy_vtk_by_hand(tmp_path: Path, binary: bool, kind: str) -> None:
    values = made.numbered(channels=3)
    assert_volume(read(tmp_path, "a.vtk", made.vtk(values, binary=binary, kind=kind)), values)


def test_legacy_vtk_with_cells_and_several_arrays(tmp_path: Path) -> None:
    """Cell centres are half a step inside; an array after a binary array is found by name."""
    volume = read(tmp_path, "a.vtk", made.vtk(made.numbered(), cells=True))
    assert volume.meta["centering"] == "cell"
    assert read(tmp_path, "c.vtk", made.vtk(made.numbered())).meta["centering"] == "point"
    np.testing.assert_allclose(volume.origin, (10.75, 21, 31.25))
    data = made.vtk(made.numbered()) + b"METADATA\nINFORMATION 0\n\nSCALARS two unsigned_char\n" + bytes(range(24)) + b"\n"
    np.testing.assert_array_equal(read(tmp_path, "b.vtk", data, dataset="two").values.ravel(), np.arange(24))


# -- Text, slices, HDF5 ---------------------------------------------------------------------------------------------


def test_pbrt_by_hand(tmp_path: Path) -> None:
    volume = read(tmp_path, "a.pbrt", made.pbrt(made.numbered()))
    assert_volume(volume, made.numbered(), np.diag([8.0, 6, 4, 1]))


def test_les_by_hand(tmp_path: Path) -> None:
    """Extinction 1.5 lwc / reff: g/m^3 over um is 1/m; dry cells may have a radius of 0."""
    data = made.les([(3, 2, 1, 0.5, 10.0), (0, 1, 0, 0.25, 5.0), (1, 1, 1, 0.0, 0.0)])
    volume = read(tmp_path, "a.txt", data)
    expected = np.zeros((2, 3, 4, 1), np.float32)
    expected[1, 2, 3], expected[0, 1, 0] = 1.5 * 0.5 / 10, 1.5 * 0.25 / 5
    np.testing.assert_array_equal(volume.values, expected)
    np.testing.assert_allclose((volume.spacing, volume.origin), ((20, 30, 40), (0, 0, 400)), atol=1e-9)
    assert read(tmp_path, "b.csv", data, dataset="reff").values[1, 2, 3] == 10
    cells_by_their_other_name = read(tmp_path, "c.txt", data.replace(b"x,y,z,lwc", b"i,j,k,lwc"))
    np.testing.assert_array_equal(cells_by_their_other_name.values, expected)


def test_slices_are_ordered_by_number(tmp_path: Path) -> None:
    values = made.numbered(nz=3)
    for z, name in enumerate(("s.2", "s.9", "s.10")):
        (tmp_path / name).write_bytes(b"head" + made.packed(made.in_order(values[z : z + 1]), "u2", ">"))
    (tmp_path / "notes.txt").write_text("not a slice")
    volume = files.read_slices(
        tmp_path, shape=(3, 4), dtype=">u2", spacing=(1.5, 2, 2.5), origin=(10, 20, 30), pattern="s.*", skip=4
    )
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose((volume.spacing, volume.origin), ((1.5, 2, 2.5), (10, 20, 30)))


def make_exchange(path: Path, **changes: object) -> Path:
    """Write a Data Exchange file of 4 views of 2 x 3 pixels; ``changes`` replace datasets, or remove them by None."""
    import h5py

    arrays = {
        "data": np.arange(24, dtype="u2").reshape(4, 2, 3),
        "data_white": np.full((2, 2, 3), 100, ">f4"),
        "data_dark": np.full((1, 2, 3), 5, "i4"),
        "theta": np.array([0.0, 45, 90, 135]),
    } | changes
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array is not None:
                file[f"exchange/{name}"] = array
        if arrays["data"] is not None:
            file["exchange/data"].attrs["units"] = "counts"
    return path


def test_projections(tmp_path: Path) -> None:
    read_back = files.read_projections(make_exchange(tmp_path / "a.h5"))
    np.testing.assert_array_equal(read_back.projections, np.arange(24).reshape(4, 2, 3))
    assert read_back.projections.dtype == read_back.flats.dtype == read_back.darks.dtype == np.float32
    assert (read_back.flats.shape, read_back.darks.shape) == ((2, 2, 3), (1, 2, 3))
    np.testing.assert_allclose(read_back.angles, np.arange(4) * np.pi / 4, rtol=1e-15)
    assert read_back.meta["unit"] == "counts"


def test_hdf5_volume_by_name(tmp_path: Path) -> None:
    make_exchange(tmp_path / "a.h5", data_white=made.numbered(channels=3))
    assert_volume(files.read_volume(tmp_path / "a.h5", "/exchange/data_white"), made.numbered(channels=3), np.eye(4))


def test_hdf5_names_and_units_outside_utf8(tmp_path: Path) -> None:
    """Invalid bytes are replaced in units and names, so refusals can be printed."""
    import h5py

    path = make_exchange(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file[b"exchange/\xfe"] = np.ones(3)
    with pytest.raises(MivolError, match="no dataset exchange/white.*\ufffd") as caught:
        files.read_projections(path, names={"flats": "exchange/white"})
    assert str(caught.value).encode()
    make_exchange(path)
    with h5py.File(path, "a") as file:
        file["exchange/data"].attrs["units"] = np.bytes_(b"counts \xff")
    assert files.read_projections(path).meta["unit"] == "counts \ufffd"
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file[b"grid \xfe"] = made.numbered()[..., 0]
    assert files.read_volume(tmp_path / "b.h5").meta["dataset"] == "grid \ufffd"


# -- Frames and round trips -----------------------------------------------------------------------------------------


def test_steps_place_the_voxel_centres() -> None:
    """Local ((i + .5)/Nx, ...) maps to origin + steps @ (i, j, k), for a sheared, mirrored frame."""
    steps, origin = np.array([[0, -2.0, 0.5], [1.5, 0, 0], [0, 0.25, -2.5]]), np.array([10.0, 20, 30])
    to_world = files.frame_from_steps((4, 3, 2), steps, origin)
    for index in np.ndindex(4, 3, 2):
        local = (np.array(index) + 0.5) / (4, 3, 2)
        np.testing.assert_allclose(to_world[:3, :3] @ local + to_world[:3, 3], origin + steps @ index, atol=1e-12)


def test_unit_frame_ignores_the_header(tmp_path: Path) -> None:
    volume = read(tmp_path, "a.vol", made.vol(made.numbered(), box=(0, 0, 0, 0, 0, 0)), frame="unit")
    assert_volume(volume, made.numbered(), np.eye(4))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    shape=st.tuples(*[st.integers(1, 5)] * 3, st.sampled_from([1, 2, 3])),
    suffix=st.sampled_from([".npz", ".nrrd"]),
    compress=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(tmp_path: Path, shape: tuple[int, ...], suffix: str, compress: bool, seed: int) -> None:
    """Arbitrary finite float32 values and frames: equal bits, and the frame to float64 rounding (NRRD stores steps)."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 2**32, shape, np.uint32).view(np.float32)
    values = np.where(np.isfinite(values), values, 0).astype(np.float32)
    to_world = np.eye(4)
    to_world[:3] = rng.normal(size=(3, 4)) + 3 * np.eye(3, 4)
    metadata = {"space": "RAS", "note": "two\nlines"}
    files.write_volume(tmp_path / f"a{suffix}", values, to_world, metadata=metadata, compress=compress)
    volume = files.read_volume(tmp_path / f"a{suffix}")
    assert_volume(volume, values, to_world)
    assert volume.meta["space"] == "RAS"


def test_a_reader_of_values_and_place_alone_serves_every_verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new format is a reader and an entry in the table. Facts about the file are a courtesy."""
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4, 1)
    made_up = formats.VolumeFormat("made up", lambda head: head == b"MADE", lambda path, _: files.VolumeData(values, np.eye(4)))
    monkeypatch.setitem(formats.FORMATS, ".made", made_up)
    source, target = tmp_path / "a.made", tmp_path / "a.nrrd"
    source.write_bytes(b"MADE")
    assert "1 channel of float32" in formats.describe_volume(source)
    formats.convert_volume(source, target)
    assert_volume(files.read_volume(target), values, np.eye(4))


@pytest.mark.parametrize("suffix", [".npz", ".nrrd"])
def test_files_are_compressed_unless_asked_otherwise(tmp_path: Path, suffix: str) -> None:
    """A ramp of 32^3 values shrinks to less than a tenth; stored, it keeps the size of its values."""
    values = np.broadcast_to(np.arange(32, dtype=np.float32), (32, 32, 32))[..., None]
    sizes = {}
    for compress in (True, False):
        files.write_volume(tmp_path / f"a{suffix}", values, compress=compress)
        sizes[compress] = (tmp_path / f"a{suffix}").stat().st_size
    assert sizes[True] < values.nbytes / 10
    assert suffix == ".nrrd" or sizes[False] >= values.nbytes


def test_npy_round_trip_of_a_strided_array(tmp_path: Path) -> None:
    values = made.numbered(4, 4, 4, 3)[::2, :, ::-1]
    files.write_volume(tmp_path / "a.npy", values)
    assert_volume(files.read_volume(tmp_path / "a.npy"), values, np.eye(4))


def test_npz_stores_metadata_as_json(tmp_path: Path) -> None:
    files.write_volume(tmp_path / "a.npz", made.numbered(), metadata={"unit": "1/m", "seeds": [1, 2]})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert archive["metadata"].ndim == 0
        assert json.loads(archive["metadata"].item()) == {"unit": "1/m", "seeds": [1, 2]}
    assert files.read_volume(tmp_path / "a.npz").meta["metadata"]["unit"] == "1/m"


# -- Images ---------------------------------------------------------------------------------------------------------


def test_exr_round_trip_with_layers_and_header(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    picture, variance, tau = rng.normal(size=(5, 7, 3)), rng.normal(size=(5, 7, 4)), rng.normal(size=(5, 7))
    tau[1, 2], tau[3, 4] = np.nan, np.inf
    header = {"mivol": json.dumps({"spp": 16, "name": "später"}), "spp": 16}
    files.write_exr(tmp_path / "a.exr", {"": picture[:, ::-1], "variance": variance, "tau": tau}, header)
    channels, read_header = files.read_exr(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B", "tau", *(f"variance.{letter}" for letter in "RGBA")}
    assert all(channel.dtype == np.float32 for channel in channels.values())
    stacked = files.stack_layers(channels)
    np.testing.assert_array_equal(stacked[""], picture[:, ::-1].astype(np.float32))
    np.testing.assert_array_equal(stacked["variance"], variance.astype(np.float32))
    np.testing.assert_array_equal(stacked["tau"], tau.astype(np.float32))
    assert json.loads(read_header["mivol"]) == {"spp": 16, "name": "später"}
    assert read_header["spp"] == 16


def test_exr_is_exchanged_with_mitsuba(tmp_path: Path, two_threads: None) -> None:
    import mitsuba as mi

    rng = np.random.default_rng(2)
    picture, variance = rng.random((4, 6, 3), np.float32), rng.random((4, 6, 3), np.float32)
    files.write_exr(tmp_path / "a.exr", {"": picture, "variance": variance}, {"mivol": "{}"})
    seen = dict(mi.Bitmap(str(tmp_path / "a.exr")).split())
    np.testing.assert_array_equal(np.array(seen["<root>"]), picture)
    np.testing.assert_array_equal(np.array(seen["variance"]), variance)
    mi.Bitmap(picture).write(str(tmp_path / "b.exr"))
    np.testing.assert_array_equal(files.stack_layers(files.read_exr(tmp_path / "b.exr")[0])[""], picture)


def test_png_is_srgb(tmp_path: Path) -> None:
    """Codes of IEC 61966-2-1 by hand: 0.5 -> 187.5 -> 188, 0.002 -> 6.59 -> 7; alpha stays linear."""
    row = np.array([[[0.5, 0.002, 2.0, 0.5], [-1.0, 1.0, 0.0, 1.0]]])
    files.write_png(tmp_path / "a.png", row)
    assert np.array(Image.open(tmp_path / "a.png")).tolist() == [[[188, 7, 255, 128], [0, 255, 0, 255]]]
    for grey in (np.full((2, 3), 0.5), np.full((2, 3, 1), 0.5)):
        files.write_png(tmp_path / "b.png", grey)
        assert np.array(Image.open(tmp_path / "b.png")).tolist() == [[188] * 3] * 2


def test_png_refuses_nan_with_its_pixel(tmp_path: Path) -> None:
    for shape in ((4, 5), (4, 5, 3)):
        image = np.zeros(shape)
        image[2, 3] = np.nan
        assert_refused("NaN at row 2, column 3", files.write_png, tmp_path / "c.png", image)


@pytest.mark.parametrize("shape", [(3,), (2, 3, 2), (2, 3, 5), (0, 3), (1, 2, 3, 3)])
def test_png_refuses_other_shapes(tmp_path: Path, shape: tuple[int, ...]) -> None:
    assert_refused("convert the array|choose channels", files.write_png, tmp_path / "c.png", np.zeros(shape))


# -- Whole writes ---------------------------------------------------------------------------------------------------


class Stop(BaseException):
    """A BaseException like Ctrl-C."""


@pytest.mark.parametrize("fault", [RuntimeError("no"), Stop(), OSError(errno.ENOSPC, "full")], ids=lambda e: repr(e))
def test_a_failed_write_keeps_the_earlier_file(tmp_path: Path, fault: BaseException) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")

    def writer(file: io.BufferedWriter) -> None:
        file.write(b"half")
        raise fault

    with pytest.raises(MivolError if isinstance(fault, OSError) else type(fault)):
        files.write_whole(path, writer)
    assert path.read_bytes() == b"before"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


def test_a_file_appears_only_when_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"

    def writer(file: io.BufferedWriter) -> None:
        file.write(b"new")
        assert not path.exists()

    files.write_whole(path, writer)
    assert path.read_bytes() == b"new"


def test_a_file_is_synced_before_its_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    sync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (events.append("sync"), sync(handle)))
    monkeypatch.setattr(Path, "replace", lambda self, to: (events.append("replace"), replace(self, to))[1])
    files.write_whole_text(tmp_path / "a.txt", "größer")
    assert events[:2] == ["sync", "replace"]
    assert (tmp_path / "a.txt").read_text("utf-8") == "größer"


def test_links_and_the_umask_are_kept(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    before = os.umask(0o027)
    try:
        files.write_whole_bytes(tmp_path / "link", b"new")
    finally:
        os.umask(before)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o640


WRITE_TOO_MUCH = """
import resource, sys, numpy as np
from mivol import files
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
noise = np.random.default_rng(0).random((20, 20, 20, 3), np.float32)
writers = {
    ".exr": lambda path: files.write_exr(path, {"": noise[0]}),
    ".png": lambda path: files.write_png(path, noise[0]),
}
try:
    writers.get(sys.argv[1], lambda path: files.write_volume(path, noise))(sys.argv[2])
except ValueError as error:
    print(error)
else:
    print("no error")
"""


@pytest.mark.slow_for(".exr", ".npz", ".nrrd", ".png", ".vol")
@pytest.mark.skipif(sys.platform == "win32", reason="needs the resource module of POSIX")
@pytest.mark.parametrize("suffix", [".vol", ".npy", ".npz", ".nrrd", ".exr", ".png"])
def test_every_writer_reports_errors_of_the_system(tmp_path: Path, suffix: str) -> None:
    """A limit on the file size acts as a full disk: the same error path without a special disk."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"before")
    done = subprocess.run([sys.executable, "-c", WRITE_TOO_MUCH, suffix, str(path)], capture_output=True, text=True, check=True)
    assert "larger than the limit of the system" in done.stdout, done.stdout + done.stderr
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


# -- Real files -----------------------------------------------------------------------------------------------------

#: path -> shape (Z, Y, X, C), smallest, largest, spacing, all from the manifest or the files' own headers.
REAL = {
    "volumes_vol/tutorials_volume.vol": ((53, 45, 44, 1), 0, 1.8496094, (0.061161, 0.061161, 0.06137)),
    "volumes_vol/sapo17_colored_albedo.vol": ((16, 16, 16, 3), 0, 1, (1 / 16, 1 / 16, 1 / 16)),
    "volumes_vol/sapo17_empty_albedo.vol": ((16, 16, 16, 3), 0, 0, (1 / 16, 1 / 16, 1 / 16)),
    "ct_mri/tooth.nrrd": ((161, 94, 103, 1), 0, 255, (1, 1, 1)),
    "ct_mri/bonsai.vti": ((256, 256, 256, 1), 0, 255, (1, 1, 1)),
    "ct_mri/HeadMRVolume.mhd": ((42, 62, 48, 1), 0, 255, (4, 4, 4)),
    "ct_mri/hydrogen.vti": ((64, 64, 64, 1), 0, 1, (1, 1, 1)),
    "ct_mri/ironProt.vtk": ((68, 68, 68, 1), 0, 255, (1, 1, 1)),
    "ct_mri/FLAIR.nii.gz": ((140, 160, 124, 1), 0, 255, (1, 1, 1)),
    "volumes_pbrt/smoke_seq/density_render.60.pbrt": ((40, 100, 100, 1), 0, 1, (0.0198, 0.0198, 0.0195)),
    "volumes_pbrt/fds_fire_t12/12SmokeExtinction.pbrt": ((21, 41, 81, 1), 0, 43.811, (0.02444, 0.0239, 0.02286)),
    "volumes_pbrt/fds_fire_t12/12SmokeKelvinTemperature.pbrt": ((21, 41, 81, 1), 275.412, 1318.05, None),
}


@pytest.mark.slow_for("ct_mri/bonsai.vti")
@pytest.mark.parametrize("name", REAL)
def test_real_volume(data_dir: Path, name: str) -> None:
    """Ranges and spacings have 4 to 5 digits."""
    shape, low, high, spacing = REAL[name]
    volume = files.read_volume(data_dir / name)
    assert volume.values.shape == shape
    np.testing.assert_allclose((volume.values.min(), volume.values.max()), (low, high), rtol=1e-4, atol=1e-4)
    if spacing:
        np.testing.assert_allclose(volume.spacing, spacing, rtol=1e-3)
    files.check_volume(volume.values, name=name)


def test_real_vol_against_mitsuba(data_dir: Path, variant_rgb: str) -> None:
    import mitsuba as mi

    path = data_dir / "volumes_vol/tutorials_volume.vol"
    stock = mi.VolumeGrid(str(path))
    np.testing.assert_array_equal(files.read_volume(path).values, np.array(stock).reshape(53, 45, 44, 1))


def test_a_real_signed_distance_grid_is_refused(data_dir: Path) -> None:
    path = data_dir / "volumes_vol/torus_sdfgrid.vol"
    assert_refused("degenerate box", files.read_volume, path)
    volume = files.read_volume(path, frame="unit")
    with pytest.raises(MivolError, match=r"found -[\d.]+ at voxel \(z=\d+, y=\d+, x=\d+, channel=0\) and \d+ more"):
        files.check_volume(volume.values, name="sigma_t")


def test_real_slices(data_dir: Path) -> None:
    volume = files.read_slices(
        data_dir / "ct_mri/headsq", shape=(64, 64), dtype="<u2", spacing=(3.2, 3.2, 1.5), pattern="quarter.*"
    )
    assert volume.values.shape == (93, 64, 64, 1)
    assert (volume.values.min(), volume.values.max()) == (0, 3926)
    assert volume.meta["files"][9] == "quarter.10"


def test_real_cloud(data_dir: Path) -> None:
    """The largest optical depth of a column is 25.8 (manifest)."""
    volume = files.read_volume(data_dir / "clouds_les/rico32x37x26.txt")
    assert volume.values.shape == (26, 37, 32, 1)
    np.testing.assert_allclose(volume.spacing, (20, 20, 40))
    np.testing.assert_allclose(volume.values.sum(axis=0).max() * 40, 25.8, atol=0.05)


def test_real_projections(data_dir: Path) -> None:
    """(p - d)/(w - d) lies in .14 to 1.10 with median .985 (manifest, two digits)."""
    tooth = files.read_projections(data_dir / "ct_projections/tooth.h5")
    assert (tooth.projections.shape, tooth.flats.shape, tooth.darks.shape) == ((181, 2, 640), (10, 2, 640), (10, 2, 640))
    np.testing.assert_allclose(np.degrees(tooth.angles[-1]), 179, atol=0.5)
    dark = tooth.darks.mean(axis=0)
    ratio = (tooth.projections - dark) / (tooth.flats.mean(axis=0) - dark)
    np.testing.assert_allclose((ratio.min(), ratio.max(), np.median(ratio)), (0.14, 1.10, 0.985), atol=5e-3)


def test_readers_emit_no_warnings(tmp_path: Path) -> None:
    """Readers turn warnings of NumPy's text parser into refusals and leave no filter behind."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path, "a.nrrd", made.nrrd(made.numbered(), encoding="ascii"))
        with pytest.raises(MivolError):
            read(tmp_path, "b.nrrd", made.nrrd(made.numbered(), encoding="ascii") + b" word")
