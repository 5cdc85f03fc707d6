r"""The baseline of the derivatives of flights: a rough radiance b, subtracted from the light that a flight finds.

.. math:: E\left[ \frac{b(t)\,\partial\sigma(t)}{\sigma(t)} [\text{collision}] - \int_0^t b\,\partial\sigma\,dt' \right] = 0

This holds for any function b of position, since a flight passes t' with probability T(t') and collides there with density
sigma T. So derivatives with L - b in place of L have the same mean. They have the least noise if b is the mean light at
collisions, weighted by the square of each derivative's weight, beta / (sigma + kappa).

A medium has ``BLOCKS``^3 blocks, and b is constant in each. The blocks of a grid consist of cells of the grid, so that a
collision and a walk read equal values. For another medium in a box, b is constant along a flight, and read where the flight
enters the box. Any other medium is a single block. Blocks with few collisions, or whose differences are noise, are drawn to the
mean of all (James-Stein).

Large passes divide each block of a grid into ``PARTS``^3 parts with a known direct light D (:mod:`.direct_light_table`):

.. math:: b = c_{block} + a\,D_{part}

Weighted least squares and shrinkage give the slope a of L over D inside of blocks. Blocks of L - a D give c, as blocks of L
give b in small passes.

References: Vicini et al. 2021 (path replay); Efron & Morris 1973 (shrinkage towards the mean).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body, is_followed
from mivol.transport.media.extinction import to_components
from mivol.transport.media.grid_extinction import have_same_cells
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import map_point
from mivol.transport.traversal.lattice import Lattice, locate_cell
from mivol.transport.traversal.rays import Ray

__all__ = ["Baseline", "BaselineSums", "DirectLightTable", "MediumBlocks"]


BLOCKS = 6
"""Blocks along an edge of a medium. (Second moment of the light about the baseline at second collisions, for 1, 4, 6, 8 and 16
blocks an edge: 0.41, 0.18, 0.18, 0.19 and 0.32 beside a lamp, 0.081, 0.053, 0.055, 0.056 and 0.070 in smoke over a floor.)"""

PARTS = 3
"""Parts along an edge of a block, each with one value of the direct light."""

INSET = 1e-5
"""Least distance of points of parts from the faces of a grid, as a fraction of the grid [1]."""

MIN_SPREAD = 1e-4
"""Least variance of the direct light inside of blocks over its second moment [1]. Below, rounding would decide the slope."""

DEPENDENCE = 3.0
"""Number of collisions that tell as much as one independent collision, since a path has several."""


@dataclass
class MediumBlocks:
    """The blocks of a medium, divided into parts. An undivided block is one part.

    Attributes:
        body: the medium.
        first, first_block: numbers of the first part and of the first block.
        lattice: grid whose cells form the parts; None in a medium without a grid.
        parts: number of parts along an edge of a block.
    """

    body: Body
    first: int
    first_block: int
    lattice: Lattice | None
    parts: int = 1

    @classmethod
    def of(cls, media: SceneMedia, has_parts: bool = False) -> list[MediumBlocks]:
        """The blocks of each of the media; blocks of grids have parts if ``has_parts``."""
        found: list[MediumBlocks] = []
        for body in media.bodies:
            first = (found[-1].first + found[-1].count, found[-1].last_block + 1) if found else (0, 0)
            lattice = _find_lattice(body)
            found.append(cls(body, *first, lattice, PARTS if has_parts and lattice is not None else 1))
        return found

    @property
    def edge(self) -> int:
        """Number of parts along an edge of the medium."""
        return 1 if self.lattice is None and self.body.box is None else BLOCKS * self.parts

    @property
    def count(self) -> int:
        """Number of parts."""
        return self.edge**3

    @property
    def last_block(self) -> int:
        """Number of the last block."""
        return self.first_block + (self.edge // self.parts) ** 3 - 1

    def block_of(self, part: mi.UInt32) -> mi.UInt32:
        """The block of a part of this medium."""
        if self.parts == 1:
            return part - self.first + self.first_block
        x, y, z = (index // self.parts for index in self._indices(part - self.first))
        edge = self.edge // self.parts
        return (z * edge + y) * edge + x + self.first_block

    def place(self, part: mi.UInt32, inside: mi.Point3f) -> mi.Point3f:
        """A point in the world, by the index of a part in this medium and the place ``inside`` the part, in [0, 1)^3."""
        u = mi.Vector3f()
        for a, (index, n) in enumerate(zip(self._indices(part), self.lattice.res[::-1], strict=True)):
            # The outermost cells are half outside of the grid.
            node = (mi.Float(index) + inside[a]) * ((n + 1) / self.edge) - 1
            u[a] = dr.clip((node + 0.5) / n, INSET, 1 - INSET)
        return mi.Point3f(self.lattice.to_world_points(u))

    def at_node(self, lower: mi.Vector3i) -> mi.UInt32:
        """The part around the cell of the grid with the lower node ``lower``."""
        return self._number([(lower[a] + 1) * self.edge // (n + 1) for a, n in enumerate(self.lattice.res[::-1])])

    def at_point(self, ray: Ray, t: mi.Float64, active: mi.Bool) -> mi.UInt32:
        """The part at a point of a flight along a ray."""
        if self.lattice is not None:
            return self.at_node(locate_cell(self.lattice, ray.o, ray.d, dr.select(active, t, 0))[0])
        return self.of_flight(ray)

    def of_flight(self, ray: Ray) -> mi.UInt32:
        """The block in which a flight along a ray enters the box of the medium."""
        if self.body.box is None:
            return mi.UInt32(self.first)
        t, _ = self.body.clip(ray, mi.Float64(0), mi.Float64(dr.inf))
        p = mi.Point3d(ray.o) + mi.Vector3d(ray.d) * dr.select(dr.isfinite(t), t, 0)
        return self._number([mi.Int32(dr.floor(BLOCKS * map_point(row, p))) for row in self.body.rows])

    def _number(self, index: list[mi.Int32]) -> mi.UInt32:
        x, y, z = (dr.clip(i, 0, self.edge - 1) for i in index)
        return mi.UInt32((z * self.edge + y) * self.edge + x) + self.first

    def _indices(self, number: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The indices along x, y and z, from the index of a part in this medium."""
        return number % self.edge, number // self.edge % self.edge, number // self.edge**2


def _find_lattice(body: Body) -> Lattice | None:
    """The grid whose cells every differentiated part of a medium shares; None without one."""
    if is_followed(body.view.microflakes):
        return None
    parts = body.view.parts
    lattices = [part.lattice for part in parts if part.exact_line and part.lattice is not None]
    alike = len(lattices) == len(parts) and all(have_same_cells(lattice, lattices[0]) for lattice in lattices)
    return lattices[0] if alike and lattices else None


@dataclass
class DirectLightTable:
    """The direct light in the parts of blocks.

    Attributes:
        blocks: blocks of each medium.
        values: radiance of each colour in each part, parts fastest.
    """

    blocks: list[MediumBlocks]
    values: mi.Float


class BaselineSums:
    """The sums over the collisions of some paths, from which a baseline follows.

    Args:
        media: media of the scene.
        table: direct light in the parts of blocks; None: the baseline is constant in a block.

    Attributes:
        blocks: blocks of each medium.
    """

    def __init__(self, media: SceneMedia, table: DirectLightTable | None = None) -> None:
        self.media, self.table = media, table
        self.blocks = MediumBlocks.of(media) if table is None else table.blocks
        self._count, self._colours = self.blocks[-1].last_block + 1, dr.size_v(mi.Spectrum)
        self._parts = self.blocks[-1].first + self.blocks[-1].count
        # For each colour and block the sums of w, w L and w L^2, the number of collisions in each block, and the mean light of
        # all paths.
        self.sums = dr.zeros(mi.Float, (3 * self._colours + 1) * self._count + self._colours)
        # For each colour and block the sums of w D, w D^2 and w D L, with the direct light D.
        self.direct_sums = None if table is None else dr.zeros(mi.Float, 3 * self._colours * self._count)

    def add_path(self, L: mi.Spectrum) -> None:
        """Add the light of paths, from which the baseline follows if none collides."""
        for c, light in enumerate(to_components(L)):
            dr.scatter_add(self.sums, light / dr.width(L), mi.UInt32((3 * self._colours + 1) * self._count + c))

    def add(self, ray: Ray, t: mi.Float64, body: mi.UInt32, weight: mi.Spectrum, L: mi.Spectrum, active: mi.Bool) -> None:
        """Add the collisions of a flight.

        Args:
            ray, t: ray, and distance of the collision [length].
            body: index of the medium.
            weight: weight w of each colour.
            L: light behind the collision [radiance].
            active: lanes with a collision.
        """
        part, block = mi.UInt32(0), mi.UInt32(0)
        for blocks, (_, on) in zip(self.blocks, self.media.bodies_at(body, active), strict=True):
            own = blocks.at_point(ray, t, on)
            part, block = dr.select(on, own, part), dr.select(on, blocks.block_of(own), block)
        for c, (w, light) in enumerate(zip(to_components(weight), to_components(L), strict=True)):
            for k, value in enumerate((w, w * light, w * light * light)):
                dr.scatter_add(self.sums, value, block + (k * self._colours + c) * self._count, active)
            if self.table is None:
                continue
            D = dr.gather(mi.Float, self.table.values, part + c * self._parts, active)
            for k, value in enumerate((w * D, w * D * D, w * D * light)):
                dr.scatter_add(self.direct_sums, value, block + (k * self._colours + c) * self._count, active)
        dr.scatter_add(self.sums, mi.Float(1), block + 3 * self._colours * self._count, active)

    def finish(self) -> Baseline:
        """The baseline: the mean light of the paths if none has collided."""
        n, colours = self._count, self._colours
        i = dr.arange(mi.UInt32, colours * n)
        colour = i // n
        W, S, Q = (dr.gather(mi.Float, self.sums, i + k * colours * n) for k in range(3))
        events = dr.gather(mi.Float, self.sums, i + 3 * colours * n, i < n)
        slope, known_rows = None, []
        if self.table is not None:
            SD, SDD, SDL = (dr.gather(mi.Float, self.direct_sums, i + k * colours * n) for k in range(3))
            slope, known_rows = self._find_slope(colour, (W, S, Q), (SD, SDD, SDL), events), [S, Q]
            S, Q = S - slope * SD, Q - slope * (2 * SDL - slope * SDD)
        own = _ratio(S, W)

        # -- The sums over all blocks -----------------------------------------------------------------------------------------
        rows = [W, S, Q, S * own, dr.select(W > 0, mi.Float(1), 0), *known_rows]
        totals, total = self._total(colour, rows, events)
        total_W, total_S, total_Q, explained, filled = totals[:5]
        light = dr.gather(mi.Float, self.sums, colour + (3 * colours + 1) * n)
        mean = dr.select(total_W > 0, _ratio(total_S, total_W), light)

        # -- The variance inside the blocks and between them ------------------------------------------------------------------
        inside = _ratio(dr.maximum(total_Q - explained, 0), total_W) * _ratio(total, dr.maximum(total - filled, 1))
        spread = _ratio(dr.maximum(explained - total_S * mean, 0), total_W)
        between = dr.maximum(spread - DEPENDENCE * inside * _ratio(filled, total), 0)
        informs = W * _ratio(total, total_W) * between
        share = _ratio(informs, informs + DEPENDENCE * inside)
        values = mean + dr.select(W > 0, share * (own - mean), 0)

        left = dr.zeros(mi.Float, 1)
        dr.scatter_add(left, Q - 2 * values * S + dr.square(values) * W, mi.UInt32(0), mode=dr.ReduceMode.Direct)
        square = total_Q
        if slope is not None:
            mean, square = dr.select(total_W > 0, _ratio(totals[5], total_W), light), totals[6]
            values = self._add_direct_light(values, slope)
        dr.eval(values, left, mean, square)
        known = sum(dr.gather(mi.Float, square, mi.UInt32(c * n)) for c in range(colours))
        return Baseline(self.blocks, values, self._parts, mean, n, _ratio(dr.maximum(left, 0), known))

    def _total(self, colour: mi.UInt32, rows: list[mi.Float], events: mi.Float) -> tuple[list[mi.Float], mi.Float]:
        """The sums of rows over the blocks of each colour, and the number of all collisions, for each colour and block."""
        colours = self._colours
        totals, lanes = dr.zeros(mi.Float, len(rows) * colours + 1), dr.width(colour)
        for k, row in enumerate(rows):
            dr.scatter_add(totals, row, colour + k * colours, mode=dr.ReduceMode.Direct)
        is_first = dr.arange(mi.UInt32, lanes) < self._count
        dr.scatter_add(totals, events, len(rows) * colours, is_first, dr.ReduceMode.Direct)
        sums = [dr.gather(mi.Float, totals, colour + k * colours) for k in range(len(rows))]
        return sums, dr.gather(mi.Float, totals, mi.UInt32(len(rows) * colours))

    def _find_slope(
        self, colour: mi.UInt32, sums: tuple[mi.Float, ...], direct: tuple[mi.Float, ...], events: mi.Float
    ) -> mi.Float:
        """The slope of the light on the direct light inside of blocks, for each colour and block.

        Args:
            colour: colour of each colour and block.
            sums: sums of w, w L and w L^2.
            direct: sums of w D, w D^2 and w D L.
            events: number of collisions of each block.
        """
        (W, S, Q), (SD, SDD, SDL) = sums, direct
        filled = dr.select(W > 0, mi.Float(1), 0)
        rows = [filled, SDD, SDD - _ratio(SD * SD, W), SDL - _ratio(SD * S, W), Q - _ratio(S * S, W)]
        (count, square, spread, common, inside), total = self._total(colour, rows, events)
        slope = dr.select(spread > MIN_SPREAD * square, _ratio(common, spread), 0)
        explained = slope * common
        # A slope of pure noise explains as much as the noise of one collision.
        noise = DEPENDENCE * dr.maximum(inside - explained, 0) * _ratio(mi.Float(1), dr.maximum(total - count, 1))
        return slope * _ratio(dr.maximum(explained - noise, 0), explained)

    def _add_direct_light(self, values: mi.Float, slope: mi.Float) -> mi.Float:
        """The values of parts, from the values and slopes of blocks."""
        j = dr.arange(mi.UInt32, self._colours * self._parts)
        part, block = j % self._parts, mi.UInt32(0)
        for own in self.blocks:
            block = dr.select(part >= own.first, own.block_of(part), block)
        block += j // self._parts * self._count
        return dr.gather(mi.Float, values, block) + dr.gather(mi.Float, slope, block) * self.table.values


def _ratio(a: mi.Float, b: mi.Float) -> mi.Float:
    """a / b, and 0 for b = 0."""
    return dr.select(b > 0, a / dr.select(b > 0, b, 1), 0)


@dataclass
class Baseline:
    """The baseline.

    Attributes:
        blocks: blocks of each medium.
        values: radiance of each colour in each part, parts fastest.
        count: number of parts.
        mean: mean of each colour, repeated ``repeats`` times.
        repeats: number of blocks.
        noise: second moment of the light about the baseline at collisions, over its second moment about 0 [1].
    """

    blocks: list[MediumBlocks]
    values: mi.Float
    count: int
    mean: mi.Float
    repeats: int
    noise: mi.Float

    def at_point(self, body: Body, ray: Ray, t: mi.Float64, active: mi.Bool) -> mi.Spectrum:
        """The baseline at a point of a flight along a ray in a medium."""
        return self._read(self._of(body).at_point(ray, t, active), active)

    def along(self, body: Body, ray: Ray, active: mi.Bool) -> mi.Spectrum | Callable[[mi.Vector3i], mi.Spectrum]:
        """The baseline of a flight in a medium, or its value in the cell of a grid with a lower node."""
        blocks = self._of(body)
        if blocks.lattice is None:
            return self._read(blocks.of_flight(ray), active)
        return lambda lower: self._read(blocks.at_node(lower), active)

    @property
    def depends_on_starts(self) -> bool:
        """Whether some baseline is that of the block in which a flight begins: where no grid tells blocks along the flight."""
        return any(blocks.lattice is None for blocks in self.blocks)

    @property
    def average(self) -> mi.Spectrum:
        """The mean over all collisions."""
        first = (mi.UInt32(c * self.repeats) for c in range(dr.size_v(mi.Spectrum)))
        return mi.Spectrum(*(dr.gather(mi.Float, self.mean, k) for k in first))

    def _of(self, body: Body) -> MediumBlocks:
        return next(blocks for blocks in self.blocks if blocks.body is body)

    def _read(self, block: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        rows = range(dr.size_v(mi.Spectrum))
        return mi.Spectrum(*(dr.gather(mi.Float, self.values, block + c * self.count, active) for c in rows))
