r"""Emission-absorption compositing in one medium: a sweep over the cells of a ray's interval, from the far end to the near end.

.. math:: N \leftarrow N_i + T_i N

Conventions. The sweep runs back to front, so the light behind a cell is known at the cell, and no sum is undone. The reverse
pass repeats the walk of the forward pass: it subtracts from a float64 sum exactly the optical depths that the forward pass
added, bit for bit. Rows are channels or colours, followed by the rows of tangents if tangents are followed.

References: Max 1995 (the discrete emission-absorption integral); Porter & Duff 1984 (``over``, from back to front).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.line_integrals.integrand import LineIntegral, RayPiece
from mivol.transport.media.compositing import BodyIntegral, CellIntegral, ReverseState, composite_over, pass_cell, zeros
from mivol.transport.media.grid_extinction import SummedExtinction
from mivol.transport.media.ray_intervals import MediumInterval
from mivol.transport.traversal.grid_walk import Cell, walk_cells
from mivol.transport.traversal.interpolation import node_weights
from mivol.transport.traversal.lattice import Lattice, Segment, clip_to_grid
from mivol.transport.traversal.rays import Ray

__all__ = ["BodySweep"]


@dataclass
class _IntervalLayout:
    """The cells of an interval in a medium: cells lie between ``enter`` and ``leave``, only constants outside.

    ``segment`` runs from ``leave`` back to ``enter``; ``segment`` and ``lattice`` are None for a medium without a grid.
    """

    t0: mi.Float64
    enter: mi.Float64
    leave: mi.Float64
    t1: mi.Float64
    lattice: Lattice | None
    segment: Segment | None


class BodySweep:
    """The sweep over one medium.

    Args:
        line: line integral.
        interval: interval of the ray in the medium.
        tangent: whether to follow tangents, which the media took from the parameters.
    """

    def __init__(self, line: LineIntegral, interval: MediumInterval, tangent: bool = False) -> None:
        self.media, self.integrand, self.ray = line.media, line.integrand, line.ray_segment.ray
        self.body, self.active = interval.body, interval.active
        self.layout = _find_layout(interval, self.ray)
        self.extinction = self.body.extinction(self.ray)
        self.tangent = None
        if tangent:
            self.tangent = SummedExtinction(self.body.view.parts, self.body.tangents, mi.Float(1), linear=True)

    # -- The sum and its tangent ---------------------------------------------------------------------------------------

    def integrate(self, skip: bool) -> BodyIntegral:
        """Sum the rows of the medium.

        Args:
            skip: whether the walk may skip empty blocks, which changes the order of sums.

        Cost: a walk of the medium.
        """
        layout, tangent = self.layout, self.tangent is not None
        rows = self.integrand.rows * (2 if tangent else 1)
        integral = BodyIntegral(zeros(mi.Float64, rows), zeros(mi.Float, rows))

        def add_constant(integral: BodyIntegral, a: mi.Float64, b: mi.Float64) -> BodyIntegral:
            piece, sigma, integrals = self._constant(a, b)
            if not tangent:
                return composite_over(integral, integrals, [], [])
            changes = [[d] for d in self._rows(self.tangent.constant)]
            return composite_over(integral, integrals, changes, self.integrand.jvp(piece, sigma))

        def visit(integral: BodyIntegral, cell: Cell, on: mi.Bool) -> BodyIntegral:
            piece, sigma, integrals = self._cell(cell, on)
            if not tangent:
                return composite_over(integral, integrals, [], [])
            return composite_over(integral, integrals, self._tangents(cell), self.integrand.jvp(piece, sigma))

        if self._has_constants and layout.lattice is not None:
            integral = add_constant(integral, layout.leave, layout.t1)
        if layout.lattice is not None:
            alone = skip and len(self.extinction.reads) == 1 and not self._has_constants
            lattice = layout.lattice if alone else self._walked_lattice
            integral = walk_cells(lattice, layout.segment, visit, integral, self._reads, self.active)
        if self._has_constants:
            integral = add_constant(integral, layout.t0, layout.enter)
        return integral

    # -- The transpose -------------------------------------------------------------------------------------------------

    def vjp(self, weight: list[mi.Float], ahead: list[mi.Float64], behind: list[mi.Float]) -> None:
        """Add ``weight`` times the derivatives of N to the gradients of the medium.

        Args:
            weight: d loss / d N of each row.
            ahead: optical depth from the camera to the far end of the interval.
            behind: weight times N of the light behind the interval, attenuated to the camera.

        Cost: a walk of the medium, and one packed write of 8 a cell and channel.
        """
        integrand, layout, body = self.integrand, self.layout, self.body
        sweep = ReverseState(zeros(mi.Float, integrand.rows), [mi.Float64(a) for a in ahead], zeros(mi.Float, integrand.rows))
        grids = [p for p in body.view.parts if p.lattice is not None]
        outside: list[tuple] = []

        def add_constant(sweep: ReverseState, a: mi.Float64, b: mi.Float64) -> ReverseState:
            piece, sigma, integrals = self._constant(a, b)
            sweep, _, weights = pass_cell(sweep, integrals, weight, behind)
            outside.append((piece, sigma, weights))
            return sweep

        def visit(sweep: ReverseState, cell: Cell, on: mi.Bool) -> ReverseState:
            piece, sigma, integrals = self._cell(cell, on)
            sweep, slopes, weights = pass_cell(sweep, integrals, weight, behind)
            integrand.vjp(piece, sigma, weights)
            points = self._points(cell)
            corners = [node_weights(p, cell, layout.lattice.res) for p in points]
            activations = self.extinction.slopes(cell.corners, points)
            if activations is not None:
                slopes = [[g * slope for g, slope in zip(row, activations, strict=True)] for row in slopes]
            by_point = [self.media.sum_channels([row[p] for row in slopes]) for p in range(len(corners))]
            for part in grids:
                body.add_to_grid(part, cell.lower, list(zip(by_point, corners, strict=True)), on)
            return sweep

        if self._has_constants and layout.lattice is not None:
            sweep = add_constant(sweep, layout.leave, layout.t1)
        if layout.lattice is not None:
            sweep = walk_cells(self._walked_lattice, layout.segment, visit, sweep, self.extinction.reads, self.active)
        if self._has_constants:
            sweep = add_constant(sweep, layout.t0, layout.enter)
            body.add_to_constants(self.media.sum_channels(sweep.constant), self.active)
        # After the walk: Dr.Jit loses derivatives taken inside a loop by an array that already has derivatives before it.
        for piece, sigma, weights in outside:
            integrand.vjp(piece, sigma, weights)

    # -- Pieces of the ray ---------------------------------------------------------------------------------------------

    @property
    def _has_constants(self) -> bool:
        """Whether the medium has matter outside its grid too, which forbids skipping blocks."""
        return self.body.view.emission_density is not None or any(p.is_constant for p in self.body.view.parts)

    @property
    def _walked_lattice(self) -> Lattice:
        """The lattice to walk where empty blocks count: matter outside of the grid, or derivatives."""
        lattice = self.layout.lattice
        return replace(lattice, empty_distances=None) if self._has_constants else lattice.where_derivatives()

    @property
    def _reads(self) -> list:
        """Node arrays read by the walk."""
        return self.extinction.reads + (self.tangent.reads if self.tangent else [])

    def _cell(self, cell: Cell, on: mi.Bool) -> tuple[RayPiece, list[list[mi.Float]], list[CellIntegral]]:
        """A cell as a piece of the ray, its extinction [row][point], and its integrals; the walk runs towards the camera."""
        a = mi.Float(self.layout.leave - mi.Float64(cell.s + cell.dt))
        piece = RayPiece(self.body, self.ray, a, dr.select(on, cell.dt, 0), on)
        sigma = self._along(self.extinction, cell.corners[: len(self.extinction.reads)], cell)
        return piece, sigma, self.integrand.integrate_cell(piece, sigma)

    def _constant(self, a: mi.Float64, b: mi.Float64) -> tuple[RayPiece, list[list[mi.Float]], list[CellIntegral]]:
        """The same for the interval [a, b] of constant extinction."""
        on = self.active & (b > a)
        piece = RayPiece(self.body, self.ray, mi.Float(dr.select(on, a, 0)), mi.Float(dr.select(on, b - a, 0)), on)
        sigma = self._rows(self.extinction.constant)
        return piece, [[s] * len(self.integrand.points) for s in sigma], self.integrand.integrate_constant(piece, sigma)

    def _points(self, cell: Cell) -> list[mi.Vector3f]:
        """The points of a cell, as fractions from its near planes; the point nearest to the camera comes first."""
        return [dr.fma(cell.step, 1 - p, cell.frac) for p in self.integrand.points]

    def _along(self, extinction: SummedExtinction, corners: list, cell: Cell) -> list[list[mi.Float]]:
        """[row][point] values of an extinction, or of its tangent, at the points of a cell."""
        values = extinction.along(corners, self._points(cell))
        points = [self._rows([row[p] for row in values]) for p in range(len(self.integrand.points))]
        return [list(row) for row in zip(*points, strict=True)]

    def _tangents(self, cell: Cell) -> list[list[mi.Float]]:
        """[row][point] tangents of the extinction."""
        values = self._along(self.tangent, cell.corners[len(self.extinction.reads) :], cell)
        slopes = self.extinction.slopes(cell.corners, self._points(cell))
        return values if slopes is None else [[v * slope for v, slope in zip(row, slopes, strict=True)] for row in values]

    def _rows(self, channels: list[mi.Float]) -> list[mi.Float]:
        """One number for each row of the integrand, from one number for each channel of the medium."""
        channels = self.media.to_channels(channels)
        return [channels[r % len(channels)] for r in range(self.integrand.rows)]


def _find_layout(interval: MediumInterval, ray: Ray) -> _IntervalLayout:
    lattice = interval.body.view.walked_lattice
    start, end = mi.Float64(interval.t0), mi.Float64(interval.t1)
    if lattice is None:
        return _IntervalLayout(start, end, end, end, None, None)
    segment = clip_to_grid(lattice, ray.o, -ray.d, -interval.t1, -interval.t0)
    hit = segment.length > 0
    leave = dr.select(hit, -segment.start, end)
    return _IntervalLayout(start, dr.select(hit, -segment.end, end), leave, end, lattice, segment)
