r"""The walk of a path from the camera through media and surfaces: path tracing with next-event estimation.

.. math:: L = \sum_k \beta_k \left( L_{media,k} + T_k\, ( w_k L_e + L_d ) \right)

A path consists of straight segments. A segment ends at an opaque surface or, with some segment estimators, at a collision with
a medium. The segment estimator computes the light and the transmittance of the media along the segment. At the end of the
segment, next-event estimation (one emitter sample) and one sample of the BSDF or phase function estimate the direct light
together, weighted by the power heuristic (Veach 1997, Eq. 9.13). Images, gradients and tangents share this walk: a score
(:mod:`mivol.transport.estimators.scores`) accumulates either of the three.

Conventions. ``max_depth`` counts as in ``volpath``: depth 1 is light seen through media, each scattering event adds 1, and -1
means no limit. Boundaries with a ``null`` BSDF do not count. Slab tests cut the boxes of media; Mitsuba traces surfaces and
boundaries of other shapes only.

References: radiative backpropagation by replaying paths: Vicini et al. 2021.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from mivol.kernel_recording import begin_kernel
from mivol.transport.estimators.flights.flight_derivatives import Probe, Probes, ProbeTerm, ShadowReservoir, ShadowTerm
from mivol.transport.estimators.flights.free_flight import make_collision
from mivol.transport.estimators.lighting.direct_lighting import (
    DirectLight,
    DistantEmitterSample,
    EmitterSample,
    power_heuristic,
)
from mivol.transport.estimators.lighting.emitters import is_among
from mivol.transport.estimators.lighting.kept_rays import LARGEST_REFLECTANCE, KeptMirror
from mivol.transport.estimators.lighting.refracted_light import RefractedSamples, VertexBeforeGlass, refracts_only
from mivol.transport.estimators.lighting.tabulated_shadows import KeptShadow
from mivol.transport.estimators.scores import IMAGE, Primal, Replay, Tangent, TrackedTerm
from mivol.transport.estimators.segment import Collision, KnownFlight, PathSegment
from mivol.transport.estimators.single_scattering.near_light import AimedDirections
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.extinction import to_components
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.event import DirectionSamples, PathEvent, is_glass, mirror_ray, sample_next_direction
from mivol.transport.path.kept_segments import SegmentNumber
from mivol.transport.path.side_flight import (
    SideFlightSamples,
    WeightedEmitterSample,
    aim_at_emitter,
    estimate_side_flight,
    weigh_emitter_sample,
)
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, draw_state, fork_state
from mivol.transport.traversal.rays import FineRay, Ray, clip_camera_ray, point_along

__all__ = [
    "Path",
    "PathStart",
    "Score",
    "add_probes",
    "advance_path",
    "begin_path",
    "film_alpha",
    "gather_lanes",
    "has_one_segment",
    "leave_camera",
    "leave_camera_from_memory",
    "start_path",
    "walk_from_camera",
    "walk_in_kernel",
    "walk_light",
    "walk_part",
    "walk_path",
]

T = TypeVar("T")
Score = TypeVar("Score", Primal, Replay, Tangent)


ROULETTE_THROUGHPUT = 0.5
"""Throughput above which a path in a medium always survives the roulette [1]. (Variance x time at 1/2, compared with 1: 3 times
less in a white box of optical depth 64, and between 1.04 times more and 1.6 times less in smoke of albedo 0.5 to 0.95. 1/4
performs like 1/2.)"""

LONG_PATH = 128.0
"""Number n of scattering events beyond which roulette may raise the throughput above 1, up to sqrt(n / ``LONG_PATH``). The
share of paths still inside a half-space after n events falls as 1 / sqrt(n), and leaving takes a multiple of n more events.
Under emitters of a finite size or direction these long paths cost as much as others and find less light. (Variance x time falls
by 1.1 times in a glass of milk, 1.3 times in a dense cloud, 1.6 to 1.7 times in a white box under a lamp, and rises by at most
1.04 times where the sky gives most of the light.)"""


# -- The state of a path -------------------------------------------------------------------------------------------------


@dataclass
class Path:
    """The state of a path.

    Attributes:
        ray: ray of the next segment.
        medium: medium around the origin of the ray.
        beta: throughput up to the origin [1].
        eta: product of the relative indices of refraction, for Russian roulette [1].
        depth: number of scattering events so far.
        last: interaction at which the direction was sampled, for the power heuristic.
        pdf: density of the sampled direction [1/sr].
        delta: whether the density is a delta function.
        is_opaque: whether a surface has stopped or turned the path, for the film's alpha.
        T: transmittance of the media along the path so far, for the film's alpha [1].
        active: lanes that continue.
        score: accumulator of radiance or derivatives (:mod:`mivol.transport.estimators.scores`).
        sampler: random numbers.
        probes: points kept from the flights so far, for derivatives; None in images.
        shadow: shadow ray kept for derivatives; None in images and for paths scattering at surfaces only.
        tabulated: shadow ray kept from those of vertices in media, by a table of shadows; None without a table.
        emitter_sample: emitter sample of the next vertex; None without side flights (each vertex then draws its own sample).
        emission_pdf: ``pdf`` in lanes where ``last`` has sampled the emission of media too, 0 in other lanes [1/sr]; None if
            media emission is never sampled.
        left_medium: lanes in which ``last`` is a point of a medium; None if vertices draw the light of near emitters.
        known: flights of camera rays, for the first segment of the path, and the collisions at which stems have stopped; None
            if all flights are drawn with the segment.
        mirror: kept ray mirrored by glass; None if mirrored paths find lamps by chance.
        mirrored: lanes mirrored by the last event, with the mirrored ray offered to ``mirror``; None without ``mirror``.
        met_glass: lanes that have met smooth glass; None if chance decides what glass does (``Estimators.glass``).
        number: number of the next segment among the segments in memory (:mod:`.kept_segments`); None without memory.
        before_glass: the last vertex with a density of directions; None if lamps behind glass are met by chance.
    """

    ray: FineRay
    medium: mi.MediumPtr
    beta: mi.Spectrum
    eta: mi.Float
    depth: mi.UInt32
    last: mi.Interaction3f
    pdf: mi.Float
    delta: mi.Bool
    is_opaque: mi.Bool
    T: mi.Spectrum
    active: mi.Bool
    score: Any
    sampler: mi.Sampler | SpreadSampler
    probes: Probes | None = None
    shadow: ShadowReservoir | None = None
    tabulated: KeptShadow | None = None
    emitter_sample: WeightedEmitterSample | None = None
    emission_pdf: mi.Float | None = None
    left_medium: mi.Bool | None = None
    known: KnownFlight | None = None
    met_glass: mi.Bool | None = None
    mirror: KeptMirror | None = None
    mirrored: mi.Bool | None = None
    number: SegmentNumber | None = None
    before_glass: VertexBeforeGlass | None = None


@dataclass
class PathStart:
    """The start of a path, at the camera or at the first collision with a medium.

    Attributes:
        ray: camera ray, ended at the sensor's ``far_clip``, or the ray of the segment that ends at the collision.
        medium: medium around the origin of the ray.
        beta, eta, depth: as of :class:`Path`.
        sampler: random numbers of the path, behind those of a known flight.
        active: lanes to walk.
        flight: first flights of camera rays, on where they are known, or the collisions.
        at_collision: lanes that start at the end of their flight.
        number: as of :class:`Path`.
    """

    ray: Ray
    medium: mi.MediumPtr
    beta: mi.Spectrum
    eta: mi.Float
    depth: mi.UInt32
    sampler: mi.Sampler | SpreadSampler
    active: mi.Bool
    flight: KnownFlight | None
    at_collision: mi.Bool
    number: SegmentNumber | None = None

    @classmethod
    def at_stop(cls, path: Path, sampler: SpreadSampler) -> PathStart:
        """The starts of branches, at the collisions at which paths have stopped."""
        flight = path.known
        return cls(path.ray, path.medium, path.beta, path.eta, path.depth, sampler, flight.on, flight, flight.on)

    def in_memory(self) -> PathStart:
        """The start as arrays in memory, one for each attribute and colour, and no constants: kernels that begin with it then
        have the same instructions.
        """
        lane = dr.arange(mi.UInt32, dr.width(self.ray))

        def write(values: T) -> T:
            stored = dr.empty(type(values), len(lane))
            dr.scatter(stored, values, lane)
            return stored

        ray, sampler, flight = FineRay.from_ray(self.ray), self.sampler, self.with_flight().flight
        return PathStart(
            FineRay(*(write(values) for values in (ray.o, ray.d, ray.maxt, ray.time)), ray.wavelengths),
            *(write(values) for values in (self.medium, self.beta, self.eta, self.depth)),
            SpreadSampler(*(write(values) for values in (sampler.bits, sampler.state, sampler.lead))),
            write(self.active),
            KnownFlight(
                *(write(values) for values in (flight.t, flight.body, flight.on)),
                weight=None if flight.weight is None else write(flight.weight),
            ),
            write(self.at_collision),
            self.number and SegmentNumber(write(self.number.index), write(self.number.left)),
        )

    def with_flight(self) -> PathStart:
        """The same start, with flights that are known in no lane in place of None."""
        none = KnownFlight(mi.Float64(0), mi.UInt32(0), mi.Bool(False))
        return replace(self, flight=none) if self.flight is None else self

    def clone(self) -> PathStart:
        """The same start for another walk, which draws the same numbers: a walk advances the sampler of its start."""
        return replace(self, sampler=self.sampler.clone())

    def gather(self, index: mi.UInt32, active: mi.Bool) -> PathStart:
        """The starts of the lanes with an index, active where ``active``."""
        ray = self.ray
        o, d, maxt, time = (gather_lanes(values, index, active) for values in (ray.o, ray.d, ray.maxt, ray.time))
        state = (self.medium, self.beta, self.eta, self.depth, self.at_collision)
        medium, beta, eta, depth, at_collision = (gather_lanes(values, index, active) for values in state)
        flight = None if self.flight is None else self.flight.at(index, active)
        fine = FineRay(o, d, maxt, time, ray.wavelengths)
        return PathStart(fine, medium, beta, eta, depth, self.sampler.gather(index, active), active, flight, at_collision)


def start_path(
    estimators: Estimators,
    ray: Ray,
    score: Score,
    sampler: mi.Sampler | SpreadSampler,
    active: mi.Bool,
) -> Path:
    """A path before the first segment, outside all media."""
    n = dr.width(ray)
    return Path(
        ray=FineRay.from_ray(ray),
        medium=dr.zeros(mi.MediumPtr, n),
        beta=dr.full(mi.Spectrum, 1, n),
        eta=dr.full(mi.Float, 1, n),
        depth=dr.zeros(mi.UInt32, n),
        last=dr.zeros(mi.Interaction3f, n),
        pdf=dr.full(mi.Float, 1, n),
        delta=dr.full(mi.Bool, True, n),
        is_opaque=dr.full(mi.Bool, False, n),
        T=dr.full(mi.Spectrum, 1, n),
        active=active,
        score=score,
        sampler=sampler,
        emission_pdf=None if estimators.emission is None else dr.zeros(mi.Float, n),
        left_medium=None if estimators.near is None else dr.full(mi.Bool, False, n),
        **estimators.start_kept_rays(n),
        mirrored=None if estimators.mirrored is None else dr.full(mi.Bool, False, n),
        met_glass=None if estimators.glass == "any" else dr.full(mi.Bool, False, n),
        before_glass=None if estimators.refracted is None else VertexBeforeGlass.none(n),
    )


def leave_camera(
    estimators: Estimators, sampler: mi.Sampler | SpreadSampler, ray: mi.Ray3f, active: mi.Bool = True
) -> PathStart:
    """Start paths at the camera, and find their first flights where that lowers the noise.

    Args:
        sampler, ray, active: as in :func:`walk_path`.
    """
    ray, medium, flight = clip_camera_ray(ray), estimators.media.medium_at(ray), None
    active = mi.Bool(active) & (estimators.settings.depth_limit > 0) & dr.full(mi.Bool, True, dr.width(ray))
    if estimators.segment.ends_in_media:
        flight = estimators.segment.find_first_collision(ray, medium, sampler, active)
    beta, eta, depth = mi.Spectrum(1), mi.Float(1), mi.UInt32(0)
    return PathStart(ray, medium, beta, eta, depth, sampler, active, flight, mi.Bool(False))


def leave_camera_from_memory(estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f) -> PathStart:
    """The starts of :func:`leave_camera` in memory, from a kernel that images, derivatives and baselines share."""
    ray = clip_camera_ray(ray)
    begin_kernel(ray, sampler)
    start = leave_camera(estimators, sampler, ray).in_memory()
    begin_kernel(start)
    return start


def begin_path(estimators: Estimators, start: PathStart, score: Score, *probes: str) -> Path:
    """A path at its start (see :func:`_start_reservoirs` for ``probes``)."""
    path = start_path(estimators, start.ray, score, start.sampler, mi.Bool(start.active))
    path.medium = start.medium
    path.beta, path.eta, path.depth = path.beta * start.beta, path.eta * start.eta, path.depth + start.depth
    path.is_opaque |= not estimators.settings.hide_emitters and estimators.media.scene.environment() is not None
    path.known, path.number = start.flight, start.number
    return _sample_first_emitter(estimators, _start_reservoirs(estimators, path, *probes))


def has_one_segment(estimators: Estimators) -> bool:
    """Whether every path has one segment: no surfaces, or depth 1 and no surface transmitting light without deviation."""
    media = estimators.media
    if estimators.segment.ends_in_media:
        return False
    return not media.has_surfaces or (estimators.settings.scatterings == 0 and not media.has_null_transmission)


def film_alpha(path: Path) -> mi.Float:
    """Alpha of a path for the film [1]: 1 if a surface has stopped the path, otherwise the opacity of the media.

    From ``max_depth`` 2 on, ``volpath`` draws alpha (1 if a path finds a point in a medium or on a surface); film_alpha is the
    mean of these draws, without noise. At depth 1 ``volpath`` finds no points in media and its smoke has alpha 0; mivol's alpha
    does not depend on the depth.
    """
    return dr.select(path.is_opaque, 1, 1 - sum(to_components(path.T)) / dr.size_v(path.T))


def gather_lanes(values: T, index: mi.UInt32, active: mi.Bool = True) -> T:
    """Gather values by lane; a value shared by all lanes stays as it is."""
    return dr.gather(type(values), values, index, active) if dr.width(values) > 1 else values


# -- Whole paths, stems and branches -------------------------------------------------------------------------------------


def walk_path(
    estimators: Estimators,
    sampler: mi.Sampler | SpreadSampler,
    ray: Ray,
    score: Score,
    active: mi.Bool = True,
) -> tuple[Score, mi.Float]:
    """Walk a path from the camera and report its terms and factors to a score.

    Args:
        estimators: estimators of the render, with its scene, media and settings.
        sampler: random numbers: three 2D and two 1D numbers a surface, and the numbers of the segment estimator.
        ray: camera ray in world space, with a unit direction.
        score: accumulator of radiance or derivatives (:mod:`mivol.transport.estimators.scores`).
        active: lanes to walk.

    Returns:
        The score, and the alpha for the film, in [0, 1].

    Bias: the bias of the segment estimator. Variance: none at depth 1 beyond the variance inside a pixel; the variance of
    emitter and BSDF samples at surfaces.
    """
    return walk_from_camera(estimators, leave_camera(estimators, sampler, ray, active), score)


def walk_from_camera(estimators: Estimators, start: PathStart, score: Score) -> tuple[Score, mi.Float]:
    """Walk a path as :func:`walk_path` does, from its start."""
    if has_one_segment(estimators):
        path, event = _follow_segment(estimators, begin_path(estimators, start, score))
        path = _add_emitted_light(estimators, path, event)
        path.is_opaque |= event.at_surface
        return path.score, film_alpha(path)
    path = begin_path(estimators, start, score, "first", "later")
    path = add_probes(estimators, _end_path(estimators, _walk_to_end(estimators, path)))
    return path.score, film_alpha(path)


def walk_part(
    estimators: Estimators, start: PathStart, score: Score, stops: mi.Bool | None = None, probes: tuple[str, ...] = ()
) -> Path:
    """Walk stems, branches or both, each in its lanes.

    Args:
        estimators: estimators of the render; their segments end in media.
        start: starts of the paths.
        score: accumulator of radiance or derivatives.
        stops: lanes of stems, which end at their first collision (``known`` of the path, on there); None without stems.
        probes: as of :func:`_start_reservoirs`.

    Returns:
        The paths at their ends, with thinned probes, whose derivatives are not yet added.
    """
    path = begin_path(estimators, start, score, *probes)
    flight = start.flight
    at = make_collision(estimators.media, path.ray, flight.t, flight.body, flight.on & start.at_collision)
    return _end_path(estimators, _walk_from_collision(estimators, path, at, stops))


def walk_light(
    estimators: Estimators, start: PathStart, stops: bool, shares: bool = True
) -> tuple[mi.Spectrum, mi.Float, Path]:
    """Find the light of paths (arguments: :func:`walk_in_kernel`).

    Returns:
        Radiance, alpha for the film (in [0, 1]), and the paths at their ends.
    """
    black = dr.zeros(mi.Spectrum, dr.width(start.ray))
    score, alpha, path = walk_in_kernel(estimators, start, Primal(black), stops, shares)
    return score.L, alpha, path


def walk_in_kernel(
    estimators: Estimators, start: PathStart, score: Score, stops: bool, shares: bool = True, probes: tuple[str, ...] = ()
) -> tuple[Score, mi.Float, Path]:
    """Walk stems or branches in a kernel of their own.

    Args:
        estimators: estimators of the render; their segments end in media.
        start: starts of the paths.
        score: accumulator of radiance or of its tangent.
        stops: whether the paths are stems, which end at their first collision.
        shares: whether images, stems and branches share the kernel of the walk, so that it is compiled once. Their starts are
            in memory then (:func:`leave_camera_from_memory`, :meth:`PathStart.in_memory`), and the results are evaluated.
        probes: as of :func:`_start_reservoirs`.

    Returns:
        The score, alpha for the film (in [0, 1]), and the paths at their ends.
    """
    stem = dr.opaque(mi.Bool, stops)
    if shares:
        begin_kernel(start, stem)
    path = add_probes(estimators, walk_part(estimators, start, score, stem, probes))
    alpha = dr.select(path.known.on, 1, film_alpha(path))
    if shares:
        begin_kernel(path.score, alpha, (path.ray, path.medium, path.beta, path.eta, path.depth, path.known))
    return path.score, alpha, path


def advance_path(estimators: Estimators, path: Path, collision: Collision | None = None, stops: mi.Bool | None = None) -> Path:
    """Follow a path along its next segment and across the event at the end.

    Args:
        estimators: estimators of the render.
        path: the path.
        collision: lanes that are at a collision on their segment already, and scatter there; None for no lanes.
        stops: lanes whose paths end at a collision with a medium; None for no lanes.
    """
    active = path.active
    if collision is not None:
        path.active = active & ~collision.on
    path, event = _follow_segment(estimators, path)
    path = _add_emitted_light(estimators, path, event)
    path.active, hit, stopped = active, event.collision, None
    if stops is not None:
        stopped, ray, beta = stops & hit.on, path.ray, mi.Spectrum(path.beta)
        event = event.omit_collisions(stopped)
    if collision is not None:
        event = event.begin_at(replace(collision, on=active & collision.on))
    path = _scatter(estimators, path, event)
    if stopped is not None:
        path.ray, path.beta = dr.select(stopped, ray, path.ray), dr.select(stopped, beta, path.beta)
        path.known = dr.select(stopped, replace(path.known, t=hit.t, body=hit.body, on=stopped), path.known)
    return path


def _walk_to_end(estimators: Estimators, path: Path) -> Path:
    return dr.while_loop(
        state=(path,), cond=lambda path: path.active, body=lambda path: (advance_path(estimators, path),), label="path"
    )[0]


def _walk_from_collision(estimators: Estimators, path: Path, collision: Collision, stops: mi.Bool | None = None) -> Path:
    """Walk paths to their ends. Where ``collision`` is on, they begin at this collision (``stops``: :func:`advance_path`).

    The loop scatters at the first collision too: an event in front of the loop would be compiled a second time.
    """

    def advance(path: Path, begins: mi.Bool) -> tuple[Path, mi.Bool]:
        path = advance_path(estimators, path, replace(collision, on=collision.on & begins), stops)
        return path, dr.full(mi.Bool, False, dr.width(begins))

    state = (path, dr.full(mi.Bool, True, dr.width(collision.on)))
    return dr.while_loop(state=state, cond=lambda path, begins: path.active, body=advance, label="path")[0]


# -- One segment and its event -------------------------------------------------------------------------------------------


def _follow_segment(estimators: Estimators, path: Path) -> tuple[Path, PathEvent]:
    """Follow the next segment: report the light of its media as a term and their transmittance as a factor."""
    may_scatter = path.active & (path.depth + 1 < estimators.settings.depth_limit)
    if estimators.glass == "mirrors":
        may_scatter &= path.depth > 0
    samples = estimators.segment.draw(path.sampler, may_scatter)
    # Copies: throughput and depth change in place below, and derivatives read the values at the start of the segment later.
    segment = PathSegment(path.ray, path.medium, mi.Spectrum(path.beta), may_scatter, samples, mi.UInt32(path.depth))
    # Distances to near emitters are drawn up to the surface, behind the collision of the flight too.
    segment.needs_surface = estimators.near is not None
    if path.known is not None:
        segment.known, path.known = path.known, path.known.forget()
    number, stored = path.number, None
    if number is not None:
        stored = path.active & (number.left > 0)
        if not estimators.writes_segments:
            segment.known = estimators.kept.flight_at(number.index, stored, segment.known)
    if estimators.emission is not None:
        segment.emission_weight = estimators.emission.weigh_path(path.last, path.emission_pdf, path.ray.d, path.active)
    if not (isinstance(estimators.camera_emission, float) and estimators.camera_emission == 1):
        weight = dr.select(path.depth == 0, estimators.camera_emission, 1)
        segment.emission_weight = weight * (1 if segment.emission_weight is None else segment.emission_weight)
    estimate = estimators.segment.estimate(segment, path.score.purpose, path.active)
    if estimate.light is not None:
        path.score = path.score.add(estimate.light)
    if estimators.near is not None:
        path = _add_near_light(estimators, path, segment, estimate.end.t, stored)
    if number is not None:
        if estimators.writes_segments:
            estimators.kept.set_flight(number.index, estimate, stored)
        path.number = number.after(dr.width(path.ray), path.active)
    path.score = path.score.scale(estimate.transmittance)
    if estimate.probe is not None:
        path.probes = path.probes.offer(segment, estimate.probe, estimate.chance)
    path.beta *= estimate.T
    path.T *= estimate.T
    path.medium = estimate.end.medium
    return path, PathEvent.from_estimate(estimate, path.active)


def _add_emitted_light(estimators: Estimators, path: Path, event: PathEvent) -> Path:
    """Add the emission of the surface or environment hit by the path, weighted against emitter samples."""
    scene, si = estimators.media.scene, event.si
    if not estimators.meets_light:
        # A replay of one segment waits for this term.
        path.score = path.score.add(TrackedTerm(mi.Spectrum(0), mi.Bool(False)))
        return path
    visible = path.active & ~event.in_medium & ((path.depth > 0) | estimators.is_shown(si))
    emitter = si.emitter(scene, visible)
    if path.mirrored is not None:
        # Kept rays pass lamps on surfaces that let light through.
        visible &= ~path.mirrored | is_among(estimators.direct.emitters.transmissive, emitter)
    w_mis = mi.Float(1)
    if estimators.lights_surfaces or estimators.lights_media:
        direct = mi.DirectionSample3f(scene, si, path.last)
        pdf_emitter = _emitter_pdf(estimators, path, direct, ~path.delta & (emitter != None))
        is_balanced = estimators.direct.emitters.are_balanced(emitter)
        w_mis = dr.select(path.delta, 1, power_heuristic(path.pdf, pdf_emitter, is_balanced))
    if path.before_glass is not None:
        w_mis *= estimators.refracted.weigh_path(path.before_glass, emitter, visible & path.delta)
    with dr.resume_grad(when=path.score.purpose != IMAGE):
        Le = path.beta * w_mis * emitter.eval(si, visible)
    path.score = path.score.add(TrackedTerm(Le, visible))
    return path


def _emitter_pdf(estimators: Estimators, path: Path, direct: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
    """Density of a direction in the emitter samples of the last vertex [1/sr]."""
    lighting = estimators.direct
    if path.left_medium is None:
        return lighting.emitters.pdf_direction(path.last, direct, active)
    inside, pdf = active & path.left_medium, mi.Float(0)
    for emitters in (lighting.near_emitters, lighting.far_emitters):
        pdf += dr.select(inside, emitters.pdf_direction(path.last, direct, inside), 0)
    if not estimators.lights_surfaces:
        return pdf
    outside = active & ~path.left_medium
    return pdf + dr.select(outside, lighting.emitters.pdf_direction(path.last, direct, outside), 0)


def _scatter(estimators: Estimators, path: Path, event: PathEvent) -> Path:
    """Estimate the direct light at the end of a segment, and sample the direction in which the path continues."""
    arrives, sampler, limit = event.at_surface | event.in_medium, path.sampler, estimators.settings.depth_limit
    may_scatter, splits = arrives & (path.depth + 1 < limit), None
    if path.met_glass is not None:
        splits = event.at_surface & (path.depth == 0) & ~path.met_glass & is_glass(event.si)
        path.met_glass |= splits
        if estimators.glass == "mirrors":
            may_scatter &= splits | (path.depth > 0)

    # -- Direct light --------------------------------------------------------------------------------------------------
    path = _add_direct_light(estimators, path, event, may_scatter)
    if estimators.emission is not None:
        path = _add_media_emission(estimators, path, event, may_scatter)
    if path.emitter_sample is not None:
        flies_aside = event.in_medium & may_scatter & (path.depth + 2 < limit)
        emitter_sample = _sample_distant_emitter(estimators, path.ray, sampler, arrives)
        aimed = aim_at_emitter(estimators, emitter_sample, path.beta, sampler.next_1d(arrives), flies_aside)
        path = _add_side_flight(estimators, path, event, emitter_sample, aimed, flies_aside)

    if path.before_glass is not None:
        path = _add_refracted_light(estimators, path, event, may_scatter)

    # -- What glass mirrors --------------------------------------------------------------------------------------------
    offered = None
    if path.mirror is not None:
        path, offered = _offer_mirror(estimators, path, event, may_scatter)

    # -- The next direction --------------------------------------------------------------------------------------------
    samples = DirectionSamples(sampler.next_1d(arrives), sampler.next_2d(arrives), splits=splits)
    if path.emitter_sample is not None:
        samples.aimed = aimed
    elif estimators.near is not None and estimators.near.aims:
        # The last segment of a path finds emitters by chance only.
        aims = may_scatter & (path.depth + 2 < limit)
        p = mi.Point3f(event.vertex(estimators.media).interaction.p)
        samples.aimed = estimators.near.aim(p, path.beta, sampler.next_1d(aims), aims)
    onward = sample_next_direction(estimators, path.ray, event, samples, may_scatter)
    path.is_opaque |= arrives & ~onward.through
    if splits is not None:
        path.T *= dr.select(splits & onward.through, onward.pdf, 1)
    for factor in onward.factors:
        path.score = path.score.scale(factor)
    if path.emitter_sample is not None:
        pdf = aimed.mix(onward.pdf, onward.ray.d)
        path.emitter_sample = weigh_emitter_sample(estimators, emitter_sample, onward.ray.d, pdf, flies_aside & onward.on)
    path.beta *= dr.select(onward.on, onward.weight, 0)
    path.eta *= dr.select(onward.on, onward.eta, 1)
    path.ray, path.medium = onward.ray, dr.select(onward.on, onward.medium, path.medium)
    scatters = onward.on & ~onward.through
    path.last = dr.select(scatters, onward.origin, path.last)
    path.pdf = dr.select(scatters, onward.pdf, path.pdf)
    if offered is not None:
        path.mirrored = dr.select(scatters, offered & onward.mirrored, path.mirrored)
    path.delta = dr.select(scatters, onward.delta, path.delta)
    if path.emission_pdf is not None:
        samples_emission = event.in_medium | ~onward.delta
        path.emission_pdf = dr.select(scatters, dr.select(samples_emission, onward.pdf, 0), path.emission_pdf)
    if path.left_medium is not None:
        path.left_medium = dr.select(scatters, event.in_medium, path.left_medium)
    path.depth += dr.select(scatters, mi.UInt32(1), mi.UInt32(0))
    if path.before_glass is not None:
        is_smooth = event.in_medium | ~onward.delta
        fresh = VertexBeforeGlass(onward.origin, mi.Vector3f(onward.ray.d), onward.pdf, mi.Bool(False), mi.Bool(False))
        old = path.before_glass.at_specular(scatters & ~is_smooth, onward.mirrored | ~refracts_only(event.si))
        path.before_glass = dr.select(scatters & is_smooth, fresh, old)

    # -- Russian roulette ----------------------------------------------------------------------------------------------
    # At surfaces q is at most 0.95, to end paths that never lose light; paths in media find their way out.
    throughput, q_max = mi.Float(1), mi.Float(0.95)
    if event.collision is not None:
        allowed = mi.Float(ROULETTE_THROUGHPUT)
        if not estimators.long_paths_count:
            allowed = dr.maximum(ROULETTE_THROUGHPUT, dr.sqrt(path.depth / LONG_PATH))
        throughput, q_max = dr.select(event.in_medium, allowed, throughput), dr.select(event.in_medium, 1, q_max)
    q = dr.minimum(dr.max(path.beta) * dr.square(path.eta) / throughput, q_max)
    is_late = path.depth >= estimators.settings.rr_depth
    survives = ~is_late | (sampler.next_1d(onward.on) < q)
    path.beta = dr.select(is_late, path.beta * dr.rcp(dr.maximum(q, 1e-30)), path.beta)
    path.active = onward.on & survives & dr.any(path.beta != 0)
    if not estimators.meets_light:
        # The last segment of a path would find nothing.
        path.active &= (path.depth == 0) | (path.depth + 1 < limit)
    return path


def _offer_mirror(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> tuple[Path, mi.Bool]:
    """Offer the ray mirrored by smooth glass to the reservoir of a path; also returns the lanes with an offered ray."""
    at_glass = may_scatter & event.at_surface & is_glass(event.si)
    ray, medium, share, chance = mirror_ray(estimators.media, event, at_glass)
    at_glass &= chance < LARGEST_REFLECTANCE
    light = path.beta * share
    weight = dr.select(at_glass, dr.max(light * estimators.mirrored.guess(ray, at_glass)), 0)
    kept = mi.Point3d(ray.o), mi.Point3f(ray.d), medium, light
    path.mirror = path.mirror.add(kept, weight, path.sampler.next_1d(at_glass))
    return path, at_glass


# -- Direct light --------------------------------------------------------------------------------------------------------


def _add_direct_light(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> Path:
    """Next-event estimation: add the light of an emitter sample, attenuated by the media along its shadow ray."""
    if not (estimators.lights_surfaces or estimators.lights_media_at_vertices):
        return path
    media, sampler, attached = estimators.media, path.sampler, path.score.purpose != IMAGE
    lit = mi.Bool(False)
    if estimators.lights_surfaces:
        lit = may_scatter & event.at_surface & mi.has_flag(event.si.bsdf().flags(), mi.BSDFFlags.Smooth)
    if estimators.lights_media_at_vertices:
        lit |= may_scatter & event.in_medium
    vertex = event.vertex(media)
    if path.emitter_sample is not None:
        sample = path.emitter_sample.sample.at_point(vertex.interaction)
    elif estimators.near is None or not estimators.lights_media_at_vertices:
        sample = estimators.direct.sample_emitter(vertex.interaction, sampler.next_2d(lit), lit)
    else:
        sample = _sample_far_emitter(estimators, vertex.interaction, event, sampler.next_2d(lit), lit)
    rng = draw_state(sampler, lit) if estimators.draws_shadows else None
    known, number = None, path.number
    if number is not None and not estimators.writes_segments:
        known = estimators.kept.shadow_at(number.index, lit & (number.left > 0))
    direct = estimators.direct.estimate_at_vertex(vertex, sample, attached, lit, rng, known)
    if known is not None:
        # The lengths in media of a ray that is not followed are unknown.
        direct.ray_segment.passages = None
    if number is not None and estimators.writes_segments:
        estimators.kept.set_shadow(number.index, direct.T, lit & (number.left > 0))
    with dr.resume_grad(when=attached):
        weight = mi.Spectrum(1)
        if event.collision is not None:
            weight = event.collision.albedo
            if path.emitter_sample is not None:
                weight = weight * path.emitter_sample.weight
            weight = dr.select(event.in_medium, weight, 1)
        value = path.beta * direct.value * weight
    if path.tabulated is not None:
        (chance,) = draw_pcg32(fork_state(rng, 1), 1)[1]
        path.tabulated = path.tabulated.offer(direct.shadow.times(path.beta * weight), chance, direct.on)
    light = DirectLight(media, direct.ray_segment, value, direct.on)
    if path.shadow is None:
        path.score = path.score.add(light)
        return path
    path.score = path.score.add(TrackedTerm(value, direct.on))
    path.shadow = path.shadow.offer(light, event.chance)
    return path


def _add_refracted_light(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> Path:
    """Add the light of a lamp behind smooth glass, scattered at a vertex."""
    is_smooth = event.at_surface & mi.has_flag(event.si.bsdf().flags(), mi.BSDFFlags.Smooth)
    # The glass is another event.
    lit = may_scatter & (event.in_medium | is_smooth) & (path.depth + 2 < estimators.settings.depth_limit)
    sampler = path.sampler
    samples = RefractedSamples(sampler.next_1d(lit), sampler.next_2d(lit), draw_state(sampler, lit))
    L = estimators.refracted.estimate(event.vertex(estimators.media), samples, path.depth + 1, lit)
    if event.collision is not None:
        L *= dr.select(event.in_medium, event.collision.albedo, 1)
    path.score = path.score.add(TrackedTerm(path.beta * L, lit))
    return path


def _sample_far_emitter(
    estimators: Estimators, it: mi.Interaction3f, event: PathEvent, u: mi.Point2f, active: mi.Bool
) -> EmitterSample:
    """Sample an emitter for a vertex: in media an emitter at infinity, since segments draw the light of near emitters."""
    lighting, inside = estimators.direct, active & event.in_medium
    sample = lighting.sample_emitter(it, u, inside, lighting.far_emitters)
    if not estimators.lights_surfaces:
        return sample
    at_surface = lighting.sample_emitter(it, u, active & ~event.in_medium)
    return dr.select(event.in_medium, sample, at_surface)


def _add_near_light(estimators: Estimators, path: Path, segment: PathSegment, length: mi.Float, stored: mi.Bool | None) -> Path:
    """Add the light of near emitters scattered along a segment; ``stored``: lanes whose segment has room in memory, or None."""
    attached, places = path.score.purpose != IMAGE, None
    on, known = path.active & segment.may_scatter, None
    samples = estimators.near.draw(path.sampler, on)
    if stored is not None:
        places, stored = estimators.kept.places, stored & on
    if places is not None and not estimators.writes_segments:
        known = places.at(path.number.index, stored), stored

    def add(score: Score, shadow: ShadowReservoir | None, tabulated: KeptShadow | None) -> tuple:
        near = estimators.near.estimate(segment, length, samples, attached, path.active, known)
        if places is not None and estimators.writes_segments:
            places.set(path.number.index, near.place, stored)
        score = score.add(near.light)
        if tabulated is not None:
            tabulated = tabulated.offer(near.tabulated, near.chance, near.shadow.active)
        kept = _keep_shadow_ray(estimators, replace(path, score=score, shadow=shadow), near.shadow, near.chance)
        return kept.score, kept.shadow, tabulated

    # Packets of lanes pass by if none of them has such a segment.
    state = path.score, path.shadow, path.tabulated
    state = dr.if_stmt(args=state, cond=on, true_fn=add, false_fn=lambda *state: state, label="near light")
    path.score, path.shadow, path.tabulated = state
    return path


def _add_media_emission(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> Path:
    """Add the light of a sampled point of the emitting media."""
    media, sampler, attached = estimators.media, path.sampler, path.score.purpose != IMAGE
    lit, albedo = may_scatter & event.in_medium, mi.Spectrum(1)
    if media.has_surfaces:
        lit |= may_scatter & event.at_surface & mi.has_flag(event.si.bsdf().flags(), mi.BSDFFlags.Smooth)
    if event.collision is not None:
        albedo = dr.select(event.in_medium, event.collision.albedo, 1)
    light = estimators.emission.estimate_at_vertex(
        event.vertex(media),
        path.beta * albedo,
        (sampler.next_1d(lit), draw_state(sampler, lit)),
        attached,
        lit,
        estimators.draws_shadows,
    )
    path.score = path.score.add(light)
    return _keep_shadow_ray(estimators, path, light.shadow, light.point.chance)


def _keep_shadow_ray(estimators: Estimators, path: Path, shadow: DirectLight, chance: mi.Float) -> Path:
    """Offer a shadow ray to the reservoir of the path; without a reservoir, add its derivatives now."""
    if path.shadow is not None:
        path.shadow = path.shadow.offer(shadow, chance)
    elif path.score.purpose != IMAGE:
        alone = ShadowReservoir.empty(estimators.media, path.ray).offer(shadow, chance)
        path.score = path.score.add(ShadowTerm(estimators.media, alone))
    return path


def _sample_first_emitter(estimators: Estimators, path: Path) -> Path:
    """Draw the emitter sample of the first vertex, for paths with side flights."""
    if estimators.lobe is not None:
        sample = _sample_distant_emitter(estimators, path.ray, path.sampler, path.active)
        path.emitter_sample = WeightedEmitterSample(sample, dr.full(mi.Float, 1, dr.width(path.ray)))
    return path


def _sample_distant_emitter(
    estimators: Estimators, ray: FineRay, sampler: mi.Sampler | SpreadSampler, active: mi.Bool
) -> DistantEmitterSample:
    """Sample an emitter for a later vertex. All emitters are at infinity, so the sample is valid at any point."""
    it = dr.zeros(mi.Interaction3f, dr.width(ray))
    it.p, it.time, it.wavelengths = mi.Point3f(ray.o), ray.time, ray.wavelengths
    return DistantEmitterSample.from_sample(estimators.direct.sample_emitter(it, sampler.next_2d(active), active))


def _add_side_flight(
    estimators: Estimators,
    path: Path,
    event: PathEvent,
    sample: DistantEmitterSample,
    aimed: AimedDirections,
    active: mi.Bool,
) -> Path:
    """Add the light of an emitter sample that reaches the path through the end of a side flight."""
    sampler = path.sampler
    lobe, flight = sampler.next_2d(active), estimators.segment.draw(sampler, active)
    samples = SideFlightSamples(lobe, flight, draw_state(sampler, active) if estimators.draws_shadows else None)
    side = estimate_side_flight(
        estimators, event.collision, path.beta, path.depth, sample, aimed, samples, path.score.purpose, active
    )
    path.score = path.score.add(side.light)
    if path.shadow is not None:
        path.shadow = path.shadow.offer(side.shadow, side.chance)
    if path.tabulated is not None:
        (chance,) = draw_pcg32(fork_state(samples.shadow, 1), 1)[1]
        path.tabulated = path.tabulated.offer(side.tabulated, chance, side.light.active)
    return path


# -- Points and shadow rays kept for derivatives ------------------------------------------------------------------------


def _start_reservoirs(estimators: Estimators, path: Path, *probes: str) -> Path:
    """Give a path the empty reservoirs that its derivatives need, if it scatters in media.

    Args:
        probes: "first": keep a point of the first segment; "later": keep a point of a later segment, and a shadow ray.
    """
    if not estimators.segment.ends_in_media or path.score.purpose == IMAGE:
        return path
    if any(body.needs_probes for body in estimators.media.bodies):
        path.probes = Probes(*(Probe.empty(path.ray) if name in probes else None for name in ("first", "later")))
    if "later" in probes and estimators.media.follows_extinction:
        path.shadow = ShadowReservoir.empty(estimators.media, path.ray)
        if path.number is not None and not estimators.writes_segments and estimators.kept.shadow is not None:
            path.shadow.ray_segment.passages = None
    return path


def _end_path(estimators: Estimators, path: Path) -> Path:
    """Add the light of the kept shadow ray in images, or its derivatives, at the end of a path; thin the probes."""
    for kept in (path.tabulated, path.mirror):
        if kept is not None:
            path.score = path.score.add(TrackedTerm(kept.light_at_camera(estimators.media, path.ray), mi.Bool(True)))
    if path.shadow is not None:
        path.score = path.score.add(ShadowTerm(estimators.media, path.shadow))
    if path.probes is not None:
        first, later = (
            None if probe is None else probe.thin(estimators.media, path.sampler.next_1d())
            for probe in (path.probes.first, path.probes.later)
        )
        path.probes = Probes(first, later)
    return path


def add_probes(estimators: Estimators, path: Path) -> Path:
    """Add the derivatives at the kept points."""
    if path.probes is None:
        return path
    first, later = path.probes.first, path.probes.later
    if first is None or later is None:
        path.score = path.score.add(_estimate_probe(estimators, first or later, path.sampler))
        return path

    def turn(number: mi.UInt32, score: Score, sampler: mi.Sampler | SpreadSampler) -> tuple:
        probe = dr.select(number == 0, first, later)
        own = sampler.branch(number, mi.UInt32(2)) if isinstance(sampler, SpreadSampler) else sampler
        return number + 1, score.add(_estimate_probe(estimators, probe, own)), sampler

    state = dr.zeros(mi.UInt32, dr.width(first.t)), path.score, path.sampler
    _, path.score, path.sampler = dr.while_loop(state=state, cond=lambda number, *_: number < 2, body=turn, label="probes")
    return path


def _estimate_probe(estimators: Estimators, probe: Probe, sampler: mi.Sampler) -> ProbeTerm:
    """Estimate the radiance scattered at a kept point towards the path, by a path starting there."""
    media, n = estimators.media, dr.width(probe.ray)
    on = probe.weight > 0
    mei = medium_interaction(probe.ray, dr.select(on, probe.t, 0))
    mei.medium = media.medium_of(probe.body, on)
    path = start_path(estimators, probe.ray, Primal(dr.zeros(mi.Spectrum, n)), sampler, on)
    path.depth = mi.UInt32(probe.depth)
    # The term of the probe multiplies by the albedo.
    collision = Collision(mei, point_along(probe.ray, probe.t), dr.full(mi.Spectrum, 1, n), on, probe.t, probe.body)
    path = _walk_from_collision(estimators, path, collision)
    return ProbeTerm(media, probe, mei, dr.detach(path.score.L), estimators.segment.baseline, on)
