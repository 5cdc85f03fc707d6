r"""Shadows read from a table of optical depths, in place of shadow rays or with one exact shadow ray a path.

.. math:: L = \frac{w}{w_c}\, f_c\, T_c, \qquad w_k = f_k \max(\hat T_k, T_0), \quad w = \sum_k w_k

A :class:`TransmittanceGrid` holds the optical depth towards each emitter at the nodes of a lattice. The optical depth is
interpolated: an interpolated transmittance would be too bright between nodes (by 54 % for a step of 2 in optical depth).
Shadows from the table alone are biased.

The light of a path in media is the sum of f T over many vertices, and walking a shadow ray takes most of the time of a vertex.
So a path keeps one vertex c of its vertices k, with a probability w_c / w in proportion to its light by the table (weighted
reservoir sampling), and at the end follows the exact shadow ray of this vertex alone. The mean is that of all shadow rays. If
the table is right, w is their sum, so the noise is that of the path. T_0 bounds the weight of light where the table is dark.

References: Chao 1982 (weighted reservoir sampling); Talbot et al. 2005 (resampling in proportion to approximate light).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.kept_rays import KeptRay
from mivol.transport.estimators.lighting.shadow_rays import NEGLIGIBLE_TAU, trace_shadow_ray
from mivol.transport.media.extinction import to_spectrum
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box, evaluated_numbers, map_point
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice
from mivol.transport.traversal.rays import Ray

__all__ = [
    "KeptShadow",
    "TabulatedShadow",
    "TransmittanceGrid",
    "find_sun",
    "measure_transmittance_bias",
    "optical_depth_towards",
    "place_nodes",
]


INSET = 1e-5
"""Distance from the faces of the box at which the outermost nodes send shadow rays, as a fraction of the box [1]."""

SUN_RADIUS = 0.06
"""Angle around the direction of the sun in which its table is used [rad]."""

SUN_DRAWS, SUN_CANDIDATES = 512, 64
"""Number of directions drawn to find the sun of an environment, and number of candidates among these directions."""

MIN_TABLE, UNKNOWN = 0.02, 0.3
"""Least transmittance T_0 that a table may claim, and the transmittance that stands for light from other directions than the
sun's [1]. Any numbers above 0 are unbiased."""


def optical_depth_towards(
    media: SceneMedia, p: mi.Point3f, emitter: mi.Emitter, active: mi.Bool, sun: mi.Vector3f | None = None
) -> list[mi.Float]:
    """Optical depth from points to an emitter, for each channel [1].

    It is at most ``NEGLIGIBLE_TAU``, its value behind an opaque surface. Inactive lanes have no meaning.

    Args:
        media: media and surfaces.
        p: the points.
        emitter: emitter with a single position or direction, or an environment.
        active: lanes to follow.
        sun: direction to follow, for an environment.
    """
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    direct, _ = emitter.sample_direction(it, mi.Point2f(0.5), active)
    if sun is not None:
        direct.p = p + sun * direct.dist
    # A point at the emitter itself has no direction towards it, and no shadow.
    apart = active & dr.any(direct.p != p)
    direct.p = dr.select(apart, direct.p, p + mi.Vector3f(0, 0, 1))
    _, clear, tau, _ = trace_shadow_ray(media, mi.Point3d(p), media.medium_around(p), direct, apart)
    return [dr.select(apart, dr.select(clear, dr.minimum(t, NEGLIGIBLE_TAU), NEGLIGIBLE_TAU), 0) for t in tau]


def find_sun(emitter: mi.Emitter) -> tuple[mi.Vector3f, mi.Float]:
    """The direction around which an environment gives most light, and the share of its light within ``SUN_RADIUS``.

    Estimated from ``SUN_DRAWS`` samples of the emitter.
    """
    k = dr.arange(mi.Float, SUN_DRAWS) + 0.5
    it = dr.zeros(mi.Interaction3f, SUN_DRAWS)
    u = mi.Point2f(k / SUN_DRAWS, k * 0.6180339887 - dr.floor(k * 0.6180339887))
    d = emitter.sample_direction(it, u, True)[0].d
    dr.eval(d)
    pair, each = dr.arange(mi.UInt32, SUN_CANDIDATES * SUN_DRAWS), SUN_DRAWS // SUN_CANDIDATES
    one, other = (dr.gather(mi.Vector3f, d, index) for index in (pair // SUN_DRAWS * each, pair % SUN_DRAWS))
    near = dr.select(dr.dot(one, other) > dr.cos(mi.Float(SUN_RADIUS)), mi.UInt32(1), 0)
    counts = dr.block_sum(near, SUN_DRAWS)
    best = dr.max(counts)
    first = dr.min(dr.select(counts == best, dr.arange(mi.UInt32, SUN_CANDIDATES), SUN_CANDIDATES))
    return dr.gather(mi.Vector3f, d, first * each), mi.Float(best) / SUN_DRAWS


# -- The table ----------------------------------------------------------------------------------------------------------


def place_nodes(corners: np.ndarray, edge: int) -> tuple[tuple[int, int, int], Box]:
    """Place about ``edge``^3 nodes at equal distances in a box along the axes of the world.

    Args:
        corners: corners of the box, (2, 3) [length].
        edge: number of nodes.

    Returns:
        The number of nodes along z, y, x, and the box. A flat box is made thicker: it would have no map from the world.
    """
    size = corners[1] - corners[0]
    box = Box(np.diag([*np.maximum(size, max(1e-6 * size.max(), 1e-30)), 1.0]))
    box.to_world[:3, 3] = corners[0]
    return tuple(max(2, min(2 * edge, round(edge * box.to_world[a, a] / box.edge))) for a in (2, 1, 0)), box


@dataclass
class TransmittanceGrid:
    """Optical depth towards each emitter at the nodes of a lattice over a box.

    Attributes:
        tau: flat (nodes in z, y, x; emitters; channels) [1].
        nodes: number of nodes along z, y, x; the first and the last lie in the faces of the box.
        rows: (3, 4) map from the world to the unit cube of the box.
        emitters, channels: their numbers in ``tau``.
        suns: direction of the table of each emitter, for an environment; None for an emitter of one position or direction.
    """

    tau: mi.Float
    nodes: tuple[int, int, int]
    rows: list[list[mi.Float64]]
    emitters: int
    channels: int
    suns: list[mi.Vector3f | None]

    @classmethod
    def over_lattice(cls, media: SceneMedia, emitters: SceneEmitters, lattice: Lattice, cells: int = 1) -> TransmittanceGrid:
        """Integrate over the box of a grid, with at most ``cells`` cells of the grid between two nodes.

        Args:
            media: media and surfaces.
            emitters: emitters of the scene, each with a single position or direction.
            lattice: the grid.
            cells: number of cells.

        Bias: O(h^2) of tau in the distance h of nodes; a cell across the edge of an opaque shadow leaks light.
        Cost: one shadow ray for each node and emitter.
        """
        nodes = tuple(max(2, -(-n // cells) + 1) for n in lattice.res)
        return cls._integrate(media, emitters, nodes, Box(lattice.to_world))

    @classmethod
    def over_box(cls, media: SceneMedia, emitters: SceneEmitters, corners: np.ndarray, edge: int) -> TransmittanceGrid:
        """Integrate over a box along the axes of the world, with about ``edge``^3 nodes at equal distances.

        Args:
            media: media and surfaces.
            emitters: emitters of the scene; environments count in the direction of their sun.
            corners: corners of the box, (2, 3) [length].
            edge: number of nodes.

        Bias, cost: as of :meth:`over_lattice`.
        """
        return cls._integrate(media, emitters, *place_nodes(corners, edge))

    @classmethod
    def _integrate(
        cls,
        media: SceneMedia,
        emitters: SceneEmitters,
        nodes: tuple[int, int, int],
        box: Box,
    ) -> TransmittanceGrid:
        """Integrate the optical depth from every node in a box to every emitter."""
        z, y, x = nodes
        index = dr.arange(mi.UInt32, z * y * x)
        at = (index % x, (index // x) % y, index // (x * y))
        # Slightly inside, since a shadow ray in the plane of a face counts as outside the box.
        u = [dr.clip(mi.Float(a) / (m - 1), INSET, 1 - INSET) for a, m in zip(at, (x, y, z), strict=True)]
        numbers = evaluated_numbers(box.to_world[:3].ravel())
        p = mi.Point3f(*(map_point(numbers[k : k + 4], u) for k in (0, 4, 8)))
        count, k = len(emitters.sampled), media.channels
        suns = [find_sun(e)[0] if e.is_environment() else None for e in emitters.sampled]
        tau = dr.zeros(mi.Float, z * y * x * count * k)
        for number, (emitter, sun) in enumerate(zip(emitters.sampled, suns, strict=True)):
            for c, row in enumerate(optical_depth_towards(media, p, emitter, mi.Bool(True), sun)):
                dr.scatter(tau, row, (index * count + number) * k + c)
        dr.eval(tau, suns)
        return cls(tau, nodes, box.rows(), count, k, suns)

    def transmittance(self, p: mi.Point3f | mi.Point3d, number: mi.UInt32 | int, active: mi.Bool) -> mi.Spectrum:
        """exp(-tau) towards one emitter, with tau interpolated trilinearly at a point [1]."""
        z, y, x = self.nodes
        q = [mi.Float(dr.clip(map_point(row, p) * (m - 1), 0, m - 1)) for row, m in zip(self.rows, (x, y, z), strict=True)]
        low = [dr.minimum(mi.UInt32(v), m - 2) for v, m in zip(q, (x, y, z), strict=True)]
        frac = mi.Vector3f(*(v - mi.Float(i) for v, i in zip(q, low, strict=True)))
        node = [((low[2] + (b >> 2)) * y + low[1] + (b >> 1 & 1)) * x + low[0] + (b & 1) for b in range(8)]
        channels = []
        for c in range(self.channels):
            offset = number * self.channels + c
            corners = [dr.gather(mi.Float, self.tau, k * (self.emitters * self.channels) + offset, active) for k in node]
            channels.append(dr.exp(-interpolate(corners, frac)))
        return to_spectrum(channels)

    def knows(self, number: mi.UInt32, d: mi.Vector3f) -> mi.Bool:
        """Whether the table holds the direction ``d`` towards an emitter."""
        known = mi.Bool(True)
        for k, sun in enumerate(self.suns):
            if sun is not None:
                known &= (number != k) | (dr.dot(sun, d) > dr.cos(mi.Float(SUN_RADIUS)))
        return known


def measure_transmittance_bias(
    media: SceneMedia, emitters: SceneEmitters, grid: TransmittanceGrid, lattice: Lattice
) -> tuple[float, float]:
    """Compare a transmittance grid with exact shadow rays at points of the box of a medium's grid.

    Returns:
        Mean and root mean square of T_grid - T_exact over points and emitters [1]; the extinction weights the points.
    """
    (body,) = media.bodies
    points = 1 << 14
    k = mi.Float64(dr.arange(mi.UInt32, points)) + 0.5
    u = [k / points, k * 0.7548776662 - dr.floor(k * 0.7548776662), k * 0.5698402910 - dr.floor(k * 0.5698402910)]
    p = lattice.to_world_points(mi.Vector3f(*(mi.Float(v) for v in u)))
    ray = mi.Ray3f(p, mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    weight = body.extinction_at(ray, mi.Float(0), 1, mi.Bool(True))[0]
    total, first, second = dr.sum(weight), mi.Float(0), mi.Float(0)
    for number, emitter in enumerate(emitters.sampled):
        exact = optical_depth_towards(media, p, emitter, mi.Bool(True))
        off = grid.transmittance(p, number, mi.Bool(True))[0] - dr.exp(-exact[0])
        first += dr.sum(weight * off)
        second += dr.sum(weight * off * off)
    scale = dr.rcp(dr.maximum(total * len(emitters.sampled), 1e-30))
    return float((first * scale)[0]), float(dr.sqrt(second * scale)[0])


# -- The kept shadow ray ------------------------------------------------------------------------------------------------


@dataclass
class TabulatedShadow:
    """The shadow of a vertex in a medium, read from a table.

    Attributes:
        p: the vertex.
        target: point of the emitter.
        medium: medium around the vertex.
        T: largest transmittance of a channel by the table [1].
        light: light f of the vertex without its shadow [radiance].
    """

    p: mi.Point3d
    target: mi.Point3f
    medium: mi.MediumPtr
    T: mi.Float
    light: mi.Spectrum

    @classmethod
    def look_up(
        cls,
        grid: TransmittanceGrid,
        p: mi.Point3d,
        medium: mi.MediumPtr,
        direct: mi.DirectionSample3f,
        number: mi.UInt32,
        active: mi.Bool,
    ) -> TabulatedShadow:
        """Read the shadow of a point.

        Args:
            grid: the table.
            p: the point.
            medium: medium around the point.
            direct: Mitsuba's sample of the emitter.
            number: number of the emitter.
            active: lanes to read.
        """
        known = grid.knows(number, direct.d)
        T = dr.maximum(dr.max(grid.transmittance(p, number, active)), MIN_TABLE)
        return cls(p, direct.p, medium, dr.select(known, T, UNKNOWN), mi.Spectrum(1))

    def times(self, factor: mi.Spectrum) -> TabulatedShadow:
        """The shadow with its light multiplied by a factor."""
        return replace(self, light=self.light * factor)


class KeptShadow(KeptRay):
    """A kept shadow ray of a vertex; ``aim`` is the point of the emitter."""

    def offer(self, shadow: TabulatedShadow, chance: mi.Float, active: mi.Bool) -> KeptShadow:
        """Offer another vertex, with its light at the camera; ``chance`` is uniform in [0, 1)."""
        weight = dr.select(active, dr.max(shadow.light) * shadow.T, 0)
        return self.add((shadow.p, shadow.target, shadow.medium, shadow.light), weight, chance)

    def light_at_camera(self, media: SceneMedia, ray: Ray) -> mi.Spectrum:
        """The light of all vertices at the camera, from the kept shadow ray [radiance]."""
        on = self.weight > 0
        direct = dr.zeros(mi.DirectionSample3f, dr.width(self.weight))
        direct.p, direct.time = self.aim, ray.time
        _, clear, _, T = trace_shadow_ray(media, self.p, self.medium, direct, on)
        # Lanes without a ray have no direction, and T of microflakes is NaN there.
        return dr.select(on & clear, self.light_of_all() * T, 0)
