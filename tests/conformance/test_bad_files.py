"""Every bad file is refused in one sentence (found, expected, way out), never with another exception.

BAD is the table: name -> (file name, what makes its bytes, words that the sentence must hold).
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import volume_files as made
from conformance.test_files import SFORM, make_exchange
from PIL import Image

from mivol import files
from mivol.errors import MivolError

ONE = made.numbered()
RGB = made.numbered(channels=3)


def assert_sentence(message: str, *words: str) -> None:
    """One line, one sentence, with its three parts and the given words."""
    assert re.fullmatch(r"[^\n]+: found [^\n]+, expected [^\n]+; [^\n]+[.?]", message), message
    for word in words:
        assert word in message, message


@contextmanager
def refused(*words: str) -> Iterator[None]:
    """Expect a refusal in one sentence that holds the words."""
    with pytest.raises(MivolError) as caught:
        yield
    assert_sentence(str(caught.value), *words)


def npy(array: np.ndarray, *, pickled: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=pickled)
    return buffer.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def swapped(data: bytes, old: bytes, new: bytes) -> bytes:
    assert data.count(old) >= 1
    return data.replace(old, new, 1)


BAD: dict[str, tuple[str, Callable[[], bytes], tuple[str, ...]]] = {
    # -- any format
    "empty file": ("a.vol", lambda: b"", ("an empty file",)),
    "suffix unknown": ("a.xyz", lambda: b"x", ("'.xyz'", ".vol", ".nii.gz")),
    "foreign, recognised": ("a.vol", lambda: made.nrrd(ONE), ("a NRRD file", "Mitsuba grid", "rename it to .nrrd")),
    "foreign, gzip missing": ("a.nii.gz", lambda: made.nifti(ONE), ("a NIfTI file", "rename it to .nii")),
    "foreign, unknown": ("a.nrrd", lambda: b"%PDF-1.7 and so on", ("b'%PDF-1.7'", "NRRD")),
    "text for binary": ("a.vti", lambda: b"<html>404</html>", ("VTK XML image",)),
    # -- Mitsuba .vol
    "vol header cut": ("a.vol", lambda: made.vol(ONE)[:40], ("40 bytes", "48", "truncated")),
    "vol data cut": ("a.vol", lambda: made.vol(ONE)[:-4], ("92 bytes", "96", "truncated")),
    "vol too long": ("a.vol", lambda: made.vol(ONE) + b"\0", ("97 bytes", "longer than its header")),
    "vol version": ("a.vol", lambda: made.vol(ONE, version=2), ("version 2", "version 3")),
    "vol encoding": ("a.vol", lambda: made.vol(ONE, encoding=4), ("encoding 4", "float32")),
    "vol no voxels": ("a.vol", lambda: made.vol(ONE[:0]), ("4 x 3 x 0 voxels",)),
    "vol box empty": ("a.vol", lambda: made.vol(ONE, box=(0, 0, 0, 1, 1, 0)), ("degenerate box (1 x 1 x 0)", "unit")),
    "vol box denormal": ("a.vol", lambda: made.vol(ONE, box=(0, 0, 0, 1e-45, 1e-45, 1e-45)), ("degenerate box",)),
    "vol box NaN": ("a.vol", lambda: made.vol(ONE, box=(0, 0, 0, 1, 1, np.nan)), ("NaN or Inf",)),
    # -- NumPy
    "npy cut": ("a.npy", lambda: npy(ONE)[:-4], ("truncated",)),
    "npy header cut": ("a.npy", lambda: npy(ONE)[:20], ("truncated",)),
    "npy objects": ("a.npy", lambda: npy(np.array([[[None]]]), pickled=True), ("Python objects", "numbers")),
    "npy complex": ("a.npy", lambda: npy(ONE * 1j), ("type complex64", "real")),
    "npy text": ("a.npy", lambda: npy(np.array([[["a"]]])), ("type <U1", "real")),
    "npy rank 2": ("a.npy", lambda: npy(ONE[0, :, :, 0]), ("shape (3, 4)", "(Z, Y, X)")),
    "npy rank 5": ("a.npy", lambda: npy(ONE[None]), ("shape (1, 2, 3, 4, 1)",)),
    "npy empty": ("a.npy", lambda: npy(ONE[:0]), ("empty array",)),
    "npy beyond float32": ("a.npy", lambda: npy(np.diag([0, 0, 1e300])[None]), ("1e+300 at voxel (z=0, y=2, x=2", "float32")),
    "npz cut": ("a.npz", lambda: npz(values=ONE)[:-30], ("damaged archive",)),
    "npz damaged member": ("a.npz", lambda: swapped(npz(values=ONE), b"NUMPY", b"NUMPX"), ("damaged",)),
    "npz several": ("a.npz", lambda: npz(a=ONE, b=ONE), ("2 arrays ('a', 'b')", "dataset=")),
    "npz none": ("a.npz", lambda: npz(a=np.arange(3)), ("0 arrays (none)",)),
    "npz objects": ("a.npz", lambda: npz(values=np.array([None])), ("Python objects",)),
    "npz frame": ("a.npz", lambda: npz(values=ONE, to_world=np.eye(3)), ("shape (3, 3)", "4x4")),
    "npz frame of words": ("a.npz", lambda: npz(values=ONE, to_world=np.full((4, 4), "1")), ("type <U1", "4x4 real numbers")),
    "npz frame flat": ("a.npz", lambda: npz(values=ONE, to_world=np.diag([1.0, 1, 0, 1])), ("degenerate",)),
    "npz frame det 0": (
        "a.npz",
        lambda: npz(values=ONE, to_world=np.array([[1.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 2, 0], [0, 0, 0, 1]])),
        ("determinant 0",),
    ),
    "npz frame projective": ("a.npz", lambda: npz(values=ONE, to_world=np.ones((4, 4))), ("affine",)),
    "npz metadata": ("a.npz", lambda: npz(values=ONE, metadata=np.array("{")), ("metadata", "JSON")),
    # -- NRRD
    "nrrd data cut": ("a.nrrd", lambda: made.nrrd(ONE)[:-1], ("95 bytes", "96", "truncated")),
    "nrrd gzip cut": ("a.nrrd", lambda: made.nrrd(ONE, encoding="gzip")[:-9], ("gzip stream that breaks off",)),
    "nrrd bzip2 damaged": (
        "a.nrrd",
        lambda: swapped(made.nrrd(ONE, encoding="bzip2"), b"1AY&SY", b"1AY&SX"),
        ("damaged bzip2",),
    ),
    "nrrd gzip too long": (
        "a.nrrd",
        lambda: swapped(made.nrrd(ONE, encoding="gzip"), b"sizes: 4 3 2", b"sizes: 4 3 1"),
        ("more than 48 bytes",),
    ),
    "nrrd text cut": ("a.nrrd", lambda: made.nrrd(ONE, encoding="ascii")[:-5], ("23 numbers", "24")),
    "nrrd text too long": ("a.nrrd", lambda: made.nrrd(ONE, encoding="ascii") + b" 1", ("25 numbers", "longer than")),
    "nrrd text word": ("a.nrrd", lambda: made.nrrd(ONE, encoding="ascii") + b" word", ("not a number",)),
    "nrrd type": ("a.nrrd", lambda: made.nrrd(ONE, type="block"), ("'block'",)),
    "nrrd encoding": ("a.nrrd", lambda: made.nrrd(ONE).replace(b": raw", b": hex"), ("'hex'", "raw, gzip")),
    "nrrd no endian": ("a.nrrd", lambda: made.nrrd(ONE, endian=""), ("no field 'endian'",)),
    "nrrd endian": ("a.nrrd", lambda: made.nrrd(ONE, endian="middle"), ("'endian: middle'", "little or big")),
    "nrrd sizes": ("a.nrrd", lambda: made.nrrd(ONE, sizes="4 3"), ("sizes [4, 3]", "3 sizes")),
    "nrrd sizes words": ("a.nrrd", lambda: made.nrrd(ONE, sizes="four"), ("'sizes = four'",)),
    "nrrd axes unclear": (
        "a.nrrd",
        lambda: made.nrrd(RGB, space="", space_directions="", space_origin=""),
        ("4 axes of which 4 are spatial", "kinds"),
    ),
    "nrrd flat": ("a.nrrd", lambda: made.nrrd(ONE, space_directions="(1,0,0) (0,1,0) (1,1,0)"), ("determinant 0",)),
    "nrrd spacings": (
        "a.nrrd",
        lambda: made.nrrd(ONE, space="", space_directions="", space_origin="", spacings="1 2 3 4"),
        ("'spacings = 1 2 3 4'", "numbers (3)"),
    ),
    "nrrd 2-vectors": (
        "a.nrrd",
        lambda: made.nrrd(ONE, space_directions="(1,0) (0,1) (1,1)"),
        ("'space directions = 1,0'", "numbers (3)"),
    ),
    "nrrd bad line": ("a.nrrd", lambda: made.nrrd(ONE, sizes="4 3 2\nnonsense"), ("'nonsense'", "field: value")),
    "nrrd data missing": (
        "a.nhdr",
        lambda: (made.nrrd_head(ONE) + "data file: nowhere.raw\n").encode(),
        ("nowhere.raw", "nothing there"),
    ),
    # -- MetaImage
    "mha data cut": ("a.mha", lambda: made.mha(ONE)[:-1], ("95 bytes", "truncated")),
    "mha zlib cut": ("a.mha", lambda: made.mha(ONE, CompressedData="True")[:-9], ("zlib stream that breaks off",)),
    "mha type": ("a.mha", lambda: made.mha(ONE, ElementType="MET_STRING"), ("'MET_STRING'", "MET_FLOAT")),
    "mha 2D": ("a.mha", lambda: made.mha(ONE, NDims="2", DimSize="4 6"), ("NDims 2", "3D")),
    "mha no size": ("a.mha", lambda: made.mha(ONE, DimSize=""), ("no key DimSize",)),
    "mha spacing": ("a.mha", lambda: made.mha(ONE, ElementSpacing="1 1"), ("'ElementSpacing = 1 1'", "numbers (3)")),
    "mha spacing 0": ("a.mha", lambda: made.mha(ONE, ElementSpacing="1 0 1"), ("degenerate box (4 x 0 x 2)",)),
    "mha word": ("a.mha", lambda: made.mha(ONE, Offset="a b c"), ("'Offset = a b c'", "numbers")),
    "mha truth": ("a.mha", lambda: made.mha(ONE, CompressedData="maybe"), ("maybe", "True or False")),
    "mha no data file": ("a.mha", lambda: made.mha(ONE).partition(b"ElementDataFile")[0], ("no key ElementDataFile",)),
    "mhd data missing": ("a.mhd", lambda: made.meta_head(ONE, data="nowhere.raw"), ("nowhere.raw", "nothing there")),
    # -- NIfTI
    "nii data cut": ("a.nii", lambda: made.nifti(ONE, sform=SFORM)[:-4], ("92 bytes", "96")),
    "nii header cut": ("a.nii", lambda: made.nifti(ONE, sform=SFORM)[:200], ("first bytes", "NIfTI")),
    "nii.gz cut": ("a.nii.gz", lambda: made.PACK["gzip"](made.nifti(ONE))[:-5], ("gzip stream that breaks off",)),
    "nii complex": ("a.nii", lambda: made.nifti(ONE, code=32), ("datatype 32",)),
    "nii flat": ("a.nii", lambda: made.nifti(ONE, sform=[0.0] * 12), ("degenerate box",)),
    "nii sizes": ("a.nii", lambda: made.nifti(ONE[:0]), ("dim [3, 4, 3, 0",)),
    "nii pair": ("a.nii", lambda: swapped(made.nifti(ONE), b"n+1\0", b"ni1\0"), ("NIfTI",)),
    # -- VTK
    "vti raw cut": ("a.vti", lambda: made.vti(ONE).partition(b"\n</App")[0][:-40], ("breaks off",)),
    "vti xml cut": ("a.vti", lambda: made.vti(ONE, mode="ascii")[:-40], ("broken XML",)),
    "vti lz4": ("a.vti", lambda: swapped(made.vti(ONE, compressor="zlib"), b"vtkZLib", b"vtkLZ4"), ("vtkLZ4", "zlib")),
    "vti zlib damaged": ("a.vti", lambda: swapped(made.vti(ONE, compressor="zlib"), b"x\x9c", b"x\x9d"), ("damaged",)),
    "vti base64 damaged": (
        "a.vti",
        lambda: swapped(made.vti(ONE, mode="inline"), b'offset="4">', b'offset="4">!'),
        ("not base64",),
    ),
    "vti type": ("a.vti", lambda: swapped(made.vti(ONE), b'type="Float32"', b'type="String"'), ("type String",)),
    "vti header type": ("a.vti", lambda: swapped(made.vti(ONE), b"UInt32", b"Int8"), ("header_type Int8", "UInt64")),
    "vti extent": ("a.vti", lambda: made.vti(ONE).replace(b"0 3 0 2 0 1", b"0 3 0 2 0 2"), ("96 bytes", "144")),
    "vti empty": ("a.vti", lambda: made.vti(ONE).replace(b"0 3 0 2 0 1", b"0 3 0 -1 0 0"), ("extent",)),
    "vti other kind": (
        "a.vti",
        lambda: made.vti(ONE).replace(b'type="ImageData"', b'type="PolyData"'),
        ("PolyData", "ImageData"),
    ),
    "vti pieces": (
        "a.vti",
        lambda: swapped(made.vti(ONE, mode="ascii"), b"</ImageData>", b"<Piece/></ImageData>"),
        ("2 pieces",),
    ),
    "vti spacing": (
        "a.vti",
        lambda: swapped(made.vti(ONE), b'Spacing="1.5 2 2.5"', b'Spacing="1 1"'),
        ("'Spacing = 1 1'", "3"),
    ),
    "vti no arrays": ("a.vti", lambda: made.vti(ONE).replace(b"DataArray", b"Nothing"), ("0 arrays",)),
    "vtk cut": ("a.vtk", lambda: made.vtk(ONE)[:-9], ("88 bytes", "96", "truncated")),
    "vtk text cut": ("a.vtk", lambda: made.vtk(ONE, binary=False)[:-9], ("23 numbers", "24")),
    "vtk header cut": ("a.vtk", lambda: made.vtk(ONE)[:90], ("POINT_DATA", "truncated")),
    "vtk mode": ("a.vtk", lambda: swapped(made.vtk(ONE), b"BINARY", b"MORSE"), ("'MORSE'", "ASCII or BINARY")),
    "vtk mesh": ("a.vtk", lambda: swapped(made.vtk(ONE), b"STRUCTURED_POINTS", b"POLYDATA"), ("POLYDATA",)),
    "vtk count": ("a.vtk", lambda: swapped(made.vtk(ONE), b"DATA 24", b"DATA 25"), ("POINT_DATA 25", "24")),
    "vtk type": ("a.vtk", lambda: swapped(made.vtk(ONE), b"rho float", b"rho bit"), ("the type bit",)),
    "vtk spacing": ("a.vtk", lambda: swapped(made.vtk(ONE), b"1.5 2 2.5", b"1.5 2"), ("'SPACING = 1.5 2'", "numbers (3)")),
    "vtk no arrays": ("a.vtk", lambda: swapped(made.vtk(ONE), b"SCALARS", b"TENSORS"), ("0 arrays",)),
    # -- text
    "pbrt cut": ("a.pbrt", lambda: made.pbrt(ONE)[:-20], ("breaks off",)),
    "pbrt count": ("a.pbrt", lambda: swapped(made.pbrt(ONE), b'nx" 4', b'nx" 5'), ("24 numbers", "30")),
    "pbrt no box": ("a.pbrt", lambda: swapped(made.pbrt(ONE), b"point p1", b"point p2"), ("no p1",)),
    "pbrt flat": ("a.pbrt", lambda: swapped(made.pbrt(ONE), b"8 6 4", b"8 6 0"), ("degenerate",)),
    "les outside": ("a.txt", lambda: made.les([(4, 0, 0, 1, 1)]), ("[4, 0, 0]", "[4, 3, 2]")),
    "les radius": ("a.txt", lambda: made.les([(0, 0, 0, 1, 0)]), ("radius 0",)),
    "les cut": ("a.txt", lambda: made.les([(0, 0, 0, 1, 1)])[:-4], ("3 numbers", "5")),
    "les uneven": ("a.csv", lambda: made.les([], size="4,3,3", altitudes="0.4,0.44,0.52"), ("uneven",)),
    "les huge": ("a.csv", lambda: made.les([(0, 0, 0, 1, 1)], size="90000000,90000,2"), ("1073741824 cells",)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file(tmp_path: Path, name: str) -> None:
    file_name, make, words = BAD[name]
    path = tmp_path / file_name
    path.write_bytes(make())
    with refused(str(tmp_path), *words):
        files.read_volume(path)


def test_a_missing_file_suggests_a_similar_name(tmp_path: Path) -> None:
    (tmp_path / "smoke.vol").write_bytes(made.vol(ONE))
    with refused("nothing there", "did you mean smoke.vol?"):
        files.read_volume(tmp_path / "smoek.vol")
    with refused("nowhere does not exist"):
        files.read_volume(tmp_path / "nowhere" / "smoke.vol")


def test_a_folder_instead_of_a_file_is_refused(tmp_path: Path) -> None:
    for read in (files.read_volume, files.read_exr, files.read_projections):
        with refused("a folder", "read_slices"):
            read(tmp_path)
    with refused("a folder", f"{tmp_path.name}/*.tif"):
        files.read_stack(tmp_path)


def test_an_unknown_dataset_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(npz(density=ONE, albedo=RGB))
    with refused("'densty'", "did you mean 'density'"):
        files.read_volume(tmp_path / "a.npz", "densty")
    (tmp_path / "a.vol").write_bytes(made.vol(ONE))
    with refused("one unnamed array"):
        files.read_volume(tmp_path / "a.vol", "density")


def test_an_unknown_frame_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.vol").write_bytes(made.vol(ONE))
    with refused("'world'", "file, unit"):
        files.read_volume(tmp_path / "a.vol", frame="world")


# -- No other exception, whatever the bytes ---------------------------------------------------------------------------

SOUND: dict[str, tuple[str, bytes]] = {
    "vol": ("a.vol", made.vol(ONE)),
    "npy": ("a.npy", npy(ONE)),
    "npz": ("a.npz", npz(values=ONE, to_world=np.eye(4), metadata=np.array("{}"))),
    "nrrd": ("a.nrrd", made.nrrd(RGB)),
    "nrrd gzip": ("a.nrrd", made.nrrd(ONE, encoding="gzip")),
    "nrrd text": ("a.nrrd", made.nrrd(ONE, encoding="ascii")),
    "mha": ("a.mha", made.mha(ONE)),
    "mha zlib": ("a.mha", made.mha(ONE, CompressedData="True")),
    "nii": ("a.nii", made.nifti(ONE, sform=SFORM)),
    "nii.gz": ("a.nii.gz", made.PACK["gzip"](made.nifti(ONE, version=2, sform=SFORM))),
    "vti raw": ("a.vti", made.vti(ONE)),
    "vti inline": ("a.vti", made.vti(ONE, mode="inline", compressor="zlib")),
    "vtk": ("a.vtk", made.vtk(ONE)),
    "vtk field": ("a.vtk", made.vtk(ONE, kind="FIELD", binary=False)),
    "pbrt": ("a.pbrt", made.pbrt(ONE)),
    "les": ("a.txt", made.les([(3, 2, 1, 0.5, 10.0), (0, 1, 0, 0.25, 5.0)])),
}

#: Bytes from the end whose loss leaves a sound file: line ends, closing tags, digits of a last number written as text,
#: and all rows of the LES list, which says nowhere how long it is.
SPARE = {"vti raw": 40, "vti inline": 1, "vtk": 1, "vtk field": 5, "nrrd text": 4, "pbrt": 2, "les": 32}


def read_or_refuse(path: Path) -> bool:
    """Whether the file was read; a refusal must be one sentence, and any other exception fails the test."""
    try:
        volume = files.read_volume(path)
    except MivolError as error:
        assert_sentence(str(error))
        return False
    assert volume.values.dtype == np.float32
    assert volume.values.ndim == 4
    return True


@pytest.mark.parametrize("name", SOUND)
def test_every_truncation_is_refused(tmp_path: Path, name: str) -> None:
    """Cut at 60 places spread over the file: a file without all voxels is never read."""
    file_name, data = SOUND[name]
    path = tmp_path / file_name
    path.write_bytes(data)
    assert read_or_refuse(path)
    for end in np.linspace(0, len(data) - 1 - SPARE.get(name, 0), 60).astype(int):
        path.write_bytes(data[:end])
        assert not read_or_refuse(path), f"read from the first {end} of {len(data)} bytes"


@pytest.mark.parametrize("name", SOUND)
def test_damaged_files_are_read_or_refused(tmp_path: Path, name: str, seed: int) -> None:
    """One to four random bytes, 80 times: read or refused with a sentence, never another exception."""
    file_name, data = SOUND[name]
    path = tmp_path / file_name
    rng = np.random.default_rng(seed)
    for _ in range(80):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 5)):
            damaged[at] = rng.choice(np.frombuffer(b"\0\xff\x7f -.0123456789eNa\n", np.uint8))
        path.write_bytes(bytes(damaged))
        read_or_refuse(path)


# -- Values -----------------------------------------------------------------------------------------------------------


def with_voxel(value: float, shape: tuple[int, ...] = (3, 4, 5, 3)) -> np.ndarray:
    values = np.ones(shape, np.float32)
    values[1, 2, 3, 2] = values[2, 0, 0, 0] = value
    return values


VALUES: dict[str, tuple[np.ndarray, dict, tuple[str, ...]]] = {
    "NaN": (with_voxel(np.nan), {}, ("nan at voxel (z=1, y=2, x=3, channel=2)", "1 more bad", "at least 0")),
    "Inf": (with_voxel(np.inf), {}, ("inf at voxel (z=1, y=2, x=3, channel=2)",)),
    "-Inf": (with_voxel(-np.inf), {"minimum": None}, ("-inf at voxel (z=1, y=2, x=3, channel=2)", "finite")),
    "negative": (with_voxel(-0.25), {}, ("-0.25 at voxel (z=1, y=2, x=3, channel=2)", "at least 0")),
    "below minimum": (with_voxel(1.0), {"minimum": 1.5}, ("1 at voxel (z=0, y=0, x=0, channel=0)", "1.5")),
    "rank 3": (np.ones((3, 4, 5)), {}, ("rank 3", "(3, 4, 5)", "(Z, Y, X, C)")),
    "channels": (np.ones((3, 4, 5, 2)), {}, ("2 channels", "1 or 3")),
    "channels of grey": (np.ones((3, 4, 5, 3)), {"channels": (1,)}, ("3 channels", "expected 1;")),
    "empty": (np.ones((3, 0, 5, 1)), {}, ("empty grid", "(3, 0, 5, 1)")),
    "complex": (np.ones((1, 1, 1, 1), complex), {}, ("complex128",)),
}


@pytest.mark.parametrize("case", VALUES)
def test_bad_values_are_refused_with_their_voxel(case: str, tmp_path: Path) -> None:
    values, options, words = VALUES[case]
    with refused("sigma_t: ", *words):
        files.check_volume(values, name="sigma_t", **options)


def test_valid_values_are_accepted() -> None:
    files.check_volume(np.zeros((1, 1, 1, 1)), name="sigma_t")
    files.check_volume(with_voxel(-3.0), name="hounsfield", minimum=None)
    files.check_volume(np.ones((2, 2, 2, 6), np.uint8), name="directions", channels=(6,))


# -- Slices, projections, images ----------------------------------------------------------------------------------------


def test_bad_slices(tmp_path: Path) -> None:
    (tmp_path / "s.1").write_bytes(bytes(24))
    (tmp_path / "s.2").write_bytes(bytes(23))
    for options, words in (
        ({"shape": (3, 4), "dtype": "<u2"}, ("s.2", "23 bytes", "24")),
        ({"shape": (3, 5), "dtype": "<u2"}, ("s.1", "24 bytes", "30")),
        ({"shape": (0, 5), "dtype": "<u2"}, ("(0, 5)",)),
        ({"shape": (3, 4), "dtype": "<u2", "pattern": "*.raw"}, ("'*.raw'",)),
        ({"shape": (3, 4), "dtype": "<u2", "pattern": "s.1", "spacing": (1, 1, 0)}, ("degenerate box",)),
    ):
        with refused(*words):
            files.read_slices(tmp_path, **options)
    with refused("no folder"):
        files.read_slices(tmp_path / "nowhere", shape=(3, 4), dtype="u1")


EXCHANGE: dict[str, tuple[dict, tuple[str, ...]]] = {
    "no data": ({"data": None}, ("no dataset exchange/data", "data_dark, data_white, theta")),
    "no flats": ({"data_white": None}, ("no flat (light without sample)", "data.flats")),
    "angles": ({"theta": np.arange(3.0)}, ("3 angles", "4, one per view")),
    "angle NaN": ({"theta": np.array([0, 1, np.nan, 2])}, ("nan in theta at (2,)",)),
    "flats of another size": ({"data_white": np.ones((1, 2, 4))}, ("data_white of 2 x 4", "2 x 3")),
    "rank": ({"data": np.ones((4, 6))}, ("shape (4, 6)",)),
    "projection Inf": ({"data": np.where(np.arange(24) == 23, np.inf, 0).reshape(4, 2, 3)}, ("inf in data at (3, 1, 2)",)),
    "flat NaN": ({"data_white": np.where(np.arange(12) == 5, np.nan, 1).reshape(2, 2, 3)}, ("nan in data_white at (0, 1, 2)",)),
    "NaN": ({"data_dark": np.array([[[0, 0, 0], [0, 0, np.nan]]])}, ("nan in data_dark at (0, 1, 2)",)),
}


@pytest.mark.parametrize("case", EXCHANGE)
def test_bad_projections(tmp_path: Path, case: str) -> None:
    changes, words = EXCHANGE[case]
    with refused("a.h5", *words):
        files.read_projections(make_exchange(tmp_path / "a.h5", **changes))


def test_angles_of_unknown_unit(tmp_path: Path) -> None:
    import h5py

    path = make_exchange(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["exchange/theta"].attrs["units"] = "gon"
    with refused("'gon'", "degrees or radians"):
        files.read_projections(path)


def test_pages_of_a_tiff_must_be_grey_and_equal(tmp_path: Path) -> None:
    """A page more, wider than the first; two colour pages of one size."""
    path = tmp_path / "a.tif"
    first = Image.fromarray(np.zeros((3, 4), np.float32))
    first.save(path, save_all=True, append_images=[Image.fromarray(np.zeros((3, 5), np.float32))])
    with refused("images of shapes [(3, 4), (3, 5)]", "grey images of one size"):
        files.read_stack(path)
    colour = Image.fromarray(np.zeros((3, 4, 3), np.uint8))
    colour.save(path, save_all=True, append_images=[colour])
    with refused("images of shapes [(3, 4, 3)]", "crop or convert them"):
        files.read_stack(path)


def test_a_foreign_hdf5_is_refused(tmp_path: Path) -> None:
    path = make_exchange(tmp_path / "a.h5")
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"not HDF5 at all"):
        path.write_bytes(broken)
        with refused("HDF5"):
            files.read_projections(path)


def test_hdf5_without_h5py(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_exchange(tmp_path / "a.h5")
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with refused("no h5py", "pip install h5py"):
        files.read_projections(path)


def test_bad_exr(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    files.write_exr(path, {"": np.random.default_rng(0).random((30, 40, 3))})
    data = path.read_bytes()
    for broken, words in (
        (data[:3], ("another format",)),
        (b"\x89PNG" + data, ("another format",)),
        *((data[:end], ("damaged", "truncated")) for end in np.linspace(4, len(data) - 1, 20).astype(int)),
    ):
        path.write_bytes(broken)
        with refused(*words):
            files.read_exr(path)


def test_an_exr_of_several_parts_is_refused(tmp_path: Path) -> None:
    import OpenEXR

    plane = np.zeros((2, 3), np.float32)
    parts = [OpenEXR.Part({}, {"R": plane}, "left"), OpenEXR.Part({}, {"Z": plane}, "right")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with refused("2 parts"):
        files.read_exr(tmp_path / "a.exr")


WRITES: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no folder": (lambda p: files.write_volume(p / "no" / "a.vol", ONE), ("no folder", "create it first")),
    "a folder": (lambda p: files.write_whole_bytes(p, b""), ("a folder", "file name")),
    "suffix": (lambda p: files.write_volume(p / "a.nhdr", ONE), ("'.nhdr'", ".vol, .npy, .npz, .nrrd")),
    "rank": (lambda p: files.write_volume(p / "a.vol", ONE[0, 0]), ("shape (4, 1)",)),
    "rotated box": (
        lambda p: files.write_volume(p / "a.vol", ONE, np.eye(4)[[1, 0, 2, 3]]),
        ("rotated", "axis-aligned", ".npz"),
    ),
    "far box": (
        lambda p: files.write_volume(p / "a.vol", ONE, files.frame_from_box((1e9,) * 3, (1e9 + 1,) * 3)),
        ("differ in float32",),
    ),
    "flat box": (lambda p: files.write_volume(p / "a.npz", ONE, np.diag([1.0, 0, 1, 1])), ("degenerate",)),
    "place in npy": (lambda p: files.write_volume(p / "a.npy", ONE, 2 * np.eye(4) - np.diag([0, 0, 0, 1.0])), (".npz",)),
    "metadata in vol": (lambda p: files.write_volume(p / "a.vol", ONE, metadata={"a": 1}), ("metadata", ".npz")),
    "exr sizes": (lambda p: files.write_exr(p / "a.exr", {"a": ONE[0, :, :, 0], "b": np.ones((1, 1))}), ("(1, 1)",)),
    "exr empty": (lambda p: files.write_exr(p / "a.exr", {}), ("no channel",)),
    "exr rank": (lambda p: files.write_exr(p / "a.exr", {"a": np.ones((2, 2, 2))}), ("'a' of shape (2, 2, 2)",)),
    "png NaN": (lambda p: files.write_png(p / "a.png", np.array([[0, np.nan]])), ("NaN at row 0, column 1",)),
    "png channels": (lambda p: files.write_png(p / "a.png", np.ones((2, 2, 2))), ("2 channels", "1, 3 or 4")),
    "png rank": (lambda p: files.write_png(p / "a.png", np.ones(3)), ("(3,)",)),
    "frame unknown": (lambda p: files.to_space(files.VolumeData(ONE, np.eye(4)), "RAS"), ("None", "RAS, LPS")),
}


@pytest.mark.parametrize("case", WRITES)
def test_bad_write(tmp_path: Path, case: str) -> None:
    write, words = WRITES[case]
    with refused(*words):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []
