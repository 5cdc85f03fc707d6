"""The optical depth of the media along a ray, with its tangent and its transpose.

Conventions. Rows are one number for each channel of the scene's extinction; spectra have one for each colour.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.media.channels import by_channel, spectrum
from mivol.transport.media.ray_intervals import (
    MediumInterval,
    MediumVisitor,
    RaySegment,
    SegmentEnd,
    revisit_media,
    visit_media,
)
from mivol.transport.media.scene_media import SceneMedia

__all__ = [
    "integrate_optical_depth",
    "jvp_optical_depth",
    "jvp_rows",
    "sum_optical_depth",
    "transmittance",
    "vjp_optical_depth",
    "vjp_rows",
]


def sum_optical_depth(ray: mi.Ray3f, enough: float | None = None) -> MediumVisitor:
    """The visitor that sums the optical depth of each channel along ``ray``.

    Args:
        ray: world space, unit direction.
        enough: a walk of a grid may stop where the grid's own optical depth exceeds this in every channel; None to walk to the
            end.
    """

    def visit(tau: list[mi.Float], interval: MediumInterval) -> list[mi.Float]:
        own = interval.body.optical_depth(ray, interval.t0, interval.t1, len(tau), interval.active, None, enough)
        return [t + d for t, d in zip(tau, own, strict=True)]

    return visit


def integrate_optical_depth(
    media: SceneMedia, ray: mi.Ray3f, medium: mi.MediumPtr, active: mi.Bool
) -> tuple[SegmentEnd, list[mi.Float]]:
    """Integrate the optical depth [1] of each channel to the first opaque surface or to ``ray.maxt``.

    Returns:
        Where the ray ends, and the optical depth to there.
    """
    zero = [mi.Float(0) for _ in range(media.channels)]
    return visit_media(media, ray, medium, sum_optical_depth(ray), zero, active)


def transmittance(tau: list[mi.Float]) -> mi.Spectrum:
    """exp(-tau) of each channel."""
    return mi.Spectrum(*(dr.exp(-t) for t in tau)) if len(tau) == 3 else mi.Spectrum(dr.exp(-tau[0]))


def vjp_optical_depth(media: SceneMedia, segment: RaySegment, weight: mi.Spectrum, active: mi.Bool) -> None:
    """Add the derivatives of the optical depth of a segment, times ``weight``, to the gradients of its media.

    Args:
        media: of the scene.
        segment: the ray, which has been walked before.
        weight: d loss / d tau of each colour.
        active: lanes that add; lanes of weight 0 are left out.

    Cost: one walk of each medium, with one packed write of 8 a cell and channel.
    """
    vjp_rows(media, segment, by_channel(weight, media.channels), active & dr.any(weight != 0))


def vjp_rows(media: SceneMedia, segment: RaySegment, weight: list[mi.Float], active: mi.Bool) -> None:
    """As :func:`vjp_optical_depth`, ``weight`` one number for each channel."""

    def visit(state: mi.Float, interval: MediumInterval) -> mi.Float:
        interval.body.backproject(segment.ray, interval.t0, interval.t1, weight, interval.active)
        return state

    revisit_media(media, segment, visit, mi.Float(0), active)


def jvp_optical_depth(media: SceneMedia, segment: RaySegment, active: mi.Bool) -> mi.Spectrum:
    """Tangent of the optical depth of a segment, from the parameters' tangents that :meth:`SceneMedia.start_tangent` took."""
    return spectrum(jvp_rows(media, segment, active))


def jvp_rows(media: SceneMedia, segment: RaySegment, active: mi.Bool) -> list[mi.Float]:
    """As :func:`jvp_optical_depth`, one number for each channel."""

    def visit(tau: list[mi.Float], interval: MediumInterval) -> list[mi.Float]:
        own = interval.body.tangent(segment.ray, interval.t0, interval.t1, len(tau), interval.active)
        return [t + d for t, d in zip(tau, own, strict=True)]

    return revisit_media(media, segment, visit, [mi.Float(0) for _ in range(media.channels)], active)
