r"""Light of near emitters scattered along a segment of a path, at a distance drawn for the emitter.

.. math:: L = \int_0^D T(t)\,\sigma_s(x_t)\,L_d(x_t, \omega)\,dt \approx \frac{T \sigma_s L_d}{p(t)}

A path that scatters many times flies freely, and its collisions are drawn by the extinction alone. The light of an emitter with
a position falls as 1 / r^2, so its light at collisions has a heavy tail. Here every segment draws a second distance, by the
extinguished light and the angle seen from the emitter together (:mod:`.distance_sampling`), and adds the light of near emitters
there. The collision adds none. So the variance is the variance of single scattering, for every order of scattering.

The path may hit an extended emitter after a collision. That path and the sample at the drawn distance estimate the same light
from the same point and direction. The power heuristic weights both, by the densities of their directions at that point.

References: Kulla & Fajardo 2012 (equiangular sampling); Veach 1997, Eq. 9.13 (the power heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.direct_lighting import DirectLight, DirectLighting
from mivol.transport.estimators.lighting.vertex import MediumVertex
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.estimators.single_scattering.distance_sampling import (
    DistanceProposal,
    refill_reservoir,
    sample_distance,
    start_reservoir,
)
from mivol.transport.estimators.single_scattering.scattering_derivatives import (
    ScatteredLight,
    Scattering,
    event_coefficients,
    event_interaction,
)
from mivol.transport.media.optical_depth import segment_optical_depth, transmittance
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, draw_state
from mivol.transport.traversal.rays import point_along

__all__ = ["NearLight", "NearLightSamples", "NearLighting"]


@dataclass
class NearLightSamples:
    """The random numbers of the near light of a segment.

    Attributes:
        which_emitter: uniform random number in [0, 1) for the emitter.
        inside: two for the distance inside the chosen piece of the ray.
        emitter: two for the point on the emitter.
        rng: state of a generator for the piece, the shadow ray and the choice of a shadow ray for derivatives.
    """

    which_emitter: mi.Float
    inside: mi.Point2f
    emitter: mi.Point2f
    rng: mi.UInt32


@dataclass
class NearLight:
    """The light of near emitters scattered along a segment.

    Attributes:
        light: the light as a term.
        shadow: its shadow ray.
        chance: uniform random number in [0, 1), by which a shadow ray of the path is kept for derivatives.
    """

    light: ScatteredLight
    shadow: DirectLight
    chance: mi.Float


class NearLighting:
    """The estimator of the light of near emitters scattered along a segment.

    Args:
        direct: estimator of direct lighting.
        probe_depth: optical depth added over a medium for derivatives [1]; 0 for images.

    Attributes:
        emitters: the emitters with a position.
        lights_vertices: collisions draw the other emitters, at infinity.

    Bias: none. Variance: one distance and one point on one emitter. Cost: a walk of the segment, one up to the drawn distance,
    and a shadow ray.
    """

    def __init__(self, direct: DirectLighting, probe_depth: float) -> None:
        self.direct, self.media, self.probe_depth = direct, direct.media, probe_depth
        # Their tables are made here, outside of recorded loops.
        self.emitters = direct.near_emitters
        self.lights_vertices = bool(direct.far_emitters.sampled)

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> NearLightSamples:
        """Draw the random numbers of a segment."""
        return NearLightSamples(
            sampler.next_1d(active), sampler.next_2d(active), sampler.next_2d(active), draw_state(sampler, active)
        )

    def estimate(
        self, segment: PathSegment, length: mi.Float, samples: NearLightSamples, attached: bool, active: mi.Bool
    ) -> NearLight:
        """Estimate the light of a segment of known length."""
        media, ray = self.media, segment.ray
        on = active & segment.may_scatter
        rng, (chance,) = draw_pcg32(samples.rng, 1)
        # -- The distance ------------------------------------------------------------------------------------------------
        chosen = self.emitters.choose_emitter(ray, samples.which_emitter)
        proposal = DistanceProposal(media, ray, chosen, None, self.probe_depth, is_rough=True)
        passed = RaySegment(ray, segment.medium, length)
        reservoir = refill_reservoir(proposal, passed, start_reservoir(media, [rng]), on)
        (candidate,) = reservoir.candidates
        event = sample_distance(proposal, candidate, reservoir.total, samples.inside, on)
        mei, tau = event_interaction(media, ray, event), event.tau
        if not proposal.is_exact:
            tau = segment_optical_depth(media, RaySegment.upto(ray, segment.medium, event.t), event.on)
        gain = dr.select(event.on, segment.beta * transmittance(tau) / event.pdf, 0)
        # -- Direct light ------------------------------------------------------------------------------------------------
        sample = self.direct.sample_near_emitter(mei, chosen, samples.emitter, event.on)
        vertex = MediumVertex(media, mei, point_along(ray, event.t))
        direct = self.direct.estimate_at_vertex(vertex, sample, attached, event.on, candidate.rng)
        coefficients = event_coefficients(media, ray, event, mei, proposal.is_exact)
        light = ScatteredLight(media, segment, Scattering(event, mei, gain, [direct], *coefficients, chance))
        return NearLight(light, DirectLight(media, direct.ray_segment, light.value, direct.on), chance)
