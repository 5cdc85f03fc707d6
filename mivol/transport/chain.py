r"""What a ray meets in its order, and what each thing adds: sums over the media along a ray that each cell in front dims.

.. math:: N = \sum_i T_1 \cdots T_{i-1} N_i, \qquad N \leftarrow N_i + T_i N

A rule says what a cell adds (N_i: the distance at which it stops a ray, the light that it sends); the chain puts cells, bodies
and surfaces in the order of the ray, with the tangent and the transpose of the sum.

Conventions. A body is swept from its far end to its near end: what lies behind a cell is known when it is passed, and no sum
is undone. The transpose repeats the very walk that measured the body, so optical depths taken off a float64 sum
are those that went into it. Rows are what is followed (channels, or colours), then their tangents where these are asked for.

References: the sum is the discrete equation of transfer (Max 1995); a sweep back to front is Porter & Duff's ``over``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.numerics import one_minus_exp
from mivol.transport.field import SumField, share_cells
from mivol.transport.lattice import Cell, Lattice, Segment, clip, slab, walk
from mivol.transport.optical_depth import node_weights
from mivol.transport.path import Way, revisit, visit_boxes
from mivol.transport.world import Body, World

__all__ = ["Chain", "Rule", "Site", "Stop", "backproject_chain", "link_chain"]


@dataclass
class Stop:
    """What a cell does to a ray that enters it: optical depth, transmittance, and N, of one row.

    ``dtau`` and ``dN`` are their derivatives with respect to the extinction at each point that it was given at.
    """

    tau: mi.Float
    T: mi.Float
    N: mi.Float
    dtau: list[mi.Float]
    dN: list[mi.Float]


@dataclass
class Site:
    """A stretch of a ray in a body that is taken as one: a cell, or a stretch of constant extinction.

    ``a`` is the distance of its near end from the ray's origin and ``dt`` its length [length]; only a constant may be infinite.
    """

    body: Body
    ray: mi.Ray3f
    a: mi.Float
    dt: mi.Float
    on: mi.Bool


class Rule(Protocol):
    """What a chain sums.

    Attributes:
        rows: how many sums are followed, a multiple of the channels of the extinction.
        points: where a cell wants its extinction, as fractions of its length, nearest to the camera first.
        asked, way_out: what a sentence that refuses a medium says was asked for, and how to do without.
    """

    rows: int
    points: tuple[float, ...]
    asked: str
    way_out: str

    def cell(self, site: Site, sigma: list[list[mi.Float]]) -> list[Stop]:
        """Each row of a cell, from the extinction [row][point]."""

    def constant(self, site: Site, sigma: list[mi.Float]) -> list[Stop]:
        """Each row of a stretch of constant extinction (one derivative)."""

    def pull(self, site: Site, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        """Hand ``weight`` (d loss / d N of each row) on to whatever else N depends on; extinction as in :meth:`cell`."""

    def push(self, site: Site, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        """Tangent of N of each row by whatever else it depends on."""

    def least(self, t1: mi.Float) -> mi.Float | float:
        """A lower bound of what a unit of opacity behind ``t1`` may add."""


def _check(body: Body, rule: Rule) -> None:
    """Refuse grids that do not share their cells, and an extinction that depends on the direction."""
    if body.view.flakes is not None:
        raise MivolError(f"{rule.asked} and a medium has the phase function sggx; {rule.way_out}.")
    grids = [p.lattice for p in body.view.parts if p.lattice is not None]
    for other in grids[1:]:
        if not share_cells(grids[0], other):
            raise MivolError(
                f"{rule.asked} and a medium sums grids of {grids[0].res} and {other.res} voxels (Z, Y, X); "
                f"give both the same resolution and to_world, or {rule.way_out}."
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

    ``segment`` runs from ``leave`` to ``enter``; it and ``lattice`` are None where no grid says where the cells are.
    """

    t0: mi.Float64
    enter: mi.Float64
    leave: mi.Float64
    t1: mi.Float64
    lattice: Lattice | None
    segment: Segment | None


@dataclass
class _Stretch:
    """The stretch [t0, t1] of a ray in a body, with its coefficients and, for a tangent, their changes."""

    world: World
    rule: Rule
    body: Body
    ray: mi.Ray3f
    lay: _Lay
    field: SumField
    change: SumField | None
    active: mi.Bool

    @property
    def has_constants(self) -> bool:
        """Whether there is something outside the grid too, so that no block may be skipped."""
        return self.body.view.glow is not None or any(p.lattice is None for p in self.body.view.parts)

    @property
    def reads(self) -> list:
        """What the walk reads."""
        return self.field.reads + (self.change.reads if self.change else [])

    def site(self, cell: Cell, on: mi.Bool) -> Site:
        """A cell of the walk, which runs towards the camera."""
        return Site(self.body, self.ray, mi.Float(self.lay.leave - mi.Float64(cell.s + cell.dt)), dr.select(on, cell.dt, 0), on)

    def outside(self, a: mi.Float64, b: mi.Float64) -> Site:
        """A stretch [a, b] of constants."""
        on = self.active & (b > a)
        return Site(self.body, self.ray, mi.Float(dr.select(on, a, 0)), mi.Float(dr.select(on, b - a, 0)), on)

    def points(self, cell: Cell) -> list[mi.Vector3f]:
        """The points of a cell, the one nearest to the camera first: a sweep meets it last."""
        return [dr.fma(cell.step, 1 - p, cell.frac) for p in self.rule.points]

    def along(self, field: SumField, corners: list, cell: Cell) -> list[list[mi.Float]]:
        """[row][point] values of a field at the points of a cell."""
        values = field.along(corners, self.points(cell))
        points = [self.rows([row[p] for row in values]) for p in range(len(self.rule.points))]
        return [list(row) for row in zip(*points, strict=True)]

    def changes(self, cell: Cell) -> list[list[mi.Float]]:
        """[row][point] tangents of the extinction."""
        values = self.along(self.change, cell.corners[len(self.field.reads) :], cell)
        turns = self.field.slopes(cell.corners, self.points(cell))
        return values if turns is None else [[v * turn for v, turn in zip(row, turns, strict=True)] for row in values]

    def rows(self, channels: list[mi.Float]) -> list[mi.Float]:
        """Numbers for each channel of a body, for each row of the rule."""
        channels = self.world.rows(channels)
        return [channels[r % len(channels)] for r in range(self.rule.rows)]

    def cell(self, cell: Cell, on: mi.Bool) -> tuple[Site, list[list[mi.Float]], list[Stop]]:
        """A cell, its extinction, and what it does, each row."""
        site = self.site(cell, on)
        sigma = self.along(self.field, cell.corners[: len(self.field.reads)], cell)
        return site, sigma, self.rule.cell(site, sigma)

    def constant(self, a: mi.Float64, b: mi.Float64) -> tuple[Site, list[list[mi.Float]], list[Stop]]:
        """As :meth:`cell`, a stretch of constants."""
        site, sigma = self.outside(a, b), self.rows(self.field.constant)
        return site, [[s] * len(self.rule.points) for s in sigma], self.rule.constant(site, sigma)


def _open(
    world: World, rule: Rule, body: Body, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool, tangent: bool
) -> _Stretch:
    field = body.extinction(ray)
    change = SumField(body.view.parts, body.tangents, mi.Float(1), linear=True) if tangent else None
    return _Stretch(world, rule, body, ray, _lay(body, ray, t0, t1), field, change, active)


def _lay(body: Body, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float) -> _Lay:
    lattice = body.view.guide
    start, end = mi.Float64(t0), mi.Float64(t1)
    if lattice is None:
        return _Lay(start, end, end, end, None, None)
    segment = clip(lattice, ray.o, -ray.d, -t1, -t0)
    hit = segment.length > 0
    leave = dr.select(hit, -segment.start, end)
    return _Lay(start, dr.select(hit, -segment.end, end), leave, end, lattice, segment)


def _measure(stretch: _Stretch, skip: bool) -> _Moment:
    """Rows of a stretch of a body; empty blocks may be skipped where nothing depends on the order of sums."""
    rule, lay, tangent = stretch.rule, stretch.lay, stretch.change is not None
    rows = rule.rows * (2 if tangent else 1)
    moment = _Moment(_zeros(mi.Float64, rows), _zeros(mi.Float, rows))

    def add_constant(moment: _Moment, a: mi.Float64, b: mi.Float64) -> _Moment:
        site, sigma, stops = stretch.constant(a, b)
        if not tangent:
            return _put_in_front(moment, stops, [], [])
        changes = [[d] for d in stretch.rows(stretch.change.constant)]
        return _put_in_front(moment, stops, changes, rule.push(site, sigma))

    def visit(moment: _Moment, cell: Cell, on: mi.Bool) -> _Moment:
        site, sigma, stops = stretch.cell(cell, on)
        if not tangent:
            return _put_in_front(moment, stops, [], [])
        changes = stretch.changes(cell)
        return _put_in_front(moment, stops, changes, rule.push(site, sigma))

    if stretch.has_constants and lay.lattice is not None:
        moment = add_constant(moment, lay.leave, lay.t1)
    if lay.lattice is not None:
        alone = skip and len(stretch.field.reads) == 1 and not stretch.has_constants
        lattice = lay.lattice if alone else replace(lay.lattice, gaps=None)
        moment = walk(lattice, lay.segment, visit, moment, stretch.reads, stretch.active)
    if stretch.has_constants:
        moment = add_constant(moment, lay.t0, lay.enter)
    return moment


def _put_in_front(moment: _Moment, stops: list[Stop], changes: list[list[mi.Float]], pushed: list[mi.Float]) -> _Moment:
    """A cell dims all that has been swept so far, and adds its own."""
    tau = [t + mi.Float64(s.tau) for t, s in zip(moment.tau, stops, strict=False)]
    N = [dr.fma(s.T, n, s.N) for n, s in zip(moment.N, stops, strict=False)]
    for c, (s, change) in enumerate(zip(stops, changes, strict=False)):
        dtau, row = _dot(s.dtau, change), len(stops) + c
        tau.append(moment.tau[row] + mi.Float64(dtau))
        N.append(_dot(s.dN, change) + pushed[c] + s.T * (moment.N[row] - dtau * moment.N[c]))
    return _Moment(tau, N)


@dataclass
class _Pull:
    """State of a reverse sweep: N of what was swept, optical depth still ahead, derivatives of the constants."""

    N: list[mi.Float]
    ahead: list[mi.Float64]
    constant: list[mi.Float]


def _backproject(
    stretch: _Stretch, weight: list[mi.Float], ahead: list[mi.Float64], behind: list[mi.Float]
) -> None:
    """Add ``weight`` dN of a stretch to the gradients of a body.

    Args:
        weight: d loss / d N of each row.
        ahead: optical depth from the camera to the far end of the stretch.
        behind: weight times N of what lies behind the stretch, as the camera sees it.
    """
    rule, lay, body = stretch.rule, stretch.lay, stretch.body
    pull = _Pull(_zeros(mi.Float, rule.rows), [mi.Float64(a) for a in ahead], _zeros(mi.Float, rule.rows))
    grids = [p for p in body.view.parts if p.lattice is not None]
    outside: list[tuple] = []

    def add_constant(pull: _Pull, a: mi.Float64, b: mi.Float64) -> _Pull:
        site, sigma, stops = stretch.constant(a, b)
        pull, _, weights = _pull_through(pull, stops, weight, behind)
        outside.append((site, sigma, weights))
        return pull

    def visit(pull: _Pull, cell: Cell, on: mi.Bool) -> _Pull:
        site, sigma, stops = stretch.cell(cell, on)
        pull, slopes, weights = _pull_through(pull, stops, weight, behind)
        rule.pull(site, sigma, weights)
        points = stretch.points(cell)
        corners = [node_weights(p, cell, lay.lattice.res) for p in points]
        turns = stretch.field.slopes(cell.corners, points)
        if turns is not None:
            slopes = [[g * turn for g, turn in zip(row, turns, strict=True)] for row in slopes]
        by_point = [stretch.world.sums([row[p] for row in slopes]) for p in range(len(corners))]
        for part in grids:
            body.add_to_grid(part, cell.lower, list(zip(by_point, corners, strict=True)), on)
        return pull

    if stretch.has_constants and lay.lattice is not None:
        pull = add_constant(pull, lay.leave, lay.t1)
    if lay.lattice is not None:
        pull = walk(replace(lay.lattice, gaps=None), lay.segment, visit, pull, stretch.field.reads, stretch.active)
    if stretch.has_constants:
        pull = add_constant(pull, lay.t0, lay.enter)
        body.add_to_constants(stretch.world.sums(pull.constant), stretch.active)
    # After the walk: what Dr.Jit pulls back in a loop is lost where the same array was pulled to before it.
    for site, sigma, weights in outside:
        rule.pull(site, sigma, weights)


def _pull_through(
    pull: _Pull, stops: list[Stop], weight: list[mi.Float], behind: list[mi.Float]
) -> tuple[_Pull, list[list[mi.Float]], list[mi.Float]]:
    """Pass a cell: its derivatives with respect to the extinction, [row][point], and those with respect to its own N."""
    ahead = [a - mi.Float64(s.tau) for a, s in zip(pull.ahead, stops, strict=True)]
    weights = [w * _transmittance(a) for w, a in zip(weight, ahead, strict=True)]
    slopes = []
    for s, P, n, b in zip(stops, weights, pull.N, behind, strict=True):
        # More extinction here dims what was swept of this body, and what lies behind the body.
        dims = dr.fma(P * s.T, n, b)
        slopes.append([dr.fma(P, dN, -dims * dtau) for dN, dtau in zip(s.dN, s.dtau, strict=True)])
    N = [dr.fma(s.T, n, s.N) for n, s in zip(pull.N, stops, strict=True)]
    constant = [sum(g, total) for total, g in zip(pull.constant, slopes, strict=True)]
    return _Pull(N, ahead, constant), slopes, weights


def _dot(a: list[mi.Float], b: list[mi.Float]) -> mi.Float:
    return sum((x * y for x, y in zip(a, b, strict=True)), mi.Float(0))


def _transmittance(tau: mi.Float64) -> mi.Float:
    return dr.exp(-mi.Float(dr.maximum(tau, 0)))


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

    ``fronts`` and ``behinds`` are what they add to those of each body in a box; ``reach`` is the largest N of an opaque one.
    """

    tau: list[mi.Float64]
    N: list[mi.Float]
    fronts: list[list[mi.Float64]]
    behinds: list[list[mi.Float]]
    reach: mi.Float


@dataclass
class Chain:
    """All that a ray meets.

    Attributes:
        boxes, traced: bodies in boxes, and stretches found by tracing.
        tau: optical depth of the whole ray, each row (then its tangent).
        last: what the end of the ray adds, as the camera sees it.
        N: the sum, each row (then its tangent).
    """

    boxes: list[_Boxed]
    traced: _Traced
    tau: list[mi.Float64]
    last: list[mi.Float]
    N: list[mi.Float]


def link_chain(
    world: World,
    rule: Rule,
    scene: mi.Scene,
    way: Way,
    end: list[mi.Float],
    active: mi.Bool,
    tangent: bool = False,
    skip: bool = False,
) -> Chain:
    """Measure each body by itself and put them in the order of the ray.

    Args:
        world, scene: the media, and Mitsuba's scene.
        rule: what is summed.
        way: the ray, the medium around its origin, and how far it goes; world space, unit direction.
        end: what the end of the ray adds, each row, by itself.
        active: lanes to follow.
        tangent: follow tangents too, along those that the world took from the parameters.
        skip: pass over empty blocks where the order of sums does not matter.

    Raises:
        MivolError: a medium that sums grids of two resolutions or places, or whose extinction depends on the direction.

    Cost: a walk of each body.
    """
    for body in world.bodies:
        _check(body, rule)
    rows = rule.rows * (2 if tangent else 1)

    def measure(body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> _Moment:
        return _measure(_open(world, rule, body, way.ray, t0, t1, on, tangent), skip)

    def visit_box(found: list[_Boxed], body: Body, t0: mi.Float64, t1: mi.Float64, on: mi.Bool) -> list[_Boxed]:
        middle = _middle(body, way.ray, t0, t1) if len(world.bodies) > 1 else mi.Float64(0)
        own, none = measure(body, t0, t1, on), _zeros(mi.Float, rows)
        return [*found, _Boxed(body, t0, t1, on, middle, own, _zeros(mi.Float64, rows), [], none)]

    boxes = visit_boxes(world, way.ray, way.length, visit_box, [], active)

    def visit_traced(t: _Traced, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> _Traced:
        if body.box is not None:
            return t
        own, middle = measure(body, t0, t1, on), _halfway(t0, t1)
        seen = _see(_add(t.tau, _tau_in_front(boxes, middle, rows)), own.N, rule.rows)
        opaque = [one_minus_exp(mi.Float(x)) for x in own.tau[: rule.rows]]
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
    return _order(boxes, traced, end, rule.rows, rows)


def _order(boxes: list[_Boxed], traced: _Traced, end: list[mi.Float], channels: int, rows: int) -> Chain:
    """Find what is in front of and behind each body in a box, and N of the whole ray."""
    for box, front in zip(boxes, traced.fronts, strict=True):
        box.front = _add(front, _tau_in_front(boxes, box.middle, rows))
        box.seen = _see(box.front, box.own.N, channels)
    total = traced.tau
    for box in boxes:
        total = _add(total, box.own.tau)
    last = _see(total, end + _zeros(mi.Float, rows - channels), channels)
    N = _add(traced.N, last)
    for box, behind in zip(boxes, traced.behinds, strict=True):
        N = _add(N, box.seen)
        box.behind = _add(behind, _add(last, _seen_behind(boxes, box.middle, rows)))
    return Chain(boxes, traced, total, last, N)


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


def backproject_chain(
    world: World,
    rule: Rule,
    scene: mi.Scene,
    way: Way,
    chain: Chain,
    weight: list[mi.Float],
    rest: list[mi.Float],
    active: mi.Bool,
) -> None:
    """Add ``weight`` times the derivative of N to the gradients of the world: the transpose of the tangent.

    What lies behind a cell is summed, never left over by a subtraction, so a voxel behind an optical depth of 50 gets
    its e^-50. Only between two stretches that were both found by tracing it is what is left over; that is clamped to
    what a known transmittance can let through.

    Args:
        world, rule, scene, way, active: as :func:`link_chain`, which made ``chain``.
        weight: d loss / d N of each row.
        rest: what else dims with the whole ray: d loss / d log T of each row, from behind its end.

    Cost: a walk of each body, and one packed write of 8 a cell and channel; stretches found by tracing are walked twice.
    """
    for box in chain.boxes:
        ahead = _add(box.front, box.own.tau)
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, box.behind, rest, strict=True)]
        _backproject(_open(world, rule, box.body, way.ray, box.t0, box.t1, box.on, False), weight, ahead, behind)

    def visit(passed: _Moment, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> _Moment:
        if body.box is not None:
            return passed
        stretch, middle = _open(world, rule, body, way.ray, t0, t1, on, False), _halfway(t0, t1)
        own = _measure(stretch, False)
        front = _add(passed.tau, _tau_in_front(chain.boxes, middle, rule.rows))
        ahead, N = _add(front, own.tau), _add(passed.N, _see(front, own.N, rule.rows))
        P = [_transmittance(a) for a in ahead]
        near, far = rule.least(t1), chain.traced.reach
        left = [dr.clip(n - m, p * near, p * far) for n, m, p in zip(chain.traced.N, N, P, strict=True)]
        seen = _add(left, _add(chain.last, _seen_behind(chain.boxes, middle, rule.rows)))
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, seen, rest, strict=True)]
        _backproject(stretch, weight, ahead, behind)
        return _Moment(_add(passed.tau, own.tau), N)

    if world.traced:
        revisit(scene, world, way, visit, _Moment(_zeros(mi.Float64, rule.rows), _zeros(mi.Float, rule.rows)), active)
