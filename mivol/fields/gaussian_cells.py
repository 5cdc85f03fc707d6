"""The Gaussians of each cell of a box: lists from which a ray reads only Gaussians near its path.

Conventions. The box lies along the world axes and holds every Gaussian up to ``reach`` standard deviations. Its lattice has
(Z, Y, X) nodes at voxel centres. Along each axis a cell lies between two nodes, or between a node and a face of the box; cells
are numbered from 0 to N, x fastest. A list holds each Gaussian whose ellipsoid touches the cell, and may hold more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.machine import available_memory

CELLS_PER_GAUSSIAN = 1.0
"""Cells for each Gaussian: 22^3 cells for 10,000 Gaussians. On a dense cloud of this size line integrals take the same time
(within 10 %) from 0.4 to 8 cells a Gaussian; with 8 the lists take four times as long to make."""

MIN_CELLS, MAX_CELLS = 8, 1 << 21
"""Limits of the number of cells."""

MAX_NODES = 256
"""Limit along an axis."""

SLACK = 1e-3
"""Enlargement of the box and of each cell, in edges; float32 rounding of a ray's position must not lose a Gaussian."""

PAIR_BYTES = 120
"""Memory of one pair of cell and Gaussian during the touch test [bytes]."""

ENTRY_BYTES = 12
"""Memory of one list entry while the lists are sorted [bytes]."""


@dataclass(frozen=True)
class CellLists:
    """The Gaussians of each cell.

    Attributes:
        to_world: (4, 4) float64, unit cube to box.
        res: nodes (Z, Y, X); each axis has one cell more.
        starts: (cells + 1,) uint32; cell c owns the entries from ``starts[c]`` to ``starts[c + 1]``.
        entries: (n,) uint32, numbers of Gaussians.
    """

    to_world: np.ndarray
    res: tuple[int, int, int]
    starts: np.ndarray
    entries: np.ndarray

    def max_cell_sum(self, values: np.ndarray) -> float:
        """The largest sum over the entries of a cell of ``values`` (N,), one number a Gaussian."""
        sums = np.concatenate([[0.0], np.cumsum(values[self.entries], dtype=np.float64)])
        return float(np.diff(sums[self.starts]).max(initial=0.0))


def list_gaussians(means: np.ndarray, whitening: np.ndarray, reach: float) -> CellLists:
    """List the Gaussians of each cell of a box around all Gaussians.

    Args:
        means: (N, 3) float64, world [length].
        whitening: (N, 3, 3) float64 [1/length]; W (x - mean) has length 1 at one standard deviation.
        reach: radius of a Gaussian [standard deviations].

    Raises:
        MivolError: no Gaussians, or lists larger than the free memory.
    """
    if not len(means):
        raise MivolError("no Gaussians were given; at least one is expected: without Gaussians rays have nothing to cross.")
    spread = reach * np.sqrt((np.linalg.inv(whitening) ** 2).sum(axis=2))
    low, high = (means - spread).min(axis=0), (means + spread).max(axis=0)
    slack = SLACK * (high - low).max()
    low, edge = low - slack, high - low + 2 * slack
    size = _choose_resolution(edge, len(means))
    first, last = (np.clip(_locate_cells(p, low, edge, size), 0, size) for p in (means - spread, means + spread))
    counts = (last - first + 1).prod(axis=1)
    _check_memory(counts)
    touched = [
        _find_touched_cells(index, first[index], last[index], (means - low) / edge * size, whitening * (edge / size), reach)
        for index in np.split(np.arange(len(means)), find_chunk_starts(counts))
    ]
    cells, entries = (np.concatenate(rows) for rows in zip(*touched, strict=True))
    cells = cells @ np.cumprod([1, *(size[:2] + 1)])
    order = np.argsort(cells, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=int((size + 1).prod())))])
    to_world = np.diag([*edge, 1.0])
    to_world[:3, 3] = low
    return CellLists(to_world, tuple(int(n) for n in size[::-1]), starts.astype(np.uint32), entries[order].astype(np.uint32))


def _choose_resolution(edge: np.ndarray, count: int) -> np.ndarray:
    """Nodes (x, y, z) that make the cells nearly cubic."""
    cells = np.clip(CELLS_PER_GAUSSIAN * count, MIN_CELLS, MAX_CELLS)
    return np.clip(np.rint(edge / (edge.prod() / cells) ** (1 / 3)), 1, MAX_NODES).astype(np.int64)


def _locate_cells(p: np.ndarray, low: np.ndarray, edge: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.floor((p - low) / edge * size + 0.5).astype(np.int64)


def _find_touched_cells(
    index: np.ndarray, first: np.ndarray, last: np.ndarray, means: np.ndarray, whitening: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of touched cells (n, 3) and Gaussians (n,); ``means`` and ``whitening`` are in units of cells."""
    sizes = last - first + 1
    owner = np.repeat(index, sizes.prod(axis=1))
    cell = np.repeat(first, sizes.prod(axis=1), axis=0) + list_box_nodes(sizes)
    W = whitening[owner]
    # Largest distance of a point of the cell from its middle, in standard deviations: |W| applied to half the edges.
    size = np.linalg.norm(np.abs(W) @ np.full(3, 0.5 + SLACK), axis=1)
    distance = np.linalg.norm(np.einsum("nij,nj->ni", W, cell - means[owner]), axis=1)
    touches = distance - size <= reach
    return cell[touches], owner[touches]


def _check_memory(counts: np.ndarray) -> None:
    """Refuse lists that exceed the free memory, counting all entries and one chunk of pairs."""
    needed, free = ENTRY_BYTES * int(counts.sum()) + PAIR_BYTES * (MAX_CHUNK_PAIRS + int(counts.max())), available_memory()
    if free is not None and needed > free:
        raise MivolError(
            f"{len(counts)} Gaussians reach into {counts.mean():.0f} cells each; their lists take {needed / 2**30:.1f} GiB, "
            f"where {free / 2**30:.1f} GiB are free: remove the widest of them, which reaches into {counts.max()} cells."
        )


MAX_CHUNK_PAIRS = 1 << 21
"""Pairs of nodes and boxes listed at once. A chunk may exceed the limit by one box."""


def list_box_nodes(sizes: np.ndarray) -> np.ndarray:
    """Integer offsets (x, y, z) of all nodes of boxes with the given sizes (n, 3), box by box, each from (0, 0, 0)."""
    counts = sizes.prod(axis=1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x, y = (np.repeat(sizes[:, axis], counts) for axis in (0, 1))
    return np.stack([number % x, number // x % y, number // (x * y)], axis=1)


def find_chunk_starts(counts: np.ndarray) -> np.ndarray:
    """Indices that split a list of boxes, with the given node counts, into chunks of about ``MAX_CHUNK_PAIRS`` nodes."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // MAX_CHUNK_PAIRS)) + 1
