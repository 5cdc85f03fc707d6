"""The walk of a ray through the occupied cells of a grid, or of nested grids.

The search for the next occupied cell is an inner loop of its own. Lanes of a packet wait for each other in the search, where a
step costs a read, and then visit cells, which costs far more, together.

Nested boxes. Boxes have the same middle and twice the extent from level to level; an outer level leaves out the box of the
level inside. A ray through k levels crosses at most 2 k - 1 pieces: inwards through the levels k - 1, ..., 1, through the
innermost level, and out again. Piece p lies in the level |p - (k - 1)|. A single box (k = 1) has a single piece. A level is
walked in its *own* lengths, 2^-l of the lengths of the world, so all levels have the same lattice. Entries and exits are found
in float64.

References: Amanatides & Woo 1987 (the traversal); Cohen & Sheffer 1994 (proximity clouds: distances for a ray to skip).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.numerics import fast_max, fast_min
from mivol.transport.traversal.box import clip_to_box, map_point, map_vector
from mivol.transport.traversal.interpolation import GAUSS_POINT
from mivol.transport.traversal.lattice import Segment, clip_to_grid, segment_between
from mivol.transport.traversal.occupied_cells import OccupiedCells

__all__ = ["OccupiedCell", "walk_occupied_cells", "find_last_cell", "reverse_segment", "Piece", "count_pieces", "find_piece"]


@dataclass
class OccupiedCell:
    """An occupied cell as a visitor sees it.

    Attributes:
        number: index in the list of occupied cells.
        points: the two Gauss points, as fractions along the axes of the grid, in the order of the ray.
        t: length walked before the cell [length].
        dt: length in the cell [length].
        along: the two Gauss points, as fractions along each axis in the direction of the ray.
        cell: lower node of the cell.
        level: level of the cell.
        ahead: axes along which the ray runs upwards.
        entered: axis of the face between this cell and the previously visited cell; -1 after an unvisited cell or an edge.
        leaves: axis of the face of exit; the first axis at an edge.
    """

    number: mi.UInt32
    points: tuple[mi.Vector3f, mi.Vector3f]
    t: mi.Float
    dt: mi.Float
    along: tuple[mi.Vector3f, mi.Vector3f]
    cell: mi.Vector3i
    level: mi.Int32 | int
    ahead: Any
    entered: mi.Int32
    leaves: mi.Int32


@dr.syntax
def walk_occupied_cells(
    cells: OccupiedCells,
    segment: Segment,
    visit: Callable[[Any, OccupiedCell, mi.Bool], Any],
    state: Any,
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
    level: mi.Int32 | int = 0,
) -> tuple[Any, mi.Vector3i, mi.Float]:
    """Visit the occupied cells along a segment, in order.

    Args:
        cells: list of the occupied cells.
        segment: from :func:`mivol.transport.traversal.lattice.clip_to_grid`, or :func:`reverse_segment`.
        visit: ``visit(state, cell, active) -> state``, called once, while Dr.Jit traces the loop.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.
        until: ``until(state) -> mask`` of lanes to stop, evaluated after each cell; None to walk to the end.
        level: level of the segment, which is in the lattice coordinates of this level.

    Returns:
        The last state, the last visited cell (lower node), and the distance of its exit from the start of the segment [length].

    Error: positions are off by at most 2^-23 (X + Y + Z) of a cell.
    Cost: two reads a search step, at most X + Y + Z + 3 steps, fewer in empty surroundings.
    """
    # -- State: n counts the cells crossed since the first, along each axis ----------------------------------------------
    index, length = cells.index, segment.length
    z, y, x = cells.res
    # An axis to which the ray is parallel counts as ahead: its fraction is then used as it is, without a rounding.
    ahead = segment.d >= 0
    sign = dr.select(ahead, mi.Vector3i(1), mi.Vector3i(-1))
    first = segment.cell + 1
    most = dr.select(ahead, mi.Vector3i(x, y, z) - first, first)
    entry = dr.select(ahead, segment.frac, 1 - segment.frac)
    speed = dr.abs(segment.d)
    still = speed < 1e-30
    pace = dr.select(still, 0, dr.rcp(speed))
    never = dr.select(still, mi.Vector3f(1e30), 0)

    active = mi.Bool(active) & (length > 0)
    n = mi.Vector3i(0)
    t = mi.Float(0)
    entered = mi.Int32(-1)
    last, left = mi.Vector3i(segment.cell), mi.Float(0)

    while dr.hint(active, label="march"):
        # -- The next occupied cell --------------------------------------------------------------------------------------
        brick = mi.UInt32(0)
        searching = mi.Bool(active)
        while dr.hint(searching, label="search"):
            brick, free = index.look_up(first + sign * n, level, ahead, searching)
            searching &= free.x > 0
            ends = n + free
            reach = dr.fma(mi.Vector3f(ends) - entry, pace, never)
            exit = fast_min(fast_min(reach.x, reach.y), reach.z)
            arrival = dr.clip(mi.Vector3i(dr.fma(speed, exit, entry)), n, ends - 1)
            arrival = dr.select(reach <= exit, ends, arrival)
            t = dr.select(searching, exit, t)
            n = dr.select(searching, arrival, n)
            entered = dr.select(searching, -1, entered)
            inside = (exit < length) & dr.all(arrival <= most)
            active &= inside | ~searching
            searching &= inside

        # -- Visit it, and leave it ----------------------------------------------------------------------------------------
        reach = dr.fma(mi.Vector3f(n + 1) - entry, pace, never)
        exit = fast_min(fast_min(reach.x, reach.y), reach.z)
        dt = fast_max(fast_min(exit, length) - t, 0)
        offset = entry - mi.Vector3f(n)
        along = tuple(dr.clip(dr.fma(speed, dr.fma(dt, g, t), offset), 0, 1) for g in (GAUSS_POINT, 1 - GAUSS_POINT))
        points = tuple(dr.select(ahead, p, 1 - p) for p in along)
        through = reach <= exit
        leaves = dr.select(through.x, 0, dr.select(through.y, 1, mi.Int32(2)))
        cell = segment.cell + sign * n
        visited = OccupiedCell(index.rank(cell + 1, brick, active), points, t, dt, along, cell, level, ahead, entered, leaves)
        state = visit(state, visited, active)
        last = dr.select(active, cell, last)
        left = dr.select(active, t + dt, left)
        n = dr.select(through, n + 1, n)
        entered = dr.select(dr.count(through) == 1, leaves, -1)
        t = exit
        active &= (exit < length) & dr.all(n <= most)
        if until is not None:
            active &= ~until(state)
    return state, last, left


def find_last_cell(segment: Segment) -> mi.Vector3i:
    """The cell (lower node) at the end of a segment, found in float64: either of the two cells at a face."""
    cell = mi.Vector3i()
    for a in range(3):
        speed = mi.Float64(segment.d[a]) + mi.Float64(segment.d_rest[a])
        cell[a] = segment.cell[a] + mi.Int32(dr.floor(dr.fma(speed, mi.Float64(segment.length), mi.Float64(segment.frac[a]))))
    return cell


def reverse_segment(segment: Segment, cell: mi.Vector3i, t: mi.Float, until: mi.Float) -> Segment:
    """The reversed segment from the point in ``cell`` at ``t`` back to ``until`` [lengths from the start of ``segment``]."""
    planes = mi.Vector3f(cell - segment.cell)
    frac = dr.clip(dr.fma(segment.d, t, segment.frac - planes), 0, 1)
    return Segment(cell, frac, -segment.d, -segment.d_rest, segment.t0 + t, t - until)


@dataclass
class Piece:
    """The part of a ray in the box of a level and outside the box of the level inside.

    Attributes:
        level: counted from the innermost level, 0.
        segment: in the lattice and the lengths of the level; its length is 0 if the ray has no such part.
        scale: factor from lengths of the level to lengths of the world, 2^level.
    """

    level: mi.Int32
    segment: Segment
    scale: mi.Float


def count_pieces(cells: OccupiedCells) -> int:
    """Largest number of pieces of a ray through nested boxes."""
    return 2 * cells.levels - 1


def find_piece(cells: OccupiedCells, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float | float, number: mi.Int32) -> Piece:
    """Find a piece of rays.

    Args:
        cells: place and levels of the boxes.
        o, d: world rays, |d| = 1.
        t_max: end of the rays [length]; may be infinite.
        number: index of the piece, from 0 in the order of the ray.
    """
    if cells.levels == 1:
        return Piece(mi.Int32(0), clip_to_grid(cells, o, d, mi.Float(0), t_max), mi.Float(1))
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
        place.append(dr.fma(map_point(row, o) - m, shrink, m))
    speed = [map_vector(row, d) for row in cells.from_world]
    own = [[f64(a == b) for b in range(3)] + [f64(0)] for a in range(3)]
    q, v, start, end = clip_to_box(own, (-0.5,) * 3, tuple(k - 0.5 for k in n), place, speed, f64(0), f64(t_max) * shrink)
    inner = [tuple(m + sign * 0.25 * k for m, k in zip(middle, n, strict=True)) for sign in (-1, 1)]
    _, _, entry, leave = clip_to_box(own, *inner, place, speed, start, end)
    crosses = leave > entry
    inwards, outwards = number < last, number > last
    t0 = dr.select(outwards, dr.select(crosses, leave, end), start)
    t1 = dr.select(inwards & crosses, entry, end)
    return Piece(level, segment_between(q, v, n, t0, t1), mi.Float(size))
