r"""Side flights: a second sampling technique for light scattered twice by peaked phase functions.

At a vertex x of a path in a medium, the direction w of an emitter sample is drawn for the *next* vertex x'. The path leaves x
in a direction of the phase function, with density p. Vertex x' scatters little light from w unless this direction lies near w.
A side flight leaves x in a direction of a lobe about w, with density q, and receives the emitter's light along w at its
collision. Given w, both techniques estimate the light travelling from w over x' to x. The balance heuristic combines them: the
direct light at x' has the weight p / (p + q), and the light at the end of the side flight q / (p + q).

All emitters are at infinity, so w has the same density at x' and at x.

Light scattered three times and more comes from many directions, most of them near w. So a share of the path's own directions
is drawn from a lobe about w too, and p is the density of the mixture. This lobe is wider: the mean cosine after two
scatterings is the product of both. The throughput grows by at most 1 / (1 - ``AIMED_SHARE``) at a vertex, and paths with a
throughput above 1 draw from the phase function alone.

For derivatives, a side flight is walked back like the path's own flights, and its shadow ray is offered to the path's
reservoir. Only the probes of the path estimate derivatives in regions without extinction
(:mod:`mivol.transport.estimators.flights.flight_derivatives`), since the points of probes are drawn without these weights.

Source: the balance heuristic (Veach & Guibas 1995), applied to next-event estimation with a direction drawn one vertex early.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.phase.closed_forms import angle_between, eval_hg, sample_hg, scattered_direction
from mivol.transport.estimators.lighting.direct_lighting import DirectLight, DistantEmitterSample
from mivol.transport.estimators.lighting.tabulated_shadows import TabulatedShadow
from mivol.transport.estimators.lighting.vertex import MediumVertex
from mivol.transport.estimators.scores import IMAGE, Factor, TrackedTerm
from mivol.transport.estimators.segment import Collision, PathSegment
from mivol.transport.estimators.single_scattering.near_light import AimedDirections
from mivol.transport.path.estimators import Estimators
from mivol.transport.traversal.rays import FineRay

__all__ = [
    "SideFlight",
    "SideFlightLight",
    "SideFlightSamples",
    "WeightedEmitterSample",
    "aim_at_emitter",
    "estimate_side_flight",
    "weigh_emitter_sample",
]


AIMED_SHARE = 0.1
"""Share of the directions at a vertex that are drawn about the emitter sample [1]. (Variance over the variance without them, at
0.07, 0.1, 0.15 and 0.25: 0.53, 0.50, 0.49 and 0.76 in a smoke of optical depth 20 with a mean cosine of 0.8 under a sun, and
0.99, 1.02, 1.07 and 1.22 in a cloud of albedo 0.999.)

A constant environment is the same in all directions. Aimed directions find nothing there, and their weights are noise of this
light. Therefore the share falls with ``Estimators.even_share``."""


@dataclass
class WeightedEmitterSample:
    """The emitter sample of the next vertex.

    Attributes:
        sample: emitter sample.
        weight: weight of the direct light at a vertex in a medium [1].
    """

    sample: DistantEmitterSample
    weight: mi.Float


@dataclass
class SideFlightSamples:
    """Random numbers of a side flight: for the lobe, for the flight, and the generator of the shadow ray at the end."""

    lobe: mi.Point2f
    flight: tuple[mi.Float, mi.UInt32]
    shadow: mi.UInt32 | None


class SideFlightLight(TrackedTerm):
    """The light at the end of a side flight, as a term without the derivatives of the media along its shadow ray.

    Args:
        value: radiance at the camera, attached to the phase functions and the emitter.
        flown: factor with the derivatives of the transmittance of the flight and of the albedo at the end.
        active: lanes receiving light.
    """

    def __init__(self, value: mi.Spectrum, flown: Factor, active: mi.Bool) -> None:
        super().__init__(value, active)
        self.flown = flown

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add the derivatives of the phase functions, the emitter and the flight, weighted by ``dL``."""
        super().vjp(dL)
        self.flown.vjp(dL * self.value)

    def jvp(self) -> mi.Spectrum:
        """Tangent of the light."""
        return super().jvp() + self.value * self.flown.jvp()


@dataclass
class SideFlight:
    """A side flight.

    Attributes:
        light: light at the end.
        shadow: shadow ray at the end.
        chance: uniform random number in [0, 1), by which a shadow ray of the path is kept for derivatives; None in images.
        tabulated: the same shadow ray with its shadow read from a table; None without a table.
    """

    light: SideFlightLight
    shadow: DirectLight
    chance: mi.Float | None
    tabulated: TabulatedShadow | None


def estimate_side_flight(
    estimators: Estimators,
    collision: Collision,
    beta: mi.Spectrum,
    depth: mi.UInt32,
    sample: DistantEmitterSample,
    aimed: AimedDirections,
    numbers: SideFlightSamples,
    purpose: str,
    active: mi.Bool,
) -> SideFlight:
    """Estimate light scattered twice by a side flight.

    Args:
        estimators: estimators of the render; ``lobe`` is the mean cosine of the lobe.
        collision: vertex at which the flight starts.
        beta: throughput up to the vertex [1].
        depth: number of scattering events before the vertex.
        sample: emitter sample, used by the next vertex of the path too.
        aimed: share of the path's own directions drawn about the emitter.
        numbers: random numbers.
        purpose: IMAGE, REVERSE or FORWARD; values stay attached for derivatives.
        active: lanes whose path may scatter at the vertex and once more.

    Returns:
        The side flight; its light is 0 in lanes without a collision.

    Cost: one flight and one shadow ray.
    """
    media, mei, attached = estimators.media, collision.mei, purpose != IMAGE
    # -- The direction: from the lobe about the emitter ------------------------------------------------------------------
    w = _direction_to_emitter(sample)
    wo = scattered_direction(-w, sample_hg(numbers.lobe.x, estimators.lobe), numbers.lobe.y)
    vertex = MediumVertex(media, mei, collision.p)
    f, p = vertex.eval_and_pdf(wo, active)
    # beta albedo f / q, times the weight q / (p + q): q cancels.
    weight = beta * collision.albedo * dr.rcp(aimed.mix(p, wo) + eval_hg(angle_between(-w, wo), estimators.lobe))

    # -- The flight ------------------------------------------------------------------------------------------------------
    ray = FineRay.from_point(collision.p, wo, mei)
    segment = PathSegment(ray, mei.medium, weight * f, active, numbers.flight, depth, is_side_flight=True)
    flight = estimators.segment.estimate(segment, purpose, active)

    # -- The emitter's light at its end ----------------------------------------------------------------------------------
    hit = flight.collision
    on = active & hit.on
    end = MediumVertex(media, hit.mei, hit.p)
    direct = estimators.direct.estimate_at_vertex(end, sample.at_point(hit.mei), attached, on, numbers.shadow)
    with dr.resume_grad(when=attached):
        if attached:
            f = vertex.eval(wo, active)
        flown = weight * f * (flight.T * hit.albedo)
        value = flown * direct.value
    lit = on & direct.on
    light = SideFlightLight(value, flight.transmittance, lit)
    shadow = DirectLight(media, direct.ray_segment, value, lit)
    tabulated = None if direct.shadow is None else direct.shadow.times(flown)
    return SideFlight(light, shadow, flight.chance, tabulated)


def aim_at_emitter(
    estimators: Estimators, sample: DistantEmitterSample, beta: mi.Spectrum, u: mi.Float, active: mi.Bool
) -> AimedDirections:
    """Draw a share of the path's directions about an emitter sample.

    Args:
        estimators: estimators of the render.
        sample: emitter sample.
        beta: throughput up to the vertex [1].
        u: uniform random number in [0, 1) that chooses such a direction.
        active: lanes with a side flight at the vertex; the share is 0 in other lanes.
    """
    share = dr.select(active & (dr.max(beta) <= 1), AIMED_SHARE * (1 - mi.Float(estimators.even_share)), 0)
    return AimedDirections([_direction_to_emitter(sample)], [share], u, dr.square(estimators.lobe))


def weigh_emitter_sample(
    estimators: Estimators, sample: DistantEmitterSample, wo: mi.Vector3f, pdf: mi.Float, active: mi.Bool
) -> WeightedEmitterSample:
    """Weigh the emitter sample for the next vertex.

    Args:
        estimators: estimators of the render.
        sample: emitter sample.
        wo: direction in which the path leaves the vertex.
        pdf: density of ``wo`` [1/sr].
        active: lanes with a side flight at the vertex; the weight is 1 in other lanes.
    """
    q = eval_hg(angle_between(-_direction_to_emitter(sample), wo), estimators.lobe)
    return WeightedEmitterSample(sample, dr.select(active, pdf * dr.rcp(pdf + q), 1))


def _direction_to_emitter(sample: DistantEmitterSample) -> mi.Vector3f:
    # The direction is 0 if an emitter has no light to sample. The light is 0 then, so the axis of the lobe does not matter.
    return dr.select(dr.squared_norm(sample.d) > 0.5, sample.d, mi.Vector3f(0, 0, 1))
