"""The exact derivative of a grid control variate, and of a ray's transmittance: one sweep of its cells from the far end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.distance_reservoir import taken_light
from mivol.transport.estimators.grid_control import GridControl
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, find_boxed_intervals
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, Nodes, box_nodes, read_nodes, walk
from mivol.transport.traversal.interpolation import GAUSS, gauss_points, interpolate, node_weights, upward_frac, weights
from mivol.transport.traversal.lattice import clip, locate

__all__ = ["ControlSweep", "Probe", "Tracks"]


@dataclass
class Probe:
    """What a probe estimates of the difference between the true source function and S.

    Attributes:
        begin: distance at which the piece of the ray that holds the probe starts [length], in float64.
        t: its own distance [length], in float64.
        source: derivative of each track by the extinction at the probe.
        dims: minus the derivative of each track by the optical depth in front of the probe.
        on: lanes that have one.
    """

    begin: mi.Float64
    t: mi.Float64
    source: list[mi.Float]
    dims: list[mi.Float]
    on: mi.Bool


@dataclass
class Tracks:
    """The sums that are differentiated: one for each channel of extinction for a gradient, each colour for a tangent.

    Attributes:
        shares: (channel of S, factor) pairs of each track.
        rest: light from behind the ray, which all of its cells dim, of each track.
        tangent: tangents are summed; else derivatives are added to the gradient of the medium.
    """

    shares: list[list[tuple[int, mi.Float]]]
    rest: list[mi.Float]
    tangent: bool


@dataclass
class _Sweep:
    """State of a sweep from the far end.

    Attributes:
        behind: light of S from behind, as the camera sees it, of each track.
        ahead, T: optical depth and transmittance between the camera and the cell, of each channel.
        change: tangent of each track.
    """

    behind: list[mi.Float]
    ahead: list[mi.Float]
    T: list[mi.Float]
    change: list[mi.Float]


@dataclass
class ControlSweep:
    """A ray through a single medium with a single grid, whose derivatives are swept.

    Attributes:
        media: the medium.
        control: the source function S of its cells.
        passed: the ray, and how far it goes.
        tau: optical depth [1] of the whole ray, each channel of the extinction.
        tracks: the sums that are differentiated.
        probe: estimate of what S misses.
    """

    media: SceneMedia
    control: GridControl
    passed: RaySegment
    tau: list[mi.Float]
    tracks: Tracks
    probe: Probe

    def differentiate(self, active: mi.Bool) -> list[mi.Float]:
        """Differentiate the light of a ray with respect to the extinction in each of its cells.

        Returns:
            The tangent of each track; zeros for a gradient, which is added to that of the medium.

        Bias: none. Cost: one walk, with one packed write of 8 a cell and channel for a gradient.
        """
        (interval,) = find_boxed_intervals(self.media, self.passed.ray, self.passed.length, active)
        return [a + b for a, b in zip(self._pass_cells(interval), self._add_probe(), strict=True)]

    def _pass_cells(self, interval: MediumInterval) -> list[mi.Float]:
        """Pass all cells: each adds light of S, and dims what lies behind it."""
        media, body, ray, tracks, probe = self.media, interval.body, self.passed.ray, self.tracks, self.probe
        (part,) = body.view.parts
        extinction = body.extinction(ray)
        lattice = replace(part.lattice, empty_distances=None)
        segment = clip(lattice, ray.o, -ray.d, -interval.t1, -interval.t0)
        # Distances from the far end, where the walk begins: those from the camera would have to be compared in float64.
        begin = mi.Float(-segment.start - probe.begin)
        reads = [*extinction.reads, Nodes(body.tangents[0], part.channels)] if tracks.tangent else extinction.reads

        def visit(state: _Sweep, cell: Cell, on: mi.Bool) -> _Sweep:
            points = list(gauss_points(cell))
            half = dr.select(on, 0.5 * cell.dt, 0)
            own = media.rows([half * (a + b) for a, b in extinction.along(cell.corners[:1], points)])
            near = [dr.maximum(a - o, 0) for a, o in zip(state.ahead, own, strict=True)]
            T_out, T_in = state.T, [dr.exp(-n) for n in near]
            taken = [taken_light(o, i, t) for o, i, t in zip(own, T_in, T_out, strict=True)]
            S = self.control.at(cell.lower, on)
            in_front = cell.s + 0.5 * cell.dt > begin
            slopes, behind = [], []
            for j, shares in enumerate(tracks.shares):
                c = j % len(own)
                source = sum((factor * S[k] for k, factor in shares), mi.Float(0))
                dims = state.behind[j] + tracks.rest[j] + dr.select(in_front, probe.dims[j], 0)
                slopes.append(dr.fma(T_out[c], source, -dims))
                behind.append(dr.fma(taken[c], source, state.behind[j]))
            change = state.change
            if tracks.tangent:
                rows = media.rows([half * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in cell.corners[1]])
                change = [dr.fma(w, rows[j % len(rows)], t) for j, (w, t) in enumerate(zip(slopes, change, strict=True))]
            else:
                a, b = (node_weights(p, cell, lattice.res) for p in points)
                row = [half * (x + y) for x, y in zip(a, b, strict=True)]
                body.add_to_grid(part, cell.lower, [(slopes, row)], on)
            return _Sweep(behind, near, T_in, change)

        zero = [dr.zeros(mi.Float, dr.width(ray)) for _ in tracks.shares]
        state = _Sweep(zero, [mi.Float(t) for t in self.tau], [dr.exp(-t) for t in self.tau], list(zero))
        return walk(lattice, segment, visit, state, reads, interval.active).change

    def _add_probe(self) -> list[mi.Float]:
        """Differentiate the probe: its extinction, and that of the part of its cell in front of it."""
        media, (body,), ray, tracks, probe = self.media, self.media.bodies, self.passed.ray, self.tracks, self.probe
        (part,) = body.view.parts
        cell, frac, inside = locate(part.lattice, ray.o, ray.d, probe.t)
        on = inside & probe.on
        length = mi.Float(dr.maximum(probe.t - probe.begin, 0))
        rows = part.lattice.from_world
        speed = mi.Vector3f(*(mi.Float(sum(row[a] * mi.Float64(ray.d[a]) for a in range(3))) for row in rows))
        start = dr.clip(frac - speed * length, 0, 1)
        points = [dr.fma(frac - start, g, start) for g in (GAUSS, 1 - GAUSS)]
        if tracks.tangent:
            upward = dr.full(dr.mask_t(mi.Vector3f), True)
            (corners,) = read_nodes([Nodes(body.tangents[0], part.channels)], box_nodes(cell, upward, part.lattice.res), on)
            at = media.rows([interpolate(v, frac) for v in corners])
            front = media.rows([0.5 * length * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in corners])
            pairs = zip(probe.source, probe.dims, strict=True)
            return [dr.select(on, s * at[j % len(at)] - d * front[j % len(at)], 0) for j, (s, d) in enumerate(pairs)]
        at, a, b = (weights(upward_frac(p, cell, part.lattice.res)) for p in (frac, *points))
        front = [-0.5 * length * (x + y) for x, y in zip(a, b, strict=True)]
        body.add_to_grid(part, cell, [(probe.source, at), (probe.dims, front)], on)
        return [mi.Float(0) for _ in probe.source]
