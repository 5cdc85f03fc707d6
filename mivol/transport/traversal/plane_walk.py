"""The walk of a ray through cells between planes that stand at any places across the world axes.

The intervals of the cells follow each other without a gap: each begins at the number at which the one before it ends, and the
first and the last end with the passage. So a place on the passage lies in exactly one interval.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_field import PlaneGrid
from mivol.numerics import fast_max, fast_min

__all__ = ["walk_planes"]


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
        length: length of the passage, up to its end in the box [length].
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
