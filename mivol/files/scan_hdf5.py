"""The projections of a scan in an HDF5 file: NXtomo, Data Exchange, or datasets by name.

Layouts. *NXtomo* (NeXus, GDA): flats, darks and views are frames of one dataset, told apart by ``image_key`` (0: a view, 1: a
flat, 2: a dark, 3: invalid). *Data Exchange*: datasets ``data``, ``data_white``, ``data_dark`` and ``theta`` of one group.
*Named*: any datasets. A layout is found by the contents of the file, not by its suffix.

Conventions. Projections are counts (views, rows, columns). Flat fields (beam without sample) and dark fields (no beam) are
stacks of the same rows and columns. Angles are in degrees unless their ``units`` say radians; angles are returned in radians,
lengths in mm.

References: De Carlo et al. 2014, "Scientific data exchange: a schema for HDF5-based storage of raw and analyzed data"; NeXus
International Advisory Committee, application definition NXtomo.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.files.hdf5 import (
    broken_links,
    check_storage,
    find_item,
    has_link,
    is_group,
    is_hdf5,
    list_grids,
    open_hdf5,
    read_name,
    to_text,
)
from mivol.files.source import check_file, refusal
from mivol.machine import check_memory

#: units of theta -> factor to radians.
ANGLES: dict[str, float] = {
    "degrees": np.pi / 180,
    "degree": np.pi / 180,
    "deg": np.pi / 180,
    "\u00b0": np.pi / 180,
    "radians": 1.0,
    "radian": 1.0,
    "rad": 1.0,
}

#: units of a length -> factor to mm.
LENGTHS: dict[str, float] = {
    f"{prefix}{name}": factor
    for factor, letters, prefix in (
        (1e3, ("m",), ""),
        (10.0, ("cm",), "centi"),
        (1.0, ("mm",), "milli"),
        (1e-3, ("um", "\u00b5m", "\u03bcm", "micron", "microns"), "micro"),
        (1e-6, ("nm",), "nano"),
    )
    for prefix, names in (("", letters), (prefix, ("meter", "metre", "meters", "metres")))
    for name in names
}

VIEW, FLAT, DARK = 0, 1, 2
"""Values of ``image_key``."""

NO_DARKS = "no darks: a reading of 0 is taken as no light"

READING_BYTES = 36
"""Memory per reading of a scan [byte]: the reading in float32, and four numbers computed from it in float64."""


@with_short_repr
@dataclasses.dataclass(frozen=True)
class ProjectionData:
    """The counts of a tomographic scan.

    Attributes:
        projections: counts with sample, float32 (views, rows, columns).
        flats: counts of the beam without sample, float32 (n, rows, columns).
        darks: counts without beam, float32 (m, rows, columns).
        angles: rotation of the sample, float64 (views,) [rad]; None if the file has none.
        meta: ``path``, ``format``, ``group``, ``dtype`` and ``unit`` of the counts.
        notes: what was found beside the numbers, and what was assumed.
        pitch: distance of pixel centres along (rows, columns) [mm]; None if the file does not tell.
        distances: from source to sample and from sample to detector [mm]; None for each that the file does not tell.
    """

    projections: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    angles: np.ndarray | None
    meta: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pitch: tuple[float, float] | None = None
    distances: tuple[float | None, float | None] = (None, None)


def read_projections(
    path: str | os.PathLike,
    group: str = "",
    names: Mapping[str, str] | None = None,
    angle_unit: str | None = None,
    rows: slice | None = None,
) -> ProjectionData:
    """Read the counts of a scan from an HDF5 file of any suffix.

    Args:
        path: HDF5 file.
        group: entry of NXtomo, or group of Data Exchange; "": the first entry of NXtomo, else ``exchange``.
        names: datasets by role: ``data``, ``flats``, ``darks``, ``angles``. A name replaces what the layout has; with a name of
            ``data``, all roles are read by name. ``other.h5:name`` is a dataset of another file, in the folder of this one.
        angle_unit: "degree" or "radian" in place of the file's; None: as the angles say, else as the covered arc says.
        rows: rows of the detector, upwards; None: all rows.

    Raises:
        MivolError: no HDF5 file, a missing h5py, dataset, link target or compression filter, inconsistent shapes, angles or
            counts that are not finite, or more readings than memory.
    """
    path = check_file(path)
    with open_hdf5(path) as file:
        scan = _find_scan(file, path, group, names or {})
        stacks = {role: _read_frames(path, role, frames, rows) for role, frames in scan.frames.items()}
        projections = stacks["data"]
        angles, notes = _read_angles(path, scan.angles, angle_unit)
        data = scan.frames["data"].dataset
        meta = {"path": str(path), "format": scan.format, "group": scan.group, "dtype": str(data.dtype)}
        meta["unit"] = to_text(data.attrs.get("units", ""))
    if not len(stacks.get("flats", ())):
        raise refusal(path, "no flat (light without sample)", "at least one", "name a dataset: data.flats")
    if not len(stacks.get("darks", ())):
        notes += (NO_DARKS,)
        stacks["darks"] = np.zeros((1, *projections.shape[1:]), np.float32)
    _check_projections(path, stacks, {role: frames.name for role, frames in scan.frames.items()}, angles)
    _check_brightness(path, stacks, data.dtype)
    return ProjectionData(
        projections, stacks["flats"], stacks["darks"], angles, meta, (*scan.notes, *notes), scan.pitch, scan.distances
    )


class ScanFacts(NamedTuple):
    """What a scan's file tells without its readings: layout, numbers of frames (views, flats, darks), pixels (rows, columns).

    ``angles`` [rad], ``pitch`` and ``distances`` [mm], and ``notes`` are as in :class:`ProjectionData`.
    """

    layout: str
    frames: tuple[int, int, int]
    pixels: tuple[int, int]
    angles: np.ndarray | None
    pitch: tuple[float, float] | None
    distances: tuple[float | None, float | None]
    notes: tuple[str, ...]


def survey_projections(
    path: str | os.PathLike, group: str, names: Mapping[str, str] | None, angle_unit: str | None
) -> ScanFacts:
    """Find what a scan's file tells without its readings.

    Args, raises: as :func:`read_projections`.
    """
    path = check_file(path)
    with open_hdf5(path) as file:
        scan = _find_scan(file, path, group, names or {})
        angles, notes = _read_angles(path, scan.angles, angle_unit)
        counts = [_count(scan.frames.get(role)) for role in ("data", "flats", "darks")]
        layout = {"nxtomo": f"NXtomo, entry {scan.group}", "data-exchange": f"Data Exchange, group {scan.group}"}
        return ScanFacts(
            layout.get(scan.format, "datasets by name"),
            (counts[0], counts[1], counts[2]),
            scan.frames["data"].dataset.shape[-2:],
            angles,
            scan.pitch,
            scan.distances,
            (*scan.notes, *notes),
        )


def _count(frames: Frames | None) -> int:
    if frames is None:
        return 0
    dataset, _, indices = frames
    return len(indices) if indices is not None else len(dataset) if dataset.ndim == 3 else 1


def is_scan(path: Path) -> bool:
    """Whether a file is HDF5 and has a layout of a scan, NXtomo or Data Exchange."""
    if not (path.is_file() and is_hdf5(path)):
        return False
    with open_hdf5(path) as file:
        return bool(_nxtomo_entries(file)) or "exchange/data" in file


# -- Layouts -----------------------------------------------------------------------------------------------------------------


class Frames(NamedTuple):
    """Frames of a dataset: its name, and the indices of the frames, or None for all."""

    dataset: Any
    name: str
    indices: np.ndarray | None = None


class _ThinDataset:
    """A dataset without its first axes of length 1, so that three axes remain."""

    def __init__(self, dataset: Any) -> None:
        extra = [axis for axis, size in enumerate(dataset.shape) if size == 1][: dataset.ndim - 3]
        self._dataset, self._extra = dataset, extra
        self.shape = tuple(size for axis, size in enumerate(dataset.shape) if axis not in extra)
        self.ndim = len(self.shape)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: slice | tuple[slice, ...]) -> Any:
        given = iter(index if isinstance(index, tuple) else (index,))
        axes = range(self._dataset.ndim)
        return self._dataset[tuple(0 if axis in self._extra else next(given, slice(None)) for axis in axes)]


def _thin(dataset: Any) -> Any:
    """Return a dataset of frames with at most three axes, if its others have the length 1."""
    return _ThinDataset(dataset) if dataset.ndim > 3 else dataset


@dataclasses.dataclass(frozen=True)
class _Scan:
    """The datasets of a scan. ``angles`` has the dataset and the indices of its views, or is None."""

    format: str
    group: str
    frames: dict[str, Frames]
    angles: Frames | None
    notes: tuple[str, ...] = ()
    pitch: tuple[float, float] | None = None
    distances: tuple[float | None, float | None] = (None, None)


def _find_scan(file: Any, path: Path, group: str, names: Mapping[str, str]) -> _Scan:
    """Find the layout, and replace the datasets that are named."""
    names = {role: name for role, name in names.items() if name}
    group, notes = group.strip("/"), ()
    if "data" in names:
        scan = _Scan("named", "", {}, None)
    else:
        entries = _nxtomo_entries(file)
        if not group and entries:
            group = entries[0]
            if len(entries) > 1:
                notes = (f"the file has {len(entries)} scans, {', '.join(entries)}: {group} is read, data.group names another",)
        if group in entries:
            scan = _nxtomo(file, path, group, names)
        elif group or "exchange" in file:
            scan = _exchange(file, path, group or "exchange", names)
        else:
            raise _no_layout(file, path)
    frames = scan.frames | {r: Frames(_thin(read_name(file, path, n)), n) for r, n in names.items() if r != "angles"}
    angles = Frames(read_name(file, path, names["angles"]), names["angles"]) if "angles" in names else scan.angles
    return dataclasses.replace(scan, frames=frames, angles=angles, notes=(*notes, *scan.notes))


def _no_layout(file: Any, path: Path) -> MivolError:
    broken = next((error for error in broken_links(file, path)), None)
    if broken is not None:
        return broken
    arrays = ", ".join(f"{name} {' x '.join(map(str, file[key].shape))}" for name, key in list_grids(file).items()) or "none"
    return refusal(
        path,
        f"neither an image_key (NXtomo) nor a group exchange (Data Exchange); arrays of 3 dimensions: {arrays}",
        "the projections of a scan",
        "name the datasets: data.data, data.flats, data.darks, data.angles, or data.group",
    )


def _exchange(file: Any, path: Path, group: str, names: Mapping[str, str]) -> _Scan:
    parts = {"data": "data", "flats": "data_white", "darks": "data_dark", "angles": "theta"}
    # Flats are needed, but their absence has a refusal of its own.
    found = {
        role: Frames(_thin(_dataset(file, path, group, part)), part)
        for role, part in parts.items()
        if role not in names and (role == "data" or has_link(file, f"{group}/{part}"))
    }
    angles = found.pop("angles", None)
    objective = file[OBJECTIVE] if is_group(file, OBJECTIVE) else None
    edge = _length(objective, "resolution", "um")
    notes = _describe_unit(objective, "resolution", "micrometres, as Data Exchange has them")
    return _Scan("data-exchange", group, found, angles, tuple(notes), edge and (edge, edge))


OBJECTIVE = "measurement/instrument/detection_system/objective"
"""Group of Data Exchange whose ``resolution`` is the edge of a pixel at the sample."""


def _nxtomo(file: Any, path: Path, entry: str, names: Mapping[str, str]) -> _Scan:
    key_name = _key_name(file[entry])
    assert key_name is not None
    holder = f"{entry}/{key_name.rpartition('/')[0]}"
    key = np.asarray(find_item(file, path, f"{entry}/{key_name}")).ravel()
    data_name = next((n for n in (f"{holder}/data", f"{entry}/data/data") if has_link(file, n)), f"{holder}/data")
    data = _thin(find_item(file, path, data_name))
    if data.ndim != 3 or len(key) != len(data):
        raise refusal(
            path,
            f"{len(key)} numbers of image_key for {data_name} of shape {data.shape}",
            "one for each frame (frames, rows, columns)",
            "correct image_key, or name the datasets: data.data, data.flats, data.darks, data.angles",
        )
    notes = []
    if has_link(file, f"{holder}/image_key_control"):
        control = np.asarray(find_item(file, path, f"{holder}/image_key_control")).ravel()
        # A frame of the alignment repeats an angle after the scan, when the sample may have moved.
        key = np.where(control == -1, 3, key) if len(control) == len(key) else key
    if skipped := int((~np.isin(key, (VIEW, FLAT, DARK))).sum()):
        notes.append(f"{skipped} of {len(key)} frames are called invalid or of the alignment: they are not used")
    frames = {
        role: Frames(data, data_name, np.flatnonzero(key == number))
        for role, number in (("data", VIEW), ("flats", FLAT), ("darks", DARK))
    }
    if not len(frames["data"].indices):
        raise refusal(path, f"no view (0) in {entry}/{key_name}", "at least one", "correct image_key")
    frames = {role: part for role, part in frames.items() if len(part.indices)}
    angles = None if "angles" in names else _nxtomo_angles(file, path, entry, holder, key)
    detector = file[holder] if "pixel_size" in " ".join(file[holder]) else _first_detector(file, entry)
    pitch = tuple(_length(detector, f"{axis}_pixel_size") for axis in "yx") if detector is not None else (None,)
    notes += _describe_unit(detector, "x_pixel_size")
    source = next((file[n] for n in (f"{entry}/instrument/source",) if n in file), None)
    distances = (_length(source, "distance"), _length(detector, "distance"))
    return _Scan(
        "nxtomo", entry, frames, angles, tuple(notes), None if None in pitch else pitch, tuple(d and abs(d) for d in distances)
    )


def _nxtomo_angles(file: Any, path: Path, entry: str, holder: str, key: np.ndarray) -> Frames | None:
    places = (f"{entry}/sample", f"{entry}/data", f"{entry}/sample/transformations", holder)
    name = next((f"{place}/rotation_angle" for place in places if has_link(file, f"{place}/rotation_angle")), None)
    name = name or _angles_by_name(file, entry, holder, len(key))
    if name is None:
        return None
    angles, views = find_item(file, path, name), np.flatnonzero(key == VIEW)
    if angles.size not in (len(key), len(views)):
        raise refusal(
            path, f"{angles.size} angles in {name}", f"{len(key)}, one for each frame, or {len(views)}, one for each view",
            "correct them, or name others: data.angles",
        )  # fmt: skip
    return Frames(angles, name, views if angles.size == len(key) else None)


ANGLE_WORDS = "theta", "rot", "angle"
"""Parts of the names of motors that turn a sample."""


def _angles_by_name(file: Any, entry: str, holder: str, frames: int) -> str | None:
    """Name of the dataset of angles, one per frame, beside a detector's frames and named after a motor; None if missing."""
    for group in (f"{entry}/{holder.rpartition('/')[2]}", holder):
        for child in sorted(map(to_text, file[group])) if is_group(file, group) else ():
            try:
                item = file[f"{group}/{child}"] if any(word in child.lower() for word in ANGLE_WORDS) else None
            except (KeyError, OSError):  # a link that misses its target
                continue
            if item is not None and getattr(item, "ndim", 0) == 1 and item.size == frames and item.dtype.kind == "f":
                return f"{group}/{child}"
    return None


def _nxtomo_entries(file: Any) -> list[str]:
    """Names of the groups with an ``image_key``, in a detector or in ``data``, down to two levels; the deeper ones last."""
    children = [name for name in map(to_text, file) if is_group(file, name)]
    below = [
        f"{name}/{to_text(child)}" for name in children for child in file[name] if is_group(file, f"{name}/{to_text(child)}")
    ]
    return [name for name in (*children, *below) if _key_name(file[name]) is not None]


def _key_name(entry: Any) -> str | None:
    """Name of ``image_key`` below an entry: of the first detector whose frames are there, else of the first detector."""
    holders = [f"instrument/{to_text(name)}" for name in entry["instrument"]] if is_group(entry, "instrument") else []
    holders += ["data"]
    holders = [h for h in holders if is_group(entry, h) and has_link(entry[h], "image_key")]
    chosen = next((h for h in holders if _has_frames(entry, h)), holders[0] if holders else None)
    return None if chosen is None else f"{chosen}/image_key"


def _has_frames(entry: Any, holder: str) -> bool:
    """Whether the frames of a detector can be read: a link may miss its target."""
    name = next((n for n in (f"{holder}/data", "data/data") if has_link(entry, n)), None)
    try:
        return name is not None and getattr(entry[name], "ndim", 0) >= 3
    except (KeyError, OSError):
        return False


def _first_detector(file: Any, entry: str) -> Any:
    instrument = file[entry]["instrument"] if is_group(file[entry], "instrument") else {}
    return next((instrument[n] for n in instrument if is_group(instrument, n) and "x_pixel_size" in instrument[n]), None)


def _length(holder: Any, name: str, usual: str = "m") -> float | None:
    """A length [mm], in the unit ``usual`` if it names none; None if absent, or of an unknown unit."""
    if holder is None or name not in holder:
        return None
    item = holder[name]
    factor = LENGTHS.get(to_text(item.attrs.get("units", usual)).strip().lower())
    value = np.asarray(item, np.float64).ravel() if factor and np.issubdtype(item.dtype, np.number) else np.empty(0)
    return float(value[0] * factor) if value.size and np.isfinite(value[0]) and value[0] else None


def _describe_unit(holder: Any, name: str, usual: str = "metres, as NeXus has them") -> list[str]:
    """What is assumed of a length without a unit, and that a length of an unknown unit is not read."""
    if holder is None or name not in holder:
        return []
    unit = to_text(holder[name].attrs.get("units", "")).strip()
    if unit and unit.lower() not in LENGTHS:
        return [f"{name} is in {unit!r}, which is no known unit of length: it is not read; scan.pitch sets it"]
    return [] if unit else [f"{name} has no unit and is taken as {usual}; scan.pitch sets it"]


def _dataset(file: Any, path: Path, group: str, name: str) -> Any:
    full = f"{group}/{name}"
    if not has_link(file, full):
        holder = file[group] if group in file and hasattr(file[group], "keys") else file
        present = ", ".join(sorted(map(to_text, holder.keys())))
        raise refusal(path, f"no dataset {full} (present: {present})", "the dataset", "name another group or add the dataset")
    return find_item(file, path, full)


# -- Numbers -----------------------------------------------------------------------------------------------------------------


def _read_frames(path: Path, role: str, frames: Frames, rows: slice | None) -> np.ndarray:
    """Read frames as float32 (n, rows, columns); one image counts as a stack of one."""
    dataset, name, indices = frames
    if dataset.ndim != 3 and not (dataset.ndim == 2 and role != "data"):
        raise refusal(f"{path}:{name}", f"an array of shape {dataset.shape}", "(frames, rows, columns)", "name another dataset")
    if dataset.dtype.kind not in "uifb":
        raise refusal(f"{path}:{name}", f"values of type {dataset.dtype}", "real numbers", "name another dataset")
    check_storage(path, dataset)
    height, width = dataset.shape[-2:]
    rows = rows or slice(0, height)
    first, end, step = rows.start, rows.stop, rows.step or 1
    if not 0 <= first < end <= height:
        raise refusal(
            path, f"data.rows = [{first}, {end}]", f"rows from 0 to {height}, the first before the last", "correct it"
        )
    if dataset.ndim == 2:
        return np.asarray(dataset[first:end:step], np.float32)[None]
    indices = np.arange(len(dataset)) if indices is None else indices
    count = len(range(first, end, step))
    size = len(indices) * count * width
    advice = f"give data.rows = [{height // 2}, {height // 2 + 4}] for a few of the {height} rows"
    check_memory(READING_BYTES * size, f"{path}: {role} of {len(indices)} x {count} x {width} pixels", advice)
    stack = np.empty((len(indices), count, width), np.float32)
    # Runs of neighbouring frames: a list of frames is read one by one.
    for run in np.split(np.arange(len(indices)), np.flatnonzero(np.diff(indices) != 1) + 1):
        if len(run):
            stack[run[0] : run[-1] + 1] = dataset[indices[run[0]] : indices[run[-1]] + 1, first:end:step]
    return stack


def _read_angles(path: Path, part: Frames | None, unit: str | None) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Angles [rad] and notes."""
    if part is None:
        return None, ()
    if part.dataset.dtype.kind not in "uif":
        raise refusal(f"{path}:{part.name}", f"values of type {part.dataset.dtype}", "angles", "name another dataset")
    angles = np.asarray(part.dataset, np.float64).ravel()
    angles = angles if part.indices is None else angles[part.indices]
    called = to_text(part.dataset.attrs.get("units", ""))
    said = (called or "degrees").strip().lower()
    if unit is None and said not in ANGLES:
        way_out = f"correct the attribute 'units' of {part.name}, or give data.angle_unit"
        raise refusal(path, f"{part.name} in {called!r}", "degrees or radians", way_out)
    if unit is not None:
        return angles * ANGLES[unit], ()
    other, unit_of = ("radian", 1.0) if ANGLES[said] != 1 else ("degree", np.pi / 180)
    if turns := half_turns_in_radians(angles * unit_of):
        own = "degree" if other == "radian" else "radian"
        return angles * unit_of, (
            f"the angles {'are called ' + called if called else 'have no unit'} and span {np.ptp(angles):.4f}, {turns} in "
            f'{other}s: they are taken as {other}s; data.angle_unit = "{own}" takes them as {own}s',
        )
    return angles * ANGLES[said], ()


def half_turns_in_radians(angles: np.ndarray) -> str:
    """Name of the arc, if at least 16 angles that are called degrees cover half a turn or a turn in radians; else "".

    The arc is that from the first to the last view, or a step more, to a hundredth.
    """
    if len(angles) < 16 or not np.isfinite(angles).all():
        return ""
    span = float(np.ptp(angles))
    arcs = np.array([span, span * len(angles) / (len(angles) - 1)])
    return next(
        (name for name, arc in (("half a turn", np.pi), ("a turn", 2 * np.pi)) if (abs(arcs / arc - 1) < 0.01).any()), ""
    )


def _check_projections(path: Path, stacks: dict[str, np.ndarray], names: dict[str, str], angles: np.ndarray | None) -> None:
    projections = stacks["data"]
    for role in ("flats", "darks"):
        stack, name = stacks[role], names.get(role, role)
        if stack.shape[1:] != projections.shape[1:]:
            raise refusal(
                path,
                f"{name} of {stack.shape[1]} x {stack.shape[2]} pixels",
                f"{projections.shape[1]} x {projections.shape[2]} as in data",
                "crop both to the same pixels",
            )
    if angles is not None and len(angles) != len(projections):
        raise refusal(path, f"{len(angles)} angles", f"{len(projections)}, one per view", "correct theta")
    for role, numbers in (("theta", angles), *stacks.items()):
        bad = ~np.isfinite(numbers) if numbers is not None else np.empty(0)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            found = f"{numbers[index]} in {names.get(role, role)} at {index}, counted from 0 among the {role}"
            way_out = "repair the angles" if role == "theta" else "replace it by 0: a reading of 0 has weight 0"
            raise refusal(path, found, "finite numbers", way_out)


def _check_brightness(path: Path, stacks: dict[str, np.ndarray], kind: np.dtype) -> None:
    """Refuse flats that are brighter than numbers of the views' type can be, such as sums of several flats."""
    brightest, most = float(stacks["flats"].max()), np.iinfo(kind).max if kind.kind in "ui" else np.inf
    if brightest > most * (1 + 1e-6):  # float32 rounds the largest numbers of 32 bits up
        found = f"flats of up to {brightest:.6g}, which are brighter than the detector of the views can be"
        raise refusal(path, found, f"at most {most} ({kind})", "divide a sum of flats by their number")
