"""A grid downsampled by means over blocks of voxels, and a list of the blocks that are not empty."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.traversal.empty_blocks import find_empty_distances
from mivol.transport.traversal.lattice import Lattice

__all__ = ["CoarseGrid", "coarsen_grid"]


@dataclass
class CoarseGrid:
    """The means of a grid over blocks of voxels, as a grid in the same place.

    Attributes:
        lattice: voxel i holds the mean of the voxels 2^shift i to 2^shift (i + 1) - 1, along each axis; the last one repeats
            the border of the grid.
        held: flat indices (z, y, x) of the non-empty blocks, for a visibility cache; None where no list was asked for.
    """

    lattice: Lattice
    held: mi.UInt32 | None


def coarsen_grid(lattice: Lattice, shift: int, lists: bool) -> CoarseGrid:
    """Take means over blocks of 2^shift voxels along each axis.

    Args:
        lattice: the grid.
        shift: log2 of the edge of a block [voxels].
        lists: whether to list the blocks that are not empty, too.

    Cost: 8/7 look-ups a voxel, 8 a block.
    """
    c, edge, shape = lattice.channels, 1 << shift, list(lattice.res)
    flat = dr.detach(lattice.values.array)
    for axis in (2, 1, 0):
        inner = int(np.prod(shape[axis + 1 :])) * c
        flat = _mean_along(flat, shape[axis], inner, edge)
        shape[axis] = -(-shape[axis] // edge)
    values = mi.TensorXf(flat, (*shape, c))
    scale = np.diag([edge * m / n for m, n in zip(shape[::-1], lattice.res[::-1], strict=True)] + [1.0])
    empty_distances = find_empty_distances(values) if lattice.empty_distances is not None else None
    return CoarseGrid(
        Lattice(values, lattice.to_world @ scale, empty_distances), _held(values, lattice.res, shift) if lists else None
    )


def _mean_along(flat: mi.Float, n: int, inner: int, edge: int) -> mi.Float:
    """Means of ``edge`` neighbours along the middle axis of (outer, n, inner)."""
    b = -(-n // edge)
    i = dr.arange(mi.UInt32, dr.width(flat) // n * b)
    row, first = (i // (inner * b)) * (n * inner) + i % inner, (i // inner) % b * edge
    total = mi.Float(0)
    for k in range(edge):
        total += dr.gather(mi.Float, flat, row + dr.minimum(first + k, n - 1) * inner)
    total *= 1 / edge
    dr.eval(total)
    return total


def _held(means: mi.TensorXf, res: tuple[int, int, int], shift: int) -> mi.UInt32:
    """List the blocks of cells that have a node above 0.

    A block of cells lies across two mean voxels along each axis (one at the border), so it is empty where all 8 means are 0.
    """
    c, sizes = means.shape[3], [(n >> shift) + 1 for n in res]
    i, found = dr.arange(mi.UInt32, sizes[0] * sizes[1] * sizes[2]), mi.Bool(False)
    block = (i // (sizes[1] * sizes[2]), i // sizes[2] % sizes[1], i % sizes[2])
    for corner in range(8):
        z, y, x = (
            dr.clip(mi.Int32(b) - (corner >> k & 1), 0, n - 1) for k, (b, n) in enumerate(zip(block, means.shape, strict=False))
        )
        node = mi.UInt32((z * means.shape[1] + y) * means.shape[2] + x) * c
        for channel in range(c):
            found |= dr.gather(mi.Float, means.array, node + channel) > 0
    return dr.compress(found)
