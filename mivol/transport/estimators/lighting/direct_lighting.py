r"""Direct lighting (next-event estimation): light from emitters that a vertex scatters towards the camera, with shadows of
media.

.. math:: L_d(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i)\, L_e(x, \omega_i)\, e^{-\tau(x, \omega_i)}\,d\omega_i

One estimator serves surfaces and media. A direction towards an emitter is sampled, the emitted radiance is multiplied by the
transmittance of the shadow ray, and the sample is weighed by the power heuristic (multiple importance sampling, Veach 1997,
Eq. 9.13) against the density of the vertex' own directions. For a surface, the path's next segment is the other sample; for a
medium vertex of single scattering, a phase sample is drawn here.

Rays of the phase function are not stopped by emitters on transmissive surfaces, which let part of the light pass undeviated.
Such an emitter is found by emitter samples only, whose weight there is 1.

Conventions. A direct sample is one shadow ray; its value contains the transmittance and the BSDF or phase function. Surfaces
cast shadows; light that they reflect towards a medium has scattered twice, and is not part of direct lighting.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.emitters import ChosenEmitter, EventSamples, SceneEmitters, is_among
from mivol.transport.estimators.lighting.moving_emitters import attach_position, moving_transmittance
from mivol.transport.estimators.lighting.shadow_rays import find_transmittance, trace_shadow_ray
from mivol.transport.estimators.lighting.vertex import MediumVertex, Vertex, sample_phase
from mivol.transport.media.channels import take_tangent
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import seed_pcg32
from mivol.transport.traversal.rays import FineRay

__all__ = ["DirectLight", "DirectLighting", "DirectSample", "DistantEmitterSample", "EmitterSample", "power_heuristic"]


@dataclass
class DirectSample:
    """The contribution of one shadow ray to the radiance that a vertex scatters towards the camera.

    Attributes:
        ray_segment: the shadow ray.
        value: radiance, with derivatives where these are asked for; the optical depth along the ray is detached.
        on: lanes that receive any.
    """

    ray_segment: RaySegment
    value: mi.Spectrum
    on: mi.Bool


@dataclass
class EmitterSample:
    """A direction that was sampled towards an emitter.

    Attributes:
        direct: Mitsuba's sample.
        weight: radiance over ``direct.pdf``.
        emitter: the emitter.
        u: the random numbers of the direction.
        count: number of emitters that it was chosen from with equal probabilities; not contained in ``direct.pdf``.
        has_alternative: lanes in which a BSDF or phase sample could have hit the emitter, so that the two are weighed.
    """

    direct: mi.DirectionSample3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    u: mi.Point2f
    count: int
    has_alternative: mi.Bool | bool


@dataclass
class DistantEmitterSample:
    """A direction that was sampled towards an emitter at infinity: it is the same from every point.

    Attributes:
        d: the direction; 0 where the emitter has no light to sample.
        dist: beyond all of the scene [length].
        uv: where the emitter has its texture.
        pdf: its density [1/sr].
        delta: whether that is a delta function.
        weight: radiance over ``pdf``.
        emitter: the emitter.
        u: the random numbers of the direction.
    """

    d: mi.Vector3f
    dist: mi.Float
    uv: mi.Point2f
    pdf: mi.Float
    delta: mi.Bool
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    u: mi.Point2f

    @classmethod
    def from_sample(cls, sample: EmitterSample) -> DistantEmitterSample:
        """What is the same from every point."""
        direct = sample.direct
        return cls(direct.d, direct.dist, direct.uv, direct.pdf, direct.delta, sample.weight, sample.emitter, sample.u)

    def at_point(self, it: mi.Interaction3f) -> EmitterSample:
        """The sample of a point."""
        direct = dr.zeros(mi.DirectionSample3f, dr.width(self.d))
        direct.p, direct.n, direct.d, direct.dist = mi.Point3f(it.p) + self.dist * self.d, -self.d, self.d, self.dist
        direct.pdf, direct.delta, direct.emitter = self.pdf, self.delta, self.emitter
        direct.uv, direct.time = self.uv, it.time
        return EmitterSample(direct, self.weight, self.emitter, self.u, 1, True)


class DirectLighting:
    """The estimator of direct lighting at surfaces and in media.

    Args:
        media: media of the scene, and its surfaces.
    """

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    @cached_property
    def emitters(self) -> SceneEmitters:
        """The emitters of the scene, read when media first scatter their light; at surfaces Mitsuba chooses the emitter."""
        return SceneEmitters(self.media.scene)

    def sample_emitter(self, it: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> EmitterSample:
        """Sample a direction towards an emitter from a point, by two numbers in [0, 1)."""
        direct, weight = self.media.scene.sample_emitter_direction(it, u, False, active)
        return EmitterSample(direct, weight, direct.emitter, u, 1, True)

    def estimate_at_vertex(
        self, vertex: Vertex, aim: EmitterSample, attached: bool, active: mi.Bool, rng: mi.UInt32 | None = None
    ) -> DirectSample:
        """Estimate direct light at a vertex of a path by one emitter sample; the path's next segment is the other sample.

        Args:
            vertex: the point.
            aim: the emitter sample.
            attached: keep the derivatives of BSDF or phase function, and emitter.
            active: lanes to estimate.
            rng: of the tracker that estimates the shadow; None for an exact one.

        Bias: none. Variance: that of one emitter sample. Cost: one shadow ray.
        """
        direct, it = aim.direct, vertex.interaction
        on = active & (direct.pdf > 0)
        start, medium = vertex.leave(direct.p)
        ray_segment, clear, tau, light = trace_shadow_ray(self.media, start, medium, direct, on, rng)
        on &= clear
        w_mis = mi.Float(1)
        if aim.has_alternative is not False:
            pdf = direct.pdf / aim.count
            w_mis = dr.select(direct.delta | ~mi.Bool(aim.has_alternative), 1, power_heuristic(pdf, vertex.pdf(direct.d, on)))
        dim = light * (w_mis * aim.count)
        with dr.resume_grad(when=attached):
            source, moved = aim.weight, direct
            if attached:
                placed, _ = aim.emitter.sample_direction(it, aim.u, on)
                if dr.grad_enabled(placed.p):
                    moved = attach_position(placed, direct)
                source = aim.emitter.eval_direction(it, moved, on) / direct.pdf
                if dr.grad_enabled(moved.p):
                    source = source * moving_transmittance(self.media, ray_segment, tau, moved.p, on)
                if not dr.grad_enabled(source, moved):
                    # What was computed for derivatives only is dropped from the kernel: emitters are looked at once.
                    source, moved = aim.weight, direct
            # Where the density is 0 the source is infinite; the lanes are not active, but 0 * inf in their derivative would be
            # NaN.
            value = dr.select(on, dim * vertex.eval(moved.d, on) * dr.select(direct.pdf > 0, source, 0), 0)
        return DirectSample(ray_segment, value, on)

    def estimate_in_medium(
        self,
        vertex: MediumVertex,
        chosen: ChosenEmitter,
        samples: EventSamples,
        attached: bool,
        active: mi.Bool,
        estimates: bool = False,
    ) -> list[DirectSample]:
        """Estimate direct light at a point of a medium that is scattered into ``vertex.interaction.wi``.

        Args:
            vertex: the point.
            chosen: the emitter that was chosen for each lane.
            samples: random numbers.
            attached: keep the derivatives of phase function and emitters.
            active: lanes to estimate.
            estimates: transmittance may be estimated, in grids whose block ranges are known; otherwise it is exact.

        Returns:
            One or two shadow rays, whose values add up to L_d.

        Bias: none. Variance: that of one emitter sample and one phase sample. Cost: a shadow ray for each.
        """
        found = []
        # Shadows are estimated in images only, and images need no choice of a shadow ray to differentiate: its random number
        # seeds the generators of the trackers.
        one, two = (seed_pcg32(samples.which_shadow_ray, dr.width(active), k) if estimates else None for k in range(2))
        if self.emitters.sampled:
            mei = vertex.interaction
            direct, weight = chosen.emitter.sample_direction(mei, samples.emitter, active)
            weighed = ~is_among(self.emitters.transmissive, chosen.emitter) if self.emitters.samples_phase else False
            aim = EmitterSample(direct, weight, chosen.emitter, samples.emitter, len(self.emitters.sampled), weighed)
            found.append(self.estimate_at_vertex(vertex, aim, attached, active, one))
        if self.emitters.samples_phase:
            found.append(self._phase_sample(vertex, samples, attached, active, two))
        return found

    def _phase_sample(
        self, vertex: MediumVertex, samples: EventSamples, attached: bool, active: mi.Bool, rng: mi.UInt32 | None
    ) -> DirectSample:
        """Light from a direction that was sampled from the phase function."""
        emitters, mei = self.emitters, vertex.interaction
        wo, weight, pdf = sample_phase(self.media, mei, samples.component, samples.direction, active)
        on = active & (pdf > 0)
        ray = FineRay.from_point(vertex.p, wo, mei)
        end, _, light = find_transmittance(self.media, ray, mei.medium, on, rng)
        si = end.si
        emitter = si.emitter(self.media.scene, on)
        on &= (emitter != None) & ~is_among(emitters.transmissive, emitter)
        w_mis = mi.Float(1)
        if emitters.sampled:
            direct = mi.DirectionSample3f(self.media.scene, si, mei)
            pdf_emitter = emitter.pdf_direction(mei, direct, on) / len(emitters.sampled)
            w_mis = dr.select(is_among(emitters.sampled, emitter), power_heuristic(pdf, pdf_emitter), 1)
        dim = light * w_mis
        with dr.resume_grad(when=attached):
            if attached:
                weight = vertex.eval(wo, on) / pdf
            value = dr.select(on, dim * weight * emitter.eval(si, on), 0)
        return DirectSample(RaySegment(ray, mei.medium, end.t, True), value, on)


class DirectLight:
    """The term of a shadow ray, with derivatives with respect to the media along it.

    Args:
        media: of the scene.
        ray_segment: the shadow ray.
        value: radiance as the camera sees it, attached to all parameters but those of the media along the ray.
        active: lanes that receive it.
    """

    is_replayed = True

    def __init__(self, media: SceneMedia, ray_segment: RaySegment, value: mi.Spectrum, active: mi.Bool) -> None:
        self.media, self.ray_segment, self.attached, self.active = media, ray_segment, value, active
        self.value = dr.select(active, dr.detach(value), 0)

    def vjp(self, dL: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.ray_segment, -dL * self.value, self.active)
        with dr.resume_grad():
            if dr.grad_enabled(self.attached):
                dr.backward_from(dr.select(self.active, dL * self.attached, 0))

    def jvp(self) -> mi.Spectrum:
        along = jvp_optical_depth(self.media, self.ray_segment, self.active)
        with dr.resume_grad():
            own = take_tangent(self.attached)
        return dr.select(self.active, own - along * self.value, 0)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample drawn with density ``a`` that another technique draws with density ``b`` (Veach 1997, Eq. 9.13)."""
    # As a function of b / a, since a^2 overflows float32 for a > 1.8e19.
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)
