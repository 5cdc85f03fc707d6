r"""A visibility cache: rough transmittance towards emitters for each block of a grid, which guides distance sampling.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

Light of an emitter with one position or one direction reaches only parts of a dense medium, and the extinction along a camera
ray does not tell which. The optical depth from the middle of each block of cells to the emitter does, so distances are drawn in
proportion to w_b. The optical depth is integrated over a grid that is as coarse as the blocks. Shadow rays stay exact, so
nothing is biased. The floor ``w_0`` bounds the sample weights where a block lies across the edge of a shadow.
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
"""w_0, the weight of a block in full shadow: the sample weight of a lit point in it is at most 50 times as large."""

RAY_FRACTION = 0.2
"""Largest number of shadow rays of the cache, as a fraction of those of the image. The smallest blocks that keep to it are
chosen. (Measured: under a directional light on smoke, blocks of 2 cells divide the variance by 2.7, blocks of 4 do nothing;
under a point light on a CT of 256^3, blocks of 4 halve the variance that blocks of 8 leave.)"""

COARSEST = 3
"""log2 of the edge of the largest blocks [cells]; shadows vary too much within larger ones."""

MOST_EMITTERS = 8
"""Largest number of emitters for which a cache is built."""


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
        emitters: of the scene.
        rays: number of shadow rays of the image, which decides how fine a cache pays.
        occupied: fraction of the grid's blocks that are not empty, if only those are needed; None for all blocks.
        take: :func:`coarsen_grid`, or a function that remembers its results.

    Returns:
        The cache; None where no emitter has one position or direction, there are several media or grids or more than
        ``MOST_EMITTERS`` emitters, or the image is too small for a cache to pay.

    Cost: one shadow ray through the coarse grid for each block and emitter.
    """
    grids = [p.lattice for b in media.bodies for p in b.view.parts if p.lattice is not None]
    delta = [k for k, e in enumerate(emitters.sampled) if int(e.flags()) & int(mi.EmitterFlags.Delta)]
    if not media.is_single or len(grids) != 1 or not delta or len(emitters.sampled) > MOST_EMITTERS:
        return None
    (lattice,), (body,) = grids, media.bodies
    # A medium that has a constant beside its grid has no empty blocks.
    lists = occupied is not None and len(body.view.parts) == 1
    rays_of_block = (occupied if lists else 1) * len(delta)
    fits = [shift for shift in range(COARSEST + 1) if _count(lattice, shift) * rays_of_block <= RAY_FRACTION * rays]
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
        p = _middles(lattice, blocks, shift, index)
        for number in delta:
            tau = tau_towards(far, far.bodies[0], p, emitters.sampled[number])
            dr.scatter(weights, dr.exp(-sum(tau) / len(tau)) + FLOOR, index * k + number)
    dr.eval(weights)
    return VisibilityCache(weights, blocks, shift, k)


def _count(lattice: Lattice, shift: int) -> int:
    """Number of blocks."""
    z, y, x = ((n >> shift) + 1 for n in lattice.res)
    return z * y * x


def _with_grid(media: SceneMedia, lattice: Lattice) -> SceneMedia:
    """The media, with the grid of their only medium replaced."""
    (body,) = media.bodies
    parts = [p if p.is_constant else replace(p, lattice=lattice) for p in body.view.parts]
    other, bodies = copy.copy(media), [Body(replace(body.view, parts=parts), body.box)]
    other.boxed, other.traced = (bodies, []) if body.box is not None else ([], bodies)
    return other


def _middles(lattice: Lattice, blocks: tuple[int, int, int], shift: int, index: mi.UInt32) -> mi.Point3f:
    """The middles of blocks in the world."""
    _, y, x = blocks
    at = (index % x, (index // x) % y, index // (x * y))
    # Block b holds the cells from b 2^shift - 1 on, of which the outermost are half as wide. As a fraction of the box, the
    # middle of the last block may lie outside; it is clamped.
    half = 0.5 * (1 << shift) - 0.5
    u = [
        dr.clip((mi.Float(a) * (1 << shift) + half) / n, 0.25 / n, 1 - 0.25 / n)
        for a, n in zip(at, lattice.res[::-1], strict=True)
    ]
    return lattice.place(mi.Vector3f(*u))


def tau_towards(media: SceneMedia, body: Body, p: mi.Point3f, emitter: mi.Emitter) -> list[mi.Float]:
    """Optical depth [1] of each channel from points in a medium to an emitter of one position or direction.

    It is at most ``DARK``, and ``DARK`` where an opaque surface hides the emitter.
    """
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    medium = dr.select(dr.full(mi.Bool, True, dr.width(p)), mi.MediumPtr(body.view.medium), None)
    direct, _ = emitter.sample_direction(it, mi.Point2f(0.5), mi.Bool(True))
    _, clear, tau, _ = shadow_ray(media, p, medium, direct, mi.Bool(True))
    return [dr.select(clear, dr.minimum(t, DARK), DARK) for t in tau]
