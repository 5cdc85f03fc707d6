r"""Where media emit light: a coarse table of the power of each cell, which directions towards it are drawn by.

.. math:: p(\omega) = \int_0^\infty p(o + t\,\omega)\,t^2\,dt = \sum_k p_k\,\frac{t_{k+1}^3 - t_k^3}{3}

A point is drawn with the density p_k [1/length^3] of the cell that it lies in, and the direction towards it has the density
p(omega) [1/sr], a sum over all cells that the ray passes. Along that ray a point is drawn anew, with a density [1/length] in
proportion to p_k: the first point would have a weight of 1 / t^2, whose variance is not finite where the vertex lies in the
medium.

Each cell has a share of the even density beside that of its power, so the table may be rough, or old: light is drawn from
everywhere in its box.

Conventions. Each medium has a box of ``CELLS`` cells along each axis; the cells of all boxes are counted on, x fastest.

References: Villemin & Hery 2013, Simon et al. 2017 (points and lines of volumes that emit).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.media.body import Body
from mivol.transport.media.box import Box
from mivol.transport.media.channels import colours
from mivol.transport.media.coefficients import eval_emission
from mivol.transport.traversal.box_walk import walk_box

__all__ = ["CELLS", "EmissionTable", "EmittingBox", "LinePoint", "Look", "tabulate_emission"]


CELLS = 16
"""Cells along each axis of a box."""

POINTS = 2
"""Points along each axis of a cell at which emission is looked at."""

EVEN = 0.1
"""Share of the points that is drawn evenly from all boxes."""


@dataclass
class EmittingBox:
    """A medium that emits, and the box that all of its emission lies in."""

    body: Body
    box: Box

    @cached_property
    def rows(self) -> list[list[mi.Float64]]:
        """The map from the world to cells."""
        return [[CELLS * v for v in row] for row in self.box.rows()]

    @cached_property
    def to_world(self) -> list[list[mi.Float]]:
        """The map from cells to the world."""
        scaled = self.box.to_world @ np.diag([1 / CELLS] * 3 + [1])
        return [[dr.opaque(mi.Float, float(v)) for v in row] for row in scaled[:3]]

    @property
    def cell_volume(self) -> float:
        """Volume of a cell [length^3]."""
        return abs(float(np.linalg.det(self.box.to_world[:3, :3]))) / CELLS**3

    def holds(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in the medium, as far as that is known without tracing: its boundary is a box."""
        if self.body.box is None:
            return dr.full(mi.Bool, True, dr.width(p))
        hole = mi.Bool(False) if self.body.hole is None else _lies_in(self.body.hole_rows, p)
        return _lies_in(self.body.rows, p) & ~hole

    def place(self, cell: mi.Point3f) -> mi.Point3f:
        """A point of the world by its place among the cells."""
        return mi.Point3f(*(dr.fma(x, cell.x, dr.fma(y, cell.y, dr.fma(z, cell.z, rest))) for x, y, z, rest in self.to_world))


@dataclass
class Look:
    """What the table says of a ray.

    Attributes:
        pdf: density [1/sr] of its direction.
        light: the density of points, summed along it [1/length^2]: in proportion to the light that comes from there.
    """

    pdf: mi.Float
    light: mi.Float


@dataclass
class LinePoint:
    """A point that is drawn from a ray through the boxes.

    Attributes:
        pdf: density [1/sr] of the ray's direction.
        t: distance of the point [length].
        density: of the point along the ray [1/length]; 0 where the ray passes no box.
        box: number of its box.
    """

    pdf: mi.Float
    t: mi.Float
    density: mi.Float
    box: mi.UInt32


@dataclass
class EmissionTable:
    """The density of points in each cell of all boxes.

    Attributes:
        boxes: of the media that emit.
        density: of each cell [1/length^3].
        cumulative: probability of each cell and those before it.
    """

    boxes: list[EmittingBox]
    density: mi.Float
    cumulative: mi.Float

    def draw_place(self, u: mi.Float, inside: list[mi.Float]) -> mi.Point3f:
        """Draw a point of the world: its cell by ``u``, its place in that by three numbers; all in [0, 1)."""
        n = len(self.boxes) * CELLS**3
        index = dr.binary_search(0, n - 1, lambda i: dr.gather(mi.Float, self.cumulative, i) <= u)
        k = index % CELLS**3
        cell = mi.Point3f(k % CELLS, k // CELLS % CELLS, k // CELLS**2) + mi.Point3f(*inside)
        p = mi.Point3f(0)
        for number, box in enumerate(self.boxes):
            p = dr.select(index // CELLS**3 == number, box.place(cell), p)
        return p

    def look(self, o: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> Look:
        """What a ray without end passes."""

        def visit(state: tuple, k: mi.UInt32, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> tuple:
            pdf, light = state
            own = dr.select(on, dr.gather(mi.Float, self.density, k, on), 0)
            return pdf + own * _solid_angle(t0, t1), light + own * (t1 - t0)

        return Look(*self._walk(mi.Ray3f(o, d), visit, (mi.Float(0), mi.Float(0)), active))

    def draw_along(self, o: mi.Point3f, d: mi.Vector3f, u: mi.Float, active: mi.Bool) -> LinePoint:
        """Draw a point of a ray, by a number in [0, 1) that serves all cells (weighted reservoir sampling, Chao 1982)."""

        def visit(state: tuple, k: mi.UInt32, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> tuple:
            pdf, total, begin, length, density, box, u = state
            own = dr.select(on, dr.gather(mi.Float, self.density, k, on), 0)
            weight = own * (t1 - t0)
            total += weight
            share = weight / dr.select(total > 0, total, 1)
            keep = u < share
            # Given the outcome, the number is uniform in [0, share) or in [share, 1), and is stretched to [0, 1) again.
            u = dr.select(keep, u / dr.select(share > 0, share, 1), (u - share) / dr.select(share < 1, 1 - share, 1))
            begin, length = dr.select(keep, t0, begin), dr.select(keep, t1 - t0, length)
            density, box = dr.select(keep, own, density), dr.select(keep, k // CELLS**3, box)
            return pdf + own * _solid_angle(t0, t1), total, begin, length, density, box, u

        zero = mi.Float(0)
        start = (zero, zero, zero, zero, zero, mi.UInt32(0), u + zero)
        pdf, total, begin, length, density, box, u = self._walk(mi.Ray3f(o, d), visit, start, active)
        density = dr.select(total > 0, density / dr.select(total > 0, total, 1), 0)
        return LinePoint(pdf, dr.fma(u, length, begin), density, box)

    def _walk(self, ray: mi.Ray3f, visit: Callable, state: Any, active: mi.Bool) -> Any:
        """Visit the cells of all boxes along a ray, by their numbers."""
        for number, box in enumerate(self.boxes):

            def visit_cell(state: Any, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool, first: int = number) -> Any:
                k = mi.UInt32((cell.z * CELLS + cell.y) * CELLS + cell.x) + first * CELLS**3
                return visit(state, k, t0, t1, on)

            state = walk_box(box.rows, CELLS, ray, visit_cell, state, active)
        return state


def _lies_in(rows: list[list[mi.Float64]], p: mi.Point3f) -> mi.Bool:
    """Whether a point lies in the box that ``rows`` map to the unit cube."""
    inside = mi.Bool(True)
    for row in rows:
        local = dr.fma(row[0], mi.Float64(p.x), dr.fma(row[1], mi.Float64(p.y), dr.fma(row[2], mi.Float64(p.z), row[3])))
        inside &= (local >= 0) & (local <= 1)
    return inside


def _solid_angle(t0: mi.Float, t1: mi.Float) -> mi.Float:
    """The integral of t^2, (t1^3 - t0^3) / 3, without the difference of two large numbers."""
    return (t1 - t0) * dr.fma(t1, t1 + t0, t0 * t0) * (1 / 3)


def tabulate_emission(boxes: list[EmittingBox], channels: int) -> EmissionTable:
    """Look at the emission of media in ``POINTS``^3 points of each cell, and make a table of it.

    Args:
        boxes: the media, at least one.
        channels: of the scene's extinction.
    """
    power = dr.concat([_power(box, channels) for box in boxes])
    volume = dr.concat([dr.full(mi.Float, box.cell_volume, CELLS**3) for box in boxes])
    total = dr.sum(power)
    share = dr.select(total > 0, power / dr.select(total > 0, total, 1), 1 / dr.width(power))
    share = dr.lerp(share, 1 / dr.width(power), EVEN)
    density, cumulative = share / volume, dr.cumsum(share)
    dr.eval(density, cumulative)
    return EmissionTable(boxes, density, cumulative)


def _power(box: EmittingBox, channels: int) -> mi.Float:
    """The light that each cell emits, mean of the colours, in one direction for each point."""
    edge = CELLS * POINTS
    i = dr.arange(mi.UInt32, edge**3)
    x, y, z = i % edge, i // edge % edge, i // edge**2
    p = box.place((mi.Point3f(x, y, z) + 0.5) * (1 / POINTS))
    # Directions that change from point to point, evenly over the sphere (a spiral by the golden ratio).
    turn, height = mi.Float(i) * 0.6180339887, mi.Float(i) * 0.7548776662
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(height - dr.floor(height), turn - dr.floor(turn)))
    ray = mi.Ray3f(p, d)
    on = box.holds(p)
    light = dr.detach(eval_emission(box.body, ray, mi.Float64(0), channels, on))
    value = dr.select(on, sum(colours(light)), 0)
    power = dr.zeros(mi.Float, CELLS**3)
    dr.scatter_add(power, value, mi.UInt32((z // POINTS * CELLS + y // POINTS) * CELLS + x // POINTS))
    return power * box.cell_volume
