"""The event at the end of a path segment: a collision with a medium, a surface, or escape from the scene."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.vertex import MediumVertex, MixedVertex, SurfaceVertex, Vertex, sample_phase
from mivol.transport.estimators.scores import TrackedFactor
from mivol.transport.estimators.segment import Collision, SegmentEstimate
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import Estimators
from mivol.transport.traversal.rays import FineRay, Ray, spawn_ray

__all__ = ["PathEvent", "NextDirection", "TurnSamples", "sample_next_direction"]


@dataclass
class PathEvent:
    """The end of a segment.

    Attributes:
        si: the surface; not valid where the path has left the scene.
        t: length of the segment to there [length].
        medium: the medium around it.
        at_surface: lanes that have hit a surface.
        collision: where lanes have met a medium before; None where paths scatter at surfaces only.
        chance: for derivatives of paths that scatter in media, a number in [0, 1) by which one of their shadow rays is kept.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    at_surface: mi.Bool
    collision: Collision | None
    chance: mi.Float | None = None

    @classmethod
    def from_estimate(cls, estimate: SegmentEstimate, active: mi.Bool) -> PathEvent:
        """The event at the end of a segment."""
        end, collision = estimate.end, estimate.collision
        arrives = active if collision is None else active & ~collision.on
        chance = None if estimate.probe is None else estimate.probe.chance
        return cls(end.si, end.t, end.medium, arrives & end.si.is_valid(), collision, chance)

    @property
    def in_medium(self) -> mi.Bool:
        """Lanes that have met a medium."""
        return mi.Bool(False) if self.collision is None else self.collision.on

    def vertex(self, media: SceneMedia) -> Vertex:
        """The point at which light is scattered."""
        if self.collision is None:
            return self.surface_vertex(media)
        inside = MediumVertex(media, self.collision.mei, self.collision.place)
        return MixedVertex(self.surface_vertex(media), inside, self.collision.on) if media.has_surfaces else inside

    def surface_vertex(self, media: SceneMedia) -> SurfaceVertex:
        """The point of the surface."""
        return SurfaceVertex(media, self.si, self.si.bsdf(), self.medium)


@dataclass
class TurnSamples:
    """The random numbers of a direction, uniform in [0, 1): of the component, and of the direction."""

    component: mi.Float
    direction: mi.Point2f


@dataclass
class NextDirection:
    """How a path goes on.

    Attributes:
        ray: of the next segment.
        medium: around its origin.
        weight: value over density of the direction.
        pdf: that density [1/sr].
        delta: lanes in which no emitter sample could have found what lies there.
        eta: relative index of refraction.
        origin: where the direction was sampled.
        on: lanes that go on.
        through: lanes that pass a surface undeviated.
        factors: the weight with its derivatives.
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
    factors: list[TrackedFactor]


def sample_next_direction(
    estimators: Estimators, ray: Ray, event: PathEvent, samples: TurnSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample the direction in which a path goes on.

    Args:
        estimators: of the render.
        ray: of the segment that has ended.
        event: its end.
        samples: random numbers.
        may_scatter: lanes whose path may scatter once more; the others pass surfaces undeviated or end.
    """
    if event.collision is None:
        return _sample_bsdf(estimators, ray, event, samples, may_scatter)
    inside = _sample_phase_function(estimators, event.collision, samples, may_scatter)
    if not estimators.media.has_surfaces:
        return inside
    outside = _sample_bsdf(estimators, ray, event, samples, may_scatter)
    here, names = event.in_medium, ("ray", "medium", "weight", "pdf", "delta", "eta", "origin", "on", "through")
    either = {name: dr.select(here, getattr(inside, name), getattr(outside, name)) for name in names}
    return NextDirection(**either, factors=outside.factors + inside.factors)


def _sample_bsdf(
    estimators: Estimators, ray: Ray, event: PathEvent, samples: TurnSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample a direction of the BSDF; the null transmission of a surface leaves the ray as it is."""
    media, si = estimators.media, event.si
    vertex = event.surface_vertex(media)
    sample, weight = vertex.bsdf.sample(mi.BSDFContext(), si, samples.component, samples.direction, event.at_surface)
    through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    # A sampled direction of density 0 has weight 0; its path ends where beta is 0.
    on = event.at_surface & (may_scatter | through)
    onward = spawn_ray(si, si.to_world(sample.wo), media.size)
    # A ray that is transmitted undeviated keeps its end (the sensor's far_clip).
    onward.maxt = dr.select(through, dr.minimum(ray.maxt - event.t, onward.maxt), onward.maxt)
    medium = dr.select(si.is_medium_transition(), si.target_medium(onward.d), event.medium)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    factor = _bsdf_factor(vertex, sample.wo, on & ~through)
    return NextDirection(
        FineRay.from_ray(onward), medium, weight, sample.pdf, delta, sample.eta, mi.Interaction3f(si), on, through, [factor]
    )


def _sample_phase_function(
    estimators: Estimators, collision: Collision, samples: TurnSamples, may_scatter: mi.Bool
) -> NextDirection:
    """Sample a direction of the phase function. The derivative of the albedo belongs to the flight that has ended here."""
    media, mei = estimators.media, collision.mei
    on = collision.on & may_scatter
    wo, weight, pdf = sample_phase(media, mei, samples.component, samples.direction, on)
    ray, n = FineRay.from_point(collision.place, wo, mei), dr.width(wo)
    never, alone = dr.full(mi.Bool, False, n), dr.full(mi.Bool, not estimators.lights_media, n)
    factor = TrackedFactor(lambda: MediumVertex(media, mei, collision.place).eval(wo, on), on)
    weight = collision.albedo * weight
    return NextDirection(ray, mei.medium, weight, pdf, alone, mi.Float(1), mi.Interaction3f(mei), on, never, [factor])


def _bsdf_factor(vertex: SurfaceVertex, wo: mi.Vector3f, active: mi.Bool) -> TrackedFactor:
    """The BSDF as a factor of all light ahead, with its derivatives."""
    return TrackedFactor(lambda: vertex.bsdf.eval(mi.BSDFContext(), vertex.interaction, wo, active), active)
