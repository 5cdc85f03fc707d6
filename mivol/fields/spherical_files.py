"""Radiance fields on disk: our own ``.npz``, and checkpoints of svox2, which are read."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid
from mivol.fields.spherical_svox2 import read_svox2
from mivol.files import write_whole

__all__ = ["load_field", "save_field"]

FORMAT = "mivol spherical grid 1"

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
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise MivolError(f"{path.name} is not a whole .npz archive ({error}); write it again.") from error
    if "links" in arrays:
        return read_svox2(path.name, arrays)
    if str(arrays.get("format", "")) != FORMAT:
        held = ", ".join(arrays) or "nothing"
        raise MivolError(f"{path.name} holds {held}; a field of mivol or a checkpoint of svox2 is expected.")
    return _of_ours(path.name, arrays)


def _of_ours(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid:
    needed = {"density", "sh", "res", "to_world", "activation", "offset", "clamp"} - arrays.keys()
    if needed:
        raise MivolError(f"{name} lacks {', '.join(sorted(needed))}; write it again.")
    res = tuple(int(n) for n in arrays["res"])
    nodes = arrays.get("nodes")
    n, shape = math.prod(res) if nodes is None else len(nodes), arrays["sh"].shape
    if len(res) != 3 or arrays["density"].shape != (n,) or len(shape) != 3 or shape[0] != n or shape[2] != 3:
        found = f"{arrays['density'].shape} densities and {shape} harmonics"
        raise MivolError(f"{name} holds {found} for {n} nodes; write it again.")
    if nodes is not None:
        _check_nodes(name, nodes, math.prod(res))
    return SphericalGrid.from_rows(
        res,
        arrays["to_world"],
        arrays["density"].astype(np.float32),
        arrays["sh"].astype(np.float32),
        None if nodes is None else mi.UInt32(nodes.astype(np.uint32)),
        str(arrays["activation"]),
        float(arrays["offset"]),
        bool(arrays["clamp"]),
    )


def _check_nodes(name: str, nodes: np.ndarray, count: int) -> None:
    ordered = nodes.ndim == 1 and (len(nodes) < 2 or (np.diff(nodes.astype(np.int64)) > 0).all())
    if not ordered or (len(nodes) and int(nodes[-1]) >= count):
        raise MivolError(f"{name} lists nodes out of order or beyond the {count} of its grid; write it again.")
