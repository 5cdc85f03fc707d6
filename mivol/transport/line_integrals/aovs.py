r"""Arbitrary output variables (AOVs) of a camera ray: optical depth, opacity, and expected depth.

.. math:: \tau = \int \sigma\,dt, \qquad \alpha = 1 - e^{-\tau}, \qquad
          \bar t = \frac{1}{\alpha} \Big( \int t\,\sigma T\,dt + t_s T_s \Big)

Conventions. AOVs belong to the first segment of a ray: from the camera to the first opaque surface (at t_s; alpha is 1 there),
or out of the scene. Optical depth is returned as it was integrated, and not as -log T, which is infinite where T underflows.
``tau`` and ``alpha`` are means over the channels of the extinction, and so are numerator and denominator of ``depth``, which is
0 where nothing stops the ray; ``tau.R`` is ``tau`` where the extinction is grey. Rays and surfaces carry no derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import one_minus_exp
from mivol.transport.line_integrals.expected_depth import integrate_expected_depth, jvp_expected_depth, vjp_expected_depth
from mivol.transport.media.optical_depth import integrate_optical_depth, jvp_rows, vjp_rows
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import Ray, camera_ray

__all__ = ["AOVS", "integrate_aovs", "jvp_aovs", "vjp_aovs"]


AOVS = ("tau", "tau.R", "tau.G", "tau.B", "alpha", "depth")
"""Names: optical depth [1] (mean, and of a channel), opacity [1], and expected depth [length]."""


@dataclass
class _FirstSegment:
    """The first segment of camera rays.

    Attributes:
        ray_segment, end: the ray, and where it ends.
        tau, T, alpha: optical depth, transmittance (0 behind a surface) and opacity [1], of each channel.
    """

    ray_segment: RaySegment
    end: SegmentEnd
    tau: list[mi.Float]
    T: list[mi.Float]
    alpha: list[mi.Float]


def integrate_aovs(media: SceneMedia, ray: Ray, names: tuple[str, ...], active: mi.Bool = True) -> list[mi.Float]:
    """Integrate AOVs along camera rays.

    Args:
        media: of the scene.
        ray: world space, unit direction.
        names: of :data:`AOVS`.
        active: lanes to integrate.

    Returns:
        One number a ray for each name, in their order.

    Raises:
        MivolError: ``depth`` of a medium that sums grids of two resolutions or places.

    Cost: a walk of the first segment, and another one for ``depth``.
    """
    if not names:
        return []
    first = _find_first_segment(media, ray, active)
    rows = {"tau": first.tau, "alpha": first.alpha}
    values = {"depth": _depth(media, first, active)[0]} if "depth" in names else {}
    return [values[n] if n in values else _weigh(_channel_weights(n, media.channels), rows[_row(n)]) for n in names]


def jvp_aovs(media: SceneMedia, ray: Ray, names: tuple[str, ...], active: mi.Bool = True) -> list[mi.Float]:
    """Tangents of AOVs, from the parameters' tangents that :meth:`SceneMedia.start_tangent` took.

    Args:
        media, ray, names, active: as :func:`integrate_aovs`.
    """
    if not names:
        return []
    first = _find_first_segment(media, ray, active)
    rows, values = {}, {}
    if set(names) != {"depth"}:
        rows["tau"] = jvp_rows(media, first.ray_segment, active)
        rows["alpha"] = [T * d for T, d in zip(first.T, rows["tau"], strict=True)]
    if "depth" in names:
        depth, opacity = _depth(media, first, active)
        dN = jvp_expected_depth(media, first.ray_segment, first.end, depth, active)
        values["depth"] = dN * _inverse(opacity)
    return [values[n] if n in values else _weigh(_channel_weights(n, media.channels), rows[_row(n)]) for n in names]


def vjp_aovs(media: SceneMedia, ray: Ray, names: tuple[str, ...], daovs: list[mi.Float], active: mi.Bool = True) -> None:
    """Add the derivatives of AOVs, weighted by ``daovs``, to the gradients of the media.

    Args:
        media, ray, names, active: as :func:`integrate_aovs`.
        daovs: d loss / d AOV of each ray, in the order of ``names``.
    """
    if not names:
        return
    first = _find_first_segment(media, ray, active)
    weight = [mi.Float(0) for _ in range(media.channels)]
    for name, d in zip(names, daovs, strict=True):
        if name != "depth":
            slopes = first.T if _row(name) == "alpha" else [1] * media.channels
            weight = [w + d * s * T for w, s, T in zip(weight, _channel_weights(name, media.channels), slopes, strict=True)]
    if set(names) != {"depth"}:
        vjp_rows(media, first.ray_segment, weight, active)
    for name, d in zip(names, daovs, strict=True):
        if name == "depth":
            depth, opacity = _depth(media, first, active)
            vjp_expected_depth(media, first.ray_segment, first.end, depth, d * _inverse(opacity), active)


def _find_first_segment(media: SceneMedia, ray: Ray, active: mi.Bool) -> _FirstSegment:
    """Follow rays to the first opaque surface or out of the scene."""
    ray = camera_ray(ray)
    medium = media.medium_at(ray)
    end, tau = integrate_optical_depth(media, ray, medium, mi.Bool(active))
    stopped = end.si.is_valid()
    T = [dr.select(stopped, 0, dr.exp(-t)) for t in tau]
    alpha = [dr.select(stopped, 1, one_minus_exp(t)) for t in tau]
    return _FirstSegment(RaySegment(ray, medium, end.t), end, tau, T, alpha)


def _depth(media: SceneMedia, first: _FirstSegment, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """The expected depth, and the opacity that it is divided by."""
    N, opacity = integrate_expected_depth(media, first.ray_segment, first.end, mi.Bool(active))
    some = opacity > 0
    return dr.select(some, N / dr.select(some, opacity, 1), 0), opacity


def _row(name: str) -> str:
    return name.partition(".")[0]


def _channel_weights(name: str, channels: int) -> list[float]:
    """The weight of each channel in an AOV: that of a mean, or of one channel alone."""
    channel = name.partition(".")[2]
    if not channel:
        return [1 / channels] * channels
    return [float(c == "RGB".index(channel) % channels) for c in range(channels)]


def _weigh(weights: list[float], rows: list[mi.Float]) -> mi.Float:
    return sum((s * row for s, row in zip(weights, rows, strict=True) if s), mi.Float(0))


def _inverse(alpha: mi.Float) -> mi.Float:
    """1 / alpha; 0 where nothing stops the ray, whose depth is 0 by definition. 1 / 1e-37 is still finite in float32."""
    some = alpha > 1e-37
    return dr.select(some, dr.rcp(dr.select(some, alpha, 1)), 0)
