r"""Emission-absorption compositing of all media along a ray, with the tangent and the transpose of the sum.

.. math:: N = \sum_i T_1 \cdots T_{i-1} N_i

A sweep (:class:`BodySweep`; for Gaussians :mod:`mivol.transport.media.gaussian_sweep`) integrates each medium alone, over the
cells of the interval of the ray from the far end to the near end: N <- N_i + T_i N. The light behind a cell is known at the
cell, and no sum is undone. The reverse pass repeats the walk of the forward pass: it subtracts from a float64 sum exactly the
optical depths that the forward pass added, bit for bit. Media are disjoint, so the middles of their intervals give their order
along the ray, and the optical depth of the media in front attenuates each medium.

Conventions. Media in boxes are integrated once and kept in a list. Traced intervals come in the order of the ray, in a loop
that keeps only sums. Rows are channels or colours, followed by the rows of tangents if tangents are followed.

References: Max 1995 (the discrete emission-absorption integral); Porter & Duff 1984 (``over``, from back to front).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.numerics import maximum, one_minus_exp
from mivol.transport.line_integrals.integrand import LineIntegral, RayPiece, check_cells_shared
from mivol.transport.media.compositing import (
    BodyIntegral,
    CellIntegral,
    ReverseState,
    composite_over,
    pass_cell,
    transmittance_of,
    zeros,
)
from mivol.transport.media.gaussian_sweep import GaussianSweep
from mivol.transport.media.grid_extinction import NodeValues, SummedExtinction
from mivol.transport.media.ray_intervals import MediumInterval, find_boxed_intervals, trace_boundaries
from mivol.transport.traversal.grid_walk import Cell, walk_cells
from mivol.transport.traversal.interpolation import node_weights
from mivol.transport.traversal.lattice import Lattice, Segment, clip_to_grid
from mivol.transport.traversal.rays import Ray

__all__ = ["BodySweep", "Composite", "composite_ray", "vjp_composite"]


@dataclass
class _BoxedMedium:
    """A medium in a box along a ray.

    Attributes:
        interval: interval of the ray in the medium.
        middle: middle of the interval, which orders the media.
        own: integral of the medium alone.
        front: optical depth in front of the medium.
        attenuated: N of the medium, attenuated to the camera.
        behind: N behind the medium, attenuated to the camera.
    """

    interval: MediumInterval
    middle: mi.Float64
    own: BodyIntegral
    front: list[mi.Float64]
    attenuated: list[mi.Float]
    behind: list[mi.Float]


@dataclass
class _TracedSums:
    """Sums over the traced intervals.

    Attributes:
        tau: optical depth.
        N: sum, attenuated to the camera.
        fronts: for each boxed medium, the optical depth of the traced intervals in front.
        behinds: for each boxed medium, N of the traced intervals behind, attenuated to the camera.
        max_opaque: largest N of an interval if the interval were opaque.
    """

    tau: list[mi.Float64]
    N: list[mi.Float]
    fronts: list[list[mi.Float64]]
    behinds: list[list[mi.Float]]
    max_opaque: mi.Float


@dataclass
class Composite:
    """The sum along a ray, with the parts that the transpose needs.

    Attributes:
        boxes, traced: media in boxes, and sums over traced intervals.
        tau: optical depth [1] of the whole ray, each row (then its tangent).
        last: contribution of the end of the ray, attenuated to the camera.
        N: sum, each row (then its tangent).
    """

    boxes: list[_BoxedMedium]
    traced: _TracedSums
    tau: list[mi.Float64]
    last: list[mi.Float]
    N: list[mi.Float]


def composite_ray(line: LineIntegral, end: list[mi.Float], tangent: bool = False, skip: bool = False) -> Composite:
    """Integrate each medium alone, and composite the media in the order of the ray.

    Args:
        line: line integral.
        end: contribution of the end of the ray, each row, not attenuated.
        tangent: whether to follow tangents, which the media took from the parameters.
        skip: whether to skip empty blocks, which changes the order of sums.

    Raises:
        MivolError: a medium with grids of two resolutions or places, or with an extinction that depends on the direction.

    Cost: a walk of each medium.
    """
    media, integrand, ray_segment = line.media, line.integrand, line.ray_segment
    check_cells_shared(media, integrand)
    rows = integrand.rows * (2 if tangent else 1)

    boxes = []
    for interval in find_boxed_intervals(media, ray_segment.ray, ray_segment.length, line.active):
        middle = interval.middle() if len(media.bodies) > 1 else mi.Float64(0)
        own = make_sweep(line, interval, tangent).integrate(skip)
        boxes.append(_BoxedMedium(interval, middle, own, zeros(mi.Float64, rows), [], zeros(mi.Float, rows)))

    def add_interval(t: _TracedSums, interval: MediumInterval) -> _TracedSums:
        own, middle = make_sweep(line, interval, tangent).integrate(skip), interval.middle()
        attenuated = _multiply_transmittance(_add_rows(t.tau, _tau_in_front(boxes, middle, rows)), own.N, integrand.rows)
        opacity = [one_minus_exp(mi.Float(x)) for x in own.tau[: integrand.rows]]
        means = [dr.select(a > 0, n / dr.select(a > 0, a, 1), 0) for n, a in zip(own.N, opacity, strict=False)]
        return _TracedSums(
            _add_rows(t.tau, own.tau),
            _add_rows(t.N, attenuated),
            [_add_rows(f, _mask_rows(middle < b.middle, own.tau)) for f, b in zip(t.fronts, boxes, strict=True)],
            [_add_rows(g, _mask_rows(middle > b.middle, attenuated)) for g, b in zip(t.behinds, boxes, strict=True)],
            dr.maximum(t.max_opaque, maximum(means)),
        )

    traced = _TracedSums(
        zeros(mi.Float64, rows),
        zeros(mi.Float, rows),
        [zeros(mi.Float64, rows) for _ in boxes],
        [zeros(mi.Float, rows) for _ in boxes],
        mi.Float(0),
    )
    if media.traced:
        ray, medium, passes_null = ray_segment.ray, ray_segment.medium, ray_segment.passes_null
        _, traced = trace_boundaries(media, ray, medium, add_interval, traced, line.active, passes_null)
    return _composite_media(boxes, traced, end, integrand.rows, rows)


def make_sweep(line: LineIntegral, interval: MediumInterval, tangent: bool = False) -> BodySweep | GaussianSweep:
    """The sweep over one medium."""
    if interval.body.view.gaussians is None:
        return BodySweep(line, interval, tangent)
    return GaussianSweep(interval, line.integrand.rows, tangent)


def _composite_media(
    boxes: list[_BoxedMedium], traced: _TracedSums, end: list[mi.Float], channels: int, rows: int
) -> Composite:
    """Find the light in front of and behind each boxed medium, and N of the whole ray."""
    for box, front in zip(boxes, traced.fronts, strict=True):
        box.front = _add_rows(front, _tau_in_front(boxes, box.middle, rows))
        box.attenuated = _multiply_transmittance(box.front, box.own.N, channels)
    total = traced.tau
    for box in boxes:
        total = _add_rows(total, box.own.tau)
    last = _multiply_transmittance(total, end + zeros(mi.Float, rows - channels), channels)
    N = _add_rows(traced.N, last)
    for box, behind in zip(boxes, traced.behinds, strict=True):
        N = _add_rows(N, box.attenuated)
        box.behind = _add_rows(behind, _add_rows(last, _visible_behind(boxes, box.middle, rows)))
    return Composite(boxes, traced, total, last, N)


def vjp_composite(line: LineIntegral, composite: Composite, weight: list[mi.Float], rest: list[mi.Float]) -> None:
    """Add ``weight`` times the derivatives of N to the gradients of the media: the transpose of the tangent.

    The light behind a cell is a sum, not a difference, so a voxel behind an optical depth of 50 gets its derivative of the size
    e^-50. Only the light behind a traced interval is a difference of two sums; it is clamped to the largest value that the
    transmittance in front of the interval allows.

    Args:
        line: line integral of :func:`composite_ray`.
        composite: result of :func:`composite_ray`.
        weight: d loss / d N of each row.
        rest: d loss / d log T of each row, with T the transmittance of the whole ray, for light from behind its end.

    Cost: a walk of each medium, and one packed write of 8 a cell and channel; traced intervals are walked twice.
    """
    media, integrand, ray_segment = line.media, line.integrand, line.ray_segment
    for box in composite.boxes:
        ahead = _add_rows(box.front, box.own.tau)
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, box.behind, rest, strict=True)]
        make_sweep(line, box.interval).vjp(weight, ahead, behind)

    def add_gradients(passed: BodyIntegral, interval: MediumInterval) -> BodyIntegral:
        sweep, middle = make_sweep(line, interval), interval.middle()
        own = sweep.integrate(False)
        front = _add_rows(passed.tau, _tau_in_front(composite.boxes, middle, integrand.rows))
        ahead, N = _add_rows(front, own.tau), _add_rows(passed.N, _multiply_transmittance(front, own.N, integrand.rows))
        P = [transmittance_of(a) for a in ahead]
        near, far = integrand.lower_bound(interval.t1), composite.traced.max_opaque
        remaining = [dr.clip(n - m, p * near, p * far) for n, m, p in zip(composite.traced.N, N, P, strict=True)]
        visible = _add_rows(remaining, _add_rows(composite.last, _visible_behind(composite.boxes, middle, integrand.rows)))
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, visible, rest, strict=True)]
        sweep.vjp(weight, ahead, behind)
        return BodyIntegral(_add_rows(passed.tau, own.tau), N)

    if media.traced:
        empty = BodyIntegral(zeros(mi.Float64, integrand.rows), zeros(mi.Float, integrand.rows))
        ray, medium, passes_null = ray_segment.ray, ray_segment.medium, ray_segment.passes_null
        trace_boundaries(media, ray, medium, add_gradients, empty, line.active, passes_null)


# -- Rows of media in the order of the ray -----------------------------------------------------------------------------


def _tau_in_front(boxes: list[_BoxedMedium], middle: mi.Float64, rows: int) -> list[mi.Float64]:
    """Optical depth of the boxed media in front of a distance."""
    total = zeros(mi.Float64, rows)
    for box in boxes:
        total = _add_rows(total, _mask_rows(box.middle < middle, box.own.tau))
    return total


def _visible_behind(boxes: list[_BoxedMedium], middle: mi.Float64, rows: int) -> list[mi.Float]:
    """N of the boxed media behind a distance, attenuated to the camera."""
    total = zeros(mi.Float, rows)
    for box in boxes:
        total = _add_rows(total, _mask_rows(box.middle > middle, box.attenuated))
    return total


def _multiply_transmittance(front: list[mi.Float64], N: list[mi.Float], channels: int) -> list[mi.Float]:
    """Rows of N and of its tangent, attenuated by rows of optical depth."""
    P = [transmittance_of(f) for f in front[:channels]]
    attenuated = [p * n for p, n in zip(P, N, strict=False)]
    changes = zip(P, N, N[channels:], front[channels:], strict=False)
    return attenuated + [p * (dn - mi.Float(df) * n) for p, n, dn, df in changes]


def _add_rows(a: list, b: list) -> list:
    return [x + y for x, y in zip(a, b, strict=True)]


def _mask_rows(mask: mi.Bool, rows: list) -> list:
    return [dr.select(mask, row, 0) for row in rows]


# -- Sweep of one medium ----------------------------------------------------------------------------------------------------


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
            self.tangent = SummedExtinction(self.body.view.parts, self.body.tangents, mi.Float(1), True, self.ray)

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
        grids = [p for p in body.view.parts if isinstance(p, NodeValues)]
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
            for part, _ in self.extinction.at_points:
                for weights, t in zip(by_point, self._distances(cell), strict=True):
                    body.vjp_extinction_at(self.ray, t, weights, on, part.name)
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

    def _distances(self, cell: Cell) -> list[mi.Float]:
        """The points of a cell as distances along the ray [length]."""
        near = mi.Float(self.layout.leave - mi.Float64(cell.s + cell.dt))
        return [dr.fma(cell.dt, p, near) for p in self.integrand.points]

    def _along(self, extinction: SummedExtinction, corners: list, cell: Cell) -> list[list[mi.Float]]:
        """[row][point] values of an extinction, or of its tangent, at the points of a cell."""
        values = extinction.along(corners, self._points(cell), self._distances(cell))
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
