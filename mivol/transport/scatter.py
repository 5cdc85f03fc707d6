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

from mivol.transport.direct import Arrival, Draw, arrivals
from mivol.transport.free_flight import Event, Kept, Lamp, Pick, offer, place, start_pick
from mivol.transport.path import Reach, Stretch, Way, add_optical_depth, reach, revisit, transmittance
from mivol.transport.world import Body, World, spectrum

__all__ = ["Scattering", "albedo", "at_event", "interaction", "scatter", "scattered_light", "sigma_t_at", "way_to"]

KAPPA = 4.0
"""Optical depth that a probe for derivatives adds over a body (measured: flat between 2 and 8)."""


@dataclass
class Scattering:
    """A point of a stretch that scatters, and the light that arrives there.

    Attributes:
        event: where.
        mei: the point, as Mitsuba's phase functions want it.
        gain: throughput and transmittance to the camera, over the density of the point.
        arrivals: the shadow rays; their values carry derivatives where these are asked for.
        sigma_s: scattering coefficient [1/length] there.
        chance: a number in [0, 1), for the choice of one of the shadow rays.
    """

    event: Event
    mei: mi.MediumInteraction3f
    gain: mi.Spectrum
    arrivals: list[Arrival]
    sigma_s: mi.Spectrum
    chance: mi.Float

    @property
    def weight(self) -> mi.Spectrum:
        """What a unit of sigma_s would send to the camera."""
        return self.gain * sum((dr.detach(a.value) for a in self.arrivals), mi.Spectrum(0))


def scatter(
    scene: mi.Scene, world: World, stretch: Stretch, probes: bool, active: mi.Bool
) -> tuple[Reach, list[mi.Float], Scattering]:
    """Walk a stretch to its end, and let it scatter once on the way.

    Args:
        scene, world: surfaces, lamps and media.
        stretch: ray, throughput and random numbers.
        probes: draw points for derivatives: where there is no extinction too, and with derivatives of what arrives.
        active: lanes to walk.

    Returns:
        Where the stretch ends, the optical depth of each channel to there, and the scattering.

    Bias: none. Cost: one walk of the stretch, one of each shadow ray; where several media lie along a ray, one to the point.
    """
    end, pick, lamp = _walk(scene, world, stretch, 1, probes, active)
    draw = stretch.draw.part(mi.UInt32(0), 1)
    return end, pick.tau, _light_up(scene, world, stretch, pick.kept[0], pick.total, lamp, draw, probes, active)


def scattered_light(
    scene: mi.Scene, world: World, stretch: Stretch, active: mi.Bool
) -> tuple[Reach, list[mi.Float], mi.Spectrum]:
    """Walk a stretch to its end, and let it scatter at ``world.events`` points on the way, for a picture.

    Returns:
        Where the stretch ends, the optical depth of each channel to there, and the light of all points, in the mean.

    Bias: none. Variance: of each point as of :func:`scatter`; they share the lamp. Cost: one walk of the stretch, one of each
    shadow ray: long stretches pay for several points.
    """
    count, draw = world.events, stretch.draw
    end, pick, lamp = _walk(scene, world, stretch, count, False, active)

    def light_of(number: mi.UInt32) -> mi.Spectrum:
        kept, numbers = pick.of(number), draw.part(number, count)
        at = _light_up(scene, world, stretch, kept, pick.total, lamp, numbers, False, active)
        return dr.select(at.event.on, at.sigma_s * at.weight, 0)

    if count == 1:
        return end, pick.tau, light_of(mi.UInt32(0))
    _, light = dr.while_loop(
        state=(dr.zeros(mi.UInt32, dr.width(stretch.ray)), dr.zeros(mi.Spectrum, dr.width(stretch.ray))),
        cond=lambda number, light: number < count,
        body=lambda number, light: (number + 1, light + light_of(number)),
        label="points that scatter",
    )
    return end, pick.tau, light * (1 / count)


def _walk(
    scene: mi.Scene, world: World, stretch: Stretch, count: int, probes: bool, active: mi.Bool
) -> tuple[Reach, Pick, Lamp]:
    """Walk a stretch to its end and keep pieces of it, for a lamp that was drawn before."""
    kappa, draw, ray = KAPPA if probes else 0.0, stretch.draw, stretch.ray
    lamp = world.lights.choose(ray, draw.lamp)
    pick = start_pick(world, draw.piece, dr.width(ray), count)
    end, pick = reach(scene, world, ray, stretch.medium, offer(world, ray, lamp, kappa), pick, active)
    return end, pick, lamp


def _light_up(
    scene: mi.Scene,
    world: World,
    stretch: Stretch,
    kept: Kept,
    total: mi.Float,
    lamp: Lamp,
    draw: Draw,
    probes: bool,
    active: mi.Bool,
) -> Scattering:
    """Choose a point in a piece that was kept, and look from there to the lamps."""
    kappa, ray = KAPPA if probes else 0.0, stretch.ray
    event = place(world, ray, kept, total, lamp.focus, kappa, draw.inside, active & stretch.scatters)
    mei = _interaction(world, ray, event)
    tau = event.tau
    if not world.is_single:
        zero = [mi.Float(0) for _ in range(world.channels)]
        tau = revisit(scene, world, way_to(stretch, event.t), add_optical_depth(ray), zero, event.on)
    gain = dr.select(event.on, stretch.beta * transmittance(tau) / event.pdf, 0)
    found = arrivals(scene, world, mei, lamp, draw, probes, event.on, estimates=not probes)
    return Scattering(event, mei, gain, found, _sigma_s(world, ray, event, mei), draw.choice)


def way_to(stretch: Stretch, t: mi.Float64) -> Way:
    """The first part of a stretch, of length ``t``."""
    ray = stretch.ray
    return Way(mi.Ray3f(ray.o, ray.d, mi.Float(t), ray.time, ray.wavelengths), stretch.medium, t)


def interaction(ray: mi.Ray3f, t: mi.Float | mi.Float64, medium: mi.Medium | None = None) -> mi.MediumInteraction3f:
    """A point of a ray as Mitsuba's phase functions want it, found in float64 and rounded once."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
    p = [mi.Float(dr.fma(mi.Float64(t), mi.Float64(ray.d[a]), mi.Float64(ray.o[a]))) for a in range(3)]
    mei.t, mei.p, mei.wi = mi.Float(t), mi.Point3f(*p), -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    if medium is not None:
        mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(ray)), mi.MediumPtr(medium), None)
    return mei


def _interaction(world: World, ray: mi.Ray3f, event: Event) -> mi.MediumInteraction3f:
    mei = interaction(ray, event.t)
    for index, body in enumerate(world.bodies):
        mei.medium = dr.select(event.on & (event.body == index), mi.MediumPtr(body.view.medium), mei.medium)
    return mei


def at_event(world: World, event: Event) -> list[tuple[Body, mi.Bool]]:
    """The bodies, each with the lanes that scatter in it."""
    return [(body, event.on & (event.body == index)) for index, body in enumerate(world.bodies)]


def albedo(body: Body, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The albedo of a body at a point, with its derivative."""
    share = body.view.share
    return share.eval(mei, on) if isinstance(share, mi.Volume) else mi.Spectrum(share)


def sigma_t_at(world: World, body: Body, ray: mi.Ray3f, event: Event, on: mi.Bool) -> mi.Spectrum:
    """The extinction [1/length] at an event."""
    rows = event.sigma_t if world.is_single else body.extinction_at(ray, event.t, world.channels, on)
    return spectrum(rows)


def _sigma_s(world: World, ray: mi.Ray3f, event: Event, mei: mi.MediumInteraction3f) -> mi.Spectrum:
    total = mi.Spectrum(0)
    for body, on in at_event(world, event):
        if body.view.share is None:
            value = spectrum(body.extinction_at(ray, event.t, world.channels, on, "sigma_s"))
        else:
            value = dr.detach(albedo(body, mei, on)) * sigma_t_at(world, body, ray, event, on)
        total = dr.select(on, value, total)
    return total
