r"""Derivatives of free flights, with respect to the coefficients of media along the flights and at their collisions.

.. math:: \partial L = \int_0^D T \left( \partial\sigma\,(\alpha L_s - L_t) + \sigma\,\partial\alpha\,L_s \right) dt

with the in-scattered radiance L_s at t, and the radiance L_t arriving at t from further along the ray. A flight of length t
with the radiance L at the end estimates this derivative by

.. math:: -\int_0^t (L - b)\,\partial\sigma\,dt' + (L - b)\,\frac{\partial\sigma(t)}{\sigma(t) + \kappa}\,[\text{collision}]
          + \ell\,(\alpha \hat L_s - b)\,\frac{\kappa\,\partial\sigma(s)}{\sigma(s) + \kappa}

The first term is an exact walk along the flight. Collisions alone would miss the derivative in regions without extinction.
Therefore collisions have the weight sigma / (sigma + kappa), and a probe has the rest: a point s drawn uniformly from the
length l of the flight in the media. Both are unbiased, since the mean over all flights of an integral over [0, t] is the
integral of T times its integrand. A baseline b about as bright as L removes most of the noise (:mod:`.baseline`); inside the
integral it stands at t', at collisions at t, and at probes at s.

A homogeneous medium that is thick enough to make paths collide needs no probes: kappa is 0. Without followed extinction there
are neither probes nor kept shadow rays.

For an albedo below ``MIN_ALBEDO``, the probe estimates the derivative by the albedo, in place of L / albedo.

A path keeps few of these points and shadow rays, by weighted reservoir sampling (Chao 1982): one probe from its flights before
the first scattering event, one probe from its later flights, and one of its shadow rays, in proportion to the light of each.
The derivative along the kept shadow ray is divided by the probability of having been kept. The mean does not change, and the
noise hardly changes if one vertex carries most of a path's light.

References: Vicini et al. 2021 (path replay); Nimier-David et al. 2022 (probes in regions without extinction); Yu et al. 2026
(one point for both terms).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flights.baseline import Baseline, BaselineSums
from mivol.transport.estimators.flights.gaussian_light import GaussianLight
from mivol.transport.estimators.lighting.direct_lighting import DirectLight
from mivol.transport.estimators.segment import Collision, FlightPoint, PathSegment
from mivol.transport.media.body import Body, emission_slope, eval_albedo, eval_emission, medium_interaction
from mivol.transport.media.extinction import Weight, colours_to_channels, take_tangent, to_spectrum
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth, vjp_rows
from mivol.transport.media.ray_intervals import RaySegment, start_passages
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import FineRay, Ray

__all__ = [
    "MIN_ALBEDO",
    "FlightSegment",
    "Probe",
    "ProbeTerm",
    "Probes",
    "collision_weights",
    "ShadowReservoir",
    "ShadowTerm",
]


PROBE_TAU = 0.6
"""Optical depth of the extinction kappa across a medium [1] (measured in a box: 0.3 per half edge)."""

SURVIVAL = 4.0
"""The number c in the probability min(1, c kappa / (sigma + kappa)) with which a path keeps a probe at its end. In dense places
collisions carry the derivative. Where probes are left out, their variance is at most kappa l / (c - 1) of the variance of
collisions, with the length l of the flight."""

MIN_ALBEDO = 0.1
"""Albedo below which probes estimate the derivatives by the albedo [1]; above, L / albedo is at most 10 L."""


# -- A flight ------------------------------------------------------------------------------------------------------------


@dataclass
class FlightSegment:
    """A flight, with the derivatives of its emission and of its throughput (a ``SharedSegment``).

    Attributes:
        media: media of the scene.
        segment: segment of the path, with its throughput.
        passed: ray up to the end of the flight.
        collision: collision at the end of the flight.
        weight: weight of each channel at the end of the flight [1].
        baseline: baseline b; None means 0.
        emission: sampled point of the emission; None without emission by position.
        gaussian_light: light of Gaussians; None without emitting Gaussians.
        active: lanes that fly.
        dL: d loss / d emission, known after the path has reported the emission.
    """

    media: SceneMedia
    segment: PathSegment
    passed: RaySegment
    collision: Collision
    weight: mi.Spectrum
    baseline: Baseline | None
    emission: FlightPoint | None
    gaussian_light: GaussianLight | None
    active: mi.Bool
    dL: mi.Spectrum | None = None

    @property
    def _scattered(self) -> mi.Spectrum:
        """Throughput at the end of the flight; 0 for paths that may not scatter any more, which have no baseline."""
        return dr.select(self.segment.may_scatter, self.segment.beta * self.weight, 0)

    @property
    def emitted(self) -> mi.Spectrum:
        """Light emitted by the media along the flight, at the camera."""
        total = mi.Spectrum(0) if self.gaussian_light is None else self.gaussian_light.value()
        if self.emission is None:
            return total
        ray, point = self.segment.ray, self.emission.point
        for body, on in self.media.bodies_at(point.body, point.on):
            if _emits_at_points(body):
                light = self.emission.gain * dr.detach(eval_emission(body, ray, point.t, self.media.channels, on))
                total += dr.select(on, light, 0)
        return total

    # -- Emission --------------------------------------------------------------------------------------------------------

    def vjp_light(self, dL: mi.Spectrum) -> None:
        """Add the derivatives of the emission, and of the media in front of its sampled point."""
        if self.gaussian_light is not None:
            self.gaussian_light.vjp(dL)
        if self.emission is None:
            return
        media, ray, sampled = self.media, self.segment.ray, self.emission
        value = mi.Spectrum(0)
        for body, on in media.bodies_at(sampled.point.body, sampled.point.on):
            if not _emits_at_points(body):
                continue
            with dr.resume_grad():
                emitted = eval_emission(body, ray, sampled.point.t, media.channels, on)
                if dr.grad_enabled(emitted):
                    dr.backward_from(dr.select(on, dL * sampled.gain * emitted, 0))
            value = dr.select(on, dr.detach(emitted), value)
            for name, slope in _emission_slopes(body, ray, sampled.point.t, on):
                body.vjp_extinction_at(
                    ray, sampled.point.t, colours_to_channels(dL * sampled.gain * slope, media.channels), on, name
                )
        vjp_optical_depth(media, self._to_emission, -dL * sampled.gain * value, sampled.point.on)

    def jvp_light(self) -> mi.Spectrum:
        total = mi.Spectrum(0)
        if self.baseline is not None:
            b = _baseline_of_tangents(self.media, self.baseline, self.segment.ray, self.active)
            total -= self._scattered * b * self._jvp_extinction
        if self.gaussian_light is not None:
            total += self.gaussian_light.jvp()
        if self.emission is None:
            return total
        media, ray, sampled = self.media, self.segment.ray, self.emission
        value, change = mi.Spectrum(0), mi.Spectrum(0)
        for body, on in media.bodies_at(sampled.point.body, sampled.point.on):
            if not _emits_at_points(body):
                continue
            with dr.resume_grad():
                emitted = eval_emission(body, ray, sampled.point.t, media.channels, on)
                tangent = take_tangent(emitted)
            for name, slope in _emission_slopes(body, ray, sampled.point.t, on):
                tangent += slope * to_spectrum(body.jvp_extinction_at(ray, sampled.point.t, media.channels, on, name))
            value, change = dr.select(on, dr.detach(emitted), value), dr.select(on, tangent, change)
        change -= value * jvp_optical_depth(media, self._to_emission, sampled.point.on)
        return total + dr.select(sampled.point.on, sampled.gain * change, 0)

    @property
    def _to_emission(self) -> RaySegment:
        front = RaySegment.upto(self.segment.ray, self.segment.medium, self.emission.point.t)
        front.u = self.passed.u
        return front

    # -- Throughput ------------------------------------------------------------------------------------------------------

    def vjp(self, dlog: mi.Spectrum) -> None:
        media, ray, hit = self.media, self.segment.ray, self.collision
        self._vjp_passed(dlog)
        for body, on in media.bodies_at(hit.body, hit.on & self.segment.may_scatter):
            name, weight = _collision_weight(media, body, ray, hit.t, on)
            rest = dlog
            if self.baseline is not None:
                rest = rest - self.dL * self._scattered * self.baseline.at_point(body, ray, hit.t, on)
            body.vjp_extinction_at(
                ray, dr.select(on, hit.t, 0), colours_to_channels(dr.select(on, rest * weight, 0), media.channels), on, name
            )
            if body.view.albedo is None:
                continue
            with dr.resume_grad():
                albedo = eval_albedo(body, hit.mei, on)
                if dr.grad_enabled(albedo):
                    dr.backward_from(dr.select(on, dlog * _albedo_ratio(albedo), 0))

    def _vjp_passed(self, dlog: mi.Spectrum) -> None:
        """Add the derivatives of the transmittance up to the end of the flight."""
        if self.baseline is None:
            vjp_optical_depth(self.media, self.passed, -dlog, self.active)
            return
        scattered, channels = self.dL * self._scattered, self.media.channels

        def weight(body: Body) -> Weight:
            b = self.baseline.along(body, self.segment.ray, self.active)
            if callable(b):
                return lambda lower: colours_to_channels(scattered * b(lower) - dlog, channels)
            return colours_to_channels(scattered * b - dlog, channels)

        vjp_rows(self.media, self.passed, weight, self.active & dr.any((dlog != 0) | (scattered != 0)))

    def collect(self, sums: BaselineSums, L: mi.Spectrum, active: mi.Bool) -> None:
        """Add the collision at the end of the flight to the sums of a baseline.

        Args:
            sums: the sums.
            L: light behind the flight, at the camera [radiance].
            active: lanes whose collision counts.
        """
        hit, scattered = self.collision, self._scattered
        on = active & hit.on & self.segment.may_scatter & dr.any(scattered != 0)
        weight = scattered * collision_weights(self.media, self.segment.ray, hit)
        light = L / dr.select(scattered != 0, scattered, 1)
        sums.add(self.segment.ray, hit.t, hit.body, dr.square(weight), light, on)

    def jvp_transmittance(self) -> mi.Spectrum:
        media, hit, change = self.media, self.collision, mi.Spectrum(self._jvp_extinction)
        for body, on in media.bodies_at(hit.body, hit.on & self.segment.may_scatter):
            if body.view.albedo is None:
                continue
            with dr.resume_grad():
                tangent = take_tangent(_albedo_ratio(eval_albedo(body, hit.mei, on)))
            change += dr.select(on, tangent, 0)
        return change

    @cached_property
    def _jvp_extinction(self) -> mi.Spectrum:
        """Tangent of log throughput by the extinction, without the share of the probes."""
        media, ray, hit = self.media, self.segment.ray, self.collision
        change = -jvp_optical_depth(media, self.passed, self.active)
        for body, on in media.bodies_at(hit.body, hit.on & self.segment.may_scatter):
            name, weight = _collision_weight(media, body, ray, hit.t, on)
            tangent = to_spectrum(body.jvp_extinction_at(ray, dr.select(on, hit.t, 0), media.channels, on, name))
            change += dr.select(on, tangent * weight, 0)
        return change


# -- Kept points of flights ----------------------------------------------------------------------------------------------


@dataclass
class Probe:
    """A point of one of a path's flights, kept in proportion to the light it represents (weighted reservoir sampling).

    Attributes:
        ray: ray of the flight.
        t: distance of the point [length].
        body: index of its medium.
        gain: throughput up to the point, times the sampled length [length].
        depth: number of scattering events before the point.
        weight: reservoir weight of the point.
        total: total weight of the flights so far.
    """

    ray: FineRay
    t: mi.Float64
    body: mi.UInt32
    gain: mi.Spectrum
    depth: mi.UInt32
    weight: mi.Float
    total: mi.Float

    @classmethod
    def empty(cls, ray: Ray) -> Probe:
        """A reservoir before the first flight."""
        n = dr.width(ray)
        zero = dr.zeros(mi.Float, n)
        nothing = dr.zeros(mi.Float64, n), dr.zeros(mi.UInt32, n), dr.zeros(mi.Spectrum, n)
        return cls(FineRay.from_ray(ray), *nothing, dr.zeros(mi.UInt32, n), zero, zero)

    def offer(self, segment: PathSegment, flight_point: FlightPoint, chance: mi.Float, on: mi.Bool) -> Probe:
        """Offer the point of another flight to the reservoir; it is kept if ``chance`` is below weight / (total weight)."""
        point, gain = flight_point.point, flight_point.gain
        weight = dr.select(point.on & segment.may_scatter & on, dr.max(gain), 0)
        total = self.total + weight
        keep = chance * total < weight
        return Probe(
            dr.select(keep, segment.ray, self.ray),
            dr.select(keep, point.t, self.t),
            dr.select(keep, point.body, self.body),
            dr.select(keep, gain, self.gain),
            dr.select(keep, segment.depth, self.depth),
            dr.select(keep, weight, self.weight),
            total,
        )

    def thin(self, media: SceneMedia, chance: mi.Float) -> Probe:
        """Keep the probe if ``chance``, uniform in [0, 1), is below its survival probability (:data:`SURVIVAL`).

        A kept probe has the gain of the whole reservoir, over this probability, and a weight of 1.
        """
        survival, found = mi.Float(0), self.weight > 0
        mei = medium_interaction(self.ray, dr.select(found, self.t, 0))
        mei.medium = media.medium_of(self.body, found)
        for body, on in media.bodies_at(self.body, found):
            weight = dr.max(_collision_weight(media, body, self.ray, self.t, on)[1])
            share = dr.minimum(SURVIVAL * _probe_extinction(media, body) * weight, 1)
            if body.view.albedo is not None:
                # Such a probe has all of the derivative by the albedo, however dense the medium is.
                share = dr.select(dr.min(dr.detach(eval_albedo(body, mei, on))) < MIN_ALBEDO, 1, share)
            survival = dr.select(on, share, survival)
        kept = chance < survival
        gain = self.gain * (self.total / dr.select(kept, self.weight * survival, 1))
        weight = dr.select(kept, mi.Float(1), 0)
        return replace(self, gain=gain, weight=weight, total=weight)


@dataclass
class Probes:
    """The probes of a path: one of its flights before the first scattering event, one of its later flights.

    Later flights are few beside the first flights of the paths passing the media, and cause more than half of the noise. (With
    one probe for both, variance x time over all voxels was 1.2 to 1.4 times as large under a sun or a lamp, and the same in
    even light.)

    Attributes:
        first, later: the probes; None if not kept.
    """

    first: Probe | None
    later: Probe | None

    def offer(self, segment: PathSegment, flight_point: FlightPoint, chance: mi.Float) -> Probes:
        """Offer the point of another flight to the reservoir of its kind."""
        on = segment.depth == 0
        first = None if self.first is None else self.first.offer(segment, flight_point, chance, on)
        return Probes(first, None if self.later is None else self.later.offer(segment, flight_point, chance, ~on))


@dataclass
class ProbeTerm:
    """The derivatives at a probe, as a term of value 0.

    Attributes:
        media: media of the scene.
        probe: the probe.
        mei: position of the probe.
        source: estimate of the in-scattered radiance at the probe.
        baseline: baseline b; None means 0.
        on: lanes with a probe.
    """

    media: SceneMedia
    probe: Probe
    mei: mi.MediumInteraction3f
    source: mi.Spectrum
    baseline: Baseline | None
    on: mi.Bool
    is_replayed = True

    @property
    def value(self) -> mi.Spectrum:
        """Zero: the path has counted this light already."""
        return mi.Spectrum(0)

    @property
    def _gain(self) -> mi.Spectrum:
        return dr.select(self.on, self.probe.gain * (self.probe.total / dr.select(self.on, self.probe.weight, 1)), 0)

    def _weight(self, body: Body, on: mi.Bool, baseline: mi.Spectrum | None) -> tuple[str, mi.Spectrum]:
        """The name of the probe's coefficient, and the derivative of the light by this coefficient."""
        name, weight = _collision_weight(self.media, body, self.probe.ray, self.probe.t, on)
        bracket = self.source
        if body.view.albedo is not None:
            bracket = bracket * dr.detach(eval_albedo(body, self.mei, on))
        if baseline is not None:
            bracket = bracket - baseline
        return name, self._gain * bracket * _probe_extinction(self.media, body) * weight

    def vjp(self, dL: mi.Spectrum) -> None:
        media, probe = self.media, self.probe
        for body, on in media.bodies_at(probe.body, self.on):
            b = None if self.baseline is None else self.baseline.at_point(body, probe.ray, probe.t, on)
            name, weight = self._weight(body, on, b)
            body.vjp_extinction_at(
                probe.ray, probe.t, colours_to_channels(dr.select(on, dL * weight, 0), media.channels), on, name
            )
            if body.view.albedo is None:
                continue
            with dr.resume_grad():
                albedo = eval_albedo(body, self.mei, on)
                if dr.grad_enabled(albedo):
                    dr.backward_from(dr.select(on, dL * self._by_albedo(body, albedo, on) * albedo, 0))

    def jvp(self) -> mi.Spectrum:
        media, probe, total = self.media, self.probe, mi.Spectrum(0)
        b = None if self.baseline is None else _baseline_of_tangents(media, self.baseline, probe.ray, self.on)
        for body, on in media.bodies_at(probe.body, self.on):
            name, weight = self._weight(body, on, b)
            tangent = weight * to_spectrum(body.jvp_extinction_at(probe.ray, probe.t, media.channels, on, name))
            if body.view.albedo is not None:
                with dr.resume_grad():
                    albedo = eval_albedo(body, self.mei, on)
                    tangent += take_tangent(self._by_albedo(body, albedo, on) * albedo)
            total += dr.select(on, tangent, 0)
        return total

    def _by_albedo(self, body: Body, albedo: mi.Spectrum, on: mi.Bool) -> mi.Spectrum:
        """The derivative of the light by a small albedo, omitted at collisions."""
        sigma_t = to_spectrum(body.extinction_at(self.probe.ray, self.probe.t, self.media.channels, on))
        return dr.select(dr.detach(albedo) < MIN_ALBEDO, self._gain * sigma_t * self.source, 0)


# -- The kept shadow ray ------------------------------------------------------------------------------------------------


@dataclass
class ShadowReservoir:
    """The shadow ray kept from a path's shadow rays.

    Attributes:
        ray_segment: the ray.
        value: its light at the camera [radiance].
        weight: its reservoir weight.
        total: total weight of the shadow rays so far.
    """

    ray_segment: RaySegment
    value: mi.Spectrum
    weight: mi.Float
    total: mi.Float

    @classmethod
    def empty(cls, media: SceneMedia, ray: Ray) -> ShadowReservoir:
        """A reservoir before the first shadow ray."""
        n = dr.width(ray)
        zero = dr.zeros(mi.Float, n)
        u = zero if media.is_bounded else None
        return cls(
            RaySegment(FineRay.from_ray(ray), dr.zeros(mi.MediumPtr, n), zero, True, u, start_passages(media, n)),
            dr.zeros(mi.Spectrum, n),
            zero,
            zero,
        )

    def offer(self, light: DirectLight, chance: mi.Float) -> ShadowReservoir:
        """Offer another shadow ray to the reservoir.

        Args:
            light: light of the shadow ray; the weight is its largest channel.
            chance: uniform random number in [0, 1); the new ray is kept if chance is below weight / (total weight).
        """
        weight = dr.select(light.active, dr.max(dr.abs(light.value)), 0)
        total = self.total + weight
        keep, new, old = chance * total < weight, light.ray_segment, self.ray_segment
        kept = RaySegment(
            dr.select(keep, new.ray, old.ray),
            dr.select(keep, new.medium, old.medium),
            dr.select(keep, mi.Float(new.length), old.length),
            True,
            None if old.u is None else dr.select(keep, new.u, old.u),
            None if old.passages is None else dr.select(keep, new.passages, old.passages),
        )
        return ShadowReservoir(kept, dr.select(keep, light.value, self.value), dr.select(keep, weight, self.weight), total)


@dataclass
class ShadowTerm:
    """The derivatives of the media along the kept shadow ray, as a term of value 0."""

    media: SceneMedia
    kept: ShadowReservoir
    is_replayed = True

    @property
    def value(self) -> mi.Spectrum:
        """Zero: the path has counted this light already."""
        return mi.Spectrum(0)

    @property
    def _light(self) -> mi.Spectrum:
        """The light divided by the probability of having been kept."""
        kept = self.kept
        return dr.select(self._on, kept.value * (kept.total / dr.select(self._on, kept.weight, 1)), 0)

    @property
    def _on(self) -> mi.Bool:
        return self.kept.weight > 0

    def vjp(self, dL: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.kept.ray_segment, -dL * self._light, self._on)

    def jvp(self) -> mi.Spectrum:
        return -self._light * jvp_optical_depth(self.media, self.kept.ray_segment, self._on)


# -- Weights and slopes at points --------------------------------------------------------------------------------------


def _baseline_of_tangents(media: SceneMedia, baseline: Baseline, ray: Ray, active: mi.Bool) -> mi.Spectrum:
    """The baseline of the only medium with a tangent, if it is constant along a flight; else its mean.

    A baseline that varies along the flight would need a second walk. Flights and probes must have the same one, or their terms
    would not have the mean 0.
    """
    followed = [body for body in media.bodies if any(body.has_tangent)]
    b = baseline.along(followed[0], ray, active) if len(followed) == 1 else None
    return baseline.average if b is None or callable(b) else b


def collision_weights(media: SceneMedia, ray: Ray, hit: Collision) -> mi.Spectrum:
    """The weight of derivatives at collisions, 1 / (sigma + kappa) [length]; 0 without a collision."""
    weight = mi.Spectrum(0)
    for body, on in media.bodies_at(hit.body, hit.on):
        weight = dr.select(on, _collision_weight(media, body, ray, hit.t, on)[1], weight)
    return weight


def _collision_weight(media: SceneMedia, body: Body, ray: Ray, t: mi.Float64, on: mi.Bool) -> tuple[str, mi.Spectrum]:
    """The name of the coefficient sigma causing scattering collisions, and 1 / (sigma + kappa) [length] at a point."""
    name = "sigma_s" if body.view.albedo is None else "sigma_"
    sigma = to_spectrum(body.extinction_at(ray, dr.select(on, t, 0), media.channels, on, name))
    return name, dr.rcp(sigma + _probe_extinction(media, body))


def _probe_extinction(media: SceneMedia, body: Body) -> mi.Float:
    """The extinction kappa [1/length]: an optical depth of ``PROBE_TAU`` across the medium; 0 if collisions suffice."""
    if body.is_thick:
        return mi.Float(0)
    size = media.size if body.edge is None else body.edge
    # Without any shape nothing ends a flight but a collision, and collisions suffice.
    return dr.select(size > 0, PROBE_TAU / size, 0)


def _emits_at_points(body: Body) -> bool:
    """Whether the emission of a medium is a function of position (unlike the light of Gaussians)."""
    return body.view.emits and not body.view.shows_gaussians


def _albedo_ratio(albedo: mi.Spectrum) -> mi.Spectrum:
    """A large albedo over its own detached value, with the derivative of its logarithm; 0 for a small albedo."""
    value = dr.detach(albedo)
    large = value >= MIN_ALBEDO
    return dr.select(large, albedo * dr.rcp(dr.select(large, value, 1)), 0)


def _emission_slopes(body: Body, ray: Ray, t: mi.Float64, on: mi.Bool) -> list[tuple[str, mi.Spectrum]]:
    """The coefficient multiplying the emission, and the derivative of the emission by this coefficient."""
    if body.view.emission is None:
        return []
    name, slope = emission_slope(body, ray, t, on)
    return [(name, dr.detach(slope))]
