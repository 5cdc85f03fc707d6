"""Corner values carried along a ray from cell to cell: the corners of a shared face are read, and their derivatives written,
once.

Conventions. The axes A, B, C of a cell are the grid axes in cyclic order, beginning with the axis of the face of entry (x if
the ray comes from no neighbour), in the direction of the ray. Bits 0, 1, 2 of a corner's number are A, B, C; even corners lie
on the face of entry. The four corners of a face follow the order of the two axes after the axis of the face.
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
"""The corners of the face of entry, and the four far corners."""

EXIT_CORNERS = (FAR_CORNERS, (2, 6, 3, 7), (4, 5, 6, 7))
"""The corners of the exit face, for an exit across A, B and C."""

OTHER_CORNERS = (ENTRY_CORNERS, (0, 4, 1, 5), (0, 1, 2, 3))
"""The corners opposite to the exit face."""

Numbers = list
"""A number for each of several corners, or a list of numbers for each."""


@dataclass
class Face:
    """The face through which a ray has left a cell.

    Attributes:
        rows: field rows of the 4 corners.
        values: values at the corners, [corner][channel].
    """

    rows: list = field(default_factory=lambda: [mi.UInt32(0) for _ in range(4)])
    values: list = field(default_factory=lambda: _zeros(4))


@dataclass
class PendingGradients:
    """A face, and derivatives by its values that are not yet written: the next cell adds its own.

    Attributes:
        face: the face.
        pending: derivatives in the shape of the face's values.
        has_pending: lanes with derivatives to write.
    """

    face: Face = field(default_factory=Face)
    pending: list = field(default_factory=lambda: _zeros(4))
    has_pending: mi.Bool = field(default_factory=lambda: mi.Bool(False))

    def add(
        self, corners: CellCorners, visited: OccupiedCell, slopes: Numbers, write: Callable, on: mi.Bool
    ) -> PendingGradients:
        """Add the derivatives of a cell, and write the derivatives of the corners that the ray leaves behind.

        Args:
            corners: corners of the cell.
            visited: the cell.
            slopes: derivatives by the values of its corners, [corner][channel].
            write: ``write(row, derivatives, mask)``.
            on: lanes in the cell.
        """
        through = visited.entered >= 0
        slopes = list(slopes)
        for q, pending in zip(ENTRY_CORNERS, self.pending, strict=True):
            slopes[q] = [s + dr.select(through, w, 0) for s, w in zip(slopes[q], pending, strict=True)]
        behind = corners.behind(corners.rows), corners.behind(slopes)
        _write_twice(write, *behind, self.face.rows, self.pending, on, self.has_pending & ~through)
        pending = _select_lanes(on, corners.ahead(slopes), self.pending)
        face = Face(_select_lanes(on, corners.ahead(corners.rows), self.face.rows), corners.ahead(corners.values))
        return PendingGradients(face, pending, self.has_pending | on)

    def finish(self, write: Callable) -> None:
        """Write the pending derivatives at the ends of rays."""
        # Without this evaluation the kernel of the writes would repeat the walk.
        dr.eval(self)
        _write(write, self.face.rows, self.pending, self.has_pending)


@dataclass
class CellCorners:
    """The corners of a cell, and the face through which the ray leaves.

    Attributes:
        rows, values: field rows and values of the 8 corners.
        points: Gauss points, as fractions along A, B and C.
        across: 0, 1, 2 for an exit across A, B, C.
    """

    rows: list[mi.UInt32]
    values: list[list[mi.Float]]
    points: tuple[mi.Vector3f, mi.Vector3f]
    across: mi.Int32

    def ahead(self, corners: Numbers) -> Numbers:
        """The entries of ``corners``, one a corner of the cell, at the exit face."""
        return _select_corners(corners, EXIT_CORNERS, self.across)

    def behind(self, corners: Numbers) -> Numbers:
        """The entries of ``corners`` at the other four corners."""
        return _select_corners(corners, OTHER_CORNERS, self.across)

    def face(self) -> Face:
        """The exit face."""
        return Face(self.ahead(self.rows), self.ahead(self.values))


def read_corners(
    res: tuple[int, int, int],
    row: Callable[[mi.UInt32, mi.Bool], mi.UInt32],
    value: Callable[[mi.UInt32, mi.Bool], list[mi.Float]],
    face: Face,
    visited: OccupiedCell,
    on: mi.Bool,
) -> CellCorners:
    """Read the corners of a cell; a ray from the last cell brings the values of the shared face.

    Args:
        res: nodes (Z, Y, X) of the grid.
        row: ``row(node, mask)``, rows of nodes by their numbers.
        value: ``value(row, mask)``, a list of channels.
        face: exit face of the last cell.
        visited: the cell.
        on: lanes in the cell.

    Cost: 4 rows read; 8 in packets with a ray from no neighbour.
    """
    axis = dr.maximum(visited.entered, 0)
    node = _node_numbers(res, axis, visited)

    def read(corners: tuple[int, ...], on: mi.Bool) -> Face:
        rows = [row(node(q), on) for q in corners]
        return Face(rows, [value(r, on) for r in rows])

    near = _read_if_new(on & (visited.entered < 0), lambda on: read(ENTRY_CORNERS, on), face)
    far = read(FAR_CORNERS, on)
    rows = [r for pair in zip(near.rows, far.rows, strict=True) for r in pair]
    values = [v for pair in zip(near.values, far.values, strict=True) for v in pair]
    across = visited.leaves - axis
    points = tuple(mi.Vector3f(*_cycle_axes(p, axis)) for p in visited.along)
    return CellCorners(rows, values, points, dr.select(across < 0, across + 3, across))


@dr.syntax
def _read_if_new(is_new: mi.Bool, read: Callable[[mi.Bool], Face], face: Face) -> Face:
    if is_new:
        face = read(is_new)
    return face


@dr.syntax
def _write_twice(write: Callable, rows: list, values: list, more_rows: list, more: list, on: mi.Bool, twice: mi.Bool) -> None:
    """Write four corners, and four more in some lanes: a loop with a single turn in most packets."""
    on, twice = mi.Bool(on), mi.Bool(twice)
    while dr.hint(on, label="corners"):
        _write(write, rows, values, on)
        rows, values = list(more_rows), [list(m) for m in more]
        on &= twice
        twice = mi.Bool(False)


def _write(write: Callable, rows: list[mi.UInt32], values: list[list[mi.Float]], on: mi.Bool) -> None:
    for row, numbers in zip(rows, values, strict=True):
        write(row, numbers, on)


def _node_numbers(res: tuple[int, int, int], axis: mi.Int32, visited: OccupiedCell) -> Callable[[int], mi.UInt32]:
    """A function of corner numbers that returns the node numbers of the corners of a cell."""
    z, y, x = res
    low, high = dr.maximum(visited.cell, 0), dr.minimum(visited.cell + 1, mi.Vector3i(x - 1, y - 1, z - 1))
    stride, start = mi.Vector3i(1, x, x * y), mi.Vector3i(0, 0, visited.level * z)
    near, far = dr.select(visited.ahead, low, high), dr.select(visited.ahead, high, low)
    ends = [_cycle_axes(stride * (start + p), axis) for p in (near, far)]

    def node(q: int) -> mi.UInt32:
        return mi.UInt32(sum(ends[q >> bit & 1][bit] for bit in range(3)))

    return node


def _cycle_axes(v: mi.Vector3f | mi.Vector3i, axis: mi.Int32) -> list:
    """The components of a vector along A, B and C."""
    return [_select_of_three(axis, *(v[(k + a) % 3] for a in range(3))) for k in range(3)]


def _select_corners(corners: Numbers, faces: tuple[tuple[int, ...], ...], across: mi.Int32) -> Numbers:
    """The entries of ``corners`` at one of three faces."""
    return [_select_of_three(across, *(corners[face[k]] for face in faces)) for k in range(4)]


def _select_of_three(which: mi.Int32, *choices: Any) -> Any:
    if isinstance(choices[0], list):
        return [_select_of_three(which, *parts) for parts in zip(*choices, strict=True)]
    return dr.select(which == 0, choices[0], dr.select(which == 1, choices[1], choices[2]))


def _select_lanes(on: mi.Bool, a: Numbers, b: Numbers) -> Numbers:
    """Entries of ``a`` in lanes of a mask, of ``b`` in the others."""
    return [_select_lanes(on, x, y) if isinstance(x, list) else dr.select(on, x, y) for x, y in zip(a, b, strict=True)]


def _zeros(corners: int) -> list[list[mi.Float]]:
    """Density and three colours, zero, for each corner."""
    return [[mi.Float(0) for _ in range(4)] for _ in range(corners)]
