r"""Distance sampling for single scattering: a reservoir keeps a piece of the ray in one walk, and a distance is drawn inside
the piece.

.. math:: p(t) = \frac{W_c}{\sum_c W_c}\, p_c(t), \qquad
          W_c = \overline{T_a (1 - e^{-\tau_c})}\;\frac{\theta_b - \theta_a}{\rho\,(b - a)}

The walk sums the optical depth of the ray. It offers every piece c = [a, b] of the ray (a cell, or a region of constant
extinction) to a reservoir, which keeps one piece in proportion to its weight W_c. The weight is the light extinguished in the
piece (mean over the channels), times the mean of 1 / r^2 as seen from the chosen emitter (equiangular sampling), times the
piece's entry in the visibility cache. In the kept piece, the distance is drawn with the density p_c: by inverting the exact
optical depth (free flight), or uniformly in the angle seen from the emitter. If 1 / r^2 varies within a thin piece, the angle
draws nearly all distances, otherwise half of them. The density of both steps together is exact, so any weights give an unbiased
estimate.

Conventions. For derivatives, ``probe_depth`` is added to the optical depth of each medium. Such a probe also samples regions
without extinction, where the derivative is not zero.

References: Chao 1982 (weighted reservoir sampling); Kulla & Fajardo 2012 (equiangular sampling); Miller et al. 2019 (spectral
combination of free paths).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.numerics import minimum, one_minus_exp
from mivol.transport.estimators.lighting.emitters import ChosenEmitter, EquiangularSampler
from mivol.transport.estimators.lighting.shadow_rays import NEGLIGIBLE_TAU
from mivol.transport.estimators.single_scattering.visibility_cache import VisibilityCache
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import ExactExtinction
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, SegmentEnd, revisit_media, visit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, corner_nodes, read_nodes, walk_cells
from mivol.transport.traversal.interpolation import eval_cubic, fit_cubic, gauss_points, integrate_cubic, invert_cubic_integral
from mivol.transport.traversal.lattice import clip_to_grid, points_of_piece, split_float64
from mivol.transport.traversal.random_numbers import draw_pcg32
from mivol.transport.traversal.rays import Ray

__all__ = [
    "MediumEvent",
    "sample_distance",
    "Candidate",
    "DistanceProposal",
    "Reservoir",
    "fill_reservoir",
    "bounded_inverse",
    "lit_length",
    "refill_reservoir",
    "start_reservoir",
    "extinguished_light",
]


MIN_ROUGH_TRANSMITTANCE = 1e-3
"""Smallest transmittance that weighs a piece with a rough optical depth [1]. A ray may pass between dense voxels whose means
stand in its way; light from behind then weighs at most 1000 times as much."""


# -- The reservoir ------------------------------------------------------------------------------------------------------


@dataclass
class DistanceProposal:
    """The ingredients of the distribution of distances along a ray.

    Attributes:
        media: media of the scene.
        ray: ray in world space, with a unit direction.
        chosen: emitter of each lane.
        cache: rough visibility of the emitters; None without a cache.
        probe_depth: optical depth added uniformly over each medium, for probes of derivatives [1]; 0 for an image.
        is_rough: coarse grids stand for the grids of media, where media have them: fewer cells, and an optical depth and an
            extinction of the event that weigh the distance only.
    """

    media: SceneMedia
    ray: Ray
    chosen: ChosenEmitter
    cache: VisibilityCache | None
    probe_depth: float
    is_rough: bool = False

    def parts_of(self, body: Body) -> list[ExactExtinction]:
        """The parts of a medium whose cells are walked."""
        return [p if p.rough is None else p.rough for p in body.flight_parts] if self.is_rough else body.flight_parts

    @property
    def is_exact(self) -> bool:
        """Whether optical depth and extinction of an event are those of the media."""
        return self.media.is_single and not (self.is_rough and any(p.rough for p in self.media.bodies[0].flight_parts))


@dataclass
class Candidate:
    """The piece of a ray held by a reservoir.

    Attributes:
        weight: weight of the piece.
        begin, s, dt: the piece starts at the distance begin + s along the ray and has the length dt [length]; cells deep in a
            grid would lose digits in the sum.
        front: optical depth in front of the piece, for each channel [1].
        probe_sigma: extinction added by a probe [1/length].
        body: index of the medium.
        is_new: whether the piece belongs to the medium of the current walk.
        rng: state of the random number generator.
    """

    weight: mi.Float
    begin: mi.Float
    s: mi.Float
    dt: mi.Float
    front: list[mi.Float]
    probe_sigma: mi.Float
    body: mi.UInt32
    is_new: mi.Bool
    rng: mi.UInt32


@dataclass
class Reservoir:
    """A reservoir of one or more independent candidates, and the sums of the walk.

    Attributes:
        tau, T: optical depth and transmittance of the walked part of the ray, for each channel [1].
        total: total weight of the offered pieces.
        candidates: the kept pieces.
    """

    tau: list[mi.Float]
    T: list[mi.Float]
    total: mi.Float
    candidates: list[Candidate]

    def candidate(self, number: mi.UInt32) -> Candidate:
        """The candidate with an index, which may differ from lane to lane."""
        candidate = self.candidates[0]
        for k, other in enumerate(self.candidates[1:], 1):
            candidate = dr.select(number == k, other, candidate)
        return candidate


def start_reservoir(media: SceneMedia, rngs: list[mi.UInt32]) -> Reservoir:
    """An empty reservoir, with a candidate for each state of a random number generator."""
    width = dr.width(rngs[0])
    tau, T = [[dr.full(mi.Float, v, width) for _ in range(media.channels)] for v in (0, 1)]
    return Reservoir(tau, T, dr.zeros(mi.Float, width), [_start_candidate(media, rng, width) for rng in rngs])


def _start_candidate(media: SceneMedia, rng: mi.UInt32, width: int) -> Candidate:
    zero = [dr.zeros(mi.Float, width) for _ in range(5)]
    front = [dr.zeros(mi.Float, width) for _ in range(media.channels)]
    return Candidate(*zero[:4], front, zero[4], dr.zeros(mi.UInt32, width), dr.zeros(mi.Bool, width), rng)


def fill_reservoir(
    proposal: DistanceProposal, medium: mi.MediumPtr, reservoir: Reservoir, active: mi.Bool
) -> tuple[SegmentEnd, Reservoir]:
    """Follow a ray to the end, sum the optical depth, and offer each cell or region of constant extinction to a reservoir as a
    piece.

    The :class:`Reservoir` keeps one piece for each candidate, in proportion to the light extinguished in the piece.

    Args:
        proposal: the ray and the weights of its pieces.
        medium: medium around the origin of the ray.
        reservoir: reservoir from :func:`start_reservoir`.
        active: lanes to follow.

    Cost: an optical depth, with one exponential and one random number for each cell and candidate (1.7 times its time with one
    candidate).
    """
    return visit_media(proposal.media, proposal.ray, medium, _Filling(proposal).visit, reservoir, active)


def refill_reservoir(proposal: DistanceProposal, passed: RaySegment, reservoir: Reservoir, active: mi.Bool) -> Reservoir:
    """Fill a reservoir as :func:`fill_reservoir` does, along a segment of known length."""
    return revisit_media(proposal.media, passed, _Filling(proposal).visit, reservoir, active)


@dataclass
class _Piece:
    """A piece of a ray offered to a reservoir.

    Attributes:
        begin, s, dt: as in :class:`Candidate`.
        tau: optical depth of the piece, for each channel [1].
        on: lanes with the piece.
    """

    begin: mi.Float
    s: mi.Float
    dt: mi.Float
    tau: list[mi.Float]
    on: mi.Bool


@dataclass
class _Filling:
    """The walk of a reservoir."""

    proposal: DistanceProposal

    def visit(self, reservoir: Reservoir, interval: MediumInterval) -> Reservoir:
        """Offer the pieces of a medium, and sum the optical depth of its parts with other cells."""
        body = interval.body
        reservoir = self._offer_body(reservoir, interval)
        media = self.proposal.media
        number = next(index for index, other in enumerate(media.bodies) if other is body)
        for candidate in reservoir.candidates:
            candidate.body = dr.select(candidate.is_new, number, candidate.body)
            candidate.is_new = dr.zeros(mi.Bool, dr.width(candidate.is_new))
        others = [p for p in body.view.parts if not any(p is q for q in body.flight_parts)]
        if others:
            rest = body.optical_depth(interval, media.channels, others)
            reservoir.tau = [t + r for t, r in zip(reservoir.tau, rest, strict=True)]
            reservoir.T = [dr.exp(-t) for t in reservoir.tau]
        return reservoir

    def _offer_body(self, reservoir: Reservoir, interval: MediumInterval) -> Reservoir:
        """Offer the pieces of a medium, in their order.

        The ends of a box come in float64: seen from 30 box sizes away, a float32 entry has an error of 1e-6 of a box.
        """
        body, t0, t1, on = interval.body, interval.t0, interval.t1, interval.active
        ray, rows, chosen, cache = self.proposal.ray, self.proposal.media.to_channels, self.proposal.chosen, self.proposal.cache
        parts = self.proposal.parts_of(body)
        extinction = body.extinction(ray, parts)
        grid = next((p.lattice for p in parts if p.lattice is not None), None)
        segment = clip_to_grid(grid, ray.o, ray.d, t0, t1) if grid is not None else None
        filled = segment.length if segment is not None and not extinction.has_constants else mi.Float(t1 - t0)
        probe_sigma = self._probe_sigma(filled)

        def add_constant(reservoir: Reservoir, a: mi.Float | mi.Float64, b: mi.Float | mi.Float64) -> Reservoir:
            sigma, front = rows(extinction.constant), reservoir.tau
            length = dr.select(on, dr.maximum(mi.Float(b - a), 0), 0)
            dt = lit_length(sigma, length)
            tau = [s * dt for s in sigma]
            begin, rest = split_float64(a)
            reservoir = self._offer(reservoir, _Piece(begin, rest, dt, tau, on & (dt > 0)), None, probe_sigma)
            # The length may be infinite, and 0 * inf is NaN.
            tau = [f + dr.select(s > 0, s * length, 0) for f, s in zip(front, sigma, strict=True)]
            return replace(reservoir, tau=tau, T=[dr.exp(-t) for t in tau])

        if segment is None:
            reservoir = add_constant(reservoir, t0, t1)
            return _set_probe_sigma(reservoir, probe_sigma)
        # Empty blocks scatter no light, but their derivative is not 0.
        walks_all = self.proposal.probe_depth > 0 or len(extinction.reads) > 1
        lattice = grid.where_derivatives() if walks_all else grid
        if extinction.has_constants:
            lattice = replace(grid, empty_distances=None)
        hit = segment.length > 0

        def visit(reservoir: Reservoir, cell: Cell, full: mi.Bool) -> Reservoir:
            half = dr.select(full, 0.5 * cell.dt, 0)
            tau = rows([half * (a + b) for a, b in extinction.along(cell.corners, list(gauss_points(cell)))])
            lit = None if cache is None else cache.at(cell.lower, chosen.number, full)
            return self._offer(reservoir, _Piece(segment.t0, segment.t0_rest + cell.s, cell.dt, tau, full), lit, probe_sigma)

        if extinction.has_constants:
            reservoir = add_constant(reservoir, t0, dr.select(hit, segment.start, t1))
        # Light from beyond NEGLIGIBLE_TAU does not matter in an image. Derivatives need the whole optical depth, since their
        # sweep starts at the far end. A rough optical depth may be far above the true one.
        whole = self.proposal.probe_depth or self.proposal.is_rough
        until = None if whole else lambda p: minimum(p.tau) > NEGLIGIBLE_TAU
        reservoir = walk_cells(lattice, segment, visit, reservoir, extinction.reads, on, until)
        if extinction.has_constants:
            reservoir = add_constant(reservoir, dr.select(hit, segment.end, t1), t1)
        return _set_probe_sigma(reservoir, probe_sigma)

    def _probe_sigma(self, length: mi.Float) -> mi.Float | None:
        """Extinction added by a probe over a length [1/length]; None in images."""
        if not self.proposal.probe_depth:
            return None
        return dr.select(dr.isfinite(length) & (length > 0), self.proposal.probe_depth * bounded_inverse(length), 0)

    def _offer(self, reservoir: Reservoir, piece: _Piece, lit: mi.Float | None, probe_sigma: mi.Float | None) -> Reservoir:
        """Offer a piece to each candidate; ``lit`` is its entry in the visibility cache."""
        equiangular, dt = self.proposal.chosen.equiangular, piece.dt
        ahead = [a + b for a, b in zip(reservoir.tau, piece.tau, strict=True)]
        beyond = [dr.exp(-t) for t in ahead]
        weight = mi.Float(0)
        for tau, T, T_out in zip(piece.tau, reservoir.T, beyond, strict=True):
            extinguished = extinguished_light(tau, T, T_out)
            if self.proposal.is_rough:
                extinguished = dr.maximum(extinguished, MIN_ROUGH_TRANSMITTANCE * tau / (1 + tau))
            weight += extinguished
            if probe_sigma is not None:
                weight += 0.5 * probe_sigma * dt * (T + T_out)
        if equiangular is not None:
            weight *= equiangular.mean(piece.begin + piece.s, dt)
        if lit is not None:
            weight *= lit
        # The mean angle of a piece of length 0 is NaN. An infinite weight would make the total infinite, and the piece final.
        weight = dr.select(piece.on & (dt > 0) & (weight < 1e30), weight, 0)
        total = reservoir.total + weight
        kept = [_replace_candidate(old, piece, weight, total, reservoir.tau) for old in reservoir.candidates]
        return Reservoir(ahead, beyond, total, kept)


def _replace_candidate(old: Candidate, piece: _Piece, weight: mi.Float, total: mi.Float, front: list[mi.Float]) -> Candidate:
    """Keep the new piece with the probability weight / total, otherwise the old piece: a step of weighted reservoir
    sampling."""
    rng, (u,) = draw_pcg32(old.rng, 1)
    keep = u * total < weight
    return Candidate(
        dr.select(keep, weight, old.weight),
        dr.select(keep, piece.begin, old.begin),
        dr.select(keep, piece.s, old.s),
        dr.select(keep, piece.dt, old.dt),
        [dr.select(keep, t, f) for t, f in zip(front, old.front, strict=True)],
        old.probe_sigma,
        old.body,
        old.is_new | keep,
        rng,
    )


def lit_length(sigma: list[mi.Float], length: mi.Float) -> mi.Float:
    """The length over which a constant extinction lets light through, up to the optical depth ``NEGLIGIBLE_TAU`` [length].

    The channel with the smallest positive extinction decides. If all extinctions are 0, the result is the whole length.
    """
    least = mi.Float(dr.inf)
    for s in sigma:
        least = dr.select(s > 0, dr.minimum(least, s), least)
    return dr.minimum(length, NEGLIGIBLE_TAU / least)


def _set_probe_sigma(reservoir: Reservoir, probe_sigma: mi.Float | None) -> Reservoir:
    """Store the extinction added by probes in this medium with the candidates replaced in it.

    Candidates of media further in front keep the value of their medium: the extinction is a fixed optical depth over the length
    of each medium, so it differs from medium to medium.
    """
    if probe_sigma is None:
        return reservoir
    return replace(
        reservoir,
        candidates=[replace(k, probe_sigma=dr.select(k.is_new, probe_sigma, k.probe_sigma)) for k in reservoir.candidates],
    )


def extinguished_light(tau: mi.Float, T: mi.Float, T_out: mi.Float) -> mi.Float:
    """T (1 - exp(-tau)), the light extinguished in a piece, to 4e-5 of it.

    The difference T - T_out loses its digits for small tau; a series replaces it.
    """
    series = dr.fma(tau, dr.fma(tau, dr.fma(tau, dr.fma(tau, 1 / 120, -1 / 24), 1 / 6), -1 / 2), 1)
    return dr.select(tau < 0.5, T * tau * series, T - T_out)


def bounded_inverse(x: mi.Float) -> mi.Float:
    """1 / x for x >= 0; finite at 0 (1e30), so its product with 0 is 0."""
    return dr.rcp(dr.maximum(x, 1e-30))


# -- The distance inside the kept piece ---------------------------------------------------------------------------------


@dataclass
class MediumEvent:
    """A scattering event on a ray.

    Attributes:
        t, begin: distances of the event and of the start of its piece, in float64 [length].
        pdf: density of the distance [1/length].
        tau: optical depth in front of the event, for each channel, summed over the media in the order of the walk [1].
        sigma_t: extinction at the event, for each channel [1/length].
        body: index of the medium.
        on: lanes with an event.
    """

    t: mi.Float64
    begin: mi.Float64
    pdf: mi.Float
    tau: list[mi.Float]
    sigma_t: list[mi.Float]
    body: mi.UInt32
    on: mi.Bool


def sample_distance(
    proposal: DistanceProposal, candidate: Candidate, total: mi.Float, u: mi.Point2f, active: mi.Bool
) -> MediumEvent:
    """Draw a distance inside the piece kept by a reservoir.

    Args:
        proposal: proposal of the reservoir's weights.
        candidate: the piece.
        total: total weight of the pieces.
        u: two uniform random numbers in [0, 1).
        active: lanes that may scatter.
    """
    equiangular = proposal.chosen.equiangular
    on = active & (candidate.weight > 0)
    dt = dr.select(on, candidate.dt, 1)
    curve = _extinction_curves(proposal, candidate, on)
    whole = [integrate_cubic(c, dt, 1) for c in curve]
    front = [dr.exp(-f) for f in candidate.front]

    # -- The technique: free flight, or uniform (in angle where the emitter is finite, in length for probes) -----------
    by_collision, mean = mi.Float(1), sum(whole) / len(whole)
    if proposal.probe_depth:
        by_collision = mean * bounded_inverse(mean + candidate.probe_sigma * dt)
    begin = candidate.begin + candidate.s
    if equiangular is not None:
        by_collision *= _collision_share(equiangular, begin, dt, mean)
    collides = u.x < by_collision
    even = u.y * dt if equiangular is None else dr.select(equiangular.finite, equiangular.sample(begin, dt, u.y), u.y * dt)
    x = dr.select(collides, _invert_collision_cdf(curve, whole, front, dt, u), even * dr.rcp(dt))

    # -- The density of their mixture ------------------------------------------------------------------------------------
    sigma = [dr.maximum(eval_cubic(c, x), 0) for c in curve]
    tau = [integrate_cubic(c, dt, x) for c in curve]
    extinguished = sum((f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)), mi.Float(0))
    hits = sum((f * s * dr.exp(-t) for f, s, t in zip(front, sigma, tau, strict=True)), mi.Float(0))
    pdf = by_collision * dr.select(extinguished > 0, hits / dr.select(extinguished > 0, extinguished, 1), 0)
    evenly = dr.rcp(dt)
    if equiangular is not None:
        evenly = dr.select(equiangular.finite, equiangular.density(begin, dt, x * dt), evenly)
    pdf = (pdf + (1 - by_collision) * evenly) * candidate.weight / dr.select(on, total, 1)
    start = mi.Float64(candidate.begin) + mi.Float64(candidate.s)
    t = start + mi.Float64(x) * mi.Float64(dt)
    on &= (pdf > 0) & dr.isfinite(pdf)
    return MediumEvent(
        t, start, dr.select(on, pdf, 1), [f + a for f, a in zip(candidate.front, tau, strict=True)], sigma, candidate.body, on
    )


def _collision_share(equiangular: EquiangularSampler, begin: mi.Float, dt: mi.Float, tau: mi.Float) -> mi.Float:
    """Share of distances in a piece drawn by free flight [1]; 1 for an emitter at infinity.

    The light scattered at a distance is proportional to 1 / r^2 and to the transmittance towards the camera and the emitter.
    If the transmittance is constant, the angle alone draws the light exactly; if neither is constant, both techniques are used.
    The optical depth varies by at most that of the piece. It also varies by no more than the extinction times the distance
    to the emitter: in front of the emitter, the way to the emitter becomes shorter as the way to the camera becomes longer.
    """
    clear = dr.exp(-tau * dr.minimum(1, equiangular.nearest(begin, dt) / dt))
    by_angle = clear * (1 - equiangular.evenness(begin, dt))
    # With weights that vary little, the halves are measured to be best.
    return dr.select(equiangular.finite, dr.select(by_angle > 0.5, 0.5 * (1 - by_angle), 0.5), 1)


def _extinction_curves(proposal: DistanceProposal, candidate: Candidate, on: mi.Bool) -> list[list[mi.Float]]:
    """The extinction along a piece for each channel: the coefficients of a cubic on [0, 1]."""
    media = proposal.media
    values = [[mi.Float(0) for _ in range(4)] for _ in range(media.channels)]
    for index, body in enumerate(media.bodies):
        lanes = on & (candidate.body == index)
        along = _extinction_along(proposal, body, candidate, lanes)
        values = [
            [dr.select(lanes, n, v) for n, v in zip(new, old, strict=True)] for new, old in zip(along, values, strict=True)
        ]
    return [fit_cubic(*v) for v in values]


def _extinction_along(proposal: DistanceProposal, body: Body, candidate: Candidate, on: mi.Bool) -> list[list[mi.Float]]:
    """[channel][point] extinction at 0, 1/3, 2/3 and 1 of a piece, in one medium [1/length]."""
    media, ray, parts = proposal.media, proposal.ray, proposal.parts_of(body)
    extinction = body.extinction(ray, parts)
    constant = [[c] * 4 for c in extinction.constant]
    lattice = next((p.lattice for p in parts if p.lattice is not None), None)
    if lattice is None:
        return _to_scene_channels(media, constant)
    start = mi.Float64(candidate.begin) + mi.Float64(candidate.s)
    cell, points, inside = points_of_piece(lattice, ray, start, candidate.dt, on)
    grid = extinction.along(read_nodes(extinction.reads, corner_nodes(cell, lattice, inside), inside), points)
    values = [[dr.select(inside, g, k) for g, k in zip(*row, strict=True)] for row in zip(grid, constant, strict=True)]
    return _to_scene_channels(media, values)


def _to_scene_channels(media: SceneMedia, values: list[list[mi.Float]]) -> list[list[mi.Float]]:
    """[channel of the scene][point], from [channel of the medium][point]."""
    return [list(row) for row in zip(*(media.to_channels([v[k] for v in values]) for k in range(4)), strict=True)]


def _invert_collision_cdf(curve: list, whole: list[mi.Float], front: list[mi.Float], dt: mi.Float, u: mi.Point2f) -> mi.Float:
    """Invert the cumulative distribution of collisions in a piece: the fraction of its length with the value ``u.y``.

    With an rgb extinction, one channel is drawn in proportion to the light extinguished in the piece.
    """
    c, tau = curve[0], whole[0]
    if len(curve) > 1:
        shares = [f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)]
        # u.x has chosen the technique and u.y is needed below, so a third number draws the channel.
        left = dr.select(sum(shares) > 0, _hash_numbers(u), 0) * sum(shares)
        for k in range(1, len(curve)):
            later = left >= sum(shares[:k])
            c = [dr.select(later, a, b) for a, b in zip(curve[k], c, strict=True)]
            tau = dr.select(later, whole[k], tau)
    goal = _collision_quantile(u.y, tau)
    return invert_cubic_integral(c, dt, goal, tau)


def _hash_numbers(u: mi.Point2f) -> mi.Float:
    """A third number in [0, 1) from the bits of two."""
    return draw_pcg32(mi.UInt32(u.x * (1 << 24)) * mi.UInt32(0x9E3779B9) + mi.UInt32(u.y * (1 << 24)), 1)[1][0]


def _collision_quantile(u: mi.Float, tau: mi.Float) -> mi.Float:
    """-log(1 - u (1 - exp(-tau))): the optical depth reached by the fraction u of all collisions within tau [1]."""
    x = u * one_minus_exp(tau)
    series = dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, 1 / 6, 1 / 5), 1 / 4), 1 / 3), 1 / 2), 1)
    return dr.minimum(dr.select(x < 0.05, x * series, -dr.log(dr.maximum(1 - x, 1e-37))), tau)
