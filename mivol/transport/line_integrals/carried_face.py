"""The corners of the cells that a ray crosses one after the other: those of the face between two are read, and written, once.

Conventions. Axes A, B, C of a cell are those of the grid in cyclic order from the one through whose face the ray has entered
(x where it comes from elsewhere), in the sense of the ray. Bits 0, 1, 2 of the number of a corner are A, B, C: even ones lie on
the face of entry. The four corners of a face stand in the order of the two axes that follow its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.occupied_walk import OccupiedCell

__all__ = ["CellCorners", "Face", "PendingGradients", "read_corners"]

ENTRY_CORNERS, FAR_CORNERS = (0, 2, 4, 6), (1, 3, 5, 7)
"""The corners of the face of entry, and the other four."""

EXIT_CORNERS = (FAR_CORNERS, (2, 6, 3, 7), (4, 5, 6, 7))
"""The corners of the faces through which a ray may leave: across A, B and C."""

OTHER_CORNERS = (ENTRY_CORNERS, (0, 4, 1, 5), (0, 1, 2, 3))
"""The corners opposite of those."""

Numbers = list
"""A number of each of some corners, or a list of numbers of each."""


@dataclass
class Face:
    """The face through which a ray has left a cell.

    Attributes:
        rows: of the field, of its corners; a list of 4.
        values: those of the corners, [corner][channel].
    """

    rows: list = field(default_factory=lambda: [mi.UInt32(0) for _ in range(4)])
    values: list = field(default_factory=lambda: _zeros(4))


@dataclass
class PendingGradients:
    """A face, and the derivatives by its values that wait for those of the next cell.

    Attributes:
        face: the face.
        waiting: as its values.
        some: whether there are any.
    """

    face: Face = field(default_factory=Face)
    waiting: list = field(default_factory=lambda: _zeros(4))
    some: mi.Bool = field(default_factory=lambda: mi.Bool(False))

    def add(self, corners: CellCorners, here: OccupiedCell, slopes: Numbers, write: Callable, on: mi.Bool) -> PendingGradients:
        """Add the derivatives of a cell, and write those of the corners that the ray leaves behind.

        Args:
            corners: of the cell.
            here: the cell.
            slopes: derivatives by the values of its corners, [corner][channel].
            write: ``write(row, derivatives, mask)``.
            on: lanes that are in the cell.
        """
        through = here.entered >= 0
        slopes = list(slopes)
        for q, waiting in zip(ENTRY_CORNERS, self.waiting, strict=True):
            slopes[q] = [s + dr.select(through, w, 0) for s, w in zip(slopes[q], waiting, strict=True)]
        behind = corners.behind(corners.rows), corners.behind(slopes)
        _write_twice(write, *behind, self.face.rows, self.waiting, on, self.some & ~through)
        waiting = _select_lanes(on, corners.ahead(slopes), self.waiting)
        face = Face(_select_lanes(on, corners.ahead(corners.rows), self.face.rows), corners.ahead(corners.values))
        return PendingGradients(face, waiting, self.some | on)

    def finish(self, write: Callable) -> None:
        """Write what still waits where rays have ended."""
        # Without this the walk would be taken once more, for what it leaves.
        dr.eval(self)
        _write(write, self.face.rows, self.waiting, self.some)


@dataclass
class CellCorners:
    """The corners of a cell, and how a ray goes on from there.

    Attributes:
        rows, values: of the 8 corners.
        points: the Gauss points, as fractions along A, B and C.
        across: 0, 1, 2 where the ray leaves across A, B, C.
    """

    rows: list[mi.UInt32]
    values: list[list[mi.Float]]
    points: tuple[mi.Vector3f, mi.Vector3f]
    across: mi.Int32

    def ahead(self, corners: Numbers) -> Numbers:
        """What belongs to the corners of the face through which the ray leaves."""
        return _select_corners(corners, EXIT_CORNERS, self.across)

    def behind(self, corners: Numbers) -> Numbers:
        """What belongs to the other four."""
        return _select_corners(corners, OTHER_CORNERS, self.across)

    def face(self) -> Face:
        """The face through which the ray leaves."""
        return Face(self.ahead(self.rows), self.ahead(self.values))


def read_corners(
    res: tuple[int, int, int],
    row: Callable[[mi.UInt32, mi.Bool], mi.UInt32],
    value: Callable[[mi.UInt32, mi.Bool], list[mi.Float]],
    face: Face,
    here: OccupiedCell,
    on: mi.Bool,
) -> CellCorners:
    """The corners of a cell, of which those of the last face are known where the ray has come through it.

    Args:
        res: nodes (Z, Y, X) of the grid.
        row: ``row(place, mask)`` of nodes by their flat numbers.
        value: ``value(row, mask)``, a list of channels.
        face: that the ray has left the last cell through.
        here, on: the cell, and lanes that are in it.

    Cost: 4 rows read; 8 where a ray of the packet comes from elsewhere.
    """
    axis = dr.maximum(here.entered, 0)
    place = _node_numbers(res, axis, here)

    def read(corners: tuple[int, ...], on: mi.Bool) -> Face:
        rows = [row(place(q), on) for q in corners]
        return Face(rows, [value(r, on) for r in rows])

    near = _read_if_new(on & (here.entered < 0), lambda on: read(ENTRY_CORNERS, on), face)
    far = read(FAR_CORNERS, on)
    rows = [r for pair in zip(near.rows, far.rows, strict=True) for r in pair]
    values = [v for pair in zip(near.values, far.values, strict=True) for v in pair]
    across = here.leaves - axis
    points = tuple(mi.Vector3f(*_cycle_axes(p, axis)) for p in here.along)
    return CellCorners(rows, values, points, dr.select(across < 0, across + 3, across))


@dr.syntax
def _read_if_new(elsewhere: mi.Bool, read: Callable[[mi.Bool], Face], face: Face) -> Face:
    if elsewhere:
        face = read(elsewhere)
    return face


@dr.syntax
def _write_twice(write: Callable, rows: list, values: list, more_rows: list, more: list, on: mi.Bool, again: mi.Bool) -> None:
    """Write four corners, and four more where rays have some: a loop of one turn in most packets."""
    on, again = mi.Bool(on), mi.Bool(again)
    while dr.hint(on, label="corners"):
        _write(write, rows, values, on)
        rows, values = list(more_rows), [list(m) for m in more]
        on &= again
        again = mi.Bool(False)


def _write(write: Callable, rows: list[mi.UInt32], values: list[list[mi.Float]], on: mi.Bool) -> None:
    for row, numbers in zip(rows, values, strict=True):
        write(row, numbers, on)


def _node_numbers(res: tuple[int, int, int], axis: mi.Int32, here: OccupiedCell) -> Callable[[int], mi.UInt32]:
    """The flat numbers of the nodes at the corners of a cell."""
    z, y, x = res
    low, high = dr.maximum(here.cell, 0), dr.minimum(here.cell + 1, mi.Vector3i(x - 1, y - 1, z - 1))
    stride, start = mi.Vector3i(1, x, x * y), mi.Vector3i(0, 0, here.level * z)
    near, far = dr.select(here.ahead, low, high), dr.select(here.ahead, high, low)
    ends = [_cycle_axes(stride * (start + p), axis) for p in (near, far)]

    def place(q: int) -> mi.UInt32:
        return mi.UInt32(sum(ends[q >> bit & 1][bit] for bit in range(3)))

    return place


def _cycle_axes(v: mi.Vector3f | mi.Vector3i, axis: mi.Int32) -> list:
    """The components of a vector along A, B and C."""
    return [_select_of_three(axis, *(v[(k + a) % 3] for a in range(3))) for k in range(3)]


def _select_corners(corners: Numbers, faces: tuple[tuple[int, ...], ...], across: mi.Int32) -> Numbers:
    """What belongs to the corners of one of three faces."""
    return [_select_of_three(across, *(corners[face[k]] for face in faces)) for k in range(4)]


def _select_of_three(which: mi.Int32, *choices: Any) -> Any:
    if isinstance(choices[0], list):
        return [_select_of_three(which, *parts) for parts in zip(*choices, strict=True)]
    return dr.select(which == 0, choices[0], dr.select(which == 1, choices[1], choices[2]))


def _select_lanes(on: mi.Bool, a: Numbers, b: Numbers) -> Numbers:
    """Those of ``a`` where a mask holds, else those of ``b``."""
    return [_select_lanes(on, x, y) if isinstance(x, list) else dr.select(on, x, y) for x, y in zip(a, b, strict=True)]


def _zeros(corners: int) -> list[list[mi.Float]]:
    """Density and three colours, a corner each."""
    return [[mi.Float(0) for _ in range(4)] for _ in range(corners)]
