"""A radiance field as a checkpoint of svox2, the program of Plenoxels; :func:`mivol.fields.spherical.load_field` reads them.

Conventions. Its axes are X Y Z, ``links`` hold the row of each node (-1: none), coefficients lie [rgb][basis] in half floats,
and the box is said by its middle and half its edges. After interpolation it shows ``max(0, 1/2 + sum)`` and
``max(0, density)``, so a field that is shown in another way, or turned, is none of its own.

Source: Fridovich-Keil, Yu et al. 2022, and the names in svox2's own files.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mivol.fields.spherical import SVOX2_SH, SphericalGrid
from mivol.files import write_whole
from mivol.files.source import refusal

__all__ = ["save_svox2"]

HALF = float(np.finfo(np.float16).max)


def save_svox2(path: Path, field: SphericalGrid) -> None:
    """Write a checkpoint, whole or not at all; coefficients are rounded to half floats, as svox2 does.

    Raises:
        MivolError: a field that svox2 would show otherwise (turned, another activation or offset, no clamp), coefficients
            beyond 65504, disk full.
    """
    box = np.diagonal(field.to_world)[:3]
    shown = (field.activation in ("none", "relu"), field.offset == 0.5, field.clamp)
    if np.count_nonzero(field.to_world[:3, :3] - np.diag(box)) or box.min() <= 0:
        raise refusal(path, "a turned or mirrored field", "an axis-aligned box, as svox2 has", "write .npz")
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
