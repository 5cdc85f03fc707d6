"""Cone-beam views in DICOM: angles, distances and pixels from the header, read by the package pydicom.

Conventions. Lengths are in mm, angles in degrees. Views are in the order of frames and of ``InstanceNumber``. The geometry of
:mod:`mivol.tomography.geometry` has its first row lowest, towards the feet, and turns about the axis towards the head:

* X-ray angiography: an image is seen from the detector, the patient's left at the right. The columns are reversed, so that the
  positioner's primary angle (towards the patient's left) is the angle of the view, in a world of right, anterior, head;
* RT image: an image is seen from the source, so columns stay, and the angle of the gantry (IEC 61217) is the angle of the view,
  in a world of the fixed x, minus the fixed z, and the fixed y.

Reference: DICOM PS3.3, C.8.7.5 (XA positioner), C.8.19.6 (enhanced XA positioner and geometry), C.8.8.2 (RT image).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.files.dicom import check_elements, decode, find_dicom, frame_count, import_dcmread, is_dicom_file, refuse_unreadable
from mivol.files.npy import check_memory
from mivol.files.source import refusal

KEYWORDS = (
    *("Rows", "Columns", "NumberOfFrames", "InstanceNumber", "SeriesInstanceUID", "SamplesPerPixel", "Modality"),
    *("PositionerPrimaryAngle", "PositionerPrimaryAngleIncrement", "PositionerSecondaryAngle"),
    *("PositionerSecondaryAngleIncrement", "DistanceSourceToDetector", "DistanceSourceToPatient"),
    *("DistanceSourceToIsocenter", "EstimatedRadiographicMagnificationFactor", "ImagerPixelSpacing"),
    *("GantryAngle", "RadiationMachineSAD", "RTImageSID", "ImagePlanePixelSpacing", "RTImagePosition", "RTImageOrientation"),
    *("XRayImageReceptorTranslation", "ImageOrientationPatient"),
    *("RescaleSlope", "RescaleIntercept", "PixelIntensityRelationship", "PixelIntensityRelationshipSign"),
    *("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"),
)
"""Elements of a header that are read."""

SAME_LENGTH, SAME_ANGLE = 1e-3, 0.05
"""Largest relative difference of distances between views, and of the secondary angle from 0 [degree]: digits of headers."""


@dataclass(frozen=True, eq=False)
class DicomViews:
    """Cone-beam views on a circle.

    Attributes:
        path: file or folder.
        frames: (file, frame, slope, intercept) of each view.
        kind: "X-ray angiography" or "RT image".
        angles: (views,) [degree].
        source_to_axis, source_to_detector: distances [mm].
        pitch: distance of pixel centres along (rows, columns) [mm].
        detector_offset: shift of the detector's middle from the central ray along (rows upwards, columns as read) [mm].
        pixels: (rows, columns).
        relation: ``PixelIntensityRelationship``, or "".
        is_falling: whether larger values mean less light (``PixelIntensityRelationshipSign`` is -1).
        assumed: assumptions, a sentence each.
    """

    path: Path
    frames: tuple[tuple[Path, int, float, float], ...]
    kind: str
    angles: np.ndarray
    source_to_axis: float
    source_to_detector: float
    pitch: tuple[float, float]
    detector_offset: tuple[float, float]
    pixels: tuple[int, int]
    relation: str
    is_falling: bool
    assumed: tuple[str, ...]


def has_views(path: Path) -> bool:
    """Whether a DICOM file, or a folder of such files, holds views from several angles; False without pydicom."""
    try:
        return bool(_views_of(path))
    except MivolError:
        return False


def _views_of(path: Path) -> dict[Path, Any]:
    """Headers of the views of a file or a folder; empty if they are slices, other objects, or a single view."""
    files = [path] if path.is_file() and is_dicom_file(path) else list(find_dicom(path)) if path.is_dir() else []
    if not files:
        return {}
    dcmread, views, angles, is_turning = import_dcmread(path), {}, set(), False
    for file in files:
        with refuse_unreadable(file):
            header = dcmread(file, stop_before_pixels=True, specific_tags=list(KEYWORDS))
            if "Rows" not in header or header.get("ImageOrientationPatient") is not None:
                continue
            finders = [_finder(header, frame) for frame in range(frame_count(header, file))]
            found = [(find("GantryAngle"), find("PositionerPrimaryAngle")) for find in finders]
            if found[0] == (None, None):
                continue
            views[file] = header
            angles |= {tuple(map(str, one)) for one in found}
            is_turning |= bool(np.any(np.array(header.get("PositionerPrimaryAngleIncrement") or 0, np.float64)))
    return views if len(angles) > 1 or is_turning else {}


def survey_dicom_views(path: str | os.PathLike) -> DicomViews:
    """Read the headers of cone-beam views.

    Args:
        path: multi-frame file, or folder with a file a view.

    Raises:
        MivolError: no pydicom, no views from several angles, a damaged file, views of several series, sizes or distances, a
            positioner that leans, or a header without distances or pixel size.
    """
    path = Path(path)
    headers = _views_of(path)
    if not headers:
        raise refusal(path, "no DICOM views from several angles", "X-ray angiography or RT images", "name another file")
    for file, header in headers.items():
        check_elements(file, header, KEYWORDS)
    series = {str(header.get("SeriesInstanceUID", "")) for header in headers.values()}
    if len(series) > 1:
        raise refusal(path, f"views of {len(series)} series", "one", "put one series into a folder of its own")
    ordered = sorted(headers.items(), key=lambda item: (int(item[1].get("InstanceNumber") or 0), str(item[0])))
    frames, angles, assumed = [], [], []
    facts: list[tuple[float, ...]] = []
    first = ordered[0][1]
    with refuse_unreadable(ordered[0][0]):
        is_rt = _finder(first, 0)("GantryAngle") is not None
        is_falling = _number(ordered[0][0], _finder(first, 0), "PixelIntensityRelationshipSign") == -1
    for file, header in ordered:
        with refuse_unreadable(file):
            count = frame_count(header, file)
            finders = [_finder(header, frame) for frame in range(count)]
            angles += (_gantry_angles if is_rt else _positioner_angles)(file, header, finders, assumed)
            for frame, find in enumerate(finders):
                slope, intercept = _number(file, find, "RescaleSlope"), _number(file, find, "RescaleIntercept")
                frames.append((file, frame, 1.0 if slope is None else slope, intercept or 0.0))
                lengths = (_rt_lengths if is_rt else _angiography_lengths)(file, header, find, assumed)
                facts.append((int(header["Rows"].value), int(header["Columns"].value), *lengths))
    table = np.array(facts)
    scale = np.maximum(np.abs(table[0]), table[0, 3])
    unlike = np.argwhere(np.abs(table - table[0]) > SAME_LENGTH * scale)
    if len(unlike):
        view, key = map(int, unlike[0])
        names = "rows", "columns", "source to axis", "source to detector", "pixel", "pixel", "detector shift", "detector shift"
        found = f"{names[key]} {table[view, key]:g} in view {view + 1} and {table[0, key]:g} in view 1"
        raise refusal(path, found, "one circle", 'give the geometry as a TOML file with beam = "table"')
    rows, columns, to_axis, to_detector, pitch_v, pitch_u, offset_v, offset_u = facts[0]
    if not 0 < to_axis < to_detector or not min(pitch_v, pitch_u) > 0:
        found = f"{to_axis:g} mm from source to axis, {to_detector:g} to the detector, and pixels of {pitch_v:g} x {pitch_u:g}"
        raise refusal(path, found, "lengths above 0, the axis before the detector", "correct the header")
    return DicomViews(
        path, tuple(frames), "RT image" if is_rt else "X-ray angiography", np.array(angles), to_axis, to_detector,
        (pitch_v, pitch_u), (offset_v, offset_u), (rows, columns), str(first.get("PixelIntensityRelationship") or ""),
        is_falling, tuple(dict.fromkeys(assumed)),
    )  # fmt: skip


def read_views(path: str | os.PathLike, rows: slice = slice(None)) -> np.ndarray:
    """Read the views: values times slope plus intercept, float32 (views, rows, columns), lowest row first.

    Args:
        path: as in :func:`survey_dicom_views`.
        rows: rows, counted upwards.

    Raises:
        MivolError: as :func:`survey_dicom_views`, or pixels that pydicom cannot decode.
    """
    views = survey_dicom_views(path)
    height, columns = views.pixels
    part = range(height)[rows]
    check_memory(views.path, 4 * len(views.frames) * len(part) * columns)
    stack = np.empty((len(views.frames), len(part), columns), np.float32)
    dcmread, decoded = import_dcmread(views.path), (None, np.empty(0))
    for k, (file, frame, slope, intercept) in enumerate(views.frames):
        if decoded[0] != file:
            stored = decode(dcmread, file)
            if stored.ndim > 3 or stored.shape[-2:] != views.pixels:
                raise refusal(file, f"pixels of shape {stored.shape}", "grey values of Rows x Columns", "name another series")
            decoded = file, stored.reshape(-1, height, columns)
        image = decoded[1][frame][::-1, :: 1 if views.kind == "RT image" else -1][rows]
        stack[k] = image if (slope, intercept) == (1, 0) else image * np.float64(slope) + intercept
    return stack


# -- Headers -----------------------------------------------------------------------------------------------------------------

Finder = Callable[[str], Any]
"""Value of an element of a frame; None if it is absent or empty."""


def _finder(header: Any, frame: int) -> Finder:
    """Look an element up in the functional groups of the frame, of all frames, and in the file."""

    def find(keyword: str) -> Any:
        of_frame = header.get("PerFrameFunctionalGroupsSequence")
        shared = header.get("SharedFunctionalGroupsSequence")
        for groups in ([of_frame[frame]] if of_frame else []) + ([shared[0]] if shared else []):
            for element in groups:
                value = element.value[0].get(keyword) if element.VR == "SQ" and element.value else None
                if value not in (None, ""):
                    return value
        value = header.get(keyword)
        return None if value == "" else value

    return find


def _numbers(file: Path, find: Finder, keyword: str, count: int) -> np.ndarray | None:
    value = find(keyword)
    if value is None:
        return None
    array = np.atleast_1d(np.array(value, np.float64))
    if array.shape != (count,) or not np.isfinite(array).all():
        raise refusal(file, f"{keyword} {value}", f"{count} finite numbers", "correct the header")
    return array


def _number(file: Path, find: Finder, keyword: str) -> float | None:
    found = _numbers(file, find, keyword, 1)
    return None if found is None else float(found[0])


def _needed(file: Path, find: Finder, keyword: str, count: int) -> np.ndarray:
    found = _numbers(file, find, keyword, count)
    if found is None:
        way_out = 'write the views as TIFF, and their geometry as [scan] with beam = "cone"'
        raise refusal(file, f"views without {keyword}", "a cone beam whose geometry is in the header", way_out)
    return found


def _gantry_angles(file: Path, header: Any, finders: list[Finder], assumed: list[str]) -> list[float]:
    return [float(_needed(file, find, "GantryAngle", 1)[0]) for find in finders]


def _positioner_angles(file: Path, header: Any, finders: list[Finder], assumed: list[str]) -> list[float]:
    """Angles of the frames of a file.

    ``PositionerPrimaryAngleIncrement`` has a number a frame. Equal numbers other than 0 are steps between neighbours; other
    numbers are distances from the first frame.
    """
    angles = np.array([float(_needed(file, find, "PositionerPrimaryAngle", 1)[0]) for find in finders])
    steps = header.get("PositionerPrimaryAngleIncrement")
    if steps is not None and len(finders) > 1:
        steps = np.atleast_1d(np.array(steps, np.float64))
        if len(steps) not in (len(finders), len(finders) - 1) or not np.isfinite(steps).all():
            expected = f"one for each of {len(finders)} frames"
            raise refusal(file, f"{len(steps)} numbers of PositionerPrimaryAngleIncrement", expected, "correct the header")
        later = steps[-(len(finders) - 1) :]
        is_even = later[0] != 0 and np.ptp(later) < 0.1 * abs(later[0])
        angles += np.concatenate([[0.0], np.cumsum(later) if is_even else later - (len(steps) == len(finders)) * steps[0]])
        how = "steps from frame to frame, because they are equal" if is_even else "distances from the first frame"
        assumed.append(f"the increments of the positioner's angle are {how}")
    leaning = [find("PositionerSecondaryAngle") for find in finders]
    more = header.get("PositionerSecondaryAngleIncrement")
    lean = np.array([float(one or 0) for one in leaning] + [float(one) for one in np.atleast_1d([] if more is None else more)])
    if np.abs(lean).max() > SAME_ANGLE:
        found = f"a positioner that leans by {np.abs(lean).max():g} degrees (PositionerSecondaryAngle)"
        raise refusal(file, found, "a circle about the patient's axis", 'give the geometry by beam = "table"')
    return [float(angle) for angle in angles]


def _angiography_lengths(file: Path, header: Any, find: Finder, assumed: list[str]) -> tuple[float, ...]:
    to_detector = float(_needed(file, find, "DistanceSourceToDetector", 1)[0])
    to_axis = _number(file, find, "DistanceSourceToIsocenter")
    if to_axis is None and (to_axis := _number(file, find, "DistanceSourceToPatient")) is not None:
        assumed.append(f"the axis is {to_axis:g} mm from the source (DistanceSourceToPatient)")
    if to_axis is None and (factor := _number(file, find, "EstimatedRadiographicMagnificationFactor")):
        to_axis = to_detector / factor
        assumed.append(f"the axis is {to_axis:g} mm from the source, by EstimatedRadiographicMagnificationFactor {factor:g}")
    if to_axis is None:
        to_axis = float(_needed(file, find, "DistanceSourceToPatient", 1)[0])
    assumed.append("the detector's middle lies on the central ray, and the patient's head at the top of an image")
    return to_axis, to_detector, *map(float, _needed(file, find, "ImagerPixelSpacing", 2)), 0.0, 0.0


def _rt_lengths(file: Path, header: Any, find: Finder, assumed: list[str]) -> tuple[float, ...]:
    to_axis, to_detector = (float(_needed(file, find, name, 1)[0]) for name in ("RadiationMachineSAD", "RTImageSID"))
    pitch = _needed(file, find, "ImagePlanePixelSpacing", 2)
    axes = _numbers(file, find, "RTImageOrientation", 6)
    if axes is not None and not np.allclose(axes, (1, 0, 0, 0, -1, 0), atol=SAME_LENGTH):
        raise refusal(file, f"RTImageOrientation {axes.tolist()}", "[1, 0, 0, 0, -1, 0]", 'give the geometry by beam = "table"')
    shift = _numbers(file, find, "XRayImageReceptorTranslation", 3)
    place = _numbers(file, find, "RTImagePosition", 2)
    middle = np.zeros(2) if shift is None else shift[:2].copy()
    if place is None:
        assumed.append("the middle of an image is the middle of the receptor (no RTImagePosition)")
    else:
        middle += place + (np.array([int(header["Columns"].value), int(header["Rows"].value)]) - 1) / 2 * pitch[::-1] * (1, -1)
    return to_axis, to_detector, float(pitch[0]), float(pitch[1]), float(middle[1]), float(middle[0])
