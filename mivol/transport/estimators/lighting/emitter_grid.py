r"""How much light each emitter gives in the cells of a coarse grid of space, for choosing an emitter.

.. math:: P(k) \propto s_k \sqrt{\overline{f_k^2}}, \qquad f_k(x) = \int L_k(x, \omega)\,d\omega

The fluence f_k of emitter k, without shadows, is estimated at some points of each cell by Mitsuba's own samples of the emitter.
So the cone of a spot, the horizon of a panel, textures and distances count, in every plugin. Somewhere in a cell, the sum of
f_k / P(k) has the least variance if P(k) is in proportion to the root of the mean square of f_k. The factor s_k is the
``sampling_weight`` of the emitter in the scene.

A choice by the light in all cells has a share, in case the points of a cell miss an emitter. An even choice has a smaller
share, so an emitter of radiance 0 has derivatives.

A vertex chooses by its cell. A ray chooses by the sum over points along the ray. The light scattered along a ray that passes an
emitter at a distance h much smaller than a cell rises as 1 / h, so half of the choices of a ray go by the integral of
1 / r^2 along it, if the emitters are few.

Conventions. The grid covers a box and, with wider cells, the rest of space: a coordinate x of the box, in [-1, 1], keeps its
place, and |x| > 1 moves to 1 + (1 - 1 / |x|) / 3, which is less than ``EDGE``. Cells have equal edges in these coordinates.

References: Veach 1997, Sec. 2.2 (importance sampling); Roberts 2018 (additive recurrences).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.media.extinction import to_components
from mivol.transport.traversal.rays import Ray

__all__ = ["EmitterDistribution", "EmitterGrid", "tabulate_emitters"]


MAX_CELLS = 16
"""Most cells along an axis; three quarters of them lie in the box."""

MAX_SAMPLES = 1 << 19
"""Most emitter samples of a grid, which bound its cells: 10 ms of processor time."""

CELL_POINTS = 8
"""Points of a cell."""

SINGLE_CELL_POINTS = 256
"""Points of a grid of one cell, if all emitters are at infinity."""

MARGIN = 0.125
"""Width by which the points of a cell reach into its neighbours, as a fraction of a cell [1]."""

MEAN_SHARE, EVEN_SHARE = 0.1, 0.01
"""Shares of a choice by the light in all cells, and of an even choice [1]."""

RAY_POINTS = 16
"""Points along a ray."""

MAX_PASSED = 16
"""Most emitters for which a ray computes the integral of 1 / r^2 [1]."""

PASSED_SHARE = 0.5
"""Share of the choices of a ray by this integral [1]."""

EDGE = 4 / 3
"""Largest coordinate of a cell [1], at infinity."""

MAX_FLUENCE, MIN_TOTAL = 1e15, 1e-15
"""Bounds of the fluence of a sample and of the light in a cell; their squares are finite and positive in float32."""


@dataclass
class EmitterGrid:
    """Running sums of the weights of emitters, in proportion to their light in each cell.

    Attributes:
        cumulative: flat (cells in z, y, x; emitters).
        count: number of emitters.
        cells: number of cells along each axis.
        centre, half: centre and half edges of the box [length].
        everywhere: share of each emitter in the light of all cells [1]; None with one emitter.
        balls: centre and radius of each emitter [length], if a ray weighs them by the integral of 1 / r^2; else empty.
    """

    cumulative: mi.Float
    count: int
    cells: int
    centre: mi.Point3f
    half: mi.Vector3f
    everywhere: mi.Float | None = None
    balls: Sequence[Sequence[mi.Float]] = ()

    def at_point(self, p: mi.Point3f) -> EmitterDistribution:
        """The distribution at a point."""
        return EmitterDistribution(self, [self._row(p)])

    def along_ray(self, ray: Ray, from_origin: bool) -> EmitterDistribution:
        """The distribution along a ray: the sum over points of the ray in the box.

        Args:
            ray: ray in world space, with a unit direction.
            from_origin: light scatters between the origin and the box too.
        """
        if self.cells == 1:
            return self.at_point(mi.Point3f(ray.o))
        near, far = self._clip(ray)
        start = mi.Float(0) if from_origin else near
        o, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        points = [o + d * dr.lerp(start, far, (k + 0.5) / RAY_POINTS) for k in range(RAY_POINTS)]
        passed = [self._weigh_passed(k, o + d * start, d) for k in range(len(self.balls))]
        return EmitterDistribution(self, [self._row(p) for p in points], passed)

    def _weigh_passed(self, number: int, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """The integral of 1 / r^2 from a point on along a ray, times the share of an emitter in all light."""
        *centre, radius = self.balls[number]
        away = mi.Point3f(*centre) - p
        h = dr.norm(dr.cross(away, d))
        angle = dr.pi - dr.atan2(h, dr.dot(away, d))
        return dr.gather(mi.Float, self.everywhere, number) * angle / dr.maximum(dr.maximum(h, radius), MIN_TOTAL)

    def total(self, row: mi.UInt32) -> mi.Float:
        """The last sum of a cell, by the index of its first sum."""
        return dr.gather(mi.Float, self.cumulative, row + (self.count - 1))

    def bounds(self, row: mi.UInt32, number: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """The sums of a cell before and after an emitter."""
        at = row + number
        low = dr.gather(mi.Float, self.cumulative, dr.maximum(at, 1) - 1)
        return dr.select(number > 0, low, 0), dr.gather(mi.Float, self.cumulative, at)

    def _clip(self, ray: Ray) -> tuple[mi.Float, mi.Float]:
        """Interval of a ray in the box [length]; of a ray beside the box, its part up to twice the distance of the box."""
        inverse, away = dr.rcp(mi.Vector3f(ray.d)), self.centre - mi.Point3f(ray.o)
        reach = dr.abs(self.half * inverse)
        near, far = dr.maximum(dr.max(away * inverse - reach), 0), dr.min(away * inverse + reach)
        meets = (near < far) & dr.isfinite(far)
        return dr.select(meets, near, 0), dr.select(meets, far, 2 * dr.norm(away))

    def _row(self, p: mi.Point3f) -> mi.UInt32:
        """Index of the first sum of the cell around a point."""
        if self.cells == 1:
            return mi.UInt32(0)
        x = (p - self.centre) / self.half
        size = dr.abs(x)
        place = dr.copysign(dr.select(size <= 1, size, 1 + (1 - dr.rcp(size)) / 3), x)
        i = dr.clip(mi.Vector3i((place + EDGE) * (self.cells / (2 * EDGE))), 0, self.cells - 1)
        return mi.UInt32((i.z * self.cells + i.y) * self.cells + i.x) * self.count


@dataclass
class EmitterDistribution:
    """The probabilities of emitters: in proportion to the sum of their weights over some cells of a grid.

    Attributes:
        grid: the grid.
        rows: index of the first sum of each cell.
        passed: weights of the emitters by the integral of 1 / r^2 along a ray; empty if it does not count.
    """

    grid: EmitterGrid
    rows: list[mi.UInt32]
    passed: Sequence[mi.Float] = ()

    def sample(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Choose an emitter by a uniform random number in [0, 1).

        Returns:
            The number of the emitter, and a uniform random number for another choice.
        """
        if self.grid.count == 1:
            return mi.UInt32(0), u
        if not self.passed:
            return self._sample_cells(u)
        by_passed = u < PASSED_SHARE
        u = dr.select(by_passed, u / PASSED_SHARE, (u - PASSED_SHARE) / (1 - PASSED_SHARE))
        in_cells, rest_in_cells = self._sample_cells(u)
        # -- An emitter passed by the ray --------------------------------------------------------------------------------
        left, number, own = u * sum(self.passed), mi.UInt32(0), self.passed[0]
        for k, weight in enumerate(self.passed[1:]):
            is_behind = (number == k) & (left >= own)
            left = dr.select(is_behind, left - own, left)
            number, own = dr.select(is_behind, k + 1, number), dr.select(is_behind, weight, own)
        rest = dr.clip(left / dr.select(own > 0, own, 1), 0, dr.one_minus_epsilon(mi.Float))
        return dr.select(by_passed, number, in_cells), dr.select(by_passed, rest, rest_in_cells)

    def _sample_cells(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Choose an emitter as :meth:`sample` does, by the cells alone."""
        # -- A cell ------------------------------------------------------------------------------------------------------
        totals = [self.grid.total(row) for row in self.rows]
        x, below, before, row = u * sum(totals[1:], totals[0]), totals[0], mi.Float(0), self.rows[0]
        for other, total in zip(self.rows[1:], totals[1:], strict=True):
            reached = x >= below
            row, before = dr.select(reached, other, row), dr.select(reached, below, before)
            below += total
        x -= before
        # -- An emitter in the cell --------------------------------------------------------------------------------------
        cumulative = self.grid.cumulative
        number = dr.binary_search(0, self.grid.count - 1, lambda k: dr.gather(mi.Float, cumulative, row + k) <= x)
        low, high = self.grid.bounds(row, number)
        fresh = (x - low) / dr.select(high > low, high - low, 1)
        return number, dr.clip(fresh, 0, dr.one_minus_epsilon(mi.Float))

    def probability(self, number: mi.UInt32) -> mi.Float:
        """The probability of an emitter [1]; 0 for a number beyond the last emitter."""
        there = number < self.grid.count
        if self.grid.count == 1:
            return dr.select(there, mi.Float(1), 0)
        at, weight, total = dr.minimum(number, self.grid.count - 1), mi.Float(0), mi.Float(0)
        for row in self.rows:
            low, high = self.grid.bounds(row, at)
            weight += high - low
            total += self.grid.total(row)
        share = weight / dr.select(total > 0, total, 1)
        if self.passed:
            passed = sum(dr.select(number == k, w, 0) for k, w in enumerate(self.passed))
            share = dr.lerp(share, passed / sum(self.passed), PASSED_SHARE)
        return dr.select(there & (total > 0), share, 0)


def tabulate_emitters(
    emitters: mi.EmitterPtr,
    centre: mi.Point3f,
    half: mi.Vector3f,
    balls: Sequence[Sequence[mi.Float] | None],
    weights: mi.Float,
) -> EmitterGrid:
    """Estimate the light of emitters in the cells of a grid.

    Args:
        emitters: the emitters.
        centre, half: centre and half edges of the box [length].
        balls: centre and radius of each emitter [length], None at infinity. If all are at infinity, one cell is enough.
        weights: sampling weight of each emitter [1].

    Cost: at most ``MAX_SAMPLES`` emitter samples.
    """
    count, is_near = dr.width(emitters), any(b is not None for b in balls)
    if count == 1:
        return EmitterGrid(mi.Float(1), 1, 1, centre, half)
    cells = max(1, min(MAX_CELLS, int((MAX_SAMPLES / (count * CELL_POINTS)) ** (1 / 3)))) if is_near else 1
    points = CELL_POINTS if is_near else SINGLE_CELL_POINTS
    # -- The fluence ---------------------------------------------------------------------------------------------------------
    lane = dr.arange(mi.UInt32, cells**3 * count * points)
    if not is_near:
        # A sun gives the same light everywhere. A replay would guess the number of lanes by the sizes of tables.
        lane += dr.opaque(mi.UInt32, 0, dr.width(lane))
    point, cell = mi.Float(lane % points), lane // (points * count)
    it = dr.zeros(mi.Interaction3f, dr.width(lane))
    it.p = centre + half * _draw_place(cell, point, cells)
    emitter = dr.gather(mi.EmitterPtr, emitters, lane // points % count)
    shift = mi.Float(cell) * 0.6180340
    u = mi.Point2f(_fraction(dr.fma(point, 0.7548777, shift)), _fraction(dr.fma(point, 0.5698403, shift)))
    _, radiance = emitter.sample_direction(it, u, mi.Bool(True))
    fluence = sum(dr.abs(row) for row in to_components(dr.detach(radiance)))
    fluence = dr.select(dr.isfinite(fluence), dr.minimum(fluence, MAX_FLUENCE), 0)
    rms = dr.sqrt(dr.block_sum(dr.square(fluence), points) / points)
    # -- Weights -------------------------------------------------------------------------------------------------------------
    entry = dr.arange(mi.UInt32, cells**3 * count)
    scale = dr.gather(mi.Float, weights, entry % count)
    weight, everywhere = rms * scale, dr.zeros(mi.Float, count)
    dr.scatter_add(everywhere, weight, entry % count)
    total = dr.gather(mi.Float, dr.block_sum(weight, count), entry // count)
    even = scale / dr.maximum(dr.gather(mi.Float, dr.block_sum(scale, count), entry // count), MIN_TOTAL)
    everywhere /= dr.maximum(dr.sum(everywhere), MIN_TOTAL)
    mean = dr.gather(mi.Float, everywhere, entry % count)
    other = dr.maximum(total, MIN_TOTAL) * (MEAN_SHARE * mean + EVEN_SHARE * even)
    weight = dr.fma(1 - MEAN_SHARE - EVEN_SHARE, weight, other)
    cumulative = dr.block_prefix_reduce(dr.ReduceOp.Add, weight, count, exclusive=False)
    dr.eval(cumulative, everywhere)
    passed = balls if count <= MAX_PASSED and None not in balls else ()
    return EmitterGrid(cumulative, count, cells, centre, half, everywhere, passed)


def _draw_place(cell: mi.UInt32, point: mi.Float, cells: int) -> mi.Vector3f:
    """The place of a point of a cell, in coordinates of the box."""
    index = mi.Vector3f(mi.Vector3u(cell % cells, cell // cells % cells, cell // (cells * cells)))
    inside = mi.Vector3f(*(_fraction(dr.fma(point, step, 0.5)) for step in (0.8191725, 0.6710436, 0.5497005)))
    place = (index + dr.lerp(-MARGIN, 1 + MARGIN, inside)) * (2 * EDGE / cells) - EDGE
    # The outermost points are 1 / (1 - 3 * 0.3) = 10 boxes away.
    size = dr.minimum(dr.abs(place), 1.3)
    return dr.copysign(dr.select(size <= 1, size, dr.rcp(1 - 3 * (size - 1))), place)


def _fraction(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)
