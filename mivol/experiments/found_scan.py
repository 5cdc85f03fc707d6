"""A scan without a TOML file: facts from its files, assumptions, choices, and an equivalent TOML file.

Kinds of scans (``SCAN_KINDS``) are recognised by content: a settings file of a Nikon scanner, DICOM views from several angles,
an HDF5 file with the layout of a scan, a folder with such a file, or a folder of TIFF files without cameras.

Conventions. Paths in the settings are relative to the working directory. Lengths are in mm if the files tell the size of a
pixel, in pixels otherwise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mivol import config
from mivol.display import to_toml
from mivol.errors import MivolError
from mivol.files.dicom_views import DicomViews, has_views, read_views, survey_dicom_views
from mivol.files.formats import HEAD, read_volume
from mivol.files.hdf5 import is_hdf5
from mivol.files.image_stack import IMAGES, read_header_angles, read_images, stack_shape
from mivol.files.mrc import TILT_ANGLES, find_tilt_angles, is_mrc, read_tilt_angles
from mivol.files.nikon import SECTION, read_nikon
from mivol.files.scan_hdf5 import half_turns_in_radians, is_scan, survey_projections
from mivol.files.source import read_columns, refusal
from mivol.files.tiff import ImageGroup, group_images, natural_order
from mivol.machine import available_memory
from mivol.photos import find_format

FLAT_WORDS = {
    *("flat", "flats", "flatfield", "ff", "white", "whites", "bright", "open", "openbeam", "ob", "empty", "gain", "air"),
    *("ref", "refs", "reference", "io", "i0"),
}
DARK_WORDS = {"dark", "darks", "darkfield", "df", "dc", "di", "offset", "bias", "background", "darkend"}
"""Words in the names of files and folders of light without a sample, and of no light."""

ANGLE_FILES = (".txt", ".csv", ".ang", ".tlt", ".rawtlt")

SCANNER_FILES = (".log", ".pca", ".info", ".par")
"""Suffixes of files of scanners (Bruker, GE, ESRF) that tell a scan from slices of a volume; mivol does not read them."""

DARKER = 0.9
"""Share of the light of the edges below which the middle of a view counts as darker."""

VOXEL_BYTES = 8 * 4 * 10
"""Memory per voxel of the default solver [byte]: eight unknowns, and about ten numbers each."""

FIRST_ROW = "assumed: the first row of an image is the highest; data.first_row sets it"

HELD_OUT, FEW_VIEWS = 20, 60
"""Every twentieth view is predicted and not fitted, in scans of at least sixty views."""


class ScanDraft(NamedTuple):
    """Settings of a scan, as in TOML, and lines on what was found, assumed and chosen."""

    raw: dict[str, Any]
    lines: tuple[str, ...]

    @property
    def toml(self) -> str:
        """The settings as the text of a TOML file."""
        tables = {key: value for key, value in self.raw.items() if isinstance(value, dict)}
        lines = [f"{key} = {to_toml(value)}" for key, value in self.raw.items() if key not in tables]
        for name, table in tables.items():
            lines += ["", f"[{name}]", *(f"{key} = {to_toml(value)}" for key, value in table.items())]
        return "\n".join(lines)


def find_scan(path: Path) -> str | None:
    """Return the key of ``SCAN_KINDS`` of a file or folder; None for other paths, such as photographs with cameras."""
    if not path.exists() or (path.is_dir() and find_format(path)):
        return None
    return next((name for name, (recognise, _) in SCAN_KINDS.items() if recognise(path)), None)


def describe_missing(path: Path) -> str:
    """Say what a volume lacks to be a scan; "" if nothing would make it one."""
    if find_scan(path) in (TIFF_FOLDER, SINOGRAM):
        way_out = "mivol optimize takes it as a scan, mivol explain does so with --set"
        return f"a volume, for want of flats, darks and angles: {way_out}"
    if path.suffix.lower() in (".npy", ".npz") and path.is_file():
        return 'a volume: as projections (views, rows, columns) it is data.file of a TOML file with data.source = "stack"'
    if path.suffix.lower() in (".mrc", ".st", ".ali") and path.is_file():
        names = " or ".join(f"{path.stem}{suffix}" for suffix in TILT_ANGLES)
        return f"a volume, for want of angles: a tilt series has a file {names} beside it, a line or a section for each image"
    return ""


def draft_scan(path: Path, changes: Sequence[str] = ()) -> ScanDraft:
    """Make settings for a scan from its files.

    Args:
        path: file or folder.
        changes: as in :func:`mivol.config.load`; they come before what is found.

    Raises:
        MivolError: no scan, files that cannot be read, or several scans in a folder.
    """
    given: dict[str, Any] = {}
    for change in changes:
        config.apply_change(given, change)
    kind = find_scan(path)
    if kind is None and not (path.is_file() and is_hdf5(path)):
        kinds = "an .xtekct file, DICOM views, a tilt series (MRC with .rawtlt, .tlt or .mdoc), a sinogram (TIFF)"
        expected = f"a scan in HDF5, {kinds}, or a folder of images"
        raise refusal(path, "no scan", expected, "name one of them, or write a TOML file")
    draft = SCAN_KINDS[kind or HDF5][1](path, given)
    name = path.resolve().stem
    raw = _merge({"title": name, "output": f"runs/{name}"} | draft.raw, given)
    return ScanDraft(raw, tuple(line for line in draft.lines if not _is_replaced(line, given)))


def _is_replaced(line: str, given: dict[str, Any]) -> bool:
    """Whether a line tells an assumption, and changes set all settings that it names."""
    named = re.findall(r"\b(scan|data)\.(\w+)", line) if line.startswith("assumed: ") else []
    return bool(named) and all(key in given.get(table, {}) for table, key in named)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """The tables of both; ``over`` wins."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = base[key] | value if both else value
    return merged


# -- HDF5 ------------------------------------------------------------------------------------------------------------------


def _draft_hdf5(path: Path, given: dict[str, Any]) -> ScanDraft:
    path, lines = _one_file(path, is_scan)
    data = given.get("data", {})
    names = {role: data.get(role, "") for role in ("data", "flats", "darks", "angles")}
    scan = survey_projections(path, data.get("group", ""), names, data.get("angle_unit"))
    views, flats, darks = scan.frames
    height, columns = scan.pixels
    rows = data["rows"][1] - data["rows"][0] if isinstance(data.get("rows"), list) and len(data["rows"]) == 2 else height
    lines += [
        f"found: {scan.layout}: {_count(views, 'view')} of {height} x {columns} pixels, {_count(flats, 'flat')}, "
        f"{_count(darks, 'dark')}"
    ]
    lines += [f"found: {note}" for note in scan.notes]
    raw_scan: dict[str, Any] = {"beam": "parallel"}
    if scan.angles is None:
        lines.append("assumed: no angles: the views are spread evenly over 180 degrees; scan.arc = 360 for a whole turn")
        raw_scan["arc"] = 180.0
    else:
        first, last = np.degrees(scan.angles[[0, -1]])
        lines.append(f"found: angles from {first:.4g} to {last:.4g} degrees")
    lines.append(FIRST_ROW)
    lines += _draft_beam(raw_scan, scan.pitch, scan.distances, (height, columns))
    raw: dict[str, Any] = {"unit": "mm"} if scan.pitch else {}
    raw |= {"scan": raw_scan, "data": {"source": "measured", "file": str(path), "first_row": "highest"}}
    return _finish(raw, [*lines, *_put_grid(raw, rows, columns)], views)


def _draft_beam(
    scan: dict[str, Any],
    pitch: tuple[float, float] | None,
    distances: tuple[float | None, float | None],
    pixels: tuple[int, int],
) -> list[str]:
    """Put pitch and beam into ``scan``; return lines.

    A cone beam magnifies the near and the far end of an object of half width R by factors that differ by ``2 R / D``, with the
    distance D of the axis from the source. Below half a pixel at the edge of the detector, the beam counts as parallel.
    """
    if pitch is None:
        return [
            "assumed: a parallel beam, since the files have no distances; scan.beam sets it",
            "assumed: pixels of edge 1, since the files have no size of a pixel; scan.pitch sets it",
        ]
    edges = [float(f"{edge:.8g}") for edge in pitch]
    scan["pitch"] = edges[1] if edges[0] == edges[1] else edges
    lines = [f"found: pixels of {pitch[0]:.6g} x {pitch[1]:.6g} mm (rows, columns)"]
    source, detector = distances
    if source is None:
        return [*lines, "assumed: a parallel beam, since the file has no distance of the source; scan.beam sets it"]
    reach = pixels[1] / 2 * pitch[1]
    parted = reach * reach / (source + (detector or 0.0)) / pitch[1]
    lines.append(f"found: source {source:.6g} mm before the sample" + (f", detector {detector:.6g} mm behind" * bool(detector)))
    if parted < 0.5 or detector is None:
        why = (
            f"rays of the cone part by {parted:.2g} pixels within the sample"
            if detector
            else "the detector's distance is unknown"
        )
        return [*lines, f"chosen: a parallel beam, because {why}"]
    scan |= {"beam": "cone", "source_to_axis": source, "source_to_detector": source + detector}
    return [*lines, f"chosen: a cone beam, because its rays part by {parted:.2g} pixels within the sample"]


def _draft_grid(scan: dict[str, Any], rows: int, columns: int) -> tuple[dict[str, Any], list[str]]:
    """The voxels, larger than a pixel at the axis by a whole factor if the memory does not hold voxels of a pixel."""
    pitch = np.broadcast_to(scan.get("pitch", 1.0), (2,)).astype(float)
    if scan["beam"] == "cone":
        pitch = pitch * scan["source_to_axis"] / scan["source_to_detector"]
    free = available_memory()
    factor = 1 if free is None else max(1, math.ceil((2 * VOXEL_BYTES * rows * columns**2 / free) ** (1 / 3)))
    shape = [max(1, -(-rows // factor)), -(-columns // factor), -(-columns // factor)]
    # A scan of few rows keeps their height: the box must not become higher than what the rows see.
    height = pitch[0] * rows / shape[0]
    edges = [float(f"{edge:.8g}") for edge in (pitch[1] * factor, pitch[1] * factor, height)]
    grid = {"shape": shape, "voxel_size": edges if len(set(edges)) > 1 else edges[0]}
    if factor == 1:
        return grid, ["chosen: voxels as large as a pixel, as many as the detector sees"]
    size = f"{shape[0]} x {shape[1]} x {shape[2]} voxels of {factor} pixels"
    return grid, [f"chosen: {size}: voxels of a pixel need more than half of the {free / 2**30:.0f} GiB that are free"]


def _put_grid(raw: dict[str, Any], rows: int, columns: int) -> list[str]:
    """Put the voxels into the settings if they are larger than a pixel; without them, the axis decides their number."""
    grid, lines = _draft_grid(raw["scan"], rows, columns)
    if grid["shape"][1] != columns:
        raw["grid"] = grid
    return lines


def _finish(raw: dict[str, Any], lines: list[str], views: int) -> ScanDraft:
    if views >= FEW_VIEWS:
        raw = {"held_out_every": HELD_OUT} | raw
        lines = [*lines, f"chosen: every {HELD_OUT}th view is predicted and not fitted, to judge the result"]
    return ScanDraft(raw, tuple(lines))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + "s" * (number != 1)


def _one_file(path: Path, recognise: Callable[[Path], bool]) -> tuple[Path, list[str]]:
    """The file itself, or the only file of its kind in a folder.

    Raises:
        MivolError: several files.
    """
    if path.is_file():
        return path, []
    files = [file for file in sorted(path.iterdir(), key=natural_order) if recognise(file)]
    if len(files) > 1:
        names = ", ".join(file.name for file in files[:4])
        raise refusal(path, f"{len(files)} scans ({names})", "one", "name the file")
    return files[0], [f"found: {files[0].name} in {path}"]


# -- Nikon -----------------------------------------------------------------------------------------------------------------


def _is_nikon(path: Path) -> bool:
    if not path.is_file() or path.suffix.lower() != ".xtekct":
        return False
    with path.open("rb") as file:
        return f"[{SECTION}]".encode() in file.read(4096).lower()


def _draft_nikon(path: Path, given: dict[str, Any]) -> ScanDraft:
    path, lines = _one_file(path, _is_nikon)
    scan = read_nikon(path)
    rows, columns = scan.detector
    lines += [
        f"found: a Nikon scan of {_count(len(scan.images), 'view')} of {rows} x {columns} pixels of {scan.pitch[1]:.6g} mm",
        f"found: {scan.source_to_axis:.6g} mm from source to axis, {scan.source_to_detector:.6g} mm to the detector",
        f"found: white level {scan.white_level:g}, angles from {scan.angles[0]:.4g} to {scan.angles[-1]:.4g} degrees",
    ]
    raw: dict[str, Any] = {"unit": "mm", "scan": {"beam": "data"}, "data": {"source": "nikon", "file": str(path)}}
    if scan.shape is None:
        beam = {"beam": "cone", "pitch": scan.pitch} | {
            "source_to_axis": scan.source_to_axis, "source_to_detector": scan.source_to_detector
        }  # fmt: skip
        raw["grid"], more = _draft_grid(beam, rows, columns)
        lines += more
    return _finish(raw, lines, len(scan.images))


# -- DICOM -----------------------------------------------------------------------------------------------------------------


def _draft_dicom(path: Path, given: dict[str, Any]) -> ScanDraft:
    scan = survey_dicom_views(path)
    stack = read_views(path)
    views, rows, columns = stack.shape
    lines = [
        f"found: DICOM, {scan.kind}: {_count(views, 'view')} of {rows} x {columns} pixels of {scan.pitch[0]:.6g} x "
        f"{scan.pitch[1]:.6g} mm (rows, columns)",
        f"found: {scan.source_to_axis:.6g} mm from source to axis, {scan.source_to_detector:.6g} mm to the detector",
        f"found: angles from {scan.angles[0]:.4g} to {scan.angles[-1]:.4g} degrees",
        *(f"assumed: {line}" for line in scan.assumed),
    ]
    reading, why = ({}, "") if _has_reading(given) else _guess_light(path, scan, stack)
    lines += [f"assumed: {why}: a pixel is taken as {reading['reading']}; data.reading sets it"] if reading else []
    distances = {"source_to_axis": scan.source_to_axis, "source_to_detector": scan.source_to_detector}
    beam: dict[str, Any] = {"beam": "cone"} | distances | {"pitch": scan.pitch}
    if any(scan.detector_offset):
        beam["detector_offset"] = scan.detector_offset
        lines.append("found: the detector's middle {:.6g} and {:.6g} mm beside the central ray".format(*scan.detector_offset))
    data = {"source": "stack", "file": str(path), "angles": str(path)} | reading
    raw = {"unit": "mm", "scan": beam, "data": data}
    return _finish(raw, [*lines, *_put_grid(raw, rows, columns)], views)


def _guess_light(path: Path, scan: DicomViews, stack: np.ndarray) -> tuple[dict[str, Any], str]:
    """Settings of the light of DICOM views (views, rows, columns), and the reason.

    Raises:
        MivolError: values that are neither light nor line integrals.
    """
    if scan.relation.upper() == "LOG" or scan.is_falling:
        if scan.relation.upper() == "LOG" and scan.is_falling:
            return {"reading": "line_integral"}, "the header calls the values falling logarithms of the light, up to a factor"
        found = f"PixelIntensityRelationship {scan.relation or 'empty'}" + ", falling with the light" * scan.is_falling
        expected = "values in proportion to the light (LIN), or falling logarithms of it (LOG, sign -1)"
        raise refusal(path, found, expected, "write the views as line integrals in TIFF, and the geometry as [scan]")
    return guess_light(path, stack)


def guess_light(path: Path, stack: np.ndarray) -> tuple[dict[str, Any], str]:
    """Guess the quantity of a pixel as :func:`guess_reading`; without air at the edges, the brightest reading is the light.

    Args:
        path: file, for errors.
        stack: views (views, rows, columns).

    Raises:
        MivolError: no reading above 0, or readings below 0.
    """
    with suppress(MivolError):
        return guess_reading(path, stack[len(stack) // 2])
    brightest = float(f"{stack.max():.6g}")
    if not brightest > 0 or stack.min() < 0:
        found = f"no air at the edges, and readings from {stack.min():g} to {brightest:g}"
        raise refusal(path, found, "light, at or above 0", "set data.reading if they are transmissions or line integrals")
    reason = f"no air at the edges: the brightest reading, {brightest:g}, is the light without object (data.light)"
    return {"reading": "intensity", "light": brightest}, reason


# -- Tilt series ---------------------------------------------------------------------------------------------------------


def _is_tilt_series(path: Path) -> bool:
    """Whether a file is MRC, with a file of tilt angles beside it."""
    if not path.is_file() or find_tilt_angles(path) is None:
        return False
    with path.open("rb") as file:
        return is_mrc(file.read(HEAD))


def _draft_tilt_series(path: Path, given: dict[str, Any]) -> ScanDraft:
    path, found = _one_file(path, _is_tilt_series)
    volume, table = read_volume(path), find_tilt_angles(path)
    assert table is not None
    angles, stack = read_tilt_angles(table), volume.values[..., 0]
    views, rows, columns = stack.shape
    if len(angles) != views:
        raise refusal(table, f"{len(angles)} angles", f"{views}, one for each image of {path.name}", "correct it")
    reading, why = ({}, "") if _has_reading(given) else guess_light(path, stack)
    data = {"source": "stack", "file": str(path), "angles": str(table), "find_axis": False, "air": 0} | reading
    lines = [
        *found,
        f"found: a tilt series in MRC: {_count(views, 'view')} of {rows} x {columns} pixels",
        f"found: angles from {angles[0]:.4g} to {angles[-1]:.4g} degrees in {table.name}",
        *([f"assumed: {why}: a pixel is taken as {reading['reading']}; data.reading sets it"] if reading else []),
        "assumed: a parallel beam, and a tilt axis along the columns of pixels (an aligned series)",
    ]
    scan: dict[str, Any] = {"beam": "parallel"}
    if volume.meta["unit"] == "A":
        scan["pitch"] = [float(f"{edge:.8g}") for edge in volume.spacing[1::-1]]
        lines.append(f"found: pixels of {scan['pitch'][0]:.6g} x {scan['pitch'][1]:.6g} angstrom (rows, columns)")
    lines.append("chosen: the axis is in the middle; data.find_axis = true looks for it, if the views cover half a turn")
    raw: dict[str, Any] = {"unit": "A"} if "pitch" in scan else {}
    raw |= {"scan": scan, "data": data}
    return _finish(raw, [*lines, *_put_grid(raw, rows, columns)], views)


# -- TIFF ------------------------------------------------------------------------------------------------------------------


def has_scan_files(folder: Path) -> bool:
    """Whether flats, darks, angles or a scanner's file lie beside the images of a folder: they tell a scan from slices.

    For a file of several pages, whether flats or darks of its size lie beside it.
    """
    if not folder.is_dir():
        return any(group.words & (FLAT_WORDS | DARK_WORDS) for group in _groups_beside(folder)[1:])
    if any(group.words & (FLAT_WORDS | DARK_WORDS) for group in group_images(folder, IMAGES)):
        return True
    for file in folder.iterdir():
        if file.suffix.lower() in SCANNER_FILES:
            return True
        if file.suffix.lower() in ANGLE_FILES:
            with suppress(MivolError):
                read_columns(file, 1)
                return True
    return False


def _draft_tiff(path: Path, given: dict[str, Any]) -> ScanDraft:
    folder = path if path.is_dir() else path.parent
    groups = group_images(folder, IMAGES) if path.is_dir() else _groups_beside(path)
    darks = [group for group in groups if group.words & DARK_WORDS]
    flats = [group for group in groups if group.words & FLAT_WORDS and group not in darks]
    views = groups[:1] if path.is_file() else [group for group in groups if group not in darks and group not in flats]
    if not views:
        names = ", ".join(group.name for group in groups[:4])
        raise refusal(path, f"images of flats and darks alone ({names})", "views", 'write a TOML file with source = "stack"')
    chosen = {"views": views[0], "flats": _join_groups(flats), "darks": _join_groups(darks)}
    images = {role: read_images(group.files[:1]) for role, group in chosen.items() if group}
    counts = {role: len(group.files) * len(images[role]) if group else 0 for role, group in chosen.items()}
    rows, columns = images["views"].shape[1:]
    lines = [f"found: {chosen['views'].name}: {_count(counts['views'], 'view')} of {rows} x {columns} pixels"]
    lines += [f"found: {g.name}: {_count(counts[role], role[:-1])}" for role, g in chosen.items() if g and role != "views"]
    used = [file for group in chosen.values() if group for file in group.files]
    left = [group.name for group in groups if group.files[0] not in used]
    lines += [f"found: {', '.join(left)}: not used; data.file, data.flats and data.darks name others"] if left else []
    data: dict[str, Any] = {"source": "stack", "file": chosen["views"].pattern()}
    if flats:
        data |= {"reading": "intensity", "flats": chosen["flats"].pattern()}
        data |= {"darks": chosen["darks"].pattern()} if darks else {}
    elif not _has_reading(given):
        reading, why = guess_reading(path, images["views"][0])
        data |= reading
        lines.append(f"assumed: no flats, and {why}: the pixels are taken as {data['reading']}s; data.reading sets it")
    if missing := missing_numbers(chosen["views"].files):
        lines.append(
            f"found: no view with the number {', '.join(map(str, missing))}: if views were lost there, the others are not "
            "spread evenly, and data.angles has to name a file of their angles"
        )
    lines.append(FIRST_ROW)
    data["first_row"] = "highest"
    scan: dict[str, Any] = {"beam": "parallel"}
    three = _three_views(
        chosen["views"].files, *(images[role].mean(0) if role in images else None for role in ("flats", "darks"))
    )
    lines += _draft_angles(folder, scan, data, counts["views"], three)
    lines += _draft_beam(scan, None, (None, None), (rows, columns))
    if unread := sorted(file.name for file in folder.iterdir() if file.suffix.lower() in SCANNER_FILES):
        lines.append(
            f'found: {", ".join(unread)}: not read; if distances are in it, set scan.beam = "cone", scan.source_to_axis, '
            "scan.source_to_detector, scan.pitch and scan.arc"
        )
    raw = {"scan": scan, "data": data}
    return _finish(raw, [*lines, *_put_grid(raw, rows, columns)], counts["views"])


def missing_numbers(files: list[Path]) -> list[int]:
    """Numbers between those in the names of files, whose last number counts by ones; empty if a tenth or more is missing."""
    numbers = {int(found[-1]) for file in files if (found := re.findall(r"\d+", file.stem))}
    if len(numbers) < len(files):
        return []
    missing = sorted(set(range(min(numbers), max(numbers) + 1)) - numbers) if numbers else []
    return missing if 10 * len(missing) < len(files) else []


def _groups_beside(path: Path) -> list[ImageGroup]:
    """A file of views, and the groups of equally large images in its folder: its flats and darks may be among them."""
    others = [group for group in group_images(path.parent, IMAGES) if group.files[0].parent == path.parent]
    size, found = stack_shape(path)[1:], [ImageGroup(path.name, [path])]
    for group in others:
        with suppress(MivolError):
            found += [group] if path not in group.files and stack_shape(group.files[0])[1:] == size else []
    return found


def _join_groups(groups: list[ImageGroup]) -> ImageGroup | None:
    """Flats before and after the scan as one group, if their images are equally large and one pattern finds them; else the
    largest group; None without groups.
    """
    if not groups:
        return None
    size = stack_shape(groups[0].files[0])
    alike = [group for group in groups if stack_shape(group.files[0]) == size]
    files = sorted((file for group in alike for file in group.files), key=natural_order)
    joined = ImageGroup(", ".join(group.name for group in alike), files)
    with suppress(MivolError):
        joined.pattern()
        return joined
    return groups[0]


def _has_reading(given: dict[str, Any]) -> bool:
    """Whether the changes say what a pixel means."""
    return "reading" in given.get("data", {})


def _draft_angles(folder: Path, scan: dict[str, Any], data: dict[str, Any], views: int, three: np.ndarray) -> list[str]:
    """Put a file of angles, or an arc, into the settings; return lines."""
    others = []
    for file in sorted(folder.iterdir(), key=natural_order):
        if file.suffix.lower() not in ANGLE_FILES:
            continue
        try:
            angles = read_columns(file, 1)[:, 0]
        except MivolError:
            others.append(f"{file.name} is not one column of numbers")
            continue
        if len(angles) == views:
            unit = "radian" if half_turns_in_radians(angles) else "degree"
            data |= {"angles": str(file), "angle_unit": unit}
            return [f"found: {file.name}: angles from {angles[0]:.4g} to {angles[-1]:.4g}, taken as {unit}s by their arc"]
        others.append(f"{file.name} has {len(angles)}")
    if (motor := read_header_angles(data["file"])) and len(motor[1]) == views:
        name, angles = motor
        data |= {"angles": data["file"], "angle_unit": "radian" if half_turns_in_radians(angles) else "degree"}
        in_unit = f"from {angles[0]:.4g} to {angles[-1]:.4g}, taken as {data['angle_unit']}s"
        return [f"found: {name} in the headers: angles {in_unit}; a file of angles as data.angles replaces them"]
    arc, why = guess_arc(three)
    scan["arc"] = arc
    told = f" ({', '.join(others)})" if others else ""
    lead = f"assumed: no file with {views} angles{told}: views evenly over {arc:g} degrees, because"
    return [f"{lead} {why}; scan.arc sets it"]


def guess_reading(path: Path, view: np.ndarray) -> tuple[dict[str, Any], str]:
    """Guess the quantity of a pixel from the air at both edges of a view (rows, columns): near 1, near 0, or equally bright.

    Returns:
        Settings of the data, and the reason.

    Raises:
        MivolError: neither.
    """
    width = max(1, view.shape[1] // 20)
    left, right = (float(np.median(edge)) for edge in (view[:, :width], view[:, -width:]))
    air = float(np.median(np.concatenate([view[:, :width], view[:, -width:]], axis=1)))
    middle = float(np.median(view[:, view.shape[1] // 3 : -(view.shape[1] // 3) or None]))
    if 0.7 < air < 1.3 and middle < air:
        return {"reading": "transmission"}, f"the edges have a median of {air:.3g}"
    if abs(air) < 0.1 * middle:
        return {"reading": "line_integral"}, f"the edges have a median of {air:.3g}, the middle of {middle:.3g}"
    if 0 < middle < DARKER * min(left, right) and max(left, right) < min(left, right) / DARKER and width > 1:
        air_is_light = (
            f"the edges ({left:.4g} and {right:.4g}) are brighter than the middle ({middle:.4g}), so {width} columns "
        )
        return {"reading": "transmission", "air": width}, air_is_light + "at each edge are taken for air (data.air)"
    raise refusal(
        path,
        f"no flats, and edges with a median of {air:.4g}",
        "flats (light without sample), transmissions near 1 or line integrals near 0 at the edges, or edges that are equally "
        "bright, and brighter than the middle",
        "put flats beside the views, with flat in their names, or set data.reading, and data.light for an intensity",
    )


def guess_arc(views: np.ndarray) -> tuple[float, str]:
    """Guess the arc [degree] by three views (first, middle and last; rows; columns), corrected by flats.

    After a turn the last view resembles the first, and the middle one the first's mirror image. After half a turn the last view
    resembles the mirror image. Mirror images are compared at their best shift along the columns. Slopes are compared, of views
    smoothed by a 100th of the detector: noise dominates the slopes of single rows.
    """
    from scipy.ndimage import gaussian_filter1d

    slopes = np.gradient(gaussian_filter1d(views, views.shape[-1] / 100, axis=-1), axis=-1)
    first, middle, last = slopes
    mirrored = -first[:, ::-1]
    turn = min(_correlation(first, last)[0], _correlation(mirrored, middle).max())
    half = _correlation(mirrored, last).max()
    if turn > half:
        return 360.0, f"the last view resembles the first (correlation {turn:.2f}; mirrored {half:.2f})"
    return 180.0, f"the last view resembles the mirror image of the first (correlation {half:.2f}; a whole turn {turn:.2f})"


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation of two images (rows, columns) by their shift along the columns."""
    size = 2 * a.shape[1]
    product = np.fft.irfft((np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))).sum(0), size)
    return product / (np.linalg.norm(a) * np.linalg.norm(b) or 1.0)


def _three_views(files: list[Path], flat: np.ndarray | None, dark: np.ndarray | None) -> np.ndarray:
    """The first, the middle and the last view, divided by a flat if there is one."""
    pages = [read_images([files[0]])] if len(files) == 1 else [read_images([file]) for file in (files[0], files[-1])]
    if len(files) == 1:
        three = pages[0][[0, len(pages[0]) // 2, -1]]
    else:
        found = [pages[0][0], read_images([files[len(files) // 2]])[0], pages[-1][-1]]
        if len({view.shape for view in found}) > 1:
            sizes = ", ".join("{} x {}".format(*view.shape) for view in found)
            raise refusal(files[0].parent, f"views of {sizes} pixels (first, middle, last)", "one size", "remove other images")
        three = np.stack(found)
    if flat is None:
        return three
    dark = np.zeros_like(flat) if dark is None else dark
    if not three.shape[1:] == flat.shape == dark.shape:
        sizes = ", ".join("{} x {}".format(*part.shape) for part in (three[0], flat, dark))
        raise refusal(files[0].parent, f"views, flats and darks of {sizes} pixels", "one size", "remove other images")
    return (three - dark) / np.maximum(flat - dark, 1e-6 * flat.max())


# -- Sinogram ------------------------------------------------------------------------------------------------------------


def _count_images(path: Path) -> int:
    """Images in a file of a format of detectors; 0 for other files."""
    if not path.is_file() or path.suffix.lower() not in IMAGES:
        return 0
    with suppress(MivolError):
        return stack_shape(path)[0]
    return 0


def _draft_sinogram(path: Path, given: dict[str, Any]) -> ScanDraft:
    image = read_images([path])[0]
    views, columns = image.shape
    data: dict[str, Any] = {"source": "stack", "file": str(path), "images": "sinograms"}
    reading, why = ({}, "") if _has_reading(given) else guess_reading(path, image)
    data |= reading
    lines = [
        f"found: a single image of {views} x {columns} pixels",
        f"assumed: a sinogram, {_count(views, 'view')} of {columns} columns; turn the image if its columns are views",
    ]
    if reading:
        lines.append(f"assumed: no flats, and {why}: the pixels are taken as {data['reading']}s; data.reading sets it")
    scan: dict[str, Any] = {"beam": "parallel"}
    lines += _draft_angles(path.parent, scan, data, views, image[[0, views // 2, -1], None])
    lines += _draft_beam(scan, None, (None, None), (1, columns))
    raw = {"scan": scan, "data": data}
    return _finish(raw, [*lines, *_put_grid(raw, 1, columns)], views)


def _or_in_folder(recognise: Callable[[Path], bool]) -> Callable[[Path], bool]:
    """The test of a file, which a folder passes by a file in it."""
    return lambda path: any(map(recognise, path.iterdir())) if path.is_dir() else recognise(path)


HDF5, TIFF_FOLDER, SINOGRAM = "hdf5", "tiff", "sinogram"
SCAN_KINDS: dict[str, tuple[Callable[[Path], bool], Callable[[Path, dict[str, Any]], ScanDraft]]] = {
    "nikon": (_or_in_folder(_is_nikon), _draft_nikon),
    "dicom": (has_views, _draft_dicom),
    HDF5: (_or_in_folder(is_scan), _draft_hdf5),
    "mrc": (_or_in_folder(_is_tilt_series), _draft_tilt_series),
    TIFF_FOLDER: (lambda path: bool(group_images(path, IMAGES)) if path.is_dir() else _count_images(path) > 1, _draft_tiff),
    SINOGRAM: (lambda path: _count_images(path) == 1, _draft_sinogram),
}
"""Recognition and draft of each kind of scan, in this order."""
