"""Scans of Nikon (X-Tek) laboratory CT: an ``.xtekct`` file of settings, and a TIFF file per projection.

Own reader: TIGRE and the Core Imaging Library read these scans as parts of whole reconstruction toolkits.

Conventions. Lengths are in mm, angles in degrees. In the files the first row of an image is the highest, and columns run as
seen from the detector towards the source. Reading flips both, as :mod:`mivol.tomography.geometry` expects.

Sources: ``NikonDataReader`` of the Core Imaging Library (University of Manchester and STFC), which computes angles from the
steps because the angles in ``_ctdata.txt`` and ``.ang`` files were wrong; the loaders of TIGRE and of CCPi-Reconstruction (file
names, columns of the lists).
"""

from __future__ import annotations

import configparser
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.image_stack import ALL, check_finite, read_images, stack_shape
from mivol.files.source import check_file, refusal
from mivol.files.tiff import TIFF, natural_order

SECTION = "xtekct"


@dataclass(frozen=True, eq=False)
class NikonScan:
    """The settings of an ``.xtekct`` file.

    Attributes:
        path: path of the file.
        images: file of each projection.
        source_to_axis, source_to_detector: distances from the source [mm].
        detector: pixels (rows, columns).
        pitch: distance of pixel centres along (rows, columns) [mm].
        white_level: reading of a pixel without an object.
        angles: rotation of the sample (views,), clockwise as seen from above [degree].
        axis_offset: position of the rotation axis along the flipped detector columns [mm].
        tilt, roll: angles of the rotation axis, towards the detector and along the detector [degree].
        shape: voxels (Z, Y, X), if known.
        voxel_size: edges of a voxel (x, y, z) [mm].
        left_out: settings with a value that mivol ignores.
    """

    path: Path
    images: tuple[Path, ...]
    source_to_axis: float
    source_to_detector: float
    detector: tuple[int, int]
    pitch: tuple[float, float]
    white_level: float
    angles: np.ndarray
    axis_offset: float
    tilt: float
    roll: float
    shape: tuple[int, int, int] | None
    voxel_size: tuple[float, float, float]
    left_out: tuple[str, ...]


def read_nikon(path: str | os.PathLike) -> NikonScan:
    """Read the settings of a scan and find its images.

    The rotation axis is at ``ObjectOffsetX``. Older files give its position on the detector: the mean of
    ``CentreOfRotationTop`` and ``CentreOfRotationBottom``, whose difference is the roll. Angles are
    ``InitialAngle + AngularStep i``.

    Raises:
        MivolError: no file, a missing or invalid key, or different numbers of images and projections.
    """
    path = check_file(path)
    keys = _Keys(path, _section(path))
    rows, columns = keys.count("DetectorPixelsY"), keys.count("DetectorPixelsX")
    pitch = keys.length("DetectorPixelSizeY"), keys.length("DetectorPixelSizeX")
    to_axis, to_detector = keys.length("SrcToObject"), keys.length("SrcToDetector")
    images, views = _images(path, keys), keys.count("Projections")
    if len(images) != views:
        raise refusal(path, f"{len(images)} images for {views} projections", "an image per projection", "copy the scan again")
    top, bottom = keys.number("CentreOfRotationTop", 0.0), keys.number("CentreOfRotationBottom", 0.0)
    offset = keys.number("ObjectOffsetX", (top + bottom) / 2 * to_axis / to_detector)
    sizes = tuple(keys.number(f"VoxelSize{axis}", 0.0) for axis in "XYZ")
    counts = tuple(int(keys.number(f"Voxels{axis}", 0)) for axis in "ZYX")
    ignored = [f"Detector{name}" for name in ("OffsetX", "OffsetY")] + [f"Offset{axis}" for axis in "XYZ"] + ["Scattering"]
    return NikonScan(
        path, images, to_axis, to_detector, (rows, columns), pitch, keys.length("WhiteLevel"),
        keys.number("InitialAngle", 0.0) + keys.number("AngularStep") * np.arange(views),
        -offset,
        keys.number("ObjectTilt", 0.0),
        keys.number("ObjectRoll", -math.degrees(math.atan2(top - bottom, rows * pitch[0]))),
        counts if min(counts) > 0 and min(sizes) > 0 else None,
        sizes,
        tuple(f"{name} = {keys.number(name, 0.0):g}" for name in ignored if keys.number(name, 0.0)),
    )  # fmt: skip


def read_nikon_angles(path: str | os.PathLike, views: int) -> np.ndarray:
    """Read angles [degree] from ``_ctdata.txt`` or an ``.ang`` file: lines of a view number and its angle.

    Raises:
        MivolError: no file, or another number of angles than ``views``.
    """
    path, angles = check_file(path), {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = re.split(r"[\s,:;]+", line.strip())
        if len(words) > 1 and words[0].isdigit():
            try:
                angles[int(words[0])] = float(words[1])
            except ValueError:
                continue
    # The second line of _ctdata.txt holds other numbers (projections, frames, exposure); the line of the last view replaces it.
    start = 0 if 0 in angles else 1
    numbers = range(start, start + views)
    if any(number not in angles for number in numbers):
        raise refusal(path, f"{len(angles)} angles", f"one line for each of {views} views", "complete the file")
    return np.array([angles[number] for number in numbers])


def read_nikon_transmission(scan: NikonScan, saturation: float = math.inf, rows: slice = ALL) -> np.ndarray:
    """Return readings divided by the white level, float32 (views, rows, columns).

    Rows start at the lowest, and columns run as seen from the source. Readings of ``saturation`` or more become NaN. ``rows``
    are counted upwards.

    Raises:
        MivolError: an unreadable image, or an image of another size than the detector.
    """
    height, columns = stack_shape(scan.images[0])[1:]
    if (height, columns) != scan.detector:
        expected = "{} x {} as DetectorPixels".format(*scan.detector)
        raise refusal(scan.path, f"images of {height} x {columns} pixels", expected, "correct the settings")
    down = range(height)[::-1][rows]
    readings = read_images(list(scan.images), ALL if rows == ALL else slice(down[-1], down[0] + 1, -down.step))
    check_finite(scan.path, readings)
    readings[readings >= saturation] = np.nan
    return readings[:, ::-1, ::-1] / np.float32(scan.white_level)


def _section(path: Path) -> dict[str, str]:
    parser = configparser.ConfigParser(strict=False, interpolation=None, allow_no_value=True)
    try:
        parser.read_string(path.read_text(encoding="utf-8-sig", errors="replace"))
    except configparser.Error as error:
        found = f"no settings ({' '.join(str(error).split())})"
        raise refusal(path, found, "a section [XTekCT]", "copy the file again") from None
    name = next((name for name in parser.sections() if name.lower() == SECTION), None)
    if name is None:
        raise refusal(path, f"sections {parser.sections()}", "a section XTekCT", "name the .xtekct file of a scan")
    return dict(parser[name])


@dataclass(frozen=True)
class _Keys:
    path: Path
    raw: dict[str, str]

    def text(self, key: str) -> str:
        return (self.raw.get(key.lower()) or "").strip()

    def number(self, key: str, default: float | None = None) -> float:
        text = self.text(key)
        if not text and default is not None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise refusal(self.path, f"{key} = {text!r}", "a finite number", "correct it")
        return value

    def length(self, key: str) -> float:
        value = self.number(key)
        if value <= 0:
            raise refusal(self.path, f"{key} = {value:g}", "a number above 0", "correct it")
        return value

    def count(self, key: str) -> int:
        value = self.number(key)
        if value < 1 or value != int(value):
            raise refusal(self.path, f"{key} = {value:g}", "a whole number above 0", "correct it")
        return int(value)


def _images(path: Path, keys: _Keys) -> tuple[Path, ...]:
    below = path.parent / keys.text("InputFolderName")
    folder = below if below.is_dir() else path.parent
    begins = f"{keys.text('Name')}{keys.text('InputSeparator')}".lower()
    files = [file for file in folder.iterdir() if file.suffix.lower() in TIFF and file.name.lower().startswith(begins)]
    return tuple(sorted((file for file in files if file.stem[len(begins) :].strip("_").isdigit()), key=natural_order))
