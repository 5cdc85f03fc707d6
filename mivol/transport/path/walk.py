r"""The walk of a path from the camera through media and surfaces: path tracing with next-event estimation.

.. math:: L = \sum_k \beta_k \left( L_{media,k} + T_k\, ( w_k L_e + L_d ) \right)

A path runs in straight segments from one opaque surface to the next. What media add and transmit along a segment is found by
the segment estimator that the plan has chosen. At a surface, direct light is estimated by one emitter sample (next-event
estimation) and one BSDF sample, combined by the power heuristic (Veach 1997, Eq. 9.13). The walk is the same for radiance,
gradients and tangents; a score decides what is made of it (:mod:`mivol.transport.path.scores`).

Conventions. ``max_depth`` counts as in ``volpath``: 1 is emitters seen through media, 2 adds surfaces lit directly, -1 is no
limit. Boundaries with a ``null`` BSDF do not count. Media that are bounded by boxes are cut by slab tests; the acceleration
structure is traced only for surfaces and for boundaries of other shapes.

References: radiative backpropagation by replaying paths: Vicini et al. 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.contribution import TrackedFactor, TrackedTerm
from mivol.transport.estimators.direct_lighting import DirectLight
from mivol.transport.estimators.multiple_importance import power_heuristic
from mivol.transport.estimators.segment import PICTURE, PathSegment
from mivol.transport.estimators.vertex import SurfaceVertex
from mivol.transport.media.channels import colours
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.event import PathEvent
from mivol.transport.path.scores import Primal, Replay, Tangent
from mivol.transport.path.settings import Settings
from mivol.transport.traversal.ray_spawning import camera_ray, spawn_ray
from mivol.transport.traversal.strata import Strata

__all__ = ["Path", "is_straight", "walk_path"]

Score = TypeVar("Score", Primal, Replay, Tangent)

UNLIMITED = 0xFFFFFFFF


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
        score: :mod:`mivol.transport.path.scores`.
        sampler, strata: random numbers.
    """

    ray: mi.Ray3f
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
    sampler: mi.Sampler
    strata: Strata | None


def walk_path(
    estimators: Estimators,
    settings: Settings,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    score: Score,
    active: mi.Bool = True,
    strata: Strata | None = None,
) -> tuple[Score, mi.Float]:
    """Walk a path from the camera and report its terms and factors to a score.

    Args:
        estimators: of light along segments and at surfaces; they know the scene and its media.
        settings: depth, roulette, hidden emitters.
        sampler: three 2D and two 1D numbers a surface, and what the segment estimator draws.
        ray: world space, unit direction.
        score: :mod:`mivol.transport.path.scores`.
        active: lanes to walk.
        strata: the stratum that each lane draws directions in media from.

    Returns:
        The score, and what the film's alpha sees, in [0, 1].

    Bias: that of the segment estimator. Variance: none at depth 1 beyond the pixel's own; at surfaces, that of emitter and BSDF
    samples.
    """
    media, n = estimators.media, dr.width(ray)
    limit = settings.max_depth if settings.max_depth >= 0 else UNLIMITED
    visible = not settings.hide_emitters and media.scene.environment() is not None
    path = Path(
        ray=camera_ray(ray),
        medium=media.medium_at(ray),
        beta=dr.full(mi.Spectrum, 1, n),
        eta=dr.full(mi.Float, 1, n),
        depth=dr.zeros(mi.UInt32, n),
        last=dr.zeros(mi.Interaction3f, n),
        pdf=dr.full(mi.Float, 1, n),
        delta=dr.full(mi.Bool, True, n),
        stopped=dr.full(mi.Bool, visible, n),
        clear=dr.full(mi.Spectrum, 1, n),
        active=mi.Bool(active) & (limit > 0),
        score=score,
        sampler=sampler,
        strata=strata,
    )

    def step(path: Path) -> tuple[Path]:
        path, event = _follow_segment(estimators, settings, limit, path)
        path = _add_emission(estimators, settings, path, event)
        return (_turn(estimators, settings, limit, path, event),)

    if is_straight(estimators, settings):
        path, event = _follow_segment(estimators, settings, limit, path)
        path = _add_emission(estimators, settings, path, event)
        path.stopped |= event.at_surface
    else:
        (path,) = dr.while_loop(state=(path,), cond=lambda p: p.active, body=step, label="path")
    return path.score, _alpha(path.stopped, path.clear)


def _alpha(stopped: mi.Bool, clear: mi.Spectrum) -> mi.Float:
    """What a film's alpha sees of a path: all of it where a surface stopped it, else the opacity of the media.

    This is the mean of what ``volpath`` draws from ``max_depth`` 2 on (1 where it finds a point in a medium or on a surface),
    without its noise. At depth 1 ``volpath`` finds no points in media, and its smoke has no alpha; here it has the same one.
    """
    return dr.select(stopped, 1, 1 - sum(colours(clear)) / dr.size_v(clear))


def is_straight(estimators: Estimators, settings: Settings) -> bool:
    """Whether every path has one segment: there are no surfaces, or the depth is at most 1 and none of them transmits light."""
    media = estimators.media
    return not media.has_surfaces or (settings.scatterings == 0 and not media.has_null_transmission)


def _follow_segment(estimators: Estimators, settings: Settings, limit: int, path: Path) -> tuple[Path, PathEvent]:
    """Follow the segment to the next opaque surface: media add a term, and their transmittance is a factor."""
    may_scatter = path.active & (path.depth + 1 < limit)
    samples = estimators.segment.draw(path.sampler, may_scatter, path.strata)
    # A copy of the throughput: it is multiplied in place below, and derivatives read the segment's own after that.
    segment = PathSegment(path.ray, path.medium, mi.Spectrum(path.beta), may_scatter, samples)
    found = estimators.segment.estimate(segment, path.score.purpose, path.active)
    if found.light is not None:
        path.score = path.score.add(found.light)
    path.score = path.score.scale(found.transmittance)
    path.beta *= found.T
    path.clear *= found.T
    path.medium = found.end.medium
    return path, PathEvent.of(found.end, path.active)


def _add_emission(estimators: Estimators, settings: Settings, path: Path, event: PathEvent) -> Path:
    """Add the emission of the surface, or of the environment, towards the path."""
    scene, si = estimators.media.scene, event.si
    shown = path.active & ~((path.depth == 0) & settings.hide_emitters)
    emitter = si.emitter(scene, shown)
    w_mis = mi.Float(1)
    if estimators.lights_surfaces:
        direct = mi.DirectionSample3f(scene, si, path.last)
        pdf_emitter = scene.pdf_emitter_direction(path.last, direct, ~path.delta & (emitter != None))
        w_mis = dr.select(path.delta, 1, power_heuristic(path.pdf, pdf_emitter))
    with dr.resume_grad(when=path.score.purpose != PICTURE):
        Le = path.beta * w_mis * emitter.eval(si, shown)
    path.score = path.score.add(TrackedTerm(Le, shown))
    return path


def _turn(estimators: Estimators, settings: Settings, limit: int, path: Path, event: PathEvent) -> Path:
    """Estimate the direct light at the surface, and sample the direction in which the path continues."""
    media, si, sampler = estimators.media, event.si, path.sampler
    on_surface, attached = event.at_surface, path.score.purpose != PICTURE
    vertex = event.vertex(media, path.ray)

    # -- Next-event estimation: light from an emitter, dimmed by the media ----------------------------------------------------
    may_scatter = on_surface & (path.depth + 1 < limit)
    lit = may_scatter & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
    u, chance = sampler.next_2d(lit), sampler.next_1d(lit) if media.is_bounded else None
    direct = estimators.direct.at_surface(vertex, u, attached, lit, chance)
    with dr.resume_grad(when=attached):
        carried = path.beta * direct.value
    path.score = path.score.add(DirectLight(media, direct.ray_segment, carried, direct.on))

    # -- The direction the path takes -----------------------------------------------------------------------------------------
    u1, u2 = sampler.next_1d(on_surface), sampler.next_2d(on_surface)
    sample, f_over_pdf = vertex.bsdf.sample(mi.BSDFContext(), si, u1, u2, on_surface)
    through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    # A sampled direction of density 0 has weight 0; its path ends below, where beta is 0.
    on = on_surface & (may_scatter | through)
    turned = on & ~through
    path.stopped |= on_surface & ~through
    path.score = path.score.scale(_bsdf_factor(vertex, sample.wo, turned))
    path.beta *= dr.select(on, f_over_pdf, 0)
    path.eta *= dr.select(on, sample.eta, 1)
    rest = path.ray.maxt - event.t
    path.ray = spawn_ray(si, si.to_world(sample.wo), media.size)
    # A ray that is transmitted undeviated keeps its end (the sensor's far_clip).
    path.ray.maxt = dr.select(through, dr.minimum(rest, path.ray.maxt), path.ray.maxt)
    path.medium = dr.select(on & si.is_medium_transition(), si.target_medium(path.ray.d), path.medium)
    path.last = dr.select(turned, mi.Interaction3f(si), path.last)
    path.pdf = dr.select(turned, sample.pdf, path.pdf)
    path.delta = dr.select(turned, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), path.delta)
    path.depth += dr.select(turned, mi.UInt32(1), mi.UInt32(0))

    # -- Roulette ------------------------------------------------------------------------------------------------------
    q = dr.minimum(dr.max(path.beta) * dr.square(path.eta), 0.95)
    late = path.depth >= settings.rr_depth
    survives = ~late | (sampler.next_1d(on) < q)
    path.beta = dr.select(late, path.beta * dr.rcp(dr.maximum(q, 1e-30)), path.beta)
    path.active = on & survives & dr.any(path.beta != 0)
    return path


def _bsdf_factor(vertex: SurfaceVertex, wo: mi.Vector3f, active: mi.Bool) -> TrackedFactor:
    """The BSDF as a factor of all light ahead, with its derivatives."""
    return TrackedFactor(lambda: vertex.bsdf.eval(mi.BSDFContext(), vertex.interaction, wo, active), active)
