r"""One scattering along a stretch of a path: the light that a medium turns towards the camera.

.. math:: L = \int_0^D T(t)\,\sigma_s(x_t)\,L_s(x_t, \omega)\,dt \approx \frac{T \sigma_s L_s}{p(t)}

Conventions. The stretch is walked once, for its optical depth and for the point at which it scatters. ``weight`` is what a unit
of sigma_s at that point would send to the camera: the light is ``sigma_s * weight``, and its derivative with respect to
sigma_s is the weight itself, so nothing is divided by an extinction or by an albedo that may be 0.

References: physically, the equation of transfer with the in-scattered radiance of one order (Chandrasekhar 1960).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.direct_lighting import DirectSample, estimate_direct
from mivol.transport.estimators.distance_reservoir import Candidate, Reservoir, fill_reservoir, start_reservoir
from mivol.transport.estimators.distance_sampling import MediumEvent, sample_distance
from mivol.transport.estimators.emitters import ChosenEmitter
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.estimators.path_segment import PathSegment
from mivol.transport.media.body import Body
from mivol.transport.media.channels import spectrum
from mivol.transport.media.ray_intervals import SegmentEnd, integrate_optical_depth, transmittance, visit_media
from mivol.transport.media.scene_media import World

__all__ = [
    "Scattering",
    "at_event",
    "estimate_scattered_light",
    "eval_albedo",
    "medium_interaction",
    "sample_scattering",
    "sigma_t_at",
]


PROBE_DEPTH = 4.0
"""Optical depth that a probe for derivatives adds over a body (measured: flat between 2 and 8)."""


@dataclass
class Scattering:
    """A point of a stretch that scatters, and the light that arrives there.

    Attributes:
        event: where.
        mei: the point, as Mitsuba's phase functions want it.
        gain: throughput and transmittance to the camera, over the density of the point.
        direct: the shadow rays; their values carry derivatives where these are asked for.
        sigma_s: scattering coefficient [1/length] there.
        chance: a number in [0, 1), for the choice of one of the shadow rays.
    """

    event: MediumEvent
    mei: mi.MediumInteraction3f
    gain: mi.Spectrum
    direct: list[DirectSample]
    sigma_s: mi.Spectrum
    chance: mi.Float

    @property
    def weight(self) -> mi.Spectrum:
        """What a unit of sigma_s would send to the camera."""
        return self.gain * sum((dr.detach(a.value) for a in self.direct), mi.Spectrum(0))


def sample_scattering(
    scene: mi.Scene, world: World, path_segment: PathSegment, probes: bool, active: mi.Bool
) -> tuple[SegmentEnd, list[mi.Float], Scattering]:
    """Walk a stretch to its end, and let it scatter once on the way.

    Args:
        scene, world: surfaces, lamps and media.
        path_segment: ray, throughput and random numbers.
        probes: draw points for derivatives: where there is no extinction too, and with derivatives of what arrives.
        active: lanes to walk.

    Returns:
        Where the stretch ends, the optical depth of each channel to there, and the scattering.

    Bias: none. Cost: one walk of the stretch, one of each shadow ray; where several media lie along a ray, one to the point.
    """
    end, reservoir, lamp = _walk(scene, world, path_segment, 1, probes, active)
    samples = path_segment.samples.part(mi.UInt32(0), 1)
    return (
        end,
        reservoir.tau,
        _light_up(scene, world, path_segment, reservoir.candidates[0], reservoir.total, lamp, samples, probes, active),
    )


def estimate_scattered_light(
    scene: mi.Scene, world: World, path_segment: PathSegment, active: mi.Bool
) -> tuple[SegmentEnd, list[mi.Float], mi.Spectrum]:
    """Walk a stretch to its end, and let it scatter at ``world.events`` points on the way, for a picture.

    Returns:
        Where the stretch ends, the optical depth of each channel to there, and the light of all points, in the mean.

    Bias: none. Variance: of each point as of :func:`sample_scattering`; they share the emitter.
    Cost: one walk of the segment, one of each shadow ray: on long segments several points pay.
    """
    count, samples = world.events, path_segment.samples
    end, reservoir, lamp = _walk(scene, world, path_segment, count, False, active)

    def light_of(number: mi.UInt32) -> mi.Spectrum:
        candidates, numbers = reservoir.of(number), samples.part(number, count)
        at = _light_up(scene, world, path_segment, candidates, reservoir.total, lamp, numbers, False, active)
        return dr.select(at.event.on, at.sigma_s * at.weight, 0)

    if count == 1:
        return end, reservoir.tau, light_of(mi.UInt32(0))
    _, light = dr.while_loop(
        state=(dr.zeros(mi.UInt32, dr.width(path_segment.ray)), dr.zeros(mi.Spectrum, dr.width(path_segment.ray))),
        cond=lambda number, light: number < count,
        body=lambda number, light: (number + 1, light + light_of(number)),
        label="points that scatter",
    )
    return end, reservoir.tau, light * (1 / count)


def _walk(
    scene: mi.Scene, world: World, path_segment: PathSegment, count: int, probes: bool, active: mi.Bool
) -> tuple[SegmentEnd, Reservoir, ChosenEmitter]:
    """Walk a stretch to its end and keep pieces of it, for a lamp that was drawn before."""
    probe_depth, samples, ray = PROBE_DEPTH if probes else 0.0, path_segment.samples, path_segment.ray
    lamp = world.emitters.choose(ray, samples.lamp)
    reservoir = start_reservoir(world, samples.piece, dr.width(ray), count)
    end, reservoir = visit_media(
        scene, world, ray, path_segment.medium, fill_reservoir(world, ray, lamp, probe_depth), reservoir, active
    )
    return end, reservoir, lamp


def _light_up(
    scene: mi.Scene,
    world: World,
    path_segment: PathSegment,
    candidates: Candidate,
    total: mi.Float,
    lamp: ChosenEmitter,
    samples: EventSamples,
    probes: bool,
    active: mi.Bool,
) -> Scattering:
    """Choose a point in a piece that was kept, and look from there to the lamps."""
    probe_depth, ray = PROBE_DEPTH if probes else 0.0, path_segment.ray
    event = sample_distance(
        world, ray, candidates, total, lamp.equiangular, probe_depth, samples.inside, active & path_segment.scatters
    )
    mei = _interaction(world, ray, event)
    tau = event.tau
    if not world.is_single:
        front = mi.Ray3f(ray.o, ray.d, event.t, ray.time, ray.wavelengths)
        _, tau = integrate_optical_depth(scene, world, front, path_segment.medium, event.on)
    gain = dr.select(event.on, path_segment.beta * transmittance(tau) / event.pdf, 0)
    found = estimate_direct(scene, world, mei, lamp, samples, probes, event.on, estimates=not probes)
    return Scattering(event, mei, gain, found, _sigma_s(world, ray, event, mei), samples.choice)


def medium_interaction(ray: mi.Ray3f, t: mi.Float, medium: mi.Medium | None = None) -> mi.MediumInteraction3f:
    """A point of a ray as Mitsuba's phase functions want it."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
    mei.t, mei.p, mei.wi = t, ray(t), -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    if medium is not None:
        mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(ray)), mi.MediumPtr(medium), None)
    return mei


def _interaction(world: World, ray: mi.Ray3f, event: MediumEvent) -> mi.MediumInteraction3f:
    mei = medium_interaction(ray, event.t)
    for index, body in enumerate(world.bodies):
        mei.medium = dr.select(event.on & (event.body == index), mi.MediumPtr(body.view.medium), mei.medium)
    return mei


def at_event(world: World, event: MediumEvent) -> list[tuple[Body, mi.Bool]]:
    """The bodies, each with the lanes that scatter in it."""
    return [(body, event.on & (event.body == index)) for index, body in enumerate(world.bodies)]


def eval_albedo(body: Body, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The albedo of a body at a point, with its derivative."""
    albedo = body.view.albedo
    return albedo.eval(mei, on) if isinstance(albedo, mi.Volume) else mi.Spectrum(albedo)


def sigma_t_at(world: World, body: Body, ray: mi.Ray3f, event: MediumEvent, on: mi.Bool) -> mi.Spectrum:
    """The extinction [1/length] at an event."""
    rows = event.sigma_t if world.is_single else body.extinction_at(ray, event.t, world.channels, on)
    return spectrum(rows)


def _sigma_s(world: World, ray: mi.Ray3f, event: MediumEvent, mei: mi.MediumInteraction3f) -> mi.Spectrum:
    total = mi.Spectrum(0)
    for body, on in at_event(world, event):
        if body.view.albedo is None:
            value = spectrum(body.extinction_at(ray, event.t, world.channels, on, "sigma_s"))
        else:
            value = dr.detach(eval_albedo(body, mei, on)) * sigma_t_at(world, body, ray, event, on)
        total = dr.select(on, value, total)
    return total
