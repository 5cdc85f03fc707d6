"""A transmittance grid: optical depth towards emitters at the nodes of a lattice, in place of shadow rays; a biased estimator.

Conventions. Optical depth is stored and interpolated. An interpolated transmittance would be too bright between nodes (by 54 %
for a step of 2 in optical depth).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import SceneEmitters
from mivol.transport.estimators.visibility_cache import tau_towards
from mivol.transport.media.channels import spectrum
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice

__all__ = ["TransmittanceGrid", "build_transmittance_grid", "measure_transmittance_bias"]


INSET = 1e-5
"""Distance inside the box from which the nodes in its faces send shadow rays, as a fraction of the box."""


@dataclass
class TransmittanceGrid:
    """Optical depth towards each emitter at the nodes of a lattice over a grid's box.

    Attributes:
        tau: flat (nodes in z, y, x; emitters; channels).
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
        """exp(-tau) towards one emitter, with tau interpolated trilinearly at a point."""
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
        return spectrum(rows)


def build_transmittance_grid(media: SceneMedia, emitters: SceneEmitters, cells: int = 1) -> TransmittanceGrid:
    """Integrate the optical depth from every node of a lattice to every emitter.

    Args:
        media: surfaces, and a single medium with one grid.
        emitters: of the scene, each with one position or direction.
        cells: number of cells of the grid between two nodes.

    Bias: O(h^2) of tau in the distance h of nodes; a cell across the edge of an opaque shadow leaks light.
    Cost: one shadow ray a node and emitter.
    """
    (body,) = media.bodies
    lattice = next(p.lattice for p in body.view.parts if p.lattice is not None)
    nodes = tuple(max(2, -(-n // cells) + 1) for n in lattice.res)
    z, y, x = nodes
    index = dr.arange(mi.UInt32, z * y * x)
    at = (index % x, (index // x) % y, index // (x * y))
    # A little inside, since a shadow ray in the plane of a face counts as outside the box.
    u = [dr.clip(mi.Float(a) / (m - 1), INSET, 1 - INSET) for a, m in zip(at, (x, y, z), strict=True)]
    p = lattice.place(mi.Vector3f(*u))
    count, k = len(emitters.sampled), media.channels
    tau = dr.zeros(mi.Float, z * y * x * count * k)
    for number, emitter in enumerate(emitters.sampled):
        for c, row in enumerate(tau_towards(media, body, p, emitter)):
            dr.scatter(tau, row, (index * count + number) * k + c)
    dr.eval(tau)
    return TransmittanceGrid(tau, nodes, lattice, count, k)


def measure_transmittance_bias(
    media: SceneMedia, emitters: SceneEmitters, grid: TransmittanceGrid, points: int = 1 << 14
) -> tuple[float, float]:
    """Compare a transmittance grid with exact shadow rays at points of the grid's box.

    Returns:
        Mean of T_grid - T_exact, and its root mean square, over points and emitters; points are weighted by their extinction.
    """
    (body,) = media.bodies
    k = mi.Float64(dr.arange(mi.UInt32, points)) + 0.5
    u = [k / points, k * 0.7548776662 - dr.floor(k * 0.7548776662), k * 0.5698402910 - dr.floor(k * 0.5698402910)]
    p = grid.lattice.place(mi.Vector3f(*(mi.Float(v) for v in u)))
    ray = mi.Ray3f(p, mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    weight = body.extinction_at(ray, mi.Float(0), 1, mi.Bool(True))[0]
    total, first, second = dr.sum(weight), mi.Float(0), mi.Float(0)
    for number, emitter in enumerate(emitters.sampled):
        exact = tau_towards(media, body, p, emitter)
        off = grid.transmittance(p, number, mi.Bool(True))[0] - dr.exp(-exact[0])
        first += dr.sum(weight * off)
        second += dr.sum(weight * off * off)
    scale = dr.rcp(dr.maximum(total * len(emitters.sampled), 1e-30))
    return float((first * scale)[0]), float(dr.sqrt(second * scale)[0])
