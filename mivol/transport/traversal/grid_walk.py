"""The walk through the cells of a grid, or of a box, along a ray; and between planes at any places across the world axes.

The walk knows the geometry only. A visitor, ``visit(state, cell, active) -> state``, decides what to compute in a cell: an
optical depth, its tangent, its transpose, or a candidate of a reservoir.

Conventions. Cells are those of :mod:`mivol.transport.traversal.lattice`. The state inside the grid is an integer cell and a
fraction in the cell, so the error of a position does not grow with its coordinate. The intervals between planes follow each
other without a gap: each begins at the number at which the one before it ends, and the first and the last end with the
passage. So a place on the passage lies in exactly one interval.

References: Amanatides & Woo 1987 (digital differential analyser); Szirmay-Kalos et al. 2011 (super-grids: empty blocks are
skipped whole); Cohen & Sheffer 1994 (proximity clouds: a ray skips all blocks within the empty distance).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.fields.bricks import Nodes, find_face
from mivol.fields.gaussian_field import PlaneGrid
from mivol.numerics import fast_max, fast_min
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.grid_blocks import BLOCK, SHIFT, count_blocks, read_distance
from mivol.transport.traversal.lattice import Lattice, Mask3, Segment
from mivol.transport.traversal.rays import Ray

__all__ = [
    "Cell",
    "NodeArray",
    "corner_nodes",
    "read_nodes",
    "walk_box_cells",
    "walk_cells",
    "walk_planes",
]


@dataclass
class NodeArray:
    """An array over the (stored) nodes of a lattice for a walk to read: flat, channels fastest, then x."""

    array: mi.Float
    channels: int = 1


@dataclass
class Cell:
    """A cell as a visitor sees it, in the direction of the ray.

    Attributes:
        corners: [array][channel][corner] values; bits 0, 1, 2 of the corner are near (0) or far (1) in x, y, z. Where
            ``ahead`` is false, near is the upper node of the axis.
        lower: lower node of the cell, -1 to N - 1.
        ahead: axes along which the ray runs upwards.
        frac: entry point of the ray, as fractions of the cell from the near planes.
        step: distance to the exit, in fractions of the cell.
        s: world length walked before the cell [length].
        dt: world length in the cell [length].
    """

    corners: list
    lower: mi.Vector3i
    ahead: Mask3
    frac: mi.Vector3f
    step: mi.Vector3f
    s: mi.Float
    dt: mi.Float


@dr.syntax
def walk_cells(
    lattice: Lattice,
    segment: Segment,
    visit: Callable[[Any, Cell, mi.Bool], Any],
    state: Any,
    reads: Sequence[NodeArray] = (),
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
    halts: bool = False,
) -> Any:
    """Visit the cells along a segment, in order, and return the last state.

    A ray leaving a cell through a face keeps the four corners of the face, so the next cell reads four corners only.

    Args:
        lattice: the grid. With ``empty_distances``, a step without a visit crosses an empty block and all empty blocks around
            it: everywhere, or with ``trims`` before the first and behind the last occupied block only.
        segment: from :func:`mivol.transport.traversal.lattice.clip_to_grid`.
        visit: ``visit(state, cell, active) -> state``; called once, while Dr.Jit traces the loop.
        state: any PyTree of Dr.Jit arrays.
        reads: arrays over the nodes; their values arrive in ``cell.corners``.
        active: lanes to walk.
        until: ``until(state) -> mask`` of lanes to stop, evaluated after each cell; None to walk to the end.
        halts: whether the visitor may stop inside a cell. It then returns its state and the walked distance, at most
            ``cell.dt``, and is called again from there.

    Cost: a step for each cell or empty region, at most X + Y + Z + 6 steps, and one more wherever a ray enters cells from an
        empty region; 4 reads a step and channel. With ``trims`` a step across an empty region reads no values, and a step in a
        cell looks up no block: it takes two thirds of the time.
    """
    # Dr.Jit makes every object that a loop's body names part of the loop's state: so the body names these arrays only, and
    # neither the lattice nor the segment.
    empty_distances, length = lattice.empty_distances, segment.length
    skip = empty_distances is not None and not lattice.trims
    is_sparse = lattice.bricks is not None
    table, offset = (lattice.bricks.table, lattice.bricks.offset) if is_sparse else (None, None)
    # Without arrays to read, no step prepares a read.
    prepares = skip and len(reads) > 0
    res = lattice.res

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
    if empty_distances is not None and lattice.trims:
        line = (empty_distances, res, speed, speed_rest, pace)
        cell, frac, passed, s, s_rest, active = _find_content(line, ahead, cell, entry, length, active)
        length = _trim_end(line, ahead, segment.cell, entry, length, active)
        active &= length > s
    near, far = _planes(cell, ahead, lattice.res)  #                            flat offsets of the corners, an axis each
    knows = mi.Bool(prepares)  #                                                whether the near corners are known
    through = dr.mask_t(mi.Vector3f)(False, False, True)  #                     axis of the last plane crossed
    corners = _first_corners(lattice, reads, cell, ahead, skip, active)

    while dr.hint(active, label="lattice walk"):
        # -- Cells to cross at once: one, or what is left of an empty block and the empty ones around it -----------------
        span = mi.Vector3i(0)
        full = mi.Bool(active)
        if skip:
            full, span = _read_span(empty_distances, res, cell, ahead, active)
        # -- Read four corners across the last plane; out of an empty region, first the near ones across z in a step of 0 ----
        waits = mi.Bool(False)
        if prepares:
            waits = full & ~knows
            x, y = knows & through.x, knows & through.y
            across = dr.mask_t(mi.Vector3f)(x, y, ~(x | y))
            if is_sparse:
                face = find_face(table, res, offset, cell, ahead, across, knows, full)
            else:
                near, far = _planes(cell, ahead, res)
                face = Nodes(_face(near, dr.select(knows, far, near), far - near, across))
            corners = _shift(corners, across, read_nodes(reads, face, full))

        # -- Distance to the planes ahead, and visit ----------------------------------------------------------------------
        reach = (mi.Vector3f(span) + (1 - frac)) * pace
        plane = fast_min(fast_min(reach.x, reach.y), reach.z)
        left = (length - s) - s_rest
        dt = dr.select(waits, 0, fast_min(plane, left))
        visited = Cell(corners, cell, ahead, frac, speed * dt, s, dt)
        if halts:
            state, dt = visit(state, visited, active & full & ~waits)
        else:
            state = visit(state, visited, active & full & ~waits)

        # -- Leave through one face: a tie is a step of length 0 through the next ------------------------------------------
        through_x = reach.x <= plane
        through_y = ~through_x & (reach.y <= plane)
        through_z = ~(through_x | through_y)
        if halts or prepares:
            arrives = ~waits & (dt >= plane)
            through_x, through_y, through_z = through_x & arrives, through_y & arrives, through_z & arrives
            knows = full & (waits | arrives)
        through = dr.mask_t(mi.Vector3f)(through_x, through_y, through_z)
        s, s_rest = _add(s, s_rest, dt)
        active &= dt < left if halts else waits | (plane < left)
        if until is not None:
            active &= ~until(state)

        # -- Advance: one plane further, or as many as the empty region has ----------------------------------------------
        if skip:
            arrival = dr.fma(speed, dt, frac)
            jump = dr.select(through, span + 1, dr.clip(mi.Vector3i(dr.floor(arrival)), 0, span))
            passed += mi.Vector3f(jump)
            cell = dr.clip(cell + sign * jump, -1, top)
        else:
            passed = dr.select(through, passed + 1, passed)
            cell = dr.clip(dr.select(through, cell + sign, cell), -1, top)
        if not skip:
            if is_sparse:
                face = find_face(table, res, offset, cell, ahead, through, mi.Bool(True), active)
            else:
                near = dr.select(through, far, near)
                far = dr.select(through, dr.clip(far + sign * stride, 0, top * stride), far)
                face = Nodes(_face(near, far, far - near, through))
            corners = _shift(corners, through, read_nodes(reads, face, active))
        # The fraction is found from the entry point, not from the last cell: the rounding of 3e-8 in a step has the same sign
        # in every step, and would carry a ray 1e-5 of a cell off its course in 256. speed * s and the number of planes passed
        # are nearly equal; the fused multiply-add subtracts them before it rounds, so that only the remainder is rounded.
        course = dr.fma(speed, s_rest, dr.fma(speed_rest, s, entry))
        frac = fast_min(fast_max(dr.fma(speed, s, -passed) + course, 0), 1)
    return state


def _read_span(
    distances: mi.UInt32, res: tuple[int, int, int], cell: mi.Vector3i, ahead: Mask3, active: mi.Bool
) -> tuple[mi.Bool, mi.Vector3i]:
    """Whether the block of a cell is occupied, and how many cells behind this one a step may cross along each axis."""
    block = (cell + 1) >> SHIFT
    index = (block.z * count_blocks(res[1]) + block.y) * count_blocks(res[2]) + block.x
    distance = read_distance(distances, mi.UInt32(index), active)
    inner = (cell + 1) & (BLOCK - 1)
    full = distance == 0
    return full, dr.select(full, 0, dr.select(ahead, BLOCK - 1 - inner, inner) + (distance - 1) * BLOCK)


@dr.syntax
def _find_content(
    line: tuple, ahead: Mask3, cell: mi.Vector3i, entry: mi.Vector3f, length: mi.Float, active: mi.Bool
) -> tuple[mi.Vector3i, mi.Vector3f, mi.Vector3f, mi.Float, mi.Float, mi.Bool]:
    """Walk to the first cell of an occupied block, by the steps and with the state of :func:`walk_cells`.

    Args:
        line: distances of blocks, resolution, and speed, its lost digits and pace along the axes.
        ahead, cell, entry, length, active: as the state of the same names.

    Returns:
        Cell, fraction, planes passed, length and its lost digits, and the lanes that meet an occupied block.
    """
    distances, res, speed, speed_rest, pace = line
    top, sign = _strides(res)[1], dr.select(ahead, mi.Vector3i(1), mi.Vector3i(-1))
    cell, frac, passed = mi.Vector3i(cell), mi.Vector3f(entry), mi.Vector3f(0)
    s, s_rest, active = mi.Float(0), mi.Float(0), mi.Bool(active)
    runs = mi.Bool(active)
    while dr.hint(runs, label="walk to the content"):
        full, span = _read_span(distances, res, cell, ahead, runs)
        runs &= ~full
        reach = (mi.Vector3f(span) + (1 - frac)) * pace
        plane = fast_min(fast_min(reach.x, reach.y), reach.z)
        left = (length - s) - s_rest
        dt = dr.select(runs, fast_min(plane, left), 0)
        through_x = reach.x <= plane
        through_y = ~through_x & (reach.y <= plane)
        through = dr.mask_t(mi.Vector3f)(through_x, through_y, ~(through_x | through_y))
        jump = dr.select(through, span + 1, dr.clip(mi.Vector3i(dr.floor(dr.fma(speed, dt, frac))), 0, span))
        jump = dr.select(runs, jump, 0)
        s, s_rest = _add(s, s_rest, dt)
        active &= ~runs | (plane < left)
        runs &= active
        passed += mi.Vector3f(jump)
        cell = dr.clip(cell + sign * jump, -1, top)
        course = dr.fma(speed, s_rest, dr.fma(speed_rest, s, entry))
        frac = fast_min(fast_max(dr.fma(speed, s, -passed) + course, 0), 1)
    return cell, frac, passed, s, s_rest, active


MARGIN = 0.01
"""Part of a cell that is walked behind the last occupied block, for the rounding of a length: 6e-8 of it."""


def _trim_end(line: tuple, ahead: Mask3, cell: mi.Vector3i, entry: mi.Vector3f, length: mi.Float, active: mi.Bool) -> mi.Float:
    """The length to just behind the last occupied block, found from the end, against the ray; arguments as before."""
    _, res, speed, speed_rest, pace = line
    planes = dr.floor(dr.fma(speed, length, entry))
    # The fused multiply-add rounds the fraction, not the position.
    frac = fast_min(fast_max(dr.fma(speed, length, -planes) + dr.fma(speed_rest, length, entry), 0), 1)
    last = dr.clip(cell + dr.select(ahead, 1, -1) * mi.Vector3i(planes), -1, _strides(res)[1])
    behind = _find_content(line, ~ahead, last, 1 - frac, length, active)[3]
    return fast_min(length, (length - behind) + MARGIN * fast_min(fast_min(pace.x, pace.y), pace.z))


def _first_corners(
    lattice: Lattice, reads: Sequence[NodeArray], cell: mi.Vector3i, ahead: Mask3, only_near: bool, active: mi.Bool
) -> list:
    """The corners [array][channel][corner] of the first cell; or only those near across z, in place of the far ones."""
    near, far = _planes(cell, ahead, lattice.res)
    if not only_near:
        nodes = Nodes(_box(near, far)) if lattice.bricks is None else lattice.bricks.find_corners(cell, ahead, active)
        return read_nodes(reads, nodes, active)
    across_z = dr.mask_t(mi.Vector3f)(False, False, True)
    if lattice.bricks is None:
        face = Nodes(_face(near, near, far - near, across_z))
    else:
        bricks = lattice.bricks
        face = find_face(bricks.table, bricks.res, bricks.offset, cell, ahead, across_z, mi.Bool(False), active)
    unknown = [[[mi.Float(0) for _ in range(8)] for _ in range(r.channels)] for r in reads]
    return _shift(unknown, across_z, read_nodes(reads, face, active))


def _add(total: mi.Float, rest: mi.Float, term: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Add to a compensated sum (Knuth's two-sum): with float32 alone the end of a walk of 256 cells drifts by 8e-4 of a
    cell.
    """
    after = total + term
    added = after - total
    return after, rest + ((total - (after - added)) + (term - added))


def _strides(res: tuple[int, int, int]) -> tuple[mi.Vector3i, mi.Vector3i]:
    """Flat distance of neighbouring nodes, and the last node, along each axis."""
    z, y, x = res
    return mi.Vector3i(1, x, x * y), mi.Vector3i(x - 1, y - 1, z - 1)


def _planes(cell: mi.Vector3i, ahead: Mask3, res: tuple[int, int, int]) -> tuple[mi.Vector3i, mi.Vector3i]:
    """Flat offsets of the near and the far node along each axis, clamped to the grid."""
    stride, top = _strides(res)
    low, high = dr.clip(cell, 0, top) * stride, dr.clip(cell + 1, 0, top) * stride
    return dr.select(ahead, low, high), dr.select(ahead, high, low)


def corner_nodes(cell: mi.Vector3i, lattice: Lattice, active: mi.Bool) -> Nodes:
    """The 8 corners of a cell, in the order of the axes of the grid."""
    upward = dr.full(dr.mask_t(mi.Vector3f), True)
    if lattice.bricks is not None:
        return lattice.bricks.find_corners(cell, upward, active)
    return Nodes(_box(*_planes(cell, upward, lattice.res)))


def _box(near: mi.Vector3i, far: mi.Vector3i) -> list[mi.UInt32]:
    return [mi.UInt32(k + j + i) for k in (near.z, far.z) for j in (near.y, far.y) for i in (near.x, far.x)]


def _face(near: mi.Vector3i, far: mi.Vector3i, wide: mi.Vector3i, through: Mask3) -> list[mi.UInt32]:
    """Flat node indices of the 4 corners in the plane ``far`` across the axis ``through``, ``wide`` apart along the others.

    The order is that of the two other axes, the lower axis fastest: (y, z), (x, z) or (x, y).
    """
    base = dr.select(through, far, near)
    base = base.x + base.y + base.z
    first = dr.select(through.x, wide.y, wide.x)
    second = dr.select(through.z, wide.y, wide.z)
    return [mi.UInt32(base), mi.UInt32(base + first), mi.UInt32(base + second), mi.UInt32(base + first + second)]


def _shift(old: list, through: Mask3, fresh: list) -> list:
    """Corners [array][channel][corner] after leaving through a face: far corners become near corners, and ``fresh`` are the
    far ones.
    """
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


def read_nodes(reads: Sequence[NodeArray], nodes: Nodes, active: mi.Bool) -> list:
    """Read [array][channel][node] values; 0 at nodes that are not stored."""
    pairs = list(zip(nodes.index, nodes.select(active), strict=True))
    return [
        [[dr.gather(mi.Float, r.array, n * r.channels + c, on) for n, on in pairs] for c in range(r.channels)] for r in reads
    ]


def walk_box_cells(
    rows: list[list[mi.Float64]], count: int, ray: Ray, visit: Callable[..., Any], state: Any, active: mi.Bool
) -> Any:
    """Visit the equal cells of a box along a ray without end; the box has no grid of values.

    Args:
        rows: (3, 4) map from the world to the box, in which a cell has the edge 1.
        count: cells along each axis.
        ray: world space.
        visit: ``visit(state, cell, t0, t1, on) -> state`` for the interval of the ray in a cell (x, y, z).
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.

    Returns:
        The last state.

    Cost: at most 3 ``count`` - 2 cells.
    """
    q, v, t0, t1 = clip_to_box(rows, (0.0,) * 3, (float(count),) * 3, ray.o, ray.d, mi.Float64(0), mi.Float64(dr.inf))
    q, v = mi.Point3f(*map(mi.Float, q)), mi.Vector3f(*map(mi.Float, v))
    end, parallel = mi.Float(t1), v == 0
    inv = dr.rcp(dr.select(parallel, 1, v))
    ahead = mi.Vector3i(dr.select(v > 0, mi.Vector3i(1), mi.Vector3i(0)))

    def step(t: mi.Float, cell: mi.Vector3i, on: mi.Bool, state: Any) -> tuple:
        faces = dr.select(parallel, dr.inf, (mi.Vector3f(cell + ahead) - q) * inv)
        # Where rounding puts a face behind the ray the interval is empty, and the cell is left all the same.
        to = dr.maximum(t, dr.minimum(dr.min(faces), end))
        state = visit(state, cell, t, to, on)
        cell = dr.select(faces <= to, cell + 2 * ahead - 1, cell)
        return to, cell, on & (to < end) & dr.all((cell >= 0) & (cell < count)), state

    on = mi.Bool(active) & (t1 > t0)
    begin = mi.Float(dr.select(on, t0, 0))
    cell = dr.clip(mi.Vector3i(dr.floor(q + v * begin)), 0, count - 1)
    start = (begin, cell, on, state)
    return dr.while_loop(start, lambda t, cell, on, state: on, step, label="cells of a box")[3]


# -- Between planes ----------------------------------------------------------------------------------------------------


def walk_planes(
    grid: PlaneGrid,
    o: mi.Point3f,
    d: mi.Vector3f,
    length: mi.Float,
    visit: Callable[..., Any],
    state: Any,
    active: mi.Bool = True,
    until: Callable[[Any], mi.Bool] | None = None,
) -> Any:
    """Visit the cells along a passage, in order, and return the last state.

    Args:
        grid: the planes between the cells.
        o, d: start in the box, and unit direction, in the world.
        length: length of the passage, up to the end in the box [length].
        visit: ``visit(state, cell, t0, t1, active) -> state``, with the interval of the cell [length]; called once, while
            Dr.Jit traces the loop.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.
        until: ``until(state) -> mask`` of lanes to stop, evaluated after each cell; None to walk to the end.

    Cost: three reads a cell.
    """
    planes = grid.planes
    first, top = mi.Vector3i(*grid.first), mi.Vector3i(*grid.counts) - 1
    ahead = d > 0
    last, sign, side = dr.select(ahead, top, 0), dr.select(ahead, mi.Vector3i(1), -1), dr.select(ahead, mi.Vector3i(1), 0)
    runs = dr.abs(d) > 1e-30
    pace = dr.rcp(dr.select(runs, d, 1))

    def step(active: mi.Bool, cell: mi.Vector3i, t: mi.Float, state: Any) -> tuple:
        # Behind the last plane of an axis, and along a plane, the ray stays in its cell.
        reach = mi.Vector3f()
        for a in range(3):
            place = dr.gather(mi.Float, planes, mi.UInt32(first[a] + cell[a] + side[a]))
            reach[a] = dr.select(runs[a] & (cell[a] != last[a]), (place - o[a]) * pace[a], dr.inf)
        plane = fast_min(fast_min(reach.x, reach.y), reach.z)
        end = fast_min(fast_max(plane, t), length)
        state = visit(state, cell, t, end, active)
        active = active & (plane < length)
        if until is not None:
            active &= ~until(state)
        # A tie is a step of length 0 through the next plane.
        x = reach.x <= plane
        y = ~x & (reach.y <= plane)
        through = mi.Vector3i(dr.select(x, 1, 0), dr.select(y, 1, 0), dr.select(x | y, 0, 1))
        return active, cell + sign * through, end, state

    begun = mi.Bool(active) & (length > 0), grid.find_cell(o)[0], mi.Float(0), state
    return dr.while_loop(begun, lambda active, *_: active, step, label="walk between planes")[3]
