"""The extinction of Gaussians: a ray visits each Gaussian once, in the cell of its entry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_field import GaussianField
from mivol.fields.gaussian_line import ROW_SIZE, SCALE_COLUMN, LineSlopes, WhitenedLine, read_row, row_tangent
from mivol.fields.harmonics import blocks_per_gaussian
from mivol.numerics import fast_max, fast_min
from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.box import UNIT_CUBE, Box, clip_to_box
from mivol.transport.traversal.grid_walk import walk_planes
from mivol.transport.traversal.rays import Ray

__all__ = ["GaussianExtinction", "Passage", "add_to_block"]


@dataclass
class Passage:
    """The part of an interval of a ray inside the box of the Gaussians.

    Attributes:
        start: distance of the start from the origin of the ray [length].
        length: length inside the box [length].
        o, d: start and direction; distances are from the start [length].
        active: lanes with a passage.
    """

    start: mi.Float64
    length: mi.Float
    o: mi.Point3f
    d: mi.Vector3f
    active: mi.Bool


@dataclass
class GaussianExtinction:
    """A sum of Gaussians, grey (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        field: the Gaussians.
        scale: scale of the medium, without derivatives.
        shows: whether the medium emits the colours of the Gaussians. Tangents and gradients then hold the rows of the
            harmonics behind the rows of the extinction, in the same array.
        colours: rows of the harmonics, without derivatives; None if not shown.
    """

    name: str
    field: GaussianField
    scale: mi.Float
    shows: bool = False
    exact_line: ClassVar[bool] = True
    is_constant: ClassVar[bool] = False
    lattice: ClassVar[None] = None
    rough: ClassVar[None] = None
    channels: ClassVar[int] = 1

    def __post_init__(self) -> None:
        self.box = Box(self.field.to_world).rows()
        self.colours = None
        if self.shows:
            with dr.suspend_grad():
                self.colours = dr.detach(self.field.pack_colours())

    @property
    def blocks(self) -> int:
        """Blocks of ``ROW`` numbers for the harmonics of a Gaussian."""
        return blocks_per_gaussian(self.field.degree) if self.shows else 0

    def scaled(self, scale: mi.Float) -> mi.Float:
        rows = self.field.rows(scale)
        return dr.concat([rows, self.field.pack_colours()]) if self.shows else rows

    def start_gradient(self, rays: float = math.inf) -> mi.Float:
        return dr.zeros(mi.Float, ROW_SIZE * self.field.count * (1 + self.blocks))

    def fold_gradient(self, gradient: mi.Float) -> mi.Float:
        return gradient

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        def add(tau: mi.Float, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> mi.Float:
            return tau + line.depth * line.share(*ends)

        until = None if enough is None else lambda tau: tau > enough
        passage = self.enter(interval)
        return [self.visit_gaussians(passage, dr.zeros(mi.Float, dr.width(passage.d)), add, until)]

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        def add(tau: mi.Float, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> mi.Float:
            return tau + self.jvp_value(line, line.share_slopes(*ends), line.depth * line.share(*ends), tangent, index)

        passage = self.enter(interval)
        return [self.visit_gaussians(passage, dr.zeros(mi.Float, dr.width(passage.d)), add)]

    def vjp(self, gradient: mi.Float, weight: list[mi.Float], interval: RayInterval) -> None:
        def add(state: tuple, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> tuple:
            own = line.depth * line.share(*ends)
            self.vjp_value(gradient, line, line.share_slopes(*ends), (own, weight[0]), index, mi.Bool(True))
            return state

        self.visit_gaussians(self.enter(interval), (), add)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [dr.detach(scale) * value for value in self.field.eval(ray(t), ray.d, active)]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        def add(total: mi.Float, line: WhitenedLine, index: mi.UInt32) -> mi.Float:
            own = self.jvp_value(line, line.density_slopes, line.density, tangent, index)
            return dr.select(line.contains_origin, total + own, total)

        there = mi.Ray3f(ray(t), ray.d)
        return [self.field.visit_at_points(there, active, dr.zeros(mi.Float, dr.width(there)), add)]

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        def add(state: tuple, line: WhitenedLine, index: mi.UInt32) -> tuple:
            self.vjp_value(gradient, line, line.density_slopes, (line.density, weight[0]), index, line.contains_origin)
            return state

        self.field.visit_at_points(mi.Ray3f(ray(t), ray.d), active, (), add)

    def enter(self, interval: RayInterval) -> Passage:
        """The part of an interval inside the box, from its start on: far from the origin float32 has few digits."""
        ray = interval.ray
        _, _, t0, t1 = clip_to_box(self.box, *UNIT_CUBE, ray.o, ray.d, mi.Float64(interval.t0), mi.Float64(interval.t1))
        hits = t1 > t0
        start, length = dr.select(hits, t0, 0), mi.Float(dr.select(hits, t1 - t0, 0))
        there = (dr.fma(start, mi.Float64(v), mi.Float64(x)) for x, v in zip(ray.o, ray.d, strict=True))
        return Passage(start, length, mi.Point3f(*(mi.Float(x) for x in there)), ray.d, interval.active & (length > 0))

    def visit_gaussians(
        self,
        passage: Passage,
        state: Any,
        add: Callable[..., Any],
        until: Callable[[Any], mi.Bool] | None = None,
        leave: Callable[[Any, mi.Float], Any] | None = None,
    ) -> Any:
        """Visit each Gaussian on a passage once, in the cell of its entry.

        Args:
            passage: from :meth:`enter`.
            state: any PyTree of Dr.Jit arrays.
            add: ``add(state, line, index, ends) -> state`` with the distances at which the passage enters and leaves the
                Gaussian. Called once, while Dr.Jit traces the loop.
            until: ``until(state) -> mask`` of lanes to stop, evaluated after each cell; None to go to the end.
            leave: ``leave(state, t) -> state``, after the Gaussians of a cell up to the distance t; by default nothing.

        Cost: a test of each Gaussian in the list of a cell; ``add`` runs for each Gaussian on the line.
        """
        field, through, length = self.field, (passage.o, passage.d), passage.length

        def visit(state: Any, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> Any:
            def meet(state: Any, line: WhitenedLine, index: mi.UInt32) -> Any:
                start, end = line.chord
                ends = fast_max(start, 0), fast_min(end, length)
                # Cells follow each other without a gap, so the place of entry lies in one of them.
                enters = line.hits & (ends[1] > ends[0]) & (ends[0] >= t0) & (ends[0] < t1)
                # Most are not met: a branch costs two thirds of what adding 0 for them did.
                return dr.if_stmt((state,), enters, lambda state: add(state, line, index, ends), lambda state: state)

            state = field.visit_cell(cell, through, on, state, meet)
            return state if leave is None else leave(state, t1)

        return walk_planes(field.grid, *through, length, visit, state, passage.active, until)

    def jvp_value(
        self, line: WhitenedLine, slopes: LineSlopes, value: mi.Float, tangent: mi.Float, index: mi.UInt32
    ) -> mi.Float:
        """The tangent of the scale times a value with these derivatives."""
        change = read_row(tangent, index)
        return self.scale * row_tangent(line, slopes, change) + value * change[SCALE_COLUMN]

    def vjp_value(
        self,
        gradient: mi.Float,
        line: WhitenedLine,
        slopes: LineSlopes,
        value: tuple[mi.Float, mi.Float],
        index: mi.UInt32,
        on: mi.Bool,
    ) -> None:
        """Add to the gradient of a row: ``value`` holds a number with these derivatives, and d loss / d (scale times the
        number).
        """
        own, weight = value
        entries = [self.scale * weight * slope for slope in slopes.by_row(line)]
        add_to_block(gradient, [*entries, weight * own], index, on)


def add_to_block(gradient: mi.Float, entries: list[mi.Float], index: mi.UInt32, on: mi.Bool) -> None:
    """Add numbers, at most ``ROW``, to a block of a gradient."""
    packet = mi.ArrayXf([*entries, *(mi.Float(0) for _ in range(ROW_SIZE - len(entries)))])
    dr.scatter_add(gradient, packet, index, on, mode=dr.ReduceMode.Expand)
