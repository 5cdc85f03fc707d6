r"""Derivatives of paths that scatter in media: their baseline, and reverse derivatives of paths branching at the first
collision.

.. math:: L = \frac{1}{k} \sum_{j=1}^{k} L_j

A path consists of a stem, from the camera to its first collision, and k branches, from there to their ends. The mean of the
branches is the radiance arriving at the end of the stem. Many camera rays pass a volume without a collision and have a stem
only; the few branches cause most of the noise of a gradient. Branches lie side by side in lanes, sorted by their length once it
is known, so few lanes wait for their neighbours.

Let A be the variance of stems and B of a branch, at the costs a and b. The variance A + B / k at the cost a + b k is best at
k = sqrt(B a / (A b)), and b is proportional to the share of stems with a collision.

Bias: none. Memory: about 40 numbers a branch; there are at most as many branches as stems.

References: Arvo & Kirk 1990 (splitting); Vicini et al. 2021 (path replay).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.flights.flight_derivatives import Baseline, collision_weights
from mivol.transport.estimators.scores import IMAGE, Primal, PrimalBehind, Replay
from mivol.transport.estimators.segment import Collision, PathSegment
from mivol.transport.media.channels import to_components
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.film import CameraRays
from mivol.transport.path.walk import FirstCollision, gather_lanes, walk_branch, walk_path, walk_stem
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import FineRay, clip_camera_ray

__all__ = ["count_branches", "prepare_derivatives", "replay_branches"]


MAX_BRANCHES = 4
"""Largest number of branches of a path."""

BALANCE = 0.6
"""(B a) / (A b) times the share of stems with a collision: two branches for a share of 0.17, one for a share above 0.27. (Smoke
and a cloud with this share: three branches give the least variance x time over voxels with sigma_t >= 1, one over empty
voxels.)"""

MAX_SORTED_LENGTH = np.uint16(0xFFFF)
"""Largest number of scattering events told apart when branches are sorted by length."""

MIN_PATHS, MAX_PATHS, RAYS_PER_PATH = 1 << 12, 1 << 15, 64
"""Number of paths estimating the baseline: one for 64 rays of a pass, within bounds. A rough estimate is enough, since
derivatives are unbiased for any baseline."""

TILES_PER_AXIS = 8
"""Tiles along an edge of the film, each with its own baseline. (Second moment about the baseline of the light at first
collisions, relative to one tile, 64 x 64 pixels: 0.88, 0.78, 0.76 and 0.79 in smoke in the sun with 2, 4, 8 and 16 tiles; with
any of them 0.98 in even light and 0.94 to 0.95 in a cloud.)"""

PRIOR_COLLISIONS = 16.0
"""Number of collisions in a tile that weigh as much as the mean over the film: about the ratio of the variance of paths to the
variance between tiles (3 in smoke in the sun, 16 in a cloud, 60 in smoke in even light)."""

BASELINE_SEED = 0x1E7E1
"""Seed of these paths. They are independent of the paths of a render; otherwise the baseline would bias its derivatives."""


# -- Branching paths -----------------------------------------------------------------------------------------------------


def count_branches(stems: int, collided: int) -> int:
    """Number of branches of a path, from the number of stems and of stems with a collision."""
    return min(MAX_BRANCHES, max(1, round(math.sqrt(BALANCE * stems / collided))))


def replay_branches(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum) -> None:
    """Add the derivatives of the radiance along camera rays to gradients.

    Args:
        estimators: estimators of the render, prepared for derivatives along these rays; their segments end in media.
        rays: camera rays, with a sampler of spread numbers.
        dL: d loss / d radiance of each ray.
    """
    n, sampler = dr.width(rays.ray), rays.sampler
    first, replayed_sampler, replayed = sampler.clone(), sampler.clone(), estimators.replayed()

    # -- The radiance of stems and branches ------------------------------------------------------------------------------
    stems, collision = walk_stem(replayed, sampler, rays.ray, Primal(dr.zeros(mi.Spectrum, n)))
    dr.eval(first, stems.L, collision)
    collided = dr.compress(collision.on)
    if (count := dr.width(collided)) == 0:
        replay_in_one_kernel(n, lambda: walk_stem(estimators, replayed_sampler, rays.ray, Replay(stems.L, dL)))
        return
    k = count_branches(n, count)
    share, branches = dr.opaque(mi.Float, 1 / k), _Branches.split(collision, collided, first, k)
    primal, depth = branches.walk(replayed, Primal(dr.zeros(mi.Spectrum, count * k)))
    dr.eval(primal.L, depth)
    for L_stem, L_branch in zip(stems.L, primal.L, strict=True):
        dr.scatter_add(L_stem, L_branch * share, branches.stem)

    # -- Their replays ---------------------------------------------------------------------------------------------------
    dr.eval(stems.L, dL)
    replay_in_one_kernel(n, lambda: walk_stem(estimators, replayed_sampler, rays.ray, Replay(stems.L, dL)))
    baseline = estimators.segment.baseline
    estimators.segment.baseline = None if baseline is None else baseline.for_branches
    order = _order_by_length(depth)
    branches = branches.reorder(order)
    L, dL_branch = dr.gather(mi.Spectrum, primal.L, order), dr.gather(mi.Spectrum, dL, branches.stem) * share
    dr.eval(L, dL_branch)
    replay_in_one_kernel(count * k, lambda: branches.walk(estimators, Replay(L, dL_branch)))


def replay_in_one_kernel(width: int, walk: Callable[[], object]) -> None:
    """Walk paths backwards, and add all their derivatives in one kernel.

    Dr.Jit sums the derivative by a single number (an albedo, the radiance of an emitter) over all lanes as soon as it is known.
    Each sum would be a kernel that walks the paths anew. In a recorded loop the sums become atomic additions, so the walk is
    the only turn of a loop.

    Args:
        width: number of lanes.
        walk: reports the paths to a :class:`Replay`; it changes gradients only.
    """

    def turn(number: mi.UInt32) -> tuple[mi.UInt32]:
        walk()
        return (number + 1,)

    dr.while_loop(state=(dr.zeros(mi.UInt32, width),), cond=lambda number: number < 1, body=turn, label="replay")


@dataclass
class _Branches:
    """Branches of paths.

    Attributes:
        stem: index of the stem of each branch.
        collision: collision at the end of the stem.
        sampler: random numbers of each branch.
    """

    stem: mi.UInt32
    collision: FirstCollision
    sampler: SpreadSampler

    @classmethod
    def split(cls, collision: FirstCollision, collided: mi.UInt32, sampler: SpreadSampler, k: int) -> _Branches:
        """Split each stem with a collision into k branches, side by side; ``sampler`` has the numbers of the stems."""
        number = dr.arange(mi.UInt32, dr.width(collided) * k)
        each = dr.opaque(mi.UInt32, k)
        stem = dr.gather(mi.UInt32, collided, number // each)
        sampler = sampler.gather(stem).branch(number % each, each)
        branches = cls(stem, _gather_collisions(collision, stem), sampler)
        dr.eval(branches)
        return branches

    def reorder(self, order: mi.UInt32) -> _Branches:
        """The branches in another order."""
        stem = dr.gather(mi.UInt32, self.stem, order)
        branches = _Branches(stem, _gather_collisions(self.collision, order), self.sampler.gather(order))
        dr.eval(branches)
        return branches

    def walk(self, estimators: Estimators, score: Primal | Replay) -> tuple[Primal | Replay, mi.UInt32]:
        """Walk the branches to their ends; return the score and the number of scattering events of each."""
        return walk_branch(estimators, self.sampler.clone(), self.collision, score)


def _gather_collisions(collision: FirstCollision, index: mi.UInt32) -> FirstCollision:
    ray = collision.ray
    o, d, maxt, time = (gather_lanes(values, index) for values in (ray.o, ray.d, ray.maxt, ray.time))
    rest = (gather_lanes(values, index) for values in (collision.t, collision.body, collision.beta, collision.on))
    return FirstCollision(FineRay(o, d, maxt, time, ray.wavelengths), *rest)


def _order_by_length(depth: mi.UInt32) -> mi.UInt32:
    """The indices of paths sorted by length, the longest first."""
    # Sorting 16-bit numbers takes linear time; few paths are longer than that.
    shortness = MAX_SORTED_LENGTH - np.minimum(depth.numpy(), MAX_SORTED_LENGTH).astype(np.uint16)
    return mi.UInt32(np.argsort(shortness, kind="stable"))


# -- The baseline --------------------------------------------------------------------------------------------------------


def prepare_derivatives(estimators: Estimators, ray: mi.Ray3f, on_film: mi.Point2f) -> None:
    """Prepare the segment estimator for derivatives along the camera rays of a pass.

    Args:
        estimators: estimators of the render.
        ray: camera rays of the pass.
        on_film: their positions as shares of the film, in [0, 1] [1].
    """
    segment = estimators.segment
    segment.prepare_derivatives(ray)
    if segment.ends_in_media and estimators.media.follows_extinction:
        segment.baseline = _estimate_baseline(estimators, ray, on_film)


def _estimate_baseline(estimators: Estimators, ray: mi.Ray3f, on_film: mi.Point2f) -> Baseline | None:
    """Estimate the baseline: the mean radiance at the collisions of camera paths, weighted by the square of each derivative's
    weight.

    This baseline gives the derivatives at collisions the least variance. Light seen behind a medium does not enter: such light
    is often brighter, and made the variance 1.3 to 1.6 times as large (smoke in the sun and under a constant sky, voxels with
    sigma_t >= 1).

    Returns:
        The baseline, with a value for each tile before the first scattering; None if a medium has ``sigma_s`` in place of an
        albedo, since the terms of its absorption do not have the mean 0.
    """
    media = estimators.media
    if any(body.view.albedo is None for body in media.bodies):
        return None

    # -- Some rays of the pass -------------------------------------------------------------------------------------------
    n = dr.width(ray)
    count = min(max(n // RAYS_PER_PATH, MIN_PATHS), MAX_PATHS)
    index = mi.UInt32(dr.arange(mi.UInt64, count) * n // count)
    rays, tile = mi.Ray3f(ray), _film_tile(on_film)
    # Gathers need evaluated arrays: one evaluation of all, in place of a kernel for each.
    dr.eval(rays, tile)
    chosen = clip_camera_ray(dr.gather(mi.Ray3f, rays, index))

    # -- Their radiance and the weight of their first collision ----------------------------------------------------------
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(BASELINE_SEED, count)
    collision = _find_first_collisions(estimators, sampler.clone(), chosen)
    score = Primal(dr.zeros(mi.Spectrum, count))
    if estimators.near is not None:
        # The light of near emitters on the first segment has derivatives of its own, without a baseline.
        score = PrimalBehind(score.L, dr.full(mi.Bool, False, count))
    path = walk_path(estimators, sampler, chosen, score)[0]
    # Behind a refracting boundary no first flight collides; the mean over all rays replaces the mean over collisions.
    weight = dr.select(dr.any(collision.on), dr.square(collision_weights(media, chosen, collision)), 1)
    L, weight, chosen_tile = dr.detach(path.L), dr.detach(weight), dr.gather(mi.UInt32, tile, index)
    # Without this evaluation, each sum below would walk the paths again.
    dr.eval(L, weight)

    # -- Means over the film and its tiles -------------------------------------------------------------------------------
    means = [_tile_means(row, w, chosen_tile) for row, w in zip(to_components(L), to_components(weight), strict=True)]
    first = mi.Spectrum(*(dr.gather(mi.Float, tiles, tile) for _, tiles in means))
    baseline = Baseline(first, mi.Spectrum(*(mean for mean, _ in means)))
    dr.eval(baseline)
    return baseline


def _film_tile(on_film: mi.Point2f) -> mi.UInt32:
    """The tile of a position on the film; positions beside the film belong to the nearest tile."""
    x, y = dr.clip(mi.Point2i(on_film * TILES_PER_AXIS), 0, TILES_PER_AXIS - 1)
    return mi.UInt32(y * TILES_PER_AXIS + x)


def _find_first_collisions(estimators: Estimators, sampler: mi.Sampler, ray: mi.Ray3f) -> Collision:
    """Find the collisions on the first segments of paths walked with the same random numbers."""
    on, segment = dr.full(mi.Bool, True, dr.width(ray)), estimators.segment
    samples = segment.draw(sampler, on)
    beta = dr.full(mi.Spectrum, 1, dr.width(ray))
    first = PathSegment(ray, estimators.media.medium_at(ray), beta, on, samples, mi.UInt32(0))
    return segment.estimate(first, IMAGE, on).collision


def _tile_means(values: mi.Float, weights: mi.Float, tile: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """The weighted mean of a channel, and the mean of each tile, shrunk towards it; 0 without weights."""
    total, collisions = dr.sum(weights), dr.count(weights > 0)
    mean = dr.select(total > 0, dr.sum(values * weights) / dr.select(total > 0, total, 1), 0)
    tile_sums, tile_weights = (dr.zeros(mi.Float, TILES_PER_AXIS * TILES_PER_AXIS) for _ in range(2))
    dr.scatter_add(tile_sums, values * weights, tile)
    dr.scatter_add(tile_weights, weights, tile)
    prior = PRIOR_COLLISIONS * total / dr.maximum(mi.Float(collisions), 1)
    return mean, dr.select(total > 0, (tile_sums + prior * mean) / dr.select(total > 0, tile_weights + prior, 1), 0)
