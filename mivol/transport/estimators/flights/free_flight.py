r"""Free flights: a path flies to the first collision with the media, where it may scatter, or to the end of its segment.

.. math:: L = \int_0^D T(t) \left( \sigma_s L_s + j \right) dt + T(D)\, L_{behind}, \qquad p(t) = \sigma_t(t)\,T(t)

Each part of an extinction has its own flight, and the shortest flight is the flight of the sum, since collisions with different
parts are independent. So media need no order along the ray, and exact parts combine with tracked parts.

With an rgb extinction, one channel is drawn for the flight in proportion to the path's throughput. The mean of the densities of
all channels weights the outcome (the balance heuristic). In a medium of albedo 1 these weights preserve the sum of the
throughputs, so they stay bounded on paths of any length.

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
from functools import partial

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_line import WhitenedLine
from mivol.numerics import fast_max, fast_min, minimum
from mivol.transport.estimators.flights.baseline import Baseline
from mivol.transport.estimators.flights.flight_derivatives import FlightSegment
from mivol.transport.estimators.flights.gaussian_light import GaussianLight
from mivol.transport.estimators.flights.tracking import delta_tracking, delta_tracking_in_blocks
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
    ExactExtinction,
    Extinction,
    RayInterval,
    to_components,
    to_scene_channels,
    to_spectrum,
)
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.grid_extinction import activate, clip_interval
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
) -> mi.Float64:
    """Find the first collision with a constant or a grid on an interval of a ray.

    Args:
        part: part of the extinction.
        scale: factor on its values.
        interval: interval of the ray; its end may be infinite.
        goal: optical depth up to the collision [1]: -log(1 - u) of a uniform random number u.
        channel: channel of an rgb extinction.

    Returns:
        Distance of the collision on the ray [length]; infinite without a collision.

    Bias: none, except for an extinction with an activation, interpolated by a cubic through four points of a cell. Cost: one
    walk up to the collision.
    """
    if part.is_constant:
        return _collide_in_constant(part, scale, interval, goal, channel)
    return _collide_in_grid(part, scale, interval, goal, channel)


def _collide_in_constant(
    part: ExactExtinction, scale: mi.Float, interval: RayInterval, goal: mi.Float, channel: mi.UInt32
) -> mi.Float64:
    sigma = _select_channel(part.eval_at(scale, interval.ray, interval.t0, interval.active), channel)
    t = mi.Float64(interval.t0) + mi.Float64(goal / sigma)
    return dr.select(interval.active & (sigma > 0) & (t < interval.t1), t, dr.inf)


def _collide_in_grid(
    part: ExactExtinction,
    scale: mi.Float,
    interval: RayInterval,
    goal: mi.Float,
    channel: mi.UInt32,
) -> mi.Float64:
    lattice, ray = part.lattice, interval.ray
    segment, width = clip_interval(lattice, interval), dr.width(ray)
    reads = [NodeArray(dr.detach(part.values), part.channels)]

    def visit(state: tuple, cell: Cell, on: mi.Bool) -> tuple:
        remaining, s, dt, collides = state
        corners = [_select_channel([row[q] for row in cell.corners[0]], channel) for q in range(8)]
        a, b = (activate(part.activation, interpolate(corners, p)) for p in gauss_points(cell))
        tau = 0.5 * cell.dt * scale * (a + b)
        ends = on & (tau >= remaining)
        s, dt = dr.select(ends, cell.s, s), dr.select(ends, cell.dt, dt)
        return dr.select(on & ~ends, remaining - tau, remaining), s, dt, collides | ends

    zero = dr.zeros(mi.Float, width)
    start = (mi.Float(goal), zero, zero, dr.full(mi.Bool, False, width))
    remaining, s, dt, collides = walk_cells(
        lattice, segment, visit, start, reads, interval.active, until=lambda state: state[3]
    )

    # -- The position of the collision inside its cell ---------------------------------------------------------------------
    begin = segment.start + mi.Float64(s)
    cell, points, inside = points_of_piece(lattice, ray, begin, dt, collides)
    rows = read_nodes(reads, corner_nodes(cell, lattice, inside), inside)[0]
    corners = [_select_channel([row[q] for row in rows], channel) for q in range(8)]
    curve = fit_cubic(*(scale * activate(part.activation, interpolate(corners, p)) for p in points))
    x = invert_cubic_integral(curve, dt, remaining, integrate_cubic(curve, dt, mi.Float(1)))
    return dr.select(collides, begin + mi.Float64(x) * mi.Float64(dt), dr.inf)


def _select_channel(rows: list[mi.Float], channel: mi.UInt32) -> mi.Float:
    """Select the value of a channel; a grey part has one channel, and a mono variant uses the luminance of three."""
    rows = to_scene_channels(rows, 1) if mi.is_monochromatic else rows
    value = rows[0]
    for k, row in enumerate(rows[1:], 1):
        value = dr.select(channel == k, row, value)
    return value


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
    """

    t: mi.Float64
    body: mi.UInt32
    u: mi.Float
    rng: mi.UInt32
    passages: list[mi.Float] | None


class FreeFlight:
    """The segment estimator of paths that scatter in media any number of times.

    Args:
        media: media of the scene.

    Attributes:
        baseline: baseline of the derivatives (:mod:`.baseline`); None means 0.
        bodies: media of the scene.
        emitting: media with an emission by position.
        has_gaussian_light: a medium of Gaussians emits light.

    Bias: none. Variance: one flight a segment. Cost: a walk of each medium to the first collision; one more walk for an rgb
    extinction or an emitting medium.
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
        parts = [part for body in self.bodies for part in body.view.parts]
        # With an rgb extinction the throughput of the path draws the channel of the flight, and is not known yet.
        if self.media.channels > 1 or not any(part.exact_line and _uses_delta_tracking(part) for part in parts):
            return None
        u, rng = self.draw(sampler, active)
        _, flight = _find_first_collision(self.media, ray, medium, u, mi.UInt32(0), rng, active, inverts=True)
        return KnownFlight(flight.t, flight.body, active)

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
        weight = self._channel_weight(segment, passed, active, collision)
        # -- The light of the media on the way --------------------------------------------------------------------------
        emission = None
        if self.emitting:
            emission = self._sample_point(segment, passed, self.emitting, at_emission, active)
        if segment.emission_weight is not None:
            emission.gain *= segment.emission_weight
        gaussian_light = None
        if self.has_gaussian_light:
            channel_weight = partial(self._channel_weight, segment, collision=None)
            gaussian_light = GaussianLight(media, segment, (end.t, t), channel_weight, active)
        # -- Term, factor, and the point for derivatives ----------------------------------------------------------------
        # The path's own flights and probes account for the baseline; a side flight has none.
        baseline = None if segment.is_side_flight else self.baseline
        shared = FlightSegment(media, segment, passed, collision, weight, baseline, emission, gaussian_light, active)
        light = SegmentLight(shared, shared.emitted, is_replayed=True)
        transmittance = SegmentTransmittance(shared)
        if purpose == IMAGE:
            return SegmentEstimate(end, weight, light, transmittance, collision)
        probed = [body for body in self.bodies if body.needs_probes]
        probe = self._sample_point(segment, passed, probed, at_probe, active) if probed else None
        return SegmentEstimate(end, weight, light, transmittance, collision, probe, chance)

    def _channel_weight(
        self, segment: PathSegment, passed: RaySegment, active: mi.Bool, collision: Collision | None
    ) -> mi.Spectrum:
        """The weight of each channel: its value over the mean density over the channels, in proportion to their throughputs.

        Args:
            segment: segment of the path, with its throughput.
            passed: ray up to the end of the flight.
            active: lanes that fly.
            collision: collision at the end; None means the probability of flying this far.
        """
        if self.media.channels == 1:
            return mi.Spectrum(1)
        # Only ratios of transmittances matter; the largest becomes 1. Bounded parts are grey, and cancel.
        tau = segment_optical_depth(self.media, passed, active, exact_only=True)
        least = minimum(tau)
        value = to_spectrum([dr.exp(least - row) for row in tau])
        hits = [] if collision is None else self.media.bodies_at(collision.body, collision.on)
        for body, on in hits:
            value = dr.select(on, value * _eval_extinction(self.media, body, segment.ray, collision.t, on), value)
        shares = _channel_probabilities(segment.beta)
        density = sum((p * v for p, v in zip(shares, to_components(value), strict=True)), mi.Float(0))
        return dr.select(density > 0, value / dr.select(density > 0, density, 1), 0)

    def _sample_point(
        self, segment: PathSegment, passed: RaySegment, among: list[Body], u: mi.Float, active: mi.Bool
    ) -> FlightPoint:
        """Draw a point uniformly from the intervals of a flight in some media."""
        point = draw_uniform_point(self.media, passed, among, u, active)
        front = RaySegment.upto(segment.ray, segment.medium, dr.select(point.on, point.t, 0))
        gain = segment.beta * self._channel_weight(segment, front, point.on, None) * point.length
        return FlightPoint(point, gain)


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
        number = next(k for k, other in enumerate(bodies) if other is body)
        scale = dr.detach(body.view.scale) * body.area(ray.d)
        for part in body.view.parts:
            # No part of the ray behind the first collision so far is followed.
            t0, t1 = mi.Float64(interval.t0), dr.minimum(mi.Float64(interval.t1), t)
            ahead = RayInterval(ray, t0, t1, interval.active & (t1 > t0))
            if known is not None:
                ahead.active &= ~known.on
            if not part.exact_line:
                hit, rng = delta_tracking(part, scale, ahead, rng)
            elif isinstance(part, GaussianExtinction):
                hit, rng = sample_gaussian_flight(part, scale, ahead, rng)
            elif isinstance(part, OctreeExtinction):
                hit = part.find_collision(scale, ahead, -dr.log(1 - u), channel)
                rng, (other,) = draw_pcg32(rng, 1)
                u = dr.select(ahead.active, other, u)
            else:
                if _uses_delta_tracking(part) and not inverts:
                    hit, rng = delta_tracking_in_blocks(part, scale, ahead, u, rng)
                else:
                    hit = regular_tracking(part, scale, ahead, -dr.log(1 - u), channel)
                # The first flight takes the spread number of the segment. Each other part, and each further entry into a
                # traced boundary, needs its own.
                rng, (other,) = draw_pcg32(rng, 1)
                u = dr.select(ahead.active, other, u)
            nearer = ahead.active & (hit < t)
            t, index = dr.select(nearer, hit, t), dr.select(nearer, mi.UInt32(number), index)
        return _Flight(t, index, u, rng, add_passage(media, flight.passages, interval, t))

    width = dr.width(ray)
    start = _Flight(dr.full(mi.Float64, dr.inf, width), dr.zeros(mi.UInt32, width), u, rng, start_passages(media, width))
    if known is not None:
        start.t, start.body = dr.select(known.on, known.t, start.t), dr.select(known.on, known.body, start.body)
    traced = active
    if known is not None and known.meets_no_surface is not None:
        traced = active & ~known.meets_no_surface
    end, flight = visit_media(media, ray, medium, visit, start, traced, reach=(lambda flight: flight.t) if stops else None)
    return replace(end, t=dr.select(active & ~traced, ray.maxt, end.t)), flight


def _uses_delta_tracking(part: Extinction) -> bool:
    """Whether delta tracking draws the flights through a part."""
    return not part.exact_line or (part.lattice is not None and part.lattice.block_ranges is not None and part.channels == 1)


def _channel_probabilities(beta: mi.Spectrum) -> list[mi.Float]:
    """The probability of each channel: its share of the throughput [1]."""
    rows = [dr.abs(row) for row in to_components(beta)]
    total = sum(rows[1:], rows[0])
    return [dr.select(total > 0, row / dr.select(total > 0, total, 1), 1 / len(rows)) for row in rows]


def _sample_channel(beta: mi.Spectrum, u: mi.Float) -> mi.UInt32:
    """Sample a channel in proportion to the throughput."""
    first, second, _ = _channel_probabilities(beta)
    return dr.select(u < first, mi.UInt32(0), dr.select(u < first + second, mi.UInt32(1), mi.UInt32(2)))
