"""The pieces of a ray through nested boxes: one after the other, each in the box of one level.

Boxes have the same middle and twice the extent from level to level; what the inner box covers is not in the outer one. So of k
levels a ray crosses at most 2 k - 1 pieces: inwards through the levels k - 1, ..., 1, through the innermost, and out again.
Piece p lies in the level that is the distance of p from k - 1. A single box is the case k = 1 of one piece.

Conventions. A level is walked in its *own* lengths, which are 2^-l of the world's, so that all levels have one lattice. Entries
and exits are found in float64, as those of a single box are.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.lattice import Segment, clip, segment_between, slab
from mivol.transport.traversal.occupied_cells import Cells

__all__ = ["Piece", "pieces", "piece_of"]


@dataclass
class Piece:
    """The part of a ray in the box of one level and not in that of the level before.

    Attributes:
        level: counted from the innermost, 0.
        segment: in the level's own lattice and lengths; its length is 0 where the ray has no such part.
        scale: own lengths times this are lengths of the world: 2^level.
    """

    level: mi.Int32
    segment: Segment
    scale: mi.Float


def pieces(cells: Cells) -> int:
    """Number of pieces that a ray through nested boxes may have."""
    return 2 * cells.levels - 1


def piece_of(cells: Cells, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float | float, number: mi.Int32) -> Piece:
    """A piece of rays.

    Args:
        cells: whose place and levels they cross.
        o, d: world rays, |d| = 1.
        t_max: where the rays end [length]; may be infinite.
        number: of the piece, from 0 in the order of the ray.
    """
    if cells.levels == 1:
        return Piece(mi.Int32(0), clip(cells, o, d, mi.Float(0), t_max), mi.Float(1))
    n = cells.res[::-1]
    last = dr.opaque(mi.Int32, cells.levels - 1)
    level = dr.abs(number - last)
    size = mi.Float64(mi.Int32(1) << level)
    shrink = 1 / size
    middle = [0.5 * (k - 1) for k in n]
    f64 = mi.Float64
    # The ray's origin as seen from the middle at 2^-level of its distance; the direction is the same in own lengths.
    place = []
    for row, m in zip(cells.from_world, middle, strict=True):
        q = dr.fma(row[0], f64(o[0]), dr.fma(row[1], f64(o[1]), dr.fma(row[2], f64(o[2]), row[3])))
        place.append(dr.fma(q - m, shrink, m))
    speed = [dr.fma(row[0], f64(d[0]), dr.fma(row[1], f64(d[1]), row[2] * f64(d[2]))) for row in cells.from_world]
    own = [[f64(a == b) for b in range(3)] + [f64(0)] for a in range(3)]
    q, v, start, end = slab(own, (-0.5,) * 3, tuple(k - 0.5 for k in n), place, speed, f64(0), f64(t_max) * shrink)
    inner = [tuple(m + sign * 0.25 * k for m, k in zip(middle, n, strict=True)) for sign in (-1, 1)]
    _, _, entry, leave = slab(own, *inner, place, speed, start, end)
    crosses = leave > entry
    inwards, outwards = number < last, number > last
    t0 = dr.select(outwards, dr.select(crosses, leave, end), start)
    t1 = dr.select(inwards & crosses, entry, end)
    return Piece(level, segment_between(q, v, n, t0, t1), mi.Float(size))
