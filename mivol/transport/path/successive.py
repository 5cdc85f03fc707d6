r"""Paths that a lane walks one after the other.

A packet of lanes (8 or 16 on a CPU, 32 on a GPU) walks until the longest of its paths ends. Where lengths differ widely most
lanes wait: if they are exponential, the longest of 16 is 3.4 times the mean. A lane that begins its next path as soon as one
has ended waits at the end of its last only: sums of 16 lengths differ by a quarter of their mean.

Each path has a generator of random numbers of its own, so that no path depends on those before it in its lane.

References: Novák et al. 2010 (path regeneration); O'Neill 2014 (generators).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.scores import Primal
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.walk import Path, advance_path, film_alpha, gather_lanes, leave_camera, start_path
from mivol.transport.traversal.random_numbers import LaneSampler, draw_seeds
from mivol.transport.traversal.rays import clip_camera_ray

__all__ = ["paths_per_lane", "walk_successively"]

MIN_LANES = {"llvm": 1 << 13, "cuda": 1 << 20, "metal": 1 << 20}
"""Fewest lanes. Dr.Jit deals them out to the threads of a CPU by packets, of which these are 512 at least; a GPU holds
some 2^18. The number of threads does not enter: the same seed means the same picture on every machine."""


@dataclass
class _PathStarts:
    """How paths leave the camera, one for each sample.

    Attributes:
        ray: of the camera, ended at its ``far_clip``.
        medium: around its origin.
        seeds: of its random numbers.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    seeds: tuple[mi.UInt32, mi.UInt32]

    def of(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Ray3f, mi.MediumPtr, LaneSampler]:
        """The departures with these numbers."""
        ray = self.ray
        o, d, maxt, time = (gather_lanes(values, index, active) for values in (ray.o, ray.d, ray.maxt, ray.time))
        seeds = [gather_lanes(seed, index, active) for seed in self.seeds]
        ray = mi.Ray3f(o, d, maxt, time, ray.wavelengths)
        return ray, gather_lanes(self.medium, index, active), LaneSampler.seeded(*seeds, index)


def paths_per_lane(most: int, paths: int) -> int:
    """How many of ``paths`` a lane walks one after the other, at most ``most``: fewer where lanes would become too few."""
    backend = mi.variant().split("_")[0]
    return max(1, min(most, paths // MIN_LANES[backend]))


def walk_successively(estimators: Estimators, sampler: mi.Sampler, ray: mi.Ray3f, count: int) -> tuple[mi.Spectrum, mi.Float]:
    """Walk paths from the camera, ``count`` one after the other in each lane.

    Args:
        estimators: as of :func:`mivol.transport.path.walk.walk_path`.
        sampler: two numbers a path, which seed the path's own.
        ray: world space, unit direction, one for each path.
        count: paths of a lane.

    Returns:
        The radiance of each path, and what the film's alpha sees, in [0, 1].

    Bias, variance: of the paths. Memory: 12 numbers a path.
    """
    n = dr.width(ray)
    lanes, per_lane = -(-n // count), dr.opaque(mi.UInt32, count)
    seeds = draw_seeds(sampler)
    departure = _PathStarts(clip_camera_ray(ray), estimators.media.medium_at(ray), seeds)
    L, alpha = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Float, n)
    dr.eval(departure, L, alpha)
    index = dr.arange(mi.UInt32, lanes) * per_lane
    end = dr.minimum(index + per_lane, dr.opaque(mi.UInt32, n))

    def start(index: mi.UInt32, active: mi.Bool) -> Path:
        ray, medium, sampler = departure.of(index, active)
        path = start_path(estimators, ray, Primal(dr.zeros(mi.Spectrum, lanes)), sampler, None, active)
        return leave_camera(estimators, path, medium)

    def walk_on(path: Path, index: mi.UInt32) -> tuple[Path, mi.UInt32]:
        path = advance_path(estimators, path)
        ended = ~path.active
        dr.scatter(L, path.score.L, index, ended)
        dr.scatter(alpha, film_alpha(path), index, ended)
        index += dr.select(ended, mi.UInt32(1), mi.UInt32(0))
        return dr.select(ended, start(index, ended & (index < end)), path), index

    dr.while_loop(
        state=(start(index, index < end), index), cond=lambda path, _: path.active, body=walk_on, label="successive paths"
    )
    dr.eval(L, alpha)
    return L, alpha
