"""The occupied cells of a grid: their list, an index, the empty distance around each, and an order of rays through them.

Conventions. Cells and nodes are those of :mod:`mivol.transport.traversal.lattice`: a cell lies between two nodes along each
axis, -1 to N - 1, and border nodes are repeated. The index counts cells from 0 to N along an axis of N nodes.

Index. Cells lie in bricks of 4 x 4 x 4. A brick with a listed cell has a number and a bit for each of its cells. Every other
brick has only its Chebyshev distance [bricks] to the nearest brick with a listed cell. Memory grows with the bricks around
listed cells, plus four bytes for 64 cells of the box. Listed cells are numbered brick by brick, and within a brick by their
bits. The number of a cell (its rank) is the stored number of listed cells before its brick plus the count of set bits below
its own bit.

Levels. A grid may be a level of several nested grids (:mod:`mivol.fields.spherical_grid`). All levels have the same nodes, and
their cells are counted level by level. A walk (:mod:`mivol.transport.traversal.occupied_walk`) stays in a level.

Order. Rays entering the box in the same place and leaving it in the same place cross the same cells in between. Sorted rays
wait less for memory. The key has two coarse cells, those of entry and exit, with the bits of the six indices interleaved.

References: Cohen & Sheffer 1994 (proximity clouds: distances for a ray to skip); Jacobson 1989 (rank of a bit in constant
    time); Morton 1966 (interleaved bits).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import copy_aligned
from mivol.space import check_affine, lattice_from_world
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.grid_blocks import BLOCK, SHIFT, count_blocks, find_distances

__all__ = ["CellIndex", "FEWEST_RAYS", "OccupiedCells", "RayOrder"]


@dataclass
class OccupiedCells:
    """The occupied cells of a grid.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube to world.
        count: number of occupied cells.
        index: index of the (Z + 1) (Y + 1) (X + 1) cells of each level: position of a cell in ``corners``, and ways through
            empty cells.
        corners: UInt32, 8 a cell: indices of its nodes in ``rows``; bits 0, 1, 2 of the corner are x, y, z.
        rows: UInt32, the rows of the nodes of listed cells, each once.
        from_world: (3, 4) map from the world to lattice coordinates of the innermost level.
        levels: number of nested grids.
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
    ) -> OccupiedCells:
        """Find the occupied cells of a grid.

        Args:
            res: nodes (Z, Y, X).
            to_world: (4, 4) affine map of the unit cube.
            row_of: maps flat node numbers of all levels (x fastest) to rows.
            occupied: ``occupied(rows of the 8 corners) -> mask`` of cells to list; called once.
            most: number of rows.
            levels: number of nested grids.
            stored: flat numbers of all nodes that may make a cell occupied; by default every node.

        Raises:
            MivolError: more cells than a 32-bit number counts.

        Cost: 8 reads, and the reads of ``occupied``, for each cell of the bricks of 4^3 cells at ``stored`` nodes.
        """
        z, y, x = res
        total = levels * (z + 1) * (y + 1) * (x + 1)
        if total >= 2**31:
            size = f"{levels} x {x} x {y} x {z}" if levels > 1 else f"{x} x {y} x {z}"
            raise MivolError(f"a grid of {size} nodes was given; at most 2^31 cells are expected: split it.")
        index, listed = CellIndex.find(res, levels, lambda cell: occupied(_corner_rows(cell, row_of, res)), stored)
        count = dr.width(listed)
        # Dr.Jit cannot gather from an array of length 0, not even with all lanes inactive. Where no cell is occupied the arrays
        # hold one cell, to which no number points.
        corner_rows = _corner_rows(listed if count else mi.UInt32(0), row_of, res)
        used, place = _numbered(corner_rows, most)
        corners = dr.zeros(mi.UInt32, 8 * max(count, 1))
        for q, row in enumerate(corner_rows):
            dr.scatter(corners, dr.gather(mi.UInt32, place, row), dr.arange(mi.UInt32, max(count, 1)) * 8 + q)
        to_world = check_affine(to_world)
        to_lattice = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in lattice_from_world(to_world, res)]
        dr.eval(corners, used)
        return cls(res, to_world, count, index, corners, used, to_lattice, levels)

    def nodes(self, number: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
        """The indices in ``rows`` of the 8 corners of listed cells."""
        return list(dr.gather(mi.ArrayXu, self.corners, number, active, shape=(8, 1)))

    def node_rows(self, number: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
        """The rows of the 8 corners of listed cells."""
        return [dr.gather(mi.UInt32, self.rows, node, active) for node in self.nodes(number, active)]


def _numbered(rows: list[mi.UInt32], most: int) -> tuple[mi.UInt32, mi.UInt32]:
    """The distinct numbers among ``rows`` (each at most ``most``), ascending, and the index of each number among them."""
    used = dr.zeros(mi.UInt8, most + 1)
    for row in rows:
        dr.scatter(used, mi.UInt8(1), row)
    different = dr.compress(used > 0)
    place = dr.zeros(mi.UInt32, most + 1)
    dr.scatter(place, dr.arange(mi.UInt32, dr.width(different)), different)
    return different, place


def _apart(cell: mi.UInt32, res: tuple[int, int, int]) -> tuple[mi.Int32, mi.Int32, mi.Int32]:
    """Indices along x, y, z of cells within their level, from flat indices; index 0 is the outer half voxel."""
    z, y, x = res
    across, slab = x + 1, (x + 1) * (y + 1)
    return mi.Int32(cell % across), mi.Int32(cell // across % (y + 1)), mi.Int32(cell // slab % (z + 1))


def _between(place: mi.Int32, n: int) -> tuple[mi.Int32, mi.Int32]:
    """The lower and the upper node of cells along an axis, clamped to the grid; cell 0 is the outer half voxel."""
    return dr.maximum(place - 1, 0), dr.minimum(place, n - 1)


def _corner_rows(cell: mi.UInt32, row_of: Callable[[mi.UInt32], mi.UInt32], res: tuple[int, int, int]) -> list[mi.UInt32]:
    """Rows of the 8 corners of cells, from flat indices."""
    z, y, x = res
    i, j, k = (_between(a, n) for a, n in zip(_apart(cell, res), (x, y, z), strict=True))
    level = mi.Int32(cell // math.prod(n + 1 for n in res)) * z
    return [row_of(mi.UInt32(((level + c) * y + b) * x + a)) for c in k for b in j for a in i]


FILLED = 1 << 31
"""Flag in the entry of a numbered brick."""

CELLS = BLOCK**3
"""Cells of a brick: the bits of two words."""


@dataclass
class CellIndex:
    """An index of the listed cells of nested grids of one resolution.

    Attributes:
        counts: bricks (Z, Y, X) of a level.
        bricks: UInt32, for each brick of all levels: its distance, or ``FILLED`` and its number.
        bits: UInt32, two for each numbered brick: its cells of z = 0, 1 and of z = 2, 3, x fastest.
        before: UInt32, for each numbered brick the number of listed cells before it.
    """

    counts: tuple[int, int, int]
    bricks: mi.UInt32
    bits: mi.UInt32
    before: mi.UInt32

    @property
    def bytes(self) -> int:
        """Memory of the index [bytes]."""
        return 4 * (dr.width(self.bricks) + dr.width(self.bits) + dr.width(self.before))

    @classmethod
    def find(
        cls,
        res: tuple[int, int, int],
        levels: int,
        is_listed: Callable[[mi.UInt32], mi.Bool],
        nodes: mi.UInt32 | None = None,
    ) -> tuple[CellIndex, mi.UInt32]:
        """Build the index, and list the cells in the order of their numbers.

        Args:
            res: nodes (Z, Y, X).
            levels: number of nested grids.
            is_listed: maps flat cell numbers (x fastest, levels slowest) to a mask of cells to list.
            nodes: flat numbers of all nodes among the corners of listed cells; by default every node.

        Cost: a call of ``is_listed`` for each cell of the bricks at these nodes.
        """
        counts = tuple(count_blocks(n) for n in res)
        total = levels * math.prod(counts)
        # Without a node, take the brick of the first node: Dr.Jit has no arithmetic for arrays of length 0.
        nodes = mi.UInt32(0) if nodes is not None and dr.width(nodes) == 0 else nodes
        candidates = dr.arange(mi.UInt32, total) if nodes is None else _bricks_at(nodes, res, counts, total)
        lane = dr.arange(mi.UInt32, CELLS * dr.width(candidates))
        cell, is_inside = _cell_of(dr.gather(mi.UInt32, candidates, lane // CELLS), lane % CELLS, res, counts)
        is_occupied = is_listed(cell) & is_inside
        dr.eval(is_occupied, cell)
        listed = dr.gather(mi.UInt32, cell, dr.compress(is_occupied))
        words = dr.block_sum(dr.select(is_occupied, mi.UInt32(1) << (lane & 31), 0), 32)
        low, high = (dr.gather(mi.UInt32, words, 2 * dr.arange(mi.UInt32, dr.width(candidates)) + k) for k in (0, 1))
        before = dr.prefix_sum(dr.popcnt(low) + dr.popcnt(high))
        filled = dr.compress((low | high) != 0)
        count = dr.width(filled)
        if count == 0:
            # Dr.Jit cannot gather from an array of length 0, not even with all lanes inactive.
            far = find_distances(dr.zeros(mi.Bool, total), counts)
            return cls(counts, mi.UInt32(far), dr.zeros(mi.UInt32, 2), dr.zeros(mi.UInt32, 1)), listed
        place = dr.gather(mi.UInt32, candidates, filled)
        is_filled, bits = dr.zeros(mi.UInt8, total), dr.zeros(mi.UInt32, 2 * count)
        dr.scatter(is_filled, mi.UInt8(1), place)
        dr.scatter(bits, mi.ArrayXu([dr.gather(mi.UInt32, word, filled) for word in (low, high)]), dr.arange(mi.UInt32, count))
        bricks = mi.UInt32(find_distances(is_filled > 0, counts))
        dr.scatter(bricks, dr.arange(mi.UInt32, count) | FILLED, place)
        index = cls(counts, bricks, bits, dr.gather(mi.UInt32, before, filled))
        dr.eval(index, listed)
        return index, listed

    def look_up(
        self, cell: mi.Vector3i, level: mi.Int32 | int, ahead: mi.Array3b, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Vector3i]:
        """Look up the number of the brick of cells, and the number of cells a ray may cross along each axis, the own cell
        included.

        Args:
            cell: index along x, y and z, from 0.
            level: level of the cell.
            ahead: axes along which the ray runs upwards.
            active: lanes to look up.

        Returns:
            The number (undefined for a brick without a number), and the cells to cross; 0 along all axes for a listed cell.
        """
        z, y, x = self.counts
        place = cell >> SHIFT
        at = mi.UInt32(place.x + x * (place.y + y * (place.z + z * level)))
        entry = dr.gather(mi.UInt32, self.bricks, at, active)
        is_filled = entry >= FILLED
        number = entry & (FILLED - 1)
        low, high = dr.gather(mi.ArrayXu, self.bits, number, active & is_filled, shape=(2, 1))
        bits = dr.select((cell.z & 2) == 0, low, high)
        own = mi.Int32(1 - ((bits >> _bit(cell)) & 1))
        inside = cell & (BLOCK - 1)
        within = dr.select(ahead, BLOCK - inside, inside + 1)
        is_free = ~is_filled | _is_free(low, high, inside, ahead)
        distance = mi.Int32(dr.select(is_filled, 1, entry))
        return number, dr.select(is_free, within + BLOCK * (distance - 1), own)

    def rank(self, cell: mi.Vector3i, number: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The number of listed cells, from the number of their brick."""
        low, high = dr.gather(mi.ArrayXu, self.bits, number, active, shape=(2, 1))
        before = dr.gather(mi.UInt32, self.before, number, active)
        below = (mi.UInt32(1) << _bit(cell)) - 1
        is_low = (cell.z & 2) == 0
        return before + dr.popcnt(dr.select(is_low, low & below, low)) + dr.popcnt(dr.select(is_low, 0, high & below))


def _bit(cell: mi.Vector3i) -> mi.UInt32:
    """The bit of a cell in its word."""
    return mi.UInt32((cell.x & 3) | (cell.y & 3) << 2 | (cell.z & 1) << 4)


def _is_free(low: mi.UInt32, high: mi.UInt32, inside: mi.Vector3i, ahead: mi.Array3b) -> mi.Bool:
    """Whether bricks hold no listed cell from ``inside`` on along all axes, in the direction of the ray."""
    i, j, k = (mi.UInt32(a) for a in inside)
    row = dr.select(ahead.x, (0xF << i) & 0xF, mi.UInt32(0xF) >> (3 - i)) * 0x11111111
    rows = dr.select(ahead.y, (0xFFFF << (4 * j)) & 0xFFFF, mi.UInt32(0xFFFF) >> (12 - 4 * j)) * 0x00010001
    every, second = mi.UInt32(0xFFFFFFFF), 16 * (k & 1)
    planes, beyond = dr.select(ahead.z, every << second, every >> (16 - second)), dr.select(ahead.z, every, 0)
    is_low = k < 2
    ahead_bits = dr.select(is_low, low & planes, low & ~beyond) | dr.select(is_low, high & beyond, high & planes)
    return (ahead_bits & row & rows) == 0


def _bricks_at(nodes: mi.UInt32, res: tuple[int, int, int], counts: tuple[int, int, int], total: int) -> mi.UInt32:
    """The bricks, ascending, with a cell of which some of the nodes is a corner."""
    (z, y, x), (b_z, b_y, b_x) = res, counts
    level = nodes // (x * y * z)
    i, j, k = nodes % x, nodes // x % y, nodes // (x * y) % z
    near = dr.zeros(mi.UInt8, total)
    # Node i is a corner of the cells i and i + 1.
    for corner in range(8):
        a, c, e = ((n + (corner >> axis & 1)) >> SHIFT for axis, n in enumerate((i, j, k)))
        dr.scatter(near, mi.UInt8(1), a + b_x * (c + b_y * (e + b_z * level)))
    return dr.compress(near > 0)


def _cell_of(
    brick: mi.UInt32, bit: mi.UInt32, res: tuple[int, int, int], counts: tuple[int, int, int]
) -> tuple[mi.UInt32, mi.Bool]:
    """Flat numbers of cells, clamped to the grid, and whether the cells lie in the grid."""
    (z, y, x), (b_z, b_y, b_x) = res, counts
    i = brick % b_x * BLOCK + (bit & 3)
    j = brick // b_x % b_y * BLOCK + (bit >> 2 & 3)
    k = brick // (b_x * b_y) % b_z * BLOCK + (bit >> 4)
    level = brick // (b_x * b_y * b_z)
    is_inside = (i <= x) & (j <= y) & (k <= z)
    i, j, k = dr.minimum(i, x), dr.minimum(j, y), dr.minimum(k, z)
    return i + (x + 1) * (j + (y + 1) * (k + (z + 1) * level)), is_inside


KEY_BITS = 3
"""Bits of an index: a coarse cell is an eighth of the box along each axis. (Processor time of a step of 65,536 rays through a
fog of 128^3 nodes over that of unsorted rays, a single run each: 0.82 with 3 bits, 0.86 with 4, 0.84 with 6; 0.86 to 0.88 with
all bits of the entry before the bits of the exit.)
"""

FEWEST_RAYS = 32768
"""Least number of rays to sort. (Processor time of sorted over unsorted rays, sorting included, for 65,536, 16,384 and 4096
rays: 0.84, 0.91, 0.95 through a fog of 128^3 nodes; 0.95, 0.98, 1.01 through a thin shell, where two busy threads give 0.94
and 1.05 for the first two.)
"""


@dataclass
class RayOrder:
    """An order of the rays of a call.

    Attributes:
        rays: index of the first ray, of the second ray, and so on.
        positions: position of each ray in the order.
    """

    rays: mi.UInt32
    positions: mi.UInt32

    @classmethod
    def find(cls, cells: OccupiedCells, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float | float) -> RayOrder | None:
        """Find the order of rays through a grid; None for too few rays to gain, and on GPUs, where no gain is measured.

        Args:
            cells: occupied cells of the grid.
            o, d: world rays.
            t_max: end of the rays [length]; may be infinite.

        Cost: 24 bytes a ray read, 4 bytes a ray sorted by NumPy.
        """
        count = dr.width((o, d))
        if count < FEWEST_RAYS or dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
            return None
        # The number of the ray as the low half makes keys distinct, so that the order, and that of all sums, is the same on all
        # machines; NumPy's stable sort takes twenty times as long.
        keys = np.array(_key(cells, o, d, t_max)).astype(np.uint64) << np.uint64(32) | np.arange(count, dtype=np.uint64)
        keys.sort()
        order = keys.astype(np.uint32)
        positions = np.empty_like(order)
        positions[order] = np.arange(count, dtype=np.uint32)
        # Dr.Jit compiles a kernel for arrays at aligned addresses, and another for others.
        return cls(*(mi.UInt32(copy_aligned(a)) for a in (order, positions)))


def _key(cells: OccupiedCells, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float | float) -> mi.UInt32:
    """The coarse cells at which rays enter and leave the outermost box; rays missing the box come last."""
    n, size = cells.res[::-1], 2 ** (cells.levels - 1)
    low, high = (tuple(0.5 * (k - 1) + side * size * 0.5 * k for k in n) for side in (-1, 1))
    q, v, t0, t1 = clip_to_box(cells.from_world, low, high, o, d, mi.Float64(0), mi.Float64(t_max))
    indices = []
    for t in (t0, t1):
        for a in range(3):
            share = (dr.fma(t, v[a], q[a]) - low[a]) / (high[a] - low[a])
            indices.append(mi.UInt32(dr.clip(share * (1 << KEY_BITS), 0, (1 << KEY_BITS) - 1)))
    key = mi.UInt32(0)
    for bit in reversed(range(KEY_BITS)):
        for index in indices:
            key = (key << 1) | ((index >> bit) & 1)
    return dr.select(t1 > t0, key, 1 << 6 * KEY_BITS)
