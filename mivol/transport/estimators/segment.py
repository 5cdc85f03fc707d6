r"""The protocol of segment estimators: light that media add along a path segment, and the transmittance of the segment.

.. math:: L = L_{media} + T\, L_{behind}

A segment runs from one event to the next: an opaque surface or, for estimators that end segments in media, a collision. A
:class:`SegmentEstimator` computes its light: none (:class:`Absorption`), single scattering, or emission. Light and
transmittance carry their derivatives as a term and a factor (:mod:`.scores`). Where one walk of the cells gives the
derivatives of both, they share a :class:`SharedSegment`; the walk reports the term first, then the factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.shadow_rays import estimate_transmittance
from mivol.transport.estimators.scores import Factor, Term
from mivol.transport.media.optical_depth import (
    integrate_optical_depth,
    jvp_optical_depth,
    transmittance,
    vjp_optical_depth,
)
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.media.uniform_points import UniformPoint
from mivol.transport.traversal.random_numbers import Strata, draw_pcg32, seed_pcg32
from mivol.transport.traversal.rays import Ray

__all__ = [
    "Absorption",
    "Collision",
    "FlightPoint",
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
    """The segment that lies ahead of a path.

    Attributes:
        ray: world space, unit direction.
        medium: the medium around its origin.
        beta: throughput of the path to there.
        may_scatter: lanes whose path may scatter once more.
        samples: random numbers that the estimator has drawn; None where it needs none.
        depth: number of scattering events of the path so far.
        is_side_flight: a side flight, which the path does not take itself (:mod:`mivol.transport.path.side_flight`).
        emission_weight: of the light that media emit along it, where that was drawn at its origin too; None for 1.
    """

    ray: Ray
    medium: mi.MediumPtr
    beta: mi.Spectrum
    may_scatter: mi.Bool
    samples: Any
    depth: mi.UInt32
    is_side_flight: bool = False
    emission_weight: mi.Float | None = None


@dataclass
class Collision:
    """A collision with a medium that ends the flight along a segment.

    Attributes:
        mei: the point, and its medium, as Mitsuba's phase functions are evaluated at it.
        p: the point in float64.
        albedo: probability [1] that it scatters, of each colour.
        on: lanes whose flight ends so; the others reach the end of their segment.
        t: its distance on the ray [length].
        body: index of its medium.
    """

    mei: mi.MediumInteraction3f
    p: mi.Point3d
    albedo: mi.Spectrum
    on: mi.Bool
    t: mi.Float64
    body: mi.UInt32


@dataclass
class FlightPoint:
    """A point that is drawn evenly from a flight.

    Attributes:
        point: the point.
        gain: throughput to it, times the length that it stands for.
        chance: a number in [0, 1), by which one of several flights' points is kept.
    """

    point: UniformPoint
    gain: mi.Spectrum
    chance: mi.Float


@dataclass
class SegmentEstimate:
    """The result of a segment estimator.

    Attributes:
        end: where the segment ends.
        T: transmittance of its media, of each colour, or an estimate of it.
        light: the light of its media; None where they add none.
        transmittance: the factor of the light behind.
        collision: where the path meets a medium before that end; None of estimators whose paths go straight on.
        probe: for derivatives, a point of the flight at which they may be looked at besides; None where none is needed.
    """

    end: SegmentEnd
    T: mi.Spectrum
    light: Term | None
    transmittance: Factor
    collision: Collision | None = None
    probe: FlightPoint | None = None


class SegmentEstimator(Protocol):
    """How the light of a segment is estimated.

    Attributes:
        directions: the layout of lanes that its directions need (:func:`mivol.transport.path.film.film_passes`).
        ends_in_media: a segment may end at a collision with a medium, where the path scatters.
    """

    directions: str
    ends_in_media: bool

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> Any:
        """Draw the random numbers of one segment; whatever is returned becomes ``PathSegment.samples``."""

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        """Follow a segment to its end, for IMAGE, REVERSE or FORWARD."""

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Find what derivatives along camera rays need beforehand; called before each pass, and done once."""

    def replayed(self) -> SegmentEstimator:
        """The estimator of the light that a replay finds again, without light that is sampled anew for its derivatives.

        It consumes the same random numbers, so that both passes follow the same path.
        """


class Transmittance:
    """The factor of a segment: the exact transmittance of its media."""

    def __init__(self, media: SceneMedia, segment: RaySegment, active: mi.Bool) -> None:
        self.media, self.segment, self.active = media, segment, active

    def vjp(self, dlog: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.segment, -dlog, self.active)

    def jvp(self) -> mi.Spectrum:
        return -jvp_optical_depth(self.media, self.segment, self.active)


class Absorption:
    """The segment estimator for media that only absorb: exact transmittance, no light.

    Args:
        media: of the scene.
        drawn_by: an estimator whose random numbers are drawn and not used, so that a replay with it follows the same path.

    Bias: that of the walk, none but rounding. Variance: none. Cost: one walk of each medium.
    """

    directions = "none"
    ends_in_media = False

    def __init__(self, media: SceneMedia, drawn_by: SegmentEstimator | None = None) -> None:
        self.media, self.drawn_by = media, drawn_by

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> Any:
        if self.drawn_by is not None:
            self.drawn_by.draw(sampler, active, strata)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        end, tau = integrate_optical_depth(self.media, segment.ray, segment.medium, active)
        passed = RaySegment(segment.ray, segment.medium, end.t)
        return SegmentEstimate(end, transmittance(tau), None, Transmittance(self.media, passed, active))

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Nothing is needed."""

    def replayed(self) -> Absorption:
        return self


class SharedSegment(Protocol):
    """Derivatives of a segment's light and of its transmittance that come from one walk of its cells.

    Attributes:
        dL: d loss / d light, known once the term was reported.
    """

    dL: mi.Spectrum | None

    def vjp_light(self, dL: mi.Spectrum) -> None:
        """Derivatives of the light that need no walk of the segment."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        """All other derivatives: of the light, weighted by ``dL``, and of log T, weighted by ``dlog``."""

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


class TrackedAbsorption:
    """The segment estimator for media that only absorb, of which some are known by a majorant only.

    Args:
        media: of the scene.

    Bias: none, of the radiance and of its derivatives. Variance: that of ratio tracking, and of one point for derivatives.
    Cost: one walk of each exact medium; look-ups in proportion to the majorants of the others.
    """

    directions = "none"
    ends_in_media = False

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> mi.Float:
        """One number in every lane.

        Not in ``active`` lanes only, which are those that may scatter once more: a sampler does not advance in the others, and
        would give them the same number at each segment.
        """
        return sampler.next_1d()

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        width = dr.width(segment.ray)
        rng = seed_pcg32(segment.samples, width)
        end, T = estimate_transmittance(self.media, segment.ray, segment.medium, active, rng)
        _, (u,) = draw_pcg32(seed_pcg32(segment.samples, width, 1), 1)
        passed = RaySegment(segment.ray, segment.medium, end.t, u=u)
        return SegmentEstimate(end, T, None, Transmittance(self.media, passed, active))

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Nothing is needed."""

    def replayed(self) -> TrackedAbsorption:
        """This estimator: a replay draws the same numbers, and finds the same transmittance again."""
        return self
