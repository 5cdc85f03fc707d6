"""The walk of a ray through the leaves of an octree, from leaf plane to leaf plane.

Planes. The cell of a ray is a whole number along each axis, and the distance of a plane is computed from its number and the
point of entry, so nothing accumulates along a ray. A ray in a plane, an edge or a corner belongs to one of the
cells beside it, by the whole number, and never stands still: at least one axis advances by a cell in each step.

References: Amanatides & Woo 1987 (the traversal).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.numerics import fast_max, fast_min
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.lattice import Segment, split_float64
from mivol.transport.traversal.leaf_index import LeafIndex, find_octant

__all__ = ["VisitedLeaf", "clip_to_octree", "reverse_from", "walk_leaves"]


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
        until: ``until(state) -> mask`` of lanes that stop after one more leaf, evaluated before each leaf; None to walk to the
            end.

    Returns:
        The last state, the first visited cell of the last visited leaf, and the distance of its exit from the start of the
        segment [length]; the distance is 0 for a ray without leaves.

    Error: positions are off by at most 2^-23 (X + Y + Z) cells, for 2^depth cells along each axis.
    Cost: up to four reads a leaf, or stretch of vacuum.
    """
    # Along each axis on which the ray runs downwards, cells are counted from the other end: every ray then runs upwards.
    length, d = segment.length, dr.abs(segment.d)
    highest = dr.opaque(mi.Int32, 2**index.depth - 1)
    turn = dr.select(segment.d < 0, mi.Vector3i(highest), 0)
    entry = mi.Vector3f(segment.cell) + segment.frac
    entry = dr.select(segment.d < 0, mi.Float(highest + 1) - entry, entry)
    low, high = (mi.Vector3i(*(mi.Int32(v) for v in side)) for side in (index.low, index.high))
    end = dr.select(segment.d < 0, highest + 1 - low, high)
    still = d < 1e-30
    pace = dr.select(still, 0, dr.rcp(d))
    # The distance of plane k along an axis is pace k + offset; an axis to which the ray is parallel has no plane.
    offset = dr.select(still, mi.Vector3f(1e30), -entry * pace)
    towards = find_octant(segment.d)

    def cross(cell: mi.Vector3i, edge: mi.Int32, beyond: mi.Vector3i) -> tuple[mi.Float, mi.Vector3i]:
        """Distance of the exit from a leaf or a stretch of vacuum, and the next cell."""
        plane = (cell | (edge - 1)) + (beyond + 1)
        reach = dr.fma(mi.Vector3f(plane), pace, offset)
        exit = fast_min(fast_min(reach.x, reach.y), reach.z)
        within = dr.clip(mi.Vector3i(dr.fma(d, exit, entry)), cell, plane - 1)
        return exit, dr.select(reach <= exit, plane, within)

    # -- State ---------------------------------------------------------------------------------------------------------
    active = mi.Bool(active) & (length > 0)
    cell = segment.cell ^ turn
    t = mi.Float(0)
    last, left = mi.Vector3i(cell), mi.Float(0)

    # -- The first leaf: most rays of a photograph meet none, and their packets end here ----------------------------------
    found, searching = mi.Bool(False), mi.Bool(active)
    while dr.hint(searching, label="vacuum"):
        row, is_leaf, edge, beyond = index.look_up(cell ^ turn, towards, searching)
        found |= searching & is_leaf
        searching &= ~is_leaf
        exit, following = cross(cell, edge, beyond)
        cell = dr.select(searching, following, cell)
        t = dr.select(searching, fast_max(exit, t), t)
        searching &= (exit < length) & dr.all(cell < end)
    active = found

    # -- Leaf by leaf ----------------------------------------------------------------------------------------------------
    # The next cell does not wait for the values of the leaf: a lane that is done looks up one more cell, and visits nothing.
    while dr.hint(active, label="leaves"):
        row, is_leaf, edge, beyond = index.look_up(cell ^ turn, towards, active)
        exit, following = cross(cell, edge, beyond)
        stop = fast_max(fast_min(exit, length), t)
        on = active & is_leaf
        active &= (exit < length) & dr.all(following < end)
        if until is not None:
            active &= ~until(state)  # before the visit, so that the next look-up does not wait for the values of the leaf
        state = visit(state, VisitedLeaf(row, t, stop - t), on)
        last = dr.select(on, cell, last)
        left = dr.select(on, stop, left)
        cell, t = following, stop
    return state, last ^ turn, left


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
