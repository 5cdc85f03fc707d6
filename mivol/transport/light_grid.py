r"""Optical depth towards lamps on a coarse lattice: which cells of a grid lie in the light.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

A lamp with one position or one direction lights a medium through its own shadow, which a walk along a camera ray does not
see. Its optical depth from the middle of each block of cells tells where scattering is worth a look: distances are drawn in
proportion. Shadow rays stay exact, so nothing is biased; where a block lies across the edge of a shadow the floor ``w_0``
bounds the weights.

Conventions. Optical depth is stored as the weight of a block, constant over it: never interpolated as a transmittance, which
would overestimate it between blocks (by 54 % for a step of 2 in optical depth).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.lattice import Lattice
from mivol.transport.path import light_through
from mivol.transport.world import Body, World

__all__ = ["Shade", "find_shade"]

FLOOR = 0.02
"""Weight of a block in full shadow: a lit point in it counts 50 times at most."""

SHARE = 0.25
"""Most shadow rays of the lattice, in samples of the image (measured on smoke: blocks of 2 cells take 2.7 times the variance
off a directional light's image, blocks of 4 nothing)."""

COARSEST = 3
"""log2 of the largest block: shadows change from one cell to the next, and larger ones tell nothing."""

LAMPS = 8
"""Most lamps that are looked at one by one."""


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
    it = dr.zeros(mi.Interaction3f, z * y * x)
    it.p = lattice.place(mi.Vector3f(*u))
    direct, _ = mi.EmitterPtr(lamp).sample_direction(it, mi.Point2f(0.5), mi.Bool(True))
    length = dr.norm(direct.p - it.p)
    ray = mi.Ray3f(it.p, dr.normalize(direct.p - it.p), length, mi.Float(0), mi.Color0f())
    medium = dr.select(dr.full(mi.Bool, True, z * y * x), mi.MediumPtr(body.view.medium), None)
    _, tau, _ = light_through(scene, world, ray, medium, mi.Bool(True))
    return dr.exp(-sum(tau) / len(tau)) + FLOOR
