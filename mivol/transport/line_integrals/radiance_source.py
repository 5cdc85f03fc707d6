"""Sources of a radiance field's values: they read density and colour at the corners of cells, and collect derivatives.

:class:`Baked` serves rays from pinholes: it sums the harmonics of each node once per pinhole, in the direction from the
pinhole. :class:`Exact` serves any rays: it sums harmonics at each corner, and carries the values of a face to the next cell:
the corners of a shared face are read, and their derivatives written, once.

Conventions. Values are raw: before the activation (density) and before the clamp at 0 (colour). The points of a cell are given
for the same numbering of corners. The axes A, B, C of a cell are the grid axes in cyclic order, beginning with the axis of the
face of entry (x if the ray comes from no neighbour), in the direction of the ray. Bits 0, 1, 2 of a corner's number are A, B,
C; even corners lie on the face of entry. The four corners of a face follow the order of the two axes after its axis.

References: Sloan 2008, 2013 (the basis of ``dr.sh_eval``); Fridovich-Keil, Yu et al. 2022 (the model).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.traversal.occupied_cells import OccupiedCells
from mivol.transport.traversal.occupied_walk import OccupiedCell

__all__ = [
    "Baked",
    "CellCorners",
    "CellValues",
    "Colours",
    "Exact",
    "Face",
    "PendingGradients",
    "Source",
    "add_packet",
    "bake",
    "make_exact",
    "read_corners",
    "sum_harmonics",
    "vjp_bake",
]

# -- Values of a face, carried to the next cell ------------------------------------------------------------------------


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


# -- Sources -----------------------------------------------------------------------------------------------------------


Colours = list
"""Floats, [channel][corner]."""


@dataclass
class CellValues:
    """The values of a cell.

    Attributes:
        raw: densities at the 8 corners.
        colours: function of a mask that returns the colours of the corners in lanes that need colours.
        points: Gauss points, as fractions along the axes of bits 0, 1, 2 of the corner numbers.
        corners: corners with their exit face, for a source that carries faces.
    """

    raw: list[mi.Float]
    colours: Callable[[mi.Bool], Colours]
    points: tuple[mi.Vector3f, mi.Vector3f]
    corners: CellCorners | None = None


class Source(Protocol):
    """Reads density and colour at the corners of cells, and collects derivatives.

    A ray carries a PyTree of the source from cell to cell; :meth:`start` gives its first value.

    Attributes:
        gains_by_sorting: whether reads are slow enough to pay for sorting rays.
    """

    gains_by_sorting: ClassVar[bool]

    def gather_lanes(self, which: mi.UInt32) -> Source:
        """The source for a selection of its lanes, with the same derivative."""

    def start(self, slope: bool = False) -> Any:
        """Carried state before the first cell; with ``slope`` the state for :meth:`add`."""

    def read(self, cells: OccupiedCells, visited: OccupiedCell, carried: Any, on: mi.Bool) -> CellValues:
        """The values of an occupied cell."""

    def carried_from(self, at: CellValues) -> Any:
        """Carried state after a cell was read."""

    def add(
        self,
        cells: OccupiedCells,
        visited: OccupiedCell,
        at: CellValues,
        carried: Any,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> Any:
        """Add derivatives by the values of :meth:`read` to the derivatives of the field; returns the carried state."""

    def finish(self, carried: Any) -> None:
        """Add the derivatives still carried at the ends of rays."""


@dataclass
class Baked:
    """Density, and colour as seen from each pinhole, at the nodes of occupied cells: 4 numbers, read as one packet.

    Attributes:
        table: Float, raw density and rgb (offset included) of each node; one block of all nodes for each pinhole.
        first: start of the block of each lane's pinhole.
        slope: derivative in the layout of ``table``; None without derivatives.
    """

    gains_by_sorting: ClassVar[bool] = False

    table: mi.Float
    first: mi.UInt32
    slope: mi.Float | None = None

    def gather_lanes(self, which: mi.UInt32) -> Baked:
        return replace(self, first=dr.gather(mi.UInt32, self.first, which))

    def start(self, slope: bool = False) -> list:
        return []

    def read(self, cells: OccupiedCells, visited: OccupiedCell, carried: list, on: mi.Bool) -> CellValues:
        nodes = self._nodes(cells, visited.number, on)
        packets = [dr.gather(mi.ArrayXf, self.table, node, on, shape=(4, 1)) for node in nodes]
        return CellValues([p[0] for p in packets], lambda on: [[p[k] for p in packets] for k in (1, 2, 3)], visited.points)

    def carried_from(self, at: CellValues) -> list:
        return []

    def add(
        self,
        cells: OccupiedCells,
        visited: OccupiedCell,
        at: CellValues,
        carried: list,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> list:
        for node, values in zip(self._nodes(cells, visited.number, on), zip(raw, *colours, strict=True), strict=True):
            add_packet(self.slope, values, node, on)
        return carried

    def finish(self, carried: list) -> None:
        pass

    def _nodes(self, cells: OccupiedCells, number: mi.UInt32, on: mi.Bool) -> list[mi.UInt32]:
        return [self.first + node for node in cells.nodes(number, on)]


@dataclass
class Exact:
    """Harmonics and density side by side; the harmonics of a node are summed in the direction of the ray.

    Attributes:
        field: radiance field.
        table: Float, harmonics and raw density of each row, ``packed_width`` numbers.
        basis: harmonics of each lane's direction.
        slope: derivative in the layout of ``table``; None without derivatives.
    """

    gains_by_sorting: ClassVar[bool] = True

    field: SphericalGrid
    table: mi.Float
    basis: list[mi.Float]
    slope: mi.Float | None = None

    def gather_lanes(self, which: mi.UInt32) -> Exact:
        dr.eval(self.basis)
        return replace(self, basis=[dr.gather(mi.Float, y, which) for y in self.basis])

    def start(self, slope: bool = False) -> Face | PendingGradients:
        return PendingGradients() if slope else Face()

    def read(self, cells: OccupiedCells, visited: OccupiedCell, carried: Face | PendingGradients, on: mi.Bool) -> CellValues:
        face = carried.face if isinstance(carried, PendingGradients) else carried
        corners = read_corners(cells.res, self.field.look_up_rows, self._value, face, visited, on)
        raw, *colours = (list(channel) for channel in zip(*corners.values, strict=True))
        return CellValues(raw, lambda on: colours, corners.points, corners)

    def carried_from(self, at: CellValues) -> Face:
        return at.corners.face()

    def add(
        self,
        cells: OccupiedCells,
        visited: OccupiedCell,
        at: CellValues,
        carried: PendingGradients,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> PendingGradients:
        slopes = [list(values) for values in zip(raw, *colours, strict=True)]
        return carried.add(at.corners, visited, slopes, self._write, on)

    def finish(self, carried: PendingGradients) -> None:
        carried.finish(self._write)

    def slopes(self) -> tuple[mi.Float, mi.Float]:
        """Derivatives with respect to ``density`` and ``harmonics`` of the field."""
        field = self.field
        every, many = dr.arange(mi.UInt32, field.rows), 3 * field.basis
        density, harmonics = (dr.empty(mi.Float, dr.width(v)) for v in (field.density, field.harmonics))
        row = dr.gather(mi.ArrayXf, self.slope, every, shape=(packed_width(field.basis), 1))
        dr.scatter(density, row[many], every)
        dr.scatter(harmonics, _pad_row([row[k] for k in range(many)], field.width), every)
        return density, harmonics

    def _value(self, row: mi.UInt32, on: mi.Bool) -> list[mi.Float]:
        """Raw density and rgb of a row."""
        values = dr.gather(mi.ArrayXf, self.table, row, on, shape=(packed_width(self.field.basis), 1))
        return [values[3 * self.field.basis], *sum_harmonics(values, self.basis, self.field.offset)]

    def _write(self, row: mi.UInt32, slopes: list[mi.Float], on: mi.Bool) -> None:
        """Add the derivatives by the values of :meth:`_value`."""
        raw, *colour = slopes
        values = [*(c * y for y in self.basis for c in colour), raw]
        add_packet(self.slope, _pad_row(values, packed_width(self.field.basis)), row, on)


def packed_width(basis: int) -> int:
    """Size of a row of harmonics and density, padded to packets of 4 or of 8 numbers, the largest packet of Dr.Jit."""
    return 4 if basis == 1 else -(-(3 * basis + 1) // 8) * 8


def _pad_row(values: list[mi.Float], width: int) -> mi.ArrayXf:
    """A row padded with 0."""
    return mi.ArrayXf([*values, *(mi.Float(0) for _ in range(width - len(values)))])


def sum_harmonics(row: mi.ArrayXf, basis: list[mi.Float], offset: float) -> list[mi.Float]:
    """The colour of a row of harmonics, before the clamp."""
    colour = [mi.Float(offset)] * 3
    for b, y in enumerate(basis):
        colour = [dr.fma(row[3 * b + k], y, c) for k, c in enumerate(colour)]
    return colour


def add_packet(target: mi.Float, values: Sequence[mi.Float], row: mi.UInt32, on: mi.Bool) -> None:
    """Add numbers that lie side by side in memory. On the CPU each thread adds to its own copy, without atomics."""
    mode = dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
    dr.scatter_add(target, mi.ArrayXf(list(values)), row, on, mode=mode)


def bake(
    field: SphericalGrid, cells: OccupiedCells, points: np.ndarray | mi.Float, view: mi.UInt32, slope: bool = False
) -> Baked:
    """Sum the harmonics of each node in the directions from pinholes.

    Args:
        field: radiance field.
        cells: occupied cells; other nodes are left out.
        points: (V, 3) world, the pinholes, or their offsets from :meth:`SphericalGrid.offsets_from`.
        view: number of each ray's pinhole.
        slope: whether derivatives will be computed.

    Bias: O(h^2 / r^2) of the colour for a cell of size h at distance r from a pinhole. The mean of the directions to the nodes,
        with trilinear weights, equals the direction of the ray to first order.
    Cost: the field is read once, and 4 numbers a node and pinhole are written.
    """
    offsets = _to_offsets(field, points)
    table = dr.zeros(mi.Float, 4 * dr.width(cells.rows) * _count_pinholes(offsets))
    _fill_table(field, cells.rows, table, offsets)
    first = view * _opaque_count(cells.rows)
    return Baked(table, first, dr.zeros(mi.Float, _round_up_size(dr.width(table))) if slope else None)


def _to_offsets(field: SphericalGrid, points: np.ndarray | mi.Float) -> mi.Float:
    return field.offsets_from(points) if isinstance(points, np.ndarray) else points


def _count_pinholes(offsets: mi.Float) -> int:
    return dr.width(offsets) // 3


@dr.syntax
def _fill_table(field: SphericalGrid, rows: mi.UInt32, table: mi.Float, offsets: mi.Float) -> None:
    """Fill the blocks of a table in a loop, which reads the field once; a single kernel serves any number of pinholes."""
    number, node, view_basis = dr.arange(mi.UInt32, dr.width(rows)), _look_up_node(field, rows), field.make_view_basis(offsets)
    pinholes, count = dr.opaque(mi.UInt32, _count_pinholes(offsets)), _opaque_count(rows)
    raw = dr.gather(mi.Float, field.density, rows)
    values = dr.gather(mi.ArrayXf, field.harmonics, rows, shape=(field.width, 1))
    v = mi.UInt32(0)
    while dr.hint(v < pinholes, exclude=[table]):
        dr.scatter(table, mi.ArrayXf([raw, *sum_harmonics(values, view_basis(node, v), field.offset)]), number + v * count)
        v += 1


def _round_up_size(size: int) -> int:
    """Round a size up to one of few sizes.

    A kernel that adds to a private copy per thread contains the length of the array, and would be compiled for each length.
    """
    step = 1 << max(size.bit_length() - 4, 2)
    return -(-size // step) * step


def _opaque_count(rows: mi.UInt32) -> mi.UInt32:
    """The number of rows as an opaque number: it changes during a fit, and kernels should not be compiled again."""
    return dr.opaque(mi.UInt32, dr.width(rows))


def _look_up_node(field: SphericalGrid, row: mi.UInt32) -> mi.UInt32:
    """The node of a row; the row of the vacuum gives an arbitrary node, whose values are unused."""
    return row if field.nodes is None else dr.gather(mi.UInt32, field.nodes, row, row < field.rows - 1)


def vjp_bake(
    field: SphericalGrid, cells: OccupiedCells, baked: Baked, points: np.ndarray | mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Derivatives by the rows of a field, density and harmonics, from the derivatives by its baked table: the transpose of
    bake.
    """
    return _sum_over_pinholes(field, cells.rows, baked.slope, _to_offsets(field, points))


@dr.syntax
def _sum_over_pinholes(field: SphericalGrid, rows: mi.UInt32, nodes: mi.Float, offsets: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Sum the derivatives of all pinholes in a loop; a single kernel serves any number of pinholes."""
    number = dr.arange(mi.UInt32, dr.width(rows))
    node = _look_up_node(field, rows)
    view_basis = field.make_view_basis(offsets)
    pinholes, count, width = dr.opaque(mi.UInt32, _count_pinholes(offsets)), _opaque_count(rows), field.width
    packet = mi.ArrayXf([mi.Float(0)] * 4)
    raw = dr.zeros(mi.Float, dr.width(rows))
    harmonics = [dr.zeros(mi.Float, dr.width(rows)) for _ in range(width)]
    v = mi.UInt32(0)
    while v < pinholes:
        packet = dr.gather(mi.ArrayXf, nodes, number + v * count, shape=(4, 1))
        raw += packet[0]
        harmonics = _add_outer_product(harmonics, packet, view_basis(node, v))
        v += 1
    density, total = dr.zeros(mi.Float, field.rows), dr.zeros(mi.Float, field.rows * width)
    dr.scatter(density, raw, rows)
    dr.scatter(total, mi.ArrayXf(harmonics), rows)
    return density, total


def _add_outer_product(harmonics: list[mi.Float], packet: mi.ArrayXf, basis: list[mi.Float]) -> list[mi.Float]:
    """Add the derivative of a colour times each harmonic."""
    sums = [dr.fma(packet[1 + k], y, harmonics[3 * b + k]) for b, y in enumerate(basis) for k in range(3)]
    return sums + harmonics[len(sums) :]


def make_exact(field: SphericalGrid, d: mi.Vector3f, slope: bool = False) -> Exact:
    """The source for rays of any directions.

    Args:
        field: radiance field.
        d: unit directions of the rays, world.
        slope: whether derivatives will be computed.

    Cost: all rows are copied once, since a packed row of harmonics and density is read five times faster than separate numbers.
        Derivatives double the memory.
    """
    width, every = packed_width(field.basis), dr.arange(mi.UInt32, field.rows)
    if field.nodes is not None:
        field.sparse_index()  # the index cannot be made inside a traced walk
    table = dr.empty(mi.Float, width * field.rows)
    row = dr.gather(mi.ArrayXf, field.harmonics, every, shape=(field.width, 1))
    values = [*(row[k] for k in range(3 * field.basis)), dr.gather(mi.Float, field.density, every)]
    dr.scatter(table, _pad_row(values, width), every)
    return Exact(field, table, field.eval_basis(d), dr.zeros(mi.Float, _round_up_size(width * field.rows)) if slope else None)
