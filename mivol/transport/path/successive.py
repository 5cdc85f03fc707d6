r"""Successive paths: each lane walks several paths, one after another (path regeneration).

A packet of lanes (8 or 16 on a CPU, 32 on a GPU) walks until its longest path ends. If path lengths differ widely, most lanes
wait: the longest of 16 exponentially distributed lengths is 3.4 times the mean. Here a lane starts its next path as soon as a
path ends, and waits only after its last path. Sums of 16 such lengths deviate by a quarter of their mean.

Each path draws its own random numbers, so no path depends on earlier paths of its lane.

References: Novák et al. 2010 (path regeneration).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.tabulated_shadows import KeptShadow
from mivol.transport.estimators.scores import Primal
from mivol.transport.estimators.segment import KnownFlight
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.walk import (
    Path,
    advance_branch,
    advance_path,
    film_alpha,
    gather_lanes,
    leave_camera,
    start_branch,
    start_path,
    walk_stem,
)
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import clip_camera_ray

__all__ = ["paths_per_lane", "walk_branching", "walk_successively"]


MIN_LANES = {"llvm": 1 << 13, "cuda": 1 << 20, "metal": 1 << 20}
"""Smallest number of lanes, by backend. On a CPU, Dr.Jit distributes packets of lanes over threads (at least 512 packets here);
a GPU holds about 2^18 lanes. The number of threads does not enter, so a seed gives the same image on every machine."""


@dataclass
class _PathStarts:
    """Starts of paths at the camera, one for each sample.

    Attributes:
        ray: camera rays, ended at the sensor's ``far_clip``.
        medium: media around their origins.
        sampler: random numbers of each path.
        known: flights of the camera rays; None if they are drawn with the segment.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    sampler: SpreadSampler
    known: KnownFlight | None

    def gather(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Ray3f, mi.MediumPtr, SpreadSampler, KnownFlight | None]:
        """Gather ray, medium, sampler and flight of paths by their numbers."""
        ray = self.ray
        o, d, maxt, time = (gather_lanes(values, index, active) for values in (ray.o, ray.d, ray.maxt, ray.time))
        sampler = self.sampler.gather(index, active)
        ray = mi.Ray3f(o, d, maxt, time, ray.wavelengths)
        known = None if self.known is None else self.known.at(index, active)
        return ray, gather_lanes(self.medium, index, active), sampler, known


def paths_per_lane(limit: int, paths: int) -> int:
    """Number of successive paths in a lane: at most ``limit``, and fewer if ``paths`` would fill too few lanes."""
    backend = mi.variant().split("_")[0]
    return max(1, min(limit, paths // MIN_LANES[backend]))


def lanes_of_branches(paths: int) -> int:
    return max(min(paths, MIN_LANES[mi.variant().split("_")[0]]), paths // 16)


def walk_successively(
    estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, count: int
) -> tuple[mi.Spectrum, mi.Float]:
    """Walk paths from the camera, ``count`` in succession in each lane.

    Args:
        estimators: estimators of the render.
        sampler: random numbers of each path.
        ray: camera rays in world space with unit directions, one for each path.
        count: number of paths in a lane.

    Returns:
        The radiance and the alpha (in [0, 1]) of each path.

    Bias, variance: as for :func:`mivol.transport.path.walk.walk_path`. Memory: 16 numbers a path, 34 with tabulated shadows.
    """
    n = dr.width(ray)
    lanes = -(-n // count)
    taken, number = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, n)
    clipped, medium, sampler = clip_camera_ray(ray), estimators.media.medium_at(ray), sampler.clone()
    known = estimators.segment.find_first_collision(clipped, medium, sampler, dr.full(mi.Bool, True, n))
    starts = _PathStarts(clipped, medium, sampler, known)
    L, alpha = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Float, n)
    kept = KeptShadow.empty(n) if estimators.tabulates_shadows else None
    dr.eval(starts, L, alpha, kept)
    zero = dr.zeros(mi.UInt32, lanes)
    nowhere = dr.full(mi.Bool, False, lanes)

    def start(index: mi.UInt32, active: mi.Bool) -> Path:
        ray, medium, sampler, known = starts.gather(index, active)
        path = start_path(estimators, ray, Primal(dr.zeros(mi.Spectrum, lanes)), sampler, active)
        path.known = known
        return leave_camera(estimators, path, medium)

    def advance(path: Path, index: mi.UInt32, walks: mi.Bool) -> tuple[Path, mi.UInt32, mi.Bool]:
        path = advance_path(estimators, path)
        ended = ~path.active
        done = ended & (index < number)
        dr.scatter(L, path.score.L, index, done)
        dr.scatter(alpha, film_alpha(path), index, done)
        if kept is not None:
            kept.scatter(path.tabulated, index, done)
        index = dr.select(ended, dr.scatter_inc(taken, zero, ended), index)
        walks = index < number
        return dr.select(ended, start(index, ended & walks), path), index, walks

    index = dr.full(mi.UInt32, 0xFFFFFFFF, lanes)
    dr.while_loop(
        state=(start(index, nowhere), index, ~nowhere),
        cond=lambda path, index, walks: walks,
        body=advance,
        label="successive paths",
    )
    dr.eval(L, alpha, kept)
    if kept is not None:
        # Here every lane has one shadow ray, and none waits for the longer path of another.
        L += kept.light_at_camera(estimators.media, starts.ray)
    return L, alpha


def walk_branching(
    estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, count: int
) -> tuple[mi.Spectrum, mi.Float, mi.UInt32]:
    """Walk paths from the camera that branch at their first collision with a medium.

    A lane walks all branches of a stem in succession, so the sum of their light does not depend on the threads.

    Args:
        estimators: estimators of the render; their segments end in media.
        sampler: random numbers of each path.
        ray: camera rays in world space with unit directions, one for each path.
        count: number of branches of a path.

    Returns:
        The radiance, the alpha (in [0, 1]), and the number of scattering events of the last branch (0 without a collision) of
        each path.

    Bias: none. Variance: A + B / count, with the variance A of stems and B of a branch. Memory: 40 numbers a path, 58 with
    tabulated shadows.
    """
    n, first = dr.width(ray), sampler.clone()
    stems, collision, alpha = walk_stem(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, n)))
    number, taken, collided = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 0), dr.zeros(mi.UInt32, n)
    dr.scatter(collided, dr.arange(mi.UInt32, n), dr.scatter_inc(number, mi.UInt32(0), collision.on), collision.on)
    L, depth = dr.zeros(mi.Spectrum, n), dr.zeros(mi.UInt32, n)
    kept = KeptShadow.empty(n) if estimators.tabulates_shadows else None
    dr.eval(stems.L, alpha, collision, first, number, collided, L, depth, kept)
    # -- The branches: each lane has some stems ----------------------------------------------------------------------------
    lanes = lanes_of_branches(n)
    each = dr.opaque(mi.UInt32, count)
    zero = dr.zeros(mi.UInt32, lanes)

    def take(branch: mi.UInt32, stem: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32, mi.Bool]:
        """The next branch of the stem of each lane, or the first of the next stem."""
        branch = branch + 1
        done = active & (branch == each)
        place = dr.scatter_inc(taken, zero, done)
        stem = dr.select(done, dr.gather(mi.UInt32, collided, place, done & (place < number)), stem)
        return dr.select(done, 0, branch), stem, active & (~done | (place < number))

    def start(branch: mi.UInt32, stem: mi.UInt32, active: mi.Bool, score: Primal) -> tuple[Path, KnownFlight]:
        at = collision.gather(stem, active)
        path = start_branch(estimators, first.gather(stem, active).branch(branch, each), at, score)
        return path, KnownFlight(at.t, at.body, active)

    def advance(path: Path, begun: KnownFlight, branch: mi.UInt32, stem: mi.UInt32, walks: mi.Bool) -> tuple:
        path = advance_branch(estimators, path, begun)
        ended, last = ~path.active, branch + 1 == each
        done = ended & last & (stem < n)
        dr.scatter(L, path.score.L, stem, done)
        dr.scatter(depth, path.depth, stem, done)
        if kept is not None:
            kept.scatter(path.tabulated, stem, done)
        next_branch, next_stem, active = take(branch, stem, ended)
        again, fresh = start(next_branch, next_stem, active, Primal(dr.select(last, 0, path.score.L)))
        if kept is not None:
            again.tabulated = dr.select(last, again.tabulated, path.tabulated)
        branch, stem = dr.select(ended, next_branch, branch), dr.select(ended, next_stem, stem)
        walks = active | ~ended
        return dr.select(ended, again, path), dr.select(ended, fresh, begun.forget()), branch, stem, walks

    nowhere, stem = dr.full(mi.Bool, False, lanes), dr.full(mi.UInt32, 0xFFFFFFFF, lanes)
    path, begun = start(zero, stem, nowhere, Primal(dr.zeros(mi.Spectrum, lanes)))
    dr.while_loop(
        state=(path, begun, mi.UInt32(each - 1) + zero, stem, ~nowhere),
        cond=lambda *state: state[-1],
        body=advance,
        label="branches",
    )
    dr.eval(L, depth, kept)
    if kept is not None:
        L += kept.light_at_camera(estimators.media, ray)
    return stems.L + L * dr.rcp(mi.Float(each)), alpha, depth
