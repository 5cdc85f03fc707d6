r"""Segment estimators: the light that media add along a segment of a path, and the transmittance of the segment.

.. math:: L = L_{media} + T\, L_{behind}

A segment runs from one event to the next: to an opaque surface or, with some estimators, to a collision. A
:class:`SegmentEstimator` computes the light of the media: none (:class:`Absorption`), emission, or scattered light. Light and
transmittance carry their derivatives as a term and a factor (:mod:`.scores`). If one walk of the cells computes the derivatives
of both, term and factor share a :class:`SharedSegment`; the path reports the term first, then the factor.

:class:`TrackedAbsorption` serves media with a known majorant only. Its estimate of T is ratio tracking
(:mod:`.flights.tracking`). The point t of a derivative is drawn uniformly over the length l in the medium, independently of T,
so the product :math:`\partial L = -L\,\ell\;\partial\sigma(t)` is unbiased too.

References: Novak et al. 2014 (ratio tracking).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.shadow_rays import estimate_transmittance
from mivol.transport.estimators.scores import Factor, Term
from mivol.transport.media.optical_depth import (
    integrate_optical_depth,
    jvp_optical_depth,
    segment_optical_depth,
    transmittance,
    vjp_optical_depth,
)
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd, UniformPoint, find_end
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, draw_state, fork_state
from mivol.transport.traversal.rays import Ray

__all__ = [
    "Absorption",
    "AbsorptionToLamps",
    "Collision",
    "FlightPoint",
    "KnownFlight",
    "PathSegment",
    "SegmentEstimate",
    "SegmentEstimator",
    "SegmentLight",
    "SegmentTransmittance",
    "SharedSegment",
    "Transmittance",
    "TrackedAbsorption",
]


@dataclass
class PathSegment:
    """The next segment of a path.

    Attributes:
        ray: ray in world space, with a unit direction.
        medium: medium around the origin of the ray.
        beta: throughput up to the origin [1].
        may_scatter: lanes whose path may scatter once more.
        samples: random numbers drawn by the estimator; None without random numbers.
        depth: number of scattering events so far.
        is_side_flight: a flight beside the path (:mod:`mivol.transport.path.side_flight`).
        emission_weight: weight of the emission of media along the segment, if the origin has sampled their emission too [1];
            None means a weight of 1.
        known: flights found before, for estimators whose segments end in media; None without such flights.
        needs_surface: whether the surface at the end is needed behind a collision too.
    """

    ray: Ray
    medium: mi.MediumPtr
    beta: mi.Spectrum
    may_scatter: mi.Bool
    samples: Any
    depth: mi.UInt32
    is_side_flight: bool = False
    emission_weight: mi.Float | None = None
    known: KnownFlight | None = None
    needs_surface: bool = False


@dataclass
class KnownFlight:
    """The first collision along a segment, found before the path follows the segment.

    Attributes:
        t: distance of the collision on the ray [length]; infinite without a collision.
        body: index of its medium.
        on: lanes in which the collision is known.
        meets_no_surface: lanes in which no surface lies in front of the collision, or on the whole ray without a collision, so
            nothing is traced; None if unknown.
        weight: weight of each channel of an rgb extinction at the end of the flight [1]; None in grey scenes, and for
            collisions at which paths begin.
    """

    t: mi.Float64
    body: mi.UInt32
    on: mi.Bool
    meets_no_surface: mi.Bool | None = None
    weight: mi.Spectrum | None = None

    def at(self, index: mi.UInt32, active: mi.Bool) -> KnownFlight:
        """The flights of other lanes, known where ``active``."""
        t, body = dr.gather(mi.Float64, self.t, index, active), dr.gather(mi.UInt32, self.body, index, active)
        weight = None if self.weight is None else dr.gather(mi.Spectrum, self.weight, index, active)
        return KnownFlight(t, body, active, weight=weight)

    def forget(self) -> KnownFlight:
        """The same in no lane."""
        return replace(self, on=dr.full(mi.Bool, False, dr.width(self.on)))


@dataclass
class Collision:
    """A collision with a medium, ending the flight along a segment.

    Attributes:
        mei: position and medium, for evaluating Mitsuba's phase functions.
        p: position in float64.
        albedo: probability of scattering [1], for each colour.
        on: lanes with a collision; other lanes reach the end of their segment.
        t: distance on the ray [length].
        body: index of the medium.
    """

    mei: mi.MediumInteraction3f
    p: mi.Point3d
    albedo: mi.Spectrum
    on: mi.Bool
    t: mi.Float64
    body: mi.UInt32


@dataclass
class FlightPoint:
    """A point drawn uniformly from a flight.

    Attributes:
        point: the point.
        gain: throughput up to the point, times the sampled length [length].
    """

    point: UniformPoint
    gain: mi.Spectrum


@dataclass
class SegmentEstimate:
    """The result of a segment estimator.

    Attributes:
        end: end of the segment.
        T: transmittance of the media, or an estimate, for each colour [1].
        light: light of the media; None if they add no light.
        transmittance: factor on the light behind the segment.
        collision: collision with a medium before the end; None from estimators without collisions.
        probe: point of the flight for derivatives; None in images, from estimators without probes, and if collisions suffice.
        chance: uniform random number in [0, 1), which selects one probe and one shadow ray of a path; None in images and from
            estimators without collisions.
    """

    end: SegmentEnd
    T: mi.Spectrum
    light: Term | None
    transmittance: Factor
    collision: Collision | None = None
    probe: FlightPoint | None = None
    chance: mi.Float | None = None


class SegmentEstimator(Protocol):
    """An estimator of the light and the transmittance of a segment.

    Attributes:
        ends_in_media: segments may end at collisions with media, where the path scatters.
    """

    ends_in_media: bool

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> Any:
        """Draw the random numbers of a segment, for ``PathSegment.samples``."""

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        """Follow a segment to the end, for the purpose IMAGE, REVERSE or FORWARD."""

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Prepare for derivatives along camera rays; called before each pass, with an effect in the first call only."""

    def replayed(self) -> SegmentEstimator:
        """The estimator of the light found again by a replay, without light sampled anew for its derivatives.

        It consumes the same random numbers, so both passes follow the same path.
        """


# -- Light and transmittance with common derivatives ---------------------------------------------------------------------


class SharedSegment(Protocol):
    """Derivatives of a segment's light and of its transmittance, computed in one walk of its cells.

    Attributes:
        dL: d loss / d light, known after the path has reported the term.
    """

    dL: mi.Spectrum | None

    def vjp_light(self, dL: mi.Spectrum) -> None:
        """Add derivatives of the light that need no walk of the segment."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        """Add all other derivatives: of the light, weighted by ``dL``, and of log T, weighted by ``dlog``."""

    def jvp_light(self) -> mi.Spectrum:
        """Tangent of the light."""

    def jvp_transmittance(self) -> mi.Spectrum:
        """Tangent of log T."""


@dataclass
class SegmentLight:
    """The light of a shared segment, as a term."""

    shared: SharedSegment
    value: mi.Spectrum
    is_replayed: bool

    def vjp(self, dL: mi.Spectrum) -> None:
        self.shared.dL = dL
        self.shared.vjp_light(dL)

    def jvp(self) -> mi.Spectrum:
        return self.shared.jvp_light()


@dataclass
class SegmentTransmittance:
    """The transmittance of a shared segment, as a factor."""

    shared: SharedSegment

    def vjp(self, dlog: mi.Spectrum) -> None:
        self.shared.vjp(dlog)

    def jvp(self) -> mi.Spectrum:
        return self.shared.jvp_transmittance()


# -- Absorption ----------------------------------------------------------------------------------------------------------


class Transmittance:
    """The exact transmittance of a segment's media, as a factor."""

    def __init__(self, media: SceneMedia, segment: RaySegment, active: mi.Bool) -> None:
        self.media, self.segment, self.active = media, segment, active

    def vjp(self, dlog: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.segment, -dlog, self.active)

    def jvp(self) -> mi.Spectrum:
        return -jvp_optical_depth(self.media, self.segment, self.active)


class Absorption:
    """The segment estimator for media that only absorb: exact transmittance, no light.

    Args:
        media: media of the scene.
        drawn_by: estimator whose random numbers are drawn and ignored, so that a replay with Absorption follows the same path.

    Bias: none but rounding. Variance: none. Cost: one walk of each medium.
    """

    ends_in_media = False

    def __init__(self, media: SceneMedia, drawn_by: SegmentEstimator | None = None) -> None:
        self.media, self.drawn_by = media, drawn_by

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> Any:
        if self.drawn_by is not None:
            self.drawn_by.draw(sampler, active)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        end, tau, passages = integrate_optical_depth(self.media, segment.ray, segment.medium, active)
        passed = RaySegment(segment.ray, segment.medium, end.t, passages=passages)
        return SegmentEstimate(end, transmittance(tau), None, Transmittance(self.media, passed, active))

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Needs no preparation."""

    def replayed(self) -> Absorption:
        return self


class AbsorptionToLamps(Absorption):
    """The same for the light of lamps seen directly: rays walk the media in front of a lamp, or of a surface through which a
    lamp may shine. Other rays carry no light, and have a transmittance of 1.

    Cost: one walk of each medium, in packets of rays that see a lamp.
    """

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        end = find_end(self.media, segment.ray, segment.medium, active)
        hit = active & end.si.is_valid()
        lit = hit & ((end.si.emitter(self.media.scene, hit) != None) | mi.has_flag(end.si.bsdf().flags(), mi.BSDFFlags.Null))
        passed = RaySegment(segment.ray, segment.medium, end.t)
        tau = segment_optical_depth(self.media, passed, lit)
        return SegmentEstimate(end, transmittance(tau), None, Transmittance(self.media, passed, active))


class TrackedAbsorption:
    """The segment estimator for media that only absorb, some with a known majorant only.

    Args:
        media: media of the scene.

    Bias: none, for the radiance and the derivatives. Variance: ratio tracking, and one point for derivatives. Cost: one walk of
    each exact medium; look-ups in proportion to the majorants of the others.
    """

    ends_in_media = False

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> mi.UInt32:
        """Draw a generator in every lane.

        ``active`` lanes are the lanes allowed to scatter once more. A sampler does not advance in other lanes, and would return
        the same number there at each segment.
        """
        return draw_state(sampler)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        end, T = estimate_transmittance(self.media, segment.ray, segment.medium, active, segment.samples)
        _, (u,) = draw_pcg32(fork_state(segment.samples, 1), 1)
        passed = RaySegment(segment.ray, segment.medium, end.t, u=u)
        return SegmentEstimate(end, T, None, Transmittance(self.media, passed, active))

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Needs no preparation."""

    def replayed(self) -> TrackedAbsorption:
        """This estimator: a replay draws the same numbers, and finds the same transmittance again."""
        return self
