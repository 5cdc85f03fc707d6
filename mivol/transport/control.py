r"""A control variate for derivatives: a rough, cheap source function whose part of the gradient is exact.

.. math:: \frac{d}{d\sigma} \int T \sigma (\alpha L_s)\,dt
          = \frac{d}{d\sigma} \int T \sigma S\,dt + \frac{d}{d\sigma} \int T \sigma (\alpha L_s - S)\,dt

The first term has S constant in a cell, so its integral along a ray is a sum of closed forms,
:math:`\sum_c T_c S_c (1 - e^{-\tau_c})`, and its derivative is one weight for each cell; the second is left to random probes,
whose variance falls with the square of what is left (measured: 6 times less in constant light). Any S is unbiased.

Conventions. S is found on a coarse lattice from a few directions a node, towards the middle of the cameras' rays, and spread
over the cells of the grid; light near a lamp is cut at a few times the mean, since a wrong S costs more than none.

Where the lattice does not serve, S may be one number for all places (:func:`find_level`).

References: Rousselle et al. 2016 (control variates in rendering); the split is for a fixed S the reparameterisation-free
derivative of the equation of transfer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.direct import UNIFORM, Arrival, Draw, arrivals
from mivol.transport.free_flight import taken_light
from mivol.transport.lattice import Cell, Lattice, Nodes, box_nodes, clip, locate, read_nodes, walk
from mivol.transport.optical_depth import GAUSS, gauss_points, interpolate, node_weights, upward_frac, weights
from mivol.transport.path import visit_boxes
from mivol.transport.scatter import albedo
from mivol.transport.world import Body, World

__all__ = ["Control", "Probe", "View", "find_control", "find_level", "sweep"]

STEP = 8
"""Cells between the nodes of the coarse lattice."""

MOST = 33
"""Most nodes along an axis."""

DIRECTIONS = 32
"""Directions at each of its nodes."""

CAP = 4.0
"""Largest S, in means of it: near a lamp it is not constant over a cell, let alone over eight."""


@dataclass
class View:
    """Where the rays of a camera come from: near one point (``eye``), or from ``direction`` where they are spread."""

    eye: mi.Point3f
    spread: mi.Float
    direction: mi.Vector3f

    @classmethod
    def of(cls, ray: mi.Ray3f) -> View:
        """The middle of rays."""
        eye = mi.Point3f(*(dr.mean(ray.o[a] + 0 * ray.d[a]) for a in range(3)))
        spread = dr.sqrt(dr.mean(dr.squared_norm(ray.o - eye) + 0 * ray.d.x))
        direction = dr.normalize(mi.Vector3f(*(dr.mean(ray.d[a]) for a in range(3))) + mi.Vector3f(0, 0, 1e-20))
        return cls(eye, spread, direction)

    def towards(self, p: mi.Point3f) -> mi.Vector3f:
        """The direction in which light travels along a ray of the camera at a point."""
        away = p - self.eye
        return dr.select(dr.norm(away) > 4 * self.spread, dr.normalize(away), self.direction)


@dataclass
class Control:
    """S [radiance] of each cell of a grid: flat (Z + 1, Y + 1, X + 1, channels)."""

    values: mi.Float
    res: tuple[int, int, int]
    channels: int

    def at(self, lower: mi.Vector3i, active: mi.Bool) -> list[mi.Float]:
        """S of the cell behind a node, one number a channel."""
        _, y, x = self.res
        index = mi.UInt32(((lower.z + 1) * (y + 1) + lower.y + 1) * (x + 1) + lower.x + 1) * self.channels
        return [dr.gather(mi.Float, self.values, index + c, active) for c in range(self.channels)]


    def at_point(self, body: Body, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """S at a point of a ray."""
        cell, _, inside = locate(body.view.parts[0].lattice, ray.o, ray.d, t)
        S = self.at(cell, inside & active)
        return S * 3 if self.channels == 1 and not mi.is_monochromatic else S


def find_level(scene: mi.Scene, world: World) -> mi.Spectrum | None:
    r"""A source function S [radiance] that is the same everywhere: the mean albedo times what a constant sky sends.

    The exact part of its gradient is the same number all along a ray, :math:`T(D)\,S`, so it needs no lattice and serves media
    of any number and boundary that have an albedo. None where there is no such medium or no constant sky.
    """
    skies = [e for e in scene.emitters() if e.class_name() == UNIFORM]
    shares = [a for body in world.bodies for a in body.view.albedo]
    if not skies or any(body.view.share is None for body in world.bodies):
        return None
    mean = sum(_mean_of(a) for a in shares) / len(shares)
    return mean * dr.detach(skies[0].eval(dr.zeros(mi.SurfaceInteraction3f)))


def _mean_of(albedo: mi.TensorXf | mi.Float | mi.Color3f) -> mi.Spectrum:
    """Mean over space of an albedo, or of its volume."""
    flat = dr.ravel(dr.detach(albedo))
    n = albedo.shape[-1] if dr.is_tensor_v(albedo) else dr.width(flat)
    of_each = dr.arange(mi.UInt32, dr.width(flat) // n) * n
    rows = [dr.mean(dr.gather(mi.Float, flat, of_each + c)) for c in range(n)]
    return mi.Spectrum(*rows) if len(rows) == 3 and not mi.is_monochromatic else mi.Spectrum(sum(rows) / n)


def find_control(scene: mi.Scene, world: World, body: Body, view: View) -> Control:
    """Find S on a coarse lattice and spread it over the cells of a body's grid.

    Args:
        scene, world: surfaces, lamps and media.
        body: one with a single grid.
        view: the camera.

    Cost: 64 shadow rays for 512 cells at most, and 8 look-ups a cell.
    """
    lattice = body.view.parts[0].lattice
    nodes = [max(2, min(-(-(n + 1) // STEP) + 1, MOST)) for n in lattice.res]
    coarse = _light_of_nodes(scene, world, body, view, lattice, nodes)
    z, y, x = (r + 1 for r in lattice.res)
    index = dr.arange(mi.UInt32, z * y * x)
    cell = [index // (y * x), (index // x) % y, index % x]
    # The middle of a cell, as a share of the grid's box, in steps of the coarse lattice.
    q = [mi.Float(c) / m * (k - 1) for c, m, k in zip(cell, lattice.res, nodes, strict=True)]
    low = [dr.minimum(mi.UInt32(v), k - 2) for v, k in zip(q, nodes, strict=True)]
    frac = mi.Vector3f(*(v - mi.Float(a) for v, a in zip(q[::-1], low[::-1], strict=True)))
    corner = [
        ((low[0] + (b >> 2)) * nodes[1] + low[1] + (b >> 1 & 1)) * nodes[2] + low[2] + (b & 1) for b in range(8)
    ]
    rows = [interpolate([dr.gather(mi.Float, c, k) for k in corner], frac) for c in coarse]
    if isinstance(body.view.share, mi.Volume):
        u = mi.Vector3f(*(mi.Float(c) / m for c, m in zip(cell[::-1], lattice.res[::-1], strict=True)))
        share = albedo(body, _at(lattice.place(u), mi.Vector3f(0, 0, 1)), mi.Bool(True))
    else:
        share = albedo(body, dr.zeros(mi.MediumInteraction3f), mi.Bool(True))
    rows = _merge_equal([row * dr.detach(share[c]) for c, row in enumerate(rows)])
    n = len(rows)
    values = dr.zeros(mi.Float, z * y * x * n)
    for c, row in enumerate(rows):
        dr.scatter(values, row, index * n + c)
    dr.eval(values)
    return Control(values, lattice.res, n)


def _light_of_nodes(
    scene: mi.Scene, world: World, body: Body, view: View, lattice: Lattice, nodes: list[int]
) -> list[mi.Float]:
    """L_s at the nodes of the coarse lattice, towards the camera, one array a channel."""
    z, y, x = nodes
    lane = dr.arange(mi.UInt32, z * y * x * DIRECTIONS)
    node, turn = lane // DIRECTIONS, mi.Float(lane % DIRECTIONS)
    at = [node % x, (node // x) % y, node // (x * y)]
    u = mi.Vector3f(*(mi.Float(a) / (k - 1) for a, k in zip(at, (x, y, z), strict=True)))
    p = lattice.place(u)
    mei = _at(p, view.towards(p))
    mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(lane)), mi.MediumPtr(body.view.medium), None)
    # A lattice of rank 1 (Cranley-Patterson: shifted for each node by its number) over the directions of a node.
    shift = [_fraction(mi.Float(node) * k) for k in (0.7548776, 0.5698403, 0.3819660)]
    first, second = (turn + 0.5) / DIRECTIONS, _fraction(turn * 0.6180340)
    flat = mi.Point2f(_fraction(first + shift[0]), _fraction(second + shift[1]))
    lamps, lobes = _fraction(turn * 0.7548776 + shift[2]), _fraction(turn * 0.5698403)
    draw = Draw(mi.Float(0), mi.Point2f(0), lamps, flat, lobes, flat, mi.Float(0))
    ray = mi.Ray3f(p, -mei.wi, dr.inf, mi.Float(0), mi.Color0f())
    lamp = world.lights.choose(ray, draw.lamp)
    found = arrivals(scene, world, mei, lamp, draw, False, dr.full(mi.Bool, True, dr.width(lane)))
    apart = max(float(np.linalg.norm(lattice.to_world[:3, a])) / (k - 1) for a, k in enumerate((x, y, z)))
    light = sum((_spread(a, apart) for a in found), mi.Spectrum(0))
    dr.eval(light)
    rows = []
    for c in range(dr.size_v(light)):
        mean = dr.block_sum(light[c], DIRECTIONS) / DIRECTIONS
        rows.append(dr.minimum(mean, CAP * dr.mean(mean)))
    dr.eval(rows)
    return rows


def _spread(arrival: Arrival, apart: float) -> mi.Spectrum:
    """What an arrival brings to a node that stands for all within ``apart`` of it: a lamp that is nearer counts as if it were
    that far away, and one in the node itself, whose light has no bound, as dark."""
    value = dr.select(arrival.on, arrival.value, 0)
    return dr.select(dr.isfinite(value), value * dr.minimum(dr.square(arrival.way.length / apart), 1), 0)


def _merge_equal(rows: list[mi.Float]) -> list[mi.Float]:
    """One channel where all are the same; a recording by ``dr.freeze`` cannot look, and keeps them."""
    if dr.flag(dr.JitFlag.FreezingScope) or any(dr.any(row != rows[0]) for row in rows[1:]):
        return rows
    return rows[:1]


def _fraction(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)


def _at(p: mi.Point3f, direction: mi.Vector3f) -> mi.MediumInteraction3f:
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(p))
    mei.p, mei.wi = p, -direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


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
    world: World,
    ray: mi.Ray3f,
    t_end: mi.Float,
    tau: list[mi.Float],
    tracks: Tracks,
    probe: Probe,
    active: mi.Bool,
) -> list[mi.Float]:
    """Pass all cells of a ray from the far end, with the derivative of its light with respect to the extinction in each.

    Args:
        world: of a single body with a single grid, and a control.
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
    (body,) = world.bodies
    (found,) = visit_boxes(world, ray, t_end, lambda seen, b, t0, t1, on: [*seen, (t0, t1, on)], [], active)
    t0, t1, on = found
    cells = _pass(world, body, ray, t0, t1, tau, tracks, probe, on)
    return [a + b for a, b in zip(cells, _settle(world, body, ray, tracks, probe), strict=True)]


def _pass(
    world: World,
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
    field, control = body.extinction(ray), world.control
    lattice = replace(part.lattice, gaps=None)
    segment = clip(lattice, ray.o, -ray.d, -t1, -t0)
    # Distances from the far end, where the walk begins: those from the camera would have to be compared in float64.
    begin = mi.Float(-segment.start - probe.begin)
    reads = [*field.reads, Nodes(body.tangents[0], part.channels)] if tracks.tangent else field.reads

    def visit(state: _Sweep, cell: Cell, on: mi.Bool) -> _Sweep:
        points = list(gauss_points(cell))
        half = dr.select(on, 0.5 * cell.dt, 0)
        own = world.rows([half * (a + b) for a, b in field.along(cell.corners[:1], points)])
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
            rows = world.rows([half * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in cell.corners[1]])
            change = [dr.fma(w, rows[j % len(rows)], t) for j, (w, t) in enumerate(zip(slopes, change, strict=True))]
        else:
            a, b = (node_weights(p, cell, lattice.res) for p in points)
            row = [half * (x + y) for x, y in zip(a, b, strict=True)]
            body.add_to_grid(part, cell.lower, [(slopes, row)], on)
        return _Sweep(behind, near, T_in, change)

    zero = [dr.zeros(mi.Float, dr.width(ray)) for _ in tracks.shares]
    state = _Sweep(zero, [mi.Float(t) for t in tau], [dr.exp(-t) for t in tau], list(zero))
    return walk(lattice, segment, visit, state, reads, active).change


def _settle(world: World, body: Body, ray: mi.Ray3f, tracks: Tracks, probe: Probe) -> list[mi.Float]:
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
        at = world.rows([interpolate(v, frac) for v in corners])
        front = world.rows([0.5 * length * (interpolate(v, points[0]) + interpolate(v, points[1])) for v in corners])
        k = len(at)
        return [dr.select(on, probe.source[j] * at[j % k] - probe.dims[j] * front[j % k], 0) for j in range(len(probe.source))]
    at, a, b = (weights(upward_frac(p, cell, part.lattice.res)) for p in (frac, *points))
    front = [-0.5 * length * (x + y) for x, y in zip(a, b, strict=True)]
    body.add_to_grid(part, cell, [(probe.source, at), (probe.dims, front)], on)
    return [mi.Float(0) for _ in probe.source]
