r"""Direct lighting: light that reaches a vertex from emitters, through volumetric shadows, and turns towards the camera.

.. math:: L_d(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i)\, L_e(x, \omega_i)\, e^{-\tau(x, \omega_i)}\,d\omega_i

One estimator serves surfaces and media: a direction towards an emitter is drawn, the transmittance of the shadow ray dims what
the emitter sends, and the power heuristic (Veach 1997, Eq. 9.13) weighs it against the density of the vertex' own directions.
Where a path goes on from a surface, its own next segment is the other sample; a medium vertex of single scattering draws one
of its phase function here.

Emitters on surfaces that let light pass undeviated (transmissive ones) are no end of a shadow ray: rays of the phase function
pass them, so only the first kind of sample finds them there.

Conventions. A sample is one shadow ray: the light that it brings is already dimmed by the optical depth along it and turned by
the vertex. Surfaces cast shadows; what they reflect is one more scattering and not seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import ChosenEmitter, SceneEmitters, is_among
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.estimators.moving_emitters import follow_lamp, shadow_of_moving
from mivol.transport.estimators.multiple_importance import power_heuristic
from mivol.transport.estimators.phase_sampling import sample_phase
from mivol.transport.estimators.shadow_rays import light_through, shadow_ray
from mivol.transport.estimators.vertex import MediumVertex, SurfaceVertex, Vertex
from mivol.transport.media.channels import tangent_of
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import seed_pcg32

__all__ = ["DirectLight", "DirectLighting", "DirectSample"]


@dataclass
class DirectSample:
    """Radiance that one shadow ray brings to a vertex, turned to the camera; with its derivatives where these are asked for.

    Attributes:
        ray_segment: the shadow ray.
        value: radiance; its optical depth along the ray is detached.
        on: lanes that receive any.
    """

    ray_segment: RaySegment
    value: mi.Spectrum
    on: mi.Bool


@dataclass
class EmitterAim:
    """A direction towards an emitter.

    Attributes:
        direct: Mitsuba's sample.
        weight: radiance over density, without the choice among emitters.
        emitter: what is aimed at.
        u: the numbers that drew it.
        count: the emitter was drawn from so many, all alike, and ``direct.pdf`` does not count that.
        is_met_by_chance: lanes in which a direction of the vertex could have met the emitter.
    """

    direct: mi.DirectionSample3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    u: mi.Point2f
    count: int
    is_met_by_chance: mi.Bool | bool


class DirectLighting:
    """Estimates direct light at surfaces and in media.

    Args:
        media: surfaces and media.
        emitters: of the scene.
    """

    def __init__(self, media: SceneMedia, emitters: SceneEmitters) -> None:
        self.media, self.emitters = media, emitters

    def at_surface(
        self, vertex: SurfaceVertex, u: mi.Point2f, attached: bool, active: mi.Bool, chance: mi.Float | None = None
    ) -> DirectSample:
        """Estimate what a surface receives from one emitter and turns; the path's next segment holds the other sample.

        Args:
            vertex: the point.
            u: two numbers in [0, 1).
            attached: keep the derivatives of BSDF and emitter.
            active: lanes to light.
            chance: a number in [0, 1) that estimates the shadow, where media are bounded.
        """
        rng = None if chance is None else seed_pcg32(chance, dr.width(active))
        direct, weight = self.media.scene.sample_emitter_direction(vertex.interaction, u, False, active)
        return self._aimed(vertex, EmitterAim(direct, weight, direct.emitter, u, 1, True), attached, active, rng)

    def in_medium(
        self,
        vertex: MediumVertex,
        chosen: ChosenEmitter,
        samples: EventSamples,
        attached: bool,
        active: mi.Bool,
        estimates: bool = False,
    ) -> list[DirectSample]:
        """Estimate the light that arrives at a point of a medium and turns into ``vertex.interaction.wi``.

        Args:
            vertex: the point.
            chosen: the emitter that was drawn for each lane.
            samples: random numbers.
            attached: keep the derivatives of phase function and emitters.
            active: lanes to light.
            estimates: shadows may be estimated, in grids whose blocks are known; otherwise they are exact.

        Returns:
            One or two shadow rays, whose values add up to L_d.

        Bias: none. Variance: that of one direction towards an emitter and one of the phase function.
        """
        found = []
        # Where shadows are estimated no ray is followed back: the number that would choose one is free.
        one, two = (seed_pcg32(samples.choice, dr.width(active), k) if estimates else None for k in range(2))
        if self.emitters.sampled:
            mei = vertex.interaction
            direct, weight = chosen.emitter.sample_direction(mei, samples.emitter, active)
            met = ~is_among(self.emitters.transmissive, chosen.emitter) if self.emitters.samples_phase else False
            aim = EmitterAim(direct, weight, chosen.emitter, samples.emitter, len(self.emitters.sampled), met)
            found.append(self._aimed(vertex, aim, attached, active, one))
        if self.emitters.samples_phase:
            found.append(self._met(vertex, samples, attached, active, two))
        return found

    def _aimed(
        self, vertex: Vertex, aim: EmitterAim, attached: bool, active: mi.Bool, rng: mi.UInt32 | None = None
    ) -> DirectSample:
        """Light from the direction of an emitter."""
        direct, it = aim.direct, vertex.interaction
        on = active & (direct.pdf > 0)
        start, medium = vertex.leave(direct.p)
        ray_segment, clear, tau, light = shadow_ray(self.media, start, medium, direct, on, rng)
        on &= clear
        w_mis = mi.Float(1)
        if aim.is_met_by_chance is not False:
            pdf = direct.pdf / aim.count
            w_mis = dr.select(direct.delta | ~mi.Bool(aim.is_met_by_chance), 1, power_heuristic(pdf, vertex.pdf(direct.d, on)))
        dim = light * (w_mis * aim.count)
        with dr.resume_grad(when=attached):
            source, moved = aim.weight, direct
            if attached:
                moved = follow_lamp(aim.emitter, it, aim.u, direct, on)
                source = aim.emitter.eval_direction(it, moved, on) / direct.pdf
                source = source * shadow_of_moving(self.media, ray_segment, tau, moved.p, on)
            # A density of 0 would make the source infinite: 0 times it, in lanes that are left out, has no derivative.
            value = dr.select(on, dim * vertex.eval(moved.d, on) * dr.select(direct.pdf > 0, source, 0), 0)
        return DirectSample(ray_segment, value, on)

    def _met(
        self, vertex: MediumVertex, samples: EventSamples, attached: bool, active: mi.Bool, rng: mi.UInt32 | None
    ) -> DirectSample:
        """Light from a direction of the phase function."""
        emitters, mei = self.emitters, vertex.interaction
        wo, weight, pdf = sample_phase(self.media, vertex.phase, mei, samples, active)
        on = active & (pdf > 0)
        ray = mi.Ray3f(mei.p, wo, dr.inf, mei.time, mei.wavelengths)
        end, _, light = light_through(self.media, ray, mei.medium, on, rng)
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
    """The term of a shadow ray: its value, and the media that dim it.

    Args:
        media: of the scene.
        ray_segment: the shadow ray.
        value: radiance as the camera sees it, attached to all but the media along the ray.
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
            own = tangent_of(self.attached)
        return dr.select(self.active, own - along * self.value, 0)
