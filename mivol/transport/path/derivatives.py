r"""Derivatives of paths that scatter in media: their baseline, and derivatives of paths branching at the first collision, by
replays (reverse mode) or tangents (forward mode, and reverse mode for one number).

.. math:: L = \frac{1}{k} \sum_{j=1}^{k} L_j

A path consists of a stem, from the camera to the first collision, and k branches, from there to their ends. The mean of the
branches is the radiance arriving at the end of the stem. Many camera rays pass a volume without a collision and have a stem
only; the few branches cause most of the noise of a gradient. Branches lie side by side in lanes, sorted by their length once it
is known, so few lanes wait for their neighbours.

Let A be the variance of stems and B of a branch, at the costs a and b. The variance A + B / k at the cost a + b k is best at
k = sqrt(B a / (A b)), and b is proportional to the share of stems with a collision. The light behind a collision multiplies the
derivative of the collision itself. Beside media with derivatives, a stem that collides in a medium without has one branch.

A replay reads from memory what the first walk has found (:mod:`.kept_segments`). Derivatives by albedos alone need no replay:
the walk keeps its collisions (:mod:`.kept_collisions`).

Only the device knows the number of branches, so that derivatives can be recorded and replayed. Branches have as many lanes as
stems, of which the last are off.

Bias: none. Memory: about 80 numbers a stem, 120 with probes (160 with surfaces); in passes of many rays up to 40 numbers more
for segments (100 beside near light; 90 and 210 with an rgb extinction). Derivatives by albedos alone: up to
``MAX_KEPT_COLLISIONS`` in all.

References: Arvo & Kirk 1990 (splitting); Vicini et al. 2021 (path replay).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flights.baseline import Baseline, BaselineSums, DirectLightTable
from mivol.transport.estimators.flights.direct_light_table import tabulate_direct_light
from mivol.transport.estimators.flights.flight_derivatives import Probe, ProbeTerm
from mivol.transport.estimators.scores import Factor, Replay, Rest, Tangent
from mivol.transport.estimators.segment import KnownFlight, SegmentTransmittance
from mivol.transport.media.body import medium_interaction
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.film import CameraRays
from mivol.transport.path.kept_collisions import KeptCollisions
from mivol.transport.path.kept_segments import KeptSegments, SegmentNumber
from mivol.transport.path.successive import walk_from_points
from mivol.transport.path.walk import (
    Path,
    PathStart,
    add_probes,
    leave_camera_from_memory,
    walk_from_camera,
    walk_in_kernel,
    walk_light,
    walk_part,
)
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import FineRay, point_along

__all__ = [
    "carry_tangents",
    "collect_albedo_derivatives",
    "count_branches",
    "keeps_collisions",
    "prepare_derivatives",
    "replay_branches",
]


MAX_BRANCHES = 3
"""Largest number of branches of a path. More lower variance x time by at most a quarter, in steps that take up to half as long
again (docs/notes/gradients.md)."""

MAX_BRANCHES_OF_SEGMENTS = 2
"""The same in paths whose segments draw the light of near emitters (:mod:`.near_light`), which costs most of their time. (Two
branches in place of three: 0.82 times the time of a gradient, the same variance x time within a tenth.)"""

BALANCE = 26.0
"""(B a) / (A b) times the share of stems with a collision, over the noise of the light at collisions (``Baseline.noise``): B
grows with this noise."""

BALANCE_OF_SEGMENTS = 5.0
"""The same in paths whose segments draw the light of near emitters (:mod:`.near_light`). Then A contains the light of the first
segment, and each branch costs more. (Best k of scenes with lamps inside: 1.6 to 5 for the mean variance of dense voxels, 4 to
10 for the median voxel, 1 to 2 for all voxels.)"""

USUAL_NOISE = 0.15
"""The noise of media without a baseline."""

MIN_LISTED = 1 << 15
"""Smallest number of rays in a pass whose probes are listed, and walk in a kernel of their own, whose segments are kept, and
whose baseline knows the direct light. In smaller passes a path walks on from its own probes, since fewer kernels matter more
there."""

MAX_SEGMENTS = 5
"""Largest number of segments of a stem or branch that are kept in memory for the replay."""

MAX_KEPT_DEPTH = 256
"""Largest path depth for which the collisions of a path are kept in memory."""

MAX_KEPT_COLLISIONS = 1 << 22
"""Collisions for which there is room in memory (160 MiB). More paths are walked in parts."""

MAX_SORTED_LENGTH = 0xFFF
"""Largest number of scattering events told apart when branches are sorted by length."""

RAYS_PER_PATH, FEW_PATHS, MAX_PATHS = 64, 1 << 11, 1 << 15
MIN_PATHS, PATHS_PER_RAY = 1 << 8, 2
"""Number of paths estimating the baseline: one for 64 rays of a pass, within bounds. A rough estimate is enough, since
derivatives are unbiased for any baseline. A pass of fewer rays than ``FEW_PATHS`` has two paths a ray. (16^2 rays of four
scenes: 512 paths instead of 2048 raise the variance by at most 20 %, and take .5 to .84 of the time.)"""

PATHS_PER_ROOT = 24
"""Least number of paths with a table of direct light, over the square root of the rays. (Beside a lamp, n paths raise the
variance by a share of 420 / n and the time by a share of 0.2 n / rays; in a dense cloud the time by 0.5 n / rays.)"""

BASELINE_SEED = 0x1E7E1
"""Seed of these paths. They are independent of the paths of a render; otherwise the baseline would bias its derivatives."""


# -- Branching paths -----------------------------------------------------------------------------------------------------


def count_branches(estimators: Estimators, stems: int, collided: mi.UInt32, single: mi.UInt32) -> mi.UInt32:
    """Number of branches of a path (an array of one number).

    Args:
        estimators: estimators of the render.
        stems, collided: number of stems, and of stems with a collision that may have several branches.
        single: number of stems with one branch.
    """
    baseline = estimators.segment.baseline
    noise = USUAL_NOISE if baseline is None else baseline.noise
    balance, limit = BALANCE, MAX_BRANCHES
    if estimators.near is not None:
        balance, limit = BALANCE_OF_SEGMENTS, MAX_BRANCHES_OF_SEGMENTS
    several, lanes = mi.Float(dr.maximum(collided, 1)), dr.opaque(mi.Float, stems)
    # There is a lane for each stem.
    most = dr.clip((lanes - mi.Float(single)) / several, 1, limit)
    return mi.UInt32(dr.clip(dr.round(dr.sqrt(balance * noise * lanes / several)), 1, most))


def replay_branches(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum) -> None:
    """Add the derivatives of the radiance along camera rays to gradients.

    Args:
        estimators: estimators of the render, prepared for derivatives along these rays; their segments end in media.
        rays: camera rays, with a sampler of spread numbers.
        dL: d loss / d radiance of each ray.
    """
    first, replayed = rays.sampler.clone(), estimators.replayed()
    start = leave_camera_from_memory(estimators, rays.sampler, rays.ray)
    n, (stem_rooms, rooms) = dr.width(start.ray), _count_segments(estimators)
    if n >= MIN_LISTED and rooms > 0:
        kept = _make_kept_segments(estimators, (stem_rooms + rooms) * n)
        estimators = replace(estimators, kept=kept)
        replayed = replace(replayed, kept=kept, writes_segments=True)
        start.number = SegmentNumber(dr.arange(mi.UInt32, n), dr.full(mi.UInt32, stem_rooms, n))
        dr.make_opaque(start.number)

    # -- The radiance of stems and branches ------------------------------------------------------------------------------
    stem_light, _, stems = walk_light(replayed, start.clone(), stops=True)
    dr.schedule(dL)
    branching = _Branching.of(estimators, stems, first)
    if start.number is not None:
        branching.stem_rooms, branching.rooms = stem_rooms, rooms
    _, branches = branching.gather(dr.arange(mi.UInt32, n))
    L, _, path = walk_light(replayed, branches.in_memory(), stops=False)
    lengths = _Lengths.of(path.depth)
    dr.eval(lengths)

    # -- Their replays ---------------------------------------------------------------------------------------------------
    order = lengths.sort()
    stem, branches = branching.gather(order)
    branch_score = Replay(dr.gather(mi.Spectrum, L, order), dr.gather(mi.Spectrum, dL, stem) * branching.share_of(order))
    stem_score = Replay(branching.add_light(stem_light, L), dL)
    listed = None
    if n >= MIN_LISTED and any(body.needs_probes for body in estimators.media.bodies):
        baseline = estimators.segment.baseline
        listed = _ProbeList.empty(n, estimators.media.has_surfaces, baseline is not None and baseline.depends_on_starts)

    def replay(is_stem: mi.Bool) -> None:
        begun, score = dr.select(is_stem, (start.clone(), stem_score), (branches.clone(), branch_score))
        path = walk_part(estimators, begun, score, is_stem, ("first", "later"))
        if listed is None:
            add_probes(estimators, path)
            return
        for probe, is_later in ((path.probes.first, False), (path.probes.later, True)):
            listed.add(probe, path.sampler, score.dL, is_later)

    replay_in_one_kernel(n, replay)
    if listed is not None:
        listed.add_derivatives(estimators, start.ray.wavelengths)


def _count_segments(estimators: Estimators) -> tuple[int, int]:
    """The numbers of segments of a stem and of a branch that are worth keeping; 0 if replays find every segment again."""
    media = estimators.media
    if media.is_bounded:
        # A tracked flight leaves random numbers behind for its derivative.
        return 0, 0
    rooms = min(MAX_SEGMENTS, max(0, estimators.settings.depth_limit - 1))
    return rooms if media.has_surfaces else min(rooms, 1), rooms


def _make_kept_segments(estimators: Estimators, count: int) -> KeptSegments:
    """Memory for segments, with all that replays of these media can read."""
    media, near = estimators.media, estimators.near
    needs_boundaries = any(body.follows_extinction or body.needs_probes for body in media.traced)
    return KeptSegments.empty(
        count,
        media.channels,
        # Shadows that surfaces tint are followed again.
        keeps_shadows=not media.has_null_transmission,
        keeps_places=near is not None and near.has_places,
        # Near light and Gaussians shine up to the surface behind a collision.
        skips_boundaries=not (needs_boundaries or near is not None or any(body.view.shows_gaussians for body in media.bodies)),
    )


def keeps_collisions(estimators: Estimators) -> bool:
    """Whether :func:`collect_albedo_derivatives` serves a scene in which the albedos of media alone are followed.

    All light must come from the ends of segments or be lit at collisions: near light and side flights scatter at points of
    their own, and emission depends on the albedo.
    """
    media, depth = estimators.media, estimators.settings.depth_limit
    has_own_points = estimators.near is not None or estimators.lobe is not None or estimators.start_kept_rays(1)
    finds_albedos = not media.follows_extinction and not media.emits
    return finds_albedos and not has_own_points and depth <= MAX_KEPT_DEPTH


def collect_albedo_derivatives(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum) -> None:
    """Add the derivatives of the radiance along camera rays by the albedos of media, from paths that are walked once.

    Args:
        estimators, rays, dL: as of :func:`replay_branches`, for :func:`keeps_collisions`.
    """
    first = rays.sampler.clone()
    start = leave_camera_from_memory(estimators, rays.sampler, rays.ray)
    n, most = dr.width(start.ray), max(1, estimators.settings.depth_limit - 1)
    _, _, stems = walk_light(estimators, start, stops=True)
    dr.schedule(dL)
    branching = _Branching.of(estimators, stems, first)
    parts = -(-n * most // MAX_KEPT_COLLISIONS)
    paths = -(-n // parts)
    kept, lane = KeptCollisions.empty(estimators.media, paths, most), dr.arange(mi.UInt32, paths)
    for part in range(parts):
        number = lane + dr.opaque(mi.UInt32, part * paths)
        stem, branches = branching.gather(number)
        L, end = kept.walk(estimators, branches.in_memory(), branching.count_from(part * paths, paths))
        lengths = _Lengths.of((end - lane) // paths)
        weight = dr.gather(mi.Spectrum, dL, stem) * branching.share_of(number)
        dr.eval(lengths, weight)
        order = lengths.sort()
        kept.add_derivatives(order, *(dr.gather(type(values), values, order) for values in (end, L, weight)))
        # The next part writes to the same memory.
        dr.eval()


def carry_tangents(estimators: Estimators, rays: CameraRays) -> mi.Spectrum:
    """The tangent of the radiance along camera rays, from the tangents of the parameters.

    Stems and branches carry their tangents along, so each is walked once.

    Args:
        estimators, rays: as of :func:`replay_branches`.
    """
    first = rays.sampler.clone()
    start = leave_camera_from_memory(estimators, rays.sampler, rays.ray)
    lane, probes = dr.arange(mi.UInt32, dr.width(start.ray)), ("first", "later")
    black = dr.zeros(mi.Spectrum, len(lane))
    # In memory as the tangents of branches are, so that stems and branches run one kernel.
    dlog = dr.zeros(mi.Spectrum, len(lane))
    dr.make_opaque(dlog)
    score, _, stems = walk_in_kernel(estimators, start, Tangent(black, dlog), stops=True, probes=probes)
    branching = _Branching.of(estimators, stems, first)
    stem, branches = branching.gather(lane)
    dlog = dr.gather(mi.Spectrum, score.dlog, stem)
    dr.eval(dlog)
    later, _, _ = walk_in_kernel(estimators, branches.in_memory(), Tangent(black, dlog), stops=False, probes=probes)
    return branching.add_light(score.dL, later.dL)


def replay_in_one_kernel(width: int, walk: Callable[[mi.Bool], object]) -> None:
    """Walk stems backwards, then branches, and add all their derivatives in one kernel.

    Dr.Jit sums the derivative by a single number (an albedo, the radiance of an emitter) over all lanes as soon as it is known.
    Each sum would be a kernel that walks the paths anew. In a recorded loop the sums become atomic additions, and the code for
    stems and branches is compiled once. So the two walks are the turns of a loop.

    Args:
        width: number of lanes.
        walk: reports the stems (True) or the branches (False) to a :class:`Replay`; it changes gradients only.
    """

    def turn(number: mi.UInt32) -> tuple[mi.UInt32]:
        walk(number == 0)
        return (number + 1,)

    dr.while_loop(state=(dr.zeros(mi.UInt32, width),), cond=lambda number: number < 2, body=turn, label="replay")


@dataclass
class _Branching:
    """The collisions at the ends of stems, each with as many branches; one, in a medium without derivatives beside others with.

    Attributes:
        start: starts of branches, without their random numbers: at the collisions, with the random numbers of the stems.
        collided: the stems with several branches in front, the stems with one at the back, in reverse order; the other numbers
            are left over.
        has_several: stems with several branches.
        place: place of each stem with a collision in ``collided``.
        count: number of the stems with several branches (an array of one number).
        single: number of the stems with one branch (an array of one number).
        each: branches of a stem with several (an array of one number).
        stem_rooms, rooms: segments of a stem and of a branch in memory: branches behind stems. 0 without memory.
    """

    start: PathStart
    collided: mi.UInt32
    has_several: mi.Bool
    place: mi.UInt32
    count: mi.UInt32
    single: mi.UInt32
    each: mi.UInt32
    stem_rooms: int = 0
    rooms: int = 0

    @classmethod
    def of(cls, estimators: Estimators, stems: Path, sampler: SpreadSampler) -> _Branching:
        """List the stems with a collision, and choose the number of branches.

        Args:
            estimators: estimators of the render.
            stems: stems at their ends.
            sampler: random numbers of the stems from the camera on.
        """
        start = PathStart.at_stop(stems, sampler)
        n, several = dr.width(start.active), mi.Bool(start.active)
        followed = [body.is_followed for body in estimators.media.bodies]
        count, single, collided = dr.opaque(mi.UInt32, 0), mi.UInt32(0), dr.empty(mi.UInt32, n)
        if any(followed) and not all(followed):
            # The light behind a collision counts in full at the collision itself, and only if the medium has derivatives.
            several &= reduce(or_, (start.flight.body == k for k, on in enumerate(followed) if on))
            single = dr.opaque(mi.UInt32, 0)
            behind = n - 1 - dr.scatter_inc(single, mi.UInt32(0), start.active & ~several)
            place = dr.select(several, dr.scatter_inc(count, mi.UInt32(0), several), behind)
        else:
            place = dr.scatter_inc(count, mi.UInt32(0), several)
        dr.scatter(collided, dr.arange(mi.UInt32, n), place, start.active)
        dr.eval(start, collided, several, place, count)
        return cls(start, collided, several, place, count, single, count_branches(estimators, n, count, single))

    def count_from(self, first: int, most: int) -> mi.UInt32:
        """Number of branches among ``most`` numbers from ``first`` on (an array of one number)."""
        total = self.count * self.each + self.single
        return dr.minimum(dr.maximum(total, first) - first, most)

    def share_of(self, number: mi.UInt32) -> mi.Float:
        """Share of the branches with these numbers in the light of their stems [1]."""
        return dr.select(number < self.count * self.each, dr.rcp(mi.Float(self.each)), 1)

    def gather(self, number: mi.UInt32) -> tuple[mi.UInt32, PathStart]:
        """The stems and the starts of the branches with these numbers: the branches of a stem have consecutive numbers.

        A recording cannot depend on the number of branches, so there may be more lanes; the last lanes are off.
        """
        n, ahead = dr.width(self.collided), self.count * self.each
        is_one_of_several, beyond = number < ahead, number - ahead
        on = is_one_of_several | (beyond < self.single)
        stem = dr.gather(mi.UInt32, self.collided, dr.select(is_one_of_several, number // self.each, n - 1 - beyond), on)
        start = self.start.gather(stem, on)
        branch, of = dr.select(is_one_of_several, number % self.each, 0), dr.select(is_one_of_several, self.each, 1)
        start.sampler = start.sampler.branch(branch, of)
        if self.rooms:
            start.number = SegmentNumber(number + self.stem_rooms * n, dr.full(mi.UInt32, self.rooms, n))
        return stem, start

    def add_light(self, stems: mi.Spectrum, branches: mi.Spectrum) -> mi.Spectrum:
        """The radiance of each stem, with its share of the radiance of its branches."""
        each = dr.select(self.has_several, self.each, 1)
        last = dr.width(self.collided) - 1
        first = dr.select(self.has_several, self.place * each, self.count * self.each + last - self.place)
        share = dr.rcp(mi.Float(each))

        def add(number: mi.UInt32, L: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
            return number + 1, L + dr.gather(mi.Spectrum, branches, first + number) * share

        begun = dr.zeros(mi.UInt32, dr.width(stems)), mi.Spectrum(stems)
        return dr.while_loop(begun, lambda number, L: self.start.active & (number < each), add, label="branches")[1]


@dataclass
class _Lengths:
    """The lengths of paths, counted for a sort.

    Attributes:
        key: 0 for the longest paths.
        place: number of earlier paths of the same key.
        counts: number of paths of each key.
    """

    key: mi.UInt32
    place: mi.UInt32
    counts: mi.UInt32

    @classmethod
    def of(cls, depth: mi.UInt32) -> _Lengths:
        """Count the paths by their numbers of scattering events. Evaluate the result, with the paths, before :meth:`sort`."""
        key = MAX_SORTED_LENGTH - dr.minimum(depth, MAX_SORTED_LENGTH)
        counts = dr.zeros(mi.UInt32, MAX_SORTED_LENGTH + 1)
        return cls(key, dr.scatter_inc(counts, key), counts)

    def sort(self) -> mi.UInt32:
        """The indices of the paths, the longest first (a counting sort)."""
        n, start = dr.width(self.key), dr.prefix_sum(self.counts)
        order = dr.empty(mi.UInt32, n)
        dr.scatter(order, dr.arange(mi.UInt32, n), dr.gather(mi.UInt32, start, self.key) + self.place)
        return order


# -- Probes --------------------------------------------------------------------------------------------------------------


@dataclass
class _ProbeList:
    """The probes of replayed paths, in memory.

    Few probes are left in dense media (:meth:`.Probe.thin`). Their paths walk in a kernel of their own, where no lane waits for
    another one.

    Attributes:
        p: the points.
        t: distances from the starts of their flights [length], if the baseline depends on these starts; else None.
        d: directions of their flights.
        time: times of their rays.
        body: indices of their media.
        gain: d loss / d light of each path, times the gain of the probe [length].
        depth: number of scattering events before the probe.
        bits, state: random numbers (:class:`SpreadSampler`).
        counts: number of probes of first flights, at the beginning of the arrays, and of later flights, at their end (arrays of
            one number).
    """

    p: mi.Point3d
    t: mi.Float64 | None
    d: mi.Vector3f
    time: mi.Float
    body: mi.UInt32
    gain: mi.Spectrum
    depth: mi.UInt32
    bits: mi.UInt32
    state: mi.UInt32
    counts: list[mi.UInt32]

    @classmethod
    def empty(cls, stems: int, has_surfaces: bool, keeps_starts: bool) -> _ProbeList:
        """A list with room for the probes of stems and branches, as many branches as stems."""
        # Only a stem that has scattered at a surface has a later probe too.
        n = stems * (3 if has_surfaces else 2)
        kinds = mi.Vector3f, mi.Float, mi.UInt32, mi.Spectrum, mi.UInt32, mi.UInt32, mi.UInt32
        t = dr.empty(mi.Float64, n) if keeps_starts else None
        made = cls(dr.empty(mi.Point3d, n), t, *(dr.empty(k, n) for k in kinds), [dr.opaque(mi.UInt32, 0) for _ in range(2)])
        dr.eval(made)
        return made

    def add(self, probe: Probe, sampler: SpreadSampler, dL: mi.Spectrum, is_later: bool) -> None:
        """Add the first or the later probes of paths at their ends, with their random numbers and d loss / d light."""
        gain, on = dL * probe.gain, probe.weight > 0
        place = dr.scatter_inc(self.counts[is_later], dr.zeros(mi.UInt32, dr.width(on)), on)
        place = dr.width(self.body) - 1 - place if is_later else place
        own = sampler.branch(mi.UInt32(is_later), mi.UInt32(2))
        values = point_along(probe.ray, probe.t), probe.ray.d, probe.ray.time, probe.body, gain, probe.depth
        stored = self.p, self.d, self.time, self.body, self.gain, self.depth, self.bits, self.state
        for array, value in zip(stored, (*values, own.bits, own.state), strict=True):
            dr.scatter(array, value, place, on)
        if self.t is not None:
            dr.scatter(self.t, probe.t, place, on)

    def add_derivatives(self, estimators: Estimators, wavelengths: mi.Color0f) -> None:
        """Walk paths from the probes, and add the derivatives of the probes."""
        media, n = estimators.media, dr.width(self.body)
        dr.eval(self)
        lane, (front, back) = dr.arange(mi.UInt32, n), self.counts
        on, every, zero = (lane < front) | (lane >= n - back), mi.Bool(True), dr.zeros(mi.Float64, n)
        ray = FineRay(self.p, self.d, dr.full(mi.Float, dr.inf, n), self.time, wavelengths)
        sampler = SpreadSampler(self.bits, self.state, dr.full(mi.Float, -1, n))
        nowhere, one, flight = dr.zeros(mi.MediumPtr, n), (mi.Spectrum(1), mi.Float(1)), KnownFlight(zero, self.body, every)
        start = PathStart(ray, nowhere, *one, self.depth, sampler, every, flight, every)
        L = walk_from_points(estimators.replayed(), start, front, back)
        mei = medium_interaction(ray, zero)
        # With the baseline of another flight, the terms of flights and probes would not have the mean 0.
        t = zero if self.t is None else self.t
        flown = replace(ray, o=self.p - mi.Vector3d(self.d) * t)
        probe = Probe(flown, t, self.body, self.gain, self.depth, dr.ones(mi.Float, n), dr.ones(mi.Float, n))
        mei.medium = media.medium_of(self.body, on)
        ProbeTerm(media, probe, mei, L, estimators.segment.baseline, on).vjp(mi.Spectrum(1))


# -- The baseline --------------------------------------------------------------------------------------------------------


def prepare_derivatives(estimators: Estimators, ray: mi.Ray3f) -> None:
    """Prepare the segment estimator for derivatives along the camera rays of a pass."""
    segment = estimators.segment
    segment.prepare_derivatives(ray)
    if segment.ends_in_media and estimators.media.follows_extinction:
        segment.baseline = _estimate_baseline(estimators, ray)


def count_baseline_paths(rays: int, has_table: bool = False) -> int:
    """Number of paths estimating the baseline of a pass of so many rays, with or without a table of direct light."""
    fewest = min(max(PATHS_PER_RAY * rays, MIN_PATHS), FEW_PATHS)
    if has_table:
        fewest = max(fewest, int(PATHS_PER_ROOT * math.sqrt(rays)))
    return min(max(rays // RAYS_PER_PATH, fewest), MAX_PATHS)


def _estimate_baseline(estimators: Estimators, ray: mi.Ray3f) -> Baseline | None:
    """Estimate the baseline from the collisions of some paths, walked twice.

    Returns:
        The baseline; None if a medium has ``sigma_s`` in place of an albedo, since the terms of its absorption do not have the
        mean 0.
    """
    media = estimators.media
    if any(body.view.albedo is None for body in media.bodies):
        return None

    # -- Some rays of the pass -------------------------------------------------------------------------------------------
    n = dr.width(ray)
    table = _tabulate_direct_light(estimators) if n >= MIN_LISTED else None
    count = count_baseline_paths(n, table is not None)
    index = mi.UInt32(dr.arange(mi.UInt64, count) * n // count)
    rays = mi.Ray3f(ray)
    # Gathers need evaluated arrays: one evaluation of all, in place of a kernel for each.
    dr.eval(rays)
    chosen = dr.gather(mi.Ray3f, rays, index)

    # -- Their light, and the light behind each of their collisions ------------------------------------------------------
    # Numbers of pixels outside of every film.
    lane, one = dr.arange(mi.UInt32, count), mi.UInt32(1)
    sampler = SpreadSampler.of_pixels(mi.Vector2i(lane, -1), mi.UInt32(BASELINE_SEED), dr.opaque(mi.UInt32, 0, count), one)
    sums, start = BaselineSums(media, table), leave_camera_from_memory(estimators, sampler, chosen)

    def turn(number: mi.UInt32, L: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
        """Walk the paths: the first time for their light, the second time with it for the light behind collisions. As a loop
        both walks are compiled once."""
        is_known = number > 0

        def collect(factor: Factor, light: mi.Spectrum) -> None:
            if isinstance(factor, SegmentTransmittance):
                factor.shared.collect(sums, light, is_known)

        rest = walk_from_camera(estimators, start.clone(), Rest(L, collect))[0].L
        return number + 1, dr.select(is_known, L, -dr.detach(rest))

    state = dr.zeros(mi.UInt32, count), dr.zeros(mi.Spectrum, count)
    _, L = dr.while_loop(state=state, cond=lambda number, L: number < 2, body=turn, label="baseline")
    sums.add_path(L)
    return sums.finish()


def _tabulate_direct_light(estimators: Estimators) -> DirectLightTable | None:
    """Tabulate the direct light of the emitters that collisions sample, or None if no emitter is sampled.

    None with side flights: in media that scatter forwards, light depends on the direction, and the table gains nothing.
    """
    lighting = estimators.direct
    if not estimators.lights_media_at_vertices or estimators.media.is_bounded or estimators.lobe is not None:
        return None
    emitters = None if estimators.near is None else lighting.far_emitters
    return tabulate_direct_light(estimators.media, lighting, emitters, BASELINE_SEED + 1)
