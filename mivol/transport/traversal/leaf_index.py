"""The leaves of an octree as a ray finds them.

A record describes 4 x 4 x 2 cells, half a brick: a bit for each cell with matter, a bit for each cell that begins a leaf, and
the number of leaves before. Bits, like leaves, stand in the order of codes, so the row of a leaf is that number plus the count
of leaves that begin up to its cell. An octant of vacuum has a bit for each octant of directions, set if the seven octants
beside it on that side are vacuum too: a ray may cross two octants along each axis. Up to 256 cells along an axis there is a
record for every half brick, and a look-up reads one record. A brick of vacuum then has a free box for each octant of
directions: bricks along x, y and z that a ray may cross. A brick in a larger leaf has its row and its edge.

In deeper octrees most bricks are vacuum. A table holds an entry for each of 2^top cells along each axis. An entry is a leaf,
vacuum, or the number of a brick of 4 x 4 x 4 entries, each a quarter of the edge; bricks nest until their entries are cells,
and have two records. A look-up reads four numbers or records at most. Vacuum of the table has a reach for each octant of
directions.

References: Cohen & Sheffer 1994 (distances for a ray to skip); Jacobson 1989 (rank of a bit in constant time).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.octree import Octree, cells_of, edges_of, separate
from mivol.kernel_recording import copy_aligned

__all__ = ["LeafIndex", "find_octant"]

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

DENSE = 8
"""Largest depth at which every half brick has a record: 8 MiB."""

FINE = 9
"""Largest depth at which the surroundings of octants are known: bits of 256^3 octants."""

LONGEST = 15
"""Longest edge of a free box [bricks]: 4 bits."""


@dataclass
class LeafIndex:
    """The leaves of an octree as a ray finds them.

    Attributes:
        depth: levels below the root.
        top: logarithm of the edge of the table.
        table: UInt32, an entry for each cell of the table, x fastest; a dummy up to the depth ``DENSE``.
        bricks: UInt32, 64 entries a brick, x fastest; a dummy without bricks of entries.
        halves: UInt32, a record of 4 numbers for each half brick: cells with matter, cells that begin a leaf, leaves before it,
            and a byte for each octant with a bit for each octant of directions, set if the next octants are free too. Up to
            the depth ``DENSE`` the first number is 0 in a brick of vacuum, and the others hold the edges of its free boxes
            along x, y and z, 4 bits for each octant of directions; in a larger leaf they are no beginning, its row plus 1,
            and its edge minus 1 [cells].
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
        rows = np.linalg.inv(tree.to_world)[:3] * 2**depth
        from_world = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in rows]
        corners = tree.corners()
        low, high = corners.min(axis=0), (corners + edges_of(tree.sizes)[:, None]).max(axis=0)
        ends = ([dr.opaque(mi.Float64, float(v)) for v in end] for end in (low, high))
        dummy = np.zeros(1, np.uint32)
        top, *tables = (0, dummy, dummy, _make_records(tree)) if depth <= DENSE else _make_tables(tree)
        tables = (mi.UInt32(copy_aligned(np.ascontiguousarray(a).reshape(-1))) for a in tables)
        return cls(depth, top, *tables, from_world, *ends)

    def look_up(
        self, cell: mi.Vector3i, towards: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool, mi.Int32, mi.Vector3i]:
        """Look up the leaf of cells.

        Args:
            cell: along x, y and z.
            towards: octant of the ray's direction, from :func:`find_octant`.
            active: lanes to look up.

        Returns:
            Row of the leaf, whether there is a leaf, edge of the leaf or vacuum, and along each axis the number of cells beyond
            this edge that are vacuum too, on the side to which the ray runs.
        """
        if self.depth <= DENSE:
            return self._look_up_record(cell, towards, active)
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
        is_far, is_brick = (entry >= FAR) & (entry < BRICK), entry >= BRICK
        code = (entry >> (3 * towards)) & 7
        # Codes 0 to 7: a reach of 1, 1, 2, 3, 4, 6, 8, 12.
        far = mi.Int32(((2 + (code & 1)) << (code >> 1)) >> 1)
        size = dr.select(is_far, self.depth - self.top, size)
        half = 2 * (entry & (BRICK - 1)) + mi.UInt32((cell.z >> 1) & 1)
        found = HalfBrick.read(self.halves, half, cell, towards, active & is_brick)
        row = dr.select(is_brick, found.row, entry & ROW_MASK)
        is_leaf = dr.select(is_brick, found.is_leaf, (entry & ROW_MASK) < FIRST_REACH) & ~is_far
        size = dr.select(is_brick, dr.select(found.is_large, mi.Int32(1), 0), size)
        reach = dr.select(is_brick, found.more + 1, dr.select(is_far, far, 1))
        return row, is_leaf, mi.Int32(1) << size, mi.Vector3i((reach - 1) << size)

    def _look_up_record(
        self, cell: mi.Vector3i, towards: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool, mi.Int32, mi.Vector3i]:
        """The look-up where every half brick has a record."""
        across = _bricks_across(self.depth).bit_length() - 1
        half = (cell.x >> 2) | ((cell.y >> 2) << across) | ((cell.z >> 1) << (2 * across))
        found = HalfBrick.read(self.halves, mi.UInt32(half), cell, towards, active)
        is_larger = found.is_leaf & (found.begins == 0)
        boxes = [(word >> (4 * towards)) & LONGEST for word in (found.begins, found.before, found.beside)]
        # In an empty half of another brick, no leaf begins, and the first edge is 0.
        is_far = (found.filled == 0) & (boxes[0] > 0)
        edge = dr.select(is_larger, mi.Int32(found.beside) + 1, dr.select(found.is_large, mi.Int32(2), 1))
        near = dr.select(is_larger, 0, 2 * found.more)
        beyond = mi.Vector3i(*(dr.select(is_far, 4 * mi.Int32(box) - 4, near) for box in boxes))
        return found.row, found.is_leaf, dr.select(is_far, 4, edge), beyond


@dataclass
class HalfBrick:
    """Cells in their half bricks.

    Attributes:
        filled, begins, before, beside: the numbers of the record.
        row: row of the leaf.
        is_leaf: whether there is a leaf.
        is_large: whether a leaf or vacuum fills the octant of the cell.
        more: octants beyond the own one, along each axis, that are vacuum too: 0 or 1; 0 beside a leaf.
    """

    filled: mi.UInt32
    begins: mi.UInt32
    before: mi.UInt32
    beside: mi.UInt32
    row: mi.UInt32
    is_leaf: mi.Bool
    is_large: mi.Bool
    more: mi.Int32

    @classmethod
    def read(cls, halves: mi.UInt32, half: mi.UInt32, cell: mi.Vector3i, towards: mi.UInt32, active: mi.Bool) -> HalfBrick:
        """Read the record number ``half``, and find cells in it; ``towards`` is the octant of the ray's direction."""
        filled, begins, before, beside = dr.gather(mi.ArrayXu, halves, half, active, shape=(4, 1))
        octant = mi.UInt32((cell.x & 2) << 2 | (cell.y & 2) << 3)
        bit = mi.UInt32((cell.x & 1) | (cell.y & 1) << 1 | (cell.z & 1) << 2) | octant
        row = before + dr.popcnt(begins & ((mi.UInt32(2) << bit) - 1)) - 1
        own, own_begins = ((word >> octant) & 0xFF for word in (filled, begins))
        is_large = (own == 0) | ((own == 0xFF) & (own_begins == 1))
        more = mi.Int32((beside >> (octant + towards)) & 1)
        return cls(filled, begins, before, beside, row, ((filled >> bit) & 1) > 0, is_large, more)


def _bricks_across(depth: int) -> int:
    """Bricks along an axis of an octree."""
    return 1 << max(depth - 2, 0)


def _make_records(tree: Octree) -> np.ndarray:
    """The records (2 n, n, n, 4) of all half bricks, along z, y and x."""
    n, size = _bricks_across(tree.depth), tree.sizes.astype(np.int64)
    records, empty = np.zeros((n, 2, n, n, 4), np.uint32), np.ones((n, n, n), bool)
    fine, larger = np.flatnonzero(size < 2), np.flatnonzero(size >= 2)
    x, y, z = separate(tree.codes[fine], max(tree.depth, 2)).T
    empty[z >> 2, y >> 2, x >> 2] = False
    _mark_leaves(tree, fine, records.reshape(-1, 4), ((z >> 1) * n + (y >> 2)) * n + (x >> 2))
    if tree.depth > 1:
        # Octants along z, y and x; a byte for each of the four in a half, x lowest.
        beside = _octant_surroundings(tree).reshape(n, 2, n, 2, n, 2).transpose(0, 1, 2, 4, 3, 5).reshape(n, 2, n, n, 4)
        records[..., 3] = np.ascontiguousarray(beside).view("<u4")[..., 0]
    codes, which = _spread(tree.codes[larger] >> np.uint64(6), size[larger] - 2)
    x, y, z = separate(codes, max(tree.depth - 2, 0)).T
    leaf = larger[which]
    values = [np.full(len(leaf), 0xFFFFFFFF), np.zeros(len(leaf)), leaf + 1, (1 << size[leaf]) - 1]
    records[z, :, y, x] = np.stack(values, axis=1).astype(np.uint32)[:, None]
    empty[z, y, x] = False
    for axis, edges in enumerate(_free_boxes(empty)):
        records[..., axis + 1] = np.where(empty[:, None], edges[:, None], records[..., axis + 1])
    return records


def _free_boxes(empty: np.ndarray) -> np.ndarray:
    """Edges (3, Z, Y, X) along x, y and z of a free box from each empty block on, 4 bits for each octant of directions.

    The box is the largest cube, extended along the axis on which it grows most. Outside all is free.
    """
    packed = np.zeros((3, *empty.shape), np.uint32)
    for octant in range(8):
        turn = _upwards(octant)
        free = empty[turn]
        runs = [_run_lengths(free, 2 - axis) for axis in range(3)]
        box = np.stack([free.astype(np.uint8)] * 3)
        for edge in range(1, LONGEST + 1):
            if edge > 1:
                # The shortest of edge x edge runs side by side, from that of (edge - 1) x (edge - 1).
                for axis in range(3):
                    for across in {0, 1, 2} - {2 - axis}:
                        runs[axis] = np.minimum(runs[axis], _next_along(runs[axis], across, LONGEST))
            fits = runs[0] >= edge
            if not fits.any():
                break
            longest = np.stack(runs)
            grows = np.arange(3)[:, None, None, None] == longest.argmax(axis=0)
            box = np.where(fits, np.where(grows, longest, edge), box)
        packed |= box[(slice(None), *turn)].astype(np.uint32) << np.uint32(4 * octant)
    return packed


def _run_lengths(free: np.ndarray, axis: int) -> np.ndarray:
    """Number of free blocks from each block upwards along an axis, at most ``LONGEST``."""
    run, length = free, free.astype(np.uint8)
    for _ in range(LONGEST - 1):
        run = free & _next_along(run, axis, True)
        length += run
    return length


def _next_along(values: np.ndarray, axis: int, outside: int) -> np.ndarray:
    """The value of the next block along an axis; ``outside`` after the last one."""
    moved = np.full_like(values, outside)
    low, high = ([slice(None)] * 3 for _ in range(2))
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    moved[tuple(low)] = values[tuple(high)]
    return moved


def _mark_leaves(tree: Octree, fine: np.ndarray, records: np.ndarray, half: np.ndarray) -> None:
    """Mark leaves of one or two cells an edge in the records ``half`` of their half bricks."""
    codes = tree.codes[fine]
    bit = (codes & np.uint64(HALF - 1)).astype(np.uint32)
    cells = np.where(tree.sizes[fine] == 1, np.uint32(0xFF), np.uint32(1))
    np.bitwise_or.at(records[:, 0], half, cells << bit)
    np.bitwise_or.at(records[:, 1], half, np.uint32(1) << bit)
    records[half, 2] = np.searchsorted(tree.codes, codes & ~np.uint64(HALF - 1))


def _make_tables(tree: Octree) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Logarithm of the edge of the table, the table, its bricks and the records of an octree deeper than ``DENSE``."""
    depth = tree.depth
    steps = -(-(depth - TOP) // 2)
    top = depth - 2 * steps
    leaf = np.arange(tree.leaves, dtype=np.uint32) | tree.sizes.astype(np.uint32) << np.uint32(SIZE_SHIFT)
    first, size = tree.codes, tree.sizes.astype(np.int64)
    table, shift = _fill_table(first, size, leaf, depth, top), depth - top
    # Codes of the bricks of a level, ascending; a brick of the level above holds their numbers.
    inner = np.unique(first[size < shift] >> np.uint64(3 * shift))
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
    halves = _make_halves(tree, inner)
    _mark_far_vacuum(table, 1 << top)
    return top, table, np.concatenate(levels), halves


def _make_halves(tree: Octree, bricks: np.ndarray) -> np.ndarray:
    """The records (2 bricks, 4) of bricks of cells, from the codes of the bricks, ascending."""
    fine = np.flatnonzero(tree.sizes < 2)
    codes = tree.codes[fine]
    half = 2 * np.searchsorted(bricks, codes >> np.uint64(6)) + (codes >> np.uint64(5) & np.uint64(1)).astype(np.int64)
    records = np.zeros((2 * len(bricks), 4), np.uint32)
    _mark_leaves(tree, fine, records, half)
    if tree.depth <= FINE:
        octants = (bricks[:, None] << np.uint64(3)) + np.arange(8, dtype=np.uint64)
        x, y, z = separate(octants.reshape(-1), tree.depth - 1).T
        records[:, 3] = _octant_surroundings(tree)[z, y, x].view("<u4")
    return records


def _octant_surroundings(tree: Octree) -> np.ndarray:
    """A byte (Z, Y, X) for each octant of two cells an edge: the directions of free cubes of two octants that begin there."""
    n = 1 << (tree.depth - 1)
    is_filled = np.zeros(n**3, bool)
    octants, _ = _spread(tree.codes >> np.uint64(3), np.maximum(tree.sizes.astype(np.int64) - 1, 0))
    is_filled[_flat(separate(octants, tree.depth - 1), n)] = True
    free, bits = ~is_filled.reshape(n, n, n), np.zeros((n, n, n), np.uint8)
    for octant in range(8):
        turn = _upwards(octant)
        bits[turn] |= _grow_cubes(free[turn]).astype(np.uint8) << np.uint8(octant)
    return bits


def _upwards(octant: int) -> tuple[slice, ...]:
    """Index along z, y and x that turns an array so that directions of an octant run upwards."""
    return tuple(slice(None, None, -1 if octant >> axis & 1 else 1) for axis in (2, 1, 0))


def _grow_cubes(free: np.ndarray) -> np.ndarray:
    """Blocks from which a free cube runs upwards, larger by a block than the free cubes of ``free``. Outside all is free."""
    # A cube of the edge r is free if the eight cubes of the edge r - 1 at its corners are.
    for axis in range(3):
        free = free & _next_along(free, axis, True)
    return free


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
        turn = _upwards(octant)
        free = ~is_filled.reshape(n, n, n)[turn]
        code = np.zeros((n, n, n), np.uint32)
        for reach in range(2, REACHES[-1] + 1):
            free = _grow_cubes(free)
            if reach in REACHES:
                code[free] = CODES[REACHES.index(reach)]
        vacuum |= code[turn].reshape(-1) << np.uint32(3 * octant)
    table[...] = np.where(is_filled, np.where(table < BRICK, table - 1, table), vacuum)


REACHES, CODES = (2, 3, 4, 6, 8, 12), (2, 3, 4, 5, 6, 7)
"""Stored reaches above 1 [entries], and their codes of 3 bits."""


def find_octant(d: mi.Vector3f) -> mi.UInt32:
    """Octant of directions: bits 0, 1, 2 are set for directions downwards along x, y, z."""
    return sum((dr.select(d[a] >= 0, mi.UInt32(0), 1 << a) for a in range(3)), mi.UInt32(0))
