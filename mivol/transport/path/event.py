"""Events: how a segment of a path ends (collision with a medium, surface or escape), and the direction sampled there."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.refracted_light import REFRACTS, TRANSMITS
from mivol.transport.estimators.lighting.vertex import MediumVertex, MixedVertex, SurfaceVertex, Vertex
from mivol.transport.estimators.scores import TrackedFactor
from mivol.transport.estimators.segment import Collision, SegmentEstimate
from mivol.transport.estimators.single_scattering.near_light import AimedDirections
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import Estimators
from mivol.transport.traversal.rays import FineRay, Ray, spawn_ray

__all__ = ["GLASS", "DirectionSamples", "NextDirection", "PathEvent", "is_glass", "mirror_ray", "sample_next_direction"]


# -- The end of a segment ------------------------------------------------------------------------------------------------


@dataclass
class PathEvent:
    """The end of a segment.

    Attributes:
        si: surface hit; not valid in lanes whose path escapes from the scene.
        t: length of the segment up to the surface [length].
        medium: medium around the end of the segment.
        at_surface: lanes hitting a surface.
        collision: collision with a medium before the surface; None if segments never end in media.
        chance: uniform random number in [0, 1), by which a shadow ray of the path is kept for derivatives; None in images.
        in_medium: lanes colliding with a medium.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    at_surface: mi.Bool
    collision: Collision | None
    chance: mi.Float | None = None
    in_medium: mi.Bool = field(init=False)

    def __post_init__(self) -> None:
        self.in_medium = mi.Bool(False) if self.collision is None else self.collision.on

    @classmethod
    def from_estimate(cls, estimate: SegmentEstimate, active: mi.Bool) -> PathEvent:
        """The event at the end of a segment."""
        end, collision = estimate.end, estimate.collision
        reaches_end = active if collision is None else active & ~collision.on
        return cls(end.si, end.t, end.medium, reaches_end & end.si.is_valid(), collision, estimate.chance)

    def begin_at(self, collision: Collision) -> PathEvent:
        """These events, and in the lanes of a collision, whose paths have not moved, the event of a path beginning there."""
        on = collision.on
        merged = {f.name: dr.select(on, getattr(collision, f.name), getattr(self.collision, f.name)) for f in fields(Collision)}
        return PathEvent(self.si, self.t, self.medium, self.at_surface, Collision(**merged), self.chance)

    def omit_collisions(self, lanes: mi.Bool) -> PathEvent:
        """These events, without the collisions of some lanes."""
        return replace(self, collision=replace(self.collision, on=self.collision.on & ~lanes))

    def vertex(self, media: SceneMedia) -> Vertex:
        """The point at which light is scattered."""
        if self.collision is None:
            return SurfaceVertex(media, self.si, self.si.bsdf(), self.medium)
        inside = MediumVertex(media, self.collision.mei, self.collision.p)
        if not media.has_surfaces:
            return inside
        return MixedVertex(SurfaceVertex(media, self.si, self.si.bsdf(), self.medium), inside, self.collision.on)


TRANSMISSION = int(
    mi.BSDFFlags.Null | mi.BSDFFlags.DiffuseTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DeltaTransmission
)
"""Flags of BSDFs that transmit light."""


MIRRORS = 0.0
"""Smallest float32. Mitsuba's glass mirrors for numbers up to the reflectance, and then its density is the reflectance."""

GLASS = REFRACTS, int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.Null)
"""Flags of the BSDFs that only mirror and transmit."""


def is_glass(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a surface only mirrors and transmits."""
    components = si.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.All))
    return (components == GLASS[0]) | (components == GLASS[1])


def mirror_ray(
    media: SceneMedia, event: PathEvent, active: mi.Bool
) -> tuple[mi.Ray3f, mi.MediumPtr, mi.Spectrum, mi.Float]:
    """The ray mirrored by smooth glass at the end of a segment.

    Returns:
        The ray, the medium around the origin of the ray, the mirrored share of the light [1], and the probability of mirroring
        a path [1]; 0 in inactive lanes.
    """
    si = event.si
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(MIRRORS), mi.Point2f(0.5), active)
    on = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
    ray = spawn_ray(si, si.to_world(sample.wo), media.size)
    medium = dr.select(si.is_medium_transition(), si.target_medium(ray.d), event.medium)
    return ray, medium, dr.select(on, weight * sample.pdf, 0), dr.select(on, sample.pdf, 0)


# -- The direction onwards -----------------------------------------------------------------------------------------------


@dataclass
class NextDirection:
    """The direction in which a path continues after an event.

    Attributes:
        ray: ray of the next segment.
        medium: medium around the origin of the ray.
        weight: BSDF (times cosine) or phase function times albedo, over the density of the direction [1].
        pdf: density of the sampled direction among directions of the BSDF or phase function [1/sr].
        delta: lanes in which no emitter sample can find the light from this direction.
        eta: relative index of refraction [1].
        origin: interaction at which the direction was sampled.
        on: lanes that continue.
        through: lanes passing a surface without deviation.
        mirrored: lanes mirrored by a surface.
        factors: BSDF and phase function with their derivatives.
    """

    ray: FineRay
    medium: mi.MediumPtr
    weight: mi.Spectrum
    pdf: mi.Float
    delta: mi.Bool
    eta: mi.Float
    origin: mi.Interaction3f
    on: mi.Bool
    through: mi.Bool
    mirrored: mi.Bool
    factors: list[TrackedFactor]


@dataclass
class DirectionSamples:
    """The random numbers of a direction.

    Attributes:
        component: uniform random number in [0, 1) for the component of the BSDF or phase function.
        direction: two uniform random numbers in [0, 1) for the direction.
        aimed: directions around emitters, drawn for a share of the samples (lobes in media only); None for no such directions.
        splits: lanes at the first glass of their path, which does what ``Estimators.glass`` says, with its share of the light;
            None if chance decides everywhere.
    """

    component: mi.Float
    direction: mi.Point2f
    aimed: AimedDirections | None = None
    splits: mi.Bool | None = None


PER_LANE = ("ray", "medium", "weight", "pdf", "delta", "eta", "origin", "on", "through", "mirrored")
"""Attributes of :class:`NextDirection` with a value for each lane."""


def sample_next_direction(
    estimators: Estimators, ray: Ray, event: PathEvent, samples: DirectionSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample the direction in which a path continues.

    Args:
        estimators: estimators of the render.
        ray: ray of the segment ending in the event.
        event: end of the segment.
        samples: random numbers.
        may_scatter: lanes allowed to scatter once more; paths of other lanes pass through a surface or end.
    """
    if event.collision is None:
        return _sample_bsdf(estimators, ray, event, samples, may_scatter)
    inside = _sample_phase_function(estimators, event.collision, samples, may_scatter)
    if not estimators.media.has_surfaces:
        return inside
    outside = _sample_bsdf(estimators, ray, event, samples, may_scatter)
    selected = {name: dr.select(event.in_medium, getattr(inside, name), getattr(outside, name)) for name in PER_LANE}
    return NextDirection(**selected, factors=outside.factors + inside.factors)


def _sample_bsdf(
    estimators: Estimators, ray: Ray, event: PathEvent, samples: DirectionSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample a direction of the BSDF; a null component transmits the ray without deviation."""
    media, si = estimators.media, event.si
    bsdf = si.bsdf()
    component, mirrors = samples.component, estimators.glass == "mirrors"
    if samples.splits is not None:
        component = dr.select(samples.splits, MIRRORS if mirrors else TRANSMITS, component)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, component, samples.direction, event.at_surface)
    if samples.splits is not None:
        is_mirrored = mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
        weight = dr.select(samples.splits, dr.select(is_mirrored == mirrors, weight * sample.pdf, 0), weight)
    if samples.aimed is not None and samples.aimed.cosine is None:
        sample, weight = _mix_bsdf(si, sample, weight, samples, event.at_surface)
    through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    # A sampled direction of density 0 has weight 0; its path ends at the roulette, where beta is 0.
    on = event.at_surface & (may_scatter | through)
    onward = spawn_ray(si, si.to_world(sample.wo), media.size)
    # A ray transmitted without deviation keeps its end (the sensor's far_clip).
    onward.maxt = dr.select(through, dr.minimum(ray.maxt - event.t, onward.maxt), onward.maxt)
    return NextDirection(
        ray=FineRay.from_ray(onward),
        medium=dr.select(si.is_medium_transition(), si.target_medium(onward.d), event.medium),
        weight=weight,
        pdf=sample.pdf,
        delta=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
        eta=sample.eta,
        origin=mi.Interaction3f(si),
        on=on,
        through=through,
        mirrored=mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection),
        factors=[TrackedFactor(lambda: bsdf.eval(mi.BSDFContext(), si, sample.wo, on & ~through), on & ~through)],
    )


def _mix_bsdf(
    si: mi.SurfaceInteraction3f, sample: mi.BSDFSample3f, weight: mi.Spectrum, samples: DirectionSamples, active: mi.Bool
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """Replace a share of BSDF samples by directions around a near emitter, at surfaces that reflect only."""
    bsdf, aimed = si.bsdf(), samples.aimed
    can_mix = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & ((bsdf.flags() & TRANSMISSION) == 0)
    takes = can_mix & aimed.is_drawn
    is_smooth = can_mix & (takes | ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta))
    sample.wo = dr.select(takes, si.to_local(aimed.draw(samples.direction)), sample.wo)
    f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, sample.wo, is_smooth)
    # Only the BSDF draws its delta components.
    weight = dr.select(can_mix & ~is_smooth, weight * dr.rcp(1 - aimed.share), weight)
    weight = dr.select(is_smooth, aimed.weigh(f, pdf, si.to_world(sample.wo)), weight)
    sample.pdf = dr.select(is_smooth, pdf, sample.pdf)
    sample.eta = dr.select(takes, 1, sample.eta)
    sample.sampled_type = dr.select(takes, mi.UInt32(int(mi.BSDFFlags.DiffuseReflection)), sample.sampled_type)
    return sample, dr.detach(weight)


def _sample_phase_function(
    estimators: Estimators, collision: Collision, samples: DirectionSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample a direction of the phase function. The flight ending here differentiates the albedo."""
    media, mei = estimators.media, collision.mei
    on = collision.on & may_scatter
    wo, weight, pdf = media.phases.sample(mei, samples.component, samples.direction, on)
    if (aimed := samples.aimed) is not None:
        wo = dr.select(aimed.is_drawn, aimed.draw(samples.direction), wo)
        f, pdf = MediumVertex(media, mei, collision.p).eval_and_pdf(wo, on)
        weight = aimed.weigh(f, pdf, wo)
    n = dr.width(wo)
    return NextDirection(
        ray=FineRay.from_point(collision.p, wo, mei),
        medium=mei.medium,
        weight=collision.albedo * weight,
        pdf=pdf,
        delta=dr.full(mi.Bool, not estimators.lights_media, n),
        eta=mi.Float(1),
        origin=mi.Interaction3f(mei),
        on=on,
        through=dr.full(mi.Bool, False, n),
        mirrored=dr.full(mi.Bool, False, n),
        factors=[TrackedFactor(lambda: MediumVertex(media, mei, collision.p).eval(wo, on), on)],
    )
