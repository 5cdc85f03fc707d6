"""DICOM series and multi-frame files, read by the package pydicom.

Conventions. The world frame is LPS in mm. ``ImageOrientationPatient`` has the directions of x (along a row) and of y (down a
column), ``ImagePositionPatient`` the centre of the first voxel of a slice. ``PixelSpacing`` has the distance of rows before
the distance of columns. Slices are ordered along the normal, the cross product of x and y. Values are the stored values times
the slope plus the intercept of their slice.

Reference: DICOM PS3.3, C.7.6.2 (image plane), C.7.6.16 (functional groups of multi-frame files), C.8.8.3 (dose grids).
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mivol.errors import MivolError
from mivol.files.npy import check_memory
from mivol.files.source import check_file, refusal
from mivol.files.volume import VolumeData, frame_from_steps, to_values

MAGIC = b"DICM"

MAGIC_OFFSET = 128
"""Place of the magic bytes in a file [byte]."""

UNEVEN = 0.01
"""Largest error of a slice's position, in distances of slices: positions rounded to 0.001 mm, with slices 0.05 mm apart."""

PARALLEL = 1e-3
"""Largest error of a direction: directions of a header are rounded, to four decimals by the coarsest writers."""

ALONE = "put one kind into a folder of its own"
"""Way out of a series of several kinds."""

KEYWORDS = (
    *("SeriesInstanceUID", "SeriesNumber", "SeriesDescription", "Modality", "InstanceNumber", "NumberOfFrames"),
    *("Rows", "Columns", "SamplesPerPixel", "PhotometricInterpretation", "ModalityLUTSequence"),
    *("ImageOrientationPatient", "ImagePositionPatient", "PixelSpacing", "ImagerPixelSpacing", "SliceThickness"),
    *("SpacingBetweenSlices", "GridFrameOffsetVector", "RescaleSlope", "RescaleIntercept", "DoseGridScaling"),
    *("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"),
    *("PositionerPrimaryAngle", "PositionerPrimaryAngleIncrement", "GantryAngle"),
)
"""Elements of a header that are read."""


class Slice(NamedTuple):
    """A slice: the file and the frame in it, its place [mm], and its values.

    ``axes`` are the unit vectors (2, 3) of x and y, ``pixel`` the distances of rows and of columns; None if the file has none.
    """

    file: Path
    frame: int
    size: tuple[int, int]
    position: np.ndarray | None
    axes: np.ndarray | None
    pixel: np.ndarray | None
    thickness: float | None
    slope: float
    intercept: float
    number: int | None


def is_dicom(head: bytes) -> bool:
    """Whether the first bytes are those of a DICOM file."""
    return head[MAGIC_OFFSET : MAGIC_OFFSET + len(MAGIC)] == MAGIC


def find_dicom(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder, and of the folders in it, that begin as DICOM or have its suffix, in the order of names."""
    entries = sorted(folder.iterdir())
    inner = (file for entry in entries if entry.is_dir() for file in sorted(entry.iterdir()))
    for file in (*(entry for entry in entries if entry.is_file()), *inner):
        if not file.is_file():
            continue
        with file.open("rb") as opened:
            if file.suffix.lower() == ".dcm" or is_dicom(opened.read(MAGIC_OFFSET + len(MAGIC))):
                yield file


def is_dicom_file(path: Path) -> bool:
    """Whether a file begins as DICOM."""
    with path.open("rb") as file:
        return is_dicom(file.read(MAGIC_OFFSET + len(MAGIC)))


def read_dicom(path: Path, dataset: str | None = None) -> VolumeData:
    """Read the series in a folder, or the series to which a file belongs.

    Args:
        path: folder, searched with its subfolders, or a file; a file brings the other files of its series in the same folder.
        dataset: ``SeriesInstanceUID``, or ``SeriesNumber`` (followed by .1, .2, ... if several series share the number);
            default: the series of the file, or the only series of the folder.

    Raises:
        MivolError: no pydicom, damaged files, several series, gaps, two slices in one place, or colours.
    """
    dcmread = import_dcmread(path)
    if path.is_file():
        check_file(path)
    headers = {file: _read_header(dcmread, file) for file in (find_dicom(path) if path.is_dir() else [path])}
    if path.is_file() and ("Rows" not in headers[path] or dataset is not None or frame_count(headers[path], path) == 1):
        headers |= {file: _read_header(dcmread, file) for file in find_dicom(path.parent) if file != path}
        if dataset is None:
            uid = headers[path].get("SeriesInstanceUID")
            headers = {file: header for file, header in headers.items() if header.get("SeriesInstanceUID") == uid}
    series: dict[str, dict[Path, Any]] = {}
    for file, header in headers.items():
        if "Rows" in header and "Columns" in header:
            series.setdefault(str(header.get("SeriesInstanceUID", "")), {})[file] = header
    if not series:
        raise refusal(path, "DICOM files without pixels", "images", "name the folder of a series of images")
    uid = _select_series(path, series, dataset)
    _refuse_views(path, list(series[uid].values()))
    slices = [one for file, header in series[uid].items() for one in _list_slices(file, header)]
    sizes = Counter(one.size for one in slices)
    if len(sizes) > 1:
        listed = ", ".join(f"{count} of {size[0]} x {size[1]}" for size, count in sizes.items())
        raise refusal(path, f"images of several sizes in a series ({listed})", "one size", ALONE)
    slices, steps, origin, notes, is_placed = _place(path, slices)
    values, dtype = _read_values(dcmread, path, slices)
    first = next(iter(series[uid].values()))
    meta = {
        "path": str(path),
        "format": "dicom",
        "dtype": dtype,
        "space": "LPS" if is_placed else None,
        "unit": "mm",
        "series": uid,
        "modality": str(first.get("Modality", "")),
        "description": str(first.get("SeriesDescription", "")),
        "notes": notes,
    }
    rows, columns = slices[0].size
    return VolumeData(to_values(values, path), frame_from_steps((columns, rows, len(slices)), steps, origin), meta)


# -- Headers ---------------------------------------------------------------------------------------------------------------


def _refuse_views(path: Path, headers: list[Any]) -> None:
    """Refuse views of a turning source, which are no slices."""
    angles = set()
    for one in headers:
        for frame in one.get("PerFrameFunctionalGroupsSequence") or [one]:
            place = frame.get("PositionerPositionSequence") or [one]
            angles |= {str(place[0].get(name)) for name in ("PositionerPrimaryAngle", "GantryAngle") if name in place[0]}
        angles |= {f"{angle} more" for angle in np.atleast_1d(one.get("PositionerPrimaryAngleIncrement") or []) if angle}
    if len(angles) > 1:
        found = f"views of a source from {len(angles)} angles"
        raise refusal(path, found, "slices", "reconstruct them with mivol optimize (views with a place of a slice: write TIFF)")


def import_dcmread(path: Path) -> Any:
    """The reader of pydicom.

    Raises:
        MivolError: no pydicom.
    """
    try:
        from pydicom import dcmread
    except ImportError as error:
        way_out = 'install it: pip install "mivol[lab]"'
        raise refusal(path, "a DICOM file but no pydicom", "an installed pydicom", way_out) from error
    return dcmread


@contextmanager
def refuse_unreadable(file: Path) -> Iterator[None]:
    """Refuse what pydicom cannot read: its parsers and decoders raise errors of many classes."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (MivolError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise refusal(file, f"a damaged DICOM file ({reason})", "a whole DICOM file", "copy it again") from error


def _read_header(dcmread: Any, file: Path) -> Any:
    with refuse_unreadable(file):
        header = dcmread(file, stop_before_pixels=True, specific_tags=list(KEYWORDS))
    check_elements(file, header, KEYWORDS)
    return header


def check_elements(file: Path, header: Any, keywords: tuple[str, ...]) -> None:
    """Convert elements of a header, which pydicom does when an element is asked for first.

    Raises:
        MivolError: a damaged element.
    """
    with refuse_unreadable(file):
        for keyword in keywords:
            header.get(keyword)


def frame_count(header: Any, file: Path) -> int:
    """Number of frames, at most as many as the file has bits: a frame takes one at least, packed or not."""
    with refuse_unreadable(file):
        frames, most = int(header.get("NumberOfFrames") or 1), 8 * file.stat().st_size
        if not 1 <= frames <= most:
            raise refusal(file, f"{frames} frames", f"1 to {most} in a file of this size", "correct the header")
        return frames


def _select_series(path: Path, series: dict[str, dict[Path, Any]], dataset: str | None) -> str:
    """The ``SeriesInstanceUID`` of the series to read."""
    names = _name_series(series)
    if dataset is None and len(series) == 1:
        return next(iter(series))
    found = [uid for uid, name in names.items() if dataset is not None and str(dataset) in (uid, name)]
    if found:
        return found[0]
    listed = ", ".join(
        f"{names[uid]} {str(next(iter(files.values())).get('SeriesDescription', ''))[:30]!r} of {len(files)} "
        + "image" + "s" * (len(files) != 1)
        for uid, files in sorted(series.items(), key=lambda item: -len(item[1]))
    )  # fmt: skip
    way_out = "name its number, or its SeriesInstanceUID, by dataset= in Python or by --dataset in mivol explain and convert"
    asked = f"no series {dataset!r} among " if dataset is not None else ""
    raise refusal(path, f"{asked}{len(series)} series ({listed})", "one series", way_out)


def _name_series(series: dict[str, dict[Path, Any]]) -> dict[str, str]:
    """``SeriesInstanceUID`` -> ``SeriesNumber``; series that share a number 4 are 4.1, 4.2, ... in the order of their UIDs."""
    alike: dict[str, list[str]] = {}
    for uid, files in sorted(series.items()):
        alike.setdefault(str(next(iter(files.values())).get("SeriesNumber") or 0), []).append(uid)
    return {
        uid: f"{number}.{k}" if len(uids) > 1 else number for number, uids in alike.items() for k, uid in enumerate(uids, 1)
    }


def _list_slices(file: Path, header: Any) -> list[Slice]:
    with refuse_unreadable(file):
        kind = str(header.get("PhotometricInterpretation", "MONOCHROME2"))
        if int(header.get("SamplesPerPixel") or 1) != 1 or not kind.startswith("MONOCHROME"):
            raise refusal(file, f"colours ({kind})", "grey values (MONOCHROME1 or 2)", "name a series of grey values")
        if "ModalityLUTSequence" in header:
            raise refusal(
                file, "values by a lookup table", "a slope and an intercept", "convert it to .nrrd by another program"
            )
        slices = [_make_slice(file, header, frame) for frame in range(frame_count(header, file))]
        offsets = header.get("GridFrameOffsetVector")
        if offsets is not None and len(slices) > 1 and slices[0].axes is not None and slices[0].position is not None:
            ahead = [np.cross(*one.axes) * float(offsets[one.frame]) for one in slices]
            slices = [one._replace(position=one.position + along) for one, along in zip(slices, ahead, strict=True)]
        elif len(slices) > 1 and "PerFrameFunctionalGroupsSequence" not in header:
            slices = [one._replace(position=None, axes=None) for one in slices]
        return slices


def _make_slice(file: Path, header: Any, frame: int) -> Slice:
    def find(sequence: str, keyword: str) -> Any:
        """An element of the frame, of all frames, or of the file; None if it is absent or empty."""
        of_frame = header.get("PerFrameFunctionalGroupsSequence")
        shared = header.get("SharedFunctionalGroupsSequence")
        for groups in ([of_frame[frame]] if of_frame else []) + ([shared[0]] if shared else []):
            if groups.get(sequence) and groups[sequence][0].get(keyword) is not None:
                return groups[sequence][0].get(keyword)
        return header.get(keyword)

    def numbers(sequence: str, keyword: str, count: int) -> np.ndarray | None:
        value = find(sequence, keyword)
        if value is None or value == "":
            return None
        array = np.atleast_1d(np.array(value, np.float64))
        if array.shape != (count,) or not np.isfinite(array).all():
            raise refusal(file, f"{keyword} {value}", f"{count} finite numbers", "correct the header")
        return array

    def number(sequence: str, keyword: str) -> float | None:
        found = numbers(sequence, keyword, 1)
        return None if found is None else float(found[0])

    axes = numbers("PlaneOrientationSequence", "ImageOrientationPatient", 6)
    axes = None if axes is None else axes.reshape(2, 3)
    if axes is not None and not np.allclose(axes @ axes.T, np.eye(2), atol=PARALLEL):
        raise refusal(
            file, f"ImageOrientationPatient {axes.ravel().tolist()}", "two unit vectors at right angles", "correct it"
        )
    pixel = numbers("PixelMeasuresSequence", "PixelSpacing", 2)
    pixel = numbers("", "ImagerPixelSpacing", 2) if pixel is None else pixel
    apart = [number("PixelMeasuresSequence", keyword) for keyword in ("SpacingBetweenSlices", "SliceThickness")]
    slope = number("PixelValueTransformationSequence", "RescaleSlope")
    slope = number("", "DoseGridScaling") if slope is None else slope
    return Slice(
        file,
        frame,
        (int(header["Rows"].value), int(header["Columns"].value)),
        numbers("PlanePositionSequence", "ImagePositionPatient", 3),
        axes,
        pixel,
        next((abs(length) for length in apart if length), None),
        1.0 if slope is None else slope,
        number("PixelValueTransformationSequence", "RescaleIntercept") or 0.0,
        None if header.get("InstanceNumber") in (None, "") else int(header["InstanceNumber"].value),
    )


# -- Place -----------------------------------------------------------------------------------------------------------------


def _place(path: Path, slices: list[Slice]) -> tuple[list[Slice], np.ndarray, np.ndarray, tuple[str, ...], bool]:
    """Slices in order, steps (3, 3), the centre of the first voxel, notes, and whether the file has the place."""
    first, notes = slices[0], []
    placed = [one.position is not None and one.axes is not None for one in slices]
    if any(placed) and not all(placed):
        found = f"{placed.count(False)} of {len(slices)} slices without position and orientation"
        raise refusal(path, found, "all or none", "take the others out of the folder")
    pixel = first.pixel
    if pixel is None:
        pixel = np.ones(2)
        notes.append("no distance of pixels in the file: a pixel counts as 1 mm.")
    if any(one.pixel is not None and not np.allclose(one.pixel, pixel, rtol=1e-4) for one in slices):
        raise refusal(path, "slices of several pixel sizes", "one size", ALONE)
    apart = first.thickness
    if not placed[0]:
        order = [((one.number or 0), one.frame) for one in slices]
        if len(set(order)) < len(order):
            raise refusal(path, "slices without position, and with equal numbers", "positions or numbers", "name one file")
        slices = [slices[k] for k in sorted(range(len(slices)), key=order.__getitem__)]
        distance = "a slice counts as 1 mm" if apart is None else f"slices are {apart:g} mm apart by their thickness"
        notes.append(f"no positions of slices in the file: their numbers are the order, and {distance}.")
        return slices, np.diag([pixel[1], pixel[0], apart or 1.0]), np.zeros(3), tuple(notes), False
    if turned := sum(not np.allclose(one.axes, first.axes, atol=PARALLEL) for one in slices):
        found = f"slices of several orientations ({turned} of {len(slices)} are not parallel to {first.file.name})"
        raise refusal(path, found, "parallel slices", ALONE)
    x, y = first.axes
    normal = np.cross(x, y)
    slices = sorted(slices, key=lambda one: float(one.position @ normal))
    if len(slices) == 1:
        if apart is None:
            notes.append("no thickness of the slice in the file: it counts as 1 mm.")
        step = normal * (apart or 1.0)
    else:
        step = _slice_step(path, slices, normal)
    return slices, np.stack([x * pixel[1], y * pixel[0], step], axis=1), slices[0].position, tuple(notes), True


def _slice_step(path: Path, slices: list[Slice], normal: np.ndarray) -> np.ndarray:
    """The vector from slice to slice; gaps and two slices in one place are refused."""
    places = np.array([one.position for one in slices])
    along = places @ normal
    distances = np.diff(along)
    usual = float(np.median(distances))
    same = np.flatnonzero(distances <= UNEVEN * usual) if usual > 0 else np.arange(len(distances))
    if same.size:
        pair = " and ".join(f"{one.file.name}{f' frame {one.frame + 1}' * bool(one.frame)}" for one in slices[same[0] :][:2])
        more = f", and {same.size - 1} more such pairs" * (same.size > 1)
        raise refusal(
            path,
            f"two slices at {along[same[0]]:.6g} mm along the normal ({pair}){more}",
            "one slice a position",
            "put one echo, time or copy into a folder of its own",
        )
    step = (places[-1] - places[0]) / (len(slices) - 1)
    error = np.linalg.norm(places - places[0] - np.arange(len(slices))[:, None] * step, axis=1)
    if error.max() <= UNEVEN * usual:
        return step
    gaps = np.flatnonzero(distances > 1.5 * usual)
    if gaps.size:
        low, high = (f"{along[k]:.6g} mm ({slices[k].file.name})" for k in (gaps[0], gaps[0] + 1))
        found = (
            f"{gaps.size} gap{'s' * (gaps.size > 1)}: no slice between {low} and {high}, where others are {usual:.6g} mm apart"
        )
        raise refusal(path, found, "slices at even distances", "copy the missing files into the folder")
    k = int(error.argmax())
    found = f"{slices[k].file.name} {error[k]:.4g} mm off its place in an even series of {usual:.6g} mm"
    raise refusal(path, found, "slices at even distances", "resample the series by another program")


# -- Values ----------------------------------------------------------------------------------------------------------------


def _read_values(dcmread: Any, path: Path, slices: list[Slice]) -> tuple[np.ndarray, str]:
    """Values (Z, Y, X), float32, and the stored type."""
    rows, columns = slices[0].size
    check_memory(path, 4 * len(slices) * rows * columns)
    values = np.empty((len(slices), rows, columns), np.float32)
    frames: dict[Path, list[tuple[int, Slice]]] = {}
    for k, one in enumerate(slices):
        frames.setdefault(one.file, []).append((k, one))
    dtype = ""
    for file, parts in frames.items():
        stored = decode(dcmread, file).reshape(-1, rows, columns)
        dtype = str(stored.dtype)
        for k, one in parts:
            frame = stored[one.frame]
            values[k] = frame if (one.slope, one.intercept) == (1, 0) else frame * np.float64(one.slope) + one.intercept
    return values, dtype


def decode(dcmread: Any, file: Path) -> np.ndarray:
    """The stored pixels of a file, (rows, columns) or (frames, rows, columns).

    Raises:
        MivolError: a damaged file, or a compression without its decoder.
    """
    with refuse_unreadable(file):
        image = dcmread(file)
        try:
            return image.pixel_array
        except (RuntimeError, NotImplementedError) as error:
            syntax = image.file_meta.TransferSyntaxUID
            if not syntax.is_compressed or "missing" not in str(error):
                raise
            raise refusal(
                file,
                f"pixels compressed by {syntax.name}",
                "a compression that pydicom decodes here",
                'pip install "mivol[lab]" has its decoder; or write the series uncompressed',
            ) from error
