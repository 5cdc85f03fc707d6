r"""Absorption where some media are known by a majorant only: their transmittance is estimated, that of all others is exact.

.. math:: L = \hat T\, L_{behind}, \qquad \partial L = -L\,\ell\;\partial\sigma(t)

The estimate T is that of ratio tracking (:mod:`.majorant_tracking`). The point t of a derivative is drawn uniformly over the
length l in the medium, and independently of T (:mod:`mivol.transport.media.drawn_points`), so the product is unbiased too.

References: Novak et al. 2014 (ratio tracking).
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
    """The segment estimator for media that only absorb, of which some are known by a majorant only.

    Args:
        media: of the scene.

    Bias: none, of the radiance and of its derivatives. Variance: that of ratio tracking, and of one point for derivatives.
    Cost: one walk of each exact medium; look-ups in proportion to the majorants of the others.
    """

    directions = "none"
    ends_in_media = False

    def __init__(self, media: SceneMedia) -> None:
        self.media = media

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> mi.Float:
        """One number in every lane.

        Not in ``active`` lanes only, which are those that may scatter once more: a sampler does not advance in the others, and
        would give them the same number at each segment.
        """
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
        """This estimator: a replay draws the same numbers, and finds the same transmittance again."""
        return self
