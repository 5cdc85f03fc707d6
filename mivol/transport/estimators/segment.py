r"""What a path segment through media does to the light behind it: it adds light of its own and lets a share through.

.. math:: L = L_{media} + T\, L_{behind}

A segment runs from one surface to the next. A :class:`SegmentEstimator` says how its light is found: not at all
(:class:`Absorption`), by one scattering, by emission. Both parts carry their derivatives (:mod:`.contribution`); where one walk
back serves both, they share a :class:`SharedSegment`, whose light is always told before its transmittance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from mivol.transport.estimators.contribution import Factor, Term
from mivol.transport.media.optical_depth import (
    integrate_optical_depth,
    jvp_optical_depth,
    transmittance,
    vjp_optical_depth,
)
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.strata import Strata

__all__ = [
    "FORWARD",
    "PICTURE",
    "REVERSE",
    "Absorption",
    "PathSegment",
    "SegmentEstimate",
    "SegmentEstimator",
    "SegmentLight",
    "SegmentTransmittance",
    "SharedSegment",
    "Transmittance",
]

PICTURE, REVERSE, FORWARD = "picture", "reverse", "forward"
"""What a path is followed for: its radiance, the gradients of what it met, or the tangent of its radiance."""


@dataclass
class PathSegment:
    """The segment that lies ahead of a path.

    Attributes:
        ray, medium: where it begins, and what surrounds its origin.
        beta: throughput to there.
        scatters: lanes whose path may turn once more.
        samples: random numbers that the estimator has drawn; None where it needs none.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    beta: mi.Spectrum
    scatters: mi.Bool
    samples: Any


@dataclass
class SegmentEstimate:
    """What was found along a segment.

    Attributes:
        end: where it ends.
        T: share of the light behind that its media let through, or an estimate of it.
        light: what its media add; None where they add nothing.
        transmittance: what they let through of the light behind.
    """

    end: SegmentEnd
    T: mi.Spectrum
    light: Term | None
    transmittance: Factor


class SegmentEstimator(Protocol):
    """How the light of a segment is found. ``directions`` tells the film which lanes may share out the unit square."""

    directions: str

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> Any:
        """Draw the random numbers of one segment."""

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        """Follow a segment to its end, for PICTURE, REVERSE or FORWARD."""


class Transmittance:
    """The factor of a segment whose media only take light away."""

    def __init__(self, media: SceneMedia, segment: RaySegment, active: mi.Bool) -> None:
        self.media, self.segment, self.active = media, segment, active

    def vjp(self, dlog: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.segment, -dlog, self.active)

    def jvp(self) -> mi.Spectrum:
        return -jvp_optical_depth(self.media, self.segment, self.active)


class Absorption:
    """Media add nothing: the exact optical depth, and no random number.

    Args:
        media: of the scene.
        drawn_by: an estimator whose random numbers are drawn all the same, so that a path that is followed again turns alike.

    Bias: that of the walk, none but rounding. Variance: none. Cost: one walk of each medium.
    """

    directions = "none"

    def __init__(self, media: SceneMedia, drawn_by: SegmentEstimator | None = None) -> None:
        self.media, self.drawn_by = media, drawn_by

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> Any:
        if self.drawn_by is not None:
            self.drawn_by.draw(sampler, active, strata)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        end, tau = integrate_optical_depth(self.media, segment.ray, segment.medium, active)
        passed = RaySegment(segment.ray, segment.medium, end.t)
        return SegmentEstimate(end, transmittance(tau), None, Transmittance(self.media, passed, active))


class SharedSegment(Protocol):
    """Derivatives of a segment's light and transmittance that are found in one walk.

    Attributes:
        dL: d loss / d light, noted when the light was told.
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
