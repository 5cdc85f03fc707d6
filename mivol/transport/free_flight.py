r"""Where light is scattered towards the camera: a distance along its ray, with the density it was drawn from.

.. math:: p(t) = \frac{W_c}{\sum_c W_c}\, p_c(t), \qquad
          W_c = \overline{T_a (1 - e^{-\tau_c})}\;\frac{\theta_b - \theta_a}{\rho\,(b - a)}

One walk sums the optical depth of the ray and keeps one piece (a cell, or a stretch of constant extinction) in proportion to
its weight: the light that it takes from the ray, mean over the channels, times the mean of 1 / r^2 as seen from the lamp that
was chosen. In the piece the distance is drawn by inverting its exact optical depth, or by equal angles seen from the lamp;
the density of the two together is known, so nothing is biased by the weights being approximate.

Conventions. A probe for derivatives adds ``kappa`` to the extinction: density is then drawn where there is none yet, since
the derivative is not zero there. ``Focus`` tells where a lamp is as seen from a ray; light from infinity has none.

References: Kulla & Fajardo 2012 (equal angles); Miller et al. 2019 (spectral combination of free paths); Chao 1982 (keeping one
of a weighted stream).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.numerics import one_minus_exp
from mivol.transport.dice import roll, start_dice
from mivol.transport.lattice import Cell, box_nodes, clip, read_nodes, split, walk
from mivol.transport.optical_depth import gauss_points
from mivol.transport.path import DARK, Visit
from mivol.transport.world import Body, World

__all__ = ["Event", "Focus", "Lamp", "Pick", "lit_length", "offer", "place", "start_pick", "taken_light"]

NEWTON_STEPS = 8
"""Each doubles the digits; where the extinction vanishes at an end they are halvings, and 2^-8 of a cell holds no light."""


@dataclass
class Focus:
    """A lamp as seen from a ray: it is nearest at ``t0``, at the distance ``rho``; both count where ``finite``."""

    t0: mi.Float
    rho: mi.Float
    finite: mi.Bool

    def angle(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """The angle that [a, a + dt] fills: not a difference of two, which is 0 far away."""
        near, far = a - self.t0, (a - self.t0) + dt
        return dr.atan2(self.rho * dt, dr.fma(near, far, dr.square(self.rho)))

    def mean(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Mean of 1 / (rho^2 + (t - t0)^2) over [a, a + dt]; 1 where the lamp is at infinity."""
        return dr.select(self.finite, self.angle(a, dt) * dr.rcp(self.rho * dt), 1)

    def sample(self, a: mi.Float, dt: mi.Float, u: mi.Float) -> mi.Float:
        """Distance from ``a`` at the share ``u`` of the angle, from the addition theorem of the tangent."""
        x = (a - self.t0) / self.rho
        sin, cos = dr.sincos(u * self.angle(a, dt))
        return dr.clip(self.rho * sin * dr.fma(x, x, 1) / dr.fma(-x, sin, cos), 0, dt)

    def density(self, a: mi.Float, dt: mi.Float, t: mi.Float) -> mi.Float:
        """Density of :meth:`sample` at a distance ``t`` from ``a`` [1/length]."""
        r2 = dr.square(self.rho) + dr.square((a - self.t0) + t)
        return self.rho * dr.rcp(r2 * self.angle(a, dt))


@dataclass
class Lamp:
    """The lamp that was drawn for each lane: its number, the emitter, and where it is (None: all are at infinity)."""

    number: mi.UInt32
    emitter: mi.EmitterPtr
    focus: Focus | None


@dataclass
class Kept:
    """The piece of a ray that was kept so far.

    Attributes:
        weight: of the piece.
        begin, s, dt: it starts ``s`` behind ``begin``, a distance along the ray, and is ``dt`` long.
        front: optical depth in front of it.
        spread: extinction [1/length] that a probe adds there.
        body: number of its body.
        fresh: whether the walk under way has found it.
        chance: state of the generator.
    """

    weight: mi.Float
    begin: mi.Float
    s: mi.Float
    dt: mi.Float
    front: list[mi.Float]
    spread: mi.Float
    body: mi.UInt32
    fresh: mi.Bool
    chance: mi.UInt32


@dataclass
class Pick:
    """What has been walked of a ray, and pieces of it that were kept, each drawn for itself.

    Attributes:
        tau, T: optical depth [1] and transmittance [1] of each channel, of all that was walked.
        total: sum of the weights.
        kept: the pieces.
    """

    tau: list[mi.Float]
    T: list[mi.Float]
    total: mi.Float
    kept: list[Kept]

    def of(self, number: mi.UInt32) -> Kept:
        """One of the pieces in each lane."""
        found = self.kept[0]
        for k, other in enumerate(self.kept[1:], 1):
            found = dr.select(number == k, other, found)
        return found


def start_pick(world: World, u: mi.Float, width: int, count: int = 1) -> Pick:
    """Begin with nothing; ``u`` in [0, 1) seeds the generators of ``count`` pieces."""
    tau, T = [[dr.full(mi.Float, v, width) for _ in range(world.channels)] for v in (0, 1)]
    return Pick(tau, T, dr.zeros(mi.Float, width), [_start_kept(world, start_dice(u, width, k), width) for k in range(count)])


def _start_kept(world: World, chance: mi.UInt32, width: int) -> Kept:
    zero = [dr.zeros(mi.Float, width) for _ in range(5)]
    front = [dr.zeros(mi.Float, width) for _ in range(world.channels)]
    return Kept(*zero[:4], front, zero[4], dr.zeros(mi.UInt32, width), dr.zeros(mi.Bool, width), chance)


def offer(world: World, ray: mi.Ray3f, lamp: Lamp, kappa: float) -> Visit:
    """The visitor that sums optical depth and offers every piece of a ray to a :class:`Pick`.

    Args:
        world: the media.
        ray: world space, unit direction.
        lamp: the lamp that was chosen for each lane.
        kappa: optical depth to add evenly over each body, for probes of derivatives; 0 for an image.

    Cost: as an optical depth, with one exponential and one random number a cell (measured: 1.7 times its time).
    """
    numbers = {id(body): index for index, body in enumerate(world.bodies)}

    def visit(pick: Pick, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> Pick:
        pick = _fly(world, body, ray, t0, t1, lamp, kappa, pick, on)
        for kept in pick.kept:
            kept.body = dr.select(kept.fresh, numbers[id(body)], kept.body)
            kept.fresh = dr.zeros(mi.Bool, dr.width(kept.fresh))
        others = [p for p in body.view.parts if not any(p is q for q in body.flight)]
        if others:
            rest = body.optical_depth(ray, t0, t1, world.channels, on, others)
            pick.tau = [t + r for t, r in zip(pick.tau, rest, strict=True)]
            pick.T = [dr.exp(-t) for t in pick.tau]
        return pick

    return visit


def _fly(
    world: World,
    body: Body,
    ray: mi.Ray3f,
    t0: mi.Float | mi.Float64,
    t1: mi.Float | mi.Float64,
    lamp: Lamp,
    kappa: float,
    pick: Pick,
    on: mi.Bool,
) -> Pick:
    """Offer the pieces of one body, in their order.

    Ends of a box come in float64: seen from 30 box sizes away, a float32 entry errs by 1e-6 of a box.
    """
    field = body.extinction(ray, body.flight)
    grid = next((p.lattice for p in body.flight if p.lattice is not None), None)
    segment = clip(grid, ray.o, ray.d, t0, t1) if grid is not None else None
    filled = segment.length if segment is not None and not field.has_constants else mi.Float(t1 - t0)
    spread = dr.select(dr.isfinite(filled) & (filled > 0), kappa * _inverse(filled), 0) if kappa else None

    def add_constant(pick: Pick, a: mi.Float | mi.Float64, b: mi.Float | mi.Float64) -> Pick:
        sigma, front = world.rows(field.constant), pick.tau
        length = dr.select(on, dr.maximum(mi.Float(b - a), 0), 0)
        dt = lit_length(sigma, length)
        begin, rest = split(a)
        pick = _offer_piece(pick, begin, rest, dt, [s * dt for s in sigma], lamp.focus, None, spread, on & (dt > 0))
        # A length may have no end.
        tau = [f + dr.select(s > 0, s * length, 0) for f, s in zip(front, sigma, strict=True)]
        return replace(pick, tau=tau, T=[dr.exp(-t) for t in tau])

    if segment is None:
        pick = add_constant(pick, t0, t1)
        return _note_spread(pick, spread)
    # Where there is no extinction there is no light, but there is a derivative.
    lattice = replace(grid, gaps=None) if kappa or field.has_constants or len(field.reads) > 1 else grid
    hit = segment.length > 0

    def visit(pick: Pick, cell: Cell, full: mi.Bool) -> Pick:
        half = dr.select(full, 0.5 * cell.dt, 0)
        tau = world.rows([half * (a + b) for a, b in field.along(cell.corners, list(gauss_points(cell)))])
        lit = None if world.shade is None else world.shade.at(cell.lower, lamp.number, full)
        return _offer_piece(pick, segment.t0, segment.t0_rest + cell.s, cell.dt, tau, lamp.focus, lit, spread, full)

    if field.has_constants:
        pick = add_constant(pick, t0, dr.select(hit, segment.start, t1))
    # An image takes no light from behind this depth; derivatives are swept back from the far end, and need all of it.
    until = None if kappa else lambda p: _least_of(p.tau) > DARK
    pick = walk(lattice, segment, visit, pick, field.reads, on, until)
    if field.has_constants:
        pick = add_constant(pick, dr.select(hit, segment.end, t1), t1)
    return _note_spread(pick, spread)


def lit_length(sigma: list[mi.Float], length: mi.Float) -> mi.Float:
    """How far a stretch of constant extinction is worth a look: to the optical depth ``DARK`` of its clearest channel."""
    least = mi.Float(dr.inf)
    for s in sigma:
        least = dr.select(s > 0, dr.minimum(least, s), least)
    return dr.minimum(length, DARK / least)


def _least_of(rows: list[mi.Float]) -> mi.Float:
    least = rows[0]
    for row in rows[1:]:
        least = dr.minimum(least, row)
    return least


def _note_spread(pick: Pick, spread: mi.Float | None) -> Pick:
    if spread is None:
        return pick
    return replace(pick, kept=[replace(k, spread=dr.select(k.fresh, spread, k.spread)) for k in pick.kept])


def _offer_piece(
    pick: Pick,
    begin: mi.Float,
    s: mi.Float,
    dt: mi.Float,
    tau: list[mi.Float],
    focus: Focus | None,
    lit: mi.Float | None,
    spread: mi.Float | None,
    on: mi.Bool,
) -> Pick:
    """Keep a piece with the probability of its weight among all so far."""
    ahead = [a + b for a, b in zip(pick.tau, tau, strict=True)]
    beyond = [dr.exp(-t) for t in ahead]
    weight = mi.Float(0)
    for own, T, T_out in zip(tau, pick.T, beyond, strict=True):
        weight += taken_light(own, T, T_out)
        if spread is not None:
            weight += 0.5 * spread * dt * (T + T_out)
    if focus is not None:
        weight *= focus.mean(begin + s, dt)
    if lit is not None:
        weight *= lit
    # A piece of length 0 has a NaN for its mean angle; a weight beyond float32 would be kept for ever.
    weight = dr.select(on & (dt > 0) & (weight < 1e30), weight, 0)
    total = pick.total + weight
    return Pick(ahead, beyond, total, [_keep(old, weight, total, begin, s, dt, pick.tau) for old in pick.kept])


def _keep(
    old: Kept, weight: mi.Float, total: mi.Float, begin: mi.Float, s: mi.Float, dt: mi.Float, tau: list[mi.Float]
) -> Kept:
    """The new piece in place of the old one, with the probability of its weight."""
    chance, (u,) = roll(old.chance, 1)
    keep = u * total < weight
    return Kept(
        dr.select(keep, weight, old.weight),
        dr.select(keep, begin, old.begin),
        dr.select(keep, s, old.s),
        dr.select(keep, dt, old.dt),
        [dr.select(keep, t, f) for t, f in zip(tau, old.front, strict=True)],
        old.spread,
        old.body,
        old.fresh | keep,
        chance,
    )


def taken_light(tau: mi.Float, T: mi.Float, T_out: mi.Float) -> mi.Float:
    """T (1 - exp(-tau)), to 4e-5 of it: a difference where it keeps its digits, a series elsewhere."""
    series = dr.fma(tau, dr.fma(tau, dr.fma(tau, dr.fma(tau, 1 / 120, -1 / 24), 1 / 6), -1 / 2), 1)
    return dr.select(tau < 0.5, T * tau * series, T - T_out)


@dataclass
class Event:
    """A point of a ray where light may be scattered.

    Attributes:
        t, begin: distance [length], and that at which its piece begins, in float64.
        pdf: density it was drawn from [1/length].
        tau: optical depth [1] in front of it, of each channel, along the bodies in the order of the walk.
        sigma_t: extinction [1/length] there, of each channel.
        body: number of its body.
        on: lanes that have one.
    """

    t: mi.Float64
    begin: mi.Float64
    pdf: mi.Float
    tau: list[mi.Float]
    sigma_t: list[mi.Float]
    body: mi.UInt32
    on: mi.Bool


def place(
    world: World,
    ray: mi.Ray3f,
    pick: Kept,
    total: mi.Float,
    focus: Focus | None,
    kappa: float,
    u: mi.Point2f,
    active: mi.Bool,
) -> Event:
    """Draw a distance in the piece that was kept.

    Args:
        world, ray, focus, kappa: as in :func:`offer`.
        pick: a piece that the walk has kept.
        total: sum of the weights of all pieces.
        u: two numbers in [0, 1).
        active: lanes that may scatter.
    """
    on = active & (pick.weight > 0)
    dt = dr.select(on, pick.dt, 1)
    curve = _curve(world, ray, pick, on)
    whole = [_partial(c, dt, 1) for c in curve]
    front = [dr.exp(-f) for f in pick.front]

    # -- How: by collisions, or evenly (in angle, where a lamp is near) ------------------------------------------------
    by_collision = mi.Float(1)
    if kappa:
        mean = sum(whole) / len(whole)
        by_collision = mean * _inverse(mean + pick.spread * dt)
    if focus is not None:
        by_collision = dr.select(focus.finite, 0.5 * by_collision, by_collision)
    collides = u.x < by_collision
    begin = pick.begin + pick.s
    even = u.y * dt if focus is None else dr.select(focus.finite, focus.sample(begin, dt, u.y), u.y * dt)
    x = dr.select(collides, _invert(curve, whole, front, dt, u), even * dr.rcp(dt))

    # -- The density of both together ------------------------------------------------------------------------------------
    sigma = [dr.maximum(_at(c, x), 0) for c in curve]
    tau = [_partial(c, dt, x) for c in curve]
    taken = sum((f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)), mi.Float(0))
    hits = sum((f * s * dr.exp(-t) for f, s, t in zip(front, sigma, tau, strict=True)), mi.Float(0))
    pdf = by_collision * dr.select(taken > 0, hits / dr.select(taken > 0, taken, 1), 0)
    evenly = dr.rcp(dt)
    if focus is not None:
        evenly = dr.select(focus.finite, focus.density(begin, dt, x * dt), evenly)
    pdf = (pdf + (1 - by_collision) * evenly) * pick.weight / dr.select(on, total, 1)
    start = mi.Float64(pick.begin) + mi.Float64(pick.s)
    t = start + mi.Float64(x) * mi.Float64(dt)
    on &= (pdf > 0) & dr.isfinite(pdf)
    return Event(t, start, dr.select(on, pdf, 1), [f + a for f, a in zip(pick.front, tau, strict=True)], sigma, pick.body, on)


def _curve(world: World, ray: mi.Ray3f, pick: Kept, on: mi.Bool) -> list[list[mi.Float]]:
    """The extinction along the piece that was kept, for each channel: the coefficients of a cubic of [0, 1]."""
    values = [[mi.Float(0) for _ in range(4)] for _ in range(world.channels)]
    for index, body in enumerate(world.bodies):
        here = on & (pick.body == index)
        own = _values_along(world, body, ray, pick, here)
        values = [[dr.select(here, n, v) for n, v in zip(new, old, strict=True)] for new, old in zip(own, values, strict=True)]
    return [_cubic(*v) for v in values]


def _values_along(world: World, body: Body, ray: mi.Ray3f, pick: Kept, on: mi.Bool) -> list[list[mi.Float]]:
    """[channel][point] extinction at 0, 1/3, 2/3 and 1 of the piece that was kept, in one body."""
    field = body.extinction(ray, body.flight)
    constant = [[c] * 4 for c in field.constant]
    lattice = next((p.lattice for p in body.flight if p.lattice is not None), None)
    if lattice is None:
        return _by_point(world, constant)
    start = mi.Float64(pick.begin) + mi.Float64(pick.s)
    segment = clip(lattice, ray.o, ray.d, start, start + mi.Float64(pick.dt))
    # The middle of the piece tells its cell: an end lies in a face, and may be rounded to either side.
    along = segment.d * segment.length
    shift = mi.Vector3i(dr.floor(segment.frac + 0.5 * along))
    cell, frac = segment.cell + shift, segment.frac - mi.Vector3f(shift)
    points = [dr.clip(dr.fma(along, k / 3, frac), 0, 1) for k in range(4)]
    inside = on & (segment.length > 0)
    nodes = box_nodes(cell, dr.full(dr.mask_t(mi.Vector3f), True), lattice.res)
    grid = field.along(read_nodes(field.reads, nodes, inside), points)
    own = [[dr.select(inside, g, k) for g, k in zip(*row, strict=True)] for row in zip(grid, constant, strict=True)]
    return _by_point(world, own)


def _by_point(world: World, values: list[list[mi.Float]]) -> list[list[mi.Float]]:
    """[channel of a body][point] as [channel of the world][point]."""
    return [list(row) for row in zip(*(world.rows([v[k] for v in values]) for k in range(4)), strict=True)]


def _cubic(f0: mi.Float, f1: mi.Float, f2: mi.Float, f3: mi.Float) -> list[mi.Float]:
    """Coefficients of the cubic through values at 0, 1/3, 2/3, 1 (Lagrange)."""
    return [
        f0,
        -5.5 * f0 + 9 * f1 - 4.5 * f2 + f3,
        9 * f0 - 22.5 * f1 + 18 * f2 - 4.5 * f3,
        4.5 * (f3 - f0) + 13.5 * (f1 - f2),
    ]


def _at(c: list[mi.Float], x: mi.Float) -> mi.Float:
    return dr.fma(x, dr.fma(x, dr.fma(x, c[3], c[2]), c[1]), c[0])


def _partial(c: list[mi.Float], dt: mi.Float, x: mi.Float) -> mi.Float:
    """Optical depth from 0 to x."""
    return dr.maximum(dt * x * dr.fma(x, dr.fma(x, dr.fma(x, 0.25 * c[3], c[2] / 3), 0.5 * c[1]), c[0]), 0)


def _invert(curve: list, whole: list[mi.Float], front: list[mi.Float], dt: mi.Float, u: mi.Point2f) -> mi.Float:
    """The share of a piece at which the light that it takes has fallen to the share ``u.y`` of it.

    Of one channel, drawn by what each of them takes, where the extinction is rgb.
    """
    c, tau = curve[0], whole[0]
    if len(curve) > 1:
        shares = [f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)]
        # The digits of u.x that chose the way of drawing are used up; those of u.y are not, but it is wanted whole.
        left = dr.select(sum(shares) > 0, _scramble(u), 0) * sum(shares)
        for k in range(1, len(curve)):
            later = left >= sum(shares[:k])
            c = [dr.select(later, a, b) for a, b in zip(curve[k], c, strict=True)]
            tau = dr.select(later, whole[k], tau)
    goal = _log_share(u.y, tau)
    low, high, x = mi.Float(0), mi.Float(1), dr.clip(goal / dr.maximum(tau, 1e-30), 0, 1)
    for _ in range(NEWTON_STEPS):
        error = _partial(c, dt, x) - goal
        low, high = dr.select(error < 0, x, low), dr.select(error > 0, x, high)
        step = x - error / dr.maximum(dt * _at(c, x), 1e-30)
        # The ends count as inside: a step that is lost in rounding stays at the root, which is one of them by then.
        x = dr.select((step >= low) & (step <= high), step, 0.5 * (low + high))
    return x


def _scramble(u: mi.Point2f) -> mi.Float:
    """A third number in [0, 1) from the bits of two."""
    return roll(mi.UInt32(u.x * (1 << 24)) * mi.UInt32(0x9E3779B9) + mi.UInt32(u.y * (1 << 24)), 1)[1][0]


def _log_share(u: mi.Float, tau: mi.Float) -> mi.Float:
    """-log(1 - u (1 - exp(-tau))): the optical depth at which the share u of what is taken has been taken."""
    x = u * one_minus_exp(tau)
    series = dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, 1 / 6, 1 / 5), 1 / 4), 1 / 3), 1 / 2), 1)
    return dr.minimum(dr.select(x < 0.05, x * series, -dr.log(dr.maximum(1 - x, 1e-37))), tau)


def _inverse(x: mi.Float) -> mi.Float:
    return dr.rcp(dr.maximum(x, 1e-30))
