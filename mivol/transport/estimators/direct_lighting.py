r"""Light that reaches a point of a medium from the lamps, through volumetric shadows, and turns towards the camera.

.. math:: L_s(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i)\, L_e(x, \omega_i)\, e^{-\tau(x, \omega_i)}\,d\omega_i

A lamp is drawn before the distance, so that the distance may be drawn for it; its direction is Mitsuba's. Where a lamp can be
met by chance, a second direction is drawn from the phase function, and the power heuristic weighs both (Veach 1997, Eq. 9.13);
light that is the same from everywhere needs the second one only. A lamp that lets light pass (a pane) is no end of a ray: it is
aimed at only.

Conventions. An arrival is one shadow ray: the light that it brings is already dimmed by the exact optical depth along it and
turned by the phase function. Surfaces cast shadows; what they reflect is one more scattering and not seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import ChosenEmitter, is_among
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.estimators.moving_emitters import follow_lamp, shadow_of_moving
from mivol.transport.estimators.multiple_importance import power_heuristic
from mivol.transport.estimators.phase_sampling import phase_context, phase_pdf, sample_phase
from mivol.transport.estimators.shadow_rays import light_through, shadow_ray
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import World
from mivol.transport.traversal.random_numbers import seed_pcg32

__all__ = ["DirectSample", "estimate_direct"]


@dataclass
class DirectSample:
    """Light that one shadow ray brings: ``value`` is turned and dimmed, per steradian of nothing: it is radiance."""

    ray_segment: RaySegment
    value: mi.Spectrum
    on: mi.Bool


def estimate_direct(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    lamp: ChosenEmitter,
    samples: EventSamples,
    attached: bool,
    active: mi.Bool,
    estimates: bool = False,
) -> list[DirectSample]:
    """Estimate the light that arrives at a point and turns into ``mei.wi``.

    Args:
        scene, world: surfaces and media.
        mei: the point; ``medium`` is what surrounds it.
        lamp: drawn for each lane.
        samples: random numbers.
        attached: keep the derivatives of phase function and emitters.
        active: lanes to light.
        estimates: shadows may be estimated, in grids whose blocks are known; otherwise they are exact.

    Returns:
        One or two shadow rays, whose values add up to L_s.

    Bias: none. Variance: that of one direction towards a lamp and one of the phase function.
    """
    found = []
    # Where shadows are estimated no ray is followed back: the number that would choose one is free.
    one, two = (seed_pcg32(samples.choice, dr.width(active), k) if estimates else None for k in range(2))
    if world.emitters.sampled:
        found.append(_sample_emitter(scene, world, mei, lamp, samples, attached, active, one))
    if world.emitters.samples_phase:
        found.append(_sample_phase_function(scene, world, mei, samples, attached, active, two))
    return found


def _sample_emitter(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    lamp: ChosenEmitter,
    samples: EventSamples,
    attached: bool,
    active: mi.Bool,
    rng: mi.UInt32 | None,
) -> DirectSample:
    """A direction towards the lamp."""
    lights, phase = world.emitters, mei.medium.phase_function()
    direct, weight = lamp.emitter.sample_direction(mei, samples.emitter, active)
    on = active & (direct.pdf > 0)
    ray_segment, clear, tau, light = shadow_ray(scene, world, mi.Point3f(mei.p), mei.medium, direct, on, rng)
    w_mis = mi.Float(1)
    if lights.samples_phase:
        pdf_phase = phase_pdf(world, phase, mei, direct.d, on)
        pdf = direct.pdf / len(lights.sampled)
        w_mis = dr.select(direct.delta | is_among(lights.transmissive, lamp.emitter), 1, power_heuristic(pdf, pdf_phase))
    dim = light * (w_mis * len(lights.sampled))
    with dr.resume_grad(when=attached):
        moved = follow_lamp(lamp.emitter, mei, samples.emitter, direct, on) if attached else direct
        f, _ = phase.eval_pdf(phase_context(), mei, moved.d, on)
        source = lamp.emitter.eval_direction(mei, moved, on) / direct.pdf if attached else weight
        if attached:
            source = source * shadow_of_moving(scene, world, ray_segment, tau, moved.p, on & clear)
        value = dr.select(on & clear, dim * f * source, 0)
    return DirectSample(ray_segment, value, on & clear)


def _sample_phase_function(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    samples: EventSamples,
    attached: bool,
    active: mi.Bool,
    rng: mi.UInt32 | None,
) -> DirectSample:
    """A direction of the phase function."""
    lights, phase = world.emitters, mei.medium.phase_function()
    wo, weight, pdf = sample_phase(world, phase, mei, samples, active)
    on = active & (pdf > 0)
    ray = mi.Ray3f(mei.p, wo, dr.inf, mei.time, mei.wavelengths)
    end, _, light = light_through(scene, world, ray, mei.medium, on, rng)
    si = end.si
    emitter = si.emitter(scene, on)
    on &= (emitter != None) & ~is_among(lights.transmissive, emitter)
    w_mis = mi.Float(1)
    if lights.sampled:
        direct = mi.DirectionSample3f(scene, si, mei)
        pdf_emitter = emitter.pdf_direction(mei, direct, on) / len(lights.sampled)
        w_mis = dr.select(is_among(lights.sampled, emitter), power_heuristic(pdf, pdf_emitter), 1)
    dim = light * w_mis
    with dr.resume_grad(when=attached):
        if attached:
            f, _ = phase.eval_pdf(phase_context(), mei, wo, on)
            weight = f / pdf
        value = dr.select(on, dim * weight * emitter.eval(si, on), 0)
    return DirectSample(RaySegment(ray, mei.medium, end.t, True), value, on)
