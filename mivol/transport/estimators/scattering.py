"""A scattering event on a segment: its position, its coefficients, and the direct light there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.direct_lighting import DirectSample
from mivol.transport.estimators.distance_sampling import MediumEvent
from mivol.transport.media.body import Body
from mivol.transport.media.channels import spectrum
from mivol.transport.media.coefficients import eval_albedo, medium_interaction
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.fine_ray import Ray

__all__ = ["Scattering", "at_event", "medium_event_interaction", "sigma_s_at", "sigma_t_at"]


@dataclass
class Scattering:
    """A scattering event, and the direct light there.

    Attributes:
        event: its position.
        mei: the same as Mitsuba's interaction.
        gain: throughput times transmittance to the camera, over the density of the position.
        direct: the shadow rays; their values carry derivatives where these are asked for.
        sigma_s: scattering coefficient [1/length] there.
        chance: a number in [0, 1), which chooses the shadow ray whose derivative is computed.
    """

    event: MediumEvent
    mei: mi.MediumInteraction3f
    gain: mi.Spectrum
    direct: list[DirectSample]
    sigma_s: mi.Spectrum
    chance: mi.Float

    @property
    def weight(self) -> mi.Spectrum:
        """Radiance at the camera for sigma_s = 1: the light is ``sigma_s * weight``."""
        return self.gain * sum((dr.detach(a.value) for a in self.direct), mi.Spectrum(0))


def medium_event_interaction(media: SceneMedia, ray: Ray, event: MediumEvent) -> mi.MediumInteraction3f:
    """An event as the interaction that Mitsuba's phase functions are evaluated at."""
    mei = medium_interaction(ray, event.t)
    mei.medium = media.medium_of(event.body, event.on)
    return mei


def at_event(media: SceneMedia, event: MediumEvent) -> list[tuple[Body, mi.Bool]]:
    """The bodies, each with the lanes that scatter in it."""
    return media.bodies_at(event.body, event.on)


def sigma_t_at(media: SceneMedia, body: Body, ray: Ray, event: MediumEvent, on: mi.Bool) -> mi.Spectrum:
    """The extinction [1/length] at an event."""
    rows = event.sigma_t if media.is_single else body.extinction_at(ray, event.t, media.channels, on)
    return spectrum(rows)


def sigma_s_at(media: SceneMedia, ray: Ray, event: MediumEvent, mei: mi.MediumInteraction3f) -> mi.Spectrum:
    """The scattering coefficient [1/length] at an event."""
    total = mi.Spectrum(0)
    for body, on in at_event(media, event):
        if body.view.albedo is None:
            value = spectrum(body.extinction_at(ray, event.t, media.channels, on, "sigma_s"))
        else:
            value = dr.detach(eval_albedo(body, mei, on)) * sigma_t_at(media, body, ray, event, on)
        total = dr.select(on, value, total)
    return total
