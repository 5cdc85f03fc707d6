r"""The baseline of the derivatives of flights: a rough radiance b, subtracted from the light that a flight finds.

.. math:: E\left[ \frac{b(t)\,\partial\sigma(t)}{\sigma(t)} [\text{collision}] - \int_0^t b\,\partial\sigma\,dt' \right] = 0

This holds for any function b of position, since a flight passes t' with probability T(t') and collides there with density
sigma T. So derivatives with L - b in place of L have the same mean. They have the least noise if b is the mean light at
collisions, weighted by the square of each derivative's weight, beta / (sigma + kappa).

A medium has ``BLOCKS``^3 blocks, and b is constant in each. The blocks of a grid consist of cells of the grid, so that a
collision and a walk read equal values. For another medium in a box, b is constant along a flight, and read where the flight
enters the box. Any other medium is a single block. Blocks with few collisions, or whose differences are noise, are drawn to the
mean of all (James-Stein).

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

__all__ = ["Baseline", "BaselineSums", "MediumBlocks"]


BLOCKS = 6
"""Blocks along an edge of a medium. (Second moment of the light about the baseline at second collisions, for 1, 4, 6, 8 and 16
blocks an edge: 0.41, 0.18, 0.18, 0.19 and 0.32 beside a lamp, 0.081, 0.053, 0.055, 0.056 and 0.070 in smoke over a floor.)"""

DEPENDENCE = 3.0
"""Number of collisions that tell as much as one independent collision, since a path has several."""


@dataclass
class MediumBlocks:
    """The blocks of a medium.

    Attributes:
        body: the medium.
        first: number of its first block.
        lattice: grid whose cells form the blocks; None for another medium.
    """

    body: Body
    first: int
    lattice: Lattice | None

    @classmethod
    def of(cls, media: SceneMedia) -> list[MediumBlocks]:
        """The blocks of each of the media."""
        found: list[MediumBlocks] = []
        for body in media.bodies:
            found.append(cls(body, found[-1].first + found[-1].count if found else 0, _find_lattice(body)))
        return found

    @property
    def count(self) -> int:
        """Number of blocks."""
        return 1 if self.lattice is None and self.body.box is None else BLOCKS**3

    def at_node(self, lower: mi.Vector3i) -> mi.UInt32:
        """The block around the cell of the grid with the lower node ``lower``."""
        return self._number([(lower[a] + 1) * BLOCKS // (n + 1) for a, n in enumerate(self.lattice.res[::-1])])

    def at_point(self, ray: Ray, t: mi.Float64, active: mi.Bool) -> mi.UInt32:
        """The block of a point of a flight along a ray."""
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
        x, y, z = (dr.clip(i, 0, BLOCKS - 1) for i in index)
        return mi.UInt32((z * BLOCKS + y) * BLOCKS + x) + self.first


def _find_lattice(body: Body) -> Lattice | None:
    """The grid whose cells every differentiated part of a medium shares; None without one."""
    if is_followed(body.view.microflakes):
        return None
    parts = body.view.parts
    lattices = [part.lattice for part in parts if part.exact_line and part.lattice is not None]
    alike = len(lattices) == len(parts) and all(have_same_cells(lattice, lattices[0]) for lattice in lattices)
    return lattices[0] if alike and lattices else None


class BaselineSums:
    """The sums over the collisions of some paths, from which a baseline follows.

    Args:
        media: media of the scene.

    Attributes:
        blocks: blocks of each medium.
    """

    def __init__(self, media: SceneMedia) -> None:
        self.media, self.blocks = media, MediumBlocks.of(media)
        self._count, self._colours = self.blocks[-1].first + self.blocks[-1].count, dr.size_v(mi.Spectrum)
        # For each colour and block the sums of w, w L and w L^2, the number of collisions in each block, and the mean light of
        # all paths.
        self.sums = dr.zeros(mi.Float, (3 * self._colours + 1) * self._count + self._colours)

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
        block = mi.UInt32(0)
        for blocks, (_, on) in zip(self.blocks, self.media.bodies_at(body, active), strict=True):
            block = dr.select(on, blocks.at_point(ray, t, on), block)
        for c, (w, light) in enumerate(zip(to_components(weight), to_components(L), strict=True)):
            for k, value in enumerate((w, w * light, w * light * light)):
                dr.scatter_add(self.sums, value, block + (k * self._colours + c) * self._count, active)
        dr.scatter_add(self.sums, mi.Float(1), block + 3 * self._colours * self._count, active)

    def finish(self) -> Baseline:
        """The baseline: the mean light of the paths if none has collided."""
        n, colours = self._count, self._colours
        i = dr.arange(mi.UInt32, colours * n)
        colour = i // n
        W, S, Q = (dr.gather(mi.Float, self.sums, i + k * colours * n) for k in range(3))
        own = _ratio(S, W)

        # -- The sums over all blocks -----------------------------------------------------------------------------------------
        rows = [W, S, Q, S * own, dr.select(W > 0, mi.Float(1), 0)]
        totals = dr.zeros(mi.Float, len(rows) * colours + 1)
        for k, row in enumerate(rows):
            dr.scatter_add(totals, row, colour + k * colours, mode=dr.ReduceMode.Direct)
        events = dr.gather(mi.Float, self.sums, i + 3 * colours * n, i < n)
        dr.scatter_add(totals, events, len(rows) * colours, i < n, dr.ReduceMode.Direct)
        total_W, total_S, total_Q, explained, filled = (
            dr.gather(mi.Float, totals, colour + k * colours) for k in range(len(rows))
        )
        total = dr.gather(mi.Float, totals, mi.UInt32(len(rows) * colours))
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
        dr.eval(values, left, mean)
        known = sum(dr.gather(mi.Float, totals, mi.UInt32(2 * colours + c)) for c in range(colours))
        return Baseline(self.blocks, values, n, mean, _ratio(dr.maximum(left, 0), known))


def _ratio(a: mi.Float, b: mi.Float) -> mi.Float:
    """a / b, and 0 for b = 0."""
    return dr.select(b > 0, a / dr.select(b > 0, b, 1), 0)


@dataclass
class Baseline:
    """The baseline.

    Attributes:
        blocks: blocks of each medium.
        values: radiance of each colour in each block, blocks fastest.
        count: number of blocks.
        mean: mean of each colour, repeated for each block as in ``values``.
        noise: second moment of the light about the baseline at collisions, over its second moment about 0 [1].
    """

    blocks: list[MediumBlocks]
    values: mi.Float
    count: int
    mean: mi.Float
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
    def average(self) -> mi.Spectrum:
        """The mean over all collisions."""
        return mi.Spectrum(*(dr.gather(mi.Float, self.mean, mi.UInt32(c * self.count)) for c in range(dr.size_v(mi.Spectrum))))

    def _of(self, body: Body) -> MediumBlocks:
        return next(blocks for blocks in self.blocks if blocks.body is body)

    def _read(self, block: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        rows = range(dr.size_v(mi.Spectrum))
        return mi.Spectrum(*(dr.gather(mi.Float, self.values, block + c * self.count, active) for c in rows))
