"""The exact part of a derivative with a grid control variate: one sweep along a ray from its far end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.distance_reservoir import taken_light
from mivol.transport.estimators.grid_control import GridControl
from mivol.transport.media.body import Body
from mivol.transport.media.ray_intervals import visit_boxed_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, Nodes, box_nodes, read_nodes, walk
from mivol.transport.traversal.interpolation import GAUSS, gauss_points, interpolate, node_weights, upward_frac, weights
from mivol.transport.traversal.lattice import clip, locate

__all__ = ["Probe", "Tracks", "sweep"]


@dataclass
class Probe:
    """What a probe of the rest found on a ray.

    Attributes:
        begin: distance at which the piece that holds it starts.
        t: its own distance.
        source: what a unit of extinction there adds, each track.
        dims: what a unit of optical depth in front of it takes away, each track.
        on: lanes that have one.
    """

    begin: mi.Float64
    t: mi.Float64
    source: list[mi.Float]
    dims: list[mi.Float]
    on: mi.Bool


@dataclass
class Tracks:
    """What is followed along a ray: sums over colours for a gradient, each colour for a tangent.

    Attributes:
        shares: (channel of S, factor) pairs of each track.
        rest: light that all cells of the ray dim, each track.
        tangent: whether tangents are summed; else gradients are added to.
    """

    shares: list[list[tuple[int, mi.Float]]]
    rest: list[mi.Float]
    tangent: bool


@dataclass
class _Sweep:
    """State of a sweep from the far end: light of S behind (as the camera sees it), what is ahead, and tangents."""

    behind: list[mi.Float]
    ahead: list[mi.Float]
    T: list[mi.Float]
    change: list[mi.Float]


def sweep(
    media: SceneMedia,
    control: GridControl,
    ray: mi.Ray3f,
    t_end: mi.Float,
    tau: list[mi.Float],
    tracks: Tracks,
    probe: Probe,
    active: mi.Bool,
) -> list[mi.Float]:
    """Pass all cells of a ray from the far end, with the derivative of its light with respect to the extinction in each.

    Args:
        media: a single body with a single grid.
        control: the source function of its cells.
        ray: world space, unit direction.
        t_end: where the stretch ends [length].
        tau: optical depth of the whole stretch, each channel of the extinction.
        tracks: what is followed.
        probe: what is left to it.
        active: lanes to pass.

    Returns:
        The tangent of each track (zeros for a gradient).

    Cost: one walk, with one packed write of 8 a cell and channel for a gradient.
    """
    (body,) = media.bodies
    (found,) = visit_boxed_media(media, ray, t_end, lambda seen, b, t0, t1, on: [*seen, (t0, t1, on)], [], active)
    t0, t1, on = found
    cells = _pass(media, control, body, ray, t0, t1, tau, tracks, probe, on)
    return [a + b for a, b in zip(cells, _settle(media, body, ray, tracks, probe), strict=True)]


def _pass(
    media: SceneMedia,
    control: GridControl,
    body: Body,
    ray: mi.Ray3f,
    t0: mi.Float64,
    t1: mi.Float64,
    tau: list[mi.Float],
    tracks: Tracks,
    probe: Probe,
    active: mi.Bool,
) -> list[mi.Float]:
    """All cells: what they dim, and what they send to the camera by S."""
    (part,) = body.view.parts
    field = body.extinction(ray)
    lattice = replace(part.lattice, empty_distances=None)
    segment = clip(lattice, ray.o, -ray.d, -t1, -t0)
    # Distances from the far end, where the walk begins: those from the camera would have to be compared in float64.
    begin = mi.Float(-segment.start - probe.begin)
    reads = [*field.reads, Nodes(body.tangents[0], part.channels)] if tracks.tangent else field.reads

    def visit(state: _Sweep, cell: Cell, on: mi.Bool) -> _Sweep:
        points = list(gauss_points(cell))
        half = dr.select(on, 0.5 * cell.dt, 0)
        own = media.rows([half * (a + b) for a, b in field.along(cell.corners[:1], points)])
        near = [dr.maximum(a - o, 0) for a, o in zip(state.ahead, own, strict=True)]
        T_out, T_in = state.T, [dr.exp(-n) for n in near]
        taken = [taken_light(o, i, t) for o, i, t in zip(own, T_in, T_out, strict=True)]
        S = control.at(cell.lower, on)
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
    state = _Sweep(zero, [mi.Float(t) for t in tau], [dr.exp(-t) for t in tau], list(zero))
    return walk(lattice, segment, visit, state, reads, active).change


def _settle(media: SceneMedia, body: Body, ray: mi.Ray3f, tracks: Tracks, probe: Probe) -> list[mi.Float]:
    """The cell of a probe: the point itself, and the part of the cell in front of it."""
    (part,) = body.view.parts
    cell, frac, inside = locate(part.lattice, ray.o, ray.d, probe.t)
    on = inside & probe.on
    length = mi.Float(dr.maximum(probe.t - probe.begin, 0))
    speed = mi.Vector3f(*(mi.Float(sum(row[a] * mi.Float64(ray.d[a]) for a in range(3))) for row in part.lattice.from_world))
    start = dr.clip(frac - speed * length, 0, 1)
    points = [dr.fma(frac - start, g, start) for g in (GAUSS, 1 - GAUSS)]
    if tracks.tangent:
        upward = dr.full(dr.mask_t(mi.Vector3f), True)
        (corners,) = read_nodes([Nodes(body.tangents[0], part.channels)], box_nodes(cell, upward, part.lattice.res), on)
        at = media.rows([interpolate(v, frac) for v in corners])
        front = media.rows([0.5 * length * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in corners])
        k = len(at)
        return [dr.select(on, probe.source[j] * at[j % k] - probe.dims[j] * front[j % k], 0) for j in range(len(probe.source))]
    at, a, b = (weights(upward_frac(p, cell, part.lattice.res)) for p in (frac, *points))
    front = [-0.5 * length * (x + y) for x, y in zip(a, b, strict=True)]
    body.add_to_grid(part, cell, [(probe.source, at), (probe.dims, front)], on)
    return [mi.Float(0) for _ in probe.source]
