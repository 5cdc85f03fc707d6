r"""Derivatives of paths that branch where they first collide.

.. math:: L = \frac{1}{k} \sum_{j=1}^{k} L_j

A path is walked as a stem, from the camera to its first collision, and k branches from there to its end, whose mean is the
radiance that the stem finds. Many camera rays pass a volume without a collision: they have only a stem, and most noise of a
gradient is that of the few branches. These lie side by side, in the order of their lengths once those are known, so that few
lanes wait for their neighbours.

With the noise A of stems and B of a branch, at the costs a and b, A + B / k at the cost a + b k is best with
k = sqrt(B a / (A b)), and b is in proportion to the share of stems that collide.

Bias: none. Memory: some 40 numbers a branch; there are at most as many as stems.

References: Arvo & Kirk 1990 (splitting); Vicini et al. 2021 (path replay).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.flights.flight_derivatives import Baseline, collision_weights
from mivol.transport.estimators.scores import IMAGE, Primal, Replay
from mivol.transport.estimators.segment import Collision, PathSegment
from mivol.transport.media.channels import to_components
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.film import CameraRays
from mivol.transport.path.walk import FirstCollision, gather_lanes, walk_branch, walk_path, walk_stem
from mivol.transport.traversal.random_numbers import LaneSampler, draw_seeds
from mivol.transport.traversal.rays import FineRay, clip_camera_ray

__all__ = ["count_branches", "replay_branches", "prepare_derivatives"]

MAX_BRANCHES = 4
"""Branches of a path."""

BALANCE = 0.6
"""(B a) / (A b), times the share of stems that collide: for a share of 0.17 two branches, for more than 0.27 one. (Smoke and a
cloud of that share: three have the least variance x time over voxels with sigma_t >= 1, one over empty voxels.)"""

MAX_SORTED_LENGTH = np.uint16(0xFFFF)
"""Scatterings of a path, as far as its place in the order of lengths goes."""


def count_branches(stems: int, collided: int) -> int:
    """How many branches a path has, of as many stems of which some have collided."""
    return min(MAX_BRANCHES, max(1, round(math.sqrt(BALANCE * stems / collided))))


def replay_branches(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum) -> None:
    """Add the derivatives of the radiance along camera rays to gradients.

    Args:
        estimators: whose segments end in media, prepared for derivatives along these rays.
        rays: of a sampler whose numbers are independent.
        dL: d loss / d radiance of each ray.
    """
    n, sampler = dr.width(rays.ray), rays.sampler
    seeds = draw_seeds(sampler)
    again, replayed = sampler.clone(), estimators.replayed()
    stems, landing = walk_stem(replayed, sampler, rays.ray, Primal(dr.zeros(mi.Spectrum, n)))
    dr.eval(seeds, stems.L, landing)
    collided = dr.compress(landing.on)
    if (count := dr.width(collided)) == 0:
        walk_stem(estimators, again, rays.ray, Replay(stems.L, dL))
        return
    k = count_branches(n, count)
    share, branches = dr.opaque(mi.Float, 1 / k), _Branches.of(landing, collided, seeds, k)
    found, depth = branches.walk(replayed, Primal(dr.zeros(mi.Spectrum, count * k)))
    dr.eval(found.L, depth)
    for total, one in zip(stems.L, found.L, strict=True):
        dr.scatter_add(total, one * share, branches.stem)
    walk_stem(estimators, again, rays.ray, Replay(stems.L, dL))
    level = estimators.segment.baseline
    estimators.segment.baseline = None if level is None else level.for_branches
    order = _order_by_length(depth)
    branches = branches.at(order)
    L, dL = dr.gather(mi.Spectrum, found.L, order), dr.gather(mi.Spectrum, dL, branches.stem)
    branches.walk(estimators, Replay(L, dL * share))


@dataclass
class _Branches:
    """Branches of paths.

    Attributes:
        stem: the numbers of their stems.
        landing: where these have collided.
        seeds: of the random numbers, and the number of their sequence.
    """

    stem: mi.UInt32
    landing: FirstCollision
    seeds: tuple[mi.UInt32, mi.UInt32, mi.UInt32]

    @classmethod
    def of(cls, landing: FirstCollision, collided: mi.UInt32, seeds: tuple[mi.UInt32, mi.UInt32], k: int) -> _Branches:
        """So many branches of each stem that has collided, side by side."""
        number = dr.arange(mi.UInt32, dr.width(collided) * k)
        stem = dr.gather(mi.UInt32, collided, number // dr.opaque(mi.UInt32, k))
        a, b = (dr.gather(mi.UInt32, seed, stem) for seed in seeds)
        # The branches of a stem differ in their number only: a hash of it is the state, or their numbers would resemble each
        # other.
        found = cls(stem, _gather_collisions(landing, stem), (*mi.sample_tea_32(a ^ (b << 8), number), number))
        dr.eval(found)
        return found

    def at(self, order: mi.UInt32) -> _Branches:
        """The branches in another order."""
        stem, *seeds = (dr.gather(mi.UInt32, values, order) for values in (self.stem, *self.seeds))
        found = _Branches(stem, _gather_collisions(self.landing, order), tuple(seeds))
        dr.eval(found)
        return found

    def walk(self, estimators: Estimators, score: Primal | Replay) -> tuple[Primal | Replay, mi.UInt32]:
        """Walk them to their ends; the score, and how often each has scattered."""
        return walk_branch(estimators, LaneSampler.seeded(*self.seeds), self.landing, score)


def _gather_collisions(landing: FirstCollision, index: mi.UInt32) -> FirstCollision:
    """The collisions with these numbers."""
    ray = landing.ray
    o, d, maxt, time = (gather_lanes(values, index) for values in (ray.o, ray.d, ray.maxt, ray.time))
    t, body, beta, on = (gather_lanes(values, index) for values in (landing.t, landing.body, landing.beta, landing.on))
    return FirstCollision(FineRay(o, d, maxt, time, ray.wavelengths), t, body, beta, on)


def _order_by_length(depth: mi.UInt32) -> mi.UInt32:
    """The numbers of paths in the order of their lengths, the longest first."""
    # Numbers of 16 bits are sorted in a time that is linear in their count; longer paths are too few to be told apart.
    shortness = MAX_SORTED_LENGTH - np.minimum(depth.numpy(), MAX_SORTED_LENGTH).astype(np.uint16)
    return mi.UInt32(np.argsort(shortness, kind="stable"))


MIN_PATHS, MAX_PATHS, RAYS_PER_PATH = 1 << 12, 1 << 15, 64
"""Paths that the level is estimated from: one for so many of a pass, within bounds. It need not be accurate, since derivatives
are unbiased whatever it is."""

TILES_PER_AXIS = 8
"""Tiles along an edge of the film that have a level of their own. (Second moment of the light at first collisions about the
level, 64 x 64 pixels: smoke in the sun 0.88, 0.78, 0.76 and 0.79 of that about one level for all with 2, 4, 8 and 16 tiles;
in even light 0.98 and in a cloud 0.94 to 0.95 with any of them.)"""

PRIOR_COLLISIONS = 16.0
"""As many collisions count as the mean of all does in a tile: about the ratio of the noise of paths to what the light of tiles
differs by (3 in smoke in the sun, 16 in a cloud, 60 in smoke in even light)."""

BASELINE_SEED = 0x1E7E1
"""Of those paths. They are independent of the paths of a render, or the level would bias its derivatives."""


def prepare_derivatives(estimators: Estimators, ray: mi.Ray3f, on_film: mi.Point2f) -> None:
    """Find what derivatives along the camera rays of a pass need beforehand.

    Args:
        estimators: of the render.
        ray: the camera rays of the pass.
        on_film: where they lie on the film, as shares of it.
    """
    segment = estimators.segment
    segment.prepare_derivatives(ray)
    if segment.ends_in_media:
        segment.baseline = _estimate_baseline(estimators, ray, on_film)


def _estimate_baseline(estimators: Estimators, ray: mi.Ray3f, on_film: mi.Point2f) -> Baseline | None:
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
    count = min(max(n // RAYS_PER_PATH, MIN_PATHS), MAX_PATHS)
    index = mi.UInt32(dr.arange(mi.UInt64, count) * n // count)
    rays, tile = mi.Ray3f(ray), _film_tile(on_film)
    # What is gathered from has to be evaluated: at once, not each number of a ray by a kernel of its own.
    dr.eval(rays, tile)
    some = clip_camera_ray(dr.gather(mi.Ray3f, rays, index))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(BASELINE_SEED, count)
    collision = _find_first_collisions(estimators, sampler.clone(), some)
    path = walk_path(estimators, sampler, some, Primal(dr.zeros(mi.Spectrum, count)))[0]
    # Behind a boundary that refracts no first flight collides; the mean of all rays is then as good a guess as any.
    weight = dr.select(dr.any(collision.on), dr.square(collision_weights(media, some, collision)), 1)
    seen, weight, at = dr.detach(path.L), dr.detach(weight), dr.gather(mi.UInt32, tile, index)
    # Each sum would walk the paths again.
    dr.eval(seen, weight)
    pairs = [_tile_means(L, w, at) for L, w in zip(to_components(seen), to_components(weight), strict=True)]
    first = mi.Spectrum(*(dr.gather(mi.Float, tiles, tile) for _, tiles in pairs))
    level = Baseline(first, mi.Spectrum(*(mean for mean, _ in pairs)))
    dr.eval(level)
    return level


def _film_tile(on_film: mi.Point2f) -> mi.UInt32:
    """The tile of the film that a place is in; places beside the film belong to the nearest."""
    x, y = dr.clip(mi.Point2i(on_film * TILES_PER_AXIS), 0, TILES_PER_AXIS - 1)
    return mi.UInt32(y * TILES_PER_AXIS + x)


def _find_first_collisions(estimators: Estimators, sampler: mi.Sampler, ray: mi.Ray3f) -> Collision:
    """Where paths that are walked with the same random numbers collide on their first segment."""
    on, segment = dr.full(mi.Bool, True, dr.width(ray)), estimators.segment
    samples = segment.draw(sampler, on, None)
    ahead = PathSegment(ray, estimators.media.medium_at(ray), dr.full(mi.Spectrum, 1, dr.width(ray)), on, samples, mi.UInt32(0))
    return segment.estimate(ahead, IMAGE, on).collision


def _tile_means(values: mi.Float, weights: mi.Float, tile: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """The mean of one channel, 0 where nothing has a weight, and that of each tile, drawn to the mean of all."""
    total, found = dr.sum(weights), dr.count(weights > 0)
    mean = dr.select(total > 0, dr.sum(values * weights) / dr.select(total > 0, total, 1), 0)
    sums, of_tile = (dr.zeros(mi.Float, TILES_PER_AXIS * TILES_PER_AXIS) for _ in range(2))
    dr.scatter_add(sums, values * weights, tile)
    dr.scatter_add(of_tile, weights, tile)
    prior = PRIOR_COLLISIONS * total / dr.maximum(mi.Float(found), 1)
    return mean, dr.select(total > 0, (sums + prior * mean) / dr.select(total > 0, of_tile + prior, 1), 0)
