r"""Direct lighting by next-event estimation: light of emitters scattered towards the camera, with the shadows of media.

.. math:: L_d(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i)\, L_e(x, \omega_i)\, e^{-\tau(x, \omega_i)}\,d\omega_i

One estimator serves surfaces and media. It samples a direction towards an emitter, multiplies the emitted radiance by the
transmittance of the shadow ray, and weights the sample by the power heuristic (multiple importance sampling) against the
density of directions sampled at the vertex. The second sample is the path's next segment. A vertex of single scattering has no
next segment and samples its phase function here.

Rays sampled from the phase function pass emitters on transmissive surfaces, which let part of the light through. Only emitter
samples find such an emitter, with a weight of 1.

Conventions. A direct sample is one shadow ray; its value contains the transmittance and the BSDF or phase function. Surfaces
cast shadows. Light reflected by a surface towards a medium has scattered twice, and is not part of direct lighting.

References: Veach 1997, Eq. 9.13 (the power heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.bright_map import BrightMap
from mivol.transport.estimators.lighting.emitters import (
    ChosenEmitter,
    EmitterDraw,
    EventSamples,
    SceneEmitters,
    is_among,
)
from mivol.transport.estimators.lighting.moving_emitters import attach_position, moving_transmittance
from mivol.transport.estimators.lighting.shadow_rays import find_transmittance, trace_shadow_ray
from mivol.transport.estimators.lighting.tabulated_shadows import TabulatedShadow, TransmittanceGrid
from mivol.transport.estimators.lighting.vertex import MediumVertex, Vertex
from mivol.transport.estimators.scores import TrackedTerm
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import fork_state
from mivol.transport.traversal.rays import FineRay

__all__ = ["DirectLight", "DirectLighting", "DirectSample", "DistantEmitterSample", "EmitterSample", "power_heuristic"]


def power_heuristic(a: mi.Float, b: mi.Float, is_balanced: mi.Bool | bool = False) -> mi.Float:
    """Weight of a sample drawn with density ``a`` by one technique and density ``b`` by another (Veach 1997, Eq. 9.13) [1].

    ``is_balanced``: lanes with the exponent 1 in place of 2, the balance heuristic (Eq. 9.8).
    """
    # As a function of b / a, since a^2 overflows float32 for a > 1.8e19.
    ratio = b / a
    return dr.select(a > 0, dr.rcp(1 + dr.select(is_balanced, ratio, dr.square(ratio))), 0)


# -- Samples -------------------------------------------------------------------------------------------------------------


@dataclass
class DirectSample:
    """The contribution of a shadow ray to the radiance scattered by a vertex towards the camera.

    Attributes:
        ray_segment: the shadow ray.
        value: radiance, with derivatives on request; the optical depth along the ray is detached.
        on: lanes receiving light.
        T: transmittance of the ray, or an estimate; 0 if a surface blocks it, -1 if the ray was not followed [1].
        shadow: shadow read from a table, with the light that it dims, for vertices in media; None without a table.
    """

    ray_segment: RaySegment
    value: mi.Spectrum
    on: mi.Bool
    T: mi.Spectrum
    shadow: TabulatedShadow | None = None


@dataclass
class EmitterSample:
    """A direction sampled towards an emitter.

    Attributes:
        direct: Mitsuba's sample; its density contains the probability of the emitter.
        weight: radiance over ``direct.pdf``.
        emitter: the emitter.
        u: random numbers of the direction.
        has_alternative: lanes in which a BSDF or phase sample can hit the emitter too, with a power heuristic between both.
        density: density that stands for this sample in the power heuristic [1/sr]; None means ``direct.pdf``. A path that hits
            the emitter does not know the ray along which this sample chose it.
    """

    direct: mi.DirectionSample3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    u: mi.Point2f
    has_alternative: mi.Bool | bool
    density: mi.Float | None = None

    @classmethod
    def from_draw(cls, draw: EmitterDraw, has_alternative: mi.Bool | bool) -> EmitterSample:
        """The sample of a drawn direction."""
        return cls(draw.direct, draw.weight, draw.emitter, draw.u, has_alternative, draw.density)


@dataclass
class DistantEmitterSample:
    """A direction sampled towards an emitter at infinity, valid at every point.

    Attributes:
        d: the direction; 0 if the emitter has no light to sample.
        dist: a distance beyond the whole scene [length].
        uv: texture coordinates on the emitter.
        pdf: density of the direction [1/sr].
        delta: whether the density is a delta function.
        weight: radiance over ``pdf``.
        emitter: the emitter.
        u: random numbers of the direction.
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
        """Keep the values of a sample that are valid at every point."""
        direct = sample.direct
        return cls(direct.d, direct.dist, direct.uv, direct.pdf, direct.delta, sample.weight, sample.emitter, sample.u)

    def at_point(self, it: mi.Interaction3f) -> EmitterSample:
        """The sample of a point."""
        direct = dr.zeros(mi.DirectionSample3f, dr.width(self.d))
        direct.p, direct.n, direct.d, direct.dist = mi.Point3f(it.p) + self.dist * self.d, -self.d, self.d, self.dist
        direct.pdf, direct.delta, direct.emitter = self.pdf, self.delta, self.emitter
        direct.uv, direct.time = self.uv, it.time
        return EmitterSample(direct, self.weight, self.emitter, self.u, True)


class DirectLight(TrackedTerm):
    """The light of a shadow ray as a term, with the derivatives of the media along the ray.

    Args:
        media: media of the scene.
        ray_segment: the shadow ray.
        value: radiance at the camera, attached to all parameters except the media along the ray.
        active: lanes receiving light.
    """

    def __init__(self, media: SceneMedia, ray_segment: RaySegment, value: mi.Spectrum, active: mi.Bool) -> None:
        super().__init__(value, active)
        self.media, self.ray_segment = media, ray_segment

    def vjp(self, dL: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.ray_segment, -dL * self.value, self.active)
        super().vjp(dL)

    def jvp(self) -> mi.Spectrum:
        along = jvp_optical_depth(self.media, self.ray_segment, self.active)
        return super().jvp() - dr.select(self.active, along * self.value, 0)


# -- The estimator -------------------------------------------------------------------------------------------------------


class DirectLighting:
    """The estimator of direct lighting at surfaces and in media.

    Args:
        media: media and surfaces of the scene.
        emitters: numbers of :func:`mivol.transport.estimators.lighting.emitters.read_emitters`; by default read from the scene.
        resamples: whether samples of lamps with hidden sides are drawn from candidates.
        bright: as of :class:`SceneEmitters`.

    Attributes:
        shadow_table: table of the shadows of vertices in media, in images; None for shadow rays.
        looks_up: whether few look-ups may estimate all shadows of thin grids, in derivatives.
    """

    shadow_table: TransmittanceGrid | None
    looks_up: bool

    def __init__(
        self, media: SceneMedia, emitters: mi.Float | None = None, resamples: bool = True, bright: BrightMap | None = None
    ) -> None:
        self.media, self.shadow_table, self.looks_up, self._numbers = media, None, False, emitters
        self._resamples, self._bright = resamples, bright

    @property
    def bright(self) -> BrightMap | None:
        """The bright part of the environment map; None without a map, and in derivatives."""
        return self._bright

    @cached_property
    def emitters(self) -> SceneEmitters:
        """The emitters of the scene. Their tables are made at the first call, which must not lie in a recorded loop."""
        with dr.suspend_grad():
            return self._find_emitters("any")

    @cached_property
    def near_emitters(self) -> SceneEmitters:
        """The emitters with a position; made as :attr:`emitters`."""
        return self._among("near")

    @cached_property
    def far_emitters(self) -> SceneEmitters:
        """The emitters at infinity; made as :attr:`emitters`."""
        return self._among("far")

    def _among(self, distance: str) -> SceneEmitters:
        everyone = self.emitters
        if all((everyone.bounding_ball(k) is not None) == (distance == "near") for k in range(len(everyone.sampled))):
            return everyone
        with dr.suspend_grad():
            return self._find_emitters(distance)

    def _find_emitters(self, distance: str) -> SceneEmitters:
        made = self._numbers, self.media.lit_box, self._resamples, self._bright
        return SceneEmitters(self.media.scene, self.media.start is not None, distance, *made)

    def sample_emitter(
        self, it: mi.Interaction3f, u: mi.Point2f, active: mi.Bool, emitters: SceneEmitters | None = None
    ) -> EmitterSample:
        """Sample a direction from a point towards an emitter, by two uniform random numbers in [0, 1); by default of all."""
        return EmitterSample.from_draw((emitters or self.emitters).sample_direction(it, u, active), True)

    def sample_near_emitter(self, it: mi.Interaction3f, chosen: ChosenEmitter, u: mi.Point2f, active: mi.Bool) -> EmitterSample:
        """Sample a direction from a point of a ray towards an emitter with a position, chosen along the ray."""
        sample = EmitterSample.from_draw(_draw_chosen(self.near_emitters, it, chosen, u, active), True)
        return replace(sample, density=self.near_emitters.pdf_direction(it, sample.direct, active))

    def estimate_at_vertex(
        self,
        vertex: Vertex,
        sample: EmitterSample,
        attached: bool,
        active: mi.Bool,
        rng: mi.UInt32 | None = None,
        known: tuple[mi.Float | mi.Spectrum, mi.Bool] | None = None,
        looks_up: mi.Bool | None = None,
    ) -> DirectSample:
        """Estimate the direct light at a vertex of a path by one emitter sample; the path's next segment is the second sample.

        Args:
            vertex: the point.
            sample: the emitter sample.
            attached: keep the derivatives of the emitter and of the BSDF or phase function.
            active: lanes to estimate.
            rng: state of the random number generator for an estimated shadow; None means an exact shadow.
            known: ``T`` of the same sample in an earlier walk, and lanes with such a sample.
            looks_up: as of :func:`.shadow_rays.find_transmittance`.

        Bias: none. Variance: one emitter sample. Cost: one shadow ray.
        """
        direct, it = sample.direct, vertex.interaction
        if self.looks_up and rng is not None:
            looks_up = mi.Bool(True)
        # At the place of a lamp to all digits, its light would be infinite.
        on = active & (direct.pdf > 0) & (direct.dist > 0)
        scattered, pdf = vertex.eval_and_pdf(direct.d, on)
        if not attached:
            # A dark sample needs no shadow ray. It may have derivatives, of a BSDF that is 0.
            on &= dr.any(scattered * sample.weight != 0)
        start, medium = vertex.leave(direct.p)
        shadow, traced, is_followed, is_known = None, on, mi.Bool(on), mi.Bool(False)
        if known is not None:
            stored = mi.Spectrum(known[0])
            is_known = known[1] & (stored[0] >= 0)
            traced = on & ~is_known
        if self.shadow_table is not None:
            inside = on & vertex.in_medium
            number = self.emitters.number_of(sample.emitter)
            shadow, traced = TabulatedShadow.look_up(self.shadow_table, start, medium, direct, number, inside), on & ~inside
        ray_segment, clear, tau, light = trace_shadow_ray(self.media, start, medium, direct, traced, rng, looks_up)
        if known is not None:
            tau, light, clear = None, dr.select(is_known, stored, light), dr.select(is_known, dr.any(stored > 0), clear)
        on &= clear
        w_mis = mi.Float(1)
        if sample.has_alternative is not False:
            own = direct.pdf if sample.density is None else sample.density
            weight = power_heuristic(own, pdf, self.emitters.are_balanced(sample.emitter))
            w_mis = dr.select(direct.delta | ~mi.Bool(sample.has_alternative), 1, weight)
        factor, source = light * w_mis, sample.weight
        with dr.resume_grad(when=attached):
            if attached:
                moved = direct
                placed, source = sample.emitter.sample_direction(it, sample.u, on)
                if dr.grad_enabled(placed.p):
                    moved = attach_position(placed, direct)
                if self.emitters.are_evaluated:
                    source = sample.emitter.eval_direction(it, moved, on) / direct.pdf
                if dr.grad_enabled(moved.p):
                    source = source * moving_transmittance(self.media, ray_segment, tau, moved.p, on)
                if not dr.grad_enabled(source, moved):
                    # Without derivatives, the first evaluation of the emitter is enough; the kernel drops the second.
                    source, moved = sample.weight, direct
                scattered = vertex.eval(moved.d, on)
            # A density of 0 makes the source infinite. These lanes are not active, but 0 * inf in their derivative would be
            # NaN.
            value = dr.select(on, factor * scattered * dr.select(direct.pdf > 0, source, 0), 0)
        T = dr.select(is_followed, dr.select(on, light, 0), -1)
        if shadow is None:
            return DirectSample(ray_segment, value, on, T)
        shadow = shadow.times(dr.select(traced, 0, value))
        return DirectSample(ray_segment, dr.select(traced, value, 0), on, T, shadow)

    def estimate_in_medium(
        self,
        vertex: MediumVertex,
        chosen: ChosenEmitter,
        samples: EventSamples,
        attached: bool,
        active: mi.Bool,
        estimates: bool = False,
    ) -> list[DirectSample]:
        """Estimate the direct light scattered at a point of a medium into ``vertex.interaction.wi``.

        Args:
            vertex: the point.
            chosen: emitter of each lane.
            samples: random numbers.
            attached: keep the derivatives of phase function and emitters.
            active: lanes to estimate.
            estimates: estimate transmittances in grids with block ranges; exact transmittances otherwise.

        Returns:
            One or two shadow rays, with values adding up to L_d.

        Bias: none. Variance: one emitter sample and one phase sample. Cost: a shadow ray for each.
        """
        directs = []
        rngs = [fork_state(samples.generator, k) if estimates else None for k in range(2)]
        if self.emitters.sampled:
            mei = vertex.interaction
            weighed = ~is_among(self.emitters.transmissive, chosen.emitter) if self.emitters.samples_phase else False
            draw = _draw_chosen(self.emitters, mei, chosen, samples.emitter, active)
            sample = EmitterSample.from_draw(draw, weighed)
            directs.append(self.estimate_at_vertex(vertex, sample, attached, active, rngs[0]))
        if self.emitters.samples_phase:
            directs.append(self._phase_sample(vertex, chosen, samples, attached, active, rngs[1]))
        return directs

    def _phase_sample(
        self,
        vertex: MediumVertex,
        chosen: ChosenEmitter,
        samples: EventSamples,
        attached: bool,
        active: mi.Bool,
        rng: mi.UInt32 | None,
    ) -> DirectSample:
        """Light from a direction sampled from the phase function."""
        emitters, mei = self.emitters, vertex.interaction
        wo, weight, pdf = self.media.phases.sample(mei, samples.component, samples.direction, active)
        on = active & (pdf > 0)
        ray = FineRay.from_point(vertex.p, wo, mei)
        end, _, passages, light = find_transmittance(self.media, ray, mei.medium, on, rng)
        si = end.si
        emitter = si.emitter(self.media.scene, on)
        on &= (emitter != None) & ~is_among(emitters.transmissive, emitter)
        w_mis = mi.Float(1)
        if emitters.sampled:
            direct = mi.DirectionSample3f(self.media.scene, si, mei)
            own = emitters.weigh_density(chosen.distribution, mei, direct, on)
            w_mis = power_heuristic(pdf, own, emitters.are_balanced(emitter))
        factor = light * w_mis
        with dr.resume_grad(when=attached):
            if attached:
                weight = vertex.eval(wo, on) / pdf
            value = dr.select(on, factor * weight * emitter.eval(si, on), 0)
        return DirectSample(RaySegment(ray, mei.medium, end.t, True, passages=passages), value, on, light)


def _draw_chosen(
    emitters: SceneEmitters, it: mi.Interaction3f, chosen: ChosenEmitter, u: mi.Point2f, active: mi.Bool
) -> EmitterDraw:
    """Draw a direction towards a chosen emitter; its density contains the probability of the emitter."""
    return emitters.draw_direction(it, chosen.emitter, chosen.distribution.probability(chosen.number), u, active)
