"""The walk of a ray through the leaves of an octree, from leaf plane to leaf plane.

Index. A table holds an entry for each of 2^top cells along each axis. An entry is a leaf, vacuum, or the number of a brick of
4 x 4 x 4 entries, each a quarter of the edge; bricks nest until their entries are cells. A brick of cells is two records, for
its lower and its upper half along z: a bit for each cell with matter, a bit for each cell that begins a leaf, and the number
of leaves before the half. Bits, like leaves, stand in the order of codes, so the row of a leaf is that number plus the count
of leaves that begin up to its cell. A look-up reads two records at up to 256 cells along an axis, and four at most; a record
is 16 bytes for 32 cells. Vacuum has a reach r: the ray may cross r - 1 more entries of the table, in the octant of its
direction, or r - 1 more octants of a brick, on every side (Chebyshev distance).

Planes. The cell of a ray is a whole number along each axis, and the distance of a plane is computed from its number and the
point of entry, so nothing accumulates along a ray. A ray in a plane, an edge or a corner belongs to one of the
cells beside it, by the whole number, and never stands still: at least one axis advances by a cell in each step.

References: Amanatides & Woo 1987 (the traversal); Cohen & Sheffer 1994 (distances for a ray to skip);
    Jacobson 1989 (rank of a bit in constant time).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.octree import Octree, cells_of, edges_of, separate
from mivol.numerics import fast_max, fast_min
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.grid_blocks import find_distances
from mivol.transport.traversal.lattice import Segment, split_float64

__all__ = ["LeafIndex", "VisitedLeaf", "clip_to_octree", "reverse_from", "walk_leaves"]

BRICK = 1 << 31
"""Flag of an entry that is the number of a brick."""

SIZE_SHIFT, ROW_MASK = 27, (1 << 27) - 1
"""An entry of a leaf or of vacuum: logarithm of its edge [cells] above bit 27, its row or reach below."""

FIRST_REACH = (1 << 27) - 4096
"""The row of vacuum in a brick."""

FAR = 15 << 27
"""Flag of vacuum in the table: a code of 3 bits for the reach towards each octant of directions follows."""

TOP = 6
"""Largest logarithm of the edge of the table: 1 MiB."""

HALF = 32
"""Cells of a record of half a brick."""

FINE = 9
"""Largest depth at which octants have reaches: the distances of 256^3 octants."""


@dataclass
class LeafIndex:
    """The leaves of an octree as a ray finds them.

    Attributes:
        depth: levels below the root.
        top: logarithm of the edge of the table.
        table: UInt32, an entry for each cell of the table, x fastest.
        bricks: UInt32, 64 entries a brick, x fastest; a dummy without bricks of entries.
        halves: UInt32, 4 numbers for each half of a brick of cells: cells with matter, cells that begin a leaf, leaves before
            it, and a byte for the reach of each octant; a dummy without bricks of cells.
        from_world: (3, 4) map from the world to cells: cell (i, j, k) begins at (i, j, k).
        low, high: first cell with a leaf, and the cell after the last one, along x, y and z: rays are clipped to this box.
    """

    depth: int
    top: int
    table: mi.UInt32
    bricks: mi.UInt32
    halves: mi.UInt32
    from_world: list[list[mi.Float64]]
    low: list[mi.Float64]
    high: list[mi.Float64]

    @property
    def bytes(self) -> int:
        """Memory of the index [bytes]."""
        return 4 * (dr.width(self.table) + dr.width(self.bricks) + dr.width(self.halves))

    @classmethod
    def find(cls, tree: Octree) -> LeafIndex:
        """Build the index of an octree, in NumPy."""
        depth = tree.depth
        steps = max(0, -(-(depth - TOP) // 2))
        top = depth - 2 * steps
        leaf = np.arange(tree.leaves, dtype=np.uint32) | tree.sizes.astype(np.uint32) << np.uint32(SIZE_SHIFT)
        first, size = tree.codes, tree.sizes.astype(np.int64)
        table, shift = _fill_table(first, size, leaf, depth, top), depth - top
        # Codes of the bricks of a level, ascending; a brick of the level above holds their numbers.
        inner = np.unique(first[size < shift] >> np.uint64(3 * shift)) if steps else np.zeros(0, np.uint64)
        table[_flat(separate(inner, top), 1 << top)] = BRICK | np.arange(len(inner), dtype=np.uint32)
        levels, before = [], 0
        for step in range(steps - 1):
            edge = shift - 2 * step - 2  # logarithm of the edge of an entry
            own = (size < edge + 2) & (size >= edge)
            entries = np.zeros((len(inner), 64), np.uint32)
            _fill_bricks(entries, inner, first[own], size[own], leaf[own], edge)
            before += len(inner)
            following = np.unique(first[size < edge] >> np.uint64(3 * edge))
            place = np.searchsorted(inner, following >> np.uint64(6))
            # Bricks of cells have numbers of their own, since they are stored apart.
            numbers = np.arange(len(following), dtype=np.uint32) + (0 if step == steps - 2 else before)
            entries[place, _flat(separate(following & np.uint64(63), 2), 4)] = BRICK | numbers.astype(np.uint32)
            _mark_vacuum(entries, edge)
            levels.append(entries.reshape(-1))
            inner = following
        halves = _make_halves(tree, inner) if steps else np.zeros(4, np.uint32)
        _mark_far_vacuum(table, 1 << top)
        flat = np.concatenate(levels) if levels else np.zeros(64, np.uint32)
        rows = np.linalg.inv(tree.to_world)[:3] * 2**depth
        from_world = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in rows]
        corners = tree.corners()
        low, high = corners.min(axis=0), (corners + edges_of(tree.sizes)[:, None]).max(axis=0)
        ends = ([dr.opaque(mi.Float64, float(v)) for v in end] for end in (low, high))
        tables = (mi.UInt32(np.ascontiguousarray(a).reshape(-1)) for a in (table, flat, halves))
        return cls(depth, top, *tables, from_world, *ends)

    def look_up(self, cell: mi.Vector3i, towards: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool, mi.Int32, mi.Int32]:
        """Look up the leaf of cells.

        Args:
            cell: along x, y and z.
            towards: octant of the ray's direction, from :func:`find_octant`.
            active: lanes to look up.

        Returns:
            Row of the leaf, whether there is a leaf, edge of the leaf or vacuum, and the number of cells beyond this edge that
            are vacuum, on the side to which the ray runs.
        """
        shift = self.depth - self.top
        place = cell >> shift
        at = mi.UInt32(place.x + ((place.y + (place.z << self.top)) << self.top))
        entry = dr.gather(mi.UInt32, self.table, at, active)
        while shift > 2:
            shift -= 2
            inside = (cell >> shift) & 3
            local = mi.UInt32(inside.x | inside.y << 2 | inside.z << 4)
            descends = active & (entry >= BRICK)
            below = dr.gather(mi.UInt32, self.bricks, ((entry & (BRICK - 1)) << 6) | local, descends)
            entry = dr.select(descends, below, entry)
        size = mi.Int32((entry >> SIZE_SHIFT) & 15)
        row = entry & ROW_MASK
        is_leaf = row < FIRST_REACH
        is_far = (entry >= FAR) & (entry < BRICK)
        code = (entry >> (3 * towards)) & 7
        # Codes 0 to 7: a reach of 1, 1, 2, 3, 4, 6, 8, 12.
        far = mi.Int32(((2 + (code & 1)) << (code >> 1)) >> 1)
        size, is_leaf = dr.select(is_far, self.depth - self.top, size), is_leaf & ~is_far
        reach = dr.select(is_far, far, 1)
        if shift:
            is_brick = entry >= BRICK
            fine = self._look_up_half(cell, entry & (BRICK - 1), active & is_brick)
            row, is_leaf, size, reach = (
                dr.select(is_brick, a, b) for a, b in zip(fine, (row, is_leaf, size, reach), strict=True)
            )
        return row, is_leaf, mi.Int32(1) << size, (reach - 1) << size

    def _look_up_half(
        self, cell: mi.Vector3i, brick: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool, mi.Int32, mi.Int32]:
        """Look up cells in a brick of cells: row, whether there is a leaf, logarithm of the edge, and reach."""
        half = 2 * brick + mi.UInt32((cell.z >> 1) & 1)
        filled, begins, before, reaches = dr.gather(mi.ArrayXu, self.halves, half, active, shape=(4, 1))
        inside = cell & 1
        octant = mi.UInt32((cell.x >> 1) & 1 | ((cell.y >> 1) & 1) << 1)
        bit = mi.UInt32(inside.x | inside.y << 1 | inside.z << 2) | octant << 3
        row = before + dr.popcnt(begins & ((mi.UInt32(2) << bit) - 1)) - 1
        own, own_begins = ((word >> (octant << 3)) & 0xFF for word in (filled, begins))
        is_empty = own == 0
        is_large = is_empty | ((own == 0xFF) & (own_begins == 1))
        reach = dr.select(is_empty, mi.Int32((reaches >> (octant << 3)) & 0xFF), 1)
        return row, ((filled >> bit) & 1) > 0, dr.select(is_large, mi.Int32(1), 0), reach


def _make_halves(tree: Octree, bricks: np.ndarray) -> np.ndarray:
    """The records (2 bricks, 4) of bricks of cells, from the codes of the bricks, ascending."""
    fine = np.flatnonzero(tree.sizes < 2)
    codes = tree.codes[fine]
    place = 2 * np.searchsorted(bricks, codes >> np.uint64(6)) + (codes >> np.uint64(5) & np.uint64(1)).astype(np.int64)
    bit = (codes & np.uint64(31)).astype(np.uint32)
    cells = np.where(tree.sizes[fine] == 1, np.uint32(0xFF), np.uint32(1))
    records = np.zeros((2 * len(bricks), 4), np.uint32)
    np.bitwise_or.at(records[:, 0], place, cells << bit)
    np.bitwise_or.at(records[:, 1], place, np.uint32(1) << bit)
    starts = (bricks[:, None] << np.uint64(6) | np.arange(2, dtype=np.uint64) << np.uint64(5)).reshape(-1)
    records[:, 2] = np.searchsorted(tree.codes, starts)
    records[:, 3] = _octant_reaches(tree, starts)
    return records


def _octant_reaches(tree: Octree, starts: np.ndarray) -> np.ndarray:
    """A byte for the reach of each of the 4 octants of halves that begin at the codes ``starts``; 1 in octants with a leaf."""
    if tree.depth > FINE:
        return np.full(len(starts), 0x01010101, np.uint32)
    n = 1 << (tree.depth - 1)
    is_filled = np.zeros(n**3, bool)
    octants, _ = _spread(tree.codes >> np.uint64(3), np.maximum(tree.sizes.astype(np.int64) - 1, 0))
    is_filled[_flat(separate(octants, tree.depth - 1), n)] = True
    distance = np.array(find_distances(mi.Bool(is_filled), (n, n, n)))
    own = (starts[:, None] >> np.uint64(3)) + np.arange(4, dtype=np.uint64)
    reach = distance[_flat(separate(own.reshape(-1), tree.depth - 1), n)].reshape(-1, 4).astype(np.uint32)
    return (np.maximum(reach, 1) << (8 * np.arange(4, dtype=np.uint32))).sum(axis=1, dtype=np.uint32)


def _flat(place: np.ndarray, n: int) -> np.ndarray:
    """Flat numbers, x fastest, of places (m, 3) in a cube of n along each axis."""
    return place[:, 0] + n * (place[:, 1] + n * place[:, 2])


def _fill_table(first: np.ndarray, size: np.ndarray, leaf: np.ndarray, depth: int, top: int) -> np.ndarray:
    """The table with the leaves that fill whole entries; other entries are 0."""
    table = np.zeros(8**top, np.uint32)
    shift = depth - top
    own = size >= shift
    place, which = _spread(first[own] >> np.uint64(3 * shift), size[own] - shift)
    table[_flat(separate(place, top), 1 << top)] = leaf[own][which] + 1
    return table


def _spread(first: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Codes of all entries that leaves fill, and the number of the leaf of each entry."""
    counts = cells_of(size).astype(np.int64)
    which = np.repeat(np.arange(len(first)), counts)
    within = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return first[which] + within.astype(np.uint64), which


def _fill_bricks(
    entries: np.ndarray, inner: np.ndarray, first: np.ndarray, size: np.ndarray, leaf: np.ndarray, edge: int
) -> None:
    """Put leaves into the bricks ``inner`` whose entries have the edge 2^edge; other entries stay 0."""
    place, which = _spread(first >> np.uint64(3 * edge), size - edge)
    brick = np.searchsorted(inner, place >> np.uint64(6))
    entries[brick, _flat(separate(place & np.uint64(63), 2), 4)] = leaf[which] + 1


def _vacuum(size: int) -> np.uint32:
    """An entry of vacuum of the edge 2^size in a brick."""
    return np.uint32(size << SIZE_SHIFT | FIRST_REACH)


def _mark_vacuum(entries: np.ndarray, edge: int) -> None:
    """Replace the empty entries (0) of bricks by vacuum, of twice the edge in an empty octant; undo the shift of leaves."""
    octants = entries.reshape(-1, 2, 2, 2, 2, 2, 2)
    empty = (octants == 0).all(axis=(2, 4, 6), keepdims=True)
    vacuum = np.where(empty, _vacuum(edge + 1), _vacuum(edge))
    octants[...] = np.where(octants == 0, vacuum, np.where(octants < BRICK, octants - 1, octants))


def _mark_far_vacuum(table: np.ndarray, n: int) -> None:
    """Replace the empty entries (0) of the table by vacuum with a reach towards each octant; undo the shift of leaves."""
    is_filled = table > 0
    vacuum = np.full(len(table), FAR, np.uint32)
    for octant in range(8):
        # Axes z, y, x; an octant with its bit set runs downwards along the axis.
        turn = tuple(slice(None, None, -1 if octant >> axis & 1 else 1) for axis in (2, 1, 0))
        free = ~is_filled.reshape(n, n, n)[turn]
        code = np.zeros((n, n, n), np.uint32)
        for reach in range(2, REACHES[-1] + 1):
            # A cube of the edge r is free if the eight cubes of the edge r - 1 at its corners are; outside all is free.
            for axis in range(3):
                free = free & np.concatenate([np.take(free, range(1, n), axis), np.ones_like(np.take(free, [0], axis))], axis)
            if reach in REACHES:
                code[free] = CODES[REACHES.index(reach)]
        vacuum |= code[turn].reshape(-1) << np.uint32(3 * octant)
    table[...] = np.where(is_filled, np.where(table < BRICK, table - 1, table), vacuum)


REACHES, CODES = (2, 3, 4, 6, 8, 12), (2, 3, 4, 5, 6, 7)
"""Stored reaches above 1 [entries], and their codes of 3 bits."""


def find_octant(d: mi.Vector3f) -> mi.UInt32:
    """Octant of directions: bits 0, 1, 2 are set for directions downwards along x, y, z."""
    return sum((dr.select(d[a] >= 0, mi.UInt32(0), 1 << a) for a in range(3)), mi.UInt32(0))


@dataclass
class VisitedLeaf:
    """A leaf as a visitor sees it.

    Attributes:
        row: number of the leaf.
        t: length walked before the leaf [length].
        dt: length in the leaf [length].
    """

    row: mi.UInt32
    t: mi.Float
    dt: mi.Float


def clip_to_octree(
    index: LeafIndex, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float | float, t_min: mi.Float | float = 0.0
) -> Segment:
    """Clip intervals of world rays, |d| = 1, to the box of the leaves, in float64; ``t_max`` may be infinite."""
    low, high = index.low, index.high
    q, v, t0, t1 = clip_to_box(index.from_world, low, high, o, d, mi.Float64(t_min), mi.Float64(t_max))
    hit = t1 > t0
    t0 = dr.select(hit, t0, 0)
    cell, frac = mi.Vector3i(), mi.Vector3f()
    for a in range(3):
        entry = dr.clip(dr.fma(t0, v[a], q[a]), low[a], high[a])
        # A ray may enter through an upper face: it begins in the last cell, at its end.
        first = dr.minimum(dr.floor(entry), high[a] - 1)
        cell[a], frac[a] = mi.Int32(first), mi.Float(entry - first)
    speed = mi.Vector3f(*(mi.Float(x) for x in v))
    start, start_rest = split_float64(t0)
    return Segment(cell, frac, speed, mi.Vector3f(0), start, mi.Float(dr.select(hit, t1 - t0, 0)), start_rest)


@dr.syntax
def walk_leaves(
    index: LeafIndex,
    segment: Segment,
    visit: Callable[[Any, VisitedLeaf, mi.Bool], Any],
    state: Any,
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
) -> tuple[Any, mi.Vector3i, mi.Float]:
    """Visit the leaves along a segment, in order.

    Args:
        index: index of the leaves.
        segment: from :func:`clip_to_octree` or :func:`reverse_from`.
        visit: ``visit(state, leaf, active) -> state``, called once, while Dr.Jit traces the loop.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.
        until: ``until(state) -> mask`` of lanes to stop, evaluated after each leaf; None to walk to the end.

    Returns:
        The last state, the first visited cell of the last visited leaf, and the distance of its exit from the start of the
        segment [length]; the distance is 0 for a ray without leaves.

    Error: positions are off by at most 2^-23 (X + Y + Z) cells, for 2^depth cells along each axis.
    Cost: up to four reads a leaf, or stretch of vacuum.
    """
    length, d = segment.length, segment.d
    ahead = d >= 0
    least, end = (mi.Vector3i(*(mi.Int32(v) for v in side)) for side in (index.low, index.high))
    entry = mi.Vector3f(segment.cell) + segment.frac
    still = dr.abs(d) < 1e-30
    pace = dr.select(still, 0, dr.rcp(d))
    # The distance of plane k along an axis is pace k + offset; an axis to which the ray is parallel has no plane.
    offset = dr.select(still, mi.Vector3f(1e30), -entry * pace)
    behind, towards = dr.select(ahead, mi.Vector3i(0), mi.Vector3i(-1)), find_octant(d)

    def cross(cell: mi.Vector3i, edge: mi.Int32, beyond: mi.Int32) -> tuple[mi.Float, mi.Vector3i]:
        """Distance of the exit from a leaf or a stretch of vacuum, and the next cell."""
        low = (cell & -edge) - beyond
        high = low + (edge + 2 * beyond)
        plane = dr.select(ahead, high, low)
        reach = dr.fma(mi.Vector3f(plane), pace, offset)
        exit = fast_min(fast_min(reach.x, reach.y), reach.z)
        within = dr.clip(mi.Vector3i(dr.fma(d, exit, entry)), low, high - 1)
        return exit, dr.select(reach <= exit, plane + behind, within)

    # -- State ---------------------------------------------------------------------------------------------------------
    active = mi.Bool(active) & (length > 0)
    cell = mi.Vector3i(segment.cell)
    t = mi.Float(0)
    last, left = mi.Vector3i(cell), mi.Float(0)

    # -- The first leaf: most rays of a photograph meet none, and their packets end here ----------------------------------
    found, searching = mi.Bool(False), mi.Bool(active)
    while dr.hint(searching, label="vacuum"):
        row, is_leaf, edge, beyond = index.look_up(cell, towards, searching)
        found |= searching & is_leaf
        searching &= ~is_leaf
        exit, following = cross(cell, edge, beyond)
        cell = dr.select(searching, following, cell)
        t = dr.select(searching, fast_max(exit, t), t)
        searching &= (exit < length) & dr.all((cell >= least) & (cell < end))
    active = found

    # -- Leaf by leaf ----------------------------------------------------------------------------------------------------
    while dr.hint(active, label="leaves"):
        row, is_leaf, edge, beyond = index.look_up(cell, towards, active)
        exit, following = cross(cell, edge, beyond)
        stop = fast_max(fast_min(exit, length), t)
        on = active & is_leaf
        state = visit(state, VisitedLeaf(row, t, stop - t), on)
        last = dr.select(on, cell, last)
        left = dr.select(on, stop, left)
        cell = following
        t = stop
        active &= (exit < length) & dr.all((cell >= least) & (cell < end))
        if until is not None:
            active &= ~until(state)
    return state, last, left


def reverse_from(segment: Segment, leaf_cell: mi.Vector3i, t: mi.Float, until: mi.Float, index: LeafIndex) -> Segment:
    """The reversed segment from the exit of a leaf at ``t`` back to ``until`` [lengths from the start of ``segment``].

    Args:
        segment: segment of the walk.
        leaf_cell: a cell of the leaf.
        t, until: ends.
        index: index of the leaves, to find the cell of the exit within the leaf.
    """
    _, _, edge, _ = index.look_up(leaf_cell, mi.UInt32(0), t > until)
    low = leaf_cell & -edge
    place = dr.fma(segment.d, t, mi.Vector3f(segment.cell) + segment.frac)
    cell = dr.clip(mi.Vector3i(dr.floor(place)), low, low + edge - 1)
    frac = dr.clip(place - mi.Vector3f(cell), 0, 1)
    return Segment(cell, frac, -segment.d, -segment.d_rest, segment.t0 + t, t - until)
