r"""The walk of a path from the camera through media and surfaces: path tracing with next-event estimation.

.. math:: L = \sum_k \beta_k \left( L_{media,k} + T_k\, ( w_k L_e + L_d ) \right)

A path runs in straight segments from one event to the next: to an opaque surface or, where the segment estimator that the plan
has chosen ends segments in media, to a collision. The estimator also finds what media add and transmit along a segment. At an
event, direct light is estimated by one emitter sample (next-event estimation) and one sample of the BSDF or phase function,
combined by the power heuristic (Veach 1997, Eq. 9.13). The walk is the same for radiance, gradients and tangents; a score
decides what is made of it (:mod:`mivol.transport.estimators.scores`).

Conventions. ``max_depth`` counts as in ``volpath``: 1 is emitters seen through media, each scattering adds 1, -1 is no
limit. Boundaries with a ``null`` BSDF do not count. Media that are bounded by boxes are cut by slab tests; the acceleration
structure is traced only for surfaces and for boundaries of other shapes.

References: radiative backpropagation by replaying paths: Vicini et al. 2021.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flights.flight_derivatives import Probe, Probes, ProbeTerm, ShadowReservoir, ShadowTerm
from mivol.transport.estimators.flights.free_flight import make_collision
from mivol.transport.estimators.lighting.direct_lighting import DirectLight, DistantEmitterSample, power_heuristic
from mivol.transport.estimators.scores import IMAGE, Primal, Replay, Tangent, TrackedTerm
from mivol.transport.estimators.segment import Collision, PathSegment
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.channels import to_components
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.event import PathEvent, TurnSamples, sample_next_direction
from mivol.transport.path.side_flight import (
    SideFlightSamples,
    WeightedEmitterSample,
    estimate_side_flight,
    weigh_emitter_sample,
)
from mivol.transport.traversal.random_numbers import LaneSampler, Strata, draw_state
from mivol.transport.traversal.rays import FineRay, Ray, clip_camera_ray, point_along

__all__ = [
    "FirstCollision",
    "Path",
    "film_alpha",
    "gather_lanes",
    "has_one_segment",
    "leave_camera",
    "start_path",
    "advance_path",
    "walk_branch",
    "walk_path",
    "walk_stem",
]

T = TypeVar("T")
Score = TypeVar("Score", Primal, Replay, Tangent)

ROULETTE_THROUGHPUT = 0.5
"""Throughput down to which a path in a medium surely goes on (variance x time, measured at 1, 1/2 and 1/4: in a white box of
optical depth 64 three times less at 1/2, in smoke of albedo 0.5 to 0.95 between 1.04 times more and 1.6 times less; 1/4 is as
1/2)."""

LONG_PATH = 128.0
"""Scatterings of a path from which on roulette may raise its throughput above 1, to the root of their number over this one. Of
paths that enter a half-space the share that is still inside after n scatterings falls as the root of n, and takes a multiple
of n more: where light has a place, each of these costs as much and finds less. Variance x time falls 1.1 times in milk in a
glass, 1.3 times in a dense cloud, 1.6 to 1.7 times in a white box under a lamp, and rises by at most 1.04 times where most
light is that of a sky."""


@dataclass
class Path:
    """The state of a path.

    Attributes:
        ray: of the segment ahead.
        medium: the medium around its origin.
        beta: throughput to there.
        eta: product of the relative indices of refraction, for Russian roulette.
        depth: number of scattering events so far.
        last: where the direction was sampled, for the power heuristic.
        pdf: density [1/sr] that it was sampled with.
        delta: whether that density is a delta function.
        stopped: whether a surface stopped or turned the path, for the film's alpha.
        clear: transmittance of the media up to there, for the film's alpha.
        active: lanes that go on.
        score: :mod:`mivol.transport.estimators.scores`.
        sampler, strata: random numbers.
        probes: points of the flights so far, at which derivatives are looked at besides; None for pictures.
        shadow: the shadow ray that is walked back for derivatives; None for pictures, and where paths scatter at surfaces only.
        aim: the emitter sample that the next vertex takes; None where there are no side flights, and each draws its own.
        rival: density [1/sr] of the direction where light of media was drawn at ``last`` too, 0 where it was not; None where it
            is never drawn.
    """

    ray: FineRay
    medium: mi.MediumPtr
    beta: mi.Spectrum
    eta: mi.Float
    depth: mi.UInt32
    last: mi.Interaction3f
    pdf: mi.Float
    delta: mi.Bool
    stopped: mi.Bool
    clear: mi.Spectrum
    active: mi.Bool
    score: Any
    sampler: mi.Sampler | LaneSampler
    strata: Strata | None
    probes: Probes | None = None
    shadow: ShadowReservoir | None = None
    aim: WeightedEmitterSample | None = None
    rival: mi.Float | None = None


@dataclass
class FirstCollision:
    """Where paths have first collided, on their first segment.

    Attributes:
        ray: of the camera.
        t: distance of the collision [length].
        body: index of the medium.
        beta: throughput to there.
        on: lanes that have collided.
    """

    ray: FineRay
    t: mi.Float64
    body: mi.UInt32
    beta: mi.Spectrum
    on: mi.Bool


def walk_path(
    estimators: Estimators,
    sampler: mi.Sampler,
    ray: Ray,
    score: Score,
    active: mi.Bool = True,
    strata: Strata | None = None,
) -> tuple[Score, mi.Float]:
    """Walk a path from the camera and report its terms and factors to a score.

    Args:
        estimators: of light along segments and at surfaces; they know the scene and its media.
        sampler: three 2D and two 1D numbers a surface, and what the segment estimator draws.
        ray: world space, unit direction.
        score: :mod:`mivol.transport.estimators.scores`.
        active: lanes to walk.
        strata: the stratum that each lane draws directions in media from.

    Returns:
        The score, and what the film's alpha sees, in [0, 1].

    Bias: that of the segment estimator. Variance: none at depth 1 beyond the pixel's own; at surfaces, that of emitter and BSDF
    samples.
    """
    active = mi.Bool(active) & (estimators.settings.depth_limit > 0)
    path = start_path(estimators, clip_camera_ray(ray), score, sampler, strata, active)
    path = leave_camera(estimators, path, estimators.media.medium_at(ray))
    if has_one_segment(estimators):
        path, event = _follow_segment(estimators, path)
        path = _add_emitted_light(estimators, path, event)
        path.stopped |= event.at_surface
        return path.score, film_alpha(path)
    path = _add_reservoirs(estimators, _walk_to_end(estimators, _start_reservoirs(estimators, path, "first", "later")))
    return path.score, film_alpha(path)


def walk_stem(estimators: Estimators, sampler: mi.Sampler, ray: Ray, score: Score) -> tuple[Score, FirstCollision]:
    """Walk a path from the camera, but no further than to a collision on its first segment.

    Args:
        estimators: whose segments end in media; the rest as of :func:`walk_path`.

    Returns:
        The score, and where such paths have collided: :func:`walk_branch` walks them on from there.
    """
    goes_on = estimators.media.has_surfaces
    kept = ("first", "later") if goes_on else ("first",)
    path = start_path(estimators, clip_camera_ray(ray), score, sampler, None, dr.full(mi.Bool, True, dr.width(ray)))
    path = _start_reservoirs(estimators, leave_camera(estimators, path, estimators.media.medium_at(ray)), *kept)
    path, event = _follow_segment(estimators, path)
    path = _add_emitted_light(estimators, path, event)
    hit = event.collision
    landing = FirstCollision(path.ray, hit.t, hit.body, mi.Spectrum(path.beta), hit.on)
    if goes_on:
        beside = replace(event, collision=replace(hit, on=dr.full(mi.Bool, False, dr.width(ray))))
        path = _walk_to_end(estimators, _scatter(estimators, path, beside))
    return _add_reservoirs(estimators, path).score, landing


def walk_branch(estimators: Estimators, sampler: LaneSampler, landing: FirstCollision, score: Score) -> tuple[Score, mi.UInt32]:
    """Walk a path on from where it first collided, to its end.

    Args:
        estimators, score: as of :func:`walk_path`.
        sampler: independent of the path to there.
        landing: where the path collided.

    Returns:
        The score, and how often the path has scattered.
    """
    path = start_path(estimators, landing.ray, score, sampler, None, mi.Bool(landing.on))
    path.beta = mi.Spectrum(landing.beta)
    path = _sample_first_emitter(estimators, _start_reservoirs(estimators, path, "later"))
    hit = make_collision(estimators.media, landing.ray, landing.t, landing.body, landing.on)
    path = _walk_to_end(estimators, _scatter(estimators, path, _in_medium(hit, sampler.next_1d())))
    return _add_reservoirs(estimators, path).score, path.depth


def _start_reservoirs(estimators: Estimators, path: Path, *which: str) -> Path:
    """For derivatives of paths that scatter in media, a path that keeps some of its points and shadow rays.

    Args:
        which: "first": a point before it scatters; "later": another one, and a shadow ray, after that.
    """
    if not estimators.segment.ends_in_media or path.score.purpose == IMAGE:
        return path
    path.probes = Probes(*(Probe.empty(path.ray) if name in which else None for name in ("first", "later")))
    if "later" in which:
        path.shadow = ShadowReservoir.empty(estimators.media, path.ray)
    return path


def _add_reservoirs(estimators: Estimators, path: Path) -> Path:
    """Add the derivatives that kept points and shadow rays find, at the end of a path."""
    if path.shadow is not None:
        path.score = path.score.add(ShadowTerm(estimators.media, path.shadow))
    if path.probes is not None:
        for probe in path.probes.kept:
            path.score = path.score.add(_estimate_probe(estimators, probe, path.sampler))
    return path


def start_path(
    estimators: Estimators,
    ray: Ray,
    score: Score,
    sampler: mi.Sampler | LaneSampler,
    strata: Strata | None,
    active: mi.Bool,
) -> Path:
    """A path that has not met anything yet, outside all media."""
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
        stopped=dr.full(mi.Bool, False, n),
        clear=dr.full(mi.Spectrum, 1, n),
        active=active,
        score=score,
        sampler=sampler,
        strata=strata,
        rival=None if estimators.emission is None else dr.zeros(mi.Float, n),
    )


def leave_camera(estimators: Estimators, path: Path, medium: mi.MediumPtr) -> Path:
    """A path that was started, as it leaves a camera in a medium."""
    path.stopped |= not estimators.settings.hide_emitters and estimators.media.scene.environment() is not None
    path.medium = medium
    return _sample_first_emitter(estimators, path)


def _sample_first_emitter(estimators: Estimators, path: Path) -> Path:
    """Draw the emitter sample of the first vertex, where vertices are given theirs beforehand."""
    if estimators.lobe is not None:
        path.aim = WeightedEmitterSample(
            _sample_distant_emitter(estimators, path.ray, path.sampler, path.active), dr.full(mi.Float, 1, dr.width(path.ray))
        )
    return path


def _sample_distant_emitter(
    estimators: Estimators, ray: FineRay, sampler: mi.Sampler | LaneSampler, active: mi.Bool
) -> DistantEmitterSample:
    """An emitter sample for a vertex that lies ahead; emitters are at infinity, so that any point will do."""
    it = dr.zeros(mi.Interaction3f, dr.width(ray))
    it.p, it.time, it.wavelengths = mi.Point3f(ray.o), ray.time, ray.wavelengths
    return DistantEmitterSample.from_sample(estimators.direct.sample_emitter(it, sampler.next_2d(active), active))


def advance_path(estimators: Estimators, path: Path) -> Path:
    """Follow a path along its segment and over the event at its end."""
    path, event = _follow_segment(estimators, path)
    path = _add_emitted_light(estimators, path, event)
    return _scatter(estimators, path, event)


def _walk_to_end(estimators: Estimators, path: Path) -> Path:
    """Follow a path to its end."""
    return dr.while_loop(state=(path,), cond=lambda p: p.active, body=lambda p: (advance_path(estimators, p),), label="path")[0]


def _add_side_flight(estimators: Estimators, path: Path, event: PathEvent, aim: DistantEmitterSample, active: mi.Bool) -> Path:
    """Look at the emitter sample of the next vertex from the end of a side flight."""
    sampler = path.sampler
    lobe, flight = sampler.next_2d(active), estimators.segment.draw(sampler, active, None)
    samples = SideFlightSamples(lobe, flight, draw_state(sampler, active) if estimators.draws_shadows else None)
    flight = estimate_side_flight(estimators, event.collision, path.beta, path.depth, aim, samples, path.score.purpose, active)
    path.score = path.score.add(flight.light)
    if path.shadow is not None:
        path.shadow = path.shadow.offer(flight.shadow, flight.chance)
    return path


def _estimate_probe(estimators: Estimators, probe: Probe, sampler: mi.Sampler) -> ProbeTerm:
    """Estimate the radiance that is scattered at a probe towards the path, by a path of its own."""
    media, n = estimators.media, dr.width(probe.ray)
    on = probe.weight > 0
    mei = medium_interaction(probe.ray, dr.select(on, probe.t, 0))
    mei.medium = media.medium_of(probe.body, on)
    path = start_path(estimators, probe.ray, Primal(dr.zeros(mi.Spectrum, n)), sampler, None, on)
    path.depth = mi.UInt32(probe.depth)
    collision = Collision(mei, point_along(probe.ray, probe.t), dr.full(mi.Spectrum, 1, n), on, probe.t, probe.body)
    path = _walk_to_end(estimators, _scatter(estimators, path, _in_medium(collision)))
    return ProbeTerm(media, probe, mei, dr.detach(path.score.L), estimators.segment.baseline, on)


def _in_medium(collision: Collision, chance: mi.Float | None = None) -> PathEvent:
    """The event of a collision that a path begins with."""
    n = dr.width(collision.on)
    nothing = dr.zeros(mi.SurfaceInteraction3f, n), mi.Float(0), collision.mei.medium, dr.full(mi.Bool, False, n)
    return PathEvent(*nothing, collision, chance)


def film_alpha(path: Path) -> mi.Float:
    """What a film's alpha sees of a path: all of it where a surface stopped it, else the opacity of the media.

    This is the mean of what ``volpath`` draws from ``max_depth`` 2 on (1 where it finds a point in a medium or on a surface),
    without its noise. At depth 1 ``volpath`` finds no points in media, and its smoke has no alpha; here it has the same one.
    """
    return dr.select(path.stopped, 1, 1 - sum(to_components(path.clear)) / dr.size_v(path.clear))


def has_one_segment(estimators: Estimators) -> bool:
    """Whether every path has one segment: there are no surfaces, or the depth is at most 1 and none of them transmits light."""
    media = estimators.media
    if estimators.segment.ends_in_media:
        return False
    return not media.has_surfaces or (estimators.settings.scatterings == 0 and not media.has_null_transmission)


def _follow_segment(estimators: Estimators, path: Path) -> tuple[Path, PathEvent]:
    """Follow the segment to the next opaque surface: media add a term, and their transmittance is a factor."""
    may_scatter = path.active & (path.depth + 1 < estimators.settings.depth_limit)
    samples = estimators.segment.draw(path.sampler, may_scatter, path.strata)
    # A copy of the throughput: it is multiplied in place below, and derivatives read the segment's own after that.
    segment = PathSegment(path.ray, path.medium, mi.Spectrum(path.beta), may_scatter, samples, mi.UInt32(path.depth))
    if estimators.emission is not None:
        segment.emission_weight = estimators.emission.weigh_path(path.last, path.rival, path.ray.d, path.active)
    found = estimators.segment.estimate(segment, path.score.purpose, path.active)
    if found.light is not None:
        path.score = path.score.add(found.light)
    path.score = path.score.scale(found.transmittance)
    if found.probe is not None:
        path.probes = path.probes.offer(segment, found.probe)
    path.beta *= found.T
    path.clear *= found.T
    path.medium = found.end.medium
    return path, PathEvent.from_estimate(found, path.active)


def _add_emitted_light(estimators: Estimators, path: Path, event: PathEvent) -> Path:
    """Add the emission of the surface, or of the environment, towards the path."""
    scene, si = estimators.media.scene, event.si
    shown = path.active & ~event.in_medium & ~((path.depth == 0) & estimators.settings.hide_emitters)
    emitter = si.emitter(scene, shown)
    w_mis = mi.Float(1)
    if estimators.lights_surfaces or estimators.lights_media:
        direct = mi.DirectionSample3f(scene, si, path.last)
        pdf_emitter = scene.pdf_emitter_direction(path.last, direct, ~path.delta & (emitter != None))
        w_mis = dr.select(path.delta, 1, power_heuristic(path.pdf, pdf_emitter))
    with dr.resume_grad(when=path.score.purpose != IMAGE):
        Le = path.beta * w_mis * emitter.eval(si, shown)
    path.score = path.score.add(TrackedTerm(Le, shown))
    return path


def _scatter(estimators: Estimators, path: Path, event: PathEvent) -> Path:
    """Estimate the direct light where the segment has ended, and sample the direction in which the path continues."""
    arrives, sampler = event.at_surface | event.in_medium, path.sampler
    limit = estimators.settings.depth_limit
    may_scatter = arrives & (path.depth + 1 < limit)
    path = _add_direct_light(estimators, path, event, may_scatter)
    if estimators.emission is not None:
        path = _add_media_emission(estimators, path, event, may_scatter)
    ahead = event.in_medium & (path.depth + 2 < limit)
    if path.aim is not None:
        aim = _sample_distant_emitter(estimators, path.ray, sampler, arrives)
        path = _add_side_flight(estimators, path, event, aim, ahead)

    # -- The direction the path takes -----------------------------------------------------------------------------------------
    u1, u2 = sampler.next_1d(arrives), sampler.next_2d(arrives)
    turn = sample_next_direction(estimators, path.ray, event, TurnSamples(u1, u2), may_scatter)
    path.stopped |= arrives & ~turn.through
    for factor in turn.factors:
        path.score = path.score.scale(factor)
    if path.aim is not None:
        path.aim = weigh_emitter_sample(estimators, aim, turn.ray.d, turn.pdf, ahead & turn.on)
    path.beta *= dr.select(turn.on, turn.weight, 0)
    path.eta *= dr.select(turn.on, turn.eta, 1)
    path.ray, path.medium = turn.ray, dr.select(turn.on, turn.medium, path.medium)
    turned = turn.on & ~turn.through
    path.last = dr.select(turned, turn.origin, path.last)
    path.pdf = dr.select(turned, turn.pdf, path.pdf)
    path.delta = dr.select(turned, turn.delta, path.delta)
    if path.rival is not None:
        path.rival = dr.select(turned, dr.select(event.in_medium | ~turn.delta, turn.pdf, 0), path.rival)
    path.depth += dr.select(turned, mi.UInt32(1), mi.UInt32(0))

    # -- Roulette ------------------------------------------------------------------------------------------------------
    # At surfaces it ends paths that never lose any light; in media these find their way out.
    sure, most = mi.Float(1), mi.Float(0.95)
    if event.collision is not None:
        spared = (
            mi.Float(ROULETTE_THROUGHPUT)
            if estimators.long_paths_count
            else dr.maximum(ROULETTE_THROUGHPUT, dr.sqrt(path.depth / LONG_PATH))
        )
        sure, most = dr.select(event.in_medium, spared, sure), dr.select(event.in_medium, 1, most)
    q = dr.minimum(dr.max(path.beta) * dr.square(path.eta) / sure, most)
    late = path.depth >= estimators.settings.rr_depth
    survives = ~late | (sampler.next_1d(turn.on) < q)
    path.beta = dr.select(late, path.beta * dr.rcp(dr.maximum(q, 1e-30)), path.beta)
    path.active = turn.on & survives & dr.any(path.beta != 0)
    return path


def _add_direct_light(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> Path:
    """Next-event estimation: light from an emitter, dimmed by the media, that is scattered towards the path."""
    media, sampler, purpose = estimators.media, path.sampler, path.score.purpose
    lit = mi.Bool(False)
    if estimators.lights_surfaces:
        smooth = mi.has_flag(event.si.bsdf().flags(), mi.BSDFFlags.Smooth)
        lit = may_scatter & event.at_surface & smooth
    if estimators.lights_media:
        lit |= may_scatter & event.in_medium
    if not (estimators.lights_surfaces or estimators.lights_media):
        return path
    vertex = event.vertex(media)
    if path.aim is None:
        aim = estimators.direct.sample_emitter(vertex.interaction, sampler.next_2d(lit), lit)
    else:
        aim = path.aim.sample.at_point(vertex.interaction)
    rng = draw_state(sampler, lit) if estimators.draws_shadows else None
    direct = estimators.direct.estimate_at_vertex(vertex, aim, purpose != IMAGE, lit, rng)
    with dr.resume_grad(when=purpose != IMAGE):
        carried = path.beta * direct.value
        if event.collision is not None:
            inside = event.collision.albedo if path.aim is None else event.collision.albedo * path.aim.weight
            carried = dr.select(event.in_medium, carried * inside, carried)
    light = DirectLight(media, direct.ray_segment, carried, direct.on)
    if path.shadow is None:
        path.score = path.score.add(light)
        return path
    path.score = path.score.add(TrackedTerm(carried, direct.on))
    path.shadow = path.shadow.offer(light, event.chance)
    return path


def _add_media_emission(estimators: Estimators, path: Path, event: PathEvent, may_scatter: mi.Bool) -> Path:
    """Light of media that emit, from a point that is drawn in them."""
    lit, inside = may_scatter & event.in_medium, mi.Spectrum(1)
    if estimators.media.has_surfaces:
        lit |= may_scatter & event.at_surface & mi.has_flag(event.si.bsdf().flags(), mi.BSDFFlags.Smooth)
    if event.collision is not None:
        inside = dr.select(event.in_medium, event.collision.albedo, 1)
    light = estimators.emission.estimate_at_vertex(
        event.vertex(estimators.media),
        path.beta * inside,
        (path.sampler.next_1d(lit), draw_state(path.sampler, lit)),
        path.score.purpose != IMAGE,
        lit,
        estimators.draws_shadows,
    )
    path.score = path.score.add(light)
    if path.shadow is not None:
        path.shadow = path.shadow.offer(light.shadow, light.point.chance)
    elif path.score.purpose != IMAGE:
        alone = ShadowReservoir.empty(estimators.media, path.ray).offer(light.shadow, light.point.chance)
        path.score = path.score.add(ShadowTerm(estimators.media, alone))
    return path


def gather_lanes(values: T, index: mi.UInt32, active: mi.Bool = True) -> T:
    """Gather values of lanes; a value that all lanes share stays as it is."""
    return dr.gather(type(values), values, index, active) if dr.width(values) > 1 else values
