r"""Successive paths: each lane walks several paths, one after another (path regeneration), or the branches of paths.

.. math:: L = \frac{1}{k} \sum_{j=1}^{k} L_j

A packet of lanes (8 or 16 on a CPU, 32 on a GPU) walks until its longest path ends. If path lengths differ widely, most lanes
wait: the longest of 16 exponentially distributed lengths is 3.4 times the mean. Here a lane takes the next path of a list as
soon as its path ends, so no lane waits before the list is empty.

Each path draws its own random numbers, and one lane sums the light of a camera ray. So an image depends neither on the lanes
of paths nor on the number of threads.

A path may have k branches behind its first collision with a medium. This costs less than k paths if few camera rays collide,
and lowers the variance as much if most noise comes from behind collisions. :mod:`.derivatives` has the same for derivatives.

References: Novák et al. 2010 (path regeneration); Aila & Laine 2009 (threads that take work from a list); Arvo & Kirk 1990
(splitting).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flights.free_flight import make_collision
from mivol.transport.estimators.scores import Primal
from mivol.transport.estimators.segment import KnownFlight
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.walk import (
    Path,
    PathStart,
    Score,
    advance_path,
    begin_path,
    film_alpha,
    leave_camera,
    start_path,
    walk_light,
)
from mivol.transport.traversal.random_numbers import SpreadSampler

__all__ = ["paths_per_lane", "walk_branching", "walk_from_collisions", "walk_from_points", "walk_successively"]


MIN_LANES = {"llvm": 1 << 13, "cuda": 1 << 20, "metal": 1 << 20}
"""Smallest number of lanes, by backend. On a CPU, Dr.Jit distributes packets of lanes over threads (at least 512 packets here);
a GPU holds about 2^18 lanes. The number of threads does not enter, so a seed gives the same image on every machine."""

BRANCHED_PATHS = 16
"""Paths for each lane, of those that may branch."""

PATHS_FROM_POINTS = 16
"""Starts of paths for each lane in :func:`walk_from_points` and :func:`walk_from_collisions`, left out or not."""


def paths_per_lane(limit: int, paths: int) -> int:
    """Mean number of successive paths in a lane: at most ``limit``, and fewer if ``paths`` would fill too few lanes."""
    backend = mi.variant().split("_")[0]
    return max(1, min(limit, paths // MIN_LANES[backend]))


NONE_YET = 0xFFFFFFFF
"""Number of the path in a lane that has not begun."""


@dataclass
class _WorkList:
    """Numbers below a count, which lanes take one after another.

    Attributes:
        count: how many numbers there are (an array of one number).
        taken: how many have been asked for (an array of one number).
    """

    count: mi.UInt32
    taken: mi.UInt32

    def take(self, asks: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The next number for each lane that asks, and the lanes for which there was one."""
        number = dr.scatter_inc(self.taken, dr.zeros(mi.UInt32, dr.width(asks)), asks)
        return number, asks & (number < self.count)


def walk_successively(
    estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, count: int
) -> tuple[mi.Spectrum, mi.Float]:
    """Walk paths from the camera, ``count`` in succession in each lane on average.

    Args:
        estimators: estimators of the render.
        sampler: random numbers of each path.
        ray: camera rays in world space with unit directions, one for each path.
        count: number of paths over the number of lanes.

    Returns:
        The radiance and the alpha (in [0, 1]) of each path.

    Bias, variance: as for :func:`mivol.transport.path.walk.walk_path`. Memory: 16 numbers a path, 34 with tabulated shadows.
    """
    n = dr.width(ray)
    lanes, paths = -(-n // count), _WorkList(dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, 0))
    starts = leave_camera(estimators, sampler.clone(), ray)
    # Each path writes its own results once.
    L, alpha = dr.empty(mi.Spectrum, n), dr.empty(mi.Float, n)
    kept = estimators.start_kept_rays(n)
    dr.eval(starts, L, alpha, kept)

    def start(index: mi.UInt32, active: mi.Bool) -> Path:
        return begin_path(estimators, starts.gather(index, active), Primal(dr.zeros(mi.Spectrum, lanes)))

    def advance(path: Path, index: mi.UInt32, on: mi.Bool) -> tuple[Path, mi.UInt32, mi.Bool]:
        path = advance_path(estimators, path)
        asks = on & ~path.active
        ended = asks & (index != NONE_YET)
        dr.scatter(L, path.score.L, index, ended)
        dr.scatter(alpha, film_alpha(path), index, ended)
        for name, rays in kept.items():
            rays.scatter(getattr(path, name), index, ended)
        following, begins = paths.take(asks)
        index = dr.select(asks, following, index)
        return dr.select(asks, start(index, begins), path), index, path.active | begins

    # No lane has begun: the first turn of the loop gives each its first path, until the list is empty.
    index, on = dr.full(mi.UInt32, NONE_YET, lanes), dr.full(mi.Bool, True, lanes)
    dr.while_loop(state=(start(index, ~on), index, on), cond=lambda *state: state[-1], body=advance, label="successive paths")
    dr.eval(L, alpha, kept)
    for rays in kept.values():
        # Here every lane has one ray, and none waits for the longer path of another.
        L += rays.light_at_camera(estimators.media, starts.ray)
    return L, alpha


def walk_from_points(estimators: Estimators, starts: PathStart, front: mi.UInt32, back: mi.UInt32) -> mi.Spectrum:
    """Walk paths from scattering points of media, several in succession in each lane.

    Args:
        estimators: estimators of the render; their segments end in media.
        starts: starts at collisions, in memory, with a throughput of 1.
        front, back: number of starts at the beginning of the arrays and at their end (arrays of one number); those between are
            left out.

    Returns:
        The radiance scattered at each point, over the albedo there; undefined for starts that are left out.

    Bias, variance: as for :func:`mivol.transport.path.walk.walk_path`.
    """
    n = dr.width(starts.depth)
    L = dr.empty(mi.Spectrum, n)
    dr.eval(L)

    def begin(at: PathStart, index: mi.UInt32) -> Path:
        path = start_path(estimators, at.ray, Primal(dr.zeros(mi.Spectrum, dr.width(index))), at.sampler, at.active)
        path.depth = at.depth
        return path

    def end(path: Path, index: mi.UInt32, ended: mi.Bool) -> None:
        dr.scatter(L, path.score.L, index, ended)

    def place(number: mi.UInt32) -> mi.UInt32:
        return dr.select(number < front, number, number + (n - front - back))

    _walk_starts(estimators, starts, front + back, (place, begin, end), is_white=True)
    dr.eval(L)
    return L


def walk_from_collisions(
    estimators: Estimators,
    starts: PathStart,
    count: mi.UInt32,
    begin: Callable[[PathStart, mi.UInt32], Score],
    end: Callable[[Score, mi.UInt32, mi.Bool], None],
) -> None:
    """Walk paths from collisions with media, several in succession in each lane.

    Args:
        estimators: estimators of the render; their segments end in media.
        starts: starts at collisions, in memory.
        count: number of starts at the beginning of the arrays (an array of one number).
        begin: makes the score of starts with an index.
        end: called with the scores of paths, the indices of their starts, and the lanes in which paths end.

    Bias, variance: as for :func:`mivol.transport.path.walk.walk_path`.
    """

    def start(at: PathStart, index: mi.UInt32) -> Path:
        # A path does not fly before its first event.
        return begin_path(estimators, replace(at, flight=None), begin(at, index))

    steps = mi.UInt32, start, lambda path, index, ended: end(path.score, index, ended)
    _walk_starts(estimators, starts, count, steps)


def _walk_starts(
    estimators: Estimators,
    starts: PathStart,
    count: mi.UInt32,
    steps: tuple[Callable, Callable, Callable],
    is_white: bool = False,
) -> None:
    """Walk paths from collisions in succession.

    Args:
        estimators, starts: as of :func:`walk_from_collisions`.
        count: number of paths to walk (an array of one number).
        steps: the index of the start of a path by its number; a path by its start and this index; and what is done with paths,
            indices and the lanes in which paths end.
        is_white: the first collision has an albedo of 1.
    """
    n, (place, begin, end) = dr.width(starts.depth), steps
    lanes, paths = -(-n // paths_per_lane(PATHS_FROM_POINTS, n)), _WorkList(count, dr.opaque(mi.UInt32, 0))
    dr.eval(starts)

    def start(index: mi.UInt32, active: mi.Bool) -> tuple[Path, KnownFlight]:
        at = starts.gather(index, active)
        return begin(at, index), at.flight

    def advance(path: Path, begun: KnownFlight, index: mi.UInt32, on: mi.Bool) -> tuple:
        hit = make_collision(estimators.media, path.ray, begun.t, begun.body, path.active & begun.on)
        if is_white:
            hit.albedo = dr.full(mi.Spectrum, 1, lanes)
        path, begun = advance_path(estimators, path, hit), begun.forget()
        asks = on & ~path.active
        end(path, index, asks & (index != NONE_YET))
        number, begins = paths.take(asks)
        index = dr.select(asks, place(number), index)
        fresh, at_point = start(index, begins)
        return dr.select(asks, fresh, path), dr.select(asks, at_point, begun), index, path.active | begins

    # No lane has begun: the first turn of the loop gives each its first path, until the list is empty.
    index, on = dr.full(mi.UInt32, NONE_YET, lanes), dr.full(mi.Bool, True, lanes)
    state = (*start(index, ~on), index, on)
    dr.while_loop(state=state, cond=lambda *state: state[-1], body=advance, label="paths from points")


def walk_branching(
    estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, count: int
) -> tuple[mi.Spectrum, mi.Float, mi.UInt32]:
    """Walk paths from the camera that branch at their first collision with a medium.

    Args:
        estimators: estimators of the render; their segments end in media.
        sampler: random numbers of each path.
        ray: camera rays in world space with unit directions, one for each path.
        count: number of branches of a path.

    Returns:
        The radiance, the alpha (in [0, 1]) and the number of scattering events of each path, by its last branch; 0 events
        without a collision.

    Bias: none. Variance: A + B / count, with the variance A of stems and B of a branch. Memory: 65 numbers a path, 83 with
    tabulated shadows.
    """
    n, first = dr.width(ray), sampler.clone()
    # Branches are for images of many samples, to which passing the starts through memory costs more than a kernel of its own.
    light, alpha, stems = walk_light(estimators, leave_camera(estimators, sampler, ray).with_flight(), stops=True, shares=False)
    ends = PathStart.at_stop(stems, first)
    collided, found = dr.zeros(mi.UInt32, n), _WorkList(dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, 0))
    dr.scatter(collided, dr.arange(mi.UInt32, n), *found.take(ends.active))
    L, events = dr.zeros(mi.Spectrum, n), dr.zeros(mi.UInt32, n)
    kept = estimators.start_kept_rays(n)
    dr.eval(light, alpha, ends, found.taken, collided, L, events, kept)
    lanes, each = -(-n // paths_per_lane(BRANCHED_PATHS, n)), dr.opaque(mi.UInt32, count)
    todo = _WorkList(found.taken, dr.opaque(mi.UInt32, 0))

    def start(stem: mi.UInt32, branch: mi.UInt32, active: mi.Bool, score: Primal) -> tuple[Path, KnownFlight]:
        at = ends.gather(stem, active)
        at.sampler = at.sampler.branch(branch, each)
        # A branch does not fly before its first event.
        return begin_path(estimators, replace(at, flight=None), score), at.flight

    def advance(path: Path, begun: KnownFlight, stem: mi.UInt32, branch: mi.UInt32, on: mi.Bool) -> tuple:
        hit = make_collision(estimators.media, path.ray, begun.t, begun.body, path.active & begun.on)
        path, begun = advance_path(estimators, path, hit), begun.forget()
        # -- The light of all branches of a stem -------------------------------------------------------------------------
        next_one = on & ~path.active
        asks = next_one & (branch + 1 == each)
        ended = asks & (stem != NONE_YET)
        dr.scatter(L, path.score.L, stem, ended)
        dr.scatter(events, path.depth, stem, ended)
        for name, rays in kept.items():
            rays.scatter(getattr(path, name), stem, ended)
        # -- The next branch ---------------------------------------------------------------------------------------------
        place, begins = todo.take(asks)
        stem = dr.select(asks, dr.gather(mi.UInt32, collided, place, begins), stem)
        branch = dr.select(asks, 0, dr.select(next_one, branch + 1, branch))
        begins |= next_one & ~asks
        fresh, at_collision = start(stem, branch, begins, Primal(dr.select(asks, 0, path.score.L)))
        for name in kept:
            setattr(fresh, name, dr.select(asks, getattr(fresh, name), getattr(path, name)))
        on = path.active | begins
        return dr.select(next_one, fresh, path), dr.select(next_one, at_collision, begun), stem, branch, on

    # As if all lanes had ended their last branch: the first turn of the loop gives each its first stem.
    stem, on = dr.full(mi.UInt32, NONE_YET, lanes), dr.full(mi.Bool, True, lanes)
    branch = dr.zeros(mi.UInt32, lanes) + (each - 1)
    path, begun = start(stem, branch, ~on, Primal(dr.zeros(mi.Spectrum, lanes)))
    dr.while_loop(state=(path, begun, stem, branch, on), cond=lambda *state: state[-1], body=advance, label="branches")
    dr.eval(L, events, kept)
    for rays in kept.values():
        L += rays.light_at_camera(estimators.media, ray)
    return light + L * dr.rcp(mi.Float(each)), alpha, events
