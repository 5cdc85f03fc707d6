"""The walk of a ray through the equal cells of one box, without a grid of values.

References: Amanatides & Woo 1987 (digital differential analyser).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.lattice import slab

__all__ = ["CellVisitor", "walk_box"]


CellVisitor = Callable[..., Any]
"""``visit(state, cell, t0, t1, on) -> state``: what to do with the interval of a ray in one cell (x, y, z)."""


def walk_box(rows: list[list[mi.Float64]], count: int, ray: Ray, visit: CellVisitor, state: Any, active: mi.Bool) -> Any:
    """Visit the cells of a box in the order of a ray that has no end.

    Args:
        rows: (3, 4) map from the world to the box, where a cell has the edge 1.
        count: cells along each axis.
        ray: world space.
        visit: :data:`CellVisitor`.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to walk.

    Returns:
        The last state. Cost: at most 3 ``count`` - 2 cells.
    """
    q, v, t0, t1 = slab(rows, (0.0,) * 3, (float(count),) * 3, ray.o, ray.d, mi.Float64(0), mi.Float64(dr.inf))
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
