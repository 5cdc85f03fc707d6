r"""Media of which some are bounded take light away: their transmittance is estimated, that of all others is exact.

.. math:: L = \hat T\, L_{behind}, \qquad \partial L = -L\,\ell\;\partial\sigma(t)

The point t of a derivative is drawn evenly and independently of the estimate (:mod:`mivol.transport.media.drawn_points`), so
that the product is unbiased too.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.segment import PathSegment, SegmentEstimate, Transmittance
from mivol.transport.estimators.shadow_rays import estimate_transmittance
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32
from mivol.transport.traversal.strata import Strata

__all__ = ["TrackedAbsorption"]


class TrackedAbsorption:
    """Media add nothing, and some of them are bounded.

    Args:
        media: of the scene.

    Bias: none, of the radiance and of its derivatives. Variance: that of ratio tracking, and of one point for derivatives.
    Cost: one walk of each exact medium; look-ups in proportion to the majorants of the others.
    """

    directions = "none"

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> mi.Float:
        """One number in every lane: ``active`` are those that may turn, and all others would draw the same one again."""
        return sampler.next_1d()

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        width = dr.width(segment.ray)
        rng = seed_pcg32(segment.samples, width)
        end, T = estimate_transmittance(self.media, segment.ray, segment.medium, active, rng)
        _, (u,) = draw_pcg32(seed_pcg32(segment.samples, width, 1), 1)
        passed = RaySegment(segment.ray, segment.medium, end.t, u=u)
        return SegmentEstimate(end, T, None, Transmittance(self.media, passed, active))

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Nothing is needed."""

    def replayed(self) -> TrackedAbsorption:
        """A replay meets the same estimates of the transmittance."""
        return self
