r"""Arbitrary output variables (AOVs) of a camera ray: optical depth, opacity and expected depth.

.. math:: \tau = \int \sigma\,dt, \qquad \alpha = 1 - e^{-\tau}, \qquad
          \bar t = \frac{1}{\alpha} \Big( \int t\,\sigma T\,dt + t_s T_s \Big)

Conventions. AOVs belong to the first segment of a ray: from the camera to the first opaque surface (at t_s; alpha is 1), or out
of the scene. Optical depth is the integral itself, not -log T, which is infinite after underflow of T. ``tau`` and ``alpha``
are means over the channels of the extinction, as are numerator and denominator of ``depth``. ``depth`` is 0 for a ray without
matter or surface. ``tau.R`` equals ``tau`` for a grey extinction. Rays and surfaces carry no derivatives.

Expected depth. The numerator N is the integral of t sigma T. In a cell [a, a + D] three Gauss points give the optical depth and
the first and second Legendre moments (slope B and bend G) of the extinction. The transmittance T = exp(-tau u) exp(B (u - u^2)
- G (2 u^3 - 3 u^2 + u)) is expanded, to second order in B and first order in G, about a cell of constant extinction with the
same optical depth:

.. math:: N_{cell} = a\,\alpha + \Delta \Big(\int_0^1 e^{-\tau(u)} du - e^{-\tau}\Big)
          = a\,\alpha + \Delta \Big(\tau E_1 + B (E_1 - E_2) + \frac{B^2}{2} (E_2 - 2 E_3 + E_4)
          - G (E_1 - 3 E_2 + 2 E_3)\Big)

with E_n(tau) from :mod:`mivol.numerics`. The formula is exact for a thin cell of any (cubic) extinction, and for a constant
extinction at any optical depth, so a region of constant extinction is one cell of any length. Otherwise the error falls as D^6.
Nothing is divided by a transmittance or an extinction, so derivatives are finite everywhere. Distances count from ``origin``:
with the expected depth as origin N is 0, so the derivative of the quotient N / alpha is the derivative of N over alpha.

References: Max 1995 (the integral, with distance as the source); Abramowitz & Stegun 25.4.30 (Gauss points).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.numerics import exp_moments, one_minus_exp
from mivol.transport.line_integrals.composite import composite_ray, vjp_composite
from mivol.transport.line_integrals.integrand import LineIntegral, RayPiece
from mivol.transport.media.compositing import CellIntegral
from mivol.transport.media.optical_depth import integrate_optical_depth, jvp_rows, vjp_rows
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import Ray, clip_camera_ray

__all__ = [
    "AOVS",
    "integrate_aovs",
    "jvp_aovs",
    "vjp_aovs",
    "integrate_distance_in_cell",
    "integrate_expected_depth",
    "jvp_expected_depth",
    "vjp_expected_depth",
]


AOVS = ("tau", "tau.R", "tau.G", "tau.B", "alpha", "depth")
"""Names: optical depth [1] (mean, and single channels), opacity [1], and expected depth [length]."""


@dataclass
class _FirstSegment:
    """The first segment of camera rays.

    Attributes:
        ray_segment, end: ray and its end.
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
        media: media of the scene.
        ray: world space, unit direction.
        names: names in :data:`AOVS`.
        active: lanes to integrate.

    Returns:
        One number a ray for each name, in the same order.

    Raises:
        MivolError: ``depth`` of a medium with grids of two resolutions or places.

    Cost: a walk of the first segment, and a second walk for ``depth``.
    """
    if not names:
        return []
    media = media.by_quadrature()
    first = _find_first_segment(media, ray, active)
    rows = {"tau": first.tau, "alpha": first.alpha}
    values = {"depth": _integrate_depth(media, first, active)[0]} if "depth" in names else {}
    return [values[n] if n in values else _weigh(_channel_weights(n, media.channels), rows[_row_name(n)]) for n in names]


def jvp_aovs(media: SceneMedia, ray: Ray, names: tuple[str, ...], active: mi.Bool = True) -> list[mi.Float]:
    """Tangents of AOVs, from the parameter tangents taken by :meth:`SceneMedia.start_tangent`.

    Args:
        media, ray, names, active: as :func:`integrate_aovs`.
    """
    if not names:
        return []
    media = media.by_quadrature()
    first = _find_first_segment(media, ray, active)
    rows, values = {}, {}
    if set(names) != {"depth"}:
        rows["tau"] = jvp_rows(media, first.ray_segment, active)
        rows["alpha"] = [T * d for T, d in zip(first.T, rows["tau"], strict=True)]
    if "depth" in names:
        depth, opacity = _integrate_depth(media, first, active)
        dN = jvp_expected_depth(media, first.ray_segment, first.end, depth, active)
        values["depth"] = dN * _safe_inverse(opacity)
    return [values[n] if n in values else _weigh(_channel_weights(n, media.channels), rows[_row_name(n)]) for n in names]


def vjp_aovs(media: SceneMedia, ray: Ray, names: tuple[str, ...], daovs: list[mi.Float], active: mi.Bool = True) -> None:
    """Add the derivatives of AOVs, weighted by ``daovs``, to the gradients of the media.

    Args:
        media, ray, names, active: as :func:`integrate_aovs`.
        daovs: d loss / d AOV of each ray, in the order of ``names``.
    """
    if not names:
        return
    media = media.by_quadrature()
    first = _find_first_segment(media, ray, active)
    weight = [mi.Float(0) for _ in range(media.channels)]
    for name, d in zip(names, daovs, strict=True):
        if name != "depth":
            slopes = first.T if _row_name(name) == "alpha" else [1] * media.channels
            weight = [w + d * s * T for w, s, T in zip(weight, _channel_weights(name, media.channels), slopes, strict=True)]
    if set(names) != {"depth"}:
        vjp_rows(media, first.ray_segment, weight, active)
    for name, d in zip(names, daovs, strict=True):
        if name == "depth":
            depth, opacity = _integrate_depth(media, first, active)
            vjp_expected_depth(media, first.ray_segment, first.end, depth, d * _safe_inverse(opacity), active)


def _find_first_segment(media: SceneMedia, ray: Ray, active: mi.Bool) -> _FirstSegment:
    """Follow rays to the first opaque surface or out of the scene."""
    ray = clip_camera_ray(ray)
    medium = media.medium_at(ray)
    end, tau, passages = integrate_optical_depth(media, ray, medium, mi.Bool(active))
    stopped = end.si.is_valid()
    T = [dr.select(stopped, 0, dr.exp(-t)) for t in tau]
    alpha = [dr.select(stopped, 1, one_minus_exp(t)) for t in tau]
    return _FirstSegment(RaySegment(ray, medium, end.t, passages=passages), end, tau, T, alpha)


def _integrate_depth(media: SceneMedia, first: _FirstSegment, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """The expected depth, and the opacity in its denominator."""
    N, opacity = integrate_expected_depth(media, first.ray_segment, first.end, mi.Bool(active))
    stopped = opacity > 0
    return dr.select(stopped, N / dr.select(stopped, opacity, 1), 0), opacity


def _row_name(name: str) -> str:
    return name.partition(".")[0]


def _channel_weights(name: str, channels: int) -> list[float]:
    """The weight of each channel in an AOV: equal weights, or 1 for a single channel."""
    channel = name.partition(".")[2]
    if not channel:
        return [1 / channels] * channels
    return [float(c == "RGB".index(channel) % channels) for c in range(channels)]


def _weigh(weights: list[float], rows: list[mi.Float]) -> mi.Float:
    return sum((s * row for s, row in zip(weights, rows, strict=True) if s), mi.Float(0))


def _safe_inverse(alpha: mi.Float) -> mi.Float:
    """1 / alpha; 0 for a ray of opacity 0, whose depth is 0 by definition. 1 / 1e-37 is still finite in float32."""
    stopped = alpha > 1e-37
    return dr.select(stopped, dr.rcp(dr.select(stopped, alpha, 1)), 0)


GAUSS_OFFSET = math.sqrt(15) / 10
"""Distance of the outer Gauss points from the middle of [0, 1]. With the weights 5/18, 8/18, 5/18 the rule is exact to degree
5."""

OPAQUE_DEPTH = 1000.0
"""Replaces an infinite optical depth: exp(-1000) is 0, and in float64 1000 + x - 1000 equals x to 1e-13."""


def integrate_distance_in_cell(a: mi.Float, dt: mi.Float, near: mi.Float, middle: mi.Float, far: mi.Float) -> CellIntegral:
    """Integrate t sigma T over a cell.

    Args:
        a: distance of the near end [length].
        dt: length of the cell [length], finite.
        near, middle, far: extinction [1/length] at the three Gauss points.

    Bias: none for a thin cell or a constant extinction; O(dt^7) for a smooth extinction; at most about the length of the cell,
    for
        an extinction that changes strongly within a cell of large optical depth.
    """
    sides = near + far
    tau = dt * dr.fma(sides, 5 / 18, middle * (8 / 18))
    slope = dt * (math.sqrt(15) / 6) * (far - near)
    bend = dt * (5 / 9) * dr.fma(middle, -2, sides)
    T = dr.exp(-tau)
    e0, e1, e2, e3, e4, e5 = exp_moments(tau)
    by_slope, by_bend = e1 - e2, -(e1 - 3 * e2 + 2 * e3)
    by_slope_squared = e2 - 2 * e3 + e4
    mean = tau * e1 + slope * (by_slope + 0.5 * slope * by_slope_squared) + bend * by_bend
    by_tau = T - e1 - slope * (e2 - e3 + 0.5 * slope * (e3 - 2 * e4 + e5)) + bend * (e2 - 3 * e3 + 2 * e4)
    by_slope += slope * by_slope_squared

    level = dt * dr.fma(a, T, dt * by_tau)
    tilt, curvature = dt * dt * (math.sqrt(15) / 6) * by_slope, dt * dt * (5 / 9) * by_bend
    dN = [level * (5 / 18) - tilt + curvature, level * (8 / 18) - 2 * curvature, level * (5 / 18) + tilt + curvature]
    return CellIntegral(tau, T, dr.fma(a, tau * e0, dt * mean), [dt * (5 / 18), dt * (8 / 18), dt * (5 / 18)], dN)


def _integrate_in_constant(piece: RayPiece, origin: mi.Float, sigma: mi.Float) -> CellIntegral:
    """Integrate over constant extinction of any length.

    For an infinite length N = a + 1/sigma. For extinction 0 the expected depth is undefined; N and the derivative are then 0.
    """
    begin = dr.select(piece.on, piece.a - origin, 0)
    finite = dr.isfinite(piece.dt)
    integral = integrate_distance_in_cell(begin, dr.select(finite, piece.dt, 0), sigma, sigma, sigma)
    endless = piece.on & ~finite & (sigma > 0)
    mean = dr.rcp(dr.select(endless, sigma, 1))
    return CellIntegral(
        dr.select(endless, OPAQUE_DEPTH, integral.tau),
        dr.select(endless, 0, integral.T),
        dr.select(endless, begin + mean, integral.N),
        [sum(integral.dtau, mi.Float(0))],
        [dr.select(endless, -dr.square(mean), sum(integral.dN, mi.Float(0)))],
    )


@dataclass
class _ExpectedDepthIntegrand:
    """The integrand of expected depth: distances counted from ``origin``, a row for each channel."""

    rows: int
    origin: mi.Float
    points: ClassVar[tuple[float, ...]] = (0.5 - GAUSS_OFFSET, 0.5, 0.5 + GAUSS_OFFSET)
    request: ClassVar[str] = "the AOV depth was asked for"
    alternative: ClassVar[str] = "leave depth out of aovs"

    def integrate_cell(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        return [integrate_distance_in_cell(piece.a - self.origin, piece.dt, *row) for row in sigma]

    def integrate_constant(self, piece: RayPiece, sigma: list[mi.Float]) -> list[CellIntegral]:
        return [_integrate_in_constant(piece, self.origin, s) for s in sigma]

    def vjp(self, piece: RayPiece, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        """Do nothing: N depends only on the extinction."""

    def jvp(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        return [mi.Float(0) for _ in range(self.rows)]

    def lower_bound(self, t1: mi.Float) -> mi.Float:
        return dr.minimum(t1 - self.origin, 0)

    def end(self, end: SegmentEnd) -> list[mi.Float]:
        """Contribution of the opaque surface at the end of a ray, not attenuated."""
        return [dr.select(end.si.is_valid(), end.t - self.origin, 0)] * self.rows


def integrate_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """Integrate the distance at which rays stop, mean over channels.

    Args:
        media: media of the scene.
        ray_segment: ray, medium around its origin, and length; world space, unit direction.
        end: end of the ray, possibly at an opaque surface.
        active: lanes to integrate.

    Returns:
        N [length], the expected depth times the opacity; and this opacity [1], from the optical depth of the same quadrature.
        For a radiance field it differs slightly from ``alpha``, since an activated extinction depends on the points of a cell.

    Raises:
        MivolError: a medium with grids of two resolutions or places.

    Bias: as :func:`integrate_distance_in_cell`. Cost: a walk of each body.
    """
    integrand = _ExpectedDepthIntegrand(media.channels, mi.Float(0))
    composite = composite_ray(LineIntegral(media, integrand, ray_segment, active), integrand.end(end), skip=True)
    alpha = [dr.select(end.si.is_valid(), 1, one_minus_exp(mi.Float(t))) for t in composite.tau]
    return _mean_rows(composite.N), _mean_rows(alpha)


def jvp_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, origin: mi.Float, active: mi.Bool
) -> mi.Float:
    """Tangent of N, with distances counted from ``origin``, from the tangents that the media took from the parameters.

    Args:
        media, ray_segment, end, active: as :func:`integrate_expected_depth`.
        origin: the expected depth; the result over the opacity is then its tangent.
    """
    integrand = _ExpectedDepthIntegrand(media.channels, origin)
    line = LineIntegral(media, integrand, ray_segment, active)
    return _mean_rows(composite_ray(line, integrand.end(end), tangent=True).N[media.channels :])


def vjp_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, origin: mi.Float, weight: mi.Float, active: mi.Bool
) -> None:
    """Add ``weight`` (d loss / d N) times the derivative of N to the gradients of the media: the transpose of the tangent.

    Args:
        media, ray_segment, end, active: as :func:`integrate_expected_depth`.
        origin: the expected depth, as in :func:`jvp_expected_depth`.
        weight: weight of each lane.

    Cost: two walks of each body, and one packed write of 8 a cell and channel.
    """
    k = media.channels
    integrand = _ExpectedDepthIntegrand(k, origin)
    line = LineIntegral(media, integrand, ray_segment, active)
    vjp_composite(line, composite_ray(line, integrand.end(end)), [weight / k] * k, [mi.Float(0)] * k)


def _mean_rows(rows: list[mi.Float]) -> mi.Float:
    return sum(rows[1:], rows[0]) / len(rows)
