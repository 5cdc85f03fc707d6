r"""The path of light from a camera through absorbing media, surfaces and lamps.

.. math:: L = \sum_k \beta_k\, e^{-\tau_k} \left( w_k L_e + L_d e^{-\tau_{shadow}} \right)

A path runs in straight stretches from one opaque surface to the next; along a stretch the media only take light away, by
their exact optical depth. At a surface Mitsuba's own BSDFs and emitters shade it: one emitter sample and one BSDF sample,
combined by the power heuristic (Veach 1997, Eq. 9.13). Whatever is done with a path (its radiance, its tangent, its
derivatives) is a score; the walk itself is written once.

Conventions. ``max_depth`` counts as in ``volpath``: 1 is emitters seen through media, 2 adds surfaces lit directly, -1 is no
limit. Boundaries with a ``null`` BSDF do not count. Media that are bounded by boxes are cut by slab tests; the acceleration
structure is traced only for surfaces and for boundaries of other shapes.

References: radiative backpropagation by replaying paths: Vicini et al. 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.moving_emitters import follow_lamp
from mivol.transport.estimators.multiple_importance import power_heuristic
from mivol.transport.estimators.path_segment import PathSegment
from mivol.transport.estimators.shadow_rays import ShadowedLight, shadow_ray
from mivol.transport.media.ray_intervals import SegmentEnd, transmittance
from mivol.transport.media.scene_media import World
from mivol.transport.path.settings import Settings
from mivol.transport.traversal.ray_spawning import spawn_ray
from mivol.transport.traversal.strata import Strata

__all__ = ["Path", "is_straight", "walk_path"]


@dataclass
class Path:
    """The state of a path.

    ``beta`` is the throughput so far, without the stretch ahead; ``pdf`` and ``delta`` tell how its direction was
    sampled at ``last`` (for the power heuristic); ``valid`` whether the film's alpha sees something.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    beta: mi.Spectrum
    eta: mi.Float
    depth: mi.UInt32
    last: mi.Interaction3f
    pdf: mi.Float
    delta: mi.Bool
    valid: mi.Bool
    active: mi.Bool
    score: Any
    sampler: mi.Sampler
    strata: Strata | None


def walk_path(
    scene: mi.Scene,
    world: World,
    settings: Settings,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    score: Any,
    active: mi.Bool = True,
    strata: Strata | None = None,
) -> tuple[Any, mi.Bool]:
    """Walk a path from the camera and give what it carries to a score.

    Args:
        scene: Mitsuba's scene: surfaces and emitters.
        world: its media.
        settings: depth, roulette, hidden emitters.
        sampler: three 2D and two 1D numbers a surface, three 2D and four 1D ones a stretch through media that scatter.
        ray: world space, unit direction.
        score: :mod:`mivol.transport.path.scores`.
        active: lanes to walk.
        strata: parts of the square that directions at media are drawn from.

    Returns:
        The score, and whether the film's alpha sees something.

    Bias: none. Variance: none at depth 1 beyond the pixel's own; emitter and BSDF sampling at surfaces.
    """
    limit = settings.max_depth if settings.max_depth >= 0 else 0xFFFFFFFF
    visible = not settings.hide_emitters and scene.environment() is not None
    n = dr.width(ray)
    path = Path(
        ray=mi.Ray3f(ray.o, ray.d, dr.inf, ray.time, ray.wavelengths),
        medium=world.medium_at(scene, ray),
        beta=dr.full(mi.Spectrum, 1, n),
        eta=dr.full(mi.Float, 1, n),
        depth=dr.zeros(mi.UInt32, n),
        last=dr.zeros(mi.Interaction3f, n),
        pdf=dr.full(mi.Float, 1, n),
        delta=dr.full(mi.Bool, True, n),
        valid=dr.full(mi.Bool, visible, n),
        active=mi.Bool(active) & (limit > 0),
        score=score,
        sampler=sampler,
        strata=strata,
    )
    if is_straight(world, settings):
        path = _see(scene, world, settings, limit, path)[0]
        return path.score, path.valid
    (path,) = dr.while_loop(
        state=(path,),
        cond=lambda p: p.active,
        body=lambda p: (_bounce(scene, world, settings, limit, *_see(scene, world, settings, limit, p)),),
        label="path",
    )
    return path.score, path.valid


def is_straight(world: World, settings: Settings) -> bool:
    """Whether paths have one stretch: nothing turns one that no surface meets, nor one of depth 1 that no surface lets pass."""
    return not world.has_surfaces or (settings.max_depth in (0, 1) and not world.has_null_transmission)


def _see(scene: mi.Scene, world: World, settings: Settings, limit: int, path: Path) -> tuple[Path, SegmentEnd]:
    """Go to the next opaque surface and add the emission found there; media that scatter shine on the way."""
    scatters = path.active & (path.depth + 1 < limit)
    samples = world.emitters.draw_samples(path.sampler, scatters, path.strata) if world.emitters is not None else None
    # A copy: the throughput is dimmed in place below, and a score may look at the stretch again after that.
    path_segment = PathSegment(path.ray, path.medium, mi.Spectrum(path.beta), scatters, samples)
    end, tau, path.score = path.score.pass_segment(scene, world, path_segment, path.active)
    path.beta *= transmittance(tau)
    path.medium = end.medium

    si = end.si
    shown = path.active & ~((path.depth == 0) & settings.hide_emitters)
    emitter = si.emitter(scene, shown)
    direct = mi.DirectionSample3f(scene, si, path.last)
    lit = ~path.delta & (emitter != None) if world.scatters else mi.Bool(False)
    pdf_emitter = scene.pdf_emitter_direction(path.last, direct, lit) if world.scatters else mi.Float(0)
    w_mis = dr.select(path.delta, 1, power_heuristic(path.pdf, pdf_emitter))
    with dr.resume_grad(when=path.score.attached):
        Le = emitter.eval(si, shown)
        path.score = path.score.add(path.beta * w_mis * Le, shown)
    path.valid |= path.active & si.is_valid()
    return path, end


def _bounce(scene: mi.Scene, world: World, settings: Settings, limit: int, path: Path, end: SegmentEnd) -> Path:
    """Light the surface, and choose where the path goes on."""
    si, sampler, score = end.si, path.sampler, path.score
    on_surface = path.active & si.is_valid()
    bsdf = si.bsdf(path.ray)

    # -- Light from an emitter, dimmed by the media ---------------------------------------------------------------------------
    may_scatter = on_surface & (path.depth + 1 < limit)
    lit = may_scatter & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    u = sampler.next_2d(lit)
    direct, weight = scene.sample_emitter_direction(si, u, False, lit)
    lit &= direct.pdf > 0
    start = spawn_ray(si, direct.p - si.p, world.size).o
    shadow_medium = dr.select(si.is_medium_transition(), si.target_medium(direct.p - start), path.medium)
    ray_segment, clear, tau, light = shadow_ray(scene, world, start, shadow_medium, direct, lit)
    lit &= clear
    _, pdf_bsdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direct.d), lit)
    w_mis = dr.select(direct.delta, 1, power_heuristic(direct.pdf, pdf_bsdf))
    dim = path.beta * light * w_mis
    with dr.resume_grad(when=score.attached):
        moved = follow_lamp(direct.emitter, si, u, direct, lit) if score.attached else direct
        f = bsdf.eval(mi.BSDFContext(), si, si.to_local(moved.d), lit)
        source = scene.eval_emitter_direction(si, moved, lit) / direct.pdf if score.attached else weight
        carried = dim * f * dr.select(direct.pdf > 0, source, 0)
    score = score.shadow(scene, world, ray_segment, ShadowedLight(carried, tau, moved.p), lit)

    # -- The direction the path takes -----------------------------------------------------------------------------------------
    u1, u2 = sampler.next_1d(on_surface), sampler.next_2d(on_surface)
    sample, f_over_pdf = bsdf.sample(mi.BSDFContext(), si, u1, u2, on_surface)
    through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    on = on_surface & (may_scatter | through) & (sample.pdf > 0)
    score = score.turn(bsdf, si, sample.wo, on & ~through)
    path.beta *= dr.select(on, f_over_pdf, 0)
    path.eta *= dr.select(on, sample.eta, 1)
    path.ray = spawn_ray(si, si.to_world(sample.wo), world.size)
    path.medium = dr.select(on & si.is_medium_transition(), si.target_medium(path.ray.d), path.medium)
    path.last = dr.select(on & ~through, mi.Interaction3f(si), path.last)
    path.pdf = dr.select(on & ~through, sample.pdf, path.pdf)
    path.delta = dr.select(on & ~through, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), path.delta)
    path.depth += dr.select(on & ~through, mi.UInt32(1), mi.UInt32(0))

    # -- Roulette ------------------------------------------------------------------------------------------------------
    q = dr.minimum(dr.max(path.beta) * dr.square(path.eta), 0.95)
    late = path.depth >= settings.rr_depth
    survives = ~late | (sampler.next_1d(on) < q)
    path.beta = dr.select(late, path.beta * dr.rcp(dr.maximum(q, 1e-30)), path.beta)
    path.active = on & survives & dr.any(path.beta != 0)
    path.score = score
    return path
