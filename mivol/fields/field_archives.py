"""Radiance fields on disk: our own ``.npz``, and checkpoints of svox2, which are read."""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import write_whole
from mivol.files.npy import check_memory, read_archive
from mivol.files.source import refusal

__all__ = ["load_field", "save_field", "read_svox2", "save_svox2"]

FORMAT = "mivol spherical grid 2"

HALF = float(np.finfo(np.float16).max)


SVOX2_SH = 1
"""svox2's number for a basis of spherical harmonics."""


SMALL = 2.0**-12
"""Below it the least step of a half float, 2^-24, is more than 2^-12 of the largest value."""


def save_field(path: str | Path, field: SphericalGrid, half: bool = True) -> None:
    """Write a field as ``.npz``.

    Args:
        path: ends in .npz.
        field: what to write.
        half: as half floats (11 bits); arrays with a value beyond 65504, or with none beyond 2^-12, stay float32 in any case.

    Raises:
        MivolError: another suffix, or the disk's refusal.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise MivolError(f"{path.name} was given for a radiance field; a name ending in .npz is expected.")
    density, sh = field.values()
    arrays = {"density": _narrow(density, half), "sh": _narrow(sh, half)}
    arrays |= {"res": np.array(field.res), "to_world": field.to_world}
    if field.nodes is not None:
        arrays["nodes"] = np.array(field.nodes)
    about = {"format": FORMAT, "activation": field.activation, "offset": field.offset, "clamp": field.clamp}
    about["levels"] = field.levels
    about["space"] = field.space
    write_whole(path, lambda file: np.savez_compressed(file, **arrays, **{k: np.array(v) for k, v in about.items()}))


def _narrow(values: np.ndarray, half: bool) -> np.ndarray:
    largest = np.abs(values).max(initial=0.0)
    return values.astype(np.float16) if half and SMALL <= largest <= np.finfo(np.float16).max else values


def load_field(path: str | Path) -> SphericalGrid:
    """Read a field: our ``.npz``, or a checkpoint of svox2.

    Raises:
        MivolError: no such file, no such format, or contents that do not fit together.
    """
    path = Path(path)
    if not path.is_file():
        raise MivolError(f"found no file {path}; give a radiance field (.npz).")
    arrays = read_archive(path)
    if "links" in arrays:
        return read_svox2(path.name, arrays)
    if str(arrays.get("format", "")) != FORMAT:
        held = ", ".join(arrays) or "nothing"
        raise MivolError(f"{path.name} holds {held}; a field of mivol or a checkpoint of svox2 is expected.")
    return _of_ours(path.name, arrays)


def _of_ours(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid:
    needed = {"density", "sh", "res", "to_world", "activation", "offset", "clamp", "levels", "space"} - arrays.keys()
    if needed:
        raise MivolError(f"{name} lacks {', '.join(sorted(needed))}; write it again.")
    _check_own_arrays(name, arrays)
    res = tuple(int(n) for n in arrays["res"])
    nodes = arrays.get("nodes")
    levels = int(arrays["levels"])
    n, shape = levels * math.prod(res) if nodes is None else len(nodes), arrays["sh"].shape
    if len(res) != 3 or arrays["density"].shape != (n,) or len(shape) != 3 or shape[0] != n or shape[2] != 3:
        found = f"{arrays['density'].shape} densities and {shape} harmonics"
        raise MivolError(f"{name} holds {found} for {n} nodes; write it again.")
    if nodes is not None:
        _check_nodes(name, nodes, levels * math.prod(res))
    return SphericalGrid.from_rows(
        res,
        arrays["to_world"],
        arrays["density"].astype(np.float32),
        arrays["sh"].astype(np.float32),
        None if nodes is None else mi.UInt32(nodes.astype(np.uint32)),
        str(arrays["activation"]),
        float(arrays["offset"]),
        bool(arrays["clamp"]),
        levels,
        str(arrays["space"]),
    )


KINDS = {
    "res": ("iu", (3,)), "to_world": ("f", (4, 4)), "density": ("f", None), "sh": ("f", None), "nodes": ("iu", None),
    "activation": ("U", ()), "offset": ("fiu", ()), "clamp": ("biu", ()), "levels": ("iu", ()),
    "space": ("U", ()),
}  # fmt: skip
"""Of each array the kinds of NumPy types, and the shape where there is one only."""

MOST_NODES = 2**32 - 1
"""Nodes are counted in 32 bits."""


def _check_own_arrays(name: str, arrays: dict[str, np.ndarray]) -> None:
    """Refuse arrays of another type or shape, numbers that are not finite, and a grid that cannot be.

    Raises:
        MivolError: with what was found.
    """
    for key, (kinds, shape) in KINDS.items():
        array = arrays.get(key)
        if array is None:
            continue
        if array.dtype.kind not in kinds or (shape is not None and array.shape != shape):
            raise MivolError(f"{name} holds {key} of type {array.dtype} and shape {array.shape}; write it again.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise MivolError(f"{name} holds {key} with values that are not finite; write it again.")
    res = [int(arrays["levels"]), *(int(n) for n in arrays["res"])]
    if min(res) < 1 or math.prod(res) > MOST_NODES:
        found = " x ".join(map(str, res[res[0] == 1 :]))
        raise MivolError(f"{name} has a grid of {found} nodes; 1 to {MOST_NODES} in all are expected.")
    check_memory(Path(name), 4 * math.prod(res))  # the row of each node, which rays look up


def _check_nodes(name: str, nodes: np.ndarray, count: int) -> None:
    ordered = nodes.ndim == 1 and (len(nodes) < 2 or (np.diff(nodes.astype(np.int64)) > 0).all())
    if not ordered or (len(nodes) and not (int(nodes[0]) >= 0 and int(nodes[-1]) < count)):
        raise MivolError(f"{name} lists nodes out of order or beyond the {count} of its grid; write it again.")


def save_svox2(path: Path, field: SphericalGrid) -> None:
    """Write a checkpoint, whole or not at all; coefficients are rounded to half floats, as svox2 does.

    Raises:
        MivolError: a field that svox2 would show otherwise (turned, another activation or offset, no clamp, radiance),
            coefficients beyond 65504, disk full.
    """
    if field.levels > 1:
        raise refusal(path, f"a field of {field.levels} nested levels", "one grid, as svox2 has", "write .npz or .xml")
    box = np.diagonal(field.to_world)[:3]
    shown = (field.activation in ("none", "relu"), field.offset == 0.5, field.clamp)
    if np.count_nonzero(field.to_world[:3, :3] - np.diag(box)) or box.min() <= 0:
        raise refusal(path, "a turned or mirrored field", "an axis-aligned box, as svox2 has", "write .npz")
    if field.space != "srgb":
        raise refusal(path, "colours of linear radiance", "code values, as svox2 shows them", "write .npz")
    if not all(shown):
        found = f"activation {field.activation}, offset {field.offset:g}, clamp {field.clamp}"
        raise refusal(path, found, "relu, 0.5 and True, as svox2 shows fields", "write .npz")
    density, sh = field.values()
    if np.abs(sh).max(initial=0.0) > HALF:
        raise refusal(path, f"coefficients of up to {np.abs(sh).max():g}", f"at most {HALF:g}, a half float's", "write .npz")
    links = np.full(math.prod(field.res), -1, np.int32)
    links[field.stored_nodes()] = np.arange(len(density))
    arrays = {
        "radius": box / 2, "center": field.to_world[:3, 3] + box / 2, "basis_type": np.array(SVOX2_SH),
        "links": links.reshape(field.res).transpose(2, 1, 0), "density_data": density[:, None],
        "sh_data": sh.transpose(0, 2, 1).reshape(len(sh), -1).astype(np.float16),
    }  # fmt: skip
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def _check_svox2_arrays(name: str, arrays: dict[str, np.ndarray]) -> None:
    """Refuse links that are no whole numbers on three axes, numbers of another type, and a box that is none.

    Raises:
        MivolError: with what was found.
    """
    kinds = {"links": "iu", "density_data": "f", "sh_data": "f", "radius": "fiu", "center": "fiu", "basis_type": "iu"}
    for key, wanted in kinds.items():
        if key in arrays and arrays[key].dtype.kind not in wanted:
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


def read_svox2(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid:
    """A checkpoint of svox2: axes X Y Z, links to rows (negative: empty), harmonics [rgb][basis], centre and radius."""
    needed = {"density_data", "sh_data", "radius", "center"} - arrays.keys()
    if needed:
        raise MivolError(f"{name} has links but lacks {', '.join(sorted(needed))}; a checkpoint of svox2 holds them.")
    _check_svox2_arrays(name, arrays)
    if int(arrays.get("basis_type", SVOX2_SH)) != SVOX2_SH:
        found = int(arrays["basis_type"])
        raise MivolError(f"{name} is of svox2's basis type {found}; only spherical harmonics (1) can be read.")
    if arrays.get("background_data", np.empty(0)).size:
        raise MivolError(f"{name} has a background of sphere layers, which mivol does not model; save it without one.")
    links, sh = arrays["links"].transpose(2, 1, 0), arrays["sh_data"].astype(np.float32)
    density = arrays["density_data"].astype(np.float32).reshape(-1)
    if links.ndim != 3 or sh.ndim != 2 or len(sh) != len(density) or sh.shape[1] % 3 or links.max(initial=-1) >= len(density):
        found = f"links {links.shape}, densities {density.shape} and harmonics {sh.shape}"
        raise MivolError(f"{name} holds {found} that do not fit together; write it again.")
    nodes = np.flatnonzero(links >= 0)
    row = links.reshape(-1)[nodes]
    rows = sh[row].reshape(len(row), 3, -1).transpose(0, 2, 1)
    if nodes.size and (not np.isfinite(density[row]).all() or not np.isfinite(sh[row]).all()):
        raise MivolError(f"{name} holds densities or harmonics that are not finite; write it again.")
    radius, center = (np.broadcast_to(np.asarray(arrays[k], np.float64).reshape(-1), 3) for k in ("radius", "center"))
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = np.diag(2 * radius), center - radius
    listed = mi.UInt32(nodes.astype(np.uint32))
    return SphericalGrid.from_rows(links.shape, to_world, density[row], np.ascontiguousarray(rows), listed)
