r"""Light of media that emit, found by samples that are drawn towards them.

.. math:: L_d(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i) \int_0^\infty T(t)\,j(x + t\,\omega_i)\,dt\,d\omega_i

A direction is drawn by a coarse table of the emitted power (:class:`EmissionTable`), and a point along it; the light from
there is dimmed by the media in front of it. The path's next segment passes through the same media in a direction of the BSDF or
of the phase function, and both are weighed by the power heuristic of the densities of that direction. So is all light of media
on that segment, and none of surfaces.

References: Villemin & Hery 2013, Simon et al. 2017 (points and lines of volumes that emit); Veach 1997, Eq. 9.13 (weights).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.lighting.direct_lighting import DirectLight, power_heuristic
from mivol.transport.estimators.lighting.shadow_rays import find_transmittance
from mivol.transport.estimators.lighting.vertex import Vertex
from mivol.transport.estimators.scores import TrackedTerm
from mivol.transport.media.body import Body, emission_slope, eval_emission
from mivol.transport.media.channels import colours_to_channels, to_components, to_spectrum
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.grid_walk import walk_box_cells
from mivol.transport.traversal.random_numbers import draw_pcg32
from mivol.transport.traversal.rays import FineRay, Ray

__all__ = [
    "EmissionLight",
    "EmissionSampling",
    "EmittingPoint",
    "CELLS_PER_AXIS",
    "EmissionTable",
    "EmittingBox",
    "RayPoint",
    "RayDensity",
    "tabulate_emission",
]


class EmissionSampling:
    """The estimator of light from media that emit, at surfaces and in media.

    Args:
        media: of the scene.
        table: of what they emit.
    """

    def __init__(self, media: SceneMedia, table: EmissionTable) -> None:
        self.media, self.table = media, table

    def weigh_path(self, last: mi.Interaction3f, rival: mi.Float, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The weight of the light of media on a path's segment.

        Args:
            last: where its direction was drawn.
            rival: with which density [1/sr]; 0 where no light of media was drawn there.
            d: the direction.
            active: lanes asked about.
        """
        on = active & (rival > 0)
        return dr.select(on, power_heuristic(rival, self.table.integrate_density(last.p, d, on).pdf), 1)

    def estimate_at_vertex(
        self,
        vertex: Vertex,
        carried: mi.Spectrum,
        samples: tuple[mi.Float, mi.UInt32],
        attached: bool,
        active: mi.Bool,
        estimates: bool,
    ) -> EmissionLight:
        """Estimate the light of media at a vertex of a path by one point of them.

        Args:
            vertex: the point of the path.
            carried: throughput to there, times the albedo in a medium.
            samples: the number of the cell that is aimed at, and the generator of all others.
            attached: keep the derivatives of BSDF or phase function and emission.
            active: lanes to estimate.
            estimates: whether the shadow is estimated.

        Bias: none. Variance: that of one point. Cost: one shadow ray, and a walk of the table.
        """
        media, it = self.media, vertex.interaction
        u, rng = samples
        rng, (*place, along, chance) = draw_pcg32(rng, 5)
        d = dr.normalize(self.table.sample_point(u, place) - it.p)
        line = self.table.sample_along(it.p, d, along, active)
        f = dr.detach(vertex.eval(d, active))
        on = active & (line.pdf > 0) & (line.density > 0) & dr.any(f != 0)
        weight = power_heuristic(line.pdf, vertex.pdf(d, on)) / dr.select(on, line.pdf * line.density, 1)
        # -- The light that arrives from there ----------------------------------------------------------------------------
        start, medium = vertex.leave(it.p + d * line.t)
        ray = FineRay.from_point(start, d, it, dr.select(on, line.t, 0))
        end, _, light = find_transmittance(media, ray, medium, on, rng if estimates else None)
        on &= ~end.si.is_valid()
        inside = [
            (box.body, on & (line.box == k) & _contains_end(box, ray, end.medium)) for k, box in enumerate(self.table.boxes)
        ]
        point = EmittingPoint(RaySegment(ray, medium, ray.maxt, True), inside, on, chance)
        front, emitted = carried * light * weight, mi.Spectrum(0)
        with dr.resume_grad(when=attached):
            for body, here in inside:
                emitted = dr.select(here, eval_emission(body, ray, point.t, media.channels, here), emitted)
            value = dr.select(on, front * vertex.eval(d, on) * emitted, 0)
        return EmissionLight(media, point, value, front * f)


def _contains_end(box: EmittingBox, ray: Ray, medium: mi.MediumPtr) -> mi.Bool:
    """Whether the end of a ray lies in a medium; ``medium`` is the one that was traced to there."""
    if box.body.box is None:
        return medium == mi.MediumPtr(box.body.view.medium)
    return box.holds(ray(ray.maxt))


@dataclass
class EmittingPoint:
    """A point of a medium that emits, and the shadow ray to it.

    Attributes:
        ray_segment: the shadow ray.
        bodies: the media, each with the lanes whose point lies in it.
        on: lanes that nothing hides it from.
        chance: for derivatives, a number in [0, 1) by which one of a path's shadow rays is kept.
    """

    ray_segment: RaySegment
    bodies: list[tuple[Body, mi.Bool]]
    on: mi.Bool
    chance: mi.Float

    @property
    def t(self) -> mi.Float64:
        """Its distance [length]."""
        return mi.Float64(self.ray_segment.length)


class EmissionLight(TrackedTerm):
    """The light of a point of a medium, as a term, but for the derivatives of the media along its shadow ray.

    Args:
        media: of the scene.
        point: the point.
        value: as the camera sees it, attached to BSDF or phase function and to the emission.
        front: what multiplies the emission of the point, without derivatives.
    """

    def __init__(self, media: SceneMedia, point: EmittingPoint, value: mi.Spectrum, front: mi.Spectrum) -> None:
        super().__init__(value, point.on)
        self.media, self.point, self.front = media, point, front

    @property
    def shadow(self) -> DirectLight:
        """The derivatives of the media along the shadow ray."""
        return DirectLight(self.media, self.point.ray_segment, self.value, self.active)

    def vjp(self, dL: mi.Spectrum) -> None:
        """Derivatives of BSDF or phase function and of the emission, and by the extinction that this goes with."""
        super().vjp(dL)
        ray, t = self.point.ray_segment.ray, self.point.t
        for body, on, name, slope in self._slopes():
            body.vjp_extinction_at(ray, t, colours_to_channels(dL * self.front * slope, self.media.channels), on, name)

    def jvp(self) -> mi.Spectrum:
        """Tangent of both."""
        change, ray, t = super().jvp(), self.point.ray_segment.ray, self.point.t
        for body, on, name, slope in self._slopes():
            own = to_spectrum(body.jvp_extinction_at(ray, t, self.media.channels, on, name))
            change += dr.select(on, self.front * slope * own, 0)
        return change

    def _slopes(self) -> list[tuple[Body, mi.Bool, str, mi.Spectrum]]:
        """The coefficient that the emission of each medium goes with, and the derivative by it."""
        ray, found = self.point.ray_segment.ray, []
        for body, on in self.point.bodies:
            if body.view.emission is not None:
                name, slope = emission_slope(body, ray, self.point.t, on)
                found.append((body, on, name, dr.detach(slope)))
        return found


CELLS_PER_AXIS = 16
"""Cells along each axis of a box."""

POINTS_PER_AXIS = 2
"""Points along each axis of a cell at which emission is looked at."""

UNIFORM_SHARE = 0.1
"""Share of the points that is drawn evenly from all boxes."""


@dataclass
class EmittingBox:
    """A medium that emits, and the box that all of its emission lies in."""

    body: Body
    box: Box

    @cached_property
    def rows(self) -> list[list[mi.Float64]]:
        """The map from the world to cells."""
        return [[CELLS_PER_AXIS * v for v in row] for row in self.box.rows()]

    @cached_property
    def to_world(self) -> list[list[mi.Float]]:
        """The map from cells to the world."""
        scaled = self.box.to_world @ np.diag([1 / CELLS_PER_AXIS] * 3 + [1])
        return [[dr.opaque(mi.Float, float(v)) for v in row] for row in scaled[:3]]

    @property
    def cell_volume(self) -> float:
        """Volume of a cell [length^3]."""
        return abs(float(np.linalg.det(self.box.to_world[:3, :3]))) / CELLS_PER_AXIS**3

    def holds(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in the medium, as far as that is known without tracing: its boundary is a box."""
        if self.body.box is None:
            return dr.full(mi.Bool, True, dr.width(p))
        hole = mi.Bool(False) if self.body.hole is None else _is_in_box(self.body.hole_rows, p)
        return _is_in_box(self.body.rows, p) & ~hole

    def place(self, cell: mi.Point3f) -> mi.Point3f:
        """A point of the world by its place among the cells."""
        return mi.Point3f(*(dr.fma(x, cell.x, dr.fma(y, cell.y, dr.fma(z, cell.z, rest))) for x, y, z, rest in self.to_world))


@dataclass
class RayDensity:
    """What the table says of a ray.

    Attributes:
        pdf: density [1/sr] of its direction.
        light: the density of points, summed along it [1/length^2]: in proportion to the light that comes from there.
    """

    pdf: mi.Float
    light: mi.Float


@dataclass
class RayPoint:
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

    def sample_point(self, u: mi.Float, inside: list[mi.Float]) -> mi.Point3f:
        """Draw a point of the world: its cell by ``u``, its place in that by three numbers; all in [0, 1)."""
        n = len(self.boxes) * CELLS_PER_AXIS**3
        index = dr.binary_search(0, n - 1, lambda i: dr.gather(mi.Float, self.cumulative, i) <= u)
        k = index % CELLS_PER_AXIS**3
        cell = mi.Point3f(k % CELLS_PER_AXIS, k // CELLS_PER_AXIS % CELLS_PER_AXIS, k // CELLS_PER_AXIS**2) + mi.Point3f(
            *inside
        )
        p = mi.Point3f(0)
        for number, box in enumerate(self.boxes):
            p = dr.select(index // CELLS_PER_AXIS**3 == number, box.place(cell), p)
        return p

    def integrate_density(self, o: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> RayDensity:
        """What a ray without end passes."""

        def visit(state: tuple, k: mi.UInt32, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> tuple:
            pdf, light = state
            own = dr.select(on, dr.gather(mi.Float, self.density, k, on), 0)
            return pdf + own * _integrate_square(t0, t1), light + own * (t1 - t0)

        return RayDensity(*self._walk(mi.Ray3f(o, d), visit, (mi.Float(0), mi.Float(0)), active))

    def sample_along(self, o: mi.Point3f, d: mi.Vector3f, u: mi.Float, active: mi.Bool) -> RayPoint:
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
            density, box = dr.select(keep, own, density), dr.select(keep, k // CELLS_PER_AXIS**3, box)
            return pdf + own * _integrate_square(t0, t1), total, begin, length, density, box, u

        zero = mi.Float(0)
        start = (zero, zero, zero, zero, zero, mi.UInt32(0), u + zero)
        pdf, total, begin, length, density, box, u = self._walk(mi.Ray3f(o, d), visit, start, active)
        density = dr.select(total > 0, density / dr.select(total > 0, total, 1), 0)
        return RayPoint(pdf, dr.fma(u, length, begin), density, box)

    def _walk(self, ray: mi.Ray3f, visit: Callable, state: Any, active: mi.Bool) -> Any:
        """Visit the cells of all boxes along a ray, by their numbers."""
        for number, box in enumerate(self.boxes):

            def visit_cell(state: Any, cell: mi.Vector3i, t0: mi.Float, t1: mi.Float, on: mi.Bool, first: int = number) -> Any:
                k = mi.UInt32((cell.z * CELLS_PER_AXIS + cell.y) * CELLS_PER_AXIS + cell.x) + first * CELLS_PER_AXIS**3
                return visit(state, k, t0, t1, on)

            state = walk_box_cells(box.rows, CELLS_PER_AXIS, ray, visit_cell, state, active)
        return state


def _is_in_box(rows: list[list[mi.Float64]], p: mi.Point3f) -> mi.Bool:
    """Whether a point lies in the box that ``rows`` map to the unit cube."""
    inside = mi.Bool(True)
    for row in rows:
        local = dr.fma(row[0], mi.Float64(p.x), dr.fma(row[1], mi.Float64(p.y), dr.fma(row[2], mi.Float64(p.z), row[3])))
        inside &= (local >= 0) & (local <= 1)
    return inside


def _integrate_square(t0: mi.Float, t1: mi.Float) -> mi.Float:
    """The integral of t^2, (t1^3 - t0^3) / 3, without the difference of two large numbers."""
    return (t1 - t0) * dr.fma(t1, t1 + t0, t0 * t0) * (1 / 3)


def tabulate_emission(boxes: list[EmittingBox], channels: int) -> EmissionTable:
    """Look at the emission of media in ``POINTS``^3 points of each cell, and make a table of it.

    Args:
        boxes: the media, at least one.
        channels: of the scene's extinction.
    """
    power = dr.concat([_cell_power(box, channels) for box in boxes])
    volume = dr.concat([dr.full(mi.Float, box.cell_volume, CELLS_PER_AXIS**3) for box in boxes])
    total = dr.sum(power)
    share = dr.select(total > 0, power / dr.select(total > 0, total, 1), 1 / dr.width(power))
    share = dr.lerp(share, 1 / dr.width(power), UNIFORM_SHARE)
    density, cumulative = share / volume, dr.cumsum(share)
    dr.eval(density, cumulative)
    return EmissionTable(boxes, density, cumulative)


def _cell_power(box: EmittingBox, channels: int) -> mi.Float:
    """The light that each cell emits, mean of the colours, in one direction for each point."""
    edge = CELLS_PER_AXIS * POINTS_PER_AXIS
    i = dr.arange(mi.UInt32, edge**3)
    x, y, z = i % edge, i // edge % edge, i // edge**2
    p = box.place((mi.Point3f(x, y, z) + 0.5) * (1 / POINTS_PER_AXIS))
    # Directions that change from point to point, evenly over the sphere (a spiral by the golden ratio).
    turn, height = mi.Float(i) * 0.6180339887, mi.Float(i) * 0.7548776662
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(height - dr.floor(height), turn - dr.floor(turn)))
    ray = mi.Ray3f(p, d)
    on = box.holds(p)
    light = dr.detach(eval_emission(box.body, ray, mi.Float64(0), channels, on))
    value = dr.select(on, sum(to_components(light)), 0)
    power = dr.zeros(mi.Float, CELLS_PER_AXIS**3)
    dr.scatter_add(
        power,
        value,
        mi.UInt32((z // POINTS_PER_AXIS * CELLS_PER_AXIS + y // POINTS_PER_AXIS) * CELLS_PER_AXIS + x // POINTS_PER_AXIS),
    )
    return power * box.cell_volume
