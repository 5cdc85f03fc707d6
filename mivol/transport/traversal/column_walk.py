"""The walk of rays that seldom cross one axis of a grid: the rays of a scanner, whose detector's rows lie across that axis.

A cell is four columns of two nodes along that axis. A ray moves between columns where it crosses another axis; where it crosses
a layer of that axis, and after every PIECE voxels, it starts afresh from its place in float64. So the loop over cells has
two planes to look for, two columns to change and no sums that must be compensated: half the instructions of the walk of any
ray (:mod:`mivol.transport.traversal.grid_walk`).

Conventions. Axes are numbered x, y, z. The nodes are padded by one on each side, whose values are those of the outermost
nodes, so that no index is clamped. Cells are those of :mod:`mivol.transport.traversal.lattice`; columns of a cell are numbered
near (0) or far (1) along the ray in the first and the second other axis, bits 0 and 1.

References: Amanatides & Woo 1987 (the traversal).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mivol.numerics import lesser

__all__ = ["ColumnCell", "ColumnGrid", "Corner", "Hooks", "Line", "walk_columns"]

PIECE = 32.0
"""Voxels along a ray's fastest axis between two fresh starts: float32 errs by 3e-8 of a cell in a step, by 1e-6 in 32."""


@dataclass(frozen=True)
class ColumnGrid:
    """A grid of nodes with a margin of one, and the axis of its columns.

    Attributes:
        res: (Z, Y, X), without the margin.
        along: axis of the columns; rays cross its layers seldom.
    """

    res: tuple[int, int, int]
    along: int

    @property
    def padded(self) -> tuple[int, int, int]:
        """(Z, Y, X) with the margin."""
        return tuple(n + 2 for n in self.res)

    @property
    def size(self) -> int:
        """Nodes with the margin."""
        z, y, x = self.padded
        return z * y * x

    @property
    def strides(self) -> tuple[int, int, int]:
        """Flat distance of neighbouring nodes along x, y, z."""
        _, y, x = self.padded
        return 1, x, x * y

    @property
    def rise(self) -> int:
        """Flat distance of the two nodes of a column."""
        return self.strides[self.along]

    @property
    def across(self) -> tuple[int, int]:
        """The two other axes."""
        return tuple(a for a in range(3) if a != self.along)


class Line(NamedTuple):
    """The part of a ray in a grid: from ``q`` along ``v`` for ``length``, in coordinates of the grid's nodes, float64."""

    q: list[mi.Float64]
    v: list[mi.Float64]
    length: mi.Float64


class Corner(NamedTuple):
    """Where the columns of a cell are: the flat node at the foot of column 0, and the steps to the columns 1 and 2."""

    base: mi.Int32
    first: mi.Int32
    second: mi.Int32


class ColumnCell(NamedTuple):
    """What a visitor sees of a cell: where the ray enters and how far it goes, in fractions of the cell, and the length.

    Fractions across are from the near columns, those along the columns from their feet.
    """

    frac: tuple[mi.Float, mi.Float, mi.Float]
    step: tuple[mi.Float, mi.Float, mi.Float]
    dt: mi.Float


class Hooks(NamedTuple):
    """What is done on the way; ``columns`` is any PyTree, usually four numbers of each kind.

    Attributes:
        open: ``open(corner, on) -> columns``, where a ray starts afresh.
        visit: ``visit(state, columns, cell) -> (state, columns)``.
        cross: ``cross(columns, corner, through, on) -> columns``: the cell at ``corner`` is left through its first axis where
            ``through`` is true, else through the second.
        close: ``close(state, columns, corner, on) -> state``, before a fresh start and in the end.
    """

    open: Callable[[Corner, mi.Bool], Any]
    visit: Callable[[Any, Any, ColumnCell], tuple[Any, Any]]
    cross: Callable[[Any, Corner, mi.Bool, mi.Bool], Any]
    close: Callable[[Any, Any, Corner, mi.Bool], Any]


@dr.syntax
def walk_columns(grid: ColumnGrid, line: Line, hooks: Hooks, state: Any) -> Any:
    """Visit the cells that a line crosses, in order, and return the last state.

    Args:
        grid: its strides are those of the nodes that the hooks read or write.
        line: inside the box, half a voxel around the outermost nodes.
        hooks: called once, while the loops are traced.
        state: any PyTree of Dr.Jit arrays.

    Cost: a step a cell, and a fresh start a layer that is crossed and PIECE voxels.
    """
    # Objects that a loop's body names become part of its state: the body names arrays and functions only.
    begin, visit, cross, close = hooks
    a, b, c = *grid.across, grid.along
    n, stride = grid.res[::-1], grid.strides
    v_a, v_b, v_c, q_a, q_b, q_c, length = line.v[a], line.v[b], line.v[c], line.q[a], line.q[b], line.q[c], line.length
    up_a, up_b, up_c = v_a > 0, v_b > 0, v_c > 0
    speed_a, speed_b, speed_c = mi.Float(dr.abs(v_a)), mi.Float(dr.abs(v_b)), mi.Float(v_c)
    # 1e30, not infinity: a ray in a plane has distance 0 to it, and 0 * inf would be NaN.
    pace_a = dr.select(speed_a > 1e-30, dr.rcp(speed_a), 1e30)
    pace_b = dr.select(speed_b > 1e-30, dr.rcp(speed_b), 1e30)
    first, second = _signed(up_a, stride[a]), _signed(up_b, stride[b])
    piece = PIECE / dr.maximum(dr.maximum(dr.abs(v_a), dr.abs(v_b)), dr.abs(v_c))

    # -- The layer between two planes of c, as the number of its lower one, and where along the ray it ends ----------------
    layer = dr.clip(dr.floor(q_c), -1, n[c] - 1)
    thick = dr.select(v_c == 0, dr.inf, dr.abs(1 / dr.select(v_c == 0, 1, v_c)))
    ends = dr.select(v_c == 0, dr.inf, dr.abs(layer + dr.select(up_c, 1, 0) - q_c) * thick)
    start, going = mi.Float64(0), length > 0

    while dr.hint(going, label="pieces of a ray"):
        end = dr.maximum(lesser(lesser(ends, start + piece), length), start)
        left = mi.Float(end - start)
        frac_a, base_a = _enter(dr.fma(start, v_a, q_a), up_a, n[a] - 1, stride[a])
        frac_b, base_b = _enter(dr.fma(start, v_b, q_b), up_b, n[b] - 1, stride[b])
        frac_c = mi.Float(dr.fma(start, v_c, q_c) - layer)
        base = base_a + base_b + (mi.Int32(layer) + 1) * stride[c]
        on = going & (left > 0)
        walked = mi.Bool(on)
        columns = begin(Corner(base, first, second), on)

        while dr.hint(on, label="walk between columns"):
            reach_a, reach_b = dr.fma(-frac_a, pace_a, pace_a), dr.fma(-frac_b, pace_b, pace_b)
            dt = lesser(lesser(reach_a, reach_b), left)
            step_a, step_b, step_c = speed_a * dt, speed_b * dt, speed_c * dt
            cell = ColumnCell((frac_a, frac_b, frac_c), (step_a, step_b, step_c), dt)
            state, columns = visit(state, columns, cell)
            through = reach_a <= reach_b
            left -= dt
            on &= left > 0
            frac_a = dr.select(through, 0, frac_a + step_a)
            frac_b = dr.select(through, frac_b + step_b, 0)
            frac_c += step_c
            columns = cross(columns, Corner(base, first, second), through, on)
            base += dr.select(through, first, second)

        state = close(state, columns, Corner(base, first, second), walked)
        leaves = ends <= end
        layer = dr.clip(dr.select(leaves, layer + dr.select(up_c, 1, -1), layer), -1, n[c] - 1)
        ends = dr.select(leaves, ends + thick, ends)
        start = mi.Float64(end)
        going &= end < length
    return state


def _signed(up: mi.Bool, stride: int) -> mi.Int32:
    return dr.select(up, mi.Int32(stride), mi.Int32(-stride))


def _enter(p: mi.Float64, up: mi.Bool, last: int, stride: int) -> tuple[mi.Float, mi.Int32]:
    """The fraction of a cell from its near plane, and what that plane adds to the flat index of a padded node."""
    lower = dr.clip(dr.floor(p), -1, last)
    frac = mi.Float(p - lower)
    return dr.select(up, frac, 1 - frac), (mi.Int32(lower) + dr.select(up, 1, 2)) * stride
