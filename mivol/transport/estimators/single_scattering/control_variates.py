r"""Control variates for derivatives of single scattering: a rough source function S whose derivative is exact.

.. math:: \frac{d}{d\sigma} \int T \sigma (\alpha L_s)\,dt
          = \frac{d}{d\sigma} \int T \sigma S\,dt + \frac{d}{d\sigma} \int T \sigma (\alpha L_s - S)\,dt

On a grid, S is constant in a cell. The first integral along a ray is then a sum of closed forms,
:math:`\sum_c T_c S_c (1 - e^{-\tau_c})`, whose derivative is one weight for each cell, found by one sweep of the cells from the
far end. Random probes estimate the second term; its variance falls with the square of the difference (measured: 6 times less
variance in constant light). The sum is unbiased for any S, as long as S is held fixed in the derivative.

Conventions. A coarse lattice holds estimates of S, from a few directions at each node, for light scattered towards the mean of
the cameras' origins; they are interpolated to the cells of the grid. Light near an emitter is limited to a few times the mean,
since a wrong S adds more variance than S = 0. Scenes without a grid control may have one S for all of space
(:func:`find_constant_control`).

References: Rousselle et al. 2016 (control variates in rendering).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import is_recording
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting, DirectSample
from mivol.transport.estimators.lighting.emitters import UNIFORM_EMITTER, EventSamples, fractional_part
from mivol.transport.estimators.lighting.vertex import MediumVertex
from mivol.transport.estimators.single_scattering.distance_sampling import extinguished_light
from mivol.transport.media.body import Body, eval_albedo
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, find_boxed_intervals
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, NodeArray, corner_nodes, read_nodes, walk_cells
from mivol.transport.traversal.interpolation import (
    GAUSS_POINT,
    fraction_from_lower,
    gauss_points,
    interpolate,
    node_weights,
    trilinear_weights,
)
from mivol.transport.traversal.lattice import Lattice, clip_to_grid, locate_cell
from mivol.transport.traversal.rays import Ray

__all__ = [
    "CameraOrigins",
    "GridControl",
    "build_grid_control",
    "count_nodes",
    "supports_grid_control",
    "find_constant_control",
    "ControlSweep",
    "ProbeDifference",
    "SweepSums",
]


CELLS_PER_NODE = 8
"""Cells between the nodes of the coarse lattice."""

MAX_NODES = 33
"""Largest number of nodes along an axis."""

DIRECTIONS = 32
"""Directions at each node of the coarse lattice."""

MAX_BRIGHTNESS = 4.0
"""Largest S as a multiple of its mean: near an emitter the true source function varies strongly within one cell of the grid,
and S is interpolated over ``CELLS_PER_NODE`` cells."""


# -- One source function on a lattice -----------------------------------------------------------------------------------


@dataclass
class CameraOrigins:
    """The origins of a camera's rays: near one point, or spread over an area (an orthographic camera).

    Attributes:
        eye: mean of the origins.
        spread: root mean square distance of the origins from the mean [length].
        direction: mean direction.
    """

    eye: mi.Point3f
    spread: mi.Float
    direction: mi.Vector3f

    @classmethod
    def of(cls, ray: mi.Ray3f) -> CameraOrigins:
        """The mean origin and direction of rays."""
        eye = mi.Point3f(*(dr.mean(ray.o[a] + 0 * ray.d[a]) for a in range(3)))
        spread = dr.sqrt(dr.mean(dr.squared_norm(ray.o - eye) + 0 * ray.d.x))
        direction = dr.normalize(mi.Vector3f(*(dr.mean(ray.d[a]) for a in range(3))) + mi.Vector3f(0, 0, 1e-20))
        return cls(eye, spread, direction)

    def towards(self, p: mi.Point3f) -> mi.Vector3f:
        """The direction of the camera's ray at a point; the mean direction for a point near spread origins."""
        away = p - self.eye
        return dr.select(dr.norm(away) > 4 * self.spread, dr.normalize(away), self.direction)


@dataclass
class GridControl:
    """A control variate for one grid.

    Attributes:
        values: S of each cell of the grid: flat (Z + 1, Y + 1, X + 1, channels) [radiance]; empty for a sparse grid.
        res: resolution of the grid (Z, Y, X).
        channels: 1 or 3.
        compute: S of a cell (z, y, x) counted from 0, for a sparse grid, which has less memory than its cells.
    """

    values: mi.Float
    res: tuple[int, int, int]
    channels: int
    compute: Callable[[list[mi.UInt32]], list[mi.Float]] | None = None

    def at(self, lower: mi.Vector3i, active: mi.Bool) -> list[mi.Float]:
        """S of the cell with the lower node ``lower``, one number for each channel."""
        if self.compute is not None:
            return self.compute([mi.UInt32(dr.select(active, i + 1, 0)) for i in (lower.z, lower.y, lower.x)])
        _, y, x = self.res
        index = mi.UInt32(((lower.z + 1) * (y + 1) + lower.y + 1) * (x + 1) + lower.x + 1) * self.channels
        return [dr.gather(mi.Float, self.values, index + c, active) for c in range(self.channels)]

    def at_point(self, body: Body, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """S at a point of a ray."""
        cell, _, inside = locate_cell(body.view.parts[0].lattice, ray.o, ray.d, t)
        S = self.at(cell, inside & active)
        return S * 3 if self.channels == 1 and not mi.is_monochromatic else S


def supports_grid_control(media: SceneMedia) -> bool:
    """Whether the media can have a grid control: a single medium in a box, with one grid of extinction and an albedo."""
    parts = [p for b in media.bodies for p in b.view.parts]
    alone = len(parts) == 1 and not media.traced and parts[0].lattice is not None
    return alone and media.bodies[0].view.albedo is not None and not media.phases.has_microflakes


def build_grid_control(direct: DirectLighting, body: Body, origins: CameraOrigins) -> GridControl:
    """Estimate S on a coarse lattice, and interpolate it to the cells of a medium's grid.

    Args:
        direct: estimator of direct light at the nodes.
        body: medium with a single grid.
        origins: origins of the camera rays.

    Cost: at most 64 shadow rays for 512 cells, and 8 look-ups a cell.
    """
    lattice = body.view.parts[0].lattice
    nodes = [count_nodes(n) for n in lattice.res]
    coarse = _estimate_node_light(direct, body, origins, lattice, nodes)

    def compute(cell: list[mi.UInt32]) -> list[mi.Float]:
        # The centre of each cell, in steps of the coarse lattice.
        q = [mi.Float(c) / m * (k - 1) for c, m, k in zip(cell, lattice.res, nodes, strict=True)]
        low = [dr.minimum(mi.UInt32(v), k - 2) for v, k in zip(q, nodes, strict=True)]
        frac = mi.Vector3f(*(v - mi.Float(a) for v, a in zip(q[::-1], low[::-1], strict=True)))
        corner = [((low[0] + (b >> 2)) * nodes[1] + low[1] + (b >> 1 & 1)) * nodes[2] + low[2] + (b & 1) for b in range(8)]
        rows = [interpolate([dr.gather(mi.Float, c, k) for k in corner], frac) for c in coarse]
        if isinstance(body.view.albedo, mi.Volume):
            u = mi.Vector3f(*(mi.Float(c) / m for c, m in zip(cell[::-1], lattice.res[::-1], strict=True)))
            albedo = eval_albedo(body, _interaction_at(lattice.to_world_points(u), mi.Vector3f(0, 0, 1)), mi.Bool(True))
        else:
            albedo = eval_albedo(body, dr.zeros(mi.MediumInteraction3f), mi.Bool(True))
        return [row * dr.detach(albedo[c]) for c, row in enumerate(rows)]

    if lattice.bricks is not None:
        return GridControl(mi.Float(), lattice.res, len(coarse), compute)
    z, y, x = (r + 1 for r in lattice.res)
    index = dr.arange(mi.UInt32, z * y * x)
    rows = _merge_equal(compute([index // (y * x), (index // x) % y, index % x]))
    n = len(rows)
    values = dr.zeros(mi.Float, z * y * x * n)
    for c, row in enumerate(rows):
        dr.scatter(values, row, index * n + c)
    dr.eval(values)
    return GridControl(values, lattice.res, n)


def count_nodes(voxels: int) -> int:
    """Nodes of the coarse lattice along an axis: one every ``CELLS_PER_NODE`` cells, from face to face, and at most
    ``MAX_NODES``.
    """
    cells = voxels + 1
    return min(-(-cells // CELLS_PER_NODE) + 1, MAX_NODES)


def _estimate_node_light(
    direct: DirectLighting, body: Body, origins: CameraOrigins, lattice: Lattice, nodes: list[int]
) -> list[mi.Float]:
    """In-scattered radiance L_s at the nodes of the coarse lattice, towards the camera, one array for each channel."""
    z, y, x = nodes
    lane = dr.arange(mi.UInt32, z * y * x * DIRECTIONS)
    node, turn = lane // DIRECTIONS, mi.Float(lane % DIRECTIONS)
    at = [node % x, (node // x) % y, node // (x * y)]
    u = mi.Vector3f(*(mi.Float(a) / (k - 1) for a, k in zip(at, (x, y, z), strict=True)))
    p = lattice.to_world_points(u)
    mei = _interaction_at(p, origins.towards(p))
    mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(lane)), mi.MediumPtr(body.view.medium), None)
    # A rank-1 lattice over the directions of a node, shifted by the node's number (Cranley-Patterson rotation).
    shift = [fractional_part(mi.Float(node) * k) for k in (0.7548776, 0.5698403, 0.3819660)]
    first, second = (turn + 0.5) / DIRECTIONS, fractional_part(turn * 0.6180340)
    flat = mi.Point2f(fractional_part(first + shift[0]), fractional_part(second + shift[1]))
    which, component = fractional_part(turn * 0.7548776 + shift[2]), fractional_part(turn * 0.5698403)
    samples = EventSamples(mi.UInt32(0), mi.Point2f(0), which, flat, component, flat, mi.Float(0))
    ray = mi.Ray3f(p, -mei.wi, dr.inf, mi.Float(0), mi.Color0f())
    chosen = direct.emitters.choose_emitter(ray, samples.which_emitter)
    everywhere = dr.full(mi.Bool, True, dr.width(lane))
    directs = direct.estimate_in_medium(MediumVertex(direct.media, mei, mi.Point3d(mei.p)), chosen, samples, False, everywhere)
    apart = max(float(np.linalg.norm(lattice.to_world[:3, a])) / (k - 1) for a, k in enumerate((x, y, z)))
    light = sum((_limit_near_light(a, apart) for a in directs), mi.Spectrum(0))
    dr.eval(light)
    rows = []
    for c in range(dr.size_v(light)):
        mean = dr.block_sum(light[c], DIRECTIONS) / DIRECTIONS
        rows.append(dr.minimum(mean, MAX_BRIGHTNESS * dr.mean(mean)))
    dr.eval(rows)
    return rows


def _limit_near_light(sample: DirectSample, apart: float) -> mi.Spectrum:
    """The value of a direct sample at a node representing all points within the distance ``apart``.

    An emitter nearer than ``apart`` counts as if it were at this distance; the infinite light of an emitter at the node counts
    as 0.
    """
    value = dr.select(sample.on, sample.value, 0)
    return dr.select(dr.isfinite(value), value * dr.minimum(dr.square(sample.ray_segment.length / apart), 1), 0)


def _merge_equal(rows: list[mi.Float]) -> list[mi.Float]:
    """One channel if all are the same; a recording by ``dr.freeze`` cannot read the values, and keeps all channels."""
    if is_recording() or any(dr.any(row != rows[0]) for row in rows[1:]):
        return rows
    return rows[:1]


def _interaction_at(p: mi.Point3f, direction: mi.Vector3f) -> mi.MediumInteraction3f:
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(p))
    mei.p, mei.wi = p, -direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


# -- One source function for all of space -------------------------------------------------------------------------------


def find_constant_control(media: SceneMedia) -> mi.Spectrum | None:
    r"""Find the constant source function S: the mean albedo times the radiance of a constant sky [radiance].

    The light of S along a ray is :math:`S (1 - T(D))`, and the derivative by the optical depth of any part of the ray is
    :math:`T(D)\,S`. It needs no lattice, and serves any number of media in any boundaries.

    Returns:
        S; None without a constant sky, or if a medium has ``sigma_s`` in place of an albedo.
    """
    skies = [e for e in media.scene.emitters() if e.class_name() == UNIFORM_EMITTER]
    albedos = [a for body in media.bodies for a in body.view.albedo_arrays]
    if not skies or any(body.view.albedo is None for body in media.bodies):
        return None
    mean = sum(_mean_albedo(a) for a in albedos) / len(albedos)
    return mean * dr.detach(skies[0].eval(dr.zeros(mi.SurfaceInteraction3f)))


def _mean_albedo(albedo: mi.TensorXf | mi.Float | mi.Color3f) -> mi.Spectrum:
    """Mean over space of an albedo, or of its volume [1]."""
    flat = dr.ravel(dr.detach(albedo))
    n = albedo.shape[-1] if dr.is_tensor_v(albedo) else dr.width(flat)
    of_each = dr.arange(mi.UInt32, dr.width(flat) // n) * n
    rows = [dr.mean(dr.gather(mi.Float, flat, of_each + c)) for c in range(n)]
    return mi.Spectrum(*rows) if len(rows) == 3 and not mi.is_monochromatic else mi.Spectrum(sum(rows) / n)


# -- The exact derivative of the lattice, cell by cell ------------------------------------------------------------------


@dataclass
class ProbeDifference:
    """A probe's estimate of the difference between the true source function and S.

    Attributes:
        begin: distance of the start of the piece holding the probe, in float64 [length].
        t: distance of the probe, in float64 [length].
        source: derivative of each sum by the extinction at the probe.
        attenuation: minus the derivative of each sum by the optical depth in front of the probe.
        on: lanes with a probe.
    """

    begin: mi.Float64
    t: mi.Float64
    source: list[mi.Float]
    attenuation: list[mi.Float]
    on: mi.Bool


@dataclass
class SweepSums:
    """The differentiated sums: one for each channel of extinction for a gradient, one for each colour for a tangent.

    Attributes:
        shares: (channel of S, factor) pairs of each sum.
        rest: light from behind the ray, attenuated by all of its cells, for each sum.
        tangent: sum tangents; otherwise add derivatives to the gradient of the medium.
    """

    shares: list[list[tuple[int, mi.Float]]]
    rest: list[mi.Float]
    tangent: bool


@dataclass
class _Sweep:
    """State of a sweep from the far end.

    Attributes:
        behind: light of S from behind, at the camera, for each sum.
        ahead, T: optical depth and transmittance between the camera and the cell, for each channel [1].
        change: tangent of each sum.
    """

    behind: list[mi.Float]
    ahead: list[mi.Float]
    T: list[mi.Float]
    change: list[mi.Float]


@dataclass
class ControlSweep:
    """A ray through a single medium with a single grid, for sweeping its derivatives.

    Attributes:
        media: the medium.
        control: source function S of its cells.
        passed: the ray, with its length.
        tau: optical depth of the whole ray, for each channel of the extinction [1].
        tracks: the differentiated sums.
        probe: estimate of the difference to S.
    """

    media: SceneMedia
    control: GridControl
    passed: RaySegment
    tau: list[mi.Float]
    tracks: SweepSums
    probe: ProbeDifference

    def differentiate(self, active: mi.Bool) -> list[mi.Float]:
        """Differentiate the light of a ray with respect to the extinction in each of its cells.

        Returns:
            The tangent of each sum; zeros for a gradient, which is added to the gradient of the medium.

        Bias: none. Cost: one walk; for a gradient, one packed write of 8 numbers for each cell and channel.
        """
        (interval,) = find_boxed_intervals(self.media, self.passed.ray, self.passed.length, active)
        return [a + b for a, b in zip(self._pass_cells(interval), self._add_probe(), strict=True)]

    def _pass_cells(self, interval: MediumInterval) -> list[mi.Float]:
        """Pass all cells: each adds light of S, and attenuates the light behind it."""
        media, body, ray, tracks, probe = self.media, interval.body, self.passed.ray, self.tracks, self.probe
        (part,) = body.view.parts
        extinction = body.extinction(ray)
        lattice = replace(part.lattice, empty_distances=None)
        segment = clip_to_grid(lattice, ray.o, -ray.d, -interval.t1, -interval.t0)
        # Distances count from the far end, where the walk begins; distances from the camera would need float64.
        begin = mi.Float(-segment.start - probe.begin)
        reads = [*extinction.reads, NodeArray(body.tangents[0], part.channels)] if tracks.tangent else extinction.reads

        def visit(state: _Sweep, cell: Cell, on: mi.Bool) -> _Sweep:
            points = list(gauss_points(cell))
            half = dr.select(on, 0.5 * cell.dt, 0)
            depths = media.to_channels([half * (a + b) for a, b in extinction.along(cell.corners[:1], points)])
            near = [dr.maximum(a - o, 0) for a, o in zip(state.ahead, depths, strict=True)]
            T_out, T_in = state.T, [dr.exp(-n) for n in near]
            extinguished = [extinguished_light(o, i, t) for o, i, t in zip(depths, T_in, T_out, strict=True)]
            S = self.control.at(cell.lower, on)
            in_front = cell.s + 0.5 * cell.dt > begin
            slopes, behind = [], []
            for j, shares in enumerate(tracks.shares):
                c = j % len(depths)
                source = sum((factor * S[k] for k, factor in shares), mi.Float(0))
                attenuated = state.behind[j] + tracks.rest[j] + dr.select(in_front, probe.attenuation[j], 0)
                slopes.append(dr.fma(T_out[c], source, -attenuated))
                behind.append(dr.fma(extinguished[c], source, state.behind[j]))
            change = state.change
            if tracks.tangent:
                rows = media.to_channels(
                    [half * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in cell.corners[1]]
                )
                change = [dr.fma(w, rows[j % len(rows)], t) for j, (w, t) in enumerate(zip(slopes, change, strict=True))]
            else:
                a, b = (node_weights(p, cell, lattice.res) for p in points)
                row = [half * (x + y) for x, y in zip(a, b, strict=True)]
                body.add_to_grid(part, cell.lower, [(slopes, row)], on)
            return _Sweep(behind, near, T_in, change)

        zero = [dr.zeros(mi.Float, dr.width(ray)) for _ in tracks.shares]
        state = _Sweep(zero, [mi.Float(t) for t in self.tau], [dr.exp(-t) for t in self.tau], list(zero))
        return walk_cells(lattice, segment, visit, state, reads, interval.active).change

    def _add_probe(self) -> list[mi.Float]:
        """Differentiate the probe: the extinction at the probe, and in the part of its cell in front of it."""
        media, (body,), ray, tracks, probe = self.media, self.media.bodies, self.passed.ray, self.tracks, self.probe
        (part,) = body.view.parts
        cell, frac, inside = locate_cell(part.lattice, ray.o, ray.d, probe.t)
        on = inside & probe.on
        length = mi.Float(dr.maximum(probe.t - probe.begin, 0))
        rows = part.lattice.from_world
        speed = mi.Vector3f(*(mi.Float(sum(row[a] * mi.Float64(ray.d[a]) for a in range(3))) for row in rows))
        start = dr.clip(frac - speed * length, 0, 1)
        points = [dr.fma(frac - start, g, start) for g in (GAUSS_POINT, 1 - GAUSS_POINT)]
        if tracks.tangent:
            reads = [NodeArray(body.tangents[0], part.channels)]
            (corners,) = read_nodes(reads, corner_nodes(cell, part.lattice, on), on)
            at = media.to_channels([interpolate(v, frac) for v in corners])
            front = media.to_channels([0.5 * length * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in corners])
            pairs = zip(probe.source, probe.attenuation, strict=True)
            return [dr.select(on, s * at[j % len(at)] - d * front[j % len(at)], 0) for j, (s, d) in enumerate(pairs)]
        at, a, b = (trilinear_weights(fraction_from_lower(p, cell, part.lattice.res)) for p in (frac, *points))
        front = [-0.5 * length * (x + y) for x, y in zip(a, b, strict=True)]
        body.add_to_grid(part, cell, [(probe.source, at), (probe.attenuation, front)], on)
        return [mi.Float(0) for _ in probe.source]
