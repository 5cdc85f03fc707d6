"""Which Gaussians reach into which cells of a box, so that a ray asks only those that it may meet.

Conventions. The box lies along the axes of the world and holds every Gaussian up to ``reach`` standard deviations. Its lattice
has (Z, Y, X) nodes at voxel centres, and a cell lies between two nodes along each axis, or between a node and the face of the
box: cells are counted from 0 to N, x fastest. A Gaussian is listed in each cell that its ellipsoid touches, and in some that it
does not: lists are never too short.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.machine import available_memory

__all__ = ["CellLists", "list_gaussians", "MAX_CHUNK_PAIRS", "find_chunk_starts", "list_box_nodes"]

CELLS_PER_GAUSSIAN = 1.0
"""Cells for each Gaussian: 22^3 for 10,000 (measured on a dense cloud of as many: line integrals take the same time from 0.4 to
8, within a tenth; lists of 8 take four times as long to make)."""

MIN_CELLS, MAX_CELLS = 8, 1 << 21
"""Of a box."""

MAX_NODES = 256
"""Along an axis."""

SLACK = 1e-3
"""By which the box and each cell are taken larger, in edges: rounding of a ray's place in float32 may not lose a Gaussian."""

PAIR_BYTES = 120
"""That a cell and a Gaussian take while it is asked whether they touch."""

ENTRY_BYTES = 12
"""That an entry takes while the lists are sorted."""


@dataclass(frozen=True)
class CellLists:
    """The Gaussians of each cell.

    Attributes:
        to_world: (4, 4) float64, the unit cube to the box.
        res: nodes (Z, Y, X); there is a cell more along each axis.
        starts: (cells + 1,) uint32; the entries of cell c are those from ``starts[c]`` to ``starts[c + 1]``.
        entries: (n,) uint32, Gaussians.
    """

    to_world: np.ndarray
    res: tuple[int, int, int]
    starts: np.ndarray
    entries: np.ndarray

    def max_cell_sum(self, values: np.ndarray) -> float:
        """The largest sum of a number of each Gaussian (N,) over the entries of one cell."""
        sums = np.concatenate([[0.0], np.cumsum(values[self.entries], dtype=np.float64)])
        return float(np.diff(sums[self.starts]).max(initial=0.0))


def list_gaussians(means: np.ndarray, whitening: np.ndarray, reach: float) -> CellLists:
    """List the Gaussians of each cell of a box around them all.

    Args:
        means: (N, 3) float64, world [length].
        whitening: (N, 3, 3) float64; W (x - mean) has a length of 1 at one standard deviation [1/length].
        reach: standard deviations at which a Gaussian ends.

    Raises:
        MivolError: no Gaussians, or lists that take more memory than is free.
    """
    if not len(means):
        raise MivolError("no Gaussians were given; at least one is expected: there is nothing for rays to meet.")
    spread = reach * np.sqrt((np.linalg.inv(whitening) ** 2).sum(axis=2))
    low, high = (means - spread).min(axis=0), (means + spread).max(axis=0)
    slack = SLACK * (high - low).max()
    low, edge = low - slack, high - low + 2 * slack
    size = _choose_resolution(edge, len(means))
    first, last = (np.clip(_locate_cells(p, low, edge, size), 0, size) for p in (means - spread, means + spread))
    counts = (last - first + 1).prod(axis=1)
    _check_memory(counts)
    found = [
        _find_touched_cells(index, first[index], last[index], (means - low) / edge * size, whitening * (edge / size), reach)
        for index in np.split(np.arange(len(means)), find_chunk_starts(counts))
    ]
    cells, entries = (np.concatenate(rows) for rows in zip(*found, strict=True))
    cells = cells @ np.cumprod([1, *(size[:2] + 1)])
    order = np.argsort(cells, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=int((size + 1).prod())))])
    to_world = np.diag([*edge, 1.0])
    to_world[:3, 3] = low
    return CellLists(to_world, tuple(int(n) for n in size[::-1]), starts.astype(np.uint32), entries[order].astype(np.uint32))


def _choose_resolution(edge: np.ndarray, count: int) -> np.ndarray:
    """Nodes (x, y, z) of a box: as near to cubes as whole numbers allow."""
    cells = np.clip(CELLS_PER_GAUSSIAN * count, MIN_CELLS, MAX_CELLS)
    return np.clip(np.rint(edge / (edge.prod() / cells) ** (1 / 3)), 1, MAX_NODES).astype(np.int64)


def _locate_cells(p: np.ndarray, low: np.ndarray, edge: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.floor((p - low) / edge * size + 0.5).astype(np.int64)


def _find_touched_cells(
    index: np.ndarray, first: np.ndarray, last: np.ndarray, means: np.ndarray, whitening: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """The cells (n, 3) that some Gaussians touch, and the Gaussian of each; ``means`` and ``whitening`` count in cells."""
    sizes = last - first + 1
    owner = np.repeat(index, sizes.prod(axis=1))
    cell = np.repeat(first, sizes.prod(axis=1), axis=0) + list_box_nodes(sizes)
    W = whitening[owner]
    # A point of the cell is at most this far from its middle, in standard deviations: |W| applied to half its edges.
    size = np.linalg.norm(np.abs(W) @ np.full(3, 0.5 + SLACK), axis=1)
    away = np.linalg.norm(np.einsum("nij,nj->ni", W, cell - means[owner]), axis=1)
    touches = away - size <= reach
    return cell[touches], owner[touches]


def _check_memory(counts: np.ndarray) -> None:
    """Refuse lists that do not fit: at most so many entries, and those that are looked at together."""
    needed, free = ENTRY_BYTES * int(counts.sum()) + PAIR_BYTES * (MAX_CHUNK_PAIRS + int(counts.max())), available_memory()
    if free is not None and needed > free:
        raise MivolError(
            f"{len(counts)} Gaussians reach into {counts.mean():.0f} cells each; their lists take {needed / 2**30:.1f} GiB, "
            f"where {free / 2**30:.1f} GiB are free: remove the widest of them, which reaches into {counts.max()} cells."
        )


MAX_CHUNK_PAIRS = 1 << 21
"""Places of all boxes that are listed together, and one box more, which has no more than there are nodes."""


def list_box_nodes(sizes: np.ndarray) -> np.ndarray:
    """All places (x, y, z) of boxes of these sizes (n, 3), one box after the other, each from (0, 0, 0)."""
    counts = sizes.prod(axis=1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x, y = (np.repeat(sizes[:, axis], counts) for axis in (0, 1))
    return np.stack([number % x, number // x % y, number // (x * y)], axis=1)


def find_chunk_starts(counts: np.ndarray) -> np.ndarray:
    """Where a list of boxes of so many places is cut so that no part has much more than ``PAIRS``."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // MAX_CHUNK_PAIRS)) + 1
