"""DICOM cone-beam views: rays and readings as the standard defines them, and one sentence for each header that lacks them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from dicom_series import write_series
from dicom_views import BALLS, PITCH, TO_DETECTOR, write_angiography, write_enhanced, write_rt_images
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.experiments.found_scan import draft_scan, find_scan
from mivol.experiments.projections import read_measured
from mivol.files import read_stack, read_volume
from mivol.files.dicom_views import has_views, survey_dicom_views

ANGLES = np.array([-20.0, -5.0, 10.0, 31.5, 90.0])


def write_rt(path: Path) -> Path:
    return write_rt_images(path, ANGLES, shift=3.0)


WRITERS = {
    "angiography": lambda path: write_angiography(path, ANGLES),
    "enhanced": lambda path: write_enhanced(path, ANGLES),
    "rt images": write_rt,
}


def ball_integrals(origin: np.ndarray, direction: np.ndarray, centres: np.ndarray) -> np.ndarray:
    total = np.zeros(direction.shape[:-1])
    for centre, (*_, radius) in zip(centres, BALLS, strict=True):
        towards = centre - origin
        along = np.sum(towards * direction, -1, keepdims=True)
        near = np.linalg.norm(towards - along * direction, axis=-1)
        total += 0.4 * np.sqrt(np.maximum(radius**2 - near**2, 0))
    return total


@pytest.mark.parametrize("kind", WRITERS)
def test_rays_and_light_are_those_of_the_header(tmp_path: Path, kind: str) -> None:
    """Views of three balls, written in the patient's frame; mivol's rays through the balls have the same integrals.

    A reading is rounded by half, so its logarithm by half over the least reading. The world of RT images is left, posterior,
    head: half a turn from right, anterior, head.
    """
    path = WRITERS[kind](tmp_path / "views")
    draft = draft_scan(path, ["data.find_axis=false"])
    data = read_measured(config.from_dict(draft.raw), Path())
    centres = np.array(BALLS)[:, :3] * ((-1, -1, 1) if kind == "rt images" else (1, 1, 1))
    expected = ball_integrals(*data.geometry.rays(), centres)
    assert data.y.shape == expected.shape == (5, 24, 40) and expected.max() > 0.5
    assert abs(data.y - expected).max() < 0.501 / (40000 * np.exp(-expected.max()))
    assert draft.raw["data"]["light"] == 40000
    np.testing.assert_array_equal(np.degrees(data.geometry.angles), ANGLES)
    assert draft.raw["scan"]["pitch"] == PITCH and draft.raw["scan"]["source_to_detector"] == TO_DETECTOR
    assert draft.raw["scan"].get("detector_offset", (0, 0)) == ((0, 3) if kind == "rt images" else (0, 0))
    rows = read_stack(path, rows=slice(3, 9))
    np.testing.assert_array_equal(rows, read_stack(path)[:, 3:9])


def test_increments_are_steps_or_distances(tmp_path: Path) -> None:
    """Equal increments are steps; the first of as many as frames belongs to the first frame."""
    steps = write_angiography(tmp_path / "a.dcm", ANGLES, PositionerPrimaryAngleIncrement=[0.0, 2.0, 2.0, 2.0, 2.0])
    found = survey_dicom_views(steps)
    np.testing.assert_array_equal(found.angles, -20 + 2.0 * np.arange(5))
    assert found.assumed[0] == "the increments of the positioner's angle are steps from frame to frame, because they are equal"
    four = write_angiography(tmp_path / "b.dcm", ANGLES, PositionerPrimaryAngleIncrement=[1.0, 3.0, 6.0, 10.0])
    np.testing.assert_array_equal(survey_dicom_views(four).angles, -20 + np.array([0.0, 1, 3, 6, 10]))


def test_distances_that_are_assumed(tmp_path: Path) -> None:
    by_factor = {"DistanceSourceToPatient": None, "EstimatedRadiographicMagnificationFactor": 1.5}
    found = survey_dicom_views(write_angiography(tmp_path / "a.dcm", ANGLES, **by_factor))
    assert found.source_to_axis == 60 and "by EstimatedRadiographicMagnificationFactor 1.5" in found.assumed[1]


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ({"DistanceSourceToPatient": None}, 'views without DistanceSourceToPatient.*beam = "cone"'),
        ({"ImagerPixelSpacing": None}, "views without ImagerPixelSpacing"),
        ({"PositionerSecondaryAngle": 20.0}, "leans by 20 degrees"),
        ({"PositionerSecondaryAngleIncrement": [0.0, 0, 3, 0, 0]}, "leans by 3 degrees"),
        ({"DistanceSourceToPatient": 95.0}, "95 mm from source to axis, 90 to the detector"),
        ({"PositionerPrimaryAngleIncrement": [0.0, 1.0]}, "2 numbers of PositionerPrimaryAngleIncrement.*5 frames"),
        ({"PixelIntensityRelationship": "LOG"}, "PixelIntensityRelationship LOG, expected values in proportion"),
        ({"PixelIntensityRelationshipSign": -1}, "PixelIntensityRelationship LIN, falling with the light"),
        ({"RescaleSlope": 0.0}, "readings from 0 to 0, expected light"),
    ],
)
def test_a_header_that_lacks_a_fact_is_refused(tmp_path: Path, more: dict[str, object], found: str) -> None:
    path = write_angiography(tmp_path / "a.dcm", ANGLES, **more)
    assert_refused(found, draft_scan, path)


def test_a_damaged_element_is_refused(tmp_path: Path) -> None:
    """pydicom reads the kind of a value when it is asked for it: ``Cs`` is none."""
    path = write_angiography(tmp_path / "a.dcm", ANGLES)
    path.write_bytes(path.read_bytes().replace(b"\x28\x00\x40\x10CS", b"\x28\x00\x40\x10Cs"))
    assert_refused("damaged DICOM file.*'Cs'", read_stack, path)


def test_falling_logarithms_are_line_integrals(tmp_path: Path) -> None:
    signs = {"PixelIntensityRelationship": "LOG", "PixelIntensityRelationshipSign": -1}
    draft = draft_scan(write_angiography(tmp_path / "a.dcm", ANGLES, **signs))
    assert draft.raw["data"]["reading"] == "line_integral"
    assert any("falling logarithms of the light, up to a factor" in line for line in draft.lines)


def test_views_that_disagree_are_refused(tmp_path: Path) -> None:
    folder = write_rt(tmp_path / "rt")
    image = pydicom.dcmread(folder / "003.dcm")
    image.RadiationMachineSAD = 61.0
    image.save_as(folder / "003.dcm")
    assert_refused("source to axis 61 in view 3 and 60 in view 1, expected one circle", survey_dicom_views, folder)
    image.RadiationMachineSAD, image.SeriesInstanceUID = 60.0, "1.2.4"
    image.save_as(folder / "003.dcm")
    assert_refused("views of 2 series", survey_dicom_views, folder)


def test_views_are_a_scan_and_slices_a_volume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A radiograph, and a run of frames at one angle, are no scan."""
    for kind, write in WRITERS.items():
        path = write(tmp_path / kind)
        assert find_scan(path) == "dicom"
        assert_refused("expected slices", read_volume, path)
    still = write_angiography(tmp_path / "still.dcm", ANGLES, PositionerPrimaryAngleIncrement=[0.0] * 5)
    write_series(tmp_path / "s", np.ones((4, 3, 5), "i2"))
    assert not has_views(still) and not has_views(tmp_path / "s") and not has_views(tmp_path / "none")
    assert main(["explain", str(tmp_path / "rt images")]) == 0
    said = capsys.readouterr().out
    assert "found: DICOM, RT image: 5 views of 24 x 40 pixels of 0.5 x 0.4 mm" in said
    assert 'source = "stack"' in said and "light = 40000.0" in said
