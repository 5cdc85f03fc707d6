r"""The media along a ray: the interval of each medium, a random point in them, and the surface at the end of the ray.

A ray is followed to the first opaque surface, and each medium on the way is visited with its interval [t0, t1]. Intervals of
media in boxes and balls are found in closed form, in float64; the intervals behind other boundaries are traced. Media are
disjoint, so the middles of their intervals order them.

Dr.Jit records a loop by calling its body once. A loop over boundaries is a recorded loop of unknown length, so
:func:`visit_media` takes the function for an interval as an argument; for media in boxes the function is called from a Python
loop.

Conventions. Distances are world lengths from the origin of the ray of the segment, and not from the last boundary, so entry
points keep their digits.

A uniform point estimates the derivative of the optical depth of a bounded extinction,

.. math:: \partial \tau = \int \partial \sigma\,dt = E[\ell\; \partial \sigma(t)], \qquad t \sim \mathrm{uniform}

with the length l of all intervals of the segment in the box of the field. A segment may leave a boundary and enter it again. A
reservoir keeps an interval with a probability proportional to its length, and reuses the single random number of the segment.

References: Chao 1982 (weighted reservoir sampling).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import UNIT_CUBE, clip_to_box
from mivol.transport.traversal.rays import FineRay, Ray, hit_distance, spawn_ray, to_mitsuba_ray

__all__ = [
    "OWN_SURFACE",
    "MediumInterval",
    "PointReservoir",
    "RaySegment",
    "SegmentEnd",
    "UniformPoint",
    "add_passage",
    "bounded_parts",
    "draw_uniform_point",
    "find_boxed_intervals",
    "find_end",
    "is_transparent",
    "offer_interval",
    "offer_medium_interval",
    "revisit_media",
    "start_passages",
    "start_reservoirs",
    "trace_boundaries",
    "visit_media",
]


@dataclass
class SegmentEnd:
    """The end of a segment: at an opaque surface (``si`` valid), or at ``ray.maxt``.

    Attributes:
        si: the surface.
        t: length of the segment [length].
        medium: the medium around the end.
        null_transmission: fraction of the light that surfaces on the way transmit undeviated.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    null_transmission: mi.Spectrum | float


@dataclass
class RaySegment:
    """A segment of known length.

    Attributes:
        ray: world space, unit direction.
        medium: the medium around the origin.
        length: length of the segment [length].
        passes_null: whether the ray passes surfaces that transmit part of the light undeviated.
        u: number in [0, 1) that draws the points for derivatives of bounded media; None if all optical depths are exact.
        passages: length of the segment in each of ``media.traced`` [length], if all media are homogeneous. Optical depths then
            follow without tracing the boundaries again. None if these lengths are not known.
    """

    ray: Ray
    medium: mi.MediumPtr
    length: mi.Float | mi.Float64
    passes_null: bool = False
    u: mi.Float | None = None
    passages: list[mi.Float] | None = None

    @classmethod
    def upto(cls, ray: Ray, medium: mi.MediumPtr, t: mi.Float64, passages: list[mi.Float] | None = None) -> RaySegment:
        """The first part of a ray, of length ``t``."""
        return cls(replace(FineRay.from_ray(ray), maxt=mi.Float(t)), medium, t, passages=passages)


def start_passages(media: SceneMedia, width: int) -> list[mi.Float] | None:
    """Lengths of 0 in each of ``media.traced``; None unless all media are homogeneous."""
    return [dr.zeros(mi.Float, width) for _ in media.traced] if media.is_homogeneous else None


def add_passage(
    media: SceneMedia, passages: list[mi.Float] | None, interval: MediumInterval, end: mi.Float64 | float = dr.inf
) -> list[mi.Float] | None:
    """Add an interval, up to the distance ``end`` on its ray, to the lengths in its medium."""
    if passages is None or interval.body.box is not None:
        return passages
    stop = dr.minimum(mi.Float64(interval.t1), end)
    length = dr.select(interval.active & (stop > interval.t0), mi.Float(stop - interval.t0), 0)
    pairs = zip(media.traced, passages, strict=True)
    return [total + length if body is interval.body else total for body, total in pairs]


@dataclass
class MediumInterval(RayInterval):
    """The interval of a ray in a medium.

    If the boundary is a box around all grids of the medium, the boxes of the grids suffice, and the interval covers the whole
    ray.

    Attributes:
        body: the medium in its boundary.
    """

    body: Body

    def middle(self) -> mi.Float64:
        """Distance of the middle of the interval inside the boundary [length], which orders disjoint media."""
        t0, t1 = self.inside()
        return 0.5 * (t0 + t1)

    def inside(self) -> tuple[mi.Float64, mi.Float64]:
        """The interval inside the boundary [length]; the end is not behind the start if the ray misses the boundary."""
        t0, t1 = mi.Float64(self.t0), mi.Float64(self.t1)
        if self.body.box is not None and not self.body.cuts_grids:
            t0, t1 = self.body.clip(self.ray, t0, t1)
        return t0, t1


def visit_media(
    media: SceneMedia,
    ray: Ray,
    medium: mi.MediumPtr,
    visit: Callable[[Any, MediumInterval], Any],
    state: Any,
    active: mi.Bool,
    passes_null: bool = False,
    reach: Callable[[Any], mi.Float64] | None = None,
) -> tuple[SegmentEnd, Any]:
    """Follow a ray to the first opaque surface or to ``ray.maxt``, and visit each medium on the way.

    Media behind traced boundaries are visited in the order of the ray. Media in boxes are visited in no order: before the
    tracing, if all media are homogeneous, since ``reach`` then shortens the traced ray at no cost; and after it, if there are
    grids to walk. With ``reach``, the medium that solid boundaries enclose is visited before the tracing too, without its
    end. So ``visit`` must compute a result that does not depend on the order, such as a sum.

    Args:
        media: media and surfaces of the scene.
        ray: world space, unit direction.
        medium: the medium around the origin of the ray.
        visit: ``visit(state, interval) -> state``.
        state: any PyTree of Dr.Jit arrays.
        active: lanes to follow.
        passes_null: whether the ray continues through surfaces that transmit part of the light undeviated (a shadow ray);
            ``null_transmission`` of the result is the transmitted fraction.
        reach: ``reach(state)``, the distance [length] beyond which the ray is of no use (behind a collision, in the dark). If
            the end lies behind it, surfaces behind it may be missing, and an end at a boundary of media is possible. None to
            follow all rays to their ends.

    Returns:
        The end of the ray, and the last state.
    """
    homogeneous = reach is not None and media.is_homogeneous
    knows_medium = homogeneous and media.has_solid_surfaces
    if homogeneous:
        for interval in find_boxed_intervals(media, ray, ray.maxt, active):
            state = visit(state, interval)
    if knows_medium:
        state = _visit_around(media.traced, RaySegment(ray, medium, ray.maxt), visit, state, active)
    trace = _visit_nothing if knows_medium else visit
    end, state = trace_boundaries(media, ray, medium, trace, state, active, passes_null, reach)
    if homogeneous:
        return end, state
    for interval in find_boxed_intervals(media, ray, end.t, active):
        state = visit(state, interval)
    return end, state


def _visit_around(
    traced: list[Body],
    segment: RaySegment,
    visit: Callable[[Any, MediumInterval], Any],
    state: Any,
    active: mi.Bool,
) -> Any:
    """Visit that of some traced media which lies around the origin of a segment inside of it."""
    for body in traced:
        on = active & (segment.medium == mi.MediumPtr(body.view.medium))
        state = visit(state, MediumInterval(segment.ray, mi.Float(0), segment.length, on, body))
    return state


def _visit_nothing(state: Any, interval: MediumInterval) -> Any:
    return state


def revisit_media(
    media: SceneMedia,
    segment: RaySegment,
    visit: Callable[[Any, MediumInterval], Any],
    state: Any,
    active: mi.Bool,
    anywhere: bool = False,
    among: list[Body] | None = None,
) -> Any:
    """Visit the media of a segment of known length; only boundaries that are no boxes and let rays pass are traced again.

    Args:
        media, visit, state, active: as in :func:`visit_media`.
        segment: the segment.
        anywhere: whether ``visit`` depends only on the length of an interval in a homogeneous medium, not on its place. With
            known ``passages``, no boundary is traced then.
        among: the media to visit; by default all. If they all fill boxes, no boundary is traced.
    """
    among = media.bodies if among is None else among
    traced = [body for body in media.traced if _holds(among, body)]
    if anywhere and segment.passages is not None:
        for body, length in zip(media.traced, segment.passages, strict=True):
            if _holds(among, body):
                state = visit(state, MediumInterval(segment.ray, mi.Float(0), length, active & (length > 0), body))
    elif traced and media.stops_rays:
        state = _visit_around(traced, segment, visit, state, active)
    elif traced:

        def visit_some(state: Any, interval: MediumInterval) -> Any:
            return visit(state, interval) if _holds(among, interval.body) else state

        return visit_media(media, segment.ray, segment.medium, visit_some, state, active, segment.passes_null)[1]
    for interval in find_boxed_intervals(media, segment.ray, segment.length, active, among):
        state = visit(state, interval)
    return state


def _holds(bodies: list[Body], body: Body) -> bool:
    return any(other is body for other in bodies)


def find_end(media: SceneMedia, ray: Ray, medium: mi.MediumPtr, active: mi.Bool) -> SegmentEnd:
    """Follow a ray to the first opaque surface or to ``ray.maxt``, without a visit to the media on the way."""
    return trace_boundaries(media, ray, medium, _visit_nothing, (), active, False)[0]


def find_boxed_intervals(
    media: SceneMedia, ray: Ray, t_end: mi.Float, active: mi.Bool, among: list[Body] | None = None
) -> list[MediumInterval]:
    """Find the intervals of the media in boxes between the origin of the ray and ``t_end``.

    Args:
        media: media of the scene.
        ray: world space, unit direction.
        t_end: end of the ray [length]; may be infinite.
        active: lanes to clip.
        among: as in :func:`revisit_media`.

    Returns:
        An interval for each of ``media.boxed``, in their order; two intervals for a medium with a hole, before and behind the
        hole.
    """
    intervals = []
    for body in media.boxed if among is None else (b for b in media.boxed if _holds(among, b)):
        t0, t1 = mi.Float64(0), mi.Float64(t_end)
        if body.cuts_grids:
            t0, t1 = body.clip(ray, t0, t1)
        ends = [(t0, t1)]
        if body.hole is not None:
            _, _, enter, leave = clip_to_box(body.hole_rows, *UNIT_CUBE, ray.o, ray.d, t0, t1)
            misses = leave <= enter
            ends = [(t0, dr.select(misses, t1, enter)), (dr.select(misses, t1, leave), t1)]
        intervals += [MediumInterval(ray, a, b, active & (b > a), body) for a, b in ends]
    return intervals


@dr.syntax
def trace_boundaries(
    media: SceneMedia,
    ray: Ray,
    medium: mi.MediumPtr,
    visit: Callable[[Any, MediumInterval], Any],
    state: Any,
    active: mi.Bool,
    passes_null: bool,
    reach: Callable[[Any], mi.Float64] | None = None,
) -> tuple[SegmentEnd, Any]:
    """Trace through transparent surfaces to the first opaque surface, and visit the media behind traced boundaries.

    Arguments and results are as of :func:`visit_media`. Without surfaces and traced boundaries the ray goes on to
    ``ray.maxt``.
    """
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    si.wi, si.wavelengths, si.time = -ray.d, ray.wavelengths, ray.time
    if dr.hint(not media.traces, mode="scalar"):
        state = _visit_around(media.traced, RaySegment(ray, medium, ray.maxt), visit, state, active)
        return SegmentEnd(si, mi.Float(ray.maxt), medium, 1.0), state
    is_shadow_ray = passes_null
    passes_null &= media.has_null_transmission

    # -- State ------------------------------------------------------------------------------------------------------------
    onward = to_mitsuba_ray(ray)  #                        the ray from the last boundary on
    medium = mi.MediumPtr(medium)  #                 what surrounds its origin
    t = mi.Float(0)  #                               distance of that origin
    going = mi.Bool(active)
    maxt = mi.Float(ray.maxt)
    if dr.hint(reach is not None, mode="scalar"):
        maxt = dr.minimum(maxt, mi.Float(reach(state)))
        going &= maxt > 0
    onward.maxt = maxt
    if dr.hint(media.surface_boxes is not None, mode="scalar"):
        # A packet of lanes without a surface ahead leaves out the loop.
        # A shadow ray ends at the surface of its emitter, which casts no shadow.
        meets = media.may_meet_surface(onward, maxt * OWN_SURFACE if is_shadow_ray else maxt)
        alone = going & ~meets
        for body in media.traced:
            state = visit(state, MediumInterval(ray, t, ray.maxt, alone & (medium == mi.MediumPtr(body.view.medium)), body))
        t = dr.select(alone, ray.maxt, t)
        going &= meets
    if dr.hint(media.has_solid_surfaces, mode="scalar"):
        hit, t_hit, medium, _ = _find_surface(media, ray, onward, medium, t, going)
        for body in media.traced:
            on = going & (medium == mi.MediumPtr(body.view.medium))
            state = visit(state, MediumInterval(ray, t, t_hit, on, body))
        return SegmentEnd(dr.select(going, hit, si), dr.select(going, t_hit, t), medium, 1.0), state
    null_transmission = dr.full(mi.Spectrum, 1, dr.width(ray)) if passes_null else 1.0

    while dr.hint(going, label="to the next opaque surface"):
        hit, t_hit, medium, transition = _find_surface(media, ray, onward, medium, t, going)
        is_hit = going & hit.is_valid()

        # -- The medium on this side of the surface fills the interval --------------------------------------------------------
        for body in media.traced:
            on = going & (medium == mi.MediumPtr(body.view.medium))
            state = visit(state, MediumInterval(ray, t, t_hit, on, body))

        # -- Go on through what is transparent ------------------------------------------------------------------------------
        clear = is_hit & is_transparent(hit)
        if passes_null:
            thin = is_hit & ~clear & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Null) & (t_hit < ray.maxt * OWN_SURFACE)
            null_transmission = dr.select(
                thin, null_transmission * hit.bsdf().eval_null_transmission(hit, thin), null_transmission
            )
            clear |= thin & dr.any(null_transmission != 0)
        medium = dr.select(clear & transition, hit.target_medium(ray.d), medium)
        si = dr.select(going, hit, si)
        t = dr.select(going, t_hit, t)
        onward = spawn_ray(hit, ray.d, media.size)
        onward.maxt = maxt - t_hit
        going &= clear
        if dr.hint(reach is not None, mode="scalar"):
            going &= mi.Float64(t_hit) < reach(state)
    return SegmentEnd(si, t, medium, null_transmission), state


def _find_surface(
    media: SceneMedia, ray: Ray, onward: mi.Ray3f, medium: mi.MediumPtr, t: mi.Float, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Float, mi.MediumPtr, mi.Bool]:
    """Find the next surface along ``onward``, which begins at the distance ``t`` on ``ray``.

    Returns:
        The surface, its distance on ``ray`` (``ray.maxt`` without a surface), the medium in front of the surface, and lanes in
        which the surface is the boundary of a medium.
    """
    hit = media.tracer.ray_intersect(onward, mi.RayFlags.All, False, active)
    is_hit = active & hit.is_valid()
    transition = is_hit & hit.is_medium_transition()
    medium = dr.select(transition, hit.target_medium(-ray.d), medium)
    return hit, dr.select(is_hit, dr.maximum(t, hit_distance(ray, hit)), ray.maxt), medium, transition


def is_transparent(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a surface is only a boundary: a ``null`` BSDF and no emitter."""
    components = si.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.All))
    return (components == int(mi.BSDFFlags.Null)) & ~si.shape.is_emitter()


OWN_SURFACE = 1 - 1e-3
"""Fraction of the length of a shadow ray beyond which a hit is the surface of the emitter (Mitsuba shortens its rays alike)."""


# -- Uniform points ----------------------------------------------------------------------------------------------------


@dataclass
class PointReservoir:
    """A reservoir that keeps an interval of several.

    Attributes:
        total: length of the intervals so far [length].
        begin, length: the kept interval.
        u: remainder of the random number, uniform in [0, 1).
    """

    total: mi.Float
    begin: mi.Float
    length: mi.Float
    u: mi.Float

    @property
    def t(self) -> mi.Float:
        """Distance of the point [length]."""
        return dr.fma(self.u, self.length, self.begin)


def bounded_parts(bodies: list[Body]) -> list[tuple[Body, BoundedExtinction]]:
    """The bounded extinctions of some media, in a fixed order."""
    return [(body, part) for body in bodies for part in body.view.parts if not part.exact_line]


def start_reservoirs(count: int, u: mi.Float | None, width: int) -> list[PointReservoir]:
    """Start a segment with ``count`` bounded extinctions.

    Raises:
        MivolError: ``count`` is not 0, and the segment has no random number.
    """
    if count and u is None:
        raise MivolError(
            "a segment through a bounded field has no random number; a drawn point estimates the derivative of its optical "
            "depth: give RaySegment.u."
        )
    zero = dr.zeros(mi.Float, width)
    return [PointReservoir(zero, zero, zero, mi.Float(u)) for _ in range(count)]


def offer_medium_interval(point: PointReservoir, part: BoundedExtinction, interval: RayInterval) -> PointReservoir:
    """Offer the part of an interval inside the box of a field to a reservoir."""
    return offer_interval(point, *part.clip(interval), interval.active)[0]


def offer_interval(point: PointReservoir, begin: mi.Float, end: mi.Float, on: mi.Bool) -> tuple[PointReservoir, mi.Bool]:
    """Offer the interval between two distances to a reservoir; also returns the lanes keeping the interval."""
    length = dr.select(on & (end > begin), end - begin, 0)
    total = point.total + length
    share = length / dr.select(total > 0, total, 1)
    keep = point.u < share
    # Given the outcome, the number is uniform in [0, share) or in [share, 1), and is stretched to [0, 1) again.
    u = dr.select(keep, point.u / dr.select(share > 0, share, 1), (point.u - share) / dr.select(share < 1, 1 - share, 1))
    kept = PointReservoir(total, dr.select(keep, begin, point.begin), dr.select(keep, length, point.length), u)
    return kept, keep & (length > 0)


ENDLESS = 1e30
"""Distance [length] from which a ray counts as endless: rays from a surface are as long as the largest float32, others
infinite.
"""


@dataclass
class UniformPoint:
    """A point of a segment, and the length of its intervals.

    Attributes:
        t: distance of the point on the ray [length].
        length: length of all intervals together [length]; a function times this length has the mean of its integral over them.
        body: index of the medium.
        on: lanes with a point.
    """

    t: mi.Float64
    length: mi.Float
    body: mi.UInt32
    on: mi.Bool


def draw_uniform_point(media: SceneMedia, passed: RaySegment, among: list[Body], u: mi.Float, active: mi.Bool) -> UniformPoint:
    """Draw a point uniformly from the intervals of a segment in some media.

    Args:
        media: media of the scene.
        passed: the segment, of known length.
        among: the media to draw from. Intervals without end count as empty.
        u: number in [0, 1).
        active: lanes to draw for.
    """
    width, bodies = dr.width(passed.ray), media.bodies

    def visit(state: tuple, interval: MediumInterval) -> tuple:
        point, index = state
        begin, end = interval.inside()
        on = interval.active & (end > begin) & (end < ENDLESS)
        point, kept = offer_interval(point, mi.Float(dr.select(on, begin, 0)), mi.Float(dr.select(on, end, 0)), on)
        number = next(k for k, body in enumerate(bodies) if body is interval.body)
        return point, dr.select(kept, mi.UInt32(number), index)

    zero = dr.zeros(mi.Float, width)
    start = (PointReservoir(zero, zero, zero, u + zero), dr.zeros(mi.UInt32, width))
    point, body = revisit_media(media, passed, visit, start, active, among=among)
    return UniformPoint(mi.Float64(point.t), point.total, body, active & (point.total > 0))
