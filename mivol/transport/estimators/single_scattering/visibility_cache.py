r"""A visibility cache: rough transmittance towards the emitters, which guides distance sampling.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

Light of an emitter with a single position or direction reaches only parts of a
dense medium, and the extinction along a camera ray does not tell which. The optical depth from the centre of each block of
cells to the emitter does, so distances are drawn in proportion to w_b. It is integrated over a grid as coarse as the blocks.
Shadow rays stay exact, so nothing is biased. The floor ``w_0`` bounds the sample weights in blocks across the edge of a shadow.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.tabulated_shadows import optical_depth_towards
from mivol.transport.media.body import Body
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_blocks import CoarseGrid
from mivol.transport.traversal.lattice import Lattice

__all__ = [
    "VisibilityCache",
    "build_visibility_cache",
]


MIN_WEIGHT = 0.02
"""w_0, the weight of a block in full shadow [1]: a lit point inside has at most 50 times its sample weight."""

RAY_FRACTION = 0.2
"""Largest number of shadow rays of the cache, as a fraction of the shadow rays of the image [1]. The smallest blocks within
this bound are chosen. (Measured: under a directional light on smoke, blocks of 2 cells divide the variance by 2.7, blocks of 4
have no effect; under a point light on a CT of 256^3, blocks of 4 halve the variance of blocks of 8.)"""

MAX_SHIFT = 3
"""log2 of the edge of the largest blocks [cells]; shadows vary too much within larger ones."""

MAX_EMITTERS = 8
"""Largest number of emitters with a cache."""


@dataclass
class VisibilityCache:
    """Weights of blocks of cells.

    Attributes:
        weights: flat (blocks in z, y, x; emitters) [1].
        blocks: number of blocks along z, y, x.
        shift: log2 of the edge of a block [cells].
        emitters: number of emitters.
    """

    weights: mi.Float
    blocks: tuple[int, int, int]
    shift: int
    emitters: int

    def at(self, lower: mi.Vector3i, number: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The weight of the cell with the lower node ``lower``, for the emitter of each lane."""
        _, y, x = self.blocks
        b = (lower + 1) >> self.shift
        index = mi.UInt32((b.z * y + b.y) * x + b.x) * self.emitters + number
        return dr.gather(mi.Float, self.weights, index, active)


def build_visibility_cache(
    media: SceneMedia,
    emitters: SceneEmitters,
    rays: int,
    occupied: float | None,
    take: Callable[[Lattice, int, bool], CoarseGrid],
) -> VisibilityCache | None:
    """Integrate the optical depth from the blocks of a grid to the emitters.

    Args:
        media: surfaces and media.
        emitters: emitters of the scene.
        rays: number of shadow rays of the image, limiting the resolution of the cache.
        occupied: fraction of the grid's blocks that are not empty, to build only these; None builds all blocks.
        take: :func:`coarsen_grid`, or a function remembering its results.

    Returns:
        The cache; None if no emitter has a single position or direction, with several media or grids or more than
        ``MAX_EMITTERS`` emitters, or for an image too small for a cache to pay.

    Cost: one shadow ray through the coarse grid for each block and emitter.
    """
    grids = [p.lattice for b in media.bodies for p in b.view.parts if p.lattice is not None]
    delta = [k for k, e in enumerate(emitters.sampled) if int(e.flags()) & int(mi.EmitterFlags.Delta)]
    if not media.is_single or len(grids) != 1 or not delta or len(emitters.sampled) > MAX_EMITTERS:
        return None
    (lattice,), (body,) = grids, media.bodies
    # A medium with a constant beside its grid has no empty blocks.
    skips_empty = occupied is not None and len(body.view.parts) == 1
    rays_of_block = (occupied if skips_empty else 1) * len(delta)
    fits = [shift for shift in range(MAX_SHIFT + 1) if _count_blocks(lattice, shift) * rays_of_block <= RAY_FRACTION * rays]
    if not fits:
        return None
    shift = fits[0]
    blocks = tuple((n >> shift) + 1 for n in lattice.res)
    n, k = blocks[0] * blocks[1] * blocks[2], len(emitters.sampled)
    coarse = take(lattice, shift, skips_empty)
    block, active = dr.arange(mi.UInt32, n), coarse.is_occupied if skips_empty else dr.full(mi.Bool, True, n)
    weights = dr.full(mi.Float, 1, n * k)
    far = _replace_grid(media, coarse.lattice)
    p = _block_centres(lattice, blocks, shift, block)
    for number in delta:
        tau = optical_depth_towards(far, p, emitters.sampled[number], active)
        dr.scatter(weights, dr.exp(-sum(tau) / len(tau)) + MIN_WEIGHT, block * k + number, active)
    dr.eval(weights)
    return VisibilityCache(weights, blocks, shift, k)


def _count_blocks(lattice: Lattice, shift: int) -> int:
    """Number of blocks."""
    z, y, x = ((n >> shift) + 1 for n in lattice.res)
    return z * y * x


def _replace_grid(media: SceneMedia, lattice: Lattice) -> SceneMedia:
    """The media, with another grid in their only medium."""
    (body,) = media.bodies
    parts = [p if p.is_constant else replace(p, lattice=lattice) for p in body.view.parts]
    other, bodies = copy.copy(media), [Body(replace(body.view, parts=parts), body.box)]
    other.boxed, other.traced = (bodies, []) if body.box is not None else ([], bodies)
    return other


def _block_centres(lattice: Lattice, blocks: tuple[int, int, int], shift: int, index: mi.UInt32) -> mi.Point3f:
    """The centres of blocks in the world."""
    _, y, x = blocks
    at = (index % x, (index // x) % y, index // (x * y))
    # Block b holds the cells from b 2^shift - 1 on; the outermost cells are half as wide. The centre of the last block may lie
    # outside the box, and is clamped.
    half = 0.5 * (1 << shift) - 0.5
    u = [
        dr.clip((mi.Float(a) * (1 << shift) + half) / n, 0.25 / n, 1 - 0.25 / n)
        for a, n in zip(at, lattice.res[::-1], strict=True)
    ]
    return lattice.to_world_points(mi.Vector3f(*u))
