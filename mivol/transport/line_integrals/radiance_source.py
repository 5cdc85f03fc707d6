"""How density and colour of a radiance field are read at the corners of its cells, and where their derivatives are added.

A :class:`Source` reads the corners of a cell: :class:`Baked` for rays from pinholes, where the harmonics of each node are
summed once per pinhole, in the direction from there; :class:`Exact` for any rays.

Conventions. Values come before the activation (density) and before the clamp at 0 (colour). Bits 0, 1, 2 of the number of a
corner are x, y, z.

References: Sloan 2008, 2013 (the basis of ``dr.sh_eval``); Fridovich-Keil, Yu et al. 2022 (the model).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical import SphericalGrid, row_width
from mivol.transport.traversal.occupied_cells import Cells

__all__ = ["Baked", "Colours", "Exact", "Source", "bake", "exact", "fold"]


Colours = list
"""Floats, [channel][corner]."""


class Source(Protocol):
    """Reads density and colour at the corners of cells, and takes their derivatives."""

    def read(self, cells: Cells, number: mi.UInt32, on: mi.Bool) -> tuple[list[mi.Float], Callable[[mi.Bool], Colours]]:
        """Raw densities of the 8 corners of listed cells, and a call for their colours where a mask says they are needed."""

    def add(self, cells: Cells, number: mi.UInt32, raw: list[mi.Float], colours: Colours, on: mi.Bool) -> None:
        """Add derivatives with respect to what :meth:`read` gave to those of the field."""


@dataclass
class Baked:
    """Density, and colour as seen from each pinhole, at the nodes of occupied cells: 4 numbers, which are read as one packet.

    Attributes:
        table: Float: raw density and rgb (its offset included) of a node; a block of all nodes for each pinhole.
        first: where the block of each lane's pinhole begins.
        slope: the derivative, laid out as ``table``; None where none is computed.
    """

    table: mi.Float
    first: mi.UInt32
    slope: mi.Float | None = None

    def read(self, cells: Cells, number: mi.UInt32, on: mi.Bool) -> tuple[list[mi.Float], Callable[[mi.Bool], Colours]]:
        packets = [dr.gather(mi.ArrayXf, self.table, node, on, shape=(4, 1)) for node in self._nodes(cells, number, on)]
        return [p[0] for p in packets], lambda on: [[p[k] for p in packets] for k in (1, 2, 3)]

    def add(self, cells: Cells, number: mi.UInt32, raw: list[mi.Float], colours: Colours, on: mi.Bool) -> None:
        for q, node in enumerate(self._nodes(cells, number, on)):
            _add_packet(self.slope, [raw[q], *(colours[k][q] for k in range(3))], node, on)

    def _nodes(self, cells: Cells, number: mi.UInt32, on: mi.Bool) -> list[mi.UInt32]:
        return [self.first + node for node in cells.nodes(number, on)]


@dataclass
class Exact:
    """Density and harmonics as they are stored, the harmonics summed at each corner in the direction of the ray.

    Attributes:
        density: Float, raw, one a row.
        harmonics: Float, ``row_width`` a row.
        basis: the harmonics of each lane's direction.
        offset: added to each colour.
        density_slope, harmonics_slope: the derivatives; None where none are computed.
    """

    density: mi.Float
    harmonics: mi.Float
    basis: list[mi.Float]
    offset: float = 0.5
    density_slope: mi.Float | None = None
    harmonics_slope: mi.Float | None = None

    @property
    def width(self) -> int:
        """Numbers a row, a multiple of 4."""
        return row_width(len(self.basis))

    def read(self, cells: Cells, number: mi.UInt32, on: mi.Bool) -> tuple[list[mi.Float], Callable[[mi.Bool], Colours]]:
        corners = cells.node_rows(number, on)

        def colours(on: mi.Bool) -> Colours:
            return list(zip(*(self._colour(c, on) for c in corners), strict=True))

        return [dr.gather(mi.Float, self.density, c, on) for c in corners], colours

    def _colour(self, row: mi.UInt32, on: mi.Bool) -> list[mi.Float]:
        return _summed(dr.gather(mi.ArrayXf, self.harmonics, row, on, shape=(self.width, 1)), self.basis, self.offset)

    def add(self, cells: Cells, number: mi.UInt32, raw: list[mi.Float], colours: Colours, on: mi.Bool) -> None:
        rest = [mi.Float(0)] * (self.width - 3 * len(self.basis))
        for q, c in enumerate(cells.node_rows(number, on)):
            _add_packet(self.density_slope, [raw[q]], c, on)
            _add_packet(self.harmonics_slope, [colours[k][q] * y for y in self.basis for k in range(3)] + rest, c, on)


def _summed(row: mi.ArrayXf, basis: list[mi.Float], offset: float) -> list[mi.Float]:
    """The colour of a row of harmonics, before it is clamped."""
    colour = [mi.Float(offset)] * 3
    for b, y in enumerate(basis):
        colour = [dr.fma(row[3 * b + k], y, c) for k, c in enumerate(colour)]
    return colour


def _add_packet(target: mi.Float, values: Sequence[mi.Float], row: mi.UInt32, on: mi.Bool) -> None:
    """Add numbers that lie side by side in memory; on the CPU each thread adds to a copy of its own, without atomics."""
    mode = dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
    value = mi.ArrayXf(list(values)) if len(values) > 1 else values[0]
    dr.scatter_add(target, value, row, on, mode=mode)


def bake(field: SphericalGrid, cells: Cells, points: np.ndarray, view: mi.UInt32, slope: bool = False) -> Baked:
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
    _bake(field, cells.rows, table, points)
    first = view * _count(cells.rows)
    return Baked(table, first, dr.zeros(mi.Float, _roomy(dr.width(table))) if slope else None)


@dr.syntax
def _bake(field: SphericalGrid, rows: mi.UInt32, table: mi.Float, points: np.ndarray) -> None:
    """Fill the blocks of a table, in a loop, so that the field is read once and one kernel serves any number of pinholes."""
    number, node, seen_from = dr.arange(mi.UInt32, dr.width(rows)), _node(field, rows), field.viewer(points)
    pinholes, count = dr.opaque(mi.UInt32, len(points)), _count(rows)
    raw = dr.gather(mi.Float, field.density, rows)
    values = dr.gather(mi.ArrayXf, field.harmonics, rows, shape=(field.width, 1))
    v = mi.UInt32(0)
    while dr.hint(v < pinholes, exclude=[table]):
        dr.scatter(table, mi.ArrayXf([raw, *_summed(values, seen_from(node, v), field.offset)]), number + v * count)
        v += 1


def _roomy(size: int) -> int:
    """Round a size up to one of few.

    A kernel that adds to an array with a copy for each thread contains its length, and is compiled anew for another.
    """
    step = 1 << max(size.bit_length() - 4, 2)
    return -(-size // step) * step


def _count(rows: mi.UInt32) -> mi.UInt32:
    """The number of rows as an opaque number: it changes during a fit, and the kernels need not be compiled anew."""
    return dr.opaque(mi.UInt32, dr.width(rows))


def _node(field: SphericalGrid, row: mi.UInt32) -> mi.UInt32:
    """The node of a row; any node for the row of the vacuum, whose values are not used."""
    return row if field.nodes is None else dr.gather(mi.UInt32, field.nodes, row, row < field.rows - 1)


def fold(field: SphericalGrid, cells: Cells, baked: Baked, points: np.ndarray) -> tuple[mi.Float, mi.Float]:
    """Derivatives with respect to the rows of a field, from those with respect to its baked table: the transpose of
    :func:`bake`.

    Returns:
        Those of ``density`` and of ``harmonics``.
    """
    return _over_pinholes(field, cells.rows, baked.slope, points)


@dr.syntax
def _over_pinholes(field: SphericalGrid, rows: mi.UInt32, nodes: mi.Float, points: np.ndarray) -> tuple[mi.Float, mi.Float]:
    """Sum the derivatives of all pinholes, in a loop, so that one kernel serves any number of them."""
    number = dr.arange(mi.UInt32, dr.width(rows))
    node = _node(field, rows)
    seen_from = field.viewer(points)
    pinholes, count, width = dr.opaque(mi.UInt32, len(points)), _count(rows), field.width
    packet = mi.ArrayXf([mi.Float(0)] * 4)
    raw = dr.zeros(mi.Float, dr.width(rows))
    harmonics = [dr.zeros(mi.Float, dr.width(rows)) for _ in range(width)]
    v = mi.UInt32(0)
    while v < pinholes:
        packet = dr.gather(mi.ArrayXf, nodes, number + v * count, shape=(4, 1))
        raw += packet[0]
        harmonics = _spread(harmonics, packet, seen_from(node, v))
        v += 1
    density, total = dr.zeros(mi.Float, field.rows), dr.zeros(mi.Float, field.rows * width)
    dr.scatter(density, raw, rows)
    dr.scatter(total, mi.ArrayXf(harmonics), rows)
    return density, total


def _spread(harmonics: list[mi.Float], packet: mi.ArrayXf, basis: list[mi.Float]) -> list[mi.Float]:
    """Add a colour's derivative times each harmonic."""
    more = [dr.fma(packet[1 + k], y, harmonics[3 * b + k]) for b, y in enumerate(basis) for k in range(3)]
    return more + harmonics[len(more) :]


def exact(field: SphericalGrid, d: mi.Vector3f, slope: bool = False) -> Exact:
    """The field as it is stored, for rays of any directions ``d``; ``slope``: whether derivatives will be computed."""
    zeros = [dr.zeros(mi.Float, dr.width(v)) if slope else None for v in (field.density, field.harmonics)]
    return Exact(field.density, field.harmonics, field.harmonics_of(d), field.offset, *zeros)
