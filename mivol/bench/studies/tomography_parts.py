"""What each part of the default solver of scans is worth: nRMSE of slices with it and without it.

    scripts/bench_tomography.py --only parts     half a minute on 2 cores

Slices, projections and the error are those of :mod:`mivol.bench.studies.tomography_peers`; two more kinds of data show what
fewer quanta change. Every row is pcg on voxels at or above 0, after 20 iterations.
"""

from __future__ import annotations

from itertools import islice

import msgspec

from mivol import config
from mivol.bench.studies.tomography_peers import default, make_slice

__all__ = ["DATA", "PARTS", "measure_parts", "rows_of_parts"]

DATA = {
    "few (30), no noise": (30, 0.0),
    "few (30), 1e4 quanta": (30, 1e4),
    "noisy (90, 1e4)": (90, 1e4),
    "many (360, 1e4)": (360, 1e4),
    "very noisy (90, 1e3)": (90, 1e3),
}
"""Kind of data: views, and quanta a pixel (0: no noise)."""

PARTS = {
    "from nothing": {"start": "empty", "supersampling": 1, "tv": 0.0},
    "from fbp": {"supersampling": 1, "tv": 0.0},
    "from fbp, unknowns twice as fine": {"tv": 0.0},
    "from fbp, tv = 1": {"supersampling": 1},
    "from fbp, twice as fine, tv = 0.5": {"tv": 0.5},
    "from fbp, twice as fine, tv = 1": {},
    "from fbp, twice as fine, tv = 2": {"tv": 2.0},
}
"""Settings that differ from the default's."""


def measure_parts(n: int = 129) -> dict[str, dict[str, float]]:
    """nRMSE by kind of data and row, of slices of n x n voxels (odd)."""
    found: dict[str, dict[str, float]] = {}
    for kind, (views, photons) in DATA.items():
        scan = make_slice(n, views, photons)
        found[kind] = {}
        for part, changes in PARTS.items():
            wanted = msgspec.structs.replace(config.SolveSettings(), **changes)
            *_, last = islice(default(scan, wanted), wanted.iterations)
            found[kind][part] = scan.error(last)
    return found


def rows_of_parts(found: dict[str, dict[str, float]]) -> list[str]:
    """A table in Markdown."""
    lines = ["| pcg, nRMSE after 20 iterations | " + " | ".join(found) + " |", "|---" * (len(found) + 1) + "|"]
    for part in next(iter(found.values())):
        lines.append(f"| {part} | " + " | ".join(f"{errors[part]:.3f}" for errors in found.values()) + " |")
    return lines
