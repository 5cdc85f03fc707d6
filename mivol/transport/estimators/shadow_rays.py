"""Light along a shadow ray: what media and surfaces that transmit light undeviated let through.

The transmittance is exact, or an unbiased estimate where the blocks of grids are known
(:mod:`mivol.transport.estimators.ratio_tracking`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body
from mivol.transport.media.ray_intervals import (
    OWN_SURFACE,
    MediumVisitor,
    RaySegment,
    SegmentEnd,
    sum_optical_depth,
    transmittance,
    visit_media,
)
from mivol.transport.media.scene_media import World

__all__ = ["DARK", "ShadowedLight", "light_through", "shadow_ray"]


@dataclass
class ShadowedLight:
    """Light that a shadow ray carried: its value, already dimmed by ``tau``, and the lamp's end of the ray, which may move."""

    value: mi.Spectrum
    tau: list[mi.Float]
    end: mi.Point3f


DARK = 30.0
"""Optical depth from which a shadow ray is dark: 1e-13 of a lamp's light is below the rounding of everything beside it."""


def light_through(
    scene: mi.Scene, world: World, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool, rng: mi.UInt32 | None = None
) -> tuple[SegmentEnd, list[mi.Float] | None, mi.Spectrum]:
    """Where a ray of light ends, its optical depth for each channel, and the share of it that gets there.

    It passes veils. Optical depth is summed no further than to ``DARK`` in a grid. With ``rng`` the share is an unbiased
    estimate where blocks of grids are known (:mod:`mivol.transport.estimators.ratio_tracking`), and the optical depth is None.
    """
    if rng is not None and world.is_tracked:
        start = ([mi.Float(1) for _ in range(world.channels)], rng)
        end, (T, _) = visit_media(scene, world, ray, medium, _dim(ray), start, active, passes_null=True)
        return end, None, mi.Spectrum(*T) * end.null_transmission if len(T) == 3 else mi.Spectrum(T[0]) * end.null_transmission
    zero = [mi.Float(0) for _ in range(world.channels)]
    end, tau = visit_media(scene, world, ray, medium, sum_optical_depth(ray, DARK), zero, active, passes_null=True)
    return end, tau, transmittance(tau) * end.null_transmission


def _dim(ray: mi.Ray3f) -> MediumVisitor:
    """The visitor that multiplies transmittances along ``ray``, estimated where blocks are known."""

    def visit(state: tuple, body: Body, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> tuple:
        T, rng = state
        own, rng = body.transmittance(ray, t0, t1, len(T), active, rng, DARK)
        return [a * b for a, b in zip(T, own, strict=True)], rng

    return visit


def shadow_ray(
    scene: mi.Scene,
    world: World,
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
    length = dr.norm(direct.p - start)
    ray = mi.Ray3f(start, dr.normalize(direct.p - start), length, direct.time, mi.Color0f())
    stop, tau, light = light_through(scene, world, ray, medium, active, rng)
    clear = ~(stop.si.is_valid() & (stop.t < length * OWN_SURFACE))
    return RaySegment(ray, medium, length, True), clear, tau, light
