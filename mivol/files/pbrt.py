"""pbrt-v2's ``volumegrid`` in a scene file: sizes, a box and densities as text, x fastest.

Own reader: no library reads this statement.

Conventions. ``p0`` and ``p1`` are the corners of the box. Densities are values at voxel centres. Only the first volume with
densities is read, in its object space: transforms of the scene file are ignored.

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
    """Return whether the first bytes hold a Volume statement with a grid size."""
    return b'"integer nx"' in head and b"Volume" in head


def read_pbrt(path: Path, dataset: str | None = None) -> VolumeData:
    """Read the density grid of a ``.pbrt`` file.

    Raises:
        MivolError: a missing parameter, a list that breaks off, or a number of densities other than nx ny nz.
    """
    refuse_dataset(path, dataset)
    text = source.read_bytes(path).decode("ascii", errors="replace")
    parameters: dict[str, str] = {}
    for match in PARAMETER.finditer(text):
        _, name, listed, closed, single = match.groups()
        if single is None and not closed:
            raise refusal(path, f'a list of "{name}" that breaks off', "its ]", "the file is truncated: copy it again")
        parameters.setdefault(name, single if listed is None else listed)
    missing = [name for name in ("nx", "ny", "nz", "p0", "p1", "density") if name not in parameters]
    if missing:
        raise refusal(path, f"no {', '.join(missing)}", "nx, ny, nz, p0, p1 and density", "add them to the Volume")
    size = [source.parse_integers(parameters[name], 1, path, name)[0] for name in ("nx", "ny", "nz")]
    if min(size) < 1:
        raise refusal(path, f"sizes {size}", "at least 1 each", "correct nx, ny, nz")
    density = source.parse_numbers(parameters["density"], size[0] * size[1] * size[2], path)
    to_world = frame_from_box(source.parse_numbers(parameters["p0"], 3, path), source.parse_numbers(parameters["p1"], 3, path))
    meta = {"path": str(path), "format": "pbrt", "dtype": "text", "space": None}
    return VolumeData(to_values(np.reshape(density, size[::-1]), path), to_world, meta)
