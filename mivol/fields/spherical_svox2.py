"""A radiance field as a checkpoint of svox2, the program of Plenoxels.

Conventions. Its axes are X Y Z, ``links`` hold the row of each node (-1: none), coefficients lie [rgb][basis] in half floats,
and the box is said by its middle and half its edges. After interpolation it shows ``max(0, 1/2 + sum)`` and
``max(0, density)``, so a field that is shown in another way, or turned, is none of its own.

Source: Fridovich-Keil, Yu et al. 2022, and the names in svox2's own files.
"""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid
from mivol.files import write_whole
from mivol.files.source import refusal

__all__ = ["read_svox2", "save_svox2"]

HALF = float(np.finfo(np.float16).max)


SVOX2_SH = 1
"""svox2's number for a basis of spherical harmonics."""


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
    links[field.listed()] = np.arange(len(density))
    arrays = {
        "radius": box / 2, "center": field.to_world[:3, 3] + box / 2, "basis_type": np.array(SVOX2_SH),
        "links": links.reshape(field.res).transpose(2, 1, 0), "density_data": density[:, None],
        "sh_data": sh.transpose(0, 2, 1).reshape(len(sh), -1).astype(np.float16),
    }  # fmt: skip
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def _check_kinds(name: str, arrays: dict[str, np.ndarray]) -> None:
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
    _check_kinds(name, arrays)
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
