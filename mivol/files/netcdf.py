"""Volumes of atmospheric models in NetCDF: a variable along x, y and z, placed by its coordinates.

NetCDF-4 is HDF5, read through h5py; the classic format and its 64-bit offsets are read by SciPy.

Conventions (CF). A dimension is an axis by the attribute ``axis`` or ``standard_name`` of its coordinate, or by its name; else
the last three dimensions are (z, y, x). Coordinates are the centres of voxels, in metres or in a unit that is converted to
metres; values per length, such as extinctions, become values per metre with them. A descending axis is turned around. Uneven
steps, as of stretched levels, become even steps of the smallest one: a new voxel is the mean of the overlapped voxels, so
integrals along the axis are kept. ``name[3]`` is entry 3 of the dimension before the axes.

References: NetCDF Climate and Forecast Metadata Conventions 1.11, chapters 4, 5 and 8; AT3D's ``load_from_netcdf`` (lwc, reff).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.files.hdf5 import MAGIC, check_storage, is_hdf5, open_hdf5, to_text
from mivol.files.npy import check_memory
from mivol.files.renderer_grids import UNEVEN, water_extinction
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, to_values

CLASSIC, OFFSETS, WIDE = b"CDF\x01", b"CDF\x02", b"CDF\x05"
"""First bytes of a classic file, a file with 64-bit offsets, and a file with 64-bit data."""

AXES = {
    "x": r"x|[xn]i|x[a-z]{1,2}|nx|i|west_east|lon|longitude|easting|projection_x_coordinate",
    "y": r"y|nj|y[a-z]{1,2}|ny|j|south_north|lat|latitude|northing|projection_y_coordinate",
    "z": r"z|nk|z[a-z]{1,2}|nz|k|bottom_top|lev|level|levels|height|altitude|alt|depth",
    "t": r"t|time|times|nt|record",
}
"""axis -> names of its dimension or values of ``standard_name``; a name may go on after "_"."""

METRES = {"m": 1.0, "meter": 1.0, "metre": 1.0, "km": 1e3, "kilometer": 1e3, "kilometre": 1e3, "cm": 1e-2, "mm": 1e-3}

PER_LENGTH = re.compile(r"(?:1 ?)?/ ?([A-Za-z]+)|([A-Za-z]+) ?(?:\^|\*\*)? ?\{?-1\}?")
"""Units of extinctions: 1/km, km-1, km^-1, km**-1."""

MOST_STEPS = 1 << 14
"""Most even steps along an axis: a damaged coordinate asks for any number."""

WATER = ("lwc", "reff")
"""Liquid water content [g/m^3] and effective radius [um] in files of AT3D: with both, ``extinction`` is an array too."""


@dataclass(frozen=True)
class Variable:
    """A variable of a file.

    Attributes:
        dims: names of its dimensions.
        shape: its lengths.
        attributes: texts and numbers.
        read: reads the entries of an index.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    attributes: Mapping[str, Any]
    read: Callable[[tuple[Any, ...]], np.ndarray]

    def values(self, index: tuple[Any, ...] = ()) -> np.ndarray:
        """Numbers in float64 where the file packs them (``scale_factor``, ``add_offset``); missing ones are NaN."""
        stored = np.asarray(self.read(index))
        stored = stored.astype(stored.dtype.newbyteorder("="))
        missing = [self.attributes[key] for key in ("_FillValue", "missing_value") if key in self.attributes]
        packing = [float(np.ravel(self.attributes.get(key, (d,)))[0]) for key, d in (("scale_factor", 1), ("add_offset", 0))]
        if packing == [1.0, 0.0] and not any(np.isin(stored, value).any() for value in missing):
            return stored
        numbers = np.where(np.logical_or.reduce([np.isin(stored, value) for value in missing] or [False]), np.nan, stored)
        return numbers * packing[0] + packing[1]


def is_netcdf(head: bytes) -> bool:
    """Whether a file begins as a kind of NetCDF does; NetCDF-4 begins as HDF5."""
    return head.startswith((CLASSIC, OFFSETS, WIDE, MAGIC))


def read_netcdf(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a variable along x, y and z.

    Args:
        path: file.
        dataset: name of the variable, by default the only one; ``name[3]`` is entry 3 of a dimension before the axes, counted
            from 0, and ``name[1,3]`` of two dimensions.

    Raises:
        MivolError: a damaged file, several variables or times without a choice, coordinates that are no lengths, or numbers
            that are not real.
    """
    with open_variables(path) as variables:
        name, index = _split_name(dataset)
        grids = {key: held for key, held in variables.items() if len(held.dims) > 2}
        has_water = all(key in grids for key in WATER) and grids["lwc"].dims == grids["reff"].dims
        names = [*grids, *(["extinction"] if has_water and "extinction" not in grids else [])]
        name = select_dataset(path, name, names)
        held = grids["lwc" if name not in grids else name]
        axes, notes = find_axes(held, variables)
        index = _choose_entry(path, name, held, axes, index)
        if name in grids:
            array = held.values(index)
        else:
            array = water_extinction(held.values(index), grids["reff"].values(index), path)
        place = [_read_coordinate(path, variables, held.dims[axes[axis]]) for axis in "zyx"]
    if array.dtype.kind not in "biuf":
        raise refusal(path, f"{name} with numbers of type {array.dtype}", "real numbers", "choose another array")
    stored, rest = str(array.dtype), sorted(axes.values())
    array = np.transpose(array, [rest.index(axes[axis]) for axis in "zyx"])
    array, to_world, notes = _place(path, array, place, notes, "km" if has_water else "m")
    per_metre = _find_per_metre(held) if name in grids and place[0] is not None else 1.0
    if per_metre != 1:
        array, notes = array * per_metre, [*notes, f"values in {held.attributes['units']} became values in 1/m."]
    meta = {
        "path": str(path), "format": "netcdf", "dtype": stored, "space": None, "dataset": dataset or name,
        "unit": "m" if place[0] is not None else "voxel", "notes": tuple(notes),
    }  # fmt: skip
    return VolumeData(to_values(array, path), to_world, meta)


# -- Variables ---------------------------------------------------------------------------------------------------------------


@contextmanager
def open_variables(path: Path) -> Iterator[dict[str, Variable]]:
    """Open a file, and yield its variables by name.

    Raises:
        MivolError: no NetCDF, or a damaged file.
    """
    if is_hdf5(path):
        with open_hdf5(path) as file:
            yield dict(_list_hdf5(path, file))
        return
    with path.open("rb") as file:
        if file.read(4) == WIDE:
            way_out = "write it as NetCDF-4: nccopy -k nc4 in.nc out.nc"
            raise refusal(path, "NetCDF with 64-bit data (CDF-5)", "NetCDF-4 or the classic format", way_out)
    from scipy.io import netcdf_file

    try:
        with warnings.catch_warnings():
            # SciPy warns if a file is closed while an error still holds an array of it.
            warnings.filterwarnings("ignore", "Cannot close a netcdf_file", RuntimeWarning)
            with netcdf_file(path, mmap=True) as file:
                variables = {key: _from_scipy(held) for key, held in file.variables.items()}
                yield variables
                variables.clear()
    except (MivolError, MemoryError):
        raise
    except Exception as error:  # SciPy's parser raises errors of many classes for foreign bytes
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise refusal(path, f"a damaged NetCDF file ({reason})", "a whole file", "write or copy it again") from error


def _from_scipy(held: Any) -> Variable:
    attributes = {key: to_text(value) if isinstance(value, bytes) else value for key, value in held._attributes.items()}
    return Variable(tuple(held.dimensions), tuple(map(int, held.shape)), attributes, lambda index: np.array(held.data[index]))


def _list_hdf5(path: Path, file: Any) -> Iterator[tuple[str, Variable]]:
    """Yield the variables of NetCDF-4; a dimension without a coordinate is no variable."""
    found: list[tuple[str, Any]] = []
    file.visititems(lambda name, item: found.append((to_text(name), item)) if hasattr(item, "shape") else None)
    for name, item in found:
        attributes = {key: _plain(item.attrs[key]) for key in item.attrs if key not in ("DIMENSION_LIST", "REFERENCE_LIST")}
        if str(attributes.get("NAME", "")).startswith("This is a netCDF dimension but not a netCDF variable"):
            continue

        def read(index: tuple[Any, ...], item: Any = item) -> np.ndarray:
            check_storage(path, item)
            return np.asarray(item[index])

        yield name, Variable(tuple(_name_dims(name, item)), tuple(item.shape), attributes, read)


def _plain(value: Any) -> Any:
    """An attribute as text or number."""
    value = value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return to_text(value) if isinstance(value, bytes | str) else value


def _name_dims(name: str, item: Any) -> Iterator[str]:
    """The names of an array's dimensions; a scale without others is its own."""
    for number, dim in enumerate(item.dims):
        if len(dim):
            yield to_text(dim[0].name).rpartition("/")[2]
        else:
            yield name.rpartition("/")[2] if item.is_scale and item.ndim == 1 else dim.label or f"dimension {number}"


# -- Axes and places ---------------------------------------------------------------------------------------------------------


def find_axes(held: Variable, variables: Mapping[str, Variable]) -> tuple[dict[str, int], list[str]]:
    """Find the dimensions along x, y and z.

    Returns:
        The number of the dimension by axis, and what was assumed.
    """
    named: dict[str, list[int]] = {}
    for number, dim in enumerate(held.dims):
        named.setdefault(_name_axis(dim, variables.get(dim)), []).append(number)
    if all(len(named.get(axis, ())) == 1 for axis in "xyz"):
        return {axis: named[axis][0] for axis in "xyz"}, []
    last = len(held.dims)
    dims = ", ".join(held.dims[-3:])
    return {"z": last - 3, "y": last - 2, "x": last - 1}, [f"the dimensions {dims} are z, y and x, by their order."]


def _name_axis(dim: str, coordinate: Variable | None) -> str:
    """One of x, y, z and t for a dimension; empty if unknown."""
    about = {} if coordinate is None else coordinate.attributes
    given = str(about.get("axis", "")).lower()
    if given in AXES:
        return given
    for text in (str(about.get("standard_name", "")), dim):
        for axis, names in AXES.items():
            if re.fullmatch(rf"({names})\d*(_.*)?", text.lower()):
                return axis
    return ""


def _split_name(dataset: str | None) -> tuple[str | None, tuple[int, ...]]:
    """Split ``name[1,3]`` into the name and the entries."""
    match = re.fullmatch(r"(.*)\[(\d+(?:\s*,\s*\d+)*)\]", dataset or "")
    return (match[1], tuple(map(int, match[2].split(",")))) if match else (dataset, ())


def _choose_entry(
    path: Path, name: str, held: Variable, axes: Mapping[str, int], index: tuple[int, ...]
) -> tuple[int | slice, ...]:
    """The index of a volume: an entry of each dimension that is no axis, all of an axis.

    Raises:
        MivolError: several entries and no choice, or a choice outside.
    """
    others = [number for number in range(len(held.dims)) if number not in axes.values()]
    many = [number for number in others if held.shape[number] != 1]
    many = others if len(index) == len(others) else many
    lengths = " and ".join(f"{held.shape[number]} entries along {held.dims[number]}" for number in many)
    last = ",".join(str(held.shape[number] - 1) for number in many)
    if len(index) != len(many):
        found = f"{name} with {lengths or 'one entry'}" + (f" and the choice {list(index)}" if index else "")
        way_out = f"name an entry: {name}[{last}] is the last" if many else f"name it without a choice: {name}"
        raise refusal(path, found, "one volume", way_out)
    chosen = dict.fromkeys(others, 0) | dict(zip(many, index, strict=True))
    if any(not 0 <= entry < held.shape[number] for number, entry in chosen.items()):
        raise refusal(path, f"no entry {list(index)} of {name} with {lengths}", f"up to {name}[{last}]", "count from 0")
    return tuple(chosen.get(number, slice(None)) for number in range(len(held.dims)))


def _read_coordinate(path: Path, variables: Mapping[str, Variable], dim: str) -> tuple[np.ndarray, bool] | None:
    """The coordinate of a dimension [m], and whether its file gives a unit; None without a coordinate.

    Raises:
        MivolError: degrees, pressures or other units that are no lengths, or numbers that do not rise or fall throughout.
    """
    held = variables.get(dim) or next((v for v in variables.values() if v.dims == (dim,) and _unit(v) in METRES), None)
    if held is None or held.dims != (dim,):
        return None
    unit = _unit(held)
    if unit and unit not in METRES:
        way_out = "interpolate the volume to a grid in metres first, or remove the coordinates to read it on voxels of size 1"
        raise refusal(path, f"the coordinate {dim} in {held.attributes['units']}", "a length (m, km)", way_out)
    down = str(held.attributes.get("positive", "")).lower() == "down"
    centres = np.asarray(held.values(), np.float64) * METRES.get(unit, 1.0) * (-1 if down else 1)
    steps = np.diff(centres)
    if not np.isfinite(centres).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise refusal(path, f"a coordinate {dim} that does not rise or fall throughout", "ordered centres", "correct the file")
    return centres, bool(unit)


def _unit(held: Variable) -> str:
    """The unit of a variable, in the singular."""
    unit = str(held.attributes.get("units", "")).strip().lower()
    return unit[:-1] if unit.endswith("s") and unit[:-1] in METRES else unit


def _find_per_metre(held: Variable) -> float:
    """The factor that makes values per metre of values per another length; 1 for values of another kind."""
    found = PER_LENGTH.fullmatch(str(held.attributes.get("units", "")).strip())
    unit = (found[1] or found[2]) if found else ""
    # Mm is a megametre, as in extinctions of aerosols; its small letters would be a millimetre.
    return 1e-6 if unit == "Mm" else 1 / METRES.get(unit.lower(), 1.0)


def _place(
    path: Path, array: np.ndarray, place: Sequence[tuple[np.ndarray, bool] | None], notes: list[str], unit: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Put an array (Z, Y, X) on even steps: its values, its placement, and what was assumed.

    Coordinates without a unit are in ``unit``, which is km in files of AT3D.

    Raises:
        MivolError: a coordinate for some axes only, or even steps beyond the memory.
    """
    found = [held is not None for held in place]
    if not any(found):
        size = array.shape[::-1]
        notes = [*notes, "the axes have no coordinates: a voxel counts as 1."]
        return array, frame_from_steps(size, np.eye(3), (0.5, 0.5, 0.5)), notes
    if not all(found):
        without = " and ".join(axis for axis, has in zip("zyx", found, strict=True) if not has)
        raise refusal(path, f"no coordinate along {without}", "a coordinate of each axis, or none", "add it to the file")
    if not all(has_unit for _, has_unit in place):
        notes = [*notes, f"coordinates without a unit are in {unit}."]
        place = [(centres * (1.0 if has_unit else METRES[unit]), has_unit) for centres, has_unit in place]
    spacing, origin = [0.0] * 3, [0.0] * 3
    for number, (centres, _) in enumerate(place):
        if len(centres) > 1 and centres[1] < centres[0]:
            array, centres = np.flip(array, number), centres[::-1]
        steps = np.diff(centres)
        step = float(steps.mean()) if len(steps) else 0.0
        if len(steps) and np.ptp(steps) > UNEVEN * step:
            array, centres = make_even(path, array, centres, number)
            step = float(centres[1] - centres[0])
            axis = "zyx"[number]
            notes = [*notes, f"uneven steps along {axis} became {len(centres)} even ones of {step:.4g} m, integrals kept."]
        spacing[2 - number], origin[2 - number] = step, float(centres[0])
    # A single voxel along an axis is as long as the smallest step.
    known = [step for step in spacing if step] or [1.0]
    spacing = [step or min(known) for step in spacing]
    return array, frame_from_steps(array.shape[::-1], np.diag(spacing), origin), notes


def make_even(path: Path, array: np.ndarray, centres: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Average an array over even cells of the smallest step along one axis.

    A voxel reaches to the middle between its centre and the next. A new value is the mean of the voxels that the new cell
    overlaps, weighted by the overlap, so the integral along the axis is kept.

    Args:
        path: subject of a refusal.
        array: values.
        centres: rising centres along the axis.
        number: the axis of the array.

    Returns:
        The values and the new centres.

    Raises:
        MivolError: more than :data:`MOST_STEPS` of the smallest step, or more memory than is free.
    """
    middle = (centres[1:] + centres[:-1]) / 2
    edges = np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])
    wanted = (edges[-1] - edges[0]) / np.diff(edges).min()
    if wanted > MOST_STEPS:
        found = f"steps of {np.diff(centres).min():.3g} to {np.diff(centres).max():.3g} m"
        raise refusal(path, found, f"an axis of at most {MOST_STEPS} of its smallest steps", "resample it to even steps first")
    count = max(round(wanted), 1)
    check_memory(path, 3 * 8 * array.size // len(centres) * count)
    even = np.linspace(edges[0], edges[-1], count + 1)
    low, high = np.maximum(even[:-1, None], edges[:-1]), np.minimum(even[1:, None], edges[1:])
    from scipy.sparse import csr_array

    # A missing value spreads to the cells that overlap its voxel only, since the zeros of a sparse matrix multiply nothing.
    shares = csr_array(np.maximum(high - low, 0) / (even[1] - even[0]))
    columns = np.moveaxis(np.asarray(array, np.float64), number, 0)
    values = (shares @ columns.reshape(len(centres), -1)).reshape(count, *columns.shape[1:])
    return np.moveaxis(values, 0, number), (even[1:] + even[:-1]) / 2
