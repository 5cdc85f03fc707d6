r"""A second technique for light that scatters twice in peaked phase functions: a side flight towards the light.

At a vertex x of a path in a medium the direction w of an emitter sample is drawn for the *next* vertex x'. The path's own
direction comes from the phase function at x, with density p; x' then scatters little of the light from w, unless that
direction happens to be near w. A side flight leaves x in a direction from a lobe about w, with density q, and looks at the
emitter along w from where it collides. Given w, both estimate the light that goes from w over x' to x, so they are combined by
the balance heuristic: the direct light at x' counts p / (p + q), that at the end of the side flight q / (p + q).

Emitters are at infinity here, so that w is as probable at x' as at x.

For derivatives a side flight is walked back like the path's own flights, and its shadow ray is offered to the path's reservoir.
The light that is missed where there is no extinction is found by the probes of the path alone
(:mod:`mivol.transport.estimators.flights.flight_derivatives`), since their points are drawn without those weights.

Source: the balance heuristic of Veach & Guibas 1995, applied to next-event estimation with a direction drawn one vertex early.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.phase.closed_forms import eval_hg, sample_hg
from mivol.phase.scattering_angle import angle_between, scattered_direction
from mivol.transport.estimators.lighting.direct_lighting import DirectLight, DistantEmitterSample
from mivol.transport.estimators.lighting.vertex import MediumVertex
from mivol.transport.estimators.scores import IMAGE, Factor, TrackedTerm
from mivol.transport.estimators.segment import Collision, PathSegment
from mivol.transport.path.estimators import Estimators
from mivol.transport.traversal.rays import FineRay

__all__ = [
    "WeightedEmitterSample",
    "SideFlight",
    "SideFlightLight",
    "SideFlightSamples",
    "estimate_side_flight",
    "weigh_emitter_sample",
]


@dataclass
class WeightedEmitterSample:
    """The emitter sample that the next vertex takes.

    Attributes:
        sample: it.
        weight: of the direct light there, in a medium.
    """

    sample: DistantEmitterSample
    weight: mi.Float


@dataclass
class SideFlightSamples:
    """The random numbers of a side flight: of the lobe, of the flight, and the generator of the shadow at its end."""

    lobe: mi.Point2f
    flight: tuple[mi.Float, mi.UInt32]
    shadow: mi.UInt32 | None


class SideFlightLight(TrackedTerm):
    """The light at the end of a side flight, as a term, but for the derivatives of the media along its shadow ray.

    Args:
        value: as the camera sees it, attached to the phase functions and the emitter.
        flown: the transmittance of the flight, and the albedo at its end, as a factor.
        active: lanes that receive it.
    """

    def __init__(self, value: mi.Spectrum, flown: Factor, active: mi.Bool) -> None:
        super().__init__(value, active)
        self.flown = flown

    def vjp(self, dL: mi.Spectrum) -> None:
        """Derivatives of the phase functions and the emitter, and of the flight."""
        super().vjp(dL)
        self.flown.vjp(dL * self.value)

    def jvp(self) -> mi.Spectrum:
        """Tangent of both."""
        return super().jvp() + self.value * self.flown.jvp()


@dataclass
class SideFlight:
    """A side flight.

    Attributes:
        light: that it finds.
        shadow: the shadow ray at its end.
        chance: for derivatives, a number in [0, 1) by which one of a path's shadow rays is kept; None for pictures.
    """

    light: SideFlightLight
    shadow: DirectLight
    chance: mi.Float | None


def estimate_side_flight(
    estimators: Estimators,
    collision: Collision,
    beta: mi.Spectrum,
    depth: mi.UInt32,
    aim: DistantEmitterSample,
    samples: SideFlightSamples,
    purpose: str,
    active: mi.Bool,
) -> SideFlight:
    """Estimate the light that scatters twice by a side flight.

    Args:
        estimators: of the render; their ``lobe`` is the mean cosine of the lobe.
        collision: the vertex that the flight leaves.
        beta: throughput to there.
        depth: number of scattering events before it.
        aim: the emitter sample, which the next vertex takes too.
        samples: random numbers.
        purpose: IMAGE, or that of derivatives, which keeps the values attached.
        active: lanes whose path may scatter here and once more.

    Returns:
        The light; where the flight meets no medium there is none.

    Cost: one flight and one shadow ray.
    """
    media, mei, attached = estimators.media, collision.mei, purpose != IMAGE
    w = _direction_to_emitter(aim)
    wo = scattered_direction(-w, sample_hg(samples.lobe.x, estimators.lobe), samples.lobe.y)
    vertex = MediumVertex(media, mei, collision.place)
    f, p = vertex.eval_and_pdf(wo, active)
    reached = beta * collision.albedo * dr.rcp(p + eval_hg(angle_between(-w, wo), estimators.lobe))
    ray = FineRay.from_point(collision.place, wo, mei)
    ahead = PathSegment(ray, mei.medium, reached * f, active, samples.flight, depth, is_side_flight=True)
    flown = estimators.segment.estimate(ahead, purpose, active)
    there = flown.collision
    on = active & there.on
    end = MediumVertex(media, there.mei, there.place)
    direct = estimators.direct.estimate_at_vertex(end, aim.at_point(there.mei), attached, on, samples.shadow)
    with dr.resume_grad(when=attached):
        if attached:
            f = vertex.eval(wo, active)
        value = reached * f * (flown.T * there.albedo) * direct.value
    lit = on & direct.on
    chance = None if flown.probe is None else flown.probe.chance
    return SideFlight(
        SideFlightLight(value, flown.transmittance, lit), DirectLight(media, direct.ray_segment, value, lit), chance
    )


def weigh_emitter_sample(
    estimators: Estimators, sample: DistantEmitterSample, wo: mi.Vector3f, p: mi.Float, active: mi.Bool
) -> WeightedEmitterSample:
    """The aim of the next vertex; ``active`` lanes have made a side flight for it.

    The path leaves this vertex in the direction ``wo``, of density ``p``.
    """
    q = eval_hg(angle_between(-_direction_to_emitter(sample), wo), estimators.lobe)
    return WeightedEmitterSample(sample, dr.select(active, p * dr.rcp(p + q), 1))


def _direction_to_emitter(aim: DistantEmitterSample) -> mi.Vector3f:
    # Where an emitter has no light to sample, the direction is 0; its light is 0, whatever the lobe is about.
    return dr.select(dr.squared_norm(aim.d) > 0.5, aim.d, mi.Vector3f(0, 0, 1))
