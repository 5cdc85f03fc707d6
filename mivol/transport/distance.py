r"""The mean distance at which a ray is stopped, with its tangent and its transpose.

.. math:: N = \int t\,\sigma T\,dt + t_s T_s, \quad N_{cell} = a \alpha + \Delta \Big(\int_0^1 e^{-\tau(u)} du - e^{-\tau}\Big)

The mean is N over the opacity. In a cell [a, a + D] three Gauss points give the optical depth, and the first and second
Legendre moments (slope and bend) of the extinction; T = exp(-tau u) exp(B (u - u^2) - G (2 u^3 - 3 u^2 + u)) is expanded in
these two, to the orders 2 and 1, about a cell of the same optical depth without them:

.. math:: N_{cell} = a\,\alpha + \Delta \Big(\tau E_1 + B (E_1 - E_2) + \frac{B^2}{2} (E_2 - 2 E_3 + E_4)
          - G (E_1 - 3 E_2 + 2 E_3)\Big)

with E_n(tau) from :mod:`mivol.numerics`. It is exact for a thin cell of any (cubic) extinction, and for a constant one at any
optical depth, so that constants are cells of any length; the error falls as D^6. Nothing is divided by a transmittance or by
an extinction: derivatives are finite everywhere.

Conventions. A body is swept from its far end to its near end: what lies behind a cell is known when it is passed, and no sum
is undone. Distances are counted from ``origin``: with the mean distance itself as origin, the derivative of the mean is
that of N over the opacity, since N is 0. Rows are numbers for each channel, followed by their tangents where these are
asked for.

References: Max 1995 (the integral, with distance as the source); Abramowitz & Stegun 25.4.30 (Gauss points).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.numerics import exp_moments, one_minus_exp
from mivol.transport.field import SumField, share_cells
from mivol.transport.lattice import Cell, Segment, clip, slab, walk
from mivol.transport.medium import Part
from mivol.transport.optical_depth import node_weights
from mivol.transport.path import Reach, Way, visit_boxes
from mivol.transport.score import revisit
from mivol.transport.world import Body, World

__all__ = ["Stop", "backproject_distance", "integrate_distance", "push_distance", "stop_in_cell"]

SPREAD = math.sqrt(15) / 10
"""Distance of the outer Gauss points from the middle of [0, 1]; with the weights 5/18, 8/18, 5/18 exact to degree 5."""

BLACK = 1000.0
"""Stands for an infinite optical depth: exp(-1000) is 0, and 1000 + x - 1000 is x in float64."""


@dataclass
class Stop:
    """What a cell does to a ray that enters it: optical depth, transmittance, and N.

    ``dtau`` and ``dN`` are their derivatives with respect to the extinction at each point that it was given at.
    """

    tau: mi.Float
    T: mi.Float
    N: mi.Float
    dtau: list[mi.Float]
    dN: list[mi.Float]


def stop_in_cell(a: mi.Float, dt: mi.Float, near: mi.Float, middle: mi.Float, far: mi.Float) -> Stop:
    """Integrate t sigma T over a cell.

    Args:
        a: distance of its near end [length].
        dt: its length [length], finite.
        near, middle, far: extinction [1/length] at its three Gauss points.

    Bias: none for a thin cell or a constant extinction; of seventh order in dt for a smooth one; where an extinction rises
        or falls within a cell of large optical depth, at most about that cell.
    """
    sides = near + far
    tau = dt * dr.fma(sides, 5 / 18, middle * (8 / 18))
    slope = dt * (math.sqrt(15) / 6) * (far - near)
    bend = dt * (5 / 9) * dr.fma(middle, -2, sides)
    T = dr.exp(-tau)
    e0, e1, e2, e3, e4, e5 = exp_moments(tau)
    by_slope, by_bend = e1 - e2, -(e1 - 3 * e2 + 2 * e3)
    twice = e2 - 2 * e3 + e4
    mean = tau * e1 + slope * (by_slope + 0.5 * slope * twice) + bend * by_bend
    by_tau = T - e1 - slope * (e2 - e3 + 0.5 * slope * (e3 - 2 * e4 + e5)) + bend * (e2 - 3 * e3 + 2 * e4)
    by_slope += slope * twice

    straight = dt * dr.fma(a, T, dt * by_tau)
    lean, bow = dt * dt * (math.sqrt(15) / 6) * by_slope, dt * dt * (5 / 9) * by_bend
    dN = [straight * (5 / 18) - lean + bow, straight * (8 / 18) - 2 * bow, straight * (5 / 18) + lean + bow]
    return Stop(tau, T, dr.fma(a, tau * e0, dt * mean), [dt * (5 / 18), dt * (8 / 18), dt * (5 / 18)], dN)


def _stop_in_constant(a: mi.Float, b: mi.Float, origin: mi.Float, sigma: mi.Float, on: mi.Bool) -> Stop:
    """A stretch [a, b] of constant extinction; ``b`` may be infinite.

    There N = a + 1/sigma; a medium of extinction 0 that never ends has no derivative, and 0 is returned.
    """
    on = on & (b > a)
    begin = dr.select(on, a - origin, 0)
    stop = stop_in_cell(begin, dr.select(on & dr.isfinite(b), b - a, 0), sigma, sigma, sigma)
    endless = on & ~dr.isfinite(b) & (sigma > 0)
    mean = dr.rcp(dr.select(endless, sigma, 1))
    return Stop(
        dr.select(endless, BLACK, stop.tau),
        dr.select(endless, 0, stop.T),
        dr.select(endless, begin + mean, stop.N),
        [sum(stop.dtau, mi.Float(0))],
        [dr.select(endless, -dr.square(mean), sum(stop.dN, mi.Float(0)))],
    )


# -- One body ----------------------------------------------------------------------------------------------------------


@dataclass
class _Moment:
    """Rows of a stretch by itself: optical depth (in float64, since parts of it are taken off again) and N."""

    tau: list[mi.Float64]
    N: list[mi.Float]




@dataclass
class _Lay:
    """A stretch of a ray in a body: up to ``enter`` and from ``leave`` on there are only constants.

    ``segment`` runs from ``leave`` to ``enter``; it and ``grid`` are None where there is no grid.
    """

    t0: mi.Float
    enter: mi.Float
    leave: mi.Float
    t1: mi.Float
    grid: Part | None
    segment: Segment | None


def _check_grids(body: Body) -> None:
    """Refuse grids that do not share their cells, and an extinction that depends on the direction."""
    if body.view.flakes is not None:
        raise MivolError("the AOV depth was asked for and a medium has the phase function sggx; leave depth out of aovs.")
    grids = [p.lattice for p in body.view.parts if p.lattice is not None]
    for other in grids[1:]:
        if not share_cells(grids[0], other):
            raise MivolError(
                f"the AOV depth was asked for and a medium sums grids of {grids[0].res} and {other.res} voxels (Z, Y, X); "
                "give both the same resolution and to_world, or leave depth out of aovs."
            )


def _lay(body: Body, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float) -> _Lay:
    grids = [p for p in body.view.parts if p.lattice is not None]
    start, end = mi.Float(t0), mi.Float(t1)
    if not grids:
        return _Lay(start, end, end, end, None, None)
    segment = clip(grids[0].lattice, ray.o, -ray.d, -t1, -t0)
    hit = segment.length > 0
    leave = dr.select(hit, -segment.t0, end)
    return _Lay(start, dr.select(hit, leave - segment.length, end), leave, end, grids[0], segment)


def _measure(
    body: Body, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, origin: mi.Float, active: mi.Bool, tangent: bool, skip: bool
) -> _Moment:
    """Rows of a stretch of a body; empty blocks may be skipped where nothing depends on the order of sums."""
    field, lay = body.extinction(ray), _lay(body, ray, t0, t1)
    change = SumField(body.view.parts, body.tangents, mi.Float(1)) if tangent else None
    rows = field.channels * (2 if tangent else 1)
    moment = _Moment([mi.Float64(0) for _ in range(rows)], [mi.Float(0) for _ in range(rows)])
    has_constants = any(p.lattice is None for p in body.view.parts)

    def add_constant(moment: _Moment, a: mi.Float, b: mi.Float) -> _Moment:
        stops = [_stop_in_constant(a, b, origin, s, active) for s in field.constant]
        return _put_in_front(moment, stops, [[d] for d in change.constant] if tangent else [])

    def visit(moment: _Moment, cell: Cell, on: mi.Bool) -> _Moment:
        corners, changes = cell.corners[: len(field.reads)], cell.corners[len(field.reads) :]
        stops = _stops(field, lay, cell, corners, origin, on)
        return _put_in_front(moment, stops, change.along(changes, _points(cell)) if tangent else [])

    if has_constants and lay.grid is not None:
        moment = add_constant(moment, lay.leave, lay.t1)
    if lay.grid is not None:
        reads = field.reads + (change.reads if tangent else [])
        alone = skip and len(field.reads) == 1 and not has_constants
        lattice = lay.grid.lattice if alone else replace(lay.grid.lattice, bounds=None)
        moment = walk(lattice, lay.segment, visit, moment, reads, active)
    if has_constants:
        moment = add_constant(moment, lay.t0, lay.enter)
    return moment


def _stops(field: SumField, lay: _Lay, cell: Cell, corners: list, origin: mi.Float, on: mi.Bool) -> list[Stop]:
    """What a cell of a sweep does, for each channel."""
    begin = (lay.leave - origin) - (cell.s + cell.dt)
    dt = dr.select(on, cell.dt, 0)
    return [stop_in_cell(begin, dt, *sigma) for sigma in field.along(corners, _points(cell))]


def _points(cell: Cell) -> list[mi.Vector3f]:
    """Three Gauss points of a cell's stretch, the one nearest to the camera first: a sweep meets it last."""
    return [dr.fma(cell.step, 0.5 + x, cell.frac) for x in (SPREAD, 0, -SPREAD)]


def _put_in_front(moment: _Moment, stops: list[Stop], changes: list[list[mi.Float]]) -> _Moment:
    """A cell dims all that has been swept so far, and adds its own."""
    tau = [t + mi.Float64(s.tau) for t, s in zip(moment.tau, stops, strict=False)]
    N = [dr.fma(s.T, n, s.N) for n, s in zip(moment.N, stops, strict=False)]
    for c, (s, change) in enumerate(zip(stops, changes, strict=False)):
        dtau, row = _dot(s.dtau, change), len(stops) + c
        tau.append(moment.tau[row] + mi.Float64(dtau))
        N.append(_dot(s.dN, change) + s.T * (moment.N[row] - dtau * moment.N[c]))
    return _Moment(tau, N)


@dataclass
class _Pull:
    """State of a reverse sweep: N of what was swept, optical depth still ahead, derivatives of the constants."""

    N: list[mi.Float]
    ahead: list[mi.Float64]
    constant: list[mi.Float]


def _backproject(
    body: Body,
    ray: mi.Ray3f,
    t0: mi.Float,
    t1: mi.Float,
    origin: mi.Float,
    weight: mi.Float,
    ahead: list[mi.Float64],
    behind: list[mi.Float],
    active: mi.Bool,
) -> None:
    """Add ``weight`` dN/dsigma of a stretch, for each channel of the world, to the gradients of a body.

    Args:
        ahead: optical depth from the camera to the far end of the stretch.
        behind: N of what lies behind the stretch, as the camera sees it.
    """
    field, lay = body.extinction(ray), _lay(body, ray, t0, t1)
    zeros = [mi.Float(0) for _ in range(field.channels)]
    pull = _Pull(list(zeros), [mi.Float64(a) for a in ahead], list(zeros))
    parts = list(zip(body.view.parts, body.gradients, strict=True))
    has_constants = any(p.lattice is None for p in body.view.parts)

    def add_constant(pull: _Pull, a: mi.Float, b: mi.Float) -> _Pull:
        stops = [_stop_in_constant(a, b, origin, s, active) for s in field.constant]
        return _pull_through(pull, stops, weight, behind)[0]

    def visit(pull: _Pull, cell: Cell, on: mi.Bool) -> _Pull:
        stops = _stops(field, lay, cell, cell.corners, origin, on)
        pull, slopes = _pull_through(pull, stops, weight, behind)
        shares = [node_weights(p, cell, lay.grid.lattice.res) for p in _points(cell)]
        corners = [[_dot(g, share) for share in zip(*shares, strict=True)] for g in slopes]
        for part, gradient in parts:
            if part.lattice is not None:
                for c, values in enumerate(_merge(corners, part)):
                    gradient.add(c, cell, values, on)
        return pull

    if has_constants and lay.grid is not None:
        pull = add_constant(pull, lay.leave, lay.t1)
    if lay.grid is not None:
        pull = walk(replace(lay.grid.lattice, bounds=None), lay.segment, visit, pull, field.reads, active)
    if has_constants:
        pull = add_constant(pull, lay.t0, lay.enter)
    for part, gradient in parts:
        if part.lattice is None:
            for c, g in enumerate(_merge(pull.constant, part)):
                dr.scatter_add(gradient, g, mi.UInt32(c), active)


def _pull_through(
    pull: _Pull, stops: list[Stop], weight: mi.Float, behind: list[mi.Float]
) -> tuple[_Pull, list[list[mi.Float]]]:
    """Pass a cell: its derivatives with respect to the extinction, [channel of the body][point]."""
    k = len(stops)
    ahead = [a - mi.Float64(stops[c % k].tau) for c, a in enumerate(pull.ahead)]
    slopes = [[mi.Float(0) for _ in s.dN] for s in stops]
    for c, a in enumerate(ahead):
        stop, P = stops[c % k], weight * _transmittance(a)
        # More extinction here dims what was swept of this body, and what lies behind the body.
        dims = dr.fma(P * stop.T, pull.N[c % k], weight * behind[c])
        slopes[c % k] = [
            g + dr.fma(P, dN, -dims * dtau) for g, dN, dtau in zip(slopes[c % k], stop.dN, stop.dtau, strict=True)
        ]
    N = [dr.fma(s.T, n, s.N) for n, s in zip(pull.N, stops, strict=True)]
    constant = [sum(g, total) for total, g in zip(pull.constant, slopes, strict=True)]
    return _Pull(N, ahead, constant), slopes


def _dot(a: list[mi.Float], b: list[mi.Float]) -> mi.Float:
    return sum((x * y for x, y in zip(a, b, strict=True)), mi.Float(0))


def _transmittance(tau: mi.Float64) -> mi.Float:
    return dr.exp(-mi.Float(dr.maximum(tau, 0)))


def _merge(rows: list, part: Part) -> list:
    """What belongs to the channels of a body (numbers, or lists of them) for those of a part: a grey one gets the sum."""
    if part.channels == len(rows):
        return rows
    return [[sum(r[1:], r[0]) for r in zip(*rows, strict=True)] if isinstance(rows[0], list) else sum(rows[1:], rows[0])]


# -- All bodies along a ray --------------------------------------------------------------------------------------------


@dataclass
class _Boxed:
    """A body in a box as a ray crosses it.

    ``middle`` tells which of two bodies lies in front, since they are disjoint; ``own`` is the body by itself, ``front`` the
    optical depth in front of it, ``seen`` its N and ``behind`` that of all behind it as the camera sees them.
    """

    body: Body
    t0: mi.Float64
    t1: mi.Float64
    on: mi.Bool
    middle: mi.Float64
    own: _Moment
    front: list[mi.Float64]
    seen: list[mi.Float]
    behind: list[mi.Float]


@dataclass
class _Traced:
    """What the stretches found by tracing, which come in the order of the ray, leave behind them.

    ``fronts`` and ``behinds`` are what they add to those of each body in a box; ``reach`` is the largest mean distance.
    """

    tau: list[mi.Float64]
    N: list[mi.Float]
    fronts: list[list[mi.Float64]]
    behinds: list[list[mi.Float]]
    reach: mi.Float


@dataclass
class _Chain:
    """All that stops a ray: bodies in boxes, stretches found by tracing, the surface at the end (``last``), and N of all."""

    boxes: list[_Boxed]
    traced: _Traced
    last: list[mi.Float]
    N: list[mi.Float]


def _link(
    scene: mi.Scene, world: World, way: Way, end: Reach, origin: mi.Float, active: mi.Bool, tangent: bool, skip: bool
) -> _Chain:
    """Measure each body by itself and put them in the order of the ray."""
    for body in world.bodies:
        _check_grids(body)
    k, rows = world.channels, world.channels * (2 if tangent else 1)

    def visit_box(found: list[_Boxed], body: Body, t0: mi.Float64, t1: mi.Float64, on: mi.Bool) -> list[_Boxed]:
        own = _spread(_measure(body, way.ray, t0, t1, origin, on, tangent, skip), body, k)
        middle = _middle(body, way.ray, t0, t1) if len(world.bodies) > 1 else mi.Float64(0)
        return [*found, _Boxed(body, t0, t1, on, middle, own, _zeros(mi.Float64, rows), [], _zeros(mi.Float, rows))]

    boxes = visit_boxes(world, way.ray, way.length, visit_box, [], active)

    def visit_traced(t: _Traced, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> _Traced:
        if body.box is not None:
            return t
        own, middle = _spread(_measure(body, way.ray, t0, t1, origin, on, tangent, skip), body, k), _halfway(t0, t1)
        seen = _see(_add(t.tau, _tau_in_front(boxes, middle, rows)), own.N, k)
        opaque = [one_minus_exp(mi.Float(x)) for x in own.tau[:k]]
        means = [dr.select(a > 0, n / dr.select(a > 0, a, 1), 0) for n, a in zip(own.N, opaque, strict=False)]
        return _Traced(
            _add(t.tau, own.tau),
            _add(t.N, seen),
            [_add(f, _where(middle < b.middle, own.tau)) for f, b in zip(t.fronts, boxes, strict=True)],
            [_add(g, _where(middle > b.middle, seen)) for g, b in zip(t.behinds, boxes, strict=True)],
            dr.maximum(t.reach, _largest(means)),
        )

    traced = _Traced(
        _zeros(mi.Float64, rows),
        _zeros(mi.Float, rows),
        [_zeros(mi.Float64, rows) for _ in boxes],
        [_zeros(mi.Float, rows) for _ in boxes],
        mi.Float(0),
    )
    if world.traced:
        traced = revisit(scene, world, way, visit_traced, traced, active)
    return _order(boxes, traced, way, end, origin, k, rows)


def _order(
    boxes: list[_Boxed], traced: _Traced, way: Way, end: Reach, origin: mi.Float, channels: int, rows: int
) -> _Chain:
    """Find what is in front of and behind each body in a box, and N of the whole ray."""
    for box, front in zip(boxes, traced.fronts, strict=True):
        box.front = _add(front, _tau_in_front(boxes, box.middle, rows))
        box.seen = _see(box.front, box.own.N, channels)
    total = traced.tau
    for box in boxes:
        total = _add(total, box.own.tau)
    wall = [dr.select(end.si.is_valid(), way.length - origin, 0)] * channels
    last = _see(total, wall + _zeros(mi.Float, rows - channels), channels)
    N = _add(traced.N, last)
    for box, behind in zip(boxes, traced.behinds, strict=True):
        N = _add(N, box.seen)
        box.behind = _add(behind, _add(last, _seen_behind(boxes, box.middle, rows)))
    return _Chain(boxes, traced, last, N)


def _tau_in_front(boxes: list[_Boxed], middle: mi.Float64, rows: int) -> list[mi.Float64]:
    """Optical depth of the bodies in boxes in front of a distance."""
    total = _zeros(mi.Float64, rows)
    for box in boxes:
        total = _add(total, _where(box.middle < middle, box.own.tau))
    return total


def _seen_behind(boxes: list[_Boxed], middle: mi.Float64, rows: int) -> list[mi.Float]:
    """N, as the camera sees it, of the bodies in boxes behind a distance."""
    total = _zeros(mi.Float, rows)
    for box in boxes:
        total = _add(total, _where(box.middle > middle, box.seen))
    return total


def _see(front: list[mi.Float64], N: list[mi.Float], channels: int) -> list[mi.Float]:
    """Rows of N behind rows of optical depth."""
    P = [_transmittance(f) for f in front[:channels]]
    seen = [p * n for p, n in zip(P, N, strict=False)]
    changes = zip(P, N, N[channels:], front[channels:], strict=False)
    return seen + [p * (dn - mi.Float(df) * n) for p, n, dn, df in changes]


def _middle(body: Body, ray: mi.Ray3f, t0: mi.Float64, t1: mi.Float64) -> mi.Float64:
    """The middle of the part of a stretch inside a body's box."""
    _, _, t0, t1 = slab(body.rows, (0.0,) * 3, (1.0,) * 3, ray.o, ray.d, t0, t1)
    return _halfway(t0, t1)


def _halfway(t0: mi.Float, t1: mi.Float) -> mi.Float64:
    return 0.5 * (mi.Float64(t0) + mi.Float64(t1))


def _spread(moment: _Moment, body: Body, channels: int) -> _Moment:
    """A grey body's rows for each channel of the world."""
    times = channels // body.view.channels
    return _Moment(*([row for row in rows for _ in range(times)] for rows in (moment.tau, moment.N)))


def _zeros(kind: type, rows: int) -> list:
    return [kind(0) for _ in range(rows)]


def _add(a: list, b: list) -> list:
    return [x + y for x, y in zip(a, b, strict=True)]


def _where(mask: mi.Bool, rows: list) -> list:
    return [dr.select(mask, row, 0) for row in rows]


def _largest(values: list[mi.Float]) -> mi.Float:
    best = values[0]
    for value in values[1:]:
        best = dr.maximum(best, value)
    return best


# -- The integral, its tangent, its transpose --------------------------------------------------------------------------


def integrate_distance(scene: mi.Scene, world: World, way: Way, end: Reach, active: mi.Bool) -> mi.Float:
    """Integrate the distance at which a ray is stopped, mean over channels.

    Args:
        scene: Mitsuba's scene.
        world: its media.
        way: the ray, the medium around its origin, and how far it goes; world space, unit direction.
        end: where it ends; an opaque surface there stops what is left.
        active: lanes to integrate.

    Returns:
        N [length]: the mean distance times the opacity.

    Raises:
        MivolError: a medium that sums grids of two resolutions or places.

    Bias: that of :func:`stop_in_cell`. Cost: a walk of each body.
    """
    return _mean(_link(scene, world, way, end, mi.Float(0), active, tangent=False, skip=True).N)


def push_distance(scene: mi.Scene, world: World, way: Way, end: Reach, origin: mi.Float, active: mi.Bool) -> mi.Float:
    """Tangent of N, distances counted from ``origin``, along that which the world took from the parameters.

    Args:
        scene, world, way, end, active: as :func:`integrate_distance`.
        origin: the mean distance, so that this over the opacity is the tangent of the mean.
    """
    return _mean(_link(scene, world, way, end, origin, active, tangent=True, skip=False).N[world.channels :])


def backproject_distance(
    scene: mi.Scene, world: World, way: Way, end: Reach, origin: mi.Float, weight: mi.Float, active: mi.Bool
) -> None:
    """Add ``weight`` (d loss / d N) times the derivative of N to the gradients of the world: the transpose of the tangent.

    What lies behind a cell is summed, never left over by a subtraction, so a voxel behind an optical depth of 50 gets
    its e^-50. Only between two stretches that were both found by tracing it is what is left over; N being a mean of
    distances behind a known transmittance, that is clamped to what it can be.

    Args:
        scene, world, way, end, active: as :func:`integrate_distance`.
        origin: the mean distance, as in :func:`push_distance`.
        weight: of each lane.

    Cost: two walks of each body, and one packed write of 8 a cell and channel.
    """
    k = world.channels
    chain = _link(scene, world, way, end, origin, active, tangent=False, skip=False)
    w = weight / k
    for box in chain.boxes:
        ahead = _add(box.front, box.own.tau)
        _backproject(box.body, way.ray, box.t0, box.t1, origin, w, ahead, box.behind, box.on)

    def visit(passed: _Moment, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> _Moment:
        if body.box is not None:
            return passed
        own, middle = _spread(_measure(body, way.ray, t0, t1, origin, on, False, False), body, k), _halfway(t0, t1)
        front = _add(passed.tau, _tau_in_front(chain.boxes, middle, k))
        ahead, N = _add(front, own.tau), _add(passed.N, _see(front, own.N, k))
        P = [_transmittance(a) for a in ahead]
        near, far = dr.minimum(t1 - origin, 0), chain.traced.reach
        rest = [dr.clip(n - m, p * near, p * far) for n, m, p in zip(chain.traced.N, N, P, strict=True)]
        behind = _add(rest, _add(chain.last, _seen_behind(chain.boxes, middle, k)))
        _backproject(body, way.ray, t0, t1, origin, w, ahead, behind, on)
        return _Moment(_add(passed.tau, own.tau), N)

    if world.traced:
        revisit(scene, world, way, visit, _Moment(_zeros(mi.Float64, k), _zeros(mi.Float, k)), active)


def _mean(rows: list[mi.Float]) -> mi.Float:
    return sum(rows[1:], rows[0]) / len(rows)
