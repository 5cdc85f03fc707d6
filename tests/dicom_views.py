"""DICOM cone-beam views written by pydicom: a head of ellipsoids by its exact line integrals, in the patient's frame.

The world of the phantom is right, anterior, head; the oracle gets rays from the standard's own definitions, not from mivol's
conventions. X-ray angiography: the detector is at primary angle a towards the patient's left from anterior, and an image shows
the patient's left at its right. RT image: the gantry's angle moves the source from above (IEC fixed +z) towards +x, and an
image is seen from the source.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from dicom_series import header
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

TO_AXIS, TO_DETECTOR, PITCH = 60.0, 90.0, (0.5, 0.4)
"""Distances and pixels (rows, columns) [mm]."""

BALLS = ((3.0, 1.0, 0.5, 2.0), (-2.0, 2.5, -1.0, 1.5), (0.0, -3.0, 1.5, 1.0))
"""Balls: x, y, z in right, anterior, head, and radius [mm]; each has 0.2 / mm."""


def line_integrals(
    angle: float, size: tuple[int, int], offset: tuple[float, float] = (0.0, 0.0), kind: str = "XA"
) -> np.ndarray:
    """The image (rows, columns) of a view as DICOM stores it: the head at the top.

    Args:
        angle: positioner's primary angle, or angle of the gantry [degree].
        size: (rows, columns).
        offset: place of the image's middle on the receptor, along its columns and upwards [mm].
        kind: "XA" or "RT".
    """
    a = np.radians(angle)
    left, anterior = np.array([-1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    head = np.array([0.0, 0.0, 1.0])
    if kind == "XA":
        to_detector = np.sin(a) * left + np.cos(a) * anterior
        along = np.cos(a) * left - np.sin(a) * anterior
    else:  # IEC fixed x is the patient's left, z up is anterior, in a supine patient with the head towards the gantry
        to_detector = -(np.sin(a) * left + np.cos(a) * anterior)
        along = np.cos(a) * left - np.sin(a) * anterior
    rows, columns = size
    x = (np.arange(columns) - (columns - 1) / 2) * PITCH[1] + offset[0]
    y = -(np.arange(rows) - (rows - 1) / 2) * PITCH[0] + offset[1]
    source = -TO_AXIS * to_detector
    pixels = (TO_DETECTOR - TO_AXIS) * to_detector + x[:, None] * along + y[:, None, None] * head
    rays = pixels - source
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    total = np.zeros(size)
    for *centre, radius in BALLS:
        towards = np.array(centre) - source
        near = np.linalg.norm(towards - (rays @ towards)[..., None] * rays, axis=-1)
        total += 0.2 * 2 * np.sqrt(np.maximum(radius**2 - near**2, 0))
    return total


def _write(path: Path, image: Dataset, stored: np.ndarray) -> None:
    image.PixelData = np.ascontiguousarray(stored).tobytes()
    image.save_as(path, enforce_file_format=True)


def to_counts(lines: np.ndarray) -> np.ndarray:
    """Readings in proportion to the light, 40000 without object, uint16."""
    return np.rint(40000 * np.exp(-lines)).astype("<u2")


def write_angiography(path: Path, angles: np.ndarray, size: tuple[int, int] = (24, 40), **more: object) -> Path:
    """One multi-frame file with the angles as increments from the first frame; ``more`` are elements of the header."""
    image = header(size, "u2")
    image.Modality, image.NumberOfFrames = "XA", len(angles)
    image.PositionerPrimaryAngle, image.PositionerSecondaryAngle = float(angles[0]), 0.0
    image.PositionerPrimaryAngleIncrement = [float(angle - angles[0]) for angle in angles]
    image.DistanceSourceToDetector, image.DistanceSourceToPatient = TO_DETECTOR, TO_AXIS
    image.ImagerPixelSpacing, image.PixelIntensityRelationship = list(PITCH), "LIN"
    for name, value in more.items():
        setattr(image, name, value) if value is not None else delattr(image, name)
    _write(path, image, to_counts(np.stack([line_integrals(angle, size) for angle in angles])))
    return path


def write_enhanced(path: Path, angles: np.ndarray, size: tuple[int, int] = (24, 40)) -> Path:
    """One enhanced file, with angles and distances in functional groups."""
    image = header(size, "u2")
    image.Modality, image.NumberOfFrames = "XA", len(angles)
    frames, shared, geometry, pixels = [], Dataset(), Dataset(), Dataset()
    for angle in angles:
        position, groups = Dataset(), Dataset()
        position.PositionerPrimaryAngle, position.PositionerSecondaryAngle = float(angle), 0.0
        groups.PositionerPositionSequence = Sequence([position])
        frames.append(groups)
    geometry.DistanceSourceToIsocenter, geometry.DistanceSourceToDetector = TO_AXIS, TO_DETECTOR
    pixels.ImagerPixelSpacing = list(PITCH)
    shared.XRayGeometrySequence = Sequence([geometry])
    shared.FramePixelDataPropertiesSequence = Sequence([pixels])
    image.SharedFunctionalGroupsSequence, image.PerFrameFunctionalGroupsSequence = Sequence([shared]), Sequence(frames)
    _write(path, image, to_counts(np.stack([line_integrals(angle, size) for angle in angles])))
    return path


def write_rt_images(
    folder: Path, angles: np.ndarray, size: tuple[int, int] = (24, 40), shift: float = 0.0, **more: object
) -> Path:
    """A file a view, named against the order of the views; the receptor is ``shift`` mm beside the central ray."""
    folder.mkdir()
    for k, angle in enumerate(angles):
        image = header(size, "u2")
        image.Modality, image.InstanceNumber = "RTIMAGE", k + 1
        image.GantryAngle, image.RadiationMachineSAD, image.RTImageSID = float(angle), TO_AXIS, TO_DETECTOR
        image.ImagePlanePixelSpacing = list(PITCH)
        image.RTImagePosition = [-(size[1] - 1) / 2 * PITCH[1], (size[0] - 1) / 2 * PITCH[0]]
        image.XRayImageReceptorTranslation = [shift, 0.0, TO_AXIS - TO_DETECTOR]
        for name, value in more.items():
            setattr(image, name, value)
        _write(folder / f"{len(angles) - k:03d}.dcm", image, to_counts(line_integrals(angle, size, (shift, 0.0), "RT")))
    return folder
