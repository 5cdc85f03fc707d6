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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.transport.film import Strata
from mivol.transport.lattice import slab
from mivol.transport.world import Body, World, spawn_ray

__all__ = [
    "DARK",
    "Dimmed",
    "Path",
    "Reach",
    "Settings",
    "Stretch",
    "Visit",
    "Way",
    "camera_ray",
    "distance_along",
    "follow_lamp",
    "is_straight",
    "light_through",
    "optical_depth_to",
    "reach",
    "revisit",
    "shadow_ray",
    "transmittance",
    "walk_path",
]


@dataclass(frozen=True)
class Settings:
    """How long a path may be, and how scattered light is found.

    ``max_depth`` (-1: no limit), roulette from ``rr_depth`` on, ``hide_emitters``; ``deterministic``: by quadrature, with
    ``shadows`` that are ``exact`` or looked up in a ``grid``; drawn light has ``exact`` or ``estimated`` shadows, or (``auto``)
    what the plan chooses.
    """

    max_depth: int = 6
    rr_depth: int = 5
    hide_emitters: bool = False
    deterministic: bool = False
    shadows: str = "auto"


@dataclass
class Reach:
    """Where a stretch ends: at an opaque surface (``si`` valid), or at the distance asked for.

    ``t`` is the length of the stretch, ``medium`` what surrounds its end, ``veil`` what veils on the way let through.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    veil: mi.Spectrum | float


@dataclass
class Way:
    """A stretch that has been walked: its ray, the medium it began in, its length, and whether it passed veils."""

    ray: mi.Ray3f
    medium: mi.MediumPtr
    length: mi.Float
    unveils: bool = False


@dataclass
class Dimmed:
    """Light that a shadow ray carried: its value, already dimmed by ``tau``, and the lamp's end of the ray, which may move."""

    value: mi.Spectrum
    tau: list[mi.Float]
    end: mi.Point3f


@dataclass
class Stretch:
    """A stretch ahead of a path.

    Attributes:
        ray, medium: where it begins, and what surrounds its origin.
        beta: throughput to there.
        scatters: lanes whose path may turn once more.
        draw: random numbers for the media to turn it; None where none of them scatters.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    beta: mi.Spectrum
    scatters: mi.Bool
    draw: Any


Visit = Callable[..., Any]
"""``visit(state, body, t0, t1, active) -> state``: what to do with the stretch [t0, t1] of a ray in one medium."""


def reach(
    scene: mi.Scene,
    world: World,
    ray: mi.Ray3f,
    medium: mi.MediumPtr,
    visit: Visit,
    state: Any,
    active: mi.Bool,
    unveils: bool = False,
) -> tuple[Reach, Any]:
    """Carry a ray to the first opaque surface or to ``ray.maxt``, visiting each medium on the way.

    Media in boxes come after the others and in no order: a visitor must be a sum. A ray that ``unveils`` goes on straight
    through surfaces that let part of the light through undeviated, and says how much.

    Returns:
        Where the ray ends, and the last state.
    """
    if world.traces:
        end, state = _trace(scene, world, ray, medium, visit, state, active, unveils and world.is_veiled)
    else:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        si.wi, si.wavelengths, si.time = -ray.d, ray.wavelengths, ray.time
        end = Reach(si, mi.Float(ray.maxt), medium, 1.0)
    return end, visit_boxes(world, ray, end.t, visit, state, active)


def visit_boxes(world: World, ray: mi.Ray3f, t_end: mi.Float, visit: Visit, state: Any, active: mi.Bool) -> Any:
    """Visit the media in boxes between the ray's origin and ``t_end``."""
    for body in world.boxed:
        t0, t1 = mi.Float64(0), mi.Float64(t_end)
        if body.trims:
            _, _, t0, t1 = slab(body.rows, (0.0,) * 3, (1.0,) * 3, ray.o, ray.d, t0, t1)
        state = visit(state, body, t0, t1, active & (t1 > t0))
    return state


def revisit(scene: mi.Scene, world: World, way: Way, visit: Visit, state: Any, active: mi.Bool) -> Any:
    """Visit the media of a stretch whose end is known; only boundaries that have to be traced are traced again."""
    if not world.traced:
        return visit_boxes(world, way.ray, way.length, visit, state, active)
    return reach(scene, world, way.ray, way.medium, visit, state, active, way.unveils)[1]


@dr.syntax
def _trace(
    scene: mi.Scene,
    world: World,
    ray: mi.Ray3f,
    medium: mi.MediumPtr,
    visit: Visit,
    state: Any,
    active: mi.Bool,
    unveils: bool,
) -> tuple[Reach, Any]:
    """Trace through transparent surfaces to the first opaque one; visit the media whose boundary is traced."""
    # -- State ------------------------------------------------------------------------------------------------------------
    onward = mi.Ray3f(ray)  #                        the ray from the last boundary on
    medium = mi.MediumPtr(medium)  #                 what surrounds its origin
    t = mi.Float(0)  #                               distance of that origin
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    si.wi, si.wavelengths, si.time = -ray.d, ray.wavelengths, ray.time
    going = mi.Bool(active)
    veil = dr.full(mi.Spectrum, 1, dr.width(ray)) if unveils else 1.0

    while dr.hint(going, label="to the next opaque surface"):
        hit = scene.ray_intersect(onward, mi.RayFlags.All, False, going)
        found = going & hit.is_valid()
        t_hit = dr.select(found, dr.maximum(t, distance_along(ray, hit)), ray.maxt)

        # -- The medium on this side of the surface fills the stretch ---------------------------------------------------------
        transition = found & hit.is_medium_transition()
        medium = dr.select(transition, hit.target_medium(-ray.d), medium)
        state = _visit_traced(world, medium, visit, state, t, t_hit, going)

        # -- Go on through what is transparent ------------------------------------------------------------------------------
        clear = found & is_transparent(hit)
        if unveils:
            thin = found & ~clear & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Null) & (t_hit < ray.maxt * OWN_SURFACE)
            veil = dr.select(thin, veil * hit.bsdf().eval_null_transmission(hit, thin), veil)
            clear |= thin & dr.any(veil != 0)
        medium = dr.select(clear & transition, hit.target_medium(ray.d), medium)
        si = dr.select(going, hit, si)
        t = dr.select(going, t_hit, t)
        onward = spawn_ray(hit, ray.d, world.size)
        onward.maxt = ray.maxt - t_hit
        going &= clear
    return Reach(si, t, medium, veil), state


def distance_along(ray: mi.Ray3f, hit: mi.SurfaceInteraction3f) -> mi.Float:
    """Distance of a hit along the ray that began at the camera.

    Not the sum of the parts: each spawned ray starts an epsilon (1e-4 of a length) further on and to the side, so the hit
    lies beside the first ray. The plane of the surface is met by both; at grazing incidence, where that plane says little,
    the nearest point of the ray does.
    """
    slope = dr.dot(hit.n, ray.d)
    steep = dr.abs(slope) > 1e-2
    along = hit.p - ray.o
    return dr.select(steep, dr.dot(along, hit.n) / dr.select(steep, slope, 1), dr.dot(along, ray.d))


def _visit_traced(
    world: World, medium: mi.MediumPtr, visit: Visit, state: Any, t0: mi.Float, t1: mi.Float, active: mi.Bool
) -> Any:
    for body in world.traced:
        state = visit(state, body, t0, t1, active & (medium == mi.MediumPtr(body.view.medium)))
    return state


def is_transparent(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a surface is nothing but a boundary: a ``null`` BSDF and no emitter."""
    lobes = si.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.All))
    return (lobes == int(mi.BSDFFlags.Null)) & ~si.shape.is_emitter()


OWN_SURFACE = 1 - 1e-3
"""Share of the way to a lamp behind which a shadow ray meets the lamp's own surface (Mitsuba shortens its rays alike)."""

DARK = 30.0
"""Optical depth from which a shadow ray is dark: 1e-13 of a lamp's light is below the rounding of everything beside it."""


def add_optical_depth(ray: mi.Ray3f, enough: float | None = None) -> Visit:
    """The visitor that sums the optical depth of each channel along ``ray``; in a grid it may stop at ``enough``."""

    def visit(tau: list[mi.Float], body: Body, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [t + d for t, d in zip(tau, body.optical_depth(ray, t0, t1, len(tau), active, None, enough), strict=True)]

    return visit


def optical_depth_to(
    scene: mi.Scene, world: World, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool
) -> tuple[Reach, list[mi.Float]]:
    """Optical depth [1] of each channel to the first opaque surface or ``ray.maxt``, and where that is."""
    zero = [mi.Float(0) for _ in range(world.channels)]
    return reach(scene, world, ray, medium, add_optical_depth(ray), zero, active)


def light_through(
    scene: mi.Scene, world: World, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool, dice: mi.UInt32 | None = None
) -> tuple[Reach, list[mi.Float] | None, mi.Spectrum]:
    """Where a ray of light ends, its optical depth for each channel, and the share of it that gets there.

    It passes veils. Optical depth is summed no further than to ``DARK`` in a grid. With ``dice`` the share is an unbiased
    estimate where blocks of grids are known (:mod:`mivol.transport.tracking`), and the optical depth is not told.
    """
    if dice is not None and world.is_tracked:
        start = ([mi.Float(1) for _ in range(world.channels)], dice)
        end, (T, _) = reach(scene, world, ray, medium, _dim(ray), start, active, unveils=True)
        return end, None, mi.Spectrum(*T) * end.veil if len(T) == 3 else mi.Spectrum(T[0]) * end.veil
    zero = [mi.Float(0) for _ in range(world.channels)]
    end, tau = reach(scene, world, ray, medium, add_optical_depth(ray, DARK), zero, active, unveils=True)
    return end, tau, transmittance(tau) * end.veil


def _dim(ray: mi.Ray3f) -> Visit:
    """The visitor that multiplies transmittances along ``ray``, estimated where blocks are known."""

    def visit(state: tuple, body: Body, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> tuple:
        T, dice = state
        own, dice = body.transmittance(ray, t0, t1, len(T), active, dice, DARK)
        return [a * b for a, b in zip(T, own, strict=True)], dice

    return visit


def transmittance(tau: list[mi.Float]) -> mi.Spectrum:
    """exp(-tau) of each channel."""
    return mi.Spectrum(*(dr.exp(-t) for t in tau)) if len(tau) == 3 else mi.Spectrum(dr.exp(-tau[0]))


@dataclass
class Path:
    """The state of a path.

    ``beta`` is the throughput so far, without the stretch ahead; ``pdf`` and ``delta`` tell how its direction was
    sampled at ``last`` (for the power heuristic). For the film's alpha: ``stopped`` tells whether a surface stopped or turned
    the path, ``clear`` how much of each channel the media let through up to there.
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
    scene: mi.Scene,
    world: World,
    settings: Settings,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    score: Any,
    active: mi.Bool = True,
    strata: Strata | None = None,
) -> tuple[Any, mi.Float]:
    """Walk a path from the camera and give what it carries to a score.

    Args:
        scene: Mitsuba's scene: surfaces and emitters.
        world: its media.
        settings: depth, roulette, hidden emitters.
        sampler: three 2D and two 1D numbers a surface, three 2D and four 1D ones a stretch through media that scatter.
        ray: world space, unit direction.
        score: :mod:`mivol.transport.score`.
        active: lanes to walk.
        strata: parts of the square that directions at media are drawn from.

    Returns:
        The score, and what the film's alpha sees, in [0, 1].

    Bias: none. Variance: none at depth 1 beyond the pixel's own; emitter and BSDF sampling at surfaces.
    """
    limit = settings.max_depth if settings.max_depth >= 0 else 0xFFFFFFFF
    visible = not settings.hide_emitters and scene.environment() is not None
    n = dr.width(ray)
    path = Path(
        ray=camera_ray(ray),
        medium=world.medium_at(scene, ray),
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
    if is_straight(world, settings):
        path, end = _see(scene, world, settings, limit, path)
        return path.score, _alpha(path.stopped | (path.active & end.si.is_valid()), path.clear)
    (path,) = dr.while_loop(
        state=(path,),
        cond=lambda p: p.active,
        body=lambda p: (_bounce(scene, world, settings, limit, *_see(scene, world, settings, limit, p)),),
        label="path",
    )
    return path.score, _alpha(path.stopped, path.clear)


def _alpha(stopped: mi.Bool, clear: mi.Spectrum) -> mi.Float:
    """What a film's alpha sees of a path: all of it where a surface stopped it, else the opacity of the media.

    This is the mean of what ``volpath`` draws from ``max_depth`` 2 on (1 where it finds a point in a medium or on a surface),
    without its noise. At depth 1 ``volpath`` finds no points in media, and its smoke has no alpha; here it has the same one.
    """
    return dr.select(stopped, 1, 1 - sum(clear[c] for c in range(dr.size_v(clear))) / dr.size_v(clear))


def camera_ray(ray: mi.Ray3f) -> mi.Ray3f:
    """A ray of a sensor, which ends where the sensor ends it: at its ``far_clip``; without an end where that is not finite."""
    end = dr.select(ray.maxt < dr.largest(mi.Float), ray.maxt, dr.inf)
    return mi.Ray3f(ray.o, ray.d, end, ray.time, ray.wavelengths)


def is_straight(world: World, settings: Settings) -> bool:
    """Whether paths have one stretch: nothing turns one that no surface meets, nor one of depth 1 that no surface lets pass."""
    return not world.has_surfaces or (settings.max_depth in (0, 1) and not world.is_veiled)


def _see(scene: mi.Scene, world: World, settings: Settings, limit: int, path: Path) -> tuple[Path, Reach]:
    """Go to the next opaque surface and add the emission found there; media that scatter shine on the way."""
    scatters = path.active & (path.depth + 1 < limit)
    draw = world.lights.draw(path.sampler, scatters, path.strata) if world.lights is not None else None
    # A copy: the throughput is dimmed in place below, and a score may look at the stretch again after that.
    stretch = Stretch(path.ray, path.medium, mi.Spectrum(path.beta), scatters, draw)
    end, tau, path.score = path.score.stretch(scene, world, stretch, path.active)
    T = transmittance(tau)
    path.beta *= T
    path.clear *= T
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
    return path, end


def _bounce(scene: mi.Scene, world: World, settings: Settings, limit: int, path: Path, end: Reach) -> Path:
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
    way, clear, tau, light = shadow_ray(scene, world, start, shadow_medium, direct, lit)
    lit &= clear
    _, pdf_bsdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direct.d), lit)
    w_mis = dr.select(direct.delta, 1, power_heuristic(direct.pdf, pdf_bsdf))
    dim = path.beta * light * w_mis
    with dr.resume_grad(when=score.attached):
        moved = follow_lamp(direct.emitter, si, u, direct, lit) if score.attached else direct
        f = bsdf.eval(mi.BSDFContext(), si, si.to_local(moved.d), lit)
        source = scene.eval_emitter_direction(si, moved, lit) / direct.pdf if score.attached else weight
        carried = dim * f * dr.select(direct.pdf > 0, source, 0)
    score = score.shadow(scene, world, way, Dimmed(carried, tau, moved.p), lit)

    # -- The direction the path takes -----------------------------------------------------------------------------------------
    u1, u2 = sampler.next_1d(on_surface), sampler.next_2d(on_surface)
    sample, f_over_pdf = bsdf.sample(mi.BSDFContext(), si, u1, u2, on_surface)
    through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    # A direction of density 0 has the weight 0, and its path ends below.
    path.stopped |= on_surface & ~through
    on = on_surface & (may_scatter | through)
    score = score.turn(bsdf, si, sample.wo, on & ~through)
    path.beta *= dr.select(on, f_over_pdf, 0)
    path.eta *= dr.select(on, sample.eta, 1)
    rest = path.ray.maxt - end.t
    path.ray = spawn_ray(si, si.to_world(sample.wo), world.size)
    # A ray that goes straight on ends where it was to end.
    path.ray.maxt = dr.select(through, dr.minimum(rest, path.ray.maxt), path.ray.maxt)
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


def follow_lamp(
    emitter: mi.EmitterPtr, it: mi.Interaction3f, u: mi.Point2f, direct: mi.DirectionSample3f, active: mi.Bool
) -> mi.DirectionSample3f:
    """The direction of a lamp of one position or direction, with the derivative of its place."""
    moved, _ = emitter.sample_direction(it, u, active)
    if not dr.grad_enabled(moved.p):
        return direct
    moved.p = dr.select(direct.delta, moved.p, direct.p)
    moved.d = dr.select(direct.delta, moved.d, direct.d)
    moved.dist = dr.select(direct.delta, moved.dist, direct.dist)
    moved.n, moved.uv, moved.pdf, moved.emitter = direct.n, direct.uv, direct.pdf, direct.emitter
    return moved


def shadow_ray(
    scene: mi.Scene,
    world: World,
    start: mi.Point3f,
    medium: mi.MediumPtr,
    direct: mi.DirectionSample3f,
    active: mi.Bool,
    dice: mi.UInt32 | None = None,
) -> tuple[Way, mi.Bool, list[mi.Float] | None, mi.Spectrum]:
    """Go from a point to a point of a lamp; ``dice`` as in :func:`light_through`.

    Returns:
        The way, whether no opaque surface stands in it, its optical depth for each channel, and the share of the light that
        media and veils let through.
    """
    length = dr.norm(direct.p - start)
    ray = mi.Ray3f(start, dr.normalize(direct.p - start), length, direct.time, mi.Color0f())
    stop, tau, light = light_through(scene, world, ray, medium, active, dice)
    clear = ~(stop.si.is_valid() & (stop.t < length * OWN_SURFACE))
    return Way(ray, medium, length, True), clear, tau, light


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample of density ``a`` beside ``b``, exponent 2 (Veach 1997, Eq. 9.13)."""
    # As a ratio: a^2 overflows float32 for a > 1.8e19.
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)
