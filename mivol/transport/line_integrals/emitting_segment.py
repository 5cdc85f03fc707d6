"""A path segment whose media emit: emission-absorption compositing, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.scores import FORWARD
from mivol.transport.estimators.segment import PathSegment, SegmentEstimate, SegmentLight, SegmentTransmittance
from mivol.transport.line_integrals.composite import Composite
from mivol.transport.line_integrals.emission import integrate_emission, vjp_emission
from mivol.transport.media.channels import spectrum
from mivol.transport.media.optical_depth import transmittance
from mivol.transport.media.ray_intervals import RaySegment, visit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import Strata

__all__ = ["Emission"]


class Emission:
    """The segment estimator for media that emit and absorb, without scattering.

    Bias and cost: as :func:`mivol.transport.line_integrals.emission.integrate_emission`. Variance: none.
    """

    directions = "none"
    ends_in_media = False

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> Any:
        """Draw nothing: the estimate is deterministic."""

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Nothing is needed."""

    def replayed(self) -> Emission:
        """The light of emission is met again by a replay."""
        return self

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        """Follow a segment to its end and sum its emission, for the purpose PICTURE, REVERSE or FORWARD."""
        media = self.media
        end, _ = visit_media(media, segment.ray, segment.medium, lambda state, _: state, mi.Float(0), active)
        passed = RaySegment(segment.ray, segment.medium, end.t)
        composite = integrate_emission(media, passed, active, tangent=purpose == FORWARD)
        shared = _EmittingSegment(media, segment, passed, composite, active)
        light = SegmentLight(shared, dr.select(active, shared.seen * shared.rows(0), 0), is_replayed=True)
        T = transmittance([mi.Float(t) for t in composite.tau[: media.channels]])
        return SegmentEstimate(end, T, light, SegmentTransmittance(shared))


@dataclass
class _EmittingSegment:
    """A segment with its composite: the derivatives of its light and of its transmittance (a ``SharedSegment``).

    The rows of the composite are the light of each colour; those of its tangent follow, where it is asked for.
    """

    media: SceneMedia
    segment: PathSegment
    passed: RaySegment
    composite: Composite
    active: mi.Bool
    dL: mi.Spectrum | None = None

    @property
    def seen(self) -> mi.Spectrum:
        """What multiplies the light of the media."""
        weight = self.segment.emission_weight
        return self.segment.beta if weight is None else self.segment.beta * weight

    def rows(self, block: int) -> mi.Spectrum:
        """The light (block 0), or its tangent (block 1)."""
        k = dr.size_v(mi.Spectrum)
        return mi.Spectrum(*self.composite.N[block * k : (block + 1) * k])

    def vjp_light(self, dL: mi.Spectrum) -> None:
        """Do nothing yet: the sweep in :meth:`vjp` finds the derivatives of light and transmittance together."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        vjp_emission(self.media, self.passed, self.composite, self.dL * self.seen, dlog, self.active)

    def jvp_light(self) -> mi.Spectrum:
        return dr.select(self.active, self.seen * self.rows(1), 0)

    def jvp_transmittance(self) -> mi.Spectrum:
        k = dr.size_v(mi.Spectrum)
        dtau = spectrum([mi.Float(t) for t in self.composite.tau[k : k + self.media.channels]])
        return -dr.select(self.active, dtau, 0)
