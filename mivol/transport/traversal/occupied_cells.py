"""The non-empty cells of a grid, and a walk along rays that visits only these.

Conventions. Cells and nodes are those of :mod:`mivol.transport.traversal.lattice`: a cell lies between two nodes along each
axis, -1 to N - 1, border nodes are repeated. ``Cells.index`` tells of each cell of the box whether it is occupied and where it
stands in the list, or how far a ray may go from there in one step. That takes four bytes for 64 cells of the box, and all else
goes with the occupied ones.

Levels. A grid may be one of several nested ones (:mod:`mivol.fields.spherical`): all have the same nodes, and their cells are
counted one level after the other. A walk goes through one of them; :mod:`mivol.transport.traversal.nested_path` says which
piece of a ray lies in which.

The search for the next occupied cell is an inner loop of its own. Lanes of a packet then wait for each other in the search,
where a step costs one read, and visit cells, which costs far more, together.

References: Amanatides & Woo 1987 (the traversal); Cohen & Sheffer 1994 (proximity clouds: distances that a ray may skip).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.numerics import greater, lesser
from mivol.space import check_affine, lattice_from_world
from mivol.transport.traversal.cell_index import CellIndex
from mivol.transport.traversal.interpolation import GAUSS
from mivol.transport.traversal.lattice import Segment

__all__ = ["CellVisitor", "Cells", "end_of", "march", "reversed_from"]


@dataclass
class Cells:
    """The occupied cells of a grid.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube to world.
        count: number of occupied cells.
        index: of the (Z + 1) (Y + 1) (X + 1) cells of each level: which of ``corners`` each is, and ways through empty ones.
        corners: UInt32, 8 a cell: indices of its nodes in ``rows``; bits 0, 1, 2 of the corner are x, y, z.
        rows: UInt32, the rows of the nodes of listed cells, each once.
        from_world: (3, 4) map from the world to lattice coordinates of the innermost level.
        levels: nested grids.
    """

    res: tuple[int, int, int]
    to_world: np.ndarray
    count: int
    index: CellIndex
    corners: mi.UInt32
    rows: mi.UInt32
    from_world: list[list[mi.Float64]]
    levels: int = 1

    @classmethod
    def find(
        cls,
        res: tuple[int, int, int],
        to_world: np.ndarray,
        row_of: Callable[[mi.UInt32], mi.UInt32],
        occupied: Callable[[list[mi.UInt32]], mi.Bool],
        most: int,
        levels: int = 1,
        stored: mi.UInt32 | None = None,
    ) -> Cells:
        """Find the occupied cells of a grid.

        Args:
            res: nodes (Z, Y, X).
            to_world: (4, 4) affine map of the unit cube.
            row_of: the row of nodes of all levels, by their flat numbers, x fastest.
            occupied: ``occupied(rows of the 8 corners) -> mask`` of cells to list; called once.
            most: rows that there are.
            levels: nested grids.
            stored: flat numbers of all nodes that may make a cell occupied; None for any.

        Raises:
            MivolError: more cells than a 32-bit number counts.

        Cost: 8 reads and what ``occupied`` reads for each cell of the bricks of 4^3 cells at ``stored`` nodes.
        """
        z, y, x = res
        total = levels * (z + 1) * (y + 1) * (x + 1)
        if total >= 2**31:
            found = f"{levels} x {x} x {y} x {z}" if levels > 1 else f"{x} x {y} x {z}"
            raise MivolError(f"a grid of {found} nodes was given; its cells are counted up to 2^31: split it.")
        index, listed = CellIndex.find(res, levels, lambda cell: occupied(_corner_rows(cell, row_of, res)), stored)
        count = dr.width(listed)
        # Dr.Jit cannot gather from an array of length 0, not even with all lanes inactive. Where no cell is occupied the arrays
        # hold one cell, to which no number points.
        named = _corner_rows(listed if count else mi.UInt32(0), row_of, res)
        used, place = _numbered(named, most)
        corners = dr.zeros(mi.UInt32, 8 * max(count, 1))
        for q, row in enumerate(named):
            dr.scatter(corners, dr.gather(mi.UInt32, place, row), dr.arange(mi.UInt32, max(count, 1)) * 8 + q)
        to_world = check_affine(to_world)
        to_lattice = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in lattice_from_world(to_world, res)]
        dr.eval(corners, used)
        return cls(res, to_world, count, index, corners, used, to_lattice, levels)

    def nodes(self, number: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
        """The 8 corners of listed cells, in ``rows``."""
        return list(dr.gather(mi.ArrayXu, self.corners, number, active, shape=(8, 1)))

    def node_rows(self, number: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
        """The rows of the 8 corners of listed cells."""
        return [dr.gather(mi.UInt32, self.rows, node, active) for node in self.nodes(number, active)]


def _numbered(rows: list[mi.UInt32], most: int) -> tuple[mi.UInt32, mi.UInt32]:
    """The distinct numbers among ``rows`` (each at most ``most``), ascending, and for each number its index among them."""
    used = dr.zeros(mi.UInt8, most + 1)
    for row in rows:
        dr.scatter(used, mi.UInt8(1), row)
    different = dr.compress(used > 0)
    place = dr.zeros(mi.UInt32, most + 1)
    dr.scatter(place, dr.arange(mi.UInt32, dr.width(different)), different)
    return different, place


def _apart(cell: mi.UInt32, res: tuple[int, int, int]) -> tuple[mi.Int32, mi.Int32, mi.Int32]:
    """Indices along x, y, z of cells within their level, from their flat index; index 0 is the outer half voxel."""
    z, y, x = res
    across, slab = x + 1, (x + 1) * (y + 1)
    return mi.Int32(cell % across), mi.Int32(cell // across % (y + 1)), mi.Int32(cell // slab % (z + 1))


def _between(place: mi.Int32, n: int) -> tuple[mi.Int32, mi.Int32]:
    """The lower and the upper node of cells along one axis, clamped to the grid; cell 0 is the outer half voxel."""
    return dr.maximum(place - 1, 0), dr.minimum(place, n - 1)


def _corner_rows(
    cell: mi.UInt32, row_of: Callable[[mi.UInt32], mi.UInt32], res: tuple[int, int, int]
) -> list[mi.UInt32]:
    """Rows of the 8 corners of cells, from their flat index."""
    z, y, x = res
    i, j, k = (_between(a, n) for a, n in zip(_apart(cell, res), (x, y, z), strict=True))
    level = mi.Int32(cell // math.prod(n + 1 for n in res)) * z
    return [row_of(mi.UInt32(((level + c) * y + b) * x + a)) for c in k for b in j for a in i]


@dataclass
class CellVisitor:
    """What a visitor is told of one occupied cell.

    Attributes:
        number: index in the list of occupied cells.
        points: the two Gauss points, as fractions along the grid's own axes, in the order in which the ray meets them.
        t: length walked before the cell [length].
        dt: length in the cell [length].
        along: the points, as fractions along each axis in the sense of the ray.
        cell: the lower node of the cell.
        level: that the cell lies in.
        ahead: for each axis whether the ray runs upwards along it.
        entered: the axis whose face the ray has come through from the cell that was visited before; -1 where it has come from
            another cell, or along an edge.
        leaves: the axis whose face the ray leaves through; the first of them at an edge.
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
def march(
    cells: Cells,
    segment: Segment,
    visit: Callable[[Any, CellVisitor, mi.Bool], Any],
    state: Any,
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
    level: mi.Int32 | int = 0,
) -> tuple[Any, mi.Vector3i, mi.Float]:
    """Visit the occupied cells that a segment crosses, in order.

    Args:
        cells: the list.
        segment: from :func:`mivol.transport.traversal.lattice.clip`, or :func:`reversed_from`.
        visit: ``visit(state, here, active) -> state``, called once, while the loop is traced.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.
        until: ``until(state) -> mask`` of lanes that need not go on, asked after each cell; None to walk to the end.
        level: that the segment lies in, in the level's own lattice coordinates.

    Returns:
        The last state, the last cell visited (lower node), and where the ray left it [length from the segment's start].

    Error: positions are off by at most 2^-23 (X + Y + Z) of a cell.
    Cost: two reads a search step, at most X + Y + Z + 3 of them, fewer where all around is empty.
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
            brick, free = index.look(first + sign * n, level, ahead, searching)
            searching &= free.x > 0
            ends = n + free
            reach = dr.fma(mi.Vector3f(ends) - entry, pace, never)
            exit = lesser(lesser(reach.x, reach.y), reach.z)
            there = dr.clip(mi.Vector3i(dr.fma(speed, exit, entry)), n, ends - 1)
            there = dr.select(reach <= exit, ends, there)
            t = dr.select(searching, exit, t)
            n = dr.select(searching, there, n)
            entered = dr.select(searching, -1, entered)
            inside = (exit < length) & dr.all(there <= most)
            active &= inside | ~searching
            searching &= inside

        # -- Visit it, and leave it ----------------------------------------------------------------------------------------
        reach = dr.fma(mi.Vector3f(n + 1) - entry, pace, never)
        exit = lesser(lesser(reach.x, reach.y), reach.z)
        dt = greater(lesser(exit, length) - t, 0)
        offset = entry - mi.Vector3f(n)
        along = tuple(dr.clip(dr.fma(speed, dr.fma(dt, g, t), offset), 0, 1) for g in (GAUSS, 1 - GAUSS))
        points = tuple(dr.select(ahead, p, 1 - p) for p in along)
        through = reach <= exit
        leaves = dr.select(through.x, 0, dr.select(through.y, 1, mi.Int32(2)))
        cell = segment.cell + sign * n
        here = CellVisitor(index.rank(cell + 1, brick, active), points, t, dt, along, cell, level, ahead, entered, leaves)
        state = visit(state, here, active)
        last = dr.select(active, cell, last)
        left = dr.select(active, t + dt, left)
        n = dr.select(through, n + 1, n)
        entered = dr.select(dr.count(through) == 1, leaves, -1)
        t = exit
        active &= (exit < length) & dr.all(n <= most)
        if until is not None:
            active &= ~until(state)
    return state, last, left


def end_of(segment: Segment) -> mi.Vector3i:
    """The cell (lower node) in which a segment ends, found in float64: one of the two that a face divides."""
    cell = mi.Vector3i()
    for a in range(3):
        speed = mi.Float64(segment.d[a]) + mi.Float64(segment.d_rest[a])
        cell[a] = segment.cell[a] + mi.Int32(dr.floor(dr.fma(speed, mi.Float64(segment.length), mi.Float64(segment.frac[a]))))
    return cell


def reversed_from(segment: Segment, cell: mi.Vector3i, t: mi.Float, until: mi.Float) -> Segment:
    """The reversed segment from the point in ``cell`` at ``t`` back to ``until`` [lengths from the start of ``segment``]."""
    planes = mi.Vector3f(cell - segment.cell)
    frac = dr.clip(dr.fma(segment.d, t, segment.frac - planes), 0, 1)
    return Segment(cell, frac, -segment.d, -segment.d_rest, segment.t0 + t, t - until)
