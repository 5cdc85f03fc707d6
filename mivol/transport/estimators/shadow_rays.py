"""Light along a shadow ray: what media and surfaces that transmit light undeviated let through.

The transmittance is exact, or an unbiased estimate where the blocks of grids are known
(:mod:`mivol.transport.estimators.ratio_tracking`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.majorant_tracking import ratio_tracking
from mivol.transport.estimators.ratio_tracking import residual_ratio_tracking
from mivol.transport.media.body import Body
from mivol.transport.media.channels import as_rows, spectrum
from mivol.transport.media.optical_depth import sum_optical_depth, transmittance
from mivol.transport.media.ray_intervals import OWN_SURFACE, MediumVisitor, RaySegment, SegmentEnd, visit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.lattice import clip
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["DARK", "estimate_transmittance", "light_through", "shadow_ray"]


DARK = 30.0
"""Optical depth from which a shadow ray is dark: 1e-13 of a lamp's light is below the rounding of everything beside it."""


def light_through(
    media: SceneMedia, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool, rng: mi.UInt32 | None = None
) -> tuple[SegmentEnd, list[mi.Float] | None, mi.Spectrum]:
    """Where a ray of light ends, its optical depth for each channel, and the share of it that gets there.

    It passes veils. Optical depth is summed no further than to ``DARK`` in a grid. With ``rng`` the share is an unbiased
    estimate where blocks of grids are known (:mod:`mivol.transport.estimators.ratio_tracking`) or media are bounded, and the
    optical depth is None.
    """
    if rng is not None and (media.has_block_ranges or media.is_bounded):
        end, T = estimate_transmittance(media, ray, medium, active, rng, passes_null=True)
        return end, None, T * end.null_transmission
    zero = [mi.Float(0) for _ in range(media.channels)]
    end, tau = visit_media(media, ray, medium, sum_optical_depth(ray, DARK), zero, active, passes_null=True)
    return end, tau, transmittance(tau) * end.null_transmission


def estimate_transmittance(
    media: SceneMedia, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool, rng: mi.UInt32, passes_null: bool = False
) -> tuple[SegmentEnd, mi.Spectrum]:
    """Where a ray ends, and an unbiased estimate of the share of light that its media let through; ``rng`` draws it."""
    start = ([mi.Float(1) for _ in range(media.channels)], rng)
    end, (T, _) = visit_media(media, ray, medium, _dim(ray), start, active, passes_null)
    return end, spectrum(T)


def _dim(ray: mi.Ray3f) -> MediumVisitor:
    """The visitor that multiplies transmittances along ``ray``, estimated where blocks are known."""

    def visit(state: tuple, body: Body, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> tuple:
        T, rng = state
        own, rng = _estimate_transmittance(body, ray, t0, t1, len(T), active, rng)
        return [a * b for a, b in zip(T, own, strict=True)], rng

    return visit


def _estimate_transmittance(
    body: Body, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, channels: int, active: mi.Bool, rng: mi.UInt32
) -> tuple[list[mi.Float], mi.UInt32]:
    """Transmittance [1] of each channel of a body, and the state of the generator.

    Estimated in bounded parts and in grids whose blocks are known; exact in all else, which is walked to the optical depth
    ``DARK``.
    """
    tracked = [p for p in body.exact_parts if p.lattice is not None and p.lattice.block_ranges is not None]
    others = [p for p in body.exact_parts if not any(p is q for q in tracked)]
    T = [dr.exp(-t) for t in body.optical_depth(ray, t0, t1, channels, active, others, DARK)]
    scale = dr.detach(body.view.scale) * body.area(ray.d)
    for part in tracked:
        segment = clip(part.lattice, ray.o, ray.d, t0, t1)
        own, rng = residual_ratio_tracking(part.lattice, segment, scale, rng, active)
        T = [a * b for a, b in zip(T, as_rows(own, channels), strict=True)]
    for part in (p for p in body.view.parts if not p.exact_line):
        own, rng = ratio_tracking(part, scale, ray, t0, t1, rng, active)
        T = [a * b for a, b in zip(T, as_rows(own, channels), strict=True)]
    return T, rng


def shadow_ray(
    media: SceneMedia,
    start: mi.Point3f,
    medium: mi.MediumPtr,
    direct: mi.DirectionSample3f,
    active: mi.Bool,
    rng: mi.UInt32 | None = None,
) -> tuple[RaySegment, mi.Bool, list[mi.Float] | None, mi.Spectrum]:
    """Go from a point to a point of a lamp; ``rng`` as in :func:`light_through`.

    Returns:
        The way, whether no opaque surface stands in it, its optical depth for each channel, and the share of the light that
        media and veils let through.
    """
    u = None
    if rng is not None and media.is_bounded:
        rng, (u,) = draw_pcg32(rng, 1)
    length = dr.norm(direct.p - start)
    ray = mi.Ray3f(start, dr.normalize(direct.p - start), length, direct.time, mi.Color0f())
    stop, tau, light = light_through(media, ray, medium, active, rng)
    clear = ~(stop.si.is_valid() & (stop.t < length * OWN_SURFACE))
    return RaySegment(ray, medium, length, True, u), clear, tau, light
