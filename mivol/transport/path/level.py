"""The level of radiance that derivatives of free flights are taken from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flight_derivatives import Level, weigh_collisions
from mivol.transport.estimators.segment import PICTURE, Collision, PathSegment
from mivol.transport.media.channels import colours
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.scores import Primal
from mivol.transport.path.settings import Settings
from mivol.transport.path.walk import walk_path
from mivol.transport.traversal.ray_spawning import camera_ray

__all__ = ["prepare_derivatives"]


FEWEST, MOST, SHARE = 1 << 12, 1 << 15, 64
"""Paths that the level is estimated from: one for so many of a pass, within bounds. It need not be accurate, since derivatives
are unbiased whatever it is."""

TILES = 8
"""Tiles along an edge of the film that have a level of their own. (Second moment of the light at first collisions about the
level, 64 x 64 pixels: smoke in the sun 0.88, 0.78, 0.76 and 0.79 of that about one level for all with 2, 4, 8 and 16 tiles;
in even light 0.98 and in a cloud 0.94 to 0.95 with any of them.)"""

COLLISIONS = 16.0
"""As many collisions count as the mean of all does in a tile: about the ratio of the noise of paths to what the light of tiles
differs by (3 in smoke in the sun, 16 in a cloud, 60 in smoke in even light)."""

SEED = 0x1E7E1
"""Of those paths. They are independent of the paths of a render, or the level would bias its derivatives."""


def prepare_derivatives(estimators: Estimators, settings: Settings, ray: mi.Ray3f, on_film: mi.Point2f) -> None:
    """Find what derivatives along the camera rays of a pass need beforehand.

    Args:
        estimators: of the render.
        settings: depth, roulette, hidden emitters.
        ray: the camera rays of the pass.
        on_film: where they lie on the film, as shares of it.
    """
    estimators.prepare_derivatives(ray)
    segment = estimators.segment
    if segment.ends_in_media:
        segment.level = _find_level(estimators, settings, ray, on_film)


def _find_level(estimators: Estimators, settings: Settings, ray: mi.Ray3f, on_film: mi.Point2f) -> Level | None:
    """The mean radiance that flights of camera rays find where they collide, each weighed as its derivative is, squared: the
    level at which the derivatives at collisions have the least noise. First flights have a level for each tile of the film.

    What is seen past a medium does not count: it is often brighter, and with it in the mean the noise was 1.3 to 1.6 times as
    large (smoke in the sun and under a constant sky, voxels with sigma_t >= 1, variance).

    Returns:
        The level; None where a medium has no albedo (but a ``sigma_s``), since its absorption has no such balance.
    """
    media = estimators.media
    if any(body.view.albedo is None for body in media.bodies):
        return None
    n = dr.width(ray)
    count = min(max(n // SHARE, FEWEST), MOST)
    index = mi.UInt32(dr.arange(mi.UInt64, count) * n // count)
    rays, tile = mi.Ray3f(ray), _tile_of(on_film)
    # What is gathered from has to be evaluated: at once, not each number of a ray by a kernel of its own.
    dr.eval(rays, tile)
    some = camera_ray(dr.gather(mi.Ray3f, rays, index))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, count)
    collision = _fly_first(estimators, sampler.clone(), some)
    path = walk_path(estimators, settings, sampler, some, Primal(dr.zeros(mi.Spectrum, count)))[0]
    # Behind a boundary that refracts no first flight collides; the mean of all rays is then as good a guess as any.
    weight = dr.select(dr.any(collision.on), dr.square(weigh_collisions(media, some, collision)), 1)
    seen, weight, at = dr.detach(path.L), dr.detach(weight), dr.gather(mi.UInt32, tile, index)
    # Each sum would walk the paths again.
    dr.eval(seen, weight)
    pairs = [_mean_of_tiles(L, w, at) for L, w in zip(colours(seen), colours(weight), strict=True)]
    first = mi.Spectrum(*(dr.gather(mi.Float, tiles, tile) for _, tiles in pairs))
    level = Level(first, mi.Spectrum(*(mean for mean, _ in pairs)))
    dr.eval(level)
    return level


def _tile_of(on_film: mi.Point2f) -> mi.UInt32:
    """The tile of the film that a place is in; places beside the film belong to the nearest."""
    x, y = dr.clip(mi.Point2i(on_film * TILES), 0, TILES - 1)
    return mi.UInt32(y * TILES + x)


def _fly_first(estimators: Estimators, sampler: mi.Sampler, ray: mi.Ray3f) -> Collision:
    """Where paths that are walked with the same random numbers collide on their first segment."""
    on, segment = dr.full(mi.Bool, True, dr.width(ray)), estimators.segment
    samples = segment.draw(sampler, on, None)
    ahead = PathSegment(ray, estimators.media.medium_at(ray), dr.full(mi.Spectrum, 1, dr.width(ray)), on, samples, mi.UInt32(0))
    return segment.estimate(ahead, PICTURE, on).collision


def _mean_of_tiles(values: mi.Float, weights: mi.Float, tile: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """The mean of one channel, 0 where nothing has a weight, and that of each tile, drawn to the mean of all."""
    total, found = dr.sum(weights), dr.count(weights > 0)
    mean = dr.select(total > 0, dr.sum(values * weights) / dr.select(total > 0, total, 1), 0)
    sums, of_tile = (dr.zeros(mi.Float, TILES * TILES) for _ in range(2))
    dr.scatter_add(sums, values * weights, tile)
    dr.scatter_add(of_tile, weights, tile)
    prior = COLLISIONS * total / dr.maximum(mi.Float(found), 1)
    return mean, dr.select(total > 0, (sums + prior * mean) / dr.select(total > 0, of_tile + prior, 1), 0)
