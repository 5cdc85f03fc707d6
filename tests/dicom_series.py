"""DICOM series written by pydicom, with a place and values that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

AXES = {
    "axial": ([1, 0, 0], [0, 1, 0]),
    "sagittal": ([0, 1, 0], [0, 0, -1]),
    "coronal": ([1, 0, 0], [0, 0, -1]),
    "oblique": ([0.8, 0.6, 0], [-0.48, 0.64, -0.6]),
}
"""Directions of x (along a row) and of y (down a column)."""

PIXEL = (0.5, 0.75)
"""Distances of rows and of columns [mm]."""

FIRST = np.array([-10.0, 20.0, 5.0])
"""Centre of the first voxel [mm]."""

STEP = 1.25
"""Distance of slices [mm]."""


def header(size: tuple[int, int], dtype: np.dtype | str, uid: str = "1.2.3") -> Dataset:
    """A header of grey values without a place."""
    dtype, image = np.dtype(dtype), Dataset()
    image.file_meta = FileMetaDataset()
    image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = CTImageStorage
    image.SOPInstanceUID = image.file_meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=[uid, str(size)])
    image.SeriesInstanceUID, image.SeriesNumber, image.SeriesDescription, image.Modality = uid, 4, "Head 1.25", "CT"
    image.Rows, image.Columns = size
    image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
    image.BitsAllocated = image.BitsStored = 8 * dtype.itemsize
    image.HighBit, image.PixelRepresentation = image.BitsStored - 1, int(dtype.kind == "i")
    return image


def place(image: Dataset, k: float, orientation: str) -> None:
    """Put an image ``k`` distances behind the first."""
    x, y = AXES[orientation]
    image.ImageOrientationPatient = [*x, *y]
    image.ImagePositionPatient = [float(f"{c:.10g}") for c in FIRST + k * STEP * np.cross(x, y)]
    image.PixelSpacing, image.SliceThickness = list(PIXEL), 2.0


def write_series(
    folder: Path, stored: np.ndarray, orientation: str = "axial", *, names: list[str] | None = None, uid: str = "1.2.3", **more
) -> list[Path]:
    """Write a file a slice of ``stored`` (Z, Y, X); ``more`` are elements of every header."""
    folder.mkdir(exist_ok=True)
    paths = []
    for k, values in enumerate(stored):
        image = header(values.shape, stored.dtype, uid)
        place(image, k, orientation)
        image.InstanceNumber = k + 1
        for name, value in more.items():
            setattr(image, name, value)
        image.PixelData = values.astype(stored.dtype.newbyteorder("<")).tobytes()
        paths.append(folder / (names[k] if names else f"{uid}-{k}.dcm"))
        image.save_as(paths[-1], enforce_file_format=True)
    return paths


def write_frames(path: Path, stored: np.ndarray, orientation: str, order: list[int], slopes: list[float]) -> None:
    """Write one file of functional groups, its frames in ``order``, each with its slope and place."""
    image = header(stored.shape[1:], stored.dtype)
    image.NumberOfFrames = len(stored)
    measures, turned = Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness = list(PIXEL), 2.0
    shared, frames = Dataset(), []
    for k in order:
        place(turned, k, orientation)
        groups, position, values = Dataset(), Dataset(), Dataset()
        position.ImagePositionPatient = turned.ImagePositionPatient
        values.RescaleSlope, values.RescaleIntercept = slopes[k], 10 * k
        groups.PlanePositionSequence, groups.PixelValueTransformationSequence = Sequence([position]), Sequence([values])
        frames.append(groups)
    axes = Dataset()
    axes.ImageOrientationPatient = turned.ImageOrientationPatient
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([axes])
    image.SharedFunctionalGroupsSequence, image.PerFrameFunctionalGroupsSequence = Sequence([shared]), Sequence(frames)
    image.PixelData = stored[order].tobytes()
    image.save_as(path, enforce_file_format=True)


def expected_place(orientation: str, shape: tuple[int, int, int]) -> np.ndarray:
    """The placement of the unit cube, from the definition: steps times sizes, and half a voxel before the first centre."""
    x, y = np.array(AXES[orientation])
    steps = np.stack([x * PIXEL[1], y * PIXEL[0], np.cross(x, y) * STEP], axis=1)
    to_world = np.eye(4)
    to_world[:3, :3] = steps * shape[::-1]
    to_world[:3, 3] = FIRST - steps.sum(axis=1) / 2
    return to_world
