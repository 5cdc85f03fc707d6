"""The walk through the cells of a grid that a ray crosses, one after the other.

Conventions. A cell (i, j, k), each index from -1 to N - 1, lies between the nodes i and i + 1; node indices are clamped
to the grid, so that the outer half voxel is constant and a single voxel needs no special case. A ray is o + t d with t in
world length for a unit d; it is mapped to the lattice without being normalised again, so t keeps its meaning under any
scale, shear or mirroring. Box entry and exit are found in float64 (a float32 entry point errs by 3e-3 of a cell
from 1e4 scene sizes away); inside the grid the state is an integer cell and a fraction in it, so the error of a position
does not grow with its coordinate.

The walk owns the geometry; a visitor owns the meaning: ``visit(state, cell, active) -> state``.

References: Amanatides & Woo 1987 (the traversal); blocks of cells that are skipped whole as in the super-grids of
Szirmay-Kalos et al. 2011, and as many as are empty all around (proximity clouds, Cohen & Sheffer 1994).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.space import check_affine, lattice_from_world

__all__ = [
    "BLOCK",
    "REACH",
    "Cell",
    "Lattice",
    "Nodes",
    "Segment",
    "block_bounds",
    "block_gaps",
    "box_nodes",
    "clip",
    "count_blocks",
    "distances",
    "find_gaps",
    "locate",
    "over_blocks",
    "read_nodes",
    "slab",
    "split",
    "walk",
]

Mask3 = Any
"""Three masks a lane, ``dr.mask_t(mi.Vector3f)``: Mitsuba has no public name for the type."""

SHIFT = 2
"""log2 of the edge of a block."""

BLOCK = 1 << SHIFT
"""Edge of a block of the super-grid, in cells (measured on threads in 512^3: 2 are no faster)."""

REACH = 15
"""Largest distance that a block or a cell knows [blocks, cells]: in an empty box of 128^3 cells a ray takes 10 steps."""


@dataclass
class Lattice:
    """A grid placed in the world.

    Attributes:
        values: TensorXf (Z, Y, X, C), at voxel centres.
        to_world: (4, 4) float64, unit cube to world.
        gaps: how far each block of cells is from the nearest that holds anything, from :func:`block_gaps`, or None where no
            block is to be skipped.
        blocks: :class:`mivol.transport.tracking.Blocks`, or None where every cell is walked.
        from_world: (3, 4) map from the world to lattice coordinates, made where it is not given.
    """

    values: mi.TensorXf
    to_world: np.ndarray
    gaps: mi.UInt8 | None = None
    blocks: Any = None
    from_world: list[list[mi.Float64]] | None = None

    def __post_init__(self) -> None:
        if self.from_world is not None:
            return
        if len(self.values.shape) != 4 or 0 in self.values.shape:
            raise MivolError(f"a grid of shape {tuple(self.values.shape)} was given; (Z, Y, X, channels) is expected.")
        if np.prod([n + 1 for n in self.values.shape[:3]]) * self.channels >= 2**31:
            raise MivolError(f"a grid of shape {tuple(self.values.shape)} was given; a walk counts up to 2^31: split it.")
        self.to_world = check_affine(self.to_world)
        # Opaque: two grids placed differently share one kernel.
        rows = lattice_from_world(self.to_world, self.res)
        self.from_world = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in rows]

    @property
    def res(self) -> tuple[int, int, int]:
        """Resolution (Z, Y, X)."""
        return tuple(self.values.shape[:3])

    @property
    def channels(self) -> int:
        """Number of values at each voxel."""
        return self.values.shape[3]

    def place(self, u: mi.Vector3f) -> mi.Point3f:
        """Points of the unit cube in the world, in float32."""
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in self.to_world[:3]]
        return mi.Point3f(*(dr.fma(r[0], u.x, dr.fma(r[1], u.y, dr.fma(r[2], u.z, r[3]))) for r in rows))


@dataclass
class Segment:
    """A ray's stretch inside a box of the lattice: where it enters, and how far it goes.

    ``cell`` and ``frac`` are the entry point (lattice coordinates), ``d`` the lattice distance per world length (and
    ``d_rest`` what its rounding left over), ``t0`` the world distance from the ray's origin to the entry (and ``t0_rest`` what
    its rounding left over), ``length`` the world length inside.
    """

    cell: mi.Vector3i
    frac: mi.Vector3f
    d: mi.Vector3f
    d_rest: mi.Vector3f
    t0: mi.Float
    length: mi.Float
    t0_rest: mi.Float | float = 0.0

    @property
    def start(self) -> mi.Float64:
        """Distance from the ray's origin to the entry [length]."""
        return mi.Float64(self.t0) + mi.Float64(self.t0_rest)

    @property
    def end(self) -> mi.Float64:
        """Distance from the ray's origin to the exit [length]."""
        return self.start + mi.Float64(self.length)


@dataclass
class Nodes:
    """An array over the nodes of a lattice that a walk reads: flat, channels fastest, then x."""

    array: mi.Float
    channels: int = 1


@dataclass
class Cell:
    """What a visitor sees of one cell, in the direction of the ray.

    ``corners`` holds [read][channel][corner] values, bits 0, 1, 2 of the corner: near (0) or far (1) in x, y, z; where
    ``ahead`` is false, near is the upper node of the axis. ``lower`` is the lower node of the cell, -1 to N - 1. ``frac`` is
    where the ray enters, from the near planes, and ``step`` how far it goes, in fractions of the cell; ``s`` is the world
    length walked before the cell and ``dt`` in it.
    """

    corners: list
    lower: mi.Vector3i
    ahead: Mask3
    frac: mi.Vector3f
    step: mi.Vector3f
    s: mi.Float
    dt: mi.Float


def clip(lattice: Lattice, o: mi.Point3f, d: mi.Vector3f, t_min: mi.Float, t_max: mi.Float) -> Segment:
    """Cut a ray to the box of a grid, in float64.

    Args:
        lattice: the grid and its place.
        o, d: world ray; t is world length where |d| = 1.
        t_min, t_max: the stretch asked for [length]; ``t_max`` may be infinite.

    Returns:
        The stretch inside the box; ``length`` is 0 where there is none.
    """
    n = lattice.res[::-1]
    high = tuple(k - 0.5 for k in n)
    q, v, t0, t1 = slab(lattice.from_world, (-0.5,) * 3, high, o, d, mi.Float64(t_min), mi.Float64(t_max))
    hit = t1 > t0
    t0 = dr.select(hit, t0, 0)
    cell, frac = mi.Vector3i(), mi.Vector3f()
    for a in range(3):
        entry = dr.clip(dr.fma(t0, v[a], q[a]), -0.5, n[a] - 0.5)
        low = dr.floor(entry)
        cell[a], frac[a] = mi.Int32(low), mi.Float(entry - low)
    direction = mi.Vector3f(mi.Float(v[0]), mi.Float(v[1]), mi.Float(v[2]))
    rest = mi.Vector3f(*(mi.Float(v[a] - mi.Float64(direction[a])) for a in range(3)))
    start, start_rest = split(t0)
    return Segment(cell, frac, direction, rest, start, mi.Float(dr.select(hit, t1 - t0, 0)), start_rest)


def split(x: mi.Float64 | mi.Float) -> tuple[mi.Float, mi.Float]:
    """A number as the nearest float32 and what that leaves over."""
    near = mi.Float(x)
    return near, mi.Float(mi.Float64(x) - mi.Float64(near))


def locate(lattice: Lattice, o: mi.Point3f, d: mi.Vector3f, t: mi.Float) -> tuple[mi.Vector3i, mi.Vector3f, mi.Bool]:
    """Find the cell of a point of a ray, in float64.

    Returns:
        Its lower node (-1 to N - 1), the fractions from there, and whether the point is in the box.
    """
    n, t = lattice.res[::-1], mi.Float64(t)
    cell, frac, inside = mi.Vector3i(), mi.Vector3f(), mi.Bool(True)
    p = [dr.fma(t, mi.Float64(d[a]), mi.Float64(o[a])) for a in range(3)]
    for a, row in enumerate(lattice.from_world):
        q = dr.fma(row[0], p[0], dr.fma(row[1], p[1], dr.fma(row[2], p[2], row[3])))
        # A distance that was drawn in the box and rounded may lie 1e-7 of the way outside it.
        inside &= dr.abs(q - 0.5 * (n[a] - 1)) < 0.5 * n[a] + 1e-3
        q = dr.clip(q, -0.5, n[a] - 0.5)
        low = dr.minimum(dr.floor(q), n[a] - 1)
        cell[a], frac[a] = mi.Int32(low), mi.Float(q - low)
    return cell, frac, inside


def slab(
    rows: list, low: tuple, high: tuple, o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[list[mi.Float64], list[mi.Float64], mi.Float64, mi.Float64]:
    """Cut [t0, t1] of a ray to a box, in float64 (the slab test of Kay & Kajiya 1986).

    Args:
        rows: (3, 4) map from the world to the box's coordinates.
        low, high: the box there.
        o, d: world ray.
        t0, t1: the stretch asked for [length].

    Returns:
        The ray's origin and direction in the box's coordinates, and the stretch inside; t1 <= t0 where there is none.
    """
    f64 = mi.Float64
    o, d = [f64(o[a]) for a in range(3)], [f64(d[a]) for a in range(3)]
    q, v = [], []
    for a, row in enumerate(rows):
        q.append(dr.fma(row[0], o[0], dr.fma(row[1], o[1], dr.fma(row[2], o[2], row[3]))))
        v.append(dr.fma(row[0], d[0], dr.fma(row[1], d[1], row[2] * d[2])))
        parallel = v[a] == 0
        inv = 1 / dr.select(parallel, 1, v[a])
        near, far = (low[a] - q[a]) * inv, (high[a] - q[a]) * inv
        # A ray parallel to the faces is in or out for ever: 0 * inf would be NaN. In the plane of a face it is out.
        inside = (q[a] > low[a]) & (q[a] < high[a])
        t0 = dr.select(parallel, dr.select(inside, t0, dr.inf), dr.maximum(t0, dr.minimum(near, far)))
        t1 = dr.select(parallel, t1, dr.minimum(t1, dr.maximum(near, far)))
    # NaN rays fail the comparison and are empty, as is a direction of length 0 (an infinite stretch).
    return q, v, t0, dr.select((t1 > t0) & dr.isfinite(t1 - t0), t1, t0)


def block_bounds(values: mi.TensorXf) -> mi.Float:
    """Bound |values| over each block of ``BLOCK``^3 cells (all nodes that its cells touch), all channels together.

    Returns:
        Flat array over (blocks in z, y, x), ceil((N + 1) / BLOCK) of them along an axis. A block with bound 0 is empty.

    Cost: 5/4 look-ups a voxel along x, fewer along the others.
    """
    flat = _channel_max(dr.abs(dr.detach(values.array)), values.shape[3])
    return over_blocks(flat, values.shape[:3], SHIFT, dr.maximum, 0)


def count_blocks(n: int, shift: int = SHIFT) -> int:
    """Number of blocks of 2^shift cells along an axis of n voxels (n + 1 cells)."""
    return -(-(n + 1) >> shift)


def over_blocks(
    flat: mi.Float, res: tuple[int, int, int], shift: int, reduce: Callable[[mi.Float, mi.Float], mi.Float], nothing: float
) -> mi.Float:
    """Reduce the nodes that the cells of each block of 2^shift along each axis touch, axis by axis.

    Args:
        flat: one number a voxel (Z, Y, X).
        res: (Z, Y, X).
        shift: log2 of the edge of a block [cells].
        reduce, nothing: a function of two, associative, and what leaves the other one as it is.
    """
    z, y, x = res
    b_y, b_x = count_blocks(y, shift), count_blocks(x, shift)
    for outer, n, inner in ((z * y, x, 1), (z, y, b_x), (1, z, b_y * b_x)):
        flat = _over_axis(flat, outer, n, inner, shift, reduce, nothing)
    return flat


def _channel_max(flat: mi.Float, channels: int) -> mi.Float:
    """Maximum over the last axis of (voxels, channels)."""
    base = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    best = mi.Float(0)
    for c in range(channels):
        best = dr.maximum(best, dr.gather(mi.Float, flat, base + c))
    return best


def _over_axis(
    flat: mi.Float,
    outer: int,
    n: int,
    inner: int,
    shift: int,
    reduce: Callable[[mi.Float, mi.Float], mi.Float],
    nothing: float,
) -> mi.Float:
    """Reduce the nodes of each block along the middle axis of (outer, n, inner)."""
    b, edge = count_blocks(n, shift), 1 << shift
    i = dr.arange(mi.UInt32, outer * b * inner)
    # Block b of edge e holds the cells e b - 1 .. e (b + 1) - 2, so the nodes e b - 1 .. e (b + 1) - 1.
    first = mi.Int32((i // inner) % b) * edge - 1
    row = (i // (inner * b)) * (n * inner) + i % inner
    best = mi.Float(nothing)
    for k in range(edge + 1):
        node = mi.UInt32(dr.clip(first + k, 0, n - 1))
        best = reduce(best, dr.gather(mi.Float, flat, row + node * inner))
    dr.eval(best)
    return best


def find_gaps(values: mi.TensorXf) -> mi.UInt8:
    """The :func:`block_gaps` of a grid (Z, Y, X, C)."""
    return block_gaps(block_bounds(values), values.shape[:3])


def block_gaps(bounds: mi.Float, res: tuple[int, int, int]) -> mi.UInt8:
    """Measure how far each block is from the nearest that holds anything.

    Args:
        bounds: from :func:`block_bounds`.
        res: of the grid (Z, Y, X).

    Returns:
        Flat array over the blocks: distances [blocks], the largest of the three axes'; 0 where the block itself holds
        anything, ``REACH`` where it is further. From a block of distance k a ray may cross k - 1 more along each axis.

    Cost: 6 ``REACH`` look-ups a block at most.
    """
    return distances(bounds > 0, tuple(count_blocks(n) for n in res))


def distances(occupied: mi.Bool, counts: tuple[int, int, int]) -> mi.UInt8:
    """How far each of (Z, Y, X) places is from the nearest occupied one: the largest of the three axes', at most ``REACH``.

    Cost: 6 ``REACH`` look-ups a place at most, an axis at a time.
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
    """The least, over the neighbours along an axis, of the larger of their distance along it and their own ``far``."""
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


@dr.syntax
def walk(
    lattice: Lattice,
    segment: Segment,
    visit: Callable[[Any, Cell, mi.Bool], Any],
    state: Any,
    reads: Sequence[Nodes] = (),
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
    halts: bool = False,
) -> Any:
    """Visit the cells that a segment crosses, in order, and return the last state.

    A ray that leaves a cell through a face keeps the four corners of that face, so only the four new ones are read.

    Args:
        lattice: the grid; where it has ``gaps``, empty blocks are crossed, as many at once as are empty all around, and not
            visited.
        segment: from :func:`clip`.
        visit: ``visit(state, cell, active) -> state``; called once, while the loop is traced.
        state: any PyTree of Dr.Jit arrays.
        reads: arrays over the nodes; the visitor finds their corners in ``cell.corners``.
        active: lanes to walk.
        until: whether a lane has seen enough, told from the state after a cell; None to walk to the end.
        halts: the visitor may stop inside a cell: it returns its state and how far it went, at most ``cell.dt``, and is asked
            again from there.

    Cost: one step per cell or gap, at most X + Y + Z + 6 of them; 4 reads a step and channel (8 a visited cell
        where blocks are skipped).
    """
    # Plain names for what the loop needs: it takes part in none of the rest.
    gaps, length = lattice.gaps, segment.length
    skip = gaps is not None
    res = lattice.res
    blocks_y, blocks_x = count_blocks(res[1]), count_blocks(res[2])

    # -- State: the cell is seen along the ray, corner bits 0, 1, 2 are near (0) or far (1) in x, y, z -------------------
    d = segment.d
    ahead = d > 0
    sign = dr.select(ahead, mi.Vector3i(1), mi.Vector3i(-1))
    speed = dr.abs(d)
    speed_rest = dr.select(ahead, segment.d_rest, -segment.d_rest)
    # 1e30, not infinity: a ray in a plane has distance 0 to it, and 0 * inf would be NaN.
    pace = dr.select(speed > 1e-30, dr.rcp(speed), 1e30)

    active = mi.Bool(active) & (length > 0)
    cell = mi.Vector3i(segment.cell)  #                                         lower node of the cell
    entry = dr.select(ahead, segment.frac, 1 - segment.frac)  #                 where the ray enters, from its near planes
    frac = mi.Vector3f(entry)  #                                                position in the cell, likewise
    passed = mi.Vector3f(0)  #                                                  planes crossed since
    s, s_rest = mi.Float(0), mi.Float(0)  #                                     world length walked, and its lost digits
    stride, top = _strides(lattice.res)
    near, far = _planes(cell, ahead, lattice.res)  #                            flat offsets of the corners, an axis each
    corners = read_nodes(reads, _box(near, far), active)

    while dr.hint(active, label="lattice walk"):
        # -- Cells to cross at once: one, or what is left of an empty block and the empty ones around it -----------------
        span = mi.Vector3i(0)
        full = mi.Bool(active)
        if skip:
            block = (cell + 1) >> SHIFT
            index = (block.z * blocks_y + block.y) * blocks_x + block.x
            gap = mi.Int32(dr.gather(mi.UInt8, gaps, mi.UInt32(index), active))
            full = gap == 0
            inner = (cell + 1) & (BLOCK - 1)
            span = dr.select(full, 0, dr.select(ahead, BLOCK - 1 - inner, inner) + (gap - 1) * BLOCK)
            near, far = _planes(cell, ahead, res)
            corners = read_nodes(reads, _box(near, far), full)

        # -- Distance to the planes ahead, and visit ----------------------------------------------------------------------
        reach = (mi.Vector3f(span) + (1 - frac)) * pace
        plane = _least(_least(reach.x, reach.y), reach.z)
        left = (length - s) - s_rest
        dt = _least(plane, left)
        here = Cell(corners, cell, ahead, frac, speed * dt, s, dt)
        if halts:
            state, dt = visit(state, here, active & full)
        else:
            state = visit(state, here, active & full)

        # -- Leave through one face: a tie is a step of length 0 through the next ------------------------------------------
        through_x = reach.x <= plane
        through_y = ~through_x & (reach.y <= plane)
        through_z = ~(through_x | through_y)
        if halts:
            arrives = dt >= plane
            through_x, through_y, through_z = through_x & arrives, through_y & arrives, through_z & arrives
        through = dr.mask_t(mi.Vector3f)(through_x, through_y, through_z)
        s, s_rest = _add(s, s_rest, dt)
        active &= dt < left if halts else plane < left
        if until is not None:
            active &= ~until(state)

        # -- Advance: one plane further, or as many as a gap has ---------------------------------------------------------
        if skip:
            there = dr.fma(speed, dt, frac)
            jump = dr.select(through, span + 1, dr.clip(mi.Vector3i(dr.floor(there)), 0, span))
            passed += mi.Vector3f(jump)
            cell = dr.clip(cell + sign * jump, -1, top)
        else:
            passed = dr.select(through, passed + 1, passed)
            cell = dr.clip(dr.select(through, cell + sign, cell), -1, top)
            near = dr.select(through, far, near)
            far = dr.select(through, dr.clip(far + sign * stride, 0, top * stride), far)
            corners = _shift(corners, through, read_nodes(reads, _far_face(near, far, through), active))
        # Always from the entry, never from the last cell: a rounding of 3e-8 in each step, the same in every one, would
        # carry a ray 1e-5 of a cell off its course in 256. The first product is as large as the count that is taken from
        # it, and both are exact; what remains is rounded once.
        course = dr.fma(speed, s_rest, dr.fma(speed_rest, s, entry))
        frac = _least(_most(dr.fma(speed, s, -passed) + course, 0), 1)
    return state


def _add(total: mi.Float, rest: mi.Float, term: mi.Float) -> tuple[mi.Float, mi.Float]:
    """A sum and the digits that it loses (Knuth's two-sum): float32 alone lets the end of 256 cells drift by 8e-4 of one."""
    after = total + term
    took = after - total
    return after, rest + ((total - (after - took)) + (term - took))


def _least(a: mi.Float, b: mi.Float) -> mi.Float:
    """The smaller of two numbers that are not NaN: ``dr.minimum`` would carry a NaN on, at twice the price of this."""
    return dr.select(a < b, a, b)


def _most(a: mi.Float, b: mi.Float) -> mi.Float:
    """The larger of two numbers that are not NaN."""
    return dr.select(a > b, a, b)


def _strides(res: tuple[int, int, int]) -> tuple[mi.Vector3i, mi.Vector3i]:
    """Flat distance of neighbouring nodes, and the last node, along each axis."""
    z, y, x = res
    return mi.Vector3i(1, x, x * y), mi.Vector3i(x - 1, y - 1, z - 1)


def _planes(cell: mi.Vector3i, ahead: Mask3, res: tuple[int, int, int]) -> tuple[mi.Vector3i, mi.Vector3i]:
    """Flat offsets of the near and the far node along each axis, clamped to the grid."""
    stride, top = _strides(res)
    low, high = dr.clip(cell, 0, top) * stride, dr.clip(cell + 1, 0, top) * stride
    return dr.select(ahead, low, high), dr.select(ahead, high, low)


def box_nodes(cell: mi.Vector3i, ahead: Mask3, res: tuple[int, int, int]) -> list[mi.UInt32]:
    """Flat node indices of the 8 corners of a cell, near and far along ``ahead`` (all true: lower and upper)."""
    return _box(*_planes(cell, ahead, res))


def _box(near: mi.Vector3i, far: mi.Vector3i) -> list[mi.UInt32]:
    return [mi.UInt32(k + j + i) for k in (near.z, far.z) for j in (near.y, far.y) for i in (near.x, far.x)]


def _far_face(near: mi.Vector3i, far: mi.Vector3i, through: Mask3) -> list[mi.UInt32]:
    """Flat node indices of the 4 far corners across the axis ``through``.

    In the order of the two other axes, the lower one fastest: (y, z), (x, z) or (x, y).
    """
    base = dr.select(through, far, near)
    base = base.x + base.y + base.z
    wide = far - near
    first = dr.select(through.x, wide.y, wide.x)
    second = dr.select(through.z, wide.y, wide.z)
    return [mi.UInt32(base), mi.UInt32(base + first), mi.UInt32(base + second), mi.UInt32(base + first + second)]


def _shift(old: list, through: Mask3, fresh: list) -> list:
    """[read][channel][corner] after leaving through a face: far corners become near ones, the 4 ``fresh`` are the far ones."""
    if old and isinstance(old[0], list):
        return [_shift(o, through, f) for o, f in zip(old, fresh, strict=True)]
    if not old:
        return old
    along_x = [old[q | 1] if not q & 1 else fresh[q >> 1] for q in range(8)]
    along_y = [old[q | 2] if not q & 2 else fresh[(q & 1) | (q >> 2) << 1] for q in range(8)]
    along_z = [old[q | 4] if not q & 4 else fresh[q & 3] for q in range(8)]
    return [_along(through, *c) for c in zip(along_x, along_y, along_z, strict=True)]


def _along(through: Mask3, x: mi.Float, y: mi.Float, z: mi.Float) -> mi.Float:
    return dr.select(through.x, x, dr.select(through.y, y, z))


def read_nodes(reads: Sequence[Nodes], nodes: list[mi.UInt32], active: mi.Bool) -> list:
    """Read [array][channel][node] values."""
    return [
        [[dr.gather(mi.Float, r.array, n * r.channels + c, active) for n in nodes] for c in range(r.channels)] for r in reads
    ]
