r"""Optical depth towards emitters for each block of a grid: which cells lie in the light.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

An emitter with one position or one direction lights a medium through its own shadow, which a walk along a camera ray does not
see. Its optical depth from the middle of each block of cells tells where scattering is worth a look: distances are drawn in
proportion. It is summed over a grid as coarse as the blocks, and shadow rays stay exact, so nothing is biased; where a block
lies across the edge of a shadow the floor ``w_0`` bounds the weights.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import SceneEmitters
from mivol.transport.estimators.shadow_rays import DARK, shadow_ray
from mivol.transport.media.body import Body
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.coarse_grid import CoarseGrid
from mivol.transport.traversal.lattice import Lattice

__all__ = ["VisibilityCache", "build_visibility_cache", "tau_towards"]


FLOOR = 0.02
"""Weight of a block in full shadow: a lit point in it counts 50 times at most."""

SHARE = 0.2
"""Most shadow rays of the lattice, in those of the image (measured: blocks of 2 cells take 2.7 times the variance off a
directional light's image of smoke, blocks of 4 nothing; blocks of 4 half of a point light's on a CT of 256^3 that 8 leave)."""

COARSEST = 3
"""log2 of the largest block: shadows change from one cell to the next, and larger ones tell nothing."""

LAMPS = 8
"""Most lamps that are looked at one by one."""


@dataclass
class VisibilityCache:
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


def build_visibility_cache(
    media: SceneMedia,
    emitters: SceneEmitters,
    rays: int,
    occupied: float | None,
    take: Callable[[Lattice, int, bool], CoarseGrid],
) -> VisibilityCache | None:
    """Look from the blocks of a grid to the lamps.

    Args:
        media: surfaces and media.
        emitters: of the scene.
        rays: shadow rays of the image, which decide how fine a lattice pays.
        occupied: share of the grid's blocks that hold anything, where no light is wanted from the others; None: from all.
        take: :func:`coarsen_grid`, or what keeps its answers.

    Returns:
        The weights; None where no lamp has one position or direction, several bodies or grids lie along a ray, or the image is
        too small for it to pay.

    Cost: one shadow ray through the coarse grid a block and lamp.
    """
    grids = [p.lattice for b in media.bodies for p in b.view.parts if p.lattice is not None]
    sharp = [k for k, e in enumerate(emitters.sampled) if int(e.flags()) & int(mi.EmitterFlags.Delta)]
    if not media.is_single or len(grids) != 1 or not sharp or len(emitters.sampled) > LAMPS:
        return None
    (lattice,), (body,) = grids, media.bodies
    # Where a constant lies under the grid no block is empty.
    lists = occupied is not None and len(body.view.parts) == 1
    share = (occupied if lists else 1) * len(sharp)
    fits = [shift for shift in range(COARSEST + 1) if _count(lattice, shift) * share <= SHARE * rays]
    if not fits:
        return None
    shift = fits[0]
    blocks = tuple((n >> shift) + 1 for n in lattice.res)
    n, k = blocks[0] * blocks[1] * blocks[2], len(emitters.sampled)
    coarse = take(lattice, shift, lists)
    index = coarse.held if lists else dr.arange(mi.UInt32, n)
    weights = dr.full(mi.Float, 1, n * k)
    if dr.width(index):
        far = _with_grid(media, coarse.lattice)
        for lamp in sharp:
            seen = _look(far, lattice, blocks, shift, index, emitters.sampled[lamp])
            dr.scatter(weights, seen, index * k + lamp)
    dr.eval(weights)
    return VisibilityCache(weights, blocks, shift, k)


def _count(lattice: Lattice, shift: int) -> int:
    """Number of blocks."""
    z, y, x = ((n >> shift) + 1 for n in lattice.res)
    return z * y * x


def _with_grid(media: SceneMedia, lattice: Lattice) -> SceneMedia:
    """The media with another grid in the place of theirs."""
    (body,) = media.bodies
    parts = [p if p.lattice is None else replace(p, lattice=lattice) for p in body.view.parts]
    other, bodies = copy.copy(media), [Body(replace(body.view, parts=parts), body.box)]
    other.boxed, other.traced = (bodies, []) if body.box is not None else ([], bodies)
    return other


def _look(media: SceneMedia, lattice: Lattice, blocks: tuple, shift: int, index: mi.UInt32, lamp: mi.Emitter) -> mi.Float:
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
    tau = tau_towards(media, media.bodies[0], lattice.place(mi.Vector3f(*u)), lamp)
    return dr.exp(-sum(tau) / len(tau)) + FLOOR


def tau_towards(media: SceneMedia, body: Body, p: mi.Point3f, lamp: mi.Emitter) -> list[mi.Float]:
    """Optical depth from points to a lamp; what an opaque surface hides is dark."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    medium = dr.select(dr.full(mi.Bool, True, dr.width(p)), mi.MediumPtr(body.view.medium), None)
    direct, _ = lamp.sample_direction(it, mi.Point2f(0.5), mi.Bool(True))
    _, clear, tau, _ = shadow_ray(media, p, medium, direct, mi.Bool(True))
    return [dr.select(clear, dr.minimum(t, DARK), DARK) for t in tau]
