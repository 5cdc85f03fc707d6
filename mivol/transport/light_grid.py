r"""Optical depth towards lamps on a lattice: which cells of a grid lie in the light.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

A lamp with one position or one direction lights a medium through its own shadow, which a walk along a camera ray does not
see. Its optical depth from the middle of each block of cells tells where scattering is worth a look: distances are drawn in
proportion. Shadow rays stay exact, so nothing is biased; where a block lies across the edge of a shadow the floor ``w_0``
bounds the weights.

A finer lattice of the same optical depths can take the place of the shadow rays altogether (:class:`LightGrid`): that is
biased, and the bias is measured.

Conventions. Optical depth is stored and interpolated, never a transmittance, which would be too bright between nodes (by 54 %
for a step of 2 in optical depth).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.lattice import Lattice
from mivol.transport.optical_depth import interpolate
from mivol.transport.path import DARK, shadow_ray
from mivol.transport.world import Body, World, spectrum

__all__ = ["LightGrid", "Shade", "find_light_grid", "find_shade", "measure_bias"]

FLOOR = 0.02
"""Weight of a block in full shadow: a lit point in it counts 50 times at most."""

SHARE = 0.25
"""Most shadow rays of the lattice, in samples of the image (measured on smoke: blocks of 2 cells take 2.7 times the variance
off a directional light's image, blocks of 4 nothing)."""

COARSEST = 3
"""log2 of the largest block: shadows change from one cell to the next, and larger ones tell nothing."""

LAMPS = 8
"""Most lamps that are looked at one by one."""


INSET = 1e-5
"""How far inside the box the nodes in its faces look, as a share of it."""


@dataclass
class Shade:
    """Weight of each block of cells for each lamp: flat (blocks in z, y, x; lamps)."""

    weights: mi.Float
    blocks: tuple[int, int, int]
    shift: int
    lamps: int

    def at(self, lower: mi.Vector3i, lamp: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The weight of the cell behind a node, for the lamp of each lane."""
        _, y, x = self.blocks
        b = (lower + 1) >> self.shift
        index = mi.UInt32((b.z * y + b.y) * x + b.x) * self.lamps + lamp
        return dr.gather(mi.Float, self.weights, index, active)


def find_shade(scene: mi.Scene, world: World, samples: int) -> Shade | None:
    """Look from the blocks of a grid to the lamps.

    Args:
        scene, world: surfaces, lamps and media.
        samples: of the image; they decide how fine a lattice pays.

    Returns:
        The weights; None where no lamp has one position or direction, several bodies or grids lie along a ray, or the image is
        too small for it to pay.

    Cost: one shadow ray a block and lamp.
    """
    lights = world.lights
    grids = [p.lattice for b in world.bodies for p in b.view.parts if p.lattice is not None]
    sharp = [k for k, e in enumerate(lights.drawn) if int(e.flags()) & int(mi.EmitterFlags.Delta)]
    if not world.is_single or len(grids) != 1 or not sharp or len(lights.drawn) > LAMPS:
        return None
    (lattice,), (body,) = grids, world.bodies
    fits = [shift for shift in range(COARSEST + 1) if _count(lattice, shift) * len(sharp) <= SHARE * samples]
    if not fits:
        return None
    shift = fits[0]
    blocks = tuple((n >> shift) + 1 for n in lattice.res)
    n, k = blocks[0] * blocks[1] * blocks[2], len(lights.drawn)
    weights = dr.full(mi.Float, 1, n * k)
    for lamp in sharp:
        seen = _look(scene, world, body, lattice, blocks, shift, lights.drawn[lamp])
        dr.scatter(weights, seen, dr.arange(mi.UInt32, n) * k + lamp)
    dr.eval(weights)
    return Shade(weights, blocks, shift, k)


def _count(lattice: Lattice, shift: int) -> int:
    """Number of blocks."""
    z, y, x = ((n >> shift) + 1 for n in lattice.res)
    return z * y * x


def _look(
    scene: mi.Scene, world: World, body: Body, lattice: Lattice, blocks: tuple, shift: int, lamp: mi.Emitter
) -> mi.Float:
    """Weights of all blocks for one lamp."""
    z, y, x = blocks
    index = dr.arange(mi.UInt32, z * y * x)
    at = (index % x, (index // x) % y, index // (x * y))
    # Block b holds the cells from b 2^shift - 1 on; its middle, as a share of the box, may lie outside in the last one.
    half = 0.5 * (1 << shift) - 0.5
    u = [
        dr.minimum((mi.Float(a) * (1 << shift) + half) / n, 1 - 0.25 / n) for a, n in zip(at, lattice.res[::-1], strict=True)
    ]
    tau = _tau_to(scene, world, body, lattice.place(mi.Vector3f(*u)), lamp)
    return dr.exp(-sum(tau) / len(tau)) + FLOOR


@dataclass
class LightGrid:
    """Optical depth towards each lamp at the nodes of a lattice over a grid's box, in place of shadow rays.

    Attributes:
        tau: flat (nodes in z, y, x; lamps; channels).
        nodes: their number along z, y, x; the first and the last lie in the faces of the box.
        lattice: the grid.
        lamps, channels: of ``tau``.
    """

    tau: mi.Float
    nodes: tuple[int, int, int]
    lattice: Lattice
    lamps: int
    channels: int

    def transmittance(self, p: mi.Point3f, lamp: int, active: mi.Bool) -> mi.Spectrum:
        """exp(-tau), tau interpolated: a transmittance that is interpolated itself is too bright between nodes."""
        z, y, x = self.nodes
        q = []
        for row, n, m in zip(self.lattice.from_world, self.lattice.res[::-1], (x, y, z), strict=True):
            local = mi.Float(row[0]) * p.x + mi.Float(row[1]) * p.y + mi.Float(row[2]) * p.z + mi.Float(row[3])
            q.append(dr.clip((local + 0.5) / n * (m - 1), 0, m - 1))
        low = [dr.minimum(mi.UInt32(v), m - 2) for v, m in zip(q, (x, y, z), strict=True)]
        frac = mi.Vector3f(*(v - mi.Float(i) for v, i in zip(q, low, strict=True)))
        node = [((low[2] + (b >> 2)) * y + low[1] + (b >> 1 & 1)) * x + low[0] + (b & 1) for b in range(8)]
        rows = []
        for c in range(self.channels):
            offset = lamp * self.channels + c
            corners = [dr.gather(mi.Float, self.tau, k * (self.lamps * self.channels) + offset, active) for k in node]
            rows.append(dr.exp(-interpolate(corners, frac)))
        return spectrum(rows)


def find_light_grid(scene: mi.Scene, world: World, cells: int = 1) -> LightGrid:
    """Walk from every node of a lattice to every lamp.

    Args:
        scene, world: surfaces, lamps and a single body with one grid.
        cells: of the grid, between two nodes.

    Bias: O(h^2) of tau in the distance h of nodes; a cell across the edge of an opaque shadow leaks light.
    Cost: one shadow ray a node and lamp.
    """
    (body,) = world.bodies
    lattice = next(p.lattice for p in body.view.parts if p.lattice is not None)
    nodes = tuple(max(2, -(-n // cells) + 1) for n in lattice.res)
    z, y, x = nodes
    index = dr.arange(mi.UInt32, z * y * x)
    at = (index % x, (index // x) % y, index // (x * y))
    # Just inside: a shadow ray in the plane of a face is outside the box.
    u = [dr.clip(mi.Float(a) / (m - 1), INSET, 1 - INSET) for a, m in zip(at, (x, y, z), strict=True)]
    p = lattice.place(mi.Vector3f(*u))
    lamps, k = len(world.lights.drawn), world.channels
    tau = dr.zeros(mi.Float, z * y * x * lamps * k)
    for number, lamp in enumerate(world.lights.drawn):
        for c, row in enumerate(_tau_to(scene, world, body, p, lamp)):
            dr.scatter(tau, row, (index * lamps + number) * k + c)
    dr.eval(tau)
    return LightGrid(tau, nodes, lattice, lamps, k)


def _tau_to(scene: mi.Scene, world: World, body: Body, p: mi.Point3f, lamp: mi.Emitter) -> list[mi.Float]:
    """Optical depth from points to a lamp; what an opaque surface hides is dark."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    medium = dr.select(dr.full(mi.Bool, True, dr.width(p)), mi.MediumPtr(body.view.medium), None)
    direct, _ = lamp.sample_direction(it, mi.Point2f(0.5), mi.Bool(True))
    _, clear, tau, _ = shadow_ray(scene, world, p, medium, direct, mi.Bool(True))
    return [dr.select(clear, dr.minimum(t, DARK), DARK) for t in tau]


def measure_bias(scene: mi.Scene, world: World, grid: LightGrid, points: int = 1 << 14) -> tuple[float, float]:
    """Compare a light grid with exact shadow rays at points of the grid's box, counted by extinction.

    Returns:
        Mean of T_grid - T_exact, and its root mean square, over points and lamps.
    """
    (body,) = world.bodies
    k = mi.Float64(dr.arange(mi.UInt32, points)) + 0.5
    u = [k / points, k * 0.7548776662 - dr.floor(k * 0.7548776662), k * 0.5698402910 - dr.floor(k * 0.5698402910)]
    p = grid.lattice.place(mi.Vector3f(*(mi.Float(v) for v in u)))
    ray = mi.Ray3f(p, mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    weight = body.extinction_at(ray, mi.Float(0), 1, mi.Bool(True))[0]
    total, first, second = dr.sum(weight), mi.Float(0), mi.Float(0)
    for number, lamp in enumerate(world.lights.drawn):
        exact = _tau_to(scene, world, body, p, lamp)
        off = grid.transmittance(p, number, mi.Bool(True))[0] - dr.exp(-exact[0])
        first += dr.sum(weight * off)
        second += dr.sum(weight * off * off)
    scale = dr.rcp(dr.maximum(total * len(world.lights.drawn), 1e-30))
    return float((first * scale)[0]), float(dr.sqrt(second * scale)[0])
