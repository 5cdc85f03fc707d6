r"""Light of near emitters scattered along a segment of a path, at a distance drawn for the emitter.

.. math:: L = \int_0^D T(t)\,\sigma_s(x_t)\,L_d(x_t, \omega)\,dt \approx \frac{T \sigma_s L_d}{p(t)}

A path that scatters many times flies freely, and its collisions are drawn by the extinction alone. The light of an emitter with
a position falls as 1 / r^2, so its light at collisions has a heavy tail. Here every segment draws a second distance, by the
extinguished light and the angle seen from the emitter together (:mod:`.distance_sampling`, in thin grids :mod:`.near_points`),
and adds the light of near emitters there. The collision adds none. So the variance is the variance of single scattering, for
every order of scattering.

Directions. The light of a point emitter that is scattered along a ray falls as 1 / sin(theta) with the angle between the ray
and the direction towards the emitter. Directions of a phase function or BSDF alone would find its square as 1 / sin^2(theta),
and the variance would be infinite. So a share of the directions is drawn with the density

.. math:: q(\omega) = \frac{\pi - \theta}{\pi^3 \sin\theta},

in proportion to the integral of 1 / r^2 along the ray. Each sample is weighted by the density of the mixture.

The path may hit an extended emitter after a collision. That path and the sample at the drawn distance estimate the same light
from the same point and direction. The power heuristic weights both, by the densities of their directions at that point; of the
path's directions, by their density without the mixture. Any two weights with the sum 1 are unbiased.

References: Kulla & Fajardo 2012 (equiangular sampling); Veach 1997, Eq. 9.13 (the power heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.phase.closed_forms import angle_between, eval_hg, sample_hg, scattered_direction
from mivol.transport.estimators.lighting.direct_lighting import DirectLight, DirectLighting
from mivol.transport.estimators.lighting.emitters import ChosenEmitter, join_arrays
from mivol.transport.estimators.lighting.shadow_rays import segment_transmittance
from mivol.transport.estimators.lighting.tabulated_shadows import TabulatedShadow
from mivol.transport.estimators.lighting.vertex import MediumVertex
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.estimators.single_scattering.distance_sampling import (
    DistanceProposal,
    MediumEvent,
    refill_reservoir,
    sample_distance,
    start_reservoir,
)
from mivol.transport.estimators.single_scattering.near_points import draw_near_point
from mivol.transport.estimators.single_scattering.single_scattering import (
    ScatteredLight,
    Scattering,
    event_coefficients,
    event_interaction,
)
from mivol.transport.media.extinction import to_components, to_spectrum
from mivol.transport.media.optical_depth import transmittance
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, draw_state, fork_state
from mivol.transport.traversal.rays import point_along

__all__ = ["AimedDirections", "NearLight", "NearLightSamples", "NearLighting"]


MAX_AIMED_SHARE = 0.4
"""Largest share of directions drawn around an emitter [1]. Light of other emitters then has at most 1 / (1 - 0.4) = 1.7 times
the variance. (Variance with a lamp in smoke, depth 8, and shares of 0, 1/4, 0.4 and 1/2: 1.9e-2, 4.3e-3, 3.7e-3, 3.1e-3.)"""

MAX_AIMED_THROUGHPUT = 2.0
"""Throughput to which the aimed share of directions may raise the other directions [1]. Without a bound, a path in a dense
medium gains a factor of up to 1 / (1 - 0.4) at each vertex, or ends in a direction of nearly no light. After 50 scatterings
almost no path has any light left. (Variance with a lamp in a ball, with bounds of 2, 4, 8 and none: 0.134, 0.132, 0.131 and
0.131 at an optical radius of 4; 8.7, 9.1, 26 and 26 at 12. At 60, with a mean cosine of 0.9, images are black without one.)"""

MAX_MIXED = 16
"""Largest number of emitters inside media whose directions are mixed: each costs its density at every vertex."""

MIN_AIMED_DISTANCE = 3.0
"""Distance of an emitter over its radius [1] up to which no direction is aimed: light is even over so wide an angle."""

MIN_SINE = 1e-6
"""Smallest sine in the density of directions [1], so that the density is finite in float32."""


@dataclass
class AimedDirections:
    """Directions around the directions towards emitters, drawn in place of a share of the directions at a vertex.

    Attributes:
        axes: direction towards each emitter.
        shares: probability of a direction around each emitter [1].
        u: uniform random number in [0, 1) that chooses one of them, or none.
        cosine: mean cosine of a Henyey-Greenstein lobe around each axis; None for the density of near emitters.
    """

    axes: list[mi.Vector3f]
    shares: list[mi.Float]
    u: mi.Float
    cosine: mi.Float | None = None

    @property
    def share(self) -> mi.Float:
        """Probability of a direction around some emitter [1]."""
        return sum(self.shares[1:], self.shares[0])

    @property
    def is_drawn(self) -> mi.Bool:
        """Lanes that draw such a direction."""
        return self.u < self.share

    def draw(self, u: mi.Point2f) -> mi.Vector3f:
        """Draw a direction around the chosen emitter by two uniform random numbers in [0, 1)."""
        axis, below = self.axes[0], self.shares[0]
        for other, share in zip(self.axes[1:], self.shares[1:], strict=True):
            axis = dr.select(self.u >= below, other, axis)
            below = below + share  # a copy: += would change the share
        if self.cosine is not None:
            return scattered_direction(-axis, sample_hg(u.x, self.cosine), u.y)
        sin_theta, cos_theta = dr.sincos(dr.pi * (1 - dr.sqrt(1 - u.x)))
        sin_phi, cos_phi = dr.sincos(dr.two_pi * u.y)
        return mi.Frame3f(axis).to_world(mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta))

    def pdf(self, axis: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
        """Density of a direction drawn around an axis [1/sr]."""
        if self.cosine is not None:
            return eval_hg(angle_between(-axis, d), self.cosine)
        sine = dr.norm(dr.cross(d, axis))
        return (dr.pi - dr.atan2(sine, dr.dot(d, axis))) / (dr.pi**3 * dr.maximum(sine, MIN_SINE))

    def mix(self, pdf: mi.Float, d: mi.Vector3f) -> mi.Float:
        """Density of a direction in the mixture with another density, ``pdf`` [1/sr]."""
        mixed = (1 - self.share) * pdf
        for axis, share in zip(self.axes, self.shares, strict=True):
            mixed = dr.fma(share, self.pdf(axis, d), mixed)
        return mixed

    def weigh(self, f: mi.Spectrum, pdf: mi.Float, d: mi.Vector3f) -> mi.Spectrum:
        """A value over the density of its direction in the mixture with ``pdf``; 0 for a density of 0."""
        density = self.mix(pdf, d)
        return dr.select(density > 0, f * dr.rcp(dr.select(density > 0, density, 1)), 0)


@dataclass
class NearLightSamples:
    """The random numbers of the near light of a segment.

    Attributes:
        which_emitter: uniform random number in [0, 1) for the emitter.
        inside: two for the distance inside the chosen piece of the ray.
        emitter: two for the point on the emitter.
        rng: state of a generator for the piece, the shadow ray and the choice of a shadow ray for derivatives.
    """

    which_emitter: mi.Float
    inside: mi.Point2f
    emitter: mi.Point2f
    rng: mi.UInt32


@dataclass
class NearLightPlace:
    """Where a walk has found the near light of a segment, for the replay of the walk.

    Attributes:
        t: distance on the ray [length].
        body: index of the medium.
        sigma_t: extinction [1/length].
        reach: transmittance up to the point, over the density of this distance [length]; 0 without light.
        shadow: transmittance of the shadow ray, as in :class:`.DirectSample` [1].

    The last three are numbers in grey scenes, and spectra beside an rgb extinction.
    """

    t: mi.Float64
    body: mi.UInt32
    sigma_t: mi.Float | mi.Spectrum
    reach: mi.Float | mi.Spectrum
    shadow: mi.Float | mi.Spectrum

    @classmethod
    def empty(cls, count: int, channels: int) -> NearLightPlace:
        """Room in memory for many places."""
        kinds = mi.Float64, mi.UInt32, *[mi.Float if channels == 1 else mi.Spectrum] * 3
        return cls(*(dr.empty(kind, count) for kind in kinds))

    def at(self, index: mi.UInt32, active: mi.Bool) -> NearLightPlace:
        """The places with an index; places of inactive lanes are without light."""
        arrays = self.t, self.body, self.sigma_t, self.reach, self.shadow
        return NearLightPlace(*(dr.gather(type(a), a, index, active) for a in arrays))

    def set(self, index: mi.UInt32, place: NearLightPlace, active: mi.Bool) -> None:
        """Write places to memory."""
        for name, array in vars(self).items():
            dr.scatter(array, getattr(place, name), index, active)


@dataclass
class NearLight:
    """The light of near emitters scattered along a segment.

    Attributes:
        light: the light as a term.
        shadow: its shadow ray.
        chance: uniform random number in [0, 1), by which a shadow ray of the path is kept.
        place: where the light was found.
        tabulated: the same shadow ray with its shadow read from a table; None without a table.
    """

    light: ScatteredLight
    shadow: DirectLight
    chance: mi.Float
    place: NearLightPlace
    tabulated: TabulatedShadow | None = None


class NearLighting:
    """The estimator of the light of near emitters scattered along a segment.

    Args:
        direct: estimator of direct lighting.
        probe_depth: optical depth added over a medium for derivatives [1]; 0 for images.
        inside: emitters inside media that scatter. Directions are drawn around these emitters only.
        looks_up: whether few look-ups may estimate transmittances of thin grids, behind camera rays and in derivatives.
        draws_points: whether points found by look-ups take the place of cells (:mod:`.near_points`).

    Attributes:
        emitters: the emitters with a position.
        lights_vertices: collisions draw the other emitters, at infinity.
        aims: some emitter lies inside a medium.

    Bias: none. Variance: one distance and one point on one emitter. Cost: a walk of coarse cells along the segment, one up to
    the drawn distance, and a shadow ray; look-ups in place of all in thin grids.
    """

    def __init__(
        self,
        direct: DirectLighting,
        probe_depth: float,
        inside: list[mi.Emitter],
        looks_up: bool = True,
        draws_points: bool = False,
    ) -> None:
        self.direct, self.media, self.probe_depth = direct, direct.media, probe_depth
        self.looks_up, self.draws_points = looks_up, draws_points
        # Their tables are made here, outside of recorded loops.
        self.emitters = direct.near_emitters
        self.lights_vertices = bool(direct.far_emitters.sampled)
        aimed = [any(e is other for other in inside) for e in direct.emitters.sampled]
        self.aims = any(aimed)
        self._mixed = [number for number, is_inside in enumerate(aimed) if is_inside]
        self._is_aimed = None
        if len(self._mixed) > MAX_MIXED and not all(aimed):
            self._is_aimed = join_arrays([dr.opaque(mi.Float, a) for a in aimed])

    @property
    def has_places(self) -> bool:
        """Whether a :class:`NearLightPlace` holds all results of a walk: in grids, without tinted shadows."""
        media = self.media
        return not (media.is_bounded or media.is_homogeneous or media.has_null_transmission)

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> NearLightSamples:
        """Draw the random numbers of a segment."""
        return NearLightSamples(
            sampler.next_1d(active), sampler.next_2d(active), sampler.next_2d(active), draw_state(sampler, active)
        )

    def aim(self, p: mi.Point3f, beta: mi.Spectrum, u: mi.Float, active: mi.Bool) -> AimedDirections:
        """Give emitters inside media their shares of the directions at a vertex, in proportion to their light there.

        With more than ``MAX_MIXED`` of them, one emitter is chosen. A direction of the BSDF or phase function that passes
        close by another one then has an unbounded weight.

        Args:
            p: the vertex.
            beta: throughput up to the vertex [1].
            u: uniform random number in [0, 1) for the emitter, and for drawing such a direction.
            active: lanes that may aim; the share of other lanes is 0.
        """
        emitters, bound = self.direct.emitters, 1 - dr.max(beta) / MAX_AIMED_THROUGHPUT
        part = dr.clip(bound, 0, MAX_AIMED_SHARE)
        if len(self._mixed) <= MAX_MIXED:
            shares = [part * probability for probability in emitters.probabilities_at_point(p, self._mixed)]
            towards = [self._aim_at(p, mi.UInt32(n), s, active) for n, s in zip(self._mixed, shares, strict=True)]
            return AimedDirections([axis for axis, _ in towards], [share for _, share in towards], u)
        number, u = emitters.choose_at_point(p, u)
        if self._is_aimed is not None:
            part = part * dr.gather(mi.Float, self._is_aimed, number, active)
        axis, share = self._aim_at(p, number, part, active)
        return AimedDirections([axis], [share], u)

    def _aim_at(self, p: mi.Point3f, number: mi.UInt32, share: mi.Float, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """The direction from a vertex to an emitter, and the part of ``share`` that is worth spending on it [1]."""
        centre, radius = self.direct.emitters.ball(number)
        axis = mi.Vector3f(centre - p)
        distance = dr.norm(axis)
        is_far = active & (distance > MIN_AIMED_DISTANCE * radius)
        inverse = dr.rcp(dr.select(is_far, distance, 1))
        share = dr.select(is_far, share * (1 - MIN_AIMED_DISTANCE * radius * inverse), 0)
        return dr.select(is_far, axis * inverse, mi.Vector3f(0, 0, 1)), share

    def estimate(
        self,
        segment: PathSegment,
        length: mi.Float,
        samples: NearLightSamples,
        attached: bool,
        active: mi.Bool,
        known: tuple[NearLightPlace, mi.Bool] | None = None,
    ) -> NearLight:
        """Estimate the light of a segment of known length.

        Args:
            segment, length: the segment.
            samples: its random numbers.
            attached: keep derivatives.
            active: lanes to follow.
            known: the places found by an earlier walk of the same segments, and the lanes with a known place.
        """
        media, ray = self.media, segment.ray
        everywhere = active & segment.may_scatter
        on = everywhere if known is None else everywhere & ~known[1]
        rng, (chance,) = draw_pcg32(samples.rng, 1)
        # The light of camera rays has little noise in images, so the noise of look-ups would show.
        looks_up = None
        if self.looks_up:
            looks_up = mi.Bool(True) if self.probe_depth else segment.depth > 0
        # -- The distance ------------------------------------------------------------------------------------------------
        chosen = self.emitters.choose_emitter(ray, samples.which_emitter)
        passed = RaySegment(ray, segment.medium, length)
        if self.draws_points:
            event, reach, is_exact, rng = self._draw_point(passed, chosen, rng, on)
        else:
            event, reach, is_exact, rng = self._draw_in_cells(passed, chosen, samples.inside, rng, looks_up, on)
        if known is not None:
            place, is_known = known
            event.t, event.body = dr.select(is_known, place.t, event.t), dr.select(is_known, place.body, event.body)
            stored = [place.sigma_t] if media.channels == 1 else to_components(place.sigma_t)
            event.sigma_t = [dr.select(is_known, s, found) for s, found in zip(stored, event.sigma_t, strict=True)]
            event.on = dr.select(is_known, everywhere & dr.any(mi.Spectrum(place.reach) > 0), event.on)
            reach = dr.select(is_known, place.reach, reach)
        gain = dr.select(event.on, segment.beta * reach, 0)
        # -- Direct light ------------------------------------------------------------------------------------------------
        mei = event_interaction(media, ray, event)
        sample = self.direct.sample_near_emitter(mei, chosen, samples.emitter, event.on)
        vertex = MediumVertex(media, mei, point_along(ray, event.t))
        shadows = None if known is None else (known[0].shadow, known[1])
        direct = self.direct.estimate_at_vertex(vertex, sample, attached, event.on, rng, shadows, looks_up)
        sigma_t, sigma_s = event_coefficients(media, ray, event, mei, is_exact)
        light = ScatteredLight(media, segment, Scattering(event, mei, gain, [direct], sigma_t, sigma_s, chance))
        shadow = DirectLight(media, direct.ray_segment, light.value, direct.on)
        found = [to_spectrum(event.sigma_t), mi.Spectrum(reach), mi.Spectrum(direct.T)]
        place = NearLightPlace(event.t, event.body, *(found if media.channels > 1 else [row[0] for row in found]))
        if direct.shadow is None:
            return NearLight(light, shadow, chance, place)
        return NearLight(light, shadow, chance, place, direct.shadow.times(sigma_s * gain))

    def _draw_in_cells(
        self,
        passed: RaySegment,
        chosen: ChosenEmitter,
        u: mi.Point2f,
        rng: mi.UInt32,
        looks_up: mi.Bool | None,
        active: mi.Bool,
    ) -> tuple[MediumEvent, mi.Spectrum, bool, mi.UInt32]:
        """Draw a distance in one of the cells of coarse grids, or in a homogeneous medium.

        Returns:
            The event, the transmittance up to the event over the density of the distance, whether its extinction is known, and
            the state of the generator.
        """
        proposal = DistanceProposal(self.media, passed.ray, chosen, None, self.probe_depth, is_rough=True)
        reservoir = refill_reservoir(proposal, passed, start_reservoir(self.media, [rng]), active)
        (candidate,) = reservoir.candidates
        event = sample_distance(proposal, candidate, reservoir.total, u, active)
        T = transmittance(event.tau)
        if not proposal.is_exact:
            before = RaySegment.upto(passed.ray, passed.medium, event.t)
            T = segment_transmittance(self.media, before, event.on, fork_state(candidate.rng, 1), looks_up)
        return event, dr.select(event.on, T / event.pdf, 0), proposal.is_exact, candidate.rng

    def _draw_point(
        self, passed: RaySegment, chosen: ChosenEmitter, rng: mi.UInt32, active: mi.Bool
    ) -> tuple[MediumEvent, mi.Spectrum, bool, mi.UInt32]:
        """The same by look-ups in a thin grid; the extinction is that of a corner of the cell."""
        point = draw_near_point(self.media, passed, chosen.equiangular, self.probe_depth, rng, active)
        unknown = [mi.Float(0) for _ in range(self.media.channels)]
        event = MediumEvent(point.t, point.t, mi.Float(1), unknown, point.sigma_t, point.body, point.on)
        return event, point.reach, True, point.rng
