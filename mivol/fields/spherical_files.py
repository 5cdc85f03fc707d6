"""Radiance fields on disk: our own ``.npz``, and checkpoints of svox2, which are read."""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid
from mivol.fields.spherical_svox2 import read_svox2
from mivol.files import write_whole
from mivol.files.npy import check_memory, read_archive

__all__ = ["load_field", "save_field"]

FORMAT = "mivol spherical grid 2"

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
    _check_kinds(name, arrays)
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


def _check_kinds(name: str, arrays: dict[str, np.ndarray]) -> None:
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
