"""How density and colour of a radiance field are read at the corners of its cells, and where their derivatives are added.

A :class:`Source` reads the corners of a cell: :class:`Baked` for rays from pinholes, where the harmonics of each node are
summed once per pinhole, in the direction from there; :class:`Exact` for any rays, which sum them at each corner, and so carry
what they found at the corners of a face on to the next cell (:mod:`mivol.transport.line_integrals.carried_face`).

Conventions. Values come before the activation (density) and before the clamp at 0 (colour). Corners have the numbers that the
points of their cell are given for.

References: Sloan 2008, 2013 (the basis of ``dr.sh_eval``); Fridovich-Keil, Yu et al. 2022 (the model).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.carried_face import CellCorners, Face, PendingGradients, read_corners
from mivol.transport.traversal.occupied_cells import OccupiedCells
from mivol.transport.traversal.occupied_walk import OccupiedCell

__all__ = ["Baked", "CellValues", "Colours", "Exact", "Source", "bake", "make_exact", "vjp_bake"]


Colours = list
"""Floats, [channel][corner]."""


@dataclass
class CellValues:
    """What a source gives of a cell.

    Attributes:
        raw: densities at the 8 corners.
        colours: a call for the colours of the corners, where a mask says that they are needed.
        points: the Gauss points, as fractions along the axes that bits 0, 1, 2 of the number of a corner stand for.
        corners: where a source carries faces, what it needs to go on from here.
    """

    raw: list[mi.Float]
    colours: Callable[[mi.Bool], Colours]
    points: tuple[mi.Vector3f, mi.Vector3f]
    corners: CellCorners | None = None


class Source(Protocol):
    """Reads density and colour at the corners of cells, and takes their derivatives.

    What a ray carries from cell to cell is any PyTree, and belongs to the source: a ray starts with that of :meth:`start`.

    Attributes:
        gains_by_sorting: whether reads take so long that rays are worth sorting.
    """

    gains_by_sorting: ClassVar[bool]

    def gather_lanes(self, which: mi.UInt32) -> Source:
        """The source for these of its lanes, with the same derivative."""

    def start(self, slope: bool = False) -> Any:
        """What rays carry that have met no cell; ``slope``: for :meth:`add`."""

    def read(self, cells: OccupiedCells, here: OccupiedCell, carried: Any, on: mi.Bool) -> CellValues:
        """The values of a listed cell."""

    def carried_from(self, at: CellValues) -> Any:
        """What rays carry on from a cell that they have read."""

    def add(
        self,
        cells: OccupiedCells,
        here: OccupiedCell,
        at: CellValues,
        carried: Any,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> Any:
        """Add derivatives by what :meth:`read` gave to those of the field; what rays carry on then."""

    def finish(self, carried: Any) -> None:
        """Add what rays have carried to their ends."""


@dataclass
class Baked:
    """Density, and colour as seen from each pinhole, at the nodes of occupied cells: 4 numbers, which are read as one packet.

    Attributes:
        table: Float: raw density and rgb (its offset included) of a node; a block of all nodes for each pinhole.
        first: where the block of each lane's pinhole begins.
        slope: the derivative, laid out as ``table``; None where none is computed.
    """

    gains_by_sorting: ClassVar[bool] = False

    table: mi.Float
    first: mi.UInt32
    slope: mi.Float | None = None

    def gather_lanes(self, which: mi.UInt32) -> Baked:
        return replace(self, first=dr.gather(mi.UInt32, self.first, which))

    def start(self, slope: bool = False) -> list:
        return []

    def read(self, cells: OccupiedCells, here: OccupiedCell, carried: list, on: mi.Bool) -> CellValues:
        nodes = self._nodes(cells, here.number, on)
        packets = [dr.gather(mi.ArrayXf, self.table, node, on, shape=(4, 1)) for node in nodes]
        return CellValues([p[0] for p in packets], lambda on: [[p[k] for p in packets] for k in (1, 2, 3)], here.points)

    def carried_from(self, at: CellValues) -> list:
        return []

    def add(
        self,
        cells: OccupiedCells,
        here: OccupiedCell,
        at: CellValues,
        carried: list,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> list:
        for node, values in zip(self._nodes(cells, here.number, on), zip(raw, *colours, strict=True), strict=True):
            _add_packet(self.slope, values, node, on)
        return carried

    def finish(self, carried: list) -> None:
        pass

    def _nodes(self, cells: OccupiedCells, number: mi.UInt32, on: mi.Bool) -> list[mi.UInt32]:
        return [self.first + node for node in cells.nodes(number, on)]


@dataclass
class Exact:
    """Harmonics and density side by side, the harmonics of a node summed in the direction of the ray.

    Attributes:
        field: the radiance field.
        table: Float: harmonics and raw density of each row, ``packed_width`` numbers.
        basis: the harmonics of each lane's direction.
        slope: the derivative, laid out as ``table``; None where none is computed.
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

    def read(self, cells: OccupiedCells, here: OccupiedCell, carried: Face | PendingGradients, on: mi.Bool) -> CellValues:
        face = carried.face if isinstance(carried, PendingGradients) else carried
        corners = read_corners(cells.res, self.field.look_up_rows, self._value, face, here, on)
        raw, *colours = (list(channel) for channel in zip(*corners.values, strict=True))
        return CellValues(raw, lambda on: colours, corners.points, corners)

    def carried_from(self, at: CellValues) -> Face:
        return at.corners.face()

    def add(
        self,
        cells: OccupiedCells,
        here: OccupiedCell,
        at: CellValues,
        carried: PendingGradients,
        raw: list[mi.Float],
        colours: Colours,
        on: mi.Bool,
    ) -> PendingGradients:
        slopes = [list(values) for values in zip(raw, *colours, strict=True)]
        return carried.add(at.corners, here, slopes, self._write, on)

    def finish(self, carried: PendingGradients) -> None:
        carried.finish(self._write)

    def slopes(self) -> tuple[mi.Float, mi.Float]:
        """The derivatives with respect to the rows of the field: those of ``density`` and of ``harmonics``."""
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
        return [values[3 * self.field.basis], *_sum_harmonics(values, self.basis, self.field.offset)]

    def _write(self, row: mi.UInt32, slopes: list[mi.Float], on: mi.Bool) -> None:
        """Add the derivatives by what :meth:`_value` gave."""
        raw, *colour = slopes
        values = [*(c * y for y in self.basis for c in colour), raw]
        _add_packet(self.slope, _pad_row(values, packed_width(self.field.basis)), row, on)


def packed_width(basis: int) -> int:
    """Numbers of a row of harmonics and density, filled up to packets of 4 or of 8, the largest that Dr.Jit moves."""
    return 4 if basis == 1 else -(-(3 * basis + 1) // 8) * 8


def _pad_row(values: list[mi.Float], width: int) -> mi.ArrayXf:
    """A row of so many numbers, filled up with 0."""
    return mi.ArrayXf([*values, *(mi.Float(0) for _ in range(width - len(values)))])


def _sum_harmonics(row: mi.ArrayXf, basis: list[mi.Float], offset: float) -> list[mi.Float]:
    """The colour of a row of harmonics, before it is clamped."""
    colour = [mi.Float(offset)] * 3
    for b, y in enumerate(basis):
        colour = [dr.fma(row[3 * b + k], y, c) for k, c in enumerate(colour)]
    return colour


def _add_packet(target: mi.Float, values: Sequence[mi.Float], row: mi.UInt32, on: mi.Bool) -> None:
    """Add numbers that lie side by side in memory; on the CPU each thread adds to a copy of its own, without atomics."""
    mode = dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
    dr.scatter_add(target, mi.ArrayXf(list(values)), row, on, mode=mode)


def bake(field: SphericalGrid, cells: OccupiedCells, points: np.ndarray, view: mi.UInt32, slope: bool = False) -> Baked:
    """Sum the harmonics of each node in the directions from pinholes.

    Args:
        field: the radiance field.
        cells: its occupied cells; other nodes are left out.
        points: (V, 3) world, the pinholes.
        view: the index of each ray's pinhole.
        slope: whether derivatives will be computed.

    Bias: O(h^2 / r^2) of the colour for a cell of size h at distance r from a pinhole: the directions to the nodes, averaged
        with their trilinear weights, are that of the ray to first order.
    Cost: the field is read once, and 4 numbers a node and pinhole are written.
    """
    table = dr.zeros(mi.Float, 4 * dr.width(cells.rows) * len(points))
    _fill_table(field, cells.rows, table, points)
    first = view * _opaque_count(cells.rows)
    return Baked(table, first, dr.zeros(mi.Float, _round_up_size(dr.width(table))) if slope else None)


@dr.syntax
def _fill_table(field: SphericalGrid, rows: mi.UInt32, table: mi.Float, points: np.ndarray) -> None:
    """Fill the blocks of a table, in a loop, so that the field is read once and one kernel serves any number of pinholes."""
    number, node, seen_from = dr.arange(mi.UInt32, dr.width(rows)), _look_up_node(field, rows), field.make_view_basis(points)
    pinholes, count = dr.opaque(mi.UInt32, len(points)), _opaque_count(rows)
    raw = dr.gather(mi.Float, field.density, rows)
    values = dr.gather(mi.ArrayXf, field.harmonics, rows, shape=(field.width, 1))
    v = mi.UInt32(0)
    while dr.hint(v < pinholes, exclude=[table]):
        dr.scatter(table, mi.ArrayXf([raw, *_sum_harmonics(values, seen_from(node, v), field.offset)]), number + v * count)
        v += 1


def _round_up_size(size: int) -> int:
    """Round a size up to one of few.

    A kernel that adds to an array with a copy for each thread contains its length, and is compiled anew for another.
    """
    step = 1 << max(size.bit_length() - 4, 2)
    return -(-size // step) * step


def _opaque_count(rows: mi.UInt32) -> mi.UInt32:
    """The number of rows as an opaque number: it changes during a fit, and the kernels need not be compiled anew."""
    return dr.opaque(mi.UInt32, dr.width(rows))


def _look_up_node(field: SphericalGrid, row: mi.UInt32) -> mi.UInt32:
    """The node of a row; any node for the row of the vacuum, whose values are not used."""
    return row if field.nodes is None else dr.gather(mi.UInt32, field.nodes, row, row < field.rows - 1)


def vjp_bake(field: SphericalGrid, cells: OccupiedCells, baked: Baked, points: np.ndarray) -> tuple[mi.Float, mi.Float]:
    """Derivatives with respect to the rows of a field, from those with respect to its baked table: the transpose of
    :func:`bake`.

    Returns:
        Those of ``density`` and of ``harmonics``.
    """
    return _sum_over_pinholes(field, cells.rows, baked.slope, points)


@dr.syntax
def _sum_over_pinholes(field: SphericalGrid, rows: mi.UInt32, nodes: mi.Float, points: np.ndarray) -> tuple[mi.Float, mi.Float]:
    """Sum the derivatives of all pinholes, in a loop, so that one kernel serves any number of them."""
    number = dr.arange(mi.UInt32, dr.width(rows))
    node = _look_up_node(field, rows)
    seen_from = field.make_view_basis(points)
    pinholes, count, width = dr.opaque(mi.UInt32, len(points)), _opaque_count(rows), field.width
    packet = mi.ArrayXf([mi.Float(0)] * 4)
    raw = dr.zeros(mi.Float, dr.width(rows))
    harmonics = [dr.zeros(mi.Float, dr.width(rows)) for _ in range(width)]
    v = mi.UInt32(0)
    while v < pinholes:
        packet = dr.gather(mi.ArrayXf, nodes, number + v * count, shape=(4, 1))
        raw += packet[0]
        harmonics = _add_outer_product(harmonics, packet, seen_from(node, v))
        v += 1
    density, total = dr.zeros(mi.Float, field.rows), dr.zeros(mi.Float, field.rows * width)
    dr.scatter(density, raw, rows)
    dr.scatter(total, mi.ArrayXf(harmonics), rows)
    return density, total


def _add_outer_product(harmonics: list[mi.Float], packet: mi.ArrayXf, basis: list[mi.Float]) -> list[mi.Float]:
    """Add a colour's derivative times each harmonic."""
    more = [dr.fma(packet[1 + k], y, harmonics[3 * b + k]) for b, y in enumerate(basis) for k in range(3)]
    return more + harmonics[len(more) :]


def make_exact(field: SphericalGrid, d: mi.Vector3f, slope: bool = False) -> Exact:
    """The field for rays of any directions.

    Args:
        field: the radiance field.
        d: unit directions of the rays, in the world.
        slope: whether derivatives will be computed.

    Cost: all rows are copied once, since a row of harmonics and density is read in a fifth of the time of numbers that lie
        apart; twice as much memory with derivatives.
    """
    width, every = packed_width(field.basis), dr.arange(mi.UInt32, field.rows)
    if field.nodes is not None:
        field.sparse_index()  # a walk is no place to make it
    table = dr.empty(mi.Float, width * field.rows)
    row = dr.gather(mi.ArrayXf, field.harmonics, every, shape=(field.width, 1))
    values = [*(row[k] for k in range(3 * field.basis)), dr.gather(mi.Float, field.density, every)]
    dr.scatter(table, _pad_row(values, width), every)
    return Exact(field, table, field.eval_basis(d), dr.zeros(mi.Float, _round_up_size(width * field.rows)) if slope else None)
