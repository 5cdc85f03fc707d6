"""pbrt-v2's ``volumegrid`` in a scene file: sizes, a box and densities as text, x fastest.

Conventions. ``p0`` and ``p1`` are the box's corners. Densities are the values at voxel centres. Only the first volume
with a density array is read, and its box is in the file's object space: transforms of the scene file are not applied.

Reference: Pharr, Humphreys, Physically Based Rendering, 2nd ed., section 11.3.3.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_box, to_values

PARAMETER = re.compile(r'"(integer|point|float)\s+(nx|ny|nz|p0|p1|density)"\s*(?:\[([^\]]*)(\]?)|(-?\d+))')


def is_pbrt(head: bytes) -> bool:
    """Whether the text has a Volume statement with a grid size among its first bytes."""
    return b'"integer nx"' in head and b"Volume" in head


def read_pbrt(path: Path, dataset: str | None = None) -> VolumeData:
    """Read the density grid of a ``.pbrt`` file.

    Raises:
        MivolError: a parameter missing, a list that breaks off, or a count of densities that does not fit nx ny nz.
    """
    refuse_dataset(path, dataset)
    text = source.read_bytes(path).decode("ascii", errors="replace")
    found: dict[str, str] = {}
    for match in PARAMETER.finditer(text):
        _, name, listed, closed, single = match.groups()
        if single is None and not closed:
            raise refusal(path, f'a list of "{name}" that breaks off', "its ]", "the file is truncated: copy it again")
        found.setdefault(name, single if listed is None else listed)
    missing = [name for name in ("nx", "ny", "nz", "p0", "p1", "density") if name not in found]
    if missing:
        raise refusal(path, f"no {', '.join(missing)}", "nx, ny, nz, p0, p1 and density", "add them to the Volume")
    size = [source.parse_integers(found[name], 1, path, name)[0] for name in ("nx", "ny", "nz")]
    if min(size) < 1:
        raise refusal(path, f"sizes {size}", "at least 1 each", "correct nx, ny, nz")
    density = source.parse_numbers(found["density"], size[0] * size[1] * size[2], path)
    to_world = frame_from_box(source.parse_numbers(found["p0"], 3, path), source.parse_numbers(found["p1"], 3, path))
    meta = {"path": str(path), "format": "pbrt", "dtype": "text", "space": None}
    return VolumeData(to_values(np.reshape(density, size[::-1]), path), to_world, meta)
