"""Scans in HDF5 files as beamlines write them: found by content, read by name, refused in a sentence."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from beamline_files import DARKS, DEGREES, FLATS, FRAMES, KEY, VIEWS, write_named, write_nxtomo
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.files import read_projections
from mivol.files.hdf5 import broken_links
from mivol.files.scan_hdf5 import NO_DARKS, half_turns_in_radians, is_scan, survey_projections


@pytest.mark.parametrize("name", ["a.nxs", "a.hdf", "a.he5", "a.h5", "a.hdf5", "a"])
def test_frames_are_told_apart_by_their_key(tmp_path: Path, name: str) -> None:
    """By any suffix, through an external link; an invalid frame is left out and said; lengths are in mm."""
    path = write_nxtomo(tmp_path / name)
    scan = read_projections(path)
    for found, frames in ((scan.projections, VIEWS), (scan.flats, FLATS), (scan.darks, DARKS)):
        np.testing.assert_array_equal(found, FRAMES[frames])
        assert found.dtype == np.float32
    np.testing.assert_allclose(scan.angles, np.radians([0, 36, 72, 108, 144]), rtol=1e-15)
    assert scan.pitch == pytest.approx((4e-3, 2e-3)) and scan.distances == pytest.approx((55e3, 50))
    assert (scan.meta["format"], scan.meta["group"]) == ("nxtomo", "entry")
    assert scan.notes == ("1 of 10 frames are called invalid or of the alignment: they are not used",)
    assert is_scan(path) and not is_scan(tmp_path / "no file")


def test_scans_of_the_package_nxtomo(tmp_path: Path) -> None:
    """What it writes is read back equal, and it reads the layout of the files of these tests."""
    nxtomo, units = (pytest.importorskip(name) for name in ("nxtomo.application.nxtomo", "pint"))
    units = units.get_application_registry()
    scan = nxtomo.NXtomo()
    detector, key = scan.instrument.detector, np.array(KEY)
    detector.data, detector.image_key_control = FRAMES, key
    detector.x_pixel_size, detector.y_pixel_size = 2e-6 * units.meter, 4e-6 * units.meter
    detector.distance = 0.05 * units.meter
    scan.sample.rotation_angle = DEGREES * units.degree
    scan.save(str(tmp_path / "a.nx"), "entry0000")
    found = read_projections(tmp_path / "a.nx")
    for values, kind in ((found.projections, 0), (found.flats, 1), (found.darks, 2)):
        np.testing.assert_array_equal(values, FRAMES[key == kind])
    np.testing.assert_allclose(found.angles, np.radians(DEGREES[key == 0]), rtol=1e-15)
    assert found.pitch == pytest.approx((4e-3, 2e-3)) and found.distances == (None, pytest.approx(50))
    path = write_nxtomo(tmp_path / "b.nx")
    back = nxtomo.NXtomo().load(str(path), "entry", detector_data_as="as_numpy_array")
    np.testing.assert_array_equal(back.instrument.detector.data, FRAMES)
    assert [int(kind.value) for kind in back.instrument.detector.image_key] == KEY
    np.testing.assert_allclose(back.sample.rotation_angle.to("degree").magnitude, DEGREES)


def test_frames_of_the_alignment_are_no_views(tmp_path: Path) -> None:
    """They are called views (0) in image_key, and -1 in image_key_control; a control of another length tells nothing."""
    path = write_nxtomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/image_key_control"] = np.where(np.arange(10) == 7, -1, KEY)
    scan = read_projections(path)
    np.testing.assert_array_equal(scan.projections, FRAMES[VIEWS[:-1]])
    assert len(scan.angles) == 4 and scan.notes[0].startswith("2 of 10 frames")
    change(path, "entry/instrument/detector/image_key_control", KEY[:3])
    assert len(read_projections(path).angles) == 5


@pytest.mark.parametrize(
    ("unit", "pitch", "note"),
    [
        ("micrometers", 2e-3, ""),
        ("", 2e3, "x_pixel_size has no unit and is taken as metres"),
        ("furlong", None, "x_pixel_size is in 'furlong', which is no known unit of length: it is not read; scan.pitch"),
    ],
)
def test_units_of_a_pixel_are_read_or_said(tmp_path: Path, unit: str, pitch: float | None, note: str) -> None:
    path = write_nxtomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        attributes = file["entry/instrument/detector/x_pixel_size"].attrs
        del attributes["units"]
        attributes.update({"units": unit} if unit else {})
        file["entry/sample/rotation_angle"].attrs["units"] = "\u00b0"
    scan = read_projections(path)
    assert (scan.pitch and scan.pitch[1]) == (pitch and pytest.approx(pitch))
    assert any(line.startswith(note) for line in scan.notes[1:]) if note else len(scan.notes) == 1
    assert scan.angles[1] == pytest.approx(np.radians(36))


@pytest.mark.parametrize(("unit", "pitch", "note"), [("microns", 0.00117, None), (None, 0.00117, "taken as micrometres")])
def test_the_resolution_of_the_objective_is_the_pixel(tmp_path: Path, unit: str | None, pitch: float, note: str | None) -> None:
    """In Data Exchange, as an array of one number; without it the size is unknown."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, frames in (("data", VIEWS), ("data_white", FLATS)):
            file[f"exchange/{name}"] = FRAMES[frames]
    assert survey_projections(path, "", None, None).pitch is None
    with h5py.File(path, "a") as file:
        item = file.create_dataset("measurement/instrument/detection_system/objective/resolution", data=[1.17])
        if unit:
            item.attrs["units"] = unit
    found = survey_projections(path, "", None, None)
    assert found.pitch == pytest.approx((pitch, pitch))
    assert any(note in line for line in found.notes) if note else found.notes == ()


def test_the_first_of_several_scans_is_read(tmp_path: Path) -> None:
    """And the sentence names the others; GDA's entry lies in another entry."""
    path = write_nxtomo(write_nxtomo(tmp_path / "a.nxs", "entry1/tomo_entry"), "entry0000", angles=DEGREES + 1)
    scan = read_projections(path)
    assert scan.meta["group"] == "entry0000" and np.degrees(scan.angles[0]) == pytest.approx(1)
    assert scan.notes[0].startswith("the file has 2 scans, entry0000, entry1/tomo_entry: entry0000 is read, data.group")
    assert read_projections(path, "entry1/tomo_entry").angles[0] == 0
    assert_refused(r"no dataset nowhere/data \(present: entry0000, entry1\)", read_projections, path, "nowhere")


def test_darks_and_angles_of_data_exchange_may_be_missing(tmp_path: Path) -> None:
    """Without darks one frame of 0 is no light, without angles the arc is the settings'; flats are needed."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"], file["exchange/data_white"] = FRAMES[VIEWS], FRAMES[FLATS]
    scan = read_projections(path)
    assert scan.angles is None and scan.notes == (NO_DARKS,)
    np.testing.assert_array_equal(scan.darks, np.zeros_like(FRAMES[:1]))
    with h5py.File(path, "a") as file:
        del file["exchange/data_white"]
    assert_refused("no flat", read_projections, path)


def test_datasets_by_name(tmp_path: Path) -> None:
    """One flat may be an image; the attribute tells the unit; without angles there are none; rows are cut."""
    path = write_named(tmp_path / "b.he5")
    names = {"data": "scan/camera/frames", "flats": "/before/reference", "darks": "before/background", "angles": "scan/stage"}
    scan = read_projections(path, names=names)
    np.testing.assert_array_equal(scan.projections, FRAMES[VIEWS])
    np.testing.assert_array_equal(scan.flats, FRAMES[[0]])
    np.testing.assert_allclose(scan.angles, np.radians(DEGREES[VIEWS]), rtol=1e-15)
    assert read_projections(path, names=names | {"angles": ""}).angles is None
    for part in ("projections", "flats", "darks"):
        cut = getattr(read_projections(path, names=names, rows=slice(1, 2)), part)
        np.testing.assert_array_equal(cut, getattr(scan, part)[:, 1:2])
    scan = read_projections(path, names=names | {"darks": ""})
    assert scan.darks.shape == (1, *FRAMES.shape[1:]) and scan.notes == ("no darks: a reading of 0 is taken as no light",)
    other = {"flats": "b.he5:before/background"}
    np.testing.assert_array_equal(read_projections(write_nxtomo(tmp_path / "a.nxs"), names=other).flats, FRAMES[DARKS])


@pytest.mark.parametrize(("arc", "turns"), [(np.pi, "half a turn"), (2 * np.pi, "a turn")])
def test_wrong_units_of_angles_are_seen_by_the_arc(tmp_path: Path, arc: float, turns: str) -> None:
    """With the last view at the end of the arc or a step before, to a hundredth; a setting decides otherwise."""
    angles = np.linspace(0, arc, 40)
    assert half_turns_in_radians(angles) == half_turns_in_radians(angles[:-1]) == turns
    assert not half_turns_in_radians(0.95 * angles) and not half_turns_in_radians(np.degrees(angles))
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["d"], file["f"], file["t"] = np.ones((40, 1, 2)), np.ones((1, 2)), angles
        file["t"].attrs["units"] = "degrees"
    names = {"data": "d", "flats": "f", "angles": "t"}
    scan = read_projections(path, names=names)
    np.testing.assert_array_equal(scan.angles, angles)
    assert scan.notes[0].startswith(f"the angles are called degrees and span {arc:.4f}, {turns} in radians: they are taken as")
    np.testing.assert_allclose(read_projections(path, names=names, angle_unit="degree").angles, np.radians(angles))
    with h5py.File(path, "a") as file:
        file["t"][...] = np.degrees(angles)
        file["t"].attrs["units"] = "rad"
    scan = read_projections(path, names=names)
    np.testing.assert_allclose(scan.angles, angles)
    assert f"{turns} in degrees: they are taken as degrees" in scan.notes[0]
    np.testing.assert_array_equal(read_projections(path, names=names, angle_unit="radian").angles, np.degrees(angles))


def change(path: Path, name: str, value: object) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
        if value is not None:
            file[name] = value


BROKEN = {
    "target": lambda path: path.with_name("a_frames.h5").unlink(),
    "soft": lambda path: change(path, "entry/instrument/detector/data", h5py.SoftLink("/gone")),
    "short key": lambda path: change(path, "entry/instrument/detector/image_key", KEY[:-1]),
    "no views": lambda path: change(path, "entry/instrument/detector/image_key", np.ones(10, int)),
    "no flats": lambda path: change(path, "entry/instrument/detector/image_key", np.array([0] * 8 + [2, 2])),
    "angles": lambda path: change(path, "entry/sample/rotation_angle", np.arange(7.0)),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:2500]),
    "truncated target": lambda path: (p := path.with_name("a_frames.h5")).write_bytes(p.read_bytes()[:700]),
    "nothing": lambda path: change(path, "entry", None),
    "nan": lambda path: change(path, "entry/instrument/detector/data", np.where(FRAMES[5, 1, 2] == FRAMES, np.nan, FRAMES)),
}
SENTENCES = {
    "target": r"a link from entry/instrument/detector/data to a_frames.h5:entry/data/data, which cannot be read, expected its",
    "soft": "a link from entry/instrument/detector/data to /gone, which cannot be read",
    "short key": r"9 numbers of image_key for entry/instrument/detector/data of shape \(10, 2, 3\), expected one for each",
    "no views": r"no view \(0\) in entry/instrument/detector/image_key",
    "no flats": r"no flat \(light without sample\), expected at least one; name a dataset: data.flats",
    "angles": "7 angles in entry/sample/rotation_angle, expected 10, one for each frame, or 5, one for each view",
    "truncated": "a damaged or foreign file .*truncated",
    "truncated target": "a link from entry/instrument/detector/data to a_frames.h5",
    "nan": r"nan in entry/instrument/detector/data at \(2, 1, 2\), counted from 0 among the data, .* replace it by 0",
    "nothing": r"neither an image_key \(NXtomo\) nor a group exchange .* name the datasets: data.data",
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_cannot_be_read_is_said_in_a_sentence(tmp_path: Path, case: str) -> None:
    path = write_nxtomo(tmp_path / "a.nxs")
    BROKEN[case](path)
    with pytest.raises(MivolError, match=SENTENCES[case]) as refused:
        read_projections(path)
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


@pytest.mark.parametrize("axis", [0, 1, 3])
def test_axes_of_length_1_are_left_out(tmp_path: Path, axis: int) -> None:
    """In NXtomo, and in datasets by name; an image with two such axes is one flat."""
    path = write_nxtomo(tmp_path / "a.nxs")
    change(path, "entry/instrument/detector/data", np.expand_dims(FRAMES, axis))
    data = read_projections(path, rows=slice(1, 2))
    np.testing.assert_array_equal(data.projections, FRAMES[VIEWS, 1:2])
    named = write_named(tmp_path / "b.h5")
    change(named, "scan/camera/frames", np.expand_dims(FRAMES[VIEWS], axis))
    change(named, "before/reference", FRAMES[0][None, None])
    names = {"data": "scan/camera/frames", "flats": "before/reference"}
    assert survey_projections(named, "", names, None).frames == (5, 1, 0)
    data = read_projections(named, names=names)
    np.testing.assert_array_equal(data.projections, FRAMES[VIEWS])
    np.testing.assert_array_equal(data.flats, FRAMES[:1])


def test_flats_brighter_than_the_detector_are_refused(tmp_path: Path) -> None:
    """Views of 16 bits end at 65535; flats as sums do not."""
    path = write_named(tmp_path / "a.h5")
    names = {"data": "scan/camera/frames", "flats": "before/reference"}
    change(path, "before/reference", np.full((2, 3), 65535.0))
    read_projections(path, names=names)
    change(path, "before/reference", np.full((2, 3), 70000.0))
    assert_refused("flats of up to 70000, which are brighter .* at most 65535", read_projections, path, names=names)


def test_a_part_that_is_missing_is_no_zero(tmp_path: Path) -> None:
    """HDF5 reads zeros from a virtual dataset without its file."""
    path = tmp_path / "v.h5"
    layout = h5py.VirtualLayout((4, 1, 2), "u2")
    layout[:] = h5py.VirtualSource("part.h5", "d", (4, 1, 2))
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("d", layout)
        file["f"] = np.ones((1, 2))
    names = {"data": "d", "flats": "f"}
    assert_refused("a virtual dataset /d with a part in part.h5, which is not there", read_projections, path, names=names)
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file["d"] = np.full((4, 1, 2), 7, "u2")
    assert (read_projections(path, names=names).projections == 7).all()


def test_a_compression_without_its_filter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sentence names the filter and the package."""
    path = tmp_path / "c.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("d", data=np.ones((4, 1, 2)), chunks=True, compression="gzip")
        file["f"] = np.ones((1, 2))
    names = {"data": "d", "flats": "f"}
    assert read_projections(path, names=names).projections.shape == (4, 1, 2)
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    assert_refused(r"/d compressed by filter 1 \(deflate\), .*: pip install .mivol\[lab", read_projections, path, names=names)


def test_a_detector_whose_frames_are_missing_gives_way(tmp_path: Path) -> None:
    """GDA lists a second detector first, whose file is missing, and the angles beside the frames by the name of the motor."""
    path = write_nxtomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        del file["entry/sample/rotation_angle"], file["entry/data/rotation_angle"], file["entry/data/data"]
        lost = file.create_group("entry/instrument/camera")
        lost["data"], lost["image_key"] = h5py.ExternalLink("gone.h5", "d"), KEY
        beside = file.create_group("entry/detector")
        beside["gts_theta_set"] = h5py.ExternalLink("gone.h5", "t")
        beside["gts_theta_value"], beside["gts_theta_count"] = DEGREES, np.arange(10)
    scan = read_projections(path)
    np.testing.assert_array_equal(scan.projections, FRAMES[VIEWS])
    np.testing.assert_allclose(scan.angles, np.radians(DEGREES[VIEWS]))


def test_broken_links_at_the_top_name_their_targets(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["far"], file["gone"], file["here"] = h5py.ExternalLink("b.h5", "x"), h5py.SoftLink("/nowhere"), np.ones(2)
        said = [str(error) for error in broken_links(file, tmp_path / "a.h5")]
    targets = ("far to b.h5:x,", "gone to /nowhere,")
    assert all(f"a link from {words}" in sentence for words, sentence in zip(targets, said, strict=True))
