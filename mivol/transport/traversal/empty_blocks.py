"""Empty-space skipping: the distance of each block of a grid's cells from the nearest block that is not empty.

From a block at distance k a ray may cross everything within k - 1 blocks in one step. Distances are Chebyshev distances (the
largest of the three axes' distances), counted in blocks.

References: Cohen & Sheffer 1994 (proximity clouds); Szirmay-Kalos et al. 2011 (super-grids).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

__all__ = [
    "BLOCK",
    "REACH",
    "SHIFT",
    "Reduction",
    "block_bounds",
    "count_blocks",
    "distances",
    "empty_block_distances",
    "find_empty_distances",
    "over_blocks",
]


SHIFT = 2
"""log2 of the edge of a block."""

BLOCK = 1 << SHIFT
"""Edge of a block, in cells (measured on threads in a grid of 512^3: an edge of 2 is no faster)."""

REACH = 15
"""Largest distance that is stored [blocks]; what is further counts as so far. In an empty box of 128^3 cells a ray takes 3
steps with it."""


def block_bounds(values: mi.TensorXf) -> mi.Float:
    """Bound |values| over each block of ``BLOCK``^3 cells (all nodes that its cells touch), all channels together.

    Returns:
        Flat array over (blocks in z, y, x), ceil((N + 1) / BLOCK) of them along an axis. A block with bound 0 is empty.

    Cost: 5/4 look-ups a voxel along x, fewer along the others.
    """
    flat = _channel_max(dr.abs(dr.detach(values.array)), values.shape[3])
    return over_blocks(flat, values.shape[:3], SHIFT, Reduction(dr.maximum, 0))


def count_blocks(n: int, shift: int = SHIFT) -> int:
    """Number of blocks of 2^shift cells along an axis of n voxels (n + 1 cells)."""
    return -(-(n + 1) >> shift)


class Reduction(NamedTuple):
    """An associative function of two arrays, and its neutral element."""

    combine: Callable[[mi.Float, mi.Float], mi.Float]
    neutral: float


def over_blocks(flat: mi.Float, res: tuple[int, int, int], shift: int, reduction: Reduction) -> mi.Float:
    """Reduce the values at all nodes that each block of cells touches, one axis after the other.

    Args:
        flat: one number a voxel (Z, Y, X).
        res: (Z, Y, X).
        shift: log2 of the edge of a block [cells].
        reduction: of the values.

    Returns:
        Flat array over the blocks (z, y, x).
    """
    z, y, x = res
    b_y, b_x = count_blocks(y, shift), count_blocks(x, shift)
    for shape in ((z * y, x, 1), (z, y, b_x), (1, z, b_y * b_x)):
        flat = _over_axis(flat, shape, shift, reduction)
    return flat


def _channel_max(flat: mi.Float, channels: int) -> mi.Float:
    """Maximum over the last axis of (voxels, channels)."""
    base = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    best = mi.Float(0)
    for c in range(channels):
        best = dr.maximum(best, dr.gather(mi.Float, flat, base + c))
    return best


def _over_axis(flat: mi.Float, shape: tuple[int, int, int], shift: int, reduction: Reduction) -> mi.Float:
    """Reduce the nodes of each block along the middle axis of ``shape`` = (outer, n, inner)."""
    outer, n, inner = shape
    b, edge = count_blocks(n, shift), 1 << shift
    i = dr.arange(mi.UInt32, outer * b * inner)
    # Block b of edge e holds the cells e b - 1 .. e (b + 1) - 2, so the nodes e b - 1 .. e (b + 1) - 1.
    first = mi.Int32((i // inner) % b) * edge - 1
    row = (i // (inner * b)) * (n * inner) + i % inner
    best = mi.Float(reduction.neutral)
    for k in range(edge + 1):
        node = mi.UInt32(dr.clip(first + k, 0, n - 1))
        best = reduction.combine(best, dr.gather(mi.Float, flat, row + node * inner))
    dr.eval(best)
    return best


def find_empty_distances(values: mi.TensorXf) -> mi.UInt8:
    """The :func:`empty_block_distances` of a grid (Z, Y, X, C)."""
    return empty_block_distances(block_bounds(values), values.shape[:3])


def empty_block_distances(bounds: mi.Float, res: tuple[int, int, int]) -> mi.UInt8:
    """Measure how far each block is from the nearest one that is not empty.

    Args:
        bounds: from :func:`block_bounds`.
        res: of the grid (Z, Y, X).

    Returns:
        Flat array over the blocks: Chebyshev distances [blocks], 0 for a block that is not empty, at most ``REACH``. From a
        block at distance k a ray may cross k - 1 more blocks along each axis.

    Cost: 6 ``REACH`` look-ups a block at most.
    """
    return distances(bounds > 0, tuple(count_blocks(n) for n in res))


def distances(occupied: mi.Bool, counts: tuple[int, int, int]) -> mi.UInt8:
    """The Chebyshev distance of each of (Z, Y, X) blocks from the nearest occupied one, at most ``REACH``.

    Cost: 6 ``REACH`` look-ups each at most, one axis after the other.
    """
    z, y, x = counts
    far = dr.select(occupied, mi.UInt8(0), mi.UInt8(REACH))
    for stride, n in ((1, x), (x, y), (x * y, z)):
        dr.eval(far)
        far = _nearest(far, stride, n)
    dr.eval(far)
    return far


@dr.syntax
def _nearest(far: mi.UInt8, stride: int, n: int) -> mi.UInt8:
    """Extend distances that are right across the axes before to one more axis.

    The distance of a place is the smallest, over its neighbours along the axis, of the larger of two numbers: how far the
    neighbour is along the axis, and the neighbour's own distance ``far`` across the other axes.
    """
    here = dr.arange(mi.Int32, dr.width(far))
    place = here // stride % n
    best = mi.UInt8(far)
    k = mi.Int32(1)
    while k < mi.Int32(best):
        low = dr.gather(mi.UInt8, far, mi.UInt32(here - k * stride), place >= k)
        high = dr.gather(mi.UInt8, far, mi.UInt32(here + k * stride), place + k < n)
        low = dr.select(place >= k, low, mi.UInt8(REACH))
        high = dr.select(place + k < n, high, mi.UInt8(REACH))
        best = dr.minimum(best, dr.maximum(dr.minimum(low, high), mi.UInt8(k)))
        k += 1
    return best
