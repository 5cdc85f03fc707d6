"""The level of radiance that derivatives of free flights are taken from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flight_derivatives import weigh_collisions
from mivol.transport.estimators.segment import PICTURE, Collision, PathSegment
from mivol.transport.media.channels import colours
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.scores import Primal
from mivol.transport.path.settings import Settings
from mivol.transport.path.walk import walk_path
from mivol.transport.traversal.ray_spawning import camera_ray

__all__ = ["prepare_derivatives"]


PATHS = 4096
"""Paths that the level is estimated from: it need not be accurate, since derivatives are unbiased whatever it is."""

SEED = 0x1E7E1
"""Of those paths. They are independent of the paths of a render, or the level would bias its derivatives."""


def prepare_derivatives(estimators: Estimators, settings: Settings, ray: mi.Ray3f) -> None:
    """Find what derivatives along camera rays need beforehand, once for all passes.

    Args:
        estimators: of the render.
        settings: depth, roulette, hidden emitters.
        ray: the camera rays of a pass.
    """
    estimators.prepare_derivatives(ray)
    segment = estimators.segment
    if segment.ends_in_media and segment.level is None:
        segment.level = _find_level(estimators, settings, ray)


def _find_level(estimators: Estimators, settings: Settings, ray: mi.Ray3f) -> mi.Spectrum | None:
    """The mean radiance that flights of camera rays find where they collide, each weighed as its derivative is, squared: the
    level at which the derivatives at collisions have the least noise.

    What is seen past a medium does not count: it is often brighter, and with it in the mean the noise was 1.3 to 1.6 times as
    large (smoke in the sun and under a constant sky, voxels with sigma_t >= 1, variance).

    Returns:
        The level [radiance]; None where a medium has no albedo (but a ``sigma_s``), since its
        absorption has no such balance.
    """
    media = estimators.media
    if any(body.view.albedo is None for body in media.bodies):
        return None
    n = dr.width(ray)
    index = mi.UInt32(dr.arange(mi.UInt64, PATHS) * n // PATHS)
    some = camera_ray(dr.gather(mi.Ray3f, mi.Ray3f(ray), index))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, PATHS)
    collision = _fly_first(estimators, sampler.clone(), some)
    score, _ = walk_path(estimators, settings, sampler, some, Primal(dr.zeros(mi.Spectrum, PATHS)))
    # Behind a boundary that refracts no first flight collides; the mean of all rays is then as good a guess as any.
    weight = dr.select(dr.any(collision.on), dr.square(weigh_collisions(media, some, collision)), 1)
    level = _weighted_mean(dr.detach(score.L), dr.detach(weight))
    dr.eval(level)
    return level


def _fly_first(estimators: Estimators, sampler: mi.Sampler, ray: mi.Ray3f) -> Collision:
    """Where paths that are walked with the same random numbers collide on their first segment."""
    on, segment = dr.full(mi.Bool, True, PATHS), estimators.segment
    samples = segment.draw(sampler, on, None)
    ahead = PathSegment(ray, estimators.media.medium_at(ray), dr.full(mi.Spectrum, 1, PATHS), on, samples)
    return segment.estimate(ahead, PICTURE, on).collision


def _weighted_mean(values: mi.Spectrum, weights: mi.Spectrum) -> mi.Spectrum:
    """The mean of each channel; 0 where nothing has a weight."""
    sums = [(dr.sum(v * w), dr.sum(w)) for v, w in zip(colours(values), colours(weights), strict=True)]
    return mi.Spectrum(*(dr.select(w > 0, v / dr.select(w > 0, w, 1), 0) for v, w in sums))
