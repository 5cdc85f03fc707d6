r"""Free flights: a path flies to the first collision with the media, where it may scatter, or to the end of its segment.

.. math:: L = \int_0^D T(t) \left( \sigma_s L_s + j \right) dt + T(D)\, L_{behind}, \qquad p(t) = \sigma_t(t)\,T(t)

Each part of an extinction has its own flight, and the shortest flight is the flight of the sum, since collisions with different
parts are independent. So media need no order along the ray, and exact parts combine with tracked parts.

With an rgb extinction, one channel is drawn for the flight in proportion to the path's throughput. The mean of the densities of
all channels weights the outcome (the balance heuristic). In a medium of albedo 1 these weights preserve the sum of the
throughputs, so they stay bounded on paths of any length.

.. math:: w_k = \frac{F_k}{\sum_c p_c F_c}, \qquad F_k = \sigma_k T_k \quad\text{or}\quad
          F_k = \frac{\sigma_k(x)}{M} \prod_j \Big(1 - \frac{\sigma_k(x_j)}{M_j}\Big)

The first F is exact: a walk that inverts the optical depth of one channel sums those of all. Delta tracking at one rate M for
all channels has the second F, the density of all tentative collisions. Its mean over the points x_j is the first, so terms and
derivatives that depend on the collision alone have the same means with either. A flight may have gone on behind the collision
with another medium; its density then has the same mean as well.

One point of each flight, drawn uniformly over its length t, samples the emission j: the mean of t j over all flights is
:math:`\int T j\,dt`, also in regions without extinction. The light of Gaussians is summed (:mod:`.gaussian_light`).

Regular tracking inverts the exact optical depth of one part.

.. math:: \int_{t_0}^{t} s f(x_{t'})\,dt' = -\log(1 - u), \qquad
          t = t_p + \frac{1}{|W\omega|}\,\Phi^{-1}\!\Big(\Phi(s_0) - \frac{\log(1 - u)}{s\,\tau}\Big)

The first equation is inverted cell by cell in grids. The second is its closed form for a Gaussian of optical depth tau with its
peak at t_p. Collisions with different Gaussians are independent, so the shortest of their own flights is the flight through
their sum: nothing is sorted, and no sum is inverted. A Gaussian is flown through in the cell where the ray enters it, so the
walk ends in the cell of the shortest flight.

References: Chandrasekhar 1960 (the equation of transfer); Woodcock et al. 1965, Sutton et al. 1999 (flights, regular
tracking); Amanatides & Woo 1987 (the walk); Wilkie et al. 2014, Miller et al. 2019 (channels); Spanier & Gelbard 1969 (the
track-length estimator).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_line import WhitenedLine
from mivol.numerics import fast_max, fast_min, minimum
from mivol.transport.estimators.flights.baseline import Baseline
from mivol.transport.estimators.flights.flight_derivatives import FlightSegment
from mivol.transport.estimators.flights.gaussian_light import GaussianLight
from mivol.transport.estimators.flights.tracking import (
    delta_tracking,
    delta_tracking_in_blocks,
    scale_to_largest,
    select_channel,
)
from mivol.transport.estimators.scores import IMAGE
from mivol.transport.estimators.segment import (
    Collision,
    FlightPoint,
    KnownFlight,
    PathSegment,
    SegmentEstimate,
    SegmentLight,
    SegmentTransmittance,
)
from mivol.transport.media.body import Body, eval_albedo, medium_interaction
from mivol.transport.media.extinction import (
    BoundedExtinction,
    ExactExtinction,
    Extinction,
    RayInterval,
    to_components,
    to_spectrum,
)
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.grid_extinction import (
    ActivatedGridExtinction,
    GridExtinction,
    activate,
    clip_interval,
)
from mivol.transport.media.octree_extinction import OctreeExtinction
from mivol.transport.media.optical_depth import segment_optical_depth
from mivol.transport.media.ray_intervals import (
    MediumInterval,
    RaySegment,
    SegmentEnd,
    add_passage,
    draw_uniform_point,
    start_passages,
    visit_media,
)
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, NodeArray, corner_nodes, read_nodes, walk_cells
from mivol.transport.traversal.interpolation import (
    eval_cubic,
    fit_cubic,
    gauss_points,
    integrate_cubic,
    interpolate,
    invert_cubic_integral,
)
from mivol.transport.traversal.lattice import points_of_piece
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_lead, draw_pcg32, draw_state
from mivol.transport.traversal.rays import Ray, point_along

__all__ = ["FreeFlight", "make_collision", "regular_tracking", "sample_gaussian_flight"]


def regular_tracking(
    part: ExactExtinction,
    scale: mi.Float,
    interval: RayInterval,
    goal: mi.Float,
    channel: mi.UInt32,
) -> tuple[mi.Float64, list[mi.Float]]:
    """Find the first collision with a constant or a grid on an interval of a ray.

    Args:
        part: part of the extinction.
        scale: factor on its values.
        interval: interval of the ray; its end may be infinite.
        goal: optical depth up to the collision [1]: -log(1 - u) of a uniform random number u.
        channel: channel of an rgb extinction.

    Returns:
        Distance of the collision on the ray [length], infinite without a collision; and the density of the flight for each
        channel of an rgb grid, relative to the largest [1] (empty for other parts).

    Bias: none, except for an extinction with an activation, interpolated by a cubic through four points of a cell. Cost: one
    walk up to the collision.
    """
    if part.is_constant:
        return _collide_in_constant(part, scale, interval, goal, channel), []
    return _collide_in_grid(part, scale, interval, goal, channel)


def _collide_in_constant(
    part: ExactExtinction, scale: mi.Float, interval: RayInterval, goal: mi.Float, channel: mi.UInt32
) -> mi.Float64:
    sigma = select_channel(part.eval_at(scale, interval.ray, interval.t0, interval.active), channel)
    t = mi.Float64(interval.t0) + mi.Float64(goal / sigma)
    return dr.select(interval.active & (sigma > 0) & (t < interval.t1), t, dr.inf)


def _collide_in_grid(
    part: ExactExtinction,
    scale: mi.Float,
    interval: RayInterval,
    goal: mi.Float,
    channel: mi.UInt32,
) -> tuple[mi.Float64, list[mi.Float]]:
    lattice, ray = part.lattice, interval.ray
    segment, width, is_rgb = clip_interval(lattice, interval), dr.width(ray), _has_densities(part)
    reads = [NodeArray(dr.detach(part.values), part.channels)]

    def extinction_at(corners: list[list[mi.Float]], p: mi.Vector3f) -> list[mi.Float]:
        """The extinction at a point of a cell, without the scale: of each channel, or of the only one."""
        rows = corners if is_rgb else [[select_channel([row[q] for row in corners], channel) for q in range(8)]]
        return [activate(part.activation, interpolate(row, p)) for row in rows]

    def visit(state: tuple, cell: Cell, on: mi.Bool) -> tuple:
        remaining, s, dt, collides, passed = state
        ends_of_cell = (extinction_at(cell.corners[0], p) for p in gauss_points(cell))
        taus = [0.5 * cell.dt * scale * (a + b) for a, b in zip(*ends_of_cell, strict=True)]
        tau = select_channel(taus, channel) if is_rgb else taus[0]
        ends = on & (tau >= remaining)
        s, dt = dr.select(ends, cell.s, s), dr.select(ends, cell.dt, dt)
        passed = [dr.select(on & ~ends, t + own, t) for t, own in zip(passed, taus, strict=False)]
        return dr.select(on & ~ends, remaining - tau, remaining), s, dt, collides | ends, passed

    zero = dr.zeros(mi.Float, width)
    passed = [dr.zeros(mi.Float, width) for _ in range(part.channels)] if is_rgb else []
    start = (mi.Float(goal), zero, zero, dr.full(mi.Bool, False, width), passed)
    remaining, s, dt, collides, passed = walk_cells(
        lattice, segment, visit, start, reads, interval.active, until=lambda state: state[3]
    )

    # -- The position of the collision inside its cell ---------------------------------------------------------------------
    begin = segment.start + mi.Float64(s)
    cell, points, inside = points_of_piece(lattice, ray, begin, dt, collides)
    corners = read_nodes(reads, corner_nodes(cell, lattice, inside), inside)[0]
    columns = [extinction_at(corners, p) for p in points]
    curves = [fit_cubic(*(scale * value for value in row)) for row in zip(*columns, strict=True)]
    curve = [select_channel(list(c), channel) for c in zip(*curves, strict=True)] if is_rgb else curves[0]
    x = invert_cubic_integral(curve, dt, remaining, integrate_cubic(curve, dt, mi.Float(1)))
    t = dr.select(collides, begin + mi.Float64(x) * mi.Float64(dt), dr.inf)
    if not is_rgb:
        return t, []

    # -- The density of the flight in each channel -------------------------------------------------------------------------
    tau = [p + dr.select(collides, integrate_cubic(c, dt, x), 0) for p, c in zip(passed, curves, strict=True)]
    least = minimum(tau)
    sigma = [dr.select(collides, dr.maximum(eval_cubic(c, x), 0), 1) for c in curves]
    return t, scale_to_largest([dr.exp(least - depth) * value for depth, value in zip(tau, sigma, strict=True)])


def _has_densities(part: Extinction) -> bool:
    """Whether a flight through the part finds its density in each channel: in rgb grids, and rgb fields known at points."""
    finds = isinstance(part, GridExtinction | ActivatedGridExtinction | BoundedExtinction)
    return finds and part.channels > 1 and not mi.is_monochromatic


def sample_gaussian_flight(
    part: GaussianExtinction, scale: mi.Float, interval: RayInterval, rng: mi.UInt32
) -> tuple[mi.Float64, mi.UInt32]:
    """Find the first collision with Gaussians on an interval of a ray.

    Args:
        part: the Gaussians.
        scale: factor on their extinction.
        interval: interval of the ray; its end may be infinite.
        rng: state of the random number generator.

    Returns:
        Distance of the collision on the ray [length], infinite without a collision, and the next state of the generator.

    Bias: none but rounding. Cost: one walk up to the collision, and one random number for each Gaussian on the way.
    """
    passage = part.enter(interval)

    def add(state: tuple, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> tuple:
        nearest, reached, rng = state
        rng, (u,) = draw_pcg32(rng, 1)
        before = line.share_up_to(ends[0])
        goal = before - dr.log(1 - u) / (scale * line.depth)
        hits = goal < before + line.share(*ends)
        t = line.peak + math.sqrt(2) * dr.erfinv(dr.select(hits, 2 * goal - 1, 0)) / line.speed
        # Clamp to the ends: in the tails, a share of 1e-7 is a long way.
        t = fast_min(fast_max(t, ends[0]), ends[1])
        return dr.select(hits & (t < nearest), t, nearest), reached, rng

    def leave(state: tuple, t: mi.Float) -> tuple:
        return state[0], t, state[2]

    width = dr.width(passage.d)
    start = (dr.full(mi.Float, dr.inf, width), dr.zeros(mi.Float, width), mi.UInt32(rng))
    nearest, _, rng = part.visit_gaussians(passage, start, add, lambda state: state[0] <= state[1], leave)
    return dr.select(dr.isfinite(nearest), passage.start + mi.Float64(nearest), dr.inf), rng


@dataclass
class _Flight:
    """The state of flights: the first collision found so far.

    Attributes:
        t: distance of the collision on the ray [length]; infinite without a collision.
        body: index of its medium.
        u: uniform random number of the next flight, in [0, 1).
        rng: state of the random number generator.
        passages: length up to the collision in each of ``media.traced``, as in ``RaySegment``.
        densities: density of the flights through rgb grids in each channel, relative to the largest [1]; empty without them.
        has_density: lanes whose collision is in one of these grids.
    """

    t: mi.Float64
    body: mi.UInt32
    u: mi.Float
    rng: mi.UInt32
    passages: list[mi.Float] | None
    densities: list[mi.Float]
    has_density: mi.Bool


class FreeFlight:
    """The segment estimator of paths that scatter in media any number of times.

    Args:
        media: media of the scene.

    Attributes:
        baseline: baseline of the derivatives (:mod:`.baseline`); None means 0.
        bodies: media of the scene.
        emitting: media with an emission by position.
        has_gaussian_light: a medium of Gaussians emits light.

    Bias: none. Variance: one flight a segment; in rgb grids with block ranges, tentative collisions too. Cost: a walk of each
    medium to the first collision; one more for an emitting medium, and for an octree of an rgb extinction.
    """

    ends_in_media = True

    def __init__(self, media: SceneMedia) -> None:
        self.media, self.bodies = media, media.bodies
        self.baseline: Baseline | None = None
        self.emitting = [body for body in self.bodies if body.view.emits and not body.view.shows_gaussians]
        self.has_gaussian_light = any(body.view.shows_gaussians for body in self.bodies)

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> tuple[mi.Float, mi.UInt32]:
        """Draw the number of the flight and the generator of the other numbers, in every lane, since all lanes fly."""
        return draw_lead(sampler), draw_state(sampler)

    def find_first_collision(
        self, ray: Ray, medium: mi.MediumPtr, sampler: mi.Sampler | SpreadSampler, active: mi.Bool
    ) -> KnownFlight | None:
        """Find the first collisions of camera rays by inverting optical depths; None if :meth:`estimate` does so anyway.

        The distance grows with one number in [0, 1), so numbers that are spread over the samples of a pixel spread the
        collisions. Delta tracking takes fewer steps, but the first tentative collision says little about the collision.
        (Variance of images over the variance with delta tracking, 64 samples a pixel: 0.27 to 0.74 in smokes of optical depth
        1 to 12, and 0.92 and 0.96 in a smoke and a cloud of 20 and 80, where most noise comes from later flights.)

        Args:
            ray: camera rays.
            medium: media around their origins.
            sampler: random numbers.
            active: lanes to follow.

        Bias: as of :func:`regular_tracking`. Cost: one walk up to the collision.
        """
        media = self.media
        parts = [part for body in self.bodies for part in body.view.parts]
        if not any(_tracks_grid(part) or _has_densities(part) for part in parts):
            return None
        u, rng = self.draw(sampler, active)
        channel = mi.UInt32(0)
        if media.channels > 1:
            # The number that is spread over the samples of a pixel spreads their channels too.
            scaled = u * media.channels
            channel = dr.minimum(mi.UInt32(scaled), media.channels - 1)
            u = dr.minimum(scaled - channel, dr.one_minus_epsilon(mi.Float))
        end, flight = _find_first_collision(media, ray, medium, u, channel, rng, active, inverts=True)
        found = KnownFlight(flight.t, flight.body, active)
        if media.channels > 1:
            collides = active & (flight.t < mi.Float64(end.t))
            passed = RaySegment.upto(ray, medium, dr.select(collides, flight.t, mi.Float64(end.t)), flight.passages)
            found.weight = _weigh_channels(media, mi.Spectrum(1), passed, active, flight, collides)
        return found

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Needs no preparation here: the path estimates the baseline (:mod:`mivol.transport.path.derivatives`)."""

    def replayed(self) -> FreeFlight:
        """This estimator: a replay repeats the flights."""
        return self

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        # -- The first collision, or the end of the segment -------------------------------------------------------------
        media, ray = self.media, segment.ray
        u, rng = segment.samples
        rng, (pick, at_emission, at_probe, chance) = draw_pcg32(rng, 4)
        channel = _sample_channel(segment.beta, pick) if media.channels > 1 else mi.UInt32(0)
        end, flight = _find_first_collision(
            media, ray, segment.medium, u, channel, rng, active, segment.known, stops=not segment.needs_surface
        )
        collides = active & (flight.t < mi.Float64(end.t))
        t = dr.select(collides, flight.t, mi.Float64(end.t))
        # A flight without a collision may not have known where its medium ends.
        passages = flight.passages and [dr.minimum(length, mi.Float(t)) for length in flight.passages]
        passed = RaySegment.upto(ray, segment.medium, t, passages)
        if media.is_bounded:
            # One point of the flight estimates the derivatives of bounded media.
            _, (passed.u,) = draw_pcg32(flight.rng, 1)
        collision = make_collision(media, ray, flight.t, flight.body, collides)
        known = segment.known if segment.known is not None and segment.known.weight is not None else None
        unknown = active if known is None else active & ~known.on
        weight = _weigh_channels(media, segment.beta, passed, unknown, flight, collides)
        if known is not None:
            # Paths that begin at a collision have its weight in their throughput already, and are not active.
            weight = dr.select(active & known.on, known.weight, weight)
        # -- The light of the media on the way --------------------------------------------------------------------------
        emission = None
        if self.emitting:
            emission = self._sample_point(segment, passed, self.emitting, at_emission, active, weight)
        if segment.emission_weight is not None:
            emission.gain *= segment.emission_weight
        gaussian_light = None
        if self.has_gaussian_light:

            def weigh(front: RaySegment, on: mi.Bool) -> mi.Spectrum:
                return _weigh_channels(media, segment.beta, front, on)

            gaussian_light = GaussianLight(media, segment, (end.t, t), weigh, active)
        # -- Term, factor, and the point for derivatives ----------------------------------------------------------------
        # The path's own flights and probes account for the baseline; a side flight has none.
        baseline = None if segment.is_side_flight else self.baseline
        shared = FlightSegment(media, segment, passed, collision, weight, baseline, emission, gaussian_light, active)
        light = SegmentLight(shared, shared.emitted, is_replayed=True)
        transmittance = SegmentTransmittance(shared)
        if purpose == IMAGE:
            return SegmentEstimate(end, weight, light, transmittance, collision)
        probed = [body for body in self.bodies if body.needs_probes]
        probe = self._sample_point(segment, passed, probed, at_probe, active, weight) if probed else None
        return SegmentEstimate(end, weight, light, transmittance, collision, probe, chance)

    def _sample_point(
        self,
        segment: PathSegment,
        passed: RaySegment,
        among: list[Body],
        u: mi.Float,
        active: mi.Bool,
        weight: mi.Spectrum,
    ) -> FlightPoint:
        """Draw a point uniformly from the intervals of a flight in some media; ``weight``: of each channel, at the end of the
        flight."""
        point = draw_uniform_point(self.media, passed, among, u, active)
        # The mean of the weights over the ends of all flights that pass the point is the weight at the point.
        return FlightPoint(point, segment.beta * weight * point.length)


def _weigh_channels(
    media: SceneMedia,
    beta: mi.Spectrum,
    passed: RaySegment,
    active: mi.Bool,
    flight: _Flight | None = None,
    collides: mi.Bool | None = None,
) -> mi.Spectrum:
    """The weight of each channel: its density over the mean density of the channels, in proportion to their throughputs.

    Args:
        media: media of the scene.
        beta: throughput at the start [1].
        passed: ray up to the end of the flight.
        active: lanes to weigh.
        flight: the flight, with its densities in grids; None means the probability of flying this far.
        collides: lanes whose flight ends at its collision.
    """
    if media.channels == 1:
        return mi.Spectrum(1)
    value = mi.Spectrum(1) if flight is None or not flight.densities else to_spectrum(flight.densities)

    def left(body: Body) -> list[Extinction]:
        return [part for part in body.view.parts if flight is None or not _has_densities(part)]

    def exact(body: Body) -> list[ExactExtinction]:
        return [part for part in left(body) if part.exact_line]

    # Grey parts have the same transmittance in each channel, and media of such parts alone the same density.
    coloured = [body for body in media.bodies if any(part.channels > 1 for part in left(body))]
    if coloured:
        # Only ratios of transmittances matter; the largest becomes 1.
        tau = segment_optical_depth(media, passed, active, exact)
        least = minimum(tau)
        value *= to_spectrum([dr.exp(least - row) for row in tau])
        hits = [] if flight is None else media.bodies_at(flight.body, collides & ~flight.has_density & active)
        for body, on in hits:
            if any(body is other for other in coloured):
                parts = [_eval_extinction(media, body, passed.ray, flight.t, on, part.name) for part in left(body)]
                value = dr.select(on, value * sum(parts, mi.Spectrum(0)), value)
    shares = _channel_probabilities(beta)
    density = sum((p * v for p, v in zip(shares, to_components(value), strict=True)), mi.Float(0))
    return dr.select(density > 0, value / dr.select(density > 0, density, 1), 0)


def make_collision(media: SceneMedia, ray: Ray, t: mi.Float64, body: mi.UInt32, on: mi.Bool) -> Collision:
    """Make the collision of a ray with a medium.

    Args:
        media: media of the scene.
        ray: ray of the flight.
        t: distance of the collision [length], read in ``on`` lanes only.
        body: index of the medium.
        on: lanes with a collision.
    """
    at, albedo = dr.select(on, t, 0), mi.Spectrum(0)
    mei = medium_interaction(ray, at)
    mei.medium = media.medium_of(body, on)
    for medium, inside in media.bodies_at(body, on):
        albedo = dr.select(inside, _scattering_albedo(media, medium, ray, t, mei, inside), albedo)
    return Collision(mei, point_along(ray, at), albedo, on, t, body)


def _scattering_albedo(
    media: SceneMedia, body: Body, ray: Ray, t: mi.Float64, mei: mi.MediumInteraction3f, on: mi.Bool
) -> mi.Spectrum:
    """sigma_s / sigma_t at a point of a medium [1], at least ``body.least_albedo``."""
    if body.view.albedo is not None:
        albedo = dr.detach(eval_albedo(body, mei, on))
        return dr.maximum(albedo, body.least_albedo) if body.least_albedo > 0 else albedo
    sigma_s, sigma_t = (_eval_extinction(media, body, ray, t, on, name) for name in ("sigma_s", "sigma_"))
    return dr.select(sigma_t > 0, sigma_s / dr.select(sigma_t > 0, sigma_t, 1), 0)


def _eval_extinction(media: SceneMedia, body: Body, ray: Ray, t: mi.Float64, on: mi.Bool, name: str = "sigma_") -> mi.Spectrum:
    return to_spectrum(body.extinction_at(ray, dr.select(on, t, 0), media.channels, on, name))


def _find_first_collision(
    media: SceneMedia,
    ray: Ray,
    medium: mi.MediumPtr,
    u: mi.Float,
    channel: mi.UInt32,
    rng: mi.UInt32,
    active: mi.Bool,
    known: KnownFlight | None = None,
    inverts: bool = False,
    stops: bool = True,
) -> tuple[SegmentEnd, _Flight]:
    """Follow a ray to the first opaque surface, and find the first collision in front of the surface.

    Args:
        known: collisions that are not searched again.
        inverts: optical depths are inverted where possible, instead of drawing tentative collisions.
        stops: the ray is traced up to the collision only; a surface behind the collision may be missing.
    """
    bodies = media.bodies

    def visit(flight: _Flight, interval: MediumInterval) -> _Flight:
        body, t, index, u, rng = interval.body, flight.t, flight.body, flight.u, flight.rng
        densities, has_density = flight.densities, flight.has_density
        number = next(k for k, other in enumerate(bodies) if other is body)
        scale = dr.detach(body.view.scale) * body.area(ray.d)
        for part in body.view.parts:
            # No part of the ray behind the first collision so far is followed.
            t0, t1 = mi.Float64(interval.t0), dr.minimum(mi.Float64(interval.t1), t)
            ahead = RayInterval(ray, t0, t1, interval.active & (t1 > t0))
            if known is not None:
                ahead.active &= ~known.on
            found: list[mi.Float] = []
            if not part.exact_line:
                hit, found, rng = delta_tracking(part, scale, ahead, channel, rng)
            elif isinstance(part, GaussianExtinction):
                hit, rng = sample_gaussian_flight(part, scale, ahead, rng)
            elif isinstance(part, OctreeExtinction):
                hit = part.find_collision(scale, ahead, -dr.log(1 - u), channel)
                rng, (other,) = draw_pcg32(rng, 1)
                u = dr.select(ahead.active, other, u)
            else:
                if _tracks_grid(part) and not inverts:
                    hit, found, rng = delta_tracking_in_blocks(part, scale, ahead, channel, u, rng)
                else:
                    hit, found = regular_tracking(part, scale, ahead, -dr.log(1 - u), channel)
                # The first flight takes the spread number of the segment. Each other part, and each further entry into a
                # traced boundary, needs its own.
                rng, (other,) = draw_pcg32(rng, 1)
                u = dr.select(ahead.active, other, u)
            if found:
                densities = scale_to_largest([d * f for d, f in zip(densities, found, strict=True)])
            nearer = ahead.active & (hit < t)
            t, index = dr.select(nearer, hit, t), dr.select(nearer, mi.UInt32(number), index)
            has_density = dr.select(nearer, _has_densities(part), has_density)
        return _Flight(t, index, u, rng, add_passage(media, flight.passages, interval, t), densities, has_density)

    width = dr.width(ray)
    nowhere, zero, no_lane = dr.full(mi.Float64, dr.inf, width), dr.zeros(mi.UInt32, width), dr.full(mi.Bool, False, width)
    has_grids = any(_has_densities(part) for body in bodies for part in body.view.parts)
    densities = [dr.full(mi.Float, 1, width) for _ in range(media.channels if has_grids else 0)]
    start = _Flight(nowhere, zero, u, rng, start_passages(media, width), densities, no_lane)
    if known is not None:
        start.t, start.body = dr.select(known.on, known.t, start.t), dr.select(known.on, known.body, start.body)
    traced = active
    if known is not None and known.meets_no_surface is not None:
        traced = active & ~known.meets_no_surface
    end, flight = visit_media(media, ray, medium, visit, start, traced, reach=(lambda flight: flight.t) if stops else None)
    return replace(end, t=dr.select(active & ~traced, ray.maxt, end.t)), flight


def _tracks_grid(part: Extinction) -> bool:
    """Whether the part is a grid through which delta tracking draws flights."""
    return part.exact_line and part.lattice is not None and part.lattice.block_ranges is not None


def _channel_probabilities(beta: mi.Spectrum) -> list[mi.Float]:
    """The probability of each channel: its share of the throughput [1]."""
    rows = [dr.abs(row) for row in to_components(beta)]
    total = sum(rows[1:], rows[0])
    return [dr.select(total > 0, row / dr.select(total > 0, total, 1), 1 / len(rows)) for row in rows]


def _sample_channel(beta: mi.Spectrum, u: mi.Float) -> mi.UInt32:
    """Sample a channel in proportion to the throughput."""
    first, second, _ = _channel_probabilities(beta)
    return dr.select(u < first, mi.UInt32(0), dr.select(u < first + second, mi.UInt32(1), mi.UInt32(2)))
