"""The ``.splat`` of antimatter15's viewer: 32 bytes a Gaussian, no header, colours without harmonics.

Conventions. Position and scale in float32, colour and opacity in a byte each, the unit quaternion (w, x, y, z) as 128 + 128 q
in a byte each.

Source: the open-source viewer antimatter15/splat (MIT licence).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.files.source import read_bytes, refusal
from mivol.points.byte_codes import harmonics_of_colours, logits_of_bytes, logs_of_scales
from mivol.points.gaussians import Gaussians

__all__ = ["read_splat"]

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3), ("opacity", "u1"), ("quaternion", "u1", 4)])


def read_splat(path: Path) -> Gaussians:
    """Read a file.

    Raises:
        MivolError: a size that is no multiple of 32 bytes.
    """
    data = read_bytes(path)
    if len(data) % RECORD.itemsize:
        raise refusal(path, f"{len(data)} bytes", f"a multiple of {RECORD.itemsize}", "the file is truncated: copy it again")
    table = np.frombuffer(data, RECORD)
    return Gaussians(
        table["mean"],
        logs_of_scales(table["scale"]),
        table["quaternion"] / 128 - 1,
        logits_of_bytes(table["opacity"]),
        harmonics_of_colours(table["colour"] / 255)[:, None],
    )
