"""DICOM series, written by pydicom and read back equal; what is wrong in a series is named."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pydicom
import pytest
from dicom_series import AXES, expected_place, header, write_frames, write_series
from pydicom.data import get_testdata_file
from pydicom.pixels import get_decoder
from pydicom.uid import JPEGLSLossless
from refusals import assert_refused

from mivol.cli import main
from mivol.errors import MivolError
from mivol.files import read_volume
from mivol.files.dicom import UNEVEN

RNG = np.random.default_rng(5)


def stored(dtype: str = "i2", shape: tuple[int, int, int] = (4, 3, 5)) -> np.ndarray:
    info = np.iinfo(dtype)
    return RNG.integers(info.min, info.max, shape, dtype, endpoint=True)


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.mark.parametrize("orientation", AXES)
@pytest.mark.parametrize("dtype", ["i2", "u2", "u1"])
def test_a_series_is_read_in_its_place(tmp_path: Path, orientation: str, dtype: str) -> None:
    """File names are in another order than the slices. int16 times -2.5 plus 0.5 is exact in float32."""
    values = stored(dtype)
    names = ["c", "IM0001", "b.dcm", "a"]
    slope, intercept = (-2.5, 0.5) if dtype != "u2" else (1, -1024)
    write_series(tmp_path / "s", values, orientation, names=names, RescaleSlope=slope, RescaleIntercept=intercept)
    for path in (tmp_path / "s", tmp_path / "s" / "IM0001", tmp_path):
        volume = read_volume(path)
        np.testing.assert_array_equal(volume.values[..., 0], values * np.float32(slope) + np.float32(intercept))
        np.testing.assert_allclose(volume.to_world, expected_place(orientation, values.shape), atol=1e-8)
    assert (volume.meta["space"], volume.meta["unit"], volume.meta["dtype"]) == ("LPS", "mm", np.dtype(dtype).name)


def test_slices_run_along_the_normal(tmp_path: Path) -> None:
    """Written from the last to the first: the box is right-handed, and z points along the normal."""
    values = stored()
    paths = write_series(tmp_path / "s", values[::-1])
    for k, path in enumerate(paths):
        image = pydicom.dcmread(path)
        image.ImagePositionPatient = [0, 0, -2 * k]
        image.save_as(path)
    volume = read_volume(tmp_path / "s")
    np.testing.assert_array_equal(volume.values[..., 0], values)
    np.testing.assert_allclose(volume.origin, (0, 0, -6))
    assert np.linalg.det(volume.to_world) > 0


def test_frames_of_one_file_have_places_and_slopes(tmp_path: Path) -> None:
    values, slopes = stored(), [1.0, 2.0, 0.5, 4.0]
    write_frames(tmp_path / "a.dcm", values, "oblique", [2, 0, 3, 1], slopes)
    volume = read_volume(tmp_path / "a.dcm")
    scaled = values * np.array(slopes, np.float32)[:, None, None] + 10 * np.arange(4, dtype=np.float32)[:, None, None]
    np.testing.assert_array_equal(volume.values[..., 0], scaled)
    np.testing.assert_allclose(volume.to_world, expected_place("oblique", values.shape), atol=1e-8)


def test_a_tilted_gantry_is_a_sheared_box(tmp_path: Path) -> None:
    """Slices that shift along y as they climb: the third step is not the normal."""
    for k, path in enumerate(write_series(tmp_path / "s", stored())):
        image = pydicom.dcmread(path)
        image.ImagePositionPatient = [1, 2 + 0.25 * k, 3 + k]
        image.save_as(path)
    np.testing.assert_allclose(read_volume(tmp_path / "s").steps[:, 2], (0, 0.25, 1), atol=1e-12)


@pytest.mark.parametrize("syntax", ["RLELossless", "DeflatedExplicitVRLittleEndian", "ExplicitVRBigEndian"])
def test_transfer_syntaxes(tmp_path: Path, syntax: str) -> None:
    values = stored()
    for path in write_series(tmp_path / "s", values):
        image = pydicom.dcmread(path)
        if syntax == "RLELossless":
            image.compress(pydicom.uid.RLELossless)
        elif syntax == "ExplicitVRBigEndian":
            image.PixelData = image.pixel_array.astype(">i2").tobytes()
        image.file_meta.TransferSyntaxUID = getattr(pydicom.uid, syntax)
        kept = pydicom.Dataset(image)
        kept.file_meta = image.file_meta
        kept.save_as(path, enforce_file_format=True, little_endian=syntax != "ExplicitVRBigEndian", implicit_vr=False)
    np.testing.assert_array_equal(read_volume(tmp_path / "s").values[..., 0], values)


@pytest.mark.parametrize("name", ["rtdose.dcm", "rtdose_rle.dcm", "MR_small_jp2klossless.dcm"])
def test_real_files(tmp_path: Path, name: str) -> None:
    """Files of pydicom: dose grids by offsets of frames and a scaling, and JPEG 2000."""
    shutil.copy(get_testdata_file(name), tmp_path / name)
    image, volume = pydicom.dcmread(tmp_path / name), read_volume(tmp_path / name)
    scale = float(image.get("DoseGridScaling", 1))
    np.testing.assert_array_equal(
        volume.values[..., 0], (image.pixel_array * scale).astype("f4").reshape(volume.values.shape[:3])
    )
    np.testing.assert_allclose(volume.origin, [float(c) for c in image.ImagePositionPatient], rtol=1e-12)
    np.testing.assert_allclose(volume.spacing[1::-1], [float(d) for d in image.PixelSpacing], rtol=1e-6)


def test_slices_without_a_place_are_ordered_by_number(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    values = stored()
    for path in write_series(tmp_path / "s", values, names=["d", "b", "c", "a"]):
        image = pydicom.dcmread(path)
        del image.ImagePositionPatient
        image.save_as(path)
    volume = read_volume(tmp_path / "s")
    np.testing.assert_array_equal(volume.values[..., 0], values)
    np.testing.assert_allclose((volume.origin, volume.spacing), ((0, 0, 0), (0.75, 0.5, 2)))
    assert volume.meta["space"] is None
    assert run("convert", tmp_path / "s", tmp_path / "a.nrrd") == 0
    assert "assumed: no positions of slices in the file" in capsys.readouterr().out


def test_views_of_a_turning_source_are_no_slices(tmp_path: Path) -> None:
    """Each file has the angle of its view; one angle alone is a radiograph, which is an image."""
    paths = write_series(tmp_path / "s", stored(), DistanceSourceToDetector=1200.0, PositionerPrimaryAngle=0.0)
    read_volume(tmp_path / "s")
    for k, path in enumerate(paths):
        image = pydicom.dcmread(path)
        image.PositionerPrimaryAngle = 30.0 * k
        image.save_as(path)
    assert_refused(rf"views of a source from {len(paths)} angles, expected slices.*mivol optimize", read_volume, tmp_path / "s")


def test_explain_and_convert_take_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    values = stored("u2")
    write_series(tmp_path / "s", values, "coronal")
    assert run("explain", tmp_path / "s") == 0
    assert "s: DICOM\nvoxels (x, y, z): 5 x 3 x 4, 1 channel of uint16" in capsys.readouterr().out
    assert run("convert", tmp_path / "s", tmp_path / "a.nrrd") == 0
    volume = read_volume(tmp_path / "a.nrrd")
    np.testing.assert_array_equal(volume.values[..., 0], values)
    np.testing.assert_allclose(volume.to_world, expected_place("coronal", values.shape), atol=1e-8)
    assert volume.meta["space"] == "LPS"
    for verb in ("optimize", "validate"):
        assert run(verb, next((tmp_path / "s").iterdir())) == 1
        assert "found a volume, expected a scene, a fit or points" in capsys.readouterr().err
    assert run("render", tmp_path / "s", "-o", tmp_path / "a.png", "--size", 8, 8, "--spp", 1) == 0
    assert (tmp_path / "a.png").is_file()


def test_a_series_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """By its UID, by its number, and by number and rank if two series share the number; a file brings its series."""
    some = {uid: stored() for uid in ("1.2.5", "1.2.3", "1.2.9")}
    for uid, values in some.items():
        write_series(tmp_path / "s", values, uid=uid, SeriesNumber=7 if uid == "1.2.9" else 4)
    assert_refused(r"3 series \(4.1 'Head 1.25' of 4 images, 4.2 .*--dataset in mivol explain", read_volume, tmp_path / "s")
    for dataset, uid in (("1.2.5", "1.2.5"), ("4.1", "1.2.3"), ("4.2", "1.2.5"), ("7", "1.2.9")):
        np.testing.assert_array_equal(read_volume(tmp_path / "s", dataset).values[..., 0], some[uid])
    np.testing.assert_array_equal(read_volume(tmp_path / "s" / "1.2.9-2.dcm").values[..., 0], some["1.2.9"])
    assert run("convert", tmp_path / "s", tmp_path / "a.nrrd", "--dataset", "4") == 1
    assert "no series '4' among 3 series" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda images: images.pop(2), "1 gap: no slice between .* mm .*1.2.3-1.dcm.* where others are"),
        (lambda images: setattr(images[1], "ImagePositionPatient", images[2].ImagePositionPatient), "two slices at 7.5 mm"),
        (lambda images: images[1].ImagePositionPatient.__setitem__(2, 6.25 + 3.75 * UNEVEN), "1.dcm 0.0375 mm off"),
        (lambda images: images[1].ImagePositionPatient.__setitem__(0, 3), "1.2.3-1.dcm 13 mm off its place"),
        (lambda images: setattr(images[1], "ImageOrientationPatient", [1, 0, 0, 0, 0, 1]), "1 of 5 are not parallel"),
        (lambda images: setattr(images[1], "ImageOrientationPatient", [1, 0, 0, 1, 0, 0]), "two unit vectors at right angles"),
        (lambda images: setattr(images[1], "PixelSpacing", [1, 1]), "several pixel sizes"),
        (lambda images: setattr(images[1], "PixelSpacing", [1, 1, 1]), "PixelSpacing .* expected 2 finite numbers"),
        (lambda images: images[1].pop("ImagePositionPatient"), "1 of 5 slices without position"),
        (lambda images: setattr(images[1], "Rows", 1), "several sizes"),
        (lambda images: setattr(images[1], "NumberOfFrames", 9**9), "found 387420489 frames, expected 1 to"),
        (lambda images: setattr(images[1], "PixelData", b"ab"), "a damaged DICOM file .The number of bytes"),
        (lambda images: setattr(images[1], "PhotometricInterpretation", "RGB"), r"colours \(RGB\)"),
        (lambda images: setattr(images[1], "ModalityLUTSequence", []), "values by a lookup table"),
        (lambda images: [image.pop("Rows") for image in images], "DICOM files without pixels"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_series_is_named(tmp_path: Path, change, found: str) -> None:
    paths = write_series(tmp_path / "s", stored(shape=(5, 3, 5)))
    images = [pydicom.dcmread(path) for path in paths]
    for path in paths:
        path.unlink()
    change(images)
    for image in images:
        image.save_as(image.filename)
    with pytest.raises(MivolError, match=found) as refused:
        read_volume(tmp_path / "s")
    assert "\n" not in str(refused.value)


def test_a_file_that_begins_otherwise_is_named(tmp_path: Path) -> None:
    """Only its suffix says that a file belongs to the series; other files of the folder are ignored."""
    path = write_series(tmp_path / "s", stored())[-1]
    (tmp_path / "s" / "notes.txt").write_text("a series")
    assert read_volume(tmp_path / "s").size[2] == 4
    path.write_bytes(bytes(132) + path.read_bytes()[132:])
    assert_refused(r"1.2.3-3.dcm: found a damaged DICOM file", read_volume, tmp_path / "s")


def test_a_series_that_the_memory_does_not_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_series(tmp_path / "s", stored())
    monkeypatch.setattr("mivol.files.npy.available_memory", lambda: 100)
    assert_refused("at most the free memory", read_volume, tmp_path / "s")


def test_a_file_without_pixels_is_refused(tmp_path: Path) -> None:
    shutil.copy(get_testdata_file("rtplan.dcm"), tmp_path / "rtplan.dcm")
    assert_refused("without pix", read_volume, tmp_path / "rtplan.dcm")


@pytest.mark.parametrize("has_decoder", [True, False])
def test_jpeg_ls(has_decoder: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real slice, compressed and not. The decoder is that of the extra ``lab``."""
    plain, packed = tmp_path / "plain", tmp_path / "packed"
    for folder, name in ((plain, "MR_small.dcm"), (packed, "MR_small_jpeg_ls_lossless.dcm")):
        folder.mkdir()
        shutil.copy(get_testdata_file(name), folder / name)
    if has_decoder:
        np.testing.assert_array_equal(read_volume(packed).values, read_volume(plain).values)
        return
    monkeypatch.delitem(get_decoder(JPEGLSLossless)._available, "gdcm")
    assert_refused(r"JPEG-LS.*mivol\[lab\]", read_volume, packed)


def test_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header((1, 1), "u1").save_as(tmp_path / "a.dcm", enforce_file_format=True)
    monkeypatch.setitem(sys.modules, "pydicom", None)
    assert_refused(r'pip install "mivol\[lab\]"', read_volume, tmp_path / "a.dcm")
