r"""One shadow ray of a path, kept for the derivatives of the media along it (weighted reservoir sampling).

A path that scatters n times has n shadow rays, and each would be walked back through all of its cells. Instead one of them is
kept in proportion to its light, and its derivative is divided by the probability that it was: the mean is the same, and where
one vertex has most of a path's light so is nearly all of the noise.

Bias: none. Source: weighted reservoir sampling, Chao 1982.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.direct_lighting import DirectLight
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.fine_ray import FineRay, Ray

__all__ = ["ShadowReservoir", "ShadowTerm"]


@dataclass
class ShadowReservoir:
    """The shadow ray that was kept so far.

    Attributes:
        ray_segment: the ray.
        value: its light, as the camera sees it.
        weight: that it was kept with.
        total: of the weights of all shadow rays.
    """

    ray_segment: RaySegment
    value: mi.Spectrum
    weight: mi.Float
    total: mi.Float

    @classmethod
    def empty(cls, media: SceneMedia, ray: Ray) -> ShadowReservoir:
        """No shadow ray yet."""
        n = dr.width(ray)
        zero = dr.zeros(mi.Float, n)
        u = zero if media.is_bounded else None
        return cls(RaySegment(FineRay.of(ray), dr.zeros(mi.MediumPtr, n), zero, True, u), dr.zeros(mi.Spectrum, n), zero, zero)

    def offer(self, light: DirectLight, chance: mi.Float) -> ShadowReservoir:
        """The reservoir after one more shadow ray: a step of weighted reservoir sampling.

        Args:
            light: the emitter sample whose shadow ray is offered; its weight is its largest channel.
            chance: a uniform random number in [0, 1). The new ray is kept where it is below weight / (sum of all weights).
        """
        weight = dr.select(light.active, dr.max(dr.abs(light.value)), 0)
        total = self.total + weight
        keep, new, old = chance * total < weight, light.ray_segment, self.ray_segment
        kept = RaySegment(
            dr.select(keep, new.ray, old.ray),
            dr.select(keep, new.medium, old.medium),
            dr.select(keep, mi.Float(new.length), old.length),
            True,
            None if old.u is None else dr.select(keep, new.u, old.u),
        )
        return ShadowReservoir(kept, dr.select(keep, light.value, self.value), dr.select(keep, weight, self.weight), total)


@dataclass
class ShadowTerm:
    """The derivatives of the media along the shadow ray that was kept, as a term of value 0."""

    media: SceneMedia
    kept: ShadowReservoir
    is_replayed = True

    @property
    def value(self) -> mi.Spectrum:
        """Nothing: the light of the shadow ray has been counted."""
        return mi.Spectrum(0)

    @property
    def _light(self) -> mi.Spectrum:
        """The light over the probability of having been kept."""
        kept = self.kept
        return dr.select(self._on, kept.value * (kept.total / dr.select(self._on, kept.weight, 1)), 0)

    @property
    def _on(self) -> mi.Bool:
        return self.kept.weight > 0

    def vjp(self, dL: mi.Spectrum) -> None:
        vjp_optical_depth(self.media, self.kept.ray_segment, -dL * self._light, self._on)

    def jvp(self) -> mi.Spectrum:
        return -self._light * jvp_optical_depth(self.media, self.kept.ray_segment, self._on)
