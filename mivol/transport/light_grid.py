r"""Optical depth towards lamps on a lattice: which cells of a grid lie in the light.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

A lamp with one position or one direction lights a medium through its own shadow, which a walk along a camera ray does not
see. Its optical depth from the middle of each block of cells tells where scattering is worth a look: distances are drawn in
proportion. It is summed over a grid as coarse as the blocks, and shadow rays stay exact, so nothing is biased; where a block
lies across the edge of a shadow the floor ``w_0`` bounds the weights.

A finer lattice of the same optical depths can take the place of the shadow rays altogether (:class:`LightGrid`): that is
biased, and the bias is measured.

Conventions. Optical depth is stored and interpolated, never a transmittance, which would be too bright between nodes (by 54 %
for a step of 2 in optical depth).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.lattice import Lattice, find_gaps
from mivol.transport.optical_depth import interpolate
from mivol.transport.path import DARK, shadow_ray
from mivol.transport.world import Body, World, spectrum

__all__ = ["Coarse", "LightGrid", "Shade", "coarsen", "find_light_grid", "find_shade", "measure_bias"]

FLOOR = 0.02
"""Weight of a block in full shadow: a lit point in it counts 50 times at most."""

SHARE = 0.2
"""Most shadow rays of the lattice, in those of the image (measured: blocks of 2 cells take 2.7 times the variance off a
directional light's image of smoke, blocks of 4 nothing; blocks of 4 half of a point light's on a CT of 256^3 that 8 leave)."""

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


@dataclass
class Coarse:
    """The means of a grid over blocks of voxels, as a grid in the same place.

    Attributes:
        lattice: voxel i holds the mean of the voxels 2^shift i to 2^shift (i + 1) - 1, along each axis; the last one repeats
            the border of the grid.
        held: numbers of the blocks of a :class:`Shade` (z, y, x) that hold anything; None where they were not asked for.
    """

    lattice: Lattice
    held: mi.UInt32 | None


def coarsen(lattice: Lattice, shift: int, lists: bool) -> Coarse:
    """Take means over blocks of 2^shift voxels along each axis, and list the blocks that hold anything if ``lists``.

    Cost: 8/7 look-ups a voxel, 8 a block.
    """
    c, edge, shape = lattice.channels, 1 << shift, list(lattice.res)
    flat = dr.detach(lattice.values.array)
    for axis in (2, 1, 0):
        inner = int(np.prod(shape[axis + 1 :])) * c
        flat = _mean_along(flat, shape[axis], inner, edge)
        shape[axis] = -(-shape[axis] // edge)
    values = mi.TensorXf(flat, (*shape, c))
    stretch = np.diag([edge * m / n for m, n in zip(shape[::-1], lattice.res[::-1], strict=True)] + [1.0])
    gaps = find_gaps(values) if lattice.gaps is not None else None
    return Coarse(Lattice(values, lattice.to_world @ stretch, gaps), _held(values, lattice.res, shift) if lists else None)


def _mean_along(flat: mi.Float, n: int, inner: int, edge: int) -> mi.Float:
    """Means of ``edge`` neighbours along the middle axis of (outer, n, inner)."""
    b = -(-n // edge)
    i = dr.arange(mi.UInt32, dr.width(flat) // n * b)
    row, first = (i // (inner * b)) * (n * inner) + i % inner, (i // inner) % b * edge
    total = mi.Float(0)
    for k in range(edge):
        total += dr.gather(mi.Float, flat, row + dr.minimum(first + k, n - 1) * inner)
    total *= 1 / edge
    dr.eval(total)
    return total


def _held(means: mi.TensorXf, res: tuple[int, int, int], shift: int) -> mi.UInt32:
    """Blocks one of whose nodes is not 0: they are those of two mean voxels along each axis, or fewer."""
    c, sizes = means.shape[3], [(n >> shift) + 1 for n in res]
    i, found = dr.arange(mi.UInt32, sizes[0] * sizes[1] * sizes[2]), mi.Bool(False)
    block = (i // (sizes[1] * sizes[2]), i // sizes[2] % sizes[1], i % sizes[2])
    for corner in range(8):
        z, y, x = (
            dr.clip(mi.Int32(b) - (corner >> k & 1), 0, n - 1) for k, (b, n) in enumerate(zip(block, means.shape, strict=False))
        )
        node = mi.UInt32((z * means.shape[1] + y) * means.shape[2] + x) * c
        for channel in range(c):
            found |= dr.gather(mi.Float, means.array, node + channel) > 0
    return dr.compress(found)


def find_shade(
    scene: mi.Scene, world: World, rays: int, occupied: float | None, take: Callable[[Lattice, int, bool], Coarse]
) -> Shade | None:
    """Look from the blocks of a grid to the lamps.

    Args:
        scene, world: surfaces, lamps and media.
        rays: shadow rays of the image, which decide how fine a lattice pays.
        occupied: share of the grid's blocks that hold anything, where no light is wanted from the others; None: from all.
        take: :func:`coarsen`, or what keeps its answers.

    Returns:
        The weights; None where no lamp has one position or direction, several bodies or grids lie along a ray, or the image is
        too small for it to pay.

    Cost: one shadow ray through the coarse grid a block and lamp.
    """
    lights = world.lights
    grids = [p.lattice for b in world.bodies for p in b.view.parts if p.lattice is not None]
    sharp = [k for k, e in enumerate(lights.drawn) if int(e.flags()) & int(mi.EmitterFlags.Delta)]
    if not world.is_single or len(grids) != 1 or not sharp or len(lights.drawn) > LAMPS:
        return None
    (lattice,), (body,) = grids, world.bodies
    # Where a constant lies under the grid no block is empty.
    lists = occupied is not None and len(body.view.parts) == 1
    share = (occupied if lists else 1) * len(sharp)
    fits = [shift for shift in range(COARSEST + 1) if _count(lattice, shift) * share <= SHARE * rays]
    if not fits:
        return None
    shift = fits[0]
    blocks = tuple((n >> shift) + 1 for n in lattice.res)
    n, k = blocks[0] * blocks[1] * blocks[2], len(lights.drawn)
    coarse = take(lattice, shift, lists)
    index = coarse.held if lists else dr.arange(mi.UInt32, n)
    weights = dr.full(mi.Float, 1, n * k)
    if dr.width(index):
        far = _with_grid(world, coarse.lattice)
        for lamp in sharp:
            seen = _look(scene, far, lattice, blocks, shift, index, lights.drawn[lamp])
            dr.scatter(weights, seen, index * k + lamp)
    dr.eval(weights)
    return Shade(weights, blocks, shift, k)


def _count(lattice: Lattice, shift: int) -> int:
    """Number of blocks."""
    z, y, x = ((n >> shift) + 1 for n in lattice.res)
    return z * y * x


def _with_grid(world: World, lattice: Lattice) -> World:
    """The media with another grid in the place of theirs."""
    (body,) = world.bodies
    parts = [p if p.lattice is None else replace(p, lattice=lattice) for p in body.view.parts]
    other, bodies = copy.copy(world), [Body(replace(body.view, parts=parts), body.box)]
    other.boxed, other.traced = (bodies, []) if body.box is not None else ([], bodies)
    return other


def _look(
    scene: mi.Scene, world: World, lattice: Lattice, blocks: tuple, shift: int, index: mi.UInt32, lamp: mi.Emitter
) -> mi.Float:
    """Weights of blocks for one lamp."""
    _, y, x = blocks
    at = (index % x, (index // x) % y, index // (x * y))
    # Block b holds the cells from b 2^shift - 1 on, of which the outermost are half as wide; its middle, as a share of the box,
    # may lie outside in the last one.
    half = 0.5 * (1 << shift) - 0.5
    u = [
        dr.clip((mi.Float(a) * (1 << shift) + half) / n, 0.25 / n, 1 - 0.25 / n)
        for a, n in zip(at, lattice.res[::-1], strict=True)
    ]
    tau = _tau_to(scene, world, world.bodies[0], lattice.place(mi.Vector3f(*u)), lamp)
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
