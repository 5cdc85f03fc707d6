"""Radiance fields in NumPy archives (``.npz``): mivol's own format and the checkpoints of svox2, the program of Plenoxels.

Conventions of svox2. Grid axes are X Y Z. ``links`` hold the row of each node; -1 marks an empty node. Coefficients lie
[rgb][basis] in half floats. ``center`` and ``radius`` are the middle and the half edges of the box. svox2 shows
``max(0, 1/2 + sum)`` and ``max(0, density)`` after interpolation, in an axis-aligned box.

Source: Fridovich-Keil, Yu et al. 2022; the names of the arrays are read from svox2's own files.
"""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField
from mivol.fields.sampled_field import Region, SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_whole
from mivol.files.npy import check_arrays, check_memory, read_archive
from mivol.files.source import refusal
from mivol.photos.camera_path import HomeView

FORMAT = "mivol spherical grid 2"

HALF_MAX = float(np.finfo(np.float16).max)

HALF_MIN = 2.0**-12
"""Arrays whose largest value is smaller stay float32: the step of a half float, 2^-24, would exceed 2^-12 of that value."""

SVOX2_SH = 1
"""svox2's number for a basis of spherical harmonics."""

MAX_NODES = 2**32 - 1
"""Node numbers have 32 bits."""

ARRAY_KINDS = {
    "res": ("iu", (3,)), "to_world": ("f", (4, 4)), "density": ("f", None), "sh": ("f", None), "nodes": ("iu", None),
    "activation": ("U", ()), "offset": ("fiu", ()), "clamp": ("biu", ()), "levels": ("iu", ()),
    "space": ("U", ()),
}  # fmt: skip
"""Array -> allowed kinds of NumPy types, and its shape where the shape is fixed."""

SVOX2_KINDS = {"links": "iu", "density_data": "f", "sh_data": "f", "radius": "fiu", "center": "fiu", "basis_type": "iu"}


# -- The format of mivol -----------------------------------------------------------------------------------------------


def write_archive(path: Path, field: SphericalGrid, half: bool = True, view: HomeView | None = None) -> None:
    """Write a field in mivol's own format.

    Args:
        path: destination.
        field: radiance field, nested or not.
        half: store half floats (11 bits). Arrays with a value above 65504, or with all values below 2^-12, stay float32.
        view: first view of the field, optional.

    Raises:
        MivolError: the disk refuses the file.
    """
    density, sh = field.values()
    arrays = {"density": _to_half(density, half), "sh": _to_half(sh, half)}
    arrays |= {"res": np.array(field.res), "to_world": field.to_world}
    if field.nodes is not None:
        arrays["nodes"] = np.array(field.nodes)
    if view is not None:
        arrays[VIEW] = np.array(view.numbers)
    arrays["format"] = np.array(FORMAT)
    arrays |= {name: np.array(getattr(field, name)) for name in ("activation", "offset", "clamp", "levels", "space")}
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


SAMPLED_FIELDS: dict[str, type[SampledField]] = {field.kind: field for field in (HashField, NerfField)}
"""Fields that are known at points, by the word of their files and of ``field.kind``."""

SAMPLED_KINDS = {
    "kind": ("U", ()), "to_world": ("f", (4, 4)), "space": ("U", ()), "white": ("f", ()), "res": ("iu", (3,)),
    "occupied": ("u", None), "region_to_world": ("f", (4, 4)), "step": ("f", ()),
}  # fmt: skip
"""Arrays of such a field of any kind -> allowed kinds of NumPy types, and the shape where it is fixed."""


def write_sampled_archive(path: Path, field: SampledField, half: bool, view: HomeView | None) -> None:
    """Write a fitted field that is known at points in mivol's own format.

    Args:
        path: destination.
        field: hash grid or NeRF, with a region.
        half: store features in half floats (11 bits), under the conditions of :func:`write_archive`; weights stay float32.
        view: first view of the field, optional.

    Raises:
        MivolError: a field without a region, or a disk that refuses the file.
    """
    region = field.region
    if region is None:
        raise MivolError(f"{path.name}: found a {field.noun} without occupied cells, expected one of a fit: give it a region.")
    arrays = {name: np.array(value) for name, value in field.parameters().items()}
    arrays |= {name: _to_half(arrays[name], half) for name in field.features}
    arrays |= {"kind": np.array(field.kind), "format": np.array(f"mivol {field.noun} 1")} | field.arrays()
    arrays |= {"to_world": field.to_world, "space": np.array(field.space), "white": np.array(field.white)}
    arrays |= {"res": np.array(region.res), "region_to_world": region.to_world, "step": np.array(region.step)}
    arrays["occupied"] = np.packbits(np.array(region.occupied) > 0)
    if view is not None:
        arrays[VIEW] = np.array(view.numbers)
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def is_sampled_archive(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an archive are a field that is known at points."""
    formats = [f"mivol {field.noun} 1" for field in SAMPLED_FIELDS.values()]
    return "kind" in arrays or str(arrays.get("format", "")) in formats


def parse_sampled_archive(name: str, arrays: dict[str, np.ndarray]) -> SampledField:
    """Make a field that is known at points from the arrays of mivol's own format.

    Args:
        name: file name, for error messages.
        arrays: contents of the archive.

    Raises:
        MivolError: an unknown kind, a missing array, another type or shape, or values that are not finite.
    """
    kind = SAMPLED_FIELDS.get(word := str(arrays.get("kind", "nothing")))
    if kind is None:
        known = " or ".join(f'"{each}"' for each in SAMPLED_FIELDS)
        raise MivolError(f'{name} holds a field of the kind "{word}"; the kind {known} is expected.')
    expected = SAMPLED_KINDS | kind.own_arrays | dict.fromkeys(kind.parameter_names(), ("f", None))
    missing = expected.keys() - arrays.keys()
    if missing:
        raise MivolError(f"{name} lacks {', '.join(sorted(missing))}, which a field of mivol holds: write it again.")
    check_arrays(name, arrays, expected)
    res = tuple(int(n) for n in arrays["res"])
    cells = math.prod(n + 1 for n in res)
    if min(res) < 1 or arrays["occupied"].shape != (-(-cells // 8),) or not arrays["step"] > 0:
        found = f"{arrays['occupied'].shape} bytes of occupied cells at steps of {float(arrays['step']):g}"
        wanted = f"({-(-cells // 8)},) bytes and a step above 0 are expected"
        raise MivolError(f"{name} holds {found} for {cells} cells; {wanted}: write it again.")
    occupied = np.unpackbits(arrays["occupied"].astype(np.uint8))[:cells]
    region = Region(res, arrays["region_to_world"].astype(np.float64), mi.UInt8(occupied), float(arrays["step"]))
    numbers = [mi.Float(arrays[key].astype(np.float32).ravel()) for key in kind.parameter_names()]
    try:
        return kind.from_arrays(arrays, numbers, region)
    except MivolError as error:
        raise MivolError(f"{name}: {error}") from None


VIEW = "view"
"""Array with the numbers of the first view."""


def read_field_view(path: Path) -> HomeView | None:
    """Read the first view in a field's file; None without a view.

    Raises:
        MivolError: no archive of NumPy, or numbers of no camera.
    """
    arrays = read_archive(path, VIEW)
    return HomeView.from_numbers(arrays[VIEW], path) if VIEW in arrays else None


def _to_half(values: np.ndarray, half: bool) -> np.ndarray:
    largest = np.abs(values).max(initial=0.0)
    return values.astype(np.float16) if half and HALF_MIN <= largest <= HALF_MAX else values


def is_own_archive(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an archive are in mivol's own format."""
    return str(arrays.get("format", "")) == FORMAT


def parse_archive(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid:
    """Make a field from the arrays of mivol's own format.

    Args:
        name: file name, for error messages.
        arrays: contents of the archive.

    Raises:
        MivolError: a missing array, another type or shape, values that are not finite, nodes out of order, or a grid too large
            for the memory.
    """
    missing = {"density", "sh", "res", "to_world", "activation", "offset", "clamp", "levels", "space"} - arrays.keys()
    if missing:
        raise MivolError(f"{name} lacks {', '.join(sorted(missing))}, which a field of mivol holds: write it again.")
    check_arrays(name, arrays, ARRAY_KINDS)
    _check_node_count(name, arrays)
    res, levels = tuple(int(n) for n in arrays["res"]), int(arrays["levels"])
    nodes = arrays.get("nodes")
    n, shape = levels * math.prod(res) if nodes is None else len(nodes), arrays["sh"].shape
    if arrays["density"].shape != (n,) or len(shape) != 3 or shape[0] != n or shape[2] != 3:
        found = f"{arrays['density'].shape} densities and {shape} harmonics"
        raise MivolError(f"{name} holds {found} for {n} nodes; ({n},) and ({n}, basis, 3) are expected: write it again.")
    if nodes is not None:
        _check_nodes(name, nodes, levels * math.prod(res))
    return SphericalGrid.from_rows(
        res,
        arrays["to_world"],
        arrays["density"].astype(np.float32),
        arrays["sh"].astype(np.float32),
        None if nodes is None else mi.UInt32(nodes.astype(np.uint32)),
        activation=str(arrays["activation"]),
        offset=float(arrays["offset"]),
        clamp=bool(arrays["clamp"]),
        levels=levels,
        space=str(arrays["space"]),
    )


def _check_node_count(name: str, arrays: dict[str, np.ndarray]) -> None:
    sizes = [int(arrays["levels"]), *(int(n) for n in arrays["res"])]
    if min(sizes) < 1 or math.prod(sizes) > MAX_NODES:
        found = " x ".join(map(str, sizes[sizes[0] == 1 :]))
        raise MivolError(f"{name} has a grid of {found} nodes; 1 to {MAX_NODES} in all are expected.")
    check_memory(Path(name), 4 * math.prod(sizes))  # the index of rows has 4 bytes a node


def _check_nodes(name: str, nodes: np.ndarray, count: int) -> None:
    ordered = nodes.ndim == 1 and (len(nodes) < 2 or (np.diff(nodes.astype(np.int64)) > 0).all())
    if not ordered or (len(nodes) and not (int(nodes[0]) >= 0 and int(nodes[-1]) < count)):
        raise MivolError(
            f"{name} lists nodes out of order or beyond the {count} of its grid; ascending ones are expected: write it again."
        )


# -- Checkpoints of svox2 ----------------------------------------------------------------------------------------------


def write_svox2(path: Path, field: SphericalGrid) -> None:
    """Write a checkpoint of svox2; coefficients are rounded to half floats, as svox2 rounds them.

    Raises:
        MivolError: a field that svox2 would show differently (nested, turned, another activation, offset or clamp, linear
            radiance), coefficients above 65504, or a full disk.
    """
    if field.levels > 1:
        raise refusal(path, f"a field of {field.levels} nested levels", "one grid, as svox2 has", "write .npz or .xml")
    box = np.diagonal(field.to_world)[:3]
    if np.count_nonzero(field.to_world[:3, :3] - np.diag(box)) or box.min() <= 0:
        raise refusal(path, "a turned or mirrored field", "an axis-aligned box, as svox2 has", "write .npz")
    if field.space != "srgb":
        raise refusal(path, "colours of linear radiance", "code values, as svox2 shows them", "write .npz")
    if field.activation not in ("none", "relu") or field.offset != 0.5 or not field.clamp:
        found = f"activation {field.activation}, offset {field.offset:g}, clamp {field.clamp}"
        raise refusal(path, found, "relu, 0.5 and True, as svox2 shows fields", "write .npz")
    density, sh = field.values()
    if np.abs(sh).max(initial=0.0) > HALF_MAX:
        found = f"coefficients of up to {np.abs(sh).max():g}"
        raise refusal(path, found, f"at most {HALF_MAX:g}, a half float's", "write .npz")
    links = np.full(math.prod(field.res), -1, np.int32)
    links[field.stored_nodes()] = np.arange(len(density))
    arrays = {
        "radius": box / 2, "center": field.to_world[:3, 3] + box / 2, "basis_type": np.array(SVOX2_SH),
        "links": links.reshape(field.res).transpose(2, 1, 0), "density_data": density[:, None],
        "sh_data": sh.transpose(0, 2, 1).reshape(len(sh), -1).astype(np.float16),
    }  # fmt: skip
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def is_svox2(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an archive are a checkpoint of svox2."""
    return "links" in arrays


def parse_svox2(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid:
    """Make a field from the arrays of a checkpoint.

    Args:
        name: file name, for error messages.
        arrays: contents of the archive.

    Raises:
        MivolError: a missing array, another type or shape, values that are not finite, another basis, or a background.
    """
    missing = {"density_data", "sh_data", "radius", "center"} - arrays.keys()
    if missing:
        raise MivolError(
            f"{name} has links but lacks {', '.join(sorted(missing))}, which a checkpoint of svox2 holds: save it again."
        )
    _check_svox2_arrays(name, arrays)
    if int(arrays.get("basis_type", SVOX2_SH)) != SVOX2_SH:
        found = int(arrays["basis_type"])
        raise MivolError(
            f"{name} is of svox2's basis type {found}; only spherical harmonics (1) can be read: train with that basis."
        )
    if arrays.get("background_data", np.empty(0)).size:
        raise MivolError(f"{name} has a background of sphere layers, which mivol does not model; save it without one.")
    links, sh = arrays["links"].transpose(2, 1, 0), arrays["sh_data"].astype(np.float32)
    density = arrays["density_data"].astype(np.float32).reshape(-1)
    if sh.ndim != 2 or len(sh) != len(density) or sh.shape[1] % 3 or links.max(initial=-1) >= len(density):
        found = f"links {links.shape}, densities {density.shape} and harmonics {sh.shape}"
        raise MivolError(f"{name} holds {found} that do not fit together; a row for each link is expected: write it again.")
    nodes = np.flatnonzero(links >= 0)
    row = links.reshape(-1)[nodes]
    rows = sh[row].reshape(len(row), 3, -1).transpose(0, 2, 1)
    if nodes.size and (not np.isfinite(density[row]).all() or not np.isfinite(sh[row]).all()):
        raise MivolError(
            f"{name} holds densities or harmonics that are not finite; finite numbers are expected: write it again."
        )
    radius, center = (np.broadcast_to(np.asarray(arrays[k], np.float64).reshape(-1), 3) for k in ("radius", "center"))
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = np.diag(2 * radius), center - radius
    stored = mi.UInt32(nodes.astype(np.uint32))
    return SphericalGrid.from_rows(links.shape, to_world, density[row], np.ascontiguousarray(rows), stored)


def _check_svox2_arrays(name: str, arrays: dict[str, np.ndarray]) -> None:
    for key, kinds in SVOX2_KINDS.items():
        if key in arrays and arrays[key].dtype.kind not in kinds:
            raise MivolError(f"{name} holds {key} of type {arrays[key].dtype}; a checkpoint of svox2 has other numbers there.")
    if arrays["links"].ndim != 3 or arrays["links"].size == 0:
        raise MivolError(f"{name} holds links of the shape {arrays['links'].shape}; three axes are expected.")
    for key in ("radius", "center"):
        if arrays[key].size not in (1, 3) or not np.isfinite(arrays[key]).all():
            found = arrays[key].reshape(-1)[:4].tolist()
            raise MivolError(f"{name} holds {key} {found}; one or three finite numbers are expected.")
    if not (arrays["radius"] > 0).all():
        raise MivolError(f"{name} holds radius {arrays['radius'].reshape(-1).tolist()}; numbers above 0 are expected.")
    if arrays.get("basis_type", np.array(SVOX2_SH)).size != 1:
        raise MivolError(f"{name} holds basis_type of the shape {arrays['basis_type'].shape}; one number is expected.")
