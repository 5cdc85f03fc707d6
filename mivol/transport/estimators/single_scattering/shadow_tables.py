r"""Optical depth towards the emitters, tabulated over a grid: to guide distance sampling, or in place of shadow rays.

.. math:: w_b = e^{-\overline{\tau}_l(x_b)} + w_0

A *visibility cache* guides distance sampling. Light of an emitter with a single position or direction reaches only parts of a
dense medium, and the extinction along a camera ray does not tell which. The optical depth from the centre of each block of
cells to the emitter does, so distances are drawn in proportion to w_b. It is integrated over a grid as coarse as the blocks.
Shadow rays stay exact, so nothing is biased. The floor ``w_0`` bounds the sample weights in blocks across the edge of a shadow.

A *transmittance grid* holds the optical depth at the nodes of a lattice, and replaces shadow rays; it is biased. Its optical
depth is
interpolated: an interpolated transmittance would be too bright between nodes (by 54 % for a step of 2 in optical depth).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.shadow_rays import NEGLIGIBLE_TAU, trace_shadow_ray
from mivol.transport.media.body import Body
from mivol.transport.media.channels import to_spectrum
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_blocks import CoarseGrid
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice

__all__ = [
    "VisibilityCache",
    "build_visibility_cache",
    "optical_depth_towards",
    "TransmittanceGrid",
    "build_transmittance_grid",
    "measure_transmittance_bias",
]


def optical_depth_towards(media: SceneMedia, body: Body, p: mi.Point3f, emitter: mi.Emitter, active: mi.Bool) -> list[mi.Float]:
    """Optical depth from points in a medium to an emitter with a single position or direction, for each channel [1].

    It is at most ``NEGLIGIBLE_TAU``, its value behind an opaque surface. Inactive lanes have no meaning.
    """
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    medium = dr.select(dr.full(mi.Bool, True, dr.width(p)), mi.MediumPtr(body.view.medium), None)
    direct, _ = emitter.sample_direction(it, mi.Point2f(0.5), active)
    _, clear, tau, _ = trace_shadow_ray(media, p, medium, direct, active)
    return [dr.select(clear, dr.minimum(t, NEGLIGIBLE_TAU), NEGLIGIBLE_TAU) for t in tau]


# -- The visibility cache -----------------------------------------------------------------------------------------------

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
        tau = optical_depth_towards(far, far.bodies[0], p, emitters.sampled[number], active)
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


# -- The transmittance grid ---------------------------------------------------------------------------------------------

INSET = 1e-5
"""Distance from the faces of the box at which the outermost nodes send shadow rays, as a fraction of the box [1]."""


@dataclass
class TransmittanceGrid:
    """Optical depth towards each emitter at the nodes of a lattice over a grid's box.

    Attributes:
        tau: flat (nodes in z, y, x; emitters; channels) [1].
        nodes: number of nodes along z, y, x; the first and the last lie in the faces of the box.
        lattice: the grid.
        emitters, channels: their numbers in ``tau``.
    """

    tau: mi.Float
    nodes: tuple[int, int, int]
    lattice: Lattice
    emitters: int
    channels: int

    def transmittance(self, p: mi.Point3f, number: int, active: mi.Bool) -> mi.Spectrum:
        """exp(-tau) towards one emitter, with tau interpolated trilinearly at a point [1]."""
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
            offset = number * self.channels + c
            corners = [dr.gather(mi.Float, self.tau, k * (self.emitters * self.channels) + offset, active) for k in node]
            rows.append(dr.exp(-interpolate(corners, frac)))
        return to_spectrum(rows)


def build_transmittance_grid(media: SceneMedia, emitters: SceneEmitters, cells: int = 1) -> TransmittanceGrid:
    """Integrate the optical depth from every node of a lattice to every emitter.

    Args:
        media: surfaces, and a single medium with one grid.
        emitters: emitters of the scene, each with a single position or direction.
        cells: number of cells of the grid between two nodes.

    Bias: O(h^2) of tau in the distance h of nodes; a cell across the edge of an opaque shadow leaks light.
    Cost: one shadow ray for each node and emitter.
    """
    (body,) = media.bodies
    lattice = next(p.lattice for p in body.view.parts if p.lattice is not None)
    nodes = tuple(max(2, -(-n // cells) + 1) for n in lattice.res)
    z, y, x = nodes
    index = dr.arange(mi.UInt32, z * y * x)
    at = (index % x, (index // x) % y, index // (x * y))
    # Slightly inside, since a shadow ray in the plane of a face counts as outside the box.
    u = [dr.clip(mi.Float(a) / (m - 1), INSET, 1 - INSET) for a, m in zip(at, (x, y, z), strict=True)]
    p = lattice.to_world_points(mi.Vector3f(*u))
    count, k = len(emitters.sampled), media.channels
    tau = dr.zeros(mi.Float, z * y * x * count * k)
    for number, emitter in enumerate(emitters.sampled):
        for c, row in enumerate(optical_depth_towards(media, body, p, emitter, mi.Bool(True))):
            dr.scatter(tau, row, (index * count + number) * k + c)
    dr.eval(tau)
    return TransmittanceGrid(tau, nodes, lattice, count, k)


def measure_transmittance_bias(
    media: SceneMedia, emitters: SceneEmitters, grid: TransmittanceGrid, points: int = 1 << 14
) -> tuple[float, float]:
    """Compare a transmittance grid with exact shadow rays at points of the grid's box.

    Returns:
        Mean and root mean square of T_grid - T_exact over points and emitters [1]; the extinction weights the points.
    """
    (body,) = media.bodies
    k = mi.Float64(dr.arange(mi.UInt32, points)) + 0.5
    u = [k / points, k * 0.7548776662 - dr.floor(k * 0.7548776662), k * 0.5698402910 - dr.floor(k * 0.5698402910)]
    p = grid.lattice.to_world_points(mi.Vector3f(*(mi.Float(v) for v in u)))
    ray = mi.Ray3f(p, mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    weight = body.extinction_at(ray, mi.Float(0), 1, mi.Bool(True))[0]
    total, first, second = dr.sum(weight), mi.Float(0), mi.Float(0)
    for number, emitter in enumerate(emitters.sampled):
        exact = optical_depth_towards(media, body, p, emitter, mi.Bool(True))
        off = grid.transmittance(p, number, mi.Bool(True))[0] - dr.exp(-exact[0])
        first += dr.sum(weight * off)
        second += dr.sum(weight * off * off)
    scale = dr.rcp(dr.maximum(total * len(emitters.sampled), 1e-30))
    return float((first * scale)[0]), float(dr.sqrt(second * scale)[0])
