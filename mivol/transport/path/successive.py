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
from mivol.transport.path.walk import Path, advance_path, film_alpha, gather_lanes, leave_camera, start_path
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import clip_camera_ray

__all__ = ["paths_per_lane", "walk_successively"]


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
    lanes, per_lane = -(-n // count), dr.opaque(mi.UInt32, count)
    clipped, medium, sampler = clip_camera_ray(ray), estimators.media.medium_at(ray), sampler.clone()
    known = estimators.segment.find_first_collision(clipped, medium, sampler, dr.full(mi.Bool, True, n))
    starts = _PathStarts(clipped, medium, sampler, known)
    L, alpha = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Float, n)
    kept = KeptShadow.empty(n) if estimators.tabulates_shadows else None
    dr.eval(starts, L, alpha, kept)
    index = dr.arange(mi.UInt32, lanes) * per_lane
    end = dr.minimum(index + per_lane, dr.opaque(mi.UInt32, n))

    def start(index: mi.UInt32, active: mi.Bool) -> Path:
        ray, medium, sampler, known = starts.gather(index, active)
        path = start_path(estimators, ray, Primal(dr.zeros(mi.Spectrum, lanes)), sampler, active)
        path.known = known
        return leave_camera(estimators, path, medium)

    def advance(path: Path, index: mi.UInt32) -> tuple[Path, mi.UInt32]:
        path = advance_path(estimators, path)
        ended = ~path.active
        dr.scatter(L, path.score.L, index, ended)
        dr.scatter(alpha, film_alpha(path), index, ended)
        if kept is not None:
            kept.scatter(path.tabulated, index, ended)
        index += dr.select(ended, mi.UInt32(1), mi.UInt32(0))
        return dr.select(ended, start(index, ended & (index < end)), path), index

    dr.while_loop(
        state=(start(index, index < end), index), cond=lambda path, _: path.active, body=advance, label="successive paths"
    )
    dr.eval(L, alpha, kept)
    if kept is not None:
        # Here every lane has one shadow ray, and none waits for the longer path of another.
        L += kept.light_at_camera(estimators.media, starts.ray)
    return L, alpha
