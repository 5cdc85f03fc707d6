"""The optical depth of the media along a ray, with its tangent and the transpose.

Conventions. Rows have a number for each channel of the extinction of the scene; spectra have a number for each colour.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from mivol.numerics import minimum
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import ExactExtinction, Weight, colours_to_channels, to_spectrum
from mivol.transport.media.ray_intervals import (
    MediumInterval,
    PointReservoir,
    RaySegment,
    SegmentEnd,
    add_passage,
    bounded_parts,
    offer_medium_interval,
    revisit_media,
    start_passages,
    start_reservoirs,
    visit_media,
)
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import Ray

__all__ = [
    "integrate_optical_depth",
    "jvp_optical_depth",
    "jvp_rows",
    "segment_optical_depth",
    "transmittance",
    "vjp_optical_depth",
    "vjp_rows",
]


def integrate_optical_depth(
    media: SceneMedia,
    ray: Ray,
    medium: mi.MediumPtr,
    active: mi.Bool,
    enough: float | mi.Float | None = None,
    passes_null: bool = False,
) -> tuple[SegmentEnd, list[mi.Float], list[mi.Float] | None]:
    """Integrate the optical depth [1] of each channel to the first opaque surface or to ``ray.maxt``.

    Args:
        media: media and surfaces of the scene.
        ray: world space, unit direction.
        medium: the medium around the origin of the ray.
        active: lanes to follow.
        enough: the ray may stop where its optical depth exceeds this number in every channel; None to follow it to the end.
            If all media are homogeneous, the optical depth of boxes and balls ends at ``ray.maxt``.
        passes_null: as of :func:`.ray_intervals.visit_media`.

    Returns:
        The end of the ray, the optical depth to there, and the ``passages`` of a ``RaySegment``.
    """

    def add(state: tuple, interval: MediumInterval) -> tuple:
        tau, passages = state
        own = interval.body.optical_depth(interval, media.channels, None, enough)
        return [t + d for t, d in zip(tau, own, strict=True)], add_passage(media, passages, interval)

    def reach(state: tuple) -> mi.Float64:
        return mi.Float64(dr.select(minimum(state[0]) > enough, 0, dr.inf))

    width = dr.width(ray)
    start = [dr.zeros(mi.Float, width) for _ in range(media.channels)], start_passages(media, width)
    end, (tau, passages) = visit_media(media, ray, medium, add, start, active, passes_null, None if enough is None else reach)
    return end, tau, passages


def segment_optical_depth(
    media: SceneMedia,
    segment: RaySegment,
    active: mi.Bool,
    parts_of: Callable[[Body], list[ExactExtinction]] | None = None,
) -> list[mi.Float]:
    """Integrate the optical depth [1] of each channel over a segment of known length.

    ``parts_of`` chooses the parts of each medium, with known integrals along a ray; by default all parts.
    """

    def add(tau: list[mi.Float], interval: MediumInterval) -> list[mi.Float]:
        body = interval.body
        own = body.optical_depth(interval, media.channels, None if parts_of is None else parts_of(body))
        return [t + d for t, d in zip(tau, own, strict=True)]

    return revisit_media(media, segment, add, [mi.Float(0) for _ in range(media.channels)], active, anywhere=True)


def transmittance(tau: list[mi.Float]) -> mi.Spectrum:
    """exp(-tau) of each channel."""
    return mi.Spectrum(*(dr.exp(-t) for t in tau)) if len(tau) == 3 else mi.Spectrum(dr.exp(-tau[0]))


def vjp_optical_depth(media: SceneMedia, segment: RaySegment, weight: mi.Spectrum, active: mi.Bool) -> None:
    """Add the derivatives of the optical depth of a segment, times ``weight``, to the gradients of its media.

    Args:
        media: media of the scene.
        segment: the ray, of known length.
        weight: d loss / d tau of each colour.
        active: lanes to add; lanes of weight 0 are left out.

    Cost: a walk of each medium, with a packed write of 8 a cell and channel.
    """
    vjp_rows(media, segment, colours_to_channels(weight, media.channels), active & dr.any(weight != 0))


def vjp_rows(
    media: SceneMedia, segment: RaySegment, weight: list[mi.Float] | Callable[[Body], Weight], active: mi.Bool
) -> None:
    """Like :func:`vjp_optical_depth`, with a ``weight`` for each channel, or the weight of each medium by a function."""

    if not media.follows_extinction:
        return
    followed = [body for body in media.bodies if body.follows_extinction]
    bounded = bounded_parts(followed)

    def visit(points: list[PointReservoir], interval: MediumInterval) -> list[PointReservoir]:
        interval.body.vjp_optical_depth(interval, weight(interval.body) if callable(weight) else weight)
        return _pass(points, bounded, interval)

    start = start_reservoirs(len(bounded), segment.u, dr.width(segment.ray))
    points = revisit_media(media, segment, visit, start, active, True, followed)
    for (body, part), point in zip(bounded, points, strict=True):
        # After the walk: Dr.Jit loses what is differentiated in a loop with respect to an array that already has a gradient.
        rows = weight(body) if callable(weight) else weight
        on, each = active & (point.total > 0), [w * point.total for w in rows]
        body.vjp_extinction_at(segment.ray, point.t, each, on, part.name)


def jvp_optical_depth(media: SceneMedia, segment: RaySegment, active: mi.Bool) -> mi.Spectrum:
    """Tangent of the optical depth of a segment, from the tangents of :meth:`SceneMedia.start_tangent`."""
    return to_spectrum(jvp_rows(media, segment, active))


def jvp_rows(media: SceneMedia, segment: RaySegment, active: mi.Bool) -> list[mi.Float]:
    """Like :func:`jvp_optical_depth`, with a number for each channel."""

    followed = [body for body in media.bodies if body.has_tangents]
    bounded, zero = bounded_parts(followed), [mi.Float(0) for _ in range(media.channels)]

    def visit(state: tuple, interval: MediumInterval) -> tuple:
        tau, points = state
        own = interval.body.jvp_optical_depth(interval, len(tau))
        return [t + d for t, d in zip(tau, own, strict=True)], _pass(points, bounded, interval)

    start = (zero, start_reservoirs(len(bounded), segment.u, dr.width(segment.ray)))
    tau, points = revisit_media(media, segment, visit, start, active, True, followed)
    for (body, part), point in zip(bounded, points, strict=True):
        on = active & (point.total > 0)
        rows = body.jvp_extinction_at(segment.ray, point.t, media.channels, on, part.name)
        tau = [t + dr.select(on, point.total * row, 0) for t, row in zip(tau, rows, strict=True)]
    return tau


def _pass(points: list[PointReservoir], bounded: list[tuple], interval: MediumInterval) -> list[PointReservoir]:
    """Pass an interval of a medium with the points of all bounded parts."""
    return [
        offer_medium_interval(point, part, interval) if owner is interval.body else point
        for (owner, part), point in zip(bounded, points, strict=True)
    ]
